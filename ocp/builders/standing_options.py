"""What may be asked of a standing plan: where the zero moment point may be, limits, weights, the time it takes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, TypeAlias

import casadi as ca
import numpy as np

from models.standing import Standing
from ocp.builders.task import Array
from ocp.errors import ProblemError

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
class InFoot:
    """The zero moment point stays inside the support by a margin, m."""

    margin: float = 0.0

    def check(self, machine: Standing) -> None:
        """Raise ProblemError where the margin leaves no room in the support."""
        room = float(machine.support.half_widths[list(machine.moving_axes)].min(initial=np.inf))
        if not np.isfinite(self.margin) or self.margin >= room * (1 - 1e-9):
            raise ProblemError(f"InFoot: margin {self.margin!r} m leaves no room in a support of half-width {room:g} m")


@dataclass(frozen=True)
class IndexAtLeast:
    """The stability index, (5)-(6), stays at or above a value below 1 in every direction."""

    value: float

    def __post_init__(self) -> None:
        if not (np.isfinite(self.value) and self.value < 1):
            raise ProblemError(f"IndexAtLeast: value must be below 1, not {self.value!r}; for 1 use Pinned()")


@dataclass(frozen=True)
class Pinned:
    """The zero moment point stays at (x, y), m; at the machine's most stable point if None."""

    point: Any = None

    def place(self, machine: Standing, time: Any) -> Any:
        """Shape (2, 1), m."""
        given = machine.most_stable_point if self.point is None else self.point
        point = np.asarray(given, dtype=float).ravel()
        if point.shape != (2,) or not np.isfinite(point).all():
            raise ProblemError(f"Pinned: point must be two numbers (x, y), not {self.point!r}")
        return ca.DM(point)


@dataclass(frozen=True)
class Following:
    """The zero moment point follows a reference: a function of a casadi time (s) that returns (x, y), m."""

    reference: Callable[[Any], Any]

    def place(self, machine: Standing, time: Any) -> Any:
        """Shape (2, 1), m."""
        given = self.reference(time)
        point = ca.vertcat(*given) if isinstance(given, list | tuple) else given
        if tuple(point.shape) not in ((2, 1), (2,)):
            raise ProblemError(f"Following: the reference gives {tuple(point.shape)} values, two expected (x, y)")
        return point


@dataclass(frozen=True)
class Anywhere:
    """The zero moment point is not looked at: the machine may tip over."""


ZmpRule: TypeAlias = InFoot | IndexAtLeast | Pinned | Following | Anywhere


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
            if not (np.isfinite(value) and value >= 0):
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
        if self.vertical_force is not None and not (np.isfinite(self.vertical_force) and self.vertical_force > 0):
            raise ProblemError(f"limits: vertical_force must be positive, not {self.vertical_force!r}")
        if not self.friction > 0:
            raise ProblemError(f"limits: friction must be positive, not {self.friction!r}")

    def bounds(self, machine: Standing) -> dict[str, Any]:
        """(lower, upper) of "joints" and the greatest "velocities", "accelerations", "jerks", "torques", (n,) each."""
        robot, n = machine.robot, machine.joint_size
        free = np.full(n, np.inf)
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
        if not 0 < self.lower <= self.guess <= self.upper < np.inf:
            raise ProblemError(
                f"FreeTime: 0 < lower <= guess <= upper is needed, not {self.lower!r}, {self.guess!r}, {self.upper!r}"
            )


def _each(what: str, value: Any, size: int) -> Array:
    array = np.asarray(value, dtype=float).ravel()
    if array.size not in (1, size) or not (array > 0).all():
        raise ProblemError(f"limits: {what} must be positive, one number or {size}, not {value!r}")
    return np.array(np.broadcast_to(array, size))
