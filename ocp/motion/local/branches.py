"""Postures of all branches of a task: where the arm has closed forms, all that they list at samples of what is free.

Freedom lies in joints beyond those that a closed form needs, and in the roll about the tool axis, or the turn about a
SCARA's axes, where the task leaves that open. Samples of these give all postures there, of every branch that reaches
one of them; joints are turned by whole turns into their limits, in all ways.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from models.arrays import Array
from ocp.motion.local.closed_forms import ClosedForm, closed_forms
from ocp.motion.local.inverse_kinematics import idle_positions
from ocp.motion.tasks.equations import TaskEquations
from ocp.motion.tasks.tip_task import ANGULAR, LINEAR

__all__ = ["IkBranches", "ik_branches"]

SLIDE = 1.0
"""m on either side of 0: where joints that slide without end are sampled."""
STEPS = np.sqrt([2.0, 3.0, 5.0, 7.0]) % 1
"""Of what is free from sample to sample, as shares of its range: irrational, so that no place is sampled twice."""
TURN = 2 * np.pi


class IkBranches:
    """The postures of one pose task, of whose free directions samples are taken. Make it with `branches_of`."""

    def __init__(self, equations: TaskEquations, forms: tuple[ClosedForm, ...], lower: Array, upper: Array) -> None:
        self.forms, self.lower, self.upper = forms, lower, upper
        self._task, self._idle = equations.bound[0].task, equations.idle
        self.open = not set(self._task.chosen) & set(ANGULAR)

    def postures(self, targets: Array, count: int, number: int = 0) -> Array:
        """Joints of all branches, (K, n), within limits, angles of joints without end between -pi and pi.

        Args:
            targets: Of the equations. Shape (size,).
            count: Samples of what is free, of all closed forms together.
            number: Of the first sample: other ones are taken at the next instant.
        """
        found = list[Array]()
        for form in self.forms:
            free = len(form.held) + self.open
            each = -(-count // len(self.forms)) if free else 1
            shares = ((number + np.arange(each) + 0.5)[:, None] * STEPS[:free] + 0.5) % 1
            places, rotations = self._poses(form, targets, shares[:, -1] if self.open else np.zeros(each))
            low, high = (np.array(limit)[list(form.held)] for limit in (self.lower, self.upper))
            span = np.where(form.turns[list(form.held)], np.pi, SLIDE)
            low, high = np.where(np.isfinite(low), low, -span), np.where(np.isfinite(high), high, span)
            found.append(form.postures(places, rotations, low + shares[:, : len(form.held)] * (high - low))[1])
        joints = np.concatenate(found)
        joints[:, self._idle] = idle_positions(self.lower, self.upper)[self._idle]
        return self._within(joints)

    def _poses(self, form: ClosedForm, targets: Array, shares: Array) -> tuple[Array, Array]:
        """Poses of the tip that do the task, with its open angle at shares of a turn. Shapes (M, 3), (M, 3, 3)."""
        turns = TURN * shares[:, None]
        if self._task.direction is not None:
            tool, way = np.array(self._task.tool_axis), targets[6:9] / np.linalg.norm(targets[6:9])
            turned = Rotation.from_rotvec(turns * way) * Rotation.align_vectors(way[None], tool[None])[0]
            rotations = turned.as_matrix()
        elif self.open:
            rotations = Rotation.from_rotvec(turns * form.ways[form.three[0]]).as_matrix() @ form.rotation
        else:
            rotations = np.repeat(targets[6:15].reshape(1, 3, 3).transpose(0, 2, 1), len(shares), axis=0)
        return np.repeat(targets[None, :3], len(shares), axis=0), rotations

    def _within(self, joints: Array) -> Array:
        """Those that keep the limits, with joints turned by whole turns in all ways that do."""
        turning = np.flatnonzero(np.isfinite(self.lower) & np.isfinite(self.upper) & self.forms[0].turns)
        for j in turning.tolist():
            first = joints[:, j] + TURN * np.ceil((self.lower[j] - 1e-9 - joints[:, j]) / TURN)
            more = int((self.upper[j] - self.lower[j]) // TURN)
            parts = []
            for turns in range(more + 1):
                part = joints.copy()
                part[:, j] = first + TURN * turns
                parts.append(part[part[:, j] <= self.upper[j] + 1e-9])
            joints = np.concatenate(parts)
        return joints[((joints >= self.lower - 1e-9) & (joints <= self.upper + 1e-9)).all(axis=1)]


def ik_branches(equations: TaskEquations, lower: Array, upper: Array) -> IkBranches | None:
    """The branches of a task on an arm that has closed forms; None of other tasks and machines.

    Args:
        equations: Of one pose of the arm's own tip in the world: the whole of it, a place and a direction, or, of a
            SCARA, the place alone or with the turn.
        lower, upper: Limits of the joints, infinite for those that turn without end. Shape (n,).
    """
    if len(equations.bound) != 1:
        return None
    task, tip, reference = equations.bound[0]
    whole = set(task.chosen) >= set(LINEAR) and task.position is not None and task.within is None
    if reference is not None or not task.is_pose or not whole:
        return None
    forms = closed_forms(tip)
    if task.direction is None and not set(task.chosen) >= set(ANGULAR):
        forms = tuple(form for form in forms if form.kind == "scara")
    return IkBranches(equations, forms, lower, upper) if forms else None
