"""The panels of bad input leave out nothing that a user types, and are as large as they say."""

from __future__ import annotations

import models
import ocp
import ocp.app.batch
import ocp.app.files
import ocp.motion.schedule
from tests.models.cts.test_bad_rigs import CASES as RIGS
from tests.models.machines.test_bad_machines import CASES as MACHINES
from tests.models.paths.test_bad_paths import CASES as PATHS
from tests.models.robot.test_bad_robots import CASES as ROBOTS
from tests.models.robot.test_bad_urdf import MUJOCO, OPTIONS, STATES, TEXTS, XACRO
from tests.models.shapes.test_bad_shapes import CASES as SHAPES
from tests.ocp.app.batch.test_bad_batches import CASES as BATCHES
from tests.ocp.app.files.test_bad_files import CASES as FILES
from tests.ocp.motion.builders.test_bad_tasks import CASES as TASKS
from tests.ocp.motion.plan.test_bad_plans import CASES as PLANS
from tests.ocp.motion.schedule.test_bad_schedules import CASES as SCHEDULES
from tests.ocp.problem.test_bad_problems import CASES as PROBLEMS

CASES = [
    *ROBOTS,
    OPTIONS,
    STATES,
    XACRO,
    *MUJOCO,
    *MACHINES,
    *PATHS,
    *RIGS,
    *SHAPES,
    *PROBLEMS,
    *SCHEDULES,
    *TASKS,
    *FILES,
    *PLANS,
    *BATCHES,
]
CREATED_BY_THE_PACKAGE = {
    "Audit",
    "Batch",
    "Candidate",
    "Certificate",
    "ControlStep",
    "Controller",
    "Cut",
    "Dip",
    "Finding",
    "Footprint",
    "Frame",
    "IkConfigurations",
    "Incompleteness",
    "JointPath",
    "JointRates",
    "TorqueRates",
    "LineMotion",
    "Machine",
    "Note",
    "PathLike",
    "Plan",
    "Pause",
    "Program",
    "ProgramMotion",
    "Rapid",
    "Reconfiguration",
    "Result",
    "RawTrajectory",
    "STANDING_STARTS",
    "Schedule",
    "Section",
    "SmoothPath",
    "Solution",
    "StepsMotion",
    "Table",
    "TimedProgram",
    "Sensitivity",
}
"""Results, protocols and constants: their methods are in the panels, but nobody makes them."""
WITHOUT_ARGUMENTS = {"Anywhere", "SolverStatus", "paper_example", "reference_tunnel", "standing_example"}
RAISED = {"DeadEnd", "Unreachable"}
CHECKED_BY_PROBLEMS = {
    "AccelerationOptions", "DynamicsSetup", "IkOptions", "Pinned", "RateOptions",
    "RollSettings", "StandingSetup", "VelocitySetup",
}  # fmt: skip
"""Options whose fields are in the panels of the functions that take them, such as `dynamics_problem` and `resolve`."""


def test_everything_a_user_types_is_in_a_panel() -> None:
    request = {case.what.partition(".")[0].partition(" ")[0] for case in CASES}
    faces = {
        *models.__all__,
        *ocp.__all__,
        *ocp.app.batch.__all__,
        *ocp.app.files.__all__,
        *ocp.motion.schedule.__all__,
    }
    errors = {name for name in faces if name.endswith(("Error", "Warning")) or name in RAISED}
    assert faces - request - errors - CREATED_BY_THE_PACKAGE - WITHOUT_ARGUMENTS - CHECKED_BY_PROBLEMS == set()


def test_the_panels_are_large() -> None:
    assert sum(len(bad) for case in CASES for bad in case.bad.values()) + len(TEXTS) > 7000
