(refused: line 4: m from the centre)
G21
G1 X1 F100
G2 X11 Y0 I4 J0
M2
