"""Motions from a start to a goal along collision-free paths, each audited as a candidate of a plan.

Without actuator limits, a path at constant speed is a candidate whose clearance is proven. In least time, the fastest
motion without obstacles is a candidate if it is clear. A spline near each path minimises a cost of time and of squared
velocities, accelerations and jerks (`ocp.motion.sampling.spline_motion`). With another cost, each path is the guess of
an optimal control problem. A motion that stops at the corners of the path is the last resort.
"""

from __future__ import annotations

from contextlib import AbstractContextManager, suppress
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from models import FixedBase
from models.checks import Array
from ocp.console import TimeLimitReached, report, time_left, time_limited
from ocp.direct.guess import Samples
from ocp.errors import SolveError
from ocp.motion.builders.clearance import ClearanceConstraints
from ocp.motion.builders.constant_jerk import (
    ConstantJerkMotion,
    TorqueLimits,
    least_durations,
    least_squared_velocities,
    segment_durations,
    stopping_motion,
    synchronised_motion,
)  # fmt: skip
from ocp.motion.builders.dynamics import QUINTIC, DynamicsSetup, dynamics_problem, end_velocities
from ocp.motion.builders.dynamics_plan import audit_error, within_limits
from ocp.motion.builders.joint_motion import joint_motion_problem, motion_along
from ocp.motion.builders.standing.problem import FreeTime
from ocp.motion.plan.actuators import limits_actuators
from ocp.motion.result.candidate import Candidate, Reason, Rejection, Stage
from ocp.motion.sampling.joint_paths import StraightMotions, path_length, points_along, shortest_through_corners
from ocp.motion.sampling.path_search import JointPath, PathSearchSettings
from ocp.motion.sampling.spline_motion import MotionLimits, SplineMotionSettings, has_spline_cost, optimal_motion_near
from ocp.motion.search.joint_space import JointSpace
from ocp.motion.tasks.goals import Cost
from ocp.motion.tasks.limits import JointBounds, Limits
from ocp.problem.problem import Problem
from ocp.solution import Solution
from ocp.tolerances import ROUNDING_SHARE


@dataclass(frozen=True)
class GoalSettings:
    """Settings for planning motions to a goal.

    Attributes:
        search: Settings of the search for paths.
        time_limit: Processor time after which a request without its own limit is refused, s.
        search_share: Share of the time limit after which the search for further paths ends.
        unlimited_rate: Rate of joints without a rate limit, rad/s or m/s, where the planner chooses the horizon.
        spare: Horizon of a motion within actuator limits, where the planner chooses it, relative to the least time of a
            motion that stops at corners.
        longest: Largest ratio of a free horizon to its guess, and inverse of the smallest ratio.
        guess_times: Number of time samples of a guess.
        near_bound: Relative excess of the cost over its lower bound below which a motion counts as optimal.
        phase_samples: Number of samples of each phase of a motion at which its clearance is checked before the audit.
        margins: Largest number of margins, each twice the one before, that are tried for the clearance between samples.
        spline: Settings of the locally optimal splines near a path.
        near: Pairs of bodies closer than the clearance plus this along a path are separated from the first solve on, m.
        most_goals: Largest number of goal configurations, in all full turns of the joints, to which paths are searched.
        turns: Largest number of further full turns by which goals of unlimited joints are shifted.
    """

    search: PathSearchSettings = field(default_factory=PathSearchSettings)
    time_limit: float = 20.0
    search_share: float = 0.75
    unlimited_rate: float = 1.0
    spare: float = 2.0
    longest: float = 20.0
    guess_times: int = 201
    near_bound: float = 1e-3
    phase_samples: int = 9
    margins: int = 4
    spline: SplineMotionSettings = field(default_factory=SplineMotionSettings)
    near: float = 0.02
    most_goals: int = 200
    turns: int = 1


@dataclass(frozen=True, eq=False)
class GoalRequest:
    """Request for a motion from a start to one of several goals.

    Attributes:
        machine: Machine on a fixed base.
        start: Joint positions at the start, rad or m. Shape (n,).
        goals: Configurations that each satisfy the goal. Shape (K, n), or (n,) for one.
        horizon: Final time, s; None: as short as the limits of the rates allow for the path, or free if the cost
            weights time.
        limits: Limits of joints and actuators.
        cost: Weights of the cost. With velocity or length alone, and without actuator limits, the motion has constant
            speed; else it is smooth. The weights of the joints are the metric of joint space.
        start_velocity, end_velocity: "rest", "free", or the joint velocities there, shape (n,). For smooth motions.
        clearance_constraints: Collision scene; None if collisions are not checked.
        seed: Seed of the random searches.
        time_limit: Wall time, s; None for the processor time of the settings.
        settings: Settings.
    """

    machine: FixedBase
    start: Any
    goals: Any
    horizon: float | None = None
    limits: Limits = field(default_factory=Limits)
    cost: Cost = field(default_factory=Cost)
    start_velocity: Any = "rest"
    end_velocity: Any = "rest"
    clearance_constraints: ClearanceConstraints | None = None
    seed: int = 0
    time_limit: float | None = None
    settings: GoalSettings = field(default_factory=GoalSettings)

    def limited(self, seconds: float) -> AbstractContextManager[None]:
        """Limit a ``with`` block to `seconds`: of wall time if the request has a time limit, else of processor time."""
        return time_limited(seconds, processor=self.time_limit is None)


@dataclass(frozen=True, eq=False)
class GoalTask:
    """Checked request for a motion to goals, with joint limits, goals shifted by full turns, and collision checks."""

    request: GoalRequest
    bounds: JointBounds
    start: Array
    goals: Array
    scale: Array
    motions: StraightMotions
    space: JointSpace
    torques: TorqueLimits

    @property
    def is_dynamic(self) -> bool:
        """Whether joint velocities must be continuous, due to actuator limits, the cost, or velocities at the ends."""
        terms = set(self.request.cost.terms)
        return limits_actuators(self.request.limits) or not terms <= {"velocity", "length"} or self.moves

    @property
    def moves(self) -> bool:
        """Whether the joints may move at the start or at the end of the motion."""
        ends = self.request.start_velocity, self.request.end_velocity
        return not all(isinstance(velocity, str) and velocity == "rest" for velocity in ends)

    @property
    def is_fastest(self) -> bool:
        """Whether the motion is time-optimal: the horizon is free, and time is the only term of the cost."""
        return self.request.horizon is None and self.request.cost.terms == ("time",)

    @property
    def length(self) -> bool:
        """Whether the cost is the length of the path in joint space."""
        return bool(self.request.cost.length)


def _constant_speed_candidates(task: GoalTask, paths: list[JointPath]) -> list[Candidate]:
    """Return audited candidates that follow collision-free joint paths at constant speed."""
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
        candidates.append(_audit_candidate(task, solution, path))
    return candidates


def motions_along(task: GoalTask, paths: list[JointPath]) -> list[Candidate]:
    """Return audited candidates along joint paths, at constant speed unless actuator limits determine the timing."""
    return _candidates_within_limits(task, paths) if task.is_dynamic else _constant_speed_candidates(task, paths)


def synchronised_candidates(task: GoalTask) -> list[Candidate]:
    """Return a list of the audited fastest motion that ignores obstacles, or an empty list if this motion collides.

    No other motion is faster unless torque limits slow down this motion.
    """
    durations = least_durations(np.abs(task.goals - task.start), task.bounds).max(axis=1)
    for goal in np.argsort(durations, kind="stable").tolist():
        if task.moves:
            break
        motion = synchronised_motion(task.start, task.goals[goal], task.bounds)
        with suppress(SolveError):
            motion = task.torques.slow_down(motion)
            samples = motion.sampled(np.linspace(0.0, 1.0, task.request.settings.phase_samples))[0]
            samples = samples.reshape(-1, len(task.start))
            if task.motions.are_clear(samples[:-1], samples[1:]).all():
                joints = np.array([task.start, task.goals[goal]])
                path = JointPath(joints, goal, path_length(samples, task.scale))
                return [_PathProblem(task, path, motion, None).candidate("synchronises the joints")]
    return []


def fastest_candidate(task: GoalTask, path: JointPath) -> Candidate:
    """Return an audited, locally fastest motion near a path or, if none is found, one that stops at path corners."""
    candidate = _spline_candidate(task, path, None)
    if not candidate.passed:
        with suppress(TimeLimitReached):
            return next((other for other in _candidates_within_limits(task, [path]) if other.passed), candidate)
    return candidate


def _spline_candidate(task: GoalTask, path: JointPath, horizon: float | None) -> Candidate:
    """Return an audited, locally optimal spline near a path; the horizon is free if it is None."""
    request, settings = task.request, task.request.settings.spline
    ends = (end_velocities("", each, len(task.start)) for each in (request.start_velocity, request.end_velocity))
    limits = MotionLimits(task.motions, task.bounds, task.torques, *ends)
    try:
        for _ in range(request.settings.margins):
            with request.limited(request.settings.search_share * time_left()):
                motion = optimal_motion_near(limits, path.joints, request.cost, horizon, settings=settings)
            candidate = _PathProblem(task, path, motion, horizon).candidate("is a locally optimal spline")
            report(f"path of length {path.length:.4g}: {candidate}")
            if candidate.passed or candidate.reason is None or candidate.reason.kind is not Rejection.COLLISION:
                break
            settings = replace(settings, margin=2 * settings.margin)
    except (SolveError, TimeLimitReached) as error:
        candidate = Candidate(path.joints[0], reason=Reason.of_error(Rejection.INFEASIBLE, error))
    return candidate


def _candidates_within_limits(task: GoalTask, paths: list[JointPath]) -> list[Candidate]:
    """Return audited motions along paths within actuator limits: with stops at corners or, if better, without."""
    request, settings, bounds = task.request, task.request.settings, task.bounds
    candidates, motions = list[Candidate](), list[tuple[JointPath, ConstantJerkMotion]]()
    for path in paths:
        try:
            corners = shortest_through_corners(
                task.motions, path.joints, lambda changes: segment_durations(changes, bounds)
            )
            motions.append((path, stopping_motion(corners, bounds, task.torques)))
        except (SolveError, TimeLimitReached) as error:
            reason = Reason.of_error(Rejection.ACTUATORS, error)
            candidates.append(Candidate(path.joints[0], reason=reason))
    is_free = request.horizon is None and request.cost.time > 0
    shortest = min((motion.duration for _, motion in motions), default=0.0)
    fixed = settings.spare * shortest if request.horizon is None else float(request.horizon)
    problems = [_PathProblem(task, path, motion, None if is_free else fixed) for path, motion in motions]
    stopping = [(problem, problem.stopping_motion()) for problem in problems]
    for problem, candidate in sorted(stopping, key=lambda pair: (not pair[1].passed, pair[1].cost)):
        enough = attains_bound(task, candidate) or (candidate.passed and (problem.path.length == 0 or task.is_fastest))
        best = candidate if enough else min(candidate, problem.without_stops(), key=lambda c: (not c.passed, c.cost))
        candidates.append(best)
        report(f"path of length {problem.path.length:.4g}: {best}")
    return candidates


def attains_bound(task: GoalTask, candidate: Candidate) -> bool:
    """Return whether a candidate passed its audit with a cost that equals the lower bound within tolerance."""
    if not candidate.passed or candidate.solution is None:
        return False
    bound = cost_bound(task, candidate.solution.horizon)
    return bound is not None and candidate.cost <= (1 + task.request.settings.near_bound) * bound


@dataclass(frozen=True, eq=False)
class _PathProblem:
    """Optimal control problem of a motion near one path, within actuator limits."""

    task: GoalTask
    path: JointPath
    motion: ConstantJerkMotion  # a feasible motion, such as one that stops at the corners of the path
    fixed: float | None  # horizon, s; None if it is free

    @property
    def horizon_guess(self) -> float:
        """Horizon, s; if the horizon is free, an initial guess of it."""
        return self.motion.duration if self.fixed is None else self.fixed

    def declare(self, clearance: ClearanceConstraints | None) -> Problem:
        """Declare the problem of an optimal motion between the ends of the path, with clearance constraints or none."""
        task, ends = self.task, {"start": self.path.joints[0], "end": self.path.joints[-1]}
        guess = self.horizon_guess
        least = 0.0 if task.moves else least_durations(np.abs(ends["end"] - ends["start"]), task.bounds).max()
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

    def stopping_motion(self) -> Candidate:
        """Return the audited motion that stops at all path corners, slowed to end at the horizon if that is fixed."""
        task, factor = self.task, self.horizon_guess / self.motion.duration
        if task.request.cost.energy or task.moves:
            words = "motions with stops are not offered where energy is weighted, or the machine moves at an end"
            reason = Reason(Rejection.NOT_TRIED, words)
            return Candidate(self.path.joints[0], reason=reason)
        if factor < 1 - ROUNDING_SHARE:
            words = f"with stops it takes {self.motion.duration:.4g} s"
            reason = Reason(Rejection.ACTUATORS, words, "horizon", self.motion.duration, self.horizon_guess)
            return Candidate(self.path.joints[0], reason=reason)
        return replace(self, motion=self.motion.slower(factor)).candidate("stops at the corners of a path")

    def candidate(self, method: str) -> Candidate:
        """Audit the motion and return it as a candidate; `method` says how it was computed."""
        problem = self.declare(self.task.request.clearance_constraints)
        return _audit_candidate(self.task, self.motion.solution(problem, method), self.path)

    def without_stops(self) -> Candidate:
        """Return an audited, locally optimal motion near the collision-free path that does not stop at corners."""
        if has_spline_cost(self.task.request.cost) and not self.task.is_fastest:
            spline = _spline_candidate(self.task, self.path, self.fixed)
            if spline.passed:
                return spline
        return self.solve()

    def solve(self) -> Candidate:
        """Solve the optimal control problem from a smooth guess along the path; return the audited candidate."""
        task, joints = self.task, self.path.joints
        settings, duration = task.request.settings, self.horizon_guess
        times = np.linspace(0.0, duration, settings.guess_times)
        places = points_along(joints, task.scale, QUINTIC(times / duration))
        velocities = np.gradient(places, times, axis=0)
        guess = {"joints": Samples(times, places), "velocities": Samples(times, velocities), "horizon": duration}
        constraints = task.request.clearance_constraints
        if constraints is not None:
            constraints = constraints.with_pairs(np.unique(task.motions.near_pairs(places, settings.near)[1]).tolist())
        machines = {"": (task.request.machine, task.request.limits)}
        try:
            solution = within_limits(self.declare, constraints, machines, guess=guess)
        except (SolveError, TimeLimitReached) as error:
            return Candidate(joints[0], reason=Reason.of_error(Rejection.INFEASIBLE, error))
        return _audit_candidate(task, solution, self.path)


def _audit_candidate(task: GoalTask, solution: Solution, path: JointPath) -> Candidate:
    """Audit a solution; return it as a candidate, rejected if it is infeasible or could not be audited in time."""
    candidate = Candidate(path.joints[0], solution.cost, None, Stage.FINE, solution)
    report(f"audit of a motion of cost {solution.cost:.4g} along a path of length {path.length:.4g}")
    try:
        audit = solution.audit(only_feasible=True)
    except TimeLimitReached:
        return candidate.with_rejection(Reason(Rejection.NOT_TRIED, "the time limit passed in its audit", "time_limit"))
    if audit.feasible:
        return replace(candidate, stage=Stage.AUDITED)
    collision = next((row for row in audit.failures if row.name in audit.clearances), None)
    if collision is not None:
        words = f"{audit.clearances[collision.name].worst}"
        reason = Reason(Rejection.COLLISION, words, collision.name, collision.value, collision.limit, collision.time)
        return candidate.with_rejection(reason)
    return candidate.with_rejection(Reason.of_error(Rejection.AUDIT, audit_error(audit, solution)))


def cost_bound(task: GoalTask, horizon: float) -> float | None:
    """Return a lower bound of the cost of any motion to a goal; None if the joints may move at the start or end.

    Straight motions have the least length and squared velocities. Each joint by itself needs the least time and, within
    its acceleration limit, the least squared velocity.
    """
    cost = task.request.cost
    if task.moves:
        return None
    lengths = np.linalg.norm((task.goals - task.start) * task.scale, axis=1)
    if not task.is_dynamic:
        return float(lengths.min() if task.length else lengths.min() ** 2 / (2 * horizon))
    distances = np.abs(task.goals - task.start)
    if task.request.horizon is not None or not cost.time:
        integrals = least_squared_velocities(distances, horizon, task.bounds.acceleration) @ task.scale**2
        return float(integrals.min() / 2 if cost.velocity else 0.0) + cost.time * horizon
    durations = least_durations(distances, task.bounds).max(axis=1)
    squares = lengths**2 if cost.velocity else np.zeros(len(lengths))
    # time and squared rates: time T + square / (2 T) is least at T = sqrt(square / (2 time))
    best = np.maximum(durations, np.sqrt(squares / (2 * cost.time)))
    totals = cost.time * best + np.where(best > 0, squares / (2 * np.maximum(best, 1e-300)), 0.0)
    return float(totals.min())
