(refused: no word of it moves anything)
G21 G90
(nothing)
M2
