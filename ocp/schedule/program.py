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

    def reduce(self, gradients: Array, interval: NDArray[np.intp], touched: NDArray[np.intp]) -> None:
        """Gradients (3, M) by the coefficients of their intervals as those by the free ones, in place."""
        for (outer, inner, _, _, end), ratio in zip(self.sides, self.ratio, strict=True):
            at = touched[np.abs(interval[touched] + 1 - outer) <= 1]
            seat = outer - interval[at]
            if end.rest:
                gradients[inner - interval[at], at] += ratio * gradients[seat, at]
            gradients[seat, at] = 0.0
            if not end.rest:
                at = touched[np.abs(interval[touched] + 1 - inner) <= 1]
                gradients[inner - interval[at], at] = 0.0


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
    n = len(spline.h) + 2
    bounded = np.flatnonzero(np.isfinite(most))
    order = np.argsort(rows.jerk, kind="stable")
    size = [n - 2, len(bounded), len(order)]
    # the coefficients themselves come first: positive, and at most so much; then the rows, those of jerk at the end
    interval = np.concatenate([np.arange(n - 2), np.clip(bounded - 1, 0, n - 3), rows.interval[order]])
    linear = size[0] + size[1] + int((~rows.jerk).sum())
    weights = np.zeros((3, len(interval)))
    weights[1, : size[0]] = -1.0
    weights[bounded - interval[size[0] : size[0] + size[1]], np.arange(size[0], size[0] + size[1])] = 1.0
    basis = spline.basis(rows.interval[order], rows.fraction[order])
    weights[:, size[0] + size[1] :] = np.einsum("mi,mij->jm", rows.of[order], basis)
    late = order[linear - size[0] - size[1] :]
    square = np.ascontiguousarray(spline.basis(rows.interval[late], rows.root[late])[:, 0].T)
    del basis
    bound = np.concatenate([np.zeros(size[0]), most[bounded], rows.bound[order]])
    columns = [interval, interval + 1, interval + 2]
    inside = [column[linear:] for column in columns]
    touched = np.flatnonzero((interval <= 1) | (interval >= n - 4))
    fixing = _Ends(spline, ends)
    gradients = weights.copy()
    fixing.reduce(gradients, interval, touched)
    bent = touched[touched >= linear]
    share, cost_weights = spline.share, spline.width / 2
    cost_weights[0] += 3 * ends[0].rest
    cost_weights[-1] += 3 * ends[1].rest
    pattern = ca.Sparsity.banded(n, 2)
    factor = ca.Linsol("steps", "ldl", pattern)

    def gathered(values: Array) -> Array:
        return np.asarray(sum(np.bincount(c, g * values, n) for c, g in zip(columns, gradients, strict=True)))

    b, slack, price = fixing.start(start), np.zeros(0), np.zeros(0)
    found: Array | None = None
    latest = 0
    for number in range(STEPS):
        gap = weights[0] * b[columns[0]] + weights[1] * b[columns[1]] + weights[2] * b[columns[2]]
        at = square[0] * b[inside[0]] + square[1] * b[inside[1]] + square[2] * b[inside[2]]
        root = bound[linear:] / np.sqrt(at)
        gap[:linear] -= bound[:linear]
        gap[linear:] -= root
        gradients[:, linear:] = weights[:, linear:] + (0.5 * root / at) * square
        fixing.reduce(gradients, interval, bent)

        x = b[:-1] + share * np.diff(b)
        times = cost_weights / np.sqrt(x)
        time = float(times.sum())
        slope, main, beside = _cost(fixing, share, -0.5 * times / x, 0.75 * times / x**2)
        if number == 0:
            slack = np.maximum(-gap, 0.1 * np.concatenate([np.maximum(np.abs(bound[:linear]), 1e-300), root]))
            slack[: size[0]] = b[1:-1]
            price = center * time / len(gap) / slack
        np.maximum(slack, -gap, out=slack)
        missed = gap + slack
        mean = float(slack @ price) / len(gap)
        residual = slope + gathered(price)
        residual[fixing.fixed] = 0.0
        worst = float((missed[size[0] :] / np.concatenate([np.abs(bound[size[0] : linear]) + 1e-300, root])).max())
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
        pulled = gradients * pull
        _, g1, g2 = gradients
        main += np.asarray(sum(np.bincount(c, g * w, n) for c, g, w in zip(columns, gradients, pulled, strict=True)))
        beside[:-1] += np.bincount(columns[0], pulled[0] * g1, n)[:-1] + np.bincount(columns[1], pulled[1] * g2, n)[:-1]
        apart = np.asarray(np.bincount(columns[0], pulled[0] * g2, n), dtype=float)
        matrix = ca.DM(pattern, _band(main, beside, apart, fixing.fixed))
        factor.nfact(matrix)

        def step(target: Any, pull: Array = pull, slope: Array = slope, missed: Array = missed) -> tuple[Array, ...]:
            """Change of coefficients, slacks and prices towards slack x price = target."""
            right = -(slope + gathered(target / slack + pull * missed))  # noqa: B023
            right[fixing.fixed] = 0.0
            change = np.array(factor.solve(matrix, ca.DM(right))).ravel()  # noqa: B023
            fixing.follow(change)
            # the reduced gradients know the free coefficients only
            g = gradients
            of_slack = -missed - (g[0] * change[columns[0]] + g[1] * change[columns[1]] + g[2] * change[columns[2]])
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
    miss = missed[size[0] :]
    row = int((miss / np.concatenate([np.abs(bound[size[0] : linear]) + 1e-300, root])).argmax())
    place = float(spline.nodes[interval[size[0] + row]])
    message = f"no motion keeps the limits near {place:g} m: they miss one another by {worst:.2g}"
    raise SolveError(message, name="limits", value=worst, limit=INFEASIBLE, time=place)


def _cost(fixing: _Ends, share: Array, first: Array, second: Array) -> tuple[Array, Array, Array]:
    """Slope of the time by the coefficients, and the two diagonals of its curvature; of values at the nodes."""
    n = len(share) + 1
    slope, main = np.zeros(n), np.zeros(n)
    slope[:-1] += (1 - share) * first
    slope[1:] += share * first
    main[:-1] += (1 - share) ** 2 * second
    main[1:] += share**2 * second
    beside = np.append(share * (1 - share) * second, 0.0)
    for (outer, inner, *_), ratio in zip(fixing.sides, fixing.ratio, strict=True):
        slope[inner] += ratio * slope[outer]
        main[inner] += 2 * ratio * beside[min(outer, inner)] + ratio**2 * main[outer]
    return slope, main, beside


def _band(main: Array, beside: Array, apart: Array, fixed: NDArray[np.intp]) -> Array:
    """Nonzeros of a symmetric matrix of five diagonals by columns; what is fixed stands alone."""
    n = len(main)
    main[fixed] = 1.0
    free = np.ones(n)
    free[fixed] = 0.0
    beside[:-1] *= free[:-1] * free[1:]
    apart[:-2] *= free[:-2] * free[2:]
    full = np.zeros((n, 5))
    full[2:, 0], full[1:, 1], full[:, 2] = apart[:-2], beside[:-1], main
    full[:-1, 3], full[:-2, 4] = beside[:-1], apart[:-2]
    kept = np.ones((n, 5), dtype=bool)
    kept[0, :2] = kept[1, 0] = kept[-1, 3:] = kept[-2, 4] = False
    return np.asarray(full[kept])


def _longest(value: Array, change: Array, share: float) -> float:
    """Longest step, at most 1, that keeps positive values so."""
    worst = float((change / value).min())
    return 1.0 if worst >= -share else -share / worst
