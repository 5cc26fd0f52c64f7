"""Signed distance of two shapes as an expression, for constraints, indices and reports.

Between spheres, capsules, boxes and half-spaces it is exact: the distance of the nearest points, and where the shapes
overlap minus the least translation that parts them. With meshes and cylinders it is a bound from below, the largest gap
along the normals of their faces and half-way between those that meet in a sharp edge or corner.

A shape is a core of points, swelled. Where cores are apart by d their distance is d; where they overlap it is the
largest of the gaps along the directions that may separate them (faces, edge by edge), which is then negative and the
depth of polytopes. That gap is never more than d, and positive exactly where the cores are apart, so d + min(gap, 0) is
both.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache, reduce
from math import cos, log, pi
from typing import Any, NamedTuple, TypeAlias

import casadi as ca
import numpy as np

from models.arrays import Array, checked_array, checked_instance, checked_nonnegative, checked_number
from models.errors import ModelError
from models.input_files import INPUT_LIMITS
from models.shapes.cores import (
    Block,
    Hold,
    Rod,
    Triple,
    add,
    beside_block,
    between_rods,
    cross,
    dot,
    free,
    highest,
    into,
    size_of,
    subtract,
    triple,
)
from models.shapes.hull import Hull
from models.shapes.shapes import Box, Capsule, Cylinder, HalfSpace, Mesh, Shape, Sphere, checked_shape
from models.spatial import Expression, Frame, expression, on_scalars


class Solid(NamedTuple):
    """Core of a mesh or a cylinder: a hull in axes of its own."""

    centre: Triple
    axes: tuple[Triple, ...]
    hull: Hull


class Plane(NamedTuple):
    """A half-space."""

    point: Triple
    normal: Triple


Core: TypeAlias = Rod | Block | Solid | Plane

COLUMNS: dict[type[Shape], int] = {Sphere: 4, Capsule: 7, Box: 15, HalfSpace: 6}
"""Entries of the column of a shape of each kind that has one."""
VECTORS: dict[type[Shape], tuple[int, int]] = {Sphere: (1, 0), Capsule: (2, 0), Box: (1, 3), HalfSpace: (1, 1)}
"""How many points a column begins with, and how many directions follow these."""


def distance(
    one: Shape, other: Shape, one_frame: Frame | None = None, other_frame: Frame | None = None, *, rounding: float = 0.0
) -> Expression:
    """Signed distance of two shapes, m. Shape (1, 1). Negative where they overlap; its gradient leads apart.

    Without rounding it is exact for spheres, capsules, boxes and half-spaces, and for a mesh or a cylinder (as its
    prism) beside a half-space; other pairs with a mesh or a cylinder get the largest gap along the normals of their
    faces, which is never more than the distance.

    The exact distance of capsules and boxes has a gradient with kinks: where segments are parallel the nearest points
    jump from end to end, and a method that builds on second derivatives goes back and forth there. With rounding e > 0
    it is a bound from below that such a method, an interior-point one, converges on: the form that planners use. The
    squared distance is minimised over places s, t in 0..1 along the segments with e^2 ((s - 1/2)^2 + (t - 1/2)^2) added
    to it. That is strictly convex, so places and gradient are Lipschitz. The added term is at most c = e^2/2, or e^2/4
    with one segment: the minimum M lies in d^2..d^2 + c, and (M - c)/sqrt(M + c) is at most d, smooth, and without the
    infinite slope of sqrt(M - c). For capsules the bound is short of the distance by at most 0.84 e, and by at most
    e^2/d where their cores, segments and boxes, are d apart; beside a mesh, a cylinder or a half-space it is at most
    3 e lower than without. Of two boxes it is at most 4 e lower than the largest of their gaps along 15 directions and
    of the distances of either one to the box around the other along its axes: than the distance itself where they are
    aligned, overlap, or are nearest with a face or across two edges. Kinks are rounded off over heights of about e^2/d,
    so an e of a fifth of the radii is good and a hundredth is none. Where d is less than 2 e directions swap as without
    rounding. Spheres beside spheres, capsules and boxes need none and get none.

    Args:
        one, other: In world, or in the frames.
        one_frame, other_frame: Where the frames of the two are. Numbers, SX or MX; None for world. Many pairs of the
            same frames share much: ca.cse takes it out of the graph.
        rounding: e, m.

    Raises:
        ModelError: Something that is no shape, two half-spaces, a box without ends, a frame that is none, a rounding
            that is negative.
    """
    checked_shape(one, "distance", "one")
    checked_shape(other, "distance", "other")
    if {type(one), type(other)} <= COLUMNS.keys():
        function = pair_function(type(one), type(other), rounding)
        return function(column(one, one_frame), column(other, other_frame))
    checked_nonnegative(rounding, "distance", "rounding", "m")
    places = [*_placement(one_frame, "one_frame"), *_placement(other_frame, "other_frame")]
    return expression(_with_hulls(*places, one=one, other=other, rounding=float(rounding)))


def column(shape: Shape, frame: Frame | None = None) -> Expression:
    """A sphere, capsule, box or half-space in world as a column of numbers or expressions, for `pair_function`.

    Sphere: position, radius. Capsule: start, end, radius. Box: position, its three axes, half of its edges. Half-space:
    point, normal. Shapes (4, 1), (7, 1), (15, 1), (6, 1).

    Raises:
        ModelError: A mesh or a cylinder, which have none; what distance does not take.
    """
    checked_shape(shape, "column", "shape")
    _checked_simple(type(shape), "shape")
    turn, place = _placement(frame, "frame")
    if isinstance(shape, Sphere | Capsule):
        return ca.vertcat(*(place + ca.mtimes(turn, ca.DM(point)) for point in shape.core), shape.radius)
    if isinstance(shape, HalfSpace):
        return ca.vertcat(place + ca.mtimes(turn, ca.DM(shape.point)), ca.mtimes(turn, ca.DM(shape.normal)))
    assert isinstance(shape, Box)
    half = checked_array(shape.size, (3,), "distance", "size", unit="m") / 2
    return ca.vertcat(
        place + ca.mtimes(turn, ca.DM(shape.position)), ca.vec(ca.mtimes(turn, ca.DM(shape.rotation))), half
    )


def pair_function(one: type[Shape], other: type[Shape], rounding: float = 0.0) -> Any:
    """Function (column of one, column of other) -> `distance` of two shapes of these kinds.

    Many pairs are many columns side by side: `pair_function(Capsule, Box).map(n)`. One small function that is called
    often is several times faster, compiled and to compile, than all pairs written out in one graph.

    Raises:
        ModelError: A mesh or a cylinder, two half-spaces, a rounding that is negative.
    """
    for what, kind in (("one", one), ("other", other)):
        _checked_simple(kind, what)
    checked_nonnegative(rounding, "distance", "rounding", "m")
    if one is HalfSpace and other is HalfSpace:
        raise ModelError("distance: two half-spaces have none", name="other", value=other)
    return _pair_function((one, other), float(rounding))


def pair_wrenches(one: type[Shape], other: type[Shape], rounding: float, count: int) -> Any:
    """Function (columns of ones, columns of others) -> distances of n pairs side by side, and their wrenches.

    Of the columns, one pair a row, shapes (n, COLUMNS[kind]), distances (n, 1), m, and wrenches (n, 6): (moment about
    the world's origin, force) w, with which a distance grows at the rate w . (twist of one - twist of other), twists
    being (angular, linear at the world's origin). Nearest points move along the shapes without changing the distance,
    so that only the places of points of the shapes are differentiated (envelope theorem). The operations are those of
    columns as wholes, which an interpreter does several times faster than pair after pair.

    Args:
        one, other, rounding: As of `pair_function`. count: n.

    Raises:
        ModelError: As of `pair_function`.
    """
    pair_function(one, other, rounding)
    return _pair_wrenches((one, other), float(rounding), count)


@cache
def _pair_function(kinds: tuple[Any, Any], rounding: float) -> Any:
    columns = [ca.SX.sym(kind.__name__, COLUMNS[kind]) for kind in kinds]
    gap = _of_columns(kinds, list(map(ca.vertsplit, columns)), rounding, free)
    return ca.Function("_".join(kind.__name__ for kind in kinds), columns, [ca.cse(gap)])


@cache
def _pair_wrenches(kinds: tuple[Any, Any], rounding: float, count: int) -> Any:
    given = [ca.MX.sym(kind.__name__, count, COLUMNS[kind]) for kind in kinds]
    # the derivative by the shape of fewer numbers tells the wrench
    side = 0 if COLUMNS[kinds[0]] <= COLUMNS[kinds[1]] else 1
    points, directions = VECTORS[kinds[side]]
    rows = [ca.horzsplit(each) for each in given]
    hold = Held()
    vectors = hold(given[side][:, : 3 * (points + directions)])
    own = ca.horzsplit(vectors)
    rows[side][: len(own)] = own
    gap = _of_columns(kinds, rows, rounding, hold)
    slopes = ca.horzsplit(ca.gradient(ca.sum1(gap), vectors))
    moment, force = (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)
    for k in range(points + directions):
        arm, slope = triple(own[3 * k : 3 * k + 3]), triple(slopes[3 * k : 3 * k + 3])
        moment = add(moment, cross(arm, slope))
        force = add(force, slope) if k < points else force
    wrench = ca.horzcat(*(part if side == 0 else -part for part in (*moment, *force)))
    return ca.Function("wrenches", given, ca.cse(hold.released([gap, wrench])))


class Held:
    """Numbers that a derivative takes for constants: symbols, until they are released.

    Where a distance is the least over places, or the largest over directions, these do not move it (envelope theorem).
    """

    def __init__(self) -> None:
        self._symbols: list[Expression] = []
        self._values: list[Expression] = []

    def __call__(self, value: Expression) -> Expression:
        """A symbol in the place of a value, which may hold other symbols."""
        if not isinstance(value, ca.MX) or value.is_constant():
            return value
        self._symbols.append(ca.MX.sym("held", value.shape))
        self._values.append(value)
        return self._symbols[-1]

    def released(self, expressions: list[Expression]) -> list[Expression]:
        """Expressions with the values in the places of the symbols."""
        return list(ca.substitute_inplace(self._symbols, self._values, expressions)[1])


def soft_minimum(values: Sequence[Expression], width: float) -> Expression:
    """A smooth lower bound of the least of n values, at most width log(n) below it. Shape (1, 1).

    Raises:
        ModelError: No value, or a width that is not positive.
    """
    if not isinstance(values, list | tuple) or not 0 < len(values) <= INPUT_LIMITS.count:
        message = f"soft_minimum of no values, or not of a list of at most {INPUT_LIMITS.count}: {repr(values)[:80]}"
        raise ModelError(message, name="values", value=values, limit=INPUT_LIMITS.count)
    checked_number(width, "soft_minimum", "width", positive=True)
    for value in values:
        if not isinstance(value, ca.SX | ca.MX | ca.DM):
            checked_number(value, "soft_minimum", "values")
        elif value.shape != (1, 1):
            message = f"soft_minimum: values must be numbers, not of shape {value.shape}"
            raise ModelError(message, name="values", value=value.shape, limit=(1, 1))
    stacked, least = ca.vertcat(*values), reduce(ca.fmin, values)
    return least - width * ca.log(ca.sum1(ca.exp((least - stacked) / width)))


def _placement(frame: Frame | None, what: str) -> tuple[Expression, Expression]:
    if frame is None:
        return ca.DM.eye(3), ca.DM(3, 1)
    checked_instance(frame, tuple, "distance", what)
    parts = tuple(map(expression, frame))
    shapes = [part.shape for part in parts]
    if shapes != [(3, 3), (3, 1)]:
        message = f"distance: {what} has parts of shapes {shapes}, expected (3, 3) and (3, 1)"
        raise ModelError(message, name=what, value=shapes, limit=[(3, 3), (3, 1)])
    if any(isinstance(part, ca.DM) and not part.is_regular() for part in parts):
        raise ModelError(f"distance: {what} is not finite", name=what, value=frame)
    return parts


def _checked_simple(kind: Any, what: str) -> None:
    if not isinstance(kind, type) or kind not in COLUMNS:
        names = ", ".join(known.__name__ for known in COLUMNS)
        raise ModelError(f"distance: {what} must be one of {names}, not {kind!r}", name=what, value=kind, limit=names)


# ---- cores --------------------------------------------------------------------------------------------------------


def _of_columns(kinds: tuple[Any, Any], entries: Sequence[Sequence[Expression]], rounding: float, hold: Hold) -> Any:
    """Signed distance of two shapes of these kinds, written as columns, entry by entry."""
    one, other = map(_core_of, kinds, entries)
    swept_radius = sum(own[-1] for kind, own in zip(kinds, entries, strict=True) if kind in (Sphere, Capsule))
    if isinstance(one, Plane):
        gap = _lowest(other, one.normal, one.point, rounding)
    elif isinstance(other, Plane):
        gap = _lowest(one, other.normal, other.point, rounding)
    elif isinstance(one, Rod) and isinstance(other, Rod):
        gap = between_rods(one, other, rounding, hold)
    else:
        core, block = (one, other) if isinstance(other, Block) else (other, one)
        assert isinstance(core, Rod | Block)
        assert isinstance(block, Block)
        gap = beside_block(core, block, rounding, hold)
    return gap - swept_radius


@on_scalars
def _with_hulls(*places: Expression, one: Shape, other: Shape, rounding: float) -> Expression:
    """Signed distance of two shapes, one of them a mesh or a cylinder, in frames (turn, place, turn, place)."""
    first, second = _core(one, *places[:2]), _core(other, *places[2:])
    if isinstance(first, Plane):
        gap = _lowest(second, first.normal, first.point, rounding)
    elif isinstance(second, Plane):
        gap = _lowest(first, second.normal, second.point, rounding)
    else:
        gap = highest([*_gaps(first, second, rounding), *_gaps(second, first, rounding)], rounding, free)
    return gap - (one.swept_radius + other.swept_radius)


def _core(shape: Shape, turn: Expression, place: Expression) -> Core:
    if type(shape) in COLUMNS:
        return _core_of(type(shape), list(map(_number, ca.vertsplit(column(shape, Frame(turn, place))))))
    assert isinstance(shape, Mesh | Cylinder)
    axes = ca.horzsplit(ca.mtimes(turn, ca.DM(shape.rotation)))
    return Solid(_scalars(place + ca.mtimes(turn, ca.DM(shape.position))), tuple(map(_scalars, axes)), shape.hull)


def _core_of(kind: type[Shape], entries: Sequence[Expression]) -> Core:
    """The core of a shape of this kind that is written as a column, entry by entry."""
    parts = [triple(entries[3 * k : 3 * k + 3]) for k in range(len(entries) // 3)]
    if kind is Box:
        return Block(parts[0], tuple(parts[1:4]), parts[4])
    return Plane(parts[0], parts[1]) if kind is HalfSpace else Rod(tuple(parts))


def _scalars(vector: Expression) -> Triple:
    return triple(_number(expression(vector)[k]) for k in range(3))


def _number(entry: Expression) -> Expression:
    """A scalar, as a float where it is known."""
    return float(entry) if entry.is_constant() else entry


# ---- half-spaces and hulls ------------------------------------------------------------------------------------------


def _lowest(core: Core, normal: Triple, point: Triple, rounding: float) -> Expression:
    """Least height of a core above a plane, or a smooth lower bound, at most `rounding` below."""
    if isinstance(core, Rod):
        heights = [dot(normal, subtract(end, point)) for end in core.points]
        middle, reaches = sum(heights) / len(heights), [(heights[-1] - heights[0]) / 2][: len(heights) - 1]
    else:
        assert not isinstance(core, Plane)
        middle, shares = dot(normal, subtract(core.centre, point)), into(normal, core.axes)
        if isinstance(core, Solid):
            return middle + _least([dot(shares, _scalars(vertex)) for vertex in core.hull.vertices], rounding)
        reaches = [h * share for h, share in zip(core.half, shares, strict=True)]
    slack = rounding / len(reaches) if reaches else 0.0
    return middle - sum(size_of(reach, slack) for reach in reaches)


def _least(values: Sequence[Expression], rounding: float) -> Expression:
    """The least of values, or a smooth lower bound of it, at most `rounding` below."""
    if rounding == 0 or len(values) == 1:
        return reduce(ca.fmin, values)
    return soft_minimum(values, rounding / log(len(values)))


def _gaps(one: Core, other: Core, rounding: float) -> list[Expression]:
    """Gaps along the outward normals of one's faces, from one to the other; none of a rod."""
    if isinstance(one, Block):
        signed = [(axis, side, h) for axis, h in zip(one.axes, one.half, strict=True) for side in (-1.0, 1.0)]
        normals = [(triple(side * part for part in axis), h) for axis, side, h in signed]
        return [_lowest(other, normal, one.centre, rounding) - h for normal, h in normals]
    if not isinstance(one, Solid):
        return []
    seen = _seen(other, one.centre, one.axes)
    directions = np.vstack([one.hull.normals, _across_edges(one.hull)])
    offsets = (directions @ one.hull.vertices.T).max(axis=1)
    pairs = zip(directions, offsets, strict=True)
    return [_lowest(seen, _scalars(along), (0.0, 0.0, 0.0), rounding) - float(offset) for along, offset in pairs]


def _across_edges(hull: Hull) -> Array:
    """Unit directions half-way between faces that meet in an edge or corner, each two at more than pi/4. Shape (k, 3).

    Past an edge the normals of its two faces, an angle a apart, see cos(a/2) of a distance at most, 92 % at pi/4.
    """
    a, b, c = (hull.vertices[hull.faces[:, k]] for k in range(3))
    face = (np.cross(b - a, c - a) @ hull.normals.T).argmax(axis=1)
    meeting: dict[tuple[int, ...], set[int]] = {}
    for corners, own in zip(hull.faces.tolist(), face.tolist(), strict=True):
        for k in range(3):
            meeting.setdefault((corners[k],), set()).add(own)
            meeting.setdefault(tuple(sorted((corners[k], corners[k - 1]))), set()).add(own)
    found = []
    for faces in sorted({tuple(sorted(each)) for each in meeting.values() if len(each) > 1}):
        normals = hull.normals[list(faces)]
        if (normals @ normals.T)[np.triu_indices(len(faces), 1)].max() < cos(pi / 4):
            middle = normals.sum(axis=0)
            found.append(middle / np.linalg.norm(middle))
    return np.array(found).reshape(-1, 3)


def _seen(core: Core, centre: Triple, axes: Sequence[Triple]) -> Core:
    """The core in these axes from this centre."""
    if isinstance(core, Rod):
        return Rod(tuple(into(subtract(point, centre), axes) for point in core.points))
    assert not isinstance(core, Plane)
    place = into(subtract(core.centre, centre), axes)
    return core._replace(centre=place, axes=tuple(into(axis, axes) for axis in core.axes))
