"""Inverse kinematics of the rig with the globally best roll, in a bounded number of operations.

The best roll on a set of arcs is a stationary point of the index inside an arc, or an end of an arc. The stationary
points come first, in closed form for I1 (trigonometric.least_point); for I2, the index with the squared change of roll,
by Newton steps on intervals where it is convex. Where the best of them is within reach and limits that is all.

Else the ends matter, and `Search` says which to look at, in what order, and when no more can matter. Ends by joints 4
to 6 and by the reach of the pitch link are cheap and are all compared. The others are first known roughly: one is
polished and checked only where the index there is below the best found so far. Walking downhill-to-uphill from a roll
that meets all but a limit of joint 1, the first roll that meets that limit too sits on it: so the ends by a limit of
joint 1, which cost most, are looked for only where a roll better than the best breaks that very limit.

What the functions of the search hand to each other are records of scalars, one column each.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, NamedTuple, TypeVar

import casadi as ca
import numpy as np

from models.arrays import checked_flag, checked_instance
from models.cts.rig import HOME, Branch, Rig, RigConfiguration, Tunnel, checked_branch, configuration_at, joints_of
from models.cts.roll import (
    Candidate,
    check_constraints,
    checked_gain,
    convex_minima,
    index_harmonics,
    infeasibility_code,
    inside_limit,
    level_points,
    limit_code,
    sharp_level,
    sharp_point,
    simple_ends,
    slide_points,
    unwrap_roll,
    yaw_chart,
    yaw_levels,
)
from models.cts.trigonometric import ROOTS, Harmonics, Point, least_point, polish, roots
from models.errors import ModelError
from models.spatial import Expression

_Record = TypeVar("_Record")


class Best(NamedTuple):
    """The best roll so far.

    Attributes:
        cost: Its index, inf where there is none yet.
        c, s: Its cosine and sine.
        code: Of the constraint it sits on, in roll.ACTIVE.
        below, above: Least cost of any roll that meets everything but the lower, or upper, limit of joint 1.
    """

    cost: Expression
    c: Expression
    s: Expression
    code: Expression
    below: Expression
    above: Expression


class Rough(NamedTuple):
    """A point near a roll that may be the best one.

    Attributes:
        bound: No cost near the point is below it; inf where the roll cannot be.
        c, s: Cosine and sine.
        value: What cos q2, or q1, takes at the roll it is polished to; at a stationary point cos q2 as it is.
        code: Of the constraint that the roll sits on.
        side: 1 where that constraint is met above the value, -1 where it is met below.
    """

    bound: Expression
    c: Expression
    s: Expression
    value: Expression
    code: Expression
    side: Expression


class Seen(NamedTuple):
    """A roll that was looked at: its cost, inf where joints 4 to 6 do not allow it, and cos q2."""

    cost: Expression
    cos2: Expression


class Suspect(NamedTuple):
    """A roll.Level that may matter: no cost on it is below `bound`; `side` as of Rough."""

    bound: Expression
    cosine: Expression
    code: Expression
    relevant: Expression
    side: Expression


BEST_SIZE, ANSWER_SIZE = len(Best._fields), 9
NOTHING = Best(ca.inf, 1, 0, 0, ca.inf, ca.inf)
NOWHERE = Rough(ca.inf, 1, 0, 0, 0, 0)


class Answer(NamedTuple):
    """Joints, shape (6, 1), and index of a roll, nan unless the status is 0; codes in roll.ACTIVE and roll.STATUS."""

    joints: Expression
    cost: Expression
    active: Expression
    status: Expression


def stacked(kind: Any, records: Sequence[Any]) -> Expression:
    """Records of one kind as the columns of a matrix. Shape (fields, records)."""
    return ca.horzcat(*[ca.vertcat(*record) for record in records]) if records else ca.SX(len(kind._fields), 0)


def unstacked(kind: Callable[..., _Record], matrix: Expression) -> list[_Record]:
    """The records that are the columns of a matrix."""
    return [kind(*ca.vertsplit(column)) for column in ca.horzsplit(matrix)]


def _record(kind: Callable[..., _Record], column: Expression) -> _Record:
    return kind(*ca.vertsplit(column))


def _given(symbols: Any) -> tuple[Any, Any]:
    return symbols.sym("target", 5), symbols.sym("previous")


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
        shape (6,), nan unless the status is 0; the index; code of the active constraint in roll.ACTIVE; code in
        roll.STATUS. The roll is given in the turn nearest to the previous one that the limits of joint 6 allow,
        or, where they allow less than a turn, in theirs.

    Raises:
        ModelError: A negative or non-finite rate weight; limits=False with a rate weight.
    """
    checked_instance(rig, Rig, "rig", "rig")
    checked_instance(tunnel, Tunnel, "rig", "tunnel")
    branch, limits = checked_branch(branch), checked_flag(limits, "rig", "limits")
    gain = checked_gain(rate_weight)
    if gain and not limits:
        message = "limits=False is for the closed form of I1; with a rate weight leave limits on"
        raise ModelError(message, name="limits", value=limits)
    return _built(rig, tunnel, branch, gain, limits)


@lru_cache(maxsize=32)  # rig and tunnel are frozen; a function asked for again is the same
def _built(rig: Rig, tunnel: Tunnel, branch: Branch, gain: float, limits: bool) -> Any:
    search = Search(rig, tunnel, branch, gain)
    target, previous = _given(ca.MX)
    direct = search.direct()
    result, done, best, seen = direct(target, previous)
    if limits:
        thorough = search.thorough(direct.size2_out(3))
        result = choose(thorough, (ANSWER_SIZE, 1))(done, result, target, previous, best, seen)
    name = f"optimal_inverse_{'i2' if gain else 'i1'}{'' if limits else '_free'}"
    outputs = Answer(*ca.vertsplit(result, [0, 6, 7, 8, 9]))
    return ca.Function(name, [target, previous], list(outputs), ["target", "previous"], list(Answer._fields))


@dataclass(frozen=True)
class Search:
    """The steps of the search as casadi Functions. Their `best` is a Best, `seen` a row of Seen, `rough` of Rough.

    Attributes:
        gain: w4 / (2 pi) of I2; 0 for I1.
    """

    rig: Rig
    tunnel: Tunnel
    branch: Branch
    gain: float

    def direct(self) -> Any:
        """Function (target, previous) -> (answer, done, best, seen): the stationary point of least index.

        `done` says that it settles the matter: it is within reach and limits, or the input is no number.
        """
        if self.gain:
            return self._direct_by_descent()
        target, previous = _given(ca.SX)
        f = self._index(target)
        c, s = least_point(f)
        meets = check_constraints(self.rig, target, self._posture(target, c, s), c, s)
        best, seen, _ = self._compare(target, previous, [Candidate(c, s, 0)], NOTHING)
        status = ca.if_else(ca.logic_and(meets.slide(), meets.angles()), 0, 4)
        status = ca.if_else(meets.pitch, ca.if_else(meets.yaw, status, 3), 2)
        status = ca.if_else(_number(target, previous), status, 1)
        result = self._answer(target, previous, NOTHING._replace(cost=f.value(c, s), c=c, s=s), status)
        outputs = [result, status <= 1, ca.vertcat(*best), stacked(Seen, seen)]
        return ca.Function("direct", [target, previous], ca.cse(outputs))

    def _direct_by_descent(self) -> Any:
        target, previous = _given(ca.SX)
        rolls = ca.SX.sym("rolls", 5)
        points = [Candidate(ca.cos(rolls[k]), ca.sin(rolls[k]), 0) for k in range(5)]
        if np.isfinite(self.rig.limit(6, False)):  # the penalty may push against a limit that the index does not feel
            for upper in (False, True):
                angle = inside_limit(self.rig, 6, upper)
                points.append(Candidate(np.cos(angle), np.sin(angle), limit_code(6, upper)))
        best, seen, least = self._compare(target, previous, points, NOTHING)
        number = _number(target, previous)
        result = self._answer(target, previous, best, ca.if_else(number, 0, 1))
        done = ca.logic_or(ca.logic_and(least >= best.cost, best.cost < ca.inf), ca.logic_not(number))
        outputs = [result, done, ca.vertcat(*best), stacked(Seen, seen)]
        settle = ca.Function("settle", [target, previous, rolls], ca.cse(outputs))
        x, before = _given(ca.MX)
        settled = settle(x, before, convex_minima(self.rig, self.tunnel, self.gain)(x, before))
        return ca.Function("direct", [x, before], list(settled))

    def thorough(self, count: int) -> Any:
        """Function (target, previous, best, seen) -> answer, from the ends of the arcs; `count` rolls were seen."""
        target, previous = _given(ca.MX)
        first, seen = ca.MX.sym("best", BEST_SIZE), ca.MX.sym("seen", len(Seen._fields), count)
        best, more = self._simple()(target, previous, first)
        known = [seen, more]
        chart = yaw_chart(self.rig, self.branch)
        if not self.gain:
            rough = self._rough_stationary()(target)
            best = self._gates(self._sharpen(self._stationary), 4)(target, previous, rough, best)
            known.append(stacked(Seen, [Seen(point.bound, point.value) for point in unstacked(Rough, rough)]))
        seen = ca.horzcat(*known)
        best = self._levels(chart, seen.shape[1])(target, previous, seen, best)
        for upper in (False, True):
            if np.isfinite(self.rig.limit(1, upper)):
                now = _record(Best, best)
                settled = (now.above if upper else now.below) >= now.cost
                best = choose(self._slide(chart, upper), (BEST_SIZE, 1))(settled, best, target, previous, best)
        found = self._finish()(target, previous, best)
        result = choose(self._nowhere(), (ANSWER_SIZE, 1))(_record(Best, best).cost < ca.inf, found, target)
        return ca.Function("thorough", [target, previous, first, known[0]], [result])

    # ---- candidates ------------------------------------------------------------------------------------------

    def _simple(self) -> Any:
        """Function (target, previous, best) -> (best, seen), with the ends that are known to rounding."""
        target, previous = _given(ca.SX)
        first = ca.SX.sym("best", BEST_SIZE)
        ends = simple_ends(self.rig, target, self.branch)
        best, seen, _ = self._compare(target, previous, ends, _record(Best, first))
        return ca.Function("simple", [target, previous, first], ca.cse([ca.vertcat(*best), stacked(Seen, seen)]))

    def _rough_stationary(self) -> Any:
        """Function (target) -> points near the minima of I1; nowhere where it certainly has one minimum only.

        In the axes of trigonometric.least_point there are two stationary points alone outside the astroid
        |p|^(2/3) + |q|^(2/3) = (4 r)^(2/3), which the circle hypot(p, q) = 4 r encloses.
        """
        target, _ = _given(ca.SX)
        rough, f = self._rough(target), self._index(target)
        points = [rough(c, s) for c, s in roots(f.derivative(), steps=0)]
        near = ca.Function("rough", [target], ca.cse([stacked(Rough, points)]))
        first, second = ca.sqrt(f.a1**2 + f.b1**2), ca.sqrt(f.a2**2 + f.b2**2)
        one_minimum = ca.Function("one_minimum", [target], [first > 4 * second])
        x, nowhere = ca.MX.sym("target", 5), stacked(Rough, [NOWHERE] * len(points))
        found = choose(near, nowhere.shape)(one_minimum(x), nowhere, x)
        return ca.Function("rough_stationary", [x], [found])

    def _levels(self, chart: Any, count: int) -> Any:
        """Function (target, previous, seen, best) -> best, with the ends by joints 2 and 3 and the yaw link's reach.

        A level is looked at where a roll that was seen, better than the best, is on its wrong side; all are where one
        breaks a limit of joint 1 alone, since the arc that it is on may end before that limit is met.
        """
        target, _ = _given(ca.SX)
        rolls, suspect = ca.SX.sym("seen", len(Seen._fields), count), ca.SX.sym("suspect", len(Suspect._fields))
        suspects, (_, slack) = [], self._slack()
        for level in yaw_levels(self.rig, target, self.branch):
            bound = ca.SX(ca.inf)
            for roll in unstacked(Seen, rolls):
                over = roll.cos2 - level.cosine if level.above else level.cosine - roll.cos2
                bound = ca.fmin(bound, ca.if_else(over < slack, roll.cost, ca.inf))
            bound = ca.if_else(level.relevant, bound, ca.inf)
            suspects.append(Suspect(bound, level.cosine, level.code, level.relevant, 1 if level.above else -1))
        needed = ca.Function("levels", [target, rolls], ca.cse([stacked(Suspect, suspects)]))

        (_, cosine, code, _, side), rough = _record(Suspect, suspect), self._rough(target)
        ends = level_points(self.rig, target, cosine)
        points = [rough(c, s, cosine, code, side, about=(cosine, slack)) for c, s in ends]
        near_level = ca.Function("rough", [target, suspect], ca.cse([stacked(Rough, points)]))

        def polished(at: Expression, end: Rough) -> Point:
            return sharp_level(self.rig, chart, at, end.value, end.side, (end.c, end.s))

        x, before = _given(ca.MX)
        first, column = ca.MX.sym("best", BEST_SIZE), ca.MX.sym("suspect", len(Suspect._fields))
        found = self._gates(self._sharpen(polished), len(points))(x, before, near_level(x, column), first)
        one = choose(ca.Function("level", [x, before, column, first], [found]), (BEST_SIZE, 1))
        seen = ca.MX.sym("seen", *rolls.shape)
        best = first
        for level in ca.horzsplit(needed(x, seen)):
            best = one(_record(Suspect, level).bound >= _record(Best, best).cost, best, x, before, level, best)
        if np.isfinite([self.rig.limit(1, False), self.rig.limit(1, True)]).any():
            for level in ca.horzsplit(needed(x, seen)):
                now, relevant = _record(Best, best), _record(Suspect, level).relevant
                settled = ca.logic_or(ca.fmin(now.below, now.above) >= now.cost, ca.logic_not(relevant))
                best = one(settled, best, x, before, level, best)
        return ca.Function("levels", [x, before, seen, first], [best])

    def _slide(self, chart: Any, upper: bool) -> Any:
        """Function (target, previous, best) -> best, with the ends by one limit of joint 1."""
        target, points = ca.SX.sym("target", 5), ca.SX.sym("points", 2, 8)
        rough, reach = self._rough(target), (0, 1 + self._slack()[1])
        datum = inside_limit(self.rig, 1, upper), limit_code(1, upper)
        ends = [rough(points[0, k], points[1, k], *datum, about=reach) for k in range(8)]
        near_limit = ca.Function("rough", [target, points], ca.cse([stacked(Rough, ends)]))

        def polished(at: Expression, end: Rough) -> Point:
            return sharp_point(chart, at, 2, end.value, (end.c, end.s))

        x, before = _given(ca.MX)
        best = ca.MX.sym("best", BEST_SIZE)
        found = near_limit(x, slide_points(self.rig, upper)(x))
        gates = self._gates(self._sharpen(polished), len(ends))
        return ca.Function("slide", [x, before, best], [gates(x, before, found, best)])

    def _slack(self) -> tuple[float, float]:
        """Return bounds of the changes of sin q4 and cos q2 within ROOTS.reach of a roll."""
        rig = self.rig
        sin4 = ROOTS.reach * rig.goose_neck / rig.pitch_link
        cos4 = float(np.sqrt(2 * sin4)) + sin4
        return sin4, (ROOTS.reach * rig.goose_neck + rig.pitch_link * cos4) / rig.yaw_link_1

    def _rough(self, target: Expression) -> Callable[..., Rough]:
        """Maker of a Rough from all but its bound; cos q2 must be within (middle, half) where they are given."""
        f, (slack4, _) = self._index(target), self._slack()
        slack = ROOTS.reach * (ca.fabs(f.a1) + ca.fabs(f.b1) + 2 * (ca.fabs(f.a2) + ca.fabs(f.b2)))

        def rough(
            c: Expression, s: Expression, value: Expression = None, code: Any = 0, side: Any = 0, about: Any = None
        ) -> Rough:
            posture = self._posture(target, c, s)
            near = ca.fabs(posture.sin4) < 1 + slack4
            if about is not None:
                near = ca.logic_and(near, ca.fabs(posture.cos2 - about[0]) < about[1])
            bound = ca.if_else(near, f.value(c, s) - slack, ca.inf)
            return Rough(bound, c, s, posture.cos2 if value is None else value, code, side)

        return rough

    def _gates(self, sharpen: Any, count: int) -> Any:
        """Function (target, previous, rough, best) -> best: points one by one, those that may matter sharpened."""
        target, previous = _given(ca.MX)
        first, rough = ca.MX.sym("best", BEST_SIZE), ca.MX.sym("rough", len(Rough._fields), count)
        gate, best = choose(sharpen, (BEST_SIZE, 1)), first
        for point in ca.horzsplit(rough):
            settled = _record(Rough, point).bound >= _record(Best, best).cost
            best = gate(settled, best, target, previous, point, best)
        return ca.Function("gates", [target, previous, rough, first], [best])

    def _sharpen(self, polished: Callable[[Expression, Rough], Point]) -> Any:
        """Function (target, previous, rough, best) -> best: one point polished and compared."""
        target, previous = _given(ca.SX)
        rough, first = ca.SX.sym("rough", len(Rough._fields)), ca.SX.sym("best", BEST_SIZE)
        point = _record(Rough, rough)
        sharp = Candidate(*polished(target, point), point.code)
        best, _, _ = self._compare(target, previous, [sharp], _record(Best, first))
        return ca.Function("sharpen", [target, previous, rough, first], ca.cse([ca.vertcat(*best)]))

    def _stationary(self, target: Expression, rough: Rough) -> Point:
        """The stationary point of I1 near a point."""
        slope = self._index(target).derivative()
        bend = slope.derivative()
        return polish((rough.c, rough.s), lambda c, s: (slope.value(c, s), bend.value(c, s)))

    def _compare(
        self, target: Expression, previous: Expression, points: Sequence[Candidate], best: Best
    ) -> tuple[Best, list[Seen], Expression]:
        """The best with more rolls looked at, these rolls, and the least cost of any, feasible or not."""
        f = self._index(target)
        cost, c, s, code, below, above = best
        least, seen = ca.SX(ca.inf), []
        for point in points:
            value = f.value(point.c, point.s)
            if self.gain:
                value += self.gain * (unwrap_roll(self.rig, point.c, point.s, previous) - previous) ** 2
            posture = self._posture(target, point.c, point.s)
            meets = check_constraints(self.rig, target, posture, point.c, point.s)
            relaxed = meets.relaxed()
            better = ca.logic_and(ca.logic_and(relaxed, meets.slide()), value < cost)
            least = ca.fmin(least, value)
            seen.append(Seen(ca.if_else(meets.pitch_side(), value, ca.inf), posture.cos2))
            over = ca.if_else(relaxed, value, ca.inf)
            below = ca.fmin(below, ca.if_else(meets.slide_lower, ca.inf, over))
            above = ca.fmin(above, ca.if_else(meets.slide_upper, ca.inf, over))
            cost = ca.if_else(better, value, cost)
            c, s = ca.if_else(better, point.c, c), ca.if_else(better, point.s, s)
            code = ca.if_else(better, point.code, code)
        return Best(cost, c, s, code, below, above), seen, least

    def _index(self, target: Expression) -> Harmonics:
        return index_harmonics(self.rig, self.tunnel, target)

    def _posture(self, target: Expression, c: Expression, s: Expression) -> RigConfiguration:
        return configuration_at(self.rig, target, c, s, self.branch)

    # ---- answers ---------------------------------------------------------------------------------------------

    def _finish(self) -> Any:
        """Function (target, previous, best) -> answer with the best roll."""
        target, previous = _given(ca.SX)
        best = ca.SX.sym("best", BEST_SIZE)
        found = self._answer(target, previous, _record(Best, best), 0)
        return ca.Function("finish", [target, previous, best], ca.cse([found]))

    def _nowhere(self) -> Any:
        """Function (target) -> answer where no roll will do: without joints, with the status that tells why."""
        target = ca.SX.sym("target", 5)
        result = Answer(ca.DM.ones(6) * np.nan, np.nan, 0, infeasibility_code(self.rig, target, self.branch))
        return ca.Function("nowhere", [target], ca.cse([ca.vertcat(*result)]))

    def _answer(self, target: Expression, previous: Expression, best: Best, status: Expression) -> Expression:
        """The Answer with the best roll. Shape (9, 1)."""
        roll = unwrap_roll(self.rig, best.c, best.s, previous)
        joints = joints_of(self.rig, target, roll, self._posture(target, best.c, best.s))
        spoilt = ca.if_else(ca.SX(status) == 0, 0, np.nan)
        return ca.vertcat(*Answer(joints + spoilt, best.cost + spoilt, best.code, status))


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
