(refused: line 4: needs P)
G21
G1 X1 F100
G4
M2
