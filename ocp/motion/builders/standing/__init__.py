"""Plans of machines that stand unfastened on the ground, on one support or on one after the other."""

from ocp.motion.builders.standing.plan import plan_standing, plan_steps
from ocp.motion.builders.standing.problem import FreeTime, StandingSetup, Weights, motion_cost, standing_problem
from ocp.motion.builders.standing.resolved import StepsMotion, resolve_steps, steps_motion
from ocp.motion.builders.standing.stances import StancePhase, Steps, standing_configuration, walk
from ocp.motion.builders.standing.steps import StepWeights, steps_problem
from ocp.motion.tasks.limits import Limits
from ocp.motion.tasks.zmp_rules import Anywhere, Following, IndexAtLeast, InFoot, Pinned, ZmpRule

__all__ = [
    "Anywhere",
    "Following",
    "FreeTime",
    "InFoot",
    "IndexAtLeast",
    "Limits",
    "Pinned",
    "StancePhase",
    "StandingSetup",
    "StepWeights",
    "Steps",
    "StepsMotion",
    "Weights",
    "ZmpRule",
    "motion_cost",
    "plan_standing",
    "plan_steps",
    "resolve_steps",
    "standing_configuration",
    "standing_problem",
    "steps_motion",
    "steps_problem",
    "walk",
]
