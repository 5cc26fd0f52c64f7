"""Plans in the fewest segments, for tasks that no single motion does, with reconfigurations between the segments.

Where a branch of inverse kinematics ends, the tool stops, leaves the task, and returns to the same place in another
configuration. Planned are the segments, each a plan of its part of the tasks' time, and a collision-free motion from
the end of each to the start of the next, while the tasks wait.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from models import FixedBase
from models.arrays import Array
from ocp.console import interruptible
from ocp.errors import ProblemError, SolveError, checked_instance
from ocp.motion.builders.tool_motion import stretches_of
from ocp.motion.local.inverse_kinematics import Unreachable
from ocp.motion.plan.goal_plan import GoalRequest, plan_to_goal
from ocp.motion.plan.motion import Plan
from ocp.motion.plan.planner import checked_request, clearance_for, plan_request
from ocp.motion.search.configurations import PlanRequest, fix_ignorable_joints, local_motions_from, start_configurations
from ocp.motion.search.task_search import TaskSearch
from ocp.motion.tasks.limits import Limits
from ocp.motion.tasks.tip_task import TipTask, timed

__all__ = ["Reconfiguration", "SegmentedPlan", "plan_in_segments"]


@dataclass(frozen=True, eq=False)
class Reconfiguration:
    """Motion between two segments, to the same place of the tasks in another configuration.

    Attributes:
        time: Time of the tasks, which wait, s.
        before, after: Joints, rad or m. Shape (n,).
        motion: Collision-free motion within the rate limits; unlike in a plan, its joints do not start at rest. None if
            none was found, which does not prove that there is none.
        failure: Why there is no motion; "" otherwise.
    """

    time: float
    before: Array
    after: Array
    motion: Plan | None
    failure: str = ""

    @property
    def duration(self) -> float:
        """Duration of the motion, s; nan without a motion."""
        return np.nan if self.motion is None else self.motion.horizon

    def __str__(self) -> str:
        largest = np.abs(self.after - self.before).max()
        how = f"no collision-free motion was found: {self.failure}"
        if self.motion is not None:
            how = f"in {self.duration:.4g} s"
        return f"at {self.time:.4g} s the arm reconfigures, a joint by up to {largest:.3g}: {how}"


@dataclass(frozen=True, eq=False)
class SegmentedPlan:
    """Motions that do the tasks one after the other.

    Attributes:
        machine: The arm.
        segments: Audited plans of parts of the tasks; the time of each starts at 0.
        start_times: Time of the tasks at which each segment starts, s; each ends where the next one starts.
        reconfigurations: Motions between segments.
        fewest: Lower bound of the number of reconfigurations, under the assumptions of `ocp.motion.search.search`.
    """

    machine: FixedBase
    segments: tuple[Plan, ...]
    start_times: tuple[float, ...]
    reconfigurations: tuple[Reconfiguration, ...]
    fewest: int

    @property
    def cost(self) -> float:
        """Cost of all segments, without reconfigurations."""
        return float(sum(segment.cost for segment in self.segments))

    @property
    def horizon(self) -> float:
        """Duration of the tasks, s."""
        return self.start_times[-1] + self.segments[-1].horizon

    @property
    def duration(self) -> float:
        """Duration of tasks and reconfigurations, s; nan if a reconfiguration has no motion."""
        return self.horizon + float(sum(each.duration for each in self.reconfigurations))

    def __repr__(self) -> str:
        return f"<SegmentedPlan of {self.horizon:.6g} s: {len(self.segments)} segments, cost {self.cost:.6g}>"

    def __str__(self) -> str:
        count = len(self.reconfigurations)
        counted = f"{count} reconfiguration{'' if count == 1 else 's'}"
        fewest = "the fewest possible" if self.fewest == count else f"at least {self.fewest} needed"
        names = ", ".join(self.machine.robot.joint_names)
        lines = [f"plan of {self.horizon:.6g} s for {names}: {counted}, {fewest}; cost {self.cost:.6g}"]
        for k, segment in enumerate(self.segments):
            end = self.start_times[k] + segment.horizon
            bound = "" if segment.bound is None else f", lower bound {segment.bound:.6g}"
            lines.append(f"  {self.start_times[k]:.4g} to {end:.4g} s: cost {segment.cost:.6g}{bound}")
            if k < count:
                lines.append(f"  {self.reconfigurations[k]}")
        return "\n".join(lines)


@interruptible
def plan_in_segments(
    machine: FixedBase,
    tasks: TipTask | Sequence[TipTask],
    horizon: float | None = None,
    *,
    start: Any = None,
    weights: Any = None,
    limits: Limits | None = None,
    seed: int = 0,
    obstacles: Any = (),
    clearance: float | None = 0.0,
    ignored: Any = (),
    srdf: Any = None,
    folders: Any = (),
    missing: str = "raise",
) -> SegmentedPlan:
    """Plan tasks in the fewest segments, between which the arm reconfigures, at the least cost.

    If one motion does the tasks, there is one segment, the plan of `plan(..., search="global")`. Else the tasks are
    divided at time samples, refined to a thousandth of the horizon where that may save a segment. Among divisions into
    the fewest segments, the one whose segments cost least is chosen; reconfigurations cost nothing.

    Args:
        machine: An arm on a fixed base.
        tasks, horizon, start, weights, limits, seed: As in `plan`; the tasks are poses that leave at most two
            directions free. Actuator limits do not influence the division, but the segments are planned within them.
        obstacles, clearance, ignored, srdf, folders, missing: As in `plan`, for static obstacles, since a
            reconfiguration takes time.

    Returns:
        The segments and reconfigurations, with a lower bound of their number.

    Raises:
        ProblemError: As in `plan`; or an obstacle moves.
        DeadEnd: At some time no motion does the tasks even for the shortest while, in any configuration.
        SolveError: No segment could be planned, however the tasks were divided.
    """
    checked_instance("machine", machine, FixedBase)
    options: dict[str, Any] = {"start": start, "weights": weights, "limits": limits, "seed": seed}
    request = checked_request(machine, tasks, horizon, search="global", **options)
    collision: dict[str, Any] = {"obstacles": obstacles, "clearance": clearance, "ignored": ignored}
    collision |= {"srdf": srdf, "folders": folders, "missing": missing}
    constraints = clearance_for(machine, limits, **collision)
    if constraints is not None and constraints.scene.has_moving_obstacles:
        words = "moving obstacles do not wait while the arm reconfigures; give static obstacles"
        raise ProblemError(words, name="obstacles", value=obstacles)
    request = replace(request, clearance_constraints=constraints)
    configurations = start_configurations(request)
    if request.start is None:
        configurations = fix_ignorable_joints(request, configurations)[1]
    search = TaskSearch(request, local_motions_from(request, configurations))
    excluded: list[tuple[float, float]] = []
    plans: dict[tuple[float, float], Plan] = {}
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


def _plan_segment(request: PlanRequest, begin: float, end: float) -> Plan:
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
    assert isinstance(request.machine, FixedBase)
    goal = GoalRequest(
        request.machine,
        before,
        after,
        limits=request.limits,
        weights=request.weights,
        clearance_constraints=request.clearance_constraints,
        seed=request.seed,
    )
    try:
        return Reconfiguration(time, before, after, plan_to_goal(goal))
    except (ProblemError, SolveError) as error:
        if isinstance(error.__cause__, KeyboardInterrupt):
            raise
        return Reconfiguration(time, before, after, None, str(error).split("\n")[0])
