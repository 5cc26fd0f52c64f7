"""The command `selfmotion`: plan from a task file, check anybody's trajectory, export, report.

The only part of the packages that draws.
"""

from ocp.app.check.verdict import Check, Fault, Row, check_trajectory
from ocp.app.command import main

__all__ = ["Check", "Fault", "Row", "check_trajectory", "main"]
