"""Kinematics of the captive trajectory rig of a wind tunnel, and the choice of the roll that its task leaves free."""
