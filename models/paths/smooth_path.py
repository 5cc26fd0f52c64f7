"""A path whose corners are rounded, as a function of the distance along it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from models.arrays import Array, ArrayInput, checked_array, checked_broadcast, checked_count
from models.errors import ModelError
from models.paths.arc_length import Cells, parameter
from models.paths.blends import BlendKind, by_arc_length, curvature, quintic
from models.paths.orientation import along_piece
from models.paths.path import Path

__all__ = ["Blend", "Place", "SmoothPath", "Turn"]

SAMPLES_AT_ONCE = 50_000
"""Samples handled at once, so that memory does not grow with them."""


class Place(NamedTuple):
    """Where a path is at M distances, and its derivatives by the distance.

    Attributes:
        position: In world. Shape (M, 3), m.
        tangent: Unit. Shape (M, 3).
        curvature: Curvature vector. Shape (M, 3), 1/m.
        curvature_rate: Its derivative. Shape (M, 3), 1/m^2.
    """

    position: Array
    tangent: Array
    curvature: Array
    curvature_rate: Array


class Turn(NamedTuple):
    """How the tool is turned at M distances.

    Attributes:
        quaternion: Tool orientation in world. Shape (M, 4).
        rate: Angular velocity at unit line speed, in world axes. Shape (M, 3), rad/m.
        acceleration, jerk: Its derivatives by the distance. Shape (M, 3), rad/m^2 and rad/m^3.
    """

    quaternion: Array
    rate: Array
    acceleration: Array
    jerk: Array


@dataclass(frozen=True, eq=False)
class Blend:
    """One rounded corner.

    Attributes:
        vertex: The corner in world. Shape (3,), m.
        angle: Interior angle, rad.
        remaining: Distance (m) from the vertex, along either segment, at which the blend leaves it.
        shape: Shape factor.
        start, end: Distances along the smooth path at which the blend begins and ends, m.
        coefficients: Ascending polynomial in u of [0, 1]. Shape (6, 3), m.
    """

    vertex: Array
    angle: float
    remaining: float
    shape: float
    start: float
    end: float
    coefficients: Array

    @property
    def length(self) -> float:
        """m."""
        return self.end - self.start


@dataclass(frozen=True, eq=False)
class SmoothPath:
    """Pieces of segments and the blends between them, parametrised by the distance from the start. Made by `smooth`.

    Attributes:
        path: The task, before the corners were rounded.
        kind: "cubic" or "quintic".
        remaining, shape: Of each vertex. Shape (V,), m and 1.
        coefficients: Of the blends. Shape (V, 6, 3), m.
        bounds: Distances at which the pieces begin, and the length at last. Shape (P + 1,), m.
        piece_segment: Segment that a piece is part of, -1 for a blend. Shape (P,).
        piece_blend: Vertex of the blend that a piece is, -1 for a part of a segment. Shape (P,).
    """

    path: Path
    kind: BlendKind
    remaining: Array
    shape: Array
    coefficients: Array
    bounds: Array
    piece_segment: NDArray[np.intp]
    piece_blend: NDArray[np.intp]
    cells: Cells

    @property
    def length(self) -> float:
        """m."""
        return float(self.bounds[-1])

    @property
    def piece_lengths(self) -> Array:
        """Shape (P,), m."""
        return np.diff(self.bounds)

    @cached_property
    def blend_starts(self) -> NDArray[np.intp]:
        """Index in `bounds` at which each blend begins. Shape (V,)."""
        return np.flatnonzero(self.piece_blend >= 0)

    @cached_property
    def cell_bounds(self) -> Array:
        """Distance at which each cell of each blend begins. Shape (C,), m."""
        before = np.cumsum(self.cells.length) - self.cells.length
        first = np.searchsorted(self.cells.curve, np.arange(len(self.coefficients)))
        # the first cell's bound must be that of its blend to the last bit, or a place there falls into the blend before
        inside = before - before[first][self.cells.curve]
        return np.asarray(self.bounds[self.blend_starts][self.cells.curve] + inside)

    def blend(self, vertex: int) -> Blend:
        """The blend at a vertex, 0 being the end of the first segment; ModelError when there is none."""
        count = len(self.remaining)
        if not isinstance(vertex, int | np.integer) or isinstance(vertex, bool) or not 0 <= vertex < count:
            message = f"vertex {vertex!r} does not exist; the path has {count}"
            raise ModelError(message, name="vertex", value=vertex, limit=count)
        piece = int(self.blend_starts[vertex])
        return Blend(
            self.path.start[vertex + 1],
            float(self.path.corner_angles()[vertex]),
            float(self.remaining[vertex]),
            float(self.shape[vertex]),
            float(self.bounds[piece]),
            float(self.bounds[piece + 1]),
            self.coefficients[vertex],
        )

    def at(self, distance: ArrayInput) -> Place:
        """Position, tangent, curvature and its derivative at distances from the start. Shape (M,), m.

        Raises:
            ModelError: nan, or a distance off the path by more than rounding.
        """
        return Place(*_in_parts(self._at, self.checked_distance(distance), (3, 3, 3, 3)))

    def curvature(self, distance: ArrayInput) -> Array:
        """Curvature at distances from the start. Shape (M,), 1/m."""
        return _in_parts(self._curvature, self.checked_distance(distance), (1,))[0][:, 0]

    def turn(self, distance: ArrayInput) -> Turn:
        """Tool orientation and its rates at distances from the start. Shape (M,), m.

        Continuous up to `acceleration`.
        """
        s = self.checked_distance(distance)
        if not self.path.turns:
            still = np.zeros((len(s), 3))
            return Turn(np.repeat(self.path.orientation[:1], len(s), axis=0), still, still, still)
        return Turn(*_in_parts(self._turn, s, (4, 3, 3, 3)))

    def parameter(self, distance: ArrayInput) -> Array:
        """u of the blend at distances from the start; nan on segments. Shape (M,)."""
        s = self.checked_distance(distance)
        u, curved = np.full(len(s), np.nan), self.piece_blend[self._piece(s)] >= 0
        u[curved] = _in_parts(lambda at: (self._parameter(at)[1][:, None],), s[curved], (1,))[0][:, 0]
        return u

    def dense(self, per_cell: int = 16, per_segment: int = 2) -> Array:
        """Distances that resolve every piece: evenly in each cell of a blend and in each part of a segment.

        Shape (M,), m.
        """
        for what, number in (("per_cell", per_cell), ("per_segment", per_segment)):
            checked_count(number, "path", what)
        on_segment = np.flatnonzero(self.piece_segment >= 0)
        starts = np.concatenate([self.bounds[on_segment], self.cell_bounds])
        lengths = np.concatenate([self.piece_lengths[on_segment], self.cells.length])
        counts = np.concatenate([np.full(len(on_segment), per_segment), np.full(len(self.cells.length), per_cell)])
        order = np.argsort(starts, kind="stable")
        starts, lengths, counts = starts[order], lengths[order], counts[order]
        first = np.cumsum(counts) - counts
        step = np.arange(counts.sum()) - np.repeat(first, counts)
        inside = np.repeat(starts, counts) + np.repeat(lengths / counts, counts) * step
        return np.append(inside, self.length)

    def by_piece(self, of_segments: ArrayInput) -> Array:
        """A speed for each segment (or one for all) as one for each piece; a blend takes its neighbours' lower one.

        Shape (P,).

        Raises:
            ModelError: A number of values that is not that of the segments.
        """
        count = len(self.path.segments)
        values = checked_broadcast(of_segments, count, "path", "speed", "segments", finite=False)
        blends = np.minimum(values[self.piece_blend], values[np.minimum(self.piece_blend + 1, count - 1)])
        return np.where(self.piece_blend >= 0, blends, values[self.piece_segment])

    def curvature_jumps(self) -> Array:
        """Jump of the curvature vector at each inner bound between pieces. Shape (P - 1,), 1/m."""
        left, right = self._ends(1.0)[:-1], self._ends(0.0)[1:]
        return np.asarray(np.linalg.norm(right - left, axis=1))

    def checked_distance(self, distance: ArrayInput) -> Array:
        """`distance` as an array within the path; ModelError when it is not."""
        s = checked_array(distance, ("distances",), "path", "distance", finite=False, nan=True, least=0)
        slack = 1e-9 * self.length
        wrong = s[~((s >= -slack) & (s <= self.length + slack))]
        if wrong.size:
            message = f"distance {wrong[:3].tolist()} m is off the path, which is {self.length:g} m long"
            raise ModelError(message, name="distance", value=float(wrong[0]), limit=self.length)
        return np.asarray(np.clip(s, 0.0, self.length))

    def _piece(self, s: Array) -> NDArray[np.intp]:
        return np.asarray(np.clip(np.searchsorted(self.bounds, s, side="right") - 1, 0, len(self.bounds) - 2))

    def _parameter(self, s: Array) -> tuple[NDArray[np.intp], Array]:
        cell = np.maximum(np.searchsorted(self.cell_bounds, s, side="right") - 1, 0)
        curve, length = self.cells.curve[cell], self.cells.length[cell]
        inside = np.clip(s - self.cell_bounds[cell], 0.0, length)
        return curve, parameter(
            self.coefficients[curve], self.cells.start[cell], self.cells.width[cell], length, inside
        )

    def _at(self, s: Array) -> tuple[Array, ...]:
        piece = self._piece(s)
        results = tuple(np.empty((len(s), 3)) for _ in range(4))
        straight = np.flatnonzero(self.piece_segment[piece] >= 0)
        if straight.size:
            which = piece[straight]
            segment = self.piece_segment[which]
            for result, value in zip(results, self._on_segment(segment, s[straight] - self.bounds[which]), strict=True):
                result[straight] = value
        curved = np.flatnonzero(self.piece_blend[piece] >= 0)
        if curved.size:
            curve, u = self._parameter(s[curved])
            for result, value in zip(results, by_arc_length(self.coefficients[curve], u), strict=True):
                result[curved] = value
        return results

    def _curvature(self, s: Array) -> tuple[Array]:
        piece = self._piece(s)
        found = np.abs(self.path.curvature[self.piece_segment[piece]])
        curved = np.flatnonzero(self.piece_blend[piece] >= 0)
        curve, u = self._parameter(s[curved])
        found[curved] = curvature(self.coefficients[curve], u)
        return (found[:, None],)

    def _turn(self, s: Array) -> tuple[Array, ...]:
        piece, (reference, theta) = self._piece(s), self.charts
        length = self.piece_lengths[piece]
        return along_piece(reference[piece], theta[piece], length, (s - self.bounds[piece]) / length)

    def _on_segment(self, segment: NDArray[np.intp], distance: Array) -> tuple[Array, ...]:
        # distance from where the blend before it has ended
        skipped = np.concatenate([[0.0], self.remaining])[segment]
        return self.path.at(segment, skipped + distance)

    def _ends(self, u: float) -> Array:
        # curvature vector of each piece at its start (u = 0) or end (u = 1), seen from inside the piece
        result = np.empty((len(self.piece_segment), 3))
        parts = np.flatnonzero(self.piece_segment >= 0)
        result[parts] = self._on_segment(self.piece_segment[parts], u * self.piece_lengths[parts])[2]
        blends = np.flatnonzero(self.piece_blend >= 0)
        result[blends] = by_arc_length(self.coefficients, np.full(len(blends), u))[2]
        return result

    @cached_property
    def charts(self) -> tuple[Array, Array]:
        """Reference quaternion (P, 4) and rotation vector polynomials (P, 6, 3) of the pieces, by distance/length."""
        path, lengths = self.path, self.piece_lengths
        rate = path.turn / path.lengths[:, None]
        skipped = np.concatenate([[0.0], self.remaining])
        reference = np.empty((len(lengths), 4))
        theta = np.zeros((len(lengths), 6, 3))
        parts = np.flatnonzero(self.piece_segment >= 0)
        segment = self.piece_segment[parts]
        reference[parts] = path.orientation[segment]
        theta[parts, 0] = rate[segment] * skipped[segment][:, None]
        theta[parts, 1] = rate[segment] * lengths[parts][:, None]
        blends = np.flatnonzero(self.piece_blend >= 0)
        reference[blends] = path.orientation[1:]
        away, length = self.remaining[:, None], lengths[blends][:, None]
        before, after = rate[:-1], rate[1:]
        none = np.zeros_like(before)
        theta[blends] = quintic(-before * away, before * length, none, after * away, after * length, none)
        return reference, theta


def _in_parts(function: Callable[[Array], tuple[Array, ...]], s: Array, widths: tuple[int, ...]) -> list[Array]:
    """Rows of a function of distances, which is given some of them at a time. Shapes (M,) to (M, width) each."""
    results = [np.empty((len(s), width)) for width in widths]
    for first in range(0, len(s), SAMPLES_AT_ONCE):
        part = slice(first, first + SAMPLES_AT_ONCE)
        for result, values in zip(results, function(s[part]), strict=True):
            result[part] = values
    return results
