"""Minimum-time motion along part of a path: convex optimisation of the squared speed by an interior-point method.

With x = v^2 as a function of the distance s, a = x'/2 and j = v x''/2, so that

    speed          x <= x_max
    acceleration   p x'/2 + q x + r between two bounds
    jerk           |p x''/2 + q x'/2 + r x| <= J x^(-1/2)
    time           integral of x^(-1/2) ds

are linear in (x, x', x'') except for x^(-1/2), which is convex: the time is a convex cost, and a row of jerk is linear
<= convex, whose tangent is conservative (Debrouwere et al., Time-Optimal Path Following for Robots With Convex-Concave
Constraints, 2013). Each step of the primal-dual interior point updates the tangents.

x is a spline with a knot at every node; in an interval x'' is proportional to the reciprocal of a speed that is known
in advance. Its coefficients are the unknowns; a row involves three of them and the normal equations have five
diagonals, so a step costs time and memory in proportion to the nodes.

Motions at distant places are almost independent. Therefore each interval has its own step length, which varies slowly
along the path; the number of steps then hardly grows with the nodes. If such steps diverge from the bounds, all
intervals use the shortest length from then on.
"""

from __future__ import annotations

from collections.abc import Iterable
from copy import copy
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import scipy
from numpy.typing import NDArray

from models.checks import Array
from ocp.errors import SolveError
from ocp.tolerances import SOLVER_SHARE


@dataclass(frozen=True)
class ProgramSettings:
    """Settings of the interior-point method that computes the fastest motion along part of a path.

    Complementarity is relative to the travel time.

    Attributes:
        steps: Largest number of steps.
        more_steps: Further steps after an accepted one, where rounding stops progress.
        accepted: Complementarity at which a solution is accepted, and the stationarity residual by the logarithm of the
            coefficients, over the time.
        violation: Largest violation of a row in an accepted solution, unless `violation_by_accuracy` times the squared
            accuracy is larger.
        diverged: Complementarity above which the program counts as infeasible.
        to_boundary: Largest share of the step to the nearest bound.
        reduction: Largest share of a coefficient that a step removes: a motion close to rest may be a trap.
        block: Intervals of a block; step lengths are interpolated between the middles of blocks.
        regularisations: Relative additions to the diagonal, tried in order until the equations are positive definite.
        growth: Largest growth of the worst violation in a step.
        negligible: Violation below which any growth is accepted.
    """

    steps: int = 200
    more_steps: int = 10
    accepted: float = 1e-3
    violation: float = SOLVER_SHARE
    violation_by_accuracy: float = 100.0
    diverged: float = 1e12
    to_boundary: float = 0.995
    reduction: float = 0.7
    block: int = 10
    regularisations: tuple[float, ...] = (0.0, 1e-14, 1e-12, 1e-10)
    growth: float = 2.0
    negligible: float = 1e-2


INTERIOR = ProgramSettings()


class SplineRows(NamedTuple):
    """Constraints on the squared speed along a path and on its first two derivatives with respect to distance.

    Attributes:
        interval: Interval in which each row holds. Shape (M,).
        fraction: Position in the interval at which it holds, in [0, 1]. Shape (M,).
        of: Coefficients c in c . (x, x', x'') <= bound for squared speed x. Shape (M, 3).
        bound: Upper bound of each row. Shape (M,).
        jerk: Whether the row is a limit of jerk, c . (x, x', x'') <= bound x^(-1/2). Shape (M,).
    """

    interval: NDArray[np.intp]
    fraction: Array
    of: Array
    bound: Array
    jerk: NDArray[np.bool_]


class Spline:
    """Spline of the squared speed over the distance along a path, with N + 1 nodes (m) and N + 2 coefficients.

    In each interval the acceleration is linear in the time of a motion whose speed v is linear in time and starts at
    `ratios` times its mean: x'' is proportional to 1 / v, and the jerk is constant however much the speed grows. With
    ratios of 1 this is a spline of degree 2. The coefficients are the values where tangents at neighbouring nodes meet.
    """

    def __init__(self, nodes: Array, ratios: Array) -> None:
        self.nodes, self.h, self.ratios = nodes, np.diff(nodes), ratios
        mean = (4 - ratios) / 6
        before, after = np.append(0.0, mean * self.h), np.append((1 - mean) * self.h, 0.0)
        self.width = 2 * (before + after)
        self.share = 2 * before / self.width

    def part(self, at: NDArray[np.intp]) -> Spline:
        """Return the spline that consists of those coefficients of this spline that have the indices `at`."""
        part, last = copy(self), len(self.h)
        part.h, part.ratios = (kind[np.minimum(at[:-2], last - 1)] for kind in (self.h, self.ratios))
        nodes = np.minimum(at[:-1], last)
        part.nodes, part.width, part.share = self.nodes[nodes], self.width[nodes], self.share[nodes]
        return part

    def at_nodes(self, b: Array) -> tuple[Array, Array]:
        """Return the squared speed and its derivative with respect to distance at the nodes. Shape (N + 1,) each."""
        step = np.diff(b)
        return b[:-1] + self.share * step, 2 * step / self.width

    def through(self, x: Array, slope: Array) -> Array:
        """Return the spline's coefficients from squared speeds and their derivatives at the nodes (N + 1,)."""
        return np.append(x - self.share * self.width * slope / 2, x[-1])

    def basis(self, interval: NDArray[np.intp], fraction: Array) -> Array:
        """Return matrices (3, 3, M) that map 3 coefficients to squared speed and its 2 derivatives at M points."""
        h, share, ratio = self.h[interval], self.share[interval], self.ratios[interval]
        time = 2 * fraction / (ratio + np.sqrt(ratio**2 + 4 * (1 - ratio) * fraction))  # fraction of the time
        first, last = 2 / self.width[interval], 2 / self.width[interval + 1]
        start, change = np.array([-first, first, 0 * h]), np.array([first, -(first + last), last])
        slope, second = start + change * time, change / (h * (ratio + 2 * (1 - ratio) * time))
        value = h * (start * fraction + change * (fraction * time - time**2 * (ratio / 2 + (1 - ratio) * time / 3)))
        value[0] += 1 - share
        value[1] += share
        return np.array([value, slope, second])


class Program(NamedTuple):
    """Minimum-time optimisation problem for a motion along part of a path.

    Attributes:
        spline: Spline of the squared speed.
        rows: Constraints on the spline.
        upper: Upper bounds of the spline coefficients; infinite for none. Shape (N + 2,).
        rest: Distances (m) from rest to the beginning and from the end of the spline to rest, with constant jerk and
            x ~ s^(4/3); 0 where the motion does not begin or end at rest.
        fixed: Indices of fixed coefficients: the outer two where the stretch begins or ends in motion.
    """

    spline: Spline
    rows: SplineRows
    upper: Array
    rest: tuple[float, float]
    fixed: NDArray[np.intp]

    def part(self, free: NDArray[np.intp]) -> tuple[Program, NDArray[np.intp]]:
        """Return the problem in which only given intervals are free, and its coefficients' indices in this problem."""
        count = len(self.spline.h)  # stretches are concatenated, with two intervals without rows between them
        cuts = np.flatnonzero(np.diff(free) > 1)
        first, last = free[np.append(0, cuts + 1)], free[np.append(cuts, len(free) - 1)] + 1
        sizes = last - first + 2
        begin = np.cumsum(sizes) - sizes
        at = np.arange(sizes.sum()) + np.repeat(first - begin, sizes)
        fixed = np.isin(at, self.fixed)
        left, right = first > 0, last < count
        inner = np.concatenate([begin[left], begin[left] + 1, (begin + sizes)[right] - 1, (begin + sizes)[right] - 2])
        fixed[inner] = True
        new_interval = np.full(count, -1)
        new_interval[free] = np.arange(len(free)) + 2 * np.repeat(np.arange(len(first)), last - first)
        # rows without x'' at the outer nodes depend on fixed coefficients only
        known = np.zeros((2, count), dtype=bool)
        known[0, first[left]], known[1, last[right] - 1] = True, True
        interval, inside, curved = self.rows.interval, self.rows.fraction, self.rows.of[:, 2] != 0
        outer = (known[0, interval] & (inside == 0)) | (known[1, interval] & (inside == 1))
        rows = SplineRows(*(kind[(new_interval[interval] >= 0) & (curved | ~outer)] for kind in self.rows))
        upper = self.upper[at]
        upper[inner] = np.inf
        rest = 0.0 if left[0] else self.rest[0], 0.0 if right[-1] else self.rest[1]
        moved = rows._replace(interval=new_interval[rows.interval])
        return Program(self.spline.part(at), moved, upper, rest, np.flatnonzero(fixed)), at


class _EndConditions:
    """Ends of squared-speed splines: the outer two coefficients have a fixed ratio at rest, fixed values in motion."""

    def __init__(self, program: Program) -> None:
        n, width, (first, last) = len(program.upper), program.spline.width, program.rest
        self.sides = [(0, 1, 1 / (1 + 2 * width[0] / (3 * first)))] if first else []
        self.sides += [(n - 1, n - 2, 1 / (1 + 2 * width[-1] / (3 * last)))] if last else []
        self.fixed = np.union1d(program.fixed, np.array([outer for outer, *_ in self.sides], dtype=np.intp))

    def impose(self, b: Array) -> Array:
        """Return a copy of the spline coefficients ``b`` that satisfies the end conditions."""
        b = b.copy()
        for outer, inner, ratio in self.sides:
            b[outer] = ratio * b[inner]
        return b

    def adapt_step(self, change: Array) -> None:
        """Adapt a change of the coefficients, in place, to the end conditions, so that they stay satisfied."""
        change[self.fixed] = 0.0
        for outer, inner, ratio in self.sides:
            change[outer] = ratio * change[inner]

    def reduce_gradient(self, slope: Array) -> None:
        """Replace a gradient, in place, by the gradient with respect to the free coefficients."""
        for outer, inner, ratio in self.sides:
            slope[inner] += ratio * slope[outer]
        slope[self.fixed] = 0.0

    def reduce_hessian(self, main: Array, first: Array, second: Array) -> Array:
        """Return the diagonals of a Hessian with respect to the free coefficients, as input of `_BandSolver`.

        Args:
            main, first, second: Diagonals for all coefficients, changed in place. Shape (n,), (n - 1,), (n - 2,).
        """
        n = len(main)
        for outer, inner, ratio in self.sides:
            at, next_at = (0, 1) if outer == 0 else (n - 2, n - 3)
            main[inner] += ratio * (2 * first[at] + ratio * main[outer])
            first[next_at] += ratio * second[min(at, n - 3)]
        main[self.fixed] = 1.0
        for kind in (first, second):
            reach = n - len(kind)
            kind[self.fixed[self.fixed < n - reach]] = 0.0
            kind[self.fixed[self.fixed >= reach] - reach] = 0.0
        full = np.zeros((3, n), order="F")
        full[0], full[1, :-1], full[2, :-2] = main, first, second
        return full


class _BandSolver:
    """Solver of linear systems with a symmetric positive definite pentadiagonal matrix, given by diagonals (3, n).

    Raises:
        LinAlgError: The equations are not positive definite, for example when only rounding errors remain.
    """

    def __init__(self, band: Array) -> None:
        for share in INTERIOR.regularisations:
            regularised = band.copy(order="F")
            regularised[0] *= 1 + share
            self.factors, failed = scipy.linalg.lapack.dpbtrf(regularised, lower=1, overwrite_ab=1)
            if not failed:
                return
        raise np.linalg.LinAlgError("the equations of a step are not positive definite")

    def solve(self, right: Array) -> Array:
        """Solve the factorised linear system for a right-hand side."""
        return np.asarray(scipy.linalg.lapack.dpbtrs(self.factors, right, lower=1)[0])


class _Constraints:
    """Constraints of a `Program`: coefficients are positive and below upper bounds, and the motion keeps its limits.

    Values of constraints, shape (M,), are in this order; the jerk limits come last.

    Attributes:
        count: Number of intervals.
        interval: Interval of each constraint. Shape (M,).
        gradients: Derivatives of the rows with respect to their interval's three coefficients. Shape (3, M - `alone`).
    """

    def __init__(self, program: Program) -> None:
        spline, rows, upper, *_ = program
        self.count = len(spline.h)
        self.bounded = np.flatnonzero(np.isfinite(upper))
        self.alone = self.count + len(self.bounded)
        order = np.lexsort((rows.interval, rows.jerk))
        self.row_interval = interval = rows.interval[order]
        self.interval = np.concatenate([np.arange(self.count), np.clip(self.bounded - 1, 0, self.count - 1), interval])
        self.bound = np.concatenate([np.zeros(self.count), upper[self.bounded], rows.bound[order]])
        basis, of = spline.basis(interval, rows.fraction[order]), rows.of[order].T
        self.linear = of[0] * basis[0] + of[1] * basis[1] + of[2] * basis[2]
        self.gradients = self.linear.copy()
        self.jerk = int(len(order) - rows.jerk.sum())  # first jerk limit
        self.square = basis[0][:, self.jerk :]
        self.sharp = self.bound[self.alone + self.jerk :].copy()
        self.bound[self.alone + self.jerk :] = 0.0
        ends = np.searchsorted(np.sort(interval), np.arange(self.count + 1))
        data = np.ones(len(interval)), np.argsort(interval, kind="stable"), ends
        self.by_interval = scipy.sparse.csr_array(data, (self.count, len(interval)))
        block = self.interval // INTERIOR.block
        starts = np.diff(block, prepend=-1) != 0
        starts[self.count : self.count + 1] = True
        self.runs = np.flatnonzero(starts)
        self.blocks = block[self.runs]
        self.middles = INTERIOR.block * np.arange(self.blocks.max() + 1) + (INTERIOR.block - 1) / 2

    def evaluate(self, b: Array) -> tuple[Array, Array]:
        """Return violations and scales of all constraints at spline coefficients; linearise the jerk limits there."""
        coefficients, sharp = self._coefficients(b), self.alone + self.jerk
        at = _weighted_sum(self.square, [each[self.jerk :] for each in coefficients])
        root = self.sharp / np.sqrt(at)
        gap = self._all_values(b, _weighted_sum(self.linear, coefficients)) - self.bound
        size = np.abs(self.bound) + 1e-300
        gap[sharp:] -= root
        size[sharp:] += root
        tangent = self.gradients[:, self.jerk :]
        np.multiply(self.square, 0.5 * root / at, out=tangent)
        tangent += self.linear[:, self.jerk :]
        return gap, size

    def change_of(self, change: Array) -> Array:
        """Return the linearised change of each constraint value due to a change of the coefficients. Shape (M,)."""
        return self._all_values(change, _weighted_sum(self.gradients, self._coefficients(change)))

    def weighted_gradients(self, values: Array) -> Array:
        """Return the sum of the gradients of all constraints, each multiplied by its weight. Shape (N + 2,)."""
        out = self._accumulate(self.gradients * values[self.alone :])
        out[1:-1] -= values[: self.count]
        out[self.bounded] += values[self.count : self.alone]
        return out

    def outer_products(self, values: Array) -> tuple[Array, Array, Array]:
        """Return diagonals (N + 2,), (N + 1,), (N,) of the weighted sum of outer products of the gradients."""
        g = self.gradients
        pulled = g * values[self.alone :]
        main = self._accumulate(g * pulled)
        main[1:-1] += values[: self.count]
        main[self.bounded] += values[self.count : self.alone]
        return main, self._accumulate([g[0] * pulled[1], g[1] * pulled[2]]), self._accumulate([g[0] * pulled[2]])

    def _coefficients(self, b: Array) -> list[Array]:
        """Return, for each limit constraint, the three spline coefficients of the interval in which it holds."""
        return [b[k : self.count + k].take(self.row_interval) for k in range(3)]

    def _all_values(self, b: Array, rows: Array) -> Array:
        """Stack the values of all constraints: those on single coefficients `b`, then those on the motion (`rows`)."""
        return np.concatenate([-b[1:-1], b[self.bounded], rows])

    def _accumulate(self, values: Iterable[Array]) -> Array:
        """Sum values of limits by spline coefficient: a limit's k-th value goes to its interval's k-th coefficient.

        Shapes (M - `alone`,) each to (N + number of values - 1,).
        """
        sums = [self.by_interval @ each for each in values]
        out = np.zeros(self.count + len(sums) - 1)
        for k, own in enumerate(sums):
            out[k : self.count + k] += own
        return out

    def step_lengths(self, rates: Array, share: float, of_positive: float) -> Array:
        """Return a Newton step length of at most 1 for each interval; it varies slowly along the path. Shape (N,).

        Args:
            rates: Relative rates of change of values that stay positive. Shape (M,).
            share: Largest share of the way to zero that a step takes.
            of_positive: Largest share of the way to zero for the coefficients.
        """
        runs = np.minimum.reduceat(rates, self.runs)
        last = len(self.middles)
        runs[:last] *= share / of_positive
        worst = np.zeros(last)
        np.minimum.at(worst, self.blocks, runs)
        steps = 1 / np.maximum(-worst / share, 1.0)
        if not (steps < 1).any():
            return np.ones(self.count)
        # the least step of a block and its neighbours: then no interpolated step exceeds that of either block
        padded = np.concatenate([steps[:1], steps, steps[-1:]])
        least = np.minimum(np.minimum(padded[:-2], padded[2:]), steps)
        return np.asarray(np.interp(np.arange(self.count), self.middles, least))


def _weighted_sum(weights: Array, values: list[Array]) -> Array:
    """Return the sum of three arrays of values, each multiplied by its weights."""
    return np.asarray(weights[0] * values[0] + weights[1] * values[1] + weights[2] * values[2])


def least_time(program: Program, start: Array, *, accuracy: float, center: float) -> Array:
    """Return the spline coefficients of the fastest motion, computed by an interior-point method. Shape (N + 2,).

    Args:
        program: Program of the stretch.
        start: Positive initial coefficients; they need not satisfy the rows. Shape (N + 2,).
        accuracy: Relative accuracy of the time; other tolerances are loosened if they are tighter than it requires.
        center: Initial complementarity (sum of slacks times multipliers) divided by the time.

    Raises:
        SolveError: No motion that satisfies the rows was found, with the distance of the worst row as `time`.
    """
    spline, rest = program.spline, program.rest
    count, constraints, ends = len(spline.h), _Constraints(program), _EndConditions(program)
    cost_weights = spline.width / 2
    cost_weights[0] += 3 * rest[0]
    cost_weights[-1] += 3 * rest[1]
    b = ends.impose(start)
    gap, size = constraints.evaluate(b)
    slack = np.maximum(-gap, 0.1 * size)
    slack[:count] = b[1:-1]
    multiplier = center * _travel_time(spline.share, cost_weights, b)[0] / len(gap) / slack

    def solve(right: Array) -> Array:
        """Return the Newton step of the coefficients."""
        ends.reduce_gradient(right)
        change = equations.solve(right)
        ends.adapt_step(change)
        return change

    accepted: Array | None = None
    latest, worst, uniform = 0, np.inf, False
    before: tuple[tuple[Array, float, Array], ...] = ()
    for number in range(INTERIOR.steps):
        np.maximum(slack, -gap, out=slack)
        violation = _violations(gap, slack, size, count)
        if before and not uniform and not violation.max() < max(INTERIOR.growth * worst, INTERIOR.negligible):
            uniform = True
            b, slack, multiplier = (value + step * change for value, step, change in before)
            gap, size = constraints.evaluate(b)
            np.maximum(slack, -gap, out=slack)
            violation = _violations(gap, slack, size, count)
        time, slope, *curvature = _travel_time(spline.share, cost_weights, b)
        mean, worst = float(slack @ multiplier) / len(gap), float(violation.max())
        if not np.isfinite(mean + worst) or mean * len(gap) > INTERIOR.diverged * time:
            break
        complementary = mean * len(gap) < max(INTERIOR.accepted, accuracy) * time
        if complementary and worst < max(INTERIOR.violation, INTERIOR.violation_by_accuracy * accuracy**2):
            stationarity = slope + constraints.weighted_gradients(multiplier)
            ends.reduce_gradient(stationarity)
            if float(np.abs(stationarity * b).sum()) < max(INTERIOR.accepted, accuracy) * time:
                accepted = b
        if accepted is not None and (mean * len(gap) < accuracy * time or number > latest):
            return accepted
        if accepted is None:
            latest = number + INTERIOR.more_steps

        per_slack, residual = 1 / slack, gap + slack
        weight = multiplier * per_slack
        squares = constraints.outer_products(weight)
        hessian = [own + more for own, more in zip(curvature, squares, strict=True)]
        try:
            equations = _BandSolver(ends.reduce_hessian(*hessian))
        except np.linalg.LinAlgError:
            break
        gradient = slope + constraints.weighted_gradients(weight * residual)

        # the relative rates of the multipliers are those of the slacks, mirrored about -1/2
        change = solve(-gradient)
        rates = -(residual + constraints.change_of(change)) * per_slack
        reached = constraints.step_lengths(np.minimum(rates, -1 - rates), 1.0, 1.0)
        affine, product = reached.take(constraints.interval), slack * multiplier
        after = float((product * (1 + affine * rates)) @ (1 - affine - affine * rates)) / len(gap)
        remaining = 1 - reached
        sigma = np.maximum(min((after / mean) ** 3, 1.0), remaining * remaining * remaining)
        target = (mean * sigma).take(constraints.interval) + affine * affine * product * rates * (1 + rates)
        target_multiplier = target * per_slack
        change = solve(-(gradient + constraints.weighted_gradients(target_multiplier)))
        slack_change = -(residual + constraints.change_of(change))
        multiplier_change = target_multiplier - multiplier - weight * slack_change
        lengths = [
            constraints.step_lengths(slack_change * per_slack, INTERIOR.to_boundary, INTERIOR.reduction),
            constraints.step_lengths(multiplier_change / multiplier, INTERIOR.to_boundary, INTERIOR.to_boundary),
        ]
        primal, dual = (each.min() for each in lengths)
        if uniform:
            lengths = [np.full(count, each) for each in (primal, dual)]
        else:
            before = (b, primal, change), (slack, primal, slack_change), (multiplier, dual, multiplier_change)
        b = b + np.concatenate([lengths[0][:1], lengths[0], lengths[0][-1:]]) * change
        slack = slack + lengths[0].take(constraints.interval) * slack_change
        multiplier = multiplier + lengths[1].take(constraints.interval) * multiplier_change
        gap, size = constraints.evaluate(b)
    if accepted is not None:
        return accepted
    place = float(spline.nodes[constraints.interval[int(violation.argmax())]])
    message = f"no motion keeps the limits near {place:g} m: they conflict by {worst:.2g}"
    raise SolveError(message, name="limits", value=worst, limit=INTERIOR.violation, time=place)


def _violations(gap: Array, slack: Array, size: Array, count: int) -> Array:
    """Return the relative residuals of constraints with slack variables; 0 for the first `count`, which always hold."""
    violation = (gap + slack) / size
    violation[:count] = 0.0
    return np.asarray(violation)


def _travel_time(share: Array, weights: Array, b: Array) -> tuple[float, Array, Array, Array, Array]:
    """Return the travel time, its gradient, and three diagonals of its Hessian in the spline coefficients.

    These are the main and two upper diagonals. `weights` are the path lengths that the quadrature points represent.
    """
    x = b[:-1] + share * np.diff(b)
    times = weights / np.sqrt(x)
    first, second = -0.5 * times / x, 0.75 * times / (x * x)
    slope, main = np.zeros(len(b)), np.zeros(len(b))
    slope[:-1] += (1 - share) * first
    slope[1:] += share * first
    main[:-1] += (1 - share) ** 2 * second
    main[1:] += share**2 * second
    return float(times.sum()), slope, main, share * (1 - share) * second, np.zeros(len(b) - 2)
