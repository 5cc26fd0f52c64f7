"""What may be asked of a standing plan besides its task: limits, weights, the time it takes."""

from __future__ import annotations

from dataclasses import dataclass
from numbers import Real
from typing import Any

import numpy as np

from models.machines.standing import Standing
from ocp.errors import ProblemError
from ocp.tasks.start import Array
from ocp.tasks.zmp_rules import Anywhere, Following, IndexAtLeast, InFoot, Pinned, ZmpRule, is_finite

__all__ = [
    "Anywhere",
    "Following",
    "FreeTime",
    "InFoot",
    "IndexAtLeast",
    "Limits",
    "Pinned",
    "Weights",
    "ZmpRule",
]


@dataclass(frozen=True)
class Weights:
    """Of the parts of the cost, an integral over the motion plus `time` times a free final time.

    Attributes:
        acceleration, velocity, jerk: Of the sums of squares over the joints.
        joint_limits: Of the joint-limit index p1 (23).
        manipulability: Of minus the manipulability p2 (27) of the task's rows.
        time: Of a free final time, 1/s.
    """

    acceleration: float = 0.01
    velocity: float = 0.01
    joint_limits: float = 1.0
    manipulability: float = 0.5
    jerk: float = 1e-4
    time: float = 0.0

    def __post_init__(self) -> None:
        for what, value in vars(self).items():
            if not (is_finite(value) and value >= 0):
                raise ProblemError(f"weights: {what} must be a finite number, zero or above, not {value!r}")


@dataclass(frozen=True)
class Limits:
    """What joints and ground bear; None means what the robot says.

    Attributes:
        joints: Whether the robot's position limits hold.
        velocity, torque: Of each joint, or one number for all; the robot's own if None.
        acceleration, jerk: Of each joint, or one number for all.
        vertical_force: Least vertical ground force, N; a tenth of the weight if None.
        friction: Coefficient of friction of the ground.
    """

    joints: bool = True
    velocity: Any = None
    torque: Any = None
    acceleration: Any = np.inf
    jerk: Any = np.inf
    vertical_force: float | None = None
    friction: float = np.inf

    def __post_init__(self) -> None:
        if self.vertical_force is not None and not (is_finite(self.vertical_force) and self.vertical_force > 0):
            raise ProblemError(f"limits: vertical_force must be positive, not {self.vertical_force!r}")
        if not (isinstance(self.friction, Real) and self.friction > 0):
            raise ProblemError(f"limits: friction must be positive, not {self.friction!r}")

    def least_force(self, machine: Standing) -> float:
        """Least vertical ground force, N."""
        return 0.1 * machine.weight if self.vertical_force is None else float(self.vertical_force)

    def bounds(self, machine: Standing) -> dict[str, Any]:
        """(lower, upper) of "joints" and the greatest "velocities", "accelerations", "jerks", "torques", (n,) each."""
        robot, n = machine.robot, machine.joint_size
        free = np.full(n, np.inf)
        for what, given, own in (("velocity", self.velocity, robot.velocity), ("torque", self.torque, robot.effort)):
            if given is None and not (own > 0).all():
                names = [name for name, value in zip(robot.joint_names, own, strict=True) if not value > 0]
                raise ProblemError(
                    f"limits: the robot gives the joints {names} a {what} limit of 0; lock them, or say what they "
                    f"bear: Limits({what}=...), inf for no limit"
                )
        return {
            "joints": (robot.lower, robot.upper) if self.joints else (-free, free),
            "velocities": _each("velocity", robot.velocity if self.velocity is None else self.velocity, n),
            "torques": _each("torque", robot.effort if self.torque is None else self.torque, n),
            "accelerations": _each("acceleration", self.acceleration, n),
            "jerks": _each("jerk", self.jerk, n),
        }


@dataclass(frozen=True)
class FreeTime:
    """A final time that is found: between lower and upper, with a first guess, s."""

    lower: float
    upper: float
    guess: float

    def __post_init__(self) -> None:
        given = (self.lower, self.guess, self.upper)
        if not (all(map(is_finite, given)) and 0 < self.lower <= self.guess <= self.upper):
            raise ProblemError(
                f"FreeTime: 0 < lower <= guess <= upper is needed, not {self.lower!r}, {self.guess!r}, {self.upper!r}"
            )


def _each(what: str, value: Any, size: int) -> Array:
    try:
        array = np.asarray(value, dtype=float).ravel()
    except (TypeError, ValueError):
        array = np.zeros(0)
    if array.size not in (1, size) or not (array > 0).all():
        raise ProblemError(f"limits: {what} must be positive, one number or {size}, not {value!r}")
    return np.array(np.broadcast_to(array, size))
