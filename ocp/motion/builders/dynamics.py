"""Motions of fixed and free-floating arms within actuator limits, controlled by joint acceleration or jerk.

The joint torques follow from inverse dynamics,

    tau = M(q) q'' + h(q, q') - (external forces) + d q' + c tanh(q' / w),

with viscous friction d and Coulomb friction c, smoothed below the speed w. A floating base conserves momentum: it moves
as the joints make it move, and the torques are those of the joints alone. No mass matrix is inverted, and torque limits
are ordinary path constraints (Featherstone 2008, chapter 5; Betts 2010, section 4.10).
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Any, Literal

import casadi as ca
import numpy as np

from models import FixedBase, FreeFloating, Machine, Robot, Standing, find_wheels
from models.checks import NOT_NUMBERS, Array, floats
from models.machines.machine import Wrenches, wrenches_at
from models.robot.dynamics import GRAVITY, Wrench, inverse_dynamics
from models.spatial import quaternion_product
from ocp.console import interruptible
from ocp.errors import ProblemError, require
from ocp.motion.builders.clearance import ClearanceConstraints
from ocp.motion.builders.standing.problem import (
    FreeTime,
    constrain_tips,
    declare_horizon,
    declare_joints,
    limit_torques,
)
from ocp.motion.tasks.checks import (
    check_length,
    check_rest,
    checked_configuration,
    checked_tasks,
    checked_weights,
    clip_to_limits,
    rates_at_rest,
)
from ocp.motion.tasks.equations import TaskEquations, bind
from ocp.motion.tasks.goals import PER_JOINT, Cost
from ocp.motion.tasks.limits import JointBounds, Limits
from ocp.motion.tasks.tip_task import TipTask
from ocp.problem.problem import Problem, remembers_request

LENGTH_RATE = 1e-2
"""Joint rate below which the integrand |q'| of the path length in a cost is smoothed, rad/s.

sqrt(|q'|^2 + LENGTH_RATE^2) exceeds |q'| by 0.02 % at 0.5 rad/s, and by LENGTH_RATE at rest.
"""

QUINTIC = np.polynomial.Polynomial([0, 0, 0, 10, -15, 6])
Motors = FixedBase | FreeFloating  # type of the machines whose motion the joint torques alone determine


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
    rests: tuple[bool, bool] = (False, False)  # whether the joints rest at the start and at the end
    rest_rows: tuple[Any, Any] = (None, None)  # rows (k, n) of the motion that is zero at rest at each end; None: all
    smoothing: float = 1e-3  # duration in which a control passes from limit to limit, as a share of the horizon


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
    "power" where these are limited or weighted. `place` has base configuration and joint positions, `pace` is the
    seconds of the motion in a second of the problem.
    """
    (base, joints), robot, n = place, machine.robot, machine.joint_size
    cost = Cost() if actuation.cost is None else actuation.cost
    smoothing, (starts, ends) = actuation.smoothing * horizon, actuation.rests
    start_rows, end_rows = (np.eye(n) if rows is None else np.asarray(rows) for rows in actuation.rest_rows)
    limits: dict[str, Any] = {"lower": -bounds.velocity, "upper": bounds.velocity, "unit": robot.unit("/s")}
    first, last = (0.0 if rest and len(rows) == n else None for rest, rows in ((starts, start_rows), (ends, end_rows)))
    rates = problem.state(f"velocities{suffix}", n, initial=0.0 if starts else None, terminal=last, **limits)
    if ends and 0 < len(end_rows) < n:
        problem.end(f"rest{suffix}", ca.mtimes(ca.DM(end_rows), rates), 0, 0)
    limits = {"lower": -bounds.acceleration, "upper": bounds.acceleration, "unit": robot.unit("/s^2")}
    jerks: Any = ca.DM(0, 1)
    if np.isfinite(bounds.jerk).any() or cost.jerk:
        second = problem.state(f"accelerations{suffix}", n, initial=first, terminal=last, **limits)
        if starts and 0 < len(start_rows) < n:
            problem.start(f"start acceleration{suffix}", ca.mtimes(ca.DM(start_rows), second), 0, 0)
        if ends and 0 < len(end_rows) < n:
            problem.end(f"end acceleration{suffix}", ca.mtimes(ca.DM(end_rows), second), 0, 0)
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
    return bool({"effort", "energy"} & set(cost.terms))


def running_cost(machine: Machine, cost: Cost, motion: tuple[Any, Any, Any, Any], *, jerks: Any, torques: Any) -> Any:
    """Return the cost per second of a motion, without the terms of duration and positive power, as an expression."""
    (base, joints, rates, second), n = motion, machine.joint_size
    effort, acceleration = (require.broadcast(f"cost: {name}", getattr(cost, name), n, "joints") for name in PER_JOINT)
    running = ca.dot(ca.DM(acceleration), second**2)
    if cost.velocity:
        running += ca.dot(ca.DM(cost.joint_weights(n)), rates**2) / 2
    if cost.length:
        running += cost.length * ca.sqrt(ca.dot(ca.DM(checked_weights(cost.weights, n)), rates**2) + LENGTH_RATE**2)
    if cost.jerk:
        running += cost.jerk * ca.sumsqr(jerks)
    if cost.turning and isinstance(machine, FreeFloating):
        spin = [k for k, row in enumerate(machine.twist_rows) if row < 3]
        running += cost.turning * ca.sumsqr(machine.base_twist(base, joints, rates)[spin])
    if effort.any():
        running += ca.dot(ca.DM(effort), torques**2)
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


@dataclass(frozen=True, eq=False)
class DynamicsSetup:
    """Settings of `dynamics_problem` that most motions leave at their defaults.

    Attributes:
        start_velocity, end_velocity: "rest", "free", or the joint velocities at that end, nan where free. Shape (n,),
            rad/s or m/s. Reaction wheels that store the momentum of a base at rest turn at the end.
        start_base: Configuration of the base at the start; home if None. All nan leaves it free, in a phase that is
            joined to another. Shape (base_size,).
        end_base: Configuration of a floating base at the end, nan where free. A quaternion is given as a whole or not
            at all. Shape (base_size,).
        friction, gravity: Arguments of `joint_torques`.
        wrenches: External wrenches on an arm on a fixed base: a list, or a function of time and tip position.
        control: "acceleration", or "jerk" for continuous accelerations, zero at ends at rest.
        clearance_constraints: Collision avoidance, see `ocp.motion.builders.clearance`; None for none.
        symbols: casadi.SX, or casadi.MX if a task calls an interpolant.
    """

    start_velocity: Literal["rest", "free"] | Any = "rest"
    end_velocity: Literal["rest", "free"] | Any = "rest"
    start_base: Any = None
    end_base: Any = None
    friction: JointFriction | None = None
    wrenches: Wrenches = ()
    gravity: Any = None
    control: Literal["acceleration", "jerk"] = "acceleration"
    clearance_constraints: ClearanceConstraints | None = None
    symbols: Any = ca.SX


@interruptible
@remembers_request("dynamics")
def dynamics_problem(
    machine: Motors,
    tasks: TipTask | Sequence[TipTask],
    horizon: float | FreeTime,
    *,
    start: Any,
    end: Any = None,
    limits: Limits | None = None,
    cost: Cost | None = None,
    setup: DynamicsSetup | None = None,
) -> Problem:
    """Declare the optimal control problem of a motion within actuator limits that minimises effort, energy or time.

    The states are "joints", "velocities", "accelerations" if the jerk is the control, and "base" of a floating machine.
    The controls are "accelerations" or "jerks", and "power" (W, the positive actuator power) if energy is weighted. The
    path constraints are "torques", "power", and with tasks "tip": the time derivative of the task velocities, with pose
    errors fed back. A start with free velocity must satisfy the task velocities.

    Args:
        machine: A FixedBase, or a FreeFloating machine, whose momentum is conserved.
        tasks: A TipTask, several that are done at once over the whole motion, or none. Functions of the time in s.
        horizon: Final time, s, or FreeTime(...).
        start, end: Start and end configurations. Shape (n,), rad or m; nan where free, None if all are free. A start is
            free only in a phase that is joined to another.
        limits: Limits of joints, velocities, accelerations, jerks, torques and power; the robot's own if None.
        cost: Weights of the cost; the squared torques if None.
        setup: Velocities and base at both ends, friction, loads, control and clearance.

    Raises:
        ProblemError: Sizes or options do not match; an end is outside the limits; the jerk is limited but not the
            control; a task does not begin at its tip, or moves where the joints are at rest; the horizon is free
            although tasks fix the time.
    """
    checked_motors("dynamics_problem", machine)
    limits = Limits() if limits is None else require.instance("dynamics_problem: limits", limits, Limits)
    cost = Cost(velocity=0.0, effort=1.0) if cost is None else require.instance("dynamics_problem: cost", cost, Cost)
    setup = DynamicsSetup() if setup is None else require.instance("dynamics_problem: setup", setup, DynamicsSetup)
    for option, kind in (("friction", JointFriction), ("clearance_constraints", ClearanceConstraints)):
        if getattr(setup, option) is not None:
            require.instance(f"dynamics_problem: {option}", getattr(setup, option), kind)
    if cost.length:
        words = "cost: the length of a motion under dynamics is not smooth at rest; weight its velocity instead"
        raise ProblemError(words, name="length", value=cost.length, limit=0.0)
    control = require.choice("control", setup.control, ("acceleration", "jerk"))
    bounds = limits.bounds(machine, ("velocity", "torque"))
    if control == "acceleration" and (np.isfinite(bounds.jerk).any() or cost.jerk):
        words = "the jerk is limited or weighted, but the control is the acceleration; set control='jerk'"
        raise ProblemError(words, name="control", value=control, limit="jerk")
    free = isinstance(horizon, FreeTime)
    duration = require.positive("horizon", horizon.guess if isinstance(horizon, FreeTime) else horizon)
    ends = _Ends.checked(machine, bounds, (start, end), (setup.start_velocity, setup.end_velocity), setup.start_base)
    tasks = (tasks,) if isinstance(tasks, TipTask) else require.each("tasks", tasks, TipTask)
    equations = bind(machine, tasks) if tasks else None
    if equations is not None:
        if free:
            raise ProblemError("tasks fix the time: give a horizon in s, not a free one", name="horizon")
        if ends.rests[1]:
            ends = replace(ends, last_rates=rates_at_rest(equations, ends.base, ends.end))

    problem = Problem("dynamics", setup.symbols)
    final = declare_horizon(problem, horizon)
    motion, jerks = _declare_motion(problem, machine, ends, bounds, duration, control)
    if setup.end_base is not None:
        _declare_end_base(problem, machine, motion[0], setup.end_base)
    wrenches = wrenches_at(setup.wrenches, machine, *motion[:2], time=problem.time)
    torques = joint_torques(machine, motion, friction=setup.friction, wrenches=wrenches, gravity=setup.gravity)
    limit_torques(problem, machine.robot, torques, bounds.torque)
    running = running_cost(machine, cost, motion, jerks=jerks, torques=torques)
    if cost.energy or np.isfinite(bounds.power).any():
        running += limit_power(problem, torques * motion[2], bounds, cost)
    if equations is not None:
        _declare_tasks(problem, equations, ends, motion, duration)
    if setup.clearance_constraints is not None:
        base = "base" if machine.base_size else machine.base_home()
        setup.clearance_constraints.declare(problem, base, horizon=None if free else duration)
    problem.minimize(running=running, terminal=cost.time * final)
    return problem


def _declare_tasks(problem: Problem, equations: TaskEquations, ends: _Ends, motion: Any, duration: float) -> None:
    """Check that tasks fit the ends of a motion, and constrain the tips."""
    if not np.isnan(ends.first).any():
        checked_tasks(equations, ends.base, ends.first, duration)
    check_length(equations, ends.base, duration)
    check_rest(equations, 0.0 if ends.rests[0] else None, duration if ends.rests[1] else None)
    constrain_tips(problem, equations, motion, (problem.time,), moving=not ends.rests[0])


@dataclass(frozen=True, eq=False)
class _Ends:
    """Boundary conditions of a motion, checked against the joint limits; free positions and velocities are nan."""

    first: Array  # joint positions at the start, (n,)
    last: Array  # and at the end
    first_rates: Array
    last_rates: Array
    rests: tuple[bool, bool]  # whether all joints are at rest at the start, and at the end
    base: Array  # configuration of the base at the start; its guess where it is free
    joined: bool  # whether joints or base continue from another phase
    start: Array  # joint positions at the start of the guess, (n,)

    @classmethod
    def checked(
        cls, machine: Motors, bounds: JointBounds, joints: tuple[Any, Any], velocities: tuple[Any, Any], base: Any
    ) -> _Ends:
        n, hint = machine.joint_size, "keep within them, or leave that end free: nan"
        first, last = (
            clip_to_limits(machine, _checked_end(name, value, n), bounds.lower, bounds.upper, label=name, hint=hint)
            for name, value in zip(("start", "end"), joints, strict=True)
        )
        largest = bounds.velocity
        first_rates, last_rates = (
            clip_to_limits(machine, end_velocities(name, value, n), -largest, largest, label=name, hint=hint)
            for name, value in zip(("start_velocity", "end_velocity"), velocities, strict=True)
        )
        known = np.clip(np.where(np.isnan(first), np.nan_to_num(last), first), bounds.lower, bounds.upper)
        free = base is not None and bool(np.isnan(_checked_end("start_base", base, machine.base_size)).all())
        _, home = checked_configuration(machine, known, None if free else base)
        rests = bool((first_rates == 0).all()), bool((last_rates == 0).all())
        return cls(first, last, first_rates, last_rates, rests, home, joints[0] is None or free, known)

    @property
    def end(self) -> Array:
        """Joint positions at the end of the initial guess; joints with a free end stay where they start. Shape (n,)."""
        return np.where(np.isnan(self.last), self.start, self.last)

    def quintic(self, duration: float, order: int) -> Any:
        """Return the quintic joint motion of the initial guess, or a derivative of it, as a function of time."""
        shape = QUINTIC.deriv(order) if order else QUINTIC
        begin = self.start if order == 0 else np.zeros(len(self.start))
        return lambda t: begin + (self.end - self.start) * shape(t / duration) / duration**order


def _declare_motion(
    problem: Problem, machine: Motors, ends: _Ends, bounds: JointBounds, duration: float, control: str
) -> tuple[tuple[Any, Any, Any, Any], Any]:
    """Declare states and controls of base and joints; return base, positions, rates and accelerations, and jerks."""
    guess = {name: ends.quintic(duration, k) for k, name in enumerate(("joints", "velocities", "accelerations"))}
    joints, rates, second, jerks = declare_joints(
        problem, machine.robot, bounds, guess, jerk=control == "jerk",
        starts=(ends.first, ends.first_rates, 0.0 * ends.first_rates),
        ends=(ends.last, ends.last_rates, 0.0 * ends.last_rates),
        scales=_wheel_scales(machine.robot, bounds, duration),
    )  # fmt: skip
    base: Any = ca.DM(0, 1)
    if machine.base_size:
        base = problem.state("base", machine.base_size, initial=None if ends.joined else ends.base, guess=ends.base)
        problem.dynamics(base, machine.base_rate(base, joints, rates))
    return (base, joints, rates, second), jerks


def _checked_end(name: str, value: Any, n: int) -> Array:
    """Check positions or velocities given for one end of a motion; return them as numbers (n,), nan where free."""
    if value is None:
        return np.full(n, np.nan)
    with suppress(*NOT_NUMBERS):
        numbers = floats(value).reshape(-1)
        if numbers.shape == (n,) and not np.isinf(numbers).any():
            return numbers
    raise ProblemError(f"{name} must be {n} numbers, nan where free, not {value!r}", name=name, value=value, limit=n)


def _wheel_scales(robot: Robot, bounds: JointBounds, duration: float) -> Array:
    """Return scales (4, n) of angles, speeds, accelerations and jerks of reaction wheels; nan for other joints."""
    # rotors are light and turn fast: a quarter of saturation speed and motor torque, or what 1 N m s and 1 N m cause
    scales = np.full((4, robot.dof), np.nan)
    for name, inertia in find_wheels(robot).items():
        k = robot.joint_names.index(name)
        speed, torque = bounds.velocity[k], bounds.torque[k]
        speed = speed / 4 if np.isfinite(speed) else 1 / inertia
        acceleration = torque / inertia / 4 if np.isfinite(torque) else 1 / inertia
        scales[:, k] = speed * duration / 4, speed, acceleration, 4 * acceleration / duration
    return scales


def end_velocities(name: str, value: Any, n: int) -> Array:
    """Convert numbers, "rest" or "free" to joint velocities (n,) at one end of a motion; free velocities are nan."""
    if isinstance(value, str):
        return np.full(n, 0.0 if require.choice(name, value, ("rest", "free")) == "rest" else np.nan)
    if value is None:
        raise ProblemError(f"{name} must be 'rest', 'free' or velocities, not None", name=name, value=value)
    return _checked_end(name, value, n)


def _declare_end_base(problem: Problem, machine: Motors, base: Any, end_base: Any) -> None:
    """Constrain the base configuration at the end of a motion; a spatial attitude takes three equations, not four."""
    if not machine.base_size:
        raise ProblemError("a fixed base has no end_base", name="end_base", value=end_base)
    goal = _checked_end("end_base", end_base, machine.base_size)
    gaps = base - goal
    rows = np.flatnonzero(~np.isnan(goal)).tolist()
    if machine.base_size == 7 and set(rows) & {3, 4, 5, 6}:
        if not abs(np.linalg.norm(goal[3:]) - 1) <= 1e-9:
            words = f"end_base has the quaternion {goal[3:].tolist()}; give all four entries, of unit length"
            raise ProblemError(words, name="end_base", value=goal[3:])
        turned = quaternion_product(ca.DM([goal[3], *(-goal[4:])]), base[3:7])
        gaps = ca.vertcat(gaps[:3], 2 * turned[1:4])
        rows = [row for row in rows if row < 3] + [3, 4, 5]
    if rows:
        problem.end("base", gaps[rows], 0.0, 0.0, unit="m, rad")
