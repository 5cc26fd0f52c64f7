"""Motions from joints to joints with the joint rates as controls.

A path of straight motions in joint space at constant speed is a motion of this problem, with rates that jump at its
corners. `motion_along` returns it as a solution that can be audited and saved like one of a solver.
"""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np

from models import FixedBase
from models.arrays import Array
from ocp.curves import PiecewisePolynomial
from ocp.motion.builders.clearance import ClearanceConstraints
from ocp.motion.tasks.checks import checked_configuration, checked_horizon, checked_weights, clip_to_limits
from ocp.motion.tasks.limits import Limits
from ocp.problem.problem import Problem, remembers_request
from ocp.solution import Solution
from ocp.status import SolverStatus

__all__ = ["joint_motion_problem", "motion_along"]

RATE_SLACK = 1e-9
"""Relative excess allowed over a rate limit, since a motion at constant speed may be at its limit all the time."""


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
    """Declare a motion between two configurations of least squared rates or of least length in joint space.

    The state is "joints", the control "rates". With weights w and rates u the cost is the integral of sum(w u^2) / 2,
    or the length, the integral of sqrt(sum(w u^2)).

    Args:
        machine: Machine on a fixed base.
        horizon: Final time, s.
        start, end: Joints, rad or m. Shape (n,).
        limits: Limits of joint positions and rates; the robot's own if None.
        weights: Weights of the squared rates, shape (n,); all 1 if None.
        length: Whether the length is the cost.
        clearance_constraints: Collision avoidance; None for none.

    Raises:
        ProblemError: Sizes do not match, or an end is outside the limits.
    """
    bounds, n = (limits or Limits()).bounds(machine, ("velocity",)), machine.joint_size
    ends = []
    for name, value in (("start", start), ("end", end)):
        joints, _ = checked_configuration(machine, value, None)
        hint = "keep within them"
        ends.append(clip_to_limits(name, machine.robot.joint_names, joints, bounds.lower, bounds.upper, hint))
    scale = ca.DM(checked_weights(weights, n))
    problem = Problem("joint motion")
    problem.horizon(checked_horizon(horizon))
    joints = problem.state(
        "joints", n, initial=ends[0], terminal=ends[1], lower=bounds.lower, upper=bounds.upper,
        unit=machine.robot.unit(),
    )  # fmt: skip
    fastest = (1 + RATE_SLACK) * bounds.velocity
    rates = problem.control("rates", n, lower=-fastest, upper=fastest, unit=machine.robot.unit("/s"))
    problem.dynamics(joints, rates)
    if clearance_constraints is not None:
        clearance_constraints.declare(problem, machine.base_home(), joints, horizon=horizon)
    square = ca.dot(rates, scale * rates)
    problem.minimize(running=ca.sqrt(square) if length else square / 2)
    return problem


def motion_along(problem: Problem, path: Array, scale: Array, horizon: float, *, length: bool) -> Solution:
    """Return the motion of a `joint_motion_problem` along a path at constant speed.

    A straight motion is optimal. One with corners has no multipliers: the audit proves whether it is feasible.

    Args:
        problem: The problem.
        path: Configurations with straight motions between them, the first and the last one those of the problem. Shape
            (M, n).
        scale: The length of a displacement is |scale * dq|, the roots of the weights. Shape (n,).
        horizon: Final time, s.
        length: Whether the length is the cost.
    """
    changes = np.diff(path, axis=0)
    lengths = np.linalg.norm(changes * scale, axis=1)
    moves = lengths > 0
    path = np.vstack([path[:-1][moves], path[-1:]]) if moves.any() else path[[0, -1]]
    total = float(lengths.sum())
    shares = lengths[moves] / total if moves.any() else np.ones(1)
    breaks = np.append(0.0, np.cumsum(shares))
    breaks[-1] = 1.0
    rates = np.diff(path, axis=0) / (np.diff(breaks)[:, None] * horizon)
    ends, middle = np.array([0.0, 1.0]), np.array([0.5])
    states = PiecewisePolynomial(breaks, ends, np.stack([path[:-1], path[1:]], axis=1))
    controls, is_straight = PiecewisePolynomial(breaks, middle, rates[:, None]), len(rates) == 1
    # the costates of a motion without active constraints: minus the derivative of the running cost by the rates
    speeds = np.linalg.norm(rates * scale, axis=1, keepdims=True)
    duals = -(scale**2) * rates / (np.maximum(speeds, np.finfo(float).tiny) if length else 1.0)
    costates = np.vstack([duals, duals[-1:]])
    return Solution(
        name=problem.name,
        method={"type": "path at constant speed"},
        solver="path",
        success=is_straight,
        status=SolverStatus.SOLVED if is_straight else SolverStatus.ACCEPTABLE,
        message="" if is_straight else "it follows a path of straight motions, whose optimality no multipliers show",
        cost=total if length else total**2 / (2 * horizon),
        iterations=0,
        horizon=horizon,
        t=breaks * horizon,
        states={"joints": path},
        controls={"rates": np.vstack([rates, rates[-1:]])},
        costates={"joints": costates},
        parameters={},
        cost_gradients={},
        state_interpolant=states,
        control_interpolant=controls,
        costate_interpolant=PiecewisePolynomial(breaks, ends, np.stack([duals, duals], axis=1)),
        variables=path.ravel(),
        multipliers=np.zeros(0),
        seconds={"build": 0.0, "solve": 0.0},
        problem=problem,
    )
