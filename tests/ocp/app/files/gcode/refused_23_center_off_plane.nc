(refused: line 4: is not in the plane)
G21
G1 X1 F100
G2 X11 Y0 I5 K1
M2
