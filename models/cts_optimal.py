"""Inverse kinematics of the rig with the globally best roll, in a bounded number of operations.

The best roll on a set of arcs is a stationary point of the index inside an arc or an end of an arc. All of them are
known in closed form (I1), or up to a Newton iteration on an interval where the index is convex (I2), so that the best
is found by comparison. Where the best roll of all is within limits, the ends of the arcs are not computed; the limits
of joint 1, whose ends cost most, are looked at last and only where they matter.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import casadi as ca
import numpy as np

from models.cts import HOME, Branch, Rig, Tunnel, joints_of, posture_at
from models.cts_roll import (
    ANGLE_INSET,
    Candidate,
    angle_ends,
    index_harmonics,
    limit_code,
    slide_ends,
    verdict,
)
from models.errors import ModelError
from models.harmonics import Harmonics, polish, roots
from models.spatial import Expression

TURN = 2 * np.pi
CONVEX_STEPS, PIECE_STEPS = 12, 20
BEST = 6
"""Entries of a best roll: cost, cosine, sine, code of ACTIVE, whether any roll let the pitch and the yaw link reach."""
NOTHING = ca.DM([ca.inf, 1, 0, 0, 0, 0, ca.inf, ca.inf])


def optimal_inverse(
    rig: Rig, tunnel: Tunnel, branch: Branch = HOME, *, rate_weight: float = 0.0, limits: bool = True
) -> Any:
    """Function (target, previous) -> (joints, cost, active, status): the joints with the roll of least index.

    Args:
        rig: Lengths and joint limits.
        tunnel: Centre, ranges and weights of the index.
        branch: Which of the four joint sets.
        rate_weight: w4 of I2 = I1 + w4 / (2 pi) (roll - previous)^2, (37); 0 for I1.
        limits: Whether reach and joint limits bound the roll. Without them the stationary point of least index is
            taken, in closed form only, and the status tells whether the pose is in reach and within limits.

    Returns:
        A casadi Function. Inputs: target (x, y, z, yaw, pitch), shape (5,); previous roll, rad. Outputs: joints,
        shape (6,), nan unless the status is 0; the index; code of the active constraint in cts_roll.ACTIVE; code in
        cts_roll.STATUS. The roll is given in the turn nearest to the previous one that the limits of joint 6 allow,
        or, where they allow less than a turn, in theirs.

    Raises:
        ModelError: A negative or non-finite rate weight; limits=False with a rate weight.
    """
    gain = checked_gain(rate_weight)
    if gain and not limits:
        raise ModelError("limits=False is for the closed form of I1; with a rate weight leave limits on")
    search = Search(rig, tunnel, branch, gain)
    target, previous = ca.MX.sym("target", 5), ca.MX.sym("previous")
    result, done, state = search.direct()(target, previous)
    if limits:
        result = _choose(search.thorough(), 9)(done, result, target, previous, state)
    out = ca.vertsplit(result, [0, 6, 7, 8, 9])
    name = f"optimal_inverse_{'i2' if gain else 'i1'}{'' if limits else '_free'}"
    labels = ["target", "previous"], ["joints", "cost", "active", "status"]
    return ca.Function(name, [target, previous], list(out), *labels)


def checked_gain(rate_weight: float) -> float:
    """w4 / (2 pi); ModelError for a weight that is negative or not finite."""
    if not (np.isfinite(rate_weight) and rate_weight >= 0):
        raise ModelError(f"rate_weight {rate_weight} must be finite and not negative")
    return float(rate_weight) / TURN


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


@dataclass(frozen=True)
class Search:
    """The steps of the search as casadi Functions, each given the state of the search by those before it.

    The state, shape (BEST + 2,), is the best roll so far, the least cost of any roll looked at, in reach or not, and
    the least cost of those that meet everything but the limits of joint 1.
    """

    rig: Rig
    tunnel: Tunnel
    branch: Branch
    gain: float

    def direct(self) -> Any:
        """Function (target, previous) -> (result, done, state): the stationary point of least index.

        `done` says that it settles the matter: it is within reach and limits, or the input is no number.
        """
        if not self.gain:
            target, previous = ca.SX.sym("target", 5), ca.SX.sym("previous")
            f = index_harmonics(self.rig, self.tunnel, target)
            cost, c, s = ca.SX(ca.inf), ca.SX(1), ca.SX(0)
            for x, y in roots(f.derivative(), steps=0):
                value = f.value(x, y)
                better = value < cost
                cost, c, s = ca.if_else(better, value, cost), ca.if_else(better, x, c), ca.if_else(better, y, s)
            slope, bend = f.derivative(), f.derivative().derivative()
            c, s = polish((c, s), lambda x, y: (slope.value(x, y), bend.value(x, y)), 2)
            result = self.result(target, previous, ca.vertcat(f.value(c, s), c, s, 0, 1, 1))
            done = result[8] <= 1
            outputs = ca.cse([result, done, NOTHING])
            return ca.Function("direct", [target, previous], outputs)
        x, before = ca.MX.sym("target", 5), ca.MX.sym("previous")
        state = self.stationary()(x, before)
        result = self.finish()(x, before, state[:BEST])
        return ca.Function("direct", [x, before], [result, state[BEST] >= state[0], state])

    def thorough(self) -> Any:
        """Function (target, previous, state) -> result, from the ends of the arcs."""
        target, previous, state = ca.MX.sym("target", 5), ca.MX.sym("previous"), ca.MX.sym("state", BEST + 2)
        best = self.ends()(target, previous, state)
        if np.isfinite([self.rig.lower[0], self.rig.upper[0]]).any():
            best = _choose(self.slide(), BEST + 2)(best[BEST + 1] >= best[0], best, target, previous, best)
        result = self.finish()(target, previous, best[:BEST])
        return ca.Function("thorough", [target, previous, state], [result])

    def stationary(self) -> Any:
        """Function (target, previous) -> state, from the stationary points of I2."""
        target, previous = ca.SX.sym("target", 5), ca.SX.sym("previous")
        f = index_harmonics(self.rig, self.tunnel, target)
        roll = ca.SX.sym("roll", 5)
        points = [Candidate(ca.cos(roll[k]), ca.sin(roll[k]), 0) for k in range(5)]
        if np.isfinite(self.rig.lower[5]):  # the penalty may push against a limit that the index does not feel
            for upper in (False, True):
                angle = self.rig.upper[5] - ANGLE_INSET if upper else self.rig.lower[5] + ANGLE_INSET
                points.append(Candidate(np.cos(angle), np.sin(angle), limit_code(6, upper)))
        state = self.compare(target, previous, points, NOTHING)
        compare = ca.Function("compare", [target, previous, roll], [state])

        start, end = roll_window(self.rig, previous)
        start, end = start + 2 * ANGLE_INSET, end - 2 * ANGLE_INSET
        first = ca.fmin(ca.fmax(previous, start), end)
        whole = descend(f, self.gain, previous, start, end, first, CONVEX_STEPS)
        convex = ca.Function("convex", [target, previous], [ca.repmat(whole, 5, 1)])
        cuts = [start, *_sorted(_splits(f, self.gain, start, end)), end]
        pieces = [descend(f, self.gain, previous, a, b, (a + b) / 2, PIECE_STEPS) for a, b in pairwise(cuts)]
        cut = ca.Function("pieces", [target, previous], [ca.vertcat(*pieces)])
        is_convex = ca.Function("is_convex", [target], [2 * self.gain >= f.slope_bound()])
        x, before = ca.MX.sym("target", 5), ca.MX.sym("previous")
        rolls = ca.Function.if_else("descend", convex, cut)(is_convex(x), x, before)
        return ca.Function("stationary", [x, before], [compare(x, before, rolls)])

    def ends(self) -> Any:
        """Function (target, previous, state) -> state, with the ends of arcs but for joint 1.

        And for I1 with its stationary points, of which the direct way has looked at the best only.
        """
        target, previous, state = ca.SX.sym("target", 5), ca.SX.sym("previous"), ca.SX.sym("state", BEST + 2)
        points = angle_ends(self.rig, target, self.branch)
        if not self.gain:
            slope = index_harmonics(self.rig, self.tunnel, target).derivative()
            points = [*[Candidate(c, s, 0) for c, s in roots(slope)], *points]
        return ca.Function("ends", [target, previous, state], [ca.cse(self.compare(target, previous, points, state))])

    def slide(self) -> Any:
        """Function (target, previous, state) -> state, with the ends of arcs by the limits of joint 1."""
        target, previous, state = ca.SX.sym("target", 5), ca.SX.sym("previous"), ca.SX.sym("state", BEST + 2)
        x, before, known = ca.MX.sym("target", 5), ca.MX.sym("previous"), ca.MX.sym("state", BEST + 2)
        result = known
        for upper in (False, True):
            if np.isfinite((self.rig.upper if upper else self.rig.lower)[0]):
                ends = slide_ends(self.rig, self.branch, upper)
                points = ca.SX.sym("points", 2, 8)
                candidates = [Candidate(points[0, k], points[1, k], limit_code(1, upper)) for k in range(8)]
                compared = self.compare(target, previous, candidates, state)
                compare = ca.Function("compare", [target, previous, points, state], [compared])
                result = compare(x, before, ends(x), result)
        return ca.Function("slide", [x, before, known], [result])

    def compare(
        self, target: Expression, previous: Expression, points: list[Candidate], state: Expression
    ) -> Expression:
        """The state with more rolls looked at. Shape (BEST + 2, 1)."""
        f = index_harmonics(self.rig, self.tunnel, target)
        cost, c, s, code, pitch, yaw, least, relaxed = ca.vertsplit(ca.SX(state))
        for point in points:
            value = f.value(point.c, point.s)
            if self.gain:
                value += self.gain * (unrolled(self.rig, point.c, point.s, previous) - previous) ** 2
            posture = posture_at(self.rig, target, point.c, point.s, self.branch)
            meets = verdict(self.rig, target, posture, point.c, point.s)
            yaw_reaches = ca.logic_and(meets.pitch, meets.yaw)
            inside = ca.logic_and(yaw_reaches, meets.angles)
            better = ca.logic_and(ca.logic_and(inside, meets.slide), value < cost)
            pitch, yaw = ca.logic_or(pitch, meets.pitch), ca.logic_or(yaw, yaw_reaches)
            least = ca.if_else(value < least, value, least)
            relaxed = ca.if_else(ca.logic_and(inside, value < relaxed), value, relaxed)
            cost = ca.if_else(better, value, cost)
            c, s = ca.if_else(better, point.c, c), ca.if_else(better, point.s, s)
            code = ca.if_else(better, point.code, code)
        return ca.vertcat(cost, c, s, code, pitch, yaw, least, relaxed)

    def finish(self) -> Any:
        """Function (target, previous, best) -> result."""
        target, previous, best = ca.SX.sym("target", 5), ca.SX.sym("previous"), ca.SX.sym("best", BEST)
        result = ca.cse(self.result(target, previous, best))
        return ca.Function("finish", [target, previous, best], [result])

    def result(self, target: Expression, previous: Expression, best: Expression) -> Expression:
        """Joints, index, code of ACTIVE and of STATUS of a best roll. Shape (9, 1)."""
        cost, c, s, code, pitch, yaw = ca.vertsplit(best)
        roll = unrolled(self.rig, c, s, previous)
        posture = posture_at(self.rig, target, c, s, self.branch)
        meets = verdict(self.rig, target, posture, c, s)
        number = ca.sum1(target) + previous
        number = ca.logic_and(ca.fabs(number) < ca.inf, number == number)
        status = ca.if_else(ca.logic_and(meets.angles, meets.slide), 0, 4)
        status = ca.if_else(ca.logic_and(yaw, meets.yaw), status, 3)
        status = ca.if_else(ca.logic_and(pitch, meets.pitch), status, 2)
        # a search that found nothing still holds its start, a roll that may happen to be in reach
        nothing = ca.if_else(pitch, ca.if_else(yaw, 4, 3), 2)
        status = ca.if_else(cost < ca.inf, status, nothing)
        status = ca.if_else(number, status, 1)
        fine = status == 0
        joints = joints_of(self.rig, target, roll, posture)
        joints = [ca.if_else(fine, joints[k], np.nan) for k in range(6)]
        return ca.vertcat(*joints, ca.if_else(fine, cost, np.nan), code, status)


def _choose(other: Any, size: int) -> Any:
    """Function (settled, known, arguments) -> known, shape (size,), or else other(arguments), which only then runs.

    Made by hand because casadi.if_else would evaluate again whatever its arguments depend on.
    """
    known = ca.MX.sym("known", size)
    inputs = [ca.MX.sym(f"x{i}", other.sparsity_in(i)) for i in range(other.n_in())]
    keep = ca.Function("keep", [known, *inputs], [known])
    call = ca.Function("call", [known, *inputs], other.call(inputs))
    return ca.Function.if_else("choose", keep, call)


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
