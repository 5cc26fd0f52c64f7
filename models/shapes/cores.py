"""Signed distances of points, segments and boxes as expressions: the cores of shapes.

Where cores are apart it is the root of the least square over the places on them; where they overlap it is the largest
of the gaps along the directions that may separate them, minus their depth. Every formula takes scalars or columns of
scalars, and can be rounded from below for methods that build on second derivatives, see `distance`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from functools import reduce
from itertools import product
from math import log
from typing import NamedTuple, TypeAlias

import casadi as ca

from models.spatial import Expression

Triple: TypeAlias = tuple[Expression, Expression, Expression]
"""A vector as three scalars or columns, floats where they are known: products with zeros and ones vanish."""
Hold: TypeAlias = Callable[[Expression], Expression]
"""Takes a value for a constant where a distance is differentiated (`Held`), or does nothing."""

KINK = 1e-12
"""m: what rounds off the kink of an exact distance at zero."""
NO_EDGE = 1e-18
"""Squared sine of an angle: edges at less span no direction that could separate."""


class Rod(NamedTuple):
    """Core of a sphere or a capsule: one point or two."""

    points: tuple[Triple, ...]


class Block(NamedTuple):
    """Core of a box: its centre, its axes, half of its edges."""

    centre: Triple
    axes: tuple[Triple, ...]
    half: Triple


def free(value: Expression) -> Expression:
    """Hold nothing."""
    return value


# ---- vectors -------------------------------------------------------------------------------------------------------


def triple(entries: Iterable[Expression]) -> Triple:
    x, y, z = entries
    return x, y, z


def add(a: Triple, b: Triple) -> Triple:
    return a[0] + b[0], a[1] + b[1], a[2] + b[2]


def subtract(a: Triple, b: Triple) -> Triple:
    return a[0] - b[0], a[1] - b[1], a[2] - b[2]


def dot(a: Triple, b: Triple) -> Expression:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def cross(a: Triple, b: Triple) -> Triple:
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


def along(a: Triple, step: Expression, direction: Triple) -> Triple:
    return triple(a[k] + step * direction[k] for k in range(3))


def into(vector: Triple, axes: Sequence[Triple]) -> Triple:
    """A vector of world by its shares along three axes."""
    return triple(dot(axis, vector) for axis in axes)


def _clip(x: Expression, low: Expression = 0.0, high: Expression = 1.0) -> Expression:
    return ca.fmin(ca.fmax(x, low), high)


# ---- from squares to distances, from gaps to depths -----------------------------------------------------------------


def _root(square: Expression, excess: float = 0.0) -> Expression:
    """A lower bound of d where d^2 <= square <= d^2 + excess; for no excess d itself."""
    root = ca.sqrt(square + (excess or KINK**2))
    return (square - excess) * (1 / root) if excess else root - KINK


def _negative_part(gap: Expression, rounding: float) -> Expression:
    """min(gap, 0), or a smooth lower bound of it, at most rounding/4 below; from a gap of `rounding` on it is zero."""
    if rounding == 0:
        return ca.fmin(gap, 0)
    return ca.fmin(gap + rounding, 0) - _clip(rounding - gap, 0.0, 2 * rounding) ** 2 * (0.25 / rounding)


def _positive_part(gap: Expression, rounding: float) -> Expression:
    """A smooth lower bound of max(gap, 0), at most rounding/2 below; up to a gap of zero it is zero."""
    return ca.fmax(gap - rounding, 0) + _clip(gap, 0.0, rounding) ** 2 * (0.5 / rounding)


def highest(gaps: Sequence[Expression], rounding: float, hold: Hold) -> Expression:
    """The largest of gaps, or a smooth lower bound of it, at most `rounding` below."""
    most = reduce(ca.fmax, gaps)
    if rounding == 0 or len(gaps) == 1:
        return most
    most, width = hold(most), rounding / log(len(gaps))
    return most + width * ca.log(sum(ca.exp((gap - most) * (1 / width)) for gap in gaps)) - rounding


# ---- points and segments --------------------------------------------------------------------------------------------


def between_rods(one: Rod, other: Rod, rounding: float, hold: Hold) -> Expression:
    """Distance of points and segments; that of crossing segments is 0, which is their depth."""
    if len(one.points) < len(other.points):
        one, other = other, one
    p, q = one.points[0], other.points[0]
    gap = subtract(p, q)
    if len(one.points) == 1:
        return _root(dot(gap, gap))
    u = subtract(one.points[1], p)
    if len(other.points) == 1:
        apart = along(gap, hold(_clip(-dot(u, gap) / (dot(u, u) + KINK**2))), u)
        return _root(dot(apart, apart))
    weight = rounding**2
    return _root(_segments(gap, u, subtract(other.points[1], q), weight, hold), weight / 2)


def _segments(gap: Triple, u: Triple, v: Triple, weight: float, hold: Hold) -> Expression:
    """Least over s, t in 0..1 of |gap + s u - t v|^2 + weight ((s - 1/2)^2 + (t - 1/2)^2).

    s of the whole plane, cut to 0..1; then the best t for it, cut; then the best s for that (Ericson, Real-Time
    Collision Detection, 2005, 5.1.9).
    """
    a, e, b = dot(u, u) + weight + KINK**2, dot(v, v) + weight + KINK**2, dot(u, v)
    c, f = dot(u, gap) - weight / 2, dot(v, gap) + weight / 2
    # less than 1e-13 of the squared sine counts as parallel, which costs at most 3e-7 of the length
    s = _clip((b * f - c * e) / ca.fmax(a * e - b * b, 1e-13 * a * e))
    t = _clip((b * s + f) / e)
    s = _clip((b * t - c) / a)
    s, t = hold(s), hold(t)
    apart = along(along(gap, s, u), -t, v)
    square = dot(apart, apart)
    return square + weight * ((s - 0.5) ** 2 + (t - 0.5) ** 2) if weight else square


# ---- beside a box ---------------------------------------------------------------------------------------------------


def beside_block(core: Rod | Block, block: Block, rounding: float, hold: Hold) -> Expression:
    """Distance of a point, a segment or a box to a box: the root of the least square, where the cores are apart, and
    minus their depth, the largest gap along the directions that may separate them.

    Rounded, which an interior-point method differentiates twice at every point of a motion, that of two boxes is a
    bound without the squares, in a fifth of the operations: each box, too, beside the box around the other along its
    axes.
    """
    middle, axes, halves = _in_axes_of(core, block)
    if not axes:
        gap = highest([ca.fabs(x) - h for x, h in zip(middle, block.half, strict=True)], 0.0, hold)
        return _root(_outside(middle, block.half, hold)) + _negative_part(gap, 0.0)
    boxes, smooth = len(axes) == 3, rounding > 0
    slack = rounding / sum((*halves, *block.half)) if boxes and smooth else 0.0
    gaps = _gaps_beside_block(middle, axes, halves, block.half, slack)
    gap = highest(gaps, rounding if boxes else 0.0, hold)
    if boxes and smooth:
        away = [_positive_part(gap, rounding)]
        for faces in (gaps[:3], gaps[3:6]):
            square = sum(_positive_part(each, rounding) ** 2 for each in faces)
            away.append(ca.sqrt(square + rounding**2) - rounding)
        return highest(away, rounding, hold) + _negative_part(gap, rounding)
    squares = [_segment_box(middle, axes[0], block.half, rounding**2, hold)] if not boxes else []
    if isinstance(core, Block):
        squares = [*_edges_beside(middle, axes, halves, block.half, hold), *_corners_beside(block, core, hold)]
    square = reduce(ca.fmin, squares)
    # what the rounding of numbers leaves of it has slopes where they overlap
    square = square if smooth else square * (gap > 0)
    return _root(square, rounding**2 / 4) + _negative_part(gap, rounding)


def _in_axes_of(core: Rod | Block, block: Block) -> tuple[Triple, list[Triple], Sequence[Expression]]:
    """Middle, axes and half extents along these of a point (no axis), a segment or a box, in a box's axes."""
    if isinstance(core, Block):
        centre = into(subtract(core.centre, block.centre), block.axes)
        return centre, [into(axis, block.axes) for axis in core.axes], core.half
    ends = [into(subtract(point, block.centre), block.axes) for point in core.points]
    if len(ends) == 1:
        return ends[0], [], []
    u = subtract(ends[1], ends[0])
    return along(ends[0], 0.5, u), [u], [0.5]


def _gaps_beside_block(
    middle: Triple, axes: list[Triple], halves: Sequence[Expression], half: Triple, slack: Expression
) -> list[Expression]:
    """Gaps of a segment or a box to a box along its faces' normals, along those of the other, and across an edge of
    each (Gottschalk, Lin & Manocha 1996).

    With slack the sizes of cosines, which have kinks where boxes are aligned, are rounded up by as much at most.
    """
    sizes = [triple(size_of(share, slack) for share in axis) for axis in axes]
    sums = [sum(h * size[i] for h, size in zip(halves, sizes, strict=True)) for i in range(3)]
    found = [ca.fabs(middle[i]) - half[i] - sums[i] for i in range(3)]
    if boxes := len(axes) == 3:
        found += [ca.fabs(dot(middle, axes[j])) - halves[j] - dot(half, sizes[j]) for j in range(3)]
    least = NO_EDGE if boxes else NO_EDGE * dot(axes[0], axes[0])
    for i, j in product(range(3), range(len(axes))):
        i1, i2, j1, j2 = (i + 1) % 3, (i + 2) % 3, (j + 1) % 3, (j + 2) % 3
        reach = half[i1] * sizes[j][i2] + half[i2] * sizes[j][i1]
        if boxes:
            reach += halves[j1] * sizes[j2][i] + halves[j2] * sizes[j1][i]
        across = ca.fabs(middle[i2] * axes[j][i1] - middle[i1] * axes[j][i2]) - reach
        square = axes[j][i1] ** 2 + axes[j][i2] ** 2
        none = square <= least  # no direction, which separates nothing
        found.append(across / ca.sqrt(square + none) - none * (1 / NO_EDGE))
    return found


def size_of(x: Expression, slack: Expression) -> Expression:
    """|x|, or a smooth upper bound of it, at most the slack above."""
    return ca.fabs(x) if isinstance(slack, float) and slack == 0 else ca.sqrt(x * x + slack * slack)


def _outside(x: Triple, half: Triple, hold: Hold) -> Expression:
    """Square of the distance of a point to a box, in the box's axes."""
    away = triple(part - hold(_clip(part, -h, h)) for part, h in zip(x, half, strict=True))
    return dot(away, away)


def _segment_box(middle: Triple, u: Triple, half: Triple, weight: float, hold: Hold) -> Expression:
    """Least over s in -1/2..1/2 of the squared distance of middle + s u to a box plus weight s^2, in the box's axes.

    Half of its derivative is weight s and of each axis u_k (x_k - what x_k is cut to by the box), which is zero while
    x_k is within the box and straight before and after. First the axis is added that is farthest in s from there where
    s = 0; then that of the others that is farthest where the first leads to; then the last, if it is beyond where these
    lead to. What is added later pulls no farther than an axis that was added is straight: the least is found in three
    steps. Derivatives do not go through the places on the way.
    """
    sizes, squares = triple(ca.fabs(part) + KINK for part in u), triple(part * part for part in u)
    s, pull, rise = 0.0, 0.0, weight + KINK**2
    left: Sequence[Expression] = (1.0, 1.0, 1.0)
    for step in range(3):
        x = along(middle, s, u)
        nearest = triple(_clip(part, -h, h) for part, h in zip(x, half, strict=True))
        over = triple(keep * (part - near) for keep, part, near in zip(left, x, nearest, strict=True))
        added = _farthest(over, sizes) if step < 2 else (1.0, 1.0, 1.0)
        for k in range(3):
            taken = added[k] * (over[k] != 0) if step else added[k]
            pull, rise = pull + taken * (u[k] * (middle[k] - nearest[k])), rise + taken * squares[k]
        left = [keep * (1 - taken) for keep, taken in zip(left, added, strict=True)]
        s = _clip(-pull / rise, -0.5, 0.5)
        s = _placed(s) if step < 2 else hold(s)
    square = _outside(along(middle, s, u), half, hold)
    return square + weight * s**2 if weight else square


def _placed(s: Expression) -> Expression:
    """A place along a segment, -1/2..1/2, without derivatives: whole numbers of 2^-53, which hold all but tiny ones."""
    return ca.floor(s * 2.0**53) / 2.0**53


def _farthest(over: Triple, sizes: Triple) -> list[Expression]:
    """1 for one of three with the largest |over| / size, 0 for the others."""
    a, b, c = (ca.fabs(x) for x in over)
    first = (a * sizes[1] >= b * sizes[0]) * (a * sizes[2] >= c * sizes[0])
    second = (1 - first) * (b * sizes[2] >= c * sizes[1])
    return [first, second, 1 - first - second]


def _edges_beside(
    middle: Triple, axes: list[Triple], halves: Sequence[Expression], half: Triple, hold: Hold
) -> list[Expression]:
    """Squares of the distances of the edges of a box to another. With those of the other's corners they suffice: from
    a nearest point within a face one gets, along that face, to a corner or to an edge."""
    reaches = [triple(h * part for part in axis) for axis, h in zip(axes, halves, strict=True)]
    found = []
    for k, (i, j) in enumerate(((1, 2), (2, 0), (0, 1))):
        direction = triple(2 * part for part in reaches[k])
        for side, back in product((-1.0, 1.0), repeat=2):
            centre = along(along(middle, side, reaches[i]), back, reaches[j])
            found.append(_segment_box(centre, direction, half, 0.0, hold))
    return found


def _corners_beside(one: Block, other: Block, hold: Hold) -> list[Expression]:
    """Squares of the distances of the corners of one box to another."""
    centre, axes, halves = _in_axes_of(one, other)
    reaches = [triple(h * part for part in axis) for axis, h in zip(axes, halves, strict=True)]
    found = []
    for signs in product((-1.0, 1.0), repeat=3):
        corner = reduce(lambda point, way: along(point, *way), zip(signs, reaches, strict=True), centre)
        found.append(_outside(corner, other.half, hold))
    return found
