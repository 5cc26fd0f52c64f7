"""Least-cost motions of machines whose support changes, such as walking legs or docking bases.

A motion is a sequence of stances (`models.machines.stance`), one phase each. A held foot does not move: its
acceleration is zero, with position errors fed back. The load of each held foot but the first is a control. The first
foot, at which the machine is rooted, bears the rest: rate of momentum = weight + sum of loads (Newton-Euler). Each load
must press on its own sole, in it, and lie in the friction cone. So the zero moment point lies in the hull of the held
soles, and the distribution of the load is part of the plan. A foot lands at rest, without an impact.

With balance "static" the center of mass, too, stays over the support: the machine can be stopped softly anywhere.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np

from models.checks import Array
from models.machines.stance import Stance
from models.paths import rest_to_rest
from models.robot.kinematics import joint_limit_index
from ocp.console import interruptible
from ocp.errors import ProblemError, problem_errors, require
from ocp.motion.builders.standing.problem import FreeTime, declare_horizon, declare_joints
from ocp.motion.builders.standing.stances import (
    PLACEMENT_TOLERANCE,
    Steps,
    Swing,
    check_placed,
    first_guess,
    foothold_equations,
)
from ocp.motion.builders.standing.start import start_inside
from ocp.motion.tasks.checks import rates_at_rest
from ocp.motion.tasks.limits import JointBounds, Limits
from ocp.problem.phases import Phases
from ocp.problem.problem import Problem, remembers_request

GROUND_TOLERANCE = 0.01  # share of the clearance that a sole may be below the ground where it lifts and lands
GUESSED_LIFT = 1.5  # height of a foot halfway in the guess, over the clearance


@dataclass(frozen=True)
class StepWeights:
    """Weights of the terms of the cost of `steps_problem`: integrals over the motion, and free durations of phases.

    Attributes:
        acceleration, velocity: Weights of the sums of squares over the joints.
        torque: Weight of the sum of squared joint torques, 1/(N m)^2/s.
        joint_limits: Weight of the joint-limit index p1, equation (23) of Yoo et al. 2004.
        load: Weight of the squared loads of the feet, in units of the machine's weight (and 1 m). It distributes the
            load.
        time: Weight of the free durations, 1/s.
    """

    acceleration: float = 0.01
    velocity: float = 0.01
    torque: float = 0.0
    joint_limits: float = 1.0
    load: float = 0.01
    time: float = 0.0

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            require.nonnegative(f"step weights: {name}", value)


@remembers_request("steps")
@interruptible
def steps_problem(steps: Steps, *, start: Any, cost: StepWeights | None = None, limits: Limits | None = None) -> Phases:
    """Declare the optimal control problem of a rest-to-rest motion through stances (sets of feet on the ground).

    The phases have the names `Steps.names`; joint vectors of a phase are in its stance's order. The states are "joints"
    and "velocities". The controls are "accelerations", and "FOOT load" of each held foot but the first, in the rows
    `Stance.load_rows`. The path constraints are

    - "feet": the held feet do not move;
    - "FOOT pressure": normal force, N;
    - "FOOT center of pressure": distance from the edges of the sole times its share of the weight, m;
    - "FOOT friction": difference of squared forces over the squared weight;
    - "torques", and "FOOT clearance" of a foot in the air, m.

    A phase ends with "FOOT landing", and the motion with "balance", the center of mass over the support, m.

    Args:
        steps: Robot and its stances.
        start: Configuration in the robot's order, with the feet on footholds, see `standing_configuration`. Shape (n,).
        cost: Weights of the cost.
        limits: Limits of joints and ground. `vertical_force` is the least normal force of a held sole, N; 0 if None.

    Returns:
        The problem, with a guess that interpolates between standing configurations.

    Raises:
        ProblemError: Sizes or values do not fit; the start is outside the limits, off the footholds or out of balance;
            no configuration reaches the footholds; the margin leaves no room; power or jerk is limited.
    """
    require.instance("steps_problem: steps", steps, Steps)
    limits = Limits() if limits is None else require.instance("steps_problem: limits", limits, Limits)
    weights = StepWeights() if cost is None else require.instance("steps_problem: cost", cost, StepWeights)
    for name in ("power", "jerk"):
        if getattr(limits, name) is not None:
            words = f"limits: steps have no limit of {name}; limit torques and accelerations"
            raise ProblemError(words, name=name, value=getattr(limits, name))
    begin = require.array("start", start, (steps.robot.dof,), meaning="one entry for each joint")
    first = steps.stances[0]
    own = start_inside(first, begin[steps.order(first)], first.robot.lower, first.robot.upper)
    check_placed(first, own)
    if first.support is not None:
        outside = steps.margin - float(first.support.margin(first.center_of_mass(own)[:2]))
        if outside > PLACEMENT_TOLERANCE:
            words = (
                f"start: the center of mass is {outside:.3g} m outside the support, less its margin; "
                "standing_configuration(stance, near, over=...) finds joints in balance"
            )
            raise ProblemError(words, name="start", value=outside, limit=0.0)
    begin = steps.in_order(first, own[None])[0]
    guesses = first_guess(steps, begin, GUESSED_LIFT * steps.clearance)
    problems = {}
    for k, name in enumerate(steps.names):
        with problem_errors(f"phase {name!r}: "):
            problems[name] = _declare_phase(steps, k, own if k == 0 else None, guesses[k], weights, limits)
    whole = Phases("steps", problems)
    for k, (before, after) in enumerate(zip(steps.names[:-1], steps.names[1:], strict=True)):
        old, new = steps.order(steps.stances[k]), steps.order(steps.stances[k + 1])
        places = [int(np.flatnonzero(old == index)[0]) for index in new]
        whole.join(before, after, {part: whole[before].at_end(part)[places] for part in ("joints", "velocities")})
    return whole


def _declare_phase(
    steps: Steps, k: int, start: Array | None, guess: dict[str, Any], weights: StepWeights, limits: Limits
) -> Problem:
    """Declare the problem of phase k of `steps_problem`, in which some feet are held and others swing."""
    phase, stance, last = steps.phases[k], steps.stances[k], k + 1 == len(steps.phases)
    robot, n, bounds = stance.robot, stance.joint_size, _stance_bounds(steps, stance, limits)
    problem = Problem(steps.names[k])
    final = declare_horizon(problem, phase.duration)
    none = ca.DM(0, 1)
    equations = foothold_equations(stance) if stance.other_feet else None

    stationary: Any = None
    if last:
        stationary = np.zeros(n) if equations is None else rates_at_rest(equations, (), guess["joints"].values[-1])
    starts, ends = (start, None if start is None else 0.0), (None, stationary)
    joints, rates, second, _ = declare_joints(problem, robot, bounds, guess, starts=starts, ends=ends)
    if equations is not None:
        gap = equations.acceleration(none, joints, rates, second, progress=(problem.time,))
        problem.path("feet", gap, lower=0, upper=0, unit=equations.unit("/s^2", "/s^2"))
        for name, deviation in equations.deviations(none, joints, rates, equations.targets(problem.time)).items():
            problem.watch(name.replace("task", "feet"), **deviation)
    for swing in steps.swings(k):
        _constrain_swing(problem, stance, swing, (joints, rates), problem.time / final, steps.clearance)
    over = _over_support(stance, joints)
    if over.numel():
        if steps.balance == "static":
            problem.path("balance", over, lower=steps.margin, unit="m")
        elif last:
            problem.end("balance", over, lower=steps.margin, unit="m")

    foot_loads = {name: _declare_load(problem, stance, name) for name in stance.other_feet}
    loads = stance.loads(joints, rates, second, foot_loads)
    for name, load in loads.items():
        _limit_load(problem, stance, name, load, steps.margin, limits)
    torques = stance.joint_torques(joints, rates, second, foot_loads)
    effort = bounds.torque
    limited = np.flatnonzero(np.isfinite(effort)).tolist()
    if limited:
        problem.path("torques", torques[limited], lower=-effort[limited], upper=effort[limited], unit=robot.effort_unit)
    running = weights.acceleration * ca.sumsqr(second) + weights.velocity * ca.sumsqr(rates)
    running += weights.joint_limits * joint_limit_index(robot, joints)
    if weights.torque:
        running += weights.torque * ca.sumsqr(torques)
    running += weights.load * sum(ca.sumsqr(load / stance.weight) for load in loads.values())
    free = isinstance(phase.duration, FreeTime)
    problem.minimize(running=running, terminal=weights.time * final if free else 0)
    return problem


def _stance_bounds(steps: Steps, stance: Stance, limits: Limits) -> JointBounds:
    """Return the limits of joints and actuators by name, reordered from the robot's joint order to that of a stance."""
    order = steps.order(stance)
    bounds = limits.bounds(stance, ("velocity", "torque"))._asdict()
    for name in bounds:
        explicit = getattr(limits, name, None) if name not in ("lower", "upper") else None
        if explicit is not None and np.size(explicit) != 1:
            bounds[name] = np.asarray(explicit, dtype=float).ravel()[order]
    return JointBounds(**bounds)


def _declare_load(problem: Problem, stance: Stance, name: str) -> Any:
    """Declare the load on a foot other than the first as a control, and return the load. Shape (6, 1)."""
    rows = stance.load_rows[name]
    share = stance.weight / len(stance.footholds)
    guess = [share * (row == 5) for row in rows]
    unit = ", ".join(dict.fromkeys("N m" if row < 3 else "N" for row in rows))
    return stance.full_load(name, problem.control(f"{name} load", len(rows), guess=guess, unit=unit))


def _limit_load(problem: Problem, stance: Stance, name: str, load: Any, margin: float, limits: Limits) -> None:
    """Constrain a foot's load to what its sole can bear; the load of a grip is not limited."""
    if stance.feet[name].sole is None:
        return
    least = 0.0 if limits.vertical_force is None else float(limits.vertical_force)
    problem.path(f"{name} pressure", stance.pressure(name, load), lower=least, unit="N")
    inside = stance.edge_moments(name, load, margin) / stance.weight
    if inside.numel():
        problem.path(f"{name} center of pressure", inside, lower=0.0, unit="m")
    if np.isfinite(limits.friction):
        reserve = stance.friction_margin(name, load, limits.friction) / stance.weight**2
        problem.path(f"{name} friction", reserve, lower=0.0)


def _constrain_swing(
    problem: Problem, stance: Stance, swing: Swing, motion: tuple[Any, Any], share: Any, clearance: float
) -> None:
    """Constrain the sole of a swinging foot to stay above the ground and to land at rest on its foothold."""
    joints, rates = motion
    none = ca.DM(0, 1)
    foot = stance.feet[swing.name]
    if foot.sole is not None and swing.lifted is not None:
        before = float(np.asarray(swing.lifted.position)[2])
        after = before if swing.landing is None else float(np.asarray(swing.landing.position)[2])
        height = 64 * (share * (1 - share)) ** 3 if swing.landing is not None else share**2 * (3 - 2 * share)
        # above the higher of both footholds in the middle: where the ground rises in between is unknown
        risen = ca.fmin(2 * share, 1) if after > before else ca.fmax(2 * share - 1, 0)
        ground = before + (after - before) * rest_to_rest(risen)
        least = clearance * ((1 + GROUND_TOLERANCE) * height - GROUND_TOLERANCE)
        heights = stance.sole_corners(swing.name, joints)[2, :].T - ground - least
        rows = _distinct_rows(heights, joints)
        problem.path(f"{swing.name} clearance", heights[rows], lower=0.0, unit="m")
    if swing.landing is not None:
        equations = foothold_equations(stance, {swing.name: swing.landing})
        targets = ca.DM(equations.target_function()(0.0))
        gap = equations.error(none, joints, targets)
        problem.end(f"{swing.name} landing", gap, lower=0.0, upper=0.0, unit=equations.unit(""))
        speed = equations.twist(none, joints, rates)
        problem.end(f"{swing.name} landing speed", speed, lower=0.0, upper=0.0, unit=equations.unit())


def _distinct_rows(rows: Any, joints: Any) -> list[int]:
    """Return the indices of the distinct rows of a constraint; in planar machines, corners of soles coincide."""
    rng = np.random.default_rng(0)
    others = [
        symbol for symbol in ca.symvar(rows) if not any(ca.is_equal(symbol, each) for each in ca.vertsplit(joints))
    ]
    inputs = [joints, ca.vertcat(ca.DM(0, 1), *others)]
    function = ca.Function("rows", inputs, [rows])
    samples = [function(rng.normal(size=joints.numel()), rng.uniform(size=len(others))) for _ in range(3)]
    values = np.column_stack([np.array(value).ravel() for value in samples])
    return [i for i in range(len(values)) if not any(np.allclose(values[i], values[j]) for j in range(i))]


def _over_support(stance: Stance, joints: Any) -> Any:
    """Return those distances, m, of the center of mass from support edges that the joints can change. Shape (k, 1)."""
    if stance.support is None:
        return ca.DM(0, 1)
    distances = ca.densify(stance.support.distances(stance.center_of_mass(joints)[:2]))
    rng = np.random.default_rng(0)
    function = ca.Function("distances", [joints], [distances])
    values = np.column_stack([np.array(function(rng.normal(size=joints.numel()))).ravel() for _ in range(3)])
    return distances[[i for i in range(len(values)) if np.ptp(values[i]) > PLACEMENT_TOLERANCE]]
