"""What a machine's joints bear, and the ground that it stands on."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass
from typing import Any, NamedTuple
from warnings import warn

import numpy as np

from models import Machine, ModelWarning, Robot, Standing
from models.arrays import Array
from ocp.errors import NOT_NUMBERS, ProblemError, checked_flag, checked_positive, floats, real

__all__ = ["JointBounds", "Limits", "unknown_limits"]


class JointBounds(NamedTuple):
    """Limits of every joint, infinite where there are none. Shape (n,) each, rad or m and seconds, N m or N, W.

    Attributes:
        lower, upper: Of the positions.
        velocity, acceleration, jerk, torque: The greatest sizes. power: What a drive gives at most.
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
    """What joints and ground bear; None means what the robot says, which is nothing of accelerations, jerks and power.

    A robot that says 0 of a velocity or a torque, as many URDF files do, does not know it: no such limit holds.

    Attributes:
        velocity, acceleration, jerk, torque: Of each joint, or one number for all; inf for no limit.
        power: What each drive gives at most, W, likewise; braking is free.
        joints: Whether the robot's position limits hold.
        vertical_force: Least vertical force of the ground on a standing machine, N; a tenth of its weight if None.
        friction: Coefficient of friction of the ground.

    Raises:
        ProblemError: A limit that is not positive.
    """

    velocity: Any = None
    acceleration: Any = None
    jerk: Any = None
    torque: Any = None
    power: Any = None
    joints: bool = True
    vertical_force: float | None = None
    friction: float = np.inf

    def __post_init__(self) -> None:
        for what in ("velocity", "acceleration", "jerk", "torque", "power"):
            value = getattr(self, what)
            if value is not None and not (_numbers(value) > 0).all():
                words = f"limits: {what} must be positive, one number or one for each joint, not {value!r}"
                raise ProblemError(words, name=what, value=value, limit=0.0)
        if self.vertical_force is not None:
            checked_positive("limits: vertical_force", self.vertical_force)
        checked_flag("limits: joints", self.joints)
        if not real(self.friction) > 0:  # which may be infinite
            words = f"limits: friction must be positive, not {self.friction!r}"
            raise ProblemError(words, name="friction", value=self.friction, limit=0.0)

    def least_force(self, machine: Standing) -> float:
        """Least vertical ground force, N."""
        return 0.1 * machine.weight if self.vertical_force is None else float(self.vertical_force)

    def bounds(self, machine: Machine, used: Collection[str] = ()) -> JointBounds:
        """Return the limits of a machine's joints; those that the robot does not know are infinite.

        Args:
            machine: Whose joints.
            used: Kinds of limits, "velocity" or "torque", of which a robot is warned of that gives 0 for them.

        Raises:
            ProblemError: Not one number or one for each joint.

        Warns:
            ModelWarning: The robot gives joints 0 for a used limit that is not given here, so that none holds.
        """
        robot, n = machine.robot, machine.joint_size
        free = np.full(n, np.inf)
        given = {"velocity": robot.velocity, "acceleration": free, "jerk": free, "torque": robot.effort, "power": free}
        for what in given:
            value = getattr(self, what)
            if value is not None:
                array = _numbers(value)
                if array.size not in (1, n):
                    words = f"limits: {what} must be positive, one number or {n}, not {value!r}"
                    raise ProblemError(words, name=what, value=value, limit=n)
                given[what] = np.array(np.broadcast_to(array, n))
            elif what in used and (names := unknown_limits(robot, what)):
                words = f"the robot gives {', '.join(names)} a {what} limit of 0, which says that it is unknown: none "
                words += f"holds; give Limits({what}=...), inf for no limit"
                warn(ModelWarning(words, name=names[0], value=0.0), stacklevel=2)
        lower, upper = (robot.lower, robot.upper) if self.joints else (-free, free)
        return JointBounds(lower, upper, **given)


def unknown_limits(robot: Robot, what: str) -> list[str]:
    """Return the joints for which a robot's description says 0: their limit of "velocity" or "torque" is unknown."""
    own = {"velocity": "velocity", "torque": "effort"}.get(what)
    return [joint.name for joint in robot.moving_joints if own and getattr(joint, own) == 0]


def _numbers(value: Any) -> Array:
    """A limit as a flat array, a single 0 where it is none."""
    try:
        given = floats(value).ravel()
        return given if given.size else np.zeros(1)
    except NOT_NUMBERS:
        return np.zeros(1)
