"""Statement of an optimal control problem: states, controls, parameters, dynamics, constraints, cost."""
