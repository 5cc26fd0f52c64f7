"""Targets of tasks over time: target poses in world along a motion, and the mesh nodes needed to represent targets."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import casadi as ca
import numpy as np

from models import Machine
from models.checks import Array
from models.spatial import quaternion_from_rotation
from ocp.curves import lagrange
from ocp.motion.tasks.equations import TaskEquations, bind
from ocp.motion.tasks.tip_task import TipTask
from ocp.problem.values import Sampler
from ocp.tolerances import LIMIT_SHARE, ROUNDING_SHARE


@dataclass(frozen=True)
class NodeSettings:
    """Settings for choosing the mesh nodes that are needed to represent the targets of tasks."""

    points: int = 7  # of an interval of the mesh at which the targets determine the motion
    samples: int = 4  # between two breaks at which the targets are compared with their interpolants
    pose_error: float = 1e-6  # largest error of an interpolated position, rotation matrix or direction, m and 1
    rate_error: float = LIMIT_SHARE / 2  # largest error of an interpolated velocity, relative to its largest value
    chord_error: float = 1e-3  # largest distance of a pose from the chord of a time step, m and 1


NODES = NodeSettings()


class Target(NamedTuple):
    """Target pose of a tip task at M times; coordinates that the task does not prescribe are nan."""

    t: Array  # (M,), s
    position: Array  # origin of the frame in the world, (M, 3), m
    rotation: Array  # frame axes in the world as columns, (M, 3, 3); with a free roll the tool axis alone, the last one


def targets_along(
    machine: Machine,
    tasks: Sequence[TipTask],
    times: Array,
    *,
    base: Array,
    joints: Array,
    shown_times: Array | None = None,
) -> tuple[Target, ...]:
    """Return the target poses of all pose tasks along a motion, in world, also of tasks relative to a link.

    Args:
        times: Times on the clock of the tasks, s. Shape (M,).
        base, joints: Configurations. Shapes (M, base_size), (M, joint_size).
        shown_times: Times to report in the targets if they differ from `times`, s. Shape (M,).
    """
    equations = bind(machine, tasks)
    count = len(times)
    target_values = np.array(equations.target_function().map(count)(times[None, :])).reshape(-1, count)
    targets = []
    for bound, rows_of_task in equations.by_task(target_values):
        task, values = bound.task, rows_of_task.T
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


def required_nodes(equations: TaskEquations, breaks: Array) -> Array:
    """Return those breaks (k,) of targets, including both ends, that a mesh needs as nodes to represent the targets.

    Intervals are bisected at the break nearest to their middle until the interpolants of the targets deviate by no more
    than `NODES` allows. A path of many short segments thus needs no more nodes than a smooth path of the same shape.
    Velocity tasks need all breaks, since velocity errors accumulate to a pose error.
    """
    if not all(part.task.is_pose for part in equations.bound):
        return breaks
    time = ca.MX.sym("time")
    sampler = Sampler([time], [equations.target_function()(time)])
    inner = breaks[:-1, None] + np.diff(breaks)[:, None] * np.arange(NODES.samples) / NODES.samples
    values = sampler(inner.reshape(-1, 1))[0]
    largest = np.full(values.shape[1], NODES.pose_error)
    for rates in _target_rows(equations)[1]:
        largest[rates] = NODES.rate_error * np.linalg.norm(values[:, rates], axis=1).max()
    points = np.array(ca.collocation_points(NODES.points, "radau"))
    ends, open_intervals = {0, len(breaks) - 1}, [(0, len(breaks) - 1)]
    while open_intervals:
        first, last = np.transpose(sorted(open_intervals))
        width = breaks[last] - breaks[first]
        fits = sampler((breaks[first, None] + width[:, None] * points).reshape(-1, 1))[0]
        open_intervals = []
        for k, fit in enumerate(fits.reshape(len(first), len(points), -1)):
            inside = slice(first[k] * NODES.samples, last[k] * NODES.samples)
            basis = lagrange(points, (inner.ravel()[inside] - breaks[first[k]]) / width[k])
            if last[k] - first[k] > 1 and (np.abs(basis @ fit - values[inside]) > largest).any():
                middle = int(np.abs(breaks[first[k] + 1 : last[k]] - breaks[first[k]] - width[k] / 2).argmin())
                split = int(first[k]) + 1 + middle
                ends.add(split)
                open_intervals += [(int(first[k]), split), (split, int(last[k]))]
    return breaks[sorted(ends)]


def resolving_times(equations: TaskEquations, times: Array) -> Array:
    """Insert times until target poses are nearly linear between neighbouring times; return all times (k,)."""
    time = ca.MX.sym("time")
    sampler = Sampler([time], [equations.target_function()(time)])
    poses, _ = _target_rows(equations)
    shortest = ROUNDING_SHARE * (times[-1] - times[0])
    while poses:
        middle = (times[:-1] + times[1:]) / 2
        ends, inside = (sampler(part[:, None])[0][:, poses] for part in (times, middle))
        bends = np.abs(inside - (ends[:-1] + ends[1:]) / 2).max(axis=1) > NODES.chord_error
        bends &= np.diff(times) > shortest
        if not bends.any():
            break
        times = np.union1d(times, middle[bends])
    return times


def _target_rows(equations: TaskEquations) -> tuple[list[int], list[slice]]:
    """Return the indices of pose values in the stacked task targets, and the slice of the velocity of each pose."""
    poses, rates, at = list[int](), list[slice](), 0
    for part in equations.bound:
        for pose, rate in part.target_rows.values():
            poses += range(at + pose.start, at + pose.stop)
            rates.append(slice(at + rate.start, at + rate.stop))
        at += part.target_size
    return poses, rates


def _frames(machine: Machine, base: Array, joints: Array) -> tuple[Array, Array]:
    """Return rotations (M, 3, 3) and positions (M, 3) of a machine's tip in world in given configurations."""
    b, q = ca.SX.sym("b", machine.base_size), ca.SX.sym("q", machine.joint_size)
    pose: Any = machine.tip_pose(b, q)
    function = ca.Function("frames", [b, q], [pose.rotation, pose.position])
    rotations, positions = (np.array(value) for value in function.map(len(joints))(base.T, joints.T))
    return rotations.reshape(3, -1, 3).transpose(1, 0, 2), positions.T


def tip_poses(machine: Machine, bases: Array, joints: Array) -> Array:
    """Return tip poses in world, position and quaternion; nan if the robot has no tip. Shape (M, 7)."""
    if machine.robot.tip is None:
        return np.full((len(joints), 7), np.nan)
    rotations, positions = _frames(machine, bases, joints)
    return np.column_stack([positions, quaternion_from_rotation(rotations)])
