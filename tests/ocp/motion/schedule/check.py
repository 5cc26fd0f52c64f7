"""What a schedule demands of its limits, looked at densely: shared by the tests and the benchmark."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ocp.motion.schedule import JointPath, LineMotion, Schedule, joint_motion

__all__ = ["dense", "largest"]


def dense(plan: Schedule, times: int = 20_001) -> LineMotion:
    """The motion at instants that many, and about every change of the jerk, from both sides."""
    steps = np.clip(np.repeat(plan.profile.t, 2) + np.tile([-1e-9, 1e-9], len(plan.profile.t)), 0, plan.duration)
    return plan.at(np.sort(np.concatenate([np.linspace(0, plan.duration, times), steps])))


def largest(plan: Schedule, joints: JointPath, times: int = 20_001) -> NDArray[np.float64]:
    """Joint velocity, acceleration and jerk, speed, line acceleration, line jerk and centripetal, over their limits."""
    motion, limits = dense(plan, times), plan.limits
    moved = joint_motion(joints, motion)[1:]
    matches = [
        float(np.max(np.abs(value) / bound))
        for value, bound in zip(moved, limits.of_joints(len(joints.names)), strict=True)
    ]
    segment = plan.path.by_piece(limits.speed)
    sides = np.clip(motion.distance + np.array([[-1e-9], [1e-9]]) * plan.path.length, 0, plan.path.length)
    at = np.clip(np.searchsorted(plan.path.bounds, sides, side="right") - 1, 0, len(segment) - 1)
    matches += [
        float((motion.speed / segment[at].max(axis=0)).max()),
        float(np.abs(motion.acceleration).max() / limits.acceleration),
        float(np.abs(motion.jerk).max() / limits.jerk),
        float((motion.speed**2 * plan.path.curvature(motion.distance)).max() / limits.centripetal),
    ]
    return np.array(matches)
