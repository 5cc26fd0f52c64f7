(refused: line 2: scaled)
G51 X2 Y2
G21
G1 X10 F100
M2
