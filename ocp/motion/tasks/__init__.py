"""Tip tasks of a machine: their targets over time, equations and checks, and rules for the zero moment point."""
