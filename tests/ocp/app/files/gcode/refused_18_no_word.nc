(refused: line 3: is not a G-code word)
G21
G1 X10Y F100
M2
