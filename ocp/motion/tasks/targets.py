"""Poses along a motion in the world: those that tasks require, for display next to the motion, and the tip's."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import casadi as ca
import numpy as np

from models import Machine
from models.checks import Array
from models.spatial import quaternion_from_rotation
from ocp.motion.tasks.equations import bind
from ocp.motion.tasks.tip_task import TipTask, target_size

__all__ = ["Target", "targets_along", "tip_poses"]


class Target(NamedTuple):
    """Target frame of a task at M times, nan where the task prescribes nothing.

    Attributes:
        t: Times, s. Shape (M,).
        position: Origin of the frame in the world. Shape (M, 3), m.
        rotation: Axes of the frame in the world, as columns; with a free roll the tool axis alone, as the last column.
            Shape (M, 3, 3).
    """

    t: Array
    position: Array
    rotation: Array


def targets_along(
    machine: Machine,
    tasks: Sequence[TipTask],
    times: Array,
    base: Array,
    joints: Array,
    shown_times: Array | None = None,
) -> tuple[Target, ...]:
    """Return the target of each pose task along a motion; the motion moves the targets that are relative to a link.

    Args:
        machine: The machine that does the tasks.
        tasks: The tasks, each active from its begin to its end.
        times: Times on the clock of the tasks, s. Shape (M,).
        base: Base configurations. Shape (M, base_size).
        joints: Joint positions. Shape (M, joint_size).
        shown_times: Times to report in the targets if they differ from `times`, s. Shape (M,).
    """
    equations = bind(machine, tasks)
    count = len(times)
    target_values = np.array(equations.target_function().map(count)(times[None, :])).reshape(-1, count).T
    targets, at = [], 0
    for bound in equations.bound:
        task, values = bound.task, target_values[:, at : at + target_size(bound.task)]
        at += target_size(task)
        if not task.is_pose:
            continue
        position, rotation = np.full((count, 3), np.nan), np.full((count, 3, 3), np.nan)
        rows = task.linear if task.along_reference else [0, 1, 2]
        if task.position is not None:
            position[:, rows], values = values[:, rows], values[:, 6:]
        if task.orientation is not None:
            rotation = values[:, :9].reshape(count, 3, 3).transpose(0, 2, 1)
        elif task.direction is not None:
            rotation[:, :, 2] = values[:, :3]
        if bound.reference is not None:
            rotations, origin = _frames(bound.reference, base, joints)
            position = np.einsum("mij,mj->mi", rotations, position) + origin
            rotation = rotations @ rotation
        active = (times >= task.begin) & (times <= task.end)
        position[~active], rotation[~active] = np.nan, np.nan
        targets.append(Target(times if shown_times is None else shown_times, position, rotation))
    return tuple(targets)


def _frames(machine: Machine, base: Array, joints: Array) -> tuple[Array, Array]:
    """Return rotations (M, 3, 3) and positions (M, 3) of a machine's tip."""
    b, q = ca.SX.sym("b", machine.base_size), ca.SX.sym("q", machine.joint_size)
    pose: Any = machine.tip_pose(b, q)
    function = ca.Function("frames", [b, q], [pose.rotation, pose.position])
    rotations, positions = (np.array(value) for value in function.map(len(joints))(base.T, joints.T))
    return rotations.reshape(3, -1, 3).transpose(1, 0, 2), positions.T


def tip_poses(machine: Machine, bases: Array, joints: Array) -> Array:
    """Return the poses of a machine's tip in world, nan if it has none: position and quaternion. Shape (M, 7).

    Args:
        bases, joints: Configurations. Shapes (M, base_size) and (M, n).
    """
    if machine.robot.tip is None:
        return np.full((len(joints), 7), np.nan)
    b, q = ca.SX.sym("b", machine.base_size), ca.SX.sym("q", machine.joint_size)
    pose = machine.tip_pose(b, q)
    function = ca.Function("tip", [b, q], [pose.position, pose.rotation])
    position, rotation = function.map(len(joints))(bases.T, joints.T)
    turns = np.array(rotation).reshape(3, len(joints), 3).transpose(1, 0, 2)
    return np.column_stack([np.array(position).T, quaternion_from_rotation(turns)])
