(refused: line 3: no number)
G21
G1 X1e-3 F100
M2
