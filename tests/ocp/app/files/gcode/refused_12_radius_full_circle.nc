(refused: line 4: ends where it starts)
G21
G1 X1 F100
G2 X1 Y0 R8
M2
