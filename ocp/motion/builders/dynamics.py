"""Motions by what drives them: torques, power, accelerations and jerks within limits, at the least effort or time.

For arms on a fixed base and for free-floating ones. Joint accelerations (or jerks) are the control, and the torques are
those of the inverse dynamics,

    tau = M(q) q'' + h(q, q') - (what acts from outside) + d q' + c tanh(q' / w),

with viscous friction d and Coulomb friction c, smoothed below the speed w. On a floating base the momentum is kept, the
base moves as the joints make it move, and the torques are those of the joints alone. So no mass matrix is inverted, and
limits of torque are path constraints like all others (Featherstone 2008, chapter 5; Betts 2010, section 4.10).

A motion goes from point to point, along tasks of the tool, or both; through points on the way and with loads that are
picked up and put down as :class:`~ocp.problem.phases.Phases` of such problems, whose joints and velocities go on.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal, NamedTuple, TypedDict

import casadi as ca
import numpy as np

from models import FreeFloating, Robot, wheels_of
from models.arrays import Array
from models.robot.dynamics import Wrench
from models.spatial import quaternion_product
from ocp.console import interruptible
from ocp.errors import NOT_NUMBERS, ProblemError, checked_choice, checked_each, checked_instance, floats
from ocp.motion.builders.actuator_limits import (
    Effort,
    JointFriction,
    Motors,
    checked_motors,
    joint_torques,
    nonnegative_each,
)
from ocp.motion.builders.clearance import ClearanceConstraints
from ocp.motion.builders.standing.problem import FreeTime
from ocp.motion.tasks.checks import (
    check_length,
    check_rest,
    checked_configuration,
    checked_horizon,
    checked_tasks,
    clip_to_limits,
    rates_at_rest,
)
from ocp.motion.tasks.equations import TaskEquations, bind
from ocp.motion.tasks.limits import JointBounds, Limits
from ocp.motion.tasks.tip_task import TipTask
from ocp.problem.problem import Problem, remembers_request

__all__ = ["AskedOfDrives", "dynamics_problem", "rates_at"]

QUINTIC = np.polynomial.Polynomial([0, 0, 0, 10, -15, 6])


class AskedOfDrives(TypedDict, total=False):
    """The options of `dynamics_problem` but what has to stay clear."""

    end_joints: Any
    tasks: TipTask | Sequence[TipTask]
    start_base: Any
    limits: Limits | None
    effort: Effort | None
    friction: JointFriction | None
    wrenches: Sequence[Wrench]
    gravity: Any
    control: Literal["acceleration", "jerk"]
    start: Any
    end: Any
    end_base: Any
    symbols: Any


@interruptible
@remembers_request("dynamics")
def dynamics_problem(
    machine: Motors,
    start_joints: Any,
    horizon: float | FreeTime,
    *,
    end_joints: Any = None,
    tasks: TipTask | Sequence[TipTask] = (),
    start_base: Any = None,
    limits: Limits | None = None,
    effort: Effort | None = None,
    friction: JointFriction | None = None,
    wrenches: Sequence[Wrench] = (),
    gravity: Any = None,
    control: Literal["acceleration", "jerk"] = "acceleration",
    start: Literal["rest", "free"] | Any = "rest",
    end: Literal["rest", "free"] | Any = "rest",
    end_base: Any = None,
    clearance_constraints: ClearanceConstraints | None = None,
    symbols: Any = ca.SX,
) -> Problem:
    """A motion within the limits of the drives, at the least effort, energy or time.

    States "joints", "velocities" (and "accelerations" where the jerk is the control), and "base" of a machine that
    floats; controls "accelerations" or "jerks" (and "power", W, what drives give, where energy costs or power is
    limited). Path constraints "torques", "power", and "tip" where there are tasks: the derivative of their velocities,
    with the gaps of their poses fed back, which a start that is free has to begin with.

    Args:
        machine: A FixedBase, or a FreeFloating one whose momentum is kept.
        start_joints: Shape (n,), rad or m; nan where free, and None for all, in a phase that is joined to another.
        horizon: Final time, s, or FreeTime(...).
        end_joints: Shape (n,), nan where free; all free if None.
        tasks: A TipTask, or several that are done at once over the whole motion, of the time, s.
        start_base: Configuration of the base at the start; home if None, and all nan in a phase that is joined to
            another, where it is free.
        limits: Of joints, velocities, accelerations, jerks, torques and power; the robot's own if None.
        effort: Weights of the cost; the squared torques if None.
        friction, wrenches, gravity: As of `joint_torques`.
        control: "jerk" makes accelerations continuous, zero at ends at rest.
        start, end: Whether the joints are at rest there, or free to move; or their velocities, nan where free, shape
            (n,): wheels that hold the momentum of a base at rest turn.
        end_base: Configuration of a floating base at the end, nan where free; a quaternion is given whole or not at
            all. Shape (base_size,).
        clearance_constraints: What the motion has to stay clear of, see `ocp.motion.builders.clearance`.
        symbols: casadi.SX, or casadi.MX when a task calls an interpolant.

    Raises:
        ProblemError: Sizes or options that do not fit, an end outside the limits, limits of jerk where accelerations
            are the control, a task that does not begin at its tip or moves where the joints rest, a free horizon with
            tasks, whose time is theirs.
    """
    checked_motors("dynamics_problem", machine)
    limits = Limits() if limits is None else checked_instance("dynamics_problem: limits", limits, Limits)
    effort = Effort() if effort is None else checked_instance("dynamics_problem: effort", effort, Effort)
    if friction is not None:
        checked_instance("dynamics_problem: friction", friction, JointFriction)
    checked_choice("control", control, ("acceleration", "jerk"))
    bounds = limits.bounds(machine, ("velocity", "torque"))
    if control == "acceleration" and (np.isfinite(bounds.jerk).any() or effort.jerk):
        words = "jerks are limited or cost, and accelerations are the control; say control='jerk'"
        raise ProblemError(words, name="control", value=control, limit="jerk")
    free = isinstance(horizon, FreeTime)
    duration = checked_horizon(horizon.guess if isinstance(horizon, FreeTime) else horizon)
    ends = _Ends.of(machine, bounds, (start_joints, end_joints), (start, end), start_base)
    given = (tasks,) if isinstance(tasks, TipTask) else checked_each("tasks", tasks, TipTask)
    equations = bind(machine, given) if given else None
    if equations is not None:
        if free:
            raise ProblemError("tasks say their own time: give a horizon in s", name="horizon")
        ends = ends.ending_with(equations)

    problem = Problem("dynamics", symbols)
    final = (
        problem.horizon(lower=horizon.lower, upper=horizon.upper, guess=horizon.guess)
        if isinstance(horizon, FreeTime)
        else problem.horizon(duration)
    )
    motion = _declare_motion(problem, machine, ends, bounds, duration, control)
    if end_base is not None:
        _declare_end_base(problem, machine, motion.base, end_base)
    torques = joint_torques(machine, *motion[:4], friction=friction, wrenches=wrenches, gravity=gravity)
    running = _declare_drives(problem, machine, motion, torques, bounds, effort)
    if equations is not None:
        _declare_tasks(problem, equations, ends, motion, duration)
    if clearance_constraints is not None:
        clearance_constraints = checked_instance("dynamics_problem: clear", clearance_constraints, ClearanceConstraints)
        name = "base" if machine.base_size else ""
        clearance_constraints.declare(
            problem, motion.base, motion.joints, base_name=name, horizon=None if free else duration
        )
    problem.minimize(running=running, terminal=effort.time * final)
    return problem


@dataclass(frozen=True, eq=False)
class _Ends:
    """Where a motion begins and ends, checked against the limits; nan where that is free.

    Attributes:
        first, last: Joints. Shape (n,). first_rates, last_rates: Their velocities. Shape (n,).
        rests: Whether all joints rest at the beginning, and at the end.
        base: Configuration of the base at the beginning; where it is free, the guess of it.
        joined: Whether joints or base begin where another phase ends.
        start: Where the guess of the joints begins. Shape (n,).
    """

    first: Array
    last: Array
    first_rates: Array
    last_rates: Array
    rests: tuple[bool, bool]
    base: Array
    joined: bool
    start: Array

    @classmethod
    def of(
        cls, machine: Motors, bounds: JointBounds, joints: tuple[Any, Any], velocities: tuple[Any, Any], base: Any
    ) -> _Ends:
        robot, n, hint = machine.robot, machine.joint_size, "keep them, or leave that end free by nan"
        first, last = (
            clip_to_limits(what, robot.joint_names, _ends(what, given, n), bounds.lower, bounds.upper, hint)
            for what, given in zip(("start_joints", "end_joints"), joints, strict=True)
        )
        first_rates, last_rates = (
            clip_to_limits(
                f"{what} velocities", robot.joint_names, rates_at(what, given, n), -bounds.velocity, bounds.velocity,
                hint,
            )
            for what, given in zip(("start", "end"), velocities, strict=True)
        )  # fmt: skip
        known = np.clip(np.where(np.isnan(first), np.nan_to_num(last), first), bounds.lower, bounds.upper)
        free = _is_free(base)
        _, home = checked_configuration(machine, known, None if free else base)
        rests = bool((first_rates == 0).all()), bool((last_rates == 0).all())
        return cls(first, last, first_rates, last_rates, rests, home, joints[0] is None or free, known)

    @property
    def end(self) -> Array:
        """Where the guess of the joints ends. Shape (n,)."""
        return np.where(np.isnan(self.last), self.start, self.last)

    def ending_with(self, equations: TaskEquations) -> _Ends:
        """The same; joints that rest at the end have there the velocities that the tasks ask for."""
        rates = rates_at_rest(equations, self.base, self.end)
        return replace(self, last_rates=rates) if self.rests[1] else self

    def quintic(self, duration: float, order: int) -> Any:
        """The joints from rest to rest as a function of time, or a derivative of that."""
        shape = QUINTIC.deriv(order) if order else QUINTIC
        begin = self.start if order == 0 else np.zeros(len(self.start))
        return lambda t: begin + (self.end - self.start) * shape(t / duration) / duration**order


class _Motion(NamedTuple):
    """Symbols of a motion: states, the control, and the rate of the base."""

    base: Any
    joints: Any
    rates: Any
    second: Any
    jerks: Any
    base_rate: Any


def _declare_motion(
    problem: Problem, machine: Motors, ends: _Ends, bounds: JointBounds, duration: float, control: str
) -> _Motion:
    """Declare joints and base with their derivatives, within the limits, from end to end."""
    robot, n = machine.robot, machine.joint_size
    sizes = _wheel_sizes(robot, bounds, duration)
    joints = problem.state(
        "joints", n, initial=ends.first, terminal=ends.last, lower=bounds.lower, upper=bounds.upper,
        guess=ends.quintic(duration, 0), unit=robot.unit(), scale=sizes[0],
    )  # fmt: skip
    rates = problem.state(
        "velocities", n, initial=ends.first_rates, terminal=ends.last_rates, lower=-bounds.velocity,
        upper=bounds.velocity, guess=ends.quintic(duration, 1), unit=robot.unit("/s"), scale=sizes[1],
    )  # fmt: skip
    push: dict[str, Any] = {
        "lower": -bounds.acceleration, "upper": bounds.acceleration, "guess": ends.quintic(duration, 2),
        "scale": sizes[2], "unit": robot.unit("/s^2"),
    }  # fmt: skip
    jerks: Any = ca.DM(0, 1)
    if control == "jerk":
        still: dict[str, Any] = {"initial": 0.0 * ends.first_rates, "terminal": 0.0 * ends.last_rates}
        second = problem.state("accelerations", n, **still, **push)
        jerks = problem.control(
            "jerks", n, lower=-bounds.jerk, upper=bounds.jerk, unit=robot.unit("/s^3"), scale=sizes[3]
        )
        problem.dynamics(second, jerks)
    else:
        second = problem.control("accelerations", n, **push)
    problem.dynamics(joints, rates)
    problem.dynamics(rates, second)
    base: Any = ca.DM(0, 1)
    if machine.base_size:
        base = problem.state("base", machine.base_size, initial=None if ends.joined else ends.base, guess=ends.base)
    base_rate = machine.base_rate(base, joints, rates)
    if machine.base_size:
        problem.dynamics(base, base_rate)
    return _Motion(base, joints, rates, second, jerks, base_rate)


def _declare_drives(
    problem: Problem, machine: Motors, motion: _Motion, torques: Any, bounds: JointBounds, effort: Effort
) -> Any:
    """Declare the limits of torques and power, and return the running cost."""
    n, limited = machine.joint_size, np.flatnonzero(np.isfinite(bounds.torque)).tolist()
    if limited:
        most = bounds.torque[limited]
        problem.path("torques", torques[limited], lower=-most, upper=most, unit=machine.robot.effort_unit)
    running = ca.dot(ca.DM(nonnegative_each("effort: acceleration", effort.acceleration, n)), motion.second**2)
    running += effort.jerk * ca.sumsqr(motion.jerks)
    if effort.turning and isinstance(machine, FreeFloating):
        spin = [k for k, row in enumerate(machine.twist_rows) if row < 3]
        running += effort.turning * ca.sumsqr(machine.base_twist(motion.base, motion.joints, motion.rates)[spin])
    running += ca.dot(ca.DM(nonnegative_each("effort: torque", effort.torque, n)), torques**2)
    if effort.energy or np.isfinite(bounds.power).any():
        given = problem.control("power", n, lower=0.0, upper=bounds.power, unit="W")
        problem.path("power", given - torques * motion.rates, lower=0.0, unit="W")
        running += effort.energy * ca.sum1(given)
    return running


def _is_free(given: Any) -> bool:
    """Whether a configuration of the base is told to be free."""
    try:
        return given is not None and bool(np.isnan(floats(given)).all())
    except NOT_NUMBERS:
        return False


def _ends(what: str, given: Any, n: int) -> Array:
    """Joints or their velocities at an end, nan where free. Shape (n,).

    Raises:
        ProblemError: Other sizes, or infinite.
    """
    if given is None:
        return np.full(n, np.nan)
    try:
        found = floats(given).reshape(-1)
    except NOT_NUMBERS as error:
        raise ProblemError(f"{what}: {n} numbers are expected, not {given!r}", name=what, value=given) from error
    if found.shape != (n,) or np.isinf(found).any():
        words = f"{what}: {n} numbers, nan where free, are expected, not {found.tolist()}"
        raise ProblemError(words, name=what, value=found, limit=n)
    return found


def _wheel_sizes(robot: Robot, bounds: JointBounds, duration: float) -> Array:
    """About how large angles, speeds, accelerations and jerks of wheels become, nan of other joints. Shape (4, n).

    Rotors are light and turn fast: a fraction of what they saturate at and of what their motors give, or else what
    1 N m s and 1 N m make of them.
    """
    found = np.full((4, robot.dof), np.nan)
    for name, inertia in wheels_of(robot).items():
        k = robot.joint_names.index(name)
        speed, torque = bounds.velocity[k], bounds.torque[k]
        speed = speed / 4 if np.isfinite(speed) else 1 / inertia
        acceleration = torque / inertia / 4 if np.isfinite(torque) else 1 / inertia
        found[:, k] = speed * duration / 4, speed, acceleration, 4 * acceleration / duration
    return found


def rates_at(what: str, given: Any, n: int) -> Array:
    """Velocities at an end, nan where free. Shape (n,).

    Raises:
        ProblemError: Neither "rest" nor "free", nor n numbers.
    """
    if isinstance(given, str):
        return np.full(n, 0.0 if checked_choice(what, given, ("rest", "free")) == "rest" else np.nan)
    if given is None:
        raise ProblemError(f"{what} must be 'rest', 'free' or velocities, not None", name=what, value=given)
    return _ends(what, given, n)


def _declare_end_base(problem: Problem, machine: Motors, base: Any, given: Any) -> None:
    """Hold the configuration of the base at the end, its attitude by three equations."""
    if not machine.base_size:
        raise ProblemError("a fixed base has no end_base", name="end_base", value=given)
    goal = _ends("end_base", given, machine.base_size)
    gaps = base - goal
    rows = np.flatnonzero(~np.isnan(goal)).tolist()
    if machine.base_size == 7 and set(rows) & {3, 4, 5, 6}:
        if not abs(np.linalg.norm(goal[3:]) - 1) <= 1e-9:
            words = f"end_base has the quaternion {goal[3:].tolist()}: all of it is expected, and of unit length"
            raise ProblemError(words, name="end_base", value=goal[3:])
        turned = quaternion_product(ca.DM([goal[3], *(-goal[4:])]), base[3:7])
        gaps = ca.vertcat(gaps[:3], 2 * turned[1:4])
        rows = [row for row in rows if row < 3] + [3, 4, 5]
    if rows:
        problem.end("base", gaps[rows], 0.0, 0.0, unit="m, rad")


def _declare_tasks(problem: Problem, equations: TaskEquations, ends: _Ends, motion: _Motion, duration: float) -> None:
    """Hold the tips to their tasks by their accelerations, and watch where they are."""
    base, joints, rates, second, *_ = motion
    if not np.isnan(ends.first).any():
        checked_tasks(equations, ends.base, ends.first, duration)
    check_length(equations, ends.base, duration)
    check_rest(equations, 0.0 if ends.rests[0] else None, duration if ends.rests[1] else None)
    targets = equations.targets(problem.time)
    if not ends.rests[0]:
        residual = equations.residual(base, joints, rates, targets)
        problem.start("tip velocity", residual, lower=0, upper=0, unit=equations.unit())
    gap = equations.acceleration(base, joints, rates, second, problem.time)
    problem.path("tip", gap, lower=0, upper=0, unit=equations.unit("/s^2", "/s^2"))
    for name, stray in equations.deviations(base, joints, rates, targets).items():
        problem.watch(name, **stray)
