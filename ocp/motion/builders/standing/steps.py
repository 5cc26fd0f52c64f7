"""Least-cost motions of machines whose support changes, such as walking legs or docking bases, and their samples.

A motion is a sequence of stances (`models.machines.stance`), one phase each. A held foot does not move: its
acceleration is zero, with position errors fed back. The load of each held foot but the first is a control. The first
foot, at which the machine is rooted, bears the rest: rate of momentum = weight + sum of loads (Newton-Euler). Each load
must press on its own sole, in it, and lie in the friction cone. So the zero moment point lies in the hull of the held
soles, and the distribution of the load is part of the plan. A foot lands at rest, without an impact.

`resolve_steps` tracks the same footholds with the least joint rates at every time, as a baseline: it ignores what the
ground can bear. The machine falls where the zero moment point leaves the soles, or where a sole would have to pull.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np
import scipy
from numpy.typing import NDArray

from models.checks import Array
from models.machines.stance import Stance
from models.paths import rest_to_rest
from models.robot.kinematics import joint_limit_index, link_frames
from ocp.console import interruptible
from ocp.errors import ProblemError, SolveError, problem_errors, require
from ocp.motion.builders.standing.problem import FreeTime, declare_horizon, declare_joints, limit_torques
from ocp.motion.builders.standing.stances import (
    PLACEMENT_TOLERANCE,
    Steps,
    Swing,
    check_placed,
    first_guess,
    foot_task,
    foothold_equations,
)
from ocp.motion.builders.standing.start import start_inside
from ocp.motion.local.rates import resolve
from ocp.motion.tasks.checks import rates_at_rest
from ocp.motion.tasks.limits import Limits
from ocp.motion.tasks.tip_task import TipTask
from ocp.motion.tasks.tracks import pose_line
from ocp.problem.phases import Phases
from ocp.problem.problem import Problem, remembers_request
from ocp.solution import Solution

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
            words = f"start: the center of mass is {outside:.3g} m outside the support, less its margin; "
            words += "standing_configuration(stance, near, over=...) finds joints in balance"
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
    robot, n = stance.robot, stance.joint_size
    limits.bounds(stance)  # checks the number of their entries, before these are reordered
    bounds = limits.of_joints(steps.order(stance)).bounds(stance, ("velocity", "torque"))
    problem = Problem(steps.names[k])
    final = declare_horizon(problem, phase.duration)
    none, equations = ca.DM(0, 1), foothold_equations(stance) if stance.other_feet else None
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
    limit_torques(problem, robot, torques, bounds.torque)
    running = weights.acceleration * ca.sumsqr(second) + weights.velocity * ca.sumsqr(rates)
    running += weights.joint_limits * joint_limit_index(robot, joints)
    if weights.torque:
        running += weights.torque * ca.sumsqr(torques)
    running += weights.load * sum(ca.sumsqr(load / stance.weight) for load in loads.values())
    problem.minimize(running=running, terminal=weights.time * final if isinstance(phase.duration, FreeTime) else 0)
    return problem


def _declare_load(problem: Problem, stance: Stance, name: str) -> Any:
    """Declare the load on a foot other than the first as a control, and return the load. Shape (6, 1)."""
    rows = stance.load_rows[name]
    guess = [stance.weight / len(stance.footholds) * (row == 5) for row in rows]
    unit = ", ".join(dict.fromkeys("N m" if row < 3 else "N" for row in rows))
    return stance.full_load(name, problem.control(f"{name} load", len(rows), guess=guess, unit=unit))


def _limit_load(problem: Problem, stance: Stance, name: str, load: Any, margin: float, limits: Limits) -> None:
    """Constrain pressure, center of pressure and friction of the load on a foot; a grip has no limits."""
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
    if stance.feet[swing.name].sole is not None and swing.lifted is not None:
        before = float(np.asarray(swing.lifted.position)[2])
        after = before if swing.landing is None else float(np.asarray(swing.landing.position)[2])
        height = 64 * (share * (1 - share)) ** 3 if swing.landing is not None else share**2 * (3 - 2 * share)
        # above the higher of both footholds in the middle: where the ground rises in between is unknown
        risen = ca.fmin(2 * share, 1) if after > before else ca.fmax(2 * share - 1, 0)
        ground = before + (after - before) * rest_to_rest(risen)
        least = clearance * ((1 + GROUND_TOLERANCE) * height - GROUND_TOLERANCE)
        heights = stance.sole_corners(swing.name, joints)[2, :].T - ground - least
        values = _at_random(heights, joints)
        # rows of sole corners coincide in planar machines
        distinct = [i for i in range(len(values)) if not any(np.allclose(values[i], values[j]) for j in range(i))]
        problem.path(f"{swing.name} clearance", heights[distinct], lower=0.0, unit="m")
    if swing.landing is not None:
        equations = foothold_equations(stance, {swing.name: swing.landing})
        none, targets = ca.DM(0, 1), ca.DM(equations.target_function()(0.0))
        gap = equations.error(none, joints, targets)
        problem.end(f"{swing.name} landing", gap, lower=0.0, upper=0.0, unit=equations.unit(""))
        speed = equations.twist(none, joints, rates)
        problem.end(f"{swing.name} landing speed", speed, lower=0.0, upper=0.0, unit=equations.unit())


def _over_support(stance: Stance, joints: Any) -> Any:
    """Return the distances (k, 1), m, of the center of mass from support edges, without distances that are constant."""
    if stance.support is None:
        return ca.DM(0, 1)
    distances = ca.densify(stance.support.distances(stance.center_of_mass(joints)[:2]))
    values = _at_random(distances, joints)
    return distances[[i for i in range(len(values)) if np.ptp(values[i]) > PLACEMENT_TOLERANCE]]


def _at_random(rows: Any, joints: Any) -> Array:
    """Evaluate expressions at three random joint positions, with random values of all other symbols. Shape (k, 3)."""
    rng = np.random.default_rng(0)
    own = ca.vertsplit(joints)
    free = [symbol for symbol in ca.symvar(rows) if not any(ca.is_equal(symbol, each) for each in own)]
    function = ca.Function("rows", [joints, ca.vertcat(ca.DM(0, 1), *free)], [rows])
    samples = [function(rng.normal(size=joints.numel()), rng.uniform(size=len(free))) for _ in range(3)]
    return np.column_stack([np.array(value).ravel() for value in samples])


@dataclass(frozen=True, eq=False)
class StepsMotion:
    """Motion of a legged machine through its stances (sets of feet on the ground) at M times.

    The time at which two phases meet occurs twice.

    Attributes:
        steps: Machine and its stances.
        t: Times. Shape (M,), s.
        phase: Index of the phase of each time. Shape (M,).
        joints, joint_velocities, joint_accelerations, joint_torques: In the robot's joint order. Shape (M, n).
        root_position, root_rotation: Frame of the robot's root link in world. Shapes (M, 3), m, and (M, 3, 3).
        center_of_mass: Its position in world. Shape (M, 3), m.
        loads: By foot: moment about the origin of its sole's frame, and force, in world axes; zero in the air. Shape
            (M, 6), N m and N.
        sole_position, sole_rotation: By foot: frame of its sole in world. Shapes (M, 3), m, and (M, 3, 3).
        zero_moment_point: (x, y) of the sum of the loads. Shape (M, 2), m.
        margin: Distance of the zero moment point from the edge of the hull of the soles, positive inside; nan with a
            grip. Shape (M,), m.
        balance: The same distance of the center of mass. Shape (M,), m.
    """

    steps: Steps
    t: Array
    phase: Array
    joints: Array
    joint_velocities: Array
    joint_accelerations: Array
    joint_torques: Array
    root_position: Array
    root_rotation: Array
    center_of_mass: Array
    loads: Mapping[str, Array]
    sole_position: Mapping[str, Array]
    sole_rotation: Mapping[str, Array]
    zero_moment_point: Array
    margin: Array
    balance: Array

    def held(self, foot: str) -> NDArray[np.bool_]:
        """Return at which of the M times a foot is on the ground. Shape (M,), bool."""
        by_phase = np.array([foot in phase.footholds for phase in self.steps.phases], dtype=bool)
        return np.asarray(by_phase[self.phase.astype(int)], dtype=bool)

    def _load_in_sole(self, foot: str) -> tuple[Array, Array]:
        """Return the moment, N m, and the force, N, on a foot in the axes of its sole. Shape (M, 3) each."""
        turned = np.einsum("kji,kpj->pki", self.sole_rotation[foot], self.loads[foot].reshape(-1, 2, 3))
        return turned[0], turned[1]

    def center_of_pressure(self, foot: str) -> Array:
        """Return the center of pressure (x, y) of a foot in the frame of its sole; nan in the air. Shape (M, 2), m."""
        moment, force = self._load_in_sole(foot)
        with np.errstate(divide="ignore", invalid="ignore"):
            points = np.column_stack([-moment[:, 1], moment[:, 0]]) / force[:, 2:]
        return np.where(self.held(foot)[:, None], points, np.nan)

    def friction(self, foot: str) -> Array:
        """Return the ratio of the tangential to the normal force on a foot; nan in the air. Shape (M,)."""
        _, force = self._load_in_sole(foot)
        with np.errstate(divide="ignore", invalid="ignore"):
            needed = np.linalg.norm(force[:, :2], axis=1) / force[:, 2]
        return np.asarray(np.where(self.held(foot), needed, np.nan))

    def summary(self) -> dict[str, float]:
        """Return duration, smallest margins and largest loads of the motion by name, with their units."""
        soles = [name for name, foot in self.steps.feet.items() if foot.sole is not None]
        return {
            "duration_s": float(self.t[-1]),
            "zmp_margin_min_m": float(np.nanmin(self.margin)),
            "com_margin_min_m": float(np.nanmin(self.balance)),
            "pressure_min_n": float(min(self._load_in_sole(name)[1][self.held(name), 2].min() for name in soles)),
            "friction_max": float(max(np.nanmax(self.friction(name)) for name in soles)),
            "peak_joint_velocity": float(np.abs(self.joint_velocities).max()),
            "peak_joint_torque": float(np.abs(self.joint_torques).max()),
        }


def steps_motion(steps: Steps, solution: Solution, samples: int = 101) -> StepsMotion:
    """Sample a plan of footsteps at evenly spaced times of each phase, including foot loads and joint torques.

    Args:
        steps, solution: The steps, and their plan.
        samples: Number of samples of each phase, both ends included.

    Raises:
        ProblemError: The plan has other phases.
    """
    require.instance("steps_motion: steps", steps, Steps)
    require.instance("steps_motion: solution", solution, Solution)
    count = require.count("steps_motion: samples", samples, least=2)
    times = solution.phases
    if tuple(times) != steps.names:
        words = f"steps_motion: the plan has the phases {list(times)}, the steps {list(steps.names)}"
        raise ProblemError(words, name="solution", value=tuple(times), limit=steps.names)
    parts, share = [], np.linspace(0.0, 1.0, count)
    for k, (name, (begin, end)) in enumerate(times.items()):
        values = solution.phase(name).at_fraction(share)
        foot_loads = {foot: values[f"{foot} load"] for foot in steps.stances[k].other_feet}
        motion = tuple(values[part] for part in ("joints", "velocities", "accelerations"))
        parts.append(sample_stance(steps, k, begin + (end - begin) * share, motion, foot_loads=foot_loads))
    return motion_of(steps, parts)


def motion_of(steps: Steps, parts: Sequence[Mapping[str, Array]]) -> StepsMotion:
    """Join the quantities of each phase, as `sample_stance` returns them, into the motion of a legged machine."""
    whole = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}

    def by_foot(quantity: str) -> dict[str, Array]:
        return {foot: whole.pop(f"{foot} {quantity}") for foot in steps.feet}

    loads, places, turns = by_foot("load"), by_foot("position"), by_foot("rotation")
    return StepsMotion(steps, loads=loads, sole_position=places, sole_rotation=turns, **whole)


def sample_stance(
    steps: Steps, k: int, times: Array, motion: tuple[Array, ...], *, foot_loads: Mapping[str, Array]
) -> dict[str, Array]:
    """Return the samples of a motion in phase k by name, as in `StepsMotion`: loads, margins and torques at M times.

    The motion and the loads of all feet but the first, in the rows `Stance.load_rows`, are in the stance's joint order.
    """
    stance = steps.stances[k]
    symbols, rows, loads = _symbols_of_loads(stance)
    root = link_frames(stance.robot, symbols[0], stance.world_from_base())[steps.robot.root]
    center, balance_point = stance.center_of_mass(symbols[0]), stance.zero_moment_point(loads)
    outputs = {
        "joint_torques": stance.joint_torques(*symbols, {name: loads[name] for name in stance.other_feet}),
        "root_position": root.position,
        "root_rotation": ca.vec(root.rotation.T),
        "center_of_mass": center,
        "zero_moment_point": balance_point,
        "margin": ca.DM(np.nan) if stance.support is None else stance.support.margin(balance_point),
        "balance": ca.DM(np.nan) if stance.support is None else stance.support.margin(center[:2]),
    }
    for name in steps.feet:
        frame = stance.sole_frame(name, symbols[0])
        outputs[f"{name} load"] = loads.get(name, ca.DM.zeros(6))
        outputs[f"{name} position"] = frame.position
        outputs[f"{name} rotation"] = ca.vec(frame.rotation.T)
    function = ca.Function("motion", [*symbols, rows], list(map(ca.densify, outputs.values())), {"cse": True})
    stacked = np.column_stack([np.zeros((len(times), 0)), *foot_loads.values()])
    sampled = function.map(len(times))(*(part.T for part in (*motion, stacked)))
    values = {name: np.array(value).T for name, value in zip(outputs, sampled, strict=True)}
    values |= dict(zip(("joints", "joint_velocities", "joint_accelerations"), motion, strict=True))
    for name, value in values.items():
        if name.startswith("joint"):
            values[name] = steps.in_order(stance, value)
        elif name.endswith("rotation"):
            values[name] = value.reshape(-1, 3, 3)
    values |= {"margin": values["margin"].ravel(), "balance": values["balance"].ravel()}
    return {"t": times, "phase": np.full(len(times), float(k)), **values}


def _symbols_of_loads(stance: Stance) -> tuple[tuple[Any, Any, Any], Any, dict[str, Any]]:
    """Return symbols of the joint motion, symbols of the loads on all feet but the first, and the loads on all feet."""
    n = stance.joint_size
    symbols = ca.SX.sym("q", n), ca.SX.sym("qd", n), ca.SX.sym("qdd", n)
    rows = {name: ca.SX.sym("load", len(stance.load_rows[name])) for name in stance.other_feet}
    loads = stance.loads(*symbols, {name: stance.full_load(name, part) for name, part in rows.items()})
    return symbols, ca.vertcat(ca.SX(0, 1), *rows.values()), loads


def resolve_steps(steps: Steps, *, start: Any, samples: int = 101) -> StepsMotion:
    """Compute a motion through the stances of a legged machine by resolved-rate control with the least joint rates.

    A lifted foot moves to its next foothold from rest to rest. Seen from above its path is straight; at the share s of
    the path it is raised by 64 s^3 (1 - s)^3 times the steps' clearance. A foot without a next foothold follows the
    others. The held feet share the load so that the sum of the squared loads is least.

    Args:
        steps: Robot and its stances; a free duration takes its guess.
        start: Joint positions in the robot's order, with the feet on their footholds. Shape (n,), rad or m.
        samples: Number of samples of each phase, both ends included.

    Raises:
        ProblemError: Sizes or values do not fit, or a foot is off its foothold at the start.
        SolveError: The motion breaks down, for example at a stretched leg; names the phase and the time in it.
    """
    require.instance("resolve_steps: steps", steps, Steps)
    count = require.count("resolve_steps: samples", samples, least=2)
    joints = require.array("start", start, (steps.robot.dof,), meaning="one entry for each joint")
    check_placed(steps.stances[0], joints[steps.order(steps.stances[0])])
    parts, begin = [], 0.0
    for k, stance in enumerate(steps.stances):
        t = np.linspace(0.0, steps.phases[k].seconds, count)
        motion = _resolve_phase(steps, k, joints[steps.order(stance)], t)
        parts.append(sample_stance(steps, k, begin + t, motion, foot_loads=_least_loads(stance, motion)))
        joints, begin = parts[-1]["joints"][-1], begin + t[-1]
    return motion_of(steps, parts)


def _resolve_phase(steps: Steps, k: int, joints: Array, t: Array) -> tuple[Array, Array, Array]:
    """Return the resolved-rate motion in phase k: joint positions, rates and accelerations, in the stance's order."""
    stance = steps.stances[k]
    swings = [swing for swing in steps.swings(k) if swing.lifted is not None and swing.landing is not None]
    if not swings:
        still = np.zeros((len(t), len(joints)))
        return still + joints, still, still
    held = [(name, stance.footholds[name]) for name in stance.other_feet]
    tasks = [foot_task(stance, name, place.position, place.rotation) for name, place in held]
    tasks += [_swing_task(stance, swing, t[-1], steps.clearance) for swing in swings]
    local = resolve(stance, tasks, t[-1], start=joints, samples=t)
    if local.stopped is not None:
        words = f"phase {steps.names[k]!r}: the pseudo-inverse breaks down at {local.t[-1]:.4g} s: {local.stopped}"
        raise SolveError(words, name=steps.names[k], time=float(local.t[-1]))
    return local.joints, local.joint_rates, scipy.interpolate.CubicSpline(t, local.joint_rates).derivative()(t)


def _swing_task(stance: Stance, swing: Swing, seconds: float, clearance: float) -> TipTask:
    """Return the task of moving a foot from one foothold to the next, from rest to rest."""
    lifted, landing = swing.lifted, swing.landing
    assert lifted is not None
    assert landing is not None
    line = pose_line((lifted.rotation, lifted.position), (landing.rotation, landing.position), seconds)

    def position(t: Any) -> Any:
        s = t / seconds
        return line.position(t) + 64 * (s * (1 - s)) ** 3 * clearance * ca.DM(np.asarray(landing.rotation)[:, 2])

    return foot_task(stance, swing.name, position, line.orientation, duration=seconds)


def _least_loads(stance: Stance, motion: tuple[Array, Array, Array]) -> dict[str, Array]:
    """Return the loads (M, k) of all feet but the first for which the sum of the squared loads of all feet is least."""
    sizes = {name: len(stance.load_rows[name]) for name in stance.other_feet}
    if not sizes:
        return {}
    symbols, free, loads = _symbols_of_loads(stance)
    every = ca.vertcat(*loads.values())
    slope = ca.jacobian(every, free)
    rest = ca.substitute(every, free, ca.DM.zeros(free.shape))
    least = -ca.solve(ca.mtimes(slope.T, slope), ca.mtimes(slope.T, rest))
    function = ca.Function("shared", symbols, [ca.densify(least)], {"cse": True})
    values = np.array(function.map(len(motion[0]))(*(part.T for part in motion))).T
    return dict(zip(sizes, np.split(values, np.cumsum([*sizes.values()])[:-1], axis=1), strict=True))
