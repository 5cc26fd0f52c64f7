(refused: line 4: canned cycles)
G21
G0 X0 Y0 Z5
G81 X10 Y10 Z-5 R2 F100
G80
M2
