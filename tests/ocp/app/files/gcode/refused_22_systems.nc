(refused: line 5: a second coordinate system)
G21
G54 G0 X0 Y0
G1 X10 F100
G55
G1 X0
M2
