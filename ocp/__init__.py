"""Optimal control: declare a problem, transcribe it, solve it, audit it; ready problems and plans for machines."""

from ocp.audit.audit import Audit, Finding
from ocp.audit.certificate import Certificate
from ocp.builders.capture import capture_problem, chained_capture, plan_capture
from ocp.builders.clearance import Clear
from ocp.builders.cts import roll_problem, spline_targets
from ocp.builders.drives import Effort, JointFriction, joint_torques
from ocp.builders.dynamics import dynamics_problem
from ocp.builders.dynamics_plan import plan_dynamics
from ocp.builders.grasping import Cone, Grasp
from ocp.builders.joint_spline import joint_path
from ocp.builders.legs import Leg, dynamics_phases
from ocp.builders.minimum_velocity import minimum_velocity_problem
from ocp.builders.standing.loads import StepsMotion, steps_motion
from ocp.builders.standing.plan import plan_standing, plan_steps
from ocp.builders.standing.postures import standing_posture
from ocp.builders.standing.problem import FreeTime, Weights, standing_problem
from ocp.builders.standing.resolved import resolve_steps
from ocp.builders.standing.stances import StancePhase, Steps, walk
from ocp.builders.standing.steps import StepWeights, steps_problem
from ocp.builders.timing import minimum_time_problem, plan_minimum_time
from ocp.confirmation import certificate
from ocp.direct.collocation import Collocation
from ocp.direct.shooting import MultipleShooting
from ocp.errors import AuditError, BoundWarning, ProblemError, RefinementWarning, SolveError, StorageWarning
from ocp.indirect.method import Indirect
from ocp.local.accelerations import resolve_accelerations
from ocp.local.inverse_kinematics import Unreachable, inverse_kinematics
from ocp.local.laws import Layer, Stabiliser
from ocp.local.rates import resolve
from ocp.methods import prepare, solve
from ocp.planning import (
    Candidate,
    DeadEnd,
    Plan,
    PlanInPieces,
    Reconfiguration,
    WaypointPlan,
    plan,
    plan_in_pieces,
    plan_waypoints,
)
from ocp.problem.phases import Phases
from ocp.problem.problem import Problem
from ocp.refinement import refine
from ocp.solution import Sensitivity, Solution
from ocp.status import SolverStatus
from ocp.tasks.limits import Limits
from ocp.tasks.tip_task import TipTask
from ocp.tasks.zmp_rules import Anywhere, Following, IndexAtLeast, InFoot, Pinned
from ocp.tightening import tighten

__version__ = "0.1.0"

__all__ = [
    "Anywhere",
    "Audit",
    "AuditError",
    "BoundWarning",
    "Candidate",
    "Certificate",
    "Clear",
    "Collocation",
    "Cone",
    "DeadEnd",
    "Effort",
    "Finding",
    "Following",
    "FreeTime",
    "Grasp",
    "InFoot",
    "IndexAtLeast",
    "Indirect",
    "JointFriction",
    "Layer",
    "Leg",
    "Limits",
    "MultipleShooting",
    "Phases",
    "Pinned",
    "Plan",
    "PlanInPieces",
    "Problem",
    "ProblemError",
    "Reconfiguration",
    "RefinementWarning",
    "Sensitivity",
    "Solution",
    "SolveError",
    "SolverStatus",
    "Stabiliser",
    "StancePhase",
    "StepWeights",
    "Steps",
    "StepsMotion",
    "StorageWarning",
    "TipTask",
    "Unreachable",
    "WaypointPlan",
    "Weights",
    "capture_problem",
    "certificate",
    "chained_capture",
    "dynamics_phases",
    "dynamics_problem",
    "inverse_kinematics",
    "joint_path",
    "joint_torques",
    "minimum_time_problem",
    "minimum_velocity_problem",
    "plan",
    "plan_capture",
    "plan_dynamics",
    "plan_in_pieces",
    "plan_minimum_time",
    "plan_standing",
    "plan_steps",
    "plan_waypoints",
    "prepare",
    "refine",
    "resolve",
    "resolve_accelerations",
    "resolve_steps",
    "roll_problem",
    "solve",
    "spline_targets",
    "standing_posture",
    "standing_problem",
    "steps_motion",
    "steps_problem",
    "tighten",
    "walk",
]
