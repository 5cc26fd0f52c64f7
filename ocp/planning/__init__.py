"""The front door: a machine and its tasks in, the cheapest motion out that passes its audit."""

from ocp.planning.candidate import Candidate, Reason, Rejection
from ocp.planning.dead_end import DeadEnd
from ocp.planning.motion import Plan, PlanSample
from ocp.planning.piecewise import PlanInPieces, Reconfiguration, plan_in_pieces
from ocp.planning.planner import plan
from ocp.planning.waypoints import WaypointPlan, plan_waypoints

__all__ = [
    "Candidate",
    "DeadEnd",
    "Plan",
    "PlanInPieces",
    "PlanSample",
    "Reason",
    "Reconfiguration",
    "Rejection",
    "WaypointPlan",
    "plan",
    "plan_in_pieces",
    "plan_waypoints",
]
