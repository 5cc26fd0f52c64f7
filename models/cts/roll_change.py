"""The index I2 = I1 + w4 / (2 pi) (roll - previous)^2 of the rig, (37): the turn a roll is counted in, and all minima.

I2 is the only place where a roll is more than a point of the circle: it grows with every whole turn away from the roll
before. Its minima are found by Newton steps on intervals where it is convex; at most four roots of I1'' cut these out.
"""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import casadi as ca
import numpy as np

from models.arrays import checked_nonnegative
from models.cts.rig import Rig, Tunnel, in_nearest_turn, in_turn_after
from models.cts.roll import ANGLE_INSET, index_harmonics
from models.cts.trigonometric import Harmonics, roots
from models.spatial import FULL_TURN, Expression


def checked_gain(rate_weight: float) -> float:
    """w4 / (2 pi); ModelError for a weight that is negative or not finite."""
    return checked_nonnegative(rate_weight, "rig", "rate_weight") / FULL_TURN


def unrolled(rig: Rig, c: Expression, s: Expression, previous: Expression) -> Expression:
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
