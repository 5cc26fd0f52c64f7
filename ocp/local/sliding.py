"""Postures slid along their self-motions until no bodies touch.

Where joints are more than a task's rows, of the postures that do the task a sample may touch and others between not.
Each step moves what touches apart by damped least squares (Nakamura & Hanafusa 1986) in the null space of the task, and
puts the tips back on it. Slopes of distances are finite differences: depths of hulls have no better ones.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from models import Surroundings
from models.arrays import Array
from ocp.local.touching import distances_along

__all__ = ["slid"]


@dataclass(frozen=True)
class SlidingSettings:
    """How postures are slid.

    Attributes:
        steps: At most.
        difference: Of finite differences, rad or m: the root of the distances' rounding, 1e-10 m.
        longest: Step of any joint, rad or m.
        damping: Relative to the size of the slopes.
        spare: By which what is slid is farther off than it has to be, so that putting the tips back leaves it clear, m.
    """

    steps: int = 12
    difference: float = 1e-5
    longest: float = 0.25
    damping: float = 0.1
    spare: float = 2e-3


def slid(
    surroundings: Surroundings,
    base: Array,
    joints: Array,
    time: float,
    *,
    jacobian: Callable[[Array], Array],
    back: Callable[[Array], Array],
    lower: Array,
    upper: Array,
    settings: SlidingSettings = SlidingSettings(),
) -> Array:
    """Postures moved off what they touch, as far as that goes.

    Args:
        surroundings: Of the machine. base: Its base. Shape (base_size,). time: s.
        joints: Postures that do the task. Shape (K, n).
        jacobian: Of the task at a posture (n,). Shape (m, n).
        back: Postures (K, n) -> postures nearby that do the task again.
        lower, upper: Limits of the joints. Shape (n,).
        settings: How.

    Returns:
        Of each posture the one on its way whose least distance is largest. Shape (K, n).
    """
    count, n = joints.shape
    wanted = surroundings.clearance + settings.spare

    def measured(postures: Array) -> Array:
        """Of all pairs, those farther than is wanted not told how far. Shape (K, P)."""
        return distances_along(surroundings, base, postures, np.full(len(postures), time), near=wanted)

    best, at, depth = joints.copy(), joints.copy(), np.full(count, -np.inf)
    for _ in range(settings.steps):
        moved = (at[:, None] + settings.difference * np.eye(n)).reshape(-1, n)
        gaps = measured(at)
        least = gaps.min(axis=1)
        better = least > depth
        best[better], depth[better] = at[better], least[better]
        if (depth >= surroundings.clearance).any():
            break
        slopes = (measured(moved).reshape(count, n, -1) - gaps[:, None]) / settings.difference
        step = np.array([_step(*each, wanted, settings) for each in zip(map(jacobian, at), gaps, slopes, strict=True)])
        at = back(np.clip(at + step, lower, upper))
    return best


def _step(task: Array, gaps: Array, slopes: Array, wanted: float, settings: SlidingSettings) -> Array:
    """Joints (n,) that move what is too near apart, and the tips nowhere to first order."""
    close = gaps < wanted
    null = np.eye(task.shape[1]) - np.linalg.pinv(task) @ task
    rows = slopes[:, close].T @ null
    soft = settings.damping**2 * max(float((rows**2).sum(axis=1).max(initial=0.0)), 1e-12)
    step = rows.T @ np.linalg.solve(rows @ rows.T + soft * np.eye(len(rows)), wanted - gaps[close])
    return np.asarray(step * min(1.0, settings.longest / max(float(np.abs(step).max()), 1e-12)))
