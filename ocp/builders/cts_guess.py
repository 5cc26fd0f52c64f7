"""First guess of the roll plan: dynamic programming over a grid of rolls and times, which finds the way round.

The roll of least index of each target by itself may lie inside an obstacle, or jump from one side of it to the other;
near such a guess there is no plan. Here the whole course of least cost on a grid is found, with penalties for what is
out of reach, beyond limits or too near, and is then refined within a tube about itself that grows thinner.
"""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import numpy as np

from models.arrays import Array

__all__ = ["ROLLS", "least_course"]

TURN = 2 * np.pi
ROLLS = 120
"""Rolls of the grid to a turn."""
SIDE, FINER, LEVELS = 8, 4, 3  # rolls of the tube to each side, how much finer each level is, levels
WINDOW = 2 * TURN  # how far from its start a roll with limits is looked for, rad
SLOW = 2.0  # grid steps that the rate limit should allow from one time to the next


def least_course(
    cost: Any,
    t: Array,
    *,
    lower: float,
    upper: float,
    start: float | None,
    rate_weight: float,
    acceleration_weight: float,
    rate_limit: float,
) -> Array:
    """Roll over time of least integral of cost + rate_weight rate^2, to the step of a grid. Shape (samples,), rad.

    Args:
        cost: Function (indices of times, rolls), both of shape (n,) -> costs, shape (n,), finite.
        t: Equally spaced times, shape (samples,), s.
        lower, upper: Of the roll, rad; infinite for none: then all rolls of a turn are looked at and the course
            winds as it likes.
        start: Roll at t[0]; None for a free one, which is then given in the turn nearest to 0.
        acceleration_weight: Of the squared acceleration, which a grid of rolls does not see: a weight of the rate that
            makes a change of roll as dear, in the time best for it, stands in its place.
        rate_limit: rad/s; the first grid may exceed it by one step.
    """
    count, about = len(t), float(np.clip(0.0, lower, upper)) if start is None else start
    step = TURN / ROLLS
    circle = not np.isfinite([lower, upper]).any()
    if circle:
        rolls = about + step * np.arange(ROLLS) - np.pi
    else:
        first, last = max(lower, about - WINDOW), min(upper, about + WINDOW)
        rolls = np.linspace(first, last, int(np.ceil((last - first) / step)) + 1) if first < last else np.array([about])
    table = cost(np.repeat(np.arange(count), len(rolls)), np.tile(rolls, count)).reshape(count, -1)
    gain = float(np.median(np.median(table, axis=1) - table.min(axis=1)))  # of the best roll over any
    span = min(t[-1] - t[0], (36 * acceleration_weight / max(gain, 1e-12)) ** 0.25)  # least gain span + 12 v / span^3
    if span > 0:
        rate_weight += 12 * acceleration_weight / span**2
    if start is not None:
        table[0, np.arange(len(rolls)) != int(np.abs(rolls - about).argmin())] = np.inf
    # a slow roll needs a coarse grid of times: else a step of the grid is faster than it may move
    ticks = int(np.clip((t[-1] - t[0]) * min(rate_limit, 1e6) / (SLOW * step), 8, count))
    groups = np.array_split(np.arange(count), ticks)
    stage = np.array([table[group].mean(axis=0) for group in groups])
    at = np.array([t[group].mean() for group in groups])
    away = rolls[None, :] - rolls[:, None]
    if circle:
        away = (away + np.pi) % TURN - np.pi
    path = _cheapest(stage, [away] * (ticks - 1), np.diff(at), rate_weight, rate_limit, step)
    moves = [away[i, k] for i, k in pairwise(path)]
    roll = np.interp(t, at, rolls[path[0]] + np.concatenate([[0.0], np.cumsum(moves)]))
    for _ in range(LEVELS):
        step /= FINER
        offsets = step * np.arange(-SIDE, SIDE + 1)
        tube = np.clip(roll[:, None] + offsets, lower, upper)
        if start is not None:
            tube[0] = start
        stage = cost(np.repeat(np.arange(count), len(offsets)), tube.ravel()).reshape(count, -1)
        away_by_time = [b[None, :] - a[:, None] for a, b in pairwise(tube)]
        path = _cheapest(stage, away_by_time, np.diff(t), rate_weight, rate_limit, step)
        roll = tube[np.arange(count), path]
    return np.asarray(roll)


def _cheapest(stage: Array, away: Any, spans: Array, rate_weight: float, rate_limit: float, step: float) -> Any:
    """Indices of the rolls of the cheapest course, one for each time; moves beyond the rate limit cost dearly."""
    weights = np.convolve(np.append(spans, 0), [0.5, 0.5])[: len(stage)]
    weights[[0, -1]] = np.maximum(weights[[0, -1]], spans[[0, -1]] / 2)
    dear = 1e3 * (np.ptp(stage[np.isfinite(stage)]) + rate_weight + 1e-9)
    total, back = weights[0] * stage[0], []
    for k, span in enumerate(spans):
        over = np.maximum(np.abs(away[k]) - max(rate_limit * span, step), 0.0)
        costs = total[:, None] + rate_weight * away[k] ** 2 / span + dear * over
        best = costs.argmin(axis=0)
        back.append(best)
        total = costs[best, np.arange(costs.shape[1])] + weights[k + 1] * stage[k + 1]
    path = [int(total.argmin())]
    for best in reversed(back):
        path.append(int(best[path[-1]]))
    return np.array(path[::-1])
