"""Motions through singular configurations: which tasks to relax, and the reason why a motion misses its tasks."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from models.checks import Array
from ocp.motion.builders.tool_motion import Stretch
from ocp.motion.local.inverse_kinematics import describe_miss
from ocp.motion.local.rates import LocalMotion
from ocp.motion.result.candidate import Reason, Rejection
from ocp.motion.search.configurations import PlanRequest

__all__ = ["MotionSample", "describe_shortfall", "is_nearly_singular", "limit_reason"]


@dataclass(frozen=True)
class SingularSettings:
    """Settings of the treatment of singular configurations.

    Attributes:
        conditioning: Ratio of the least to the largest singular value of the tasks' Jacobian below which tasks are
            relaxed. Below it joint rates exceed the tip's velocity by more than its inverse, and the multipliers of the
            tasks grow with its square.
        at_limit: Distance from a limit, relative to the limit of a rate or to the range of a position, below which a
            joint is at it.
    """

    conditioning: float = 1e-2
    at_limit: float = 1e-3


SINGULAR = SingularSettings()


def is_nearly_singular(stretches: Sequence[Stretch], motions: Sequence[LocalMotion]) -> bool:
    """Return whether the task Jacobian becomes nearly singular somewhere along a local (resolved-rate) motion."""
    for stretch, motion in zip(stretches, motions, strict=True):
        if stretch.equations is None or not stretch.equations.size:
            continue
        joints, base = motion.joints[0], motion.base[0]
        columns = np.array(stretch.equations.jacobian_function.map(len(joints))(joints.T, base.T))
        jacobians = columns.reshape(len(columns), *joints.shape).transpose(1, 0, 2)
        values = np.linalg.svd(jacobians[np.isfinite(jacobians).all(axis=(1, 2))], compute_uv=False)
        if (values[:, -1] < SINGULAR.conditioning * values[:, 0]).any():
            return True
    return False


@dataclass(frozen=True)
class MotionSample:
    """Samples of a motion in one time interval, in which the same tasks are active.

    Attributes:
        stretch: The time interval and its tasks.
        t: Times, s. Shape (M,).
        base, joints, rates: Base and joint positions, and joint rates. Shapes (M, base_size), (M, n), (M, n).
    """

    stretch: Stretch
    t: Array
    base: Array
    joints: Array
    rates: Array

    @classmethod
    def of_local(cls, stretch: Stretch, motion: LocalMotion) -> MotionSample:
        """Return the samples of the first of several local (resolved-rate) motions."""
        return cls(stretch, motion.t, motion.base[0], motion.joints[0], motion.rates[0])

    def misses(self) -> tuple[Array, Array]:
        """Return the largest position and orientation errors of any task at each sample, m and rad. Shapes (M,).

        The error of a velocity task is the integral of its velocity error.
        """
        equations, worst = self.stretch.equations, np.zeros((2, len(self.t)))
        if equations is None:
            return worst[0], worst[1]
        errors = np.nan_to_num(equations.errors(self.t, self.base, self.joints), nan=np.inf)
        if not equations.pose_rows.all():
            targets = np.array(equations.target_function().map(len(self.t))(self.t[None, :]))
            columns, right = (
                np.array(part) for part in equations.function.map(len(self.t))(self.base.T, self.joints.T, targets)[:2]
            )
            jacobians = columns.reshape(equations.size, *self.joints.shape)
            velocities = np.einsum("mkn,kn->km", jacobians, self.rates) - right.T
            strayed = np.cumsum(velocities[:-1] * np.diff(self.t)[:, None], axis=0)
            errors = np.where(equations.pose_rows, errors, np.vstack([np.zeros((1, equations.size)), strayed]))
        ends = np.cumsum([0, *(part.task.size for part in equations.bound)]).tolist()
        for begin, end in pairwise(ends):
            turning = equations.turning[begin:end]
            for k, chosen in enumerate((~turning, turning)):
                worst[k] = np.maximum(worst[k], np.linalg.norm(errors[:, begin:end][:, chosen], axis=1))
        return worst[0], worst[1]


def limit_reason(request: PlanRequest, samples: Sequence[MotionSample]) -> Reason | None:
    """Return a rejection reason about the joint that exceeds its rate limit most; None if no joint exceeds it."""
    reasons = []
    for sample in samples:
        shares = _rate_shares(request, sample.rates)
        k, joint = (int(i) for i in np.unravel_index(int(shares.argmax()), shares.shape))
        if shares[k, joint] > 1 + SINGULAR.at_limit:
            name, unit = _joint(request, joint)
            rate, limit = float(abs(sample.rates[k, joint])), float(request.bounds.velocity[joint])
            words = (
                f"at {sample.t[k]:.4g} s {name!r} would have to move at {rate:.4g} {unit}/s, its limit is {limit:.4g} "
                f"{unit}/s; lengthen the horizon or start elsewhere"
            )
            reasons.append((rate / limit, Reason(Rejection.INFEASIBLE, words, name, rate, limit, float(sample.t[k]))))
    return max(reasons, key=lambda entry: entry[0])[1] if reasons else None


def describe_shortfall(request: PlanRequest, samples: Sequence[MotionSample]) -> Reason:
    """Return a rejection reason for a motion that misses its tasks: time, pose error, and a joint at its limit."""
    sample, k, misses = samples[0], 0, (0.0, 0.0)
    for each in samples:
        distances, angles = each.misses()
        i = int((distances + angles).argmax())
        if distances[i] + angles[i] > sum(misses):
            sample, k, misses = each, i, (float(distances[i]), float(angles[i]))
    bounds, joints, time = request.bounds, sample.joints[k], float(sample.t[k])
    words = f"at {time:.4g} s the tip misses its task by {describe_miss(*misses)}"
    with np.errstate(invalid="ignore"):
        slack = np.nan_to_num(SINGULAR.at_limit * (bounds.upper - bounds.lower), nan=0.0, posinf=0.0)
    for limits in (bounds.lower, bounds.upper):
        for joint in np.flatnonzero(np.abs(joints - limits) <= slack).tolist():
            name, unit = _joint(request, joint)
            words = (
                f"{words}, with {name!r} at its limit {limits[joint]:.5g} {unit}; start elsewhere or leave a row free"
            )
            return Reason(Rejection.INFEASIBLE, words, name, float(joints[joint]), float(limits[joint]), time)
    shares = _rate_shares(request, sample.rates[k])
    fastest = int(shares.argmax())
    name, unit = _joint(request, fastest)
    value, limit = float(abs(sample.rates[k, fastest])), float(bounds.velocity[fastest])
    at_limit = shares[fastest] >= 1 - SINGULAR.at_limit
    words += (
        f", with {name!r} {'at the limit of its rate' if at_limit else 'as the fastest joint'}, {value:.4g} {unit}/s"
    )
    return Reason(Rejection.INFEASIBLE, f"{words}; lengthen the horizon or start elsewhere", name, value, limit, time)


def _rate_shares(request: PlanRequest, rates: Array) -> Array:
    """Return absolute joint rates as fractions of the rate limits; the fraction is zero for a joint at rest."""
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.nan_to_num(np.abs(rates) / request.bounds.velocity, nan=0.0)


def _joint(request: PlanRequest, joint: int) -> tuple[str, str]:
    """Return the name of a joint, and the unit of its position."""
    moving = request.machine.robot.moving_joints[joint]
    return moving.name, "m" if moving.kind == "prismatic" else "rad"
