"""Motions from a start to one of several goal configurations, around obstacles.

A sampling-based search finds collision-free paths of several homotopy classes (`ocp.motion.sampling.path_search`).
Motions along them are audited (`ocp.motion.plan.goal_motions`). The one of least cost is the plan, the others are
listed with the reason.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress
from dataclasses import replace
from itertools import product
from typing import Any

import numpy as np

from models import FixedBase
from models.checks import Array
from ocp.console import TimeLimitReached, interruptible, report, time_left
from ocp.errors import ProblemError, SolveError, require
from ocp.motion.builders.constant_jerk import TorqueLimits
from ocp.motion.local.inverse_kinematics import spread_points
from ocp.motion.plan.goal_motions import (
    GoalRequest,
    GoalTask,
    attains_bound,
    cost_bound,
    fastest_candidate,
    motions_along,
    synchronised_candidates,
)
from ocp.motion.result.candidate import Candidate, ranked
from ocp.motion.result.solved_plan import Part, SolvedPlan
from ocp.motion.sampling.joint_paths import StraightMotions, optimise_length
from ocp.motion.sampling.path_search import JointPath, TreeSearch, find_paths, search_paths
from ocp.motion.search.joint_space import FULL_TURN, JointSpace
from ocp.motion.search.search import checked_bound
from ocp.motion.tasks.checks import checked_configuration, checked_weights, clip_to_limits
from ocp.motion.tasks.goals import Cost
from ocp.motion.tasks.limits import JointBounds, Limits


@interruptible
def plan_to_goal(request: GoalRequest) -> SolvedPlan:
    """Return the lowest-cost collision-free motion that was found from the start to one of the goals.

    Raises:
        ProblemError: Sizes do not match; the start, or every goal, is outside the limits or collides: names the pair of
            bodies and their distance.
        SolveError: No motion was found within the time limit, which does not prove that there is none.
    """
    task = _check_request(request)
    seconds = request.settings.time_limit if request.time_limit is None else request.time_limit
    with request.limited(require.positive("time_limit", seconds)):
        try:
            return _plan_of_best(task, _find_candidates(task, seconds))
        except TimeLimitReached as error:
            words = f"no motion was found within the time limit of {seconds:.4g} s; raise time_limit"
            raise SolveError(words, name="time_limit", limit=seconds) from error


def _find_candidates(task: GoalTask, seconds: float) -> list[Candidate]:
    """Return audited candidate motions to the goals that are found within the given time, s.

    The search ends when a motion attains the lower bound of the cost.
    """
    settings, candidates = task.request.settings, list[Candidate]()
    if task.is_fastest:
        with suppress(TimeLimitReached), task.request.limited((1 - settings.search_share) * seconds):
            candidates = synchronised_candidates(task)
    if any(attains_bound(task, candidate) for candidate in candidates):
        return candidates
    try:
        if not task.is_fastest:
            return motions_along(task, list(_find_paths(task, seconds)))
        paths = list[JointPath]()
        for path in _find_paths(task, seconds):
            paths.append(path)
            candidates.append(fastest_candidate(task, path))
            if attains_bound(task, candidates[-1]):
                return candidates
        shortest = min(paths, key=lambda path: path.length)
        if len(shortest.joints) > 2:
            with task.request.limited(settings.search_share * time_left()):
                limits = task.bounds.lower, task.bounds.upper
                joints = optimise_length(task.motions, shortest.joints, task.scale, limits=limits)
            candidates.append(fastest_candidate(task, replace(shortest, joints=joints)))
    except (SolveError, TimeLimitReached):
        if not any(candidate.passed for candidate in candidates):
            raise
    return candidates


def _check_request(request: GoalRequest) -> GoalTask:
    """Return a checked request, with goals shifted towards the start by full turns of the periodic joints."""
    machine = require.instance("machine", request.machine, FixedBase)
    # the problem that is declared warns of unknown limits
    bounds = require.instance("limits", request.limits, Limits).bounds(machine)
    unlimited = np.isinf([bounds.velocity, bounds.acceleration, bounds.jerk, bounds.torque]).all(axis=0)
    bounds = bounds._replace(velocity=np.where(unlimited, request.settings.unlimited_rate, bounds.velocity))
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
        raise _collision_error(scene, "start", collisions[0])
    within, errors = [], []
    for goal in goals:
        try:
            within.append(_checked_end(machine, "end" if len(goals) == 1 else "goal", goal, bounds))
        except ProblemError as error:
            errors.append(error)
    clear = motions.are_clear(np.array(within), np.array(within)) if within else np.zeros(0, dtype=bool)
    kept = []
    for joints, is_clear in zip(within, clear.tolist(), strict=True):
        collisions = [] if is_clear else motions.collisions(joints)  # without a proof it may be clear all the same
        if collisions:
            errors.append(_collision_error(scene, "goal", collisions[0]))
        else:
            kept.append(joints)
    if not kept:
        raise errors[0]
    turned = np.array(
        [shifted for goal in kept for shifted in _equivalent_goals(space, bounds, start, goal, request.settings.turns)]
    )
    turned = _nearest_and_spread(turned, (turned - start) * scale, request.settings.most_goals)
    return GoalTask(request, bounds, start, turned, scale, motions, space, TorqueLimits(machine, bounds))


def _nearest_and_spread(goals: Array, changes: Array, most: int) -> Array:
    """Select at most `most` of K goals: half of them need the least joint changes (K, n), the others are spread out."""
    if len(goals) <= most:
        return goals
    order = np.argsort(np.linalg.norm(changes, axis=1), kind="stable")
    nearest, others = order[: most // 2], order[most // 2 :]
    kept: Array = goals[np.concatenate([nearest, others[spread_points(changes[others], most - most // 2)]])]
    return kept


def _checked_end(machine: FixedBase, name: str, value: Any, bounds: JointBounds) -> Array:
    joints, _ = checked_configuration(machine, value, None)
    return clip_to_limits(machine, joints, bounds.lower, bounds.upper, label=name)


def _collision_error(scene: Any, name: str, collision: Any) -> ProblemError:
    first, second = collision.bodies
    how = (
        f"overlap by {-collision.distance:.3g} m" if collision.distance < 0 else f"are {collision.distance:.3g} m apart"
    )
    ignored = [scene.pair_names(collision.pair)]
    words = f"{name}: {first} and {second} {how}, {scene.clearance:.3g} m are required; "
    words += f"give a collision-free {name}, or ignore this pair of bodies: {ignored=}"
    return ProblemError(words, name=f"{first} and {second}", value=collision.distance, limit=scene.clearance)


def _equivalent_goals(space: JointSpace, bounds: JointBounds, start: Array, goal: Array, turns: int) -> list[Array]:
    """Return configurations that differ from a goal by full turns of periodic joints, the nearest to `start` first."""
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


def _find_paths(task: GoalTask, seconds: float) -> Iterator[JointPath]:
    """Yield collision-free paths, or raise SolveError if there is none.

    The paths are locally shortest in several homotopy classes, and the shortest of them is the first. Where only the
    time of the motion counts, they are neither optimised nor sorted.
    """
    request, bounds, joints = task.request, task.bounds, np.vstack([task.start, task.goals])
    lower = np.where(np.isfinite(bounds.lower) & ~task.space.periodic, bounds.lower, joints.min(axis=0) - np.pi)
    upper = np.where(np.isfinite(bounds.upper) & ~task.space.periodic, bounds.upper, joints.max(axis=0) + np.pi)
    range_of_samples = np.maximum(lower, bounds.lower), np.minimum(upper, bounds.upper)
    search = TreeSearch(task.motions, task.start, task.goals, *range_of_samples, task.scale)
    share = request.settings.search_share
    shared: dict[str, Any] = {"seed": request.seed, "settings": request.settings.search}
    reason, name, has_path = "in all random searches", "search", False
    try:
        if task.is_fastest:
            paths = search_paths(search, **shared)
        else:
            with request.limited(share * seconds):
                paths = iter(find_paths(search, limits=(bounds.lower, bounds.upper), **shared))
        while True:
            with request.limited(share * time_left()):
                path = next(paths, None)
            if path is None:
                break
            report(f"a path of length {path.length:.4g}")
            has_path = True
            yield path
    except TimeLimitReached:
        reason, name = f"within the time limit of {seconds:.4g} s", "time_limit"
    if has_path:
        return
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


def _plan_of_best(task: GoalTask, candidates: list[Candidate]) -> SolvedPlan:
    """Return the plan of the lowest-cost candidate, with a cost bound, or raise SolveError if no candidate passed."""
    if not any(candidate.passed for candidate in candidates):
        reasons = "\n".join(f"  {candidate.reason}" for candidate in candidates)
        first = candidates[0].reason
        words = f"none of the {len(candidates)} collision-free paths led to a motion that passes its audit:\n{reasons}"
        raise SolveError(words, candidates[0].solution, **({} if first is None else first.fault))
    listed = ranked(candidates)
    solution = listed[0].solution
    assert solution is not None
    bound = cost_bound(task, solution.horizon)
    bound = None if bound is None else checked_bound(bound, solution.cost)
    parts = (Part(0.0, solution.horizon, ""),)
    return SolvedPlan(task.request.machine, solution, parts, tuple(listed), bound)
