(refused: line 3: no word of G-code)
G21
G1 X10Y F100
M2
