"""Redundancy resolved over the whole motion: the least joint velocity that does a task of the tip.

Problem (27) of the free-floating paper (Kim, Kim 2011), for any machine of `models`, on a fixed or a floating base.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Literal

import casadi as ca
import numpy as np

from models import Machine
from ocp.errors import ProblemError
from ocp.local import Array, LocalSolution, Velocity, checked_start, least_rates, resolve, velocity_expression
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

    "rates": control "rates" are the joint rates x2', the task G x2' = v is the path equality "task". Regular where
        the Jacobian loses rank as long as v stays in its range; the one to use.
    "null_space": control "null" is u of x2' = (1 - G# G) u + G# v, equation (26), which does the task by itself.
        Fragile: G# is unbounded where the Jacobian loses rank, and the part of u in the row space of G has no
        effect, so that the optimal u is not unique (the motion is).

    Args:
        machine: A FixedBase, a FreeFloating, or anything else that is a Machine.
        tip_velocity: Velocity v of the tip in the task's rows: a constant of shape (len(rows),), or a function that
            takes `problem.time` (s) and returns a casadi vector or a list of expressions.
        rows: Which rows of the tip's twist the task fixes: angular 0..2, linear 3..5, world axes.
        start_joints: Shape (joint_size,), rad or m.
        horizon: Final time, s.
        start_base: Base configuration at the start, shape (base_size,); the machine's base_home() if None.
        formulation: "rates" or "null_space".
        limits: Whether the robot's position limits bound the state "joints" and its velocity limits the joint rates
            (a bound of the control "rates", or the path constraint "velocity limits" of the null-space form).
        guess_damping: Damping of the local solution (see ocp.local.resolve) that is attached as the initial guess,
            relative to the root mean square of the singular values of the task's Jacobian at the start. Small values
            start near the pseudo-inverse; large ones avoid its singular passages and may lead to another extremal:
            on the paper's example up to 0.01 leads to J = 1.7351 and 0.03 to 1.7467.
        symbols: casadi.SX, or casadi.MX when tip_velocity calls an interpolant.

    Returns:
        The problem, its guesses attached; nothing is solved but the local motion.

    Raises:
        ProblemError: Rows out of range, repeated, none, or more than joints; wrong sizes; a start outside the
            limits; a horizon or a damping that is not positive; an unknown formulation.
    """
    if formulation not in ("rates", "null_space"):
        raise ProblemError(f"unknown formulation {formulation!r}; use 'rates' or 'null_space'")
    if not (np.isfinite(guess_damping) and guess_damping > 0):
        raise ProblemError(f"guess_damping must be positive, not {guess_damping!r}")
    start = checked_start(machine, rows, start_joints, horizon, start_base)
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

    if formulation == "rates":
        rates = problem.control("rates", lower=-speed, upper=speed, guess=_guess(local, "joint_rates"))
        base_rate, twist = machine.base_rate(base, joints, rates), machine.tip_twist(base, joints, rates)
        base_rate, twist = ca.cse([base_rate, twist])  # both contain the kinematics
        problem.path("task", twist[start.rows] - velocity, lower=0, upper=0)
    else:
        null = problem.control("null", machine.joint_size, guess=_guess(local, "joint_rates"))
        task = machine.tip_jacobian(base, joints)[start.rows, :]
        # (1 - G# G) u + G# v with a single right-hand side.
        rates = null + least_rates(task, velocity - ca.mtimes(task, null))
        base_rate, rates = ca.cse([machine.base_rate(base, joints, rates), rates])
        if np.isfinite(speed).any():
            problem.path("velocity limits", rates, lower=-speed, upper=speed)
    if machine.base_size:
        problem.dynamics(base, base_rate)
    problem.dynamics(joints, rates)
    problem.minimize(running=ca.dot(rates, rates) / 2)
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


def _guess(local: LocalSolution, what: str) -> Any:
    return lambda time: local.at(time)[what]
