(refused: line 4: less than half the chord)
G21
G1 X1 F100
G2 X21 Y0 R8
M2
