(refused: line 4: remove one)
G21
G1 X1 F100
G2 X11 Y0 I5 J0 R5
M2
