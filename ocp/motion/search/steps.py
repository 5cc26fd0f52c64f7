"""Lower bounds of the cost of straight steps between charts of the self-motion manifold, as functions of the start.

The integral of half the squared rates is no less than |dq|^2 / (2 dt), the length no less than |dq|_1. Charts are
tangent to the manifold; its measured deviation is taken into account, and assumed to be no larger within a box than at
its rim.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, replace
from itertools import product
from typing import Any, NamedTuple, TypeAlias

import numpy as np

from models.checks import Array
from ocp.motion.search.charts import Charts

__all__ = [
    "CurvedCharts", "Homogeneous", "LargestMotion", "PathLength", "QuadraticBounds", "SquaredRates", "StepBounds",
    "StepCost", "least_in_box",
]  # fmt: skip

INTERIOR_STEPS = 8
"""Number of steps of the interior-point method for the multipliers of steps; each reduces the gap about tenfold."""
CENTERING, STEP_SHARE = 0.1, 0.97
"""Reduction of the gap at which a step aims, and share of the way to the boundary that a step takes at most."""
NARROWEST = 1e-9
"""Least half width of a box for the interior-point method, rad or m."""
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
        """Return the lower bounds on the charts with the given indices."""
        return QuadraticBounds(*(part[rows] for part in self))

    @classmethod
    def constant(cls, least: Array, free: int) -> QuadraticBounds:
        """Return constant lower bounds on manifold charts of dimension `free`."""
        return cls(least, np.zeros((len(least), free)), np.zeros((len(least), free, free)))

    def minimum(self, low: Array, high: Array) -> tuple[Array, Array]:
        """Return the minimum of each lower bound over the box (N, r) of its chart, and the minimiser (N, r)."""
        least, place = least_in_box(self.slope, self.curve, low, high)
        return self.least + least, place

    def at(self, places: Array) -> Array:
        """Return the values (N,) of the lower bounds at chart coordinates (N, r)."""
        products = np.einsum("nab,nb->na", self.curve, places)
        return np.asarray(self.least + (places * (self.slope + products / 2)).sum(axis=1))


@dataclass(frozen=True, eq=False)
class Steps:
    """Joint displacement limits, times and cost of the steps between consecutive time samples.

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


class StepCost(ABC):
    """Cost of a straight step between configurations, and its lower bounds over manifold charts (base class)."""

    @abstractmethod
    def minimal_steps(
        self, delta: Array, target: Charts, after: QuadraticBounds, seconds: float
    ) -> tuple[Array, Array]:
        """Return the costs (P,) and end coordinates (P, r) of the lowest-cost step into each of P manifold charts.

        The centres of the charts are `delta` (P, n) away. The costs include the remaining costs `after`.
        """

    @abstractmethod
    def lower_bounds(
        self, delta: Array, source: CurvedCharts, target: CurvedCharts, after: QuadraticBounds, *, seconds: float
    ) -> StepBounds:
        """Return lower bounds of the costs of P steps between manifold charts, plus the costs `after` the steps.

        The centres of the charts are `delta` (P, n) apart.
        """

    @abstractmethod
    def evaluate(self, delta: Array, seconds: Any) -> Array:
        """Return the costs of steps with given joint displacements (..., n) and durations."""

    @abstractmethod
    def reach(self, cost: float, seconds: float) -> float:
        """Return the greatest length, in the metric of the charts, of a step whose cost is at most `cost`."""


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
        displacement, column_weights = _rows_last(delta), self.weights[:, None]
        start_tangents = _rows_last(start.tangents)
        weighted_tangents = _rows_last(end.tangents) * column_weights[:, None]
        slope, curve = _rows_last(after.slope), _rows_last(after.curve)
        end_box = np.stack([_rows_last(end.low), _rows_last(end.high)])
        start_box = np.stack([_rows_last(start.low), _rows_last(start.high)])
        rotation = _multiply_transposed(weighted_tangents, start_tangents)
        projection = _apply_transposed(weighted_tangents, displacement)
        start_place, end_place = _nearest_places(projection, rotation, start_box, end_box, slope, curve, seconds)
        start_bends, end_bends = _rows_last(source.bends), _rows_last(target.bends)
        relative_bend = _apply(_apply(end_bends, end_place), end_place)
        relative_bend -= _apply(_apply(start_bends, start_place), start_place)
        normal = displacement - _apply(start_tangents, start_place) + relative_bend / 2
        normal -= _apply(_rows_last(end.tangents), _apply_transposed(weighted_tangents, normal))
        multiplier = column_weights * normal / seconds
        normal_cost = _dot(multiplier, normal)
        loss = _support(_rows_last(source.rest), multiplier) + _support(_rows_last(target.rest), -multiplier)
        # the more the manifold may deviate across the charts, the smaller the multiplier
        with np.errstate(divide="ignore", invalid="ignore"):
            share = np.where(normal_cost > 0, np.clip(1 - loss / normal_cost, 0.0, 1.0), 0.0)
        multiplier *= share
        curve, excess = _raise_eigenvalues(curve + _dot(end_bends, multiplier[:, None, None]), -MAX_CONCAVITY / seconds)
        curve = _separate(curve)
        # the deviation also shifts the ends along the chart
        slack = _symmetric_support(_rows_last(start.deviations), weighted_tangents)
        slack += _symmetric_support(_rows_last(end.deviations), weighted_tangents)
        widened_box = np.stack([end_box[0] - slack, end_box[1] + slack])
        extent = np.abs(widened_box).max(axis=0)
        loss = share * loss + excess * _dot(extent, extent) / 2
        loss += _dot(slack, np.abs(slope) + _apply(np.abs(curve), extent + slack / 2))
        start_curve = -_dot(start_bends, multiplier[:, None, None])
        least = after.least + _dot(multiplier, displacement) - share**2 * normal_cost / 2 - loss
        start_slope = -_apply_transposed(start_tangents, multiplier)
        after_terms = projection, rotation, slope, curve, widened_box, start_box
        return SquaredRateBounds(seconds, least, start_slope, start_curve, *after_terms)


def _rows_last(rows: Array) -> Array:
    """Move the first axis (the steps) to the end, which vectorises sums over joints over all steps."""
    return np.ascontiguousarray(np.moveaxis(rows, 0, -1))


def _apply(matrix: Array, vector: Array) -> Array:
    """Multiply P matrices (..., b, P) by P vectors (b, P)."""
    return np.asarray((matrix * vector).sum(axis=-2))


def _apply_transposed(matrix: Array, vector: Array) -> Array:
    """Multiply P transposed matrices (a, b, P) by P vectors (a, P)."""
    return np.asarray((matrix * vector[:, None]).sum(axis=0))


def _multiply_transposed(left: Array, right: Array) -> Array:
    """Multiply P transposed matrices (a, b, P) by P matrices (a, c, P)."""
    return np.asarray((left[:, :, None] * right[:, None]).sum(axis=0))


def _dot(left: Array, right: Array) -> Array:
    return np.asarray((left * right).sum(axis=0))


def _support(points: Array, direction: Array) -> Array:
    """Return the largest component, but at least 0, of each point set (c, n, P) along directions (n, P). Shape (P,)."""
    support = np.zeros(direction.shape[1])
    for point in points:
        np.maximum(support, _dot(point, direction), out=support)
    return support


def _symmetric_support(points: Array, directions: Array) -> Array:
    """Return the largest absolute component of each point set (c, n, P) along directions (n, r, P). Shape (r, P)."""
    support = np.zeros(directions.shape[1:])
    for point in points:
        np.maximum(support, np.abs(_apply_transposed(directions, point)), out=support)
    return support


def _nearest_places(
    projection: Array, rotation: Array, start_box: Array, end_box: Array, slope: Array, curve: Array, seconds: float
) -> tuple[Array, Array]:
    """Return start and end coordinates (r, P) of a low-cost step between the tangent boxes of each of P chart pairs."""
    square, middle = curve + np.eye(len(projection))[:, :, None] / seconds, (start_box[0] + start_box[1]) / 2
    end_place = _least_in_box((projection - _apply(rotation, middle)) / seconds + slope, square, *end_box)[1]
    slope, square = -_apply_transposed(rotation, projection + end_place), _multiply_transposed(rotation, rotation)
    return _least_in_box(slope, square, *start_box)[1], end_place


@dataclass(frozen=True, eq=False)
class SquaredRateBounds:
    """Lower bounds of the cost of a step and of the motion after it, as functions of where the step starts.

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
        reduced = np.linalg.solve(_rows_first(self._square), _rows_first(self.after_curve)) / self.seconds
        rotation = _rows_first(self.rotation)
        return np.asarray(rotation.transpose(0, 2, 1) @ reduced @ rotation + _rows_first(self.level))

    def _minimize_after(self, places: Array) -> tuple[Array, Array, Array]:
        """Minimise the bounds over the end of a step; return step to the chart centre, minimum and minimiser."""
        start = self.projection - _apply(self.rotation, places)
        return start, *_least_in_box(start / self.seconds + self.after, self._square, *self.end_box)

    def at(self, places: Array) -> tuple[Array, Array]:
        """Return values (P,) and gradients (P, r) of the bounds at start coordinates (P, r)."""
        places = _rows_last(places)
        start, after, end_place = self._minimize_after(places)
        products = _apply(self.level, places)
        value = self.least + after + _dot(start, start) / (2 * self.seconds)
        slope = products + self.slope - _apply_transposed(self.rotation, start + end_place) / self.seconds
        return value + _dot(places, products / 2 + self.slope), _rows_first(slope)

    def lower(self, places: Array, slope: Array, curve: Array) -> Array:
        """Improve start coordinates (P, r) towards a minimum of the bounds minus a quadratic function.

        With start coordinates t, the quadratic function is slope . t + t . curve . t / 2.
        """
        if places.shape[1] > 2:
            return places
        end_place = self._minimize_after(_rows_last(places))[2]
        gradient = -_apply_transposed(self.rotation, self.projection + end_place) / self.seconds
        square = _multiply_transposed(self.rotation, self.rotation) / self.seconds + self.level - _rows_last(curve)
        return _rows_first(_least_in_box(gradient + self.slope - _rows_last(slope), square, *self.start_box)[1])


def _rows_first(columns: Array) -> Array:
    """Move the last axis (the steps) to the front, which is the inverse of `_rows_last`."""
    return np.ascontiguousarray(np.moveaxis(columns, -1, 0))


@dataclass(frozen=True, eq=False)
class Homogeneous(StepCost):
    """Step cost proportional to the length of the step, a norm of the weighted joint displacements.

    By weak duality, any gradient p of the norm, of dual norm at most one, gives the lower bound p . d of the cost of a
    step d. It is linear in the start and in the end of the step, but for the quadratic deviations of the manifolds.
    These enter the curvature of the bounds, where they cancel from step to step as far as p does not change.

    Attributes:
        weights: Weights of the joint displacements, 0 to ignore a joint. Shape (n,).
    """

    weights: Array

    @abstractmethod
    def pool(self, values: Array) -> Array:
        """Return sums (g, ..., P) of values (n, ..., P) over the joints whose largest displacement counts."""

    def minimize(self, delta: Array, target: Charts, after: QuadraticBounds) -> tuple[Array, Array, Array]:
        """Return lower bounds (P,) of step costs plus later costs, multipliers (P, n), and step ends (P, r).

        Args: As in `minimal_steps`. The least cost of P steps is that of the linear programs

            minimise  sum of s_g + slope . t,   s_g >= |w_j (delta_j + T_j . t)|,   low <= t <= high,

        with one s for each joint (sum) or for all (maximum). A primal-dual interior-point method solves all at once
        (Wright 1997, Primal-Dual Interior-Point Methods, chapter 5); any of its iterates gives a valid bound.
        """
        weights, delta, slope = self.weights[:, None], _rows_last(delta), _rows_last(after.slope)
        tangents, low, high = (_rows_last(part) for part in (target.tangents, target.low, target.high))
        scaled, offset, r = weights[:, None] * tangents, weights * delta, len(low)
        middle, half = (low + high) / 2, np.maximum((high - low) / 2, NARROWEST)
        place, size = middle.copy(), float(self.weights.max()) * np.maximum(target.radii, NARROWEST)
        value = offset + _apply(scaled, place)
        above = (np.abs(value) if len(self.pool(value)) > 1 else np.abs(value).max(axis=0, keepdims=True)) + size
        slacks = [above - value, above + value, place - middle + half, middle + half - place]
        share = 0.5 / self.pool(np.ones(value.shape))
        duals = [np.zeros(value.shape) + share, np.zeros(value.shape) + share, *([size / half / 2] * 2)]
        for _ in range(INTERIOR_STEPS if r else 0):
            gap = sum((slack * dual).sum(axis=0) for slack, dual in zip(slacks, duals, strict=True))
            aim = CENTERING * gap / (2 * len(value) + 2 * r)
            rates = [dual / slack for dual, slack in zip(duals, slacks, strict=True)]
            aims = [aim / slack for slack in slacks]
            total, lean = self.pool(rates[0] + rates[1]), self.pool((rates[1] - rates[0])[:, None] * scaled)
            excess = (self.pool(aims[0] + aims[1]) - 1) / total
            square = _multiply_transposed(scaled, (rates[0] + rates[1])[:, None] * scaled)
            square -= _multiply_transposed(lean, lean / total[:, None])
            square[np.arange(r), np.arange(r)] += rates[2] + rates[3]
            right = slope + _apply_transposed(scaled, aims[0] - aims[1]) + _apply_transposed(lean, excess)
            right += aims[3] - aims[2]
            step = -_rows_last(np.linalg.solve(_rows_first(square), _rows_first(right)[:, :, None])[:, :, 0])
            moved = _apply(scaled, step)
            raised = excess - _apply(lean, step) / total
            changes = [raised - moved, raised + moved, step, -step]
            turns = [aims[i] - rates[i] * changes[i] - duals[i] for i in range(4)]
            lengths = _longest_step(slacks, changes), _longest_step(duals, turns)
            slacks = [part + lengths[0] * change for part, change in zip(slacks, changes, strict=True)]
            duals = [part + lengths[1] * change for part, change in zip(duals, turns, strict=True)]
            place = place + lengths[0] * step
        multiplier = weights * (duals[0] - duals[1]) / np.maximum(self.pool(duals[0] + duals[1]), 1.0)
        remaining = _apply_transposed(tangents, multiplier) + slope
        least = np.minimum(remaining * low, remaining * high).sum(axis=0)
        place = np.clip(place, low, high)
        return _dot(multiplier, delta) + least + after.least, _rows_first(multiplier), _rows_first(place)

    def minimal_steps(
        self, delta: Array, target: Charts, after: QuadraticBounds, seconds: float
    ) -> tuple[Array, Array]:
        cost, _, place = self.minimize(delta, target, after)
        return cost, place

    def lower_bounds(
        self, delta: Array, source: CurvedCharts, target: CurvedCharts, after: QuadraticBounds, *, seconds: float
    ) -> StepBounds:
        charts = source.charts
        middle = delta - np.einsum("pnr,pr->pn", charts.tangents, (charts.low + charts.high) / 2)
        multiplier = self.minimize(middle, target.charts, after)[1]
        return HomogeneousBounds(self, delta, source, target, after, multiplier)


class PathLength(Homogeneous):
    """Cost of a step: the weighted sum of the absolute joint displacements."""

    def evaluate(self, delta: Array, seconds: Any) -> Array:
        return np.asarray((self.weights * np.abs(delta)).sum(axis=-1))

    def reach(self, cost: float, seconds: float) -> float:
        return float(cost / self.weights.min()) if (self.weights > 0).all() else np.inf

    def pool(self, values: Array) -> Array:
        return values


class LargestMotion(Homogeneous):
    """Cost of a step: the largest weighted joint displacement; a duration if the weights are inverse rate limits."""

    def evaluate(self, delta: Array, seconds: Any) -> Array:
        return np.asarray((self.weights * np.abs(delta)).max(axis=-1))

    def reach(self, cost: float, seconds: float) -> float:
        return float(np.linalg.norm(cost / self.weights)) if (self.weights > 0).all() else np.inf

    def pool(self, values: Array) -> Array:
        return values.sum(axis=0, keepdims=True)


@dataclass(frozen=True, eq=False)
class HomogeneousBounds:
    """Lower bounds of step costs proportional to length plus later costs, from `Homogeneous.lower_bounds`.

    Attributes:
        multiplier: Multipliers of the steps that start in the middle of the boxes, which determine the curvature.
    """

    cost: Homogeneous
    delta: Array
    source: CurvedCharts
    target: CurvedCharts
    after: QuadraticBounds
    multiplier: Array

    def select(self, rows: Any) -> HomogeneousBounds:
        source, target, after = (self.source.select(rows), self.target.select(rows), self.after.select(rows))
        return HomogeneousBounds(self.cost, self.delta[rows], source, target, after, self.multiplier[rows])

    @property
    def curve(self) -> Array:
        return -np.einsum("pn,pnab->pab", self.multiplier, self.source.bends)

    def at(self, places: Array) -> tuple[Array, Array]:
        source, target = self.source.charts, self.target.charts
        start = np.einsum("pnr,pr->pn", source.tangents, places)
        multiplier = self.cost.minimize(self.delta - start, target, self.after)[1]
        square = self.after.curve + np.einsum("pn,pnab->pab", multiplier, self.target.bends)
        slope = self.after.slope + np.einsum("pnr,pn->pr", target.tangents, multiplier)
        least = least_in_box(slope, square, target.low, target.high)[0]
        loss = np.einsum("pcn,pn->pc", self.source.rest, multiplier).max(axis=1, initial=0.0)
        loss -= np.einsum("pcn,pn->pc", self.target.rest, multiplier).min(axis=1, initial=0.0)
        # the curvature is that of another multiplier
        change = np.einsum("pn,pnab->pab", multiplier - self.multiplier, self.source.bends)
        extent = np.maximum(np.abs(source.low), np.abs(source.high))
        loss += np.maximum(-_lowest_eigenvalue(-change), 0.0) * (extent**2).sum(axis=1) / 2
        value = (multiplier * self.delta).sum(axis=1) + self.after.least + least - loss
        slope = -np.einsum("pnr,pn->pr", source.tangents, multiplier)
        curvature = np.einsum("pab,pb->pa", self.curve, places)
        return value + (places * (slope + curvature / 2)).sum(axis=1), slope + curvature

    def lower(self, places: Array, slope: Array, curve: Array) -> Array:
        return places


StepBounds: TypeAlias = SquaredRateBounds | HomogeneousBounds
"""Lower bounds of the costs of P steps plus the costs after the steps, as functions of the start coordinates."""


def _longest_step(values: list[Array], changes: list[Array]) -> Array:
    """Return how far, at most 1, positive values may move along changes and stay positive, for each of P programs."""
    shares = np.zeros(values[0].shape[1])
    for value, change in zip(values, changes, strict=True):
        np.maximum(shares, (-change / value).max(axis=0), out=shares)
    return STEP_SHARE / np.maximum(shares, STEP_SHARE)


def least_in_box(slope: Array, square: Array, low: Array, high: Array) -> tuple[Array, Array]:
    """Return the minima (P,) and minimisers (P, r) of P quadratic functions over boxes.

    The functions are slope . t + t . square . t / 2. Compared are the corners, the stationary points on the sides, and
    the stationary point inside. In more dimensions, the result is a lower bound of the minimum, see `_separate`.
    """
    least, place = _least_in_box(_rows_last(slope), _rows_last(square), _rows_last(low), _rows_last(high))
    return least, _rows_first(place)


def _least_in_box(slope: Array, square: Array, low: Array, high: Array) -> tuple[Array, Array]:
    """Minimise P quadratic functions over boxes; unlike in `least_in_box`, the last array axis counts the functions."""
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
    """Return diagonal matrices (r, r, P) below symmetric matrices, which are returned themselves if r < 3 (Gershgorin).

    Each mixed term is at least minus the mean of both squares.
    """
    if len(square) < 3:
        return square
    diagonal = np.einsum("aap->ap", square)
    diagonal = diagonal + np.abs(diagonal) - np.abs(square).sum(axis=1)
    return np.asarray(diagonal[:, None] * np.eye(len(square))[:, :, None])


def _lowest_eigenvalue(square: Array) -> Array:
    """Return the least eigenvalues of symmetric matrices (P, r, r). Shape (P,)."""
    if square.shape[1] < 2:
        return np.asarray(square.sum(axis=(1, 2)))
    if square.shape[1] > 2:
        return np.asarray(np.linalg.eigvalsh(square)[:, 0])
    middle, half = (square[:, 0, 0] + square[:, 1, 1]) / 2, (square[:, 0, 0] - square[:, 1, 1]) / 2
    return np.asarray(middle - np.hypot(half, square[:, 0, 1]))


def _raise_eigenvalues(square: Array, floor: float) -> tuple[Array, Array]:
    """Raise the eigenvalues of symmetric matrices (r, r, P) to at least `floor`; also return the largest increases."""
    excess = np.maximum(floor - _lowest_eigenvalue(np.moveaxis(square, -1, 0)), 0.0)
    rows = np.flatnonzero(excess > 0)
    if rows.size:
        values, vectors = np.linalg.eigh(np.moveaxis(square[..., rows], -1, 0))
        square = square.copy()
        raised = (vectors * np.maximum(values, floor)[:, None]) @ vectors.transpose(0, 2, 1)
        square[..., rows] = np.moveaxis(raised, 0, -1)
    return square, excess
