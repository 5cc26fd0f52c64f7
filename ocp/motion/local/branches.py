"""IK solutions on all branches of a pose task, from the closed forms of the arm at samples of its free parameters.

Free parameters are the joints beyond those of the closed form and, if the task leaves it open, the roll about the tool
axis or the rotation about the axes of a SCARA. Each sample gives all solutions there; revolute joints are shifted by
whole turns into their limits in all possible ways.
"""

from __future__ import annotations

import numpy as np
import scipy

from models.arrays import Array
from ocp.motion.local.closed_forms import ClosedForm, closed_forms
from ocp.motion.local.inverse_kinematics import idle_positions
from ocp.motion.tasks.equations import TaskEquations
from ocp.motion.tasks.tip_task import ANGULAR, LINEAR

__all__ = ["IkBranches", "ik_branches"]

SLIDE_RANGE_M = 1.0
"""Prismatic joints without limits are sampled this far on either side of 0."""
STEPS = np.sqrt([2.0, 3.0, 5.0, 7.0]) % 1
"""Steps of the free parameters between samples, as shares of their ranges; irrational, so that none repeats."""
TURN = 2 * np.pi


class IkBranches:
    """IK solutions of one pose task at samples of its free parameters. Use `ik_branches` to build it."""

    def __init__(self, equations: TaskEquations, forms: tuple[ClosedForm, ...], lower: Array, upper: Array) -> None:
        self.forms, self.lower, self.upper = forms, lower, upper
        self._task, self._idle = equations.bound[0].task, equations.idle
        self.roll_is_free = not set(self._task.chosen) & set(ANGULAR)

    def solutions(self, targets: Array, count: int, number: int = 0) -> Array:
        """Return the solutions of all branches within the limits, (K, n); joints without limits between -pi and pi.

        Args:
            targets: Targets of the equations. Shape (size,).
            count: Number of samples of the free parameters, over all closed forms.
            number: Number of the first sample; a different one gives other samples.
        """
        solutions = list[Array]()
        for form in self.forms:
            free = len(form.redundant) + self.roll_is_free
            n = -(-count // len(self.forms)) if free else 1
            shares = ((number + np.arange(n) + 0.5)[:, None] * STEPS[:free] + 0.5) % 1
            positions, rotations = self._sample_poses(
                form, targets, shares[:, -1] if self.roll_is_free else np.zeros(n)
            )
            low, high = (np.array(limit)[list(form.redundant)] for limit in (self.lower, self.upper))
            span = np.where(form.turns[list(form.redundant)], np.pi, SLIDE_RANGE_M)
            low, high = np.where(np.isfinite(low), low, -span), np.where(np.isfinite(high), high, span)
            redundant = low + shares[:, : len(form.redundant)] * (high - low)
            solutions.append(form.solutions(positions, rotations, redundant)[1])
        joints = np.concatenate(solutions)
        joints[:, self._idle] = idle_positions(self.lower, self.upper)[self._idle]
        return self._within_limits(joints)

    def _sample_poses(self, form: ClosedForm, targets: Array, shares: Array) -> tuple[Array, Array]:
        """Return tip poses that do the task, the open angle at shares of a turn. Shapes (M, 3), (M, 3, 3)."""
        angles, rotation_type = TURN * shares[:, None], scipy.spatial.transform.Rotation
        if self._task.direction is not None:
            tool, direction = np.array(self._task.tool_axis), targets[6:9] / np.linalg.norm(targets[6:9])
            rotated = rotation_type.from_rotvec(angles * direction)
            rotated *= rotation_type.align_vectors(direction[None], tool[None])[0]
            rotations = rotated.as_matrix()
        elif self.roll_is_free:
            rotations = rotation_type.from_rotvec(angles * form.axes[form.triple[0]]).as_matrix() @ form.rotation
        else:
            rotations = np.repeat(targets[6:15].reshape(1, 3, 3).transpose(0, 2, 1), len(shares), axis=0)
        return np.repeat(targets[None, :3], len(shares), axis=0), rotations

    def _within_limits(self, joints: Array) -> Array:
        """Return the solutions within the limits, with joints shifted by whole turns in all ways that keep them."""
        shiftable = np.flatnonzero(np.isfinite(self.lower) & np.isfinite(self.upper) & self.forms[0].turns)
        for j in shiftable.tolist():
            first = joints[:, j] + TURN * np.ceil((self.lower[j] - 1e-9 - joints[:, j]) / TURN)
            extra_turns = int((self.upper[j] - self.lower[j]) // TURN)
            parts = []
            for turns in range(extra_turns + 1):
                shifted = joints.copy()
                shifted[:, j] = first + TURN * turns
                parts.append(shifted[shifted[:, j] <= self.upper[j] + 1e-9])
            joints = np.concatenate(parts)
        return joints[((joints >= self.lower - 1e-9) & (joints <= self.upper + 1e-9)).all(axis=1)]


def ik_branches(equations: TaskEquations, lower: Array, upper: Array) -> IkBranches | None:
    """Return the IK branches of a task on an arm that has closed forms, None for other tasks and machines.

    Args:
        equations: Equations of one pose of the tip of the arm in the world: the whole pose, a position and a direction,
            or, on a SCARA, the position alone or with the rotation.
        lower, upper: Limits of the joints, infinite for unlimited ones. Shape (n,).
    """
    if len(equations.bound) != 1:
        return None
    task, tip, reference = equations.bound[0]
    whole_position = set(task.chosen) >= set(LINEAR) and task.position is not None and task.within is None
    if reference is not None or not task.is_pose or not whole_position:
        return None
    forms = closed_forms(tip)
    if task.direction is None and not set(task.chosen) >= set(ANGULAR):
        forms = tuple(form for form in forms if form.kind == "scara")
    return IkBranches(equations, forms, lower, upper) if forms else None
