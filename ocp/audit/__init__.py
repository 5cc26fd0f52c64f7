"""The audit: checks of feasibility, also between the nodes of a plan, and of optimality."""
