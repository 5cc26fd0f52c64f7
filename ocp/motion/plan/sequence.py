"""Plans in the fewest segments, for tasks that no single motion does, with reconfigurations between the segments.

Where a branch of inverse kinematics ends, the tool stops, leaves the task, and returns to the same place in another
configuration. Planned are the segments, each a plan of its part of the tasks' time, and a collision-free motion from
the end of each to the start of the next, while the tasks wait.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, Literal

import numpy as np

from models import FixedBase
from models.checks import Array
from ocp.errors import ProblemError, SolveError, require
from ocp.motion.builders.tool_motion import stretches_of
from ocp.motion.local.inverse_kinematics import Unreachable
from ocp.motion.plan.goal_plan import GoalRequest, plan_to_goal
from ocp.motion.plan.planner import checked_request, clearance_for, plan_request
from ocp.motion.result.segmented_plan import Reconfiguration, SegmentedPlan
from ocp.motion.result.solved_plan import SolvedPlan
from ocp.motion.search.configurations import PlanRequest, local_motions_from
from ocp.motion.search.held_joints import fix_ignorable_joints, hold_idle_joints, place_held_joints
from ocp.motion.search.task_search import TaskSearch
from ocp.motion.tasks.goals import Cost, Scene
from ocp.motion.tasks.limits import Limits
from ocp.motion.tasks.tip_task import TipTask, timed

__all__ = ["plan_in_segments"]


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
    require.instance("machine", machine, FixedBase)
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
    """Return a motion between two configurations of all joints: straight, or around obstacles."""
    machine, whole = require.instance("machine", request.machine, FixedBase), request.whole or request.machine
    free = [name not in request.held for name in whole.robot.joint_names]
    goal = GoalRequest(
        machine,
        before[free],
        after[free],
        limits=request.limits,
        cost=Cost(weights=request.weights),
        clearance_constraints=request.clearance_constraints,
        seed=request.seed,
    )
    try:
        motion = replace(plan_to_goal(goal), machine=whole, held=request.held)
    except (ProblemError, SolveError) as error:
        if isinstance(error.__cause__, KeyboardInterrupt):
            raise
        return Reconfiguration(time, before, after, None, str(error).split("\n")[0])
    return Reconfiguration(time, before, after, motion)
