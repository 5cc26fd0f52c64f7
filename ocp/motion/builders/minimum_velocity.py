"""The least joint velocity that does a task, over the whole motion: the problem of `plan`, to change and solve.

Problem (27) of the free-floating paper (Kim, Kim 2011), for any machine of `models`, on a fixed or a floating base, and
any tasks: velocities, poses, free tool axes, several arms, a base held still.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from models import Machine
from models.arrays import Array
from ocp.console import interruptible
from ocp.errors import ProblemError, checked_each, checked_flag, checked_instance, checked_positive
from ocp.motion.builders.clearance import ClearanceConstraints
from ocp.motion.builders.tool_motion import ToolMotion, stretches_of, tool_motion_problem
from ocp.motion.local.inverse_kinematics import inverse_kinematics
from ocp.motion.local.rates import LocalMotion, track_tasks
from ocp.motion.tasks.checks import checked_configuration, checked_tasks, checked_weights, clip_to_limits, horizon_of
from ocp.motion.tasks.equations import bind
from ocp.motion.tasks.limits import JointBounds, Limits
from ocp.motion.tasks.tip_task import TipTask
from ocp.problem.problem import Problem

__all__ = ["minimum_velocity_problem"]

STEPS_OF_GUESS = 64
"""Steps of the local motion over the horizon, beside the breaks of the tasks."""


@interruptible
def minimum_velocity_problem(
    machine: Machine,
    tasks: TipTask | Sequence[TipTask],
    start_joints: Any = None,
    horizon: float | None = None,
    *,
    start_base: Any = None,
    near: Any = None,
    cyclic: bool = False,
    weights: Any = None,
    limits: Limits | None = None,
    guess_damping: float = 0.01,
    clearance_constraints: ClearanceConstraints | None = None,
) -> Problem:
    """Do tasks while the integral of half the squared joint rates, 1/2 |x2'|^2, is least (27).

    States "joints" and, on a floating base, "base"; control "rates"; path equality "task", G x2' = v. What a machine
    with momentum does at rest (its drift), and the feedback of a pose task, are part of v. Where tasks begin or end on
    the way, the names have the number of their stretch of time, see `ocp.motion.builders.tool_motion`.

    Args:
        machine, tasks: As of `plan`.
        start_joints: Shape (joint_size,), rad or m. None: the joints start wherever the tips are where their tasks
            begin; for a task of velocities, where they are at `near`.
        horizon: Final time, s; that of the tasks if None.
        start_base: Base at the start, shape (base_size,); the machine's base_home() if None.
        near: Joints at which the guess of a start that is free begins; inverse kinematics finds some if None.
        cyclic: Whether the joints end where they started, after a closed task. What of this follows from the task is
            not asked twice: a constant velocity, state "closure", of the size of the discretisation error is left to
            the task, so that the joints close exactly. The base of a floating machine closes only if the task says so.
        weights: Of the squared joint rates in the cost, positive. Shape (joint_size,); all 1 if None.
        limits: Of the joints' positions and rates; the robot's own if None.
        guess_damping: Damping of the local motion that is the guess, relative to the root mean square of the singular
            values of the tasks' Jacobian. Small values start near the pseudo-inverse; large ones avoid its singular
            passages and may lead to another extremal.
        clearance_constraints: What the motion has to stay clear of, see `ocp.motion.builders.clearance`.

    Returns:
        The problem, its guesses attached; nothing is solved but the local motion.

    Raises:
        ProblemError: Rows out of range, repeated, more than joints, moved by no joint, or dependent everywhere; wrong
            sizes; a start outside the limits or off the task's pose; a cyclic task that is not closed; a horizon or a
            damping that is not positive.
        Unreachable: No start found where it is free (a ProblemError).
    """
    checked_positive("guess_damping", guess_damping)
    checked_flag("cyclic", cyclic)
    given = (tasks,) if isinstance(tasks, TipTask) else checked_each("tasks", tasks, TipTask)
    bind(machine, given)
    duration = horizon_of(given, horizon)
    limits = Limits() if limits is None else checked_instance("limits", limits, Limits)
    reference = near if start_joints is None else start_joints
    if reference is None:
        first = [task for task in given if task.is_pose and task.begin == 0]
        if not first:
            words = "start_joints are missing; inverse_kinematics(machine, task) finds some for a pose"
            raise ProblemError(words, name="start_joints")
        reference = inverse_kinematics(machine, first, base=start_base, limits=limits.joints)[0].joints
    joints, base = checked_configuration(machine, reference, start_base)
    heavy = checked_weights(weights, machine.joint_size)
    stretches = stretches_of(machine, given, duration)
    for stretch in stretches:
        if stretch.equations is not None:
            begins = stretch is stretches[0] and start_joints is not None
            checked_tasks(stretch.equations, base, joints, duration, start=begins)
    bounds, names = limits.bounds(machine, ("velocity",)), machine.robot.joint_names
    joints = clip_to_limits("start_joints", names, joints, bounds.lower, bounds.upper, "start inside them")
    if clearance_constraints is not None:
        checked_instance("clearance_constraints", clearance_constraints, ClearanceConstraints)
    motion = tool_motion_problem(
        machine, stretches, base=base, start=None if start_joints is None else joints, reference=joints,
        cyclic=cyclic, weights=heavy, bounds=bounds, clearance_constraints=clearance_constraints,
    )  # fmt: skip
    _attach_guess(motion, base, joints, heavy, bounds, guess_damping)
    return motion.problem


def _attach_guess(
    motion: ToolMotion, base: Array, joints: Array, weights: Array, bounds: JointBounds, damping: float
) -> None:
    """Make the damped local motion through all stretches the guess of states and controls."""
    followed: list[LocalMotion] = []
    place, at = base[None], joints[None]
    for stretch in motion.stretches:
        steps = max(int(np.ceil(STEPS_OF_GUESS * stretch.duration / motion.horizon)), 1)
        times = np.union1d(np.linspace(stretch.begin, stretch.end, steps + 1), stretch.breaks)
        if stretch.equations is None:
            followed.append(LocalMotion.stationary(times, place, at))
        else:
            told: dict[str, Any] = {"weights": weights, "damping": damping}
            followed.append(
                track_tasks(stretch.equations, at, place, times, lower=bounds.lower, upper=bounds.upper, **told)
            )
        place, at = followed[-1].base[:, -1], followed[-1].joints[:, -1]
    declared = motion.problem.declared
    for name, guess in motion.guess(followed, 0).items():
        pool = declared.states if name in declared.states else declared.controls
        pool[name] = replace(pool[name], guess=guess)
