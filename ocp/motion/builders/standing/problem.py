"""Least-cost motions of a machine that stands on the ground, performs tasks with its tips, and must not tip over.

This is the planned counterpart of local.accelerations (Yoo et al. 2004), for any Standing machine, planar or spatial,
and any tasks. Joint accelerations (or jerks) are the control. Limits hold at the points of the grid;
`ocp.tighten(problem, method)` instead of `solve` enforces those of joints and ground between the points as well.
`ocp.motion.builders.standing.plan` chooses formulation and mesh.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, Literal

import casadi as ca
import numpy as np

from models.checks import Array, real
from models.machines.machine import Wrenches, wrenches_at
from models.machines.standing import Standing, StandingMotion, center_of_pressure
from models.robot.dynamics import Wrench
from models.robot.kinematics import joint_limit_index
from models.robot.robot import Robot
from ocp.console import interruptible
from ocp.errors import ProblemError, require
from ocp.motion.builders.clearance import ClearanceConstraints
from ocp.motion.builders.standing.start import (
    check_freedom,
    check_loads,
    check_slope,
    local_guess,
    start_inside,
    task_demand,
)
from ocp.motion.tasks.checks import check_length, check_rest, checked_configuration, checked_tasks, rates_at_rest
from ocp.motion.tasks.equations import TaskEquations, bind
from ocp.motion.tasks.limits import InFoot, JointBounds, Limits, Pinned, ZmpRule, check_rule, foot_rows
from ocp.motion.tasks.tip_task import TipTask
from ocp.problem.problem import Problem, remembers_request


@dataclass(frozen=True)
class Weights:
    """Weights of the terms of the cost of `standing_problem`: integrals over the motion, and a free final time.

    Attributes:
        acceleration, velocity, jerk: Weights of the sums of squares over the joints.
        joint_limits: Weight of the joint-limit index p1, equation (23) of Yoo et al. 2004.
        manipulability: Weight of minus the manipulability p2 of the tasks' rows, equation (27) there.
        time: Weight of a free final time, 1/s.
    """

    acceleration: float = 0.01
    velocity: float = 0.01
    joint_limits: float = 1.0
    manipulability: float = 0.5
    jerk: float = 1e-4
    time: float = 0.0

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            require.nonnegative(f"weights: {name}", value)


@dataclass(frozen=True, eq=False)
class StandingSetup:
    """Settings of `standing_problem` that most motions leave at their defaults.

    With tip_level "position" the tip is on its path at the nodes. It suits plans that switch, with controls held over
    intervals or linear in them, `MultipleShooting(..., control="held")` or `"linear"`. Held controls converge with
    first order where a constraint of the ground is active: the audit finds the motion feasible, but its cost too high.

    With tip_level "acceleration" the tip's acceleration is that of the path. It suits smooth plans with controls at the
    points of `Collocation(...)`, Legendre rather than Radau: they are much closer to the optimum for the same number of
    intervals. Choose it where prismatic joints move the tip along straight lines, between whose nodes the tip
    oscillates with "position".

    Attributes:
        start_velocity, end_velocity: Whether the joints are at "rest" there, or "free" to move.
        end: Joint positions at the end, nan where free; all are free if None. Shape (n,), rad or m.
        wrenches: External wrenches: a list, or a function of time and tip position, for example `tip_spring`.
        control: "acceleration" or "jerk".
        along: Argument of the tasks: "time", or "parameter" from 0 to 1 with velocities per unit of it. A free final
            time needs "parameter", or tasks that suit any horizon.
        tip_level: What the constraint "tip" prescribes. "position": the poses (m; sines of angles), and velocities of
            velocity tasks. "acceleration": the derivative of the velocities (m/s^2, rad/s^2), which alone can close a
            gap at the start.
        clearance_constraints: Collision avoidance; None for none.
        symbols: casadi.SX, or casadi.MX if a task, `wrenches` or a reference calls an interpolant.
    """

    start_velocity: Literal["rest", "free"] = "rest"
    end_velocity: Literal["rest", "free"] = "rest"
    end: Any = None
    wrenches: Wrenches = ()
    control: Literal["acceleration", "jerk"] = "acceleration"
    along: Literal["time", "parameter"] = "time"
    tip_level: Literal["position", "acceleration"] = "position"
    clearance_constraints: ClearanceConstraints | None = None
    symbols: Any = ca.SX

    def __post_init__(self) -> None:
        for option, choices in (
            ("control", ("acceleration", "jerk")),
            ("along", ("time", "parameter")),
            ("tip_level", ("position", "acceleration")),
            ("start_velocity", ("rest", "free")),
            ("end_velocity", ("rest", "free")),
        ):
            require.choice(option, getattr(self, option), choices)
        if self.clearance_constraints is not None:
            require.instance("clearance_constraints", self.clearance_constraints, ClearanceConstraints)


@dataclass(frozen=True)
class FreeTime:
    """Free final time, s, with a lower bound, an upper bound and an initial guess."""

    lower: float
    upper: float
    guess: float

    def __post_init__(self) -> None:
        times = (self.lower, self.guess, self.upper)
        if not (np.isfinite([*map(real, times)]).all() and 0 < self.lower <= self.guess <= self.upper):
            message = "FreeTime: 0 < lower <= guess <= upper is needed, not " + ", ".join(map(repr, times))
            raise ProblemError(message, name="FreeTime", value=times)


@remembers_request("standing")
@interruptible
def standing_problem(
    machine: Standing,
    tasks: TipTask | Sequence[TipTask],
    horizon: float | FreeTime,
    *,
    start: Any,
    zmp: ZmpRule | None = None,
    weights: Weights | None = None,
    limits: Limits | None = None,
    setup: StandingSetup | None = None,
) -> Problem:
    """Declare the optimal control problem of a standing machine that performs tip tasks at the lowest cost.

    The states are "joints", "velocities", and "accelerations" if the jerk is the control. The controls are
    "accelerations" or "jerks". With tasks along a parameter there are the states "path" from 0 to 1 and "path_rate" >=
    0, and the control "path_acceleration". The path constraints are "tip", see `StandingSetup.tip_level`; "zero moment
    point", the distance from the edges of the region that `zmp` allows, or from a point that it prescribes, m; "foot",
    the distance from other edges of the foot then, m; "vertical force", N; "friction", squared friction limit less
    squared tangential force, over the squared weight; and "torques". The guess is a local motion.

    Args:
        tasks: A TipTask, or several that are done at once, functions of the time in s or of the path parameter.
        horizon: Final time, s, or FreeTime(...).
        start: Start configuration. Shape (n,), rad or m.
        zmp: Where the zero moment point may be; by default the rule of the limits. InFoot(margin), IndexAtLeast(value),
            Pinned(point) or Anywhere().
        weights, limits: Weights of the parts of the cost; limits of joints and ground.
        setup: Both ends, external wrenches, control, formulation and clearance.

    Raises:
        ProblemError: Sizes, rows or options do not fit; the start is outside the limits; a task does not begin at its
            tip, is longer than the arm, or moves where the joints must be at rest; no joint accelerations satisfy the
            limits of torque, vertical force and zero moment point at a start from rest; the zero moment point is to
            leave the support; no freedom is left to come to rest; the start is singular while the cost contains the
            manipulability.
    """
    weights = Weights() if weights is None else require.instance("standing_problem: weights", weights, Weights)
    limits = Limits() if limits is None else require.instance("standing_problem: limits", limits, Limits)
    zmp = limits.zmp or InFoot() if zmp is None else zmp
    require.instance("standing_problem: machine", machine, Standing)
    if limits.power is not None:
        words = "limits: standing plans have no limit of power; limit the torques"
        raise ProblemError(words, name="power", value=limits.power)
    setup = StandingSetup() if setup is None else require.instance("standing_problem: setup", setup, StandingSetup)
    tip_level, along_parameter = setup.tip_level, setup.along == "parameter"
    if tip_level == "acceleration" and setup.control == "jerk":
        message = "tip_level 'acceleration' goes with control 'acceleration', not with 'jerk'"
        raise ProblemError(message, name="control", value=setup.control, limit="acceleration")
    rests = setup.start_velocity == "rest", setup.end_velocity == "rest"
    equations = bind(machine, tasks)
    duration = require.positive("horizon", horizon.guess if isinstance(horizon, FreeTime) else horizon)
    begin, base = checked_configuration(machine, start, None)
    bounds = limits.bounds(machine, ("velocity", "torque"))
    begin = start_inside(machine, begin, bounds.lower, bounds.upper)
    check_rule(machine, duration, zmp)
    last = 1.0 if along_parameter else duration
    checked_tasks(equations, base, begin, last)
    check_freedom(
        machine, equations.size, zmp, along_parameter=along_parameter, tip_level=tip_level, ends_at_rest=rests[1]
    )
    if weights.manipulability:
        check_slope(equations, begin)
    check_length(equations, base, last)
    if not along_parameter:
        check_rest(equations, 0.0 if rests[0] else None, last if rests[1] else None)
    if rests[0]:
        acting = wrenches_at(setup.wrenches, machine, (), ca.DM(begin), time=ca.DM(0.0))
        # with tip_level "position" the tip is on its path at the nodes alone
        demand = task_demand(equations, begin, along_parameter) if tip_level == "acceleration" else None
        least_force = limits.least_force(machine)
        check_loads(machine, begin, acting, zmp=zmp, least_force=least_force, bounds=bounds, demand=demand)
    guess = local_guess(machine, equations, duration, begin, by_parameter=along_parameter, wrenches=setup.wrenches)

    problem = Problem("standing plan", symbols=setup.symbols)
    final = declare_horizon(problem, horizon)
    resting: Array | None = None
    if rests[1]:
        rows = ~equations.pose_rows if tip_level == "position" else None
        resting = rates_at_rest(equations, (), guess["joints"].values[-1], rows)
    starts, ends = (begin, 0.0 if rests[0] else None, None), (setup.end, resting, None)
    jerk = setup.control == "jerk"
    declared = declare_joints(problem, machine.robot, bounds, guess, starts=starts, ends=ends, jerk=jerk)
    motion, jerks = declared[:3], declared[3]
    joints, velocities, accelerations = motion
    progress: tuple[Any, ...] = (problem.time,)
    if along_parameter:
        progress = _declare_progress(problem, rests, guess)
    none = ca.DM(0, 1)
    constrain_tips(problem, equations, (none, *motion), progress, moving=not rests[0], level=tip_level)
    wrenches = wrenches_at(setup.wrenches, machine, (), joints, time=problem.time)
    _constrain_ground(problem, machine, motion, wrenches, zmp, limits)
    limit_torques(problem, machine.robot, machine.joint_torques(*motion, wrenches), bounds.torque)

    if setup.clearance_constraints is not None:
        known = None if isinstance(horizon, FreeTime) else duration
        setup.clearance_constraints.declare(problem, none, horizon=known)
    running = weights.acceleration * ca.sumsqr(accelerations) + weights.velocity * ca.sumsqr(velocities)
    if weights.joint_limits:
        running += weights.joint_limits * joint_limit_index(machine.robot, joints)
    if weights.manipulability:
        running -= weights.manipulability * equations.manipulability(none, joints)
    running += weights.jerk * ca.sumsqr(jerks)
    problem.minimize(running=running, terminal=weights.time * final)
    return problem


def constrain_tips(
    problem: Problem,
    equations: TaskEquations,
    motion: tuple[Any, Any, Any, Any],
    progress: tuple[Any, ...],
    *,
    moving: bool,
    level: str = "acceleration",
) -> None:
    """Constrain the tips to poses if `level` is "position", else to accelerations and, if `moving`, start velocities.

    `motion` has base, joint positions, rates and accelerations.
    """
    targets = equations.targets(*progress[:2])
    if level == "position":
        gap = equations.gap(*motion[:3], targets)
        problem.path("tip", gap, lower=0, upper=0, unit=equations.unit(""), tolerance=equations.tolerances)
        return
    if moving:
        residual = equations.residual(*motion[:3], targets)
        problem.start("tip velocity", residual, lower=0, upper=0, unit=equations.unit())
    gap = equations.acceleration(*motion, progress=progress)
    problem.path("tip", gap, lower=0, upper=0, unit=equations.unit("/s^2", "/s^2"))
    for name, deviation in equations.deviations(*motion[:3], targets).items():
        problem.watch(name, **deviation)


def declare_horizon(problem: Problem, horizon: float | FreeTime) -> Any:
    """Declare the fixed or free final time of a problem, and return its expression."""
    if isinstance(horizon, FreeTime):
        return problem.horizon(lower=horizon.lower, upper=horizon.upper, guess=horizon.guess)
    return problem.horizon(float(horizon))


def declare_joints(
    problem: Problem,
    robot: Robot,
    bounds: JointBounds,
    guess: Mapping[str, Any],
    *,
    starts: Sequence[Any],
    ends: Sequence[Any],
    jerk: bool = False,
    scales: Any = (None,) * 4,
) -> tuple[Any, Any, Any, Any]:
    """Declare joint positions, velocities and accelerations within limits, with jerks if requested; return the symbols.

    The last of these quantities is the control; the others are states, whose derivatives are declared. `starts` and
    `ends` are the values at both ends, None or nan where free; `scales` are the scales of the quantities.
    """
    lower = (bounds.lower, -bounds.velocity, -bounds.acceleration, -bounds.jerk)
    upper = (bounds.upper, bounds.velocity, bounds.acceleration, bounds.jerk)
    symbols = []
    for k, name in enumerate(("joints", "velocities", "accelerations", "jerks")[: 3 + jerk]):
        options: dict[str, Any] = {"lower": lower[k], "upper": upper[k], "guess": guess.get(name), "scale": scales[k]}
        options["unit"] = robot.unit(("", "/s", "/s^2", "/s^3")[k])
        if k < 2 + jerk:
            symbols.append(problem.state(name, robot.dof, initial=starts[k], terminal=ends[k], **options))
        else:
            symbols.append(problem.control(name, robot.dof, **options))
    for state, derivative in pairwise(symbols):
        problem.dynamics(state, derivative)
    joints, velocities, accelerations, *jerks = symbols
    return joints, velocities, accelerations, jerks[0] if jerk else ca.DM(0, 1)


def limit_torques(problem: Problem, robot: Robot, torques: Any, largest: Array, *, suffix: str = "") -> None:
    """Declare the torque limits of a robot's joints, where these are finite, as a path constraint."""
    if rows := np.flatnonzero(np.isfinite(largest)).tolist():
        bounds = {"lower": -largest[rows], "upper": largest[rows]}
        problem.path(f"torques{suffix}", torques[rows], unit=robot.effort_unit, **bounds)


def _declare_progress(problem: Problem, rests: tuple[bool, bool], guess: Mapping[str, Any]) -> tuple[Any, Any, Any]:
    """Declare the path parameter, which runs from 0 to 1; return the parameter, its rate and its acceleration."""
    at = problem.state("path", initial=0.0, terminal=1.0, lower=0.0, upper=1.0, guess=guess["path"])
    first, last = (0.0 if rest else None for rest in rests)
    rate = problem.state("path_rate", lower=0.0, guess=guess["path_rate"], initial=first, terminal=last, unit="1/s")
    acceleration = problem.control("path_acceleration", guess=guess["path_acceleration"], unit="1/s^2")
    problem.dynamics(at, rate)
    problem.dynamics(rate, acceleration)
    return at, rate, acceleration


def motion_cost(motion: StandingMotion, weights: Weights | None = None) -> float:
    """Return the cost of `standing_problem`, without jerk terms, for a sampled motion, by the trapezoidal rule."""
    w = weights or Weights()
    running = w.acceleration * (motion.joint_accelerations**2).sum(axis=1)
    running += w.velocity * (motion.joint_velocities**2).sum(axis=1)
    running += w.joint_limits * motion.joint_limit_index - w.manipulability * motion.manipulability
    return float(np.trapezoid(running, motion.t) + w.time * motion.t[-1])


def _constrain_ground(
    problem: Problem,
    machine: Standing,
    motion: tuple[Any, Any, Any],
    wrenches: Sequence[Wrench],
    zmp: ZmpRule,
    limits: Limits,
) -> None:
    """Declare the path constraints of ground force, friction and zero moment point."""
    reaction = machine.ground_reaction(*motion, wrenches)
    force = reaction[3:6]
    problem.path("vertical force", force[2], lower=limits.least_force(machine), unit="N")
    if np.isfinite(limits.friction):
        reserve = ((limits.friction * force[2]) ** 2 - ca.sumsqr(force[:2])) / machine.weight**2
        problem.path("friction", reserve, lower=0)
    point = center_of_pressure(reaction)
    name = "zero moment point"
    if isinstance(zmp, Pinned):
        gap = ca.mtimes(ca.DM(machine.moving_directions), point - zmp.place(machine, problem.time))
        problem.path(name, gap, lower=0, upper=0, unit="m")
        name = "foot"
    inside = foot_rows(machine, zmp, point, bool(wrenches))
    if inside.numel():
        problem.path(name, inside, lower=0, unit="m")
