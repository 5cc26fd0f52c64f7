"""What is asked: states, controls, parameters, dynamics, constraints, cost."""
