"""Minimum-time motion along a given path under all limits, as an optimal control problem over a path parameter.

This is the reference for `schedule`, which plans by construction. The independent variable is a path parameter theta:
the time (s) at which a reference motion, usually a schedule of the same path, passes a place. The distance, speed
w(theta), curvature and joints of the reference are known functions of theta. They are smooth between the joins of the
path's segments, where the mesh has nodes. With line speed v, acceleration a and jerk j,

    dv/dtheta = a w/v,   da/dtheta = j w/v,   time = integral of w/v dtheta.

From rest the jerk is constant over a first short distance d (and over a last one, mirrored): there v = j t^2/2, a = j
t, d = j t^3/6, so that a = 2 v^2/(3 d), j = a v/(3 d), t = 3 d/v. The problem begins at the end of this distance, so
that v stays positive and the problem is regular for every method. The reference is one of the motions with constant
jerk in each interval of the mesh.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from math import comb
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from models.checks import Array
from ocp.console import interruptible
from ocp.curves import gauss_points
from ocp.direct.discretisation import Collocation
from ocp.errors import ProblemError, require
from ocp.methods import solve
from ocp.motion.schedule.grid import subdivide
from ocp.motion.schedule.limits import (
    JointPath,
    LineLimits,
    PathLike,
    check_line,
    check_smooth,
    curvature_along,
    limit_rows,
    rates_along,
)
from ocp.motion.schedule.planner import Schedule, schedule
from ocp.motion.tasks.speed_profile import LineMotion, SpeedProfile, integrate_jerk, segment_index
from ocp.problem.problem import Problem
from ocp.solution import Solution

Columns = Callable[[Array], Array]  # function that returns C path quantities (M, C) at times (M,) of the reference


@dataclass(frozen=True)
class TimingSettings:
    """Settings of the tables of path quantities, and of the mesh of the minimum-time problem and its refinement."""

    degree: int = 7  # degree of the polynomials of a table
    accuracy: float = 1e-8  # largest error of a tabulated quantity, relative to its largest value
    smallest_cell: float = 1e-9  # width of an interval that is not halved further, relative to the whole
    points: int = 40  # points of an interval at which ratios to limits are evaluated
    beside_jump: float = 1e-6  # distance of nodes from a jump of the path's derivatives, relative to the whole time
    same_node: float = 1e-7  # distance of nodes that count as one, relative to the whole time
    demand: float = 2e-4  # largest accepted relative excess of a limit in an interval
    defect: float = 1e-6  # largest error of integration in an interval, per distance and top speed
    parts: int = 8  # largest number of parts of an interval in one refinement


TIMING = TimingSettings()
IPOPT = {"tol": 1e-9, "constr_viol_tol": 1e-9, "max_iter": 1000}


@dataclass(frozen=True, eq=False)
class TimingProblem:
    """Minimum-time problem along a path, its mesh, and the reference motion whose time is the path parameter.

    The states are "speed" and "acceleration", the control is "jerk", in `units`. The time of the problem is theta less
    the start of the span, and its cost the time, s.
    """

    problem: Problem
    mesh: tuple[float, ...]  # nodes as fractions of the horizon, at jumps of derivatives of path and reference
    units: tuple[float, float, float]  # largest speed, acceleration and jerk of the reference, m/s, m/s^2, m/s^3
    reference: SpeedProfile  # motion whose time is theta
    span: tuple[float, float]  # first and last theta of the problem, s; before and after, the jerk is constant

    @property
    def method(self) -> Collocation:
        """Collocation method with constant jerk in each interval, which does not overshoot between the points."""
        return Collocation(len(self.mesh) - 1, 3, scheme="legendre", control="held", mesh=self.mesh)

    def profile(self, solution: Solution) -> SpeedProfile:
        """Return the speed profile of a solution, with constant jerk in each interval."""
        curve = solution.control_interpolant
        if curve.values.shape[1] != 1:
            message = "the jerk of this solution is not constant in its intervals; solve with control='held'"
            raise ProblemError(message, name="jerk", value=curve.values.shape[1], limit=1)
        breaks, begin, horizon = np.asarray(curve.breaks), self.span[0], self.span[1] - self.span[0]
        v, a = (solution.state_interpolant(breaks) * np.array(self.units[:2])).T
        jerk = curve.values[:, 0, 0] * self.units[2]
        inside, shares = gauss_points(breaks, 8)
        speed = solution.state_interpolant(inside.ravel())[:, 0] * self.units[0]
        pace = (self.reference.at(begin + horizon * inside.ravel()).speed / speed).reshape(inside.shape)
        durations = horizon * (pace * shares).sum(axis=1)
        s = self.reference.at(begin + horizon * breaks).distance
        first, last = _ends(self.reference, self.span)
        ramps = 3 * first / v[0], 3 * last / v[-1]
        return SpeedProfile(
            np.concatenate([[0.0], np.cumsum([ramps[0], *durations, ramps[1]])]),
            np.concatenate([[0.0], s, self.reference.distance[-1:]]),
            np.concatenate([[0.0], v, [0.0]]),
            np.concatenate([[0.0], a, [0.0]]),
            np.concatenate([[a[0] * v[0] / (3 * first)], jerk, [-a[-1] * v[-1] / (3 * last)]]),
        )


@dataclass(frozen=True, eq=False)
class FastestMotion:
    """Fastest motion along a path, with its minimum-time problem and solution."""

    schedule: Schedule  # motion as from ocp.motion.schedule, without a list of dips
    solution: Solution  # on the last mesh
    timing: TimingProblem  # problem with that mesh
    demand: float  # largest ratio of a limited quantity to its limit, on a grid ten times finer

    @property
    def duration(self) -> float:
        """Duration of the motion, s."""
        return self.schedule.duration


@interruptible
def solve_minimum_time(
    path: PathLike,
    limits: LineLimits,
    joints: JointPath | None = None,
    *,
    guess: Schedule | None = None,
    intervals: int = 200,
    rounds: int = 6,
    options: dict[str, Any] | None = None,
) -> FastestMotion:
    """Plan the fastest motion along a path from rest to rest under all limits.

    The duration is an upper bound of the least time. Jerks held over intervals cannot follow a limit exactly, which
    costs time in proportion to the interval (about 0.2 % in the example with joint limits and 200 intervals). Because
    of this loss the audit finds the motion feasible, but not optimal.

    Args:
        path, limits, joints: As for `ocp.motion.schedule.schedule`.
        guess: Schedule of the same path to start from; planned here if None.
        intervals: Least number of intervals, besides nodes at the path's joins and the guess's changes of jerk.
        rounds: Largest number of mesh refinements where a limit is exceeded between the points.

    Raises:
        ProblemError, SolveError: As `minimum_time_problem`; or the solver failed, with the worst residuals.
    """
    require.count("rounds", rounds, 0)
    options = require.mapping("options", options)
    timing = minimum_time_problem(path, limits, joints, guess=guess, intervals=intervals)
    solution: Solution | None = None
    for number in range(rounds + 1):
        solution = solve(timing.problem, timing.method, guess=solution, options={**IPOPT, **options})
        profile = timing.profile(solution)
        demand = demand_of_intervals(path, limits, joints, profile)
        parts = _parts_of_intervals(profile, demand)
        if number == rounds or parts.max() == 1:
            break
        mesh = tuple(subdivide(np.array(timing.mesh), parts).tolist())
        timing = TimingProblem(timing.problem, mesh, timing.units, timing.reference, timing.span)
    assert solution is not None
    return FastestMotion(Schedule(path, limits, profile, (), joints), solution, timing, float(demand.max()))


@interruptible
def minimum_time_problem(
    path: PathLike,
    limits: LineLimits,
    joints: JointPath | None = None,
    *,
    guess: Schedule | None = None,
    intervals: int = 200,
) -> TimingProblem:
    """Declare the optimal control problem of the fastest motion along a path from rest to rest under all limits.

    The path constraints are "asked speed" (the line speed's limit), "centripetal acceleration", "joint velocity",
    "joint acceleration" and "joint jerk", each over its limit and only if limited. The boundary constraints are "start
    at rest" and "end at rest", "start jerk" and "end jerk". The arguments are those of `solve_minimum_time`.

    Raises:
        ProblemError: Joint limits are given without joints; limits of tool or torque are given; the joint jerk is
            limited on a path whose curvature jumps; curvature or joints are not finite; the guess is for another path;
            there are fewer than 10 intervals.
    """
    require.count("intervals", intervals, 10)
    limited = check_line(path, limits, joints)
    unsupported = {"tool": limits.tool is not None}
    unsupported["torque"] = limits.joints is not None and bool(np.isfinite(limits.joints.torque).any())
    for name in (name for name, is_limited in unsupported.items() if is_limited):
        raise ProblemError(f"this problem has no constraints on the {name}; call schedule instead", name=name)
    if guess is not None:
        require.instance("guess", guess, Schedule)
    if guess is not None and abs(guess.path.length - path.length) > 1e-9 * path.length:
        message = f"the guess is for a path of {guess.path.length:g} m, but this path has {path.length:g} m"
        raise ProblemError(message, name="guess", value=guess.path.length, limit=path.length)
    path_columns(path, limits, limited, path.sample_distances())  # raises if anything is not finite
    reference = schedule(path, limits, joints=limited).profile if guess is None else guess.profile
    if guess is not None and limited is not None:
        check_smooth(path, limits, limited)  # raises, like a schedule, if no motion satisfies the limits
    whole = reference.duration
    phases = np.diff(reference.t)
    span = (min(phases[0], whole / intervals), whole - min(phases[-1], whole / intervals))
    joins = reference.at_distance(np.asarray(path.bounds)[1:-1]).t if len(path.bounds) > 2 else np.zeros(0)
    mesh = reference_mesh(reference, joins, span, intervals)

    peak = reference.at(np.linspace(0, whole, 1001)).speed
    units = tuple(float(np.abs(values).max()) for values in (peak, reference.acceleration, reference.jerk))
    breaks = distinct(np.concatenate([[0.0, whole], joins, reference.t]), 1e-9 * whole)

    def columns(theta: Array) -> Array:
        motion = reference.at(theta)
        return np.column_stack([motion.speed, path_columns(path, limits, limited, motion.distance)])

    problem = _declare(path, limits, limited, reference, span, units, table(columns, breaks))
    return TimingProblem(problem, tuple(mesh.tolist()), units, reference, span)  # type: ignore[arg-type]


def _declare(
    path: PathLike,
    limits: LineLimits,
    joints: JointPath | None,
    reference: SpeedProfile,
    span: tuple[float, float],
    units: tuple[float, ...],
    along: Any,
) -> Problem:
    """Declare the minimum-time problem, with the time of the reference motion as independent variable, in scaled units.
    `along` returns the reference speed and the `path_columns` at a time of this motion.
    """
    problem = Problem("minimum time along a path", symbols=ca.MX)
    v_unit, a_unit, j_unit = units
    speeds = np.asarray(path.by_piece(limits.speed))

    def guess_of(quantity: str, unit: float) -> Any:
        return lambda theta: float(getattr(reference.at([span[0] + float(theta)]), quantity)[0]) / unit

    slowest = 1e-3 * float(reference.at(list(span)).speed.min())
    fastest, largest = float(speeds.max()) / v_unit, limits.acceleration / a_unit
    speed = problem.state("speed", lower=slowest / v_unit, upper=fastest, guess=guess_of("speed", v_unit))
    rate = problem.state("acceleration", lower=-largest, upper=largest, guess=guess_of("acceleration", a_unit))
    jerks = limits.jerk / j_unit
    control = problem.control("jerk", lower=-jerks, upper=jerks, guess=guess_of("jerk", j_unit))
    problem.horizon(span[1] - span[0])
    v, a, j = v_unit * speed, a_unit * rate, j_unit * control
    values = along(span[0] + problem.time)
    pace = values[0] / v
    problem.dynamics(speed, a * pace / v_unit)
    problem.dynamics(rate, j * pace / a_unit)
    if speeds.min() < speeds.max():
        problem.path("asked speed", v / values[1], upper=1)
    for name, rows in _demands(limits, joints, values, v, a, j).items():
        problem.path(name, rows, lower=-1, upper=1)

    first, last = _ends(reference, span)
    starts, stops = ("start", 1.0, first, problem.start), ("end", -1.0, last, problem.end)
    for (where, sign, distance, ends), rest, bound in ((starts, 0.0, span[0]), (stops, reference.duration, span[1])):
        ends(f"{where} at rest", (sign * a - 2 * v**2 / (3 * distance)) / a_unit, 0, 0)
        jerk = sign * a * v / (3 * distance)
        # the jerk of the line, and those of the joints at rest and at the bound of the span
        rows = [jerk / limits.jerk]
        if joints is not None:
            for theta, v_, a_ in ((rest, 0.0, 0.0), (bound, v, a)):
                rows += [_demands(limits, joints, ca.DM(along(theta)), v_, a_, jerk).get("joint jerk", ca.MX(0, 1))]
        ends(f"{where} jerk", ca.vertcat(*rows), -1, 1)
    problem.minimize(running=pace, terminal=3 * first / (problem.at_start(speed) * v_unit) + 3 * last / v)
    return problem


def _demands(limits: LineLimits, joints: JointPath | None, values: Any, v: Any, a: Any, j: Any) -> dict[str, Any]:
    """Return the ratios of centripetal acceleration and of joint velocities, accelerations and jerks to their limits,
    at path speed v, acceleration a and jerk j. `values` has the reference speed, then the columns of `path_columns`.
    """
    demands: dict[str, Any] = {}
    if np.isfinite(limits.centripetal):
        demands["centripetal acceleration"] = v**2 * values[2] / limits.centripetal
    if joints is None:
        return demands
    number = len(joints.names)
    q1, q2, q3 = (values[3 + k * number : 3 + (k + 1) * number] for k in range(3))
    kinds = {
        "joint velocity": q1 * v,
        "joint acceleration": q2 * v**2 + q1 * a,
        "joint jerk": q3 * v**3 + 3 * q2 * v * a + q1 * j,
    }
    for (name, value), bound in zip(kinds.items(), limits.of_joints(number), strict=True):
        rows = np.flatnonzero(np.isfinite(bound))
        if rows.size:
            demands[name] = value[rows.tolist()] / ca.DM(bound[rows])
    return demands


def _parts_of_intervals(profile: SpeedProfile, demand: Array) -> NDArray[np.intp]:
    """Return the number of parts into which to split each mesh interval, from its limit violation and its integration
    error; both decrease with the square of the interval's length.
    """
    v, a, j, t = profile.speed, profile.acceleration, profile.jerk, np.diff(profile.t)
    distance, speed, _ = integrate_jerk(v[:-1], a[:-1], j, t)
    distance_error, speed_error = distance / np.diff(profile.distance) - 1, (speed - v[1:]) / v.max()
    defect = np.maximum(np.abs(distance_error), np.abs(speed_error))
    error = np.maximum((demand - 1) / TIMING.demand, defect / TIMING.defect)[1:-1]
    parts = np.ceil(np.sqrt(np.maximum(error, 1.0)) * 1.2).astype(np.intp)
    return np.where(error > 1, np.minimum(parts, TIMING.parts), 1)


def _ends(reference: SpeedProfile, span: tuple[float, float]) -> tuple[float, float]:
    """Return the distances, m, that the reference motion covers before the start and after the end of a time span."""
    # the jerk is constant there; the cube is accurate near the end, a difference of distances is not
    left = reference.duration - span[1]
    return float(reference.jerk[0] * span[0] ** 3 / 6), float(reference.jerk[-1] * left**3 / 6)


# ---- reference motion, mesh and tables of path quantities ------------------------------------------------------------


def table(columns: Columns, breaks: Array) -> Any:
    """Return a casadi Function that approximates path quantities over time by piecewise polynomials of degree 7.

    Intervals between `breaks` are halved as far as necessary. At a break the interval that begins there applies.
    """
    angles = np.pi * (np.arange(TIMING.degree + 1) + 0.5) / (TIMING.degree + 1)
    nodes = (1 - np.cos(angles)) / 2  # inside the interval, off the breaks
    between = (nodes[1:] + nodes[:-1]) / 2
    fit = np.linalg.inv(_bernstein(nodes))
    start, width = breaks[:-1], np.diff(breaks)
    finished, scale = list[tuple[Array, Array]](), None
    while start.size:
        places = np.concatenate([nodes, between])
        values = columns((start[:, None] + width[:, None] * places).ravel()).reshape(len(start), len(places), -1)
        scale = np.maximum(np.abs(values).max(axis=(0, 1)), 1e-300) if scale is None else scale
        coefficients = np.einsum("ij,cjm->cim", fit, values[:, : len(nodes)])
        error = np.abs(np.einsum("ij,cjm->cim", _bernstein(between), coefficients) - values[:, len(nodes) :])
        fine = (error <= TIMING.accuracy * scale).all(axis=(1, 2))
        fine |= width < TIMING.smallest_cell * (breaks[-1] - breaks[0])
        finished.append((start[fine], coefficients[fine]))
        half = width[~fine] / 2
        start = np.stack([start[~fine], start[~fine] + half], axis=1).ravel()
        width = np.repeat(half, 2)
    starts, cells = (np.concatenate(parts) for parts in zip(*finished, strict=True))
    order = np.argsort(starts)
    cells = cells[order]
    # a constant polynomial behind the end, which belongs to no other interval
    cells = np.concatenate([cells, np.repeat(cells[-1:, -1:], TIMING.degree + 1, axis=1)])
    ends = np.concatenate([starts[order], [breaks[-1], 2 * breaks[-1] - breaks[0]]])
    knots = np.repeat(ends, TIMING.degree + 1).tolist()
    flat = cells.reshape(-1, cells.shape[2])
    time = ca.MX.sym("time")
    value = ca.bspline(time, ca.DM(flat.ravel()), [knots], [TIMING.degree], flat.shape[1], {"lookup_mode": ["binary"]})
    return ca.Function("along", [time], [value])


def speed_limit(path: PathLike, limits: LineLimits, s: Array) -> Array:
    """Return the limit of the speed along a path at distances (M,) from its start. Shape (M,), m/s."""
    return np.asarray(path.by_piece(limits.speed)[segment_index(path.bounds, s)])


def path_columns(path: PathLike, limits: LineLimits, joints: JointPath | None, s: Array) -> Array:
    """Return speed limit, curvature and first three joint derivatives at path distances (M,), as columns. Shape (M, C).

    The curvature is zero if the centripetal acceleration is not limited.
    """
    limited = np.isfinite(limits.centripetal)
    columns = [speed_limit(path, limits, s), curvature_along(path, s) if limited else np.zeros(len(s))]
    if joints is None:
        return np.column_stack(columns)
    rates = rates_along(joints, s)
    return np.column_stack([*columns, rates.first, rates.second, rates.third])


def largest_demand(path: PathLike, limits: LineLimits, joints: JointPath | None, motion: LineMotion) -> Array:
    """Return the largest ratio of any limited quantity, except torques, to its limit at M samples. Shape (M,)."""
    usage = np.abs(limit_rows(path, limits, joints, motion.distance, torques=False).usage(motion))
    usage[:, 0] **= 2  # the speed at the centripetal limit, of which the acceleration is the square
    return np.asarray(np.maximum(motion.speed / speed_limit(path, limits, motion.distance), usage.max(axis=1)))


def demand_of_intervals(path: PathLike, limits: LineLimits, joints: JointPath | None, profile: SpeedProfile) -> Array:
    """Return the largest ratio of a limited quantity to its limit in each interval of a speed profile. Shape (K,)."""
    inside = (np.arange(TIMING.points) + 0.5) / TIMING.points
    inside[0], inside[-1] = 1e-9, 1 - 1e-9
    motion = profile.at((profile.t[:-1, None] + np.diff(profile.t)[:, None] * inside).ravel())
    distance = np.clip(motion.distance, 0.0, path.length)
    demand = largest_demand(path, limits, joints, motion._replace(distance=distance))
    return np.asarray(demand.reshape(-1, TIMING.points).max(axis=1))


def _bernstein(x: Array) -> Array:
    """Return the Bernstein polynomials of degree `TIMING.degree` at points x. Shape (len(x), degree + 1)."""
    n = TIMING.degree
    return np.stack([comb(n, i) * x**i * (1 - x) ** (n - i) for i in range(n + 1)], axis=1)


def distinct(values: Array, tolerance: float) -> Array:
    """Sort values; drop each value that exceeds the value before by at most a tolerance, but keep the largest value."""
    ordered = np.sort(values)
    ordered = ordered[np.concatenate([[True], np.diff(ordered) > tolerance])]
    ordered[-1] = values.max()
    return np.asarray(ordered)


def reference_mesh(reference: SpeedProfile, joins: Array, span: tuple[float, float], intervals: int) -> Array:
    """Return the mesh nodes of the minimum-time problem as fractions of its horizon.

    Nodes are at the changes of jerk of the reference motion, and on both sides of the joins (B,), s, at which the
    path's derivatives jump. The whole time has at least the given number of intervals.
    """
    whole, (begin, end) = reference.duration, span
    beside, same = TIMING.beside_jump * whole, TIMING.same_node * whole
    joins = joins[(joins > begin + 2 * beside) & (joins < end - 2 * beside)]
    sides = np.concatenate([joins - beside, joins + beside])
    changes = reference.t[(reference.t > begin + same) & (reference.t < end - same)]
    if sides.size:
        changes = changes[np.abs(changes[:, None] - sides).min(axis=1) > 2 * beside]
    nodes = distinct(np.concatenate([[begin, end], sides, changes]), same)
    parts = np.maximum(np.ceil(np.diff(nodes) / (whole / intervals) - 1e-9), 1).astype(int)
    fractions = (subdivide(nodes, parts) - begin) / (end - begin)
    fractions[0], fractions[-1] = 0.0, 1.0
    return np.asarray(fractions)
