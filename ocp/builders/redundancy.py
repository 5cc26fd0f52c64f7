"""Redundancy resolved over the whole motion: the least joint velocity that does a task of the tip.

Problem (27) of the free-floating paper (Kim, Kim 2011), for any machine of `models`, on a fixed or a floating
base.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Literal

import casadi as ca
import numpy as np

from models import Machine
from ocp.builders.task import Array, Velocity, checked_start, is_singular, velocity_expression
from ocp.errors import ProblemError
from ocp.guess import Samples
from ocp.local import LocalSolution, least_rates, resolve
from ocp.problem import Problem

__all__ = ["minimum_velocity"]

GUESS_TOLERANCE = 1e-8


def minimum_velocity(
    machine: Machine,
    tip_velocity: Velocity,
    rows: Sequence[int],
    start_joints: Any,
    horizon: float,
    *,
    start_base: Any = None,
    formulation: Literal["rates", "null_space"] = "rates",
    limits: bool = True,
    guess_damping: float = 0.005,
    symbols: Any = ca.SX,
) -> Problem:
    """Move the tip as told while the integral of half the squared joint rates, 1/2 |x2'|^2, is least (27).

    States "joints" and, on a floating base, "base". Two formulations of the same problem:

    "rates": control "rates" are the joint rates x2', the task G x2' = v is the path equality "task". Regular
    where
        the Jacobian loses rank as long as v stays in its range; the one to use.
    "null_space": control "null" is u of x2' = (1 - G# G) u + G# v, equation (26), which does the task by
    itself.
        Fragile: G# is unbounded where the Jacobian loses rank. The part G# G u of the control has no effect
            on the
        motion; 1/2 |G# G u|^2 is added to the cost, so that the running cost is 1/2 |u|^2 + 1/2 |G# v|^2. It
        vanishes at the optimum and makes the optimal u unique: u lies in the null space and x2' = u + G# v
        there. Without it shooting with linear controls takes hundreds of iterations instead of ten.

    Args:
        machine: A FixedBase, a FreeFloating, or anything else that is a Machine.
        tip_velocity: Velocity v of the tip in the task's rows: a constant of shape (len(rows),), or a
            function that takes `problem.time` (s) and returns a casadi vector or a list of expressions.
        rows: Which rows of the tip's twist the task fixes: angular 0..2, linear 3..5, world axes.
        start_joints: Shape (joint_size,), rad or m.
        horizon: Final time, s.
        start_base: Base configuration at the start, shape (base_size,); the machine's base_home() if None.
        formulation: "rates" or "null_space".
        limits: Whether the robot's position limits bound the state "joints" and its velocity limits the joint
            rates (a bound of the control "rates", or the path constraint "velocity limits" of the null-space
            form).
        guess_damping: Damping of the local solution (see ocp.local.resolve) that is attached as the initial
            guess, relative to the root mean square of the singular values of the task's Jacobian at the
            start. Small values start near the pseudo-inverse; large ones avoid its singular passages and may
            lead to another extremal: on the paper's example 0.001 to 0.02 lead to J = 1.7351, 0.03 to
            J = 1.7467.
        symbols: casadi.SX, or casadi.MX when tip_velocity calls an interpolant.

    Returns:
        The problem, its guesses attached; nothing is solved but the local motion.

    Raises:
        ProblemError: Rows out of range, repeated, none, more than joints, or moved by no joint; wrong sizes;
            a start outside the limits, or singular for the null-space form; a horizon or a damping that is
            not positive; an unknown formulation.
    """
    if formulation not in ("rates", "null_space"):
        raise ProblemError(f"unknown formulation {formulation!r}; use 'rates' or 'null_space'")
    if not (np.isfinite(guess_damping) and guess_damping > 0):
        raise ProblemError(f"guess_damping must be positive, not {guess_damping!r}")
    start = checked_start(machine, rows, start_joints, horizon, start_base)
    if formulation == "null_space" and is_singular(machine, start):
        raise ProblemError(
            f"the task of rows {start.rows} is singular at the start joints {start.joints.tolist()}, where the "
            "null-space form does not exist; use formulation='rates' or start elsewhere"
        )
    lower, upper, speed = _limits(machine, limits)
    _check_inside(machine, start.joints, lower, upper)
    jacobian = np.array(ca.DM(machine.tip_jacobian(start.base, start.joints)))[start.rows]
    local = resolve(
        machine,
        tip_velocity,
        rows,
        start.joints,
        horizon,
        start_base=start.base,
        damping=guess_damping * float(np.linalg.norm(jacobian)) / np.sqrt(len(start.rows)),
        tolerance=GUESS_TOLERANCE,
    )

    problem = Problem(f"minimum velocity, {formulation.replace('_', ' ')}", symbols=symbols)
    base: Any = np.zeros(0)
    if machine.base_size:
        base = problem.state("base", initial=start.base, guess=_guess(local, "base"))
    joints = problem.state("joints", initial=start.joints, lower=lower, upper=upper, guess=_guess(local, "joints"))
    problem.horizon(start.horizon)
    velocity = velocity_expression(tip_velocity, problem.time, len(start.rows))

    running: Any = 0
    if formulation == "rates":
        rates = problem.control("rates", lower=-speed, upper=speed, guess=_guess(local, "joint_rates"))
        base_rate, twist = machine.base_rate(base, joints, rates), machine.tip_twist(base, joints, rates)
        base_rate, twist = ca.cse([base_rate, twist])  # both contain the kinematics
        problem.path("task", twist[start.rows] - velocity, lower=0, upper=0)
    else:
        null = problem.control("null", machine.joint_size, guess=0.0)  # local motion has no part there
        task = machine.tip_jacobian(base, joints)[start.rows, :]
        both = least_rates(task, ca.horzcat(velocity, ca.mtimes(task, null)))
        idle = both[:, 1]  # G# G u, without effect
        rates = null + both[:, 0] - idle
        base_rate, rates, idle = ca.cse([machine.base_rate(base, joints, rates), rates, idle])
        running += ca.dot(idle, idle) / 2
        if np.isfinite(speed).any():
            problem.path("velocity limits", rates, lower=-speed, upper=speed)
    if machine.base_size:
        problem.dynamics(base, base_rate)
    problem.dynamics(joints, rates)
    problem.minimize(running=running + ca.dot(rates, rates) / 2)
    return problem


def _limits(machine: Machine, limits: bool) -> tuple[Array, Array, Array]:
    robot = machine.robot
    if limits:
        return robot.lower, robot.upper, robot.velocity
    unbounded = np.full(machine.joint_size, np.inf)
    return -unbounded, unbounded, unbounded


def _check_inside(machine: Machine, joints: Array, lower: Array, upper: Array) -> None:
    for name, value, low, high in zip(machine.robot.joint_names, joints, lower, upper, strict=True):
        if not low <= value <= high:
            raise ProblemError(
                f"start_joints: {name!r} starts at {value:g}, outside its limits {low:g} .. {high:g}; "
                "start inside or pass limits=False"
            )


def _guess(local: LocalSolution, what: str) -> Samples:
    return Samples(local.t, getattr(local, what))
