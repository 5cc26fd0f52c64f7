(refused: line 3: X stands twice)
G21
G1 X10 X20 F100
M2
