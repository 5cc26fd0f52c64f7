(refused: line 3: not known)
G21
G77 X1
M2
