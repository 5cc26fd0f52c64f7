"""Machines: robots on a fixed, floating or standing base, SCARA arms, and their collision scenes."""
