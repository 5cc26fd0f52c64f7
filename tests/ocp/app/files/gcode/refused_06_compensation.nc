(refused: line 4: cutter compensation)
G21
G0 X0 Y0
G41 D1 X10
G1 X20 F100
M2
