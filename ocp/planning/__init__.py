"""The front door: a machine and its tasks in, the cheapest motion out that passes its audit."""

from ocp.planning.motion import Candidate, Plan, PlanSample
from ocp.planning.planner import plan

__all__ = ["Candidate", "Plan", "PlanSample", "plan"]
