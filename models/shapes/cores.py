"""Signed distances of points, segments and boxes, the cores of shapes, as CasADi expressions.

Every formula accepts scalars or columns of scalars, and has a smooth lower bound for second-order methods; see
`models.shapes.distance`.
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
"""A vector as three scalars or columns. Constants are floats, so that products with zero and one are simplified."""
StopGradient: TypeAlias = Callable[[Expression], Expression]
"""Function that makes an expression constant for differentiation (`StoppedGradients`), or returns it unchanged."""

KINK = 1e-12
"""Length over which the kink of an exact distance at zero is smoothed, m."""
PARALLEL = 1e-18
"""Squared sine of the angle between two edges below which their cross product is not used as a separating axis."""


class SegmentCore(NamedTuple):
    """Point or segment along which a sphere sweeps to form a ball or a capsule: one point, or the two ends."""

    points: tuple[Triple, ...]


class BoxCore(NamedTuple):
    """A box as distance formulas use it: its centre, axes and half edge lengths."""

    centre: Triple
    axes: tuple[Triple, ...]
    half: Triple


def keep_gradient(value: Expression) -> Expression:
    """Return an expression unchanged; used in place of `StoppedGradients` where all derivatives are needed."""
    return value


def triple(entries: Iterable[Expression]) -> Triple:
    """Return the three entries of a vector as a tuple (x, y, z)."""
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


def in_axes(vector: Triple, axes: Sequence[Triple]) -> Triple:
    """Return the components of a vector along three axes."""
    return triple(dot(axis, vector) for axis in axes)


def _clip(x: Expression, low: Expression = 0.0, high: Expression = 1.0) -> Expression:
    return ca.fmin(ca.fmax(x, low), high)


def _root(square: Expression, excess: float = 0.0) -> Expression:
    """Return the root of a squared distance, or a lower bound of the root if the square may be `excess` too large."""
    root = ca.sqrt(square + (excess or KINK**2))
    return (square - excess) * (1 / root) if excess else root - KINK


def _negative_part(gap: Expression, rounding: float) -> Expression:
    """Return min(gap, 0) or, with `rounding` > 0, a smooth lower bound that is at most `rounding` / 4 below it."""
    if rounding == 0:
        return ca.fmin(gap, 0)
    return ca.fmin(gap + rounding, 0) - _clip(rounding - gap, 0.0, 2 * rounding) ** 2 * (0.25 / rounding)


def _positive_part(gap: Expression, rounding: float) -> Expression:
    """Return a smooth lower bound of max(gap, 0), at most `rounding` / 2 below it and zero for negative gaps."""
    return ca.fmax(gap - rounding, 0) + _clip(gap, 0.0, rounding) ** 2 * (0.5 / rounding)


def largest_of(gaps: Sequence[Expression], rounding: float, stop_gradient: StopGradient) -> Expression:
    """Return the largest of several gaps, or a smooth lower bound at most the smoothing width `rounding` below it."""
    largest = reduce(ca.fmax, gaps)
    if rounding == 0 or len(gaps) == 1:
        return largest
    largest, width = stop_gradient(largest), rounding / log(len(gaps))
    return largest + width * ca.log(sum(ca.exp((gap - largest) * (1 / width)) for gap in gaps)) - rounding


def distance_of_segments(
    first: SegmentCore, second: SegmentCore, rounding: float, stop_gradient: StopGradient
) -> Expression:
    """Return the distance of two points, a point and a segment, or two segments, which is zero if segments cross."""
    if len(first.points) < len(second.points):
        first, second = second, first
    p, q = first.points[0], second.points[0]
    gap = subtract(p, q)
    if len(first.points) == 1:
        return _root(dot(gap, gap))
    u = subtract(first.points[1], p)
    if len(second.points) == 1:
        difference = along(gap, stop_gradient(_clip(-dot(u, gap) / (dot(u, u) + KINK**2))), u)
        return _root(dot(difference, difference))
    weight = rounding**2
    return _root(_segments_square(gap, u, subtract(second.points[1], q), weight, stop_gradient), weight / 2)


def _segments_square(gap: Triple, u: Triple, v: Triple, weight: float, stop_gradient: StopGradient) -> Expression:
    """Return the least squared distance of two segments, smoothed by a penalty on the closest points if `weight` > 0.

    The minimum over s, t in 0..1 of |gap + s u - t v|^2 + weight ((s - 1/2)^2 + (t - 1/2)^2) by clipping s, then t,
    then s again (Ericson, Real-Time Collision Detection, 2005, 5.1.9).
    """
    a, e, b = dot(u, u) + weight + KINK**2, dot(v, v) + weight + KINK**2, dot(u, v)
    c, f = dot(u, gap) - weight / 2, dot(v, gap) + weight / 2
    # a squared sine below 1e-13 counts as parallel; the error is at most 3e-7 of the length
    s = _clip((b * f - c * e) / ca.fmax(a * e - b * b, 1e-13 * a * e))
    t = _clip((b * s + f) / e)
    s = _clip((b * t - c) / a)
    s, t = stop_gradient(s), stop_gradient(t)
    difference = along(along(gap, s, u), -t, v)
    square = dot(difference, difference)
    return square + weight * ((s - 0.5) ** 2 + (t - 0.5) ** 2) if weight else square


def distance_to_box(
    core: SegmentCore | BoxCore, box: BoxCore, rounding: float, stop_gradient: StopGradient
) -> Expression:
    """Return the signed distance of a point, a segment or a box to another box.

    The rounded distance of two boxes, which an interior-point method differentiates twice, is a bound without the
    squares of closest points, at a fifth of the cost. It also uses the distance of each box to the bounding box of the
    other along its own axes.
    """
    middle, axes, halves = _in_box_axes(core, box)
    if not axes:
        gap = largest_of([ca.fabs(x) - h for x, h in zip(middle, box.half, strict=True)], 0.0, stop_gradient)
        return _root(_point_box_square(middle, box.half, stop_gradient)) + _negative_part(gap, 0.0)
    boxes, smooth = len(axes) == 3, rounding > 0
    slack = rounding / sum((*halves, *box.half)) if boxes and smooth else 0.0
    gaps = _separating_gaps(middle, axes, halves, box.half, slack)
    gap = largest_of(gaps, rounding if boxes else 0.0, stop_gradient)
    if boxes and smooth:
        distances = [_positive_part(gap, rounding)]
        for faces in (gaps[:3], gaps[3:6]):
            square = sum(_positive_part(each, rounding) ** 2 for each in faces)
            distances.append(ca.sqrt(square + rounding**2) - rounding)
        return largest_of(distances, rounding, stop_gradient) + _negative_part(gap, rounding)
    squares = [_segment_box_square(middle, axes[0], box.half, rounding**2, stop_gradient)] if not boxes else []
    if isinstance(core, BoxCore):
        squares = _edge_squares(middle, axes, halves, box.half, stop_gradient)
        squares += _corner_squares(box, core, stop_gradient)
    square = reduce(ca.fmin, squares)
    # for overlapping cores rounding errors leave a small square with large slopes: set it to zero
    square = square if smooth else square * (gap > 0)
    return _root(square, rounding**2 / 4) + _negative_part(gap, rounding)


def _in_box_axes(core: SegmentCore | BoxCore, box: BoxCore) -> tuple[Triple, list[Triple], Sequence[Expression]]:
    """Return centre, axes (a point has none) and half extents of a point, segment or box in the axes of another box."""
    if isinstance(core, BoxCore):
        centre = in_axes(subtract(core.centre, box.centre), box.axes)
        return centre, [in_axes(axis, box.axes) for axis in core.axes], core.half
    ends = [in_axes(subtract(point, box.centre), box.axes) for point in core.points]
    if len(ends) == 1:
        return ends[0], [], []
    u = subtract(ends[1], ends[0])
    return along(ends[0], 0.5, u), [u], [0.5]


def _separating_gaps(
    middle: Triple, axes: list[Triple], halves: Sequence[Expression], half: Triple, slack: Expression
) -> list[Expression]:
    """Return the gaps between a segment or box and another box along face normals and cross products of edges.

    Absolute values of cosines have kinks at aligned boxes; a positive slack replaces them by smooth upper bounds.
    """
    sizes = [triple(smooth_abs(share, slack) for share in axis) for axis in axes]
    sums = [sum(h * size[i] for h, size in zip(halves, sizes, strict=True)) for i in range(3)]
    gaps = [ca.fabs(middle[i]) - half[i] - sums[i] for i in range(3)]
    if boxes := len(axes) == 3:
        gaps += [ca.fabs(dot(middle, axes[j])) - halves[j] - dot(half, sizes[j]) for j in range(3)]
    least = PARALLEL if boxes else PARALLEL * dot(axes[0], axes[0])
    for i, j in product(range(3), range(len(axes))):
        i1, i2, j1, j2 = (i + 1) % 3, (i + 2) % 3, (j + 1) % 3, (j + 2) % 3
        reach = half[i1] * sizes[j][i2] + half[i2] * sizes[j][i1]
        if boxes:
            reach += halves[j1] * sizes[j2][i] + halves[j2] * sizes[j1][i]
        across = ca.fabs(middle[i2] * axes[j][i1] - middle[i1] * axes[j][i2]) - reach
        square = axes[j][i1] ** 2 + axes[j][i2] ** 2
        parallel = square <= least  # no direction of separation
        gaps.append(across / ca.sqrt(square + parallel) - parallel * (1 / PARALLEL))
    return gaps


def smooth_abs(x: Expression, slack: Expression) -> Expression:
    """Return the absolute value of x, or a smooth upper bound that is at most `slack` larger."""
    return ca.fabs(x) if isinstance(slack, float) and slack == 0 else ca.sqrt(x * x + slack * slack)


def _point_box_square(x: Triple, half: Triple, stop_gradient: StopGradient) -> Expression:
    """Return the squared distance of a point from a box; the point is given in the axes of the box."""
    away = triple(part - stop_gradient(_clip(part, -h, h)) for part, h in zip(x, half, strict=True))
    return dot(away, away)


def _segment_box_square(
    middle: Triple, u: Triple, half: Triple, weight: float, stop_gradient: StopGradient
) -> Expression:
    """Return the least squared distance of a segment's points middle + s u from a box, plus `weight` s^2, in box axes.

    The minimum over s in -1/2..1/2 of the squared distance of middle + s u, plus weight s^2. Half the derivative is
    weight s plus, for each axis, u_k times the excess of x_k over the box, which is zero inside and linear outside. The
    axes enter one by one, that of the largest relative excess first. An axis that enters later never moves s out of the
    linear range of an earlier one, so three steps find the minimum.
    """
    sizes, squares = triple(ca.fabs(part) + KINK for part in u), triple(part * part for part in u)
    s, pull, rise = 0.0, 0.0, weight + KINK**2
    remaining: Sequence[Expression] = (1.0, 1.0, 1.0)
    for step in range(3):
        x = along(middle, s, u)
        nearest = triple(_clip(part, -h, h) for part, h in zip(x, half, strict=True))
        over = triple(keep * (part - clipped) for keep, part, clipped in zip(remaining, x, nearest, strict=True))
        added = _largest_indicator(over, sizes) if step < 2 else (1.0, 1.0, 1.0)
        for k in range(3):
            taken = added[k] * (over[k] != 0) if step else added[k]
            pull, rise = pull + taken * (u[k] * (middle[k] - nearest[k])), rise + taken * squares[k]
        remaining = [keep * (1 - taken) for keep, taken in zip(remaining, added, strict=True)]
        s = _clip(-pull / rise, -0.5, 0.5)
        # rounded to a multiple of 2^-53, so that its derivative is zero
        s = ca.floor(s * 2.0**53) / 2.0**53 if step < 2 else stop_gradient(s)
    square = _point_box_square(along(middle, s, u), half, stop_gradient)
    return square + weight * s**2 if weight else square


def _largest_indicator(over: Triple, sizes: Triple) -> list[Expression]:
    """Return 1 for the component whose magnitude is largest relative to its entry in `sizes`, 0 for the other two."""
    a, b, c = (ca.fabs(x) for x in over)
    first = (a * sizes[1] >= b * sizes[0]) * (a * sizes[2] >= c * sizes[0])
    second = (1 - first) * (b * sizes[2] >= c * sizes[1])
    return [first, second, 1 - first - second]


def _edge_squares(
    middle: Triple, axes: list[Triple], halves: Sequence[Expression], half: Triple, stop_gradient: StopGradient
) -> list[Expression]:
    """Return the squared distances of a box's twelve edges from another box, in whose axes the first box is given.

    With the corners of the other box they suffice: from a closest point inside a face one can slide to a corner or an
    edge.
    """
    reaches = [triple(h * part for part in axis) for axis, h in zip(axes, halves, strict=True)]
    squares = []
    for k, (i, j) in enumerate(((1, 2), (2, 0), (0, 1))):
        direction = triple(2 * part for part in reaches[k])
        for side, back in product((-1.0, 1.0), repeat=2):
            centre = along(along(middle, side, reaches[i]), back, reaches[j])
            squares.append(_segment_box_square(centre, direction, half, 0.0, stop_gradient))
    return squares


def _corner_squares(first: BoxCore, second: BoxCore, stop_gradient: StopGradient) -> list[Expression]:
    """Return the squared distances of the eight corners of the first box from the second box."""
    centre, axes, halves = _in_box_axes(first, second)
    reaches = [triple(h * part for part in axis) for axis, h in zip(axes, halves, strict=True)]
    squares = []
    for signs in product((-1.0, 1.0), repeat=3):
        corner = reduce(lambda point, step: along(point, *step), zip(signs, reaches, strict=True), centre)
        squares.append(_point_box_square(corner, second.half, stop_gradient))
    return squares
