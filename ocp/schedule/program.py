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
"""

from __future__ import annotations

from typing import Any, NamedTuple

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from ocp.errors import SolveError
from ocp.schedule.profile import Array

__all__ = ["End", "Spline", "SplineRows", "least_time"]

STEPS = 200
ACCEPTED, MORE_STEPS = 1e-3, 10
"""Complementarity over the time that is accepted where rounding leads no further in so many steps."""
DIVERGED = 1e12
"""Complementarity over the time that tells that no motion keeps the rows."""
TO_BOUNDARY = 0.995
"""Share of the way to the nearest bound that a step takes at most."""
INFEASIBLE = 1e-6
"""What a row may miss its bound by, relative, when a solution is accepted."""
UNEVEN = 1e-3
"""Sum of the slopes that prices leave, by the logarithm of the coefficients, over the time, when it is accepted."""


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


class End(NamedTuple):
    """How a stretch begins or ends: at rest outside it, or moving.

    Attributes:
        rest: Distance (m) from rest to the stretch, over which the jerk is constant and x ~ s^(4/3); 0 if moving.
        x, slope: Squared speed and its derivative by the distance if moving.
    """

    rest: float = 0.0
    x: float = 0.0
    slope: float = 0.0


class Spline:
    """Squared speed over nodes, shape (N + 1,), m: N + 2 coefficients."""

    def __init__(self, nodes: Array) -> None:
        self.nodes, self.h = nodes, np.diff(nodes)
        before, after = np.append(0.0, self.h), np.append(self.h, 0.0)
        self.width = before + after
        self.share = before / self.width

    def at_nodes(self, b: Array) -> tuple[Array, Array]:
        """x and x' at the nodes. Shape (N + 1,) each."""
        step = np.diff(b)
        return b[:-1] + self.share * step, 2 * step / self.width

    def through(self, x: Array, slope: Array) -> Array:
        """Coefficients of the spline with x and x' at the nodes. Shape (N + 1,) each."""
        return np.append(x - self.share * self.width * slope / 2, x[-1])

    def basis(self, interval: NDArray[np.intp], fraction: Array) -> Array:
        """(x, x', x'') at places as linear functions of the three coefficients of their interval. Shape (M, 3, 3)."""
        h, inside = self.h[interval], fraction * self.h[interval]
        first, last, share = 2 / self.width[interval], 2 / self.width[interval + 1], self.share[interval]
        out = np.zeros((len(h), 3, 3))
        slope = np.zeros((len(h), 3))
        slope[:, 0], slope[:, 1] = -first, first
        out[:, 2, 0], out[:, 2, 1], out[:, 2, 2] = first / h, -(first + last) / h, last / h
        out[:, 1] = slope + inside[:, None] * out[:, 2]
        out[:, 0, 0], out[:, 0, 1] = 1 - share, share
        out[:, 0] += inside[:, None] * (slope + out[:, 1]) / 2
        return out


class _Ends:
    """What the ends of a stretch fix: at rest the outermost coefficient follows the next, moving both are known."""

    def __init__(self, spline: Spline, ends: tuple[End, End]) -> None:
        n = len(spline.h) + 2
        self.sides = ((0, 1, spline.h[0], 1.0, ends[0]), (n - 1, n - 2, spline.h[-1], -1.0, ends[1]))
        self.ratio = [1 / (1 + 2 * h / (3 * end.rest)) if end.rest else 0.0 for _, _, h, _, end in self.sides]
        fixed = [outer for outer, *_ in self.sides] + [inner for _, inner, *_, end in self.sides if not end.rest]
        self.fixed = np.array(sorted(fixed))

    def start(self, b: Array) -> Array:
        """Coefficients that keep to the ends."""
        b = b.copy()
        for (outer, inner, h, sign, end), ratio in zip(self.sides, self.ratio, strict=True):
            if end.rest:
                b[outer] = ratio * b[inner]
            else:
                b[outer], b[inner] = end.x, end.x + sign * h * end.slope / 2
        return b

    def follow(self, change: Array) -> None:
        """Make a change of the coefficients one that keeps to the ends, in place."""
        for (outer, inner, _, _, end), ratio in zip(self.sides, self.ratio, strict=True):
            change[outer] = ratio * change[inner] if end.rest else 0.0

    def reduce(self, slope: Array) -> None:
        """Make a slope by the coefficients one by the free ones, in place."""
        for (outer, inner, *_), ratio in zip(self.sides, self.ratio, strict=True):
            slope[inner] += ratio * slope[outer]
        slope[self.fixed] = 0.0

    def band(self, main: Array, beside: Array, apart: Array) -> Array:
        """Nonzeros, by columns, of a curvature by the free coefficients; what is fixed stands alone.

        Args:
            main, beside, apart: Its diagonals by all coefficients, changed in place. Shape (n,), (n - 1,), (n - 2,).
        """
        n = len(main)
        for (outer, inner, *_), ratio in zip(self.sides, self.ratio, strict=True):
            at, next_at = (0, 1) if outer == 0 else (n - 2, n - 3)
            main[inner] += ratio * (2 * beside[at] + ratio * main[outer])
            beside[next_at] += ratio * apart[min(at, n - 3)]
        free = np.ones(n)
        free[self.fixed] = 0.0
        full = np.zeros((n, 5))
        full[:, 2] = np.where(free > 0, main, 1.0)
        full[1:, 1] = full[:-1, 3] = beside * free[:-1] * free[1:]
        full[2:, 0] = full[:-2, 4] = apart * free[:-2] * free[2:]
        return np.concatenate([full[0, 2:], full[1, 1:], full[2:-2].ravel(), full[-2, :-1], full[-1, :-2]])


class _Steps:
    """Equations of five diagonals, solved by casadi in place."""

    def __init__(self, n: int) -> None:
        pattern = ca.Sparsity.banded(n, 2)
        matrix, right = ca.MX.sym("matrix", pattern), ca.MX.sym("right", n)
        self.function = ca.Function("steps", [matrix, right], [ca.solve(matrix, right, "ldl")])
        self.memory = [np.zeros(size) for size in (pattern.nnz(), n, n)]
        self.buffer, self.run = self.function.buffer()
        for k in (0, 1):
            self.buffer.set_arg(k, memoryview(self.memory[k]))  # type: ignore[arg-type]
        self.buffer.set_res(0, memoryview(self.memory[2]))  # type: ignore[arg-type]

    def matrix(self, band: Array) -> None:
        """Take a matrix by its nonzeros."""
        self.memory[0][:] = band

    def solve(self, right: Array) -> Array:
        self.memory[1][:] = right
        self.run()
        return self.memory[2].copy()


class _Group:
    """Rows in the order of their intervals: what they are of coefficients, and sums over those of each interval."""

    def __init__(self, interval: NDArray[np.intp], count: int) -> None:
        self.interval = interval
        self.first = np.flatnonzero(np.diff(interval, prepend=-1))
        self.each = np.diff(np.append(self.first, len(interval)))
        some = interval[self.first]
        self.present = slice(None) if len(some) == count else some

    def of(self, weights: Array, b: Array) -> Array:
        """Weights (3, M) times the three coefficients of each row. Shape (M,)."""
        near = np.repeat(np.stack([b[:-2], b[1:-1], b[2:]])[:, self.present], self.each, axis=1)
        return np.asarray(weights[0] * near[0] + weights[1] * near[1] + weights[2] * near[2])

    def add(self, values: Array, sums: Array) -> None:
        """Add values (k, M) to sums (k, N) of the intervals, in place."""
        if self.first.size:
            sums[:, self.present] += np.add.reduceat(values, self.first, axis=1)


def least_time(
    spline: Spline,
    rows: SplineRows,
    most: Array,
    ends: tuple[End, End],
    start: Array,
    *,
    accuracy: float,
    center: float,
) -> Array:
    """Coefficients of the fastest motion. Shape (N + 2,).

    Args:
        spline, rows: The stretch.
        most: Upper bounds of the coefficients; infinite for none. Shape (N + 2,).
        ends: Of the stretch.
        start: Coefficients to start from, positive; they need not keep the rows. Shape (N + 2,).
        accuracy: Of the time, relative.
        center: How far from the bounds to begin: complementarity over the time.

    Raises:
        SolveError: No motion was found that keeps the rows, with the distance of the worst as its `time`.
    """
    count = len(spline.h)
    n = count + 2
    bounded = np.flatnonzero(np.isfinite(most))
    # linear rows: the coefficients themselves, which are positive (one an interval) and at most so much, and others
    other = np.flatnonzero(~rows.jerk)
    interval = np.concatenate([np.arange(count), np.clip(bounded - 1, 0, count - 1), rows.interval[other]])
    weights = np.zeros((3, len(interval)))
    weights[1, :count] = -1.0
    weights[bounded - interval[count : count + len(bounded)], np.arange(count, count + len(bounded))] = 1.0
    weights[:, count + len(bounded) :] = _weights(spline, rows, other)
    bound = np.concatenate([np.zeros(count), most[bounded], rows.bound[other]])
    order = np.argsort(interval, kind="stable")
    lines, bound, linear = _Group(interval[order], count), bound[order], len(order)
    positive = np.flatnonzero(order < count)
    late = np.flatnonzero(rows.jerk)
    late = late[np.argsort(rows.interval[late], kind="stable")]
    jerks, sharp = _Group(rows.interval[late], count), rows.bound[late]
    of_jerks = _weights(spline, rows, late)
    square = np.ascontiguousarray(spline.basis(rows.interval[late], rows.root[late])[:, 0].T)
    gradients = np.concatenate([weights[:, order], of_jerks], axis=1)
    weights = gradients[:, :linear]

    fixing, steps = _Ends(spline, ends), _Steps(n)
    share, cost_weights = spline.share, spline.width / 2
    cost_weights[0] += 3 * ends[0].rest
    cost_weights[-1] += 3 * ends[1].rest

    def summed(values: Array) -> Array:
        sums = np.zeros((len(values), count))
        lines.add(values[:, :linear], sums)
        jerks.add(values[:, linear:], sums)
        return sums

    def gathered(values: Array) -> Array:
        sums, out = summed(gradients * values), np.zeros(n)
        for k in range(3):
            out[k : count + k] += sums[k]
        return out

    b, slack, price = fixing.start(start), np.zeros(0), np.zeros(0)
    found: Array | None = None
    latest = 0
    for number in range(STEPS):
        at = jerks.of(square, b)
        root = sharp / np.sqrt(at)
        gap = np.concatenate([lines.of(weights, b) - bound, jerks.of(of_jerks, b) - root])
        gradients[:, linear:] = of_jerks + (0.5 * root / at) * square
        size = np.concatenate([np.abs(bound), root]) + 1e-300

        x = b[:-1] + share * np.diff(b)
        times = cost_weights / np.sqrt(x)
        time = float(times.sum())
        slope, main, beside = _cost(share, -0.5 * times / x, 0.75 * times / x**2)
        if number == 0:
            slack = np.maximum(-gap, 0.1 * size)
            slack[positive] = b[1:-1]
            price = center * time / len(gap) / slack
        np.maximum(slack, -gap, out=slack)
        missed = gap + slack
        mean = float(slack @ price) / len(gap)
        residual = slope + gathered(price)
        fixing.reduce(residual)
        lacking = missed / size
        lacking[positive] = 0.0
        worst = float(lacking.max())
        if not np.isfinite(mean + worst) or mean * len(gap) > DIVERGED * time:
            if found is not None:
                return found
            break
        uneven = float(np.abs(residual * b).sum()) / time
        if worst < INFEASIBLE and uneven < UNEVEN and mean * len(gap) < ACCEPTED * time:
            found = b
        if found is not None and (mean * len(gap) < accuracy * time or number > latest):
            return found
        if found is None:
            latest = number + MORE_STEPS

        pull = price / slack
        g = gradients
        pulled = g * pull
        squares = summed(np.concatenate([g * pulled, g[:2] * pulled[1:], g[:1] * pulled[2:]]))
        for k in range(3):
            main[k : count + k] += squares[k]
        beside[:-1] += squares[3]
        beside[1:] += squares[4]
        steps.matrix(fixing.band(main, beside, squares[5]))

        def step(target: Any, pull: Array = pull, slope: Array = slope, missed: Array = missed) -> tuple[Array, ...]:
            """Change of coefficients, slacks and prices towards slack x price = target."""
            right = -(slope + gathered(target / slack + pull * missed))  # noqa: B023
            fixing.reduce(right)
            change = steps.solve(right)
            fixing.follow(change)
            of_lines = lines.of(gradients[:, :linear], change)
            of_slack = -missed - np.concatenate([of_lines, jerks.of(gradients[:, linear:], change)])
            return change, of_slack, target / slack - price - pull * of_slack  # noqa: B023

        _, of_slack, of_price = step(0.0)
        free, priced = _longest(slack, of_slack, 1.0), _longest(price, of_price, 1.0)
        reached = min(free, priced)
        after = float((slack + reached * of_slack) @ (price + reached * of_price)) / len(gap)
        sigma = max(min((after / mean) ** 3, 1.0), (1 - reached) ** 3)
        change, more_slack, more_price = step(sigma * mean - reached**2 * of_slack * of_price)
        free, priced = _longest(slack, more_slack, TO_BOUNDARY), _longest(price, more_price, TO_BOUNDARY)
        if min(free, priced) < 0.5 * reached:  # where the correction of second order leads astray
            change, more_slack, more_price = step(max(sigma, 0.1) * mean)
            free, priced = _longest(slack, more_slack, TO_BOUNDARY), _longest(price, more_price, TO_BOUNDARY)
        b, slack, price = b + free * change, slack + free * more_slack, price + priced * more_price
    row = int(lacking.argmax())
    place = float(spline.nodes[np.append(lines.interval, jerks.interval)[row]])
    message = f"no motion keeps the limits near {place:g} m: they miss one another by {worst:.2g}"
    raise SolveError(message, name="limits", value=worst, limit=INFEASIBLE, time=place)


def _weights(spline: Spline, rows: SplineRows, which: NDArray[np.intp]) -> Array:
    """Some rows by the coefficients of their intervals. Shape (3, M)."""
    basis = spline.basis(rows.interval[which], rows.fraction[which])
    return np.ascontiguousarray(np.einsum("mi,mij->jm", rows.of[which], basis))


def _cost(share: Array, first: Array, second: Array) -> tuple[Array, Array, Array]:
    """Slope of the time by the coefficients, and the two diagonals of its curvature; of values at the nodes."""
    n = len(share) + 1
    slope, main = np.zeros(n), np.zeros(n)
    slope[:-1] += (1 - share) * first
    slope[1:] += share * first
    main[:-1] += (1 - share) ** 2 * second
    main[1:] += share**2 * second
    return slope, main, share * (1 - share) * second


def _longest(value: Array, change: Array, share: float) -> float:
    """Longest step, at most 1, that keeps positive values so."""
    worst = float((change / value).min())
    return 1.0 if worst >= -share else -share / worst
