"""The command `selfmotion`: plan from task files, check joint trajectories, export, report and view.

No other package draws.
"""

from ocp.app.check.joint_limits import Fault, Row
from ocp.app.check.verdict import Check, CheckTolerances, Interpretation, check_trajectory

__all__ = ["Check", "CheckTolerances", "Fault", "Interpretation", "Row", "check_trajectory"]
