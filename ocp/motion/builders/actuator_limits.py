"""Actuation of a machine: joint torques and friction."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np

from models import FixedBase, FreeFloating, Machine, Standing
from models.robot.dynamics import GRAVITY, Wrench, inverse_dynamics
from ocp.errors import ProblemError, require
from ocp.motion.tasks.limits import JointBounds
from ocp.problem.problem import Problem

__all__ = ["JointFriction", "Motors", "checked_motors", "declare_actuators", "joint_torques"]

Motors = FixedBase | FreeFloating
"""Machines that are moved by the torques of their joints alone."""


@dataclass(frozen=True)
class JointFriction:
    """Viscous and Coulomb friction in the joints, each one number or one for each joint.

    Attributes:
        viscous: Viscous coefficient, N m s/rad or N s/m.
        coulomb: Coulomb friction, N m or N.
        slip: Speed at which the smoothed Coulomb friction reaches three quarters of its value, rad/s or m/s.

    Raises:
        ProblemError: A coefficient is negative, or `slip` is not positive.
    """

    viscous: Any = 0.0
    coulomb: Any = 0.0
    slip: float = 0.01

    def __post_init__(self) -> None:
        for name in ("viscous", "coulomb"):
            require.array(f"friction: {name}", getattr(self, name), ("joints",), sign="nonnegative")
        require.positive("friction: slip", self.slip)

    def torques(self, rates: Any) -> Any:
        """Return the joint torques that overcome the friction. Shape (n, 1)."""
        n = rates.numel()
        viscous, coulomb = (
            ca.DM(require.broadcast(f"friction: {name}", getattr(self, name), n, "joints", sign="nonnegative"))
            for name in ("viscous", "coulomb")
        )
        return viscous * rates + coulomb * ca.tanh(rates / self.slip)


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
    """Return the joint torques (forces of prismatic joints) of a motion. Shape (n, 1), N m or N.

    Args:
        machine: Machine on a fixed base, or floating freely.
        base, joints, rates: Configuration of the base, joints and their rates. Shapes (base_size, 1) and (n, 1).
            Symbols for a floating machine, because they are differentiated.
        accelerations: Joint accelerations. Shape (n, 1).
        friction: Friction in the joints; None for none.
        wrenches: External wrenches, on a fixed base only.
        gravity: Acceleration of free fall, m/s^2, on a fixed base only; GRAVITY if None.

    Raises:
        ProblemError: The machine is of another kind, or external forces act on a floating one.
    """
    robot = checked_motors("joint_torques", machine).robot
    if isinstance(machine, FixedBase):
        fall = GRAVITY if gravity is None else gravity
        torques = inverse_dynamics(robot, joints, rates, accelerations, wrenches, fall, machine.world_from_base(base))
    else:
        if wrenches or gravity is not None:
            words = "external wrenches and gravity need a fixed base: a free-floating machine conserves its momentum"
            name = "wrenches" if wrenches else "gravity"
            raise ProblemError(words, name=name, value=wrenches or gravity)
        torques = machine.joint_torques(base, joints, rates, accelerations)
    return torques if friction is None else torques + friction.torques(rates)


def checked_motors(name: str, machine: Any) -> Motors:
    """Return the machine; raise ProblemError unless its joint torques alone move it."""
    if not isinstance(machine, FixedBase | FreeFloating) or isinstance(machine, Standing):
        words = f"{name}: a FixedBase or a FreeFloating is expected, not a {type(machine).__name__}; use "
        words += "standing_problem for a standing machine"
        raise ProblemError(words, name="machine", value=machine)
    return machine


def declare_actuators(
    problem: Problem,
    machine: Machine,
    motion: tuple[Any, Any, Any],
    bounds: JointBounds,
    *,
    suffix: str,
    pace: float,
    smoothing: float,
) -> tuple[Any, Any]:
    """Declare accelerations within the actuator limits, and return them and the smoothing cost, (rad/s)^2.

    The cost is half the squared accelerations or jerks, times powers of a duration.

    Args:
        motion: Base, joints and rates as symbols.
        bounds: Limits of acceleration, jerk, torque and power.
        suffix: Suffix of the declared names.
        pace: Seconds of the motion in a second of the problem.
        smoothing: Duration in which a control passes from limit to limit instead of jumping, s.
    """
    (base, joints, rates), robot, n = motion, machine.robot, machine.joint_size
    options: dict[str, Any] = {"lower": -bounds.acceleration, "upper": bounds.acceleration, "unit": robot.unit("/s^2")}
    if np.isfinite(bounds.jerk).any():
        second = problem.state(f"accelerations{suffix}", n, **options)
        jerks = problem.control(f"jerks{suffix}", n, lower=-bounds.jerk, upper=bounds.jerk, unit=robot.unit("/s^3"))
        problem.dynamics(second, pace * jerks)
        smooth = smoothing**2 * ca.sumsqr(jerks)
    else:
        second = problem.control(f"accelerations{suffix}", n, **options)
        smooth = ca.sumsqr(second)
    problem.dynamics(rates, pace * second)
    if np.isfinite([bounds.torque, bounds.power]).any():
        torques = joint_torques(checked_motors("limits", machine), base, joints, rates, second)
        for name, values, low, high, unit in (
            ("torques", torques, -bounds.torque, bounds.torque, robot.effort_unit),
            ("power", torques * rates, np.full(n, -np.inf), bounds.power, "W"),
        ):
            rows = np.flatnonzero(np.isfinite(high)).tolist()
            if rows:
                problem.path(f"{name}{suffix}", values[rows], lower=low[rows], upper=high[rows], unit=unit)
    return second, smoothing**2 / 2 * smooth
