"""Minimum time along a given path under all limits, as an optimal control problem on the path parameter.

The reference for schedule, which plans by construction. The independent variable is a path parameter theta: the
time (s) at which a reference motion, usually a schedule of the same path, passes a place. Its distance, its speed
w(theta), curvature and joints are known functions of theta, smooth between the joints of the path, where the mesh has
nodes. With line speed v, acceleration a and jerk j,

    dv/dtheta = a w/v,   da/dtheta = j w/v,   time = integral of w/v dtheta.

From rest the jerk is constant over a first short distance d (and over a last one, mirrored): there v = j t^2/2,
a = j t, d = j t^3/6, so that a = 2 v^2/(3 d), j = a v/(3 d), t = 3 d/v. The problem begins where this ends, v stays
positive, and it is regular for every method. Held jerks on the mesh given here contain the reference itself.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from ocp.console import interruptible
from ocp.direct.collocation import Collocation
from ocp.errors import ProblemError, checked_count, checked_instance, checked_mapping
from ocp.methods import solve
from ocp.motion.builders.timing_tables import (
    cut,
    demand_of_pieces,
    distinct,
    path_columns,
    reference_mesh,
    reference_motion,
    table,
)
from ocp.motion.schedule.limits import JointPath, LineLimits, PathLike, check_line, check_smooth
from ocp.motion.schedule.planner import Schedule
from ocp.motion.schedule.profile import Array, SpeedProfile, integrate_jerk
from ocp.problem.problem import Problem
from ocp.solution import Solution

__all__ = ["Fastest", "TimingProblem", "minimum_time_problem", "plan_minimum_time"]

IPOPT = {"tol": 1e-9, "constr_viol_tol": 1e-9, "max_iter": 1000}


@dataclass(frozen=True)
class CutSettings:
    """Which intervals of the mesh of a fastest motion are cut.

    Attributes:
        demand: Share by which a limit may be passed in an interval.
        defect: Share of the distance and of the top speed by which states may not follow from their jerk.
        parts: Into which an interval is cut at most.
    """

    demand: float = 2e-4
    defect: float = 1e-6
    parts: int = 8


CUTS = CutSettings()


@dataclass(frozen=True, eq=False)
class TimingProblem:
    """Minimum time along a path, and what belongs to it.

    Attributes:
        problem: States "speed" and "acceleration", control "jerk" in `units`; its time is theta less its start, and
            its cost the time (s).
        mesh: Fractions of the horizon with nodes at every place where the path's derivatives jump, and at the
            reference's changes of jerk.
        units: Of speed, acceleration and jerk: the reference's largest, m/s, m/s^2, m/s^3.
        reference: The motion whose time is theta.
        span: First and last theta of the problem, s. Before and after, the jerk is constant.
    """

    problem: Problem
    mesh: tuple[float, ...]
    units: tuple[float, float, float]
    reference: SpeedProfile
    span: tuple[float, float]

    @property
    def method(self) -> Collocation:
        """Collocation with one jerk an interval: no overshoot between its points, at no change of the jerk."""
        return Collocation(len(self.mesh) - 1, 3, scheme="legendre", control="held", mesh=self.mesh)

    def profile(self, solution: Solution) -> SpeedProfile:
        """The motion of a solution, as pieces of constant jerk.

        Raises:
            ProblemError: A solution whose jerk is not held.
        """
        curve = solution.control_interpolant
        if curve.values.shape[1] != 1:
            message = "the jerk of this solution is not constant in its intervals; solve with control='held'"
            raise ProblemError(message, name="jerk", value=curve.values.shape[1], limit=1)
        breaks, begin, horizon = np.asarray(curve.breaks), self.span[0], self.span[1] - self.span[0]
        v, a = (solution.state_interpolant(breaks) * np.array(self.units[:2])).T
        jerk = curve.values[:, 0, 0] * self.units[2]
        points, weights = np.polynomial.legendre.leggauss(8)
        inside = (breaks[:-1, None] + np.diff(breaks)[:, None] * (points + 1) / 2).ravel()
        speed = solution.state_interpolant(inside)[:, 0] * self.units[0]
        pace = (self.reference.at(begin + horizon * inside).speed / speed).reshape(-1, len(points))
        durations = horizon * np.diff(breaks) * (pace @ weights) / 2
        s = self.reference.at(begin + horizon * breaks).distance
        first, last = self.ends
        ramps = 3 * first / v[0], 3 * last / v[-1]
        return SpeedProfile(
            np.concatenate([[0.0], np.cumsum([ramps[0], *durations, ramps[1]])]),
            np.concatenate([[0.0], s, self.reference.distance[-1:]]),
            np.concatenate([[0.0], v, [0.0]]),
            np.concatenate([[0.0], a, [0.0]]),
            np.concatenate([[a[0] * v[0] / (3 * first)], jerk, [-a[-1] * v[-1] / (3 * last)]]),
        )

    @property
    def ends(self) -> tuple[float, float]:
        """Distances (m) at both ends over which the jerk is constant."""
        return _ends(self.reference, self.span)


@dataclass(frozen=True, eq=False)
class Fastest:
    """The fastest motion found.

    Attributes:
        schedule: The motion, without dips listed; as that of ocp.motion.schedule.
        solution: Of the last problem solved. timing: That problem.
        demand: Largest demand over its limit at ten times the grid, the largest of all kinds; 1 is at the limit.
    """

    schedule: Schedule
    solution: Solution
    timing: TimingProblem
    demand: float

    @property
    def duration(self) -> float:
        """s."""
        return self.schedule.duration


@interruptible
def plan_minimum_time(
    path: PathLike,
    limits: LineLimits,
    joints: JointPath | None = None,
    *,
    guess: Schedule | None = None,
    intervals: int = 200,
    rounds: int = 6,
    options: dict[str, Any] | None = None,
) -> Fastest:
    """Fastest motion along a path from rest to rest under all limits.

    A motion that keeps them, hence an upper bound of the least time: jerks held over intervals cannot follow a limit
    exactly, which costs time in proportion to their width (about 0.2 % of the example's with joint limits at 200).
    The audit of its solution finds the motion feasible, but no optimum, for the time that is lost.

    Args:
        path, limits, joints: As of `ocp.motion.schedule.schedule`.
        guess: A schedule of the same path to start from; planned here if None.
        intervals: Least number of intervals, beside those at the path's joints and the guess's changes of jerk.
        rounds: How often intervals in which a limit is passed between the points are cut, at most.
        options: Of ipopt.

    Raises:
        ProblemError: As minimum_time_problem. SolveError: the solver failed, naming the worst residuals.
    """
    checked_count("rounds", rounds, 0)
    own = checked_mapping("options", options)
    timing = minimum_time_problem(path, limits, joints, guess=guess, intervals=intervals)
    solution: Solution | None = None
    for number in range(rounds + 1):
        solution = solve(timing.problem, timing.method, guess=solution, options={**IPOPT, **own})
        profile = timing.profile(solution)
        demand = demand_of_pieces(path, limits, joints, profile)
        parts = _parts(profile, demand)
        if number == rounds or parts.max() == 1:
            break
        mesh = tuple(cut(np.array(timing.mesh), parts).tolist())
        timing = TimingProblem(timing.problem, mesh, timing.units, timing.reference, timing.span)
    assert solution is not None
    return Fastest(Schedule(path, limits, profile, (), joints), solution, timing, float(demand.max()))


@interruptible
def minimum_time_problem(
    path: PathLike,
    limits: LineLimits,
    joints: JointPath | None = None,
    *,
    guess: Schedule | None = None,
    intervals: int = 200,
) -> TimingProblem:
    """The problem of `plan_minimum_time`, for any method to solve.

    Path constraints "asked speed", "centripetal acceleration", "joint velocity", "joint acceleration" and "joint jerk"
    (those that are limited), each over its limit; "start at rest" and "end at rest", "start jerk" and "end jerk".

    Raises:
        ProblemError: Joint limits without joints; a joint jerk limit on a path whose curvature jumps; curvature or
            joints that are not finite; a guess for another path; fewer than 10 intervals.
    """
    checked_count("intervals", intervals, 10)
    limited = check_line(path, limits, joints)
    if guess is not None:
        checked_instance("guess", guess, Schedule)
    if guess is not None and abs(guess.path.length - path.length) > 1e-9 * path.length:
        message = f"the guess is for a path of {guess.path.length:g} m, this one has {path.length:g} m"
        raise ProblemError(message, name="guess", value=guess.path.length, limit=path.length)
    path_columns(path, limits, limited, path.sample_distances())  # refuses what is not finite
    reference = reference_motion(path, limits, limited) if guess is None else guess.profile
    if guess is not None and limited is not None:
        check_smooth(path, limits, limited)  # refuses what no motion keeps, as a schedule does
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

    problem = _declared(path, limits, limited, reference, span, units, table(columns, breaks))
    return TimingProblem(problem, tuple(mesh.tolist()), units, reference, span)  # type: ignore[arg-type]


def _declared(
    path: PathLike,
    limits: LineLimits,
    joints: JointPath | None,
    reference: SpeedProfile,
    span: tuple[float, float],
    units: tuple[float, ...],
    along: Any,
) -> Problem:
    """The problem over a span of the reference's time, in units; `along`: reference speed and path_columns of theta."""
    problem = Problem("minimum time along a path", symbols=ca.MX)
    top, most, sharp = units
    asked = np.asarray(path.by_piece(limits.speed))

    def guessed(kind: str, unit: float) -> Any:
        return lambda theta: float(getattr(reference.at([span[0] + float(theta)]), kind)[0]) / unit

    slowest = 1e-3 * float(reference.at(list(span)).speed.min())
    fast, steep = float(asked.max()) / top, limits.acceleration / most
    speed = problem.state("speed", lower=slowest / top, upper=fast, guess=guessed("speed", top))
    rate = problem.state("acceleration", lower=-steep, upper=steep, guess=guessed("acceleration", most))
    bend = problem.control("jerk", lower=-limits.jerk / sharp, upper=limits.jerk / sharp, guess=guessed("jerk", sharp))
    problem.horizon(span[1] - span[0])
    v, a, j = top * speed, most * rate, sharp * bend
    values = along(span[0] + problem.time)
    pace = values[0] / v
    problem.dynamics(speed, a * pace / top)
    problem.dynamics(rate, j * pace / most)
    if asked.min() < asked.max():
        problem.path("asked speed", v / values[1], upper=1)
    for name, rows in _demands(limits, joints, values, v, a, j).items():
        problem.path(name, rows, lower=-1, upper=1)

    first, last = _ends(reference, span)
    starts, stops = ("start", 1.0, first, problem.start), ("end", -1.0, last, problem.end)
    for (where, sign, distance, ends), rest, bound in ((starts, 0.0, span[0]), (stops, reference.duration, span[1])):
        ends(f"{where} at rest", (sign * a - 2 * v**2 / (3 * distance)) / most, 0, 0)
        jerk = sign * a * v / (3 * distance)
        # the jerk, and with it the joints', at rest and where the problem begins
        rows = [jerk / limits.jerk]
        if joints is not None:
            for theta, v_, a_ in ((rest, 0.0, 0.0), (bound, v, a)):
                rows += [_demands(limits, joints, ca.DM(along(theta)), v_, a_, jerk).get("joint jerk", ca.MX(0, 1))]
        ends(f"{where} jerk", ca.vertcat(*rows), -1, 1)
    problem.minimize(running=pace, terminal=3 * first / (problem.at_start(speed) * top) + 3 * last / v)
    return problem


def _demands(limits: LineLimits, joints: JointPath | None, values: Any, v: Any, a: Any, j: Any) -> dict[str, Any]:
    """Everything limited along the path over its limit, by name; `values`: reference speed, then path_columns."""
    found: dict[str, Any] = {}
    if np.isfinite(limits.centripetal):
        found["centripetal acceleration"] = v**2 * values[2] / limits.centripetal
    if joints is None:
        return found
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
            found[name] = value[rows.tolist()] / ca.DM(bound[rows])
    return found


def _parts(profile: SpeedProfile, demand: Array) -> NDArray[np.intp]:
    """Into how many each interval of the problem is to be cut; the error falls with the square of their width."""
    v, a, j, t = profile.speed, profile.acceleration, profile.jerk, np.diff(profile.t)
    way, speed, _ = integrate_jerk(v[:-1], a[:-1], j, t)
    covered, gained = way / np.diff(profile.distance) - 1, (speed - v[1:]) / v.max()
    error = np.maximum((demand - 1) / CUTS.demand, np.maximum(np.abs(covered), np.abs(gained)) / CUTS.defect)[1:-1]
    parts = np.ceil(np.sqrt(np.maximum(error, 1.0)) * 1.2).astype(np.intp)
    return np.where(error > 1, np.minimum(parts, CUTS.parts), 1)


def _ends(reference: SpeedProfile, span: tuple[float, float]) -> tuple[float, float]:
    """Distances (m) before and after a span of the reference's time."""
    # the reference's jerk is constant there; from the cube, which keeps its digits near the end
    left = reference.duration - span[1]
    return float(reference.jerk[0] * span[0] ** 3 / 6), float(reference.jerk[-1] * left**3 / 6)
