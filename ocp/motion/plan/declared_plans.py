"""Plans from one optimal control problem: goals in sequence, tasks of a standing machine, steps, captures."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np

from models import Box, FixedBase, FreeFloating, Machine, Sphere, Stance, Standing
from models.checks import Array, floats
from models.machines.machine import Wrenches
from ocp.console import time_left
from ocp.errors import ProblemError, SolveError, require
from ocp.motion.builders.clearance import ClearanceConstraints
from ocp.motion.builders.dynamics import DynamicsSetup, checked_motors
from ocp.motion.builders.dynamics_plan import (
    POINTS,
    SolveSettings,
    dynamics_phases,
    machines_of,
    phase_names,
    within_limits,
)
from ocp.motion.builders.space.capture import Capture, solve_capture
from ocp.motion.builders.standing.plan import solve_standing, solve_steps
from ocp.motion.builders.standing.problem import StandingSetup, Weights
from ocp.motion.builders.standing.stances import Steps
from ocp.motion.local.inverse_kinematics import IkOptions, Unreachable, inverse_kinematics
from ocp.motion.plan.candidate_queue import CandidateQueue, Solver
from ocp.motion.plan.goal_motions import GoalRequest
from ocp.motion.plan.goal_plan import plan_to_goal
from ocp.motion.plan.planner import PlanOptions
from ocp.motion.result.candidate import Candidate, Reason, Rejection, Stage
from ocp.motion.result.solved_plan import Part, PhasedPlan, SolvedPlan
from ocp.motion.search.configurations import PlannerSettings
from ocp.motion.tasks.checks import are_at_rest, clip_to_limits, horizon_of
from ocp.motion.tasks.equations import bind
from ocp.motion.tasks.goals import Cost, Goal, Start
from ocp.motion.tasks.limits import Limits
from ocp.motion.tasks.tip_task import TipTask
from ocp.motion.tasks.tracks import on_symbols
from ocp.problem.problem import Problem
from ocp.solution import Solution

PHASE_INTERVALS = 40
"""Number of intervals of the first mesh, summed over all phases; no phase gets more than a single motion would."""
REGION_SAMPLES, REGION_STARTS = 8, 16
"""Number of random tip positions in the region of a goal, besides its centre, and of IK samples at each position."""


def plan_sequence(
    machine: Machine,
    goals: Sequence[Goal],
    total: float | None,
    options: PlanOptions,
    *,
    constraints: ClearanceConstraints | None,
) -> PhasedPlan:
    """Plan motions to consecutive goals as the phases of one problem, which minimises their total cost.

    A pose is reached in the configuration that is nearest to the goal before it. Each goal has a duration in s, or
    FreeTime(...), and may have its own machine with the same joints. `total` is the duration of all of them together,
    s, if some are free; None leaves it free. The cost is that of the squared torques by default, and the robot's own
    torque limits hold beside the limits of the options.

    Raises:
        ProblemError: As `dynamics_phases`; or the start is missing.
        SolveError: No motion satisfies its limits.
    """
    motors, goals = checked_motors("plan", machine), require.each("goals", goals, Goal)
    state, joints, base = Start.of(options.start, motors, known=True)
    own_limits = Limits() if options.limits is None else require.instance("limits", options.limits, Limits)
    cost = None if options.cost is None else require.instance("cost", options.cost, Cost)
    if len(goals) == 1 and goals[0].duration is None:  # one motion has the horizon
        goals, total = [replace(goals[0], duration=total)], None
    near, resolved = joints, list[Goal]()
    for goal in goals:
        if goal.has_pose:
            own = goal.machine or motors
            near = goal_configurations(own, goal, near, limits=own_limits, constraints=None, seed=options.seed)[0]
            goal = with_joints(goal, near)
        elif goal.joints is not None:
            near = np.where(np.isnan(np.asarray(goal.joints, dtype=float)), near, goal.joints)
        resolved.append(goal)
    machines = machines_of(motors, resolved)  # checks them before anything is solved
    smooth = own_limits.jerk is not None or (cost is not None and bool(cost.jerk))
    control: Literal["acceleration", "jerk"] = "jerk" if smooth else "acceleration"
    setup = DynamicsSetup(start_velocity=state.velocity, start_base=base, control=control)

    def declare(clearance: ClearanceConstraints | None) -> Problem:
        own = replace(setup, clearance_constraints=clearance)
        return dynamics_phases(motors, resolved, start=joints, total=total, limits=own_limits, cost=cost, setup=own)

    limited = {name: (each, own_limits) for name, each in zip(phase_names(resolved), machines, strict=True)}
    mesh = replace(POINTS, intervals=min(POINTS.intervals, -(-PHASE_INTERVALS // len(resolved))))
    solution = within_limits(declare, constraints, limited, settings=SolveSettings(mesh))
    return _plan_of_phases(motors, solution, joints)


def plan_goal(
    machine: Machine, goal: Goal, horizon: Any, options: PlanOptions, *, constraints: ClearanceConstraints | None
) -> SolvedPlan:
    """Plan the motion to one goal: around obstacles or, if the goal has its own tasks or machine, as a single phase.

    A goal that is only a target has another default cost than `plan_sequence`: the squared joint velocities, and also
    the time if the horizon, s, is "free". A horizon of None is the duration of the goal.

    Raises:
        ProblemError, SolveError: As `plan_to_goal` or `plan_sequence`.
    """
    if not (isinstance(machine, FixedBase) and has_only_target(goal)):
        return plan_sequence(machine, (goal,), horizon, options, constraints=constraints)
    state, joints, _ = Start.of(options.start, machine, known=True)
    limits = Limits() if options.limits is None else require.instance("limits", options.limits, Limits)
    is_free = isinstance(horizon, str)
    if is_free:
        require.choice("horizon", horizon, ("free",))
    cost = Cost(time=float(is_free)) if options.cost is None else require.instance("cost", options.cost, Cost)
    goals = goal_configurations(machine, goal, joints, limits=limits, constraints=constraints, seed=options.seed)
    request = GoalRequest(
        machine, joints, goals, goal.duration if horizon is None or is_free else horizon, limits, cost,
        start_velocity=state.velocity, end_velocity=goal.velocity, clearance_constraints=constraints,
        seed=options.seed, time_limit=time_left() if np.isfinite(time_left()) else None,
    )  # fmt: skip
    return plan_to_goal(request)


def has_only_target(goal: Goal) -> bool:
    """Return whether a goal is only a target, without tasks, another machine (load) or base pose of its own."""
    has_tasks = not (isinstance(goal.tasks, Sequence) and not goal.tasks)
    return not has_tasks and goal.machine is None and goal.base is None


def plan_steps(machine: Machine, steps: Steps, options: PlanOptions) -> PhasedPlan:
    """Plan the motion of a standing machine that makes given footsteps, as one optimal control problem with phases.

    The machine is that of the first stance, `steps.stances[0]`, and the start is in the order of its joints.

    Raises:
        ProblemError: As `steps_problem`; or the machine is not that of the first stance.
        SolveError: As `solve_steps`.
    """
    stance = steps.stances[0]
    if not isinstance(machine, Stance) or machine.robot.joint_names != stance.robot.joint_names:
        words = "steps begin in their first stance: give plan(steps.stances[0], steps, start=...)"
        raise ProblemError(words, name="machine", value=machine)
    joints = Start.of(options.start, stance, known=True)[1]
    begin = steps.in_order(stance, joints[None])[0]
    return _plan_of_phases(stance, solve_steps(steps, start=begin, cost=options.cost, limits=options.limits), joints)


def plan_capture(
    machine: Machine, capture: Capture, options: PlanOptions, *, constraints: ClearanceConstraints | None
) -> PhasedPlan:
    """Plan the capture of a tumbling body by a free-floating chaser, as one optimal control problem with two phases.

    Raises:
        ProblemError: As `capture_problem`.
        SolveError: No motion satisfies its limits.
    """
    chaser = require.instance("machine", machine, FreeFloating)
    setup: dict[str, Any] = {"cost": options.cost, "limits": options.limits, "clearance_constraints": constraints}
    solution = solve_capture(chaser, capture, start=options.start, **setup)
    return _plan_of_phases(chaser, solution, Start.of(options.start, chaser, known=True)[1])


def with_joints(goal: Goal, joints: Array) -> Goal:
    """Return the goal with its pose replaced by a joint configuration."""
    no_pose: dict[str, Any] = dict.fromkeys(("tip", "position", "orientation", "direction", "within", "region"))
    return replace(goal, joints=joints, **no_pose)


def _plan_of_phases(machine: Machine, solution: Solution, start: Array) -> PhasedPlan:
    """Convert the solution of a problem with phases to a plan, whose only candidate starts at `start`."""
    candidate = Candidate(start, solution.cost, None, Stage.AUDITED, solution)
    parts = tuple(Part(begin, end, name) for name, (begin, end) in solution.phases.items())
    return PhasedPlan(machine, solution, parts, (candidate,))


def goal_configurations(
    machine: Machine, goal: Goal, near: Array, *, limits: Limits, constraints: ClearanceConstraints | None, seed: int
) -> Array:
    """Return configurations that satisfy a goal, sorted by distance from `near`. Shape (K, n).

    They are within the joint limits and, at a pose, collision-free. The tip of a goal with a region is at the centre of
    the region, and at random places in it. Joints that do not move the tip stay where they are in `near`, (n,).

    Raises:
        Unreachable, ProblemError: As `inverse_kinematics`; or the joints of the goal do not fit, see `clip_to_limits`.
    """
    bounds = limits.bounds(machine)
    if not goal.has_pose:
        if goal.joints is None:
            raise ProblemError("a goal needs joints or a pose", name="joints", value=None)
        values = require.array("goal", np.nan_to_num(floats(goal.joints)), (len(near),), meaning="one for each joint")
        joints = np.where(np.isnan(floats(goal.joints).ravel()), near, values)
        return clip_to_limits(machine, joints, bounds.lower, bounds.upper, label="end")[None]
    scene, options = None if constraints is None else constraints.scene, IkOptions(limits=limits.joints)
    tasks = [goal.task, *(replace(goal.task, position=point) for point in _points_inside(goal.region, seed))]
    samples = {} if goal.region is None else {"starts": REGION_STARTS}
    solutions, error = list[Array](), None
    for task in tasks:
        try:
            members = inverse_kinematics(machine, task, **samples, near=near, seed=seed, scene=scene, options=options)
        except Unreachable as unreachable:
            error = error or unreachable
            continue
        idle = bind(machine, task).idle
        solutions += [np.where(idle, near, solution.joints) for solution in members]
    if not solutions:
        assert error is not None
        raise error
    order = np.argsort([float(np.linalg.norm(joints - near)) for joints in solutions], kind="stable")
    return np.array(solutions)[order]


def _points_inside(region: Box | Sphere | None, seed: int) -> Array:
    """Return random points inside the region of a goal in the world frame. Shape (K, 3), m; K = 0 without a region."""
    if region is None:
        return np.zeros((0, 3))
    center: Array = np.array(region.position, dtype=float)
    rng = np.random.default_rng(seed)
    if isinstance(region, Box):
        inside = (rng.random((REGION_SAMPLES, 3)) - 0.5) * np.asarray(region.size)
        return np.asarray(center + inside @ np.asarray(region.rotation, dtype=float).T)
    directions = rng.normal(size=(REGION_SAMPLES, 3))
    radii = float(region.radius) * np.cbrt(rng.random((REGION_SAMPLES, 1)))
    return np.asarray(center + radii * directions / np.linalg.norm(directions, axis=1, keepdims=True))


def plan_to_stand(
    machine: Standing,
    tasks: TipTask | Sequence[TipTask],
    horizon: Any,
    options: PlanOptions,
    *,
    constraints: ClearanceConstraints | None,
    wrenches: Wrenches,
) -> SolvedPlan:
    """Plan a motion of a standing machine that satisfies the tasks and keeps the zero moment point inside the foot.

    The joints start and end at rest if their tasks do; else they may move there. Candidates start from every
    configuration that inverse kinematics finds and that stands; with search "start", from the best conditioned one that
    leads to a plan.

    Raises:
        ProblemError: A cyclic motion, tasks that are active only a part of the time, a horizon that is no number, or as
            in `solve_standing`.
        SolveError: No start leads to a plan that passes its audit.
    """
    start, limits, cost = options.start, options.limits, options.cost
    if options.cyclic:
        words = "a standing motion cannot be cyclic; declare standing_problem with StandingSetup(end=...)"
        raise ProblemError(words, name="cyclic", value=options.cyclic)
    if cost is not None:
        require.instance("cost", cost, Weights)
    equations = bind(machine, tasks)
    all_tasks = [part.task for part in equations.bound]
    duration = horizon_of(all_tasks, horizon)
    for number, task in enumerate(all_tasks):
        if task.begin > 0 or task.end < duration * (1 - 1e-9):
            words = f"task {number} lasts from {task.begin:g} to {task.end:g} s, not for the whole standing motion"
            raise ProblemError(words, name=f"task {number}", value=(task.begin, task.end), limit=(0.0, duration))

    def accepted(symbols: Any) -> Any:
        equations.targets(symbols.sym("time"))
        return symbols

    setup = StandingSetup(
        start_velocity="rest" if are_at_rest(equations, 0.0) else "free",
        end_velocity="rest" if are_at_rest(equations, duration) else "free",
        wrenches=wrenches,
        clearance_constraints=constraints,
        symbols=on_symbols(accepted),
    )
    arguments: dict[str, Any] = {"weights": cost, "limits": limits, "setup": setup}
    solver = _StandingSolver(machine, all_tasks, duration, arguments, start is not None)
    queue = CandidateQueue(solver, PlannerSettings())
    seeds = [Candidate(joints) for joints in _start_configurations(machine, all_tasks, start, limits, options.seed)]
    for batch in [[candidate] for candidate in seeds] if options.search == "start" else [seeds]:
        queue.run(batch)
        if queue.passed:
            break
    return queue.plan()


@dataclass
class _StandingSolver(Solver):
    """Solver of the candidate motions of a standing machine; `solve_standing` solves and audits each in one stage."""

    machine: Standing
    tasks: list[TipTask]
    duration: float
    options: dict[str, Any]
    start_is_fixed: bool

    def advance(self, candidate: Candidate) -> list[Candidate]:
        """Solve and audit a candidate; return the candidate as audited or rejected.

        Raises:
            ProblemError, SolveError: The only start is given, and no motion was found from it.
        """
        try:
            solution = solve_standing(self.machine, self.tasks, self.duration, start=candidate.start, **self.options)
        except (ProblemError, SolveError) as error:
            if self.start_is_fixed:
                raise
            return [candidate.with_rejection(Reason.of_error(Rejection.INFEASIBLE, error))]
        return [replace(candidate, stage=Stage.AUDITED, cost=solution.cost, solution=solution)]

    def plan(self, candidates: Sequence[Candidate]) -> SolvedPlan:
        """Return the first candidate as a plan, which also lists the other candidates."""
        best = candidates[0].solution
        assert best is not None
        parts = (Part(0.0, self.duration, ""),)
        return SolvedPlan(self.machine, best, parts, tuple(candidates)).with_targets(self.tasks)


def _start_configurations(
    machine: Standing, tasks: list[TipTask], start: Any, limits: Limits | None, seed: int
) -> list[Array]:
    """Return the given start configuration or, without one, inverse kinematics solutions by decreasing quality."""
    if start is not None:
        return [start]
    poses = [task for task in tasks if task.is_pose]
    if not poses:
        words = "start is missing: no task gives the tip's pose at the start; give plan(..., start=...)"
        raise ProblemError(words, name="start")
    options = IkOptions(limits=limits is None or limits.joints)
    solutions = inverse_kinematics(machine, poses, seed=seed, options=options)
    return [solution.joints for solution in solutions]
