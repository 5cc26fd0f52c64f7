"""Plans in the fewest segments, for tasks that no single motion does, with reconfigurations between the segments.

Where a branch of inverse kinematics ends, the tool stops, leaves the task, and returns to the same place in another
configuration. Planned are the segments, each a plan of its part of the tasks' time, and a collision-free motion from
the end of each to the start of the next, while the tasks wait.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import casadi as ca
import numpy as np

from models import FixedBase
from models.arrays import Array
from ocp.direct.collocation import Collocation
from ocp.direct.guess import Samples
from ocp.errors import ProblemError, SolveError, checked_instance
from ocp.methods import solve
from ocp.motion.builders.clearance import ClearanceConstraints, collision_error, solve_with_clearance
from ocp.motion.builders.tool_motion import stretches_of
from ocp.motion.local.collisions import distances_along
from ocp.motion.local.inverse_kinematics import Unreachable
from ocp.motion.plan.planner import checked_request, clearance_for, plan_request
from ocp.motion.result.candidate import Candidate, Stage
from ocp.motion.result.segmented_plan import Reconfiguration, SegmentedPlan
from ocp.motion.result.solved_plan import Part, SolvedPlan
from ocp.motion.search.configurations import PlanRequest, fix_ignorable_joints, local_motions_from
from ocp.motion.search.held_joints import hold_idle_joints, place_held_joints
from ocp.motion.search.task_search import TaskSearch
from ocp.motion.tasks.limits import Limits
from ocp.motion.tasks.scene import Scene
from ocp.motion.tasks.tip_task import TipTask, timed
from ocp.problem.problem import Problem
from ocp.solution import Solution

__all__ = ["plan_in_segments"]


@dataclass(frozen=True)
class ReconfigurationSettings:
    """Settings of the motions between segments.

    Attributes:
        mesh: Mesh of their problem.
        options: Options of IPOPT.
        slowness: Duration of a motion around an obstacle, as a multiple of the straight motion's.
        detours, samples: Via configurations that are tried, the best of so many random samples.
        reach: Largest distance of the samples from the box between start and end, rad or m.
        unlimited_rate: Rate of joints without a rate limit, rad/s or m/s.
        rate_slack: Relative excess allowed over a rate limit, since a straight motion is at its limit all the time.
    """

    mesh: Collocation = field(default_factory=lambda: Collocation(12, 3))
    options: Mapping[str, Any] = field(default_factory=lambda: {"max_iter": 200})
    slowness: float = 3.0
    detours: int = 4
    samples: int = 256
    reach: float = np.pi / 2
    unlimited_rate: float = 1.0
    rate_slack: float = 1e-9


def plan_in_segments(
    machine: FixedBase,
    tasks: TipTask | Sequence[TipTask],
    horizon: Any = None,
    *,
    start: Any = None,
    cost: Any = None,
    limits: Limits | None = None,
    scene: Scene | Literal[False] | None = None,
    seed: int = 0,
) -> SegmentedPlan:
    """Plan tasks in the fewest segments, between which the arm reconfigures, at the least cost.

    If one motion does the tasks, there is one segment, the plan of `plan(..., search="global")`. Else the tasks are
    divided at time samples, refined to a thousandth of the horizon where that may save a segment. Among divisions into
    the fewest segments, the one whose segments cost least is chosen; reconfigurations cost nothing.

    Args:
        machine: An arm on a fixed base.
        tasks, horizon, start, cost, limits, seed: As in `plan`; the tasks are poses that leave at most two
            directions free. Actuator limits do not influence the division, but the segments are planned within them.
        scene: As in `plan`, with static obstacles, since a reconfiguration takes time.

    Returns:
        The segments and reconfigurations, with a lower bound of their number.

    Raises:
        ProblemError: As in `plan`; or an obstacle moves.
        DeadEnd: At some time no motion does the tasks even for the shortest while, in any configuration.
        SolveError: No segment could be planned, however the tasks were divided.
    """
    checked_instance("machine", machine, FixedBase)
    options: dict[str, Any] = {"start": start, "cost": cost, "limits": limits, "seed": seed}
    request = checked_request(machine, tasks, horizon, search="global", **options)
    constraints = clearance_for(machine, limits, scene)
    if constraints is not None and constraints.scene.has_moving_obstacles:
        words = "moving obstacles do not wait while the arm reconfigures; give static obstacles"
        raise ProblemError(words, name="obstacles", value=constraints.scene.obstacles)
    whole = replace(request, clearance_constraints=constraints)
    request, configurations = place_held_joints(whole, hold_idle_joints(whole))
    if request.start is None:
        configurations = fix_ignorable_joints(request, configurations)[1]
    search = TaskSearch(request, local_motions_from(request, configurations))
    excluded: list[tuple[float, float]] = []
    plans: dict[tuple[float, float], SolvedPlan] = {}
    error: SolveError | ProblemError | None = None
    while True:
        division = search.segments(excluded)
        if division is None:
            raise error or search.dead_end() or SolveError("no division into segments does the tasks", name="tasks")
        spans, fewest = division
        for begin, end in spans:
            if (begin, end) in plans:
                continue
            try:
                plans[begin, end] = _plan_segment(request, begin, end)
            except (SolveError, Unreachable) as failed:
                if isinstance(failed.__cause__, KeyboardInterrupt):
                    raise
                error = failed
                excluded.append((begin, end))
                break
        else:
            break
    segments = [plans[span] for span in spans]
    reconfigurations = []
    for (begin, _), before, after in zip(spans[1:], segments, segments[1:], strict=False):
        ends = before.at(before.horizon)["joints"], after.at(0.0)["joints"]
        reconfigurations.append(_plan_reconfiguration(request, begin, *ends))
    start_times = tuple(begin for begin, _ in spans)
    return SegmentedPlan(machine, tuple(segments), start_times, tuple(reconfigurations), fewest - 1)


def _plan_segment(request: PlanRequest, begin: float, end: float) -> SolvedPlan:
    """Plan the tasks from one time to another.

    Raises:
        ProblemError, SolveError: As in `plan`.
    """
    tasks = tuple(part for task in request.tasks if (part := _task_between(task, begin, end)) is not None)
    stretches = stretches_of(request.machine, tasks, end - begin)
    start = request.start if begin == 0 else None
    return plan_request(replace(request, tasks=tasks, horizon=end - begin, stretches=stretches, start=start))


def _task_between(task: TipTask, begin: float, end: float) -> TipTask | None:
    """Return the part of a task between two times, which starts at 0; None if it is empty."""
    first, last = max(task.begin, begin), min(task.end, end)
    if last <= first:
        return None
    shift, breaks = first - task.begin, np.asarray(task.breaks)
    inside = breaks[(breaks > shift) & (breaks < last - task.begin)] - shift
    shifted = replace(task, breaks=()) if shift == 0 else timed(replace(task, breaks=()), lambda time: time + shift)
    return replace(shifted, begin=first - begin, duration=last - first, breaks=inside)


def _plan_reconfiguration(request: PlanRequest, time: float, before: Array, after: Array) -> Reconfiguration:
    """Return a motion between two configurations: straight, or around obstacles."""
    settings, limits, ends = ReconfigurationSettings(), request.bounds.velocity, (before, after)
    whole = request.whole or request.machine
    free = [name not in request.held for name in whole.robot.joint_names]
    before, after = before[free], after[free]
    fastest = np.where(np.isfinite(limits), limits, settings.unlimited_rate)
    straight = float((np.abs(after - before) / fastest).max())
    middle, failure = (before + after) / 2, ""
    vias = [(middle, straight)]
    if request.clearance_constraints is not None:
        vias += [
            (via, settings.slowness * straight)
            for via in (middle, *_via_configurations(request, request.clearance_constraints, before, after, settings))
        ]
    for via, duration in vias:
        try:
            path, separate = (before, via, after), duration > straight
            solution = _solve_reconfiguration(request, *path, duration, fastest, separate, settings)
        except SolveError as error:
            if isinstance(error.__cause__, KeyboardInterrupt):
                raise
            failure = failure or str(error).split("\n")[0]
            continue
        candidate = Candidate(ends[0], solution.cost, None, Stage.AUDITED, solution)
        motion = SolvedPlan(whole, solution, (Part(0.0, duration, ""),), (candidate,), held=request.held)
        return Reconfiguration(time, *ends, motion)
    return Reconfiguration(time, *ends, None, failure)


def _via_configurations(
    request: PlanRequest,
    constraints: ClearanceConstraints,
    before: Array,
    after: Array,
    settings: ReconfigurationSettings,
) -> Array:
    """Return collision-free random configurations, the nearest to the middle of two others first. Shape (K, n)."""
    bounds, clearance = request.bounds, constraints.scene.clearance
    low = np.maximum(np.minimum(before, after) - settings.reach, bounds.lower)
    high = np.minimum(np.maximum(before, after) + settings.reach, bounds.upper)
    samples = low + (high - low) * np.random.default_rng(request.seed).random((settings.samples, len(before)))
    scene, base, times = constraints.scene, np.zeros(0), np.zeros(settings.samples)
    distances = distances_along(scene, base, samples, times, clearance)
    clear = samples[(distances >= clearance).all(axis=1)]
    return np.asarray(clear[np.argsort(((clear - (before + after) / 2) ** 2).sum(axis=1))[: settings.detours]])


def _solve_reconfiguration(
    request: PlanRequest,
    before: Array,
    via: Array,
    after: Array,
    duration: float,
    fastest: Array,
    separate: bool,
    settings: ReconfigurationSettings,
) -> Solution:
    """Return the motion of least squared rates between two configurations, from a guess through a third.

    Args:
        separate: Whether bodies that come too close are separated by constraints.

    Raises:
        SolveError: No motion was found within limits and clearance.
    """
    machine, n, bounds = request.machine, request.machine.joint_size, request.bounds
    guess = {"joints": Samples(np.array([0.0, duration / 2, duration]), np.array([before, via, after]))}

    def run(constraints: ClearanceConstraints | None) -> Solution:
        problem = Problem("reconfiguration")
        problem.horizon(duration)
        options: dict[str, Any] = {"lower": bounds.lower, "upper": bounds.upper, "unit": machine.robot.unit()}
        joints = problem.state("joints", n, initial=before, terminal=after, **options)
        max_rates = (1 + settings.rate_slack) * fastest
        rates = problem.control("rates", n, lower=-max_rates, upper=max_rates, unit=machine.robot.unit("/s"))
        problem.dynamics(joints, rates)
        if constraints is not None:
            constraints.declare(problem, machine.base_home(), joints, horizon=duration)
        problem.minimize(running=ca.dot(rates, ca.DM(request.weights) * rates) / 2)
        solution = solve(problem, settings.mesh, guess=guess, options=settings.options)
        audit = solution.audit()
        if not audit.feasible:
            worst = audit.failures[0]
            raise collision_error(audit, solution) or SolveError(str(worst), solution, name=worst.name)
        return solution

    return solve_with_clearance(request.clearance_constraints, run) if separate else run(request.clearance_constraints)
