(refused: line 3: O-words)
G21
o100 sub
G1 X1 F100
o100 endsub
M2
