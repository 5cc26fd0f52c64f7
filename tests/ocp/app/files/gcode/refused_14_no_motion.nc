(refused: line 3: without a motion)
G21
X10 Y10
M2
