"""Roll of least index that keeps clear of the surroundings: clearance as a constraint, in the index, or both.

With links and obstacles in it the index has no closed form any more. The rolls of a fixed grid are compared, those that
fall short of the clearance with a penalty, and the least minima among them, together with the best roll of the closed
form, are refined by a pattern search whose step shrinks: a fixed number of operations. A minimum that no roll of the
grid is drawn to may be missed; a finer grid finds it.

Gaps between the links of the rig and what stands around it, as casadi expressions.

They are the rig's own, apart from `models.shapes.distance`: its tunnel is a box without ends, seen from inside. Gaps
are signed: negative where bodies overlap (as far as noted), and their derivative is that of the nearest pair of points.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import reduce
from typing import Any, NamedTuple

import casadi as ca
import numpy as np

from models.arrays import checked_count, checked_each, checked_instance, checked_nonnegative, checked_number
from models.cts.best_roll import optimal_inverse
from models.cts.rig import HOME, INCH, Branch, Rig, Tunnel, checked_branch, configuration_at, dh_frames, joints_of
from models.cts.roll import ACTIVE, STATUS, check_constraints, checked_gain, index_harmonics, unwrap_roll
from models.errors import ModelError
from models.robot.kinematics import checked_vector
from models.shapes.distance import soft_minimum
from models.shapes.shapes import Box, Capsule
from models.spatial import FULL_TURN, Expression, expression

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


@dataclass(frozen=True)
class ClearanceSearch:
    """Settings of the search for a roll that keeps clear.

    Attributes:
        basins: Minima of the grid that are refined.
        steps, shrink: Of the pattern search, and ratio of its steps: 0.62^44 = 7e-10 of a grid's step.
        shortfall_price: Of a clearance that falls short, in what the search compares, 1/m.
        inset: How far inside the least clearance the search aims, m.
        at_limit: Nearer to the least clearance than this counts as held by it, m.
    """

    basins: int = 4
    steps: int = 44
    shrink: float = 0.62
    shortfall_price: float = 1e3
    inset: float = 1e-10
    at_limit: float = 1e-6


SEARCH = ClearanceSearch()


@dataclass(frozen=True)
class Radii:
    """Radii of the rig's capsules, m: yaw links, pitch link, goose-neck and sting."""

    yaw: float = 2.0 * INCH
    pitch: float = 1.5 * INCH
    sting: float = 0.75 * INCH

    def __post_init__(self) -> None:
        for what, radius in vars(self).items():
            checked_nonnegative(radius, "radii", what, "m")


@dataclass(frozen=True)
class CollisionScene:
    """What the rig must not touch.

    Attributes:
        walls: The tunnel, hollow; its floor is a wall. None for no walls.
        solids: The floor's fittings, the parent aircraft, ... as boxes.
        capsules: The same as capsules, in world.
    """

    walls: Box | None = None
    solids: tuple[Box, ...] = ()
    capsules: tuple[Capsule, ...] = ()

    def __post_init__(self) -> None:
        if self.walls is not None:
            checked_instance(self.walls, Box, "scene", "walls")
        for what, kind in (("solids", Box), ("capsules", Capsule)):
            object.__setattr__(self, what, checked_each(getattr(self, what), kind, "scene", what))


def rig_capsules(rig: Rig, q: Expression, radii: Radii | None = None) -> dict[str, LinkCapsule]:
    """Links of the rig as capsules, by name, from joint 2 to the store."""
    checked_instance(rig, Rig, "rig", "rig")
    radii = Radii() if radii is None else checked_instance(radii, Radii, "rig", "radii")
    frames = dh_frames(rig, checked_vector(q, 6, "q", "one entry for each joint of the rig"))
    joint2, joint3, joint4 = (frames[k].position for k in (1, 2, 3))
    side = frames[3].point((0, 0, rig.yaw_offset))
    corner, tool = frames[4].position, frames[7]
    behind = tool.point((-rig.sting, 0, 0))
    return {
        "yaw link 1": LinkCapsule(radii.yaw, joint2, joint3),
        "yaw link 2": LinkCapsule(radii.yaw, joint3, joint4),
        "yaw offset": LinkCapsule(radii.yaw, joint4, side),
        "pitch link": LinkCapsule(radii.pitch, side, corner),
        "goose-neck": LinkCapsule(radii.sting, corner, behind),
        "sting": LinkCapsule(radii.sting, behind, tool.position),
    }


def clearances(
    rig: Rig, q: Expression, scene: CollisionScene, radii: Radii | None = None
) -> dict[tuple[str, str], Expression]:
    """Distance of every link to everything around it, by (link, thing). Each of shape (1, 1), m.

    Raises:
        ModelError: Nothing around.
    """
    checked_instance(scene, CollisionScene, "clearances", "scene")
    found: dict[tuple[str, str], Expression] = {}
    for name, capsule in rig_capsules(rig, q, radii).items():
        if scene.walls is not None:
            found[name, "walls"] = capsule_in_box(capsule, scene.walls)
        for k, box in enumerate(scene.solids):
            found[name, f"solid {k}"] = capsule_to_box(capsule, box)
        for k, other in enumerate(scene.capsules):
            found[name, f"capsule {k}"] = capsule_to_capsule(capsule, other)
    if not found:
        message = "clearances: the surroundings are empty; give walls, solids or capsules"
        raise ModelError(message, name="scene", value=scene)
    return found


def proximity_cost(gap: Expression, weight: float, width: float) -> Expression:
    """Term of the index that grows as the rig comes near: weight exp(-gap / width), gap and width in m.

    Raises:
        ModelError: A weight that is negative or not finite, a width that is not positive.
    """
    checked_nonnegative(weight, "clearance", "weight")
    checked_number(width, "clearance", "width", positive=True, unit="m")
    return weight * ca.exp(-gap / width)


def checked_clearance(clearance: float) -> float:
    """`clearance` itself, m; ModelError unless it is a finite distance or -inf for none."""
    if checked_number(clearance, "rig", "clearance", finite=False) == np.inf:
        message = f"clearance {clearance} m must be a finite distance or -inf for none"
        raise ModelError(message, name="clearance", value=clearance)
    return clearance


def collision_free_inverse(
    rig: Rig,
    tunnel: Tunnel,
    scene: CollisionScene,
    branch: Branch = HOME,
    *,
    clearance: float = -np.inf,
    weight: float = 0.0,
    width: float = 0.05,
    rate_weight: float = 0.0,
    samples: int = 72,
    softness: float = 2e-3,
    radii: Radii | None = None,
) -> Any:
    """Function (target, previous) -> (joints, cost, active, status, gap): optimal_inverse among obstacles.

    Args:
        clearance: Least distance of the rig from its surroundings, m; -inf for no constraint.
        weight, width: Of the term weight exp(-gap / width) of the index.
        rate_weight: w4 of I2; 0 for I1.
        samples: Rolls of the grid, at least 8.
        softness: Width of the smooth minimum of all distances, m; see soft_minimum.
        radii: Of the rig's capsules.

    Returns:
        A casadi Function as optimal_inverse, and the smooth least distance, m. `active` is "clearance"
        where it holds the roll; where the closed form has the best roll it is that of the closed form, else "free".
        The status "clearance" says that the target is reached within limits, but by no roll clear of everything.

    Raises:
        ModelError: A weight, width, clearance or number of samples that cannot be.
    """
    gain = checked_gain(rate_weight)
    checked_instance(rig, Rig, "rig", "rig")
    checked_instance(tunnel, Tunnel, "rig", "tunnel")
    branch = checked_branch(branch)
    checked_clearance(clearance)
    checked_count(samples, "rig", "samples", 8)
    target, previous, angle = ca.SX.sym("target", 5), ca.SX.sym("previous"), ca.SX.sym("angle")
    c, s = ca.cos(angle), ca.sin(angle)
    configuration = configuration_at(rig, target, c, s, branch)
    roll = unwrap_roll(rig, c, s, previous)
    joints = joints_of(rig, target, roll, configuration)
    gap = soft_minimum(list(clearances(rig, joints, scene, radii).values()), softness)
    cost = index_harmonics(rig, tunnel, target).value(c, s) + gain * (roll - previous) ** 2
    cost += proximity_cost(gap, weight, width)
    meets = check_constraints(rig, target, configuration, c, s)
    held = ca.logic_and(meets.all_but_slide(), meets.slide())
    fine = ca.logic_and(held, gap >= clearance)
    given = [target, previous, angle]
    value = ca.Function("value", given, ca.cse([ca.if_else(fine, cost, ca.inf)]))
    short: Any = ca.fmax(clearance + SEARCH.inset - gap, 0) if np.isfinite(clearance) else 0.0
    merit = ca.Function("merit", given, ca.cse([ca.if_else(held, cost + SEARCH.shortfall_price * short, ca.inf)]))
    place = ca.Function("place", given, ca.cse([joints, gap]))

    x, before = ca.MX.sym("target", 5), ca.MX.sym("previous")
    closed, _, closed_active, closed_status = optimal_inverse(rig, tunnel, branch, rate_weight=rate_weight)(x, before)
    reached = closed_status == 0
    free = ca.if_else(reached, closed[5], 0.0)
    grid = ca.DM(np.linspace(-np.pi, np.pi, samples, endpoint=False)).T
    starts = ca.Function("starts", *_starts(samples))(merit.map(samples)(x, before, grid))
    states = ca.horzcat(starts, ca.vertcat(free, merit(x, before, free), FULL_TURN / samples))
    refined = _pattern(merit)(states, ca.repmat(ca.vertcat(x, before), 1, SEARCH.basins + 1))
    angles = ca.horzcat(free, refined[0, :])
    values = value.map(SEARCH.basins + 2)(x, before, angles)
    best, least, from_closed = ca.Function("choice", *_choice(SEARCH.basins + 2))(angles, values)
    q, distance = place(x, before, best)
    status = ca.if_else(reached, ca.if_else(least < ca.inf, 0, STATUS.index("clearance")), closed_status)
    spoilt = ca.if_else(status == 0, 0, np.nan)
    active = ca.if_else(from_closed, closed_active, 0)
    active = ca.if_else(distance - clearance < SEARCH.at_limit, ACTIVE.index("clearance"), active)
    outputs = [q + spoilt, least + spoilt, active, status, distance + spoilt]
    labels = ["target", "previous"], ["joints", "cost", "active", "status", "gap"]
    return ca.Function("collision_free_inverse", [x, before], outputs, *labels)


def _starts(samples: int) -> tuple[list[Any], list[Any]]:
    """Inputs and outputs of the function (merits of the grid) -> columns (angle, merit, step) of its least minima."""
    merits = ca.SX.sym("merits", 1, samples)
    angles = np.linspace(-np.pi, np.pi, samples, endpoint=False)
    left = []
    for k in range(samples):
        low = ca.logic_and(merits[k] <= merits[k - 1], merits[k] <= merits[(k + 1) % samples])
        left.append(ca.if_else(low, merits[k], ca.inf))
    columns = []
    for _ in range(SEARCH.basins):
        at, least = ca.SX(0), ca.SX(ca.inf)
        for angle, merit in zip(angles, left, strict=True):
            at, least = ca.if_else(merit < least, angle, at), ca.fmin(merit, least)
        left = [ca.if_else(at == angle, ca.inf, merit) for angle, merit in zip(angles, left, strict=True)]
        columns.append(ca.vertcat(at, least, FULL_TURN / samples))
    return [merits], [ca.horzcat(*columns)]


def _choice(count: int) -> tuple[list[Any], list[Any]]:
    """Inputs and outputs of (angles, values) -> (angle of the least, the least, whether it is the first)."""
    angles, values = ca.SX.sym("angles", 1, count), ca.SX.sym("values", 1, count)
    at, least, first = angles[0], values[0], ca.SX(1)
    for k in range(1, count):
        better = values[k] < least
        at, least = ca.if_else(better, angles[k], at), ca.fmin(values[k], least)
        first = ca.if_else(better, 0, first)
    return [angles, values], [at, least, first]


def _pattern(merit: Any) -> Any:
    """Function (states, given) -> states: a search about each state (angle, merit, step); given target, previous."""
    state, given = ca.MX.sym("state", 3), ca.MX.sym("given", 6)
    angle, least, step = ca.vertsplit(state)
    for side in (-0.5, 0.5):
        at = state[0] + side * step
        found = merit(given[:5], given[5], at)
        better = found < least
        angle, least = ca.if_else(better, at, angle), ca.if_else(better, found, least)
    once = ca.Function("once", [state, given], [ca.vertcat(angle, least, step * SEARCH.shrink)])
    all_steps = once.mapaccum(SEARCH.steps)(state, ca.repmat(given, 1, SEARCH.steps))[:, -1]
    return ca.Function("pattern", [state, given], [all_steps]).map(SEARCH.basins + 1)
