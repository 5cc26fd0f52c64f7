"""The least time over a stretch of a path as a sequence of convex programs in the squared speed, by one interior point.

With x = v^2 as a function of the distance s, a = x'/2 and j = v x''/2, so that

    speed          x <= most
    acceleration   p x'/2 + q x + r between two bounds
    jerk           |p x''/2 + q x'/2 + r x| <= J x^(-1/2)
    time           integral of x^(-1/2) ds

are linear in (x, x', x'') but for x^(-1/2), which is convex: the time is a convex cost, and a jerk's row linear <=
convex, whose tangent is on the safe side (Debrouwere et al., Time-Optimal Path Following for Robots With Convex-Concave
Constraints, 2013). Each step of the primal-dual interior point takes the tangents anew, so that the sequence of
programs and the way to the solution of each are one.

x is a spline of degree 2 with a knot at every node: x'' is constant in an interval. Its B-spline coefficients are the
unknowns; a row touches three of them and the normal equations have five diagonals, so a step costs time and memory in
proportion to the nodes.

Motions at places far from one another hardly depend on one another. So a step is not of one length, that which its
worst row allows, but of as many as there are intervals, which change slowly along the path; the number of steps then
hardly grows with the nodes. Where such steps lead away from the bounds, all places make the shortest from there on.
"""

from __future__ import annotations

from collections.abc import Iterable
from copy import copy
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg.lapack import dpbtrf, dpbtrs
from scipy.sparse import csr_array

from ocp.errors import SolveError
from ocp.motion.schedule.profile import Array
from ocp.tolerances import SOLVER_SHARE

__all__ = ["INTERIOR", "Program", "ProgramSettings", "Spline", "SplineRows", "least_time"]


@dataclass(frozen=True)
class ProgramSettings:
    """How the interior point goes. Shares are relative; complementarity is over the time.

    Attributes:
        steps: At most. more_steps: After one that is accepted, where rounding leads no further.
        accepted: Complementarity at which a solution is accepted, and what prices may leave of the slopes by the
            logarithm of the coefficients, over the time.
        missed: What a row may miss its bound by in a solution that is accepted, or `missed_by_accuracy` times the
            square of the accuracy that is asked.
        diverged: Complementarity above which no motion keeps the rows.
        to_boundary: Share of the way to the nearest bound that a step takes at most.
        lost: Share of a coefficient that a step takes at most: a motion that all but stands still may be a trap.
        block: Intervals of a block, from whose middle to the next one's the lengths of steps change.
        firm: Added to the diagonal of the equations of a step, until rounding does not make them indefinite.
        astray: Ratio by which the worst miss may grow in a step. no_matter: What it may be in any case.
    """

    steps: int = 200
    more_steps: int = 10
    accepted: float = 1e-3
    missed: float = SOLVER_SHARE
    missed_by_accuracy: float = 100.0
    diverged: float = 1e12
    to_boundary: float = 0.995
    lost: float = 0.7
    block: int = 10
    firm: tuple[float, ...] = (0.0, 1e-14, 1e-12, 1e-10)
    astray: float = 2.0
    no_matter: float = 1e-2


INTERIOR = ProgramSettings()


class SplineRows(NamedTuple):
    """Rows c . (x, x', x'') <= bound, or <= bound x^(-1/2).

    Attributes:
        interval: That the place lies in. Shape (M,).
        fraction: Place in the interval, of [0, 1]. Shape (M,).
        root: Place in the interval of the x of x^(-1/2). Shape (M,).
        of: Coefficients of x, x' and x''. Shape (M, 3).
        bound: Shape (M,).
        jerk: Whether the bound is that of a jerk, which grows as x^(-1/2). Shape (M,).
    """

    interval: NDArray[np.intp]
    fraction: Array
    root: Array
    of: Array
    bound: Array
    jerk: NDArray[np.bool_]


class Spline:
    """Squared speed over nodes, shape (N + 1,), m: N + 2 coefficients."""

    def __init__(self, nodes: Array) -> None:
        self.nodes, self.h = nodes, np.diff(nodes)
        before, after = np.append(0.0, self.h), np.append(self.h, 0.0)
        self.width = before + after
        self.share = before / self.width

    def part(self, at: NDArray[np.intp]) -> Spline:
        """That of some coefficients, as if they were neighbours."""
        found, last = copy(self), len(self.h)
        found.h = self.h[np.minimum(at[:-2], last - 1)]
        found.nodes, found.width, found.share = (
            kind[np.minimum(at[:-1], last)] for kind in (self.nodes, self.width, self.share)
        )
        return found

    def at_nodes(self, b: Array) -> tuple[Array, Array]:
        """x and x' at the nodes. Shape (N + 1,) each."""
        step = np.diff(b)
        return b[:-1] + self.share * step, 2 * step / self.width

    def through(self, x: Array, slope: Array) -> Array:
        """Coefficients of the spline with x and x' at the nodes. Shape (N + 1,) each."""
        return np.append(x - self.share * self.width * slope / 2, x[-1])

    def basis(self, interval: NDArray[np.intp], fraction: Array) -> Array:
        """(x, x', x'') at places as linear functions of the three coefficients of their interval. Shape (3, 3, M)."""
        h, share = self.h[interval], self.share[interval]
        inside = fraction * h
        first, last = 2 / self.width[interval], 2 / self.width[interval + 1]
        bend = np.array([first / h, -(first + last) / h, last / h])
        before = np.array([-first, first, 0 * h])
        slope = before + inside * bend
        here = inside / 2 * (before + slope)
        here[0] += 1 - share
        here[1] += share
        return np.array([here, slope, bend])


class Program(NamedTuple):
    """What is run in the least time.

    Attributes:
        spline: Squared speed.
        rows: What it keeps.
        most: Upper bounds of its coefficients; infinite for none. Shape (N + 2,).
        rest: Distances (m) from rest to its beginning and from its end to rest, over which the jerk is constant and
            x ~ s^(4/3); 0 where it moves there.
        fixed: Coefficients that stay: the outer two where it begins or ends moving.
    """

    spline: Spline
    rows: SplineRows
    most: Array
    rest: tuple[float, float]
    fixed: NDArray[np.intp]

    def part(self, free: NDArray[np.intp]) -> tuple[Program, NDArray[np.intp]]:
        """That of some intervals (B,), in order, between motions that stay, and its coefficients in this one.

        Its stretches stand one behind the other, two intervals without rows between them.
        """
        count = len(self.spline.h)
        cuts = np.flatnonzero(np.diff(free) > 1)
        first, last = free[np.append(0, cuts + 1)], free[np.append(cuts, len(free) - 1)] + 1
        sizes = last - first + 2
        begin = np.cumsum(sizes) - sizes
        at = np.arange(sizes.sum()) + np.repeat(first - begin, sizes)
        stays = np.isin(at, self.fixed)
        left, right = first > 0, last < count
        inner = np.concatenate([begin[left], begin[left] + 1, (begin + sizes)[right] - 1, (begin + sizes)[right] - 2])
        stays[inner] = True
        seat = np.full(count, -1)
        seat[free] = np.arange(len(free)) + 2 * np.repeat(np.arange(len(first)), last - first)
        # what is known at the outer nodes is not asked for again
        known = np.zeros((2, count), dtype=bool)
        known[0, first[left]], known[1, last[right] - 1] = True, True
        interval, inside, bent = self.rows.interval, self.rows.fraction, self.rows.of[:, 2] != 0
        outer = (known[0, interval] & (inside == 0)) | (known[1, interval] & (inside == 1))
        rows = SplineRows(*(kind[(seat[interval] >= 0) & (bent | ~outer)] for kind in self.rows))
        most = self.most[at]
        most[inner] = np.inf
        rest = 0.0 if left[0] else self.rest[0], 0.0 if right[-1] else self.rest[1]
        own = rows._replace(interval=seat[rows.interval])
        return Program(self.spline.part(at), own, most, rest, np.flatnonzero(stays)), at


class _Ends:
    """What of the coefficients is no unknown: some stay, and where a program is at rest the outer one follows."""

    def __init__(self, program: Program) -> None:
        n, h, (first, last) = len(program.most), program.spline.h, program.rest
        self.sides = [(0, 1, 1 / (1 + 2 * h[0] / (3 * first)))] if first else []
        self.sides += [(n - 1, n - 2, 1 / (1 + 2 * h[-1] / (3 * last)))] if last else []
        self.fixed = np.union1d(program.fixed, np.array([outer for outer, *_ in self.sides], dtype=np.intp))

    def start(self, b: Array) -> Array:
        """Coefficients that keep to the ends."""
        b = b.copy()
        for outer, inner, ratio in self.sides:
            b[outer] = ratio * b[inner]
        return b

    def follow(self, change: Array) -> None:
        """Make a change of the coefficients one that keeps to the ends, in place."""
        change[self.fixed] = 0.0
        for outer, inner, ratio in self.sides:
            change[outer] = ratio * change[inner]

    def reduce(self, slope: Array) -> None:
        """Make a slope by the coefficients one by the free ones, in place."""
        for outer, inner, ratio in self.sides:
            slope[inner] += ratio * slope[outer]
        slope[self.fixed] = 0.0

    def band(self, main: Array, beside: Array, apart: Array) -> Array:
        """Diagonals of a curvature by the free coefficients, what is fixed alone, as `_Steps` takes them.

        Args:
            main, beside, apart: Its diagonals by all coefficients, changed in place. Shape (n,), (n - 1,), (n - 2,).
        """
        n = len(main)
        for outer, inner, ratio in self.sides:
            at, next_at = (0, 1) if outer == 0 else (n - 2, n - 3)
            main[inner] += ratio * (2 * beside[at] + ratio * main[outer])
            beside[next_at] += ratio * apart[min(at, n - 3)]
        main[self.fixed] = 1.0
        for kind in (beside, apart):
            reach = n - len(kind)
            kind[self.fixed[self.fixed < n - reach]] = 0.0
            kind[self.fixed[self.fixed >= reach] - reach] = 0.0
        full = np.zeros((3, n), order="F")
        full[0], full[1, :-1], full[2, :-2] = main, beside, apart
        return full


class _Steps:
    """Solves equations of five diagonals, symmetric and positive, by those on the diagonal and below. Shape (3, n).

    Raises:
        LinAlgError: They are not positive, as where rounding is all that is left of a program.
    """

    def __init__(self, band: Array) -> None:
        for firm in INTERIOR.firm:
            firmer = band.copy(order="F")
            firmer[0] *= 1 + firm
            self.factors, failed = dpbtrf(firmer, lower=1, overwrite_ab=1)
            if not failed:
                return
        raise np.linalg.LinAlgError("the equations of a step are not positive")

    def solve(self, right: Array) -> Array:
        return np.asarray(dpbtrs(self.factors, right, lower=1)[0])


class _Rows:
    """All rows of a program: coefficients that are positive, and at most so much, and others, those of jerk last.

    Values of rows, shape (M,), stand in this order.

    Attributes:
        count: Of intervals.
        interval: That each lies in. Shape (M,).
        gradients: Of the others by the three coefficients of their interval. Shape (3, M - `alone`).
    """

    def __init__(self, program: Program) -> None:
        spline, rows, most, *_ = program
        self.count = len(spline.h)
        self.bounded = np.flatnonzero(np.isfinite(most))
        self.alone = self.count + len(self.bounded)
        order = np.lexsort((rows.interval, rows.jerk))
        self.others = interval = rows.interval[order]
        self.interval = np.concatenate([np.arange(self.count), np.clip(self.bounded - 1, 0, self.count - 1), interval])
        self.bound = np.concatenate([np.zeros(self.count), most[self.bounded], rows.bound[order]])
        basis, of = spline.basis(interval, rows.fraction[order]), rows.of[order].T
        self.linear = of[0] * basis[0] + of[1] * basis[1] + of[2] * basis[2]
        self.gradients = self.linear.copy()
        self.jerk = int(len(order) - rows.jerk.sum())  # the first of these
        self.square = spline.basis(interval[self.jerk :], rows.root[order[self.jerk :]])[0]
        self.sharp = self.bound[self.alone + self.jerk :].copy()
        self.bound[self.alone + self.jerk :] = 0.0
        ends = np.searchsorted(np.sort(interval), np.arange(self.count + 1))
        shape = self.count, len(interval)
        self.by_interval = csr_array((np.ones(len(interval)), np.argsort(interval, kind="stable"), ends), shape)
        block = self.interval // INTERIOR.block
        starts = np.diff(block, prepend=-1) != 0
        starts[self.count : self.count + 1] = True
        self.runs = np.flatnonzero(starts)
        self.blocks = block[self.runs]
        self.middles = INTERIOR.block * np.arange(self.blocks.max() + 1) + (INTERIOR.block - 1) / 2

    def look(self, b: Array) -> tuple[Array, Array]:
        """What rows miss their bounds by, and the size of these. Takes the tangents of the rows of jerk at b."""
        near, sharp = self._near(b), self.alone + self.jerk
        at = _weighed(self.square, [each[self.jerk :] for each in near])
        root = self.sharp / np.sqrt(at)
        gap, size = self._with(b, _weighed(self.linear, near)) - self.bound, np.abs(self.bound) + 1e-300
        gap[sharp:] -= root
        size[sharp:] += root
        tangent = self.gradients[:, self.jerk :]
        np.multiply(self.square, 0.5 * root / at, out=tangent)
        tangent += self.linear[:, self.jerk :]
        return gap, size

    def of(self, change: Array) -> Array:
        """What a change of the coefficients changes. Shape (M,)."""
        return self._with(change, _weighed(self.gradients, self._near(change)))

    def gathered(self, values: Array) -> Array:
        """Sums of values times gradients, by the coefficients. Shape (N + 2,)."""
        out = self._spread(self.gradients * values[self.alone :])
        out[1:-1] -= values[: self.count]
        out[self.bounded] += values[self.count : self.alone]
        return out

    def squares(self, values: Array) -> tuple[Array, Array, Array]:
        """Diagonals of the sum of values times squares of gradients. Shape (N + 2,), (N + 1,), (N,)."""
        g = self.gradients
        pulled = g * values[self.alone :]
        main = self._spread(g * pulled)
        main[1:-1] += values[: self.count]
        main[self.bounded] += values[self.count : self.alone]
        return main, self._spread([g[0] * pulled[1], g[1] * pulled[2]]), self._spread([g[0] * pulled[2]])

    def _near(self, b: Array) -> list[Array]:
        """The three coefficients of the interval of each of the others."""
        return [b[k : self.count + k].take(self.others) for k in range(3)]

    def _with(self, b: Array, others: Array) -> Array:
        return np.concatenate([-b[1:-1], b[self.bounded], others])

    def _spread(self, values: Iterable[Array]) -> Array:
        """Sums over the others of each interval, by its first coefficient or pair of these, its second one and so on.

        Shapes (M - `alone`,) each to one of N and as many as there are, less one.
        """
        sums = [self.by_interval @ each for each in values]
        out = np.zeros(self.count + len(sums) - 1)
        for k, own in enumerate(sums):
            out[k : self.count + k] += own
        return out

    def longest(self, rates: Array, share: float, of_positive: float) -> Array:
        """Steps, at most 1, that change slowly along the path: one an interval. Shape (N,).

        Args:
            rates: At which values that stay positive change, relative. Shape (M,).
            share: Of the way to zero that a step takes at most. of_positive: The same, for those of the coefficients.
        """
        runs = np.minimum.reduceat(rates, self.runs)
        last = len(self.middles)
        runs[:last] *= share / of_positive  # those of the coefficients
        worst = np.zeros(last)
        np.minimum.at(worst, self.blocks, runs)
        steps = 1 / np.maximum(-worst / share, 1.0)
        if not (steps < 1).any():
            return np.ones(self.count)
        # of a block and those beside it the least: so no way between the middles of two of them is above either
        around = np.concatenate([steps[:1], steps, steps[-1:]])
        least = np.minimum(np.minimum(around[:-2], around[2:]), steps)
        return np.asarray(np.interp(np.arange(self.count), self.middles, least))


def _weighed(weights: Array, values: list[Array]) -> Array:
    return np.asarray(weights[0] * values[0] + weights[1] * values[1] + weights[2] * values[2])


def least_time(program: Program, start: Array, *, accuracy: float, center: float) -> Array:
    """Coefficients of the fastest motion. Shape (N + 2,).

    Args:
        program: The stretch.
        start: Coefficients to start from, positive; they need not keep the rows. Shape (N + 2,).
        accuracy: Of the time, relative, and of all else where that is less accurate than what is accepted.
        center: How far from the bounds to begin: complementarity over the time.

    Raises:
        SolveError: No motion was found that keeps the rows, with the distance of the worst as its `time`.
    """
    spline, rest = program.spline, program.rest
    count, every, fixing = len(spline.h), _Rows(program), _Ends(program)
    cost_weights = spline.width / 2
    cost_weights[0] += 3 * rest[0]
    cost_weights[-1] += 3 * rest[1]
    b = fixing.start(start)
    gap, size = every.look(b)
    slack = np.maximum(-gap, 0.1 * size)
    slack[:count] = b[1:-1]
    price = center * _time(spline.share, cost_weights, b)[0] / len(gap) / slack

    def solved(right: Array) -> Array:
        """Change of the coefficients."""
        fixing.reduce(right)
        change = equations.solve(right)
        fixing.follow(change)
        return change

    found: Array | None = None
    latest, worst, together = 0, np.inf, False
    before: tuple[tuple[Array, float, Array], ...] = ()
    for number in range(INTERIOR.steps):
        np.maximum(slack, -gap, out=slack)
        lacking = _lacking(gap, slack, size, count)
        if before and not together and not lacking.max() < max(INTERIOR.astray * worst, INTERIOR.no_matter):
            together = True
            b, slack, price = (value + step * change for value, step, change in before)
            gap, size = every.look(b)
            np.maximum(slack, -gap, out=slack)
            lacking = _lacking(gap, slack, size, count)
        time, slope, *curvature = _time(spline.share, cost_weights, b)
        mean, worst = float(slack @ price) / len(gap), float(lacking.max())
        if not np.isfinite(mean + worst) or mean * len(gap) > INTERIOR.diverged * time:
            if found is not None:
                return found
            break
        near_enough = mean * len(gap) < max(INTERIOR.accepted, accuracy) * time
        if near_enough and worst < max(INTERIOR.missed, INTERIOR.missed_by_accuracy * accuracy**2):
            residual = slope + every.gathered(price)
            fixing.reduce(residual)
            if float(np.abs(residual * b).sum()) < max(INTERIOR.accepted, accuracy) * time:
                found = b
        if found is not None and (mean * len(gap) < accuracy * time or number > latest):
            return found
        if found is None:
            latest = number + INTERIOR.more_steps

        per_slack, missed = 1 / slack, gap + slack
        pull = price * per_slack
        squares = every.squares(pull)
        try:
            equations = _Steps(fixing.band(*(own + more for own, more in zip(curvature, squares, strict=True))))
        except np.linalg.LinAlgError:
            if found is not None:
                return found
            break
        base = slope + every.gathered(pull * missed)

        # the prices' relative rates towards 0 are those of the slacks, mirrored about -1/2
        change = solved(-base)
        rates = -(missed + every.of(change)) * per_slack
        reached = every.longest(np.minimum(rates, -1 - rates), 1.0, 1.0)
        far, product = reached.take(every.interval), slack * price
        after = float((product * (1 + far * rates)) @ (1 - far - far * rates)) / len(gap)
        left = 1 - reached
        sigma = np.maximum(min((after / mean) ** 3, 1.0), left * left * left)
        target = (mean * sigma).take(every.interval) + far * far * product * rates * (1 + rates)
        wanted = target * per_slack
        change = solved(-(base + every.gathered(wanted)))
        of_slack = -(missed + every.of(change))
        of_price = wanted - price - pull * of_slack
        taken = [
            every.longest(of_slack * per_slack, INTERIOR.to_boundary, INTERIOR.lost),
            every.longest(of_price / price, INTERIOR.to_boundary, INTERIOR.to_boundary),
        ]
        shortest = [each.min() for each in taken]
        if together:
            taken = [np.full(count, each) for each in shortest]
        else:
            before = (b, shortest[0], change), (slack, shortest[0], of_slack), (price, shortest[1], of_price)
        b = b + np.concatenate([taken[0][:1], taken[0], taken[0][-1:]]) * change
        slack = slack + taken[0].take(every.interval) * of_slack
        price = price + taken[1].take(every.interval) * of_price
        gap, size = every.look(b)
    row = int(lacking.argmax())
    place = float(spline.nodes[every.interval[row]])
    message = f"no motion keeps the limits near {place:g} m: they miss one another by {worst:.2g}"
    raise SolveError(message, name="limits", value=worst, limit=INTERIOR.missed, time=place)


def _lacking(gap: Array, slack: Array, size: Array, count: int) -> Array:
    """What rows lack beside their slacks, over their bounds; none of the first so many, which are positive."""
    lacking = (gap + slack) / size
    lacking[:count] = 0.0
    return np.asarray(lacking)


def _time(share: Array, weights: Array, b: Array) -> tuple[float, Array, Array, Array, Array]:
    """The time, its slope by the coefficients and the three diagonals of its curvature; of weights at the nodes."""
    x = b[:-1] + share * np.diff(b)
    times = weights / np.sqrt(x)
    first, second = -0.5 * times / x, 0.75 * times / (x * x)
    slope, main = np.zeros(len(b)), np.zeros(len(b))
    slope[:-1] += (1 - share) * first
    slope[1:] += share * first
    main[:-1] += (1 - share) ** 2 * second
    main[1:] += share**2 * second
    return float(times.sum()), slope, main, share * (1 - share) * second, np.zeros(len(b) - 2)
