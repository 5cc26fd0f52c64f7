"""The shape factor that suits a corner: the one whose quintic bends least at its sharpest place.

A steady speed v is permitted up to v^2 curvature = centripetal limit, so of all shapes at one remaining distance that
of least peak curvature is run fastest. A small factor bends near the ends, a large one in the middle: between them the
peak has one lowest place, and where a neighbour's own curvature is the peak a whole stretch of them. It is found by a
search along one line, coarse and then by the golden section. Between two lines it is a function of the angle alone,
kept in a table; next to arcs it depends on their curvatures times the remaining distance too.

A tangent joint of line and arc is left at the arc's own curvature: 1 of its speed, where the factor 1.5 permits 0.79.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from models.arrays import Array
from models.paths.blends import LARGEST_SHAPE, polynomial, quintic

__all__ = ["best_shape", "corner_shape"]


@dataclass(frozen=True)
class ShapeSearch:
    """How the best shape factor is looked for.

    Attributes:
        narrowest, widest: Of the factor times remaining distance over the chord: between two lines the best lies from
            0.885 to 2.44.
        below_cusp: Share of the factor at which a blend has a cusp.
        coarse: Factors compared first. steps: Of the golden section between the neighbours of the best.
        samples: Of a blend whose peak is looked for.
        table_angles, table_samples: Corners of the table, and samples of each.
        least_angle: Of the table, rad; below, the best factor over sine of half the angle is constant.
        block: Corners handled at once, which bounds the memory.
    """

    narrowest: float = 0.5
    widest: float = 3.0
    below_cusp: float = 0.95
    coarse: int = 9
    steps: int = 16
    samples: int = 49
    table_angles: int = 65
    table_samples: int = 201
    least_angle: float = 1e-3
    block: int = 500


SEARCH = ShapeSearch()


def corner_shape(angle: Array) -> Array:
    """Best factors at corners between two lines, of interior angles (rad). Shapes (V,) to (V,)."""
    angles, over_chord = _table()
    return np.asarray(2 * np.sin(angle / 2) * np.interp(angle, angles, over_chord))


@lru_cache(maxsize=1)
def _table() -> tuple[Array, Array]:
    """Interior angles, rad, and the best factor over the chord at remaining distance 1."""
    angles = np.linspace(SEARCH.least_angle, np.pi, SEARCH.table_angles)
    zero = np.zeros((SEARCH.table_angles, 3))
    before = np.column_stack([np.ones(SEARCH.table_angles), zero[:, :2]])
    after = np.column_stack([-np.cos(angles), np.sin(angles), zero[:, 0]])
    nearly = angles.copy()
    nearly[-1] = (angles[-1] + angles[-2]) / 2  # where all is straight any factor will do: the limit counts
    after[-1] = [-np.cos(nearly[-1]), np.sin(nearly[-1]), 0.0]
    found = best_shape(-before, before, zero, after, after, zero, np.ones(SEARCH.table_angles), SEARCH.table_samples)
    return angles, found / (2 * np.sin(nearly / 2))


def best_shape(
    start: Array,
    start_tangent: Array,
    start_bend: Array,
    end: Array,
    end_tangent: Array,
    end_bend: Array,
    remaining: Array,
    samples: int = SEARCH.samples,
) -> Array:
    """Factors of least peak curvature of quintic blends between given ends.

    Args:
        start, end: Shape (V, 3), m.
        start_tangent, end_tangent: Unit. Shape (V, 3).
        start_bend, end_bend: Curvature vectors. Shape (V, 3), 1/m.
        remaining: Distance from the vertex at either end. Shape (V,), m.
        samples: Of a blend whose peak is looked for.

    Returns:
        Shape (V,).
    """
    ends = start, start_tangent, start_bend, end, end_tangent, end_bend
    parts = [slice(first, first + SEARCH.block) for first in range(0, len(remaining), SEARCH.block)]
    found = [_searched(tuple(each[part] for each in ends), remaining[part], samples) for part in parts]
    return np.concatenate(found) if found else np.zeros(0)


def _searched(ends: tuple[Array, ...], remaining: Array, samples: int) -> Array:
    start, tangent, bend, end, end_tangent, end_bend = ends
    u = np.linspace(0, 1, samples)

    def peak(logarithm: Array) -> Array:
        rate = (np.exp(logarithm) * remaining)[:, None]
        curve = quintic(start, rate * tangent, rate**2 * bend, end, rate * end_tangent, rate**2 * end_bend)
        first, second = (polynomial(curve[:, None], u, order) for order in (1, 2))
        square = np.einsum("vui,vui->vu", first, first)
        # |F' x F''|^2 = |F'|^2 |F''|^2 - (F' F'')^2, over |F'|^6
        across = square * np.einsum("vui,vui->vu", second, second) - np.einsum("vui,vui->vu", first, second) ** 2
        with np.errstate(divide="ignore", invalid="ignore"):
            curvature = np.maximum(across, 0.0) / square**3
        return np.asarray(np.nan_to_num(curvature, nan=np.inf).max(axis=1))

    chord = np.linalg.norm(end - start, axis=1) / remaining
    golden = (np.sqrt(5) - 1) / 2
    cusp = SEARCH.below_cusp * LARGEST_SHAPE["quintic"]
    low = np.log(np.clip(SEARCH.narrowest * chord, 1e-6, cusp / 2))
    high = np.log(np.minimum(np.maximum(SEARCH.widest * chord, 2 * np.exp(low)), cusp))
    grid = low + np.linspace(0, 1, SEARCH.coarse)[:, None] * (high - low)
    lowest = np.argmin([peak(each) for each in grid], axis=0)
    row = np.arange(len(remaining))
    low, high = grid[np.maximum(lowest - 1, 0), row], grid[np.minimum(lowest + 1, SEARCH.coarse - 1), row]
    left, right = high - golden * (high - low), low + golden * (high - low)
    at_left, at_right = peak(left), peak(right)
    for _ in range(SEARCH.steps):
        lower = at_left <= at_right
        low, high = np.where(lower, low, left), np.where(lower, right, high)
        new = np.where(lower, high - golden * (high - low), low + golden * (high - low))
        at_new = peak(new)
        left, right = np.where(lower, new, right), np.where(lower, left, new)
        at_left, at_right = np.where(lower, at_new, at_right), np.where(lower, at_left, at_new)
    return np.asarray(np.exp(np.where(at_left <= at_right, left, right)))
