"""Tool motions of least joint velocity: the problem that `plan` solves, to change and solve directly.

Problem (27) of Kim and Kim 2011 for free-floating arms, for any machine of `models` on a fixed or floating base, and
any tasks: velocities, poses, free tool axes, several arms, a base at rest.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from models import Machine
from models.checks import Array
from ocp.console import interruptible
from ocp.errors import ProblemError, require
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

GUESS_STEPS = 64
"""Steps of the local motion over the horizon, besides the breaks of the tasks."""


@interruptible
def minimum_velocity_problem(
    machine: Machine,
    tasks: TipTask | Sequence[TipTask],
    horizon: float | None = None,
    *,
    start: Any = None,
    start_base: Any = None,
    near: Any = None,
    cyclic: bool = False,
    weights: Any = None,
    limits: Limits | None = None,
    guess_damping: float = 0.01,
    clearance_constraints: ClearanceConstraints | None = None,
) -> Problem:
    """Declare a motion along tasks with the least integral of half the squared joint rates, 1/2 |x2'|^2 (27).

    The states are "joints" and, on a floating base, "base"; the control is "rates". The path equality is "task",
    G x2' = v, where v contains the drift of a machine with momentum and the feedback of a pose task. If tasks begin or
    end during the motion, the names have the number of their stretch of time, see `ocp.motion.builders.tool_motion`.

    Args:
        machine, tasks: As for `plan`.
        horizon: Final time, s; that of the tasks if None.
        start: Joints at the start. Shape (joint_size,), rad or m. None leaves them free wherever the tips are at the
            beginning of their tasks. With a velocity task the tip is then where it is at `near`.
        start_base: Base at the start, shape (base_size,); the machine's base_home() if None.
        near: Joints from which the guess of a free start begins; from inverse kinematics if None.
        cyclic: Whether the joints end where they started, after a closed task. The closure that already follows from
            the task is not required twice: the task may deviate by a constant velocity of the size of the
            discretisation error, the state "closure", so that the joints close exactly. A floating base closes only if
            the task requires it.
        weights: Weights of the squared joint rates, positive. Shape (joint_size,); all 1 if None.
        limits: Limits of joint positions and rates; the robot's own if None.
        guess_damping: Damping of the local motion used as the guess, relative to the root mean square of the singular
            values of the tasks' Jacobian. With small values it is close to the pseudo-inverse; large ones avoid
            singularities and may lead to another extremal.
        clearance_constraints: Collision avoidance, see `ocp.motion.builders.clearance`; None for none.

    Returns:
        The problem with its guess. Only the local motion is solved.

    Raises:
        ProblemError: Rows are out of range, repeated, more than the joints, moved by no joint, or dependent everywhere;
            sizes are wrong; the start is outside the limits or off the task's pose; a cyclic task is not closed; the
            horizon or the damping is not positive.
        Unreachable: A free start was not found (a ProblemError).
    """
    require.positive("guess_damping", guess_damping)
    require.flag("cyclic", cyclic)
    tasks = (tasks,) if isinstance(tasks, TipTask) else require.each("tasks", tasks, TipTask)
    bind(machine, tasks)
    duration = horizon_of(tasks, horizon)
    limits = Limits() if limits is None else require.instance("limits", limits, Limits)
    reference = near if start is None else start
    if reference is None:
        first = [task for task in tasks if task.is_pose and task.begin == 0]
        if not first:
            words = "start is missing; inverse_kinematics(machine, task) finds joints for a pose"
            raise ProblemError(words, name="start")
        reference = inverse_kinematics(machine, first, base=start_base, limits=limits.joints)[0].joints
    joints, base = checked_configuration(machine, reference, start_base)
    weights = checked_weights(weights, machine.joint_size)
    stretches = stretches_of(machine, tasks, duration)
    for stretch in stretches:
        if stretch.equations is not None:
            begins = stretch is stretches[0] and start is not None
            checked_tasks(stretch.equations, base, joints, duration, start=begins)
    bounds, names = limits.bounds(machine, ("velocity",)), machine.robot.joint_names
    joints = clip_to_limits("start", names, joints, bounds.lower, bounds.upper, "start inside them")
    if clearance_constraints is not None:
        require.instance("clearance_constraints", clearance_constraints, ClearanceConstraints)
    motion = tool_motion_problem(
        machine, stretches, base=base, start=None if start is None else joints, reference=joints,
        cyclic=cyclic, weights=weights, bounds=bounds, clearance_constraints=clearance_constraints,
    )  # fmt: skip
    _attach_guess(motion, base, joints, weights, bounds, guess_damping)
    return motion.problem


def _attach_guess(
    motion: ToolMotion, base: Array, joints: Array, weights: Array, bounds: JointBounds, damping: float
) -> None:
    """Set the damped local motion through all stretches as the guess of states and controls."""
    motions: list[LocalMotion] = []
    place, at = base[None], joints[None]
    for stretch in motion.stretches:
        steps = max(int(np.ceil(GUESS_STEPS * stretch.duration / motion.horizon)), 1)
        times = np.union1d(np.linspace(stretch.begin, stretch.end, steps + 1), stretch.breaks)
        if stretch.equations is None:
            motions.append(LocalMotion.stationary(times, place, at))
        else:
            options: dict[str, Any] = {"lower": bounds.lower, "upper": bounds.upper, "weights": weights}
            motions.append(track_tasks(stretch.equations, at, place, times, damping=damping, **options))
        place, at = motions[-1].base[:, -1], motions[-1].joints[:, -1]
    declared = motion.problem.declared
    for name, guess in motion.guess(motions, 0).items():
        pool = declared.states if name in declared.states else declared.controls
        pool[name] = replace(pool[name], guess=guess)
