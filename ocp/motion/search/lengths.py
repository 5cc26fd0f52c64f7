"""Lower bounds of lengths and durations of straight steps between charts of the self-motion manifold.

The length of a step, the weighted sum of the joint displacements, or its duration, the largest of them, is a norm. Its
least value between two charts is that of a linear program. An interior-point method solves the programs of all pairs of
charts at once; their multipliers yield lower bounds by weak duality.
"""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import dataclass
from typing import Any

import numpy as np

from models.checks import Array
from ocp.motion.search.charts import Charts
from ocp.motion.search.steps import (
    CurvedCharts,
    QuadraticBounds,
    StepBounds,
    StepCost,
    apply,
    apply_transposed,
    dot,
    least_in_box,
    lowest_eigenvalue,
    multiply_transposed,
    rows_first,
    rows_last,
)

INTERIOR_STEPS = 8
"""Number of steps of the interior-point method for the multipliers of steps; each reduces the gap about tenfold."""
CENTERING, STEP_SHARE = 0.1, 0.97
"""Reduction of the gap at which a step aims, and share of the way to the boundary that a step takes at most."""
NARROWEST = 1e-9
"""Least half width of a box for the interior-point method, rad or m."""


@dataclass(frozen=True, eq=False)
class Homogeneous(StepCost):
    """Step cost that is proportional to the length of the step: a norm of the weighted joint displacements.

    By weak duality, any gradient p of the norm, of dual norm at most one, gives the lower bound p . d of the cost of a
    step d. It is linear in the start and in the end of the step, but for the quadratic deviations of the manifolds.
    These enter the curvature of the bounds, where they cancel from step to step as far as p does not change.

    Attributes:
        weights: Weights of the joint displacements, 0 to ignore a joint. Shape (n,).
    """

    weights: Array

    @abstractmethod
    def dual_terms(self, values: Array) -> Array:
        """Return terms whose maximum is the dual norm: joint values (n, ..., P), or their sum for a maximum as cost."""

    def minimize(self, delta: Array, target: Charts, after: QuadraticBounds) -> tuple[Array, Array, Array]:
        """Minimise the cost of P steps and later motion over their ends; return bounds (P,), multipliers, ends (P, r).

        Args: As in `minimal_steps`. The least cost of P steps is that of the linear programs

            minimise  sum of s_g + slope . t,   s_g >= |w_j (delta_j + T_j . t)|,   low <= t <= high,

        with one s for each joint (sum) or for all (maximum). A primal-dual interior-point method solves all at once
        (Wright 1997, Primal-Dual Interior-Point Methods, chapter 5); any of its iterates gives a valid bound.
        """
        weights, delta, slope = self.weights[:, None], rows_last(delta), rows_last(after.slope)
        tangents, low, high = (rows_last(part) for part in (target.tangents, target.low, target.high))
        scaled, offset, r = weights[:, None] * tangents, weights * delta, len(low)
        middle, half = (low + high) / 2, np.maximum((high - low) / 2, NARROWEST)
        place, size = middle.copy(), float(self.weights.max()) * np.maximum(target.radii, NARROWEST)
        value = offset + apply(scaled, place)
        above = (np.abs(value) if len(self.dual_terms(value)) > 1 else np.abs(value).max(axis=0, keepdims=True)) + size
        slacks = [above - value, above + value, place - middle + half, middle + half - place]
        share = 0.5 / self.dual_terms(np.ones(value.shape))
        duals = [np.zeros(value.shape) + share, np.zeros(value.shape) + share, *([size / half / 2] * 2)]
        for _ in range(INTERIOR_STEPS if r else 0):
            gap = sum((slack * dual).sum(axis=0) for slack, dual in zip(slacks, duals, strict=True))
            aim = CENTERING * gap / (2 * len(value) + 2 * r)
            rates = [dual / slack for dual, slack in zip(duals, slacks, strict=True)]
            aims = [aim / slack for slack in slacks]
            total, lean = self.dual_terms(rates[0] + rates[1]), self.dual_terms((rates[1] - rates[0])[:, None] * scaled)
            excess = (self.dual_terms(aims[0] + aims[1]) - 1) / total
            square = multiply_transposed(scaled, (rates[0] + rates[1])[:, None] * scaled)
            square -= multiply_transposed(lean, lean / total[:, None])
            square[np.arange(r), np.arange(r)] += rates[2] + rates[3]
            right = slope + apply_transposed(scaled, aims[0] - aims[1]) + apply_transposed(lean, excess)
            right += aims[3] - aims[2]
            step = -rows_last(np.asarray(np.linalg.solve(rows_first(square), rows_first(right)[:, :, None])[:, :, 0]))
            moved = apply(scaled, step)
            raised = excess - apply(lean, step) / total
            changes = [raised - moved, raised + moved, step, -step]
            turns = [aims[i] - rates[i] * changes[i] - duals[i] for i in range(4)]
            lengths = _longest_step(slacks, changes), _longest_step(duals, turns)
            slacks = [part + lengths[0] * change for part, change in zip(slacks, changes, strict=True)]
            duals = [part + lengths[1] * change for part, change in zip(duals, turns, strict=True)]
            place = place + lengths[0] * step
        multiplier = weights * (duals[0] - duals[1]) / np.maximum(self.dual_terms(duals[0] + duals[1]), 1.0)
        remaining = apply_transposed(tangents, multiplier) + slope
        least = np.minimum(remaining * low, remaining * high).sum(axis=0)
        place = np.clip(place, low, high)
        return dot(multiplier, delta) + least + after.least, rows_first(multiplier), rows_first(place)

    def quick_bounds(
        self, delta: Array, spans: Array, source: Charts, target: Charts, *, after: QuadraticBounds
    ) -> Array:
        shares = np.clip(delta / np.maximum(spans, NARROWEST), -1.0, 1.0)
        multiplier = self.weights * shares / np.maximum(self.dual_terms(np.abs(shares.T)), 1.0).T
        start = -np.einsum("pnr,pn->pr", source.tangents, multiplier)
        end = np.einsum("pnr,pn->pr", target.tangents, multiplier) + after.slope
        curve = -np.maximum(-lowest_eigenvalue(after.curve), 0.0)
        extent = np.maximum(np.abs(target.low), np.abs(target.high))
        slopes = (start, source), (end, target)
        least = sum(np.minimum(slope * box.low, slope * box.high).sum(axis=1) for slope, box in slopes)
        loss = (np.abs(multiplier) * (source.max_deviation + target.max_deviation)).sum(axis=1)
        least = least + (multiplier * delta).sum(axis=1) + curve * (extent**2).sum(axis=1) / 2
        return np.asarray(after.least + least - loss)

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
        return HomogeneousBounds(self, delta, source, target, after, self.minimize(middle, target.charts, after)[1])


class PathLength(Homogeneous):
    """Cost of a step: the weighted sum of the absolute joint displacements."""

    def minimize(self, delta: Array, target: Charts, after: QuadraticBounds) -> tuple[Array, Array, Array]:
        """Return lower bounds (P,) of the costs of steps plus later motion, dual multipliers, and step ends (P, r).

        Exact on curves: a minimum lies at an end of the chart or where a joint has no displacement. There the slope of
        the cost, which rises by 2 |w_j T_j| where joint j has no displacement, changes sign (weighted median).
        """
        if target.low.shape[1] != 1:
            return super().minimize(delta, target, after)
        scaled, offset = self.weights * target.tangents[:, :, 0], self.weights * delta
        with np.errstate(divide="ignore", invalid="ignore"):
            zeros = np.where(scaled != 0, -offset / scaled, np.inf)
        rises = np.abs(scaled)
        order, rows = np.argsort(zeros, axis=1), np.arange(len(zeros))
        slopes = after.slope - rises.sum(axis=1, keepdims=True)
        slopes = slopes + 2 * np.take_along_axis(rises, order, axis=1).cumsum(axis=1)
        joint = order[rows, np.argmax(slopes >= 0, axis=1)]
        median = np.where((slopes >= 0).any(axis=1), zeros[rows, joint], np.inf)
        place = np.clip(median, target.low[:, 0], target.high[:, 0])
        shares = np.sign(offset + scaled * place[:, None])
        inside = np.flatnonzero(place == median)
        shares[inside, joint[inside]] = 0.0
        rest = (shares * scaled).sum(axis=1) + after.slope[:, 0]
        shares[inside, joint[inside]] = np.clip(-rest[inside] / scaled[inside, joint[inside]], -1.0, 1.0)
        multiplier = self.weights * shares
        remaining = (target.tangents[:, :, 0] * multiplier).sum(axis=1, keepdims=True) + after.slope
        least = np.minimum(remaining * target.low, remaining * target.high)[:, 0]
        return (multiplier * delta).sum(axis=1) + least + after.least, multiplier, place[:, None]

    def evaluate(self, delta: Array, seconds: Any) -> Array:
        return np.asarray((self.weights * np.abs(delta)).sum(axis=-1))

    def reach(self, cost: float, seconds: float) -> float:
        return float(cost / self.weights.min()) if (self.weights > 0).all() else np.inf

    def dual_terms(self, values: Array) -> Array:
        return values


class LargestMotion(Homogeneous):
    """Cost of a step: the largest weighted joint displacement; a duration if the weights are inverse rate limits."""

    def evaluate(self, delta: Array, seconds: Any) -> Array:
        return np.asarray((self.weights * np.abs(delta)).max(axis=-1))

    def reach(self, cost: float, seconds: float) -> float:
        return float(np.linalg.norm(cost / self.weights)) if (self.weights > 0).all() else np.inf

    def dual_terms(self, values: Array) -> Array:
        return np.asarray(values.sum(axis=0, keepdims=True))


@dataclass(frozen=True, eq=False)
class HomogeneousBounds:
    """Lower bounds of the cost of a step and the later motion, if step costs are proportional to step lengths.

    On curves, the multipliers of each start are computed anew, since the cost has kinks. On manifolds of more
    dimensions this would take too long.

    Attributes:
        multiplier: Multipliers of the steps that start in the middle of the boxes. Shape (P, n).
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
        return np.asarray(-np.einsum("pn,pnab->pab", self.multiplier, self.source.bends))

    def at(self, places: Array) -> tuple[Array, Array]:
        source, target, multiplier = self.source.charts, self.target.charts, self.multiplier
        loss: Any = 0.0
        if places.shape[1] == 1:
            start = np.einsum("pnr,pr->pn", source.tangents, places)
            multiplier = self.cost.minimize(self.delta - start, target, self.after)[1]
            change = np.einsum("pn,pnab->pab", multiplier - self.multiplier, self.source.bends)[:, 0, 0]
            loss = np.maximum(change, 0.0) * np.maximum(source.low**2, source.high**2)[:, 0] / 2
        square = self.after.curve + np.einsum("pn,pnab->pab", multiplier, self.target.bends)
        slope = self.after.slope + np.einsum("pnr,pn->pr", target.tangents, multiplier)
        value = self.after.least + least_in_box(slope, square, target.low, target.high)[0] - loss
        value += (multiplier * self.delta).sum(axis=1)
        value -= np.einsum("pcn,pn->pc", self.source.rest, multiplier).max(axis=1, initial=0.0)
        value += np.einsum("pcn,pn->pc", self.target.rest, multiplier).min(axis=1, initial=0.0)
        slope = -np.einsum("pnr,pn->pr", source.tangents, multiplier)
        curvature = np.einsum("pab,pb->pa", self.curve, places)
        return value + (places * (slope + curvature / 2)).sum(axis=1), slope + curvature

    def descend(self, places: Array, slope: Array, curve: Array) -> Array:
        return places


def _longest_step(values: list[Array], changes: list[Array]) -> Array:
    """Return, for P linear programs, the largest fraction, at most 1, of a change that keeps all values positive."""
    shares = np.zeros(values[0].shape[1])
    for value, change in zip(values, changes, strict=True):
        np.maximum(shares, (-change / value).max(axis=0), out=shares)
    return STEP_SHARE / np.maximum(shares, STEP_SHARE)
