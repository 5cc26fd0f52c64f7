"""Instant by instant: redundancy resolved locally, inverse kinematics, reach."""
