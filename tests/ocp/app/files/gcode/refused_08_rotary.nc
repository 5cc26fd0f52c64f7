(refused: line 4: A moves an axis)
G21
G0 X0 A0
G1 X1 A90 F100
M2
