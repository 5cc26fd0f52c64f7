(refused: line 4: whole number)
G21
G1 X1 F100
G2 X11 Y0 I5 P1.5
M2
