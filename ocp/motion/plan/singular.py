"""Motions through singular configurations: which tasks to relax, and the reason why a motion misses its tasks."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from models.arrays import Array
from ocp.motion.builders.tool_motion import Stretch
from ocp.motion.local.rates import LocalMotion
from ocp.motion.plan.candidate import Reason, Rejection
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
    """Return whether the rows of the tasks are nearly dependent somewhere along a single local motion."""
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
    """Samples of a motion in one stretch of time.

    Attributes:
        stretch: The stretch.
        t: Times, s. Shape (M,).
        base, joints, rates: Shapes (M, base_size), (M, n), (M, n).
    """

    stretch: Stretch
    t: Array
    base: Array
    joints: Array
    rates: Array

    @classmethod
    def of_local(cls, stretch: Stretch, motion: LocalMotion) -> MotionSample:
        """Return the samples of the first of some local motions."""
        return cls(stretch, motion.t, motion.base[0], motion.joints[0], motion.rates[0])

    def misses(self) -> tuple[Array, Array]:
        """Return the position errors, m, and the orientation errors, rad, of the worst task. Shapes (M,)."""
        equations, worst = self.stretch.equations, np.zeros((2, len(self.t)))
        if equations is None:
            return worst[0], worst[1]
        errors = np.nan_to_num(equations.errors(self.t, self.base, self.joints), nan=np.inf)
        ends = np.cumsum([0, *(part.task.size for part in equations.bound)]).tolist()
        for begin, end in pairwise(ends):
            turning = equations.turning[begin:end]
            for k, chosen in enumerate((~turning, turning)):
                worst[k] = np.maximum(worst[k], np.linalg.norm(errors[:, begin:end][:, chosen], axis=1))
        return worst[0], worst[1]


def limit_reason(request: PlanRequest, samples: Sequence[MotionSample]) -> Reason | None:
    """Return the reason that a motion exceeds the limit of a joint's rate, by the largest share; None if it does not."""
    bounds, names = request.bounds, request.machine.robot.joint_names
    worst: Reason | None = None
    largest = 1.0 + SINGULAR.at_limit
    for sample in samples:
        with np.errstate(divide="ignore", invalid="ignore"):
            shares = np.nan_to_num(np.abs(sample.rates) / bounds.velocity, nan=0.0)
        k, joint = np.unravel_index(int(shares.argmax()), shares.shape)
        if shares[k, joint] > largest:
            largest = float(shares[k, joint])
            rate, limit, time = float(abs(sample.rates[k, joint])), float(bounds.velocity[joint]), float(sample.t[k])
            unit = request.machine.robot.moving_joints[int(joint)]
            unit_name = "m/s" if unit.kind == "prismatic" else "rad/s"
            words = (
                f"at {time:.4g} s {names[joint]!r} would have to move at {rate:.4g} {unit_name}, its limit is "
                f"{limit:.4g} {unit_name}; lengthen the horizon or start elsewhere"
            )
            worst = Reason(Rejection.INFEASIBLE, words, names[joint], rate, limit, time)
    return worst


def describe_shortfall(request: PlanRequest, samples: Sequence[MotionSample]) -> Reason:
    """Return the reason that a motion misses its tasks: when, by how much, and which joint is at its limit there.

    The motion is the one that misses its tasks least among those near the guess.
    """
    bounds, robot = request.bounds, request.machine.robot
    sample, k, position, angle = samples[0], 0, 0.0, 0.0
    for each in samples:
        positions, angles = each.misses()
        i = int((positions + angles).argmax())
        if positions[i] + angles[i] > position + angle:
            sample, k, position, angle = each, i, float(positions[i]), float(angles[i])
    time = float(sample.t[k])
    words = f"at {time:.4g} s the tip misses its task by {position:.3g} m and {angle:.3g} rad"
    joints, rates, width = sample.joints[k], sample.rates[k], bounds.upper - bounds.lower
    slack = np.where(np.isfinite(width), SINGULAR.at_limit * width, 0.0)
    for joint, name in enumerate(robot.joint_names):
        unit = "m" if robot.moving_joints[joint].kind == "prismatic" else "rad"
        for limit in (bounds.lower[joint], bounds.upper[joint]):
            if np.isfinite(limit) and abs(joints[joint] - limit) <= slack[joint]:
                words = f"{words}, with {name!r} at its limit {limit:.5g} {unit}; start elsewhere or leave a row free"
                return Reason(Rejection.INFEASIBLE, words, name, float(joints[joint]), float(limit), time)
    with np.errstate(divide="ignore", invalid="ignore"):
        shares = np.nan_to_num(np.abs(rates) / bounds.velocity, nan=0.0)
    fastest = int(shares.argmax())
    if shares[fastest] >= 1 - SINGULAR.at_limit:
        name, limit = robot.joint_names[fastest], float(bounds.velocity[fastest])
        unit = "m/s" if robot.moving_joints[fastest].kind == "prismatic" else "rad/s"
        words = f"{words}, with {name!r} at the limit of its rate, {limit:.5g} {unit}; lengthen the horizon"
        return Reason(Rejection.INFEASIBLE, words, name, float(abs(rates[fastest])), limit, time)
    words = f"{words}, where the arm is singular: no joint moves the tip in that direction; start elsewhere"
    return Reason(Rejection.INFEASIBLE, words, "tip", max(position, angle), 0.0, time)
