"""Motions whose tools do tasks, each in its own interval of time, with the least joint velocity.

The cost is the integral of half the weighted squared joint rates, problem (27) of Kim and Kim 2011. The horizon falls
into stretches in which the same tasks are done. All stretches run at once, each over the whole horizon of the problem
at a pace of its own, as states side by side; the end of each is tied to the start of the next. So a task that begins or
ends on the way asks for no more than conditions at both ends, which every method and the audit know.
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
from ocp.direct.guess import Samples
from ocp.errors import ProblemError
from ocp.motion.builders.actuator_limits import checked_motors, joint_torques
from ocp.motion.builders.clearance import ClearanceConstraints
from ocp.motion.local.rates import LocalMotion
from ocp.motion.tasks.checks import check_closed, check_speed
from ocp.motion.tasks.equations import TaskEquations, bind
from ocp.motion.tasks.geometry import is_holonomic
from ocp.motion.tasks.limits import JointBounds
from ocp.motion.tasks.tip_task import TipTask
from ocp.problem.problem import Problem
from ocp.tolerances import ROUNDING_SHARE

__all__ = ["CLOCK", "PACE", "SLOPES", "Stretch", "ToolMotion", "stretches_of", "tool_motion_problem"]

CLOCK, SLOPES, PACE = "clock", "slopes", "pace"
"""Names where the time is free: of the time as a state, of the derivatives of joints and time by the tasks' own."""


@dataclass(frozen=True)
class FeedbackSettings:
    """How fast the feedback of pose errors may be, and how smooth accelerations are.

    Attributes:
        stiffest: Powers of e by which the feedback may lower a pose error over an interval of a mesh: a mesh that
            follows more has to be finer, for errors that are zero where the tasks begin at their poses.
        intervals: That a mesh has in a stretch at least.
        closed_gap: m and rad: a pose error that a task has to begin with is no gap to close if it is smaller.
        smoothing: Share of the horizon over which accelerations that are the control go from limit to limit where
            nothing else asks: without, they would jump.
    """

    stiffest: float = 4.0
    intervals: int = 8
    closed_gap: float = 1e-6
    smoothing: float = 1e-3


FEEDBACK = FeedbackSettings()


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

    def guess(self, followed: Sequence[LocalMotion], number: int) -> dict[str, Any]:
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
    slack = ROUNDING_SHARE * horizon  # times nearer to each other are one
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
        count = FEEDBACK.intervals
        pieces = np.diff([begin, *breaks, end]) if len(breaks) >= count else np.array([(end - begin) / count])
        most = FEEDBACK.stiffest / float(pieces.max())
        equations = bind(machine, [_gentle(tasks[i], most) for i in active]) if active else None
        suffix = f" {len(found) + 1}" if len(bounds) > 2 else ""
        new = tuple(i not in before for i in active)
        found.append(Stretch(begin, end, active, equations, new, breaks, suffix))
    return tuple(found)


def _gentle(task: TipTask, most: float) -> TipTask:
    """A task whose feedback is no faster than so many 1/s, but where it has a gap to close as it is told."""
    return task if task.gain <= most or task.start_gap > FEEDBACK.closed_gap else replace(task, gain=most)


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
    clearance_constraints: ClearanceConstraints | None = None,
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
            on from stretch to stretch, and are free at both ends as the rates are. Accelerations (jerks) are smoothed
            by a small weight in the cost, see FeedbackSettings.
        held: Which joints stand still. Shape (joint_size,), bool.

    Raises:
        ProblemError: A cyclic motion whose task is not closed, or of several stretches with a task in the last; a task
            faster than the rates allow in any posture. Where the time is free: several stretches, a base that drifts.
    """
    horizon = stretches[-1].end
    problem = Problem("tool motion" if time_cost is None else "tool motion in free time")
    problem.horizon(horizon)
    if held is not None:
        bounds = bounds._replace(velocity=np.where(held, 0.0, bounds.velocity))
    motion = _Motion(
        problem,
        machine,
        tuple(stretches),
        bounds,
        base,
        start,
        reference,
        cyclic,
        weights,
        clearance_constraints,
        driven,
    )
    if time_cost is not None:
        return _in_free_time(motion, time_cost)
    for stretch in stretches:
        if stretch.equations is not None:
            check_speed(stretch.equations, bounds.velocity, stretch.begin, stretch.end)
    running: Any = 0
    before, first, known = None, None, None
    for stretch in stretches:
        states, cost, known = _declare_stretch(motion, stretch, known)
        running += cost
        if before is not None:
            here = ca.vertcat(*[problem.at_start(state) for state in states])
            unit = "" if machine.base_size or driven else machine.robot.unit()
            problem.end(f"passage at {stretch.begin:g} s", here - ca.vertcat(*before), 0, 0, unit=unit)
        before, first = states, first or states
    if cyclic and motion.free and before and first:
        place = 1 if machine.base_size else 0
        problem.end("cyclic", before[place] - problem.at_start(first[place]), 0, 0, unit=machine.robot.unit())
    problem.minimize(running=running)
    inside = [(stretch.breaks - stretch.begin) / stretch.duration for stretch in stretches]
    return ToolMotion(problem, tuple(stretches), horizon, np.unique(np.concatenate(inside)))


@dataclass(frozen=True, eq=False)
class _Motion:
    """What all stretches of a motion share; see `tool_motion_problem`."""

    problem: Problem
    machine: Machine
    stretches: tuple[Stretch, ...]
    bounds: JointBounds
    base: Array
    start: Array | None
    reference: Array
    cyclic: bool
    weights: Array
    clearance_constraints: ClearanceConstraints | None
    driven: bool

    @property
    def horizon(self) -> float:
        """s."""
        return self.stretches[-1].end

    @property
    def free(self) -> bool:
        """Whether joints may start wherever the tips are where their tasks begin."""
        return self.start is None or bool(np.isnan(self.start).any())

    def pace(self, stretch: Stretch) -> float:
        """Seconds of a stretch in a second of the problem."""
        return stretch.duration / self.horizon

    def states(self, stretch: Stretch) -> tuple[Any, Any]:
        """Declare base, where it moves, and joints."""
        machine, begins, ends = self.machine, stretch is self.stretches[0], stretch is self.stretches[-1]
        place: Any = np.zeros(0)
        if machine.base_size:
            unit = "m, rad" if machine.base_size == 3 else "m, 1"  # a quaternion has none
            initial = self.base if begins else None
            place = self.problem.state(f"base{stretch.suffix}", machine.base_size, initial=initial, unit=unit)
        returns = self.cyclic and ends and begins and not self.free
        told: dict[str, Any] = {"lower": self.bounds.lower, "upper": self.bounds.upper, "unit": machine.robot.unit()}
        told |= {"initial": self.start if begins else None, "terminal": self.start if returns else None}
        return place, self.problem.state(f"joints{stretch.suffix}", machine.joint_size, **told)

    def keep_clear(self, stretch: Stretch, base: Any, joints: Any, horizon: float | None) -> None:
        """Declare what the motion has to stay clear of; no horizon where the time is free."""
        if self.clearance_constraints is not None:
            when = stretch.suffix
            self.clearance_constraints.declare(
                self.problem, base, joints, base_name=f"base{when}" if self.machine.base_size else "",
                joints_name=f"joints{when}", suffix=when, begin=stretch.begin,
                pace=1.0 if horizon is None else self.pace(stretch), horizon=horizon,
            )  # fmt: skip


def _declare_stretch(motion: _Motion, stretch: Stretch, known: Array | None) -> tuple[list[Any], Any, Array | None]:
    """Declare one of several stretches.

    Args:
        known: Slopes of what the stretch before leads to, see `_slopes`; None where it leads nowhere.

    Returns:
        States that go on in the next stretch, the running cost, and the slopes of what this one leads to.
    """
    problem, machine, bounds, pace = motion.problem, motion.machine, motion.bounds, motion.pace(stretch)
    begins, ends = stretch is motion.stretches[0], stretch is motion.stretches[-1]
    place, joints = motion.states(stretch)
    unit = machine.robot.unit("/s")
    told: dict[str, Any] = {"lower": -bounds.velocity, "upper": bounds.velocity, "unit": unit}
    second, smooth = None, 0
    if motion.driven:
        rates = problem.state(f"velocities{stretch.suffix}", machine.joint_size, **told)
        second, smooth = _declare_drives(motion, stretch, place, joints, rates)
    else:
        rates = problem.control(f"rates{stretch.suffix}", machine.joint_size, **told)
    slack = _closure(motion) if motion.cyclic and ends else 0
    leads: Array | None = None
    if stretch.equations is not None:
        asked = np.ones(stretch.equations.size, dtype=bool)
        slopes = _slopes(stretch, motion.base, motion.reference)
        if known is not None:
            asked = ~_within(slopes, known)
        of_drives = None if second is None else (second, machine.base_rate(place, joints, rates))
        free = not begins or motion.free
        _declare_tasks(motion, stretch, (place, joints, rates), pace, slack, free, asked, of_drives)
        placed = np.concatenate([is_holonomic(part) for part in stretch.equations.bound]).astype(bool)
        leads = slopes[stretch.equations.pose_rows | (placed & (begins | ~asked))]
    if machine.base_size:
        problem.dynamics(place, pace * machine.base_rate(place, joints, rates))
    problem.dynamics(joints, pace * rates)
    motion.keep_clear(stretch, place, joints, motion.horizon)
    states = [*([place] if machine.base_size else []), joints]
    if motion.driven:
        states += [rates, *([second] if f"jerks{stretch.suffix}" in problem.declared.controls else [])]
    cost = pace * (ca.dot(rates, ca.DM(motion.weights) * rates) / 2 + motion.horizon**2 * smooth)
    return states, cost, leads


def _declare_drives(motion: _Motion, stretch: Stretch, base: Any, joints: Any, rates: Any) -> tuple[Any, Any]:
    """Accelerations of the joints within what the drives give; and half their squares, or those of the jerks (s^2).

    In units of squared rates over squared horizons.
    """
    problem, machine, bounds, when = motion.problem, motion.machine, motion.bounds, stretch.suffix
    robot, n, pace = machine.robot, machine.joint_size, motion.pace(stretch)
    told: dict[str, Any] = {"lower": -bounds.acceleration, "upper": bounds.acceleration, "unit": robot.unit("/s^2")}
    share = FEEDBACK.smoothing**2 / 2
    if np.isfinite(bounds.jerk).any():
        second = problem.state(f"accelerations{when}", n, **told)
        jerks = problem.control(f"jerks{when}", n, lower=-bounds.jerk, upper=bounds.jerk, unit=robot.unit("/s^3"))
        problem.dynamics(second, pace * jerks)
        smooth = (FEEDBACK.smoothing * motion.horizon) ** 2 * ca.sumsqr(jerks)
    else:
        second = problem.control(f"accelerations{when}", n, **told)
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
                problem.path(f"{name}{when}", values[rows], lower=low[rows], upper=high[rows], unit=unit)
    return second, share * smooth


def _in_free_time(motion: _Motion, time_cost: float) -> ToolMotion:
    """As `tool_motion_problem`, the time being a state over the tasks' own.

    With q' = dq/ds and z = dt/ds the cost, the integral of (time_cost + q. W q. / 2) dt = (time_cost z + q' W q'/(2 z))
    ds, is convex in both; the tasks, J q' = v(s), and the limits of the rates, |q'| <= v z, are linear in them.
    """
    machine, problem, stretches, bounds = motion.machine, motion.problem, motion.stretches, motion.bounds
    if motion.driven:
        words = "a free horizon knows no drives: give a horizon in s, or limits of velocity alone"
        raise ProblemError(words, name="horizon")
    if len(stretches) > 1 or stretches[0].equations is None:
        words = "a free horizon is for tasks that begin and end together; give each its time, or one task"
        raise ProblemError(words, name="horizon", value=len(stretches))
    momentum = getattr(machine, "conserved_momentum", None)
    if momentum is not None and np.any(np.asarray(momentum) != 0):
        words = "a free horizon is for a base that rests when the joints do; its momentum carries this one on"
        raise ProblemError(words, name="conserved_momentum", value=momentum)
    (stretch,) = stretches
    clock = problem.state(CLOCK, initial=0.0, lower=0.0, unit="s", guess=lambda s: s)
    place, joints = motion.states(stretch)
    unit = machine.robot.unit("/s")
    slopes = problem.control(SLOPES, machine.joint_size, unit=unit)
    pace = problem.control(PACE, lower=1.0, guess=1.0)
    slack = _closure(motion) if motion.cyclic else 0
    _declare_tasks(motion, stretch, (place, joints, slopes), 1.0, slack, motion.free)
    limited = np.flatnonzero(np.isfinite(bounds.velocity)).tolist()
    if limited:
        most = ca.DM(bounds.velocity[limited]) * pace
        problem.path("rates", ca.vertcat(most - slopes[limited], most + slopes[limited]), lower=0, unit=unit)
    problem.dynamics(clock, pace)
    if machine.base_size:
        problem.dynamics(place, machine.base_rate(place, joints, slopes))
    problem.dynamics(joints, slopes)
    motion.keep_clear(stretch, place, joints, None)
    problem.minimize(running=time_cost * pace + ca.dot(slopes, ca.DM(motion.weights) * slopes) / (2 * pace))
    if motion.cyclic and motion.free:
        problem.end("cyclic", joints - problem.at_start(joints), 0, 0, unit=machine.robot.unit())
    return ToolMotion(problem, stretches, stretch.end, stretch.breaks / stretch.end)


def _closure(motion: _Motion) -> Any:
    """What a closed task gives way by, so that the joints close exactly.

    Where they return, a closed task returns by itself: asked for twice, both would contradict each other by the error
    of the discretisation. So the task may be off by a constant velocity, which is about zero.
    """
    problem, stretches = motion.problem, motion.stretches
    equations = stretches[-1].equations
    if equations is None:
        return 0
    if len(stretches) > 1:
        words = "a cyclic motion of several stretches has to end without a task, so that the joints can return"
        raise ProblemError(words, name="cyclic", value=len(stretches))
    check_closed(equations, stretches[-1].end)
    directions = equations.closing(motion.base, motion.reference)
    if not directions.shape[1]:
        return 0
    slack = problem.state("closure", directions.shape[1], guess=0.0, unit=equations.unit())
    problem.dynamics(slack, np.zeros(directions.shape[1]))
    return ca.mtimes(ca.DM(directions), slack)


def _declare_tasks(
    motion: _Motion,
    stretch: Stretch,
    moving: tuple[Any, Any, Any],
    pace: float,
    closure: Any,
    free: bool,
    asked: NDArray[np.bool_] | None = None,
    of_drives: tuple[Any, Any] | None = None,
) -> None:
    """The tasks of a stretch, over the time of the problem; `free`: what begins here has to be at its start.

    But for rows that are not `asked`, (size,), because what came before leads there. `moving`: base, joints and their
    rates. `of_drives`: accelerations of the joints and rate of the base, where these hold the tasks: what begins here
    has to begin with its velocity, too.
    """
    problem, equations, when, (base, joints, rates) = motion.problem, stretch.equations, stretch.suffix, moving
    assert equations is not None
    targets_at = equations.target_function()
    constant = targets_at.sparsity_jac(0, 0).nnz() == 0
    targets: Any = targets_at(0.0)
    if not constant:
        targets = problem.signal(f"targets{when}", lambda time: targets_at(stretch.begin + pace * time))
    residual = ca.cse(equations.residual(base, joints, rates, targets))
    begins = np.repeat(stretch.new, [part.task.size for part in equations.bound])
    begins &= True if asked is None else asked
    if equations.size and of_drives is not None:
        second, drift = of_drives
        at, along = [joints, rates], [rates, second]
        if not constant:
            time = ca.MX.sym("time")
            change_at = ca.Function("change", [time], [ca.jtimes(targets_at(time), time, 1)])
            at.append(targets)
            along.append(problem.signal(f"target rates{when}", lambda t: change_at(stretch.begin + pace * t)))
        if equations.machine.base_size:
            at, along = [base, *at], [drift, *along]
        gains = np.repeat([float(part.task.gain) for part in equations.bound], [p.task.size for p in equations.bound])
        gap = ca.jtimes(residual, ca.vertcat(*at), ca.vertcat(*along)) + ca.DM(gains) * (residual - closure)
        problem.path(f"task{when}", ca.cse(gap), lower=0, upper=0, unit=equations.unit("/s^2", "/s^2"))
        if begins.any():
            rows = np.flatnonzero(begins).tolist()
            problem.start(f"start velocity{when}", (residual - closure)[rows], 0, 0, unit=equations.unit())
    elif equations.size:
        problem.path(f"task{when}", residual - closure, lower=0, upper=0, unit=equations.unit())
    most = equations.cone_angles
    if most.size:
        problem.path(f"lean{when}", equations.cone_cosines(base, joints, targets), lower=np.cos(most))
    for name, stray in equations.deviations(base, joints, rates, targets).items():
        if stray["integral"]:
            stray = {**stray, "expression": pace * stray["expression"]}
        problem.watch(f"{name}{when}", **{**stray, "way": pace * stray["way"]})
    if not free:
        return
    error = equations.error(base, joints, targets)[np.flatnonzero(begins & equations.pose_rows).tolist()]
    # a velocity says nothing of places: at the start of the motion its tip is where the reference has it
    held = [] if stretch.begin else [equations.holding(base, joints, motion.base, motion.reference)]
    if (condition := ca.vertcat(error, *held)).numel():
        problem.start(f"start pose{when}", condition, 0, 0, unit=equations.unit("", ""))


def _slopes(stretch: Stretch, base: Array, reference: Array) -> Array:
    """Derivatives in base and joints of where the rows of a stretch's tasks are, in a random configuration.

    What holds of them there holds, but for a set of measure zero, everywhere. Shape (size, base_size + joint_size).
    """
    equations = stretch.equations
    assert equations is not None
    b, q = ca.SX.sym("base", len(base)), ca.SX.sym("joints", len(reference))
    error = equations.error(b, q, equations.target_function()(stretch.begin))
    held, at, rows = equations.holding(b, q, base, reference), 0, []
    for i, posed in enumerate(equations.pose_rows):
        rows.append(error[i] if posed else held[at])
        at += not posed
    slope = ca.Function("slope", [b, q], [ca.jacobian(ca.vertcat(*rows), ca.vertcat(b, q))])
    rng = np.random.default_rng(0)
    place = base + rng.normal(size=len(base))
    place[3:] /= np.linalg.norm(place[3:]) if len(base) == 7 else 1.0
    return np.array(slope(place, reference + rng.normal(size=len(reference))))


def _within(slopes: Array, known: Array) -> NDArray[np.bool_]:
    """Which rows are combinations of those that are known. Shapes (k, n), (m, n) to (k,)."""
    left = slopes - slopes @ np.linalg.pinv(known, rcond=ROUNDING_SHARE) @ known
    return np.asarray(np.linalg.norm(left, axis=1) <= ROUNDING_SHARE * np.linalg.norm(slopes, axis=1))
