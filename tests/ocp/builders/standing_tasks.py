"""The tasks of Tables 1 and 2, and a spatial one, for local and optimal plans alike."""

from __future__ import annotations

from functools import cache
from typing import Any

import casadi as ca
import numpy as np

from models.machines.standing import External, Standing, tip_spring
from models.machines.standing_motion import StandingMotion, standing_motion
from models.papers import STANDING_STARTS, standing_example
from models.robot.dynamics import Wrench
from ocp import Problem, Solution
from ocp.builders.standing.plan import FreeTime, Limits, Weights, standing_problem
from tests.models.machines.standing_machines import planar_machine, six_joint_arm, standing_arm
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


def table_path(table: int) -> Any:
    """zdot = 0.4 sin t (Table 1) or ydot = 0.2 sin t (Table 2); the other coordinate is held."""
    _, y, z = tip_at(machine(), STANDING_STARTS[table])
    if table == 1:
        return lambda t: [y, z + 0.4 * (1 - ca.cos(t))]
    return lambda t: [y + 0.2 * (1 - ca.cos(t)), z]


def spring() -> External:
    """k = 150 N/m along y, relaxed where the tip of Table 2 starts."""
    return tip_spring(machine(), (0, 150, 0), tip_at(machine(), STANDING_STARTS[2]))


def table_plan(table: int, zmp: Any, **changes: Any) -> Problem:
    settings = {"zmp": zmp, "limits": LIMITS, "external": spring() if table == 2 else None, **changes}
    return standing_problem(machine(), table_path(table), ROWS, STANDING_STARTS[table], HORIZON, **settings)


def lift_plan(zmp: Any, **changes: Any) -> Problem:
    """The tip 0.8 m straight up in the least time."""
    _, y, z = tip_at(machine(), STANDING_STARTS[1])
    settings = {"limits": LIFT_LIMITS, "weights": LIFT_WEIGHTS, "along": "parameter", **changes}
    return standing_problem(
        machine(), lambda s: [y, z + 0.8 * s], ROWS, STANDING_STARTS[1], FreeTime(0.2, 3.0, 1.0), zmp=zmp, **settings
    )


def arm_path(t: Any) -> list[Any]:
    """0.25 m forward and aside and 0.1 m down, from rest to rest."""
    x, y, z = tip_at(arm(), ARM_START)
    s = t / ARM_HORIZON
    share = s**3 * (10 - 15 * s + 6 * s**2)
    return [x + 0.25 * share, y + 0.25 * share, z - 0.1 * share]


def tool(time: Any, tip: Any) -> list[Wrench]:
    """A load that grows, and a constant moment, at the arm's tip."""
    return [arm().tip_wrench((0, 0, -25 - 20 * time), (1.0, 2.0, 0.5))]


def quintic(s: Any) -> Any:
    """From 0 to 1 at rest and without acceleration at both ends."""
    return s**3 * (10 - 15 * s + 6 * s**2)


PLANAR_HORIZON = 2.0
SIX_START = np.array([0.3, -1.2, 1.6, -0.6, 0.2, 0.1])


def planar_start(size: int) -> Array:
    return np.array([np.pi / 2 + 0.5, -1.4, 1.2, *[-0.3] * (size - 3)])


def planar_path(size: int, ahead: float = 0.35, up: float = -0.5) -> Any:
    """The tip of planar_machine(size) forward and down, from rest to rest."""
    _, y, z = tip_at(planar_machine(size), planar_start(size))
    return lambda t: [y + ahead * quintic(t / PLANAR_HORIZON), z + up * quintic(t / PLANAR_HORIZON)]


@cache
def six() -> Standing:
    return six_joint_arm()


def six_path(t: Any) -> list[Any]:
    """0.3 m aside and 0.15 m down in 1 s, from rest to rest."""
    x, y, z = tip_at(six(), SIX_START)
    return [x + 0.02 * quintic(t), y + 0.3 * quintic(t), z - 0.15 * quintic(t)]


def six_tool(time: Any, tip: Any) -> list[Wrench]:
    """A load that grows and swings, and a moment, at the tip of the six-joint arm."""
    return [six().tip_wrench((3 * ca.sin(3 * time), 5, -40 - 40 * time), (1.0, -2.0, 0.5))]


def sampled(
    standing: Standing,
    solution: Solution,
    external: External | None = None,
    rows: Any = ROWS,
    finer: int = 10,
) -> StandingMotion:
    """A plan on a grid `finer` times its own, at the middles of the parts, where held controls are plain."""
    count = solution.method["intervals"] * finer
    values = solution.at_fraction((np.arange(count) + 0.5) / count)
    times = (np.arange(count) + 0.5) / count * solution.horizon
    return standing_motion(
        standing, times, values["joints"], values["velocities"], values["accelerations"], external, rows
    )


def tip_error(motion: StandingMotion, path: Any, rows: Any = ROWS) -> float:
    """Greatest distance from the path, m."""
    axes = [row - 3 for row in rows]
    wanted = np.array([np.array(ca.DM(ca.vertcat(*path(float(t))))).ravel() for t in motion.t])
    return float(np.linalg.norm(motion.tip_in_world[:, axes] - wanted, axis=1).max())
