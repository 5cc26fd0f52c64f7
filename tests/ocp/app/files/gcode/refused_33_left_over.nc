(refused: line 3: belongs to no code)
G21
G1 X10 F100 P3
M2
