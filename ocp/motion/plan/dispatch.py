"""The function `plan` for all kinds of motions, which selects the planner for the given tasks and goals."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any, Literal, TypeAlias, get_args

import numpy as np

from models import FixedBase, FreeFloating, Machine, MovingObstacle, Standing
from models.checks import NOT_NUMBERS, check_entries
from models.shapes.shapes import checked_shape, enlarge_shape
from ocp.console import TimeLimitReached, interruptible, shown_progress, time_limited
from ocp.errors import ProblemError, SolveError, checked_time_limit, problem_errors, require
from ocp.motion.builders.clearance import ClearanceConstraints
from ocp.motion.builders.dynamics import DynamicsSetup, dynamics_problem
from ocp.motion.builders.dynamics_plan import dynamics_phases
from ocp.motion.builders.joint_motion import VelocitySetup, joint_motion_problem, minimum_velocity_problem
from ocp.motion.builders.space.capture import Capture, capture_problem
from ocp.motion.builders.standing.problem import FreeTime, StandingSetup, Weights, standing_problem
from ocp.motion.builders.standing.stances import Steps
from ocp.motion.builders.standing.steps import StepWeights, steps_problem
from ocp.motion.local.inverse_kinematics import LARGEST_SEED
from ocp.motion.plan.actuators import limits_actuators
from ocp.motion.plan.declared_plans import (
    has_only_target,
    plan_capture,
    plan_goal,
    plan_sequence,
    plan_steps,
    plan_to_stand,
)  # fmt: skip
from ocp.motion.plan.planner import PlanOptions, checked_request, clearance_for, plan_request
from ocp.motion.plan.sequence import plan_consecutive, plan_in_segments
from ocp.motion.plan.waypoints import plan_path
from ocp.motion.result.margin import LOADS, checked_uncertainty, tightened_torques
from ocp.motion.result.path_plan import PathPlan
from ocp.motion.result.plan import Plan
from ocp.motion.result.request import RESERVE, request_of
from ocp.motion.result.segmented_plan import ConsecutivePlans, SegmentedPlan, SequencePlan, solved_plan_of
from ocp.motion.tasks.goals import Cost, Goal, Scene, Start, Waypoints
from ocp.motion.tasks.limits import Limits
from ocp.motion.tasks.tip_task import TipTask
from ocp.problem.problem import Problem
from ocp.storage import read_arrays

MAX_TIGHTENINGS = 6
"""Largest number of motions that are planned, each with tighter torque limits, until one covers its uncertainties."""
Search: TypeAlias = Literal["start", "configurations", "global", "segments"]
Parts: TypeAlias = Sequence[Goal | TipTask | Sequence[TipTask]]
Tasks: TypeAlias = TipTask | Goal | Waypoints | Steps | Capture | Sequence[TipTask] | Sequence[Goal] | Parts


@interruptible
def plan(
    machine: Machine,
    tasks: Tasks,
    horizon: float | Literal["free"] | None = None,
    *,
    start: Any = None,
    cyclic: bool = False,
    cost: Cost | Weights | StepWeights | None = None,
    limits: Limits | None = None,
    scene: Scene | Literal[False] | None = None,
    search: Search = "configurations",
    seed: int = 0,
    time_limit: float | None = None,
    progress: Callable[[str], Any] | bool | None = None,
) -> Plan:
    """Plan the lowest-cost motion that satisfies the tasks, by default with the least integral of squared joint rates.

    Args:
        machine: A machine on a fixed or floating base, or standing, see `plan_to_stand`.
        tasks: Tasks of its tips, each from its `begin` for its `duration`; goals, which are reached one after the
            other; or waypoints, which an arm on a fixed base with at most two redundant joints passes by the shortest
            joint path. Goals and tasks in one sequence are done one after the other, tasks at once in an inner
            sequence, and a motion of its own leads to each task (see `plan.sequence`).
        horizon: s; None: until the last task ends. "free": the tasks may be done more slowly than they say, never
            faster; their pace is planned together with the self-motion, for the least sum of duration and joint rates.
        start: Joint positions at the start, rad or m, shape (n,), or a `Start` with the configuration of a floating
            base; None: any that satisfy the first tasks, which are searched. Joints that move no task frame, such as a
            gripper's, stay at rest there, or at the nearest free position, see `Plan.held`.
        cyclic: Whether the joints end where they start.
        cost: Weights of the cost. For tip tasks all its terms, the `time` only if the horizon is free (1 if `cost` is
            None), in (rad/s)^2: the larger, the closer to the least time. For waypoints,
            `length`, the sum of all joint displacements with the `weights` of the joints, or `time`, s, by the
            velocity limits. `Weights` for a standing machine. None: half the squared joint velocities, the length of a
            path through waypoints, the squared torques of a motion to several goals.
        limits: Limits of joint positions and rates; the robot's own if None. Limits of acceleration, jerk, torque or
            power, if given, hold at all times together with the robot's own torque limits, at the same cost (see
            `plan.actuators`). Rates are then continuous, and the joints rest at the start or the end if the tips do.
            With `robust`, the plan's margin covers these sizes: obstacles are enlarged by the sum of all misplacements,
            and torque limits are tightened until the torques that payload and friction add fit in.
        scene: Obstacles, the clearance that is kept from them and between links, and external wrenches; None: the links
            of the machine do not touch. False: collisions are not checked.
        search: "start": from the given start, or from the best conditioned solution of inverse kinematics.
            "configurations": from all solutions of inverse kinematics; each may slide along its self-motion.
            "global": among all motions in the tasks' own time. On a fixed base, the plan has a lower `bound`; the tasks
            must be poses. If they leave more than two degrees of freedom undetermined, joints that also carry another
            limb, such as a torso, are held at rest (see `search.search`). If there are none, motions from all solutions
            of inverse kinematics are compared, and the bound is loose (see `search.task_search.tool_rate_bound`). On a
            floating base, the motions come from a search over exact states without a bound (see `search.cells`), which
            also passes singularities.
            "segments": as "global"; if no single motion does the tasks, in the fewest segments, between which an arm on
            a fixed base moves to another configuration while the tasks wait.
        seed: Seed of all random numbers.
        time_limit: Seconds after which planning ends with a SolveError. None: no limit while motions are found,
            but if all motions fail, planning along tasks ends after about 20 s.
        progress: Function that is called with the name of each stage; True: a line shows it; False: nothing is shown;
            None: a line after two seconds on a terminal or in a notebook.

    Returns:
        The audited plan, with all other motions found, their costs and the reasons of their rejection.

    Raises:
        ProblemError: The request does not fit the machine or is contradictory. Its subclass Unreachable names the time
            and the place out of reach.
        SolveError: No motion passes its audit; names what happened to each candidate. Its subclass DeadEnd says where
            the motions of a global search end, what obstructs them, by how much the tasks would have to be relaxed, and
            in how few segments they may be done (search="segments").
    """
    require.choice("search", search, get_args(Search))
    require.flag("cyclic", cyclic)
    require.count("seed", seed, 0, LARGEST_SEED)
    with time_limited(checked_time_limit(time_limit)), shown_progress("plan", progress):
        try:
            options = PlanOptions(start, cyclic, cost, limits, search, seed)
            if isinstance(limits, Limits) and limits.robust is not None:
                return _plan_robustly(machine, tasks, horizon, scene, options)
            return _plan(machine, tasks, horizon, scene, options)
        except TimeLimitReached as error:
            if time_limit is None:  # that of an outer call
                raise
            words = f"no motion was found within the time limit of {time_limit:g} s; raise time_limit{error.advice}"
            tried = getattr(error.__cause__, "candidates", ())  # with the reasons of those that were tried in time
            raise SolveError(words, candidates=tried, name="time_limit", limit=time_limit) from error


def _plan(machine: Machine, tasks: Any, horizon: Any, scene: Any, options: PlanOptions) -> Plan:
    """Select the planner for the tasks, and call this planner with the arguments of `plan`."""
    cyclic = options.cyclic or None
    wrenches = scene.wrenches if isinstance(scene, Scene) else ()
    if wrenches and (not isinstance(machine, Standing) or isinstance(tasks, Steps)):
        words = "scene: wrenches act on a machine that stands and does tasks; for an arm on a fixed base, give them in "
        words += "DynamicsSetup(wrenches=...) of dynamics_problem"
        raise ProblemError(words, name="wrenches", value=wrenches)
    if isinstance(tasks, Waypoints):
        _check_unused("a path through waypoints", horizon=horizon, start=options.start, cyclic=cyclic)
        return plan_path(require.instance("machine", machine, FixedBase), tasks, options, scene=scene)
    if options.search == "segments":
        _check_unused("search='segments'", cyclic=cyclic)
        arm = require.instance("machine", machine, FixedBase)
        return plan_in_segments(arm, tasks, horizon, options, scene=scene)
    if isinstance(tasks, Steps):
        _check_unused("a walk, whose phases have durations", horizon=horizon, cyclic=cyclic)
        _check_unused("a walk, whose feet stand on footholds,", scene=scene or None)
        return plan_steps(machine, tasks, options)
    if _is_sequence(tasks):
        require.choice("horizon", horizon, ("free", None))
        _check_unused("a sequence of goals and tasks", cyclic=cyclic)
        return plan_consecutive(machine, tasks, horizon, options, scene=scene)
    constraints = clearance_for(machine, options.limits, scene)
    if isinstance(tasks, Capture):
        _check_unused("a capture, whose phases have durations", horizon=horizon, cyclic=cyclic)
        return plan_capture(machine, tasks, options, constraints=constraints)
    goals = (tasks,) if isinstance(tasks, Goal) else tasks
    if isinstance(goals, Sequence) and isinstance(next(iter(goals), None), Goal):
        _check_unused("a motion to goals", cyclic=cyclic)
        if len(goals) == 1:
            return plan_goal(machine, goals[0], horizon, options, constraints=constraints)
        moving = constraints is not None and constraints.scene.has_moving_obstacles
        is_open = horizon is None or (isinstance(horizon, str) and horizon == "free")
        if isinstance(machine, FixedBase) and is_open and not moving and _are_separate(goals):
            return plan_consecutive(machine, goals, horizon, options, scene=scene)
        return plan_sequence(machine, goals, horizon, options, constraints=constraints)
    if isinstance(machine, Standing):
        return plan_to_stand(machine, tasks, horizon, options, constraints=constraints, wrenches=wrenches)
    request = checked_request(machine, tasks, horizon, options)
    return plan_request(replace(request, clearance_constraints=constraints))


def _plan_robustly(machine: Machine, tasks: Any, horizon: Any, scene: Any, options: PlanOptions) -> Plan:
    """Plan with enlarged obstacles and tightened torque limits until the margin of the plan covers the uncertainties.

    Raises:
        SolveError: No such plan was found; names the limit that is violated first.
    """
    limits = replace(options.limits, robust=None)
    sizes = {name: size for name, size in checked_uncertainty(options.limits.robust).items() if size is not None}
    if isinstance(tasks, Waypoints) or not sizes:
        words = "limits: robust needs the sizes of uncertainties, and tasks with times; for a path through waypoints, "
        words += "add the misplacement of its obstacles to Scene(clearance=...)"
        raise ProblemError(words, name="robust", value=options.limits.robust)
    torque = limits.bounds(machine).torque
    reserve = {"distance": sum(size for name, size in sizes.items() if name not in LOADS), "torque": torque}
    if isinstance(scene, Scene) and reserve["distance"]:
        scene = _enlarge_obstacles(scene, reserve["distance"])
    tightened = torque
    for _ in range(MAX_TIGHTENINGS):
        own = limits if tightened is torque else replace(limits, torque=tightened)
        try:
            result = _plan(machine, tasks, horizon, scene, replace(options, limits=own))
        except SolveError as error:
            stricter = [f"obstacles enlarged by {reserve['distance']:g} m"] if reserve["distance"] else []
            stricter += [] if tightened is torque else [f"torque limits of {np.round(tightened, 4).tolist()}"]
            covered = ", ".join(f"{name} {size:g}" for name, size in sizes.items())
            words = f"no motion covers {covered}: with {' and '.join(stricter) or 'the limits as they are'}, "
            error.args = (f"{words}{error}",)
            raise
        parts = [piece.plan for piece in result.pieces] if isinstance(result, ConsecutivePlans) else [result]
        for problem in (part.solution.problem for part in parts):
            if (request := request_of(problem)) is not None:
                problem.origin = replace(request, arguments={**request.arguments, RESERVE: reserve})
        margin = result.margin(sizes)
        if margin.covers_stated:
            return result
        lower = tightened_torques(result, sizes)
        if not lower:
            break
        tightened = np.minimum(tightened, [lower.get(name, np.inf) for name in machine.robot.joint_names])
    words = f"no motion keeps all limits for the stated uncertainties: the best one found {margin.sentence}"
    raise SolveError(words, name=margin.factor.limit, value=margin.factor.size, limit=1.0, time=margin.factor.time)


def _enlarge_obstacles(scene: Scene, by: float) -> Scene:
    """Return a scene whose obstacles contain all points that are at most `by` (m) from the obstacles of this scene."""
    obstacles: Any = scene.obstacles if isinstance(scene.obstacles, list | tuple) else (scene.obstacles,)
    with problem_errors():
        enlarged = [
            replace(each, shape=enlarge_shape(each.shape, by))
            if isinstance(each, MovingObstacle)
            else enlarge_shape(checked_shape("scene: obstacle", each), by)
            for each in obstacles
        ]
    return replace(scene, obstacles=enlarged)


def _are_separate(goals: Sequence[Any]) -> bool:
    """Return whether motions to goals can be planned one by one, because the machine comes to rest between them."""
    each = [goal for goal in goals if isinstance(goal, Goal)]
    if len(each) < len(goals) or not all(map(has_only_target, each)):
        return False
    if any(isinstance(goal.duration, FreeTime) for goal in each):
        return False
    return all(isinstance(goal.velocity, str) and goal.velocity == "rest" for goal in each[:-1])


def _is_sequence(tasks: Any) -> bool:
    """Return whether the argument `tasks` lists consecutive motions: goals mixed with tasks, or several lists of tasks.

    If one of these motions is neither a goal nor tasks, raise ProblemError.
    """
    if not isinstance(tasks, Sequence) or isinstance(tasks, str):
        return False
    try:
        check_entries(tasks)
    except NOT_NUMBERS:
        return False  # refused as tasks
    goals = [isinstance(part, Goal) for part in tasks]
    if all(goals) or all(isinstance(part, TipTask) for part in tasks):
        return False
    if not any(goals) and not all(isinstance(part, TipTask | Sequence) for part in tasks):
        return False  # refused as tasks
    for number, part in enumerate(tasks, 1):
        each = part if isinstance(part, Sequence) and not isinstance(part, str) else (part,)
        if not each or not (isinstance(part, Goal) or all(isinstance(task, TipTask) for task in each)):
            words = f"part {number} of the sequence is neither a Goal nor TipTasks, but {part!r}; waypoints have no "
            words += "times: give a TipTask.along(smooth(path), speed) through them, or plan them alone"
            raise ProblemError(words, name=f"part {number}", value=part)
    return True


def _check_unused(reason: str, **arguments: Any) -> None:
    """Raise ProblemError if an argument that the selected planner does not use is not None."""
    for name, value in arguments.items():
        if value is not None:
            raise ProblemError(f"{reason} takes no {name}; leave it out", name=name, value=value)


def plan_problem(
    machine: Machine,
    tasks: TipTask | Goal | Steps | Capture | Sequence[TipTask] | Sequence[Goal],
    horizon: Any = None,
    *,
    start: Any = None,
    cyclic: bool = False,
    cost: Cost | Weights | StepWeights | None = None,
    limits: Limits | None = None,
    scene: Scene | Literal[False] | None = None,
) -> Problem:
    """Declare, but do not solve, the optimal control problem of `plan`; no start configurations are searched for.

    The clearance of the scene is proven by the audit of a solution, but no pair of bodies is separated yet, see
    `ClearanceConstraints.with_pairs`. A goal needs joint positions here, not a pose. Beside tip tasks, limits of
    actuators, a free horizon, and all terms of the cost but the squared joint velocities belong to `plan`.

    Args:
        machine, tasks, horizon, start, cyclic, cost, limits, scene: As in `ocp.plan`.

    Raises:
        ProblemError: As the builder of the problem; waypoints have no optimal control problem.
    """
    if isinstance(tasks, Waypoints):
        raise ProblemError("a path through waypoints has no optimal control problem", name="tasks", value=tasks)
    own: Any = cost
    if not isinstance(machine, FixedBase | FreeFloating):
        raise ProblemError(f"a machine is expected, not a {type(machine).__name__}", name="machine", value=machine)
    if limits is not None:
        require.instance("limits", limits, Limits)
    if isinstance(tasks, Steps):
        joints = Start.of(start, tasks.stances[0])[1]
        begin = None if joints is None else tasks.in_order(tasks.stances[0], joints[None])[0]
        return steps_problem(tasks, start=begin, cost=own, limits=limits)
    constraints = clearance_for(machine, limits, scene)
    shared: dict[str, Any] = {"limits": limits, "clearance_constraints": constraints}
    if isinstance(tasks, Capture):
        chaser = require.instance("machine", machine, FreeFloating)
        return capture_problem(chaser, tasks, start=start, cost=own, **shared)
    goals: Any = (tasks,) if isinstance(tasks, Goal) else tasks
    if isinstance(goals, Sequence) and isinstance(next(iter(goals), None), Goal):
        return _goal_problem(machine, goals, horizon, start=start, cost=own, **shared)
    _, joints, base = Start.of(start, machine)
    if isinstance(machine, Standing):
        wrenches = scene.wrenches if isinstance(scene, Scene) else ()
        setup = StandingSetup(wrenches=wrenches, clearance_constraints=constraints)
        options: dict[str, Any] = {"start": joints, "weights": own, "limits": limits, "setup": setup}
        return standing_problem(machine, goals, horizon, **options)
    own = Cost() if own is None else require.instance("cost", own, Cost)
    if own.terms != ("velocity",):
        words = f"cost: plan_problem weights the squared joint velocities of tip tasks alone, not {own}; use plan"
        raise ProblemError(words, name="cost", value=own)
    own_setup = VelocitySetup(start_base=base, clearance_constraints=constraints)
    weights = own.joint_weights(machine.joint_size)
    options = {"start": joints, "cyclic": cyclic, "weights": weights, "limits": limits, "setup": own_setup}
    return minimum_velocity_problem(machine, goals, horizon, **options)


def _goal_problem(
    machine: Any,
    goals: Sequence[Goal],
    horizon: Any,
    *,
    start: Any,
    cost: Cost | None,
    limits: Limits | None,
    clearance_constraints: ClearanceConstraints | None,
) -> Problem:
    """Declare the optimal control problem of a motion to one goal or several goals.

    On a fixed base, a motion to one goal has constant speed if only velocities are weighted and limited. Every other
    motion has continuous velocities.
    """
    state, joints, base = Start.of(start, machine)
    is_smooth = limits is not None and limits_actuators(limits)
    is_smooth = is_smooth or (cost is not None and cost.terms != ("velocity",))
    control: Literal["acceleration", "jerk"] = "acceleration" if limits is None or limits.jerk is None else "jerk"
    setup = DynamicsSetup(
        start_velocity=state.velocity,
        start_base=base if machine.base_size else None,
        control=control,
        clearance_constraints=clearance_constraints,
    )
    options: dict[str, Any] = {"start": joints, "limits": limits, "cost": cost}
    if len(goals) > 1:
        return dynamics_phases(machine, goals, total=horizon, setup=setup, **options)
    goal = goals[0]
    duration = goal.duration if horizon is None else horizon
    if goal.has_pose:
        words = "a pose needs joints here; inverse_kinematics(machine, goal.task) finds some"
        raise ProblemError(words, name="joints", value=None)
    if isinstance(machine, FixedBase) and not is_smooth:
        weights = (cost or Cost()).joint_weights(machine.joint_size)
        ends: dict[str, Any] = {"start": joints, "end": goal.joints, "limits": limits, "weights": weights}
        return joint_motion_problem(machine, duration, clearance_constraints=clearance_constraints, **ends)
    setup = replace(setup, end_velocity=goal.velocity, end_base=goal.base)
    return dynamics_problem(machine, goal.tasks, duration, end=goal.joints, setup=setup, **options)


def load_plan(path: str | os.PathLike[str]) -> Plan:
    """Read a plan of any kind from a file that `Plan.save` has written."""
    arrays = read_arrays(path)
    if "path" in arrays:
        return PathPlan.of_arrays(path, arrays)
    for kind in (SegmentedPlan, SequencePlan):
        if kind.kind in arrays:
            return kind.of_arrays(path, arrays)
    return solved_plan_of(path, arrays)
