(refused: line 4: splines)
G21
G0 X0 Y0
G5 I0 J3 P0 Q-3 X1 Y1
M2
