"""The tasks of Tables 1 and 2, and a spatial one, for local and optimal plans alike."""

from __future__ import annotations

from dataclasses import fields
from functools import cache
from typing import Any, cast

import casadi as ca
import numpy as np

from models import STANDING_STARTS, Standing, Wrench, standing_example
from models.machines.machine import Wrenches, with_tip
from models.machines.standing import StandingMotion, standing_motion, tip_spring
from models.paths import rest_to_rest
from ocp import Problem, Solution, TipTask
from ocp.motion.builders.standing.problem import FreeTime, StandingSetup, Weights, standing_problem
from ocp.motion.tasks.equations import task_errors
from ocp.motion.tasks.limits import Limits
from tests.models.machines.standing_machines import planar_machine, six_joint_arm, standing_arm, two_armed
from tests.models.robot.trees import Array

HORIZON = 2 * np.pi
ROWS = (4, 5)
LIMITS = Limits(velocity=6.0, acceleration=60.0, vertical_force=60.0)
LIFT_LIMITS = Limits(velocity=3.0, acceleration=20.0, torque=(200, 350, 250, 60, 30), vertical_force=60.0, friction=0.6)
LIFT_WEIGHTS = Weights(acceleration=1e-5, velocity=0.0, joint_limits=0.0, manipulability=0.0, time=1.0)

ARM_START = np.array([0.3, -0.5, 0.2, 1.6, -0.2, 0.9, 0.1])
ARM_HORIZON = 1.2


@cache
def machine() -> Standing:
    return standing_example()


@cache
def arm() -> Standing:
    return standing_arm()


def tip_at(standing: Standing, joints: Array) -> Array:
    return np.array(ca.DM(standing.tip_pose((), joints).position)).ravel()


def led(position: Any, rows: Any = ROWS) -> TipTask:
    """The tip on a path in these rows, without feedback."""
    return TipTask(position=position, rows=rows, gain=0.0)


def table_task(table: int) -> TipTask:
    """zdot = 0.4 sin t (Table 1) or ydot = 0.2 sin t (Table 2); the other coordinate is held."""
    _, y, z = tip_at(machine(), STANDING_STARTS[table])
    if table == 1:
        return led(lambda t: [y, z + 0.4 * (1 - ca.cos(t))])
    return led(lambda t: [y + 0.2 * (1 - ca.cos(t)), z])


def spring() -> Wrenches:
    """k = 150 N/m along y, relaxed where the tip of Table 2 starts."""
    return tip_spring(machine(), (0, 150, 0), tip_at(machine(), STANDING_STARTS[2]))


def with_setup(options: dict[str, Any]) -> dict[str, Any]:
    """Arguments of standing_problem, those that belong to its setup collected there."""
    names = {field.name for field in fields(StandingSetup)}
    rest = {name: value for name, value in options.items() if name not in names}
    return {**rest, "setup": StandingSetup(**{name: options[name] for name in names & options.keys()})}


@cache
def table_plan(table: int, zmp: Any, **changes: Any) -> Problem:
    settings = with_setup({"wrenches": spring() if table == 2 else (), **changes})
    settings = {"zmp": zmp, "limits": LIMITS, "start": STANDING_STARTS[table], **settings}
    return standing_problem(machine(), table_task(table), HORIZON, **settings)


def straight(forward: float, up: float) -> TipTask:
    """The tip of the paper's machine on a straight line, over a path parameter."""
    _, y, z = tip_at(machine(), STANDING_STARTS[1])
    return led(lambda s: [y + forward * s, z + up * s])


@cache
def lift_plan(zmp: Any, **changes: Any) -> Problem:
    """The tip 0.8 m straight up in the least time."""
    settings = with_setup({"limits": LIFT_LIMITS, "weights": LIFT_WEIGHTS, "along": "parameter", **changes})
    horizon = settings.pop("horizon", FreeTime(0.2, 3.0, 1.0))
    return standing_problem(machine(), straight(0.0, 0.8), horizon, start=STANDING_STARTS[1], zmp=zmp, **settings)


def moved_task(standing: Standing, start: Array, by: Any, seconds: float, **fields: Any) -> TipTask:
    """A tip by so many m along the axes in which it is moved at all, from rest to rest, without feedback.

    Args:
        fields: Further ones of the task: link and point, what it does with its orientation.
    """
    if "link" in fields:
        standing = cast(Standing, with_tip(standing, fields["link"], fields.get("point", np.zeros(3))))
    axes = [0, 1, 2] if len(by) == 3 else [1, 2]
    place, step = ca.DM(tip_at(standing, start)[axes]), ca.DM(by)
    rows = None if len(by) == 3 else ROWS
    return TipTask(position=lambda t: place + step * rest_to_rest(t / seconds), rows=rows, gain=0.0, **fields)


def arm_task() -> TipTask:
    """0.25 m forward and aside and 0.1 m down, from rest to rest."""
    return moved_task(arm(), ARM_START, (0.25, 0.25, -0.1), ARM_HORIZON)


def tool(time: Any, tip: Any) -> list[Wrench]:
    """A load that grows, and a constant moment, at the arm's tip."""
    return [arm().tip_wrench((0, 0, -25 - 20 * time), (1.0, 2.0, 0.5))]


PLANAR_HORIZON = 2.0
SIX_START = np.array([0.3, -1.2, 1.6, -0.6, 0.2, 0.1])


def planar_start(size: int) -> Array:
    return np.array([np.pi / 2 + 0.5, -1.4, 1.2, *[-0.3] * (size - 3)])


def planar_task(size: int, ahead: float = 0.35, up: float = -0.5) -> TipTask:
    """The tip of planar_machine(size) forward and down, from rest to rest."""
    return moved_task(planar_machine(size), planar_start(size), (ahead, up), PLANAR_HORIZON)


@cache
def six() -> Standing:
    return six_joint_arm()


def six_task() -> TipTask:
    """0.3 m aside and 0.15 m down in 1 s, from rest to rest."""
    return moved_task(six(), SIX_START, (0.02, 0.3, -0.15), 1.0)


def six_tool(time: Any, tip: Any) -> list[Wrench]:
    """A load that grows and swings, and a moment, at the tip of the six-joint arm."""
    return [six().tip_wrench((3 * ca.sin(3 * time), 5, -40 - 40 * time), (1.0, -2.0, 0.5))]


TWO_START = np.array([0.2, -0.1, -0.5, 1.9, 0.6, 0.5, 1.7, -0.6])
TWO_HORIZON = 0.7
GRIP = (0.0, 0.0, 0.15)  # in the hand, m


@cache
def two() -> Standing:
    return two_armed()


def two_tasks(left: Any, right: Any) -> list[TipTask]:
    """The hands of the two-armed machine by so many m."""
    paths = {"left_hand": left, "right_hand": right}
    return [moved_task(two(), TWO_START, by, TWO_HORIZON, link=name, point=GRIP) for name, by in paths.items()]


def sampled(
    standing: Standing, solution: Solution, wrenches: Wrenches = (), rows: Any = ROWS, finer: int = 10
) -> StandingMotion:
    """A plan on a grid `finer` times its own, at the middles of the parts, where held controls are plain."""
    count = solution.method["intervals"] * finer
    values = solution.at_fraction((np.arange(count) + 0.5) / count)
    times = (np.arange(count) + 0.5) / count * solution.horizon
    return standing_motion(
        standing,
        times,
        values["joints"],
        values["velocities"],
        joint_accelerations=values["accelerations"],
        wrenches=wrenches,
        rows=rows,
    )


def tip_error(standing: Standing, motion: StandingMotion, task: Any) -> float:
    """Greatest norm of the pose errors, m and rad."""
    return float(np.linalg.norm(task_errors(standing, task, motion.t, motion.joints), axis=1).max())
