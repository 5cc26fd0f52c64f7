"""Sample plans, solutions of optimal control problems, and joint trajectories for display.

Every motion is sampled once, together with its targets, limits, costs, closest bodies and audit, as far as known.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import casadi as ca
import numpy as np
import scipy

from models import FreeFloating, Machine, Standing
from models.checks import Array
from models.machines.standing import center_of_pressure
from ocp.app.check.data_checks import clean_trajectory
from ocp.app.check.joint_limits import Row, interpolate
from ocp.app.check.motion_checks import integrate_base, torque_expression
from ocp.app.check.verdict import PlanVerdict, audit_rows, verdict_of
from ocp.app.files import RawTrajectory
from ocp.app.view.appearance import Obstacle, obstacles_of, obstacles_of_plan
from ocp.audit.audit import Audit
from ocp.audit.clearance import closest_pairs_along
from ocp.errors import ProblemError, require
from ocp.motion.plan import Plan
from ocp.motion.tasks.limits import JointBounds, Limits
from ocp.motion.tasks.targets import Target
from ocp.problem.formulation import Formulation
from ocp.problem.values import Sampler
from ocp.solution import Solution
from ocp.solution_data import match_order, unstack
from ocp.tolerances import ROUNDING_SHARE


@dataclass(frozen=True, eq=False)
class Curve:
    """A quantity as a function of time along a motion; curves of one group share a diagram.

    Attributes:
        group, name, unit: Group, name and unit of the quantity; the unit is "" if it has none.
        values: Values at the motion's M times. Shape (M,).
        lower, upper: Limits of the quantity, infinite if there are none.
    """

    group: str
    name: str
    unit: str
    values: Array
    lower: float = -np.inf
    upper: float = np.inf


class MotionSamples(NamedTuple):
    """Times (M,), s, joint positions and velocities (M, n), and base configurations (M, base_size) of a motion.

    Accelerations are None if the motion is not smooth enough, base rates if they are unknown.
    """

    t: Array
    joints: Array
    rates: Array
    accelerations: Array | None
    base: Array
    base_rates: Array | None


@dataclass(frozen=True, eq=False)
class GroundContact:
    """Corners (k, 2) of the contact area, zero moment points (M, 2), m, and whether these include external forces."""

    corners: Array
    points: Array
    forces: bool


def joint_curves(machine: Machine, bounds: JointBounds, samples: MotionSamples) -> list[Curve]:
    """Return curves of the positions, velocities and torques of all joints, with the limits of these quantities."""
    joints, torques = machine.robot.moving_joints, _torques(machine, samples)
    torque_group = "Torques, without external forces" if isinstance(machine, Standing) else "Torques"
    units, rate_units = [joint.unit for joint in joints], [f"{joint.unit}/s" for joint in joints]
    quantities = [
        ("Joints", units, samples.joints, bounds.lower, bounds.upper),
        ("Joint velocities", rate_units, samples.rates, -bounds.velocity, bounds.velocity),
    ]
    if torques is not None:
        effort_units = [joint.effort_unit for joint in joints]
        quantities.append((torque_group, effort_units, torques, -bounds.torque, bounds.torque))
    return [
        Curve(group, joint.name, units[k], values[:, k], float(lower[k]), float(upper[k]))
        for group, units, values, lower, upper in quantities
        for k, joint in enumerate(joints)
    ]


def _torques(machine: Machine, samples: MotionSamples) -> Array | None:
    """Return the joint torques of a motion by inverse dynamics, (M, n); None if accelerations or masses are unknown."""
    robot = machine.robot
    if samples.accelerations is None or robot.total_mass == 0:
        return None
    q, v, a = (ca.SX.sym(name, robot.dof) for name in ("q", "v", "a"))
    sampler = Sampler([q, v, a], [torque_expression(machine, q, v, a)])
    return sampler(samples.joints, samples.rates, samples.accelerations)[0]


def machine_curves(machine: Machine, samples: MotionSamples) -> list[Curve]:
    """Return curves of manipulability, of tip speed and, for a floating machine with known base rates, of momentum."""
    robot, curves = machine.robot, []
    base, joints, rates, base_rates = samples.base, samples.joints, samples.rates, samples.base_rates
    b, q, v = ca.SX.sym("b", machine.base_size), ca.SX.sym("q", robot.dof), ca.SX.sym("v", robot.dof)
    if robot.tip is not None:
        rows, twist = _controlled_rows(machine, base[0]), machine.tip_twist(b, q, v)
        if rows:
            index = Sampler([b, q], [machine.manipulability(b, q, rows)])(base, joints)[0][:, 0]
            description = "of the pose" if min(rows) < 3 else "of the position"
            curves.append(Curve("The motion", f"manipulability {description}", "", index))
        (speed,) = Sampler([b, q, v], [ca.norm_2(twist[3:6])])(base, joints, rates)
        curves.append(Curve("The motion", "speed of the tip", "m/s", speed[:, 0]))
    if isinstance(machine, FreeFloating) and base_rates is not None:
        r = ca.SX.sym("r", machine.base_size)
        total = machine.momentum(b, q, machine.twist_of_rate(b, r), v)
        joints_only = machine.momentum(b, q, ca.SX(len(machine.twist_rows), 1), v)
        angular_rows = 3 if machine.base_size == 7 else 1
        parts = [total[:angular_rows], total[angular_rows:], joints_only[:angular_rows], joints_only[angular_rows:]]
        sampler = Sampler([b, q, v, r], [ca.norm_2(part) for part in parts])
        angular, linear, joints_angular, joints_linear = sampler(base, joints, rates, base_rates)
        for name, value, part, unit in (
            ("moment of momentum", angular, joints_angular, "N m s"),
            ("momentum", linear, joints_linear, "N s"),
        ):
            curves.append(Curve("Momentum", f"{name}, total", unit, value[:, 0]))
            curves.append(Curve("Momentum", f"{name}, of the joints alone", unit, part[:, 0]))
    return curves


def _controlled_rows(machine: Machine, base: Array) -> list[int]:
    """Return the rows of the tip's twist that the joints control independently, or an empty list if there are none.

    These are all rows in which the joints move the tip or, if the joints are too few, the linear rows among these. They
    are computed at a random configuration, where the rank of the Jacobian is that of almost all configurations.
    """
    b, q = ca.SX.sym("b", machine.base_size), ca.SX.sym("q", machine.joint_size)
    jacobian = ca.Function("jacobian", [b, q], [machine.tip_jacobian(b, q)])
    values = np.array(jacobian(base, np.random.default_rng(0).normal(size=machine.joint_size)))
    sizes = np.linalg.norm(values, axis=1)
    moved = np.flatnonzero(sizes > ROUNDING_SHARE * sizes.max()).tolist()
    for rows in (moved, [row for row in moved if row >= 3]):
        if rows and np.linalg.matrix_rank(values[rows], ROUNDING_SHARE * sizes.max()) == len(rows):
            return rows
    return []


def ground_contact(
    machine: Standing, samples: MotionSamples, inside: Sequence[Curve] = ()
) -> tuple[GroundContact, list[Curve]]:
    """Return the zero moment points of a standing machine and a curve of their distance from the edge of the foot.

    `inside` has the distances inside each edge, up to a constant margin, from a problem that includes external forces.
    Without it the external forces are unknown.
    """
    normals, corners = machine.support.normals, np.asarray(machine.support.vertices)
    if len(inside) == len(normals):
        point = ca.SX.sym("point", 2)
        edges = np.array(ca.Function("edges", [point], [machine.support.distances(point)])(np.zeros(2))).ravel()
        rows = np.column_stack([normals, -np.ones(len(normals))])
        edge_distances = np.column_stack([one.values for one in inside]) - edges
        solution, *_ = np.linalg.lstsq(rows, edge_distances.T, rcond=None)
        if np.abs(rows @ solution - edge_distances.T).max() < 1e-8:  # m, rounding: the distances belong to one point
            points = np.ascontiguousarray(solution[:2].T)
            distances = edges + points @ normals.T
            margin = Curve("Standing", "zero moment point from the edge of the foot", "m", distances.min(axis=1), 0.0)
            return GroundContact(corners, points, True), [margin]
    q, v, a = (ca.SX.sym(name, machine.joint_size) for name in ("q", "v", "a"))
    point = center_of_pressure(machine.ground_reaction(q, v, a))
    motion = samples.joints, samples.rates, samples.accelerations
    points, margins = Sampler([q, v, a], [point, machine.support.margin(point)])(*motion)
    name = "zero moment point from the edge of the foot, without external forces"
    return GroundContact(corners, points, False), [Curve("Standing", name, "m", margins[:, 0], 0.0)]


ZMP_CONSTRAINT = "zero moment point"
"""Name of the constraint that keeps the zero moment point in the foot, in problems of standing machines."""


@dataclass(frozen=True)
class PageSettings:
    """Resolution and largest size of a page that plays motions.

    Attributes:
        per_second, least, most: Samples of a motion per second, and their smallest and largest number.
        poses: Largest number of samples with poses, between which the page interpolates.
        pair_samples: Number of times at which the closest bodies are computed, which is slower.
        same_cost: Relative difference of two final costs below which the curve of only one is shown.
        most_bytes: Largest size of a page.
    """

    per_second: int = 50
    least: int = 200
    most: int = 600
    poses: int = 301
    pair_samples: int = 161
    same_cost: float = 1e-3
    most_bytes: int = 8_000_000


PAGE_SETTINGS = PageSettings()


class ClosestPairs(NamedTuple):
    """Pair of bodies with the smallest difference between distance and required clearance, at each of K times.

    Attributes:
        t: Times, s. Shape (K,).
        points: Closest points of the cores of both bodies, in world. Shape (K, 2, 3), m.
        distances, required: Distances of the bodies, and required ones. Shape (K,), m.
        bodies: Names of the two bodies at each time.
    """

    t: Array
    points: Array
    distances: Array
    required: Array
    bodies: tuple[tuple[str, str], ...]


@dataclass(frozen=True, eq=False)
class Animation:
    """A sampled motion with all data about the motion that a page displays.

    Attributes:
        name, machine: Name of the motion, and the machine that moves.
        t, joints, base: Times (M,), s, joint positions (M, n) and base configurations (M, base_size).
        curves: Quantities over time.
        targets: Targets of the tips.
        footing: Contact with the ground; None for a machine that does not stand.
        closest: The closest bodies; None if they are unknown.
        obstacles: Obstacles; moving ones have their poses at the times t.
        verdict: Sentence of the audit, or "".
        passed: Whether the audit passes; None if there is none.
        rows: Rows of the audit.
        cost: Cost; None if it is unknown.
    """

    name: str
    machine: Machine
    t: Array
    joints: Array
    base: Array
    curves: tuple[Curve, ...]
    targets: tuple[Target, ...] = ()
    footing: GroundContact | None = None
    closest: ClosestPairs | None = None
    obstacles: tuple[Obstacle, ...] = ()
    verdict: str = ""
    passed: bool | None = None
    rows: tuple[Row, ...] = ()
    cost: float | None = None


def animate_plan(plan: Plan, name: str = "plan", **settings: Any) -> Animation:
    """Sample a plan for display, and audit the plan; `settings` are those of the audit."""
    times = _times(plan.horizon)
    sample = plan.sampled(times)
    base = plan.at(times)["base"] if plan.machine.base_size else np.zeros((len(times), 0))
    times_of_pairs = np.linspace(0.0, plan.horizon, PAGE_SETTINGS.pair_samples)
    parts, own_curves = plan.solved_parts(times), list[Curve]()
    if len(parts) == 1:
        solution, _, solution_times = parts[0]
        own_curves = _problem_curves(solution, solution_times / solution.horizon, solution_times)
    details: dict[str, Any] = {
        "closest": _closest_pairs(plan.solved_parts(times_of_pairs), plan.horizon),
        "obstacles": tuple(obstacles_of_plan(plan, times)),
        "cost": plan.cost,
        "targets": plan.targets,
    }
    details |= _audit_verdict([part[0] for part in parts], lambda: verdict_of(plan, sample, name, **settings))
    base_rates = np.gradient(base, times, axis=0, edge_order=2) if base.shape[1] else base
    samples = MotionSamples(times, sample.joints, sample.rates, sample.accelerations, base, base_rates)
    return _animation(name, plan.machine, samples, own_curves, bounds=plan.joint_bounds, **details)


def animate_solution(
    solution: Solution,
    machine: Machine,
    name: str = "solution",
    *,
    joints: str = "joints",
    base: str = "base",
    **settings: Any,
) -> Animation:
    """Sample the solution of an optimal control problem for display.

    Args:
        machine: Machine whose joints, and base if it moves, are states of the problem.
        joints, base: Names of these states.
        settings: Settings of the audit.

    Raises:
        ProblemError: A state is missing or has the wrong size.
    """
    sizes = {joints: machine.joint_size} | ({base: machine.base_size} if machine.base_size else {})
    for state, size in sizes.items():
        if state not in solution.states:
            raise require.unknown("state", state, list(solution.states))
        actual = solution.states[state].shape[1]
        if actual != size:
            words = f"state {state!r} has {actual} entries, the machine {size}: {list(machine.robot.joint_names)}"
            raise ProblemError(words, name=state, value=actual, limit=size)
    times = _times(solution.horizon)
    fractions = times / solution.horizon
    curve = solution.state_interpolant
    curves = curve, curve.derivative(), curve.derivative().derivative()
    derivatives = [
        unstack(solution.states, each(fractions) / solution.horizon**order) for order, each in enumerate(curves)
    ]
    q, v, a = (samples[joints] for samples in derivatives)
    none = np.zeros((len(times), 0))
    base_path, base_rates = (samples[base] if machine.base_size else none for samples in derivatives[:2])
    details: dict[str, Any] = {"cost": solution.cost, "obstacles": tuple(obstacles_of([(solution, "", times)]))}
    details |= _audit_verdict([solution], lambda: solution.audit(**settings))
    times_of_pairs = np.linspace(0.0, solution.horizon, PAGE_SETTINGS.pair_samples)
    details["closest"] = _closest_pairs([(solution, "", times_of_pairs)], solution.horizon)
    smooth = _is_smooth(solution, joints)
    own_curves = _problem_curves(solution, fractions, times)
    samples = MotionSamples(times, q, v, a if smooth else None, base_path, base_rates)
    return _animation(name, machine, samples, own_curves, **details)


def animate_trajectory(raw: RawTrajectory, machine: Machine, name: str = "") -> Animation:
    """Sample a joint trajectory for display, interpolated between its samples as robot controllers do.

    Raises:
        ProblemError: The trajectory lacks joints of the machine, or has no valid sample.
    """
    robot = machine.robot
    cleaned = clean_trajectory(raw, robot, Limits().bounds(machine))
    if len(cleaned.joints) < robot.dof:
        missing = [joint for k, joint in enumerate(robot.joint_names) if k not in cleaned.joints]
        words = f"{raw.file} does not move {missing}; lock them: --lock {missing[0]}=VALUE"
        raise ProblemError(words, name=missing[0], value=raw.file)
    motion = cleaned.motion
    times = _times(float(motion.t[-1] - motion.t[0]))
    at = motion.t[0] + times
    base, base_rates = np.zeros((len(times), 0)), None
    if isinstance(machine, FreeFloating) and cleaned.base is None:
        base = interpolate(at, motion.t, integrate_base(machine, motion)[0])  # by conservation of momentum
    elif cleaned.base is not None and machine.base_size:
        base = interpolate(at, motion.t, cleaned.base)
        base_rates = interpolate(at, motion.t, np.gradient(cleaned.base, motion.t, axis=0))
    accelerations = None if motion.acceleration is None else motion.acceleration.at(at)
    samples = MotionSamples(times, motion.position.at(at), motion.velocity.at(at), accelerations, base, base_rates)
    return _animation(name or raw.file, machine, samples, [])


def _animation(
    name: str,
    machine: Machine,
    samples: MotionSamples,
    own_curves: Sequence[Curve],
    *,
    bounds: JointBounds | None = None,
    **details: Any,
) -> Animation:
    """Combine the samples of a motion, the curves of its problem (if any) and the curves that every motion has.

    `bounds` are the limits of the joints; those of the robot if None.
    """
    t, relative = samples.t, PAGE_SETTINGS.same_cost
    effort = scipy.integrate.cumulative_trapezoid((samples.rates**2).sum(axis=1) / 2, t, initial=0.0)
    curves = [Curve("Cost", "integral of half the squared joint velocities", "", effort)]
    costs = [curve for curve in own_curves if curve.group == "Cost"]
    least = relative * max(abs(effort[-1]), 1e-12)
    curves += [cost for cost in costs if abs(cost.values[-1] - effort[-1]) > least]
    curves += machine_curves(machine, samples)
    closest = details.get("closest")
    if closest is not None:
        distances = np.interp(t, closest.t, closest.distances)
        curves.append(Curve("The motion", "closest two bodies", "m", distances, float(closest.required.min())))
    footing = None
    if isinstance(machine, Standing) and samples.accelerations is not None:
        inside = [curve for curve in own_curves if curve.group == ZMP_CONSTRAINT]
        footing, more = ground_contact(machine, samples, inside)
        curves += more
    curves += joint_curves(machine, bounds or Limits().bounds(machine), samples)
    curves += _margins([one for one in own_curves if one.group != "Cost"])
    return Animation(name, machine, t, samples.joints, samples.base, tuple(curves), footing=footing, **details)


def _times(horizon: float) -> Array:
    """Return the uniformly spaced times from 0 to the horizon, s, at which a motion is sampled."""
    count = int(np.clip(np.ceil(PAGE_SETTINGS.per_second * horizon), PAGE_SETTINGS.least, PAGE_SETTINGS.most))
    return np.linspace(0.0, horizon, count + 1)


def _is_smooth(solution: Solution, joints: str) -> bool:
    """Return whether the joint positions of a solution are smooth enough for inverse dynamics."""
    return len(solution.state_interpolant.nodes) > 2 and any(
        name != joints and values.shape[1] == solution.states[joints].shape[1]
        for name, values in solution.states.items()
    )


def _audit_verdict(solutions: Sequence[Solution], judge: Callable[[], Audit | PlanVerdict]) -> dict[str, Any]:
    """Return the attributes of an Animation that describe the audit, or that state why there is no audit."""
    lost = next((solution.problem_lost for solution in solutions if solution.problem is None), None)
    if lost is not None:
        return {"verdict": f"There is no audit, because the file has no problem: {lost}."}
    verdict = judge()
    audit = verdict.audit if isinstance(verdict, PlanVerdict) else verdict
    rows = sorted(audit_rows(audit), key=lambda row: -row.urgency)
    margin = f" It {verdict.margin}." if isinstance(verdict, PlanVerdict) and verdict.margin else ""
    return {"verdict": f"The plan {verdict.sentence}.{margin}", "passed": verdict.passed, "rows": tuple(rows)}


def _problem_curves(solution: Solution, fractions: Array, times: Array) -> list[Curve]:
    """Return the integrated running cost of a problem and all entries of its path constraints, by constraint."""
    if solution.problem is None:
        return []
    form = Formulation.of(solution.problem)
    ordered = match_order(form, solution)
    x, u = ordered.state_interpolant(fractions), ordered.control_interpolant(fractions)
    p = form.parameter_vector(ordered.parameters)
    running, rows = form.sampled([form.running, form.path.expression], x, u, times, ordered.horizon, p)
    lower, upper = (side[form.path.bounds] for side in form.bound_values(p))
    integral = scipy.integrate.cumulative_trapezoid(running[:, 0], fractions * ordered.horizon, initial=0.0)
    return [Curve("Cost", "the problem's own cost, integrated", "", integral)] + [
        Curve(owner, label, form.units[owner], rows[:, k], float(lower[k]), float(upper[k]))
        for k, (owner, label) in enumerate(zip(form.path.owners, form.path.labels, strict=True))
    ]


def _margins(rows: Sequence[Curve]) -> list[Curve]:
    """Return, as curves, the least margin of each inequality constraint and the largest error of each equality."""
    curves = []
    for name in dict.fromkeys(one.group for one in rows):
        group = [one for one in rows if one.group == name]
        unit = group[0].unit if "," not in group[0].unit else ""
        if equations := [one for one in group if one.lower == one.upper]:
            errors = np.max([np.abs(one.values - one.lower) for one in equations], axis=0)
            curves.append(Curve("Constraints", f"{name}: error", unit, errors))
        if inequalities := [one for one in group if one.lower < one.upper]:
            margins = [np.minimum(one.values - one.lower, one.upper - one.values) for one in inequalities]
            curves.append(Curve("Constraints", f"{name}: margin to its limit", unit, np.min(margins, axis=0), 0.0))
    return [one for one in curves if np.isfinite(one.values).any()]


def _closest_pairs(parts: Sequence[tuple[Solution, str, Array]], horizon: float) -> ClosestPairs | None:
    """Return the closest pair of bodies at evenly spaced times of a motion, or None if the pairs are unknown.

    `parts` are solutions, suffixes and times as returned by `Plan.solved_parts` for these times.
    """
    pairs = [
        pair
        for solution, suffix, times in parts
        if solution.problem is not None
        for pair in closest_pairs_along(solution.problem, solution, times, suffix)
    ]
    t = np.linspace(0.0, horizon, PAGE_SETTINGS.pair_samples)
    if len(pairs) < len(t):
        return None
    names = ("points", "distance", "required")
    points, distances, required = (np.array([getattr(pair, name) for pair in pairs]) for name in names)
    return ClosestPairs(t, points, distances, required, tuple(pair.bodies for pair in pairs))
