"""Minima of I2, the index with the squared change of roll: on intervals where it is convex, by Newton steps."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import Any

import casadi as ca
import numpy as np

from models.cts import Rig, Tunnel
from models.cts_roll import ANGLE_INSET, index_harmonics
from models.harmonics import Harmonics, roots
from models.spatial import Expression

TURN = 2 * np.pi
CONVEX_STEPS, PIECE_STEPS = 12, 20


def unrolled(rig: Rig, c: Expression, s: Expression, previous: Expression) -> Expression:
    """Roll of a point of the circle in the turn that is nearest to the previous roll, or in that of the limits."""
    angle = ca.atan2(s, c)
    if rig.limited(6):
        middle = (rig.lower[5] + rig.upper[5]) / 2
        return angle - TURN * ca.floor((angle - middle) / TURN + 0.5)
    start = roll_window(rig, previous)[0]
    return angle + TURN * ca.ceil((start - angle) / TURN)


def roll_window(rig: Rig, previous: Expression) -> tuple[Expression, Expression]:
    """The turn, or less, of rolls within the limits of joint 6 in which each roll is nearest to the previous one."""
    start = previous - np.pi
    if not np.isfinite(rig.lower[5]):
        return start, start + TURN
    low, high = rig.lower[5], rig.upper[5]
    start = ca.fmax(low, ca.fmin(start, high - TURN))
    return start, ca.fmin(high, start + TURN)


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
    whole = descend(f, gain, previous, start, end, first, CONVEX_STEPS)
    convex = ca.Function("convex", [target, previous], [ca.repmat(whole, 5, 1)])
    cuts = [start, *_sorted(_splits(f, gain, start, end)), end]
    pieces = [descend(f, gain, previous, a, b, (a + b) / 2, PIECE_STEPS) for a, b in pairwise(cuts)]
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
    found = []
    for c, s in roots(bend._replace(a0=2 * gain)):
        angle = ca.atan2(s, c)
        found.append(ca.fmin(angle + TURN * ca.ceil((start - angle) / TURN), end))
    return found


def _sorted(values: Sequence[Expression]) -> list[Expression]:
    """Four expressions in order, by a network of five exchanges."""
    v = list(values)
    for i, k in ((0, 1), (2, 3), (0, 2), (1, 3), (1, 2)):
        v[i], v[k] = ca.fmin(v[i], v[k]), ca.fmax(v[i], v[k])
    return v
