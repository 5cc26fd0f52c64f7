"""Geometry of a tip task: relative twists, pose errors, and the rows that the task selects from them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from models import FreeFloating, Machine, center_of_mass
from models.checks import Array
from models.spatial import Frame, on_scalars, rotation_from_quaternion, skew
from ocp.errors import ProblemError
from ocp.motion.tasks.tip_task import ANGULAR, TipTask


class BoundTask(NamedTuple):
    """A task with the machine whose tip is the frame of the task, and one for the reference frame (None: the world)."""

    task: TipTask
    tip: Machine
    reference: Machine | None


def target_size(task: TipTask) -> int:
    """Return the number of entries that a task takes in the column of targets."""
    if task.velocity is not None:
        return task.size
    sizes = [(task.position, 6), (task.orientation, 12), (task.direction, 6)]
    return sum(size for track, size in sizes if track is not None)


def split_targets(task: TipTask, targets: Any) -> tuple[Any, Any]:
    """Return (position, velocity) and (rotation or direction, angular velocity) of a pose task, each or None."""
    translation, at = None, 0
    if task.position is not None:
        translation, at = (targets[0:3], targets[3:6]), 6
    if task.orientation is not None:
        return translation, (ca.reshape(targets[at : at + 9], 3, 3), targets[at + 9 : at + 12])
    if task.direction is not None:
        return translation, (targets[at : at + 3], targets[at + 3 : at + 6])
    return translation, None


def reference_pose(part: BoundTask, base: Any, joints: Any) -> Frame | None:
    """Return the pose of the reference frame in the world, None if the reference is the world."""
    return None if part.reference is None else part.reference.tip_pose(base, joints)


def relative_twist(part: BoundTask, base: Any, joints: Any, twist: Any, rates: Any) -> Any:
    """Return a twist, or columns of twists, relative to the reference frame at the tip of the task, in world axes.

    Args:
        twist: Twist of the tip, (6, 1), or the columns of its Jacobian.
        rates: Joint rates of a single twist; None for the joint Jacobian, "base" for that by the base twist.
    """
    if part.reference is None:
        return twist
    if isinstance(rates, str):
        moving = part.reference.jacobians(base, joints)[0]  # type: ignore[attr-defined]
    elif rates is None:
        moving = part.reference.tip_jacobian(base, joints)
    else:
        moving = part.reference.tip_twist(base, joints, rates)
    lever = part.tip.tip_pose(base, joints).position - part.reference.tip_pose(base, joints).position
    return twist - ca.vertcat(moving[0:3, :], moving[3:6, :] - ca.mtimes(skew(lever), moving[0:3, :]))


def task_rows(part: BoundTask, base: Any, joints: Any, twist: Any) -> Any:
    """Return the rows of the task from a twist in world axes, or from several twists as columns."""
    task = part.task
    angular, linear = twist[0:3, :], twist[3:6, :]
    rotation = None
    if task.axes == "base":
        rotation = part.tip.world_from_base(base).rotation
    elif task.axes == "tip":
        rotation = part.tip.tip_pose(base, joints).rotation
    elif task.axes == "reference" and part.reference is not None:
        rotation = part.reference.tip_pose(base, joints).rotation
    rotated = twist if rotation is None else ca.vertcat(ca.mtimes(rotation.T, angular), ca.mtimes(rotation.T, linear))
    selected = rotated[list(task.chosen), :]
    if not task.tilts:
        return selected
    normals = ca.mtimes(part.tip.tip_pose(base, joints).rotation, _tool_normals(task))
    return ca.vertcat(ca.mtimes(normals.T, angular), selected)


def _tool_normals(task: TipTask) -> Any:
    """Return two unit vectors that form an orthogonal basis with the tool axis, in the tool frame. Shape (3, 2)."""
    axis = np.asarray(task.tool_axis)
    _, _, basis = np.linalg.svd(axis[None, :])
    if np.count_nonzero(axis) == 1:
        basis[1:] = np.eye(3)[axis == 0]
    return ca.sparsify(ca.DM(basis[1:].T))


def pose_error(part: BoundTask, base: Any, joints: Any, targets: Any) -> Any:
    """Return the pose error as a twist in world axes: (sine of the angle about its axis, displacement)."""
    position_target, goal = split_targets(part.task, targets)
    pose, reference = part.tip.tip_pose(base, joints), reference_pose(part, base, joints)
    angular, linear = ca.DM(3, 1), ca.DM(3, 1)
    if position_target is not None:
        linear = (position_target[0] if reference is None else reference.point(position_target[0])) - pose.position
    if part.task.orientation is not None:
        rotation = goal[0] if reference is None else ca.mtimes(reference.rotation, goal[0])
        angular = sum((cross_product(pose.rotation[:, i], rotation[:, i]) for i in range(3)), start=ca.DM(3, 1)) / 2
    elif part.task.tilts:
        tool = ca.mtimes(pose.rotation, ca.DM(part.task.tool_axis))
        angular = cross_product(tool, goal[0] if reference is None else ca.mtimes(reference.rotation, goal[0]))
    return ca.vertcat(angular, linear)


def target_twist(part: BoundTask, base: Any, joints: Any, targets: Any) -> Any:
    """Return the twist of the target relative to the reference plus the fed-back pose error, in world axes. Shape (6,
    1).
    """
    position_target, rotation_target = split_targets(part.task, targets)
    reference = reference_pose(part, base, joints)
    angular = ca.DM(3, 1) if rotation_target is None else rotation_target[1]
    linear = ca.DM(3, 1) if position_target is None else position_target[1]
    if reference is not None:
        angular, linear = ca.mtimes(reference.rotation, angular), ca.mtimes(reference.rotation, linear)
    return ca.vertcat(angular, linear) + part.task.gain * pose_error(part, base, joints, targets)


def pose_in_reference(part: BoundTask, base: Any, joints: Any) -> tuple[Any, Any]:
    """Return position and rotation of the tip in the reference frame."""
    pose, reference = part.tip.tip_pose(base, joints), reference_pose(part, base, joints)
    if reference is None:
        return pose.position, pose.rotation
    rotation = reference.rotation
    return ca.mtimes(rotation.T, pose.position - reference.position), ca.mtimes(rotation.T, pose.rotation)


@on_scalars
def pose_error_rows(part: BoundTask, base: Any, joints: Any, targets: Any) -> Any:
    """Return the pose error in the rows of the task."""
    return task_rows(part, base, joints, pose_error(part, base, joints, targets))


def is_holonomic(part: BoundTask) -> Array:
    """Return which rows of a task have an integral that does not depend on the path. Shape (size,), bool."""
    task = part.task
    if task.is_pose:
        return np.ones(task.size, dtype=bool)
    all_angular = set(movable_angular_rows(part)) <= set(task.chosen)
    fixed_axes = task.axes in ("world", "reference")
    return np.array([all_angular and fixed_axes if row in ANGULAR else fixed_axes for row in task.chosen], dtype=bool)


def movable_angular_rows(part: BoundTask) -> list[int]:
    """Return the angular rows, in world axes, that some joint moves."""
    base, joints = ca.SX.sym("base", part.tip.base_size), ca.SX.sym("joints", part.tip.joint_size)
    jacobian = part.tip.tip_jacobian(base, joints)
    return [row for row in ANGULAR if not all(entry.is_zero() for entry in ca.horzsplit(jacobian[row, :]))]


def derivative(value: Any, time: Any) -> Any:
    """Return the dense derivative of an expression by the time, zeros for a constant."""
    return ca.densify(ca.jacobian(value, time)) if isinstance(value, ca.SX | ca.MX) else ca.DM.zeros(*value.shape)


@on_scalars
def rotation_of(quaternion: Any) -> Any:
    """Return the rotation matrix of a quaternion, on scalar symbols."""
    return rotation_from_quaternion(quaternion)


@on_scalars
def cross_product(a: Any, b: Any) -> Any:
    """Return a x b, on scalar symbols."""
    return ca.mtimes(skew(a), b)


@on_scalars
def angular_velocity(rotation: Any, rate: Any) -> Any:
    """Return the angular velocity in world axes from a rotation matrix and its derivative. Shape (3, 1)."""
    spin = ca.mtimes(rate, rotation.T)
    return ca.vertcat(spin[2, 1] - spin[1, 2], spin[0, 2] - spin[2, 0], spin[1, 0] - spin[0, 1]) / 2


def closing_combinations(
    machine: FreeFloating, bound_tasks: Sequence[BoundTask], selected: NDArray[np.bool_], base: Array, joints: Array
) -> Array:
    """Return combinations of the selected rows that no base motion changes while the centre of mass stays. Shape (m,
    k).

    Raises:
        ProblemError: The momentum moves the centre of mass, and the joints cannot return.
    """
    jacobians = []
    for bound in bound_tasks:
        base_jacobian = relative_twist(bound, base, joints, bound.tip.jacobians(base, joints)[0], "base")  # type: ignore[attr-defined]
        jacobians.append(np.array(ca.DM(task_rows(bound, ca.DM(base), ca.DM(joints), base_jacobian))))
    frame = machine.world_from_base(base)
    lever = center_of_mass(machine.robot, joints, frame) - frame.position
    center = np.array(ca.DM(ca.horzcat(-skew(lever), ca.DM.eye(3))))[:, machine.twist_rows]
    task = np.vstack(jacobians)[selected]
    closing = _combinations(np.vstack([task, center]), len(task))
    linear = machine.twist_rows.index(3)  # the rows of the angular momentum come first
    if np.any(np.asarray(machine.conserved_momentum)[linear:]):
        without_center = _combinations(task, len(task))
        if without_center.shape[1] < closing.shape[1]:
            words = (
                "cyclic: the linear momentum keeps moving the centre of mass, so the joints and a tip prescribed "
                "in the world cannot both return to the start; define the task relative to the base"
            )
            raise ProblemError(words, name="cyclic", value=machine.conserved_momentum)
        closing = without_center
    return closing


def _combinations(jacobian: Array, count: int) -> Array:
    """Return orthonormal combinations of the first `count` rows that vanish together with any of the others. Shape
    (count, k).
    """
    left, values, _ = np.linalg.svd(jacobian)
    rank = int(np.sum(values > 1e-9 * max(values[0], 1.0)))
    combinations, shares, _ = np.linalg.svd(left[:count, rank:], full_matrices=False)
    return np.asarray(combinations[:, : int(np.sum(shares > 1e-9))])
