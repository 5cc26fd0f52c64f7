"""Optimal control problems of fixed and free-floating arms within actuator limits, controlled by acceleration or jerk.

The joint torques follow from inverse dynamics (see `torques`). No mass matrix is inverted, and torque limits are
ordinary path constraints (Featherstone 2008, chapter 5; Betts 2010, section 4.10).

`ocp.motion.builders.dynamics_plan` declares problems with several goals, and with changing loads, as phases.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Any, Literal

import casadi as ca
import numpy as np

from models import Robot, find_wheels
from models.checks import NOT_NUMBERS, Array, floats
from models.robot.dynamics import Wrench
from models.spatial import quaternion_product
from ocp.console import interruptible
from ocp.errors import ProblemError, require
from ocp.motion.builders.clearance import ClearanceConstraints
from ocp.motion.builders.standing.problem import FreeTime, declare_horizon, declare_joints
from ocp.motion.builders.torques import (
    JointFriction,
    Motors,
    checked_motors,
    joint_torques,
    limit_power,
    limit_torques,
    running_cost,
)
from ocp.motion.tasks.checks import (
    check_length,
    check_rest,
    checked_configuration,
    checked_tasks,
    clip_to_limits,
    rates_at_rest,
)
from ocp.motion.tasks.equations import TaskEquations, bind
from ocp.motion.tasks.goals import Cost
from ocp.motion.tasks.limits import JointBounds, Limits
from ocp.motion.tasks.tip_task import TipTask
from ocp.problem.problem import Problem, remembers_request

QUINTIC = np.polynomial.Polynomial([0, 0, 0, 10, -15, 6])


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
        friction, wrenches, gravity: Arguments of `joint_torques`.
        control: "acceleration", or "jerk" for continuous accelerations, zero at ends at rest.
        clearance_constraints: Collision avoidance, see `ocp.motion.builders.clearance`; None for none.
        symbols: casadi.SX, or casadi.MX if a task calls an interpolant.
    """

    start_velocity: Literal["rest", "free"] | Any = "rest"
    end_velocity: Literal["rest", "free"] | Any = "rest"
    start_base: Any = None
    end_base: Any = None
    friction: JointFriction | None = None
    wrenches: Sequence[Wrench] = ()
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
    The controls are "accelerations" or "jerks", and "power" (W, the positive actuator power) if energy is weighted.
    The path constraints are "torques", "power", and with tasks "tip": the time derivative of the
    task velocities, with pose errors fed back. A start with free velocity must satisfy the task velocities.

    Args:
        machine: A FixedBase, or a FreeFloating machine, whose momentum is conserved.
        tasks: A TipTask, or several that are done at once over the whole motion, functions of the time in s. An empty
            sequence for a motion from point to point.
        horizon: Final time, s, or FreeTime(...).
        start, end: Start and end configurations. Shape (n,), rad or m; nan where free, None if all are free. A
            start is free only in a phase that is joined to another.
        limits: Limits of joints, velocities, accelerations, jerks, torques and power; the robot's own if None.
        cost: Weights of the cost; the squared torques if None.
        setup: Velocities and base at both ends, friction, loads, control and clearance; the defaults if None.

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
    loads: dict[str, Any] = {"friction": setup.friction, "wrenches": setup.wrenches, "gravity": setup.gravity}
    torques = joint_torques(machine, motion, **loads)
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
        words: dict[str, Any] = {"names": machine.robot.joint_names, "hint": hint}
        first, last = (
            clip_to_limits(_checked_end(name, value, n), bounds.lower, bounds.upper, label=name, **words)
            for name, value in zip(("start", "end"), joints, strict=True)
        )
        first_rates, last_rates = (
            clip_to_limits(end_velocities(name, value, n), -bounds.velocity, bounds.velocity, label=name, **words)
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
    guess = {
        name: ends.quintic(duration, order) for order, name in enumerate(("joints", "velocities", "accelerations"))
    }
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
    """Return positions or velocities given for one end as numbers (n,), nan where free, or raise ProblemError."""
    if value is None:
        return np.full(n, np.nan)
    with suppress(*NOT_NUMBERS):
        numbers = floats(value).reshape(-1)
        if numbers.shape == (n,) and not np.isinf(numbers).any():
            return numbers
    raise ProblemError(f"{name} must be {n} numbers, nan where free, not {value!r}", name=name, value=value, limit=n)


def _wheel_scales(robot: Robot, bounds: JointBounds, duration: float) -> Array:
    """Return scales (4, n) of angles, speeds, accelerations and jerks of reaction wheels, nan for other joints."""
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


def _declare_tasks(
    problem: Problem, equations: TaskEquations, ends: _Ends, motion: tuple[Any, Any, Any, Any], duration: float
) -> None:
    """Constrain the tip accelerations to those that tasks prescribe; declare the pose errors that the audit checks."""
    base, joints, rates, second = motion
    if not np.isnan(ends.first).any():
        checked_tasks(equations, ends.base, ends.first, duration)
    check_length(equations, ends.base, duration)
    check_rest(equations, 0.0 if ends.rests[0] else None, duration if ends.rests[1] else None)
    targets = equations.targets(problem.time)
    if not ends.rests[0]:
        residual = equations.residual(base, joints, rates, targets)
        problem.start("tip velocity", residual, lower=0, upper=0, unit=equations.unit())
    gap = equations.acceleration(base, joints, rates, second, progress=(problem.time,))
    problem.path("tip", gap, lower=0, upper=0, unit=equations.unit("/s^2", "/s^2"))
    for name, deviation in equations.deviations(base, joints, rates, targets).items():
        problem.watch(name, **deviation)
