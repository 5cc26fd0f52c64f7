(refused: line 4: no feed)
G21
G0 X0
G1 X10
M2
