"""Signed distance of two shapes as an expression, for constraints, performance indices and reports.

The distance is exact for spheres, capsules, boxes and half-spaces: the distance of the closest points or, for
overlapping shapes, minus the penetration depth. For a `Polytope`, such as a mesh or a cylinder, it is a lower bound,
the largest gap along the normals of its faces and along the bisectors of normals that meet at a sharp edge or corner.

A shape is a convex core swept by a sphere. Separated cores have the distance d of their closest points. Overlapping
cores have the largest gap along the candidate separating axes (face normals and cross products of edges), which is
negative and equals minus the penetration depth of polytopes. That gap never exceeds d and is positive exactly for
separated cores, so d + min(gap, 0) covers both cases.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache, reduce
from itertools import accumulate, pairwise
from math import cos, log, pi
from typing import Any, NamedTuple, TypeAlias

import casadi as ca
import numpy as np

from models.checks import Array, require
from models.errors import ModelError
from models.files import INPUT_LIMITS
from models.robot.kinematics import checked_placement
from models.shapes.cores import (
    BoxCore,
    SegmentCore,
    StopGradient,
    Triple,
    add,
    cross,
    distance_of_segments,
    distance_to_box,
    dot,
    in_axes,
    keep_gradient,
    largest_of,
    smooth_abs,
    subtract,
    triple,
)
from models.shapes.hull import Hull
from models.shapes.shapes import Box, Capsule, HalfSpace, Polytope, Shape, Sphere, checked_shape
from models.spatial import Expression, Frame, expression, on_scalars


class HullCore(NamedTuple):
    """A `Polytope` as distance formulas use it: a convex hull, with the centre and axes of its pose."""

    centre: Triple
    axes: tuple[Triple, ...]
    hull: Hull


class PlaneCore(NamedTuple):
    """The boundary plane of a half-space as distance formulas use it: a point and the outward normal."""

    point: Triple
    normal: Triple


Core: TypeAlias = SegmentCore | BoxCore | HullCore | PlaneCore

COLUMNS: dict[type[Shape], int] = {Sphere: 4, Capsule: 7, Box: 15, HalfSpace: 6}
"""Number of entries of the column that describes a shape (see `column`), by kind of shape."""
VECTORS: dict[type[Shape], tuple[int, int]] = {Sphere: (1, 0), Capsule: (2, 0), Box: (1, 3), HalfSpace: (1, 1)}
"""Numbers of points and of directions at the beginning of the column that describes a shape, by kind of shape."""


def distance(
    first: Shape,
    second: Shape,
    first_frame: Frame | None = None,
    second_frame: Frame | None = None,
    *,
    rounding: float = 0.0,
) -> Expression:
    """Return the signed distance of two shapes as an expression; their poses may be symbols. Shape (1, 1), m.

    The distance is negative for overlapping shapes; its gradient points out of the overlap. Without rounding it is
    exact for spheres, capsules, boxes and half-spaces, and for the hull of a `Polytope` beside a half-space. Any other
    pair with a polytope, such as a mesh or a cylinder, gets a lower bound, the largest gap along the normals of faces.

    The exact distance of capsules and boxes has kinks, where second-order methods zigzag. With rounding e > 0 the
    result is a smooth lower bound on which an interior-point method converges. It minimises the squared distance over
    positions s, t in 0..1 along the segments with e^2 ((s - 1/2)^2 + (t - 1/2)^2) added. This problem is strictly
    convex, so positions and gradient are Lipschitz. The added term is at most c = e^2/2, or e^2/4 with one segment. The
    minimum M lies in d^2..d^2 + c, so (M - c)/sqrt(M + c) is at most d and smooth.

    For capsules the bound is below the distance by at most 0.84 e, and by at most e^2/d for cores a distance d apart.
    Beside a polytope or a half-space it is at most 3 e below the unrounded result, for two boxes at most 4 e
    below the largest of their gaps along 15 axes and of the distances of either one to the bounding box of the other in
    its own axes. A fifth of the radii is a good e and a hundredth has no effect. Spheres beside spheres, capsules and
    boxes are smooth already and ignore the rounding.

    Args:
        first, second: Shapes in world, or in the frames.
        first_frame, second_frame: Poses of the shapes' frames in world; numbers, SX or MX. None: world. Pairs that
            share a frame have common subexpressions, which ca.cse extracts.
        rounding: e, m.

    Raises:
        ModelError: An argument is no shape, both are half-spaces, a box is infinite, a frame is invalid, or the
            rounding is negative.
    """
    checked_shape("distance: first", first)
    checked_shape("distance: second", second)
    if {type(first), type(second)} <= COLUMNS.keys():
        function = pair_function(type(first), type(second), rounding)
        return function(column(first, first_frame), column(second, second_frame))
    require.nonnegative("distance: rounding", rounding, unit="m")
    places = [
        *checked_placement(first_frame, "distance: first_frame"),
        *checked_placement(second_frame, "distance: second_frame"),
    ]
    return expression(_distance_with_hull(*places, first=first, second=second, rounding=float(rounding)))


def column(shape: Shape, frame: Frame | None = None) -> Expression:
    """Return a sphere, capsule, box or half-space in the world as the column of numbers that `pair_function` takes.

    Sphere: position, radius. Capsule: start, end, radius. Box: position, axes, half of its edges. Half-space: point,
    normal. Shapes (4, 1), (7, 1), (15, 1), (6, 1).

    Raises:
        ModelError: The shape is a polytope, which has no column, or is invalid for `distance`.
    """
    checked_shape("column: shape", shape)
    _check_kind(type(shape), "shape")
    turn, place = checked_placement(frame, "distance: frame")
    if isinstance(shape, Sphere | Capsule):
        return ca.vertcat(*(place + ca.mtimes(turn, ca.DM(point)) for point in shape.core), shape.radius)
    if isinstance(shape, HalfSpace):
        return ca.vertcat(place + ca.mtimes(turn, ca.DM(shape.point)), ca.mtimes(turn, ca.DM(shape.normal)))
    assert isinstance(shape, Box)
    half = require.array("distance: size", shape.size, (3,), unit="m") / 2
    axes = ca.vec(ca.mtimes(turn, ca.DM(shape.rotation)))
    return ca.vertcat(place + ca.mtimes(turn, ca.DM(shape.position)), axes, half)


def pair_function(first: type[Shape], second: type[Shape], rounding: float = 0.0) -> Any:
    """Return the CasADi Function for the `distance` of two shapes of given kinds, whose inputs are results of `column`.

    `pair_function(Capsule, Box).map(n)` evaluates n pairs, side by side as columns. One small function that is called
    often evaluates and compiles several times faster than one graph of all pairs.

    Raises:
        ModelError: A kind is a polytope, both are HalfSpace, or the rounding is negative.
    """
    for what, kind in (("first", first), ("second", second)):
        _check_kind(kind, what)
    require.nonnegative("distance: rounding", rounding, unit="m")
    if first is HalfSpace and second is HalfSpace:
        raise ModelError("distance: two half-spaces have no distance", name="second", value=second)
    return _pair_function((first, second), float(rounding))


def pair_wrenches(first: type[Shape], second: type[Shape], rounding: float, count: int) -> Any:
    """Return the CasADi Function from n pairs of shapes to the distances and, as wrenches, the distances' gradients.

    Pairs are rows of the inputs: columns (see `column`) have shapes (n, COLUMNS[kind]), distances (n, 1), m, and
    wrenches (n, 6). A wrench w is (moment about the world's origin, force); the distance changes at the rate w . (first
    twist - second twist), with twists (angular, linear at the world's origin). Closest points slide along the shapes
    without changing the distance, so only the positions of the shapes are differentiated (envelope theorem). Arguments
    and errors are those of `pair_function`.
    """
    pair_function(first, second, rounding)
    return _pair_wrenches((first, second), float(rounding), count)


@cache
def _pair_function(kinds: tuple[Any, Any], rounding: float) -> Any:
    columns = [ca.SX.sym(kind.__name__, COLUMNS[kind]) for kind in kinds]
    gap = _distance_of_columns(kinds, list(map(ca.vertsplit, columns)), rounding, keep_gradient)
    return ca.Function("_".join(kind.__name__ for kind in kinds), columns, [ca.cse(gap)])


@cache
def _pair_wrenches(kinds: tuple[Any, Any], rounding: float, count: int) -> Any:
    columns = [ca.MX.sym(kind.__name__, count, COLUMNS[kind]) for kind in kinds]
    # differentiate with respect to the shape with fewer entries
    side = 0 if COLUMNS[kinds[0]] <= COLUMNS[kinds[1]] else 1
    points, directions = VECTORS[kinds[side]]
    rows = [ca.horzsplit(each) for each in columns]
    stop_gradient = StoppedGradients()
    vectors = stop_gradient(columns[side][:, : 3 * (points + directions)])
    own = ca.horzsplit(vectors)
    rows[side][: len(own)] = own
    gap = _distance_of_columns(kinds, rows, rounding, stop_gradient)
    slopes = ca.horzsplit(ca.gradient(ca.sum1(gap), vectors))
    moment, force = (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)
    for k in range(points + directions):
        arm, slope = triple(own[3 * k : 3 * k + 3]), triple(slopes[3 * k : 3 * k + 3])
        moment = add(moment, cross(arm, slope))
        force = add(force, slope) if k < points else force
    wrench = ca.horzcat(*(part if side == 0 else -part for part in (*moment, *force)))
    return ca.Function("wrenches", columns, ca.cse(stop_gradient.restore([gap, wrench])))


class StoppedGradients:
    """Store of expressions that differentiation treats as constants, because symbols replace them until `restore`.

    A distance is a minimum over positions or a maximum over directions, whose motion does not change it to first order
    (envelope theorem).
    """

    def __init__(self) -> None:
        self._symbols: list[Expression] = []
        self._values: list[Expression] = []

    def __call__(self, value: Expression) -> Expression:
        """Return a new symbol for an expression, so that differentiation treats the expression as a constant."""
        if not isinstance(value, ca.MX) or value.is_constant():
            return value
        self._symbols.append(ca.MX.sym("stopped", value.shape))
        self._values.append(value)
        return self._symbols[-1]

    def restore(self, expressions: list[Expression]) -> list[Expression]:
        """Return expressions in which the symbols are replaced by the expressions that they stand for."""
        return list(ca.substitute_inplace(self._symbols, self._values, expressions)[1])


def soft_minimum(values: Sequence[Expression], width: float) -> Expression:
    """Return a smooth lower bound of the smallest of n values, at most width log(n) below it. Shape (1, 1).

    Raises:
        ModelError: There is no value, or the width is not positive.
    """
    if not isinstance(values, list | tuple) or not 0 < len(values) <= INPUT_LIMITS.count:
        message = f"soft_minimum: values must be a list of 1 to {INPUT_LIMITS.count} numbers, not {repr(values)[:80]}"
        raise ModelError(message, name="values", value=values, limit=INPUT_LIMITS.count)
    require.positive("soft_minimum: width", width)
    for value in values:
        if not isinstance(value, ca.SX | ca.MX | ca.DM):
            require.number("soft_minimum: values", value)
        elif value.shape != (1, 1):
            message = f"soft_minimum: values must be numbers, not of shape {value.shape}"
            raise ModelError(message, name="values", value=value.shape, limit=(1, 1))
    stacked, least = ca.vertcat(*values), reduce(ca.fmin, values)
    return least - width * ca.log(ca.sum1(ca.exp((least - stacked) / width)))


def soft_minima(
    value: Expression, gradient: Expression, positions: list[int], counts: list[int], *, softness: float
) -> tuple[Expression, Expression]:
    """Return the smooth minimum of the distances in each group, and the gradient of this minimum.

    The distances of the groups, `counts` each, are at the rows `positions` of `value` and `gradient`.
    """
    values, rows, order = [value], [gradient], []
    for begin, end in pairwise(accumulate(counts, initial=0)):
        members = positions[begin:end]
        if len(members) == 1:
            order += members
            continue
        group = value[members]
        weights = ca.exp((ca.mmin(group) - group) / softness)
        order.append(len(positions) + len(values) - 1)
        values.append(soft_minimum(ca.vertsplit(group), softness))
        rows.append(ca.mtimes((weights / ca.sum1(weights)).T, gradient[members, :]))
    return ca.vertcat(*values)[order], ca.vertcat(*rows)[order, :]


def _check_kind(kind: Any, what: str) -> None:
    if not isinstance(kind, type) or kind not in COLUMNS:
        names = ", ".join(known.__name__ for known in COLUMNS)
        raise ModelError(f"distance: {what} must be one of {names}, not {kind!r}", name=what, value=kind, limit=names)


def _distance_of_columns(
    kinds: tuple[Any, Any], entries: Sequence[Sequence[Expression]], rounding: float, stop_gradient: StopGradient
) -> Any:
    """Return the signed distance of two shapes of the given kinds, each described by its column (see `column`)."""
    swept_radius = sum(own[-1] for kind, own in zip(kinds, entries, strict=True) if kind in (Sphere, Capsule))
    first, second = map(_core_of_column, kinds, entries)
    return _distance_of_cores(first, second, rounding, stop_gradient) - swept_radius


@on_scalars
def _distance_with_hull(*poses: Expression, first: Shape, second: Shape, rounding: float) -> Expression:
    """Return the signed distance of two shapes, one of them a `Polytope`, at `poses` (each a rotation and position)."""
    cores = _core_in_frame(first, *poses[:2]), _core_in_frame(second, *poses[2:])
    return _distance_of_cores(*cores, rounding, keep_gradient) - (first.swept_radius + second.swept_radius)


def _distance_of_cores(first: Core, second: Core, rounding: float, stop_gradient: StopGradient) -> Any:
    """Return the signed distance of two cores, m, smooth within the width `rounding`."""
    if isinstance(first, PlaneCore):
        return _least_height(second, first.normal, first.point, rounding)
    if isinstance(second, PlaneCore):
        return _least_height(first, second.normal, second.point, rounding)
    if isinstance(first, HullCore) or isinstance(second, HullCore):
        gaps = [*_face_gaps(first, second, rounding), *_face_gaps(second, first, rounding)]
        return largest_of(gaps, rounding, stop_gradient)
    if isinstance(second, BoxCore):
        return distance_to_box(first, second, rounding, stop_gradient)
    if isinstance(first, BoxCore):
        return distance_to_box(second, first, rounding, stop_gradient)
    return distance_of_segments(first, second, rounding, stop_gradient)


def _core_in_frame(shape: Shape, turn: Expression, place: Expression) -> Core:
    if type(shape) in COLUMNS:
        return _core_of_column(type(shape), list(map(_as_number, ca.vertsplit(column(shape, Frame(turn, place))))))
    assert isinstance(shape, Polytope)
    axes = ca.horzsplit(ca.mtimes(turn, ca.DM(shape.rotation)))
    return HullCore(_scalars(place + ca.mtimes(turn, ca.DM(shape.position))), tuple(map(_scalars, axes)), shape.hull)


def _core_of_column(kind: type[Shape], entries: Sequence[Expression]) -> Core:
    """Convert the column of numbers of a shape to the point, segment, box or plane that distance formulas use."""
    parts = [triple(entries[3 * k : 3 * k + 3]) for k in range(len(entries) // 3)]
    if kind is Box:
        return BoxCore(parts[0], tuple(parts[1:4]), parts[4])
    return PlaneCore(parts[0], parts[1]) if kind is HalfSpace else SegmentCore(tuple(parts))


def _scalars(vector: Expression) -> Triple:
    return triple(_as_number(expression(vector)[k]) for k in range(3))


def _as_number(entry: Expression) -> Expression:
    """Return a scalar expression, converted to a float if it is constant."""
    return float(entry) if entry.is_constant() else entry


def _least_height(core: Core, normal: Triple, point: Triple, rounding: float) -> Expression:
    """Return the least height of a segment, box or hull above a plane or, if `rounding` > 0, a smooth lower bound."""
    if isinstance(core, SegmentCore):
        heights = [dot(normal, subtract(end, point)) for end in core.points]
        middle, reaches = sum(heights) / len(heights), [(heights[-1] - heights[0]) / 2][: len(heights) - 1]
    else:
        assert not isinstance(core, PlaneCore)
        middle, shares = dot(normal, subtract(core.centre, point)), in_axes(normal, core.axes)
        if isinstance(core, HullCore):
            heights = [dot(shares, _scalars(vertex)) for vertex in core.hull.vertices]
            smooth = rounding > 0 and len(heights) > 1
            least = soft_minimum(heights, rounding / log(len(heights))) if smooth else reduce(ca.fmin, heights)
            return middle + least
        reaches = [h * share for h, share in zip(core.half, shares, strict=True)]
    slack = rounding / len(reaches) if reaches else 0.0
    return middle - sum(smooth_abs(reach, slack) for reach in reaches)


def _face_gaps(first: Core, second: Core, rounding: float) -> list[Expression]:
    """Return the gaps between two convex bodies along the first body's face normals; empty if it has no faces."""
    if isinstance(first, BoxCore):
        signed = [(axis, side, h) for axis, h in zip(first.axes, first.half, strict=True) for side in (-1.0, 1.0)]
        normals = [(triple(side * part for part in axis), h) for axis, side, h in signed]
        return [_least_height(second, normal, first.centre, rounding) - h for normal, h in normals]
    if not isinstance(first, HullCore):
        return []
    local = _in_frame(second, first.centre, first.axes)
    directions = np.vstack([first.hull.normals, _edge_directions(first.hull)])
    pairs = zip(directions, (directions @ first.hull.vertices.T).max(axis=1), strict=True)
    return [_least_height(local, _scalars(along), (0.0, 0.0, 0.0), rounding) - float(offset) for along, offset in pairs]


def _edge_directions(hull: Hull) -> Array:
    """Return the bisectors, (k, 3), of the normals of faces that meet at a sharp edge or corner of a hull.

    All normals at a sharp edge or corner differ by more than pi/4. Beyond an edge whose faces' normals differ by an
    angle a, the normals alone see at most cos(a/2) of a distance.
    """
    a, b, c = (hull.vertices[hull.faces[:, k]] for k in range(3))
    face = (np.cross(b - a, c - a) @ hull.normals.T).argmax(axis=1)
    meeting: dict[tuple[int, ...], set[int]] = {}
    for corners, own in zip(hull.faces.tolist(), face.tolist(), strict=True):
        for k in range(3):
            meeting.setdefault((corners[k],), set()).add(own)
            meeting.setdefault(tuple(sorted((corners[k], corners[k - 1]))), set()).add(own)
    directions = []
    for faces in sorted({tuple(sorted(each)) for each in meeting.values() if len(each) > 1}):
        normals = hull.normals[list(faces)]
        if (normals @ normals.T)[np.triu_indices(len(faces), 1)].max() < cos(pi / 4):
            middle = normals.sum(axis=0)
            directions.append(middle / np.linalg.norm(middle))
    return np.array(directions).reshape(-1, 3)


def _in_frame(core: Core, centre: Triple, axes: Sequence[Triple]) -> Core:
    """Transform a segment, box or hull of distance formulas to coordinates of a frame with given centre and axes."""
    if isinstance(core, SegmentCore):
        return SegmentCore(tuple(in_axes(subtract(point, centre), axes) for point in core.points))
    assert not isinstance(core, PlaneCore)
    place = in_axes(subtract(core.centre, centre), axes)
    return core._replace(centre=place, axes=tuple(in_axes(axis, axes) for axis in core.axes))
