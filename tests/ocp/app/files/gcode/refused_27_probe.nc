(refused: line 3: probing)
G21
G38.2 Z-10 F50
M2
