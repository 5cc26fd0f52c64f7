"""Whole motions of a machine that stands on the ground: do tasks of its tips, do not tip over, spend the freedom well.

The global counterpart of local.accelerations (Yoo et al. 2004), for any Standing machine, planar or spatial, and
any task of `tip_task`: positions, orientations, free tool axes, several arms.

Joint accelerations (or jerks) are the control. Two ways to keep the tips to their tasks:

tip_level "position": for controls held over intervals, or linear in them: `MultipleShooting(..., control="held")` or
    `"linear"`, `Collocation(..., control="held")`. The tip is on its path at the nodes; what the ground and the joints
    bear is constrained at both ends of every interval; a pinned zero moment point is where it should be at the start
    of every interval. Held controls converge with the first order of the interval where a constraint of the ground is
    active: the audit then finds the motion feasible, and more of the cost lost than an optimum may lose. Linear ones
    are nearer to plans that switch; take `ocp.tighten` with them.
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
`ocp.motion.builders.standing.plan` chooses among all this.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import casadi as ca
import numpy as np

from models.arrays import Array
from models.machines.standing import External, Standing, StandingMotion, center_of_pressure, wrenches_at
from models.robot.dynamics import Wrench
from models.robot.indices import joint_limit_index
from models.robot.robot import Robot
from ocp.console import interruptible
from ocp.errors import ProblemError, checked_choice, checked_instance, checked_nonnegative
from ocp.motion.builders.clearance import ClearanceConstraints
from ocp.motion.builders.standing.start import (
    check_freedom,
    check_loads,
    check_slope,
    local_guess,
    start_inside,
    task_demand,
)
from ocp.motion.tasks.checks import (
    check_length,
    check_rest,
    checked_configuration,
    checked_horizon,
    checked_tasks,
    rates_at_rest,
)
from ocp.motion.tasks.equations import TaskEquations, bind
from ocp.motion.tasks.limits import JointBounds, Limits
from ocp.motion.tasks.tip_task import TipTask
from ocp.motion.tasks.zmp_rules import (
    Following,
    IndexAtLeast,
    InFoot,
    Pinned,
    ZmpRule,
    check_rule,
    foot_rows,
    index_rows,
    is_finite,
)
from ocp.problem.problem import Problem, remembers_request

__all__ = ["FreeTime", "Weights", "motion_cost", "standing_problem"]


@dataclass(frozen=True)
class Weights:
    """Of the parts of the cost, an integral over the motion plus `time` times a free final time.

    Attributes:
        acceleration, velocity, jerk: Of the sums of squares over the joints.
        joint_limits: Of the joint-limit index p1 (23).
        manipulability: Of minus the manipulability p2 (27) of the tasks' rows.
        time: Of a free final time, 1/s.
    """

    acceleration: float = 0.01
    velocity: float = 0.01
    joint_limits: float = 1.0
    manipulability: float = 0.5
    jerk: float = 1e-4
    time: float = 0.0

    def __post_init__(self) -> None:
        for what, value in vars(self).items():
            checked_nonnegative(f"weights: {what}", value)


@dataclass(frozen=True)
class FreeTime:
    """A final time that is found: between lower and upper, with a first guess, s."""

    lower: float
    upper: float
    guess: float

    def __post_init__(self) -> None:
        given = (self.lower, self.guess, self.upper)
        if not (all(map(is_finite, given)) and 0 < self.lower <= self.guess <= self.upper):
            message = "FreeTime: 0 < lower <= guess <= upper is needed, not " + ", ".join(map(repr, given))
            raise ProblemError(message, name="FreeTime", value=given)


@remembers_request("standing")
@interruptible
def standing_problem(
    machine: Standing,
    tasks: TipTask | Sequence[TipTask],
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
    clearance_constraints: ClearanceConstraints | None = None,
    symbols: Any = ca.SX,
) -> Problem:
    """Do the tasks while the machine stands, at the least cost.

    States "joints", "velocities" (and "accelerations" where the jerk is the control); controls "accelerations" or
    "jerks". Where the tasks are functions of a parameter, states "path" 0..1 and "path_rate" >= 0, control
    "path_acceleration". Path constraints "tip"; "zero moment point" (m; inside a foot the distance from its edges, less
    the margin); "foot", the distance from edges that another rule leaves open; "vertical force", N; "friction", the
    square of the force the ground holds less that it gives, over the squared weight; "torques".

    Args:
        machine: What stands.
        tasks: A TipTask, or several that are done at once, of the time, s, or of the path parameter.
        start_joints: Shape (n,), rad or m.
        horizon: Final time, s, or FreeTime(...).
        zmp: Where the zero moment point may be: InFoot(margin) (the default, margin 0), IndexAtLeast(value),
            Pinned(point), Following(reference) or Anywhere().
        external: Wrenches from outside as a function of time and tip position, for example `tip_spring`.
        weights: Of the parts of the cost. limits: Of joints and ground.
        control: What is held over an interval of the plan.
        along: What the tasks are functions of; "parameter" from 0 to 1, velocities per unit of it. A free final time
            needs "parameter", or tasks that suit any horizon.
        tip_level: Whether the path constraint "tip" is that the poses are as wanted (m; sines of angles), and the
            velocities of tasks that are such, or the derivative of the velocities (m/s^2, rad/s^2), by which alone a
            gap at the start can be closed; what is left of it at the end still moves the joints.
        start, end: Whether the joints are at rest there, or free to move.
        end_joints: Joint positions at the end, nan where free; all free if None. Shape (n,).
        clearance_constraints: What the motion has to stay clear of, see `ocp.motion.builders.clearance`.
        symbols: casadi.SX, or casadi.MX when a task, external or a reference calls an interpolant.

    Returns:
        The problem, with a local motion as its guess.

    Raises:
        ProblemError: Sizes, rows or options that do not fit, a start outside the limits, a task that does not begin
            at its tip, is longer than the arm, or moves where the joints are to rest; a start from rest at which
            torques, vertical force or zero moment point are beyond what may be whatever the joints do; a zero moment
            point that is asked out of the support; no freedom left to come to rest; a singular start whose
            manipulability the cost would need.
    """
    zmp = InFoot() if zmp is None else zmp
    weights = Weights() if weights is None else checked_instance("standing_problem: weights", weights, Weights)
    limits = Limits() if limits is None else checked_instance("standing_problem: limits", limits, Limits)
    checked_instance("standing_problem: machine", machine, Standing)
    if limits.power is not None:
        words = "limits: standing plans know no power; limit the torques"
        raise ProblemError(words, name="power", value=limits.power)
    checked_choice("control", control, ("acceleration", "jerk"))
    checked_choice("along", along, ("time", "parameter"))
    checked_choice("tip_level", tip_level, ("position", "acceleration"))
    checked_choice("start", start, ("rest", "free"))
    checked_choice("end", end, ("rest", "free"))
    if tip_level == "acceleration" and control == "jerk":
        message = "tip_level 'acceleration' goes with control 'acceleration', not with 'jerk'"
        raise ProblemError(message, name="control", value=control, limit="acceleration")
    equations = bind(machine, tasks)
    duration = checked_horizon(horizon.guess if isinstance(horizon, FreeTime) else horizon)
    begin, base = checked_configuration(machine, start_joints, None)
    bounds = limits.bounds(machine, ("velocity", "torque"))
    begin = start_inside(machine, begin, bounds.lower, bounds.upper)
    check_rule(machine, zmp, duration)
    last = 1.0 if along == "parameter" else duration
    checked_tasks(equations, base, begin, last)
    check_freedom(machine, equations.size, zmp, along, tip_level, end)
    if weights.manipulability:
        check_slope(equations, begin)
    check_length(equations, base, last)
    if along == "time":
        check_rest(equations, 0.0 if start == "rest" else None, last if end == "rest" else None)
    if start == "rest":
        tip = np.array(ca.DM(machine.tip_pose((), begin).position))
        acting = wrenches_at(external, ca.DM(0.0), ca.DM(tip))
        held = tip_level == "acceleration"  # else the tip is on its path at the nodes alone
        demand = task_demand(equations, begin, along == "parameter") if held else None
        check_loads(machine, begin, acting, zmp, limits.least_force(machine), bounds, demand)
    guess = local_guess(machine, equations, begin, duration, along == "parameter", external)

    problem = Problem("standing plan", symbols=symbols)
    final = _horizon(problem, horizon)
    resting = (
        None
        if end == "free"
        else rates_at_rest(
            equations, (), guess["joints"].values[-1], ~equations.pose_rows if tip_level == "position" else None
        )
    )
    motion, jerks = _motion(problem, machine.robot, bounds, begin, start, resting, end_joints, control, guess)
    joints, velocities, accelerations = motion
    progress: tuple[Any, ...] = (problem.time,)
    if along == "parameter":
        progress = _progress(problem, start, end, guess)
    _hold_tips(problem, equations, motion, progress, tip_level, start == "free")

    wrenches = wrenches_at(external, problem.time, machine.tip_pose((), joints).position)
    _ground(problem, machine, motion, wrenches, zmp, limits)
    effort = bounds.torque
    if np.isfinite(effort).any():
        limited = np.flatnonzero(np.isfinite(effort)).tolist()
        torques = machine.joint_torques(*motion, wrenches)[limited]
        problem.path("torques", torques, lower=-effort[limited], upper=effort[limited], unit=machine.robot.effort_unit)

    none = ca.DM(0, 1)
    if clearance_constraints is not None:
        known = None if isinstance(horizon, FreeTime) else duration
        checked_instance("standing_problem: clear", clearance_constraints, ClearanceConstraints).declare(
            problem, none, joints, horizon=known
        )
    running = weights.acceleration * ca.sumsqr(accelerations) + weights.velocity * ca.sumsqr(velocities)
    if weights.joint_limits:
        running += weights.joint_limits * joint_limit_index(machine.robot, joints)
    if weights.manipulability:
        running -= weights.manipulability * equations.manipulability(none, joints)
    running += weights.jerk * ca.sumsqr(jerks)
    problem.minimize(running=running, terminal=weights.time * final)
    return problem


def _hold_tips(
    problem: Problem,
    equations: TaskEquations,
    motion: tuple[Any, Any, Any],
    progress: tuple[Any, ...],
    tip_level: str,
    moving: bool,
) -> None:
    """Hold the tips to their tasks: by their poses, or by accelerations, from a start at rest or `moving`."""
    none, (joints, velocities, accelerations) = ca.DM(0, 1), motion
    targets = equations.targets(*progress[:2])
    if tip_level == "position":
        gap = equations.gap(none, joints, velocities, targets)
        problem.path("tip", gap, lower=0, upper=0, unit=equations.unit(""), tolerance=equations.tolerances)
        return
    if moving:
        residual = equations.residual(none, joints, velocities, targets)
        problem.start("tip velocity", residual, lower=0, upper=0, unit=equations.unit())
    gap = equations.acceleration(none, joints, velocities, accelerations, *progress)
    problem.path("tip", gap, lower=0, upper=0, unit=equations.unit("/s^2", "/s^2"))
    for name, stray in equations.deviations(none, joints, velocities, targets).items():
        problem.watch(name, **stray)


def _horizon(problem: Problem, horizon: float | FreeTime) -> Any:
    if isinstance(horizon, FreeTime):
        return problem.horizon(lower=horizon.lower, upper=horizon.upper, guess=horizon.guess)
    return problem.horizon(float(horizon))


def _motion(
    problem: Problem,
    robot: Robot,
    bounds: JointBounds,
    begin: Array,
    start: str,
    resting: Array | None,
    end_joints: Any,
    control: str,
    guess: Mapping[str, Any],
) -> tuple[tuple[Any, Any, Any], Any]:
    """The states and controls of the joints: (positions, velocities, accelerations), and jerks, nothing if not one."""
    n = len(begin)
    joints = problem.state(
        "joints", n, initial=begin, terminal=end_joints, lower=bounds.lower, upper=bounds.upper, guess=guess["joints"],
        unit=robot.unit(),
    )  # fmt: skip
    fast, push, rough = bounds.velocity, bounds.acceleration, bounds.jerk
    velocities = problem.state(
        "velocities", n, initial=0.0 if start == "rest" else None, terminal=resting, lower=-fast, upper=fast,
        guess=guess["velocities"], unit=robot.unit("/s"),
    )  # fmt: skip
    jerks: Any = ca.DM(0, 1)
    declare: Any = problem.state if control == "jerk" else problem.control
    accelerations = declare(
        "accelerations", n, lower=-push, upper=push, guess=guess["accelerations"], unit=robot.unit("/s^2")
    )
    if control == "jerk":
        jerks = problem.control("jerks", n, lower=-rough, upper=rough, unit=robot.unit("/s^3"))
        problem.dynamics(accelerations, jerks)
    problem.dynamics(joints, velocities)
    problem.dynamics(velocities, accelerations)
    return (joints, velocities, accelerations), jerks


def _progress(problem: Problem, start: str, end: str, guess: Mapping[str, Any]) -> tuple[Any, Any, Any]:
    """The path parameter, from 0 to 1, its rate and the rate of that."""
    at = problem.state("path", initial=0.0, terminal=1.0, lower=0.0, upper=1.0, guess=guess["path"])
    first, last = (0.0 if side == "rest" else None for side in (start, end))
    rate = problem.state("path_rate", lower=0.0, guess=guess["path_rate"], initial=first, terminal=last, unit="1/s")
    push = problem.control("path_acceleration", guess=guess["path_acceleration"], unit="1/s^2")
    problem.dynamics(at, rate)
    problem.dynamics(rate, push)
    return at, rate, push


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
    problem.path("vertical force", force[2], lower=limits.least_force(machine), unit="N")
    if np.isfinite(limits.friction):
        room = ((limits.friction * force[2]) ** 2 - ca.sumsqr(force[:2])) / machine.weight**2
        problem.path("friction", room, lower=0)
    point = center_of_pressure(reaction)
    if isinstance(zmp, IndexAtLeast):
        low, high = zmp.region(machine)
        rows = index_rows(machine, zmp, point, bool(wrenches))
        problem.path("zero moment point", point[rows], lower=low[rows], upper=high[rows], unit="m")
    elif isinstance(zmp, Pinned | Following):
        gap = ca.mtimes(ca.DM(machine.moving_directions), point - zmp.place(machine, problem.time))
        problem.path("zero moment point", gap, lower=0, upper=0, unit="m")
    inside = foot_rows(machine, zmp, point, bool(wrenches))
    if inside.numel():
        problem.path("zero moment point" if isinstance(zmp, InFoot) else "foot", inside, lower=0, unit="m")
