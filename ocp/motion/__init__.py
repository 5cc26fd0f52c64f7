"""Motions of machines: tasks, inverse kinematics, problem builders, timing, search, and the function `plan`."""
