(refused: line 3: parameters)
G21
G1 X#1 F100
M2
