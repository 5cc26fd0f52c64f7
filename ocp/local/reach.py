"""Where a task leaves the reach of a machine on a fixed base: known before anything is optimised."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import casadi as ca
import numpy as np

from models import Machine
from ocp.local.inverse_kinematics import Unreachable, inverse_kinematics
from ocp.local.rates import LocalSolution
from ocp.tasks.equations import bind
from ocp.tasks.geometry import pose_in_reference
from ocp.tasks.start import Array
from ocp.tasks.tip_task import ANGULAR, TipTask

__all__ = ["check_reach", "leaves_limits"]

PLACES = 9
MISS = 1e-4
"""A pose missed by less, m or rad, is not called out of reach."""
STEPS = 400


def leaves_limits(machine: Machine, local: LocalSolution) -> bool:
    """Whether a local motion, which heeds no limits, passes limits of position."""
    inside = (local.joints >= machine.robot.lower) & (local.joints <= machine.robot.upper)
    return not bool(inside.all())


def check_reach(machine: Machine, tasks: list[TipTask], start: Array, horizon: float, limits: bool, near: Any) -> None:
    """Raise where poses of the tasks are out of reach, judged at a few times by multi-start inverse kinematics.

    Velocities in the world's axes are summed up to positions, orientations from velocities and tasks in other axes are
    left out. A floating base may come nearer, so that nothing is said of it.

    Args:
        machine: On a fixed base; else nothing is checked.
        tasks: All that are done at once.
        start: Joints at the start. Shape (joint_size,).
        horizon: s.
        limits: Whether the robot's position limits hold.
        near: Joints to search from first. Shape (k, joint_size).

    Raises:
        Unreachable: Names the time and the nearest miss.
    """
    if machine.base_size:
        return
    for time in np.linspace(0.0, horizon, PLACES)[1:]:
        poses = [pose for task in tasks if (pose := _as_pose(machine, task, start, float(time))) is not None]
        if not poses:
            return
        try:
            inverse_kinematics(machine, poses, time=float(time), near=near, limits=limits, tolerance=MISS)
        except Unreachable as error:
            raise Unreachable(f"at {time:.4g} s {error}", error.joints, error.misfit) from error


def _as_pose(machine: Machine, task: TipTask, start: Array, time: float) -> TipTask | None:
    """The pose that a task has come to at a time; None where that depends on the way, or has a gap to close."""
    if task.is_pose:
        return task if task.start_gap <= MISS else None
    rows = [row for row in task.chosen if row not in ANGULAR]
    if not rows or task.axes not in ("world", "reference") or (task.axes == "world") != (task.relative_to is None):
        return None
    equations = bind(machine, task)
    times = np.linspace(0.0, time, STEPS + 1)
    values = np.array(equations.target_function().map(len(times))(times[None, :]))
    weights = np.ones(STEPS + 1)
    weights[1:-1:2], weights[2:-1:2] = 4, 2
    moved = np.zeros(3)
    wanted = values[[task.chosen.index(row) for row in rows]]
    moved[[row - 3 for row in rows]] = wanted @ weights * time / STEPS / 3
    first, _ = pose_in_reference(equations.bound[0], ca.DM(0, 1), ca.DM(start))
    return replace(task, velocity=None, rows=rows, position=np.array(ca.DM(first)).ravel() + moved)
