"""Whole motions of a machine that stands on the ground: do a task of the tip, do not tip over, spend the freedom well.

The global counterpart of ocp.local.accelerations (Yoo et al. 2004), for any Standing machine, planar or spatial.

Joint accelerations (or jerks) are the control. Two ways to keep the tip on its path:

tip_level "position": for controls held over intervals, `MultipleShooting(..., control="held")` or `Collocation(...,
    control="held")`. The tip is on its path at the nodes; what the ground and the joints bear is constrained at both
    ends of every interval; a pinned zero moment point is where it should be at the start of every interval. Converges
    with the first order of the interval where a constraint of the ground is active, and the multipliers of that
    constraint then belong to one end of an interval: the audit's stationarity, taken inside it, does not fit.
tip_level "acceleration": for controls at the collocation points, `Collocation(...)`, Legendre rather than Radau. The
    tip's acceleration is that of the path, so that its position follows as well as the dynamics are integrated. Far
    nearer to the optimum for the same number of intervals, and certified by the audit. The one to take where slides
    move the tip in straight lines: there a tip on its path at the nodes alone swings between them, or comes to no rest
    on the grid (try one interval more). Not for plans that switch, as
    those of least time do: between the points of an interval with a switch the polynomials swing far.

Either way limits hold at the points of the grid; `ocp.tighten(problem, method)` in place of `solve` makes those of
joints and ground hold between the points as well. Both ways have the tip within 1e-5 m of its path between the points
where the grid is fine enough: 40 intervals with collocation, 80 with held controls, for tasks such as those of the
paper. There a zero moment point that is pinned or follows a reference is within 1 mm of it by the second way, and by
the first with the jerk as control; with held accelerations it strays 5 mm, for it jumps with them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, Literal

import casadi as ca
import numpy as np

from models.machines.standing import External, Standing, center_of_pressure, wrenches_at
from models.machines.standing_motion import StandingMotion
from models.robot.dynamics import Wrench
from models.robot.indices import joint_limit_index
from ocp.builders.standing.guess import local_guess
from ocp.builders.standing.options import FreeTime, Limits, Weights
from ocp.builders.standing.start import check_freedom, check_loads, check_slope, inside_limits, tip_demand
from ocp.errors import ProblemError
from ocp.problem.problem import Problem
from ocp.tasks.start import Array, checked_start
from ocp.tasks.tip_path import Path, check_path, check_rest, linear_rows, path_derivatives
from ocp.tasks.zmp_rules import (
    Anywhere,
    Following,
    IndexAtLeast,
    InFoot,
    Pinned,
    ZmpRule,
    check_rule,
    foot_rows,
    index_rows,
)

__all__ = [
    "Anywhere",
    "Following",
    "FreeTime",
    "InFoot",
    "IndexAtLeast",
    "Limits",
    "Pinned",
    "Weights",
    "motion_cost",
    "standing_problem",
]


def standing_problem(
    machine: Standing,
    tip_path: Path,
    rows: Sequence[int],
    start_joints: Any,
    horizon: float | FreeTime,
    *,
    zmp: ZmpRule | None = None,
    external: External | None = None,
    weights: Weights | None = None,
    limits: Limits | None = None,
    control: Literal["acceleration", "jerk"] = "acceleration",
    along: Literal["time", "parameter"] = "time",
    tip_level: Literal["position", "acceleration"] = "position",
    start: Literal["rest", "free"] = "rest",
    end: Literal["rest", "free"] = "rest",
    end_joints: Any = None,
    symbols: Any = ca.SX,
) -> Problem:
    """Move the tip along its path while the machine stands, at the least cost.

    States "joints", "velocities" (and "accelerations" where the jerk is the control); controls "accelerations" or
    "jerks". Where the path is a function of a parameter, states "path" 0..1 and "path_rate" >= 0, control
    "path_acceleration". Path constraints "tip"; "zero moment point" (m; inside a foot the distance from its edges, less
    the margin); "foot", the distance from edges that another rule leaves open; "vertical force", N; "friction", the
    square of the force the ground holds less that it gives, over the squared weight; "torques".

    Args:
        machine: What stands.
        tip_path: Position of the tip in the task's rows, m, world axes: a function of the time, s, or of the path
            parameter.
        rows: Linear rows of the tip's twist that the task fixes, 3..5.
        start_joints: Shape (n,), rad or m.
        horizon: Final time, s, or FreeTime(...).
        zmp: Where the zero moment point may be: InFoot(margin) (the default, margin 0), IndexAtLeast(value),
            Pinned(point), Following(reference) or Anywhere().
        external: Wrenches from outside as a function of time and tip position, for example `tip_spring`.
        weights: Of the parts of the cost. limits: Of joints and ground.
        control: What is held over an interval of the plan.
        along: What tip_path is a function of. A free final time needs "parameter", or a path that suits any horizon.
        tip_level: Whether the path constraint "tip" is the position of the tip, m, or its acceleration, m/s^2.
        start, end: Whether the joints are at rest there, or free to move.
        end_joints: Joint positions at the end, nan where free; all free if None. Shape (n,).
        symbols: casadi.SX, or casadi.MX when tip_path, external or a reference calls an interpolant.

    Returns:
        The problem, with a local motion as its guess.

    Raises:
        ProblemError: Sizes, rows or options that do not fit, a start outside the limits, a path that does not begin at
            the tip, is longer than the arm, or moves where the joints are to rest; a start from rest at which torques,
            vertical force or zero moment point are beyond what may be whatever the joints do; a zero moment point
            that is asked out of the support; no freedom left to come to rest; a singular start whose manipulability
            the cost would need.
    """
    zmp, weights, limits = zmp or InFoot(), weights or Weights(), limits or Limits()
    if not (isinstance(machine, Standing) and isinstance(weights, Weights) and isinstance(limits, Limits)):
        given = [type(one).__name__ for one in (machine, weights, limits)]
        raise ProblemError(f"standing_problem takes a Standing machine, Weights and Limits, not {', '.join(given)}")
    _check_options(control=control, along=along, tip_level=tip_level, start=start, end=end)
    if tip_level == "acceleration" and control == "jerk":
        raise ProblemError("tip_level 'acceleration' goes with control 'acceleration', not with 'jerk'")
    duration = horizon.guess if isinstance(horizon, FreeTime) else horizon
    begin = checked_start(machine, rows, start_joints, duration, None)
    rows = begin.rows
    bounds = limits.bounds(machine)
    begin = replace(begin, joints=inside_limits(machine, begin.joints, *bounds["joints"]))
    check_rule(machine, zmp, begin.horizon)
    check_freedom(machine, rows, zmp, along, tip_level, end)
    check_slope(machine, rows, begin.joints, weights.manipulability)
    last = 1.0 if along == "parameter" else begin.horizon
    check_path(machine, tip_path, rows, begin.joints, begin.base, last)
    if along == "time":
        check_rest(tip_path, len(rows), 0.0 if start == "rest" else None, last if end == "rest" else None)
    if start == "rest":
        tip = np.array(ca.DM(machine.tip_pose((), begin.joints).position))
        acting = wrenches_at(external, ca.DM(0.0), ca.DM(tip))
        held = tip_level == "acceleration"  # else the tip is on its path at the nodes alone
        demand = tip_demand(machine, tip_path, rows, begin.joints, along == "parameter") if held else None
        check_loads(machine, begin.joints, acting, zmp, limits.least_force(machine), bounds, demand)
    guess = local_guess(machine, tip_path, rows, begin.joints, begin.horizon, along == "parameter", external)

    problem = Problem("standing plan", symbols=symbols)
    final = _horizon(problem, horizon)
    at_rest = {"initial": 0.0 if start == "rest" else None, "terminal": 0.0 if end == "rest" else None}
    joints = problem.state(
        "joints",
        machine.joint_size,
        initial=begin.joints,
        terminal=end_joints,
        lower=bounds["joints"][0],
        upper=bounds["joints"][1],
        guess=guess["joints"],
    )
    speed = bounds["velocities"]
    velocities = problem.state(
        "velocities",
        machine.joint_size,
        initial=at_rest["initial"],
        terminal=_rest(machine, rows, guess["joints"].values[-1], end, tip_level),
        lower=-speed,
        upper=speed,
        guess=guess["velocities"],
    )
    push, rough = bounds["accelerations"], bounds["jerks"]
    jerks: Any = ca.DM(1, 1)
    if control == "jerk":
        accelerations = problem.state(
            "accelerations", machine.joint_size, lower=-push, upper=push, guess=guess["accelerations"]
        )
        jerks = problem.control("jerks", machine.joint_size, lower=-rough, upper=rough)
        problem.dynamics(accelerations, jerks)
    else:
        accelerations = problem.control(
            "accelerations", machine.joint_size, lower=-push, upper=push, guess=guess["accelerations"]
        )
    problem.dynamics(joints, velocities)
    problem.dynamics(velocities, accelerations)

    states, rates, progress = [joints, velocities], [velocities, accelerations], problem.time
    if along == "parameter":
        progress = problem.state("path", initial=0.0, terminal=1.0, lower=0.0, upper=1.0, guess=guess["path"])
        rate = problem.state(
            "path_rate", lower=0.0, guess=guess["path_rate"], initial=at_rest["initial"], terminal=at_rest["terminal"]
        )
        push_along = problem.control("path_acceleration", guess=guess["path_acceleration"])
        problem.dynamics(progress, rate)
        problem.dynamics(rate, push_along)
        states, rates = [*states, progress, rate], [*rates, rate, push_along]
    else:
        states, rates = [*states, progress], [*rates, 1]
    position = machine.tip_pose((), joints).position
    gap = position[linear_rows(rows)] - path_derivatives(tip_path, progress, len(rows))[0]
    if tip_level == "acceleration":
        moving = ca.jtimes(gap, ca.vertcat(*states), ca.vertcat(*rates))
        if start == "free":
            problem.start("tip velocity", moving, lower=0, upper=0)
        gap = ca.jtimes(moving, ca.vertcat(*states), ca.vertcat(*rates))
    problem.path("tip", gap, lower=0, upper=0)

    wrenches = wrenches_at(external, problem.time, position)
    _ground(problem, machine, (joints, velocities, accelerations), wrenches, zmp, limits)
    effort = bounds["torques"]
    if np.isfinite(effort).any():
        limited = np.flatnonzero(np.isfinite(effort)).tolist()
        torques = machine.joint_torques(joints, velocities, accelerations, wrenches)[limited]
        problem.path("torques", torques, lower=-effort[limited], upper=effort[limited])

    running = weights.acceleration * ca.sumsqr(accelerations) + weights.velocity * ca.sumsqr(velocities)
    if weights.joint_limits:
        running += weights.joint_limits * joint_limit_index(machine.robot, joints)
    if weights.manipulability:
        running -= weights.manipulability * machine.manipulability((), joints, rows)
    running += weights.jerk * ca.sumsqr(jerks)
    problem.minimize(running=running, terminal=weights.time * final)
    return problem


def _check_options(**options: str) -> None:
    known = {
        "control": ("acceleration", "jerk"),
        "along": ("time", "parameter"),
        "tip_level": ("position", "acceleration"),
        "start": ("rest", "free"),
        "end": ("rest", "free"),
    }
    for what, value in options.items():
        if value not in known[what]:
            raise ProblemError(f"{what} must be one of {', '.join(known[what])}, not {value!r}")


def _horizon(problem: Problem, horizon: float | FreeTime) -> Any:
    if isinstance(horizon, FreeTime):
        return problem.horizon(lower=horizon.lower, upper=horizon.upper, guess=horizon.guess)
    return problem.horizon(float(horizon))


def _rest(machine: Standing, rows: list[int], joints: Array, end: str, tip_level: str) -> Array | None:
    """Joint velocities at the end, nan where free. Shape (n,).

    A tip whose acceleration is prescribed comes to rest by itself: as many joints as the task has rows then follow the
    others, and demanding rest of them too would be redundant. Those that move the tip best are left out.
    """
    if end == "free":
        return None
    rest = np.zeros(machine.joint_size)
    if tip_level == "acceleration":
        jacobian = np.array(ca.DM(machine.tip_jacobian((), joints)))[rows]
        for _ in rows:
            best = int((jacobian**2).sum(axis=0).argmax())
            length = np.linalg.norm(jacobian[:, best])
            if length < 1e-9:  # singular: the joints left out move the tip all ways that there are
                break
            direction = jacobian[:, best] / length
            jacobian = jacobian - np.outer(direction, direction @ jacobian)
            rest[best] = np.nan
    return rest


def motion_cost(motion: StandingMotion, weights: Weights | None = None) -> float:
    """The cost of standing_problem for a sampled motion, by the trapezoidal rule; without the weight of jerks."""
    w = weights or Weights()
    running = w.acceleration * (motion.joint_accelerations**2).sum(axis=1)
    running += w.velocity * (motion.joint_velocities**2).sum(axis=1)
    running += w.joint_limits * motion.joint_limit_index - w.manipulability * motion.manipulability
    return float(np.trapezoid(running, motion.t) + w.time * motion.t[-1])


def _ground(
    problem: Problem,
    machine: Standing,
    motion: tuple[Any, Any, Any],
    wrenches: Sequence[Wrench],
    zmp: ZmpRule,
    limits: Limits,
) -> None:
    """The path constraints on what the ground bears."""
    reaction = machine.ground_reaction(*motion, wrenches)
    force = reaction[3:6]
    problem.path("vertical force", force[2], lower=limits.least_force(machine))
    if np.isfinite(limits.friction):
        room = ((limits.friction * force[2]) ** 2 - ca.sumsqr(force[:2])) / machine.weight**2
        problem.path("friction", room, lower=0)
    point = center_of_pressure(reaction)
    if isinstance(zmp, IndexAtLeast):
        low, high = zmp.region(machine)
        rows = index_rows(machine, zmp, point, bool(wrenches))
        problem.path("zero moment point", point[rows], lower=low[rows], upper=high[rows])
    elif isinstance(zmp, Pinned | Following):
        gap = ca.mtimes(ca.DM(machine.moving_directions), point - zmp.place(machine, problem.time))
        problem.path("zero moment point", gap, lower=0, upper=0)
    inside = foot_rows(machine, zmp, point, bool(wrenches))
    if inside.numel():
        problem.path("zero moment point" if isinstance(zmp, InFoot) else "foot", inside, lower=0)
