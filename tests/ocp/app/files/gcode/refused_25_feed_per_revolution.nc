(refused: line 2: feed per revolution)
G95 G21
G1 X1 F.1
M2
