"""What the straight step between two instants costs at least, from one chart into another, by the place it begins at.

The integral of half the squared rates is no less than |dq|^2 / (2 dt), the length no less than |dq|_1. Charts touch the
sets; what a set bends away from them is taken into account, and for the rest it is assumed that within a box it strays
no farther than at the rim.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import product
from typing import Any, NamedTuple, Protocol, TypeAlias

import numpy as np

from models.arrays import Array
from ocp.motion.search.charts import Charts

__all__ = [
    "CurvedCharts",
    "Homogeneous",
    "LargestMotion",
    "PathLength",
    "QuadraticBounds",
    "SquaredRates",
    "StepBounds",
    "StepCost",
    "least_in_box",
]

MEETINGS = 8
"""Times that the least of what is homogeneous is looked for where lines meet: one of as many as joints, each time."""
CONCAVE = 0.5
"""Curvature of values, of the step's own, that is taken as it is; what is more concave is bounded by its ends."""


class QuadraticBounds(NamedTuple):
    """Bounds of what is to come (or has been) on the charts of an instant: least + slope . t + t . curve . t / 2.

    Attributes:
        least: Infinite where nothing leads on. Shape (N,). slope: Shape (N, r). curve: Symmetric. Shape (N, r, r).
    """

    least: Array
    slope: Array
    curve: Array

    def of(self, chosen: Any) -> QuadraticBounds:
        """Some of them."""
        return QuadraticBounds(*(part[chosen] for part in self))

    @classmethod
    def constant(cls, least: Array, free: int) -> QuadraticBounds:
        """The same everywhere on charts of so many free directions."""
        return cls(least, np.zeros((len(least), free)), np.zeros((len(least), free, free)))

    def lowest(self, low: Array, high: Array) -> tuple[Array, Array]:
        """The least in boxes (N, r), and where."""
        least, place = least_in_box(self.slope, self.curve, low, high)
        return self.least + least, place

    def at(self, places: Array) -> Array:
        """Values (N,) at places (N, r)."""
        pressed = np.einsum("nab,nb->na", self.curve, places)
        return np.asarray(self.least + (places * (self.slope + pressed / 2)).sum(axis=1))


class CurvedCharts(NamedTuple):
    """Charts, and how the set that they touch bends away from them: bends[t, t] / 2 + rest.

    Attributes:
        charts: N of them. bends: Shape (N, n, r, r). rest: At the rim. Shape (N, c, n).
    """

    charts: Charts
    bends: Array
    rest: Array

    def of(self, chosen: Any) -> CurvedCharts:
        """Some of them."""
        return CurvedCharts(self.charts.of(chosen), self.bends[chosen], self.rest[chosen])


class StepCost(Protocol):
    """What a straight step costs at least."""

    def cheapest(self, delta: Array, into: Charts, after: QuadraticBounds, seconds: float) -> tuple[Array, Array]:
        """Costs (P,) of the cheapest steps into P charts, whose centres are `delta` (P, n) away, and places (P, r)."""

    def below(
        self, delta: Array, out: CurvedCharts, into: CurvedCharts, after: QuadraticBounds, seconds: float
    ) -> StepBounds:
        """Bounds of P steps from charts into others, whose centres are `delta` (P, n) away."""

    def of(self, delta: Array, seconds: Any) -> Array:
        """Of steps (..., n)."""

    def farthest(self, cost: float, seconds: float) -> float:
        """How far a step of at most this cost goes in the metric of the charts."""


@dataclass(frozen=True, eq=False)
class SquaredRates:
    """The integral of half the weighted squared rates.

    A step d moves along the chart that it goes into and across it. Along, the cost is convex in both places, and the
    least over the place in the box is quadratic in the place that is gone from, by the multipliers of the box. Across,
    |d|^2 / (2 dt) is at least p . d - dt |p|^2 / 2, p what it is from the nearest places: what the set bends goes into
    the curvature of the values, where it cancels from step to step, and only the rest, of third order, is lost.
    """

    weights: Array

    def of(self, delta: Array, seconds: Any) -> Array:
        return np.asarray((self.weights * delta**2 / (2 * seconds)).sum(axis=-1))

    def farthest(self, cost: float, seconds: float) -> float:
        return float(np.sqrt(2 * seconds * cost))

    def cheapest(self, delta: Array, into: Charts, after: QuadraticBounds, seconds: float) -> tuple[Array, Array]:
        flat = np.einsum("pnr,pn->pr", into.tangents, self.weights * delta)
        square = after.curve + np.eye(flat.shape[1]) / seconds
        least, place = least_in_box(flat / seconds + after.slope, square, into.low, into.high)
        return self.of(delta, seconds) + after.least + least, place

    def below(
        self, delta: Array, out: CurvedCharts, into: CurvedCharts, after: QuadraticBounds, seconds: float
    ) -> StepBounds:
        here, there = out.charts, into.charts
        way, weights = _last(delta), self.weights[:, None]
        ways, heavy = _last(here.tangents), _last(there.tangents) * weights[:, None]
        slope, curve = _last(after.slope), _last(after.curve)
        ends = np.stack([_last(there.low), _last(there.high)])
        own = np.stack([_last(here.low), _last(here.high)])
        turn = _product(heavy, ways)
        flat = _back(heavy, way)
        near, on = _nearest(flat, turn, own, ends, slope, curve, seconds)
        out_bends, into_bends = _last(out.bends), _last(into.bends)
        bends = _times(_times(into_bends, on), on) - _times(_times(out_bends, near), near)
        across = way - _times(ways, near) + bends / 2
        across -= _times(_last(there.tangents), _back(heavy, across))
        pull = weights * across / seconds
        size = _dot(pull, across)
        lost = _farthest(_last(out.rest), pull) + _farthest(_last(into.rest), -pull)
        # the multiplier of what moves across the charts is the less, the more the set may stray that way
        with np.errstate(divide="ignore", invalid="ignore"):
            share = np.where(size > 0, np.clip(1 - lost / size, 0.0, 1.0), 0.0)
        pull *= share
        curve, excess = _raised(curve + _dot(into_bends, pull[:, None, None]), -CONCAVE / seconds)
        # places along the chart as well move by what the set strays
        slid = _widest(_last(here.strays), heavy) + _widest(_last(there.strays), heavy)
        within = np.stack([ends[0] - slid, ends[1] + slid])
        wide = np.abs(within).max(axis=0)
        lost = share * lost + excess * _dot(wide, wide) / 2
        lost += _dot(slid, np.abs(slope) + _times(np.abs(curve), wide + slid / 2))
        level = -_dot(out_bends, pull[:, None, None])
        least = after.least + _dot(pull, way) - share**2 * size / 2 - lost
        return SquaredRateBounds(seconds, least, -_back(ways, pull), level, flat, turn, slope, curve, within, own)


def _last(rows: Array) -> Array:
    """The same with what tells the steps last: sums of a few joints and axes then go along all steps at once."""
    return np.ascontiguousarray(np.moveaxis(rows, 0, -1))


def _times(matrix: Array, vector: Array) -> Array:
    """Products (..., P) of matrices (..., b, P) and vectors (b, P)."""
    return np.asarray((matrix * vector).sum(axis=-2))


def _back(matrix: Array, vector: Array) -> Array:
    """Products (b, P) of matrices (a, b, P), transposed, and vectors (a, P)."""
    return np.asarray((matrix * vector[:, None]).sum(axis=0))


def _product(one: Array, other: Array) -> Array:
    """Products (b, c, P) of matrices (a, b, P), transposed, and others (a, c, P)."""
    return np.asarray((one[:, :, None] * other[:, None]).sum(axis=0))


def _dot(one: Array, other: Array) -> Array:
    return np.asarray((one * other).sum(axis=0))


def _farthest(places: Array, way: Array) -> Array:
    """How far places (c, n, P) lie along a way (n, P), the origin among them. Shape (P,)."""
    most = np.zeros(way.shape[1])
    for place in places:
        np.maximum(most, _dot(place, way), out=most)
    return most


def _widest(places: Array, ways: Array) -> Array:
    """How far places (c, n, P) lie along ways (n, r, P), either way. Shape (r, P)."""
    most = np.zeros(ways.shape[1:])
    for place in places:
        np.maximum(most, np.abs(_back(ways, place)), out=most)
    return most


def _nearest(
    flat: Array, turn: Array, here: Array, there: Array, slope: Array, curve: Array, seconds: float
) -> tuple[Array, Array]:
    """Places in boxes (2, r, P) from and to which the ways along the charts cost little: flat - turn . one + other."""
    square, start = curve + np.eye(len(flat))[:, :, None] / seconds, (here[0] + here[1]) / 2
    other = _least((flat - _times(turn, start)) / seconds + slope, square, *there)[1]
    return _least(-_back(turn, flat + other), _product(turn, turn), *here)[1], other


@dataclass(frozen=True, eq=False)
class SquaredRateBounds:
    """least + slope . t + t . level . t / 2, and the least of v . v / (2 dt) + after . t' + t' . curved . t' / 2.

    There v = flat - turn . t + t' is the way along the chart, t' in a box `into`, t in one `out`. All arrays have the
    steps last. Each place p gives a bound of all: value + slope . (t - p) + (t - p) . curve . (t - p) / 2.
    """

    seconds: float
    least: Array
    slope: Array
    level: Array
    flat: Array
    turn: Array
    after: Array
    curved: Array
    into: Array
    out: Array

    def of(self, chosen: Any) -> SquaredRateBounds:
        names = ("least", "slope", "level", "flat", "turn", "after", "curved", "into", "out")
        return replace(self, **{name: getattr(self, name)[..., chosen] for name in names})

    @property
    def _square(self) -> Array:
        return np.asarray(self.curved + np.eye(len(self.flat))[:, :, None] / self.seconds)

    @property
    def curve(self) -> Array:
        sunk = np.linalg.solve(_first(self._square), _first(self.curved)) / self.seconds
        turn = _first(self.turn)
        return np.asarray(turn.transpose(0, 2, 1) @ sunk @ turn + _first(self.level))

    def _onward(self, places: Array) -> tuple[Array, Array, Array]:
        start = self.flat - _times(self.turn, places)
        return start, *_least(start / self.seconds + self.after, self._square, *self.into)

    def at(self, places: Array) -> tuple[Array, Array]:
        """Values (P,) and slopes (P, r) at places (P, r)."""
        places = _last(places)
        start, onward, there = self._onward(places)
        held = _times(self.level, places)
        value = self.least + onward + _dot(start, start) / (2 * self.seconds)
        slope = held + self.slope - _back(self.turn, start + there) / self.seconds
        return value + _dot(places, held / 2 + self.slope), _first(slope)

    def lower(self, places: Array, slope: Array, curve: Array) -> Array:
        """Places (P, r) at which the values are lower, less slope . t + t . curve . t / 2, if some are known."""
        pulled = -_back(self.turn, self.flat + self._onward(_last(places))[2]) / self.seconds
        square = _product(self.turn, self.turn) / self.seconds + self.level - _last(curve)
        return _first(_least(pulled + self.slope - _last(slope), square, *self.out)[1])


def _first(columns: Array) -> Array:
    """The same with what tells the steps first again."""
    return np.ascontiguousarray(np.moveaxis(columns, -1, 0))


@dataclass(frozen=True, eq=False)
class Homogeneous:
    """What is twice as much for a way twice as long, on at most one free direction; its values are affine.

    Attributes:
        weights: Of the joints' ways, 0 for what does not count. Shape (n,).
    """

    weights: Array

    def of(self, delta: Array, seconds: Any) -> Array:
        """Of steps (..., n)."""
        raise NotImplementedError

    def farthest(self, cost: float, seconds: float) -> float:
        """How far a step of at most this cost goes in the metric of the charts."""
        raise NotImplementedError

    def pull(self, way: Array) -> Array:
        """Gradients by ways (P, n)."""
        raise NotImplementedError

    def least(self, delta: Array, into: Charts, after: QuadraticBounds) -> tuple[Array, Array, Array]:
        """The cheapest steps on charts: bounds (P,), their multipliers (P, n), the gradient by the way, and places."""
        count = len(delta)
        if not into.tangents.shape[2]:
            return self.of(delta, 1.0) + after.least, self.pull(delta), np.zeros((count, 0))
        along, slope = into.tangents[:, :, 0], after.slope[:, 0]
        box = into.low[:, 0], into.high[:, 0]

        def pulled(at: Array) -> list[Array]:
            """The place, the gradient there, its value at no place, and how the whole rises."""
            pull = self.pull(delta + along * at[:, None])
            return [at, pull, (pull * delta).sum(axis=1), (pull * along).sum(axis=1) + slope]

        def meeting() -> Array:
            """Where lines from both ends meet; an end that does not fall towards the other is the least."""
            with np.errstate(divide="ignore", invalid="ignore"):
                meet = np.clip(np.nan_to_num((first[2] - last[2]) / (last[3] - first[3])), first[0], last[0])
            return np.where(first[3] >= 0, first[0], np.where(last[3] <= 0, last[0], meet))

        # a piece of the convex function is left out at a time
        first, last = (pulled(at.copy()) for at in box)
        for _ in range(MEETINGS):
            there = pulled(meeting())
            falls = (there[3] < 0) & (first[3] < 0) & (last[3] > 0)
            rises = (there[3] >= 0) & (first[3] < 0) & (last[3] > 0)
            for end, moved in ((first, falls), (last, rises)):
                for part, new in zip(end, there, strict=True):
                    part[moved] = new[moved]
        with np.errstate(divide="ignore", invalid="ignore"):
            crossed = np.nan_to_num(last[3] / (last[3] - first[3]))
        share = np.where(first[3] >= 0, 1.0, np.where(last[3] <= 0, 0.0, crossed))
        pull, place = share[:, None] * first[1] + (1 - share[:, None]) * last[1], meeting()
        rest = (pull * along).sum(axis=1) + slope
        least = np.minimum(rest * box[0], rest * box[1])
        return (pull * delta).sum(axis=1) + least + after.least, pull, place[:, None]

    def cheapest(self, delta: Array, into: Charts, after: QuadraticBounds, seconds: float) -> tuple[Array, Array]:
        cost, _, place = self.least(delta, into, after)
        return cost, place

    def below(
        self, delta: Array, out: CurvedCharts, into: CurvedCharts, after: QuadraticBounds, seconds: float
    ) -> StepBounds:
        return HomogeneousBounds(self, delta, out, into, after)


class PathLength(Homogeneous):
    """The weighted sum of the joints' ways."""

    def of(self, delta: Array, seconds: Any) -> Array:
        return np.asarray((self.weights * np.abs(delta)).sum(axis=-1))

    def farthest(self, cost: float, seconds: float) -> float:
        return float(cost / self.weights.min()) if (self.weights > 0).all() else np.inf

    def pull(self, way: Array) -> Array:
        return np.asarray(self.weights * np.sign(way))


class LargestMotion(Homogeneous):
    """The largest of the joints' weighted ways: the time, where the weights are one over the joints' velocities."""

    def of(self, delta: Array, seconds: Any) -> Array:
        return np.asarray((self.weights * np.abs(delta)).max(axis=-1))

    def farthest(self, cost: float, seconds: float) -> float:
        return float(np.linalg.norm(cost / self.weights)) if (self.weights > 0).all() else np.inf

    def pull(self, way: Array) -> Array:
        pull, rows = np.zeros(way.shape), np.arange(len(way))
        joint = (self.weights * np.abs(way)).argmax(axis=1)
        pull[rows, joint] = (self.weights * np.sign(way))[rows, joint]
        return pull


@dataclass(frozen=True, eq=False)
class HomogeneousBounds:
    """Arguments as of `Homogeneous.below`."""

    cost: Homogeneous
    delta: Array
    out: CurvedCharts
    into: CurvedCharts
    after: QuadraticBounds

    def of(self, chosen: Any) -> HomogeneousBounds:
        out, into, after = self.out.of(chosen), self.into.of(chosen), self.after.of(chosen)
        return HomogeneousBounds(self.cost, self.delta[chosen], out, into, after)

    @property
    def curve(self) -> Array:
        r = self.out.charts.tangents.shape[2]
        return np.zeros((len(self.delta), r, r))

    def at(self, places: Array) -> tuple[Array, Array]:
        here, there = self.out.charts, self.into.charts
        start = np.einsum("pnr,pr->pn", here.tangents, places)
        cost, pull, _ = self.cost.least(self.delta - start, there, self.after)
        back = np.einsum("pcn,pn->pc", there.strays, pull).min(axis=1, initial=0.0)
        lost = np.einsum("pcn,pn->pc", here.strays, pull).max(axis=1, initial=0.0) - back
        return cost - lost, -np.einsum("pnr,pn->pr", here.tangents, pull)

    def lower(self, places: Array, slope: Array, curve: Array) -> Array:
        return places


StepBounds: TypeAlias = SquaredRateBounds | HomogeneousBounds
"""Bounds of P steps, and the cost after them, by the place in the box that they go from."""


def least_in_box(slope: Array, square: Array, low: Array, high: Array) -> tuple[Array, Array]:
    """Least values (P,) of slope . t + t . square . t / 2 on boxes, and where they are, (P, r), r at most two.

    Looked at are the corners, where the function is level on a side, and where it is level.
    """
    least, place = _least(_last(slope), _last(square), _last(low), _last(high))
    return least, _first(place)


def _least(slope: Array, square: Array, low: Array, high: Array) -> tuple[Array, Array]:
    """As `least_in_box`, the functions last."""
    r, count = slope.shape
    if not r:
        return np.zeros(count), np.zeros(slope.shape)
    upwards = all(bool((square[axis, axis] > 0).all()) for axis in range(r))  # then sides need no corners
    places: list[Any] = [] if upwards else [[*side] for side in product(*zip(low, high, strict=True))]
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        if r == 1:
            places.append([np.clip(-slope[0] / square[0, 0], low[0], high[0])])
        else:
            for axis, beside in ((0, 1), (1, 0)):
                for end in (low[axis], high[axis]):
                    level = -(slope[beside] + square[0, 1] * end) / square[beside, beside]
                    level = np.clip(level, low[beside], high[beside])
                    places.append([end, level] if axis == 0 else [level, end])
            size = square[0, 0] * square[1, 1] - square[0, 1] ** 2
            one = (square[0, 1] * slope[1] - square[1, 1] * slope[0]) / size
            other = (square[0, 1] * slope[0] - square[0, 0] * slope[1]) / size
            places.append([np.clip(one, low[0], high[0]), np.clip(other, low[1], high[1])])
        least, found = np.full(count, np.inf), low.copy()
        for place in places:
            value = place[0] * (slope[0] + square[0, 0] / 2 * place[0])
            if r == 2:
                value += place[1] * (slope[1] + square[1, 1] / 2 * place[1] + square[0, 1] * place[0])
            better = value < least
            np.copyto(least, value, where=better)
            for axis in range(r):
                np.copyto(found[axis], place[axis], where=better)
    return least, found


def lowest_curvature(square: Array) -> Array:
    """Least eigenvalues of symmetric matrices (P, r, r), r at most two. Shape (P,)."""
    if square.shape[1] < 2:
        return np.asarray(square.sum(axis=(1, 2)))
    middle, half = (square[:, 0, 0] + square[:, 1, 1]) / 2, (square[:, 0, 0] - square[:, 1, 1]) / 2
    return np.asarray(middle - np.hypot(half, square[:, 0, 1]))


def _raised(square: Array, floor: float) -> tuple[Array, Array]:
    """Symmetric matrices (r, r, P), their eigenvalues raised to a floor, and the most by which one was. Shape (P,)."""
    excess = np.maximum(floor - lowest_curvature(np.moveaxis(square, -1, 0)), 0.0)
    rows = np.flatnonzero(excess > 0)
    if rows.size:
        values, ways = np.linalg.eigh(np.moveaxis(square[..., rows], -1, 0))
        square = square.copy()
        square[..., rows] = np.moveaxis((ways * np.maximum(values, floor)[:, None]) @ ways.transpose(0, 2, 1), 0, -1)
    return square, excess
