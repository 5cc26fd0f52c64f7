"""Plans of machines that stand unfastened on the ground, on one support or on one after the other."""

from ocp.builders.standing.loads import StepsMotion, steps_motion
from ocp.builders.standing.plan import plan_standing, plan_steps
from ocp.builders.standing.postures import standing_posture
from ocp.builders.standing.problem import FreeTime, Weights, motion_cost, standing_problem
from ocp.builders.standing.resolved import resolve_steps
from ocp.builders.standing.stances import StancePhase, Steps, walk
from ocp.builders.standing.steps import StepWeights, steps_problem
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
    "StancePhase",
    "StepWeights",
    "Steps",
    "StepsMotion",
    "Weights",
    "ZmpRule",
    "motion_cost",
    "plan_standing",
    "plan_steps",
    "resolve_steps",
    "standing_posture",
    "standing_problem",
    "steps_motion",
    "steps_problem",
    "walk",
]
