"""Motions from a start to one of several goal configurations, around obstacles.

A sampling-based search finds collision-free paths of several homotopy classes (`ocp.motion.sampling.path_search`).
Without actuator limits, each path at constant speed is a candidate whose clearance is proven. Within actuator limits,
each path is the guess of an optimal control problem, which stays in its class. The candidates are audited. The one of
least cost is the plan, the others are listed with the reason.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from itertools import product
from typing import Any

import numpy as np

from models import FixedBase
from models.checks import Array
from ocp.console import TimeLimitReached, interruptible, time_limited
from ocp.direct.guess import Samples
from ocp.errors import ProblemError, SolveError, require
from ocp.motion.builders.clearance import ClearanceConstraints, collision_error
from ocp.motion.builders.dynamics import QUINTIC, DynamicsSetup, dynamics_problem
from ocp.motion.builders.dynamics_plan import audit_error, within_limits
from ocp.motion.builders.joint_motion import joint_motion_problem, least_durations, motion_along
from ocp.motion.builders.standing.problem import FreeTime
from ocp.motion.builders.stopping_motion import StoppingMotion, segment_durations, stopping_motion
from ocp.motion.plan.actuators import limits_actuators
from ocp.motion.result.candidate import Candidate, Reason, Rejection, Stage
from ocp.motion.result.solved_plan import Part, SolvedPlan
from ocp.motion.sampling.path_search import JointPath, PathSearchSettings, TreeSearch, find_paths
from ocp.motion.sampling.shortening import points_along, shortest_through_corners
from ocp.motion.sampling.straight import StraightMotions
from ocp.motion.search.joint_space import FULL_TURN, JointSpace
from ocp.motion.search.search import checked_bound
from ocp.motion.tasks.checks import checked_configuration, checked_weights, clip_to_limits
from ocp.motion.tasks.goals import Cost
from ocp.motion.tasks.limits import JointBounds, Limits
from ocp.problem.problem import Problem
from ocp.solution import Solution
from ocp.tolerances import ROUNDING_SHARE

__all__ = ["GoalRequest", "GoalSettings", "plan_to_goal"]


@dataclass(frozen=True)
class GoalSettings:
    """Settings of the motions to a goal.

    Attributes:
        search: Settings of the search for paths.
        time_limit: Time after which a request without its own limit is refused, s.
        search_share: Share of the time limit after which the search for further paths ends.
        unlimited_rate: Rate of joints without a rate limit, rad/s or m/s, where the planner chooses the horizon.
        spare: Horizon of a motion within actuator limits, where the planner chooses it, relative to the least time of a
            motion that stops at corners.
        longest: Largest and inverse of the least horizon in free time, relative to the same.
        guess_times: Samples of a guess.
        near_bound: Relative excess of the cost over its lower bound below which a motion counts as optimal.
        near: Pairs of bodies closer than the clearance plus this along a path are separated from the first solve on, m.
        turns: Numbers of full turns by which goals of unlimited joints are shifted, beside the nearest one.
    """

    search: PathSearchSettings = field(default_factory=PathSearchSettings)
    time_limit: float = 20.0
    search_share: float = 0.75
    unlimited_rate: float = 1.0
    spare: float = 2.0
    longest: float = 20.0
    guess_times: int = 201
    near_bound: float = 1e-3
    near: float = 0.02
    turns: int = 1


@dataclass(frozen=True, eq=False)
class GoalRequest:
    """Request for a motion from a start to one of several goals.

    Attributes:
        machine: Machine on a fixed base.
        start: Joints at the start, rad or m. Shape (n,).
        goals: Joints that all satisfy the goal. Shape (K, n), or (n,) for one.
        horizon: Final time, s; None: as short as the limits of the rates allow for the path, or free if the cost
            weights time.
        limits: Limits of joints and actuators; the robot's own positions and rates if None.
        cost: Weights of the cost. With velocity or length alone, and without actuator limits, the motion has constant
            speed; else it is smooth. The weights of the joints are the metric of joint space.
        start_velocity, end_velocity: "rest", "free", or the joint velocities there, shape (n,). For smooth motions.
        clearance_constraints: Collision scene; None if collisions are not checked.
        seed: Seed of the random searches.
        time_limit: s; None for that of the settings.
        progress: Function that is called with a text at each stage; None for none.
        settings: Settings.
    """

    machine: FixedBase
    start: Any
    goals: Any
    horizon: float | None = None
    limits: Limits | None = None
    cost: Cost = field(default_factory=Cost)
    start_velocity: Any = "rest"
    end_velocity: Any = "rest"
    clearance_constraints: ClearanceConstraints | None = None
    seed: int = 0
    time_limit: float | None = None
    progress: Callable[[str], None] | None = None
    settings: GoalSettings = field(default_factory=GoalSettings)


@dataclass(frozen=True, eq=False)
class _Task:
    """Checked request: bounds, start, goals with their turns, metric, and the proofs of clearance."""

    request: GoalRequest
    bounds: JointBounds
    start: Array
    goals: Array
    scale: Array
    motions: StraightMotions
    space: JointSpace

    @property
    def limits(self) -> Limits:
        return self.request.limits or Limits()

    @property
    def is_dynamic(self) -> bool:
        """Whether the motion is smooth: actuators are limited, or more than velocity or length is the cost."""
        return limits_actuators(self.limits) or not set(self.request.cost.terms) <= {"velocity", "length"} or self.moves

    @property
    def moves(self) -> bool:
        """Whether the machine moves at the start or at the end."""
        ends = (self.request.start_velocity, self.request.end_velocity)
        return not all(isinstance(velocity, str) and velocity == "rest" for velocity in ends)

    @property
    def length(self) -> bool:
        """Whether the length in joint space is the cost."""
        return bool(self.request.cost.length)

    def report(self, text: str) -> None:
        if self.request.progress is not None:
            self.request.progress(text)


@interruptible
def plan_to_goal(request: GoalRequest) -> SolvedPlan:
    """Return the lowest-cost motion found from the start to one of the goals, at rest at both ends if actuators count.

    Raises:
        ProblemError: Sizes do not match; the start, or every goal, is outside the limits or collides: names the pair of
            bodies and their distance.
        SolveError: No motion was found within the time limit, which does not prove that there is none.
    """
    task = _checked(request)
    seconds = request.settings.time_limit if request.time_limit is None else request.time_limit
    with time_limited(require.positive("time_limit", seconds)):
        with time_limited(request.settings.search_share * seconds):
            paths = _paths(task, seconds)
        task.report(f"{len(paths)} paths, the shortest of length {paths[0].length:.4g}")
        candidates_of = _within_actuator_limits if task.is_dynamic else _at_constant_speed
        candidates = candidates_of(task, paths)
    return _best(task, candidates)


def _checked(request: GoalRequest) -> _Task:
    """Return the checked request, with goals of unlimited joints shifted by full turns near the start.

    Raises:
        ProblemError: As `plan_to_goal`.
    """
    machine = require.instance("machine", request.machine, FixedBase)
    limits = Limits() if request.limits is None else require.instance("limits", request.limits, Limits)
    bounds = limits.bounds(machine, ("velocity",))
    if request.horizon is not None:
        require.positive("horizon", request.horizon)
    scene = None if request.clearance_constraints is None else request.clearance_constraints.scene
    motions = StraightMotions(scene)
    cost = require.instance("cost", request.cost, Cost)
    if cost.length and cost.terms != ("length",):
        words = f"cost: the length of a motion is weighted alone, Cost(velocity=0, length=1), not in {cost}"
        raise ProblemError(words, name="length", value=cost.length)
    factor = cost.length**2 if cost.length else cost.velocity or 1.0
    scale = np.sqrt(factor * checked_weights(cost.weights, machine.joint_size))
    goals = np.atleast_2d(np.asarray(request.goals, dtype=float))
    if not len(goals):
        raise ProblemError("goals: at least one configuration is needed", name="goals", value=request.goals)
    space = JointSpace(machine, bounds.lower, bounds.upper, scale**2)
    start = _checked_end(machine, "start", request.start, bounds)
    if collisions := motions.collisions(start):
        raise _collision(scene, "start", collisions[0])
    kept, errors = [], []
    for goal in goals:
        try:
            joints = _checked_end(machine, "end" if len(goals) == 1 else "goal", goal, bounds)
        except ProblemError as error:
            errors.append(error)
            continue
        if collisions := motions.collisions(joints):
            errors.append(_collision(scene, "goal", collisions[0]))
        else:
            kept.append(joints)
    if not kept:
        raise errors[0]
    turned = [shifted for goal in kept for shifted in _turned(space, bounds, start, goal, request.settings.turns)]
    return _Task(request, bounds, start, np.array(turned), scale, motions, space)


def _checked_end(machine: FixedBase, name: str, value: Any, bounds: JointBounds) -> Array:
    joints, _ = checked_configuration(machine, value, None)
    hint = "give joints within their limits"
    return clip_to_limits(name, machine.robot.joint_names, joints, bounds.lower, bounds.upper, hint)


def _collision(scene: Any, name: str, collision: Any) -> ProblemError:
    first, second = collision.bodies
    how = (
        f"overlap by {-collision.distance:.3g} m" if collision.distance < 0 else f"are {collision.distance:.3g} m apart"
    )
    ignored = [scene.pair_names(collision.pair)]
    words = f"{name}: {first} and {second} {how}, {scene.clearance:.3g} m are required; "
    words += f"give a collision-free {name}, or ignore this pair of bodies: {ignored=}"
    return ProblemError(words, name=f"{first} and {second}", value=collision.distance, limit=scene.clearance)


def _turned(space: JointSpace, bounds: JointBounds, start: Array, goal: Array, turns: int) -> list[Array]:
    """Return a goal with its joints of more than two turns at the nearest turn to the start, and at further ones."""
    nearest = start + space.difference(goal, start)
    shifts = []
    for joint in range(len(goal)):
        values = [nearest[joint]] if space.periodic[joint] else [goal[joint]]
        if space.periodic[joint]:
            side = -1.0 if nearest[joint] > start[joint] else 1.0
            values += [nearest[joint] + side * FULL_TURN * k for k in range(1, turns + 1)]
        shifts.append(
            [value for value in values if bounds.lower[joint] <= value <= bounds.upper[joint]] or [goal[joint]]
        )
    return [np.array(joints) for joints in product(*shifts)]


def _paths(task: _Task, seconds: float) -> list[JointPath]:
    """Return paths of several classes, the shortest first.

    Raises:
        SolveError: None was found.
    """
    request, bounds, joints = task.request, task.bounds, np.vstack([task.start, task.goals])
    lower = np.where(np.isfinite(bounds.lower) & ~task.space.periodic, bounds.lower, joints.min(axis=0) - np.pi)
    upper = np.where(np.isfinite(bounds.upper) & ~task.space.periodic, bounds.upper, joints.max(axis=0) + np.pi)
    search = TreeSearch(task.motions, np.maximum(lower, bounds.lower), np.minimum(upper, bounds.upper), task.scale)
    options: dict[str, Any] = {"limits": (bounds.lower, bounds.upper), "seed": request.seed}
    reason, name = "in all random searches", "search"
    try:
        paths = find_paths(search, task.start, task.goals, **options, settings=request.settings.search)
        if paths:
            return paths
    except TimeLimitReached:
        reason, name = f"within the time limit of {seconds:.4g} s", "time_limit"
    goal = task.goals[np.linalg.norm((task.goals - task.start) * task.scale, axis=1).argmin()]
    places = task.start + np.linspace(0.0, 1.0, request.settings.guess_times)[:, None] * (goal - task.start)
    worst = min(
        (collision for joints in places for collision in task.motions.collisions(joints)[:1]),
        key=lambda collision: collision.distance,
    )
    words = (
        f"no collision-free path from the start to any of {len(task.goals)} goal configurations was found {reason}; "
    )
    words += f"start and goals are clear; on the straight motion to the nearest goal, {' and '.join(worst.bodies)} "
    words += f"overlap by up to {-worst.distance:.3g} m; this does not prove that there is none: raise time_limit, or "
    words += "use another seed"
    raise SolveError(words, name=name, value=worst.distance, limit=seconds if name == "time_limit" else None)


def _at_constant_speed(task: _Task, paths: list[JointPath]) -> list[Candidate]:
    """Return the audited motions along paths at constant speed."""
    request = task.request
    fastest = np.where(np.isfinite(task.bounds.velocity), task.bounds.velocity, request.settings.unlimited_rate)
    candidates = []
    for path in paths:
        horizon = request.horizon
        if horizon is None:
            changes = np.diff(path.joints, axis=0)
            lengths = np.linalg.norm(changes * task.scale, axis=1)
            moves = lengths > 0
            slowest = (np.abs(changes[moves]) / fastest).max(axis=1) / lengths[moves]
            horizon = path.length * float(slowest.max(initial=0.0)) or 1.0
        options: dict[str, Any] = {"start": path.joints[0], "end": path.joints[-1], "length": task.length}
        options |= {"limits": request.limits, "clearance_constraints": request.clearance_constraints}
        problem = joint_motion_problem(request.machine, horizon, weights=task.scale**2, **options)
        solution = motion_along(problem, path.joints, task.scale, horizon, length=task.length)
        candidates.append(_audited(task, solution, path))
    return candidates


def _within_actuator_limits(task: _Task, paths: list[JointPath]) -> list[Candidate]:
    """Return the audited motions within actuator limits: with stops at corners, and where time is left without."""
    request, settings, bounds = task.request, task.request.settings, task.bounds
    candidates, motions = list[Candidate](), list[tuple[JointPath, StoppingMotion]]()
    for path in paths:
        corners = shortest_through_corners(
            task.motions, path.joints, lambda changes: segment_durations(changes, bounds)
        )
        try:
            motions.append((path, stopping_motion(request.machine, corners, bounds)))
        except SolveError as error:
            reason = Reason.of_error(Rejection.ACTUATORS, error)
            candidates.append(Candidate(path.joints[0], reason=reason, stage=Stage.SEED))
    is_free = request.horizon is None and request.cost.time > 0
    shortest = min((motion.duration for _, motion in motions), default=0.0)
    fixed = settings.spare * shortest if request.horizon is None else float(request.horizon)
    problems = [_ProblemOf(task, path, motion, None if is_free else fixed) for path, motion in motions]
    stopping = [(problem, problem.stopping()) for problem in problems]
    for problem, candidate in sorted(stopping, key=lambda pair: (not pair[1].passed, pair[1].cost)):
        bound = _bound(task, problem.horizon_guess)
        is_near = bound is not None and candidate.cost <= (1 + settings.near_bound) * bound
        enough = candidate.passed and (is_near or problem.path.length == 0)
        best = candidate if enough else min(candidate, problem.smooth(), key=lambda c: (not c.passed, c.cost))
        candidates.append(best)
        task.report(f"path of length {problem.path.length:.4g}: {best}")
    return candidates


@dataclass(frozen=True, eq=False)
class _ProblemOf:
    """Motions within actuator limits along one path.

    Attributes:
        task: Checked request.
        path: The path.
        motion: Motion that stops at corners of the path.
        fixed: Fixed horizon, s; None if it is free.
    """

    task: _Task
    path: JointPath
    motion: StoppingMotion
    fixed: float | None

    @property
    def horizon_guess(self) -> float:
        """Horizon, s, or its guess."""
        return self.motion.duration if self.fixed is None else self.fixed

    def declare(self, clearance: ClearanceConstraints | None) -> Problem:
        """Declare the problem."""
        task, ends = self.task, {"start": self.path.joints[0], "end": self.path.joints[-1]}
        guess = self.horizon_guess
        least = least_durations(np.abs(ends["end"] - ends["start"]), task.bounds).max()
        shortest = min(max(float(least), guess / task.request.settings.longest), guess)
        horizon = FreeTime(shortest, task.request.settings.longest * guess, guess) if self.fixed is None else guess
        uses_jerk = np.isfinite(task.bounds.jerk).any() or task.request.cost.jerk
        setup = DynamicsSetup(
            start_velocity=task.request.start_velocity,
            end_velocity=task.request.end_velocity,
            control="jerk" if uses_jerk else "acceleration",
            clearance_constraints=clearance,
        )
        limits, cost = task.request.limits, task.request.cost
        return dynamics_problem(task.request.machine, (), horizon, **ends, limits=limits, cost=cost, setup=setup)

    def stopping(self) -> Candidate:
        """Return the audited motion that stops at corners, slowed down to a fixed horizon."""
        task, factor = self.task, self.horizon_guess / self.motion.duration
        if task.request.cost.energy or np.isfinite(task.bounds.power).any() or task.moves:
            words = "motions with stops are not offered where power counts, or the machine moves at an end"
            reason = Reason(Rejection.NOT_TRIED, words)
            return Candidate(self.path.joints[0], reason=reason)
        if factor < 1 - ROUNDING_SHARE:
            words = f"with stops it takes {self.motion.duration:.4g} s"
            reason = Reason(Rejection.ACTUATORS, words, "horizon", self.motion.duration, self.horizon_guess)
            return Candidate(self.path.joints[0], reason=reason)
        problem = self.declare(task.request.clearance_constraints)
        return _audited(task, self.motion.slower(factor).solution(problem), self.path)

    def smooth(self) -> Candidate:
        """Return the audited motion without stops that a solver finds from the path."""
        task, joints = self.task, self.path.joints
        settings, duration = task.request.settings, self.horizon_guess
        times = np.linspace(0.0, duration, settings.guess_times)
        places = points_along(joints, task.scale, QUINTIC(times / duration))
        velocities = np.gradient(places, times, axis=0)
        guess = {"joints": Samples(times, places), "velocities": Samples(times, velocities), "horizon": duration}
        constraints = task.request.clearance_constraints
        if constraints is not None:
            constraints = constraints.holding(np.unique(task.motions.near_pairs(places, settings.near)[1]).tolist())
        machines = {"": (task.request.machine, task.request.limits)}
        try:
            solution = within_limits(self.declare, constraints, machines, guess=guess)
        except (SolveError, TimeLimitReached) as error:
            if isinstance(error.__cause__, KeyboardInterrupt):
                raise
            return Candidate(joints[0], reason=Reason.of_error(Rejection.INFEASIBLE, error), stage=Stage.SEED)
        return _audited(task, solution, self.path)


def _audited(task: _Task, solution: Solution, path: JointPath) -> Candidate:
    """Return the candidate of a solution, with a reason if it is not feasible or could not be audited in time."""
    candidate = Candidate(path.joints[0], solution.cost, None, Stage.FINE, solution)
    task.report(f"audit of a motion of cost {solution.cost:.4g} along a path of length {path.length:.4g}")
    try:
        audit = solution.audit()
    except TimeLimitReached:
        return candidate.rejected(Reason(Rejection.NOT_TRIED, "the time limit passed in its audit", "time_limit"))
    if audit.feasible:
        return replace(candidate, stage=Stage.AUDITED)
    error = collision_error(audit, solution) or audit_error(audit, solution)
    return candidate.rejected(Reason.of_error(Rejection.AUDIT, error))


def _best(task: _Task, candidates: list[Candidate]) -> SolvedPlan:
    """Return the plan of the candidate of least cost, with a lower bound of the cost of all motions.

    Raises:
        SolveError: None passed its audit.
    """
    passed = sorted((c for c in candidates if c.passed), key=lambda candidate: candidate.cost)
    if not passed:
        reasons = "\n".join(f"  {candidate.reason}" for candidate in candidates)
        first = candidates[0].reason
        details: dict[str, Any] = (
            {} if first is None else {"name": first.name, "value": first.value, "limit": first.limit}
        )
        words = f"none of the {len(candidates)} collision-free paths led to a motion that passes its audit:\n{reasons}"
        raise SolveError(words, candidates[0].solution, (), **details)
    best = passed[0]
    costlier = [c.rejected(Reason(Rejection.COSTLIER, value=c.cost, limit=best.cost)) for c in passed[1:]]
    failed = [candidate for candidate in candidates if not candidate.passed]
    assert best.solution is not None
    listed = tuple(candidate.finished() for candidate in (best, *costlier, *failed))
    horizon = best.solution.horizon
    parts = (Part(0.0, horizon, ""),)
    bound = _bound(task, horizon)
    bound = None if bound is None else checked_bound(bound, best.cost)
    return SolvedPlan(task.request.machine, best.solution, parts, listed, bound)


def _bound(task: _Task, horizon: float) -> float | None:
    """Return a lower bound of the cost of any motion to one of the goals; None if it moves at an end.

    Straight motions have the least length and squared rates. No joint reaches its goal faster than by itself.
    """
    cost = task.request.cost
    if task.moves:
        return None
    lengths = np.linalg.norm((task.goals - task.start) * task.scale, axis=1)
    if not task.is_dynamic:
        return float(lengths.min() if task.length else lengths.min() ** 2 / (2 * horizon))
    durations = least_durations(np.abs(task.goals - task.start), task.bounds).max(axis=1)
    squares = lengths**2 if cost.velocity else np.zeros(len(lengths))
    if task.request.horizon is not None or not cost.time:
        return float(squares.min() / (2 * horizon) + cost.time * horizon)
    # time and squared rates: time T + square / (2 T) is least at T = sqrt(square / (2 time))
    best = np.maximum(durations, np.sqrt(squares / (2 * cost.time)))
    totals = cost.time * best + np.where(best > 0, squares / (2 * np.maximum(best, 1e-300)), 0.0)
    return float(totals.min())
