"""Motions by what drives them: torques, power, accelerations and jerks within limits, at the least effort or time.

For arms on a fixed base and for free-floating ones. Joint accelerations (or jerks) are the control, and the torques are
those of the inverse dynamics,

    tau = M(q) q'' + h(q, q') - (what acts from outside) + d q' + c tanh(q' / w),

with viscous friction d and Coulomb friction c, smoothed below the speed w. On a floating base the momentum is kept, the
base moves as the joints make it move, and the torques are those of the joints alone. So no mass matrix is inverted, and
limits of torque are path constraints like all others (Featherstone 2008, chapter 5; Betts 2010, section 4.10).
Where something acts on a floating machine from outside, thrusters above all, its momentum is a state:

    P' = sum of forces,    L' = sum of moments about the centre of mass.

A motion goes from point to point, along tasks of the tool, or both; through points on the way and with loads that are
picked up and put down as :class:`~ocp.problem.phases.Phases` of such problems, whose joints and velocities go on.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal, TypedDict

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from models import FixedBase, FreeFloating, ModelError, Robot, Standing, Thruster, link_frames, wheels_of
from models.arrays import Array
from models.robot.dynamics import GRAVITY, Wrench, external_wrench, inverse_dynamics
from models.robot.kinematics import center_of_mass
from models.spatial import cross, quaternion_product
from ocp.builders.clearance import Clear
from ocp.builders.standing.problem import FreeTime
from ocp.console import interruptible
from ocp.errors import (
    NOT_NUMBERS,
    ProblemError,
    checked_choice,
    checked_each,
    checked_instance,
    checked_nonnegative,
    floats,
    unknown_name,
)
from ocp.problem.problem import Problem, remembers_request
from ocp.tasks.checks import (
    check_length,
    check_rest,
    checked_configuration,
    checked_horizon,
    checked_tasks,
    inside_limits,
    rates_at_rest,
)
from ocp.tasks.equations import TaskEquations, bind
from ocp.tasks.limits import JointBounds, Limits
from ocp.tasks.tip_task import TipTask

__all__ = [
    "AskedOfDrives", "Effort", "JointFriction", "Motors", "checked_motors", "checked_steady", "checked_thrusters",
    "dynamics_problem", "joint_torques", "rates_at", "told_or",
]  # fmt: skip

QUINTIC = np.polynomial.Polynomial([0, 0, 0, 10, -15, 6])
Motors = FixedBase | FreeFloating
"""Machines that are moved by the torques of their joints alone."""


class AskedOfDrives(TypedDict, total=False):
    """The options of `dynamics_problem` but what has to stay clear."""

    end_joints: Any
    tasks: TipTask | Sequence[TipTask]
    start_base: Any
    limits: Limits | None
    effort: Effort | None
    friction: JointFriction | None
    wrenches: Sequence[Wrench]
    thrusters: Sequence[Thruster]
    firing: Sequence[Thruster] | None
    steady: Sequence[str]
    gravity: Any
    control: Literal["acceleration", "jerk"]
    start: Any
    end: Any
    end_base: Any
    end_momentum: Any
    symbols: Any


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
            _nonnegative(f"friction: {what}", getattr(self, what), None)
        if not checked_nonnegative("friction: slip", self.slip) > 0:
            raise ProblemError("friction: slip must be positive", name="slip", value=self.slip, limit=0.0)

    def torques(self, rates: Any) -> Any:
        """What the joints must give against it. Shape (n, 1)."""
        n = rates.numel()
        viscous, coulomb = (
            ca.DM(_nonnegative(f"friction: {what}", getattr(self, what), n)) for what in ("viscous", "coulomb")
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
        fuel: Of the thrust of all thrusters, 1/(N s). It is linear: what is best is full on or off but for singular
            arcs, so that thrusters that only switch cost no more than these, as far as the mesh resolves the switching.
        thrust: Of the squared thrusts, which makes them smooth, 1/N^2/s.
        turning: Of the squared angular velocity of a base that floats, 1/(rad/s)^2/s.
        time: Of the final time, 1/s.

    Raises:
        ProblemError: A weight below zero; none above.
    """

    torque: Any = 1.0
    energy: float = 0.0
    acceleration: Any = 0.0
    jerk: float = 0.0
    fuel: float = 0.0
    thrust: float = 0.0
    turning: float = 0.0
    time: float = 0.0

    def __post_init__(self) -> None:
        each = [_nonnegative(f"effort: {what}", getattr(self, what), None) for what in ("torque", "acceleration")]
        names = ("energy", "jerk", "fuel", "thrust", "turning", "time")
        parts = [checked_nonnegative(f"effort: {what}", getattr(self, what)) for what in names]
        if not (any(parts) or np.concatenate(each).any()):
            raise ProblemError("effort: at least one weight must be above zero", name="effort", value=self, limit=0.0)


def _nonnegative(what: str, value: Any, size: int | None) -> Array:
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
            Where something acts on it from outside, (pose, momentum) of the base.
        accelerations: Shape (n, 1).
        friction: In the joints. wrenches: From outside.
        gravity: Acceleration of free fall, m/s^2; None is GRAVITY on a fixed base and none for a machine that floats.

    Raises:
        ProblemError: Another machine; something acts on a floating machine whose momentum is not given.
    """
    robot = checked_motors("joint_torques", machine).robot
    if isinstance(machine, FixedBase):
        fall = GRAVITY if gravity is None else gravity
        found = inverse_dynamics(robot, joints, rates, accelerations, wrenches, fall, machine.world_from_base(base))
    else:
        _require_momentum(machine, base, wrenches, gravity)
        found = _floating_torques(machine, base, joints, rates, accelerations, wrenches, gravity)
    return found if friction is None else found + friction.torques(rates)


def _floating_torques(
    machine: FreeFloating,
    base: Any,
    joints: Any,
    rates: Any,
    accelerations: Any,
    wrenches: Sequence[Wrench],
    gravity: Any,
) -> Any:
    """Torques on a floating base, all in its own axes: where it is and how it lies tell the momentum and what acts.

    In these axes the momentum changes by what acts, and as they turn: h' = ... - w x h.
    """
    rows, home = machine.twist_rows, ca.DM(machine.base_home())
    spatial, turn = ca.DM.eye(6)[:, rows], machine.world_from_base(base).rotation.T
    moves = base.numel() > machine.base_size or np.any(np.asarray(machine.conserved_momentum))
    pushes = [
        replace(each, force=ca.mtimes(turn, ca.vertcat(each.force)), moment=ca.mtimes(turn, ca.vertcat(each.moment)))
        for each in wrenches
    ]
    fall = None if gravity is None else ca.mtimes(turn, ca.DM(floats(gravity).ravel()))
    momentum = type(joints).sym("momentum", len(rows) if moves else 0)
    there = ca.vertcat(home, momentum)
    twist = machine.base_twist(there, joints, rates)
    whole, held = spatial @ twist, spatial @ momentum if moves else ca.DM(6, 1)
    change = _base_rate(machine, there, joints, rates, pushes, fall)[machine.base_size :]
    turning = ca.vertcat(cross(whole[0:3], held[0:3]), cross(whole[0:3], held[3:6]))[rows[: momentum.numel()]]
    along = ca.vertcat(change - turning, rates, accelerations)
    second = spatial @ ca.jtimes(twist, ca.vertcat(momentum, joints, rates), along)
    second += ca.vertcat(ca.DM(3, 1), cross(whole[0:3], whole[3:6]))
    found = inverse_dynamics(
        machine.robot, joints, rates, accelerations, pushes, (0.0, 0.0, 0.0) if fall is None else fall, None,
        base_twist=whole, base_acceleration=second,
    )  # fmt: skip
    if not moves:
        return found
    given = spatial @ (
        base[machine.base_size :] if base.numel() > machine.base_size else ca.DM(machine.conserved_momentum)
    )
    seen = ca.vertcat(ca.mtimes(turn, given[0:3]), ca.mtimes(turn, given[3:6]))
    return ca.substitute(found, momentum, ca.densify(type(joints)(seen[rows])))


def _base_rate(machine: Any, base: Any, joints: Any, rates: Any, wrenches: Sequence[Wrench], gravity: Any) -> Any:
    """Rate of the configuration of the base, and of the momentum where it is given with it."""
    pose = machine.base_rate(base, joints, rates)
    if not isinstance(machine, FreeFloating):
        return pose
    _require_momentum(machine, base, wrenches, gravity)
    if base.numel() == machine.base_size:
        return pose
    placement = machine.world_from_base(base)
    outside = external_wrench(machine.robot, joints, wrenches, placement)
    if gravity is not None:
        weight = machine.robot.total_mass * ca.vec(ca.vertcat(gravity))
        outside += ca.vertcat(cross(center_of_mass(machine.robot, joints, placement), weight), weight)
    return ca.vertcat(pose, machine.momentum_rate(base, joints, outside))


def _require_momentum(machine: FreeFloating, base: Any, wrenches: Sequence[Wrench], gravity: Any) -> None:
    """Raise where something acts on a floating machine whose momentum is not given with its base."""
    if base.numel() == machine.base_size and (wrenches or gravity is not None):
        words = "what acts on a floating machine changes its momentum: give the base with it, (pose, momentum)"
        raise ProblemError(words, name="wrenches", value=wrenches)


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
    thrusters: Sequence[Thruster] = (),
    firing: Sequence[Thruster] | None = None,
    steady: Sequence[str] = (),
    gravity: Any = None,
    control: Literal["acceleration", "jerk"] = "acceleration",
    start: Literal["rest", "free"] | Any = "rest",
    end: Literal["rest", "free"] | Any = "rest",
    end_base: Any = None,
    end_momentum: Any = None,
    clear: Clear | None = None,
    symbols: Any = ca.SX,
) -> Problem:
    """A motion within the limits of the drives, at the least effort, energy or time.

    States "joints", "velocities" (and "accelerations" where the jerk is the control), "base" of a machine that floats,
    and its "momentum" where something acts on it from outside; controls "accelerations" or "jerks" (and "power", W,
    what drives give, where energy costs or power is limited), "thrust", N, where there are thrusters. Path
    constraints "torques", "power", and "tip" where there are tasks: the derivative of their velocities, with the gaps
    of their poses fed back, which a start that is free has to begin with.

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
        thrusters: Of a machine that floats, as of `models.Thruster`; each gives any force up to its own.
        firing: Thrusters that are full on all the time, as those that only switch are in a phase of their own; () where
            all of them are off, and None where there are none.
        steady: Names of joints that keep the speed with which they start, as rotors of gyros do, whatever torque that
            takes; no limit holds them.
        control: "jerk" makes accelerations continuous, zero at ends at rest.
        start, end: Whether the joints are at rest there, or free to move; or their velocities, nan where free, shape
            (n,): wheels that hold the momentum of a base at rest turn.
        end_base: Configuration of a floating base at the end, nan where free; a quaternion is given whole or not at
            all. Shape (base_size,).
        end_momentum: Likewise, of a machine on which something acts, in the order of
            `FreeFloating.conserved_momentum`, with which it begins. Shape (6,) or (3,).
        clear: What the motion has to stay clear of, see `ocp.builders.clearance`.
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
    robot, n = machine.robot, machine.joint_size
    pushers, fired = (checked_thrusters(machine, given) for given in (thrusters, () if firing is None else firing))
    bounds, keeps = limits.bounds(machine, ("velocity", "torque")), checked_steady(robot, steady)
    first_rates, last_rates = (rates_at(what, given, n) for what, given in (("start", start), ("end", end)))
    sizes = _wheel_sizes(robot, bounds, checked_horizon(horizon.guess if isinstance(horizon, FreeTime) else horizon))
    bounds = bounds._replace(
        velocity=np.where(keeps, np.inf, bounds.velocity),
        acceleration=np.where(keeps, 0.0, bounds.acceleration),
        torque=np.where(keeps, np.inf, bounds.torque),
    )
    if control == "acceleration" and (np.isfinite(bounds.jerk).any() or effort.jerk):
        words = "jerks are limited or cost, and accelerations are the control; say control='jerk'"
        raise ProblemError(words, name="control", value=control, limit="jerk")
    hint = "keep them, or leave that end free by nan"
    first, last = (
        inside_limits(what, robot.joint_names, _ends(what, given, n), bounds.lower, bounds.upper, hint)
        for what, given in (("start_joints", start_joints), ("end_joints", end_joints))
    )
    first_rates, last_rates = (
        inside_limits(f"{what} velocities", robot.joint_names, given, -bounds.velocity, bounds.velocity, hint)
        for what, given in (("start", first_rates), ("end", last_rates))
    )
    duration = checked_horizon(horizon.guess if isinstance(horizon, FreeTime) else horizon)
    known = np.clip(np.where(np.isnan(first), np.nan_to_num(last), first), bounds.lower, bounds.upper)
    joined = start_joints is None or _is_free(start_base)
    _, home = checked_configuration(machine, known, None if _is_free(start_base) else start_base)
    towards = np.where(np.isnan(last), known, last)

    given = (tasks,) if isinstance(tasks, TipTask) else checked_each("tasks", tasks, TipTask)
    equations = bind(machine, given) if given else None
    resting = np.zeros(n) if equations is None else rates_at_rest(equations, home, towards)

    problem = Problem("dynamics", symbols)
    free = isinstance(horizon, FreeTime)
    final = (
        problem.horizon(lower=horizon.lower, upper=horizon.upper, guess=horizon.guess)
        if isinstance(horizon, FreeTime)
        else problem.horizon(duration)
    )
    rests = [bool((given[~keeps] == 0).all()) for given in (first_rates, last_rates)]
    if rests[1]:
        last_rates = resting
    last_rates = np.where(keeps, np.nan, last_rates)

    def between(order: int) -> Any:
        """The quintic from rest to rest, or a derivative of it."""
        shape = QUINTIC.deriv(order) if order else QUINTIC
        kept = np.where(keeps, np.nan_to_num(first_rates), 0.0)
        if order:
            return lambda t: kept * (order == 1) + (towards - known) * shape(t / duration) / duration**order
        return lambda t: known + kept * t + (towards - known) * shape(t / duration)

    joints = problem.state(
        "joints", n, initial=first, terminal=last, lower=bounds.lower, upper=bounds.upper, guess=between(0),
        unit=robot.unit(), scale=sizes[0],
    )  # fmt: skip
    rates = problem.state(
        "velocities", n, initial=first_rates, terminal=last_rates, lower=-bounds.velocity, upper=bounds.velocity,
        guess=between(1), unit=robot.unit("/s"), scale=sizes[1],
    )  # fmt: skip
    push = {"lower": -bounds.acceleration, "upper": bounds.acceleration, "guess": between(2), "scale": sizes[2]}
    if control == "jerk":
        ends = {what: 0.0 * rate for what, rate in (("initial", first_rates), ("terminal", last_rates))}
        second = problem.state("accelerations", n, unit=robot.unit("/s^2"), **ends, **push)
        jerks = problem.control(
            "jerks", n, lower=-bounds.jerk, upper=bounds.jerk, unit=robot.unit("/s^3"), scale=sizes[3]
        )
        problem.dynamics(second, jerks)
    else:
        second = problem.control("accelerations", n, unit=robot.unit("/s^2"), **push)
        jerks = ca.DM(0, 1)
    problem.dynamics(joints, rates)
    problem.dynamics(rates, second)
    base: Any = ca.DM(0, 1)  # and the momentum below it
    thrust: Any = ca.DM(0, 1)
    if pushers:
        most = np.array([each.force for each in pushers])
        thrust = problem.control("thrust", len(pushers), lower=0.0, upper=most, guess=0.0, unit="N")
    if machine.base_size:
        known_base = None if joined else home
        base = problem.state("base", machine.base_size, initial=known_base, guess=home)
    if isinstance(machine, FreeFloating) and (pushers or firing is not None or wrenches or gravity is not None):
        held = machine.conserved_momentum
        momentum = problem.state(
            "momentum", initial=None if joined else held, guess=held,
            terminal=end_momentum, size=len(machine.twist_rows), unit="N m s, N s",
        )  # fmt: skip
        base = ca.vertcat(base, momentum)
        frames = link_frames(robot, joints, machine.world_from_base(base))
        wrenches = [*wrenches, *(each.wrench(frames, thrust[k]) for k, each in enumerate(pushers))]
        wrenches += [each.wrench(frames, each.force) for each in fired]
    elif end_momentum is not None:
        words = "nothing acts on the machine from outside, so that its momentum stays as it is"
        raise ProblemError(words, name="end_momentum", value=end_momentum)
    moving = _base_rate(machine, base, joints, rates, wrenches, gravity)
    if machine.base_size:
        for name, place in (("base", slice(0, machine.base_size)), ("momentum", slice(machine.base_size, None))):
            if name in problem.declared.states:
                problem.dynamics(problem.declared.states[name].symbol, moving[place])
    if end_base is not None:
        _declare_end_base(problem, machine, base, end_base)

    torques = joint_torques(machine, base, joints, rates, second, friction=friction, wrenches=wrenches, gravity=gravity)
    limited = np.flatnonzero(np.isfinite(bounds.torque)).tolist()
    if limited:
        most = bounds.torque[limited]
        problem.path("torques", torques[limited], lower=-most, upper=most, unit=robot.effort_unit)
    running = ca.dot(ca.DM(_nonnegative("effort: acceleration", effort.acceleration, n)), second**2)
    running += effort.jerk * ca.sumsqr(jerks)
    running += effort.fuel * ca.sum1(thrust) + effort.thrust * ca.sumsqr(thrust)
    running += sum(effort.fuel * each.force + effort.thrust * each.force**2 for each in fired)
    if effort.turning and isinstance(machine, FreeFloating):
        spin = [k for k, row in enumerate(machine.twist_rows) if row < 3]
        running += effort.turning * ca.sumsqr(machine.base_twist(base, joints, rates)[spin])
    running += ca.dot(ca.DM(_nonnegative("effort: torque", effort.torque, n)), torques**2)
    if effort.energy or np.isfinite(bounds.power).any():
        given = problem.control("power", n, lower=0.0, upper=bounds.power, unit="W")
        problem.path("power", given - torques * rates, lower=0.0, unit="W")
        running += effort.energy * ca.sum1(given)
    if equations is not None:
        if free:
            raise ProblemError("tasks say their own time: give a horizon in s", name="horizon")
        _declare_tasks(problem, equations, (home, first), (base, joints, rates, second, moving), duration, rests)
    if clear is not None:
        clear = checked_instance("dynamics_problem: clear", clear, Clear)
        name = "base" if machine.base_size else ""
        clear.declare(problem, base[: machine.base_size], joints, base_name=name, horizon=None if free else duration)
    problem.minimize(running=running, terminal=effort.time * final)
    return problem


def checked_motors(what: str, machine: Any) -> Motors:
    """The machine; ProblemError unless it is one that the torques of its joints alone move."""
    if not isinstance(machine, FixedBase | FreeFloating) or isinstance(machine, Standing):
        words = f"{what}: a FixedBase or a FreeFloating is expected, not a {type(machine).__name__}; what stands is "
        words += "for standing_problem"
        raise ProblemError(words, name="machine", value=machine)
    return machine


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


def checked_steady(robot: Robot, names: Any) -> NDArray[np.bool_]:
    """Whether each joint is one of these. Shape (n,)."""
    if isinstance(names, str) or not isinstance(names, Sequence):
        raise ProblemError(f"steady: names of joints are expected, not {names!r}", name="steady", value=names)
    for name in names:
        if name not in robot.joint_names:
            raise unknown_name("joint", name, robot.joint_names)
    return np.array([name in names for name in robot.joint_names], dtype=bool)


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


def told_or(told: Array, found: Any) -> Any:
    """Numbers that are told, and where they are nan what is found. Told twice they would be conditions of nothing."""
    known = ~np.isnan(told)
    return ca.DM(np.where(known, told, 0.0)) + ca.DM((~known).astype(float)) * found


def checked_thrusters(machine: Motors, thrusters: Any) -> tuple[Thruster, ...]:
    found = checked_each("thrusters", thrusters, Thruster)
    if found and not isinstance(machine, FreeFloating):
        words = "thrusters push a machine that floats; this one stands on a fixed base"
        raise ProblemError(words, name="thrusters", value=machine)
    for each in found:
        try:
            machine.robot.link(each.link)
        except ModelError as error:
            raise ProblemError(str(error), name="thrusters", value=each.link) from error
    return found


def _declare_end_base(problem: Problem, machine: Motors, base: Any, given: Any) -> None:
    """Hold the configuration of the base at the end, its attitude by three equations."""
    if not machine.base_size:
        raise ProblemError("a fixed base has no end_base", name="end_base", value=given)
    goal = _ends("end_base", given, machine.base_size)
    gaps = base[: machine.base_size] - goal
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


def _declare_tasks(
    problem: Problem,
    equations: TaskEquations,
    begin: tuple[Array, Array],
    motion: tuple[Any, Any, Any, Any, Any],
    duration: float,
    rests: Sequence[bool],
) -> None:
    """Hold the tips to their tasks by their accelerations, and watch where they are."""
    home, first = begin
    base, joints, rates, second, base_rate = motion
    if not np.isnan(first).any():
        checked_tasks(equations, home, first, duration)
    check_length(equations, home, duration)
    check_rest(equations, 0.0 if rests[0] else None, duration if rests[1] else None)
    targets = equations.targets(problem.time)
    if not rests[0]:
        residual = equations.residual(base, joints, rates, targets)
        problem.start("tip velocity", residual, lower=0, upper=0, unit=equations.unit())
    gap = equations.acceleration(base, joints, rates, second, problem.time, base_rate=base_rate)
    problem.path("tip", gap, lower=0, upper=0, unit=equations.unit("/s^2", "/s^2"))
    for name, stray in equations.strays(base, joints, rates, targets).items():
        problem.watch(name, **stray)
