"""The front door: a machine and its tasks in, the lowest-cost motion that passes its audit out."""

from ocp.motion.plan.candidate import Candidate, Reason, Rejection
from ocp.motion.plan.motion import Plan, PlanSample
from ocp.motion.plan.piecewise import Reconfiguration, SegmentedPlan, plan_in_segments
from ocp.motion.plan.planner import plan
from ocp.motion.plan.waypoints import WaypointPlan, plan_waypoints
from ocp.motion.search.dead_end import DeadEnd

__all__ = [
    "Candidate",
    "DeadEnd",
    "Plan",
    "PlanSample",
    "Reason",
    "Reconfiguration",
    "Rejection",
    "SegmentedPlan",
    "WaypointPlan",
    "plan",
    "plan_in_segments",
    "plan_waypoints",
]
