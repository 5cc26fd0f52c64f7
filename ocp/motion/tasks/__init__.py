"""Tip tasks of a machine: targets over time, their equations and checks, and rules of the zero moment point."""
