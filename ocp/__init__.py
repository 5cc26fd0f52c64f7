"""Optimal control: declaration, transcription, solution and audit of problems, and motion planning of machines."""

from importlib.util import find_spec as _find_spec
from pathlib import Path as _Path

if (_spec := _find_spec("models")) is None or [*map(_Path, _spec.submodule_search_locations or ())] != [
    _Path(__file__).parents[1] / "models"
]:
    # a folder without __init__.py has no file of its own
    _file = (_spec.origin or next(iter(_spec.submodule_search_locations or ()), None)) if _spec else None
    raise ImportError(
        f"`import models` finds {_file or 'no module'}, not the package that selfmotion installs beside {__file__}. "
        "Rename that file or folder, or exclude the folder of the script from the search for modules: "
        "python -P SCRIPT, or the environment variable PYTHONSAFEPATH=1",
        name="models",
        path=_file,
    )

from ocp.adaptive import AdaptiveCollocation
from ocp.audit.audit import Audit, Finding
from ocp.direct.controller import Controller, ControlStep
from ocp.direct.discretisation import Collocation, MultipleShooting
from ocp.errors import (
    AuditError,
    BoundWarning,
    ProblemError,
    RefinementWarning,
    SolveError,
    SolverStatus,
    StorageWarning,
)
from ocp.indirect.method import Indirect
from ocp.methods import Certificate, certificate, prepare, solve
from ocp.motion.builders.clearance import ClearanceConstraints
from ocp.motion.builders.cts import RollSettings, roll_problem, spline_targets
from ocp.motion.builders.dynamics import DynamicsSetup, JointFriction, dynamics_problem, joint_torques
from ocp.motion.builders.dynamics_plan import dynamics_phases
from ocp.motion.builders.joint_motion import VelocitySetup, minimum_velocity_problem
from ocp.motion.builders.joint_spline import joint_path
from ocp.motion.builders.space.capture import Capture, Cone, Grasp, capture_problem, chained_capture
from ocp.motion.builders.standing.problem import FreeTime, StandingSetup, Weights, standing_problem
from ocp.motion.builders.standing.stances import StancePhase, Steps, standing_configuration, walk
from ocp.motion.builders.standing.steps import StepsMotion, StepWeights, resolve_steps, steps_motion, steps_problem
from ocp.motion.builders.timing import minimum_time_problem
from ocp.motion.local.accelerations import AccelerationOptions, Layer, Stabiliser, resolve_accelerations
from ocp.motion.local.ik_solver import IkConfigurations, IkSolver, Incompleteness, ik_configurations
from ocp.motion.local.inverse_kinematics import IkOptions, Unreachable, inverse_kinematics
from ocp.motion.local.rates import RateOptions, resolve
from ocp.motion.plan import Candidate, DeadEnd, Plan, Reconfiguration, plan, plan_problem
from ocp.motion.tasks.goals import Cost, Goal, Scene, Start, Waypoints
from ocp.motion.tasks.limits import Anywhere, IndexAtLeast, InFoot, Limits, Pinned
from ocp.motion.tasks.tip_task import TipTask
from ocp.problem.phases import Phases
from ocp.problem.problem import Problem
from ocp.problem.tables import Table, table
from ocp.refinement import RefinementSettings, refine
from ocp.solution import Solution
from ocp.solution_data import Sensitivity
from ocp.solution_data import register as _register
from ocp.tightening import tighten

__version__ = "0.1.0"

_register("audit", "ocp.audit.audit")
_register("default_method", "ocp.adaptive")
_register("sensitivity", "ocp.direct.sensitivity")
_register("margin_of_plan", "ocp.motion.result.margin")
_register("load_plan", "ocp.motion.plan.dispatch")
for _drawing in ("plot_solution", "html_of_solution", "plot_plan", "html_of_plan"):
    _register(_drawing, "ocp.app.view.plots")

__all__ = [
    "AccelerationOptions", "AdaptiveCollocation", "Anywhere", "Audit", "AuditError", "BoundWarning", "Candidate",
    "Capture", "Certificate", "ClearanceConstraints", "Collocation", "Cone", "ControlStep", "Controller", "Cost",
    "DeadEnd", "DynamicsSetup", "Finding", "FreeTime", "Goal", "Grasp", "IkConfigurations", "IkOptions",
    "IkSolver", "InFoot", "Incompleteness", "IndexAtLeast", "Indirect", "JointFriction", "Layer", "Limits",
    "MultipleShooting", "Phases", "Pinned", "Plan", "Problem", "ProblemError", "RateOptions", "Reconfiguration",
    "RefinementSettings", "RefinementWarning", "RollSettings", "Scene", "Sensitivity", "Solution",
    "SolveError", "SolverStatus", "Stabiliser", "StancePhase", "StandingSetup", "Start", "StepWeights", "Steps",
    "StepsMotion", "StorageWarning", "Table", "TipTask", "Unreachable", "VelocitySetup", "Waypoints",
    "Weights", "capture_problem", "certificate", "chained_capture", "dynamics_phases", "dynamics_problem",
    "ik_configurations", "inverse_kinematics", "joint_path", "joint_torques", "minimum_time_problem",
    "minimum_velocity_problem", "plan", "plan_problem", "prepare", "refine", "resolve", "resolve_accelerations",
    "resolve_steps", "roll_problem", "solve", "spline_targets", "standing_configuration", "standing_problem",
    "steps_motion", "steps_problem", "table", "tighten", "walk",
]  # fmt: skip
