"""Planning: from a machine and its tasks to the lowest-cost motion that passes its audit."""

from ocp.motion.plan.dispatch import plan, plan_problem
from ocp.motion.result.candidate import Candidate, Reason, Rejection
from ocp.motion.result.plan import Plan, PlanSample
from ocp.motion.result.segmented_plan import Reconfiguration
from ocp.motion.search.dead_end import DeadEnd

__all__ = [
    "Candidate", "DeadEnd", "Plan", "PlanSample", "Reason", "Reconfiguration", "Rejection", "plan", "plan_problem",
]  # fmt: skip
