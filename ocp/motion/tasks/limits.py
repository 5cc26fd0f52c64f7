"""Limits of a machine's joints and of the contact with the ground."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, replace
from typing import Any, NamedTuple
from warnings import warn

import numpy as np
from numpy.typing import NDArray

from models import Machine, ModelWarning, Robot, Standing
from models.checks import NOT_NUMBERS, Array, floats, real
from ocp.errors import ProblemError, require
from ocp.motion.tasks.zmp_rules import ZmpRule

__all__ = ["JointBounds", "Limits", "unknown_limits"]


LIMITED = ("velocity", "acceleration", "jerk", "torque", "power")
"""Limits that are one number for each joint, or one for all."""


class JointBounds(NamedTuple):
    """Limits of every joint, infinite where there is none. Shape (n,) each; rad or m, s, N m or N, W.

    Attributes:
        lower, upper: Position limits.
        velocity, acceleration, jerk, torque: Largest absolute values.
        power: Largest power that an actuator delivers.
    """

    lower: Array
    upper: Array
    velocity: Array
    acceleration: Array
    jerk: Array
    torque: Array
    power: Array


@dataclass(frozen=True)
class Limits:
    """Limits of joints and ground contact.

    None means the limit of the robot description, which has none for acceleration, jerk and power. Many URDF files give
    0 for an unknown velocity or torque limit; 0 is read as unlimited.

    Attributes:
        velocity, acceleration, jerk, torque: One number for each joint, or one for all; inf for no limit.
        power: Largest power that each actuator delivers, W, in the same form; braking is free.
        joints: Whether the position limits of the robot apply.
        vertical_force: Least vertical ground force on a standing machine, N; None for a tenth of its weight.
        friction: Friction coefficient of the ground.
        zmp: Rule for the zero moment point of a standing machine; None keeps it inside the foot.

    Raises:
        ProblemError: A limit is not positive.
    """

    velocity: Any = None
    acceleration: Any = None
    jerk: Any = None
    torque: Any = None
    power: Any = None
    joints: bool = True
    vertical_force: float | None = None
    friction: float = np.inf
    zmp: ZmpRule | None = None

    def __post_init__(self) -> None:
        for kind in LIMITED:
            value = getattr(self, kind)
            if value is not None and not (_numbers(value) > 0).all():
                words = f"limits: {kind} must be positive, one number or one for each joint, not {value!r}"
                raise ProblemError(words, name=kind, value=value, limit=0.0)
        if self.vertical_force is not None:
            require.positive("limits: vertical_force", self.vertical_force)
        require.flag("limits: joints", self.joints)
        if self.zmp is not None and not isinstance(self.zmp, ZmpRule):
            words = f"limits: zmp must be a rule such as InFoot(), not {self.zmp!r}"
            raise ProblemError(words, name="zmp", value=self.zmp)
        if not real(self.friction) > 0:
            words = f"limits: friction must be positive, not {self.friction!r}"
            raise ProblemError(words, name="friction", value=self.friction, limit=0.0)

    def least_force(self, machine: Standing) -> float:
        """Least vertical ground force, N."""
        return 0.1 * machine.weight if self.vertical_force is None else float(self.vertical_force)

    def of_joints(self, chosen: NDArray[np.bool_]) -> Limits:
        """Return the limits of some joints of a machine. Shape (n,), bool."""
        values = {kind: getattr(self, kind) for kind in LIMITED}
        own: dict[str, Any] = {
            kind: _numbers(value)[chosen]
            for kind, value in values.items()
            if value is not None and _numbers(value).size > 1
        }
        return replace(self, **own)

    def bounds(self, machine: Machine, used: Collection[str] = ()) -> JointBounds:
        """Return the joint limits of a machine; those that the robot description does not give are infinite.

        Args:
            machine: The machine.
            used: Kinds of limits, "velocity" or "torque", to warn about if the robot gives 0 for them.

        Raises:
            ProblemError: A limit is neither one number nor one number for each joint.

        Warns:
            ModelWarning: A used limit is not set here and 0 in the robot description, so that the joints are unlimited.
        """
        robot, n = machine.robot, machine.joint_size
        inf = np.full(n, np.inf)
        values = {"velocity": robot.velocity, "acceleration": inf, "jerk": inf, "torque": robot.effort, "power": inf}
        for kind in values:
            value = getattr(self, kind)
            if value is not None:
                array = _numbers(value)
                if array.size not in (1, n):
                    words = f"limits: {kind} must be positive, one number or {n}, not {value!r}"
                    raise ProblemError(words, name=kind, value=value, limit=n)
                values[kind] = np.array(np.broadcast_to(array, n))
            elif kind in used and (names := unknown_limits(robot, kind)):
                words = f"the robot gives {', '.join(names)} a {kind} limit of 0, which is read as unknown: they are "
                words += f"unlimited; set Limits({kind}=...), inf for no limit"
                warn(ModelWarning(words, name=names[0], value=0.0), stacklevel=2)
        lower, upper = (robot.lower, robot.upper) if self.joints else (-inf, inf)
        return JointBounds(lower, upper, **values)


def unknown_limits(robot: Robot, kind: str) -> list[str]:
    """Return the joints whose "velocity" or "torque" limit is 0, that is unknown, in the robot description."""
    attribute = {"velocity": "velocity", "torque": "effort"}.get(kind)
    return [joint.name for joint in robot.moving_joints if attribute and getattr(joint, attribute) == 0]


def _numbers(value: Any) -> Array:
    """Return a limit as a flat array, a single 0 if it is not numeric."""
    try:
        numbers = floats(value).ravel()
        return numbers if numbers.size else np.zeros(1)
    except NOT_NUMBERS:
        return np.zeros(1)
