"""Kinematics of a wind tunnel's captive trajectory rig, and the choice of the roll angle that the task leaves free."""
