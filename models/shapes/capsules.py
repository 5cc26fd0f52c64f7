"""Distance between capsules, boxes and walls as casadi expressions, for constraints, indices and reports.

A capsule is a segment with a radius. Distances are signed: negative where bodies overlap (as far as noted), and their
derivative is that of the nearest pair of points. `soft_minimum` joins many into one smooth lower bound.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import reduce

import casadi as ca
import numpy as np

from models.arrays import ArrayInput, checked_array, checked_nonnegative, checked_number, checked_rotation
from models.errors import ModelError
from models.spatial import Expression, expression

SEARCH_STEPS = 40
GOLDEN = (5**0.5 - 1) / 2
KINK = 1e-12  # m; rounds off the kink of a distance at zero


@dataclass(frozen=True, eq=False)
class Capsule:
    """All points within `radius` (m) of the segment from `start` to `end`, in world. Shapes (3, 1), m.

    Numbers or expressions.

    Raises:
        ModelError: Other shapes, numbers that are not finite, a negative radius.
    """

    radius: Expression
    start: Expression
    end: Expression

    def __post_init__(self) -> None:
        if not isinstance(self.radius, ca.SX | ca.MX):
            checked_nonnegative(self.radius, "capsule", "radius", "m")
        for what in ("start", "end"):
            point = expression(getattr(self, what))
            if point.shape != (3, 1):
                message = f"capsule: {what} has shape {point.shape}, expected (3, 1)"
                raise ModelError(message, name=what, value=point.shape, limit=(3, 1))
            if isinstance(point, ca.DM) and not point.is_regular():
                raise ModelError(f"capsule: {what} {point} is not finite", name=what, value=np.array(point).ravel())


@dataclass(frozen=True, eq=False)
class Box:
    """A solid box in world.

    Attributes:
        size: Full length of its edges. Shape (3,), m; inf for a box without ends along an axis.
        position: Its centre. Shape (3,), m.
        rotation: Its axes as columns, in world. Shape (3, 3).

    Raises:
        ModelError: An edge that is not positive, no finite edge, or a rotation that is none.
    """

    size: ArrayInput
    position: ArrayInput = (0.0, 0.0, 0.0)
    rotation: ArrayInput = field(default_factory=lambda: np.eye(3))

    def __post_init__(self) -> None:
        size = checked_array(self.size, (3,), "box", "size", finite=False, positive=True, unit="m")
        object.__setattr__(self, "size", size)
        object.__setattr__(self, "position", checked_array(self.position, (3,), "box", "position"))
        object.__setattr__(self, "rotation", checked_rotation(self.rotation, "box", "rotation"))
        if np.isinf(size).all():
            raise ModelError("box: every edge is infinite; there is no outside", name="size", value=size)

    def local(self, point: Expression) -> Expression:
        """Coordinates of a world point in the axes of the box, of its finite axes only."""
        inside = ca.mtimes(ca.DM(self.rotation).T, expression(point) - ca.DM(self.position))
        return ca.vertcat(*[inside[k] for k in range(3) if np.isfinite(self.size[k])])

    def reach(self) -> Expression:
        """Half of the finite edges, m."""
        return ca.DM(self.size[np.isfinite(self.size)] / 2)


def box_distance(point: Expression, box: Box) -> Expression:
    """Distance of a point to a box, negative inside: there minus the way to the nearest face. Convex. Shape (1, 1)."""
    over = ca.fabs(box.local(point)) - box.reach()
    outside = ca.fmax(over, 0)
    deepest = reduce(ca.fmax, ca.vertsplit(over))
    return _length(outside) + ca.fmin(deepest, 0)


def capsule_to_box(capsule: Capsule, box: Box) -> Expression:
    """Distance of a capsule to a solid box. Shape (1, 1), m.

    The distance of a box is convex along the segment: a golden-section search of fixed length finds the nearest
    point, good to 1e-8 of the segment. Its place is piecewise constant to differentiation, as the theorem of the
    envelope wants it.
    """
    a, b, radius = expression(capsule.start), expression(capsule.end), capsule.radius

    def at(s: Expression) -> Expression:
        return box_distance(a + s * (b - a), box)

    low, high = 0.0, 1.0
    left, right = 1 - GOLDEN, GOLDEN
    f_left, f_right = at(left), at(right)
    for _ in range(SEARCH_STEPS):
        lower = f_left < f_right
        low, high = ca.if_else(lower, low, left), ca.if_else(lower, right, high)
        fresh = ca.if_else(lower, high - GOLDEN * (high - low), low + GOLDEN * (high - low))
        value = at(fresh)
        left, right, f_left, f_right = (
            ca.if_else(lower, fresh, right),
            ca.if_else(lower, left, fresh),
            ca.if_else(lower, value, f_right),
            ca.if_else(lower, f_left, value),
        )
    best = ca.fmin(at((low + high) / 2), ca.fmin(at(0.0), at(1.0)))
    return best - radius


def capsule_in_box(capsule: Capsule, walls: Box) -> Expression:
    """Distance of a capsule inside a hollow box to its nearest wall, negative beyond it. Shape (1, 1), m."""
    gaps = [walls.reach() - ca.fabs(walls.local(end)) for end in (capsule.start, capsule.end)]
    return reduce(ca.fmin, ca.vertsplit(ca.vertcat(*gaps))) - capsule.radius


def capsule_to_capsule(one: Capsule, other: Capsule) -> Expression:
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


def soft_minimum(values: Sequence[Expression], width: float) -> Expression:
    """A smooth lower bound of the least of n values, at most width log(n) below it. Shape (1, 1).

    Raises:
        ModelError: No value, or a width that is not positive.
    """
    if not values:
        raise ModelError("soft_minimum of no values", name="values", value=values)
    checked_number(width, "soft_minimum", "width", positive=True)
    stacked, least = ca.vertcat(*values), reduce(ca.fmin, values)
    return least - width * ca.log(ca.sum1(ca.exp((least - stacked) / width)))
