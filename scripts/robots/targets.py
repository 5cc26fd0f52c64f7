"""Targets of control loops, which move at random by a seed."""

from __future__ import annotations

import numpy as np

from models.checks import Array

__all__ = ["DriftingTarget", "JumpingTarget"]


class JumpingTarget:
    """A point that drifts with random accelerations in a box, and jumps about every two seconds, by a seed."""

    LOWER, UPPER = np.array([0.3, -0.4, 0.2]), np.array([0.65, 0.4, 0.7])  # m

    def __init__(self, seed: int) -> None:
        self._random = np.random.default_rng(seed)
        self.place, self._velocity = np.array([0.45, 0.0, 0.5]), np.zeros(3)

    def move(self, period: float) -> None:
        """Move for a period, s."""
        self._velocity += period * (0.4 * self._random.normal(size=3) / np.sqrt(period) - self._velocity)
        self.place = self.place + period * self._velocity
        outside = (self.place < self.LOWER) | (self.place > self.UPPER)
        self._velocity[outside] *= -1
        if self._random.uniform() < 0.5 * period:
            self.place = self.place + self._random.uniform(-0.15, 0.15, 3)
        self.place = np.clip(self.place, self.LOWER, self.UPPER)


class DriftingTarget:
    """A target that drifts with random accelerations; a new one appears near the arm after each capture or 30 s."""

    def __init__(self, seed: int, tip: Array) -> None:
        self._random = np.random.default_rng(seed)
        self.appear(tip)

    def appear(self, tip: Array) -> None:
        """Appear within 0.3 m in each direction of a position of the tip, m, with a velocity of a few cm/s."""
        self.place = tip + self._random.uniform(-0.3, 0.3, 3)
        self.velocity, self.age = self._random.uniform(-0.02, 0.02, 3), 0.0

    def move(self, period: float) -> None:
        """Move for a period, s."""
        self.velocity = self.velocity + 0.004 * np.sqrt(period) * self._random.normal(size=3)
        self.place, self.age = self.place + period * self.velocity, self.age + period
