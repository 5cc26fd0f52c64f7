"""Machines whose support changes: steps of legs, bases that dock; each foot holds where it stands, at the least cost.

A motion is a sequence of stances (`models.machines.stance`), one phase each, whose joints and velocities go on from one
to the next. A foot that is held does not move: its acceleration is zero, with gaps fed back. What it bears is a
control, and the first foot, at which the machine is rooted, bears the rest,

    rate of momentum = weight + sum of loads (Newton-Euler),   each load on its own sole: it presses, its center of
    pressure is in the sole, it is in the friction cone,

so that the zero moment point lies in the hull of the soles that are held, and how they share the load is shown. A foot
lands on its foothold at rest: there is no impact. Between lifting and landing its sole is kept above the ground.

balance "dynamic" asks no more. "static" also keeps the center of mass over the support, the hull of the soles that are
held, so that the machine stands wherever it is stopped, if softly: quasi-static steps.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import casadi as ca
import numpy as np

from models.arrays import Array
from models.errors import ModelError
from models.machines.stance import Stance
from models.paths import rest_to_rest
from models.robot.indices import joint_limit_index
from ocp.console import interruptible
from ocp.errors import ProblemError, checked_choice, checked_instance, checked_nonnegative
from ocp.motion.builders.standing.problem import FreeTime
from ocp.motion.builders.standing.stances import PLACED, StancePhase, Steps, Swing, check_placed, first_guess, hold
from ocp.motion.builders.standing.start import start_inside
from ocp.motion.tasks.checks import checked_numbers, rates_at_rest
from ocp.motion.tasks.limits import Limits
from ocp.problem.phases import Phases
from ocp.problem.problem import Problem

__all__ = ["StepWeights", "steps_problem"]

GRAZED = 0.01  # share of the clearance that a sole may be below the ground where it lifts and lands
LIFTED = 1.5  # height of a foot in the middle of its way in the guess, over the clearance


@dataclass(frozen=True)
class StepWeights:
    """Of the parts of the cost, an integral over the motion plus `time` times the durations that are free.

    Attributes:
        acceleration, velocity: Of the sums of squares over the joints. torque: Of that of their torques, 1/(N m)^2/s.
        joint_limits: Of the joint-limit index p1 (23).
        load: Of the squared loads of the feet, over the weight (and 1 m): which makes them share it.
        time: Of the durations that are free, 1/s.
    """

    acceleration: float = 0.01
    velocity: float = 0.01
    torque: float = 0.0
    joint_limits: float = 1.0
    load: float = 0.01
    time: float = 0.0

    def __post_init__(self) -> None:
        for what, value in vars(self).items():
            checked_nonnegative(f"step weights: {what}", value)


@dataclass(frozen=True)
class _Asked:
    """What is asked of every phase."""

    balance: str
    margin: float
    clearance: float
    weights: StepWeights
    limits: Limits


@interruptible
def steps_problem(
    steps: Steps,
    start_joints: Any,
    *,
    balance: Literal["dynamic", "static"] = "dynamic",
    margin: float = 0.0,
    clearance: float = 0.02,
    weights: StepWeights | None = None,
    limits: Limits | None = None,
) -> Phases:
    """Take the stances one after the other from rest to rest, at the least cost.

    The phases bear the names of `Steps.names`; joint vectors in a phase are in its stance's order. States "joints",
    "velocities"; controls "accelerations", and "FOOT load" of every foot that is held besides the first, in the rows
    `Stance.held_rows`. Path constraints "feet" (they do not move); "FOOT pressure", N; "FOOT center of pressure", its
    distance from the edges of the sole times its share of the weight, m; "FOOT friction", squares over the squared
    weight; "torques"; "FOOT clearance" of a foot in the air, m. At the end of a phase "FOOT landing", and at the end of
    all "balance", the center of mass over the support, m.

    Args:
        steps: The robot and its stances.
        start_joints: In the robot's order, with the feet on their footholds; `standing_configuration` finds some. (n,).
        balance: "static" asks for "balance" all the way; not in stances with a grip.
        margin: By which centers of pressure, and the center of mass where it is asked, stay inside, m. It has to cover
            by how much the machine leans out where ground and joints give, which are rigid here; most where it stays
            near an edge, and at corners of a sole, as in a walk in balance.
        clearance: Height of a sole above the ground in the middle of its way, m; 64 s^3 (1 - s)^3 of it at the share s.
            Ground that is higher at the end of the way rises in its first half, lower ground falls in the second.
        weights: Of the parts of the cost.
        limits: Of joints and ground. `vertical_force` is the least of any sole that is held, N; nothing if None.

    Returns:
        The problem, with a guess from posture to posture.

    Raises:
        ProblemError: Sizes or values that do not fit, a start outside the limits, off the footholds or out of balance,
            footholds that no posture reaches, a margin that leaves no room, limits of what is not limited here.
    """
    checked_instance("steps_problem: steps", steps, Steps)
    limits = Limits() if limits is None else checked_instance("steps_problem: limits", limits, Limits)
    if weights is None:
        weights = StepWeights()
    checked_instance("steps_problem: weights", weights, StepWeights)
    checked_choice("balance", balance, ("dynamic", "static"))
    for what, value in (("margin", margin), ("clearance", clearance)):
        checked_nonnegative(f"steps_problem: {what}", value)
    for what in ("power", "jerk"):
        if getattr(limits, what) is not None:
            words = f"limits: steps know no {what}; limit torques and accelerations"
            raise ProblemError(words, name=what, value=getattr(limits, what))
    begin = checked_numbers(start_joints, steps.robot.dof, "start_joints", "one entry for each joint")
    asked = _Asked(balance, float(margin), float(clearance), weights, limits)
    first = steps.stances[0]
    own = start_inside(first, begin[steps.order(first)], first.robot.lower, first.robot.upper)
    _check_start(first, own, asked)
    begin = steps.in_order(first, own[None])[0]
    guesses = first_guess(steps, begin, LIFTED * clearance)
    problems = {}
    for k, name in enumerate(steps.names):
        try:
            problems[name] = _phase(steps, k, own if k == 0 else None, guesses[k], asked)
        except ModelError as error:
            raise ProblemError(f"phase {name!r}: {error}", **vars(error)) from error
    whole = Phases("steps", problems)
    for k, (before, after) in enumerate(zip(steps.names[:-1], steps.names[1:], strict=True)):
        one, other = steps.order(steps.stances[k]), steps.order(steps.stances[k + 1])
        places = [int(np.flatnonzero(one == index)[0]) for index in other]
        whole.join(before, after, {part: whole[before].at_end(part)[places] for part in ("joints", "velocities")})
    return whole


def _check_start(stance: Stance, joints: Array, asked: _Asked) -> None:
    """Raise ProblemError where a foot is not on its foothold, or the center of mass not over the support."""
    check_placed(stance, joints)
    if stance.support is not None:
        left = float(stance.support.margin(stance.center_of_mass(joints)[:2])) - asked.margin
        if left < -PLACED:
            words = (
                f"start_joints: the center of mass is {-left:.3g} m outside the support, less its margin; "
                "standing_posture(stance, near, over=...) finds a posture in balance"
            )
            raise ProblemError(words, name="start_joints", value=-left, limit=0.0)


def _phase(steps: Steps, k: int, start: Array | None, guess: dict[str, Any], asked: _Asked) -> Problem:
    """The problem of a phase."""
    phase, stance, last = steps.phases[k], steps.stances[k], k + 1 == len(steps.phases)
    robot, n, weights = stance.robot, stance.joint_size, asked.weights
    bounds = _bounds(steps, stance, asked.limits)
    problem = Problem(steps.names[k])
    final = _horizon(problem, phase)
    none = ca.DM(0, 1)
    equations = hold(stance, {name: phase.footholds[name] for name in stance.others}) if stance.others else None

    resting: Any = None
    if last:
        resting = np.zeros(n) if equations is None else rates_at_rest(equations, (), guess["joints"].values[-1])
    joints = problem.state(
        "joints", n, initial=start, lower=bounds["lower"], upper=bounds["upper"], guess=guess["joints"],
        unit=robot.unit(),
    )  # fmt: skip
    rates = problem.state(
        "velocities", n, initial=None if start is None else 0.0, terminal=resting, lower=-bounds["velocity"],
        upper=bounds["velocity"], guess=guess["velocities"], unit=robot.unit("/s"),
    )  # fmt: skip
    push = bounds["acceleration"]
    second = problem.control(
        "accelerations", n, lower=-push, upper=push, guess=guess["accelerations"], unit=robot.unit("/s^2")
    )
    problem.dynamics(joints, rates)
    problem.dynamics(rates, second)
    if equations is not None:
        gap = equations.acceleration(none, joints, rates, second, problem.time)
        problem.path("feet", gap, lower=0, upper=0, unit=equations.unit("/s^2", "/s^2"))
        for name, stray in equations.deviations(none, joints, rates, equations.targets(problem.time)).items():
            problem.watch(name.replace("task", "feet"), **stray)
    for swing in steps.swings(k):
        _swing(problem, stance, swing, (joints, rates), problem.time / final, asked.clearance)
    over = _over_support(stance, joints)
    if over.numel():
        if asked.balance == "static":
            problem.path("balance", over, lower=asked.margin, unit="m")
        elif last:
            problem.end("balance", over, lower=asked.margin, unit="m")

    others = {name: _load(problem, stance, name) for name in stance.others}
    loads = stance.loads(joints, rates, second, others)
    for name, load in loads.items():
        _bear(problem, stance, name, load, asked)
    torques = stance.joint_torques(joints, rates, second, others)
    effort = bounds["torque"]
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


def _bounds(steps: Steps, stance: Stance, limits: Limits) -> dict[str, Array]:
    """Limits of the joints in the order of a stance; those that are given are in the robot's."""
    order = steps.order(stance)
    own = limits.bounds(stance, ("velocity", "torque"))
    found = {}
    for what, value in own._asdict().items():
        given = getattr(limits, what, None) if what not in ("lower", "upper") else None
        found[what] = value if given is None or np.size(given) == 1 else np.asarray(given, dtype=float).ravel()[order]
    return found


def _horizon(problem: Problem, phase: StancePhase) -> Any:
    if isinstance(phase.duration, FreeTime):
        return problem.horizon(lower=phase.duration.lower, upper=phase.duration.upper, guess=phase.duration.guess)
    return problem.horizon(float(phase.duration))


def _load(problem: Problem, stance: Stance, name: str) -> Any:
    """The load of a foot besides the first, a control in the rows that are resisted. Shape (6, 1)."""
    rows = stance.held_rows[name]
    share = stance.weight / len(stance.footholds)
    guess = [share * (row == 5) for row in rows]
    unit = ", ".join(dict.fromkeys("N m" if row < 3 else "N" for row in rows))
    return stance.full_load(name, problem.control(f"{name} load", len(rows), guess=guess, unit=unit))


def _bear(problem: Problem, stance: Stance, name: str, load: Any, asked: _Asked) -> None:
    """What a foot's sole can bear; nothing of a grip."""
    if stance.feet[name].sole is None:
        return
    least = 0.0 if asked.limits.vertical_force is None else float(asked.limits.vertical_force)
    problem.path(f"{name} pressure", stance.pressure(name, load), lower=least, unit="N")
    inside = stance.inside(name, load, asked.margin) / stance.weight
    if inside.numel():
        problem.path(f"{name} center of pressure", inside, lower=0.0, unit="m")
    if np.isfinite(asked.limits.friction):
        room = stance.grip(name, load, asked.limits.friction) / stance.weight**2
        problem.path(f"{name} friction", room, lower=0.0)


def _swing(
    problem: Problem, stance: Stance, swing: Swing, motion: tuple[Any, Any], share: Any, clearance: float
) -> None:
    """A foot in the air: its sole above the ground on the way, on its foothold and at rest where it lands."""
    joints, rates = motion
    none = ca.DM(0, 1)
    foot = stance.feet[swing.name]
    if foot.sole is not None and swing.lifted is not None:
        before = float(np.asarray(swing.lifted.position)[2])
        after = before if swing.landing is None else float(np.asarray(swing.landing.position)[2])
        way = 64 * (share * (1 - share)) ** 3 if swing.landing is not None else share**2 * (3 - 2 * share)
        # over the higher of both in the middle: where the ground rises in between is not told
        risen = ca.fmin(2 * share, 1) if after > before else ca.fmax(2 * share - 1, 0)
        ground = before + (after - before) * rest_to_rest(risen)
        least = clearance * ((1 + GRAZED) * way - GRAZED)
        heights = stance.sole_corners(swing.name, joints)[2, :].T - ground - least
        rows = _apart(heights, joints)
        problem.path(f"{swing.name} clearance", heights[rows], lower=0.0, unit="m")
    if swing.landing is not None:
        equations = hold(stance, {swing.name: swing.landing})
        targets = ca.DM(equations.target_function()(0.0))
        gap = equations.error(none, joints, targets)
        problem.end(f"{swing.name} landing", gap, lower=0.0, upper=0.0, unit=equations.unit(""))
        speed = equations.twist(none, joints, rates)
        problem.end(f"{swing.name} landing speed", speed, lower=0.0, upper=0.0, unit=equations.unit())


def _apart(rows: Any, joints: Any) -> list[int]:
    """The rows that are not the same as an earlier one whatever the joints, as corners beside each other in a plane."""
    rng = np.random.default_rng(0)
    others = [
        symbol for symbol in ca.symvar(rows) if not any(ca.is_equal(symbol, each) for each in ca.vertsplit(joints))
    ]
    inputs = [joints, ca.vertcat(ca.DM(0, 1), *others)]
    function = ca.Function("rows", inputs, [rows])
    drawn = [function(rng.normal(size=joints.numel()), rng.uniform(size=len(others))) for _ in range(3)]
    values = np.column_stack([np.array(value).ravel() for value in drawn])
    return [i for i in range(len(values)) if not any(np.allclose(values[i], values[j]) for j in range(i))]


def _over_support(stance: Stance, joints: Any) -> Any:
    """Distances of the center of mass from the edges of the support that the joints can change. Shape (k, 1), m."""
    if stance.support is None:
        return ca.DM(0, 1)
    distances = ca.densify(stance.support.distances(stance.center_of_mass(joints)[:2]))
    rng = np.random.default_rng(0)
    function = ca.Function("distances", [joints], [distances])
    values = np.column_stack([np.array(function(rng.normal(size=joints.numel()))).ravel() for _ in range(3)])
    return distances[[i for i in range(len(values)) if np.ptp(values[i]) > PLACED]]
