(refused: line 3: not a G-code number)
G21
G1 X1e-3 F100
M2
