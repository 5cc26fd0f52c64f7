"""What drives a machine: torques of its joints, friction in them, and the weights of what they cost."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np

from models import FixedBase, FreeFloating, Standing
from models.arrays import Array
from models.robot.dynamics import GRAVITY, Wrench, inverse_dynamics
from ocp.errors import NOT_NUMBERS, ProblemError, checked_nonnegative, floats

__all__ = ["Effort", "JointFriction", "Motors", "checked_motors", "joint_torques", "nonnegative_each"]

Motors = FixedBase | FreeFloating
"""Machines that are moved by the torques of their joints alone."""


@dataclass(frozen=True)
class JointFriction:
    """Friction in the joints, each one number or one for each joint.

    Attributes:
        viscous: N m s/rad or N s/m. coulomb: N m or N.
        slip: Speed at which Coulomb friction has reached three quarters, rad/s or m/s: it is smooth for the solver.

    Raises:
        ProblemError: A coefficient below zero, a slip that is not positive.
    """

    viscous: Any = 0.0
    coulomb: Any = 0.0
    slip: float = 0.01

    def __post_init__(self) -> None:
        for what in ("viscous", "coulomb"):
            nonnegative_each(f"friction: {what}", getattr(self, what), None)
        if not checked_nonnegative("friction: slip", self.slip) > 0:
            raise ProblemError("friction: slip must be positive", name="slip", value=self.slip, limit=0.0)

    def torques(self, rates: Any) -> Any:
        """What the joints must give against it. Shape (n, 1)."""
        n = rates.numel()
        viscous, coulomb = (
            ca.DM(nonnegative_each(f"friction: {what}", getattr(self, what), n)) for what in ("viscous", "coulomb")
        )
        return viscous * rates + coulomb * ca.tanh(rates / self.slip)


@dataclass(frozen=True)
class Effort:
    """Weights of the parts of the cost, an integral over the motion plus `time` times the final time.

    Attributes:
        torque: Of the squared torques, one number or one for each joint: losses in the windings, 1/(N m)^2/s.
        energy: Of what the drives give, the sum of max(torque times rate, 0): nothing is won back by braking, 1/J.
        acceleration: Of the squared accelerations, one number or one for each joint: light joints at the end of an arm
            turn by hardly any torque. jerk: Of the squared jerks, where they are the control.
        turning: Of the squared angular velocity of a base that floats, 1/(rad/s)^2/s.
        time: Of the final time, 1/s.

    Raises:
        ProblemError: A weight below zero; none above.
    """

    torque: Any = 1.0
    energy: float = 0.0
    acceleration: Any = 0.0
    jerk: float = 0.0
    turning: float = 0.0
    time: float = 0.0

    def __post_init__(self) -> None:
        each = [nonnegative_each(f"effort: {what}", getattr(self, what), None) for what in ("torque", "acceleration")]
        names = ("energy", "jerk", "turning", "time")
        parts = [checked_nonnegative(f"effort: {what}", getattr(self, what)) for what in names]
        if not (any(parts) or np.concatenate(each).any()):
            raise ProblemError("effort: at least one weight must be above zero", name="effort", value=self, limit=0.0)


def joint_torques(
    machine: Motors,
    base: Any,
    joints: Any,
    rates: Any,
    accelerations: Any,
    *,
    friction: JointFriction | None = None,
    wrenches: Sequence[Wrench] = (),
    gravity: Any = None,
) -> Any:
    """Torques (forces of prismatic joints) of a motion. Shape (n, 1), N m or N.

    Args:
        machine: On a fixed base, or floating freely.
        base, joints, rates: Symbols, (base_size, 1) and (n, 1) each: of a floating machine they are differentiated.
        accelerations: Shape (n, 1).
        friction: In the joints.
        wrenches, gravity: From outside, and acceleration of free fall, m/s^2, GRAVITY if None; on a fixed base alone.

    Raises:
        ProblemError: Another machine; something acts from outside on one that floats.
    """
    robot = checked_motors("joint_torques", machine).robot
    if isinstance(machine, FixedBase):
        fall = GRAVITY if gravity is None else gravity
        found = inverse_dynamics(robot, joints, rates, accelerations, wrenches, fall, machine.world_from_base(base))
    else:
        if wrenches or gravity is not None:
            words = "nothing acts from outside on a machine that floats freely: its momentum is conserved"
            name = "wrenches" if wrenches else "gravity"
            raise ProblemError(words, name=name, value=wrenches or gravity)
        found = machine.joint_torques(base, joints, rates, accelerations)
    return found if friction is None else found + friction.torques(rates)


def checked_motors(what: str, machine: Any) -> Motors:
    """The machine; ProblemError unless it is one that the torques of its joints alone move."""
    if not isinstance(machine, FixedBase | FreeFloating) or isinstance(machine, Standing):
        words = f"{what}: a FixedBase or a FreeFloating is expected, not a {type(machine).__name__}; what stands is "
        words += "for standing_problem"
        raise ProblemError(words, name="machine", value=machine)
    return machine


def nonnegative_each(what: str, value: Any, size: int | None) -> Array:
    """One number or, where a size is told, as many; ProblemError where they are negative, not finite, or others."""
    name = what.rpartition(" ")[2]
    try:
        found = floats(value).reshape(-1)
    except NOT_NUMBERS as error:
        words = f"{what}: one number or one for each joint is expected, not {value!r}"
        raise ProblemError(words, name=name, value=value) from error
    if not found.size or not (np.isfinite(found) & (found >= 0)).all():
        raise ProblemError(f"{what} must be zero or above, and finite: {value!r}", name=name, value=value, limit=0.0)
    if size is None:
        return found
    if found.size not in (1, size):
        words = f"{what}: one number or {size} are expected, not {found.size}"
        raise ProblemError(words, name=name, value=found.size, limit=size)
    return np.array(np.broadcast_to(found, size))
