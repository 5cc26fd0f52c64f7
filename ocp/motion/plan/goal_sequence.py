"""Motions of several phases: to goals one after the other, steps of a standing machine, the capture of a body."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, Literal

import numpy as np

from models import FreeFloating, Machine, Stance
from models.checks import Array
from ocp.errors import ProblemError, require
from ocp.motion.builders.actuator_limits import checked_motors
from ocp.motion.builders.clearance import ClearanceConstraints
from ocp.motion.builders.dynamics import DynamicsSetup
from ocp.motion.builders.dynamics_plan import dynamics_phases, machines_of, phase_names, within_limits
from ocp.motion.builders.space.capture import Capture, solve_capture
from ocp.motion.builders.standing.plan import solve_steps
from ocp.motion.builders.standing.stances import Steps
from ocp.motion.builders.standing.steps import StepWeights
from ocp.motion.plan.goal_configurations import nearest_configuration
from ocp.motion.result.candidate import Candidate, Stage
from ocp.motion.result.phased_plan import PhasedPlan, parts_of_phases
from ocp.motion.tasks.cost import Cost
from ocp.motion.tasks.goals import Goal, Start
from ocp.motion.tasks.limits import Limits
from ocp.problem.problem import Problem
from ocp.solution import Solution

__all__ = ["plan_capture", "plan_sequence", "plan_steps"]


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
    """Plan the motion to goals one after the other, as the phases of one problem of least total cost.

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
            goal = _with_joints(goal, near)
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
    solution = within_limits(declare, constraints, None, (), None, None, limited)
    return _phased(motors, solution, joints)


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


def _with_joints(goal: Goal, joints: Array) -> Goal:
    """Return a goal with joints in place of its pose."""
    no_pose: dict[str, Any] = dict.fromkeys(("tip", "position", "orientation", "direction", "within", "region"))
    return replace(goal, joints=joints, **no_pose)


def _phased(machine: Machine, solution: Solution, start: Array) -> PhasedPlan:
    """Return the plan of a solution with phases."""
    candidate = Candidate(start, solution.cost, None, Stage.AUDITED, solution)
    return PhasedPlan(machine, solution, parts_of_phases(solution), (candidate,))
