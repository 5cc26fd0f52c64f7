"""Configurations at goals, and motions of several phases: goals one after the other, steps, the capture of a body."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, Literal

import numpy as np

from models import Box, FixedBase, FreeFloating, Machine, Sphere, Stance
from models.checks import Array, floats
from ocp.console import report, time_left
from ocp.errors import ProblemError, require
from ocp.motion.builders.clearance import ClearanceConstraints
from ocp.motion.builders.dynamics import DynamicsSetup
from ocp.motion.builders.dynamics_plan import (
    POINTS,
    SolveSettings,
    dynamics_phases,
    machines_of,
    phase_names,
    within_limits,
)
from ocp.motion.builders.space.capture import Capture, solve_capture
from ocp.motion.builders.standing.plan import solve_steps
from ocp.motion.builders.standing.stances import Steps
from ocp.motion.builders.standing.steps import StepWeights
from ocp.motion.builders.torques import checked_motors
from ocp.motion.local.inverse_kinematics import IkOptions, Unreachable, inverse_kinematics
from ocp.motion.plan.goal_motions import GoalRequest
from ocp.motion.plan.goal_plan import plan_to_goal
from ocp.motion.result.candidate import Candidate, Stage
from ocp.motion.result.solved_plan import PhasedPlan, SolvedPlan, parts_of_phases
from ocp.motion.tasks.checks import clip_to_limits
from ocp.motion.tasks.equations import bind
from ocp.motion.tasks.goals import Cost, Goal, Start
from ocp.motion.tasks.limits import Limits
from ocp.problem.problem import Problem
from ocp.solution import Solution

__all__ = ["goal_configurations", "plan_capture", "plan_goal", "plan_sequence", "plan_steps", "with_joints"]

PHASE_INTERVALS = 40
"""Intervals of the first mesh of all phases together; one phase begins with no more than a motion of its own."""
REGION_SAMPLES = 8
"""Random places of the tip in the region of a goal, besides its centre."""


def plan_sequence(
    machine: Machine,
    goals: Sequence[Goal],
    total: float | None,
    *,
    start: Any,
    cost: Cost | None,
    limits: Limits | None,
    constraints: ClearanceConstraints | None,
    seed: int,
) -> PhasedPlan:
    """Plan motions to consecutive goals as the phases of one problem, which minimises their total cost.

    A pose is reached in the configuration that is nearest to the goal before it.

    Args:
        machine: Arm on a fixed or floating base; each goal may have its own, with the same joints.
        goals: The goals, each with a duration in s, or FreeTime(...).
        total: Duration of all of them together, s, if some are free; None leaves it free.
        start: Joints at the start, or a `Start`.
        cost: Weights of the cost; the squared torques if None.
        limits: Limits of joints and actuators, the robot's own torque limits included.
        constraints: Clearance constraints, or None.
        seed: Seed of inverse kinematics.

    Raises:
        ProblemError: As `dynamics_phases`; or the start is missing.
        SolveError: No motion satisfies its limits.
    """
    motors, goals = checked_motors("plan", machine), require.each("goals", goals, Goal)
    state, joints, base = Start.of(start, motors)
    if joints is None:
        raise ProblemError("start is missing: a goal is reached from somewhere; give plan(..., start=)", name="start")
    own_limits = Limits() if limits is None else require.instance("limits", limits, Limits)
    own_cost = None if cost is None else require.instance("cost", cost, Cost)
    if len(goals) == 1 and goals[0].duration is None:  # one motion has the horizon
        goals, total = [replace(goals[0], duration=total)], None
    near, resolved = joints, list[Goal]()
    for goal in goals:
        if goal.has_pose:
            near = nearest_configuration(goal.machine or motors, goal, near, limits=own_limits, seed=seed)
            goal = with_joints(goal, near)
        elif goal.joints is not None:
            near = np.where(np.isnan(np.asarray(goal.joints, dtype=float)), near, goal.joints)
        resolved.append(goal)
    machines = machines_of(motors, resolved)  # checks them before anything is solved
    smooth = own_limits.jerk is not None or (own_cost is not None and bool(own_cost.jerk))
    control: Literal["acceleration", "jerk"] = "jerk" if smooth else "acceleration"
    setup = DynamicsSetup(start_velocity=state.velocity, start_base=base, control=control)

    def declare(clearance: ClearanceConstraints | None) -> Problem:
        own = replace(setup, clearance_constraints=clearance)
        return dynamics_phases(motors, resolved, start=joints, total=total, limits=own_limits, cost=cost, setup=own)

    limited = {name: (each, own_limits) for name, each in zip(phase_names(resolved), machines, strict=True)}
    mesh = replace(POINTS, intervals=min(POINTS.intervals, -(-PHASE_INTERVALS // len(resolved))))
    solution = within_limits(declare, constraints, limited, settings=SolveSettings(mesh))
    return _phased(motors, solution, joints)


def plan_goal(
    machine: Machine,
    goal: Goal,
    horizon: Any,
    *,
    start: Any,
    cost: Cost | None,
    limits: Limits | None,
    constraints: ClearanceConstraints | None,
    seed: int,
) -> SolvedPlan:
    """Plan the motion to one goal: around obstacles, or as one phase of a problem with its own tasks and machine.

    Args:
        machine: Arm on a fixed or floating base.
        goal: The goal.
        horizon: s, "free", or None for the duration of the goal.
        start, cost, limits, constraints, seed: As in `plan_sequence`.

    Raises:
        ProblemError, SolveError: As `plan_to_goal` or `plan_sequence`.
    """
    options: dict[str, Any] = {"start": start, "cost": cost, "limits": limits, "constraints": constraints, "seed": seed}
    if isinstance(machine, FixedBase) and _has_only_target(goal):
        return plan_to_goal(_goal_request(machine, goal, horizon, **options))
    return plan_sequence(machine, (goal,), horizon, **options)


def _has_only_target(goal: Goal) -> bool:
    """Return whether a goal is only a target: without tasks on the way, and without change of machine or base."""
    has_tasks = not (isinstance(goal.tasks, Sequence) and not goal.tasks)
    return not has_tasks and goal.machine is None and goal.base is None


def _goal_request(
    machine: FixedBase,
    goal: Goal,
    horizon: Any,
    *,
    start: Any,
    cost: Cost | None,
    limits: Limits | None,
    constraints: ClearanceConstraints | None,
    seed: int,
) -> GoalRequest:
    """Return the request for a motion to one goal.

    Raises:
        ProblemError: The start is missing, or as in `goal_configurations`.
    """
    state, joints, _ = Start.of(start, machine)
    if joints is None:
        raise ProblemError("start is missing: a goal is reached from somewhere; give plan(..., start=)", name="start")
    own_limits = Limits() if limits is None else require.instance("limits", limits, Limits)
    places: dict[str, Any] = {"limits": own_limits, "constraints": constraints, "seed": seed}
    is_free = isinstance(horizon, str)
    if is_free:
        require.choice("horizon", horizon, ("free",))
    own_cost = Cost(time=float(is_free)) if cost is None else require.instance("cost", cost, Cost)
    return GoalRequest(
        machine,
        joints,
        goal_configurations(machine, goal, joints, **places),
        horizon=goal.duration if horizon is None or is_free else horizon,
        limits=own_limits,
        cost=own_cost,
        start_velocity=state.velocity,
        end_velocity=goal.velocity,
        clearance_constraints=constraints,
        seed=seed,
        time_limit=time_left() if np.isfinite(time_left()) else None,
        progress=report,
    )


def plan_steps(
    machine: Machine, steps: Steps, *, start: Any, cost: StepWeights | None, limits: Limits | None
) -> PhasedPlan:
    """Plan the steps of a machine on its feet; see `steps_problem`.

    Args:
        machine: Machine of the first stance, `steps.stances[0]`.
        start: Joints at the start in the order of this machine.

    Raises:
        ProblemError: As `steps_problem`; or the machine is not that of the first stance.
        SolveError: As `solve_steps`.
    """
    stance = steps.stances[0]
    if not isinstance(machine, Stance) or machine.robot.joint_names != stance.robot.joint_names:
        words = "steps begin in their first stance: give plan(steps.stances[0], steps, start=...)"
        raise ProblemError(words, name="machine", value=machine)
    joints = Start.of(start, stance)[1]
    if joints is None:
        raise ProblemError("start is missing; standing_configuration finds joints for a stance", name="start")
    begin = steps.in_order(stance, joints[None])[0]
    return _phased(stance, solve_steps(steps, start=begin, cost=cost, limits=limits), joints)


def plan_capture(
    machine: Machine,
    capture: Capture,
    *,
    start: Any,
    cost: Cost | None,
    limits: Limits | None,
    constraints: ClearanceConstraints | None,
) -> PhasedPlan:
    """Plan the capture of a tumbling body by a free-floating chaser; see `capture_problem`.

    Raises:
        ProblemError: As `capture_problem`.
        SolveError: No motion satisfies its limits.
    """
    chaser = require.instance("machine", machine, FreeFloating)
    options: dict[str, Any] = {"cost": cost, "limits": limits, "clearance_constraints": constraints}
    solution = solve_capture(chaser, capture, start=start, **options)
    return _phased(chaser, solution, np.asarray(Start.of(start, chaser)[1]))


def with_joints(goal: Goal, joints: Array) -> Goal:
    """Return a goal with joints in place of its pose."""
    no_pose: dict[str, Any] = dict.fromkeys(("tip", "position", "orientation", "direction", "within", "region"))
    return replace(goal, joints=joints, **no_pose)


def _phased(machine: Machine, solution: Solution, start: Array) -> PhasedPlan:
    """Return the plan whose motion is a solution with phases."""
    candidate = Candidate(start, solution.cost, None, Stage.AUDITED, solution)
    return PhasedPlan(machine, solution, parts_of_phases(solution), (candidate,))


def nearest_configuration(machine: Machine, goal: Goal, near: Array, *, limits: Limits, seed: int) -> Array:
    """Return the joints at the pose of a goal that are nearest to the given ones. Shape (n,).

    Raises:
        Unreachable, ProblemError: As `inverse_kinematics`.
    """
    options = IkOptions(limits=limits.joints)
    solutions = inverse_kinematics(machine, goal.task, near=near, seed=seed, options=options)
    distances = [float(np.linalg.norm(solution.joints - near)) for solution in solutions]
    return np.asarray(solutions[int(np.argmin(distances))].joints)


def goal_configurations(
    machine: Machine, goal: Goal, near: Array, *, limits: Limits, constraints: ClearanceConstraints | None, seed: int
) -> Array:
    """Return configurations at a goal within limits and clearance, sorted by distance from `near`. Shape (K, n).

    The tip of a goal with a region is at the centre of the region, and at random places in it. Joints that do not move
    the tip stay where they are.

    Args:
        near: Joints to which the goals are compared. Shape (n,).

    Raises:
        Unreachable, ProblemError: As `inverse_kinematics`; or the joints of the goal do not fit, see `clip_to_limits`.
    """
    bounds, names = limits.bounds(machine), machine.robot.joint_names
    if not goal.has_pose:
        if goal.joints is None:
            raise ProblemError("a goal needs joints or a pose", name="joints", value=None)
        values = require.array("goal", np.nan_to_num(floats(goal.joints)), (len(near),), meaning="one for each joint")
        joints = np.where(np.isnan(floats(goal.joints).ravel()), near, values)
        words: dict[str, Any] = {"label": "end", "names": names, "hint": "end inside them"}
        return clip_to_limits(joints, bounds.lower, bounds.upper, **words)[None]
    scene, options = None if constraints is None else constraints.scene, IkOptions(limits=limits.joints)
    tasks = [goal.task, *(replace(goal.task, position=point) for point in _points_inside(goal.region, seed))]
    solutions, error = list[Array](), None
    for task in tasks:
        try:
            members = inverse_kinematics(machine, task, near=near, seed=seed, scene=scene, options=options)
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
    """Return random points in a region, in world; none without a region. Shape (K, 3), m."""
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
