(refused: line 4: subroutines)
G21
G0 X0
M98 P1000
M30
