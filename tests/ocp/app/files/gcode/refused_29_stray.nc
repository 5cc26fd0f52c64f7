(refused: line 3: R belongs to)
G21
G1 X10 R5 F100
M2
