(refused: line 3: X is repeated)
G21
G1 X10 X20 F100
M2
