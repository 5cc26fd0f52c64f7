"""Feasible roll angles of the rig for a target, and the cost indices I1 and I2 by which they are compared.

The roll is the rotation of the store about the tool axis, which the task leaves free. At a given target, that is
position, yaw and pitch, it determines the positions of all joints up to the branch. It is represented as a point
(cosine, sine) of the unit circle. The feasible rolls, within reach of both links and within the joint limits, form a
set of arcs. Every end of an arc is a root of a trigonometric polynomial of degree 1 (joints 4 and 5 and the reach of
the pitch link), 2 (joints 2 and 3 and the reach of the yaw link) or 4 (joint 1).

The index I2 = I1 + w4 / (2 pi) (roll - previous)^2, equation (37) of Lee, Lee 2017, also depends on the turn of a roll.
Its minima are found by Newton's method on intervals of convexity, which at most four roots of I1'' + const delimit.
"""

from __future__ import annotations

from itertools import pairwise
from typing import Any, NamedTuple

import casadi as ca
import numpy as np

from models.checks import require
from models.cts.rig import (
    Branch,
    Rig,
    RigConfiguration,
    Tunnel,
    configuration_at,
    corner_circle,
    first_turn_after,
    nearest_turn,
)
from models.cts.trigonometric import (
    Harmonics,
    Point,
    Series,
    Slope,
    add_series,
    multiply_series,
    polish,
    roots,
    scale_harmonics,
    series_roots,
    square_of_first_harmonic,
    subtract_harmonics,
)
from models.spatial import FULL_TURN, Expression

LIMIT_NAMES = tuple(f"joint {joint} {side}" for joint in range(1, 7) for side in ("lower", "upper"))
ACTIVE = ("free", "pitch reach", "yaw reach", *LIMIT_NAMES, "clearance")
"""Names of the constraints that may be active at a roll angle, in the order of their codes."""
STATUS = ("ok", "not a number", "pitch link out of reach", "yaw link out of reach", "joint limits", "clearance")
"""Status of a target, in the order of the codes: "ok", or the reason why the target has no feasible roll angle."""
ANGLE_INSET = 1e-10
REACH_INSET = 1e-13
"""Distances inside a limit at which ends of roll intervals are placed, so that a strict limit check accepts the ends.

ANGLE_INSET is in rad or m, REACH_INSET applies to a sine or cosine.
"""
SQUARED_POLISH_STEP = 1e-5
SINE_ROUNDING = 2e-15
"""Upper bound of the rounding error of sin q4."""
COSINE_SLACK = 1e-7
"""Tolerance of the cosine by which a joint limit is checked at a possible end of a roll interval."""


class Candidate(NamedTuple):
    """A roll angle that may be optimal, given by cosine and sine, and the index of its active constraint in ACTIVE."""

    c: Expression
    s: Expression
    code: int


class ConstraintCheck(NamedTuple):
    """Boolean expressions that state which reach constraints and joint limits are satisfied at a roll angle."""

    pitch: Expression
    yaw: Expression
    pitch_angles: Expression
    yaw_angles: Expression
    slide_lower: Expression
    slide_upper: Expression

    def all_but_slide(self) -> Expression:
        """Return whether all reach constraints and joint limits but those of joint 1 (the slide) are satisfied."""
        return ca.logic_and(self.is_pitch_reachable(), ca.logic_and(self.yaw, self.yaw_angles))

    def is_pitch_reachable(self) -> Expression:
        """Return whether the rig's pitch link reaches the target, with joints 4 to 6 inside their limits."""
        return ca.logic_and(self.pitch, self.pitch_angles)

    def slide(self) -> Expression:
        """Return whether joint 1 (the slide) is within its limits."""
        return ca.logic_and(self.slide_lower, self.slide_upper)


class ArcEndLevel(NamedTuple):
    """A value of cos q2, the cosine of the angle of joint 2, at which an interval of feasible roll angles may end.

    Attributes:
        cosine: The value.
        code: Code of the constraint, in ACTIVE.
        side: 1 if the constraint is satisfied above the value, -1 if below.
        relevant: Whether joints 2 and 3 are within their limits at the value, in the given branch.
        bound: Lower bound of the cost near the value; -inf if unknown.
    """

    cosine: Expression
    code: Expression
    side: Expression
    relevant: Expression
    bound: Expression = -ca.inf


def limit_code(joint: int, upper: bool) -> int:
    """Return the index in the list ACTIVE of the lower or upper position limit of a joint (number 1 to 6)."""
    return 3 + 2 * (joint - 1) + int(upper)


def index_harmonics(rig: Rig, tunnel: Tunnel, target: Expression) -> Harmonics:
    """Return the cost index I1, a squared distance from the tunnel's centre, as a trigonometric polynomial of the roll.

    Equation (36) of Lee, Lee 2017.
    """
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


def check_constraints(
    rig: Rig, target: Expression, configuration: RigConfiguration, *, c: Expression, s: Expression
) -> ConstraintCheck:
    """Return which reach constraints and joint limits a rig configuration satisfies, by comparing cosines of angles."""
    p = configuration
    pair3 = _difference(ca.sin(target[3]), -ca.cos(target[3]), p.sin2, p.cos2)  # yaw - pi/2 - q2
    pair5 = _difference(-ca.sin(target[4]), ca.cos(target[4]), p.sin4, p.cos4)  # pitch + pi/2 - q4
    pairs = {2: (p.sin2, p.cos2), 3: (pair3[1], pair3[0]), 4: (p.sin4, p.cos4), 5: (pair5[1], pair5[0]), 6: (s, c)}
    angles: dict[bool, Expression] = {False: 1, True: 1}
    for joint, (sine, cosine) in pairs.items():
        if rig.limited(joint):
            angles[joint > 3] = ca.logic_and(angles[joint > 3], _within(rig, joint, sine, cosine, 0.0))
    low, high = rig.limit(1, False), rig.limit(1, True)
    slide = p.q1 >= low if np.isfinite(low) else 1, p.q1 <= high if np.isfinite(high) else 1
    return ConstraintCheck(ca.fabs(p.sin4) <= 1, ca.fabs(p.cos2) <= 1, angles[True], angles[False], *slide)


def infeasibility_code(rig: Rig, target: Expression, branch: Branch) -> Expression:
    """Return the index in the list STATUS of the reason why a target has no feasible roll: reach or joint limits."""
    rig = rig.unlimited()
    axle, e_c, _ = corner_circle(rig, target)
    pitch = ca.fabs(axle[2]) - rig.goose_neck * ca.fabs(e_c[2]) <= rig.pitch_link
    points: list[Point] = [(1.0, 0.0)]
    points += [(end.c, end.s) for end in arc_ends(rig, target, branch)]
    yaw: Expression = 0
    for c, s in points:
        configuration = configuration_at(rig, target, c, s, branch=branch)
        yaw = ca.logic_or(yaw, check_constraints(rig, target, configuration, c=c, s=s).all_but_slide())
    return ca.if_else(pitch, ca.if_else(yaw, 4, 3), 2)


def arc_ends(rig: Rig, target: Expression, branch: Branch) -> list[Candidate]:
    """Return roll angles that include all ends of feasible roll intervals except those at limits of joint 1."""
    ends = closed_form_ends(rig, target, branch)
    chart = yaw_chart(rig, branch)
    for level in yaw_levels(rig, target, branch):
        for point in level_points(rig, target, level.cosine):
            end = polish_to_level(rig, chart, target, value=level.cosine, above=level.side, point=point)
            ends.append(Candidate(*end, level.code))
    return ends


def closed_form_ends(rig: Rig, target: Expression, branch: Branch) -> list[Candidate]:
    """Return the possible ends of the rig's feasible roll intervals that have a closed form.

    They are due to the limits of joints 4 to 6 and to the reach of the pitch link.
    """
    axle, e_c, _ = corner_circle(rig, target)
    ends = []
    for sine, code in _pitch_sines(rig, target, branch):
        lever = rig.goose_neck * e_c[2]
        c = (-rig.pitch_link * sine - axle[2]) / (lever + ca.if_else(ca.fabs(lever) < 1e-150, 1e-150, 0.0))
        c = ca.fmin(ca.fmax(c, -1.0), 1.0)
        s = ca.sqrt((1 - c) * (1 + c))
        ends += [Candidate(c, s, code), Candidate(c, -s, code)]
    for upper in (False, True):
        if rig.limited(6):
            angle = inside_limit(rig, 6, upper)
            ends.append(Candidate(np.cos(angle), np.sin(angle), limit_code(6, upper)))
    return ends


def yaw_levels(rig: Rig, target: Expression, branch: Branch) -> list[ArcEndLevel]:
    """Return the values of cos q2 (joint angle 2) at which an interval of feasible roll angles may end.

    They are due to the limits of joints 2 and 3 and to the reach of the yaw link.
    """
    levels = []
    s_yaw, c_yaw = ca.sin(target[3]), ca.cos(target[3])

    def add(sine: Expression, cosine: Expression, code: int, above: bool, within: Expression) -> None:
        """Append to `levels` a value of cos q2 at which intervals may end, if joint 3 is then within its limits."""
        if code // 2 != limit_code(3, False) // 2 and rig.limited(3):
            cosine_3, sine_3 = _difference(s_yaw, -c_yaw, sine, cosine)
            within = ca.logic_and(within, _within(rig, 3, sine_3, cosine_3))
        levels.append(ArcEndLevel(cosine, code, 1 if above else -1, within))

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
    return levels


def level_points(rig: Rig, target: Expression, cosine: Expression) -> list[Point]:
    """Return four approximate roll angles, as (cos, sin), at which the cosine of joint 2's angle has a given value.

    They are roots of the squared equation cos q2 = `cosine`. The squared equation is smooth near a stretched pitch
    link, where cos q2 is not; near yaw 0 it has nearly double roots, where cos q2 has simple ones.
    """
    axle, e_c, e_s = corner_circle(rig, target)
    lg, lp = rig.goose_neck, rig.pitch_link
    s_yaw, c_yaw = ca.sin(target[3]), ca.cos(target[3])
    height = square_of_first_harmonic(axle[2], lg * e_c[2], lg * e_s[2])
    stretched = subtract_harmonics(Harmonics(lp**2, 0, 0, 0, 0), height)
    level = axle[1] - rig.yaw_link_2 * s_yaw - rig.yaw_offset * c_yaw
    square = square_of_first_harmonic(level - rig.yaw_link_1 * cosine, lg * e_c[1], lg * e_s[1])
    f = subtract_harmonics(square, scale_harmonics(stretched, s_yaw * s_yaw))
    slope = f.derivative()
    # at a double root a Newton step is mostly rounding error: hence the small step limit
    return [
        polish(p, lambda c, s: (f.value(c, s), slope.value(c, s)), steps=2, max_polish_step=SQUARED_POLISH_STEP)
        for p in roots(f, steps=0)
    ]


def _pitch_sines(rig: Rig, target: Expression, branch: Branch) -> list[tuple[Expression, int]]:
    """Return values of sin q4 (joint angle 4) at which feasible roll intervals may end, each with its limit's code."""
    sines: list[tuple[Expression, int]] = []
    for sign in (-1, 1):
        if _allows(rig, 4, sign * np.pi / 2):
            sines.append((sign * (1 - REACH_INSET), 1))
    for upper in (False, True):
        if rig.limited(4):
            angle = inside_limit(rig, 4, upper)
            if branch.pitch * np.cos(angle) > 0:
                sines.append((np.sin(angle), limit_code(4, upper)))
        if rig.limited(5):
            sines.append((ca.cos(target[4] - inside_limit(rig, 5, upper)), limit_code(5, upper)))
    return sines


def inside_limit(rig: Rig, joint: int, upper: bool) -> float:
    """Return a position of a joint slightly inside its lower or upper limit, m or rad."""
    return rig.limit(joint, upper) + (-1 if upper else 1) * ANGLE_INSET


def _within(rig: Rig, joint: int, sine: Expression, cosine: Expression, slack: float = COSINE_SLACK) -> Expression:
    """Return whether an angle, given by sine and cosine, is within a joint's limits, up to `slack` in the cosine."""
    if not rig.limited(joint):
        return 1
    middle, half = rig.middle_and_half(joint)
    return np.cos(middle) * cosine + np.sin(middle) * sine >= np.cos(half) - slack


def _allows(rig: Rig, joint: int, angle: float) -> bool:
    """Return whether an angle, possibly shifted by full turns, is within the limits of a joint."""
    if not rig.limited(joint):
        return True
    middle, half = rig.middle_and_half(joint)
    return bool(np.cos(angle - middle) >= np.cos(half) - 1e-9)


def yaw_chart(rig: Rig, branch: Branch) -> Any:
    """Return the CasADi Function from target and roll angle to cos q2, q1 and cos q4, where q are the joint positions.

    The limits of cos q2 and q1 bound the feasible rolls. The rounding error of cos q2 depends on cos q4. Signature:
    (target, cosine, sine of the roll) -> (cos q2, its slope, q1, its slope, cos q4); a slope is a derivative with
    respect to the roll angle. Other functions take the Function as their argument `chart`.
    """
    t, c, s = ca.SX.sym("target", 5), ca.SX.sym("c"), ca.SX.sym("s")
    configuration = configuration_at(rig, t, c, s, branch=branch)
    values = ca.vertcat(configuration.cos2, configuration.q1)
    slope = ca.jacobian(values, c) * -s + ca.jacobian(values, s) * c
    return ca.Function("chart", [t, c, s], [values[0], slope[0], values[1], slope[1], configuration.cos4])


def polish_to_level(rig: Rig, chart: Any, target: Expression, *, value: Expression, above: Any, point: Point) -> Point:
    """Return the roll angle at which cos q2 (angle of joint 2) is within a limit by a margin for rounding errors.

    Near a stretched pitch link the rounding error of sin q4 is amplified by 1 / cos q4. `above` is 1 if the constraint
    is satisfied above `value`, -1 if below.
    """
    c, s = polish(point, chart_residual(chart, target, 0, value))
    cos4 = ca.fabs(chart(target, c, s)[4])
    margin = SINE_ROUNDING * rig.pitch_link / rig.yaw_link_1 / (cos4 + 1e-8)
    return polish((c, s), chart_residual(chart, target, 0, value + above * margin), steps=1)


def chart_residual(chart: Any, target: Expression, output: int, value: Expression) -> Slope:
    """Return a function of the roll angle that is zero where cos q2, or the joint position q1, has a given value.

    `output` is 0 for cos q2 and 2 for q1. The function takes cosine and sine of the roll and also returns the
    derivative.
    """

    def function(c: Expression, s: Expression) -> Point:
        values = chart(target, c, s)
        return values[output] - value, values[output + 1]

    return function


def _difference(cos_a: Expression, sin_a: Expression, sin_b: Expression, cos_b: Expression) -> Point:
    """Return cosine and sine of the difference a - b of two angles that are given by their cosines and sines."""
    return cos_a * cos_b + sin_a * sin_b, sin_a * cos_b - cos_a * sin_b


def slide_ends(rig: Rig, branch: Branch, upper: bool) -> Any:
    """Return a CasADi Function that computes the roll angles at which joint 1 is at its lower or upper limit.

    The angles include all ends of feasible intervals at the limit. (target) -> (2, 8), rows cosine and sine of the
    roll.
    """
    t, points = ca.SX.sym("target", 5), ca.SX.sym("points", 2, 8)
    slope = chart_residual(yaw_chart(rig, branch), t, 2, inside_limit(rig, 1, upper))
    sharp = [ca.vertcat(*polish((points[0, k], points[1, k]), slope)) for k in range(8)]
    polished = ca.Function("polished", [t, points], [ca.horzcat(*sharp)])
    target = ca.MX.sym("target", 5)
    ends = polished(target, slide_points(rig, upper)(target))
    return ca.Function("slide_ends", [target], [ends], ["target"], ["points"])


def slide_points(rig: Rig, upper: bool) -> Any:
    """Return a CasADi Function for eight roll angles (cosine, sine) at which the prismatic joint may be at a limit."""
    limit = inside_limit(rig, 1, upper)
    t = ca.SX.sym("target", 5)
    axle, e_c, e_s = corner_circle(rig, t)
    s_yaw, c_yaw = ca.sin(t[3]), ca.cos(t[3])
    lg = rig.goose_neck

    def first(constant: Expression, row: int) -> Series:
        return [(constant, 0.0), (lg * e_c[row], lg * e_s[row])]

    x = first(axle[0] - rig.yaw_link_2 * c_yaw + rig.yaw_offset * s_yaw - limit, 0)
    y = first(axle[1] - rig.yaw_link_2 * s_yaw - rig.yaw_offset * c_yaw, 1)
    height = multiply_series(first(axle[2], 2), first(axle[2], 2))
    stretched = add_series([(rig.pitch_link**2, 0.0)], height, -1)
    square = add_series(multiply_series(x, x), multiply_series(y, y))
    known = add_series(square, add_series(stretched, [(rig.yaw_link_1**2, 0.0)], -1))
    along = add_series([(c_yaw * a, c_yaw * b) for a, b in x], [(s_yaw * a, s_yaw * b) for a, b in y])
    f = add_series(multiply_series(known, known), multiply_series(stretched, multiply_series(along, along)), -4)
    outputs = ca.cse([ca.vertcat(ca.horzcat(*[a for a, _ in f]), ca.horzcat(*[b for _, b in f]))])
    coefficients = ca.Function("slide", [t], outputs)
    target = ca.MX.sym("target", 5)
    return ca.Function("slide_points", [target], [series_roots(4)(coefficients(target))], ["target"], ["points"])


def checked_gain(rate_weight: float) -> float:
    """Check the weight w4 of the squared change of roll in the cost index I2, and return its factor w4 / (2 pi).

    Equation (37) of the paper.

    Raises:
        ModelError: The weight w4, `rate_weight`, is negative or not finite.
    """
    return require.nonnegative("rig: rate_weight", rate_weight) / FULL_TURN


def unwrap_roll(rig: Rig, c: Expression, s: Expression, previous: Expression) -> Expression:
    """Return the angle (rad) of a roll given by cosine and sine, within joint 6's limits and nearest to `previous`."""
    angle = ca.atan2(s, c)
    if rig.limited(6):
        return nearest_turn(angle, rig.middle_and_half(6)[0])
    return first_turn_after(angle, roll_window(rig, previous)[0])


def roll_window(rig: Rig, previous: Expression) -> tuple[Expression, Expression]:
    """Return both ends of the interval of admissible rolls, at most a full turn long, nearest to the previous roll."""
    start, low, high = previous - np.pi, rig.limit(6, False), rig.limit(6, True)
    if not np.isfinite(low):
        return start, start + FULL_TURN
    start = ca.fmax(low, ca.fmin(start, high - FULL_TURN))
    return start, ca.fmin(high, start + FULL_TURN)


def convex_minima(rig: Rig, tunnel: Tunnel, gain: float) -> Any:
    """Return a CasADi Function from target and previous roll to five roll angles that include all minima of the cost.

    The cost is the index I2 = I1 + gain (roll - previous)^2. Output shape (5, 1), rad. If I2 is convex, its one minimum
    is repeated. Otherwise the window of rolls is split where I1'' = -2 gain, and each interval yields one roll.
    """
    target, previous = ca.SX.sym("target", 5), ca.SX.sym("previous")
    f = index_harmonics(rig, tunnel, target)
    start, end = roll_window(rig, previous)
    start, end = start + 2 * ANGLE_INSET, end - 2 * ANGLE_INSET
    first = ca.fmin(ca.fmax(previous, start), end)
    minimum = minimize_convex(f, gain, previous, (start, end), start=first, steps=12)  # from a good start
    convex = ca.Function("convex", [target, previous], [ca.repmat(minimum, 5, 1)])
    inflections = roots(f.derivative().derivative()._replace(a0=2 * gain))
    turns = [ca.fmin(first_turn_after(ca.atan2(s, c), start), end) for c, s in inflections]
    bounds = [start, *_sort_four(turns), end]
    minima = [minimize_convex(f, gain, previous, (a, b), start=(a + b) / 2, steps=20) for a, b in pairwise(bounds)]
    by_intervals = ca.Function("pieces", [target, previous], [ca.vertcat(*minima)])
    is_convex = ca.Function("is_convex", [target], [2 * gain >= f.slope_bound()])
    x, before = ca.MX.sym("target", 5), ca.MX.sym("previous")
    rolls = ca.Function.if_else("descend", convex, by_intervals)(is_convex(x), x, before)
    return ca.Function("convex_minima", [x, before], [rolls])


def minimize_convex(
    f: Harmonics, gain: float, previous: Expression, bracket: Point, *, start: Expression, steps: int
) -> Expression:
    """Return the roll angle of least cost index I2 in a bracket where I2 is convex, by Newton and bisection steps."""
    a, b = bracket
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


def _sort_four(values: list[Expression]) -> list[Expression]:
    """Return four expressions in increasing order, by a sorting network of five compare-and-swap steps."""
    v = list(values)
    for i, k in ((0, 1), (2, 3), (0, 2), (1, 3), (1, 2)):
        v[i], v[k] = ca.fmin(v[i], v[k]), ca.fmax(v[i], v[k])
    return v
