"""Audit of a plan: checks that it is feasible, also between its mesh nodes, and that it is locally optimal."""
