"""Paths with rounded corners as functions of the distance along the path, in NumPy and as CasADi Functions.

On each piece of a path, a blend or what remains of a segment, the tool orientation is q(s) = reference exp(theta(s)),
where the rotation vector theta is a polynomial of the distance s. For a segment that turns at a constant rate about a
fixed axis theta is linear, whether the reference is its start or the vertex at its end. A quintic theta with the
reference at a vertex therefore joins two segments with continuous rate and acceleration.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property, lru_cache
from math import factorial
from typing import Any, NamedTuple

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from models.checks import Array, ArrayInput, require
from models.errors import ModelError
from models.paths.blends import (
    GAUSS_NODES,
    GAUSS_WEIGHTS,
    BlendKind,
    Cells,
    curvature,
    derivative_of_columns,
    derivatives_by_arc_length,
    horner,
    parameter,
    quintic,
    speed,
)
from models.paths.path import Path
from models.paths.segments import screw_axes
from models.paths.splines import SERIES_TERMS, Spline, along_piece, chart
from models.spatial import angular_velocity_from_quaternion, quaternion_product

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
        sizes = self.path.corner_angles()[vertex], self.remaining[vertex], self.shape[vertex]
        angle, remaining, shape, begin, end = map(float, (*sizes, *self.bounds[piece : piece + 2]))
        curve = self.coefficients[self.piece_curve[piece]]
        return Blend(self.path.start[vertex + 1], angle, remaining, shape, begin, end, curve)

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
        """Return tool orientations, and derivatives of them by arc length, at distances (M,), m, from the path's start.

        Orientation, rate and acceleration are continuous.
        """
        s = self.checked_distance(distance)
        if not self.path.turns:
            zero = np.zeros((len(s), 3))
            return Turn(np.repeat(self.path.orientation[:1], len(s), axis=0), zero, zero, zero)
        return Turn(*_in_blocks(self._turn, s, (4, 3, 3, 3)))

    def parameter(self, distance: ArrayInput) -> Array:
        """Return the curve parameter u at each distance along the path, nan on lines, arcs and helices. Shape (M,)."""
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
        step = np.arange(counts.sum()) - np.repeat(np.cumsum(counts) - counts, counts)
        return np.append(np.repeat(starts, counts) + np.repeat(lengths / counts, counts) * step, self.length)

    def by_piece(self, of_segments: ArrayInput) -> Array:
        """Return the speed, (P,), on every segment and blend, given the speeds on the segments.

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
        """Return curvatures at distances (M,) along the path, for a fifth of the work of `at`. Shape (M, 1), 1/m."""
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
        """Return points of segments, and their derivatives, at distances from the end of the preceding blend."""
        return self.path.at(segment, np.concatenate([[0.0], self.remaining])[segment] + distance)

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
        """Tool orientation on segments and blends: reference quaternions, (P, 4), and rotation vectors from these.

        The rotation vectors are polynomials of distance / length with coefficients (P, 6, 3).
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
    """Evaluate a function at many distances in blocks, to limit memory use. Shapes (M,) -> (M, width)."""
    results = [np.empty((len(s), width)) for width in widths]
    for first in range(0, len(s), BLOCK_SIZE):
        part = slice(first, first + BLOCK_SIZE)
        for result, values in zip(results, function(s[part]), strict=True):
            result[part] = values
    return results


def path_function(path: SmoothPath) -> Any:
    """Return the CasADi Function that evaluates position, tangent and curvature of a path at a distance (m) along it.

    Outputs: position (3, m), tangent (3), curvature vector (3, 1/m), its derivative (3, 1/m^2). It is an MX function
    with the tables of the path in it, which computes the same as `SmoothPath.at`; distances outside the path are
    clamped to it. CasADi differentiates inside a cell only.
    """
    knots, columns = _part_table(require.instance("path_function: path", path, SmoothPath))
    s = ca.MX.sym("distance")
    clamped = _clamp(s, path.length)
    outputs = _cell_function()(_column_at(knots, columns, clamped), clamped)
    return ca.Function("path", [s], list(outputs), ["distance"], ["position", "tangent", "curvature", "curvature_rate"])


def turn_function(path: SmoothPath) -> Any:
    """Return the CasADi Function that evaluates tool orientation and its derivatives at a distance (m) along a path.

    Outputs as `SmoothPath.turn`: quaternion (4), rate, acceleration, jerk (3 each, rad/m, rad/m^2, rad/m^3).
    """
    reference, theta = require.instance("turn_function: path", path, SmoothPath).charts
    columns = np.column_stack([reference, theta.reshape(-1, 18), path.piece_lengths, path.bounds[:-1]]).T
    s = ca.MX.sym("distance")
    clamped = _clamp(s, path.length)
    column = _column_at(path.bounds, columns, clamped)
    outputs = orientation_function()(column[:4], column[4:22], column[22], (clamped - column[23]) / column[22])
    return ca.Function("turn", [s], list(outputs), ["distance"], ["quaternion", "rate", "acceleration", "jerk"])


def _column_at(knots: Array, columns: Array, distance: Any) -> Any:
    """Return the table column of the interval between knots in which a distance lies, found by binary search.

    The tables are interpolants, since CasADi copies a constant matrix whenever it evaluates a function.
    """
    count = len(knots) - 1
    if count == 1:
        return ca.MX(ca.DM(columns))
    place = ca.interpolant("place", "linear", [knots], np.arange(count + 1.0), {"lookup_mode": ["binary"]})
    table = ca.interpolant("table", "linear", [np.arange(count)], columns.ravel("F"), {"lookup_mode": ["exact"]})
    return table(ca.fmin(ca.floor(place(distance)), count - 1))


def _clamp(distance: Any, length: float) -> Any:
    """Return the distance clamped to the path, as an expression whose derivative stays 1 at both ends of the path."""
    return ca.if_else(distance > length, length, ca.if_else(distance < 0, 0.0, distance))


@lru_cache(maxsize=1)
def _cell_function() -> Any:
    row, s = ca.SX.sym("row", 38), ca.SX.sym("s")
    start, axial, tangential, inward, rate, powers, cell = ca.vertsplit(row, [0, 3, 6, 9, 12, 13, 31, 38])
    coefficients = ca.reshape(powers, 3, 6)
    first_s, length, curved, first_u, width, speed0, speed1 = ca.vertsplit(cell)
    distance = s - first_s

    # on a segment; a line has the rate 0, where sin(rate s)/rate is s
    safe = rate + (rate == 0)
    along = ca.if_else(rate == 0, distance, ca.sin(rate * distance) / safe)
    across = ca.if_else(rate == 0, 0, 2 * ca.sin(rate * distance / 2) ** 2 / safe)
    cosine, sine = ca.cos(rate * distance), ca.sin(rate * distance)
    turning = cosine * tangential + sine * inward
    on_segment = [
        start + distance * axial + along * tangential + across * inward,
        axial + turning,
        rate * (cosine * inward - sine * tangential),
        -(rate**2) * turning,
    ]

    u = ca.SX.sym("u")
    slopes = derivative_of_columns(coefficients)
    bends = derivative_of_columns(slopes)
    first, second, third = (horner(columns, u) for columns in (slopes, bends, derivative_of_columns(bends)))
    rate = ca.norm_2(first)
    rate_of = ca.Function("rate", [row, u], [rate])
    x = distance / length
    slope0, slope1 = length / (width * speed0), length / (width * speed1)
    guess: Any = first_u + width * x * (slope0 + x * (3 - 2 * slope0 - slope1 + x * (slope0 + slope1 - 2)))
    rule = list(zip(GAUSS_NODES, GAUSS_WEIGHTS, strict=True))
    for _ in range(3):  # the interpolation is already close
        step = guess - first_u
        mean = sum(float(w) * rate_of(row, first_u + float(n) * step) for n, w in rule)
        guess = guess - (step * mean - distance) / rate_of(row, guess)
    rate_u = ca.dot(first, second) / rate
    rate_uu = (ca.dot(second, second) + ca.dot(first, third) - rate_u**2) / rate
    bend = (second - first * rate_u / rate) / rate**2
    change = (third - 3 * second * rate_u / rate + first * (3 * rate_u**2 / rate**2 - rate_uu / rate)) / rate**3
    curve = ca.Function("curve", [row, u], [horner(coefficients, u), first / rate, bend, change])
    outputs = [ca.if_else(curved, b, a) for a, b in zip(on_segment, curve(row, guess), strict=True)]
    return ca.Function("in_cell", [row, s], ca.cse(outputs))


def _part_table(path: SmoothPath) -> tuple[Array, Array]:
    """Return the distances at which the parts of a path start, followed by its length, and the geometry of each part.

    A part is the remainder of a line, arc or helix, or a cell of a curve; its geometry is a column. A segment has its
    start point, the axial, tangential and inward vectors of its screw, and its rotation rate; a curve has coefficients.
    Both also have distance, length, whether the part is a curve, u at the start, width in u, speeds at both ends.
    """
    on_segment = np.flatnonzero(path.piece_curve < 0)
    count, segment, task, cells = len(on_segment), path.piece_segment[on_segment], path.path, path.cells
    skipped = np.concatenate([[0.0], path.remaining])[segment]
    position, tangent, bend, _ = task.at(segment, skipped)
    k = task.curvature[segment]
    normal = bend / np.where(k == 0, 1.0, k)[:, None]
    screw = screw_axes(tangent, normal, k, task.torsion[segment])
    # a segment needs some regular curve, of nonzero speed, which is not used
    unused = np.tile([0, 0, 0, 1, 0, 0] + [0] * 12, (count, 1))
    begin, length, none, one = path.bounds[on_segment], path.piece_lengths[on_segment], np.zeros(count), np.ones(count)
    segments = np.column_stack([position, *screw, unused, begin, length, none, none, one, length, length])

    coefficients = path.coefficients[cells.curve]
    speeds = speed(coefficients, cells.start), speed(coefficients, cells.start + cells.width)
    flag, unused, begin_cells = np.ones(len(cells.curve)), np.zeros((len(cells.curve), 13)), path.cell_bounds
    shape = coefficients.reshape(-1, 18)
    curves = np.column_stack([unused, shape, begin_cells, cells.length, flag, cells.start, cells.width, *speeds])
    starts = np.concatenate([begin, begin_cells])
    order = np.argsort(starts, kind="stable")
    return np.append(starts[order], path.length), np.concatenate([segments, curves])[order].T


def exponential(vector: Any) -> Any:
    """Return the unit quaternion of a rotation vector (rad), up to 2 pi, as a CasADi expression. Shape (4, 1).

    A power series in the squared angle, smooth at zero.
    """
    square = ca.dot(vector, vector) / 4
    cosine: Any = 0
    sinc: Any = 0
    for k in reversed(range(SERIES_TERMS)):
        cosine = (-1) ** k / factorial(2 * k) + square * cosine
        sinc = (-1) ** k / factorial(2 * k + 1) + square * sinc
    return ca.vertcat(cosine, sinc / 2 * vector)


@lru_cache(maxsize=1)
def orientation_function() -> Any:
    """Return the CasADi Function that evaluates tool orientation and its derivatives on one segment or blend of a path.

    Inputs: reference (4); theta (3, 6) as 18 entries column by column; length (m); distance over length. Outputs as
    `turn_function`.
    """
    reference, theta = ca.SX.sym("reference", 4), ca.SX.sym("theta", 18)
    length, fraction = ca.SX.sym("length"), ca.SX.sym("fraction")
    powers = ca.vertcat(*[fraction**k for k in range(6)])
    quaternion = quaternion_product(reference, exponential(ca.mtimes(ca.reshape(theta, 3, 6), powers)))
    outputs = [quaternion]
    rate = angular_velocity_from_quaternion(quaternion, ca.jacobian(quaternion, fraction) / length)
    for _ in range(3):
        outputs.append(rate)
        rate = ca.jacobian(rate, fraction) / length
    return ca.Function("orientation", [reference, theta, length, fraction], ca.cse(outputs))
