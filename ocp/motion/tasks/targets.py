"""What tasks ask of a frame along a motion, in the world, to be shown beside what is done."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import casadi as ca
import numpy as np

from models import Machine
from models.arrays import Array
from ocp.motion.tasks.equations import bind
from ocp.motion.tasks.geometry import target_size
from ocp.motion.tasks.tip_task import TipTask

__all__ = ["Target", "targets_along"]


class Target(NamedTuple):
    """A frame that a task asks for, at M times; nan where it asks for nothing.

    Attributes:
        t: s. Shape (M,).
        position: Of its origin in the world. Shape (M, 3), m.
        rotation: Its axes, as columns, in the world; of a tool that may roll the tool axis alone, as the last column.
            Shape (M, 3, 3).
    """

    t: Array
    position: Array
    rotation: Array


def targets_along(
    machine: Machine, tasks: Sequence[TipTask], times: Array, base: Array, joints: Array, told: Array | None = None
) -> tuple[Target, ...]:
    """The targets of the tasks that ask for a pose, along a motion, which moves those relative to a link.

    Args:
        machine: It does the tasks.
        tasks: Each from its begin to its end.
        times: Of the tasks, s. Shape (M,).
        base: Configurations of the base, shape (M, base_size). joints: Shape (M, joint_size).
        told: Times of the motion, where these are others. Shape (M,), s.
    """
    equations = bind(machine, tasks)
    count = len(times)
    wanted = np.array(equations.target_function().map(count)(times[None, :])).reshape(-1, count).T
    found, at = [], 0
    for part in equations.bound:
        task, values = part.task, wanted[:, at : at + target_size(part.task)]
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
        if part.reference is not None:
            turn, place = _frames(part.reference, base, joints)
            position = np.einsum("mij,mj->mi", turn, position) + place
            rotation = turn @ rotation
        asked = (times >= task.begin) & (times <= task.end)
        position[~asked], rotation[~asked] = np.nan, np.nan
        found.append(Target(times if told is None else told, position, rotation))
    return tuple(found)


def _frames(machine: Machine, base: Array, joints: Array) -> tuple[Array, Array]:
    """Rotations (M, 3, 3) and positions (M, 3) of a machine's tip."""
    b, q = ca.SX.sym("b", machine.base_size), ca.SX.sym("q", machine.joint_size)
    pose: Any = machine.tip_pose(b, q)
    function = ca.Function("frames", [b, q], [pose.rotation, pose.position])
    turns, places = (np.array(part) for part in function.map(len(joints))(base.T, joints.T))
    return turns.reshape(3, -1, 3).transpose(1, 0, 2), places.T
