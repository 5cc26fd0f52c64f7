"""Optimal control problems of least joint rates between configurations or along tasks; the rates are the controls.

A path of straight motions in joint space at constant speed is a motion of `joint_motion_problem`, with rates that jump
at its corners. `motion_along` returns it as a solution that can be audited and saved like one of a solver.

`minimum_velocity_problem` is the problem that `plan` solves for tasks, to change and solve directly: problem (27) of
Kim and Kim 2011, for any machine on a fixed or floating base and any tasks.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np

from models import FixedBase, Machine
from models.checks import Array
from ocp.console import interruptible
from ocp.curves import PiecewisePolynomial
from ocp.errors import ProblemError, require
from ocp.motion.builders.clearance import ClearanceConstraints
from ocp.motion.builders.constant_jerk import path_solution
from ocp.motion.builders.tool_motion import ToolMotion, ToolMotionSetup, stretches_of, tool_motion_problem
from ocp.motion.local.inverse_kinematics import IkOptions, inverse_kinematics
from ocp.motion.local.rates import LocalMotion, track_tasks
from ocp.motion.tasks.checks import checked_configuration, checked_tasks, checked_weights, clip_to_limits, horizon_of
from ocp.motion.tasks.equations import bind
from ocp.motion.tasks.limits import JointBounds, Limits
from ocp.motion.tasks.tip_task import TipTask
from ocp.problem.problem import Problem, remembers_request
from ocp.solution import Solution

RATE_SLACK = 1e-9  # relative excess over a rate limit, at which a motion at constant speed may be all the time


@remembers_request("joint motion")
def joint_motion_problem(
    machine: FixedBase,
    horizon: float,
    *,
    start: Any,
    end: Any,
    limits: Limits | None = None,
    weights: Any = None,
    length: bool = False,
    clearance_constraints: ClearanceConstraints | None = None,
) -> Problem:
    """Declare the optimal control problem of least squared joint rates or least path length between two configurations.

    The state is "joints", the control "rates". With weights w and rates u the cost is the integral of sum(w u^2) / 2,
    or with `length` the length in joint space, the integral of sqrt(sum(w u^2)).

    Raises:
        ProblemError: Sizes do not match, or an end is outside the limits.
    """
    bounds, n = (limits or Limits()).bounds(machine, ("velocity",)), machine.joint_size
    first, last = (
        clip_to_limits(machine, checked_configuration(machine, value, None)[0], bounds.lower, bounds.upper, label=name)
        for name, value in (("start", start), ("end", end))
    )
    scale = ca.DM(checked_weights(weights, n))
    problem = Problem("joint motion")
    problem.horizon(require.positive("horizon", horizon))
    joints = problem.state(
        "joints", n, initial=first, terminal=last, lower=bounds.lower, upper=bounds.upper,
        unit=machine.robot.unit(),
    )  # fmt: skip
    fastest = (1 + RATE_SLACK) * bounds.velocity
    rates = problem.control("rates", n, lower=-fastest, upper=fastest, unit=machine.robot.unit("/s"))
    problem.dynamics(joints, rates)
    if clearance_constraints is not None:
        clearance_constraints.declare(problem, machine.base_home(), horizon=horizon)
    square = ca.dot(rates, scale * rates)
    problem.minimize(running=ca.sqrt(square) if length else square / 2)
    return problem


def motion_along(problem: Problem, path: Array, scale: Array, horizon: float, *, length: bool) -> Solution:
    """Return the motion at constant speed along a joint path (M, n) as a solution of a `joint_motion_problem`.

    A straight path is optimal. One with corners has no multipliers: the audit proves only whether it is feasible. The
    length of a displacement is |scale * dq|, with the roots (n,) of the weights.
    """
    lengths = np.linalg.norm(np.diff(path, axis=0) * scale, axis=1)
    moves = lengths > 0
    path = np.vstack([path[:-1][moves], path[-1:]]) if moves.any() else path[[0, -1]]
    total = float(lengths.sum())
    breaks = np.append(0.0, np.cumsum(lengths[moves] / total if moves.any() else np.ones(1)))
    breaks[-1] = 1.0
    rates = np.diff(path, axis=0) / (np.diff(breaks)[:, None] * horizon)
    # the costates of a motion without active constraints: minus the rate gradient of the running cost
    speeds = np.linalg.norm(rates * scale, axis=1, keepdims=True)
    duals = -(scale**2) * rates / (np.maximum(speeds, np.finfo(float).tiny) if length else 1.0)
    ends = np.array([0.0, 1.0])
    curves = (
        PiecewisePolynomial(breaks, ends, np.stack([path[:-1], path[1:]], axis=1)),
        PiecewisePolynomial(breaks, np.array([0.5]), rates[:, None]),
        PiecewisePolynomial(breaks, ends, np.stack([duals, duals], axis=1)),
    )
    message = "it follows a path of straight motions, whose optimality no multipliers show" if len(rates) > 1 else ""
    cost = total if length else total**2 / (2 * horizon)
    return path_solution(problem, "path at constant speed", curves, horizon=horizon, cost=cost, message=message)


GUESS_STEPS = 64  # number of time steps of the motion that is the initial guess, besides breaks of tasks


@dataclass(frozen=True, eq=False)
class VelocitySetup:
    """Settings of `minimum_velocity_problem` that most motions leave at their defaults.

    Attributes:
        start_base: Base at the start, shape (base_size,); the machine's base_home() if None.
        near: Configuration at which the guess of a free start begins; from inverse kinematics if None.
        guess_damping: Damping of the local motion used as the guess, relative to the root mean square of the singular
            values of the tasks' Jacobian. With small values it is close to the pseudo-inverse; large ones avoid
            singularities and may lead to another extremal.
        clearance_constraints: Collision avoidance, see `ocp.motion.builders.clearance`; None for none.

    Raises:
        ProblemError: The damping is not positive, or the clearance constraints are of another type.
    """

    start_base: Any = None
    near: Any = None
    guess_damping: float = 0.01
    clearance_constraints: ClearanceConstraints | None = None

    def __post_init__(self) -> None:
        require.positive("guess_damping", self.guess_damping)
        if self.clearance_constraints is not None:
            require.instance("clearance_constraints", self.clearance_constraints, ClearanceConstraints)


@interruptible
def minimum_velocity_problem(
    machine: Machine,
    tasks: TipTask | Sequence[TipTask],
    horizon: float | None = None,
    *,
    start: Any = None,
    cyclic: bool = False,
    weights: Any = None,
    limits: Limits | None = None,
    setup: VelocitySetup | None = None,
) -> Problem:
    """Declare the optimal control problem of tracking tasks with the least integral of half the squared joint rates.

    This is problem (27) of Kim and Kim 2011. The states are "joints", x2, and, on a floating base, "base"; the control
    is "rates". The path equality is "task", G x2' = v with the Jacobian G of the tasks, where v contains the drift of a
    machine with momentum and the feedback of a pose task. If tasks begin or end during the motion, the names end in the
    number of the time interval between these events. The guess is a local motion.

    Args:
        machine, tasks: As for `plan`.
        horizon: Final time, s; that of the tasks if None.
        start: Start configuration. Shape (joint_size,), rad or m. None leaves it free wherever the tips are at the
            beginning of their tasks. With a velocity task the tip is then where it is at `VelocitySetup.near`.
        cyclic: Whether the joints end where they started, after a closed task, which may deviate by a constant velocity
            of the size of the discretisation error, the state "closure". A floating base closes only if the task
            requires it.
        weights: Weights of the squared joint rates, positive. Shape (joint_size,); all 1 if None.
        limits: Limits of joint positions and rates; the robot's own if None.
        setup: Base at the start, guess and clearance.

    Raises:
        ProblemError: Rows are out of range, repeated, more than the joints, moved by no joint, or dependent everywhere;
            sizes are wrong; the start is outside the limits or off the task's pose; a cyclic task is not closed; the
            horizon or the damping is not positive. Unreachable, a ProblemError, if a free start is not found.
    """
    setup = VelocitySetup() if setup is None else require.instance("setup", setup, VelocitySetup)
    require.flag("cyclic", cyclic)
    tasks = (tasks,) if isinstance(tasks, TipTask) else require.each("tasks", tasks, TipTask)
    bind(machine, tasks)
    duration = horizon_of(tasks, horizon)
    limits = Limits() if limits is None else require.instance("limits", limits, Limits)
    reference = setup.near if start is None else start
    if reference is None:
        first = [task for task in tasks if task.is_pose and task.begin == 0]
        if not first:
            words = "start is missing; inverse_kinematics(machine, task) finds joints for a pose"
            raise ProblemError(words, name="start")
        ik_options = IkOptions(base=setup.start_base, limits=limits.joints)
        reference = inverse_kinematics(machine, first, options=ik_options)[0].joints
    joints, base = checked_configuration(machine, reference, setup.start_base)
    weights = checked_weights(weights, machine.joint_size)
    stretches = stretches_of(machine, tasks, duration)
    for stretch in stretches:
        if stretch.equations is not None:
            begins = stretch is stretches[0] and start is not None
            checked_tasks(stretch.equations, base, joints, duration, check_start=begins)
    bounds = limits.bounds(machine, ("velocity",))
    joints = clip_to_limits(machine, joints, bounds.lower, bounds.upper, label="start")
    options = ToolMotionSetup(
        base=base, start=None if start is None else joints, reference=joints, cyclic=cyclic, weights=weights,
        bounds=bounds, clearance_constraints=setup.clearance_constraints,
    )  # fmt: skip
    motion = tool_motion_problem(machine, stretches, options)
    _attach_guess(motion, base, joints, weights, bounds, setup.guess_damping)
    return motion.problem


def _attach_guess(
    motion: ToolMotion, base: Array, joints: Array, weights: Array, bounds: JointBounds, damping: float
) -> None:
    """Use the damped resolved-rate motion along the tasks as the initial guess of a problem's states and controls."""
    motions: list[LocalMotion] = []
    place, at = base[None], joints[None]
    for stretch in motion.stretches:
        steps = max(int(np.ceil(GUESS_STEPS * stretch.duration / motion.horizon)), 1)
        times = np.union1d(np.linspace(stretch.begin, stretch.end, steps + 1), stretch.nodes)
        if stretch.equations is None:
            motions.append(LocalMotion.stationary(times, place, at))
        else:
            options: dict[str, Any] = {"lower": bounds.lower, "upper": bounds.upper, "weights": weights}
            motions.append(track_tasks(stretch.equations, at, place, times, damping=damping, **options))
        place, at = motions[-1].base[:, -1], motions[-1].joints[:, -1]
    motion.problem.declared.set_guesses(motion.guess(motions, 0))
