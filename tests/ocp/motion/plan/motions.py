"""Machines with tasks of every kind, that the tests of plans share, each planned once, with the path as numbers."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cache
from typing import Any

import casadi as ca
import numpy as np
from scipy.spatial.transform import Rotation

from models import Arc, FixedBase, Helix, Link, Machine, Path, SmoothPath, merge_robots, smooth
from models.spatial import quaternion_product
from ocp import TipTask
from ocp.motion.plan import plan
from ocp.motion.result.solved_plan import SolvedPlan
from scripts.robots.robots import UR5
from tests.models.robot.trees import Array, numeric
from tests.ocp.motion.plan.replay import Arm
from tests.ocp.motion.tasks.space_tasks import floating_manipulator, panda, panda_arm, ur5

DOWN = (0.0, 0.0, -1.0)
CONE = float(np.radians(15.0))
SPACE_START = np.array([0.3, -0.5, 0.4, 0.9, 0.2, 0.7, 0.1])
HELD = np.array([0.45, 0.35, 0.4])
"""Where the left hand of the two holds, m."""


@dataclass(frozen=True)
class PlanCase:
    """What is asked of one arm along one path.

    Attributes:
        machine, tasks, options: Of `plan`.
        arm: The arm that moves, by Pinocchio. path: What it runs along. speed: m/s.
        direction: Of the tool axis in the world; None where the path turns it. tool_axis: In the tool's frame.
        looks: What of the tool the task fixes: "axis", "orientation", or "" for the position alone.
    """

    machine: Machine
    tasks: Any
    arm: Arm
    path: SmoothPath
    speed: float
    direction: Any = None
    tool_axis: Any = (0.0, 0.0, 1.0)
    looks: str = "axis"
    options: dict[str, Any] = field(default_factory=dict)


PLAN_CASES: dict[str, Callable[[], PlanCase]] = {}


def plan_case(what: Callable[[], PlanCase]) -> Callable[[], PlanCase]:
    PLAN_CASES[what.__name__] = cache(what)
    return PLAN_CASES[what.__name__]


def plan_bare(*request: Any, **options: Any) -> SolvedPlan:
    """As `plan`, for laws of motions whatever the links may touch."""
    result = plan(*request, scene=False, **options)
    assert isinstance(result, SolvedPlan)
    return result


@cache
def planned(name: str) -> SolvedPlan:
    """From the start that is the best conditioned."""
    what = PLAN_CASES[name]()
    result = plan(what.machine, what.tasks, search="start", **what.options)
    assert isinstance(result, SolvedPlan)
    return result


def quaternion(axis: Any, angle: float) -> Array:
    unit = np.asarray(axis, dtype=float) / np.linalg.norm(axis)
    return np.concatenate([[np.cos(angle / 2)], np.sin(angle / 2) * unit])


def turned_by(first: Any, axis: Any, angle: float) -> Array:
    """A quaternion turned on in its own axes."""
    return numeric(quaternion_product(ca.DM(first), ca.DM(quaternion(axis, angle)))).ravel()


def raster(lanes: int, first: Any = (0.45, -0.15, 0.2), size: tuple[float, float] = (0.16, 0.3)) -> SmoothPath:
    """Lanes along y, side by side over the width `size[0]`."""
    corners = []
    for lane in range(lanes):
        ends = [(lane * size[0] / (lanes - 1), 0.0, 0.0), (lane * size[0] / (lanes - 1), size[1], 0.0)]
        corners += ends if lane % 2 == 0 else ends[::-1]
    return smooth(Path.through(np.asarray(first) + corners), deviation=0.002)


def curved_seam() -> SmoothPath:
    return smooth(Path.through([(0.45, -0.3, 0.2), (0.45, 0.1, 0.2), (0.65, 0.1, 0.25)]), deviation=0.002)


def circle(center: Any, radius: float) -> SmoothPath:
    middle = np.asarray(center, dtype=float)
    ends = [middle + np.array([side, 0.0, 0.0]) for side in (radius, -radius)]
    return smooth(Path(tuple(Arc.about(end, middle, (0, 0, 1), np.pi) for end in ends)), deviation=0.001)


def helix(center: Any, radius: float, rise: float, turns: float) -> SmoothPath:
    """Up about the vertical through the centre, from the side along x."""
    middle = np.asarray(center, dtype=float)
    screw = Helix(middle + np.array([radius, 0.0, 0.0]), middle, (0, 0, 1), 2 * np.pi * turns, rise)
    return smooth(Path((screw,)), deviation=0.001)


@cache
def angled_ur5() -> FixedBase:
    return FixedBase(UR5.read())


def angled_ur5_arm() -> Arm:
    report = UR5.options
    return Arm.of("ur5", "tool0", offset=(report["tip_rotation"], report["tip_translation"]))


def panda_peer(**options: Any) -> Arm:
    return Arm.of("panda", "panda_hand", **options)


def space_peer() -> Arm:
    return Arm.of("floating manipulator", floating_manipulator().robot.tip_link)


@cache
def pair() -> FixedBase:
    """Two Pandas on a stand."""
    places = {"left_": (0.0, 0.3, 0.0), "right_": (0.0, -0.3, 0.0)}
    stand = Link("stand", 10.0, inertia=np.eye(3))
    return FixedBase(merge_robots(stand, {"left_": panda_arm(), "right_": panda_arm()}, translations=places))


def space_tip() -> tuple[Array, Array]:
    """Position and rotation of the space arm's tip at its start."""
    machine = floating_manipulator()
    pose = machine.tip_pose(machine.base_home(), SPACE_START)
    return numeric(pose.position).ravel(), numeric(pose.rotation)


@plan_case
def three_lanes_panda() -> PlanCase:
    path = raster(3)
    return PlanCase(panda(), TipTask.along(path, 0.05, steady=True, direction=DOWN), panda_peer(), path, 0.05, DOWN)


@plan_case
def three_lanes_ur5() -> PlanCase:
    """The tool's axis is that of the last joint, whose roll is free."""
    path = raster(3)
    return PlanCase(
        ur5(), TipTask.along(path, 0.05, steady=True, direction=DOWN), Arm.of("ur5", "tool0"), path, 0.05, DOWN
    )


@plan_case
def three_lanes_space_arm() -> PlanCase:
    position, rotation = space_tip()
    path, axis = raster(3, position, (0.06, 0.1)), rotation[:, 2]
    task = TipTask.along(path, 0.02, steady=True, direction=axis)
    return PlanCase(floating_manipulator(), task, space_peer(), path, 0.02, axis, options={"start": SPACE_START})


@plan_case
def five_lanes_ur5() -> PlanCase:
    path = raster(5)
    return PlanCase(
        angled_ur5(), TipTask.along(path, 0.05, steady=True, direction=DOWN), angled_ur5_arm(), path, 0.05, DOWN
    )


@plan_case
def seam_ur5() -> PlanCase:
    path, tilted = curved_seam(), (0.0, 0.3, -1.0)
    return PlanCase(
        angled_ur5(), TipTask.along(path, 0.03, steady=True, direction=tilted), angled_ur5_arm(), path, 0.03, tilted
    )


@plan_case
def seam_panda() -> PlanCase:
    path, tilted = curved_seam(), (0.0, 0.3, -1.0)
    return PlanCase(panda(), TipTask.along(path, 0.03, steady=True, direction=tilted), panda_peer(), path, 0.03, tilted)


@plan_case
def seam_space_arm() -> PlanCase:
    position, rotation = space_tip()
    corners = position + np.array([[0, 0, 0], [0, 0.1, 0.02], [0.06, 0.12, 0.05]])
    path, axis = smooth(Path.through(corners), deviation=0.003), rotation[:, 2]
    return PlanCase(
        floating_manipulator(), TipTask.along(path, 0.01, steady=True, direction=axis), space_peer(), path, 0.01, axis
    )


@plan_case
def contour_panda() -> PlanCase:
    path = circle((0.5, 0.0, 0.3), 0.1)
    task = TipTask.along(path, 0.1, steady=True, direction=DOWN)
    return PlanCase(panda(), task, panda_peer(), path, 0.1, DOWN, options={"cyclic": True})


@plan_case
def contour_ur5() -> PlanCase:
    path = circle((0.5, 0.1, 0.3), 0.08)
    task = TipTask.along(path, 0.1, steady=True, direction=DOWN)
    return PlanCase(angled_ur5(), task, angled_ur5_arm(), path, 0.1, DOWN, options={"cyclic": True})


def blended_poses() -> SmoothPath:
    places = [(0.4, -0.2, 0.4), (0.5, 0.0, 0.5), (0.4, 0.25, 0.4), (0.55, 0.2, 0.3)]
    down = quaternion((1, 0, 0), np.pi)
    turns = [down, turned_by(down, (0, 1, 0), 0.4), turned_by(down, (1, 0, 0), 0.5), down]
    return smooth(Path.through(places, turns), deviation=0.005)


@plan_case
def poses_panda() -> PlanCase:
    path = blended_poses()
    task = TipTask.along(path, 0.1, steady=True, roll="given")
    return PlanCase(panda(), task, panda_peer(), path, 0.1, looks="orientation")


@plan_case
def poses_ur5() -> PlanCase:
    """Six rows of six joints: nothing is left but the branch."""
    path = blended_poses()
    task = TipTask.along(path, 0.1, steady=True, roll="given")
    return PlanCase(angled_ur5(), task, angled_ur5_arm(), path, 0.1, looks="orientation")


@plan_case
def finishing_ur5() -> PlanCase:
    path = raster(3)
    task = TipTask.along(path, 0.05, steady=True, direction=DOWN, within=CONE)
    return PlanCase(angled_ur5(), task, angled_ur5_arm(), path, 0.05, DOWN, looks="cone")


@plan_case
def finishing_panda() -> PlanCase:
    path = raster(3)
    task = TipTask.along(path, 0.05, steady=True, direction=DOWN, within=CONE)
    return PlanCase(panda(), task, panda_peer(), path, 0.05, DOWN, looks="cone")


@plan_case
def two_arms() -> PlanCase:
    """The left hand holds, the right one moves."""
    path = smooth(Path.through([(0.45, 0.0, 0.4), (0.45, -0.2, 0.4), (0.55, -0.2, 0.4)]), deviation=0.002)
    hold = TipTask(link="left_panda_hand", position=HELD, orientation=quaternion((1, 0, 0), np.pi))
    move = replace(TipTask.along(path, 0.05, steady=True, direction=(0, 1, 0)), link="right_panda_hand")
    arm = panda_peer(prefix="right_", place=(0.0, -0.3, 0.0))
    return PlanCase(pair(), [hold, move], arm, path, 0.05, (0, 1, 0))


@plan_case
def helix_ur5() -> PlanCase:
    path = helix((0.5, 0.1, 0.2), 0.06, 0.08, 1.5)
    return PlanCase(
        angled_ur5(), TipTask.along(path, 0.1, steady=True, direction=DOWN), angled_ur5_arm(), path, 0.1, DOWN
    )


@plan_case
def helix_panda() -> PlanCase:
    path = helix((0.45, 0.0, 0.3), 0.06, 0.08, 1.5)
    return PlanCase(panda(), TipTask.along(path, 0.1, steady=True, direction=DOWN), panda_peer(), path, 0.1, DOWN)


def on_board(path: SmoothPath, speed: float, looks: str = "axis", **report: Any) -> PlanCase:
    """The space arm along a path from where its tip is, its tool as it is then but for what is told."""
    axis = space_tip()[1][:, 2]
    direction = None if looks == "orientation" else axis
    task = TipTask.along(
        path, speed, steady=True, **({"roll": "given"} if direction is None else {"direction": axis}), **report
    )
    start = {"start": SPACE_START}
    return PlanCase(floating_manipulator(), task, space_peer(), path, speed, direction, looks=looks, options=start)


@plan_case
def helix_space_arm() -> PlanCase:
    return on_board(helix(space_tip()[0] - [0.03, 0.0, 0.0], 0.03, 0.03, 1.0), 0.02)


@plan_case
def contour_space_arm() -> PlanCase:
    """Closed, but for the joints: the base has turned when the tip is back."""
    return on_board(circle(space_tip()[0] - [0.04, 0.0, 0.0], 0.04), 0.02)


@plan_case
def poses_space_arm() -> PlanCase:
    position, rotation = space_tip()
    here = numeric(ca.DM(np.roll(Rotation.from_matrix(rotation).as_quat(), 1))).ravel()
    turns = [here, turned_by(here, (0, 1, 0), 0.3), turned_by(here, (1, 0, 0), 0.3)]
    places = position + np.array([[0, 0, 0], [0, 0.06, 0.02], [0.05, 0.06, 0.0]])
    return on_board(smooth(Path.through(places, turns), deviation=0.005), 0.02, "orientation")


@plan_case
def finishing_space_arm() -> PlanCase:
    return on_board(raster(3, space_tip()[0], (0.04, 0.06)), 0.02, "cone", within=CONE)
