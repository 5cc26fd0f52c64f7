(refused: no line moves anything)
G21 G90
(nothing)
M2
