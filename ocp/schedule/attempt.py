"""Limits along a path, stretch by stretch, and the plan that keeps them."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from ocp.schedule.grid import Grid
from ocp.schedule.profile import Array, SpeedProfile
from ocp.schedule.zones import Memory, Zones

__all__ = ["TOLERANCE", "Attempt"]

TOLERANCE = 1e-9
"""Limits count as kept up to this, relative."""


@dataclass(eq=False)
class Attempt:
    """Limits in each interval of the grid, lowered until the plan keeps all.

    Attributes:
        grid: Where they are looked at.
        speed, acceleration, jerk: Limits of each interval. Shape (G - 1,).
        ramp_cause: Row of `cause_names` that made a ramp gentler there, or -1. Shape (G - 1,).
        memory: Motions of zones already found.
        passed: Phases that are known to keep the joint limits: distance, speed, acceleration, jerk, duration.
        profile: The plan.
    """

    grid: Grid
    speed: Array
    acceleration: Array
    jerk: Array
    ramp_cause: NDArray[np.intp]
    memory: Memory = field(default_factory=dict)
    passed: set[tuple[float, ...]] = field(default_factory=set)
    profile: SpeedProfile = field(init=False)

    def zones(self) -> Zones:
        values = np.stack([self.speed, self.acceleration, self.jerk])
        starts = np.concatenate([[0], 1 + np.flatnonzero((np.diff(values, axis=1) != 0).any(axis=0))])
        return Zones(self.grid.distance[np.append(starts, len(self.speed))], *values[:, starts])

    def interval(self, distance: float) -> int:
        """Index of the interval of the grid that holds a distance (m)."""
        return int(np.clip(np.searchsorted(self.grid.distance, distance, side="right") - 1, 0, len(self.speed) - 1))
