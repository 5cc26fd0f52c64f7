"""Which rolls the rig can take for a target, and what they cost: the index I1 and the ends of the reachable arcs.

Roll enters as a point (cosine, sine) of the unit circle. The set of rolls that reach, within reach of both links and
within the joint limits, is a set of arcs; every end of an arc is a root of a trigonometric polynomial of degree 1
(joints 4 and 5 and the reach of the pitch link), 2 (joints 2 and 3 and the reach of the yaw link) or 4 (joint 1).

The index I2 = I1 + w4 / (2 pi) (roll - previous)^2 of the rig, (37): the turn a roll is counted in, and all minima.

I2 is the only place where a roll is more than a point of the circle: it grows with every whole turn away from the roll
before. Its minima are found by Newton steps on intervals where it is convex; at most four roots of I1'' cut these out.
"""

from __future__ import annotations

from itertools import pairwise
from typing import Any, NamedTuple

import casadi as ca
import numpy as np

from models.arrays import checked_nonnegative
from models.cts.rig import (
    Branch,
    Rig,
    RigConfiguration,
    Tunnel,
    configuration_at,
    corner_circle,
    in_nearest_turn,
    in_turn_after,
)
from models.cts.trigonometric import (
    Harmonics,
    Point,
    Series,
    Slope,
    added,
    first_square,
    minus,
    polish,
    product,
    roots,
    scaled,
    series_roots,
)
from models.spatial import FULL_TURN, Expression

LIMITS = tuple(f"joint {joint} {side}" for joint in range(1, 7) for side in ("lower", "upper"))
ACTIVE = ("free", "pitch reach", "yaw reach", *LIMITS, "clearance")
"""Name of the constraint that holds a roll back, by its code."""

STATUS = ("ok", "not a number", "pitch link out of reach", "yaw link out of reach", "joint limits", "clearance")
"""Why there is no roll, by its code."""

ANGLE_INSET = 1e-10
REACH_INSET = 1e-13
"""How far inside its limit an end is placed, so that the strict check of the limits that follows accepts it."""

SQUARED_POLISH_REACH = 1e-5
SINE_ROUNDING = 2e-15  # of sin q4 and what depends on it
COSINE_SLACK = 1e-7  # in a cosine, where it is only asked whether an end can matter


class Candidate(NamedTuple):
    """A roll that may be the best one: a point of the circle and the code of the constraint it sits on."""

    c: Expression
    s: Expression
    code: int


class Verdict(NamedTuple):
    """Which constraints a roll meets; scalar conditions."""

    pitch: Expression
    yaw: Expression
    pitch_angles: Expression
    yaw_angles: Expression
    slide_lower: Expression
    slide_upper: Expression

    def relaxed(self) -> Expression:
        """Whether all is met but for the limits of joint 1."""
        return ca.logic_and(self.pitch_side(), ca.logic_and(self.yaw, self.yaw_angles))

    def pitch_side(self) -> Expression:
        """Whether the pitch link reaches and joints 4, 5 and 6 are within limits."""
        return ca.logic_and(self.pitch, self.pitch_angles)

    def angles(self) -> Expression:
        """Whether joints 2 to 6 are within limits."""
        return ca.logic_and(self.pitch_angles, self.yaw_angles)

    def slide(self) -> Expression:
        """Whether the limits of joint 1 are met."""
        return ca.logic_and(self.slide_lower, self.slide_upper)


class Level(NamedTuple):
    """A value of cos q2 at which an arc may end.

    Attributes:
        cosine: The value.
        code: Of the constraint, in ACTIVE.
        above: Whether the constraint is met above the value, not below.
        relevant: Whether joints 2 and 3 are within their limits at that value, in the branch at hand.
    """

    cosine: Expression
    code: int
    above: bool
    relevant: Expression


def limit_code(joint: int, upper: bool) -> int:
    """Code in ACTIVE of a limit of joint 1..6."""
    return 3 + 2 * (joint - 1) + int(upper)


def index_harmonics(rig: Rig, tunnel: Tunnel, target: Expression) -> Harmonics:
    """I1 of (36) as a function of roll: with D = diag(w / range^2) it has two harmonics and no more."""
    axle, e_c, e_s = corner_circle(rig, target)
    offset = axle - ca.DM(tunnel.center)
    weight = ca.DM(tunnel.scale)
    d_c, d_s = weight * e_c, weight * e_s
    lg = rig.goose_neck
    cc, ss = ca.dot(e_c, d_c), ca.dot(e_s, d_s)
    return Harmonics(
        ca.dot(offset, weight * offset) + lg**2 / 2 * (cc + ss),
        2 * lg * ca.dot(offset, d_c),
        2 * lg * ca.dot(offset, d_s),
        lg**2 / 2 * (cc - ss),
        lg**2 * ca.dot(e_c, d_s),
    )


def check_constraints(rig: Rig, target: Expression, posture: RigConfiguration, c: Expression, s: Expression) -> Verdict:
    """Whether a posture is within reach and limits. Angles are compared by their cosine from the middle."""
    p = posture
    pair3 = _difference(ca.sin(target[3]), -ca.cos(target[3]), p.sin2, p.cos2)  # yaw - pi/2 - q2
    pair5 = _difference(-ca.sin(target[4]), ca.cos(target[4]), p.sin4, p.cos4)  # pitch + pi/2 - q4
    pairs = {2: (p.sin2, p.cos2), 3: (pair3[1], pair3[0]), 4: (p.sin4, p.cos4), 5: (pair5[1], pair5[0]), 6: (s, c)}
    angles: dict[bool, Expression] = {False: 1, True: 1}
    for joint, (sine, cosine) in pairs.items():
        if rig.limited(joint):
            inside = _within(rig, joint, sine, cosine, 0.0)
            angles[joint > 3] = ca.logic_and(angles[joint > 3], inside)
    low, high = rig.limit(1, False), rig.limit(1, True)
    slide = p.q1 >= low if np.isfinite(low) else 1, p.q1 <= high if np.isfinite(high) else 1
    return Verdict(ca.fabs(p.sin4) <= 1, ca.fabs(p.cos2) <= 1, angles[True], angles[False], *slide)


def infeasibility_code(rig: Rig, target: Expression, branch: Branch) -> Expression:
    """Code in STATUS of a target that no roll holds: which link does not reach, or else that limits are in the way."""
    rig = rig.unlimited()
    axle, e_c, _ = corner_circle(rig, target)
    pitch = ca.fabs(axle[2]) - rig.goose_neck * ca.fabs(e_c[2]) <= rig.pitch_link
    points: list[Point] = [(1.0, 0.0)]
    points += [(end.c, end.s) for end in angle_ends(rig, target, branch)]
    yaw: Expression = 0
    for c, s in points:
        yaw = ca.logic_or(
            yaw, check_constraints(rig, target, configuration_at(rig, target, c, s, branch), c, s).relaxed()
        )
    return ca.if_else(pitch, ca.if_else(yaw, 4, 3), 2)


def angle_ends(rig: Rig, target: Expression, branch: Branch) -> list[Candidate]:
    """Ends of the reachable arcs by everything but the limits of joint 1, and points that mean nothing among them."""
    ends = simple_ends(rig, target, branch)
    chart = yaw_chart(rig, branch)
    for level in yaw_levels(rig, target, branch):
        for point in level_points(rig, target, level.cosine):
            above = 1 if level.above else -1
            ends.append(Candidate(*sharp_level(rig, chart, target, level.cosine, above, point), level.code))
    return ends


def simple_ends(rig: Rig, target: Expression, branch: Branch) -> list[Candidate]:
    """Ends by joints 4, 5 and 6 and by the reach of the pitch link, to rounding."""
    axle, e_c, _ = corner_circle(rig, target)
    ends = []
    for sine, code in _pitch_sines(rig, target, branch):
        c = (-rig.pitch_link * sine - axle[2]) / _not_zero(rig.goose_neck * e_c[2])
        c = ca.fmin(ca.fmax(c, -1.0), 1.0)
        s = ca.sqrt((1 - c) * (1 + c))
        ends += [Candidate(c, s, code), Candidate(c, -s, code)]
    for upper in (False, True):
        if rig.limited(6):
            angle = inside_limit(rig, 6, upper)
            ends.append(Candidate(np.cos(angle), np.sin(angle), limit_code(6, upper)))
    return ends


def yaw_levels(rig: Rig, target: Expression, branch: Branch) -> list[Level]:
    """Values of cos q2 at which an arc may end: by joints 2 and 3 and by the reach of the yaw link."""
    found = []
    s_yaw, c_yaw = ca.sin(target[3]), ca.cos(target[3])

    def add(sine: Expression, cosine: Expression, code: int, above: bool, within: Expression) -> None:
        """Adds the level of q2 with this sine and cosine, if joint 3 allows it."""
        if code // 2 != limit_code(3, False) // 2 and rig.limited(3):
            cosine_3, sine_3 = _difference(s_yaw, -c_yaw, sine, cosine)
            within = ca.logic_and(within, _within(rig, 3, sine_3, cosine_3))
        found.append(Level(cosine, code, above, within))

    for sign, angle in ((1, 0.0), (-1, np.pi)):
        if _allows(rig, 2, angle):
            add(0.0, sign * (1 - REACH_INSET), 2, sign < 0, 1)
    for upper in (False, True):
        if rig.limited(2):
            angle = inside_limit(rig, 2, upper)
            if branch.yaw * np.sin(angle) > 0:
                add(np.sin(angle), np.cos(angle), limit_code(2, upper), (branch.yaw < 0) != upper, 1)
        if rig.limited(3):
            angle = inside_limit(rig, 3, upper)
            cosine = s_yaw * np.cos(angle) - c_yaw * np.sin(angle)  # of q2 = yaw - pi/2 - q3
            sine = -c_yaw * np.cos(angle) - s_yaw * np.sin(angle)
            within = ca.logic_and(branch.yaw * sine > -COSINE_SLACK, _within(rig, 2, sine, cosine))
            add(sine, cosine, limit_code(3, upper), (branch.yaw < 0) == upper, within)
    return found


def level_points(rig: Rig, target: Expression, cosine: Expression) -> list[Point]:
    """Four points near the rolls at which cos q2 takes a value, in any branch; to be polished by sharp_point.

    Here the equation is squared: where the pitch link is nearly stretched it is smooth and cos q2 is not, where the
    yaw is nearly 0 it has nearly double roots and cos q2 has not.
    """
    axle, e_c, e_s = corner_circle(rig, target)
    lg, lp = rig.goose_neck, rig.pitch_link
    s_yaw, c_yaw = ca.sin(target[3]), ca.cos(target[3])
    stretched = minus(Harmonics(lp**2, 0, 0, 0, 0), first_square(axle[2], lg * e_c[2], lg * e_s[2]))
    level = axle[1] - rig.yaw_link_2 * s_yaw - rig.yaw_offset * c_yaw
    square = first_square(level - rig.yaw_link_1 * cosine, lg * e_c[1], lg * e_s[1])
    f = minus(square, scaled(stretched, s_yaw * s_yaw))
    slope = f.derivative()
    # a double root leaves Newton nothing but rounding to go by: hence the short reach
    return [
        polish(p, lambda c, s: (f.value(c, s), slope.value(c, s)), 2, SQUARED_POLISH_REACH) for p in roots(f, steps=0)
    ]


def _pitch_sines(rig: Rig, target: Expression, branch: Branch) -> list[tuple[Expression, int]]:
    """Values of sin q4 at which an arc may end."""
    found: list[tuple[Expression, int]] = []
    for sign in (-1, 1):
        if _allows(rig, 4, sign * np.pi / 2):
            found.append((sign * (1 - REACH_INSET), 1))
    for upper in (False, True):
        if rig.limited(4):
            angle = inside_limit(rig, 4, upper)
            if branch.pitch * np.cos(angle) > 0:
                found.append((np.sin(angle), limit_code(4, upper)))
        if rig.limited(5):
            found.append((ca.cos(target[4] - inside_limit(rig, 5, upper)), limit_code(5, upper)))
    return found


def inside_limit(rig: Rig, joint: int, upper: bool) -> float:
    """Position of a joint just inside one of its limits, m or rad."""
    return rig.limit(joint, upper) + (-1 if upper else 1) * ANGLE_INSET


def _within(rig: Rig, joint: int, sine: Expression, cosine: Expression, slack: float = COSINE_SLACK) -> Expression:
    """Whether an angle given by its sine and cosine is within the limits of a joint, or as good as."""
    if not rig.limited(joint):
        return 1
    middle, half = rig.middle_and_half(joint)
    return np.cos(middle) * cosine + np.sin(middle) * sine >= np.cos(half) - slack


def _allows(rig: Rig, joint: int, angle: float) -> bool:
    """Whether the limits of a joint allow an angle, in whatever turn."""
    if not rig.limited(joint):
        return True
    middle, half = rig.middle_and_half(joint)
    return bool(np.cos(angle - middle) >= np.cos(half) - 1e-9)


def yaw_chart(rig: Rig, branch: Branch) -> Any:
    """Function (target, cosine, sine of roll) -> cos q2, its derivative by roll, q1, its derivative, cos q4."""
    t, c, s = ca.SX.sym("target", 5), ca.SX.sym("c"), ca.SX.sym("s")
    posture = configuration_at(rig, t, c, s, branch)
    values = ca.vertcat(posture.cos2, posture.q1)
    slope = ca.jacobian(values, c) * -s + ca.jacobian(values, s) * c
    return ca.Function("chart", [t, c, s], [values[0], slope[0], values[1], slope[1], posture.cos4])


def sharp_point(chart: Any, target: Expression, output: int, value: Expression, point: Point) -> Point:
    """A point polished until cos q2 (output 0 of the chart) or q1 (output 2) takes a value."""
    return polish(point, sharper(chart, target, output, value))


def sharp_level(rig: Rig, chart: Any, target: Expression, value: Expression, above: Any, point: Point) -> Point:
    """A point polished until cos q2 takes a value, or is beyond it by as much as rounding may take away again.

    Where the pitch link is nearly stretched the rounding of sin q4 is amplified by 1 / cos q4. `above` is 1 where the
    constraint is met above the value, -1 where it is met below.
    """
    c, s = sharp_point(chart, target, 0, value, point)
    cos4 = ca.fabs(chart(target, c, s)[4])
    margin = SINE_ROUNDING * rig.pitch_link / rig.yaw_link_1 / (cos4 + 1e-8)
    return polish((c, s), sharper(chart, target, 0, value + above * margin), 1)


def sharper(chart: Any, target: Expression, output: int, value: Expression) -> Slope:
    """Output 0 or 2 of the chart less a value, and its derivative by roll, to polish with."""

    def function(c: Expression, s: Expression) -> Point:
        found = chart(target, c, s)
        return found[output] - value, found[output + 1]

    return function


def _difference(cos_a: Expression, sin_a: Expression, sin_b: Expression, cos_b: Expression) -> Point:
    """Cosine and sine of a - b."""
    return cos_a * cos_b + sin_a * sin_b, sin_a * cos_b - cos_a * sin_b


def _not_zero(x: Expression) -> Expression:
    return x + ca.if_else(ca.fabs(x) < 1e-150, 1e-150, 0.0)


def slide_ends(rig: Rig, branch: Branch, upper: bool) -> Any:
    """Function of the target -> ends of the reachable arcs by one limit of joint 1, and points that mean nothing.

    Output shape (2, 8): rows cosine and sine of the roll.
    """
    t, points = ca.SX.sym("target", 5), ca.SX.sym("points", 2, 8)
    slope = sharper(yaw_chart(rig, branch), t, 2, inside_limit(rig, 1, upper))
    sharp = [ca.vertcat(*polish((points[0, k], points[1, k]), slope)) for k in range(8)]
    polished = ca.Function("polished", [t, points], [ca.horzcat(*sharp)])
    target = ca.MX.sym("target", 5)
    found = polished(target, slide_points(rig, upper)(target))
    return ca.Function("slide_ends", [target], [found], ["target"], ["points"])


def slide_points(rig: Rig, upper: bool) -> Any:
    """Function of the target -> points near the ends of arcs by one limit of joint 1. Output shape (2, 8)."""
    limit = inside_limit(rig, 1, upper)
    t = ca.SX.sym("target", 5)
    axle, e_c, e_s = corner_circle(rig, t)
    s_yaw, c_yaw = ca.sin(t[3]), ca.cos(t[3])
    lg = rig.goose_neck

    def first(constant: Expression, row: int) -> Series:
        return [(constant, 0.0), (lg * e_c[row], lg * e_s[row])]

    x = first(axle[0] - rig.yaw_link_2 * c_yaw + rig.yaw_offset * s_yaw - limit, 0)
    y = first(axle[1] - rig.yaw_link_2 * s_yaw - rig.yaw_offset * c_yaw, 1)
    height = product(first(axle[2], 2), first(axle[2], 2))
    stretched = added([(rig.pitch_link**2, 0.0)], height, -1)
    known = added(added(product(x, x), product(y, y)), added(stretched, [(rig.yaw_link_1**2, 0.0)], -1))
    along = added([(c_yaw * a, c_yaw * b) for a, b in x], [(s_yaw * a, s_yaw * b) for a, b in y])
    f = added(product(known, known), product(stretched, product(along, along)), -4)
    outputs = ca.cse([ca.vertcat(ca.horzcat(*[a for a, _ in f]), ca.horzcat(*[b for _, b in f]))])
    coefficients = ca.Function("slide", [t], outputs)
    target = ca.MX.sym("target", 5)
    return ca.Function("slide_points", [target], [series_roots(4)(coefficients(target))], ["target"], ["points"])


def checked_gain(rate_weight: float) -> float:
    """w4 / (2 pi); ModelError for a weight that is negative or not finite."""
    return checked_nonnegative(rate_weight, "rig", "rate_weight") / FULL_TURN


def unwrap_roll(rig: Rig, c: Expression, s: Expression, previous: Expression) -> Expression:
    """Roll of a point of the circle in the turn that is nearest to the previous roll, or in that of the limits."""
    angle = ca.atan2(s, c)
    if rig.limited(6):
        return in_nearest_turn(angle, rig.middle_and_half(6)[0])
    return in_turn_after(angle, roll_window(rig, previous)[0])


def roll_window(rig: Rig, previous: Expression) -> tuple[Expression, Expression]:
    """The turn, or less, of rolls within the limits of joint 6 in which each roll is nearest to the previous one."""
    start, low, high = previous - np.pi, rig.limit(6, False), rig.limit(6, True)
    if not np.isfinite(low):
        return start, start + FULL_TURN
    start = ca.fmax(low, ca.fmin(start, high - FULL_TURN))
    return start, ca.fmin(high, start + FULL_TURN)


def convex_minima(rig: Rig, tunnel: Tunnel, gain: float) -> Any:
    """Function (target, previous) -> rolls, shape (5, 1), rad, among which are all minima of I1 + gain change^2.

    Where I2 is convex one descent does; else the window of rolls is cut where I1'' = -2 gain, and every piece that is
    convex has a minimum of its own.
    """
    target, previous = ca.SX.sym("target", 5), ca.SX.sym("previous")
    f = index_harmonics(rig, tunnel, target)
    start, end = roll_window(rig, previous)
    start, end = start + 2 * ANGLE_INSET, end - 2 * ANGLE_INSET
    first = ca.fmin(ca.fmax(previous, start), end)
    whole = descend(f, gain, previous, start, end, first, 12)  # Newton steps to rounding, from near
    convex = ca.Function("convex", [target, previous], [ca.repmat(whole, 5, 1)])
    cuts = [start, *_sorted(_splits(f, gain, start, end)), end]
    pieces = [descend(f, gain, previous, a, b, (a + b) / 2, 20) for a, b in pairwise(cuts)]
    cut = ca.Function("pieces", [target, previous], [ca.vertcat(*pieces)])
    is_convex = ca.Function("is_convex", [target], [2 * gain >= f.slope_bound()])
    x, before = ca.MX.sym("target", 5), ca.MX.sym("previous")
    rolls = ca.Function.if_else("descend", convex, cut)(is_convex(x), x, before)
    return ca.Function("convex_minima", [x, before], [rolls])


def descend(
    f: Harmonics, gain: float, previous: Expression, a: Expression, b: Expression, start: Expression, steps: int
) -> Expression:
    """Minimum of I2 on an interval [a, b] where it is convex, by Newton steps kept in a bracket that shrinks."""
    slope, bend = f.derivative(), f.derivative().derivative()
    x = start
    for _ in range(steps):
        c, s = ca.cos(x), ca.sin(x)
        value = slope.value(c, s) + 2 * gain * (x - previous)
        curvature = bend.value(c, s) + 2 * gain
        a, b = ca.if_else(value > 0, a, x), ca.if_else(value > 0, x, b)
        newton = x - value / curvature
        x = ca.if_else(ca.logic_and(newton >= a, newton <= b), newton, (a + b) / 2)
    return x


def _splits(f: Harmonics, gain: float, start: Expression, end: Expression) -> list[Expression]:
    """Where I1'' = -2 k within the window, and rolls that mean nothing: I2 is convex or concave between them."""
    bend = f.derivative().derivative()
    points = roots(bend._replace(a0=2 * gain))
    return [ca.fmin(in_turn_after(ca.atan2(s, c), start), end) for c, s in points]


def _sorted(values: list[Expression]) -> list[Expression]:
    """Four expressions in order, by a network of five exchanges."""
    v = list(values)
    for i, k in ((0, 1), (2, 3), (0, 2), (1, 3), (1, 2)):
        v[i], v[k] = ca.fmin(v[i], v[k]), ca.fmax(v[i], v[k])
    return v
