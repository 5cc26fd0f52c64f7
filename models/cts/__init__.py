"""The captive trajectory rig of a wind tunnel: its kinematics, and the roll that its task leaves open."""
