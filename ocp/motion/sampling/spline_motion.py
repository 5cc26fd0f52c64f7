"""Locally optimal motions among obstacles within velocity, acceleration, jerk and torque limits, as B-splines.

The joint positions are a B-spline of the fraction s of the duration T, cubic if a jerk is limited or weighted, else
quadratic. Derivatives with respect to s are splines too, with control points that are linear in those of the joint
positions. A spline stays within the range of its control points (de Boor 2001, chapter XI), so that the limits of
velocity, acceleration and jerk hold at all times if

    |D1 c| <= T V,   |D2 c| <= T^2 A,   |D3 c| <= T^3 J

hold for the control points c. The right sides are convex in T; their tangents are below them. Hence each step of c and
T that keeps the tangents keeps the limits. Distances of bodies, at samples of the motion, and torques, at the knots,
are linearised. The cost is a weighted sum of T and of the integrals of squared derivatives,

    J = w0 T + sum over k of |L_k c|^2 / T^(2k - 1),

whose terms are squares of residuals that are linearised in c and T (Gauss and Newton's method). A step minimises it by
a linear or convex quadratic program within a trust region, which shrinks if the linearisation was too coarse. A slack
relaxes the constraints that the present motion violates, by as much as it does. Where T alone is the cost, an
interior-point method without crossover solves the programs: joints that have time to spare then move in the middle of
their freedom.

The proof that the motion is clear between the samples is left to the audit.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, NamedTuple, TypeAlias

import casadi as ca
import numpy as np
import scipy

from models.checks import Array
from ocp.console import casadi_silenced, check_time, time_left
from ocp.curves import gauss_points
from ocp.errors import SolveError
from ocp.motion.builders.constant_jerk import (
    ConstantJerkMotion,
    TorqueLimits,
    least_durations,
    synchronised_motion,
)  # fmt: skip
from ocp.motion.sampling.joint_paths import StraightMotions, points_along
from ocp.motion.tasks.goals import Cost
from ocp.motion.tasks.limits import JointBounds


@dataclass(frozen=True)
class SplineMotionSettings:
    """Settings of `optimal_motion_near` for its spline, constraints, trust region and iterations.

    Attributes:
        intervals: Number of intervals of the spline between the short ones at both ends.
        growth: Ratio of neighbouring intervals at the ends, where the acceleration builds up within the first one.
        shortest: Least share of the duration of the first interval.
        ramp: Share of the duration in which the speed along the path of the first guess builds up.
        margin: Distance beyond the clearance that is required at the samples, m, since bodies come closer between them.
        reach: Distance beyond the clearance within which pairs of bodies are constrained, m.
        torque_share: Share of the torque limits that is used at the knots.
        first, smallest, largest: First, least and largest trust region: the share of the distance that a joint covers
            at its rate limit within the duration.
        again: Least trust region at the beginning of a further round.
        change: Largest relative change of the duration in a step.
        widening, narrowing: Factors of the trust region after an accepted and after a refused step.
        violation: Weight of the slack beside the relative change of the cost.
        penalty: Weight of the excess of the usages in the merit of a motion, beside the logarithm of its cost, in free
            time; in a fixed time, which cannot be extended to satisfy the limits, the weight is `violation`.
        gains: Relative decrease of the cost in a step below which a round ends; the last one serves all further rounds.
        most_steps: Largest number of programs in a round.
        finer, most_rounds: Samples of an interval at which the clearance is checked after a round, and the largest
            number of rounds. The closest approaches that are not clear become samples of the next round.
    """

    intervals: int = 40
    growth: float = 1.6
    shortest: float = 1e-3
    ramp: float = 0.2
    margin: float = 1e-3
    reach: float = 0.08
    torque_share: float = 0.985
    first: float = 0.1
    again: float = 0.01
    smallest: float = 1e-4
    largest: float = 0.3
    change: float = 0.25
    widening: float = 1.5
    narrowing: float = 1 / 3
    violation: float = 10.0
    penalty: float = 0.1
    gains: tuple[float, ...] = (1e-2, 1e-3)
    most_steps: int = 60
    finer: int = 16
    most_rounds: int = 6


LIMIT_TOLERANCE = 1e-6
"""Relative excess of velocity, acceleration and jerk that counts as rounding: the tolerance of the linear programs."""
LINEAR: dict[str, Any] = {
    "error_on_fail": False,
    "highs": {"solver": "ipm", "run_crossover": "off", "output_flag": False},
}
QUADRATIC: dict[str, Any] = {"error_on_fail": False, "print_iter": False, "print_header": False}


@dataclass(frozen=True, eq=False)
class MotionLimits:
    """Constraints of a motion: clearance, joint limits, torque limits and end velocities.

    Attributes:
        motions: Proofs of clearance.
        bounds: Limits of the joints.
        torques: Torques of the machine.
        start_velocity, end_velocity: Rates at both ends, nan where free. Shape (n,).
    """

    motions: StraightMotions
    bounds: JointBounds
    torques: TorqueLimits
    start_velocity: Array
    end_velocity: Array


def has_spline_cost(cost: Cost) -> bool:
    """Return whether a cost weights only the duration and squares of derivatives of the joint positions."""
    return set(cost.terms) <= {"time", "velocity", "acceleration", "jerk"}


def square_weights(cost: Cost, size: int) -> Array:
    """Return the weights of the squared velocities, accelerations and jerks of `size` joints. Shape (3, n)."""
    rows = cost.joint_weights(size) / 2, cost.acceleration, cost.jerk
    return np.array([np.broadcast_to(np.asarray(row, dtype=float), size) for row in rows])


def optimal_motion_near(
    limits: MotionLimits,
    path: Array,
    cost: Cost,
    horizon: float | None = None,
    *,
    settings: SplineMotionSettings = SplineMotionSettings(),
) -> ConstantJerkMotion:
    """Return a locally optimal motion near a path, with the start and end configurations of the path.

    A motion from rest to rest in free time keeps the torque limits between the knots, too: it is slowed down where it
    does not.

    Args:
        limits: Limits, clearance and rates at the ends.
        path: Configurations with straight motions between them. Shape (M, n).
        cost: The cost, see `has_spline_cost`. It must weight time if the horizon is free.
        horizon: Duration, s; None if it is free.

    Raises:
        SolveError: No motion within the limits was found near the path.
        TimeLimitReached: Nor was it before the time limit.
    """
    search = _Search(limits, path, cost, horizon, settings)
    state, region = search.evaluate(*search.guess(path)), settings.first
    for number in range(settings.most_rounds):
        state, region = _local_optimum(search, state, region, settings.gains[min(number, len(settings.gains) - 1)])
        if not state.is_feasible:
            words = f"no motion within the limits was found near a path, they are exceeded by {state.excess:.2g}"
            raise SolveError(words, name="limits", value=state.excess, limit=1.0)
        if not search.add_places(state) and number + 1 >= len(settings.gains):
            break
        state = search.evaluate(state.points, state.duration)
    motion = search.motion(state)
    rests = not (np.any(limits.start_velocity) or np.any(limits.end_velocity))
    return limits.torques.slow_down(motion) if rests and horizon is None else motion


def _local_optimum(search: _Search, state: _State, region: float, least_gain: float) -> tuple[_State, float]:
    """Solve linear or quadratic programs in sequence; return the best feasible motion and the trust region size.

    If no motion is feasible, return the last one. The sequence ends when a program predicts that a step in the first
    trust region decreases the cost by less than `least_gain`, or when two steps do.
    """
    settings = search.settings
    penalty = settings.penalty if search.horizon is None else settings.violation
    best: _State | None = state if state.is_feasible else None
    idle = 0
    for _ in range(settings.most_steps):
        if best is not None and time_left() <= 0:
            break
        check_time()
        step = search.step(state, region)
        if step is not None and state.is_feasible and step.gain * max(1.0, settings.first / region) < least_gain:
            break  # the predicted gain is a concave function of the trust region
        trial = None if step is None else search.evaluate(step.points, step.duration)
        gain = 0.0 if trial is None else state.merit(penalty) - trial.merit(penalty)
        if trial is None or gain <= 0:
            region *= settings.narrowing
            if region < settings.smallest:
                break
            continue
        region = min(region * settings.widening, settings.largest)
        idle = idle + 1 if trial.is_feasible and gain < least_gain else 0
        state = trial
        if state.is_feasible and (best is None or state.cost < best.cost):
            best = state
        if idle > 1:
            break
    return state if best is None else best, max(region, settings.again)


@dataclass(frozen=True, eq=False)
class _State:
    """Iterate of sequential linear or quadratic programming: a motion, and its constraints linearised at this motion.

    Attributes:
        points: Control points. Shape (K, n).
        duration: T, s.
        cost: The cost.
        rows, usages: Derivatives of the usages of all limits by the free control points and by log T, and the usages:
            the limit is kept up to 1. Shape (R, F + 1) and (R,).
        allowed: Largest usage at which the motion counts as feasible, by row. Shape (R,).
    """

    points: Array
    duration: float
    cost: float
    rows: Any
    usages: Array
    allowed: Array

    @property
    def excess(self) -> float:
        """Largest relative violation of a limit; 0 if the motion is feasible."""
        return max(0.0, float((self.usages - self.allowed).max(initial=0.0)))

    @property
    def is_feasible(self) -> bool:
        return self.excess == 0

    def merit(self, penalty: float) -> float:
        """Return the merit of the iterate: logarithm of the cost plus `penalty` times the largest limit violation."""
        return float(np.log(self.cost)) + penalty * self.excess


class _Step(NamedTuple):
    """Result of an optimisation step: control points (K, n), duration, s, and predicted relative decrease of cost."""

    points: Array
    duration: float
    gain: float


_Rows: TypeAlias = tuple[Any, Array, Array, float]
"""Linearised limits: derivatives with respect to control points and log T, ratios to the limits, allowed excess."""


class _Search:
    """Search for the optimal motion in a spline basis by sequential linear or quadratic programming."""

    def __init__(
        self, limits: MotionLimits, path: Array, cost: Cost, horizon: float | None, settings: SplineMotionSettings
    ) -> None:
        self.limits, self.cost, self.horizon, self.settings = limits, cost, horizon, settings
        bounds = limits.bounds
        self.start, self.end, self.size = path[0], path[-1], path.shape[1]
        self.squares = square_weights(cost, self.size)
        self.degree = 3 if np.isfinite(bounds.jerk).any() or cost.jerk else 2
        self.largest = (bounds.velocity, bounds.acceleration, bounds.jerk)[: self.degree]
        self.has_rate_limit = np.isfinite(bounds.velocity)
        self.spread = np.where(self.has_rate_limit, 0.0, np.ptp(path, axis=0).max())
        self.breaks = self._breaks(path)
        self.knots = np.concatenate([np.zeros(self.degree), self.breaks, np.ones(self.degree)])
        self.count = len(self.breaks) - 1 + self.degree
        self.derivatives = [scipy.sparse.eye_array(self.count, format="csr")]
        for order in range(1, self.degree + 1):
            last = self.derivatives[-1]
            first, ahead = np.arange(order, order + last.shape[0] - 1), self.degree + 1 - order
            width = self.knots[first + ahead] - self.knots[first]
            derivative = scipy.sparse.diags_array(ahead / width) @ (last[1:] - last[:-1])
            self.derivatives.append(scipy.sparse.csr_array(derivative))
        self.places = np.linspace(0.0, 1.0, 2 * settings.intervals + 2)[1:-1]
        both = self.degree == 2  # the acceleration jumps at knots
        sides = [self.breaks[:-1], (self.breaks[:-1] + self.breaks[1:]) / 2, self.breaks[1:]]
        at = np.concatenate(sides) if both else np.unique(np.concatenate(sides))
        second = scipy.sparse.vstack([self.derivatives[2]] * len(sides)) if both else self._values(at, 2)
        self.at_torques = self._values(at, 0), self._values(at, 1), second
        self._fix_ends()
        self.residuals = [self._residuals(order) for order in (1, 2, 3) if self.squares[order - 1].any()]

    def _residuals(self, order: int) -> tuple[int, Any]:
        """Return p, L such that |L c|^2 / T^p is an integrated squared derivative (control points c, duration T)."""
        at, shares = (each.ravel() for each in gauss_points(self.breaks, self.degree - order + 1))
        basis = scipy.sparse.diags_array(np.sqrt(shares)) @ self._values(at, order)
        joints = scipy.sparse.diags_array(np.sqrt(self.squares[order - 1]))
        return 2 * order - 1, scipy.sparse.kron(basis, joints, format="csr")

    def _breaks(self, path: Array) -> Array:
        """Return the spline knots as fractions of the duration, with short intervals at both ends.

        In free time, the times at which the fastest motion of the slowest joint switches are knots, so that a spline
        attains the least time where nothing else slows the joints down.
        """
        bounds, settings = self.limits.bounds, self.settings
        with np.errstate(divide="ignore", invalid="ignore"):
            build_up = np.where(np.isfinite(bounds.acceleration), bounds.acceleration / bounds.jerk, 0.0).max()
            least = np.where(self.has_rate_limit, np.abs(self.end - self.start) / bounds.velocity, 0.0).max()
            least = least if self.horizon is None else self.horizon
        first = min(max(build_up / least if least > 0 else 0.0, settings.shortest), 1 / settings.intervals)
        short = [first] if self.degree == 3 else []
        while short and short[-1] * settings.growth < 1 / settings.intervals:
            short.append(short[-1] * settings.growth)
        rest = 1 - 2 * sum(short)
        inner = max(round(rest * settings.intervals), 1)
        lengths = np.concatenate([short, np.full(inner, rest / inner), short[::-1]])
        breaks = np.append(0.0, np.cumsum(lengths)) / sum(lengths)
        slowest = [int(least_durations(np.abs(self.end - self.start), bounds).argmax())]
        if self.horizon is None and self.start[slowest] != self.end[slowest]:
            own = JointBounds(*(limit[slowest] for limit in bounds))
            phases = synchronised_motion(self.start[slowest], self.end[slowest], own).durations
            switches = np.cumsum(phases[:-1]) / phases.sum()
            nearest = np.abs(breaks[1:-1, None] - switches).argmin(axis=0) + 1
            breaks = np.union1d(np.delete(breaks, nearest), switches)
        return np.asarray(breaks)

    def _values(self, places: Array, order: int) -> Any:
        """Return the matrix (M, K) that maps control points to a derivative at M fractions of the duration."""
        knots = self.knots[order : len(self.knots) - order]
        return scipy.interpolate.BSpline.design_matrix(places, knots, self.degree - order) @ self.derivatives[order]

    def _fix_ends(self) -> None:
        """Determine the control points that the start and end conditions fix; the others are free.

        They are `fixed` + T `moving`. A joint is at rest at an end, or has a given velocity there and no acceleration.
        """
        free = np.ones((self.count, self.size), dtype=bool)
        self.fixed, self.moving = np.zeros((self.count, self.size)), np.zeros((self.count, self.size))
        away = np.append(0.0, np.cumsum(-1 / self.derivatives[1].diagonal()))[: self.degree]  # equal at both ends
        limits, index = self.limits, np.arange(self.degree)
        ends = (index, away, self.start, limits.start_velocity), (-1 - index, -away, self.end, limits.end_velocity)
        for points, shares, joints, velocity in ends:
            known = ~np.isnan(velocity)
            free[points] = ~known
            free[points[0]] = False
            self.fixed[points] = joints
            self.moving[points] = shares[:, None] * np.where(known, velocity, 0.0)
        self.free = np.flatnonzero(free.ravel())
        self.fixed[free], self.moving[free] = 0.0, 0.0

    def guess(self, path: Array) -> tuple[Array, float]:
        """Return control points on a path and the duration; a free duration is the least that joint limits allow."""
        p, ramp = self.degree, self.settings.ramp
        at = np.array([self.knots[k + 1 : k + 1 + p].mean() for k in range(self.count)])
        top = 1 / (1 - ramp)
        share = top * np.where(at < ramp, at**2 / (2 * ramp), at - ramp / 2)
        share = np.where(at > 1 - ramp, 1 - top * (1 - at) ** 2 / (2 * ramp), share)
        speed = np.where(self.has_rate_limit, self.limits.bounds.velocity, 1.0)
        points = points_along(path, 1 / speed, np.clip(share, 0.0, 1.0))
        points[:p], points[-p:] = path[0], path[-1]
        if self.horizon is not None:
            return points, self.horizon
        duration = 0.0
        for order in range(1, p + 1):
            used = np.abs(self.derivatives[order] @ points) / self.largest[order - 1]
            duration = max(duration, float(used.max()) ** (1 / order))
        return points, duration if duration > 0 else 1.0

    def evaluate(self, points: Array, duration: float) -> _State:
        """Evaluate and linearise the constraints of a motion, given its free control points and its duration."""
        fixed = (self.fixed + duration * self.moving).ravel()
        fixed[self.free] = points.ravel()[self.free]
        points = fixed.reshape(self.count, self.size)
        parts = [*self._derivative_rows(points, duration), self._clearance_rows(points)]
        if len(self.limits.torques.limited):
            parts += self._torque_rows(points, duration)
        rows, by_time, usages, tolerances = zip(*parts, strict=True)
        matrix = scipy.sparse.vstack(rows).tocsc()
        by_duration = np.concatenate(by_time) + matrix @ (duration * self.moving).ravel()
        matrix = scipy.sparse.hstack([matrix[:, self.free], scipy.sparse.csc_array(by_duration[:, None])])
        allowed = np.concatenate([np.full(len(part), 1 + most) for part, most in zip(usages, tolerances, strict=True)])
        squares = sum(float(((root @ points.ravel()) ** 2).sum()) / duration**power for power, root in self.residuals)
        cost = self.cost.time * duration + squares
        return _State(points, duration, cost, matrix.tocsr(), np.concatenate(usages), allowed)

    def _derivative_rows(self, points: Array, duration: float) -> Iterator[_Rows]:
        """Yield the linearised limits of velocity, acceleration and jerk, both upper and lower."""
        for order in range(1, self.degree + 1):
            limited = np.flatnonzero(np.isfinite(self.largest[order - 1]))
            if not len(limited):
                continue
            derivative = self.derivatives[order]
            scale = 1 / (self.largest[order - 1][limited] * duration**order)
            pick = scipy.sparse.csr_array((scale, (np.arange(len(limited)), limited)), shape=(len(limited), self.size))
            matrix, usages = scipy.sparse.kron(derivative, pick), ((derivative @ points)[:, limited] * scale).ravel()
            by_duration = np.full(len(usages), -float(order))
            for sign in (1.0, -1.0):
                yield sign * matrix, by_duration, sign * usages, LIMIT_TOLERANCE

    def _clearance_rows(self, points: Array) -> _Rows:
        """Return the linearised clearance constraints of bodies that are near each other at samples of the motion."""
        margin, basis = self.settings.margin, self._values(self.places, 0)
        at, _, distance, gradient = self.limits.motions.near_pairs(basis @ points, self.settings.reach)
        matrix = self._row_matrix(basis[at], -gradient / margin)
        return matrix, np.zeros(len(at)), 2 - distance / margin, 0.5

    def _torque_rows(self, points: Array, duration: float) -> Iterator[_Rows]:
        """Yield the linearised upper and lower limits of torques, and those of powers, at the knots."""
        torques, share = self.limits.torques, self.settings.torque_share
        first, second = self.at_torques[1] @ points / duration, self.at_torques[2] @ points / duration**2
        values, slopes = torques.linearise(self.at_torques[0] @ points, first, second)
        scale = 1 / (share * torques.largest)
        at = np.repeat(np.arange(len(values)), len(scale))
        matrix: Any = 0.0
        for order, (basis, slope) in enumerate(zip(self.at_torques, slopes, strict=True)):
            by_joint = slope * scale[:, None] / duration**order
            matrix = matrix + self._row_matrix(basis[at], by_joint.reshape(len(at), self.size))
        by_duration = -(slopes[1] @ first[:, :, None] + 2 * slopes[2] @ second[:, :, None])[:, :, 0] * scale
        for sign, rows in ((1.0, slice(None)), (-1.0, np.flatnonzero(np.tile(torques.two_sided, len(values))))):
            usages = (values * scale).ravel()[rows]
            yield sign * matrix[rows], sign * by_duration.ravel()[rows], sign * usages, (1 - share) / 2

    def _row_matrix(self, basis: Any, by_joint: Array) -> Any:
        """Convert the Jacobian (R, n) of constraints in the joint positions to the Jacobian in the control points.

        `basis` has the values of the K basis functions at the sample of each constraint. Shape (R, K).
        """
        weights = scipy.sparse.coo_array(basis)
        row = np.repeat(weights.row, self.size)
        column = (weights.col[:, None] * self.size + np.arange(self.size)).ravel()
        values = (weights.data[:, None] * by_joint[weights.row]).ravel()
        return scipy.sparse.csr_array((values, (row, column)), shape=(len(by_joint), self.count * self.size))

    def step(self, state: _State, region: float) -> _Step | None:
        """Return a step, computed by a linear or quadratic program in a trust region; None if the program fails."""
        settings, bounds, count = self.settings, self.limits.bounds, len(self.free)
        travel = np.where(self.has_rate_limit, bounds.velocity * state.duration, self.spread) * region
        points = state.points.ravel()[self.free]
        joint = self.free % self.size
        change = settings.change if self.horizon is None else 0.0
        lower = np.concatenate([np.maximum(-travel[joint], bounds.lower[joint] - points), [-change, 0.0]])
        upper = np.concatenate([np.minimum(travel[joint], bounds.upper[joint] - points), [change, 1.0]])
        reachable = state.usages + abs(state.rows) @ np.maximum(-lower, upper)[:-1]
        kept = np.flatnonzero(reachable > 1)
        excess = np.maximum(state.usages[kept] - 1, 0.0)
        matrix = ca.DM(scipy.sparse.hstack([state.rows[kept], scipy.sparse.csr_array(-excess[:, None])]).tocsc())
        curvature, slope = self._cost_model(state)
        shape = {"h": curvature.sparsity(), "a": matrix.sparsity()}
        solver = ca.conic("step", *(("ipqp", shape, QUADRATIC) if self.residuals else ("highs", shape, LINEAR)))
        sides = {"lba": -np.inf, "uba": 1 - state.usages[kept], "lbx": np.minimum(lower, 0.0), "ubx": upper}
        with casadi_silenced():  # it warns of a degenerate program, which ends without success
            solution = solver(h=curvature, g=slope, a=matrix, **sides)
        if not solver.stats()["success"]:
            return None
        change = solution["x"].full().ravel()
        moved = state.points.ravel().copy()
        moved[self.free] += change[:count]
        points, duration = moved.reshape(self.count, self.size), state.duration * (1 + change[count])
        return _Step(points, duration, -float(solution["cost"]))

    def _cost_model(self, state: _State) -> tuple[ca.DM, Array]:
        """Return the Hessian and gradient of the relative cost in free control points, log duration and slack."""
        count, points, duration = len(self.free), state.points.ravel(), state.duration
        slope = np.concatenate([np.zeros(count), [self.cost.time * duration / state.cost, self.settings.violation]])
        curvature = scipy.sparse.csc_array((count + 1, count + 1))
        for power, root in self.residuals:
            value = root @ points
            by_duration = root @ (duration * self.moving.ravel()) - power / 2 * value
            slopes = scipy.sparse.hstack([root[:, self.free], scipy.sparse.csr_array(by_duration[:, None])])
            scale = 2 / (duration**power * state.cost)
            curvature = curvature + scale * (slopes.T @ slopes)
            slope[:-1] += scale * (slopes.T @ value)
        return ca.diagcat(ca.DM(curvature.tocsc().sorted_indices()), ca.DM(1, 1)), slope

    def add_places(self, state: _State) -> bool:
        """Add clearance constraints at collisions between the samples; return whether there are collisions."""
        dense = np.linspace(0.0, 1.0, self.settings.finer * (len(self.breaks) - 1) + 1)[1:-1]
        at, pair, distance, _ = self.limits.motions.near_pairs(self._values(dense, 0) @ state.points, 0.0)
        worst = {each: at[pair == each][distance[pair == each].argmin()] for each in np.unique(pair).tolist()}
        self.places = np.union1d(self.places, dense[list(worst.values())])
        return bool(worst)

    def motion(self, state: _State) -> ConstantJerkMotion:
        """Convert an iterate of the spline search to a motion with phases of constant jerk."""
        duration = state.duration
        joints, rates = (self._values(self.breaks[:-1], order) @ state.points for order in (0, 1))
        accelerations = (self.derivatives[2] @ state.points)[: len(self.breaks) - 1] / duration**2
        jerks = self.derivatives[3] @ state.points / duration**3 if self.degree == 3 else np.zeros_like(joints)
        return ConstantJerkMotion(np.diff(self.breaks) * duration, joints, rates / duration, accelerations, jerks)
