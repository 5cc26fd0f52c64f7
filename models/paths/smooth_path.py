"""Paths with rounded corners as functions of the distance along the path.

On each piece of a path, a blend or what remains of a segment, the tool orientation is q(s) = reference exp(theta(s)),
where the rotation vector theta is a polynomial of the distance s. For a segment that turns at a constant rate about a
fixed axis theta is linear, whether the reference is its start or the vertex at its end. A quintic theta with the
reference at a vertex therefore joins two segments with continuous rate and acceleration.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from models.checks import Array, ArrayInput, require
from models.errors import ModelError
from models.paths.blends import BlendKind, Cells, curvature, derivatives_by_arc_length, parameter, quintic
from models.paths.path import Path
from models.paths.splines import Spline, along_piece, chart

BLOCK_SIZE = 50_000
"""Number of samples processed at once; it bounds the memory use."""


class PathPoint(NamedTuple):
    """Position on a path and its derivatives with respect to distance, at M distances from the start.

    Attributes:
        position: Position in world. Shape (M, 3), m.
        tangent: Unit tangent. Shape (M, 3).
        curvature: Curvature vector. Shape (M, 3), 1/m.
        curvature_rate: Derivative of the curvature vector. Shape (M, 3), 1/m^2.
    """

    position: Array
    tangent: Array
    curvature: Array
    curvature_rate: Array


class Turn(NamedTuple):
    """Tool orientation and its derivatives with respect to distance, at M distances along a path.

    Attributes:
        quaternion: Tool orientation in world. Shape (M, 4).
        rate: Angular velocity at unit speed along the path, in world axes. Shape (M, 3), rad/m.
        acceleration, jerk: First and second derivatives of the rate with respect to distance. Shape (M, 3), rad/m^2 and
            rad/m^3.
    """

    quaternion: Array
    rate: Array
    acceleration: Array
    jerk: Array


@dataclass(frozen=True, eq=False)
class Blend:
    """Polynomial curve that rounds one corner of a path.

    Attributes:
        vertex: The corner in world. Shape (3,), m.
        angle: Interior angle, rad.
        remaining: Distance (m) from the vertex to both ends of the blend, along the segments.
        shape: Shape factor.
        start, end: Distances of the blend's ends along the smooth path, m.
        coefficients: Coefficients of the polynomial in u from 0 to 1, in ascending order. Shape (6, 3), m.
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
        """Length of the blend, m."""
        return self.end - self.start


@dataclass(frozen=True, eq=False)
class SmoothPath:
    """A path with rounded corners, parametrised by the distance from its start. `smooth` constructs it.

    Its pieces are the remaining parts of the segments and the blends between them. Each polynomial piece of a spline
    is a piece of its own.

    Attributes:
        path: The path before its corners were rounded.
        kind: "cubic" or "quintic".
        remaining, shape: Remaining distance and shape factor of the blend at each vertex. Shape (V,), m and 1.
        coefficients: Polynomial coefficients of blends and pieces of splines, along the path. Shape (K, 6, 3), m.
        bounds: Distances at which the pieces begin, and finally the length. Shape (P + 1,), m.
        piece_segment: Segment of each piece, -1 for a blend. Shape (P,).
        piece_blend: Vertex of each blend, -1 for a part of a segment. Shape (P,).
        piece_curve: Row of `coefficients` of each piece, -1 for lines, arcs and helices. Shape (P,).
        splines: Remaining parts of the segments that are splines, by segment.
        cells: Quadrature cells of the polynomial curves.
    """

    path: Path
    kind: BlendKind
    remaining: Array
    shape: Array
    coefficients: Array
    bounds: Array
    piece_segment: NDArray[np.intp]
    piece_blend: NDArray[np.intp]
    piece_curve: NDArray[np.intp]
    splines: dict[int, Spline]
    cells: Cells

    def __repr__(self) -> str:
        segments, blends = len(self.path.segments), int((self.piece_blend >= 0).sum())
        splines = len(self.splines)
        of_splines = f" ({splines} spline{'s'[: splines != 1]} of {int((self.piece_curve >= 0).sum()) - blends} pieces)"
        counts = f"{segments} segment{'s'[: segments != 1]}{of_splines if splines else ''}"
        counts += f" and {blends} {self.kind} blend{'s'[: blends != 1]}"
        return f"<SmoothPath of {self.length:.6g} m: {counts}>"

    @property
    def length(self) -> float:
        """Length of the path, m."""
        return float(self.bounds[-1])

    @property
    def piece_lengths(self) -> Array:
        """Lengths of the pieces of the path, which are blends and remaining parts of segments. Shape (P,), m."""
        return np.diff(self.bounds)

    @cached_property
    def cell_bounds(self) -> Array:
        """Distance along the path at which each quadrature interval (cell) of the curves begins. Shape (C,), m."""
        before = np.cumsum(self.cells.length) - self.cells.length
        first = np.searchsorted(self.cells.curve, np.arange(len(self.coefficients)))
        # to the last bit, the bound of a curve's first cell must equal the curve's own, or points fall before the curve
        inside = before - before[first][self.cells.curve]
        return np.asarray(self.bounds[:-1][self.piece_curve >= 0][self.cells.curve] + inside)

    def blend(self, vertex: int) -> Blend:
        """Return the blend at a vertex (0: end of the first segment); raise a ModelError for an unknown vertex."""
        count = len(self.remaining)
        if not isinstance(vertex, int | np.integer) or isinstance(vertex, bool) or not 0 <= vertex < count:
            message = f"vertex {vertex!r} does not exist; the path has {count}"
            raise ModelError(message, name="vertex", value=vertex, limit=count)
        piece = int(np.flatnonzero(self.piece_blend == vertex)[0])
        return Blend(
            self.path.start[vertex + 1],
            float(self.path.corner_angles()[vertex]),
            float(self.remaining[vertex]),
            float(self.shape[vertex]),
            float(self.bounds[piece]),
            float(self.bounds[piece + 1]),
            self.coefficients[self.piece_curve[piece]],
        )

    def at(self, distance: ArrayInput) -> PathPoint:
        """Return position, tangent, curvature and curvature rate at distances from the start, shape (M,), m.

        Raises:
            ModelError: A distance is nan, or outside the path by more than rounding.
        """
        return PathPoint(*_in_blocks(self._at, self.checked_distance(distance), (3, 3, 3, 3)))

    def curvature(self, distance: ArrayInput) -> Array:
        """Return the curvature at given distances from the start of the path. Shape (M,), 1/m."""
        return _in_blocks(self._curvature, self.checked_distance(distance), (1,))[0][:, 0]

    def turn(self, distance: ArrayInput) -> Turn:
        """Return tool orientation and its rates at given distances from the start of the path, shape (M,), m.

        Orientation, rate and acceleration are continuous.
        """
        s = self.checked_distance(distance)
        if not self.path.turns:
            zero = np.zeros((len(s), 3))
            return Turn(np.repeat(self.path.orientation[:1], len(s), axis=0), zero, zero, zero)
        return Turn(*_in_blocks(self._turn, s, (4, 3, 3, 3)))

    def parameter(self, distance: ArrayInput) -> Array:
        """Return the curve parameter u of the blend or piece of a spline at each distance from the start. Shape (M,).

        It is nan on lines, arcs and helices.
        """
        s = self.checked_distance(distance)
        u, curved = np.full(len(s), np.nan), self.piece_curve[self._piece(s)] >= 0
        u[curved] = _in_blocks(lambda at: (self._parameter(at)[1][:, None],), s[curved], (1,))[0][:, 0]
        return u

    def sample_distances(self, per_cell: int = 16, per_segment: int = 2) -> Array:
        """Return distances at which to sample the path, for example for a plot. Shape (M,), m.

        They are equidistant in each line, arc or helix and in each cell, a quadrature interval, of a blend or spline.
        """
        for name, number in (("per_cell", per_cell), ("per_segment", per_segment)):
            require.count(f"path: {name}", number)
        on_segment = np.flatnonzero(self.piece_curve < 0)
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
        """Return the speed on every segment and blend, given the speeds on the segments. Shape (P,).

        A blend has the lower speed of its two neighbours.

        Raises:
            ModelError: The number of values differs from the number of segments.
        """
        count = len(self.path.segments)
        values = require.broadcast("path: speed", of_segments, count, "segments", entries="numbers")
        blends = np.minimum(values[self.piece_blend], values[np.minimum(self.piece_blend + 1, count - 1)])
        return np.where(self.piece_blend >= 0, blends, values[self.piece_segment])

    def curvature_jumps(self) -> Array:
        """Return the magnitudes of curvature jumps between consecutive segments and blends. Shape (P - 1,), 1/m."""
        left, right = self._end_curvatures(1.0)[:-1], self._end_curvatures(0.0)[1:]
        return np.asarray(np.linalg.norm(right - left, axis=1))

    def checked_distance(self, distance: ArrayInput) -> Array:
        """Return distances as an array after checking that they are within the path; raise a ModelError otherwise."""
        s = require.array("path: distance", distance, ("distances",), least=0, entries="any")
        slack = 1e-9 * self.length
        wrong = s[~((s >= -slack) & (s <= self.length + slack))]
        if wrong.size:
            message = f"distance {wrong[:3].tolist()} m is outside the path, which is {self.length:g} m long"
            raise ModelError(message, name="distance", value=float(wrong[0]), limit=self.length)
        return np.asarray(np.clip(s, 0.0, self.length))

    def _piece(self, s: Array) -> NDArray[np.intp]:
        return np.asarray(np.clip(np.searchsorted(self.bounds, s, side="right") - 1, 0, len(self.bounds) - 2))

    def _parameter(self, s: Array) -> tuple[NDArray[np.intp], Array]:
        cell = np.maximum(np.searchsorted(self.cell_bounds, s, side="right") - 1, 0)
        return parameter(self.coefficients, self.cells, cell, s - self.cell_bounds[cell])

    def _at(self, s: Array) -> tuple[Array, ...]:
        piece = self._piece(s)
        results = tuple(np.empty((len(s), 3)) for _ in range(4))
        straight = np.flatnonzero(self.piece_curve[piece] < 0)
        if straight.size:
            pieces = piece[straight]
            values = self._on_segment(self.piece_segment[pieces], s[straight] - self.bounds[pieces])
            for result, value in zip(results, values, strict=True):
                result[straight] = value
        curved = np.flatnonzero(self.piece_curve[piece] >= 0)
        if curved.size:
            curve, u = self._parameter(s[curved])
            for result, value in zip(results, derivatives_by_arc_length(self.coefficients[curve], u), strict=True):
                result[curved] = value
        return results

    def _curvature(self, s: Array) -> tuple[Array]:
        piece = self._piece(s)
        values = np.abs(self.path.curvature[self.piece_segment[piece]])
        curved = np.flatnonzero(self.piece_curve[piece] >= 0)
        curve, u = self._parameter(s[curved])
        values[curved] = curvature(self.coefficients[curve], u)
        return (values[:, None],)

    def _turn(self, s: Array) -> tuple[Array, ...]:
        piece, (reference, theta) = self._piece(s), self.charts
        length = self.piece_lengths[piece]
        return along_piece(reference[piece], theta[piece], length, (s - self.bounds[piece]) / length)

    def _on_segment(self, segment: NDArray[np.intp], distance: Array) -> tuple[Array, ...]:
        """Return points of segments and derivatives, at distances from the end of the blend before each segment."""
        start_offset = np.concatenate([[0.0], self.remaining])[segment]
        return self.path.at(segment, start_offset + distance)

    def _end_curvatures(self, u: float) -> Array:
        """Return the curvature vector of each segment and blend at its own start (u = 0) or end (u = 1)."""
        result = np.empty((len(self.piece_segment), 3))
        parts = np.flatnonzero(self.piece_curve < 0)
        result[parts] = self._on_segment(self.piece_segment[parts], u * self.piece_lengths[parts])[2]
        curves = np.flatnonzero(self.piece_curve >= 0)
        result[curves] = derivatives_by_arc_length(self.coefficients, np.full(len(curves), u))[2]
        return result

    @cached_property
    def charts(self) -> tuple[Array, Array]:
        """Tool orientation on each segment and blend: reference quaternions, and polynomials of the rotation vector
        from them.

        Shapes (P, 4) and (P, 6, 3). The variable of the polynomials is distance / length.
        """
        path, lengths = self.path, self.piece_lengths
        start_offset = np.concatenate([[0.0], self.remaining])
        reference = np.empty((len(lengths), 4))
        theta = np.zeros((len(lengths), 6, 3))
        parts = np.flatnonzero(self.piece_segment >= 0)
        segment = self.piece_segment[parts]
        reference[parts] = path.orientation[segment]
        rate = path.turn[segment] / path.lengths[segment, None]
        theta[parts, 0] = rate * start_offset[segment][:, None]
        theta[parts, 1] = rate * lengths[parts][:, None]
        for number, spline in self.splines.items():
            if spline.references is not None:
                reference[parts[segment == number]] = spline.references
                theta[parts[segment == number]] = spline.turns
        blends = np.flatnonzero(self.piece_blend >= 0)
        reference[blends] = path.orientation[1:]
        length, vertex = lengths[blends][:, None], np.arange(len(blends))
        ends = []
        for index, distance in ((vertex, path.lengths[:-1] - self.remaining), (vertex + 1, self.remaining)):
            vector, rate, change = chart(path.orientation[1:], *path.turn_at(index, distance))
            ends.append((vector, rate * length, change * length**2))
        theta[blends] = quintic(*ends)
        return reference, theta


def _in_blocks(function: Callable[[Array], tuple[Array, ...]], s: Array, widths: tuple[int, ...]) -> list[Array]:
    """Evaluate a function at many distances in blocks, to bound the memory. Shapes (M,) to (M, width)."""
    results = [np.empty((len(s), width)) for width in widths]
    for first in range(0, len(s), BLOCK_SIZE):
        part = slice(first, first + BLOCK_SIZE)
        for result, values in zip(results, function(s[part]), strict=True):
            result[part] = values
    return results
