(refused: line 4: no centre)
G21
G1 X1 F100
G2 X10 Y10
M2
