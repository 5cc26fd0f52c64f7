"""The command `selfmotion`: plan from task files, check joint trajectories, export, report and view.

No other package draws.
"""

from ocp.app.check.verdict import Check, CheckTolerances, Fault, Interpretation, Row, check_trajectory

__all__ = ["Check", "CheckTolerances", "Fault", "Interpretation", "Row", "check_trajectory"]
