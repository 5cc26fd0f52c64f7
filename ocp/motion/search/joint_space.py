"""Where postures lie: joints that turn without end come round, and distances are those of the squared rates.

Tasks of a machine some of whose joints are held.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from models import Machine
from models.arrays import Array
from ocp.motion.tasks.equations import TaskEquations

__all__ = ["FARTHEST", "TOLERANCE", "TURN", "Held", "JointSpace"]

Indices = NDArray[np.intp]

TOLERANCE = 1e-9
"""m and rad: by which postures may miss their tasks and pass limits."""
TURN = 2 * np.pi
FARTHEST = 1e6
"""rad or m: no step goes farther, and in the tree that neighbours are looked up in the sets of two instants are as far
from each other."""


class JointSpace:
    """Where postures lie: joints that turn without end come round, and distances are those of the squared rates.

    Attributes:
        scale: Square roots of the weights: the metric is |scale * dq|. Shape (n,).
        periodic: Which joints turn without end; two turns within their limits do, since one of these can be chosen.
        lower, upper: Limits of the others. Shape (n,).
    """

    def __init__(self, machine: Machine, lower: Array, upper: Array, weights: Array) -> None:
        robot = machine.robot
        coupled = {joint.mimic.joint for joint in robot.joints if joint.mimic is not None}
        turns = [joint.kind != "prismatic" and joint.name not in coupled for joint in robot.moving_joints]
        self.scale = np.sqrt(weights)
        self.periodic = np.array(turns) & ~(upper - lower < 2 * TURN - 1e-6)
        self.lower = np.where(self.periodic, -np.inf, lower)
        self.upper = np.where(self.periodic, np.inf, upper)

    def difference(self, to: Array, of: Array) -> Array:
        """to - of, (..., n), the shorter way round for joints that turn without end."""
        apart = to - of
        around = apart[..., self.periodic]
        apart[..., self.periodic] = around - TURN * np.round(around / TURN)
        return np.asarray(apart)

    def length(self, way: Array) -> Array:
        """Of ways (..., n) in the metric."""
        return np.asarray(np.linalg.norm(way * self.scale, axis=-1))

    def within(self, joints: Array) -> NDArray[np.bool_]:
        """Whether postures (..., n) keep the limits."""
        with np.errstate(invalid="ignore"):
            return np.asarray(((joints >= self.lower - TOLERANCE) & (joints <= self.upper + TOLERANCE)).all(axis=-1))

    def turned(self, path: Array, lower: Array, upper: Array) -> Array:
        """A path (K, n) moved by whole turns of joints to the middle between limits (n,) of theirs."""
        own = np.flatnonzero(self.periodic & np.isfinite(lower) & np.isfinite(upper))
        middle = (lower[own] + upper[own] - path[:, own].min(axis=0) - path[:, own].max(axis=0)) / 2
        turned = path.copy()
        turned[:, own] += TURN * np.round(middle / TURN)
        return turned

    def tree(self, joints: Array, layer: Indices | None = None) -> Any:
        """Tree of postures (M, n), to be asked with what `placed` says; those of other layers are far."""
        size = np.append(0.0, np.where(self.periodic, TURN * self.scale, 0.0))
        return cKDTree(self.placed(joints, layer), boxsize=size if self.periodic.any() else None)  # None is faster

    def placed(self, joints: Array, layer: Indices | None = None) -> Array:
        """Points of the tree."""
        wrapped = joints.copy()
        wrapped[:, self.periodic] = np.remainder(wrapped[:, self.periodic], TURN)
        return np.column_stack([np.zeros(len(joints)) if layer is None else FARTHEST * layer, wrapped * self.scale])


@dataclass(frozen=True, eq=False)
class Held(TaskEquations):
    """Equations of tasks and last rows: some joints are to be where the last of the targets say.

    Attributes:
        held: Numbers of these joints.
    """

    held: tuple[int, ...]

    @property
    def size(self) -> int:
        return super().size + len(self.held)

    def _rows(self, joints: Any, targets: Any) -> Any:
        return targets[targets.numel() - len(self.held) :] - joints[list(self.held)]

    def error(self, base: Any, joints: Any, targets: Any) -> Any:
        return ca.vertcat(super().error(base, joints, targets), self._rows(joints, targets))

    def pose_residual(self, base: Any, joints: Any, targets: Any) -> Any:
        return ca.vertcat(super().pose_residual(base, joints, targets), self._rows(joints, targets))

    def jacobian(self, base: Any, joints: Any) -> Any:
        rows = ca.DM.eye(self.machine.joint_size)[list(self.held), :]
        return ca.vertcat(super().jacobian(base, joints), rows)

    @property
    def _symbols(self) -> tuple[Any, Any, Any]:
        base, joints, targets = super()._symbols
        return base, joints, ca.SX.sym("targets", targets.numel() + len(self.held))
