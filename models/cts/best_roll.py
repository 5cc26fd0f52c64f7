"""Inverse kinematics of the rig with the globally best roll, in a bounded number of operations.

The best roll on a set of arcs is a stationary point of the index inside an arc or an end of an arc. The least of all is
found first, with a fixed number of operations (harmonics.least_point for I1, descents on convex intervals for I2);
where it is within reach and limits that is all. Else the ends are looked at, those that cost most last and only where
they can matter (cts_search).

Minima of I2, the index with the squared change of roll: on intervals where it is convex, by Newton steps.

What the search for the best roll answers with: joints, cost, the active constraint, or the reason for none.

Search for the globally best roll: which rolls to look at, in what order, and when no more can matter.

The best roll on a set of arcs is a stationary point of the index or an end of an arc. Ends by joints 4 to 6 and the
reach of the pitch link are cheap and are all compared. The others are first known roughly: one is polished and checked
only where the index there is below the best found so far. Walking downhill-to-uphill from a roll that meets all but a
limit of joint 1, the first roll that meets that limit too sits on it: so the ends by a limit of joint 1, which cost
most, are looked for only where a roll better than the best breaks that very limit.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import pairwise
from typing import Any

import casadi as ca
import numpy as np

from models.cts.rig import HOME, Branch, Rig, Tunnel, corner_circle, joints_of, posture_at
from models.cts.roll import (
    ANGLE_INSET,
    Candidate,
    index_harmonics,
    level_points,
    limit_code,
    sharp_level,
    sharp_point,
    simple_ends,
    slide_limit,
    slide_points,
    verdict,
    yaw_chart,
    yaw_levels,
)
from models.cts.trigonometric import Harmonics, Point, least_point, polish, roots
from models.errors import ModelError
from models.spatial import Expression

TURN = 2 * np.pi


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
    return _built(rig, tunnel, branch, gain, limits)


@lru_cache(maxsize=32)  # rig and tunnel are frozen; a function asked for again is the same
def _built(rig: Rig, tunnel: Tunnel, branch: Branch, gain: float, limits: bool) -> Any:
    search = Search(rig, tunnel, branch, gain)
    target, previous = ca.MX.sym("target", 5), ca.MX.sym("previous")
    result, done, state, rows = search.direct()(target, previous)
    if limits:
        result = choose(search.thorough(), (9, 1))(done, result, target, previous, state, rows)
    out = ca.vertsplit(result, [0, 6, 7, 8, 9])
    name = f"optimal_inverse_{'i2' if gain else 'i1'}{'' if limits else '_free'}"
    labels = ["target", "previous"], ["joints", "cost", "active", "status"]
    return ca.Function(name, [target, previous], list(out), *labels)


def checked_gain(rate_weight: float) -> float:
    """w4 / (2 pi); ModelError for a weight that is negative or not finite."""
    if not (np.isfinite(rate_weight) and rate_weight >= 0):
        raise ModelError(f"rate_weight {rate_weight} must be finite and not negative")
    return float(rate_weight) / TURN


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


SIZE = 6
"""Entries of a state of the search: cost, cosine, sine and code of the best roll, and the least costs of rolls that
meet everything but the lower, or upper, limit of joint 1."""


def finish(rig: Rig, branch: Branch) -> Any:
    """Function (target, previous, state) -> answer with the best roll."""
    target, previous, state = ca.SX.sym("target", 5), ca.SX.sym("previous"), ca.SX.sym("state", SIZE)
    cost, c, s, code = ca.vertsplit(state[:4])
    found = answer(rig, branch, target, previous, c, s, cost, code, 0)
    return ca.Function("finish", [target, previous, state], ca.cse([found]))


def reason(rig: Rig, branch: Branch) -> Any:
    """Function (target) -> answer where no roll will do: without joints, with the status that tells why."""
    target, rig = ca.SX.sym("target", 5), rig.unlimited()
    axle, e_c, _ = corner_circle(rig, target)
    pitch = ca.fabs(axle[2]) - rig.goose_neck * ca.fabs(e_c[2]) <= rig.pitch_link
    points: list[Point] = [(1.0, 0.0)]
    points += [(end.c, end.s) for end in simple_ends(rig, target, branch)]
    chart = yaw_chart(rig, branch)
    for level in yaw_levels(rig, target, branch):
        rough, above = level_points(rig, target, level.cosine), 1 if level.above else -1
        points += [sharp_level(rig, chart, target, level.cosine, above, point) for point in rough]
    yaw: Expression = 0
    for c, s in points:
        posture = posture_at(rig, target, c, s, branch)
        yaw = ca.logic_or(yaw, verdict(rig, target, posture, c, s).relaxed())
    status = ca.if_else(pitch, ca.if_else(yaw, 4, 3), 2)
    result = ca.vertcat(ca.DM.ones(7) * np.nan, 0, status)
    return ca.Function("reason", [target], ca.cse([result]))


def answer(
    rig: Rig,
    branch: Branch,
    target: Expression,
    previous: Expression,
    c: Expression,
    s: Expression,
    cost: Expression,
    code: Expression,
    status: Expression,
) -> Expression:
    """Joints and index, nan unless the status is 0, code of ACTIVE and of STATUS. Shape (9, 1)."""
    roll = unrolled(rig, c, s, previous)
    joints = joints_of(rig, target, roll, posture_at(rig, target, c, s, branch))
    spoilt = ca.if_else(ca.SX(status) == 0, 0, np.nan)
    return ca.vertcat(joints + spoilt, cost + spoilt, code, status)


NO_TABLE = ca.DM([[ca.inf] * 4, [1] * 4, [0] * 4, [0] * 4, [0] * 4, [0] * 4])
NOTHING = ca.DM([ca.inf, 1, 0, 0, ca.inf, ca.inf])
NEAR = 0.01
"""How far a point may be from the roll it is polished to, rad; more than the roots of harmonics.roots are."""


@dataclass(frozen=True)
class Search:
    """The steps of the search as casadi Functions.

    Attributes:
        gain: w4 / (2 pi) of I2; 0 for I1.
    """

    rig: Rig
    tunnel: Tunnel
    branch: Branch
    gain: float

    def direct(self) -> Any:
        """Function (target, previous) -> (result, done, state, rows): the stationary point of least index.

        `done` says that it settles the matter: it is within reach and limits, or the input is no number.
        """
        target, previous = ca.SX.sym("target", 5), ca.SX.sym("previous")
        if self.gain:
            return self._direct_by_descent()
        f = index_harmonics(self.rig, self.tunnel, target)
        c, s = least_point(f)
        cost = f.value(c, s)
        meets = verdict(self.rig, target, posture_at(self.rig, target, c, s, self.branch), c, s)
        state, rows, _ = self.compare(target, previous, [Candidate(c, s, 0)], NOTHING)
        status = ca.if_else(ca.logic_and(meets.slide(), meets.angles()), 0, 4)
        status = ca.if_else(meets.pitch, ca.if_else(meets.yaw, status, 3), 2)
        status = ca.if_else(_number(target, previous), status, 1)
        result = answer(self.rig, self.branch, target, previous, c, s, cost, 0, status)
        return ca.Function("direct", [target, previous], ca.cse([result, status <= 1, state, rows]))

    def _direct_by_descent(self) -> Any:
        target, previous = ca.SX.sym("target", 5), ca.SX.sym("previous")
        rolls = ca.SX.sym("rolls", 5)
        points = [Candidate(ca.cos(rolls[k]), ca.sin(rolls[k]), 0) for k in range(5)]
        if np.isfinite(self.rig.lower[5]):  # the penalty may push against a limit that the index does not feel
            for upper in (False, True):
                angle = self.rig.upper[5] - ANGLE_INSET if upper else self.rig.lower[5] + ANGLE_INSET
                points.append(Candidate(np.cos(angle), np.sin(angle), limit_code(6, upper)))
        state, rows, least = self.compare(target, previous, points, NOTHING)
        number = _number(target, previous)
        status = ca.if_else(number, 0, 1)
        result = answer(self.rig, self.branch, target, previous, state[1], state[2], state[0], state[3], status)
        done = ca.logic_or(ca.logic_and(least >= state[0], state[0] < ca.inf), ca.logic_not(number))
        settle = ca.Function("settle", [target, previous, rolls], ca.cse([result, done, state, rows]))
        x, before = ca.MX.sym("target", 5), ca.MX.sym("previous")
        outputs = settle(x, before, convex_minima(self.rig, self.tunnel, self.gain)(x, before))
        return ca.Function("direct", [x, before], list(outputs))

    def thorough(self) -> Any:
        """Function (target, previous, state, rows) -> result, from the ends of the arcs."""
        target, previous, state = ca.MX.sym("target", 5), ca.MX.sym("previous"), ca.MX.sym("state", SIZE)
        rows = ca.MX.sym("rows", *self.direct().size_out(3))
        best, more = self.simple()(target, previous, state)
        known = [rows, more]
        chart = yaw_chart(self.rig, self.branch)
        if not self.gain:
            table = choose(self._rough_stationary(), (6, 4))(self._one_minimum()(target), NO_TABLE, target)
            best = self._gates(self._sharpen(None, 0), 4)(target, previous, table, best)
            known.append(table[[0, 3], :])
        best = self._levels(chart, ca.horzcat(*known))(target, previous, ca.horzcat(*known), best)
        for row, upper in ((4, False), (5, True)):
            if np.isfinite((self.rig.upper if upper else self.rig.lower)[0]):
                slide = self._slide(chart, upper)
                best = choose(slide, (SIZE, 1))(best[row] >= best[0], best, target, previous, best)
        found = finish(self.rig, self.branch)(target, previous, best)
        result = choose(reason(self.rig, self.branch), (9, 1))(best[0] < ca.inf, found, target)
        return ca.Function("thorough", [target, previous, state, rows], [result])

    # ---- candidates ------------------------------------------------------------------------------------------

    def simple(self) -> Any:
        """Function (target, previous, state) -> (state, rows), with the ends that are known to rounding."""
        target, previous, state = ca.SX.sym("target", 5), ca.SX.sym("previous"), ca.SX.sym("state", SIZE)
        found, rows, _ = self.compare(target, previous, simple_ends(self.rig, target, self.branch), state)
        return ca.Function("simple", [target, previous, state], ca.cse([found, rows]))

    def _one_minimum(self) -> Any:
        """Function (target) -> whether I1 certainly has one minimum only."""
        target = ca.SX.sym("target", 5)
        f = index_harmonics(self.rig, self.tunnel, target)
        first, second = ca.sqrt(f.a1**2 + f.b1**2), ca.sqrt(f.a2**2 + f.b2**2)
        return ca.Function("one_minimum", [target], [first > 4.001 * second])

    def _rough_stationary(self) -> Any:
        """Function (target) -> table of points near the minima of I1, with cos q2 as datum."""
        target = ca.SX.sym("target", 5)
        slope = index_harmonics(self.rig, self.tunnel, target).derivative()
        sin4_slack, _ = self._slack()
        rows = []
        for c, s in roots(slope, steps=0):
            posture = posture_at(self.rig, target, c, s, self.branch)
            rows.append((c, s, ca.fabs(posture.sin4) < 1 + sin4_slack, posture.cos2, 0, 0))
        return self._table(target, rows)

    def _levels(self, chart: Any, known: Any) -> Any:
        """Function (target, previous, rows, state) -> state, with the ends by joints 2 and 3 and the yaw link's reach.

        A level is looked at where a roll of the rows, better than the best, is on its wrong side; all are where one
        breaks a limit of joint 1 alone, since the arc that it is on may end before that limit is met.
        """
        target, rows = ca.SX.sym("target", 5), ca.SX.sym("rows", 2, known.shape[1])
        _, cos2_slack = self._slack()
        columns = []
        for level in yaw_levels(self.rig, target, self.branch):
            bound = ca.SX(ca.inf)
            for k in range(rows.shape[1]):
                over = rows[1, k] - level.cosine if level.above else level.cosine - rows[1, k]
                bound = ca.fmin(bound, ca.if_else(over < cos2_slack, rows[0, k], ca.inf))
            reason = ca.if_else(level.relevant, bound, ca.inf)
            side = 1 if level.above else -1
            columns.append(ca.vertcat(reason, level.cosine, level.code, level.relevant, side))
        needed = ca.Function("levels", [target, rows], ca.cse([ca.horzcat(*columns) if columns else ca.SX(6, 0)]))

        cosine, code, above = ca.SX.sym("cosine"), ca.SX.sym("code"), ca.SX.sym("above")
        points = level_points(self.rig, target, cosine)
        sin4_slack, _ = self._slack()
        made = []
        for c, s in points:
            posture = posture_at(self.rig, target, c, s, self.branch)
            near = ca.fabs(posture.cos2 - cosine) < cos2_slack
            near = ca.logic_and(near, ca.fabs(posture.sin4) < 1 + sin4_slack)
            made.append((c, s, near, cosine, code, above))
        rough = self._table(target, made, cosine, code, above)

        x, before, best = ca.MX.sym("target", 5), ca.MX.sym("previous"), ca.MX.sym("state", SIZE)
        level_row = ca.MX.sym("level", 5)
        ends = self._gates(self._sharpen(chart, 0), 4)(
            x, before, rough(x, level_row[1], level_row[2], level_row[4]), best
        )
        one = choose(ca.Function("level", [x, before, level_row, best], [ends]), (SIZE, 1))
        given = ca.MX.sym("rows", 2, known.shape[1])
        found = best
        for column in ca.horzsplit(needed(x, given)):
            found = one(column[0] >= found[0], found, x, before, column, found)
        if np.isfinite([self.rig.lower[0], self.rig.upper[0]]).any():
            for column in ca.horzsplit(needed(x, given)):
                settled = ca.logic_or(ca.fmin(found[4], found[5]) >= found[0], ca.logic_not(column[3]))
                found = one(settled, found, x, before, column, found)
        return ca.Function("levels", [x, before, given, best], [found])

    def _slide(self, chart: Any, upper: bool) -> Any:
        """Function (target, previous, state) -> state, with the ends by one limit of joint 1."""
        x, before, best = ca.MX.sym("target", 5), ca.MX.sym("previous"), ca.MX.sym("state", SIZE)
        table = self._rough_slide(upper)(x)
        found = self._gates(self._sharpen(chart, 2), 8)(x, before, table, best)
        return ca.Function("slide", [x, before, best], [found])

    def _rough_slide(self, upper: bool) -> Any:
        """Function (target) -> table of points near the ends by one limit of joint 1."""
        target, points = ca.SX.sym("target", 5), ca.SX.sym("points", 2, 8)
        sin4_slack, cos2_slack = self._slack()
        rows = []
        for k in range(8):
            posture = posture_at(self.rig, target, points[0, k], points[1, k], self.branch)
            near = ca.logic_and(ca.fabs(posture.sin4) < 1 + sin4_slack, ca.fabs(posture.cos2) < 1 + cos2_slack)
            rows.append((points[0, k], points[1, k], near, slide_limit(self.rig, upper), limit_code(1, upper), 0))
        table = self._table(target, rows, points)
        x = ca.MX.sym("target", 5)
        return ca.Function("rough_slide", [x], [table(x, slide_points(self.rig, upper)(x))])

    def _slack(self) -> tuple[float, float]:
        """How much sin q4 and cos q2 can change within NEAR of a roll."""
        rig = self.rig
        sin4 = NEAR * rig.goose_neck / rig.pitch_link
        cos4 = float(np.sqrt(2 * sin4)) + sin4
        return sin4, (NEAR * rig.goose_neck + rig.pitch_link * cos4) / rig.yaw_link_1

    def _table(self, target: Expression, rows: Sequence[tuple[Any, ...]], *more: Expression) -> Any:
        """Function -> rows (bound, cosine, sine, datum, code, above): no cost near the point is below the bound."""
        f = index_harmonics(self.rig, self.tunnel, target)
        slack = NEAR * (ca.fabs(f.a1) + ca.fabs(f.b1) + 2 * (ca.fabs(f.a2) + ca.fabs(f.b2)))
        columns = []
        for c, s, near, *rest in rows:
            bound = ca.if_else(near, f.value(c, s) - slack, ca.inf)
            columns.append(ca.vertcat(bound, c, s, *rest))
        return ca.Function("rough", [target, *more], ca.cse([ca.horzcat(*columns) if columns else ca.SX(6, 0)]))

    def _gates(self, sharpen: Any, count: int) -> Any:
        """Function (target, previous, table, state) -> state: points one by one, those that may matter sharpened."""
        target, previous, state = ca.MX.sym("target", 5), ca.MX.sym("previous"), ca.MX.sym("state", SIZE)
        table = ca.MX.sym("table", 6, count)
        gate = choose(sharpen, (SIZE, 1))
        best = state
        for column in ca.horzsplit(table):
            best = gate(column[0] >= best[0], best, target, previous, column, best)
        return ca.Function("gates", [target, previous, table, state], [best])

    def _sharpen(self, chart: Any, output: int) -> Any:
        """Function (target, previous, column of a table, state) -> state; without a chart to a stationary point."""
        target, previous = ca.SX.sym("target", 5), ca.SX.sym("previous")
        column, state = ca.SX.sym("column", 6), ca.SX.sym("state", SIZE)
        point: Point = (column[1], column[2])
        if chart is None:
            slope = index_harmonics(self.rig, self.tunnel, target).derivative()
            bend = slope.derivative()
            point = polish(point, lambda c, s: (slope.value(c, s), bend.value(c, s)))
        elif output == 0:
            point = sharp_level(self.rig, chart, target, column[3], column[5], point)
        else:
            point = sharp_point(chart, target, output, column[3], point)
        found, _, _ = self.compare(target, previous, [Candidate(*point, column[4])], state)
        return ca.Function("sharpen", [target, previous, column, state], ca.cse([found]))

    def compare(
        self, target: Expression, previous: Expression, points: list[Candidate], state: Expression
    ) -> tuple[Expression, Expression, Expression]:
        """The state with more rolls looked at, rows of them, and the least cost of any, feasible or not.

        The rows, shape (2, points), are the cost, inf where joints 4 to 6 do not allow the roll, and cos q2.
        """
        f: Harmonics = index_harmonics(self.rig, self.tunnel, target)
        cost, c, s, code, below, above = ca.vertsplit(ca.SX(state))
        least, rows = ca.SX(ca.inf), []
        for point in points:
            value = f.value(point.c, point.s)
            if self.gain:
                value += self.gain * (unrolled(self.rig, point.c, point.s, previous) - previous) ** 2
            posture = posture_at(self.rig, target, point.c, point.s, self.branch)
            meets = verdict(self.rig, target, posture, point.c, point.s)
            relaxed = meets.relaxed()
            better = ca.logic_and(ca.logic_and(relaxed, meets.slide()), value < cost)
            least = ca.fmin(least, value)
            rows.append(ca.vertcat(ca.if_else(meets.pitch_side(), value, ca.inf), posture.cos2))
            over = ca.if_else(relaxed, value, ca.inf)
            below = ca.fmin(below, ca.if_else(meets.slide_lower, ca.inf, over))
            above = ca.fmin(above, ca.if_else(meets.slide_upper, ca.inf, over))
            cost = ca.if_else(better, value, cost)
            c, s = ca.if_else(better, point.c, c), ca.if_else(better, point.s, s)
            code = ca.if_else(better, point.code, code)
        state = ca.vertcat(cost, c, s, code, below, above)
        return state, ca.horzcat(*rows) if rows else ca.SX(2, 0), least


def _number(target: Expression, previous: Expression) -> Expression:
    """Whether the input is finite."""
    total = ca.sum1(target) + previous
    return ca.fabs(total) < ca.inf


def choose(other: Any, shape: tuple[int, int]) -> Any:
    """Function (settled, known, arguments) -> known, of that shape, or else other(arguments), which only then runs.

    Made by hand because casadi.if_else would evaluate again whatever its arguments depend on.
    """
    known = ca.MX.sym("known", *shape)
    inputs = [ca.MX.sym(f"x{i}", other.sparsity_in(i)) for i in range(other.n_in())]
    keep = ca.Function("keep", [known, *inputs], [known])
    call = ca.Function("call", [known, *inputs], other.call(inputs))
    return ca.Function.if_else("choose", keep, call)
