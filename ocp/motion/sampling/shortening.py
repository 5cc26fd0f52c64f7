"""Shortening of collision-free joint paths, and their homotopy classes.

A path is a sequence of configurations with straight motions between them. Parts of it are replaced by straight motions
that are proven clear and shorter, so that it never becomes longer.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from models.checks import Array
from ocp.motion.sampling.straight import StraightMotions

__all__ = ["ShorteningSettings", "path_length", "points_along", "same_class", "shorten", "shortest_through_corners"]


@dataclass(frozen=True)
class ShorteningSettings:
    """Settings of the shortening.

    Attributes:
        batch: Number of random shortcuts that are tried at once.
        least_gain: Relative decrease of the length, over `patience` successive batches, below which it ends.
        patience: Number of these batches.
        most_batches: Largest number of batches.
    """

    batch: int = 24
    least_gain: float = 1e-2
    patience: int = 3
    most_batches: int = 60


def path_length(path: Array, scale: Array) -> float:
    """Return the length of a path (M, n) in the metric |scale * dq|."""
    return float(np.linalg.norm(np.diff(path, axis=0) * scale, axis=1).sum())


def points_along(path: Array, scale: Array, shares: Array) -> Array:
    """Return the configurations of a path (M, n) at shares (K,) of its length. Shape (K, n)."""
    places = _places(path, scale)
    return np.column_stack([np.interp(shares * places[-1], places, column) for column in path.T])


def shorten(
    motions: StraightMotions,
    path: Array,
    scale: Array,
    random: np.random.Generator,
    settings: ShorteningSettings = ShorteningSettings(),
) -> Array:
    """Return a path of at most the same length, each straight motion of which is proven clear.

    Args:
        motions: Proofs of clearance.
        path: Configurations with clear straight motions between them. Shape (M, n).
        scale: Metric, as of `path_length`. Shape (n,).
        random: Source of the shortcuts that are tried.
    """

    def lengths_of(changes: Array) -> Array:
        return np.asarray(np.linalg.norm(changes * scale, axis=1))

    path = shortest_through_corners(motions, path, lengths_of)
    lengths = [path_length(path, scale)]
    for _ in range(settings.most_batches):
        if len(path) == 2:
            break
        path = shortest_through_corners(motions, _cut(motions, path, scale, random, settings.batch), lengths_of)
        lengths.append(path_length(path, scale))
        if (
            len(lengths) > settings.patience
            and lengths[-1] > (1 - settings.least_gain) * lengths[-1 - settings.patience]
        ):
            break
    return path


def same_class(motions: StraightMotions, first: Array, second: Array, scale: Array, rungs: int = 32) -> bool:
    """Return whether straight motions from one path (M, n) to another (K, n) are clear at equal shares of their length.

    Paths of one homotopy class need not satisfy this; paths that do can replace each other as guesses. They are
    compared at as many places as there are `rungs`.
    """
    shares = np.linspace(0.0, 1.0, rungs + 2)[1:-1]
    return bool(motions.are_clear(*(points_along(path, scale, shares) for path in (first, second))).all())


def _places(path: Array, scale: Array) -> Array:
    """Return the length of the path up to each of its configurations. Shape (M,)."""
    return np.append(0.0, np.cumsum(np.linalg.norm(np.diff(path, axis=0) * scale, axis=1)))


def shortest_through_corners(motions: StraightMotions, path: Array, costs_of: Callable[[Array], Array]) -> Array:
    """Return the path of least cost from the first to the last corner along clear straight motions between corners.

    Args:
        motions: Proofs of clearance.
        path: Configurations with clear straight motions between them. Shape (M, n).
        costs_of: Costs (K,) of straight motions by displacements (K, n).
    """
    count = len(path)
    first, last = np.triu_indices(count, 2)
    clear = np.eye(count, k=1, dtype=bool)
    clear[first, last] = motions.are_clear(path[first], path[last])
    costs = np.full((count, count), np.inf)
    costs[clear] = costs_of((path[None] - path[:, None])[clear])
    best, previous = np.full(count, np.inf), np.zeros(count, dtype=int)
    best[0] = 0.0
    for corner in range(1, count):
        totals = best[:corner] + costs[:corner, corner]
        previous[corner] = int(totals.argmin())
        best[corner] = totals[previous[corner]]
    corners = [count - 1]
    while corners[-1]:
        corners.append(int(previous[corners[-1]]))
    return path[corners[::-1]]


def _cut(motions: StraightMotions, path: Array, scale: Array, random: np.random.Generator, batch: int) -> Array:
    """Return the path with clear shortcuts between random places, those that save most first."""
    places = _places(path, scale)
    ends = np.sort(random.random((batch, 2)) * places[-1], axis=1)
    begins, stops = (points_along(path, scale, ends[:, side] / places[-1]) for side in (0, 1))
    gains = ends[:, 1] - ends[:, 0] - np.linalg.norm((stops - begins) * scale, axis=1)
    tried = np.flatnonzero(gains > 1e-9 * places[-1])
    tried = tried[motions.are_clear(begins[tried], stops[tried])]
    taken: list[int] = []
    for k in tried[np.argsort(-gains[tried], kind="stable")].tolist():
        if all(ends[k, 1] <= ends[other, 0] or ends[k, 0] >= ends[other, 1] for other in taken):
            taken.append(k)
    outside = np.ones(len(path), dtype=bool)
    for k in taken:
        outside &= (places <= ends[k, 0]) | (places >= ends[k, 1])
    positions = np.concatenate([places[outside], ends[taken].ravel()])
    corners = np.concatenate([path[outside], *([begins[k], stops[k]] for k in taken)]) if taken else path
    return np.asarray(corners[np.argsort(positions, kind="stable")]) if taken else path
