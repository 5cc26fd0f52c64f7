(refused: line 5: home=)
G21
G0 X0 Y0
G1 X10 F100
G28
G1 X0
M2
