"""Motions of machines that stand unfastened on the ground, on one support or on several in turn."""
