"""Machines and tasks that several tests share: real arms on fixed and floating bases."""

from __future__ import annotations

from functools import cache
from typing import Any

import casadi as ca
import numpy as np

from models import FixedBase, FreeFloating, Link, Machine, Robot, merge_robots
from models.paths import rest_to_rest
from ocp import Solution
from ocp.motion.tasks.equations import task_errors
from ocp.motion.tasks.tracks import PoseLine, pose_line
from tests.models.robot.pinocchio_robots import ROBOTS, urdf_file
from tests.models.robot.trees import Array, numeric

PANDA_START = np.array([0.1, -0.3, 0.3, -1.9, 0.4, 1.7, 0.7])
UR5_START = np.array([0.3, -1.2, 1.5, -1.9, -1.55, 0.2])
BASE = np.array([0.1, 0.2, 0.3, 0.8, 0.0, 0.6, 0.0])
SATELLITE = Link("satellite", 60.0, inertia=np.diag([6.0, 7.0, 8.0]))


@cache
def panda_arm() -> Robot:
    package, ending, _ = ROBOTS["panda"]
    return Robot.from_urdf(urdf_file(package, ending), tip="panda_hand", lock={"panda_finger_joint1": 0.0})


@cache
def panda() -> FixedBase:
    return FixedBase(panda_arm())


@cache
def ur5() -> FixedBase:
    return FixedBase(Robot.from_urdf(urdf_file(*ROBOTS["ur5"][:2]), tip="tool0"))


def floating_panda(momentum: Any = None) -> FreeFloating:
    robot = merge_robots(SATELLITE, {"": panda_arm()}, translations={"": (0.3, 0.0, 0.2)})
    return FreeFloating(robot, conserved_momentum=momentum)


def two_pandas(momentum: Any = None) -> FreeFloating:
    robot = merge_robots(
        SATELLITE,
        {"left_": panda_arm(), "right_": panda_arm()},
        translations={"left_": (0.3, 0.3, 0.2), "right_": (0.3, -0.3, 0.2)},
    )
    return FreeFloating(robot, conserved_momentum=momentum)


@cache
def floating_manipulator() -> FreeFloating:
    """The published seven-joint manipulator on its own base."""
    package, ending, report = ROBOTS["floating manipulator"]
    return FreeFloating(Robot.from_urdf(urdf_file(package, ending), **report))


def pose(machine: Machine, base: Any, joints: Any) -> tuple[Array, Array]:
    """(Rotation, position) of the tip."""
    frame = machine.tip_pose(base, joints)
    return numeric(frame.rotation), numeric(frame.position).ravel()


def turned(axis: Any, angle: float) -> Array:
    """Rotation about an axis."""
    unit = np.asarray(axis) / np.linalg.norm(axis)
    cross = numeric(ca.skew(ca.DM(unit)))
    return np.asarray(np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross)


def line_from(machine: Machine, base: Any, joints: Any, shift: Any, axis: Any, angle: float, time: float) -> PoseLine:
    """Pose line from where the tip is, by a shift and a turn in its own axes."""
    rotation, position = pose(machine, base, joints)
    goal = rotation @ turned(axis, angle), position + rotation @ np.asarray(shift)
    return pose_line((rotation, position), goal, time)


def circle(center: Array, radius: float, horizon: float) -> Any:
    """Closed path in x and y that starts at `center`, moving from rest to rest."""

    def position(time: Any) -> Any:
        s = time / horizon
        angle = 2 * np.pi * rest_to_rest(s)
        return ca.vertcat(center[0] + radius * (ca.cos(angle) - 1), center[1] + radius * ca.sin(angle), center[2])

    return position


def largest_error(machine: Machine, task: Any, plan: Solution) -> float:
    """Of the pose, between the nodes too, m or rad."""
    times = np.linspace(0.0, plan.horizon, 501)
    at = plan.at(times)
    base = at["base"] if machine.base_size else None
    return float(np.abs(task_errors(machine, task, times, base, at["joints"])).max())


def largest_momentum_error(machine: FreeFloating, plan: Solution) -> float:
    """Momentum less the conserved one at the reported points, N m s and N s, by the sums over the links."""
    b, q, db, dq = (ca.SX.sym(name, size) for name, size in (("b", 7), ("q", machine.joint_size)) * 2)
    residual = ca.Function("residual", [b, q, db, dq], [machine.momentum_residual(b, q, db, dq)])
    rate = ca.Function("rate", [b, q, dq], [machine.base_rate(b, q, dq)])
    worst = 0.0
    for base, joints, rates in zip(plan["base"], plan["joints"], plan["rates"], strict=True):
        worst = max(worst, float(np.abs(numeric(residual(base, joints, rate(base, joints, rates), rates))).max()))
    return worst
