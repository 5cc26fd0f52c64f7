"""Optimal control problems of least joint velocity along tool tasks, which may begin and end at different times.

The cost is the integral of half the weighted squared joint rates, problem (27) of Kim and Kim 2011. The horizon is
split into stretches, intervals in which the same tasks are active. Each stretch has its own states, scaled to the whole
horizon of the problem at its own pace, and its end is tied to the start of the next one. A task that begins or ends
during the motion thus needs boundary conditions only, which every method and the audit support.
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
from models.checks import Array
from ocp.direct.guess import Samples
from ocp.errors import ProblemError
from ocp.motion.builders.clearance import ClearanceConstraints
from ocp.motion.builders.dynamics import Actuation, declare_actuators
from ocp.motion.local.rates import LocalMotion
from ocp.motion.tasks.checks import check_closed, check_speed
from ocp.motion.tasks.equations import TaskEquations, bind
from ocp.motion.tasks.goals import Cost
from ocp.motion.tasks.limits import JointBounds
from ocp.motion.tasks.targets import required_nodes
from ocp.motion.tasks.tip_task import TipTask
from ocp.problem.problem import Problem
from ocp.tolerances import ROUNDING_SHARE

CLOCK, SLOPES, PACE = "clock", "slopes", "pace"
"""Names of variables of a problem with free time: the time, and derivatives of joint positions and of the time.

The derivatives are with respect to the time of the tasks.
"""
ERRORS, START_ERRORS = "task errors", "start errors"
"""Names of the variables for velocity errors of a relaxed task, and for its pose errors at a free start."""


@dataclass(frozen=True)
class FeedbackSettings:
    """Settings of the feedback of pose errors, and of relaxed tasks, from which a motion may deviate at a cost."""

    decay: float = 4.0  # largest decay of a pose error over a mesh interval, as a power of e
    intervals: int = 8  # least number of intervals of the mesh in a stretch
    closed_gap: float = 1e-6  # pose error at the beginning of a task below which there is no gap to close, m and rad
    relaxation: float = 1e-5  # velocity error of a relaxed task, m/s or rad/s, that costs as much as 1 rad/s


FEEDBACK = FeedbackSettings()


@dataclass(frozen=True, eq=False)
class Stretch:
    """Interval of the horizon in which the same tasks are active."""

    begin: float  # s
    end: float  # s
    tasks: tuple[int, ...]  # indices of the active tasks
    equations: TaskEquations | None  # of these tasks; None if there are none and the machine is free
    new: tuple[bool, ...]  # whether each of these tasks begins here
    breaks: Array  # times between begin and end at which the tasks are less smooth, (k,), s
    nodes: Array  # those of them at which a mesh needs nodes so that joint rates can do the tasks, (j,), s
    suffix: str  # of the names of its states and controls

    @property
    def duration(self) -> float:
        """Duration of the interval, s."""
        return self.end - self.begin


@dataclass(frozen=True, eq=False)
class ToolMotion:
    """Optimal control problem of a tool motion, and the time intervals (stretches) in which its tasks are active."""

    problem: Problem  # with states "joints" and, on a floating base, "base", and controls "rates", with suffixes
    stretches: tuple[Stretch, ...]
    horizon: float  # of the motion and of the problem, s
    breaks: Array  # fractions of the horizon at which a mesh should have nodes, (k,)

    def guess(self, motions: Sequence[LocalMotion], number: int) -> dict[str, Any]:
        """Return initial guesses of states and controls, by name, from the resolved-rate motion with index `number`."""
        guess: dict[str, Any] = {}
        for stretch, part in zip(self.stretches, motions, strict=True):
            t = (part.t - stretch.begin) * (self.horizon / stretch.duration)
            guess[f"joints{stretch.suffix}"] = Samples(t, part.joints[number])
            rates = SLOPES if CLOCK in self.problem.declared.states else f"rates{stretch.suffix}"
            guess[rates] = Samples(t, part.rates[number])
            if part.base.shape[2]:
                guess[f"base{stretch.suffix}"] = Samples(t, part.base[number])
        return guess


def stretches_of(machine: Machine, tasks: Sequence[TipTask], horizon: float) -> tuple[Stretch, ...]:
    """Divide the horizon into intervals in which the active tasks do not change, and limit the gains of pose feedback.

    Raises:
        ProblemError: A task begins or ends outside the horizon.
    """
    slack = ROUNDING_SHARE * horizon  # closer times count as one
    _check_times(tasks, horizon, slack)
    times = sorted({0.0, horizon, *(t for task in tasks for t in (task.begin, min(task.end, horizon)))})
    bounds = [times[0], *(t for before, t in pairwise(times) if t - before > slack and horizon - t > slack), horizon]
    stretches: list[Stretch] = []
    for begin, end in pairwise(bounds):
        middle = (begin + end) / 2
        active = tuple(i for i, task in enumerate(tasks) if task.begin < middle < task.end)
        before = stretches[-1].tasks if stretches else ()
        inside = [tasks[i].begin + np.asarray(tasks[i].breaks) for i in active]
        breaks = np.unique(np.concatenate([np.zeros(0), *inside]))
        breaks = breaks[(breaks > begin + slack) & (breaks < end - slack)]
        nodes, count = breaks, FEEDBACK.intervals
        if active and len(breaks) > count:
            ends = np.array([begin, *breaks, end])
            nodes = required_nodes(bind(machine, [tasks[i] for i in active]), ends)[1:-1]
        intervals = np.diff([begin, *nodes, end]) if len(nodes) >= count else np.array([(end - begin) / count])
        gain = FEEDBACK.decay / float(intervals.max())
        limited = [  # unless there is a gap to close at the start
            task if task.gain <= gain or task.start_gap > FEEDBACK.closed_gap else replace(task, gain=gain)
            for task in (tasks[i] for i in active)
        ]
        equations = bind(machine, limited) if active else None
        suffix = f" {len(stretches) + 1}" if len(bounds) > 2 else ""
        new = tuple(i not in before for i in active)
        stretches.append(Stretch(begin, end, active, equations, new, breaks, nodes, suffix))
    return tuple(stretches)


def _check_times(tasks: Sequence[TipTask], horizon: float, slack: float) -> None:
    """Raise ProblemError for a task that begins or ends outside the horizon by more than `slack`, s."""
    for number, task in enumerate(tasks):
        last = task.begin if task.duration is None else task.end
        if last > horizon + slack or task.begin > horizon - slack:
            words = f"task {number} is from {task.begin:g} to {task.end:g} s, the motion from 0 to {horizon:g} s"
            raise ProblemError(words, name=f"task {number}", value=(task.begin, task.end), limit=(0.0, horizon))


@dataclass(frozen=True, eq=False)
class ToolMotionSetup:
    """Boundary conditions, cost, limits and formulation of `tool_motion_problem`.

    With a `time_cost` the tasks may be executed more slowly. The horizon of the problem is then the tasks' own, with
    the further state CLOCK, the time, and the controls SLOPES, the derivatives of the joints, and PACE, that of the
    time, at least 1. With `actuation` the states "velocities" replace the rates, and the tasks are constrained by their
    accelerations.

    `relaxed` tasks may deviate, J u - b = relaxation S, by the control S, ERRORS, at the cost |S|^2 / 2. The
    constraints then stay independent where the rows of J depend on each other. If a motion of cost c does the tasks
    within the limits, the optimum deviates by less than relaxation sqrt(2 c horizon). Tasks can be relaxed only in
    their own time and without actuator limits.
    """

    base: Array  # configuration of the base at the start, (base_size,)
    start: Array | None  # configuration, nan or None where free if the tips are where their tasks begin, (joint_size,)
    reference: Array  # configuration that satisfies the tasks at the start, (joint_size,)
    cyclic: bool  # whether the joints end where they start
    weights: Array  # of the squared joint rates, (joint_size,)
    bounds: JointBounds  # limits of joint positions and rates
    time_cost: float | None = None  # per second; None keeps the tasks' own time
    actuation: Actuation | None = None  # options of accelerations (jerks) as the control; None for rates as the control
    relaxed: bool = False
    clearance_constraints: ClearanceConstraints | None = None

    @property
    def free(self) -> bool:
        """Whether the start position of at least one joint is not prescribed and only the tasks constrain it."""
        return self.start is None or bool(np.isnan(self.start).any())


def tool_motion_problem(machine: Machine, stretches: Sequence[Stretch], setup: ToolMotionSetup) -> ToolMotion:
    """Declare the optimal control problem of performing tasks with the least integral of weighted squared joint rates.

    Raises:
        ProblemError: A cyclic motion has a task that is not closed, or several stretches with a task in the last; a
            task is faster than the rates allow in any configuration; in free time there are several stretches, or the
            base drifts.
    """
    horizon = stretches[-1].end
    problem = Problem("tool motion" if setup.time_cost is None else "tool motion in free time")
    problem.horizon(horizon)
    motion = _Motion(problem, machine, tuple(stretches), setup)
    if setup.time_cost is not None:
        return _declare_in_free_time(motion, setup.time_cost)
    running: Any = 0
    before, first, known = None, None, None
    for stretch in stretches:
        if stretch.equations is not None:
            check_speed(stretch.equations, setup.bounds.velocity, stretch.begin, stretch.end)
        states, cost, known = _declare_stretch(motion, stretch, known)
        running += cost
        if before is not None:
            here = ca.vertcat(*[problem.at_start(state) for state in states])
            unit = "" if machine.base_size or setup.actuation else machine.robot.unit()
            problem.end(f"passage at {stretch.begin:g} s", here - ca.vertcat(*before), 0, 0, unit=unit)
        before, first = states, first or states
    if setup.cyclic and setup.free and before and first:
        place = 1 if machine.base_size else 0
        problem.end("cyclic", before[place] - problem.at_start(first[place]), 0, 0, unit=machine.robot.unit())
    start_errors = [state.symbol for name, state in problem.declared.states.items() if name.startswith(START_ERRORS)]
    problem.minimize(running=running, terminal=sum((ca.sumsqr(errors) / 2 for errors in start_errors), start=0))
    times = [stretch.breaks if setup.actuation else stretch.nodes for stretch in stretches]
    inside = [(at - stretch.begin) / stretch.duration for stretch, at in zip(stretches, times, strict=True)]
    return ToolMotion(problem, tuple(stretches), horizon, np.unique(np.concatenate(inside)))


@dataclass(frozen=True, eq=False)
class _Motion:
    """Optimal control problem of a tool motion while it is declared, with machine, time intervals and options."""

    problem: Problem
    machine: Machine
    stretches: tuple[Stretch, ...]
    setup: ToolMotionSetup

    @property
    def horizon(self) -> float:
        """Horizon of the problem, s."""
        return self.stretches[-1].end

    def pace(self, stretch: Stretch) -> float:
        """Return the ratio of a stretch's duration to the horizon, which scales the dynamics in the stretch."""
        return stretch.duration / self.horizon

    def declare_states(self, stretch: Stretch) -> tuple[Any, Any]:
        """Declare the states of one time interval: a floating base and the joint positions; return their symbols."""
        machine, begins, ends = self.machine, stretch is self.stretches[0], stretch is self.stretches[-1]
        place: Any = np.zeros(0)
        if machine.base_size:
            unit = "m, rad" if machine.base_size == 3 else "m, 1"  # a quaternion has none
            initial = self.setup.base if begins else None
            place = self.problem.state(f"base{stretch.suffix}", machine.base_size, initial=initial, unit=unit)
        returns = self.setup.cyclic and ends and begins and not self.setup.free
        bounds, unit = self.setup.bounds, machine.robot.unit()
        options: dict[str, Any] = {"lower": bounds.lower, "upper": bounds.upper, "unit": unit}
        options |= {"initial": self.setup.start if begins else None, "terminal": self.setup.start if returns else None}
        return place, self.problem.state(f"joints{stretch.suffix}", machine.joint_size, **options)

    def declare_velocities(self, stretch: Stretch, place: Any, joints: Any, pace: Any) -> tuple[Any, Any, Any]:
        """Declare the joint velocities in one time interval; return velocities, accelerations and running cost."""
        assert self.setup.actuation is not None
        begins, ends = (rests and stretch is self.stretches[-k] for k, rests in enumerate(self.setup.actuation.rests))
        cost = self.setup.actuation.cost or Cost(weights=self.setup.weights)
        own = replace(self.setup.actuation, cost=cost, rests=(begins, ends))
        options: dict[str, Any] = {"bounds": self.setup.bounds, "actuation": own, "pace": pace}
        options |= {"suffix": stretch.suffix}
        return declare_actuators(self.problem, self.machine, self.horizon, (place, joints), **options)

    def declare_task_errors(self, stretch: Stretch) -> tuple[Any, Any]:
        """Declare velocity errors of relaxed tasks as controls; return errors and cost, both 0 without such tasks."""
        assert stretch.equations is not None
        if not self.setup.relaxed or not stretch.equations.size:
            return 0, 0
        errors = self.problem.control(f"{ERRORS}{stretch.suffix}", stretch.equations.size, guess=0.0)
        return FEEDBACK.relaxation * errors, ca.sumsqr(errors) / 2

    def constrain_clearance(self, stretch: Stretch, horizon: float | None) -> None:
        """Declare the clearance constraints in one time interval; `horizon` is None if the duration is free."""
        if self.setup.clearance_constraints is not None:
            base = f"base{stretch.suffix}" if self.machine.base_size else self.machine.base_home()
            self.setup.clearance_constraints.declare(
                self.problem, base, f"joints{stretch.suffix}", suffix=stretch.suffix, begin=stretch.begin,
                pace=1.0 if horizon is None else self.pace(stretch), horizon=horizon,
            )  # fmt: skip


def _declare_stretch(motion: _Motion, stretch: Stretch, known: Array | None) -> tuple[list[Any], Any, Array | None]:
    """Declare states, controls and constraints in one time interval of fixed duration with the same active tasks.

    Return the states that continue in the next stretch, the running cost, and the Jacobian of the coordinates that this
    stretch fixes at its end (see `_pose_jacobian`); `known` is this Jacobian for the stretch before, or None.
    """
    problem, machine, bounds, pace = motion.problem, motion.machine, motion.setup.bounds, motion.pace(stretch)
    begins, ends = stretch is motion.stretches[0], stretch is motion.stretches[-1]
    place, joints = motion.declare_states(stretch)
    second: Any = None
    if motion.setup.actuation is not None:
        rates, second, running = motion.declare_velocities(stretch, place, joints, pace)
    else:
        limits: dict[str, Any] = {"lower": -bounds.velocity, "upper": bounds.velocity}
        rates = problem.control(f"rates{stretch.suffix}", machine.joint_size, unit=machine.robot.unit("/s"), **limits)
        running = ca.dot(rates, ca.DM(motion.setup.weights) * rates) / 2
    slack: Any = _declare_closure(motion) if motion.setup.cyclic and ends else 0
    ends_at, error_cost = None, 0
    if stretch.equations is not None:
        error, error_cost = motion.declare_task_errors(stretch)
        required = np.ones(stretch.equations.size, dtype=bool)
        slopes = _pose_jacobian(stretch, motion.setup.base, motion.setup.reference)
        if known is not None:
            rest = slopes - slopes @ np.linalg.pinv(known, rcond=ROUNDING_SHARE) @ known  # not fixed before
            required = ~(np.linalg.norm(rest, axis=1) <= ROUNDING_SHARE * np.linalg.norm(slopes, axis=1))
        derivatives = None
        if second is not None:
            derivatives = [(joints, rates), (rates, second), (place, machine.base_rate(place, joints, rates))]
        free = not begins or motion.setup.free
        _declare_tasks(motion, stretch, (place, joints, rates), pace, slack + error, free, required, derivatives)
        placed = np.concatenate([part.is_holonomic for part in stretch.equations.bound]).astype(bool)
        ends_at = slopes[stretch.equations.pose_rows | (placed & (begins | ~required))]
    if machine.base_size:
        problem.dynamics(place, pace * machine.base_rate(place, joints, rates))
    problem.dynamics(joints, pace * rates)
    motion.constrain_clearance(stretch, motion.horizon)
    states = [*([place] if machine.base_size else []), joints]
    if motion.setup.actuation is not None:
        states += [rates, *([second] if f"jerks{stretch.suffix}" in problem.declared.controls else [])]
    return states, pace * (running + error_cost), ends_at


def _declare_in_free_time(motion: _Motion, time_cost: float) -> ToolMotion:
    """Declare the problem of a tool motion that may execute its tasks more slowly than their targets prescribe.

    The independent variable is the tasks' own time s, and the time t is a state. With q' = dq/ds, z = dt/ds, rates
    u = q'/z and weights W the cost is the integral of (time_cost + u W u/2) dt = (time_cost z + q' W q'/(2 z)) ds,
    which is convex in q' and z; tasks and rate limits are linear. With accelerations as controls, z is a state.
    """
    machine, problem, stretches, bounds = motion.machine, motion.problem, motion.stretches, motion.setup.bounds
    if len(stretches) > 1 or stretches[0].equations is None:
        words = "with a free horizon all tasks must begin and end together; give a horizon in s, or one task"
        raise ProblemError(words, name="horizon", value=len(stretches))
    momentum = getattr(machine, "conserved_momentum", 0)
    if np.any(np.asarray(momentum) != 0):
        words = "with a free horizon the base must not drift, but it has momentum; give a horizon in s"
        raise ProblemError(words, name="conserved_momentum", value=momentum)
    (stretch,) = stretches
    clock = problem.state(CLOCK, initial=0.0, lower=0.0, unit="s", guess=lambda s: s)
    place, joints = motion.declare_states(stretch)
    slack = _declare_closure(motion) if motion.setup.cyclic else 0
    if motion.setup.actuation is None:
        pace = problem.control(PACE, lower=1.0, guess=1.0)
        slopes = problem.control(SLOPES, machine.joint_size, unit=machine.robot.unit("/s"))
        _declare_tasks(motion, stretch, (place, joints, slopes), 1.0, slack, motion.setup.free)
        if limited := np.flatnonzero(np.isfinite(bounds.velocity)).tolist():
            own, largest = slopes[limited], ca.DM(bounds.velocity[limited]) * pace
            problem.path("rates", ca.vertcat(largest - own, largest + own), lower=0, unit=machine.robot.unit("/s"))
        running = ca.dot(slopes, ca.DM(motion.setup.weights) * slopes) / (2 * pace)
    else:
        pace = problem.state(PACE, lower=1.0, guess=1.0)
        change = problem.control("pace change", guess=0.0, unit="1/s")
        problem.dynamics(pace, change)
        rates, second, running = motion.declare_velocities(stretch, place, joints, pace)
        slopes = pace * rates
        drift = machine.base_rate(place, joints, slopes)
        derivatives = [(joints, slopes), (rates, pace * second), (pace, change), (place, drift)]
        _declare_tasks(motion, stretch, (place, joints, slopes), 1.0, slack, motion.setup.free, derivatives=derivatives)
        running = pace * running + (motion.setup.actuation.smoothing * motion.horizon * change) ** 2 / 2
    problem.dynamics(clock, pace)
    if machine.base_size:
        problem.dynamics(place, machine.base_rate(place, joints, slopes))
    problem.dynamics(joints, slopes)
    motion.constrain_clearance(stretch, None)
    problem.minimize(running=time_cost * pace + running)
    if motion.setup.cyclic and motion.setup.free:
        problem.end("cyclic", joints - problem.at_start(joints), 0, 0, unit=machine.robot.unit())
    return ToolMotion(problem, stretches, stretch.end, stretch.nodes / stretch.end)


def _declare_closure(motion: _Motion) -> Any:
    """Declare a constant offset of the task velocity on a closed path, so that the joints can return exactly.

    If the joints return, the task returns as well. Both conditions differ by the error of the discretisation alone.
    """
    problem, stretches = motion.problem, motion.stretches
    equations = stretches[-1].equations
    if equations is None:
        return 0
    if len(stretches) > 1:
        words = "a cyclic motion of several stretches must end without a task, so that the joints can return"
        raise ProblemError(words, name="cyclic", value=len(stretches))
    check_closed(equations, stretches[-1].end)
    directions = equations.cyclic_rows(motion.setup.base, motion.setup.reference)
    if not directions.shape[1]:
        return 0
    slack = problem.state("closure", directions.shape[1], guess=0.0, unit=equations.unit())
    problem.dynamics(slack, np.zeros(directions.shape[1]))
    return ca.mtimes(ca.DM(directions), slack)


def _declare_tasks(
    motion: _Motion,
    stretch: Stretch,
    symbols: tuple[Any, Any, Any],
    pace: float,
    closure: Any,
    free: bool,
    required: NDArray[np.bool_] | None = None,
    derivatives: Sequence[tuple[Any, Any]] | None = None,
) -> None:
    """Declare the task constraints in a time interval, given base configuration, joint positions and rates there.

    `closure` is the deviation of a closed task. If `free`, the tasks that begin here must be at their start poses,
    except in rows that are not `required`, (size,), to which the stretch before leads. With `derivatives` (of states
    in task time, the base last), accelerations constrain the tasks, and tasks begin with their velocities, too.
    """
    problem, equations, suffix, (base, joints, rates) = motion.problem, stretch.equations, stretch.suffix, symbols
    assert equations is not None
    targets_at = equations.target_function()
    constant = targets_at.sparsity_jac(0, 0).nnz() == 0
    targets: Any = targets_at(0.0)
    if not constant:
        targets = problem.signal(f"targets{suffix}", lambda time: targets_at(stretch.begin + pace * time))
    residual = ca.cse(equations.residual(base, joints, rates, targets))
    begins = np.repeat(stretch.new, [part.task.size for part in equations.bound])
    begins &= True if required is None else required
    if equations.size and derivatives is not None:
        moving = derivatives if equations.machine.base_size else derivatives[:-1]
        at, along = [state for state, _ in moving], [derivative for _, derivative in moving]
        if not constant:
            time = ca.MX.sym("time")
            change_at = ca.Function("change", [time], [ca.jtimes(targets_at(time), time, 1)])
            at.append(targets)
            along.append(problem.signal(f"target rates{suffix}", lambda t: change_at(stretch.begin + pace * t)))
        gains = equations.by_row(lambda task: float(task.gain))
        gap = ca.jtimes(residual, ca.vertcat(*at), ca.vertcat(*along)) + ca.DM(gains) * (residual - closure)
        problem.path(f"task{suffix}", ca.cse(gap), lower=0, upper=0, unit=equations.unit("/s^2", "/s^2"))
        actuation = motion.setup.actuation
        at_rest = actuation is not None and actuation.rests[0] and stretch is motion.stretches[0]
        if begins.any() and not at_rest:
            rows = np.flatnonzero(begins).tolist()
            problem.start(f"start velocity{suffix}", (residual - closure)[rows], 0, 0, unit=equations.unit())
    elif equations.size:
        problem.path(f"task{suffix}", residual - closure, lower=0, upper=0, unit=equations.unit())
    largest_lean = equations.cone_angles
    if largest_lean.size:
        problem.path(f"lean{suffix}", equations.cone_cosines(base, joints, targets), lower=np.cos(largest_lean))
    for name, deviation in equations.deviations(base, joints, rates, targets).items():
        if deviation["integral"]:
            deviation = {**deviation, "expression": pace * deviation["expression"]}
        problem.watch(f"{name}{suffix}", **{**deviation, "way": pace * deviation["way"]})
    if not free:
        return
    error = equations.error(base, joints, targets)[np.flatnonzero(begins & equations.pose_rows).tolist()]
    # a velocity task has no pose: at the start of the motion its tip is where the reference has it
    reference = motion.setup.base, motion.setup.reference
    fixed = [] if stretch.begin else [equations.reference_error(base, joints, *reference)]
    if (condition := ca.vertcat(error, *fixed)).numel():
        if motion.setup.relaxed:
            start_errors = problem.free_parameter(f"{START_ERRORS}{suffix}", condition.numel(), guess=0.0)
            condition -= FEEDBACK.relaxation * start_errors
        problem.start(f"start pose{suffix}", condition, 0, 0, unit=equations.unit("", ""))


def _pose_jacobian(stretch: Stretch, base: Array, reference: Array) -> Array:
    """Return the Jacobian (size, base_size + joint_size) of task poses at a random configuration, at which its rank is
    that of almost all configurations.
    """
    equations: Any = stretch.equations
    b, q = ca.SX.sym("base", len(base)), ca.SX.sym("joints", len(reference))
    error = equations.error(b, q, equations.target_function()(stretch.begin))
    fixed, at, rows = equations.reference_error(b, q, base, reference), 0, []
    for i, posed in enumerate(equations.pose_rows):
        rows.append(error[i] if posed else fixed[at])
        at += not posed
    slope = ca.Function("slope", [b, q], [ca.jacobian(ca.vertcat(*rows), ca.vertcat(b, q))])
    rng = np.random.default_rng(0)
    place = base + rng.normal(size=len(base))
    place[3:] /= np.linalg.norm(place[3:]) if len(base) == 7 else 1.0
    return np.array(slope(place, reference + rng.normal(size=len(reference))))
