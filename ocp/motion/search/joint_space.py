"""Metric of the joint space with periodic joints, and task equations with some joints fixed."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np
import scipy
from numpy.typing import NDArray

from models import Machine, Robot
from models.checks import Array
from ocp.motion.tasks.equations import TaskEquations

Indices = NDArray[np.intp]

TOLERANCE = 1e-9
"""Largest task error, and largest excess over a joint limit, that a valid configuration may have, m and rad."""
FULL_TURN = 2 * np.pi
MAX_STEP = 1e6
"""Upper bound of the length of a step between two time samples, rad or m.

The nearest-neighbour tree also keeps configurations of different time samples this far apart.
"""


class JointSpace:
    """Joint space with a weighted Euclidean metric, in which revolute joints without limits are periodic.

    Attributes:
        scale: Square roots of the weights of the squared joint rates; the metric is |scale * dq|. Shape (n,).
        periodic: Mask of the periodic joints. A revolute joint whose range spans two full turns counts as one, since
            some turn always lies within its limits; a joint that others mimic does not. Shape (n,).
        lower, upper: Limits of the other joints, rad or m. Shape (n,).
    """

    def __init__(self, machine: Machine, lower: Array, upper: Array, weights: Array) -> None:
        robot = machine.robot
        coupled = {joint.mimic.joint for joint in robot.joints if joint.mimic is not None}
        turns = [joint.kind != "prismatic" and joint.name not in coupled for joint in robot.moving_joints]
        self.scale = np.sqrt(weights)
        self.periodic = np.array(turns) & ~(upper - lower < 2 * FULL_TURN - 1e-6)
        self.lower = np.where(self.periodic, -np.inf, lower)
        self.upper = np.where(self.periodic, np.inf, upper)

    def difference(self, to: Array, start: Array) -> Array:
        """Return the joint displacements (..., n) from `start` to `to`; periodic joints turn by at most half a turn."""
        delta = to - start
        turns = delta[..., self.periodic]
        delta[..., self.periodic] = turns - FULL_TURN * np.round(turns / FULL_TURN)
        return np.asarray(delta)

    def joint_difference(self, joint: int, to: Array, start: Array) -> Array:
        """Return the displacements (M,) of one joint; a periodic joint turns by at most half a turn."""
        delta = to - start
        return np.asarray(delta - FULL_TURN * np.round(delta / FULL_TURN)) if self.periodic[joint] else delta

    def length(self, displacement: Array) -> Array:
        """Return the lengths of joint displacements (..., n) in the metric of the joint space."""
        return np.asarray(np.linalg.norm(displacement * self.scale, axis=-1))

    def within(self, joints: Array) -> NDArray[np.bool_]:
        """Return which configurations (..., n) are within the joint limits."""
        with np.errstate(invalid="ignore"):
            return np.asarray(((joints >= self.lower - TOLERANCE) & (joints <= self.upper + TOLERANCE)).all(axis=-1))

    def shift_turns(self, path: Array, lower: Array, upper: Array) -> Array:
        """Return a joint path (K, n) after shifting periodic joints by full turns towards the middle of their range."""
        limited = np.flatnonzero(self.periodic & np.isfinite(lower) & np.isfinite(upper))
        middle = (lower[limited] + upper[limited] - path[:, limited].min(axis=0) - path[:, limited].max(axis=0)) / 2
        shifted = path.copy()
        shifted[:, limited] += FULL_TURN * np.round(middle / FULL_TURN)
        return shifted

    def tree(self, joints: Array, layer: Indices | None = None) -> Any:
        """Return a k-d tree of configurations (M, n) for nearest-neighbour queries with points from `tree_points`."""
        box = np.append(0.0, np.where(self.periodic, FULL_TURN * self.scale, 0.0))
        periods = box if self.periodic.any() else None  # None is faster
        return scipy.spatial.cKDTree(self.tree_points(joints, layer), boxsize=periods)

    def tree_points(self, joints: Array, layer: Indices | None = None) -> Array:
        """Return the coordinates of configurations (M, n) for the nearest-neighbour tree. Shape (M, 1 + n).

        The first coordinate separates configurations of different time samples (layers) by MAX_STEP.
        """
        wrapped = joints.copy()
        wrapped[:, self.periodic] = np.remainder(wrapped[:, self.periodic], FULL_TURN)
        return np.column_stack([np.zeros(len(joints)) if layer is None else MAX_STEP * layer, wrapped * self.scale])


@dataclass(frozen=True, eq=False)
class TasksWithFixedJoints(TaskEquations):
    """Task equations extended by equations that fix some joints; the fixed positions are appended to the targets.

    Attributes:
        fixed: Indices of the fixed joints.
    """

    fixed: tuple[int, ...]

    @property
    def size(self) -> int:
        return super().size + len(self.fixed)

    def _rows(self, joints: Any, targets: Any) -> Any:
        return targets[targets.numel() - len(self.fixed) :] - joints[list(self.fixed)]

    def error(self, base: Any, joints: Any, targets: Any) -> Any:
        return ca.vertcat(super().error(base, joints, targets), self._rows(joints, targets))

    def pose_residual(self, base: Any, joints: Any, targets: Any) -> Any:
        return ca.vertcat(super().pose_residual(base, joints, targets), self._rows(joints, targets))

    def jacobian(self, base: Any, joints: Any) -> Any:
        rows = ca.DM.eye(self.machine.joint_size)[list(self.fixed), :]
        return ca.vertcat(super().jacobian(base, joints), rows)

    @property
    def _symbols(self) -> tuple[Any, Any, Any]:
        base, joints, targets = super()._symbols
        return base, joints, ca.SX.sym("targets", targets.numel() + len(self.fixed))


# ---- whole turns of limited joints -----------------------------------------------------------------------------------


def turning_joints(robot: Robot, lower: Array, upper: Array) -> NDArray[np.intp]:
    """Return the indices of the revolute joints whose limits are at least a full turn apart.

    They have at least one finite limit, and no other joint mimics them.

    Args:
        robot: The robot.
        lower, upper: Limits. Shape (n,), rad or m.
    """
    leaders = np.bincount([coupling.column for coupling in robot.couplings.values()], minlength=robot.dof)
    revolute = np.array([joint.kind != "prismatic" for joint in robot.moving_joints])
    limited = np.isfinite(lower) | np.isfinite(upper)
    return np.flatnonzero(revolute & (leaders == 1) & limited & (upper - lower >= FULL_TURN - TOLERANCE))


def whole_turns_between(start: Array, end: Array, lower: Any = -np.inf, upper: Any = np.inf) -> Array:
    """Return the multiples of 2 pi that bring the angles `start` closest to `end` within the limits, rad."""
    least, greatest = np.ceil((lower - start) / FULL_TURN), np.floor((upper - start) / FULL_TURN)
    return np.asarray(FULL_TURN * np.clip(np.round((end - start) / FULL_TURN), least, greatest))


def whole_turns_into(joints: Array, lower: Array, upper: Array) -> tuple[Array, NDArray[np.bool_]]:
    """Return the multiples of 2 pi that shift joint motions towards mid-range, and which joints are then within limits.

    Args:
        joints: Motions of k joints. Shape (K, M, k), rad.
        lower, upper: Limits, at least one of each joint finite. Shape (k,).

    Returns:
        Shapes (K, k): turns, rad; whether all samples are within the limits. No other turns fit where these do not.
    """
    least, greatest = joints.min(axis=1), joints.max(axis=1)
    # replace a missing limit by one that is too far away to restrict the motion
    low = np.where(np.isfinite(lower), lower, upper - (greatest - least) - 2 * FULL_TURN)
    high = np.where(np.isfinite(upper), upper, lower + (greatest - least) + 2 * FULL_TURN)
    with np.errstate(invalid="ignore"):  # a motion that diverges fits nowhere
        turns = whole_turns_between((least + greatest) / 2, (low + high) / 2)
        return turns, (least + turns >= lower - TOLERANCE) & (greatest + turns <= upper + TOLERANCE)


def all_turns(joints: Array, known: Array, lower: Array, upper: Array) -> Array:
    """Return all configurations within limits that differ from a given configuration by full turns of its joints.

    Args:
        joints: Angles. Shape (k,), rad.
        known: Final angles of joints that are not shifted; nan for the others. Shape (k,).
        lower, upper: Limits, at least one of each joint finite. Shape (k,).

    Returns:
        Shape (m, k), rad. A joint with one limit has the two turns next to it.
    """
    turns = list[Array]()
    for angle, fixed, low, high in zip(joints, known, lower, upper, strict=True):
        least = np.ceil((low - angle) / FULL_TURN - TOLERANCE)
        greatest = np.floor((high - angle) / FULL_TURN + TOLERANCE)
        least = greatest - 1 if np.isinf(least) else least
        greatest = least + 1 if np.isinf(greatest) else greatest
        turns.append(angle + FULL_TURN * np.arange(least, greatest + 1) if np.isnan(fixed) else np.array([fixed]))
    return np.stack(np.meshgrid(*turns, indexing="ij"), axis=-1).reshape(-1, len(joints))
