"""Gaps between the links of the rig and what stands around it, as casadi expressions.

They are the rig's own, apart from `models.shapes.distance`: its tunnel is a box without ends, seen from inside. Gaps
are signed: negative where bodies overlap (as far as noted), and their derivative is that of the nearest pair of points.
"""

from __future__ import annotations

from functools import reduce
from typing import NamedTuple

import casadi as ca
import numpy as np

from models.shapes.shapes import Box, Capsule
from models.spatial import Expression, expression

KINK = 1e-12  # m; rounds off the kink of a distance at zero


class LinkCapsule(NamedTuple):
    """All points within `radius` (m) of the segment from `start` to `end`, expressions in world. Shapes (3, 1), m."""

    radius: float
    start: Expression
    end: Expression


def _local(point: Expression, box: Box) -> Expression:
    """Coordinates of a world point in the axes of the box, of its finite axes only."""
    inside = ca.mtimes(ca.DM(box.rotation).T, expression(point) - ca.DM(box.position))
    return ca.vertcat(*[inside[k] for k in range(3) if np.isfinite(box.size[k])])


def _half(box: Box) -> Expression:
    """Half of the finite edges, m."""
    return ca.DM(box.size[np.isfinite(box.size)] / 2)


def box_distance(point: Expression, box: Box) -> Expression:
    """Distance of a point to a box, negative inside: there minus the way to the nearest face. Convex. Shape (1, 1)."""
    over = ca.fabs(_local(point, box)) - _half(box)
    outside = ca.fmax(over, 0)
    deepest = reduce(ca.fmax, ca.vertsplit(over))
    return _length(outside) + ca.fmin(deepest, 0)


def capsule_to_box(capsule: LinkCapsule | Capsule, box: Box) -> Expression:
    """Distance of a capsule to a solid box. Shape (1, 1), m.

    The distance of a box is convex along the segment: a golden-section search of fixed length finds the nearest
    point, good to 1e-8 of the segment. Its place is piecewise constant to differentiation, as the theorem of the
    envelope wants it.
    """
    a, b, radius = expression(capsule.start), expression(capsule.end), capsule.radius

    def at(s: Expression) -> Expression:
        return box_distance(a + s * (b - a), box)

    golden, (low, high) = (5**0.5 - 1) / 2, (0.0, 1.0)
    left, right = 1 - golden, golden
    f_left, f_right = at(left), at(right)
    for _ in range(40):  # 0.618^40 = 4e-9
        lower = f_left < f_right
        low, high = ca.if_else(lower, low, left), ca.if_else(lower, right, high)
        fresh = ca.if_else(lower, high - golden * (high - low), low + golden * (high - low))
        value = at(fresh)
        left, right, f_left, f_right = (
            ca.if_else(lower, fresh, right),
            ca.if_else(lower, left, fresh),
            ca.if_else(lower, value, f_right),
            ca.if_else(lower, f_left, value),
        )
    best = ca.fmin(at((low + high) / 2), ca.fmin(at(0.0), at(1.0)))
    return best - radius


def capsule_in_box(capsule: LinkCapsule | Capsule, walls: Box) -> Expression:
    """Distance of a capsule inside a hollow box to its nearest wall, negative beyond it. Shape (1, 1), m."""
    gaps = [_half(walls) - ca.fabs(_local(end, walls)) for end in (capsule.start, capsule.end)]
    return reduce(ca.fmin, ca.vertsplit(ca.vertcat(*gaps))) - capsule.radius


def capsule_to_capsule(one: LinkCapsule | Capsule, other: LinkCapsule | Capsule) -> Expression:
    """Distance of two capsules; of overlapping ones minus the overlap of radii. Shape (1, 1), m.

    Nearest points of two segments in closed form (Ericson, Real-Time Collision Detection, 2005, 5.1.9).
    """
    p, q = expression(one.start), expression(other.start)
    u, v = expression(one.end) - p, expression(other.end) - q
    gap = p - q
    a, e, b = ca.dot(u, u) + KINK**2, ca.dot(v, v) + KINK**2, ca.dot(u, v)
    c, f = ca.dot(u, gap), ca.dot(v, gap)
    slack = a * e - b * b
    s = _clip(ca.if_else(slack > 1e-12 * a * e, (b * f - c * e) / (slack + 1e-300), 0.0))
    t = _clip((b * s + f) / e)
    s = _clip((b * t - c) / a)
    apart = gap + s * u - t * v
    return _length(apart) - one.radius - other.radius


def _length(vector: Expression) -> Expression:
    """Euclidean norm, its kink at zero rounded off."""
    return ca.sqrt(ca.dot(vector, vector) + KINK**2) - KINK


def _clip(x: Expression) -> Expression:
    return ca.fmin(ca.fmax(x, 0), 1)
