"""Splines in place of many short segments of a path: the segment, its tool orientation, and its fit to a polyline.

A least-squares B-spline of degree 5 is fitted to a polyline by its arc length, and intervals between knots are halved
where it deviates too much. Both curves have the same parameter. Between two points of the union of knots and corners,
their difference is a polynomial, and the largest norm of its Bernstein coefficients bounds it. So the bound holds for
the distance of all points of either curve from the other one.

On each piece the tool orientation is q(s) = reference exp(theta(s)), with a polynomial theta of the distance s.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from math import factorial
from typing import Any, ClassVar, NamedTuple

import numpy as np
import scipy
from numpy.typing import NDArray

from models.checks import ROUNDING, Array, ArrayInput, require, set_fields
from models.errors import ModelError
from models.paths.blends import (
    GAUSS_NODES,
    GAUSS_WEIGHTS,
    Cells,
    cells,
    curvature,
    derivatives_by_arc_length,
    parameter,
    polynomial,
    quintic,
    speed,
)

SERIES_TERMS = 18


@dataclass(frozen=True, eq=False)
class Spline:
    """A curve of quintic polynomial pieces, in place of many short segments. `fit_splines` constructs it.

    Attributes:
        coefficients: Coefficients of the pieces in u from 0 to 1, in ascending order. Shape (P, 6, 3), m.
        references, turns: Tool orientation on the pieces: the unit quaternion at the start of each piece, and the
            rotation vector from it as a polynomial of distance over length of the piece, in ascending order. Shape (P,
            4) and (P, 6, 3), 1 and rad. None: the tool does not turn.
        torsion: Zero, 1/m. The torsion of a spline varies.

    Raises:
        ModelError: An array has a wrong shape or an entry that is not finite, or a piece ends beside the start of the
            next one.
    """

    coefficients: ArrayInput
    references: ArrayInput | None = None
    turns: ArrayInput | None = None
    torsion: ClassVar[float] = 0.0

    def __post_init__(self) -> None:
        curves = require.array("spline: coefficients", self.coefficients, ("pieces", 6, 3), least=1)
        set_fields(self, coefficients=curves)
        for name, shape in (("references", (len(curves), 4)), ("turns", (len(curves), 6, 3))):
            if getattr(self, name) is not None:
                set_fields(self, **{name: require.array(f"spline: {name}", getattr(self, name), shape)})
        gaps = np.linalg.norm(curves[:-1].sum(axis=1) - curves[1:, 0], axis=1)
        if gaps.max(initial=0.0) > ROUNDING:
            i = int(gaps.argmax())
            message = f"spline: piece {i} ends {gaps[i]:.3g} m beside the start of piece {i + 1}; close the gap"
            raise ModelError(message, name="coefficients", value=float(gaps[i]), limit=ROUNDING)

    @cached_property
    def cells(self) -> Cells:
        """Intervals of the curve parameter (cells) of the spline's pieces, for computing arc lengths."""
        return cells(np.asarray(self.coefficients))

    @property
    def length(self) -> float:
        """Length of the spline, m."""
        return float(self.cells.length.sum())

    @property
    def end(self) -> Array:
        """End point of the spline in the world. Shape (3,), m."""
        return np.asarray(polynomial(np.asarray(self.coefficients)[-1], np.array(1.0)))

    @property
    def start(self) -> Array:
        """Start point of the spline in the world. Shape (3,), m."""
        return np.asarray(np.asarray(self.coefficients)[0, 0])

    @property
    def tangent(self) -> Array:
        """Unit tangent of the spline at its start. Shape (3,)."""
        return np.asarray(derivatives_by_arc_length(np.asarray(self.coefficients)[:1], np.zeros(1))[1][0])

    @property
    def normal(self) -> Array:
        """Zero vector, since points of a spline, unlike those of an arc, are computed without a normal. Shape (3,)."""
        return np.zeros(3)

    @cached_property
    def curvature(self) -> float:
        """Largest curvature of the spline at the ends of its pieces, 1/m."""
        curves = np.asarray(self.coefficients)
        return float(max(curvature(curves, np.full(len(curves), u)).max() for u in (0.0, 1.0)))

    @cached_property
    def bounds(self) -> Array:
        """Distances from the spline's start at which its pieces begin, and finally its length. Shape (P + 1,), m."""
        return np.concatenate([[0.0], np.cumsum(np.bincount(self.cells.curve, self.cells.length))])

    def parameters(self, distance: Array) -> tuple[NDArray[np.intp], Array]:
        """Return the index of the spline's piece, and the parameter u in it, at each distance (m). Shape (M,) each."""
        begins = np.cumsum(self.cells.length) - self.cells.length
        at = np.clip(np.searchsorted(begins, distance, side="right") - 1, 0, len(begins) - 1)
        return parameter(np.asarray(self.coefficients), self.cells, at, distance - begins[at])

    def part(self, first: float, last: float) -> Spline:
        """Return the part of the spline between two distances (m) from its start."""
        (begin, end), (u, v) = self.parameters(np.array([first, last]))
        end = max(begin, end - 1) if v == 0 else end
        v = 1.0 if v == 0 else v
        pieces = slice(int(begin), int(end) + 1)
        limits = np.stack([np.r_[u, np.zeros(end - begin)], np.r_[np.ones(end - begin), v]])
        curves = _between(np.asarray(self.coefficients)[pieces], *limits)
        if self.references is None or self.turns is None:
            return Spline(curves)
        lengths = np.diff(self.bounds)[pieces]
        shares = np.clip((np.array([first, last]) - self.bounds[[begin, end]]) / lengths[[0, -1]], 0.0, 1.0)
        limits[0, 0], limits[1, -1] = shares
        return Spline(curves, np.asarray(self.references)[pieces], _between(np.asarray(self.turns)[pieces], *limits))

    def turn_at(self, distance: float) -> tuple[Array, Array, Array]:
        """Return the tool orientation in the world, and its first two derivatives, at a distance (m) from the start."""
        assert self.references is not None
        assert self.turns is not None
        piece = int(np.clip(np.searchsorted(self.bounds, distance, side="right") - 1, 0, len(self.bounds) - 2))
        own, (begin, end) = slice(piece, piece + 1), self.bounds[piece : piece + 2]
        length = np.array([end - begin])
        chart = np.asarray(self.references)[own], np.asarray(self.turns)[own]
        quaternion, rate, change, _ = along_piece(*chart, length, (distance - begin) / length)
        return quaternion[0], rate[0], change[0]

    @property
    def start_orientation(self) -> Array | None:
        """Tool orientation at the spline's start, unit quaternion; None if not specified. Shape (4,)."""
        return self._orientation(0, np.array([1.0, 0, 0, 0, 0, 0]))

    @property
    def end_orientation(self) -> Array | None:
        """Tool orientation at the spline's end, unit quaternion; None if not specified. Shape (4,)."""
        return self._orientation(-1, np.ones(6))

    def _orientation(self, piece: int, powers: Array) -> Array | None:
        if self.references is None or self.turns is None:
            return None
        return product(np.asarray(self.references)[piece], exponential(powers @ np.asarray(self.turns)[piece]))


class SplineTable(NamedTuple):
    """Table that locates distances on all splines of a path, to evaluate points of many splines at once."""

    curves: Array  # polynomial that each cell is a part of. Shape (C, 6, 3), m.
    cells: Cells  # the cells, each with a curve of its own
    cell_begins: Array  # distance along the path at which each cell begins. Shape (C,), m.
    first: NDArray[np.intp]  # first cell of each segment of the path, and finally C. Shape (n + 1,).
    begins: Array  # distance along the path at which each segment begins. Shape (n,), m.

    @classmethod
    def of(cls, segments: Sequence[Any], begins: Array) -> SplineTable:
        """Return the table that locates distances on a path's splines, given all segments and where they start (m)."""
        splines = [(each, begin) for each, begin in zip(segments, begins, strict=True) if isinstance(each, Spline)]
        counts = [len(each.cells.curve) if isinstance(each, Spline) else 0 for each in segments]
        curves = np.concatenate([np.asarray(each.coefficients)[each.cells.curve] for each, _ in splines])
        columns = (np.concatenate(parts) for parts in zip(*(each.cells[1:] for each, _ in splines), strict=True))
        cell_begins = [begin + np.cumsum(each.cells.length) - each.cells.length for each, begin in splines]
        first = np.concatenate([[0], np.cumsum(counts)])
        return cls(curves, Cells(np.arange(len(curves)), *columns), np.concatenate(cell_begins), first, begins)

    def at(self, index: NDArray[np.intp], distance: Array) -> tuple[Array, Array, Array, Array]:
        """Return points at distances (m) along splines, and their first three derivatives. Shapes (M,) -> (M, 3)."""
        place = self.begins[index] + distance
        cell = np.searchsorted(self.cell_begins, place, side="right") - 1
        cell = np.clip(cell, self.first[index], self.first[index + 1] - 1)
        curve, u = parameter(self.curves, self.cells, cell, place - self.cell_begins[cell])
        return derivatives_by_arc_length(self.curves[curve], u)


def _between(coefficients: Array, first: Array, last: Array) -> Array:
    """Return polynomial curves rescaled so that u in [0, 1] spans the part from `first` to `last`. Shape (P, 6, 3)."""
    power, own = np.arange(6), np.arange(6)[:, None]
    shift = np.where(power >= own, first[:, None, None] ** np.maximum(power - own, 0), 0.0)
    matrix = scipy.special.comb(power, own) * shift * (last - first)[:, None, None] ** own
    return np.asarray(matrix @ coefficients)


class Polyline(NamedTuple):
    """Polyline to fit a spline to: its points, and the tool orientation at the points."""

    points: Array  # shape (N, 3), m; two successive points differ
    quaternions: Array | None = None  # unit, with continuous signs, (N, 4); None: the tool does not turn


@dataclass(frozen=True)
class FitSettings:
    """Settings of the fit of a spline to a polyline."""

    degree: int = 5  # degree of the spline; the pieces are quintic polynomials
    samples: int = 12  # least samples of the polyline between two knots: twice as many as a knot adds unknowns
    end_weight: float = 1e3  # weight of both ends, which are then met exactly


FIT = FitSettings()


def fit_spline(line: Polyline, deviation: float, angle: float, max_pieces: int) -> tuple[Spline, float] | None:
    """Fit a spline to a polyline, exactly at the ends; return the spline and a bound of its deviation (m), or None.

    Args:
        deviation: Largest distance (m) between points of equal parameter of polyline and spline.
        angle: Largest angle (rad) between the tool orientations there, checked at the points, at the knots and
            midway.
        max_pieces: Largest number of pieces; None is returned if more are needed.
    """
    points, quaternions = line
    places = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])
    knots = places[[0, -1]]
    while len(knots) <= max_pieces + 1:
        grid = knots[:-1, None] + np.diff(knots)[:, None] * np.arange(FIT.samples) / FIT.samples
        x = np.union1d(places, grid)
        curve = _least_squares(x, _interpolated(x, places, points), knots)
        spline, poses = Spline(_pieces(curve, knots)), None
        ends = x[:-1, None] + np.diff(x)[:, None] * np.linspace(0, 1, FIT.degree + 1)
        error = curve(ends) - _interpolated(ends, places, points)
        bounds = np.linalg.norm(_bernstein() @ error, axis=2).max(axis=1)
        share = bounds / deviation
        if quaternions is not None:
            poses = _least_squares(x, _interpolated(x, places, quaternions), knots)
            spline = _with_orientation(spline, poses, curve, knots)
            share = np.maximum(share, _angles(spline, line, (x[:-1] + x[1:]) / 2, places, knots) / angle)
            share = np.maximum(share, _angles(spline, line, x[:-1], places, knots) / angle)
        worst = np.maximum.reduceat(share, np.searchsorted(x, knots[:-1]))
        if worst.max() <= 1:
            return spline, float(bounds.max())
        knots = np.sort(np.append(knots, (knots[:-1] + knots[1:])[worst > 1] / 2))
    return None


def _interpolated(x: Array, places: Array, values: Array) -> Array:
    return np.stack([np.interp(x, places, column) for column in values.T], axis=-1)


def _least_squares(x: Array, values: Array, knots: Array) -> scipy.interpolate.BSpline:
    """Return the B-spline with given knots that best fits values (M, k) at x (M,) and equals them at both ends."""
    degree, weights = FIT.degree, np.ones(len(x))
    weights[[0, -1]] = FIT.end_weight
    whole = np.concatenate([np.repeat(knots[0], degree), knots, np.repeat(knots[-1], degree)])
    curve = scipy.interpolate.make_lsq_spline(x, values, whole, k=degree, w=weights, method="norm-eq")
    curve.c[[0, -1]] = values[[0, -1]]
    return curve


def _pieces(curve: scipy.interpolate.BSpline, knots: Array) -> Array:
    """Return the pieces of a B-spline as polynomials of u from 0 to 1. Shape (P, 6, 3)."""
    width = np.diff(knots)[:, None]
    orders = range(FIT.degree + 1)
    pieces = np.stack([curve(knots[:-1], order) * width**order / factorial(order) for order in orders], axis=1)
    pieces[:, -1] += np.concatenate([pieces[1:, 0], curve(knots[-1:])]) - pieces.sum(axis=1)  # of rounding
    return np.asarray(pieces)


@lru_cache(maxsize=1)
def _bernstein() -> Array:
    """Return the matrix, (6, 6), from a quintic's values at six equidistant points to its Bernstein coefficients."""
    u, k = np.linspace(0, 1, FIT.degree + 1)[:, None], np.arange(FIT.degree + 1)
    return np.linalg.inv(scipy.special.comb(FIT.degree, k) * u**k * (1 - u) ** (FIT.degree - k))


def _with_orientation(
    spline: Spline, poses: scipy.interpolate.BSpline, curve: scipy.interpolate.BSpline, knots: Array
) -> Spline:
    """Return a spline with tool orientations whose values and two derivatives at the knots are those of a B-spline."""
    q, first, second = (poses(knots, order) for order in range(3))
    square = (q * q).sum(axis=1, keepdims=True)
    back = q * [1, -1, -1, -1]
    spin = 2 * product(first, back)[:, 1:] / square
    change = 2 * product(second, back)[:, 1:] / square
    change -= 2 * spin * (q * first).sum(axis=1, keepdims=True) / square
    # by the arc length, instead of the parameter of the curves
    tangent, bend = curve(knots, 1), curve(knots, 2)
    pace = np.linalg.norm(tangent, axis=1, keepdims=True)
    spin = spin / pace
    change = (change - spin * (tangent * bend).sum(axis=1, keepdims=True) / pace) / pace**2
    q = q / np.sqrt(square)
    length = np.diff(spline.bounds)[:, None]
    ends = []
    for own in (slice(None, -1), slice(1, None)):
        vector, rate, second = chart(q[:-1], q[own], spin[own], change[own])
        ends.append((vector, rate * length, second * length**2))
    return Spline(spline.coefficients, q[:-1], quintic(*ends))


def _angles(spline: Spline, line: Polyline, x: Array, places: Array, knots: Array) -> Array:
    """Return the angles between the tool orientations of spline and polyline at parameters x. Shape (M,), rad."""
    assert line.quaternions is not None
    assert spline.references is not None
    assert spline.turns is not None
    at = np.clip(np.searchsorted(places, x, side="right") - 1, 0, len(places) - 2)
    share = (x - places[at]) / np.diff(places)[at]
    step = logarithm(line.quaternions[at], line.quaternions[at + 1])
    expected = product(line.quaternions[at], exponential(share[:, None] * step))
    piece = np.clip(np.searchsorted(knots, x, side="right") - 1, 0, len(knots) - 2)
    curves, length = np.asarray(spline.coefficients)[piece], np.diff(spline.bounds)[piece]
    u = (x - knots[piece]) / np.diff(knots)[piece]
    along = sum(u * w * speed(curves, n * u) for n, w in zip(GAUSS_NODES, GAUSS_WEIGHTS, strict=True)) / length
    theta = polynomial(np.asarray(spline.turns)[piece], along)
    actual = product(np.asarray(spline.references)[piece], exponential(theta))
    return np.asarray(np.linalg.norm(logarithm(expected, actual), axis=1))


def logarithm(first: Array, second: Array) -> Array:
    """Return the rotation vectors from one orientation to another, in the axes of the first. Shape (..., 3), rad."""
    step = product(first * [1, -1, -1, -1], second)
    step = np.where(step[..., :1] < 0, -step, step)
    size = np.linalg.norm(step[..., 1:], axis=-1, keepdims=True)
    return np.asarray(2 * np.arctan2(size, step[..., :1]) * step[..., 1:] / np.where(size > 0, size, 1.0))


def chart(reference: Array, quaternion: Array, rate: Array, acceleration: Array) -> tuple[Array, Array, Array]:
    """Return the rotation vectors from reference orientations to tool orientations, and their first two derivatives.

    The inverse of `along_piece`: rate and acceleration of the orientation are in world. Shapes (M, 4), (M, 3).
    """
    theta = logarithm(reference, quaternion)
    back = reference * [1, -1, -1, -1]
    spin, change = (rotate(back, vector) for vector in (rate, acceleration))
    square = _dot(theta, theta)
    (b0, b1, _), (c0, c1, _) = ([value[:, :, None] for value in _series(start, square)] for start in (2, 3))
    cross = _skew(theta)
    jacobian = np.eye(3) + b0 * cross + c0 * cross @ cross
    first: Array = np.linalg.solve(jacobian, spin[..., None]).astype(float)
    turn, slope = _skew(first[..., 0]), 2 * _dot(theta, first[..., 0])[:, :, None]
    jacobian_rate = b1 * slope * cross + b0 * turn + c1 * slope * cross @ cross + c0 * (turn @ cross + cross @ turn)
    second: Array = np.linalg.solve(jacobian, change[..., None] - jacobian_rate @ first).astype(float)
    return theta, first[..., 0], second[..., 0]


def _skew(vector: Array) -> Array:
    return np.asarray(np.cross(vector[:, None], np.eye(3)).transpose(0, 2, 1))


def rotate(quaternion: Array, vector: Array) -> Array:
    """Return vectors rotated by quaternions. Shapes (M, 4), (M, 3) -> (M, 3)."""
    twist = 2 * np.cross(quaternion[:, 1:], vector)
    return np.asarray(vector + quaternion[:, :1] * twist + np.cross(quaternion[:, 1:], twist))


def along_piece(reference: Array, theta: Array, length: Array, fraction: Array) -> tuple[Array, Array, Array, Array]:
    """Return the tool orientation and its derivatives at M samples on segments and blends of a path.

    omega = theta' + B theta x theta' + C theta x (theta x theta'), with B = (1 - cos a)/a^2, C = (a - sin a)/a^3 and a
    = |theta|, in the axes of the reference. B and C are entire functions of a^2.

    Args:
        reference: Shape (M, 4).
        theta: Shape (M, 6, 3).
        length, fraction: Shape (M,).

    Returns:
        Unit quaternion (M, 4); rate, acceleration and jerk with respect to the distance (M, 3).
    """
    t0, t1, t2, t3 = (polynomial(theta, fraction, order) / length[:, None] ** order for order in range(4))
    square = _dot(t0, t0)
    first, second = 2 * _dot(t0, t1), 2 * (_dot(t1, t1) + _dot(t0, t2))
    a0, a1 = np.cross(t0, t1), np.cross(t0, t2)
    a2 = np.cross(t1, t2) + np.cross(t0, t3)
    b0, b1 = np.cross(t0, a0), np.cross(t1, a0) + np.cross(t0, a1)
    b2 = np.cross(t2, a0) + 2 * np.cross(t1, a1) + np.cross(t0, a2)
    omega = [t1, t2, t3]
    for start, (v0, v1, v2) in ((2, (a0, a1, a2)), (3, (b0, b1, b2))):
        f0, f1, f2 = _series(start, square)
        f2 = f2 * first**2 + f1 * second
        f1 = f1 * first
        omega[0] = omega[0] + f0 * v0
        omega[1] = omega[1] + f1 * v0 + f0 * v1
        omega[2] = omega[2] + f2 * v0 + 2 * f1 * v1 + f0 * v2
    turned = product(reference, exponential(t0))
    rates = [rotate(reference, value) for value in omega]
    return turned, rates[0], rates[1], rates[2]


def _dot(a: Array, b: Array) -> Array:
    return np.asarray((a * b).sum(axis=1, keepdims=True))


def _series(start: int, square: Array) -> tuple[Array, Array, Array]:
    """Return the sum over k of (-x)^k / (2 k + start)! and its first two derivatives at x = `square`."""
    value, first, second = (np.zeros_like(square) for _ in range(3))
    for k in reversed(range(SERIES_TERMS)):
        second = second * square + 2 * first
        first = first * square + value
        value = value * square + (-1) ** k / factorial(2 * k + start)
    return value, first, second


def exponential(vector: Array) -> Array:
    """Return the unit quaternions of rotation vectors (rad). Shape (..., 3) -> (..., 4)."""
    half = np.linalg.norm(vector, axis=-1, keepdims=True) / 2
    return np.concatenate([np.cos(half), np.sinc(half / np.pi) / 2 * vector], axis=-1)


def product(first: ArrayInput, second: ArrayInput) -> Array:
    """Return the product of two quaternions [w, x, y, z], or of two arrays of quaternions. Shape (..., 4)."""
    p, q = np.asarray(first, dtype=float), np.asarray(second, dtype=float)
    scalar = p[..., :1] * q[..., :1] - (p[..., 1:] * q[..., 1:]).sum(axis=-1, keepdims=True)
    vector = p[..., :1] * q[..., 1:] + q[..., :1] * p[..., 1:] + np.cross(p[..., 1:], q[..., 1:])
    return np.concatenate([scalar, vector], axis=-1)


def simplify_polyline(points: Array, deviation: float) -> NDArray[np.intp]:
    """Return the indices of points to keep so that all others are within a deviation of the chords (Ramer 1972)."""
    kept, pending = {0, len(points) - 1}, [(0, len(points) - 1)]
    while pending:
        first, last = pending.pop()
        distances = distances_from_chord(points[first : last + 1])
        middle = first + int(distances.argmax())
        if distances[middle - first] > deviation:
            kept.add(middle)
            pending += [(first, middle), (middle, last)]
    chain, i = sorted(kept), 1
    while i < len(chain) - 1:  # of two neighbours at a corner with noise, one suffices
        if distances_from_chord(points[chain[i - 1] : chain[i + 1] + 1]).max() <= deviation:
            del chain[i]
        else:
            i += 1
    return np.array(chain)


def distances_from_chord(points: Array) -> Array:
    """Return the distances of points (N, 3) from the line segment between the first and the last of them."""
    offset = points - points[0]
    chord = offset[-1]
    share = np.clip(offset @ chord / max(float(chord @ chord), np.finfo(float).tiny), 0.0, 1.0)
    return np.asarray(np.linalg.norm(offset - share[:, None] * chord, axis=1))
