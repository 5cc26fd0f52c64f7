"""The indirect method: Pontryagin's minimum principle as a boundary value problem."""
