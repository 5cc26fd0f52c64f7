"""Dynamic programming over charts of the self-motion manifold: lower bounds of the cost-to-go.

Between two time samples a motion costs at least what the straight step costs: the integral of half the squared rates is
no less than |dq|^2 / (2 dt), the length no less than |dq|_1. The least cost over all sequences of configurations, one
per sample, is therefore a lower bound for every motion that does the task. Backward dynamic programming finds it:
w_k(q) = min over q' of d(q, q') + w_{k+1}(q').

On each chart, the value function is bounded from below by a quadratic function of the chart coordinates. Every step
gives one such function for each corner by its multipliers, all with nearly the same curvature. Minus that of the
lowest-cost step they are affine, and their minimum is concave. An affine function below a concave one at the corners of
a box lies below it everywhere. The loss is of third order in the size of the charts for squared rates, and of second
order for lengths, whose bounds are affine.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from models.checks import Array
from ocp.console import check_time
from ocp.motion.search.charts import Charts
from ocp.motion.search.joint_space import MAX_STEP, JointSpace
from ocp.motion.search.steps import CurvedCharts, QuadraticBounds, StepBounds, Steps

Indices = NDArray[np.intp]


MAX_SUCCESSORS = 8
"""Number of charts that are tried as the next one after a configuration."""
BATCH_PAIRS, SAMPLED_CHARTS = 200_000, 64
"""Approximate number of pairs of neighbouring charts that are processed together, limited by memory, and number of
charts from which the number of neighbours is estimated."""
TANGENTS, REFINEMENTS = 2, 3
"""Numbers of tangent planes that tighten the bound of a step over a box, and of iterations towards each. Fewer give
looser bounds, so that charts are split that could be discarded."""


class ChartGraph:
    """Layered graph whose nodes are the manifold charts at all time samples, and whose edges are possible steps."""

    def __init__(self, space: JointSpace, layers: list[Charts], steps: Steps, max_costs: Array) -> None:
        """Create the graph of charts of the self-motion manifold and possible steps between them.

        Args:
            space: Joint space.
            layers: Charts of each time sample.
            steps: Steps between the samples.
            max_costs: Largest cost of a step. Shape (K - 1,).
        """
        self.space, self.layers, self.seconds = space, layers, np.diff(steps.times)
        self.cost, self.limits = steps.cost, steps.limits
        self.max_costs = max_costs

    @cached_property
    def curved(self) -> list[CurvedCharts]:
        """Manifold charts of each time sample, and how far the manifold curves away from each chart."""
        return [CurvedCharts(charts, *charts.curvature()) for charts in self.layers]

    def cost_to_go(
        self, cost_to_come: list[QuadraticBounds] | None = None, max_cost: float = np.inf
    ) -> list[QuadraticBounds]:
        """Return lower bounds of the remaining cost (cost-to-go) on the manifold charts of each time sample.

        Motions that cost at least `max_cost` in all, by bounds of the `cost_to_come`, are left out.
        """
        return self._sweep(range(len(self.layers) - 1, -1, -1), -1, cost_to_come, max_cost)

    def cost_to_come(
        self, cost_to_go: list[QuadraticBounds] | None = None, max_cost: float = np.inf
    ) -> list[QuadraticBounds]:
        """Return lower bounds of the cost so far (cost-to-come) on the manifold charts of each time sample."""
        return self._sweep(range(len(self.layers)), 1, cost_to_go, max_cost)

    def reachable(self) -> list[NDArray[np.bool_]]:
        """Return, for each time sample, which of its charts lie on a path of steps from the first sample to the last.

        One array for each sample, with an entry for each of its charts.
        """
        masks = [np.ones(len(charts), dtype=bool) for charts in self.layers]
        end = len(masks) - 1
        for order in (range(end), range(end, 0, -1)):
            for k in order:
                neighbour = k + int(np.sign(order.step))
                connected = np.zeros(len(masks[neighbour]), dtype=bool)
                for i, j in self.edges(k, neighbour):
                    connected[j[masks[k][i]]] = True
                masks[neighbour] &= connected
        return masks

    def edges(self, k: int, neighbour: int) -> Iterator[tuple[Indices, Indices]]:
        """Yield, in batches, the pairs of manifold charts at two neighbouring time samples that a step can connect."""
        source, target = self.layers[k], self.layers[neighbour]
        if not len(source) or not len(target):
            return
        between, spans = min(k, neighbour), (source.spans, target.spans)
        sizes = [self.space.length(span) for span in spans]
        limit = self.limits[between]
        max_cost = max(float(self.max_costs[between]), 0.0)
        reach = min(self.cost.reach(max_cost, float(self.seconds[between])), float(self.space.length(limit)))
        reach = min(reach, MAX_STEP)
        tree = self.space.tree(target.centers)
        sample = self.space.tree(source.centers[:: max(len(source) // SAMPLED_CHARTS, 1)])
        radius = min(reach + float(sizes[0].max() + sizes[1].max()), MAX_STEP)
        mean_count = sample.count_neighbors(tree, radius) / sample.n
        batch = max(16, int(BATCH_PAIRS / max(mean_count, 1.0)))
        columns = [np.ascontiguousarray(rows.T) for rows in (source.centers, target.centers, *spans)]
        for first in range(0, len(source), batch):
            rows = np.arange(first, min(first + batch, len(source)))
            batch_tree = self.space.tree(source.centers[rows])
            radius = reach + float(sizes[0][rows].max() + sizes[1].max())
            pairs = batch_tree.sparse_distance_matrix(tree, radius, output_type="ndarray")
            i, j, distance = rows[pairs["i"]], pairs["j"].astype(np.intp), pairs["v"]
            close = distance <= reach + sizes[0][i] + sizes[1][j]
            i, j = i[close], j[close]
            for joint, (start, end, start_span, end_span) in enumerate(zip(*columns, strict=True)):
                delta = np.abs(self.space.joint_difference(joint, end[j], start[i]))
                close = delta <= limit[joint] + start_span[i] + end_span[j]
                i, j = i[close], j[close]
            order = np.argsort(i, kind="stable")
            yield i[order], j[order]

    def successors(
        self, joints: Array, k: int, neighbour: int, after: QuadraticBounds
    ) -> Iterator[tuple[Charts, Array]]:
        """Yield, by rising cost, the charts at a neighbouring time sample that one step from `joints` (n,) can reach.

        Yields:
            A single chart, shifted by full turns to the configuration, and the end of the step in chart coordinates
            (r,).
        """
        charts = self.layers[neighbour]
        between = min(k, neighbour)
        seconds = float(self.seconds[between])
        delta = self.space.difference(charts.centers, np.repeat(joints[None], len(charts), axis=0))
        reachable = (np.abs(delta) <= self.limits[between] + charts.spans).all(axis=1) & np.isfinite(after.least)
        rows = np.flatnonzero(reachable)
        if not rows.size:
            return
        candidates = charts.select(rows)
        costs, places = self.cost.minimal_steps(delta[rows], candidates, after.select(rows), seconds)
        for i in np.argsort(costs, kind="stable")[:MAX_SUCCESSORS].tolist():
            yield replace(candidates.select([i]), centers=joints + delta[rows[[i]]]), places[i]

    def _sweep(
        self, order: range, direction: int, known_bounds: list[QuadraticBounds] | None, max_cost: float
    ) -> list[QuadraticBounds]:
        """Propagate lower bounds of the cost through time samples in a given order; return all bounds."""
        bounds: list[Any] = [None] * len(self.layers)
        first = order[0]
        count, free = self.layers[first].low.shape
        least = np.zeros(count)
        if known_bounds is not None:
            least[self.minima(known_bounds[first], first) >= max_cost] = np.inf
        bounds[first] = QuadraticBounds.constant(least, free)
        for k in order[1:]:
            rest = None if known_bounds is None else known_bounds[k]
            bounds[k] = self._propagate(k, k - direction, bounds[k - direction], rest, max_cost)
        return bounds

    def _propagate(
        self, k: int, neighbour: int, after: QuadraticBounds, known_bounds: QuadraticBounds | None, max_cost: float
    ) -> QuadraticBounds:
        """Return lower bounds of the cost from the charts of time sample `k`, given the bounds at sample `neighbour`.

        Motions that cost `max_cost` or more, by `known_bounds` of their other part, are left out.
        """
        source, target = self.layers[k], self.layers[neighbour]
        seconds = float(self.seconds[min(k, neighbour)])
        bounds = QuadraticBounds.constant(np.full(len(source), np.inf), source.low.shape[1])
        known_costs = np.zeros(len(source)) if known_bounds is None else self.minima(known_bounds, k)
        # leave out steps that nowhere cost least of their chart: first by distances, then by tangent planes
        start_spans, end_spans = source.spans, target.spans
        places = np.clip(0.0, target.low, target.high)
        lowest, middle = self.minima(after, neighbour), after.at(places)
        for i, j in self.edges(k, neighbour):
            check_time()
            feasible = np.isfinite(after.least[j]) & (known_costs[i] + lowest[j] < max_cost)
            i, j = i[feasible], j[feasible]
            if not i.size:
                continue
            delta = self.space.difference(target.centers[j], source.centers[i])
            distances, spans = np.abs(delta), start_spans[i] + end_spans[j]
            lower = self.cost.evaluate(np.maximum(distances - spans, 0.0), seconds) + lowest[j]
            upper = self.cost.evaluate(distances + start_spans[i], seconds) + middle[j]
            upper = np.minimum(_least_of_groups(upper, i), max_cost - known_costs[i])
            rows = np.flatnonzero(lower <= upper)
            i, j, delta, upper, lower = i[rows], j[rows], delta[rows], upper[rows], lower[rows]
            boxes = source.select(i), target.select(j)
            quick = self.cost.quick_bounds(delta, spans[rows], *boxes, after=after.select(j))
            lower = np.maximum(lower, quick)
            floor = np.full(len(source), np.inf)
            np.minimum.at(floor, i, lower)
            rows = np.flatnonzero((lower <= upper) & (known_costs[i] + lower < max_cost))
            i, j, delta = i[rows], j[rows], delta[rows]
            if not i.size:
                continue
            ends = self.curved[k].select(i), self.curved[neighbour].select(j)
            steps = self.cost.lower_bounds(delta, *ends, after.select(j), seconds=seconds)
            if known_bounds is not None:
                totals = _bound_with_rest(steps, source.select(i), known_bounds.select(i))
                affordable = np.flatnonzero(totals < max_cost)
                i, steps = i[affordable], steps.select(affordable)
            if not i.size:
                continue
            starts = np.flatnonzero(np.diff(i, prepend=-1))
            parts = _bound_charts(steps, source.select(i), starts, max_cost - known_costs[i[starts]])
            parts = self._raise_to_floor(parts, source.select(i[starts]), floor[i[starts]])
            for whole, part in zip(bounds, parts, strict=True):
                whole[i[starts]] = part
        return bounds

    @staticmethod
    def _raise_to_floor(values: QuadraticBounds, charts: Charts, floor: Array) -> QuadraticBounds:
        """Replace chart bounds by the constant `floor` where it exceeds the mean of their minimum and central value."""
        least = values.minimum(charts.low, charts.high)[0]
        higher = values.at((charts.low + charts.high) / 2) + least < 2 * floor
        return QuadraticBounds(
            np.where(higher, floor, values.least),
            np.where(higher[:, None], 0.0, values.slope),
            np.where(higher[:, None, None], 0.0, values.curve),
        )

    def minima(self, values: QuadraticBounds, k: int) -> Array:
        """Return the minimum of the cost bound on each manifold chart of a time sample. Shape (N,)."""
        return values.minimum(self.layers[k].low, self.layers[k].high)[0]

    def cost_through(self, cost_to_come: list[QuadraticBounds], cost_to_go: list[QuadraticBounds], k: int) -> Array:
        """Return lower bounds of the cost of any motion through each manifold chart of a time sample. Shape (N,)."""
        total = QuadraticBounds(*(first + second for first, second in zip(cost_to_come[k], cost_to_go[k], strict=True)))
        return np.where(np.isfinite(total.least), self.minima(total, k), np.inf)


def _bound_with_rest(steps: StepBounds, charts: Charts, known_bounds: QuadraticBounds) -> Array:
    """Return for each step a lower bound of the cost of any complete motion that contains this step. Shape (P,)."""
    middle, curve = (charts.low + charts.high) / 2, steps.curve
    total = _tangent_bounds(middle, steps.at(middle), curve, -known_bounds.curve, -known_bounds.slope)
    return known_bounds.least + total.minimum(charts.low, charts.high)[0]


def _least_of_groups(values: Array, groups: Indices) -> Array:
    """Return for each value the least value of its group; groups are consecutive. Shape (P,)."""
    starts = np.flatnonzero(np.diff(groups, prepend=-1))
    return np.repeat(np.minimum.reduceat(values, starts), np.diff(np.append(starts, len(values))))


def _bound_charts(steps: StepBounds, charts: Charts, starts: Indices, max_costs: Array) -> QuadraticBounds:
    """Combine the cost bounds of all steps that start in the same manifold chart into one bound for each chart.

    The steps of a chart are consecutive and begin at `starts`. Values above `max_costs` (M,) need not be resolved.
    """
    r = charts.tangents.shape[2]
    count = np.diff(np.append(starts, len(charts)))
    group = np.repeat(np.arange(len(starts)), count)
    middle, half = (charts.low + charts.high) / 2, (charts.high - charts.low) / 2
    sides = [side * half * np.eye(r)[axis] for axis in range(r) for side in (-1.0, 1.0)]
    places = np.stack([middle, *(middle + side for side in sides)])
    # minus the curvature of the lowest-cost step and the concavity of their minimum, bounds are nearly affine
    values, slopes = (np.stack(parts) for parts in zip(*map(steps.at, places), strict=True))
    curves = steps.curve
    curve = curves[np.lexsort((values[0], group))[starts]].copy()
    heights = np.minimum(np.minimum.reduceat(values, starts, axis=1), max_costs)
    curve += _concavity(heights - _quadratic(curve, places[:, starts]), half[starts], curve)
    common = curve[group]
    slope = _secant_slopes(heights - _quadratic(curve, places[:, starts]), half[starts])
    # bound how far the steps lie above the linear functions by tangent planes at points where they are low
    tilt, rows = slope[group], np.arange(len(charts))
    excess = values - _quadratic(common, places) - (places * tilt).sum(axis=2)
    upper, best_place = np.minimum.reduceat(excess.min(axis=0), starts)[group], excess.argmin(axis=0)
    lowest, *tangents = (part[best_place, rows] for part in (places, values, slopes))
    best = _tangent_bounds(lowest, tangents, curves, common, tilt)
    least = best.minimum(charts.low, charts.high)[0]
    for _ in range(TANGENTS):  # only steps that may determine the minimum of their chart
        undecided = np.flatnonzero(least[rows] < upper[rows])
        rows, best = rows[undecided], best.select(undecided)
        remaining, boxes, curvature = steps.select(rows), charts.select(rows), common[rows]
        place = best.minimum(boxes.low, boxes.high)[1]
        for _ in range(REFINEMENTS):
            place = remaining.descend(place, tilt[rows], curvature)
        tangent = _tangent_bounds(place, remaining.at(place), curves[rows], curvature, tilt[rows])
        best, least[rows] = _best_combination(best, least[rows], tangent, boxes)
    least = np.minimum.reduceat(least, starts)
    return QuadraticBounds(least, slope, curve)


def _best_combination(
    best: QuadraticBounds, best_least: Array, tangent: QuadraticBounds, charts: Charts
) -> tuple[QuadraticBounds, Array]:
    """Return for each of P steps the convex combination of two cost bounds with the highest minimum, and its minimum.

    Both bounds have the same curvature. Combinations with zero slope along an axis are tried. `best_least` is the
    minimum of the first bound. Shape (P,).
    """
    first = best
    with np.errstate(divide="ignore", invalid="ignore"):
        shares = np.clip(np.nan_to_num(-first.slope / (tangent.slope - first.slope)), 0.0, 1.0)
    for share in (*shares.T, np.ones(len(best_least))):
        least = first.least + share * (tangent.least - first.least)
        mean = first._replace(least=least, slope=first.slope + share[:, None] * (tangent.slope - first.slope))
        low = mean.minimum(charts.low, charts.high)[0]
        better = low > best_least
        slope = np.where(better[:, None], mean.slope, best.slope)
        best = best._replace(least=np.where(better, mean.least, best.least), slope=slope)
        best_least = np.maximum(best_least, low)
    return best, best_least


def _quadratic(curve: Array, places: Array) -> Array:
    """Return half the values of P quadratic forms with matrices `curve`, each at its own points (..., P, r)."""
    return np.asarray((places * np.einsum("pab,...pb->...pa", curve, places)).sum(axis=-1) / 2)


def _tangent_bounds(
    places: Array, values: Sequence[Array], curve: Array, common: Array, tilt: Array
) -> QuadraticBounds:
    """Return quadratic lower bounds that touch the cost bounds at given points, minus a common quadratic function.

    The subtracted function is tilt . t + t . common . t / 2.
    """
    value, slope = values
    at_origin = value - (places * slope).sum(axis=1) + _quadratic(curve, places)
    return QuadraticBounds(at_origin, slope - np.einsum("pab,pb->pa", curve, places) - tilt, curve - common)


def _concavity(values: Array, half: Array, curve: Array) -> Array:
    """Estimate the concavity of cost bounds on charts from values in the middle and at the ends of each chart axis.

    The total curvature is kept non-negative. Shape (M, r, r).
    """
    second_differences = (values[1::2] + values[2::2] - 2 * values[0]).T
    with np.errstate(divide="ignore", invalid="ignore"):
        largest = np.maximum(np.einsum("paa->pa", curve), 0.0)
        second_differences = np.where(half > 0, np.clip(second_differences / half**2, -largest, 0.0), 0.0)
    return second_differences[:, :, None] * np.eye(half.shape[1])


def _secant_slopes(values: Array, half: Array) -> Array:
    """Estimate the slopes of cost bounds along chart axes from values in the middle and at the ends of each axis.

    Shape (M, r). A concave function gets the slope from end to end, a convex one the flattest slope.
    """
    middle, low, high = values[0][:, None], values[1::2].T, values[2::2].T
    with np.errstate(divide="ignore", invalid="ignore"):
        first, last = (middle - low) / half, (high - middle) / half
    flat = np.clip(0.0, first, np.maximum(first, last))
    return np.where(half > 0, np.where(first < last, flat, (first + last) / 2), 0.0)
