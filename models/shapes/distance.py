"""Signed distance of two shapes as an expression, for constraints, indices, proofs and reports.

Between spheres, capsules, boxes and half-spaces it is exact: the way between the nearest points, and where the shapes
overlap minus the least way that parts them. With meshes and cylinders it is a bound from below, the largest gap along
the normals of their faces and half-way between those that meet in a sharp edge or corner.

A shape is a core of points, swelled. Where cores are apart by d their distance is d; where they overlap it is the
largest of the gaps along the directions that may separate them (faces, edge by edge), which is then negative and the
depth of polytopes. That gap is never more than d, and positive exactly where the cores are apart, so d + min(gap, 0) is
both.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from functools import cache, reduce
from itertools import product
from math import cos, log, pi
from typing import Any, NamedTuple, TypeAlias

import casadi as ca
import numpy as np

from models.arrays import MOST, Array, checked_array, checked_instance, checked_nonnegative, checked_number
from models.errors import ModelError
from models.shapes.hull import Hull
from models.shapes.shapes import Box, Capsule, HalfSpace, Shape, Sphere, checked_shape
from models.spatial import Expression, Frame, expression, on_scalars

Triple: TypeAlias = tuple[Expression, Expression, Expression]
"""A vector as three scalars, floats where they are known: products with their zeros and ones vanish from the graph."""

KINK = 1e-12
"""m: what rounds off the kink of an exact distance at zero."""
PARALLEL = 1e-13
"""Squared sine of an angle: segments at less are parallel, which costs at most 3e-7 of their length."""
NO_EDGE = 1e-18
"""Squared sine of an angle: edges at less span no direction that could separate."""
SHARP = pi / 4
"""rad: between the normals of faces; past their edge these alone see 8 % too little of a distance."""
BARRED = 1e9
"""m: taken from the gap along a direction that is none."""
GRAIN = 2.0**53
"""Steps of a segment at which its piece is looked up."""


class Rod(NamedTuple):
    """Core of a sphere or a capsule: one point or two."""

    points: tuple[Triple, ...]


class Block(NamedTuple):
    """Core of a box: its centre, its axes, half of its edges."""

    centre: Triple
    axes: tuple[Triple, Triple, Triple]
    half: Triple


class Solid(NamedTuple):
    """Core of a mesh or a cylinder: a hull in axes of its own."""

    centre: Triple
    axes: tuple[Triple, Triple, Triple]
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
    checked_nonnegative(rounding, "distance", "rounding", "m")
    if isinstance(one, HalfSpace) and isinstance(other, HalfSpace):
        raise ModelError("distance: two half-spaces have none", name="other", value=other)
    places = [*_placement(one_frame, "one_frame"), *_placement(other_frame, "other_frame")]
    if any(isinstance(part, ca.MX) for part in places) and {type(one), type(other)} <= COLUMNS.keys():
        columns = column(one, Frame(*places[:2])), column(other, Frame(*places[2:]))
        return pair_function(type(one), type(other), float(rounding))(*columns)
    return expression(_written_out(*places, one=one, other=other, rounding=float(rounding)))


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
    centre, axes = place + ca.mtimes(turn, ca.DM(shape.position)), ca.mtimes(turn, ca.DM(shape.rotation))
    return ca.vertcat(centre, ca.vec(axes), _half(shape))


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


def pair_columns(one: type[Shape], other: type[Shape], rounding: float, count: int) -> Any:
    """Function (columns of ones, columns of others) -> distances (n, 1) of n pairs side by side; as `pair_wrenches`.

    Interpreted it takes a fifth of the time of `pair_function` of one pair after the other.
    """
    pair_function(one, other, rounding)
    return _pair_columns((one, other), float(rounding), count)


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
def _pair_wrenches(kinds: tuple[Any, Any], rounding: float, count: int) -> Any:
    one, other = kinds
    given = [ca.MX.sym(kind.__name__, count, COLUMNS[kind]) for kind in kinds]
    # the derivative by the shape of fewer numbers tells the wrench
    side = 0 if COLUMNS[one] <= COLUMNS[other] else 1
    points, directions = VECTORS[kinds[side]]
    rows = [ca.horzsplit(each) for each in given]
    held = Held()
    vectors = held(given[side][:, : 3 * (points + directions)])
    own = ca.horzsplit(vectors)
    rows[side][: len(own)] = own
    gap = _swelled(kinds, rows, rounding, held)
    slopes = ca.horzsplit(ca.gradient(ca.sum1(gap), vectors))
    moment, force = (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)
    for k in range(points + directions):
        arm, slope = _triple(own[3 * k : 3 * k + 3]), _triple(slopes[3 * k : 3 * k + 3])
        moment = _add(moment, _cross(arm, slope))
        force = _add(force, slope) if k < points else force
    wrench = ca.horzcat(*(part if side == 0 else -part for part in (*moment, *force)))
    return ca.Function("wrenches", given, ca.cse(held.released([gap, wrench])))


class Held:
    """Numbers that a derivative takes for constants: symbols, until they are released.

    Where a distance is the least over places, or the largest over directions, these do not move it (envelope theorem).
    """

    def __init__(self) -> None:
        self._symbols: list[Expression] = []
        self._values: list[Expression] = []

    def __call__(self, value: Expression) -> Expression:
        """A symbol in the place of a value, which may hold other symbols."""
        if not isinstance(value, ca.SX | ca.MX) or value.is_constant():
            return value
        self._symbols.append(type(value).sym("held", value.shape))
        self._values.append(value)
        return self._symbols[-1]

    def tangent(self, value: Expression, arguments: Iterable[Expression], slopes: Iterable[Expression]) -> Expression:
        """A value of arguments, by which it has these slopes."""
        terms = (self(slope) * (x - self(x)) for x, slope in zip(arguments, slopes, strict=True))
        return reduce(lambda a, b: a + b, terms, self(value))

    def released(self, expressions: list[Expression]) -> list[Expression]:
        """Expressions with the values in the places of the symbols."""
        return list(ca.substitute_inplace(self._symbols, self._values, expressions)[1])


@cache
def _pair_columns(kinds: tuple[Any, Any], rounding: float, count: int) -> Any:
    given = [ca.MX.sym(kind.__name__, count, COLUMNS[kind]) for kind in kinds]
    return ca.Function("columns", given, [ca.cse(_swelled(kinds, list(map(ca.horzsplit, given)), rounding))])


@cache
def _pair_function(kinds: tuple[Any, Any], rounding: float) -> Any:
    columns = [ca.SX.sym(kind.__name__, COLUMNS[kind]) for kind in kinds]
    gap = _swelled(kinds, list(map(ca.vertsplit, columns)), rounding)
    return ca.Function("_".join(kind.__name__ for kind in kinds), columns, [ca.cse(gap)])


def _swelled(
    kinds: tuple[Any, Any], entries: Sequence[Sequence[Expression]], rounding: float, held: Held | None = None
) -> Expression:
    """Signed distance of two shapes of these kinds, written as columns, entry by entry."""
    one, other = map(_core_of, kinds, entries)
    gap = _between(one, other, rounding, held)
    for kind, own in zip(kinds, entries, strict=True):
        gap -= own[-1] if kind in (Sphere, Capsule) else 0
    return gap


def soft_minimum(values: Sequence[Expression], width: float) -> Expression:
    """A smooth lower bound of the least of n values, at most width log(n) below it. Shape (1, 1).

    Raises:
        ModelError: No value, or a width that is not positive.
    """
    if not isinstance(values, list | tuple) or not 0 < len(values) <= MOST:
        message = f"soft_minimum of no values, or not of a list of at most {MOST}: {repr(values)[:80]}"
        raise ModelError(message, name="values", value=values, limit=MOST)
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


@on_scalars
def _written_out(
    one_turn: Expression,
    one_place: Expression,
    other_turn: Expression,
    other_place: Expression,
    *,
    one: Shape,
    other: Shape,
    rounding: float,
) -> Expression:
    first, second = _core(one, one_turn, one_place), _core(other, other_turn, other_place)
    return _between(first, second, rounding) - (one.swelling + other.swelling)


def _between(one: Core, other: Core, rounding: float, held: Held | None = None) -> Expression:
    """Signed distance of two cores; if held, derivatives take nearest points and which direction parts for given."""
    if isinstance(one, Plane):
        return _lowest(other, one.normal, one.point, rounding)
    if isinstance(other, Plane):
        return _lowest(one, other.normal, other.point, rounding)
    if isinstance(one, Solid) or isinstance(other, Solid):
        gaps = [*_gaps(one, other, rounding), *_gaps(other, one, rounding)]
        return _highest(gaps, rounding)
    if isinstance(one, Rod) and isinstance(other, Rod):
        return _rods(one, other, rounding, held)
    if isinstance(one, Block) and isinstance(other, Block):
        return _blocks(one, other, rounding, held)
    rod, block = (one, other) if isinstance(other, Block) else (other, one)
    return _rod_block(rod, block, rounding, held)


# ---- cores in world -----------------------------------------------------------------------------------------------


def _core(shape: Shape, turn: Expression, place: Expression) -> Core:
    rows, shift = [_scalars(turn[k, :]) for k in range(3)], _scalars(place)

    def turned(vector: Array) -> Triple:
        return _triple(_dot(row, _scalars(vector)) for row in rows)

    def moved(point: Array) -> Triple:
        return _add(turned(point), shift)

    if isinstance(shape, Sphere | Capsule):
        return Rod(tuple(moved(point) for point in np.unique(shape.core, axis=0)))
    if isinstance(shape, HalfSpace):
        return Plane(moved(shape.point), turned(shape.normal))
    centre, axes = moved(shape.position), _triple(turned(axis) for axis in shape.rotation.T)
    if isinstance(shape, Box):
        return Block(centre, axes, _scalars(_half(shape)))
    return Solid(centre, axes, shape.hull)


def _core_of(kind: type[Shape], entries: Sequence[Expression]) -> Core:
    """The core of a shape of this kind that is written as a column, entry by entry."""
    parts = [_triple(entries[3 * k : 3 * k + 3]) for k in range(len(entries) // 3)]
    if kind is Box:
        return Block(parts[0], (parts[1], parts[2], parts[3]), parts[4])
    return Plane(parts[0], parts[1]) if kind is HalfSpace else Rod(tuple(parts))


def _half(box: Box) -> Array:
    """Half of its edges, m; ModelError where one is infinite."""
    return np.asarray(checked_array(box.size, (3,), "distance", "size", unit="m") / 2)


def _scalars(vector: Expression) -> Triple:
    """Three scalars, as floats where they are numbers."""
    entries = (expression(vector)[k] for k in range(3))
    return _triple(float(entry) if entry.is_constant() else entry for entry in entries)


def _triple(entries: Iterable[Expression]) -> Triple:
    x, y, z = entries
    return x, y, z


def _add(a: Triple, b: Triple) -> Triple:
    return a[0] + b[0], a[1] + b[1], a[2] + b[2]


def _subtract(a: Triple, b: Triple) -> Triple:
    return a[0] - b[0], a[1] - b[1], a[2] - b[2]


def _dot(a: Triple, b: Triple) -> Expression:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def _cross(a: Triple, b: Triple) -> Triple:
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


def _along(a: Triple, step: Expression, direction: Triple) -> Triple:
    return _triple(a[k] + step * direction[k] for k in range(3))


def _into(vector: Triple, axes: tuple[Triple, Triple, Triple]) -> Triple:
    """A vector of world by its shares along three axes."""
    return _dot(axes[0], vector), _dot(axes[1], vector), _dot(axes[2], vector)


def _clip(x: Expression, low: Expression = 0.0, high: Expression = 1.0) -> Expression:
    return ca.fmin(ca.fmax(x, low), high)


# ---- apart: from squares to distances -----------------------------------------------------------------------------


def _root(square: Expression, excess: float, held: Held | None = None) -> Expression:
    """A lower bound of d where d^2 <= square <= d^2 + excess; for no excess d itself."""
    root = ca.sqrt(square + (excess or KINK**2))
    inverse = 1 / root
    away = (square - excess) * inverse if excess else root - KINK
    if held is None:
        return away
    slope = 0.5 * (square + 3 * excess) * inverse**2 * inverse if excess else 0.5 * inverse
    return held.tangent(away, [square], [slope])


def _negative_part(gap: Expression, rounding: float, held: Held | None = None) -> Expression:
    """min(gap, 0), or a smooth lower bound of it, at most rounding/4 below; from a gap of `rounding` on it is zero."""
    if rounding == 0:
        low = ca.fmin(gap, 0)
        return low if held is None else held.tangent(low, [gap], [gap < 0])
    over = _clip(rounding - gap, 0.0, 2 * rounding)
    low = ca.fmin(gap + rounding, 0) - over**2 * (0.25 / rounding)
    return low if held is None else held.tangent(low, [gap], [over * (0.5 / rounding)])


def _positive_part(gap: Expression, rounding: float, held: Held | None = None) -> Expression:
    """A smooth lower bound of max(gap, 0), at most rounding/2 below; up to a gap of zero it is zero."""
    within = _clip(gap, 0.0, rounding)
    high = ca.fmax(gap - rounding, 0) + within**2 * (0.5 / rounding)
    return high if held is None else held.tangent(high, [gap], [within * (1 / rounding)])


def _highest(gaps: Sequence[Expression], rounding: float, held: Held | None = None) -> Expression:
    """The largest of gaps, or a smooth lower bound of it, at most `rounding` below."""
    most = reduce(ca.fmax, gaps)
    if rounding == 0 or len(gaps) == 1:
        return most if held is None else held.tangent(most, gaps, _first(gaps, most))
    width = rounding / log(len(gaps))
    shares = [ca.exp((gap - most) * (1 / width)) for gap in gaps]
    whole = sum(shares)
    high = most + width * ca.log(whole) - rounding
    return high if held is None else held.tangent(high, gaps, [share * (1 / whole) for share in shares])


def _first(values: Sequence[Expression], chosen: Expression) -> list[Expression]:
    """1 for the first of values that is the chosen one, 0 for the others."""
    left, found = 1.0, []
    for value in values[:-1]:
        found.append(left * (value == chosen))
        left = left - found[-1]
    return [*found, left]


def _least(values: Sequence[Expression], rounding: float) -> Expression:
    """The least of values, or a smooth lower bound of it, at most `rounding` below."""
    if rounding == 0 or len(values) == 1:
        return reduce(ca.fmin, values)
    return soft_minimum(values, rounding / log(len(values)))


# ---- rods ---------------------------------------------------------------------------------------------------------


def _rods(one: Rod, other: Rod, rounding: float, held: Held | None) -> Expression:
    """Distance of points and segments; that of crossing segments is 0, which is their depth."""
    if len(one.points) < len(other.points):
        one, other = other, one
    p, q = one.points[0], other.points[0]
    gap = _subtract(p, q)
    if len(one.points) == 1:
        return _root(_dot(gap, gap), 0.0, held)
    u = _subtract(one.points[1], p)
    if len(other.points) == 1:
        s = _clip(-_dot(u, gap) / (_dot(u, u) + KINK**2))
        apart = _along(gap, held(s) if held else s, u)
        return _root(_dot(apart, apart), 0.0, held)
    v = _subtract(other.points[1], q)
    weight = rounding**2
    square = _segments(gap, u, v, weight, held)
    return _root(square, weight / 2, held)


def _segments(gap: Triple, u: Triple, v: Triple, weight: float, held: Held | None) -> Expression:
    """Least over s, t in 0..1 of |gap + s u - t v|^2 + weight ((s - 1/2)^2 + (t - 1/2)^2).

    s of the whole plane, cut to 0..1; then the best t for it, cut; then the best s for that (Ericson, Real-Time
    Collision Detection, 2005, 5.1.9).
    """
    a, e, b = _dot(u, u) + weight + KINK**2, _dot(v, v) + weight + KINK**2, _dot(u, v)
    c, f = _dot(u, gap) - weight / 2, _dot(v, gap) + weight / 2
    s = _clip((b * f - c * e) / ca.fmax(a * e - b * b, PARALLEL * a * e))
    t = _clip((b * s + f) / e)
    s = _clip((b * t - c) / a)
    s, t = (held(s), held(t)) if held else (s, t)
    apart = _along(_along(gap, s, u), -t, v)
    square = _dot(apart, apart)
    return square + weight * ((s - 0.5) ** 2 + (t - 0.5) ** 2) if weight else square


# ---- rods and boxes -----------------------------------------------------------------------------------------------


def _rod_block(rod: Core, block: Core, rounding: float, held: Held | None) -> Expression:
    assert isinstance(rod, Rod)
    assert isinstance(block, Block)
    ends = [_into(_subtract(point, block.centre), block.axes) for point in rod.points]
    p = ends[0]
    if len(ends) == 1:
        outside = _outside(p, block.half, held)
        gap = _highest([ca.fabs(x) - h for x, h in zip(p, block.half, strict=True)], 0.0, held)
        return _root(_dot(outside, outside), 0.0, held) + _negative_part(gap, 0.0, held)
    u = _subtract(ends[1], p)
    middle, weight = _along(p, 0.5, u), rounding**2
    gap = _segment_box_gap(middle, u, block.half, held)
    square = _segment_box(middle, u, block.half, weight, held)
    if rounding == 0:  # what the rounding of numbers leaves of it has slopes where they overlap
        square = square * (gap > 0)
    return _root(square, weight / 4, held) + _negative_part(gap, rounding, held)


def _outside(x: Triple, half: Triple, held: Held | None) -> Triple:
    """The way to a point from the nearest one of a box, in the box's axes."""
    nearest = _triple(_clip(part, -h, h) for part, h in zip(x, half, strict=True))
    return _subtract(x, _triple(map(held, nearest)) if held else nearest)


def _segment_box(middle: Triple, u: Triple, half: Triple, weight: float, held: Held | None) -> Expression:
    """Least over s in -1/2..1/2 of the squared distance of middle + s u to a box plus weight s^2, in the box's axes.

    Half of its derivative is weight s and of each axis u_k (x_k - what x_k is cut to by the box), which is zero while
    x_k is within the box and straight before and after. First the axis is added that is farthest in s from there where
    s = 0; then that of the others that is farthest where the first leads to; then the last, if it is beyond where these
    lead to. What is added later pulls no farther than an axis that was added is straight: the least is found in three
    steps. The places that are looked at are kept from differentiation: held, or by a floor.
    """
    sizes, squares = _triple(ca.fabs(part) + KINK for part in u), _triple(part * part for part in u)
    s, pull, rise = 0.0, 0.0, weight + KINK**2
    left: Sequence[Expression] = (1.0, 1.0, 1.0)
    for step in range(3):
        x = _along(middle, s, u)
        nearest = _triple(_clip(part, -h, h) for part, h in zip(x, half, strict=True))
        over = _triple(keep * (part - near) for keep, part, near in zip(left, x, nearest, strict=True))
        added = _farthest(over, sizes) if step < 2 else (1.0, 1.0, 1.0)
        for k in range(3):
            taken = added[k] * (over[k] != 0) if step else added[k]
            pull, rise = pull + taken * (u[k] * (middle[k] - nearest[k])), rise + taken * squares[k]
        left = [keep * (1 - taken) for keep, taken in zip(left, added, strict=True)]
        s = _clip(-pull / rise, -0.5, 0.5)
        if held:
            s = held(s)
        elif step < 2:
            s = _placed(s)
    outside = _outside(_along(middle, s, u), half, held)
    square = _dot(outside, outside)
    return square + weight * s**2 if weight else square


def _placed(s: Expression) -> Expression:
    """A place along a segment, without derivatives; the grid is so fine that the distance there is the same."""
    return ca.floor(s * GRAIN) / GRAIN


def _farthest(over: Triple, sizes: Triple) -> list[Expression]:
    """1 for one of three with the largest |over| / size, 0 for the others."""
    a, b, c = (ca.fabs(x) for x in over)
    first = (a * sizes[1] >= b * sizes[0]) * (a * sizes[2] >= c * sizes[0])
    second = (1 - first) * (b * sizes[2] >= c * sizes[1])
    return [first, second, 1 - first - second]


def _segment_box_gap(middle: Triple, u: Triple, half: Triple, held: Held | None = None) -> Expression:
    """Largest gap between a segment about a middle and a box along the faces' normals and those to u and an edge."""
    size = _triple(ca.fabs(part) for part in u)
    gaps = [ca.fabs(middle[k]) - size[k] / 2 - half[k] for k in range(3)]
    squares = _triple(part * part for part in u)
    whole = sum(squares)
    for i, j in ((0, 1), (1, 2), (2, 0)):
        reach = half[i] * size[j] + half[j] * size[i]
        gap = ca.fabs(middle[i] * u[j] - middle[j] * u[i]) - reach
        gaps.append(_per_length(gap, squares[i] + squares[j], NO_EDGE * whole, held))
    return _highest(gaps, 0.0, held)


def _per_length(gap: Expression, square: Expression, least: Expression, held: Held | None = None) -> Expression:
    """The gap along a vector of this squared length, where that is more than the least; else far below all others."""
    length = ca.sqrt(square + 1e-60)
    inverse = 1 / length
    share = gap * inverse
    known = share if held is None else held.tangent(share, [gap, square], [inverse, -0.5 * share * inverse**2])
    return known - BARRED * (square <= least)


# ---- two boxes ----------------------------------------------------------------------------------------------------


def _blocks(one: Block, other: Block, rounding: float, held: Held | None) -> Expression:
    """The largest gap along 15 directions where they overlap, else the least of the distances of the 12 edges of one to
    the other and of the 8 corners of that to the first.

    These suffice: from a nearest point within a face of the first one gets, along that face, to a corner of the other
    or to an edge. Rounded, which an interior-point method differentiates twice at every point of a motion, it is a
    bound without the edges, in a fifth of the operations: each box, too, beside the box around the other along its
    axes.
    """
    if rounding == 0:
        gap = _highest(_block_gaps(one, other, 0.0, held), 0.0, held)
        squares = [*_edges_to(one, other, held), *_corners_to(other, one, held)]
        square = reduce(ca.fmin, squares)
        square = square if held is None else held.tangent(square, squares, _first(squares, square))
        return _root(square * (gap > 0), 0.0, held) + _negative_part(gap, 0.0, held)
    gaps = _block_gaps(one, other, rounding / sum((*one.half, *other.half)), held)
    gap = _highest(gaps, rounding, held)
    away = [_positive_part(gap, rounding, held)]
    for along in (gaps[:3], gaps[3:6]):
        square = sum(_positive_part(each, rounding, held) ** 2 for each in along)
        length = ca.sqrt(square + rounding**2)
        away.append((length if held is None else held.tangent(length, [square], [0.5 / length])) - rounding)
    return _highest(away, rounding, held) + _negative_part(gap, rounding, held)


def _edges_to(one: Block, other: Block, held: Held | None) -> list[Expression]:
    """Squares of the distances of the edges of one box to another."""
    centre, reaches = _in_axes_of(one, other)
    found = []
    for k, (i, j) in enumerate(((1, 2), (2, 0), (0, 1))):
        direction = _triple(2 * part for part in reaches[k])
        for side, back in product((-1.0, 1.0), repeat=2):
            middle = _along(_along(centre, side, reaches[i]), back, reaches[j])
            found.append(_segment_box(middle, direction, other.half, 0.0, held))
    return found


def _corners_to(one: Block, other: Block, held: Held | None) -> list[Expression]:
    """Squares of the distances of the corners of one box to another."""
    centre, (x, y, z) = _in_axes_of(one, other)
    found = []
    for signs in product((-1.0, 1.0), repeat=3):
        corner = _along(_along(_along(centre, signs[0], x), signs[1], y), signs[2], z)
        outside = _outside(corner, other.half, held)
        found.append(_dot(outside, outside))
    return found


def _in_axes_of(one: Block, other: Block) -> tuple[Triple, list[Triple]]:
    """Centre and half edges of one box in another's axes."""
    centre = _into(_subtract(one.centre, other.centre), other.axes)
    return centre, [_triple(h * part for part in _into(a, other.axes)) for a, h in zip(one.axes, one.half, strict=True)]


def _block_gaps(one: Block, other: Block, slack: Expression, held: Held | None) -> list[Expression]:
    """Gaps of two boxes along their 6 axes and the 9 across an edge of each (Gottschalk, Lin & Manocha 1996).

    With slack the sizes of cosines, which have kinks where boxes are aligned, are rounded up by as much at most.
    """
    gap = _into(_subtract(other.centre, one.centre), one.axes)
    shares = [_into(axis, one.axes) for axis in other.axes]  # shares[j][i]: of axis j of the other along axis i
    sizes = [_triple(_size(share, slack) for share in row) for row in shares]
    found = [ca.fabs(gap[i]) - one.half[i] - sum(other.half[j] * sizes[j][i] for j in range(3)) for i in range(3)]
    found += [ca.fabs(_dot(gap, shares[j])) - other.half[j] - _dot(one.half, sizes[j]) for j in range(3)]
    for i, j in product(range(3), repeat=2):
        i1, i2, j1, j2 = (i + 1) % 3, (i + 2) % 3, (j + 1) % 3, (j + 2) % 3
        reach = one.half[i1] * sizes[j][i2] + one.half[i2] * sizes[j][i1]
        reach += other.half[j1] * sizes[j2][i] + other.half[j2] * sizes[j1][i]
        across = ca.fabs(gap[i2] * shares[j][i1] - gap[i1] * shares[j][i2]) - reach
        found.append(_per_length(across, shares[j][i1] ** 2 + shares[j][i2] ** 2, NO_EDGE, held))
    return found


def _size(x: Expression, slack: Expression) -> Expression:
    """|x|, or a smooth upper bound of it, at most the slack above."""
    return ca.fabs(x) if isinstance(slack, float) and slack == 0 else ca.sqrt(x * x + slack * slack)


# ---- planes -------------------------------------------------------------------------------------------------------


def _gaps(one: Core, other: Core, rounding: float) -> list[Expression]:
    """Gaps along the outward normals of one's faces, from one to the other; none of a rod."""
    if isinstance(one, Block):
        signed = [(axis, side, h) for axis, h in zip(one.axes, one.half, strict=True) for side in (-1.0, 1.0)]
        normals = [(_triple(side * part for part in axis), h) for axis, side, h in signed]
        return [_lowest(other, normal, one.centre, rounding) - h for normal, h in normals]
    if not isinstance(one, Solid):
        return []
    seen = _seen(other, one.centre, one.axes)
    centre = (0.0, 0.0, 0.0)
    directions = np.vstack([one.hull.normals, _across_edges(one.hull)])
    offsets = (directions @ one.hull.vertices.T).max(axis=1)
    pairs = zip(directions, offsets, strict=True)
    return [_lowest(seen, _scalars(along), centre, rounding) - float(offset) for along, offset in pairs]


def _across_edges(hull: Hull) -> Array:
    """Unit directions half-way between faces that meet in an edge or corner, each two at more than SHARP. Shape (k, 3).

    Past an edge the normals of its two faces, an angle a apart, see no more than cos(a/2) of a distance.
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
        if (normals @ normals.T)[np.triu_indices(len(faces), 1)].max() < cos(SHARP):
            middle = normals.sum(axis=0)
            found.append(middle / np.linalg.norm(middle))
    return np.array(found).reshape(-1, 3)


def _seen(core: Core, centre: Triple, axes: tuple[Triple, Triple, Triple]) -> Core:
    """The core in these axes from this centre."""
    if isinstance(core, Rod):
        return Rod(tuple(_into(_subtract(point, centre), axes) for point in core.points))
    assert not isinstance(core, Plane)
    place = _into(_subtract(core.centre, centre), axes)
    return core._replace(centre=place, axes=_triple(_into(axis, axes) for axis in core.axes))


def _lowest(core: Core, normal: Triple, point: Triple, rounding: float) -> Expression:
    """Least height of a core above a plane, or a smooth lower bound, at most `rounding` below."""
    if isinstance(core, Rod):
        heights = [_dot(normal, _subtract(end, point)) for end in core.points]
        if rounding == 0 or len(heights) == 1:
            return reduce(ca.fmin, heights)
        low, high = heights
        return (low + high - ca.sqrt((high - low) ** 2 + (2 * rounding) ** 2)) / 2
    assert not isinstance(core, Plane)
    middle = _dot(normal, _subtract(core.centre, point))
    shares = _into(normal, core.axes)
    if isinstance(core, Block):
        reaches = [h * share for h, share in zip(core.half, shares, strict=True)]
        if rounding == 0:
            return middle - sum(ca.fabs(reach) for reach in reaches)
        return middle - sum(ca.sqrt(reach * reach + (rounding / 3) ** 2) for reach in reaches)
    return middle + _least([_dot(shares, _scalars(vertex)) for vertex in core.hull.vertices], rounding)
