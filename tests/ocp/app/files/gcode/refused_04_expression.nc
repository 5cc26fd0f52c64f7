(refused: line 3: expressions)
G21
G1 X[1+2] F100
M2
