"""Which rolls the rig can take for a target, and what they cost: the index I1 and the ends of the reachable arcs.

Roll enters as a point (cosine, sine) of the unit circle. The set of rolls that reach, within reach of both links and
within the joint limits, is a set of arcs; every end of an arc is a root of a trigonometric polynomial of degree 1
(joints 4 and 5 and the reach of the pitch link), 2 (joints 2 and 3 and the reach of the yaw link) or 4 (joint 1).
"""

from __future__ import annotations

from typing import Any, NamedTuple

import casadi as ca
import numpy as np

from models.cts import HALF_PI, Branch, Posture, Rig, Tunnel, corner_circle, posture_at
from models.harmonics import (
    Harmonics,
    Point,
    Series,
    Slope,
    first_square,
    minus,
    polish,
    product,
    roots,
    scaled,
    series_roots,
)
from models.spatial import Expression

LIMITS = tuple(f"joint {joint} {side}" for joint in range(1, 7) for side in ("lower", "upper"))
ACTIVE = ("free", "pitch reach", "yaw reach", *LIMITS)
"""Name of the constraint that holds a roll back, by its code."""

STATUS = ("ok", "not a number", "pitch link out of reach", "yaw link out of reach", "joint limits")
"""Why there is no roll, by its code."""

ANGLE_INSET = 1e-10
REACH_INSET = 1e-13
"""How far inside its limit an end is placed, so that the strict check of the limits that follows accepts it."""


class Candidate(NamedTuple):
    """A roll that may be the best one: a point of the circle and the code of the constraint it sits on."""

    c: Expression
    s: Expression
    code: int


class Verdict(NamedTuple):
    """Which constraints a roll meets; scalar conditions."""

    pitch: Expression
    yaw: Expression
    angles: Expression
    slide: Expression


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


def verdict(rig: Rig, target: Expression, posture: Posture, c: Expression, s: Expression) -> Verdict:
    """Whether a posture is within reach and limits. Angles are compared by their cosine from the middle."""
    p = posture
    pair3 = _difference(ca.sin(target[3]), -ca.cos(target[3]), p.sin2, p.cos2)  # yaw - pi/2 - q2
    pair5 = _difference(-ca.sin(target[4]), ca.cos(target[4]), p.sin4, p.cos4)  # pitch + pi/2 - q4
    pairs = {2: (p.sin2, p.cos2), 3: (pair3[1], pair3[0]), 4: (p.sin4, p.cos4), 5: (pair5[1], pair5[0]), 6: (s, c)}
    angles: Expression = 1
    for joint, (sine, cosine) in pairs.items():
        if rig.limited(joint):
            low, high = rig.lower[joint - 1], rig.upper[joint - 1]
            middle, half = (low + high) / 2, (high - low) / 2
            inside = np.cos(middle) * cosine + np.sin(middle) * sine >= np.cos(half)
            angles = ca.logic_and(angles, inside)
    slide: Expression = 1
    if np.isfinite(rig.lower[0]):
        slide = ca.logic_and(slide, p.q1 >= rig.lower[0])
    if np.isfinite(rig.upper[0]):
        slide = ca.logic_and(slide, p.q1 <= rig.upper[0])
    return Verdict(ca.fabs(p.sin4) <= 1, ca.fabs(p.cos2) <= 1, angles, slide)


def angle_ends(rig: Rig, target: Expression, branch: Branch) -> list[Candidate]:
    """Ends of the reachable arcs by everything but the limits of joint 1, and points that mean nothing among them."""
    axle, e_c, e_s = corner_circle(rig, target)
    lg, lp = rig.goose_neck, rig.pitch_link
    ends = []
    for sine, code in _pitch_sines(rig, target, branch):
        c = (-lp * sine - axle[2]) / _not_zero(lg * e_c[2])
        c = ca.fmin(ca.fmax(c, -1.0), 1.0)
        s = ca.sqrt((1 - c) * (1 + c))
        ends += [Candidate(c, s, code), Candidate(c, -s, code)]

    s_yaw, c_yaw = ca.sin(target[3]), ca.cos(target[3])
    stretched = minus(Harmonics(lp**2, 0, 0, 0, 0), first_square(axle[2], lg * e_c[2], lg * e_s[2]))
    level = axle[1] - rig.yaw_link_2 * s_yaw - rig.yaw_offset * c_yaw
    chart = _chart(rig, branch)
    for cosine, code in _yaw_cosines(rig, target, branch):
        square = first_square(level - rig.yaw_link_1 * cosine, lg * e_c[1], lg * e_s[1])
        f = minus(square, scaled(stretched, s_yaw * s_yaw))
        ends += [Candidate(*point, code) for point in roots(f, _sharper(chart, target, 0, cosine))]

    for upper in (False, True):
        if rig.limited(6):
            angle = _inside(rig, 6, upper)
            ends.append(Candidate(np.cos(angle), np.sin(angle), limit_code(6, upper)))
    return ends


def slide_ends(rig: Rig, branch: Branch, upper: bool) -> Any:
    """Function of the target -> ends of the reachable arcs by one limit of joint 1, and points that mean nothing.

    Output shape (2, 8): rows cosine and sine of the roll.
    """
    limit = (rig.upper if upper else rig.lower)[0]
    limit += (-1 if upper else 1) * ANGLE_INSET
    t, points = ca.SX.sym("target", 5), ca.SX.sym("points", 2, 8)
    axle, e_c, e_s = corner_circle(rig, t)
    s_yaw, c_yaw = ca.sin(t[3]), ca.cos(t[3])
    lg = rig.goose_neck

    def first(constant: Expression, row: int) -> Series:
        return [(constant, 0.0), (lg * e_c[row], lg * e_s[row])]

    x = first(axle[0] - rig.yaw_link_2 * c_yaw + rig.yaw_offset * s_yaw - limit, 0)
    y = first(axle[1] - rig.yaw_link_2 * s_yaw - rig.yaw_offset * c_yaw, 1)
    height = product(first(axle[2], 2), first(axle[2], 2))
    stretched = _sum([(rig.pitch_link**2, 0.0)], height, -1)
    known = _sum(_sum(product(x, x), product(y, y)), _sum(stretched, [(rig.yaw_link_1**2, 0.0)], -1))
    along = _sum([(c_yaw * a, c_yaw * b) for a, b in x], [(s_yaw * a, s_yaw * b) for a, b in y])
    f = _sum(product(known, known), product(stretched, product(along, along)), -4)
    coefficients = ca.Function(
        "slide", [t], [ca.vertcat(ca.horzcat(*[a for a, _ in f]), ca.horzcat(*[b for _, b in f]))]
    )
    sharper = _sharper(_chart(rig, branch), t, 2, limit)
    sharp = [ca.vertcat(*polish((points[0, k], points[1, k]), sharper)) for k in range(8)]
    polished = ca.Function("slide_ends", [t, points], [ca.horzcat(*sharp)])
    target = ca.MX.sym("target", 5)
    found = polished(target, series_roots(4)(coefficients(target)))
    return ca.Function("slide_ends", [target], [found], ["target"], ["points"])


def _pitch_sines(rig: Rig, target: Expression, branch: Branch) -> list[tuple[Expression, int]]:
    """Values of sin q4 at which an arc may end."""
    found: list[tuple[Expression, int]] = []
    for sign in (-1, 1):
        if _allows(rig, 4, sign * HALF_PI):
            found.append((sign * (1 - REACH_INSET), 1))
    for upper in (False, True):
        if rig.limited(4):
            angle = _inside(rig, 4, upper)
            if branch.pitch * np.cos(angle) > 0:
                found.append((np.sin(angle), limit_code(4, upper)))
        if rig.limited(5):
            found.append((ca.cos(target[4] - _inside(rig, 5, upper)), limit_code(5, upper)))
    return found


def _yaw_cosines(rig: Rig, target: Expression, branch: Branch) -> list[tuple[Expression, int]]:
    """Values of cos q2 at which an arc may end."""
    found: list[tuple[Expression, int]] = []
    for sign, angle in ((1, 0.0), (-1, np.pi)):
        if _allows(rig, 2, angle):
            found.append((sign * (1 - REACH_INSET), 2))
    for upper in (False, True):
        if rig.limited(2):
            angle = _inside(rig, 2, upper)
            if branch.yaw * np.sin(angle) > 0:
                found.append((np.cos(angle), limit_code(2, upper)))
        if rig.limited(3):
            found.append((ca.sin(target[3] - _inside(rig, 3, upper)), limit_code(3, upper)))
    return found


def _inside(rig: Rig, joint: int, upper: bool) -> float:
    return float(rig.upper[joint - 1] - ANGLE_INSET if upper else rig.lower[joint - 1] + ANGLE_INSET)


def _allows(rig: Rig, joint: int, angle: float) -> bool:
    """Whether the limits of a joint allow an angle, in whatever turn."""
    if not rig.limited(joint):
        return True
    low, high = rig.lower[joint - 1], rig.upper[joint - 1]
    return bool(np.cos(angle - (low + high) / 2) >= np.cos((high - low) / 2) - 1e-9)


def _chart(rig: Rig, branch: Branch) -> Any:
    """Function (target, cosine, sine of roll) -> cos q2, its derivative by roll, q1, its derivative."""
    t, c, s = ca.SX.sym("target", 5), ca.SX.sym("c"), ca.SX.sym("s")
    posture = posture_at(rig, t, c, s, branch)
    values = ca.vertcat(posture.cos2, posture.q1)
    slope = ca.jacobian(values, c) * -s + ca.jacobian(values, s) * c
    return ca.Function("chart", [t, c, s], [values[0], slope[0], values[1], slope[1]])


def _sharper(chart: Any, target: Expression, output: int, value: Expression) -> Slope:
    def function(c: Expression, s: Expression) -> Point:
        found = chart(target, c, s)
        return found[output] - value, found[output + 1]

    return function


def _difference(cos_a: Expression, sin_a: Expression, sin_b: Expression, cos_b: Expression) -> Point:
    """Cosine and sine of a - b."""
    return cos_a * cos_b + sin_a * sin_b, sin_a * cos_b - cos_a * sin_b


def _not_zero(x: Expression) -> Expression:
    return x + ca.if_else(ca.fabs(x) < 1e-150, 1e-150, 0.0)


def _sum(f: Series, g: Series, factor: float = 1) -> Series:
    zero: Series = [(0.0, 0.0)]
    size = max(len(f), len(g))
    longer = [f + zero * (size - len(f)), g + zero * (size - len(g))]
    return [(a + factor * c, b + factor * d) for (a, b), (c, d) in zip(*longer, strict=True)]
