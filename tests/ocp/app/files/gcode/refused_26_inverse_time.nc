(refused: line 4: no feed)
G21 G93
G1 X1 F10
X2
M2
