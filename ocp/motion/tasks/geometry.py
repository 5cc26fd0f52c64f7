"""Geometry of a task: frames and twists relative to its reference, pose errors, the rows that it takes of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from models import FreeFloating, Machine, center_of_mass
from models.arrays import Array
from models.spatial import Frame, on_scalars, rotation_from_quaternion, skew
from ocp.errors import ProblemError
from ocp.motion.tasks.tip_task import ANGULAR, TipTask


class BoundTask(NamedTuple):
    """A task, and the machine with the tip in the task's frame and in its reference (None: the world)."""

    task: TipTask
    tip: Machine
    reference: Machine | None


def target_size(task: TipTask) -> int:
    if task.velocity is not None:
        return task.size
    sizes = [(task.position, 6), (task.orientation, 12), (task.direction, 6)]
    return sum(size for track, size in sizes if track is not None)


def split_targets(task: TipTask, wanted: Any) -> tuple[Any, Any]:
    """(Position, velocity) and (rotation, direction or None, angular velocity) of a pose task's targets."""
    place, at = None, 0
    if task.position is not None:
        place, at = (wanted[0:3], wanted[3:6]), 6
    if task.orientation is not None:
        return place, (ca.reshape(wanted[at : at + 9], 3, 3), wanted[at + 9 : at + 12])
    if task.direction is not None:
        return place, (wanted[at : at + 3], wanted[at + 3 : at + 6])
    return place, None


def reference_pose(part: BoundTask, base: Any, joints: Any) -> Frame | None:
    return None if part.reference is None else part.reference.tip_pose(base, joints)


def relative_twist(part: BoundTask, base: Any, joints: Any, twist: Any, rates: Any) -> Any:
    """Twist, or columns of twists, less that of the reference, of whose turning the frame takes part."""
    if part.reference is None:
        return twist
    if isinstance(rates, str):  # by the base's twist
        other = part.reference.jacobians(base, joints)[0]  # type: ignore[attr-defined]
    elif rates is None:
        other = part.reference.tip_jacobian(base, joints)
    else:
        other = part.reference.tip_twist(base, joints, rates)
    arm = part.tip.tip_pose(base, joints).position - part.reference.tip_pose(base, joints).position
    return twist - ca.vertcat(other[0:3, :], other[3:6, :] - ca.mtimes(skew(arm), other[0:3, :]))


def task_rows(part: BoundTask, base: Any, joints: Any, twist: Any) -> Any:
    """The task's rows of a twist in world axes, or of several as columns."""
    task = part.task
    angular, linear = twist[0:3, :], twist[3:6, :]
    turn = None
    if task.axes == "base":
        turn = part.tip.world_from_base(base).rotation
    elif task.axes == "tip":
        turn = part.tip.tip_pose(base, joints).rotation
    elif task.axes == "reference" and part.reference is not None:
        turn = part.reference.tip_pose(base, joints).rotation
    along = twist if turn is None else ca.vertcat(ca.mtimes(turn.T, angular), ca.mtimes(turn.T, linear))
    chosen = along[list(task.chosen), :]
    if not task.tilts:
        return chosen
    across = ca.mtimes(part.tip.tip_pose(base, joints).rotation, _across(task))
    return ca.vertcat(ca.mtimes(across.T, angular), chosen)


def _across(task: TipTask) -> Any:
    """Two unit vectors that with the tool axis are orthogonal, in the frame. Shape (3, 2)."""
    axis = np.asarray(task.tool_axis)
    _, _, right = np.linalg.svd(axis[None, :])
    if np.count_nonzero(axis) == 1:
        right[1:] = np.eye(3)[axis == 0]
    return ca.sparsify(ca.DM(right[1:].T))


def pose_error(part: BoundTask, base: Any, joints: Any, wanted: Any) -> Any:
    """Error of the pose as a twist in world axes: (sine of the angle about its axis, displacement)."""
    place, turning = split_targets(part.task, wanted)
    pose, reference = part.tip.tip_pose(base, joints), reference_pose(part, base, joints)
    angular, linear = ca.DM(3, 1), ca.DM(3, 1)
    if place is not None:
        linear = (place[0] if reference is None else reference.point(place[0])) - pose.position
    if part.task.orientation is not None:
        turn = turning[0] if reference is None else ca.mtimes(reference.rotation, turning[0])
        angular = sum((cross_product(pose.rotation[:, i], turn[:, i]) for i in range(3)), start=ca.DM(3, 1)) / 2
    elif part.task.tilts:
        tool = ca.mtimes(pose.rotation, ca.DM(part.task.tool_axis))
        angular = cross_product(tool, turning[0] if reference is None else ca.mtimes(reference.rotation, turning[0]))
    return ca.vertcat(angular, linear)


def target_twist(part: BoundTask, base: Any, joints: Any, wanted: Any) -> Any:
    """Twist of the target relative to the reference and the feedback, world axes. Shape (6, 1)."""
    place, turning = split_targets(part.task, wanted)
    reference = reference_pose(part, base, joints)
    angular = ca.DM(3, 1) if turning is None else turning[1]
    linear = ca.DM(3, 1) if place is None else place[1]
    if reference is not None:
        angular, linear = ca.mtimes(reference.rotation, angular), ca.mtimes(reference.rotation, linear)
    return ca.vertcat(angular, linear) + part.task.gain * pose_error(part, base, joints, wanted)


def pose_in_reference(part: BoundTask, base: Any, joints: Any) -> tuple[Any, Any]:
    """Position and rotation in the reference."""
    pose, reference = part.tip.tip_pose(base, joints), reference_pose(part, base, joints)
    if reference is None:
        return pose.position, pose.rotation
    turn = reference.rotation
    return ca.mtimes(turn.T, pose.position - reference.position), ca.mtimes(turn.T, pose.rotation)


def pose_holding_task(task: TipTask) -> TipTask:
    return replace(task, velocity=None, position=np.zeros(3), orientation=np.eye(3))


@on_scalars
def pose_error_rows(part: BoundTask, base: Any, joints: Any, targets: Any) -> Any:
    return task_rows(part, base, joints, pose_error(part, base, joints, targets))


def is_holonomic(part: BoundTask) -> Array:
    """Which rows of a task have an integral that does not depend on the way."""
    task = part.task
    if task.is_pose:
        return np.ones(task.size, dtype=bool)
    whole = set(movable_angular_rows(part)) <= set(task.chosen)  # all turning that there is
    fixed_axes = task.axes in ("world", "reference")
    return np.array([whole and fixed_axes if row in ANGULAR else fixed_axes for row in task.chosen], dtype=bool)


def movable_angular_rows(part: BoundTask) -> list[int]:
    """Angular rows in world axes that some joint moves."""
    base, joints = ca.SX.sym("base", part.tip.base_size), ca.SX.sym("joints", part.tip.joint_size)
    jacobian = part.tip.tip_jacobian(base, joints)
    return [row for row in ANGULAR if not all(entry.is_zero() for entry in ca.horzsplit(jacobian[row, :]))]


def derivative(value: Any, time: Any) -> Any:
    return ca.densify(ca.jacobian(value, time)) if isinstance(value, ca.SX | ca.MX) else ca.DM.zeros(*value.shape)


@on_scalars
def rotation_of(quaternion: Any) -> Any:
    return rotation_from_quaternion(quaternion)


@on_scalars
def cross_product(a: Any, b: Any) -> Any:
    return ca.mtimes(skew(a), b)


@on_scalars
def angular_velocity(turn: Any, rate: Any) -> Any:
    spin = ca.mtimes(rate, turn.T)
    return ca.vertcat(spin[2, 1] - spin[1, 2], spin[0, 2] - spin[2, 0], spin[1, 0] - spin[0, 1]) / 2


def closing_combinations(
    machine: FreeFloating, bound: Sequence[BoundTask], chosen: NDArray[np.bool_], base: Array, joints: Array
) -> Array:
    """Combinations of the chosen rows that do not depend on the base's pose, the centre of mass staying. Shape (m, k).

    Raises:
        ProblemError: The centre of mass moves, and the joints cannot return.
    """
    rows = []
    for part in bound:
        by_base = relative_twist(part, base, joints, part.tip.jacobians(base, joints)[0], "base")  # type: ignore[attr-defined]
        rows.append(np.array(ca.DM(task_rows(part, ca.DM(base), ca.DM(joints), by_base))))
    frame = machine.world_from_base(base)
    lever = center_of_mass(machine.robot, joints, frame) - frame.position
    center = np.array(ca.DM(ca.horzcat(-skew(lever), ca.DM.eye(3))))[:, machine.twist_rows]
    task = np.vstack(rows)[chosen]
    closes = _combinations(np.vstack([task, center]), len(task))
    linear = machine.twist_rows.index(3)  # the rows of the angular momentum come first
    if np.any(np.asarray(machine.conserved_momentum)[linear:]):
        alone = _combinations(task, len(task))
        if alone.shape[1] < closes.shape[1]:
            words = (
                "cyclic: the linear momentum moves the centre of mass on, and the joints cannot return together "
                "with a tip that returns in the world; let the task be relative to the base"
            )
            raise ProblemError(words, name="cyclic", value=machine.conserved_momentum)
        closes = alone
    return closes


def _combinations(by_base: Array, count: int) -> Array:
    """Orthonormal combinations of the first `count` rows, with any of the others, that are zero. Shape (count, k)."""
    left, values, _ = np.linalg.svd(by_base)
    rank = int(np.sum(values > 1e-9 * max(values[0], 1.0)))
    of_task, shares, _ = np.linalg.svd(left[:count, rank:], full_matrices=False)
    return np.asarray(of_task[:, : int(np.sum(shares > 1e-9))])
