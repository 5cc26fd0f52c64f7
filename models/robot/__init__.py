"""Robots: trees of links and joints, their kinematics and dynamics as expressions."""
