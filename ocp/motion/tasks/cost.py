"""Weights of what a motion costs."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from models.checks import Array
from ocp.errors import ProblemError, require
from ocp.motion.tasks.checks import checked_weights

__all__ = ["Cost"]

PER_JOINT = ("effort", "acceleration")


@dataclass(frozen=True, eq=False)
class Cost:
    """Weights of the cost of a motion, an integral over its time plus `time` times its duration T:

        J = time T + integral of (velocity/2 sum(w q'^2) + effort sum(tau^2) + length sqrt(sum(w q'^2))
            + acceleration sum(q''^2) + jerk sum(q'''^2) + energy sum(max(tau q', 0)) + turning |omega|^2) dt

    Attributes:
        velocity: Weight of half the squared joint velocities.
        time: Weight of the duration, 1/s.
        effort: Weight of the squared torques (losses in the windings), one number or one for each joint, 1/(N m)^2/s.
        length: Weight of the length of the joint path, 1/rad.
        energy: Weight of the positive actuator work, 1/J. Braking regains nothing.
        acceleration: Weight of the squared accelerations, one number or one for each joint. It matters for light joints
            at the end of an arm, which need hardly any torque.
        jerk: Weight of the squared jerks.
        turning: Weight of the squared angular velocity of a floating base, 1/(rad/s)^2/s.
        weights: Weights w of the joints in the velocity and the length, positive, shape (n,); all 1 if None.

    Raises:
        ProblemError: A weight is negative, or all are zero.
    """

    velocity: float = 1.0
    time: float = 0.0
    effort: Any = 0.0
    length: float = 0.0
    energy: float = 0.0
    acceleration: Any = 0.0
    jerk: float = 0.0
    turning: float = 0.0
    weights: Any = None

    def __post_init__(self) -> None:
        each = [
            require.array(f"cost: {name}", getattr(self, name), ("joints",), sign="nonnegative") for name in PER_JOINT
        ]
        single = [require.nonnegative(f"cost: {name}", getattr(self, name)) for name in self._single]
        if not (any(single) or np.concatenate(each).any()):
            raise ProblemError("cost: at least one weight must be above zero", name="cost", value=self, limit=0.0)

    @property
    def _single(self) -> tuple[str, ...]:
        return ("velocity", "time", "length", "energy", "jerk", "turning")

    @property
    def terms(self) -> tuple[str, ...]:
        """Names of the terms whose weights are not zero."""
        return tuple(name for name in (*self._single, *PER_JOINT) if np.any(np.asarray(getattr(self, name))))

    def joint_weights(self, size: int) -> Array:
        """Return the weights of the joints, `velocity` included. Shape (size,).

        Raises:
            ProblemError: The number of weights is not the number of joints, or a weight is not positive.
        """
        return self.velocity * checked_weights(self.weights, size)

    def __repr__(self) -> str:
        weighted = ", ".join(f"{name}={getattr(self, name)!r}" for name in self.terms)
        return f"Cost({weighted}{'' if self.weights is None else f', weights={self.weights!r}'})"
