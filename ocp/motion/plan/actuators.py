"""Motions along tasks within limits of torque, power, acceleration and jerk, or with other costs than squared rates.

The guess is a motion without these limits, of least squared rates, whose problem has the rates as controls. The problem
solved from it has accelerations as controls.

Limits can only increase the cost of a motion. With another cost, that of the guess bounds nothing: every local minimum
of the squared rates is then the guess of one motion, and the lowest of their costs is that of the plan.
"""

from __future__ import annotations

from dataclasses import replace
from operator import itemgetter
from typing import Any

import casadi as ca
import numpy as np

from models import Robot
from models.checks import Array
from models.machines.machine import hold_joints
from ocp.direct.discretisation import Collocation
from ocp.direct.guess import Samples
from ocp.errors import SolveError
from ocp.motion.builders.clearance import ClearanceConstraints
from ocp.motion.builders.dynamics import Actuation, checked_motors, joint_torques, running_cost, weights_torques
from ocp.motion.builders.dynamics_plan import POINTS, SolveSettings, within_limits
from ocp.motion.builders.tool_motion import CLOCK, PACE, SLOPES, ToolMotion
from ocp.motion.result.candidate import Reason, Rejection
from ocp.motion.result.plan import CHECKED_TIMES
from ocp.motion.result.request import declared_motion
from ocp.motion.result.solved_plan import SolvedPlan
from ocp.motion.search.configurations import PlanRequest
from ocp.motion.tasks.goals import Cost
from ocp.motion.tasks.limits import LIMITED, JointBounds, Limits
from ocp.motion.tasks.speed_profile import ramp_time
from ocp.problem.problem import Problem
from ocp.refinement import split
from ocp.solution import Solution
from ocp.tolerances import LIMIT_SHARE, RESOLVED_SHARE, ROUNDING_SHARE, STANDSTILL

GUESS_PLACES = np.append(ROUNDING_SHARE, np.arange(1, 17) / 16)
"""Places, 0 to 1, in an interval of the mesh at which an initial guess is sampled: jerks jump between intervals."""


ACTUATOR_LIMITS = tuple(kind for kind in LIMITED if kind != "velocity")


def limits_actuators(limits: Limits) -> bool:
    """Return whether a quantity of the joints other than their positions and velocities is limited."""
    return any(getattr(limits, quantity) is not None for quantity in ACTUATOR_LIMITS)


def weights_actuators(cost: Cost) -> bool:
    """Return whether a cost weights torques, work, accelerations or jerks."""
    return bool({"effort", "energy", "acceleration", "jerk"} & set(cost.terms))


def without_actuators(limits: Limits) -> Limits:
    """Return a copy of the limits of a motion without those in `ACTUATOR_LIMITS`."""
    none: dict[str, Any] = dict.fromkeys(ACTUATOR_LIMITS)
    return replace(limits, **none)


def cost_of_motion(plan: SolvedPlan, cost: Cost) -> float:
    """Integrate the cost of a plan's motion by the trapezoidal rule; joints that are held at rest do not count."""
    machine, t, samples = _moving_joints(plan)
    base, *motion = (ca.SX.sym("v", size) for size in (machine.base_size, *[machine.joint_size] * 4))
    torques: Any = None
    if weights_torques(cost):
        torques = joint_torques(checked_motors("cost", machine), (base, *motion[:3]))
    running = running_cost(machine, cost, (base, *motion[:3]), jerks=motion[3], torques=torques)
    if cost.energy:
        running += cost.energy * ca.sum1(ca.fmax(torques * motion[1], 0.0))
    running_at = ca.Function("cost", [base, *motion], [running])
    jerks = np.gradient(samples[-1], t, axis=0)
    values = running_at.map(CHECKED_TIMES)(*(part.T for part in (*samples, jerks)))
    return float(np.trapezoid(np.array(values)[0], t) + cost.time * plan.horizon)


def _moving_joints(plan: SolvedPlan) -> tuple[Any, Array, tuple[Array, ...]]:
    """Return the machine of a plan with the held joints locked, sample times (M,), s, and samples of the motion.

    The samples are base, joints, rates and accelerations. Shape (M, n) each.
    """
    machine = hold_joints(plan.machine, plan.held) if plan.held else plan.machine
    sample = plan.sampled(np.linspace(0.0, plan.horizon, CHECKED_TIMES))
    free = [name not in plan.held for name in plan.names]
    base = plan.at(sample.t)["base"] if machine.base_size else np.zeros((CHECKED_TIMES, 0))
    return machine, sample.t, (base, *(values[:, free] for values in sample[1:4]))


def largest_demand(plan: SolvedPlan, limits: Limits) -> Reason | None:
    """Return a `Reason` with a plan's largest demand on an actuator, relative to the limit; None without limits.

    The reason names the joint, the time, and the value and the limit of its torque, power or acceleration. Joints that
    the plan keeps at rest do not count.
    """
    machine, t, samples = _moving_joints(plan)
    symbols = [ca.SX.sym("v", values.shape[1]) for values in samples]
    torques_at = ca.Function("torques", symbols, [joint_torques(checked_motors("limits", machine), (*symbols,))])
    torques = np.array(torques_at.map(len(t))(*(values.T for values in samples))).T
    _, _, rates, accelerations = samples
    demands = {"acceleration": accelerations, "torque": torques, "power": np.maximum(torques * rates, 0.0)}
    bounds = limits.bounds(machine)
    ratios = [pair for of in demands.items() for pair in _demand(machine.robot, *of, t, bounds)]
    return max(ratios, key=itemgetter(0), default=(0.0, None))[1]


def _demand(
    robot: Robot, quantity: str, values: Array, t: Array, bounds: JointBounds, remedy: str = ""
) -> list[tuple[float, Reason]]:
    """Return the largest ratio of a joint quantity (M, n) to its limit, and the reason; an empty list if unlimited."""
    most_allowed = getattr(bounds, quantity)
    if not np.isfinite(most_allowed).any():
        return []
    row, index = np.unravel_index(int(np.argmax(np.abs(values) / most_allowed)), values.shape)
    joint = robot.moving_joints[index]
    units = {"acceleration": f"{joint.unit}/s^2", "jerk": f"{joint.unit}/s^3", "torque": joint.effort_unit}
    time, value, allowed = float(t[row]), float(abs(values[row, index])), float(most_allowed[index])
    words = f"{quantity} of {joint.name!r} is {value:.4g} {units.get(quantity, 'W')} at {time:.4g} s"
    details = joint.name, value, allowed, time, remedy
    return [(value / allowed, Reason(Rejection.ACTUATORS, f"{words}, {allowed:.4g} allowed", *details))]


def demand_of_tasks(request: PlanRequest, unlimited: SolvedPlan, limits: Limits) -> Reason | None:
    """Return the most exceeded limit of joints whose motion the tasks determine; None if no limit is exceeded.

    The limits are those of acceleration, jerk and torque at rest, on the branch of a plan. A joint that no self-motion
    moves at a random configuration is not moved at almost all configurations: the tasks determine its motion. Divided
    differences of its velocity are values of its acceleration and jerk (mean value theorem). In the same way, the tasks
    determine a gravity torque that no self-motion changes. Returns None on a floating base, with a free horizon, and if
    there is no such joint.
    """
    machine, ratios = request.machine, list[tuple[float, Reason | None]]()
    if machine.base_size or request.time_cost is not None:
        return None
    configuration = np.random.default_rng(0).normal(size=machine.joint_size)
    bounds, q, zeros = limits.bounds(machine), ca.SX.sym("q", machine.joint_size), np.zeros(machine.joint_size)
    gravity = joint_torques(checked_motors("limits", machine), ((), q, zeros, zeros))
    gravity_at = ca.Function("gravity", [q], [gravity, ca.jacobian(gravity, q)])
    for stretch in (stretch for stretch in request.stretches if stretch.equations is not None):
        equations: Any = stretch.equations
        free = _null_rows(np.array(equations.jacobian_function(configuration, ())))
        determined = ~(np.abs(free) > ROUNDING_SHARE).any(axis=0)
        ends = np.array([stretch.begin, *stretch.breaks, stretch.end])
        t = np.interp(np.arange(4 * len(ends) - 3) / 4, np.arange(len(ends)), ends)
        joints = unlimited.sampled(t).joints[:, [name not in unlimited.held for name in unlimited.names]]
        targets = equations.target_function().map(len(t))(t[None, :])
        jacobians, right, *_ = equations.function.map(len(t))(np.zeros((0, len(t))), joints.T, targets)
        rows = np.array(jacobians).reshape(equations.size, len(t), -1).transpose(1, 0, 2)
        rates = (np.linalg.pinv(rows) @ np.array(right).reshape(equations.size, len(t), 1).transpose(1, 0, 2))[:, :, 0]
        accelerations = np.diff(rates, axis=0) / np.diff(t)[:, None]
        jerks = 2 * np.diff(accelerations, axis=0) / (t[2:] - t[:-2])[:, None]
        slopes = gravity_at(configuration)[1].full()
        fixed = (np.abs(slopes @ free.T) <= ROUNDING_SHARE * np.abs(slopes).max()).all(axis=1)
        static = gravity_at.map(2)(joints[[0, -1]].T)[0].full().T
        holds = [stretch is request.stretches[-k] and rests for k, rests in enumerate(request.rests)]
        at_rest = np.array(holds)[:, None] * fixed * static
        words = "the arm must hold itself at rest there: reduce its load, or move the tasks"
        ratios += _demand(machine.robot, "torque", at_rest, t[[0, -1]], bounds, words)
        words = "the tasks determine the motion of this joint: lower the speed, acceleration or jerk of the tasks"
        for of in (("acceleration", determined * accelerations, t), ("jerk", determined * jerks, t[1:])):
            ratios += _demand(machine.robot, *of, bounds, words)
    ratio, reason = max(ratios, key=itemgetter(0), default=(0.0, None))
    return reason if ratio > 1.0 + LIMIT_SHARE else None


def solve_with_accelerations(request: PlanRequest, start: Array, reference: Array, unlimited: SolvedPlan) -> Solution:
    """Solve a request within its actuator limits from the guess `unlimited`, a motion that ignores these limits.

    If many starts are equally good, that of the first solution is fixed. Start and reference are those of
    `ToolMotionSetup`.

    Raises:
        SolveError: No motion was found. Names the joint, the time, the demand without the limit, and the limit.
    """
    limits = request.actuator_limits or request.limits
    if (demand := demand_of_tasks(request, unlimited, limits)) is not None:
        error = SolveError(demand.remedy)
        _add_demand(error, demand)
        raise error
    first = request.stretches[0]
    if request.start is None:
        # a joint that started elsewhere moves separated bodies: its start stays free
        initial = unlimited.solution[f"joints{first.suffix}"][0]
        start = np.where(np.isclose(initial, start, rtol=0.0), start, np.nan)

    fractions = [(stretch.breaks - stretch.begin) / stretch.duration for stretch in request.stretches]
    rest_rows = _undetermined_rows(request, unlimited, 0), _undetermined_rows(request, unlimited, -1)
    has_jerks = bool(np.isfinite(limits.bounds(request.machine).jerk).any() or (request.cost and request.cost.jerk))
    ramps = _ramps(request, unlimited, limits, rest_rows, has_jerks)
    # if the controls are jerks, and the time is fixed, tasks constrain states alone: a stiffly accurate scheme alone
    # damps the errors of such equations, of index 2 (Hairer, Wanner 1996, section VII.4)
    points = replace(POINTS, scheme="radau") if has_jerks and request.time_cost is None else POINTS
    mesh = points.with_nodes_at(np.unique(np.concatenate([ramps, *fractions])).tolist())
    cost = unlimited.cost if request.cost is None else cost_of_motion(unlimited, request.cost)
    is_at_rest = cost <= request.settings.negligible_rate * request.stretches[-1].end
    smoothing = Actuation.smoothing if is_at_rest else _smoothing(unlimited, mesh, cost, has_jerks)
    if has_jerks:
        mesh = _mesh_at_limits(request, unlimited, limits, mesh, smoothing)
    settings = SolveSettings(mesh, guess_cost=np.inf if is_at_rest else cost)

    def solve_from(initial: Array) -> Solution:
        def declare(constraints: ClearanceConstraints | None) -> Problem:
            guess: dict[str, Any] = {"start": initial, "reference": reference}
            actuation = Actuation(request.cost, request.rests, rest_rows, smoothing)
            motion = declared_motion(request, **guess, constraints=constraints, actuation=actuation)
            _set_guess(motion, unlimited, mesh)
            return motion.problem

        joints = {"": (request.machine, limits)}
        return within_limits(declare, request.clearance_constraints, joints, settings=settings)

    try:
        solution = solve_from(start)
        audit = solution.audit()
        if audit.feasible and audit.optimal is None and np.isnan(start).any():
            fixed_solution = solve_from(solution[f"joints{first.suffix}"][0])
            if fixed_solution.audit().passed:
                return fixed_solution
    except SolveError as error:
        _add_demand(error, largest_demand(unlimited, limits))
        raise
    return solution


def _smoothing(unlimited: SolvedPlan, mesh: Collocation, cost: float, has_jerks: bool) -> float:
    """Return the duration, as a share of the horizon, in which a control passes from limit to limit.

    It is the default unless the term of the cost that depends on this duration (see `declare_actuators`) is then larger
    than the permitted error of `cost`, the cost of the motion without actuator limits, or smaller than a plan resolves.
    """
    fractions, squares = _guess_fractions(mesh), 0.0
    for part in unlimited.parts:
        times, controls = fractions * (part.end - part.begin), unlimited.accelerations(part, fractions.ravel())
        controls = _slopes(controls, times) if has_jerks else controls
        squares += float(np.trapezoid((controls**2).sum(axis=1), times.ravel()))
    if not squares > 0:
        return Actuation.smoothing
    terms = 2.0 * cost * np.array([RESOLVED_SHARE, LIMIT_SHARE])
    return float(np.clip(Actuation.smoothing, *(terms / squares) ** (0.25 if has_jerks else 0.5) / unlimited.horizon))


def _mesh_at_limits(
    request: PlanRequest, unlimited: SolvedPlan, limits: Limits, mesh: Collocation, smoothing: float
) -> Collocation:
    """Return a mesh that resolves the jerks where a motion without actuator limits exceeds them, and just outside.

    With v'' = u, the cost v^2 + d^4 u^2 of a duration d of smoothing makes v, after a limit, a decaying oscillation
    with the wavelength 2 pi sqrt(2) d. An interval resolves half of it. A neighbour is at most twice as wide.
    """
    bounds, fractions, exceeds = limits.bounds(request.machine), _guess_fractions(mesh), np.zeros(mesh.intervals, bool)
    for part in unlimited.parts:
        accelerations = unlimited.accelerations(part, fractions.ravel())
        jerks = _slopes(accelerations, fractions * (part.end - part.begin))
        beyond = (np.abs(accelerations) > bounds.acceleration) | (np.abs(jerks) > bounds.jerk)
        exceeds |= beyond.reshape(mesh.intervals, -1).any(axis=1)
    widths = np.diff(mesh.fractions)
    parts = np.where(exceeds, np.ceil(widths / (np.pi * np.sqrt(2.0) * smoothing)), 1).astype(int)
    nodes = split(mesh.fractions, parts, widths, request.settings.max_intervals)
    while exceeds.any():
        widths = np.diff(nodes)
        narrower = np.minimum(np.append(widths[1:], 1.0), np.append(1.0, widths[:-1]))
        exceeds = widths > (2.0 + ROUNDING_SHARE) * narrower
        nodes = np.union1d(nodes, (nodes[:-1] + widths / 2)[exceeds])
    return mesh.with_mesh(nodes)


def _guess_fractions(mesh: Collocation) -> Array:
    """Return the fractions of the horizon at which a motion is sampled for a guess on a mesh of N intervals, from just
    after the start of each interval to its end. Shape (N, M).
    """
    nodes = mesh.fractions
    fractions = nodes[:-1, None] + np.diff(nodes)[:, None] * GUESS_PLACES
    fractions[:, -1] = nodes[1:]
    return np.asarray(fractions)


def _slopes(values: Array, times: Array) -> Array:
    """Return the time derivatives (N M, n) of samples (N M, n) in N intervals, by differences inside the intervals.
    `times` has the shape (N, M).
    """
    slopes = np.gradient(values.reshape(*times.shape, -1), GUESS_PLACES, axis=1)
    return np.asarray(slopes / np.gradient(times, GUESS_PLACES, axis=1)[:, :, None]).reshape(values.shape)


def _ramps(
    request: PlanRequest, unlimited: SolvedPlan, limits: Limits, rest_rows: tuple[Array, Array], has_jerks: bool
) -> Array:
    """Return the times, as fractions of the horizon, of the middles and ends of the fastest velocity ramps between rest
    and the self-motion at the ends of a plan. Limited jerks switch at these times. Unlimited accelerations last as long
    as the smoothing of controls.
    """
    horizon, bounds, shares = request.stretches[-1].end, limits.bounds(request.machine), list[float]()
    rates = unlimited.sampled(np.linspace(0.0, unlimited.horizon, CHECKED_TIMES)).rates
    rates = rates[:, [name not in unlimited.held for name in unlimited.names]]
    fastest = [np.minimum(most, 1.0 / STANDSTILL).tolist() for most in (bounds.acceleration, bounds.jerk)]
    for k, (rests, rows, end) in enumerate(zip(request.rests, rest_rows, rates[[0, -1]], strict=True)):
        speeds = np.abs(rows.T @ (rows @ end))
        share = rests * max(map(ramp_time, speeds.tolist(), *fastest)) / horizon
        if rests and not has_jerks and speeds.max() > LIMIT_SHARE * np.abs(rates).max():
            share = max(share, Actuation.smoothing)
        if share > RESOLVED_SHARE:
            doublings = max(int(np.log2(1.0 / (POINTS.intervals * share))), 0)
            shares += [abs(k - place) for place in share * 2.0 ** np.arange(-1, doublings + 1) if place < 0.5]
    return np.array(shares)


def _undetermined_rows(request: PlanRequest, unlimited: SolvedPlan, end: int) -> Array:
    """Return orthonormal rows (k, n) that span the joint velocities which tasks leave undetermined at the start (`end`
    0) or at the end (`end` -1).
    """
    stretch = request.stretches[end]
    if stretch.equations is None:
        return np.eye(request.machine.joint_size)
    names = [f"{kind}{stretch.suffix}" for kind in ("base", "joints")]
    base, joints = (unlimited.solution[name][end] if name in unlimited.solution.states else () for name in names)
    return _null_rows(np.array(stretch.equations.jacobian_function(joints, base)))


def _null_rows(jacobian: Array) -> Array:
    """Return orthonormal rows (k, n) that span the null space of a Jacobian (m, n)."""
    _, sizes, rows = np.linalg.svd(jacobian)
    return np.asarray(rows[int((sizes > RESOLVED_SHARE * sizes.max(initial=0.0)).sum()) :])


def _add_demand(error: SolveError, demand: Reason | None) -> None:
    """Add to the text of an error the largest demand on an actuator of a motion that ignores the actuator limits."""
    words = "no motion within the actuator limits was found"
    if demand is not None:
        words += f"; without them, {demand.detail}"
        assert demand.value is not None
        assert demand.limit is not None
        vars(error).update(demand.fault if demand.value > demand.limit else {})
    error.args = (f"{words}\n{error}",)


def _set_guess(motion: ToolMotion, unlimited: SolvedPlan, mesh: Collocation) -> None:
    """Use a motion that ignores actuator limits as the initial guess of the states and controls of a problem."""
    shape, fractions = (mesh.intervals, len(GUESS_PLACES)), _guess_fractions(mesh).ravel()
    sample = unlimited.solution.at_fraction(fractions)
    pace = sample[PACE] if unlimited.rate_name == SLOPES else 1.0
    for stretch, part in zip(motion.stretches, unlimited.parts, strict=True):
        accelerations = unlimited.accelerations(part, fractions)
        times = sample[CLOCK][:, 0] if CLOCK in sample else fractions * (part.end - part.begin)
        values_by_name = {
            "base": sample.get(f"base{stretch.suffix}"),
            "joints": sample[f"joints{stretch.suffix}"],
            "velocities": sample[unlimited.rate_name + stretch.suffix] / pace,
            "accelerations": accelerations,
            "jerks": _slopes(accelerations, times.reshape(shape)),
        }
        named = {name + stretch.suffix: values for name, values in values_by_name.items()}
        named |= {CLOCK: sample.get(CLOCK), PACE: sample.get(PACE)}
        guesses = {name: Samples(fractions * motion.horizon, each) for name, each in named.items() if each is not None}
        motion.problem.declared.set_guesses(guesses)
