"""Robots: trees of links and joints, with their kinematics and dynamics as CasADi expressions."""
