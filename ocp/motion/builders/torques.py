"""Joint torques of a machine, and actuator limits and costs of motions whose controls are accelerations.

The joint torques follow from inverse dynamics,

    tau = M(q) q'' + h(q, q') - (external forces) + d q' + c tanh(q' / w),

with viscous friction d and Coulomb friction c, smoothed below the speed w. A floating base conserves momentum: it moves
as the joints make it move, and the torques are those of the joints alone.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np

from models import FixedBase, FreeFloating, Machine, Robot, Standing
from models.checks import Array
from models.robot.dynamics import GRAVITY, Wrench, inverse_dynamics
from ocp.errors import ProblemError, require
from ocp.motion.tasks.checks import checked_weights
from ocp.motion.tasks.goals import Cost
from ocp.motion.tasks.limits import JointBounds
from ocp.problem.problem import Problem

LENGTH_RATE = 1e-2
"""Joint rate below which the integrand |q'| of the path length in a cost is smoothed, rad/s.

sqrt(|q'|^2 + LENGTH_RATE^2) exceeds |q'| by 0.02 % at 0.5 rad/s, and by LENGTH_RATE at rest.
"""

Motors = FixedBase | FreeFloating
"""Type of the machines whose motion the joint torques alone determine."""


@dataclass(frozen=True)
class JointFriction:
    """Viscous and smoothed Coulomb friction in the joints of a machine.

    Attributes:
        viscous: Viscous coefficient, one number or one for each joint, N m s/rad or N s/m.
        coulomb: Coulomb friction, one number or one for each joint, N m or N.
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
        if not require.nonnegative("friction: slip", self.slip) > 0:
            raise ProblemError("friction: slip must be positive", name="slip", value=self.slip, limit=0.0)

    def torques(self, rates: Any) -> Any:
        """Return the joint torques that overcome the friction at given joint rates. Shape (n, 1)."""
        n = rates.numel()
        viscous = ca.DM(require.broadcast("friction: viscous", self.viscous, n, "joints", sign="nonnegative"))
        coulomb = ca.DM(require.broadcast("friction: coulomb", self.coulomb, n, "joints", sign="nonnegative"))
        return viscous * rates + coulomb * ca.tanh(rates / self.slip)


def joint_torques(
    machine: Motors,
    motion: tuple[Any, Any, Any, Any],
    *,
    friction: JointFriction | None = None,
    wrenches: Sequence[Wrench] = (),
    gravity: Any = None,
) -> Any:
    """Return the joint torques (forces of prismatic joints) that a motion requires. Shape (n, 1), N m or N.

    Args:
        machine: Machine on a fixed base, or floating freely.
        motion: Base configuration, joint positions, rates and accelerations. Shapes (base_size, 1) and (n, 1).
            Symbols for a floating machine, because they are differentiated.
        friction: Friction in the joints; None for none.
        wrenches: External wrenches, on a fixed base only.
        gravity: Acceleration of free fall, m/s^2, on a fixed base only; GRAVITY if None.

    Raises:
        ProblemError: The machine is of another kind, or external forces act on a floating one.
    """
    robot = checked_motors("joint_torques", machine).robot
    base, joints, rates, accelerations = motion
    if isinstance(machine, FixedBase):
        load: dict[str, Any] = {"wrenches": wrenches, "gravity": GRAVITY if gravity is None else gravity}
        ground = machine.world_from_base(base)
        torques = inverse_dynamics(robot, joints, rates, accelerations, **load, world_from_base=ground)
    else:
        if wrenches or gravity is not None:
            words = "external wrenches and gravity need a fixed base: a free-floating machine conserves its momentum"
            raise ProblemError(words, name="wrenches" if wrenches else "gravity", value=wrenches or gravity)
        torques = machine.joint_torques(base, joints, rates, accelerations)
    return torques if friction is None else torques + friction.torques(rates)


def checked_motors(name: str, machine: Any) -> Motors:
    """Return a machine if the joint torques alone determine its motion, else raise ProblemError."""
    if not isinstance(machine, FixedBase | FreeFloating) or isinstance(machine, Standing):
        words = f"{name}: a FixedBase or a FreeFloating is expected, not a {type(machine).__name__}; use "
        words += "standing_problem for a standing machine"
        raise ProblemError(words, name="machine", value=machine)
    return machine


@dataclass(frozen=True, eq=False)
class Actuation:
    """Options of a motion controlled by joint accelerations, or by jerks if these are limited or weighted."""

    cost: Cost | None = None  # weights of all terms but the time; None for half the squared rates
    # whether the joints are at rest at the start and at the end; else they are free to move there
    rests: tuple[bool, bool] = (False, False)
    # rows (k, n) of the velocities that are zero at an end at rest, None for all: tasks may bring the tip to rest
    end_rows: Any = None
    # duration in which a control passes from limit to limit by a term of the cost, as a share of the horizon
    smoothing: float = 1e-3


def declare_actuators(
    problem: Problem,
    machine: Machine,
    horizon: float,
    place: tuple[Any, Any],
    *,
    bounds: JointBounds,
    actuation: Actuation,
    pace: Any,
    suffix: str = "",
) -> tuple[Any, Any, Any]:
    """Declare joint velocities and accelerations within actuator limits; return both and the running cost per second.

    The states are "velocities", and "accelerations" if the controls are "jerks". The path constraints are "torques" and
    "power" where these are limited or weighted.

    Args:
        horizon: Horizon of the problem, s.
        place: Base configuration and joint positions as symbols.
        actuation: Cost, smoothness, and whether the joints are at rest where these states start and end.
        pace: Seconds of the motion in a second of the problem.
        suffix: Suffix of the declared names.

    Raises:
        ProblemError: Torques are limited or weighted, but the joint torques alone do not move the machine.
    """
    (base, joints), robot, n = place, machine.robot, machine.joint_size
    cost = Cost() if actuation.cost is None else actuation.cost
    smoothing, (initial, terminal) = actuation.smoothing * horizon, (0.0 if rest else None for rest in actuation.rests)
    limits: dict[str, Any] = {"lower": -bounds.velocity, "upper": bounds.velocity, "unit": robot.unit("/s")}
    if terminal is None or actuation.end_rows is None:
        rates = problem.state(f"velocities{suffix}", n, initial=initial, terminal=terminal, **limits)
    else:
        rates = problem.state(f"velocities{suffix}", n, initial=initial, **limits)
        if len(actuation.end_rows):
            problem.end(f"rest{suffix}", ca.mtimes(ca.DM(actuation.end_rows), rates), 0, 0, unit=robot.unit("/s")[0])
    limits = {"lower": -bounds.acceleration, "upper": bounds.acceleration, "unit": robot.unit("/s^2")}
    jerks: Any = ca.DM(0, 1)
    if np.isfinite(bounds.jerk).any() or cost.jerk:
        second = problem.state(f"accelerations{suffix}", n, **limits)
        jerks = problem.control(f"jerks{suffix}", n, lower=-bounds.jerk, upper=bounds.jerk, unit=robot.unit("/s^3"))
        problem.dynamics(second, pace * jerks)
        smooth = smoothing**2 * ca.sumsqr(jerks)
    else:
        second = problem.control(f"accelerations{suffix}", n, **limits)
        smooth = ca.sumsqr(second)
    problem.dynamics(rates, pace * second)
    torques: Any = None
    if np.isfinite([bounds.torque, bounds.power]).any() or weights_torques(cost):
        torques = joint_torques(checked_motors("limits", machine), (base, joints, rates, second))
        limit_torques(problem, robot, torques, bounds.torque, suffix=suffix)
    running = running_cost(machine, cost, (base, joints, rates, second), jerks=jerks, torques=torques)
    if torques is not None:
        running += limit_power(problem, torques * rates, bounds, cost, suffix=suffix)
    return rates, second, running + smoothing**2 / 2 * smooth


def weights_torques(cost: Cost) -> bool:
    """Return whether a cost depends on joint torques."""
    return bool(np.any(np.asarray(cost.effort))) or bool(cost.energy)


def running_cost(machine: Machine, cost: Cost, motion: tuple[Any, Any, Any, Any], *, jerks: Any, torques: Any) -> Any:
    """Return the cost per second of a motion, without the terms of duration and positive power, as an expression."""
    (base, joints, rates, second), n = motion, machine.joint_size
    running = ca.dot(
        ca.DM(require.broadcast("cost: acceleration", cost.acceleration, n, "joints", sign="nonnegative")), second**2
    )
    if cost.velocity:
        running += ca.dot(ca.DM(cost.joint_weights(n)), rates**2) / 2
    if cost.length:
        running += cost.length * ca.sqrt(ca.dot(ca.DM(checked_weights(cost.weights, n)), rates**2) + LENGTH_RATE**2)
    if cost.jerk:
        running += cost.jerk * ca.sumsqr(jerks)
    if cost.turning and isinstance(machine, FreeFloating):
        spin = [k for k, row in enumerate(machine.twist_rows) if row < 3]
        running += cost.turning * ca.sumsqr(machine.base_twist(base, joints, rates)[spin])
    if np.any(np.asarray(cost.effort)):
        running += ca.dot(
            ca.DM(require.broadcast("cost: effort", cost.effort, n, "joints", sign="nonnegative")), torques**2
        )
    return running


def limit_power(problem: Problem, powers: Any, bounds: JointBounds, cost: Cost, *, suffix: str = "") -> Any:
    """Declare the limits of the actuators' powers, W, and return the cost per second of the positive power.

    If the cost weights energy, the positive power of each joint is a control of this name, because the cost needs it.
    """
    if not cost.energy:
        if rows := np.flatnonzero(np.isfinite(bounds.power)).tolist():
            problem.path(f"power{suffix}", powers[rows], upper=bounds.power[rows], unit="W")
        return 0.0
    power = problem.control(f"power{suffix}", powers.numel(), lower=0.0, upper=bounds.power, unit="W")
    problem.path(f"power{suffix}", power - powers, lower=0.0, unit="W")
    return cost.energy * ca.sum1(power)


def limit_torques(problem: Problem, robot: Robot, torques: Any, largest: Array, *, suffix: str = "") -> None:
    """Declare the torque limits of a robot's joints, where these are finite, as a path constraint."""
    if rows := np.flatnonzero(np.isfinite(largest)).tolist():
        bounds = {"lower": -largest[rows], "upper": largest[rows]}
        problem.path(f"torques{suffix}", torques[rows], unit=robot.effort_unit, **bounds)
