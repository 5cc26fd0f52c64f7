(refused: line 3: comment)
G21
G1 X10 F100 (to the end
M2
