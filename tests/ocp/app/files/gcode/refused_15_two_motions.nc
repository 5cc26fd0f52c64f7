(refused: line 3: contradict)
G21
G0 G1 X10 F100
M2
