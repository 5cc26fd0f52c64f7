"""Lower bounds of the cost of straight steps between charts of the self-motion manifold, as functions of the start.

The integral of half the squared rates is no less than |dq|^2 / (2 dt). `lengths` bounds the length, no less than
|dq|_1. Charts are tangent to the manifold; its measured deviation is taken into account, and assumed to be no larger
within a box than at its rim.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, replace
from itertools import product
from typing import Any, NamedTuple, Protocol, Self

import numpy as np

from models.checks import Array
from ocp.motion.search.charts import Charts

MAX_CONCAVITY = 0.5
"""Largest concavity of a cost bound, relative to the curvature of a step's cost; more concave bounds are flattened."""


class QuadraticBounds(NamedTuple):
    """Quadratic lower bounds of a value function on N charts of the self-motion manifold, in chart coordinates.

    At chart coordinates t, the bound is least + slope . t + t . curve . t / 2.

    Attributes:
        least: Constant terms, infinite where no motion passes. Shape (N,).
        slope: Coefficients of the linear terms. Shape (N, r).
        curve: Symmetric matrices of the quadratic terms. Shape (N, r, r).
    """

    least: Array
    slope: Array
    curve: Array

    def select(self, rows: Any) -> QuadraticBounds:
        """Return the lower bounds of the value function on the charts with the given indices."""
        return QuadraticBounds(*(part[rows] for part in self))

    @classmethod
    def constant(cls, least: Array, free: int) -> QuadraticBounds:
        """Return constant lower bounds on manifold charts of dimension `free`."""
        return cls(least, np.zeros((len(least), free)), np.zeros((len(least), free, free)))

    def minimum(self, low: Array, high: Array) -> tuple[Array, Array]:
        """Return each chart's minimum of the value-function bound over a box (N, r), and the minimiser (N, r)."""
        least, place = least_in_box(self.slope, self.curve, low, high)
        return self.least + least, place

    def at(self, places: Array) -> Array:
        """Return the values (N,) of the lower bounds of the value function at chart coordinates (N, r)."""
        products = np.einsum("nab,nb->na", self.curve, places)
        return np.asarray(self.least + (places * (self.slope + products / 2)).sum(axis=1))


@dataclass(frozen=True, eq=False)
class Steps:
    """Steps between consecutive time samples: limits of the joint displacements, times, and the cost of a step.

    Attributes:
        times: Times of the samples, s. Shape (K,).
        cost: Cost of a step.
        limits: Largest displacement of each joint in a step. Shape (K - 1, n).
    """

    times: Array
    cost: StepCost
    limits: Array


class CurvedCharts(NamedTuple):
    """Manifold charts, and the deviations of the manifold from the charts as quadratic forms with residuals.

    Attributes:
        charts: N charts.
        bends: Matrices of the forms t . bends . t / 2 in the chart coordinates t. Shape (N, n, r, r).
        rest: Residuals at the rims of the charts. Shape (N, c, n).
    """

    charts: Charts
    bends: Array
    rest: Array

    def select(self, rows: Any) -> CurvedCharts:
        """Return the curved charts with the given indices."""
        return CurvedCharts(self.charts.select(rows), self.bends[rows], self.rest[rows])


class StepBounds(Protocol):
    """Lower bounds of the cost of P steps plus the motion after them, as functions of the starts in chart coordinates.

    At each point p, the quadratic function with the bound's value and slope at p, and `curve`, is a lower bound too.
    """

    @property
    def curve(self) -> Array:
        """Symmetric matrices of the quadratic terms of lower bounds of the cost-to-go. Shape (P, r, r)."""

    def select(self, rows: Any) -> Self:
        """Return the lower bounds of the cost-to-go through the steps with the given indices."""

    def at(self, places: Array) -> tuple[Array, Array]:
        """Return values (P,) and gradients (P, r) of the cost bounds for steps that start at chart points (P, r)."""

    def descend(self, places: Array, slope: Array, curve: Array) -> Array:
        """Descend from `places` on the cost bound minus a quadratic function; return the chart points reached.

        The function is slope . t + t . curve . t / 2. All arguments have one entry for each step.
        """


class StepCost(ABC):
    """Cost of a straight step between configurations, and its lower bounds over manifold charts (base class)."""

    @abstractmethod
    def minimal_steps(
        self, delta: Array, target: Charts, after: QuadraticBounds, seconds: float
    ) -> tuple[Array, Array]:
        """Return costs (P,) and end coordinates (P, r) of the lowest-cost steps into each of P manifold charts.

        The centres of the charts are `delta` (P, n) away. The costs include the remaining costs `after`.
        """

    @abstractmethod
    def lower_bounds(
        self, delta: Array, source: CurvedCharts, target: CurvedCharts, after: QuadraticBounds, *, seconds: float
    ) -> StepBounds:
        """Return lower bounds on the cost of P steps between manifold charts plus the cost `after` the steps.

        The centres of the charts are `delta` (P, n) apart.
        """

    def quick_bounds(
        self, delta: Array, spans: Array, source: Charts, target: Charts, *, after: QuadraticBounds
    ) -> Array:
        """Return constant lower bounds (P,) of the cost of P steps that start in source charts, plus the cost `after`.

        Weaker but quicker than `lower_bounds`. The joint displacements differ from `delta` by at most `spans` (P, n).
        """
        return np.full(len(delta), -np.inf)

    @abstractmethod
    def evaluate(self, delta: Array, seconds: Any) -> Array:
        """Return the costs of steps with given joint displacements (..., n) and durations."""

    @abstractmethod
    def reach(self, cost: float, seconds: float) -> float:
        """Return the greatest length, in the metric of the charts, of steps that cost at most `cost`."""


@dataclass(frozen=True, eq=False)
class SquaredRates(StepCost):
    """Cost of a step: the integral of half the weighted squared joint rates.

    A step d has a component along the chart that it enters and one across it. Along the chart, the cost is convex in
    its start and end, and its minimum over the end in its box is quadratic in the start, by the multipliers of the
    box. Across, |d|^2 / (2 dt) is at least p . d - dt |p|^2 / 2, with the multiplier p taken at the nearest points. The
    quadratic deviation of the manifold enters the curvature of the bounds, where it cancels from step to step. Only its
    residual, of third order, is lost.
    """

    weights: Array

    def evaluate(self, delta: Array, seconds: Any) -> Array:
        return np.asarray((self.weights * delta**2 / (2 * seconds)).sum(axis=-1))

    def reach(self, cost: float, seconds: float) -> float:
        return float(np.sqrt(2 * seconds * cost))

    def minimal_steps(
        self, delta: Array, target: Charts, after: QuadraticBounds, seconds: float
    ) -> tuple[Array, Array]:
        flat = np.einsum("pnr,pn->pr", target.tangents, self.weights * delta)
        square = after.curve + np.eye(flat.shape[1]) / seconds
        least, place = least_in_box(flat / seconds + after.slope, square, target.low, target.high)
        return self.evaluate(delta, seconds) + after.least + least, place

    def lower_bounds(
        self, delta: Array, source: CurvedCharts, target: CurvedCharts, after: QuadraticBounds, *, seconds: float
    ) -> StepBounds:
        start, end = source.charts, target.charts
        displacement, column_weights = rows_last(delta), self.weights[:, None]
        start_tangents = rows_last(start.tangents)
        weighted_tangents = rows_last(end.tangents) * column_weights[:, None]
        slope, curve = rows_last(after.slope), rows_last(after.curve)
        end_box = np.stack([rows_last(end.low), rows_last(end.high)])
        start_box = np.stack([rows_last(start.low), rows_last(start.high)])
        rotation = multiply_transposed(weighted_tangents, start_tangents)
        projection = apply_transposed(weighted_tangents, displacement)
        start_place, end_place = _nearest_places(projection, rotation, start_box, end_box, slope, curve, seconds)
        start_bends, end_bends = rows_last(source.bends), rows_last(target.bends)
        relative_bend = apply(apply(end_bends, end_place), end_place)
        relative_bend -= apply(apply(start_bends, start_place), start_place)
        normal = displacement - apply(start_tangents, start_place) + relative_bend / 2
        normal -= apply(rows_last(end.tangents), apply_transposed(weighted_tangents, normal))
        multiplier = column_weights * normal / seconds
        normal_cost = dot(multiplier, normal)
        loss = _support(rows_last(source.rest), multiplier) + _support(rows_last(target.rest), -multiplier)
        # the more the manifold may deviate across the charts, the smaller the multiplier
        with np.errstate(divide="ignore", invalid="ignore"):
            share = np.where(normal_cost > 0, np.clip(1 - loss / normal_cost, 0.0, 1.0), 0.0)
        multiplier *= share
        curve, excess = _raise_eigenvalues(curve + dot(end_bends, multiplier[:, None, None]), -MAX_CONCAVITY / seconds)
        curve = _separate(curve)
        # the deviation also shifts the ends along the chart
        slack = _symmetric_support(rows_last(start.deviations), weighted_tangents)
        slack += _symmetric_support(rows_last(end.deviations), weighted_tangents)
        widened_box = np.stack([end_box[0] - slack, end_box[1] + slack])
        extent = np.abs(widened_box).max(axis=0)
        loss = share * loss + excess * dot(extent, extent) / 2
        loss += dot(slack, np.abs(slope) + apply(np.abs(curve), extent + slack / 2))
        start_curve = -dot(start_bends, multiplier[:, None, None])
        least = after.least + dot(multiplier, displacement) - share**2 * normal_cost / 2 - loss
        start_slope = -apply_transposed(start_tangents, multiplier)
        after_terms = projection, rotation, slope, curve, widened_box, start_box
        return SquaredRateBounds(seconds, least, start_slope, start_curve, *after_terms)


def rows_last(rows: Array) -> Array:
    """Move the first axis, which counts the steps, to the end, so that sums over joints are fast for all steps."""
    return np.ascontiguousarray(np.moveaxis(rows, 0, -1))


def apply(matrix: Array, vector: Array) -> Array:
    """Multiply P matrices (..., b, P) by P vectors (b, P)."""
    return np.asarray((matrix * vector).sum(axis=-2))


def apply_transposed(matrix: Array, vector: Array) -> Array:
    """Multiply P transposed matrices (a, b, P) by P vectors (a, P)."""
    return np.asarray((matrix * vector[:, None]).sum(axis=0))


def multiply_transposed(left: Array, right: Array) -> Array:
    """Multiply P transposed matrices (a, b, P) by P matrices (a, c, P)."""
    return np.asarray((left[:, :, None] * right[:, None]).sum(axis=0))


def dot(left: Array, right: Array) -> Array:
    return np.asarray((left * right).sum(axis=0))


def _support(points: Array, direction: Array) -> Array:
    """Return the support function of point sets (c, n, P), each with the origin, in directions (n, P). Shape (P,)."""
    support = np.zeros(direction.shape[1])
    for point in points:
        np.maximum(support, dot(point, direction), out=support)
    return support


def _symmetric_support(points: Array, directions: Array) -> Array:
    """Return the largest absolute dot product of points (c, n, P) with each direction (n, r, P). Shape (r, P)."""
    support = np.zeros(directions.shape[1:])
    for point in points:
        np.maximum(support, np.abs(apply_transposed(directions, point)), out=support)
    return support


def _nearest_places(
    projection: Array, rotation: Array, start_box: Array, end_box: Array, slope: Array, curve: Array, seconds: float
) -> tuple[Array, Array]:
    """Return start and end coordinates (r, P) of a low-cost step between the tangent boxes of each of P chart pairs."""
    square, middle = curve + np.eye(len(projection))[:, :, None] / seconds, (start_box[0] + start_box[1]) / 2
    end_place = _least_in_box((projection - apply(rotation, middle)) / seconds + slope, square, *end_box)[1]
    slope, square = -apply_transposed(rotation, projection + end_place), multiply_transposed(rotation, rotation)
    return _least_in_box(slope, square, *start_box)[1], end_place


@dataclass(frozen=True, eq=False)
class SquaredRateBounds:
    """Lower bounds of the cost of a step plus the motion after it, as functions of the start in chart coordinates.

    The cost is the integral of the squared joint rates; places are coordinates in the chart.

    At t, the bound is least + slope . t + t . level . t / 2, plus the minimum over t' in the box `end_box` of
    v . v / (2 dt) + after . t' + t' . after_curve . t' / 2. Here v = projection - rotation . t + t' is the step along
    the chart. The axis of the steps comes last. Each point p yields a global lower bound: value + slope . (t - p) plus
    (t - p) . curve . (t - p) / 2.
    """

    seconds: float
    least: Array
    slope: Array
    level: Array
    projection: Array
    rotation: Array
    after: Array
    after_curve: Array
    end_box: Array
    start_box: Array

    def select(self, rows: Any) -> SquaredRateBounds:
        names = ("least", "slope", "level", "projection", "rotation", "after", "after_curve", "end_box", "start_box")
        return replace(self, **{name: getattr(self, name)[..., rows] for name in names})

    @property
    def _square(self) -> Array:
        return np.asarray(self.after_curve + np.eye(len(self.projection))[:, :, None] / self.seconds)

    @property
    def curve(self) -> Array:
        reduced = np.linalg.solve(rows_first(self._square), rows_first(self.after_curve)) / self.seconds
        rotation = rows_first(self.rotation)
        return np.asarray(rotation.transpose(0, 2, 1) @ reduced @ rotation + rows_first(self.level))

    def _minimize_after(self, places: Array) -> tuple[Array, Array, Array]:
        """Minimise the cost bounds over end points in charts; return steps to target centres, minima, minimisers."""
        start = self.projection - apply(self.rotation, places)
        return start, *_least_in_box(start / self.seconds + self.after, self._square, *self.end_box)

    def at(self, places: Array) -> tuple[Array, Array]:
        places = rows_last(places)
        start, after, end_place = self._minimize_after(places)
        products = apply(self.level, places)
        value = self.least + after + dot(start, start) / (2 * self.seconds)
        slope = products + self.slope - apply_transposed(self.rotation, start + end_place) / self.seconds
        return value + dot(places, products / 2 + self.slope), rows_first(slope)

    def descend(self, places: Array, slope: Array, curve: Array) -> Array:
        if places.shape[1] > 2:
            return places
        end_place = self._minimize_after(rows_last(places))[2]
        gradient = -apply_transposed(self.rotation, self.projection + end_place) / self.seconds
        square = multiply_transposed(self.rotation, self.rotation) / self.seconds + self.level - rows_last(curve)
        return rows_first(_least_in_box(gradient + self.slope - rows_last(slope), square, *self.start_box)[1])


def rows_first(columns: Array) -> Array:
    """Move the last axis, which counts the steps, to the front; the inverse of `rows_last`."""
    return np.ascontiguousarray(np.moveaxis(columns, -1, 0))


def least_in_box(slope: Array, square: Array, low: Array, high: Array) -> tuple[Array, Array]:
    """Return the minima (P,) and minimisers (P, r) of P quadratic functions over boxes.

    The functions are slope . t + t . square . t / 2. The corners, the stationary points on the sides and the
    stationary point inside are compared. For r > 2 the result is a lower bound of the minimum, see `_separate`.
    """
    least, place = _least_in_box(rows_last(slope), rows_last(square), rows_last(low), rows_last(high))
    return least, rows_first(place)


def _least_in_box(slope: Array, square: Array, low: Array, high: Array) -> tuple[Array, Array]:
    """Return the minima and minimisers of P quadratic functions over boxes; the last axis counts the functions."""
    r, count = slope.shape
    if not r:
        return np.zeros(count), np.zeros(slope.shape)
    if r > 2:
        square = _separate(square)
        parts = [_least_in_box(slope[[a]], square[[a], a][:, None], low[[a]], high[[a]]) for a in range(r)]
        return np.sum([least for least, _ in parts], axis=0), np.concatenate([place for _, place in parts])
    convex = all(bool((square[axis, axis] > 0).all()) for axis in range(r))  # then the sides include the corners
    places: list[Any] = [] if convex else [[*side] for side in product(*zip(low, high, strict=True))]
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        if r == 1:
            places.append([np.clip(-slope[0] / square[0, 0], low[0], high[0])])
        else:
            for axis, other_axis in ((0, 1), (1, 0)):
                for end in (low[axis], high[axis]):
                    level = -(slope[other_axis] + square[0, 1] * end) / square[other_axis, other_axis]
                    level = np.clip(level, low[other_axis], high[other_axis])
                    places.append([end, level] if axis == 0 else [level, end])
            size = square[0, 0] * square[1, 1] - square[0, 1] ** 2
            first = (square[0, 1] * slope[1] - square[1, 1] * slope[0]) / size
            second = (square[0, 1] * slope[0] - square[0, 0] * slope[1]) / size
            places.append([np.clip(first, low[0], high[0]), np.clip(second, low[1], high[1])])
        least, minimizer = np.full(count, np.inf), low.copy()
        for place in places:
            value = place[0] * (slope[0] + square[0, 0] / 2 * place[0])
            if r == 2:
                value += place[1] * (slope[1] + square[1, 1] / 2 * place[1] + square[0, 1] * place[0])
            better = value < least
            np.copyto(least, value, where=better)
            for axis in range(r):
                np.copyto(minimizer[axis], place[axis], where=better)
    return least, minimizer


def _separate(square: Array) -> Array:
    """Return diagonal lower bounds of symmetric matrices (r, r, P), by Gershgorin's theorem; the matrices if r < 3.

    Each mixed product x y is at least -(x^2 + y^2) / 2.
    """
    if len(square) < 3:
        return square
    diagonal = np.einsum("aap->ap", square)
    diagonal = diagonal + np.abs(diagonal) - np.abs(square).sum(axis=1)
    return np.asarray(diagonal[:, None] * np.eye(len(square))[:, :, None])


def lowest_eigenvalue(square: Array) -> Array:
    """Return the least eigenvalues of symmetric matrices (P, r, r). Shape (P,)."""
    if square.shape[1] < 2:
        return np.asarray(square.sum(axis=(1, 2)))
    if square.shape[1] > 2:
        return np.asarray(np.linalg.eigvalsh(square)[:, 0])
    middle, half = (square[:, 0, 0] + square[:, 1, 1]) / 2, (square[:, 0, 0] - square[:, 1, 1]) / 2
    return np.asarray(middle - np.hypot(half, square[:, 0, 1]))


def _raise_eigenvalues(square: Array, floor: float) -> tuple[Array, Array]:
    """Raise the eigenvalues of symmetric matrices (r, r, P) to `floor` or more; also return the largest increases."""
    excess = np.maximum(floor - lowest_eigenvalue(np.moveaxis(square, -1, 0)), 0.0)
    rows = np.flatnonzero(excess > 0)
    if rows.size:
        values, vectors = np.linalg.eigh(np.moveaxis(square[..., rows], -1, 0))
        square = square.copy()
        raised = (vectors * np.maximum(values, floor)[:, None]) @ vectors.transpose(0, 2, 1)
        square[..., rows] = np.moveaxis(raised, 0, -1)
    return square, excess
