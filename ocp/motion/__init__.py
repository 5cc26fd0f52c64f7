"""Motions of machines: tasks, inverse kinematics, problem builders, timing, search, and the front door `plan`."""
