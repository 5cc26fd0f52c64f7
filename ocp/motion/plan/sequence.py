"""Consecutive motions: to goals and along tasks in sequence, or along tasks in the fewest segments.

In a sequence, each motion starts where the one before ends. The start of a task is searched as for a task alone, and a
motion of its own leads there, unless the goal before is there. A task is therefore planned before the goal that leads
to it.

Tasks that no single motion does are planned in segments. Where a branch of inverse kinematics ends, the tool stops,
leaves the task, and returns to the same place in another configuration. Each segment is a plan of its part of the
tasks' time; while the tasks wait, a collision-free motion leads from its end to the start of the next segment.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from itertools import zip_longest
from typing import Any, Literal, NamedTuple

import numpy as np

from models import FixedBase, Machine
from models.checks import Array, floats
from ocp.errors import ProblemError, SolveError, require
from ocp.motion.builders.clearance import ClearanceConstraints
from ocp.motion.builders.dynamics import checked_motors
from ocp.motion.builders.tool_motion import stretches_of
from ocp.motion.local.inverse_kinematics import Unreachable
from ocp.motion.plan.actuators import limits_actuators, weights_actuators
from ocp.motion.plan.declared_plans import plan_goal, with_joints
from ocp.motion.plan.goal_motions import GoalRequest
from ocp.motion.plan.goal_plan import plan_to_goal
from ocp.motion.plan.planner import PlanOptions, checked_request, clearance_for, plan_request
from ocp.motion.result.segmented_plan import JUMP_TOLERANCE, Reconfiguration, SegmentedPlan, SequencePlan
from ocp.motion.result.solved_plan import SolvedPlan
from ocp.motion.search.configurations import PlanRequest, local_motions_from
from ocp.motion.search.held_joints import fix_ignorable_joints, hold_idle_joints, place_held_joints
from ocp.motion.search.task_search import TaskSearch
from ocp.motion.tasks.equations import TaskEquations, bind
from ocp.motion.tasks.goals import Cost, Goal, Scene, Start
from ocp.motion.tasks.limits import Limits
from ocp.motion.tasks.tip_task import TipTask, retime_task

AT_START = 1e-6
"""Largest pose error, m and rad, with which a configuration counts as being at the start of a task or at a goal."""


class _Junction(NamedTuple):
    """Configuration and joint velocities where two motions of a sequence meet; unknown joint positions are None."""

    joints: Array | None
    base: Array
    rates: Any

    @classmethod
    def end_of(cls, plan: SolvedPlan, smooth: bool) -> _Junction:
        """Return the state at the end of a plan, with zero velocities unless these must be continuous (`smooth`)."""
        at = plan.at(plan.horizon)
        return cls(at["joints"], at.get("base", np.zeros(0)), _junction_velocity(at["rates"], smooth))


def _junction_velocity(rates: Array, smooth: bool) -> Any:
    """Return the joint velocity to keep where motions meet; "rest" if it is zero or need not be kept (not `smooth`)."""
    return rates if smooth and np.abs(rates).max(initial=0.0) > JUMP_TOLERANCE else "rest"


def plan_consecutive(
    machine: Machine,
    tasks: Sequence[Goal | TipTask | Sequence[TipTask]],
    horizon: Literal["free"] | None,
    options: PlanOptions,
    *,
    scene: Scene | Literal[False] | None,
) -> SequencePlan:
    """Plan motions to goals and motions along tasks, one after the other.

    Tasks that are done at once form a sequence of their own. The start may be None if the first motion is along a task.
    The tasks and goals state their durations unless the horizon is "free".

    Raises:
        ProblemError: The parts cannot be planned in sequence; names the part. Or as `plan` for each part.
        SolveError: A part has no motion; names the part.
    """
    return _Sequence(checked_motors("plan", machine), tuple(tasks), horizon, options, scene).plan()


@dataclass(eq=False)
class _Sequence:
    """Planner of a sequence of motions, with the plans so far and the configuration and rates at their end."""

    machine: Machine
    parts: tuple[Any, ...]
    horizon: Literal["free"] | None
    options: PlanOptions
    scene: Scene | Literal[False] | None
    state: _Junction = field(init=False)
    plans: list[SolvedPlan] = field(default_factory=list)
    names: list[str] = field(default_factory=list)

    def __post_init__(self) -> None:
        known = isinstance(self.parts[0], Goal)
        start, joints, base = Start.of(self.options.start, self.machine, known=known)
        self.state = _Junction(joints, base, start.velocity)

    @property
    def smooth(self) -> bool:
        """Whether joint rates must be continuous, because actuator quantities are limited or contribute to the cost."""
        limits, cost = self.options.limits or Limits(), self.options.cost
        return limits_actuators(limits) or (cost is not None and weights_actuators(cost))

    def plan(self) -> SequencePlan:
        """Plan the motions to all goals and along all tasks of the sequence, one after the other."""
        next_plan: SolvedPlan | None = None  # of the next tasks, if the goal before them leads to their start
        for number, (part, following) in enumerate(zip_longest(self.parts, self.parts[1:]), 1):
            if isinstance(part, Goal):
                name = part.name or f"goal {number}"
                if following is not None and not isinstance(following, Goal) and not self.machine.base_size:
                    with _errors_named_after(f"task {number + 1}"):
                        next_plan = self._plan_tasks(following, self._joints_near(part))
                    part = _with_next_start(self.machine, part, next_plan, self.smooth)
                with _errors_named_after(name):
                    self._append(self._plan_goal(part), name)
                continue
            with _errors_named_after(f"task {number}"):
                plan = next_plan or self._plan_tasks(part, self.state.joints)
            with _errors_named_after(f"approach to task {number}"):
                plan = self._with_approach(plan, part, f"approach to task {number}")
            self._append(plan, f"task {number}")
            next_plan = None
        return SequencePlan(self.plans[0].machine, tuple(self.plans), tuple(self.names), self.smooth)

    def _append(self, plan: SolvedPlan, name: str) -> None:
        self.plans.append(plan)
        self.names.append(name)
        self.state = _Junction.end_of(plan, self.smooth)

    def _joints_near(self, goal: Goal) -> Array | None:
        """Return the joint positions of a goal, with current positions for the joints that the goal leaves open."""
        if goal.joints is None or self.state.joints is None:
            return self.state.joints
        joints = floats(goal.joints).ravel()
        if joints.shape != self.state.joints.shape:
            return None
        return np.where(np.isnan(joints), self.state.joints, joints)

    def _plan_goal(self, goal: Goal) -> SolvedPlan:
        """Plan the motion to a goal from the configuration at which the previous motion of the sequence ends."""
        own = self.machine if goal.machine is None else checked_motors("goal: machine", goal.machine)
        if own.robot.joint_names != self.machine.robot.joint_names:
            words = "all machines of a sequence need the joints of the first one"
            raise ProblemError(words, name="machine", value=own.robot.joint_names, limit=self.machine.robot.joint_names)
        if own is not self.machine and not isinstance(self.state.rates, str):
            raise ProblemError("a load is picked up or put down at rest", name="machine", value=goal.machine)
        self.machine = own
        start = Start(self.state.joints, self.state.base if own.base_size else None, self.state.rates)
        options = replace(self.options, start=start)
        return plan_goal(own, replace(goal, machine=None), self.horizon, options, constraints=self._constraints())

    def _plan_tasks(self, tasks: Any, near: Array | None) -> SolvedPlan:
        """Return the motion along tasks from the configuration `near` or, if the tasks start elsewhere, from any start.

        A start configuration counts as better than another if the motion from `near` to it costs less.
        """
        machine, start = self.machine, None
        if machine.base_size or (near is not None and _is_at_start(machine, tasks, near)):
            start = Start(near, self.state.base if machine.base_size else None)
        checked = checked_request(machine, tasks, self.horizon, replace(self.options, start=start))
        checked = replace(checked, clearance_constraints=self._constraints())
        if start is None and near is not None:
            if checked.search != "global":  # its bound is that of the task alone
                checked = replace(checked, near=near)
            idle = bind(machine, checked.tasks).idle
            names = np.array(machine.robot.joint_names)[idle].tolist()
            checked = checked.with_held(dict(zip(names, near[idle].tolist(), strict=True)))
        return plan_request(checked)

    def _with_approach(self, plan: SolvedPlan, tasks: Any, name: str) -> SolvedPlan:
        """Add an approach motion to the sequence if the start of a task requires it; return the plan along the task."""
        state, first = self.state, plan.at(0.0)
        if state.joints is None:
            return plan
        rates = _junction_velocity(first["rates"], self.smooth)
        if np.abs(first["joints"] - state.joints).max() <= JUMP_TOLERANCE:
            jump = np.abs(_velocity_array(rates, first) - _velocity_array(state.rates, first)).max()
            if not self.smooth or jump <= JUMP_TOLERANCE:
                return plan
            fastest = int(np.abs(first["rates"]).argmax())
            words = f"its joints move where it begins, {self.machine.robot.joint_names[fastest]!r} at "
            words += f"{first['rates'][fastest]:.4g}, but the machine arrives there at another velocity; let the task "
            words += "begin at rest, give the goal before it velocity='free', or place that goal before the task"
            raise ProblemError(words, name="velocity", value=state.rates, limit=first["rates"], time=0.0)
        approach = self._plan_goal(Goal(joints=first["joints"], velocity=rates))
        self._append(approach, name)
        joints = approach.at(approach.horizon)["joints"]
        turned = np.abs(joints - first["joints"]).max() > JUMP_TOLERANCE  # unlimited joints, by full turns
        return self._plan_tasks(tasks, joints) if turned else plan

    def _constraints(self) -> ClearanceConstraints | None:
        """Return the clearance constraints of the machine in its scene; raise ProblemError if an obstacle moves."""
        words = "obstacles of a sequence may not move, since it is not known when each part begins"
        return clearance_for(self.machine, self.options.limits, self.scene, why_static=words)


def _is_at_start(machine: Machine, tasks: Any, joints: Array) -> bool:
    """Return whether a configuration satisfies the tasks at their start; velocity tasks may start anywhere."""
    first = [task for task in ((tasks,) if isinstance(tasks, TipTask) else tasks) if not task.begin]
    return _largest_pose_error(bind(machine, first), joints) <= AT_START if first else True


def _largest_pose_error(equations: TaskEquations, joints: Array) -> float:
    """Return the largest error of the poses that tasks require at time 0, m or rad; 0 for an axis inside its cone."""
    at: tuple[Any, ...] = np.zeros(1), None, joints[None]
    errors = equations.errors(*at), equations.cone_violations(*at)
    return max(float(np.abs(each).max(initial=0.0)) for each in errors)


def _with_next_start(machine: Machine, goal: Goal, plan: SolvedPlan, smooth: bool) -> Goal:
    """Return a goal with the joint positions at the start of the next task's plan, or the old goal if these miss it."""
    first = plan.at(0.0)
    if goal.region is not None or (
        goal.has_pose and _largest_pose_error(bind(machine, goal.task), first["joints"]) > AT_START
    ):
        return goal
    apart = 0.0 if goal.has_pose else float(np.nanmax(np.abs(floats(goal.joints).ravel() - first["joints"])))
    if not apart <= JUMP_TOLERANCE:
        return goal
    passes = isinstance(goal.velocity, str) and goal.velocity == "free"
    velocity = _junction_velocity(first["rates"], smooth) if passes else goal.velocity
    return replace(with_joints(goal, first["joints"]), velocity=velocity)


def _velocity_array(velocity: Any, like: Mapping[str, Array]) -> Array:
    """Return a joint velocity, given as numbers or as "rest", as an array; "rest" is zero."""
    return np.zeros_like(like["rates"]) if isinstance(velocity, str) else floats(velocity)


@contextmanager
def _errors_named_after(part: str) -> Iterator[None]:
    """Add the name of a motion of a sequence to the text of errors that are raised inside a `with` block."""
    try:
        yield
    except (ProblemError, SolveError) as error:
        error.args = (f"{part}: {error}",)
        raise


def plan_in_segments(
    machine: FixedBase,
    tasks: TipTask | Sequence[TipTask],
    horizon: Any,
    options: PlanOptions,
    *,
    scene: Scene | Literal[False] | None,
) -> SegmentedPlan:
    """Plan tasks in the fewest segments, at the least cost; the arm reconfigures between segments.

    If one motion does the tasks, there is one segment, the plan of `plan(..., search="global")`. Else the tasks are
    divided at time samples, refined to a thousandth of the horizon where that may save a segment. Among divisions into
    the fewest segments, the one whose segments cost least is chosen; reconfigurations cost nothing.

    The tasks are poses that leave at most two degrees of freedom undetermined. Actuator limits do not influence the
    division, but the segments are planned within them. Obstacles are static, since a reconfiguration takes time.

    Raises:
        ProblemError: As in `plan`; or an obstacle moves.
        DeadEnd: At some time no motion does the tasks even for the shortest while, in any configuration.
        SolveError: No segment could be planned, however the tasks were divided.
    """
    request = checked_request(machine, tasks, horizon, replace(options, search="global"))
    words = "moving obstacles do not wait while the arm reconfigures; give static obstacles"
    constraints = clearance_for(machine, options.limits, scene, why_static=words)
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
    """Plan the part of the tasks between two times as one segment."""
    tasks = tuple(part for task in request.tasks if (part := _task_between(task, begin, end)) is not None)
    stretches = stretches_of(request.machine, tasks, end - begin)
    start = request.start if begin == 0 else None
    return plan_request(replace(request, tasks=tasks, horizon=end - begin, stretches=stretches, start=start))


def _task_between(task: TipTask, begin: float, end: float) -> TipTask | None:
    """Return the part of a task between two times, as a task that starts at time 0; None if this part is empty."""
    first, last = max(task.begin, begin), min(task.end, end)
    if last <= first:
        return None
    shift, breaks = first - task.begin, np.asarray(task.breaks)
    inside = breaks[(breaks > shift) & (breaks < last - task.begin)] - shift
    shifted = (
        replace(task, breaks=()) if shift == 0 else retime_task(replace(task, breaks=()), lambda time: time + shift)
    )
    return replace(shifted, begin=first - begin, duration=last - first, breaks=inside)


def _plan_reconfiguration(request: PlanRequest, time: float, before: Array, after: Array) -> Reconfiguration:
    """Plan a collision-free motion between two configurations of all joints; the result says why if none is found."""
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
        return Reconfiguration(time, before, after, None, str(error).split("\n")[0])
    return Reconfiguration(time, before, after, motion)
