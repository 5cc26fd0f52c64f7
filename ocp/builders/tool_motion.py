"""Motions whose tools do tasks, each in its own interval of time, with the least joint velocity.

The cost is that of `redundancy`, the integral of half the weighted squared joint rates. The horizon falls into
stretches in which the same tasks are done. All stretches run at once, each over the whole horizon of the problem at a
pace of its own, as states side by side; the end of each is tied to the start of the next. So a task that begins or ends
on the way asks for no more than conditions at both ends, which every method and the audit know.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from models import Machine
from models.arrays import Array
from ocp.builders.clearance import Clear
from ocp.builders.drives import checked_motors, joint_torques
from ocp.direct.guess import Samples
from ocp.errors import ProblemError
from ocp.local.following import Followed
from ocp.problem.problem import Problem
from ocp.tasks.checks import check_closed, check_speed
from ocp.tasks.equations import TaskEquations, bind
from ocp.tasks.geometry import is_holonomic
from ocp.tasks.limits import JointBounds
from ocp.tasks.tip_task import TipTask

__all__ = ["CLOCK", "PACE", "SLOPES", "Stretch", "ToolMotion", "stretches_of", "tool_motion_problem"]

CLOCK, SLOPES, PACE = "clock", "slopes", "pace"
"""Names where the time is free: of the time as a state, of the derivatives of joints and time by the tasks' own."""
SAMPLES = 3
"""Configurations in which it is looked at what follows from what."""
SAME_TIME = 1e-9
"""Share of the horizon: times nearer to each other are one."""
PIECES = 8
"""Of a stretch at least, as a mesh has intervals."""
LEAST_GAP = 1e-6
"""m and rad: a pose error at the start that is none."""
SMOOTH = 1e-3
"""Share of the horizon over which accelerations that are the control go from limit to limit where nothing else asks."""
STIFFEST = 4.0
"""Powers of e by which the feedback may lower a pose error over a piece: more only makes the mesh finer."""


@dataclass(frozen=True, eq=False)
class Stretch:
    """A part of the horizon in which the same tasks are done.

    Attributes:
        begin, end: s.
        tasks: Which of the tasks of the motion, by their numbers.
        equations: Of these; None where there are none, and the machine moves as it likes.
        new: Whether each of these begins here. Shape (len(tasks),).
        breaks: Times at which the tasks are less smooth, between begin and end. Shape (k,), s.
        suffix: Of the names of its states and controls.
    """

    begin: float
    end: float
    tasks: tuple[int, ...]
    equations: TaskEquations | None
    new: tuple[bool, ...]
    breaks: Array
    suffix: str

    @property
    def duration(self) -> float:
        """s."""
        return self.end - self.begin


@dataclass(frozen=True, eq=False)
class ToolMotion:
    """A problem of `tool_motion_problem`, and how its time is that of the motion.

    Attributes:
        problem: States "joints" and, on a floating base, "base", control "rates", with the suffix of each stretch.
        stretches: One after the other.
        horizon: Of the motion and of the problem, s.
        breaks: Fractions 0..1 of the horizon at which a mesh should have nodes. Shape (k,).
    """

    problem: Problem
    stretches: tuple[Stretch, ...]
    horizon: float
    breaks: Array

    def guess(self, followed: Sequence[Followed], number: int) -> dict[str, Any]:
        """The motion `number` of those that were followed through each stretch, as a guess for a solve."""
        given: dict[str, Any] = {}
        for stretch, part in zip(self.stretches, followed, strict=True):
            t = (part.t - stretch.begin) * (self.horizon / stretch.duration)
            given[f"joints{stretch.suffix}"] = Samples(t, part.joints[number])
            slow = SLOPES if CLOCK in self.problem.declared.states else f"rates{stretch.suffix}"
            given[slow] = Samples(t, part.rates[number])
            if part.base.shape[2]:
                given[f"base{stretch.suffix}"] = Samples(t, part.base[number])
        return given


def stretches_of(machine: Machine, tasks: Sequence[TipTask], horizon: float) -> tuple[Stretch, ...]:
    """The parts of a horizon (s) with the same tasks each, their pose errors fed back no faster than a mesh can follow.

    Raises:
        ProblemError: A task that begins or ends outside the horizon.
    """
    slack = SAME_TIME * horizon
    for number, task in enumerate(tasks):
        last = task.begin if task.duration is None else task.end
        if last > horizon + slack or task.begin > horizon - slack:
            words = f"task {number} is from {task.begin:g} to {task.end:g} s, the motion from 0 to {horizon:g} s"
            raise ProblemError(words, name=f"task {number}", value=(task.begin, task.end), limit=(0.0, horizon))
    times = sorted({0.0, horizon, *(t for task in tasks for t in (task.begin, min(task.end, horizon)))})
    bounds = [times[0], *(t for before, t in pairwise(times) if t - before > slack and horizon - t > slack), horizon]
    found: list[Stretch] = []
    for begin, end in pairwise(bounds):
        middle = (begin + end) / 2
        active = tuple(i for i, task in enumerate(tasks) if task.begin < middle < task.end)
        before = found[-1].tasks if found else ()
        inside = [tasks[i].begin + np.asarray(tasks[i].breaks) for i in active]
        breaks = np.unique(np.concatenate([np.zeros(0), *inside]))
        breaks = breaks[(breaks > begin + slack) & (breaks < end - slack)]
        pieces = np.diff([begin, *breaks, end]) if len(breaks) >= PIECES else np.array([(end - begin) / PIECES])
        most = STIFFEST / float(pieces.max())
        equations = bind(machine, [_gentle(tasks[i], most) for i in active]) if active else None
        suffix = f" {len(found) + 1}" if len(bounds) > 2 else ""
        new = tuple(i not in before for i in active)
        found.append(Stretch(begin, end, active, equations, new, breaks, suffix))
    return tuple(found)


def _gentle(task: TipTask, most: float) -> TipTask:
    """A task whose feedback is no faster than so many 1/s, but where it has a gap to close as it is told."""
    return task if task.gain <= most or task.start_gap > LEAST_GAP else replace(task, gain=most)


def tool_motion_problem(
    machine: Machine,
    stretches: Sequence[Stretch],
    *,
    base: Array,
    start: Array | None,
    reference: Array,
    cyclic: bool,
    weights: Array,
    bounds: JointBounds,
    time_cost: float | None = None,
    driven: bool = False,
    clear: Clear | None = None,
    held: Array | None = None,
) -> ToolMotion:
    """Do tasks while the integral of half the weighted squared joint rates is least.

    Args:
        machine: On a fixed or a floating base.
        stretches: Of the horizon, see `stretches_of`.
        base: At the start. Shape (base_size,).
        start: Joints at the start, rad or m; where they are nan, or None, the start is free, but for the tips to be
            where their tasks begin. Shape (joint_size,).
        reference: Joints that do the tasks at the start, where a cyclic task is looked at, and where the tip is that
            a velocity task starts from where the start is free. Shape (joint_size,).
        cyclic: Whether the joints end where they start.
        weights: Of the squared joint rates. Shape (joint_size,).
        bounds: Of the joints' positions and rates.
        time_cost: Of every second, in units of the cost, where the tasks may be slower than they say: the horizon of
            the problem is then that of the tasks, its states over it are "joints", "base" and CLOCK, the time, its
            controls are SLOPES, the derivatives of the joints, and PACE, that of the time, at least 1. None where the
            tasks' own time is kept.
        driven: Whether accelerations (jerks where these are limited) are the control, within the limits of the drives:
            states "velocities" (and "accelerations") with the suffix of each stretch take the place of the rates, path
            constraints "torques" and "power" are added, and the tasks are held by their accelerations. Velocities go
            on from stretch to stretch, and are free at both ends as the rates are. Accelerations (jerks) have the
            weight SMOOTH squared times the horizon squared (to the fourth) in the cost: without, they would jump.
        held: Which joints stand still. Shape (joint_size,), bool.

    Raises:
        ProblemError: A cyclic motion whose task is not closed, or of several stretches with a task in the last; a task
            faster than the rates allow in any posture. Where the time is free: several stretches, a base that drifts.
    """
    if time_cost is not None:
        if driven:
            words = "a free horizon knows no drives: give a horizon in s, or limits of velocity alone"
            raise ProblemError(words, name="horizon")
        return _in_free_time(machine, stretches, base, start, reference, cyclic, weights, bounds, time_cost, clear)
    horizon = stretches[-1].end
    bounds = bounds if held is None else bounds._replace(velocity=np.where(held, 0.0, bounds.velocity))
    for stretch in stretches:
        if stretch.equations is not None:
            check_speed(stretch.equations, bounds.velocity, stretch.begin, stretch.end)
    problem = Problem("tool motion")
    problem.horizon(horizon)
    running: Any = 0
    moving: list[list[Any]] = []
    passed: Array | None = None
    for stretch in stretches:
        begins, ends = stretch is stretches[0], stretch is stretches[-1]
        pace = stretch.duration / horizon
        free = not begins or start is None or bool(np.isnan(start).any())
        told: dict[str, Any] = {"initial": start if begins else None}
        told["terminal"] = start if cyclic and ends and not free else None
        place, joints = _declared_states(problem, machine, bounds, stretch.suffix, base if begins else None, told)
        unit = machine.robot.unit("/s")
        told = {"size": machine.joint_size, "lower": -bounds.velocity, "upper": bounds.velocity, "unit": unit}
        second: Any = None
        if driven:
            rates = problem.state(f"velocities{stretch.suffix}", **told)
            second, smooth = _declare_drives(problem, machine, bounds, stretch, pace, place, joints, rates)
            running += smooth * pace * horizon**2
        else:
            rates = problem.control(f"rates{stretch.suffix}", **told)
        slack = _closure(problem, stretches, base, reference) if cyclic and ends else 0
        if stretch.equations is not None:
            asked = np.ones(stretch.equations.size, dtype=bool)
            slopes = _slopes(stretch, base, reference)
            if passed is not None:
                asked = ~_within(slopes, passed)
            of_drives = None if second is None else (second, machine.base_rate(place, joints, rates))
            _declare_tasks(
                problem, stretch, place, joints, rates, pace, slack, free, (base, reference), asked, of_drives
            )
            passed = slopes[:, stretch.equations.posed | (_places(stretch.equations) & (begins | ~asked))]
        else:
            passed = None
        if machine.base_size:
            problem.dynamics(place, pace * machine.base_rate(place, joints, rates))
        problem.dynamics(joints, pace * rates)
        if clear is not None:
            _declare_clearance(clear, problem, machine, place, joints, stretch, pace, horizon)
        running += pace * ca.dot(rates, ca.DM(weights) * rates) / 2
        states = [*([place] if machine.base_size else []), joints]
        if driven:
            states += [rates, *([second] if f"jerks{stretch.suffix}" in problem.declared.controls else [])]
        if moving:
            here = ca.vertcat(*[problem.at_start(state) for state in states])
            unit = "" if machine.base_size or driven else machine.robot.unit()
            problem.end(f"passage at {stretch.begin:g} s", here - ca.vertcat(*moving[-1]), 0, 0, unit=unit)
        moving.append(states)
        if cyclic and ends and free:
            first = moving[0][1 if machine.base_size else 0]
            problem.end("cyclic", joints - problem.at_start(first), 0, 0, unit=machine.robot.unit())
    problem.minimize(running=running)
    inside = [(stretch.breaks - stretch.begin) / stretch.duration for stretch in stretches]
    return ToolMotion(problem, tuple(stretches), horizon, np.unique(np.concatenate(inside)))


def _declared_states(
    problem: Problem, machine: Machine, bounds: JointBounds, suffix: str, base: Array | None, ends: dict[str, Any]
) -> tuple[Any, Any]:
    """Base, where it moves, and joints."""
    place: Any = np.zeros(0)
    if machine.base_size:
        unit = "m, rad" if machine.base_size == 3 else "m, 1"  # a quaternion has none
        place = problem.state(f"base{suffix}", machine.base_size, initial=base, unit=unit)
    told: dict[str, Any] = {"lower": bounds.lower, "upper": bounds.upper, "unit": machine.robot.unit(), **ends}
    return place, problem.state(f"joints{suffix}", machine.joint_size, **told)


def _declare_drives(
    problem: Problem,
    machine: Machine,
    bounds: JointBounds,
    stretch: Stretch,
    pace: float,
    base: Any,
    joints: Any,
    rates: Any,
) -> tuple[Any, Any]:
    """Accelerations of the joints within what the drives give; and half their squares, or those of the jerks (s^2).

    In units of squared rates over squared horizons.
    """
    robot, n, when = machine.robot, machine.joint_size, stretch.suffix
    horizon = stretch.duration / pace
    told: dict[str, Any] = {
        "size": n,
        "lower": -bounds.acceleration,
        "upper": bounds.acceleration,
        "unit": robot.unit("/s^2"),
    }
    if np.isfinite(bounds.jerk).any():
        second = problem.state(f"accelerations{when}", **told)
        jerks = problem.control(f"jerks{when}", n, lower=-bounds.jerk, upper=bounds.jerk, unit=robot.unit("/s^3"))
        problem.dynamics(second, pace * jerks)
        smooth = SMOOTH**2 * horizon**2 * ca.sumsqr(jerks) / 2
    else:
        second = problem.control(f"accelerations{when}", **told)
        smooth = ca.sumsqr(second) / 2
    problem.dynamics(rates, pace * second)
    limited = np.flatnonzero(np.isfinite(bounds.torque) | np.isfinite(bounds.power)).tolist()
    if limited:
        torques = joint_torques(checked_motors("limits", machine), base, joints, rates, second)
        for name, values, low, high, unit in (
            ("torques", torques, -bounds.torque, bounds.torque, robot.effort_unit),
            ("power", torques * rates, np.full(n, -np.inf), bounds.power, "W"),
        ):
            rows = np.flatnonzero(np.isfinite(high)).tolist()
            if rows:
                problem.path(f"{name}{when}", values[rows], lower=low[rows], upper=high[rows], unit=unit)
    return second, SMOOTH**2 * smooth


def _in_free_time(
    machine: Machine,
    stretches: Sequence[Stretch],
    base: Array,
    start: Array | None,
    reference: Array,
    cyclic: bool,
    weights: Array,
    bounds: JointBounds,
    time_cost: float,
    clear: Clear | None,
) -> ToolMotion:
    """As `tool_motion_problem`, the time being a state over the tasks' own.

    With q' = dq/ds and z = dt/ds the cost, the integral of (time_cost + q. W q. / 2) dt = (time_cost z + q' W q'/(2 z))
    ds, is convex in both; the tasks, J q' = v(s), and the limits of the rates, |q'| <= v z, are linear in them.
    """
    if len(stretches) > 1 or stretches[0].equations is None:
        words = "a free horizon is for tasks that begin and end together; give each its time, or one task"
        raise ProblemError(words, name="horizon", value=len(stretches))
    momentum = getattr(machine, "conserved_momentum", None)
    if momentum is not None and np.any(np.asarray(momentum) != 0):
        words = "a free horizon is for a base that rests when the joints do; its momentum carries this one on"
        raise ProblemError(words, name="conserved_momentum", value=momentum)
    (stretch,) = stretches
    free = start is None or bool(np.isnan(start).any())
    problem = Problem("tool motion in free time")
    problem.horizon(stretch.end)
    clock = problem.state(CLOCK, initial=0.0, lower=0.0, unit="s", guess=lambda s: s)
    told: dict[str, Any] = {"initial": start, "terminal": start if cyclic and not free else None}
    place, joints = _declared_states(problem, machine, bounds, "", base, told)
    unit = machine.robot.unit("/s")
    slopes = problem.control(SLOPES, machine.joint_size, unit=unit)
    pace = problem.control(PACE, lower=1.0, guess=1.0)
    slack = _closure(problem, stretches, base, reference) if cyclic else 0
    _declare_tasks(problem, stretch, place, joints, slopes, 1.0, slack, free, (base, reference))
    limited = np.flatnonzero(np.isfinite(bounds.velocity)).tolist()
    if limited:
        most = ca.DM(bounds.velocity[limited]) * pace
        problem.path("rates", ca.vertcat(most - slopes[limited], most + slopes[limited]), lower=0, unit=unit)
    problem.dynamics(clock, pace)
    if machine.base_size:
        problem.dynamics(place, machine.base_rate(place, joints, slopes))
    problem.dynamics(joints, slopes)
    if clear is not None:
        _declare_clearance(clear, problem, machine, place, joints, stretch, 1.0, None)
    problem.minimize(running=time_cost * pace + ca.dot(slopes, ca.DM(weights) * slopes) / (2 * pace))
    if cyclic and free:
        problem.end("cyclic", joints - problem.at_start(joints), 0, 0, unit=machine.robot.unit())
    return ToolMotion(problem, tuple(stretches), stretch.end, stretch.breaks / stretch.end)


def _declare_clearance(
    clear: Clear,
    problem: Problem,
    machine: Machine,
    base: Any,
    joints: Any,
    stretch: Stretch,
    pace: float,
    horizon: float | None,
) -> None:
    when = stretch.suffix
    clear.declare(
        problem,
        base,
        joints,
        base_name=f"base{when}" if machine.base_size else "",
        joints_name=f"joints{when}",
        suffix=when,
        begin=stretch.begin,
        pace=pace,
        horizon=horizon,
    )


def _closure(problem: Problem, stretches: Sequence[Stretch], base: Array, reference: Array) -> Any:
    """What a closed task gives way by, so that the joints close exactly, see `minimum_velocity_problem`."""
    equations = stretches[-1].equations
    if equations is None:
        return 0
    if len(stretches) > 1:
        words = "a cyclic motion of several stretches has to end without a task, so that the joints can return"
        raise ProblemError(words, name="cyclic", value=len(stretches))
    check_closed(equations, stretches[-1].end)
    directions = equations.closing(base, reference)
    if not directions.shape[1]:
        return 0
    slack = problem.state("closure", directions.shape[1], guess=0.0, unit=equations.unit())
    problem.dynamics(slack, np.zeros(directions.shape[1]))
    return ca.mtimes(ca.DM(directions), slack)


def _declare_tasks(
    problem: Problem,
    stretch: Stretch,
    base: Any,
    joints: Any,
    rates: Any,
    pace: float,
    closure: Any,
    free: bool,
    reference: tuple[Array, Array],
    asked: NDArray[np.bool_] | None = None,
    of_drives: tuple[Any, Any] | None = None,
) -> None:
    """The tasks of a stretch, over the time of the problem; `free`: what begins here has to be at its start.

    But for rows that are not `asked`, (size,), because what came before leads there. `of_drives`: accelerations of the
    joints and rate of the base, where these hold the tasks: what begins here has to begin with its velocity, too.
    """
    equations, when = stretch.equations, stretch.suffix
    assert equations is not None
    targets_at = equations.target_function()
    targets = problem.signal(f"targets{when}", lambda time: targets_at(stretch.begin + pace * time))
    residual = ca.cse(equations.residual(base, joints, rates, targets))
    begins = np.repeat(stretch.new, [part.task.size for part in equations.bound])
    begins &= True if asked is None else asked
    if equations.size and of_drives is not None:
        second, drift = of_drives
        time = ca.MX.sym("time")
        change_at = ca.Function("change", [time], [ca.jtimes(targets_at(time), time, 1)])
        change = problem.signal(f"target rates{when}", lambda time: change_at(stretch.begin + pace * time))
        at, moving = [joints, rates, targets], [rates, second, change]
        if equations.machine.base_size:
            at, moving = [base, *at], [drift, *moving]
        gains = np.repeat([float(part.task.gain) for part in equations.bound], [p.task.size for p in equations.bound])
        gap = ca.jtimes(residual, ca.vertcat(*at), ca.vertcat(*moving)) + ca.DM(gains) * (residual - closure)
        problem.path(f"task{when}", ca.cse(gap), lower=0, upper=0, unit=equations.unit("/s^2", "/s^2"))
        if begins.any():
            rows = np.flatnonzero(begins).tolist()
            problem.start(f"start velocity{when}", (residual - closure)[rows], 0, 0, unit=equations.unit())
    elif equations.size:
        problem.path(f"task{when}", residual - closure, lower=0, upper=0, unit=equations.unit())
    most = equations.most_lean
    if most.size:
        problem.path(f"lean{when}", equations.leans(base, joints, targets), lower=np.cos(most))
    for name, stray in equations.strays(base, joints, rates, targets).items():
        if stray["integral"]:
            stray = {**stray, "expression": pace * stray["expression"]}
        problem.watch(f"{name}{when}", **{**stray, "way": pace * stray["way"]})
    if not free:
        return
    error = equations.error(base, joints, targets)[np.flatnonzero(begins & equations.posed).tolist()]
    # a velocity says nothing of places: at the start of the motion its tip is where the reference has it
    held = [] if stretch.begin else [equations.holding(base, joints, *reference)]
    if (condition := ca.vertcat(error, *held)).numel():
        problem.start(f"start pose{when}", condition, 0, 0, unit=equations.unit("", ""))


def _places(equations: TaskEquations) -> NDArray[np.bool_]:
    """Which rows say where something is, or have an integral that does. Shape (size,), bool."""
    return np.concatenate([is_holonomic(part) for part in equations.bound]).astype(bool)


def _slopes(stretch: Stretch, base: Array, reference: Array) -> Array:
    """Derivatives in base and joints of where the rows of a stretch's tasks are, in random configurations.

    Shape (SAMPLES, size, base_size + joint_size).
    """
    equations = stretch.equations
    assert equations is not None
    b, q = ca.SX.sym("base", len(base)), ca.SX.sym("joints", len(reference))
    error = equations.error(b, q, equations.target_function()(stretch.begin))
    held, at, rows = equations.holding(b, q, base, reference), 0, []
    for i, posed in enumerate(equations.posed):
        rows.append(error[i] if posed else held[at])
        at += not posed
    slope = ca.Function("slope", [b, q], [ca.jacobian(ca.vertcat(*rows), ca.vertcat(b, q))])
    rng = np.random.default_rng(0)
    places = base + rng.normal(size=(SAMPLES, len(base)))
    places[:, 3:] /= np.linalg.norm(places[:, 3:], axis=1, keepdims=True) if len(base) == 7 else 1.0
    joints = reference + rng.normal(size=(SAMPLES, len(reference)))
    return np.array([np.array(slope(place, at)) for place, at in zip(places, joints, strict=True)])


def _within(slopes: Array, known: Array) -> NDArray[np.bool_]:
    """Which rows are, in every sample, combinations of those that are known. Shapes (S, k, n), (S, m, n) to (k,)."""
    found = np.ones(slopes.shape[1], dtype=bool)
    for rows, others in zip(slopes, known, strict=True):
        left = rows - rows @ np.linalg.pinv(others, rcond=1e-9) @ others
        found &= np.linalg.norm(left, axis=1) <= 1e-9 * np.linalg.norm(rows, axis=1)
    return found
