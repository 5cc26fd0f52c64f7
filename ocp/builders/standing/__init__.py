"""Plans of machines that stand unfastened on the ground."""

from ocp.builders.standing.plan import plan_standing
from ocp.builders.standing.problem import FreeTime, Weights, motion_cost, standing_problem
from ocp.tasks.limits import Limits
from ocp.tasks.zmp_rules import Anywhere, Following, IndexAtLeast, InFoot, Pinned, ZmpRule

__all__ = [
    "Anywhere",
    "Following",
    "FreeTime",
    "InFoot",
    "IndexAtLeast",
    "Limits",
    "Pinned",
    "Weights",
    "ZmpRule",
    "motion_cost",
    "plan_standing",
    "standing_problem",
]
