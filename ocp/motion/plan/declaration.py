"""The problem of a motion, to change and to solve directly, from the arguments of `plan`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, Literal

from models import FixedBase, FreeFloating, Machine, Standing
from ocp.errors import ProblemError, require
from ocp.motion.builders.clearance import ClearanceConstraints
from ocp.motion.builders.dynamics import DynamicsSetup, dynamics_problem
from ocp.motion.builders.dynamics_plan import dynamics_phases
from ocp.motion.builders.joint_motion import joint_motion_problem
from ocp.motion.builders.minimum_velocity import minimum_velocity_problem
from ocp.motion.builders.space.capture import Capture, capture_problem
from ocp.motion.builders.standing.problem import StandingSetup, Weights, standing_problem
from ocp.motion.builders.standing.stances import Steps
from ocp.motion.builders.standing.steps import StepWeights, steps_problem
from ocp.motion.plan.actuators import limits_actuators
from ocp.motion.plan.planner import clearance_for
from ocp.motion.tasks.cost import Cost
from ocp.motion.tasks.goals import Goal, Start, Waypoints
from ocp.motion.tasks.limits import Limits
from ocp.motion.tasks.scene import Scene
from ocp.motion.tasks.tip_task import TipTask
from ocp.problem.problem import Problem

__all__ = ["plan_problem"]


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
    """Declare the problem that `plan` solves, without a search: the start is given or near one configuration.

    The clearance of the scene is proven by the audit of a solution, but no pair of bodies is separated yet, see
    `ClearanceConstraints.holding`. Poses of goals need joints here. Limits of actuators beside tip tasks, and a free
    horizon for them, belong to `plan`.

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
        setup, zmp = StandingSetup(clearance_constraints=constraints), None if limits is None else limits.zmp
        options: dict[str, Any] = {"start": joints, "zmp": zmp, "weights": own, "limits": limits, "setup": setup}
        return standing_problem(machine, goals, horizon, **options)
    weights = None if own is None else require.instance("cost", own, Cost).joint_weights(machine.joint_size)
    options = {"start": joints, "start_base": base, "cyclic": cyclic, "weights": weights}
    return minimum_velocity_problem(machine, goals, horizon, **options, **shared)


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
    """Declare the motion to goals: at constant speed if velocities alone are weighted and limited, else smooth."""
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
