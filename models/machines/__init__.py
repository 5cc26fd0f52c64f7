"""Machines: a robot on a fixed, floating or standing base, and the SCARA arm."""
