"""Many local motions at once: each keeps its tips on their tasks with the least joint rates, inside the joints' limits.

What posture the motion starts from decides where it leads. Followed on one grid of times from all of them together, a
prediction with the least rates and a correction of the poses that are left, they are found at the cost of a few: where
each one leads, what it costs, and where it cannot follow. They are the guesses of plans, and no plans themselves.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np

from models.arrays import Array
from ocp.tasks.equations import TaskEquations

__all__ = ["Followed", "follow"]

CORRECTIONS = 2
"""Of the poses after each step; the second one leaves about the fourth power of what the step missed."""


@dataclass(frozen=True, eq=False)
class Followed:
    """K local motions at M times.

    Attributes:
        t: Shape (M,), s.
        base: Shape (K, M, base_size).
        joints: Shape (K, M, joint_size), within the limits.
        rates: Mean joint rates from each time to the next, and the last ones again. Shape (K, M, joint_size).
        cost: Integral of half the weighted squared joint rates. Shape (K,).
        misfit: Largest pose error anywhere, m and rad; infinite where a motion ran away. Shape (K,).
        lost_at: When the pose error is largest, s. Shape (K,).
    """

    t: Array
    base: Array
    joints: Array
    rates: Array
    cost: Array
    misfit: Array
    lost_at: Array

    @classmethod
    def resting(cls, times: Array, base: Array, joints: Array) -> Followed:
        """Motions in which nothing moves.

        Args:
            times: Shape (M,), s. base, joints: Shape (K, base_size) and (K, joint_size).
        """
        count, many = len(joints), len(times)
        still, none = np.zeros((count, many, joints.shape[1])), np.zeros(count)
        places, angles = (np.repeat(each[:, None], many, axis=1) for each in (base, joints))
        return cls(times, places, angles, still, none, none, none)

    def of(self, rows: Any) -> Followed:
        """Some of the motions."""
        kept = (self.base, self.joints, self.rates, self.cost, self.misfit, self.lost_at)
        return Followed(self.t, *(part[rows] for part in kept))


def follow(
    equations: TaskEquations,
    joints: Array,
    base: Array,
    times: Array,
    *,
    weights: Array,
    damping: float,
    lower: Array,
    upper: Array,
) -> Followed:
    """Follow tasks from several postures.

    Args:
        equations: Of the tasks, at times of their own.
        joints: At the first time. Shape (K, joint_size).
        base: At the first time. Shape (K, base_size).
        times: Increasing. Shape (M,), s.
        weights: Of the squared joint rates. Shape (joint_size,).
        damping: Relative to the root mean square of the singular values of the tasks' Jacobian.
        lower, upper: Limits of the joints. Shape (joint_size,).
    """
    machine, count, steps = equations.machine, len(joints), np.diff(times)
    targets = np.array(equations.target_function().map(len(times))(times[None, :]))
    task = equations.function().map(count)
    b, q, u = ca.SX.sym("b", machine.base_size), ca.SX.sym("q", machine.joint_size), ca.SX.sym("u", machine.joint_size)
    moves = ca.Function("moves", [b, q, u], [machine.base_rate(b, q, u)]).map(count) if machine.base_size else None
    posed, most = equations.posed, np.cos(equations.most_lean)
    leaning = _leaning(equations).map(count) if most.size else None
    place, at = np.array(base, dtype=float), np.clip(joints, lower, upper)
    bases, postures, misfits = [place], [at], list[Array]()

    def asked(k: int) -> tuple[Array, Array, Array, Array]:
        """Jacobians (K, m, n), what they are to give (K, m), pose errors (K, m), and misfits (K,)."""
        jacobian, right, error, misfit = (
            np.array(part) for part in task(place.T, at.T, np.repeat(targets[:, k : k + 1], count, axis=1))
        )
        matrix = jacobian.reshape(equations.size, count, machine.joint_size).transpose(1, 0, 2)
        off = np.abs(misfit).max(axis=0, initial=0.0)
        right, error = right.T, np.where(posed, error.T, 0.0)
        if leaning is not None:  # axes that lean too far are turned back, others may turn as they like
            cosines, slopes = (
                np.array(part) for part in leaning(place.T, at.T, np.repeat(targets[:, k : k + 1], count, 1))
            )
            missing = np.maximum(most - cosines.T, 0.0)
            turning = slopes.reshape(most.size, count, machine.joint_size).transpose(1, 0, 2)
            matrix = np.concatenate([matrix, np.where((missing > 0)[:, :, None], turning, 0.0)], axis=1)
            right, error = np.hstack([right, np.zeros_like(missing)]), np.hstack([error, missing])
        return matrix, right, error, np.where(np.isfinite(off), off, np.inf)

    def moved(step: Array, drifting: float) -> Array:
        """The base (K, base_size) after joints moved by `step`, in a time in which it drifts too."""
        if moves is None:
            return place
        still = np.array(moves(place.T, at.T, np.zeros_like(at).T)).T
        return np.asarray(place + np.array(moves(place.T, at.T, step.T)).T - still + drifting * still)

    for k, h in enumerate([*steps, 0.0]):
        matrix, right, error, misfit = asked(k)
        for _ in range(CORRECTIONS if k else 0):
            correction = _least(matrix, error, weights, damping, at, lower, upper)
            place, at = moved(correction, 0.0), np.clip(at + correction, lower, upper)
            matrix, right, error, misfit = asked(k)
        bases[k], postures[k] = place, at
        misfits.append(misfit)
        if h:
            first = h * _least(matrix, right, weights, damping, at, lower, upper)
            start = place, at
            place, at = moved(first, h), np.clip(at + first, lower, upper)
            matrix, right, _, _ = asked(k + 1)
            second = h * _least(matrix, right, weights, damping, at, lower, upper)
            place, at = start
            mean = (first + second) / 2
            place, at = moved(mean, h), np.clip(at + mean, lower, upper)
            bases.append(place)
            postures.append(at)
    path = np.stack(postures, axis=1)
    rates = np.diff(path, axis=1) / steps[:, None]
    off = np.stack(misfits, axis=1)
    worst = off.argmax(axis=1)
    return Followed(
        times,
        np.stack(bases, axis=1),
        path,
        np.concatenate([rates, rates[:, -1:]], axis=1),
        np.asarray(np.einsum("kmn,n,m->k", rates**2, weights, steps) / 2),
        off.max(axis=1),
        times[worst],
    )


def _leaning(equations: TaskEquations) -> Any:
    """casadi Function (base, joints, targets) -> cosines of the angles by which axes lean, and their slopes in q."""
    machine = equations.machine
    b, q, u = (ca.SX.sym("v", size) for size in (machine.base_size, machine.joint_size, machine.joint_size))
    targets = ca.SX.sym("targets", equations.target_function().numel_out())
    cosines = equations.leans(b, q, targets)
    slopes = ca.jacobian(cosines, q)
    if machine.base_size:
        slopes = slopes + ca.mtimes(ca.jacobian(cosines, b), ca.jacobian(machine.base_rate(b, q, u), u))
    return ca.Function("leaning", [b, q, targets], [cosines, ca.densify(slopes)], {"cse": True})


def _least(
    matrix: Array, wanted: Array, weights: Array, damping: float, at: Array, lower: Array, upper: Array
) -> Array:
    """Least weighted rates (K, n) that give what is wanted (K, m); joints at a limit that they would leave are held."""
    finite: Any = np.isfinite(matrix).all(axis=(1, 2)) & np.isfinite(wanted).all(axis=1)
    matrix, wanted = np.where(finite[:, None, None], matrix, 0.0), np.where(finite[:, None], wanted, 0.0)
    size = np.sqrt((matrix**2).sum(axis=(1, 2)) / max(matrix.shape[1], 1))
    soft = ((damping * size) ** 2 + np.finfo(float).tiny)[:, None, None] * np.eye(matrix.shape[1])
    free: Any = np.ones(at.shape, dtype=bool)
    rates = np.zeros_like(at)
    for _ in range(at.shape[1] + 1):
        light = np.where(free[:, None, :], matrix, 0.0) / weights
        square = light @ matrix.transpose(0, 2, 1) + soft
        rates = np.einsum("kmn,km->kn", light, np.linalg.solve(square, wanted[:, :, None])[:, :, 0])
        leaves: Any = free & (((at <= lower) & (rates < 0)) | ((at >= upper) & (rates > 0)))
        if not leaves.any():
            break
        free = np.logical_and(free, np.logical_not(leaves))
    return np.asarray(np.where(free, rates, 0.0))
