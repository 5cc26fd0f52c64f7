(refused: line 3: belongs to no word)
G21
G1 X10 F100 P3
M2
