"""Inverse kinematics of the captive trajectory rig at the optimal roll angle, in a bounded number of operations.

The optimal roll on a set of arcs is a stationary point of the index inside an arc, or an end of an arc. Stationary
points come first: in closed form for I1 (`trigonometric.least_point`), and by Newton's method on intervals of convexity
for I2, which adds the squared change of roll. If the best of them is within reach and limits, it is globally optimal.

Otherwise the ends of the arcs matter, and `Search` evaluates them in order until no other can improve. Ends at limits
of joints 4 to 6 and at the reach of the pitch link have a closed form and are all compared. The others are first
approximated; one is polished and checked only if a lower bound of the index near it is below the incumbent's. If the
roll changes from one that violates a limit of joint 1 alone in the direction of increasing index, the first feasible
roll is at that limit. The ends at a limit of joint 1, which are the most expensive, are therefore computed only if a
roll better than the incumbent violates that limit.

The functions of the search exchange matrices. Each column holds the scalars of one named tuple.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, NamedTuple, TypeVar

import casadi as ca
import numpy as np

from models.checks import require
from models.cts.rig import HOME, Branch, Rig, RigConfiguration, Tunnel, checked_branch, configuration_at, joints_of
from models.cts.roll import (
    ArcEndLevel,
    Candidate,
    chart_residual,
    check_constraints,
    checked_gain,
    closed_form_ends,
    convex_minima,
    index_harmonics,
    infeasibility_code,
    inside_limit,
    level_points,
    limit_code,
    polish_to_level,
    slide_points,
    unwrap_roll,
    yaw_chart,
    yaw_levels,
)
from models.cts.trigonometric import ROOTS, Harmonics, Point, least_point, polish, roots
from models.errors import ModelError
from models.spatial import Expression

_Record = TypeVar("_Record")


class Incumbent(NamedTuple):
    """Best feasible roll angle that the search for the optimal roll of a captive trajectory rig has found so far.

    Attributes:
        cost: Value of the index at the roll; inf if there is none yet.
        c, s: Cosine and sine of the roll.
        code: Code in roll.ACTIVE of the constraint that is active at the roll.
        below, above: Least cost of any roll that satisfies all constraints but the lower, or upper, limit of joint 1.
    """

    cost: Expression
    c: Expression
    s: Expression
    code: Expression
    below: Expression
    above: Expression


class RoughRoll(NamedTuple):
    """Approximation of a roll angle of the rig that may be optimal, with a lower bound of the cost near this angle.

    Attributes:
        bound: Lower bound of the cost near the point; inf if the roll is infeasible.
        c, s: Cosine and sine.
        value: Value of cos q2, or of q1 (m), at the polished roll; at a stationary point, the present cos q2.
        code: Code in roll.ACTIVE of the constraint that is active at the polished roll.
        side: 1 if the constraint is satisfied above the value, -1 if below.
    """

    bound: Expression
    c: Expression
    s: Expression
    value: Expression
    code: Expression
    side: Expression


class Evaluation(NamedTuple):
    """Cost and cosine of joint angle 2 at a roll angle; the cost is inf if pitch link or joints 4 to 6 exclude it."""

    cost: Expression
    cos2: Expression


INCUMBENT_SIZE, SOLUTION_SIZE = len(Incumbent._fields), 9
NO_INCUMBENT = Incumbent(ca.inf, 1, 0, 0, ca.inf, ca.inf)
NO_ROLL = RoughRoll(ca.inf, 1, 0, 0, 0, 0)


class RigSolution(NamedTuple):
    """Result of the rig's inverse kinematics: joint positions (6, 1), cost, codes of active constraint and status."""

    joints: Expression
    cost: Expression
    active: Expression
    status: Expression


def stack(kind: Any, records: Sequence[Any]) -> Expression:
    """Return the matrix whose columns are given named tuples of one class. Shape (fields, tuples)."""
    return ca.horzcat(*[ca.vertcat(*record) for record in records]) if records else ca.SX(len(kind._fields), 0)


def unstack(kind: Callable[..., _Record], matrix: Expression) -> list[_Record]:
    """Return the columns of a matrix as named tuples of one class; this is the inverse of `stack`."""
    return [_record(kind, column) for column in ca.horzsplit(matrix)]


def _record(kind: Callable[..., _Record], column: Expression) -> _Record:
    """Return one column of a result of `stack` as a named tuple."""
    return kind(*ca.vertsplit(column))


def _inputs(symbols: Any) -> tuple[Any, Any]:
    return symbols.sym("target", 5), symbols.sym("previous")


def optimal_inverse(
    rig: Rig, tunnel: Tunnel, branch: Branch = HOME, *, rate_weight: float = 0.0, limits: bool = True
) -> Any:
    """Return the CasADi Function that computes the rig's joint positions for a target at the roll angle of least cost.

    Args:
        rig: Dimensions and joint limits.
        tunnel: Centre, ranges and weights of the index.
        branch: Branch of inverse kinematics.
        rate_weight: w4 of I2 = I1 + w4 / (2 pi) (roll - previous)^2, equation (37) of the paper; 0 for I1.
        limits: Whether reach and joint limits constrain the roll. Without them the minimum of the index is returned, in
            closed form, and the status says whether the pose is within reach and limits.

    Returns:
        The Function (target, previous) -> (joints, cost, active, status). Inputs: target (x, y, z, yaw, pitch), shape
        (5,); previous roll, rad. Outputs: joint positions, shape (6,), nan unless the status is 0; the index; code of
        the active constraint in roll.ACTIVE; code in roll.STATUS. The roll is given in the turn nearest to the previous
        roll that the limits of joint 6 allow or, if they are less than a full turn apart, between them.

    Raises:
        ModelError: The rate weight is negative or not finite, or limits=False has a rate weight.
    """
    require.instance("rig: rig", rig, Rig)
    require.instance("rig: tunnel", tunnel, Tunnel)
    branch, limits = checked_branch(branch), require.flag("rig: limits", limits)
    gain = checked_gain(rate_weight)
    if gain and not limits:
        message = "limits=False is for the closed form of I1; with a rate weight leave limits on"
        raise ModelError(message, name="limits", value=limits)
    return _build_inverse(rig, tunnel, branch, gain, limits)


@lru_cache(maxsize=32)
def _build_inverse(rig: Rig, tunnel: Tunnel, branch: Branch, gain: float, limits: bool) -> Any:
    search = Search(rig, tunnel, branch, gain)
    target, previous = _inputs(ca.MX)
    direct = search.direct()
    result, done, best, evaluations = direct(target, previous)
    if limits:
        search_ends = search.search_ends(direct.size2_out(3))
        result = evaluate_unless(search_ends, (SOLUTION_SIZE, 1))(done, result, target, previous, best, evaluations)
    name = f"optimal_inverse_{'i2' if gain else 'i1'}{'' if limits else '_free'}"
    outputs = RigSolution(*ca.vertsplit(result, [0, 6, 7, 8, 9]))
    return ca.Function(name, [target, previous], list(outputs), ["target", "previous"], list(RigSolution._fields))


@dataclass(frozen=True)
class Search:
    """Search for the rig's roll angle of least cost; its methods return the CasADi Functions that perform its steps.

    The argument `best` of these Functions is an Incumbent, `evaluations` columns of Evaluation, `rough` columns of
    RoughRoll. Their result `answer` is a RigSolution.

    Attributes:
        gain: Factor w4 / (2 pi) of the squared change of roll in the index I2; 0 for I1.
    """

    rig: Rig
    tunnel: Tunnel
    branch: Branch
    gain: float

    def direct(self) -> Any:
        """Return the CasADi Function that finds the best roll angle among the stationary points of the cost index.

        (target, previous) -> (answer, done, best, evaluations). `done` says that the answer is final: it is within
        reach and limits, or the input is not finite.
        """
        if self.gain:
            return self._direct_by_descent()
        target, previous = _inputs(ca.SX)
        f = self._index(target)
        c, s = least_point(f)
        check = check_constraints(self.rig, target, self._configuration(target, c, s), c=c, s=s)
        best, evaluations, _ = self._compare(target, previous, [Candidate(c, s, 0)], NO_INCUMBENT)
        angles = ca.logic_and(check.pitch_angles, check.yaw_angles)
        status = ca.if_else(ca.logic_and(check.slide(), angles), 0, 4)
        status = ca.if_else(check.pitch, ca.if_else(check.yaw, status, 3), 2)
        status = ca.if_else(_is_finite(target, previous), status, 1)
        result = self._solution(target, previous, NO_INCUMBENT._replace(cost=f.value(c, s), c=c, s=s), status)
        outputs = [result, status <= 1, ca.vertcat(*best), stack(Evaluation, evaluations)]
        return ca.Function("direct", [target, previous], ca.cse(outputs))

    def _direct_by_descent(self) -> Any:
        target, previous = _inputs(ca.SX)
        rolls = ca.SX.sym("rolls", 5)
        points = [Candidate(ca.cos(rolls[k]), ca.sin(rolls[k]), 0) for k in range(5)]
        if np.isfinite(self.rig.limit(6, False)):  # the penalty on the change may drive the roll to a limit of joint 6
            for upper in (False, True):
                angle = inside_limit(self.rig, 6, upper)
                points.append(Candidate(np.cos(angle), np.sin(angle), limit_code(6, upper)))
        best, evaluations, least = self._compare(target, previous, points, NO_INCUMBENT)
        number = _is_finite(target, previous)
        result = self._solution(target, previous, best, ca.if_else(number, 0, 1))
        done = ca.logic_or(ca.logic_and(least >= best.cost, best.cost < ca.inf), ca.logic_not(number))
        outputs = [result, done, ca.vertcat(*best), stack(Evaluation, evaluations)]
        settle = ca.Function("settle", [target, previous, rolls], ca.cse(outputs))
        x, before = _inputs(ca.MX)
        settled = settle(x, before, convex_minima(self.rig, self.tunnel, self.gain)(x, before))
        return ca.Function("direct", [x, before], list(settled))

    def search_ends(self, count: int) -> Any:
        """Return the CasADi Function that searches the ends of feasible roll intervals for a roll angle of lower cost.

        (target, previous, best, `count` evaluations) -> answer.
        """
        target, previous = _inputs(ca.MX)
        first, evaluations = ca.MX.sym("best", INCUMBENT_SIZE), ca.MX.sym("seen", len(Evaluation._fields), count)
        best, more = self._closed_form_ends()(target, previous, first)
        columns = [evaluations, more]
        chart = yaw_chart(self.rig, self.branch)
        if not self.gain:
            rough = self._rough_stationary()(target)
            best = self._improve(self._stationary, 4)(target, previous, rough, best)
            points = [Evaluation(point.bound, point.value) for point in unstack(RoughRoll, rough)]
            columns.append(stack(Evaluation, points))
        evaluations = ca.horzcat(*columns)
        best = self._yaw_level_ends(chart, evaluations.shape[1])(target, previous, evaluations, best)
        for upper in (False, True):
            if np.isfinite(self.rig.limit(1, upper)):
                incumbent = _record(Incumbent, best)
                settled = (incumbent.above if upper else incumbent.below) >= incumbent.cost
                best = evaluate_unless(self._slide_ends(chart, upper))(settled, best, target, previous, best)
        answer, solved = self._finish()(target, previous, best), _record(Incumbent, best).cost < ca.inf
        result = evaluate_unless(self._infeasible(), (SOLUTION_SIZE, 1))(solved, answer, target)
        return ca.Function("thorough", [target, previous, first, columns[0]], [result])

    def _closed_form_ends(self) -> Any:
        """Return the CasADi Function that compares the best roll with closed-form ends of feasible roll intervals.

        (target, previous, best) -> (best, evaluations).
        """
        target, previous = _inputs(ca.SX)
        first = ca.SX.sym("best", INCUMBENT_SIZE)
        ends = closed_form_ends(self.rig, target, self.branch)
        best, evaluations, _ = self._compare(target, previous, ends, _record(Incumbent, first))
        outputs = ca.cse([ca.vertcat(*best), stack(Evaluation, evaluations)])
        return ca.Function("simple", [target, previous, first], outputs)

    def _rough_stationary(self) -> Any:
        """Return the CasADi Function that approximates the roll angles at which the rig's cost index is stationary.

        (target) -> rough; NO_ROLL if there is only one minimum. In the axes of trigonometric.least_point there are only
        two stationary points outside the astroid |p|^(2/3) + |q|^(2/3) = (4 r)^(2/3), which the circle hypot(p, q) = 4
        r encloses.
        """
        target, _ = _inputs(ca.SX)
        rough, f = self._rough_roll_function(target), self._index(target)
        points = [rough(c, s) for c, s in roots(f.derivative(), steps=0)]
        approximate = ca.Function("rough", [target], ca.cse([stack(RoughRoll, points)]))
        first, second = ca.sqrt(f.a1**2 + f.b1**2), ca.sqrt(f.a2**2 + f.b2**2)
        one_minimum = ca.Function("one_minimum", [target], [first > 4 * second])
        x, no_points = ca.MX.sym("target", 5), stack(RoughRoll, [NO_ROLL] * len(points))
        answer = evaluate_unless(approximate, no_points.shape)(one_minimum(x), no_points, x)
        return ca.Function("rough_stationary", [x], [answer])

    def _yaw_level_ends(self, chart: Any, count: int) -> Any:
        """Return the CasADi Function that compares the best roll so far with rolls at which joint 2 or 3 is at a limit.

        (target, previous, evaluations, best) -> best. A level, the value of cos q2 at such an end, is searched if an
        evaluated roll better than the incumbent is on its infeasible side. All levels are searched if one violates a
        limit of joint 1 alone, since its arc may end before that limit is satisfied.
        """
        target, _ = _inputs(ca.SX)
        rolls = ca.SX.sym("seen", len(Evaluation._fields), count)
        levels, (_, slack) = [], self._slack()
        for level in yaw_levels(self.rig, target, self.branch):
            bound = ca.SX(ca.inf)
            for roll in unstack(Evaluation, rolls):
                over = level.side * (roll.cos2 - level.cosine)
                bound = ca.fmin(bound, ca.if_else(over < slack, roll.cost, ca.inf))
            levels.append(level._replace(bound=ca.if_else(level.relevant, bound, ca.inf)))
        needed = ca.Function("levels", [target, rolls], ca.cse([stack(ArcEndLevel, levels)]))

        suspect, rough = ca.SX.sym("suspect", len(ArcEndLevel._fields)), self._rough_roll_function(target)
        level = _record(ArcEndLevel, suspect)
        ends = level_points(self.rig, target, level.cosine)
        points = [rough(c, s, level.cosine, level.code, level.side, about=(level.cosine, slack)) for c, s in ends]
        near_level = ca.Function("rough", [target, suspect], ca.cse([stack(RoughRoll, points)]))

        def polished(at: Expression, end: RoughRoll) -> Point:
            return polish_to_level(self.rig, chart, at, value=end.value, above=end.side, point=(end.c, end.s))

        x, before = _inputs(ca.MX)
        first, column = ca.MX.sym("best", INCUMBENT_SIZE), ca.MX.sym("suspect", len(ArcEndLevel._fields))
        answer = self._improve(polished, len(points))(x, before, near_level(x, column), first)
        search_level = evaluate_unless(ca.Function("level", [x, before, column, first], [answer]))
        evaluations = ca.MX.sym("seen", *rolls.shape)
        best = first
        for level in ca.horzsplit(needed(x, evaluations)):
            settled = _record(ArcEndLevel, level).bound >= _record(Incumbent, best).cost
            best = search_level(settled, best, x, before, level, best)
        if np.isfinite([self.rig.limit(1, False), self.rig.limit(1, True)]).any():
            for level in ca.horzsplit(needed(x, evaluations)):
                incumbent, relevant = _record(Incumbent, best), _record(ArcEndLevel, level).relevant
                cannot_improve = ca.fmin(incumbent.below, incumbent.above) >= incumbent.cost
                settled = ca.logic_or(cannot_improve, ca.logic_not(relevant))
                best = search_level(settled, best, x, before, level, best)
        return ca.Function("levels", [x, before, evaluations, first], [best])

    def _slide_ends(self, chart: Any, upper: bool) -> Any:
        """Return the CasADi Function that compares the best roll so far with rolls at which joint 1 is at a limit.

        (target, previous, best) -> best.
        """
        target, points = ca.SX.sym("target", 5), ca.SX.sym("points", 2, 8)
        rough, reach = self._rough_roll_function(target), (0, 1 + self._slack()[1])
        datum = inside_limit(self.rig, 1, upper), limit_code(1, upper)
        ends = [rough(points[0, k], points[1, k], *datum, about=reach) for k in range(8)]
        near_limit = ca.Function("rough", [target, points], ca.cse([stack(RoughRoll, ends)]))

        def polished(at: Expression, end: RoughRoll) -> Point:
            return polish((end.c, end.s), chart_residual(chart, at, 2, end.value))

        x, before = _inputs(ca.MX)
        best = ca.MX.sym("best", INCUMBENT_SIZE)
        answer = self._improve(polished, len(ends))(x, before, near_limit(x, slide_points(self.rig, upper)(x)), best)
        return ca.Function("slide", [x, before, best], [answer])

    def _slack(self) -> tuple[float, float]:
        """Return how much sin q4 and cos q2 (q: joint angles) can change if the roll changes by `root_tolerance`."""
        rig = self.rig
        sin4 = ROOTS.root_tolerance * rig.goose_neck / rig.pitch_link
        cos4 = float(np.sqrt(2 * sin4)) + sin4
        return sin4, (ROOTS.root_tolerance * rig.goose_neck + rig.pitch_link * cos4) / rig.yaw_link_1

    def _rough_roll_function(self, target: Expression) -> Callable[..., RoughRoll]:
        """Return the function from a roll angle (cosine, sine) to its RoughRoll, with a lower bound of the cost nearby.

        `about` = (middle, half width) is the range of cos q2 outside of which the bound is inf.
        """
        f, (slack4, _) = self._index(target), self._slack()
        slack = ROOTS.root_tolerance * (ca.fabs(f.a1) + ca.fabs(f.b1) + 2 * (ca.fabs(f.a2) + ca.fabs(f.b2)))

        def rough(
            c: Expression, s: Expression, value: Expression = None, code: Any = 0, side: Any = 0, about: Any = None
        ) -> RoughRoll:
            configuration = self._configuration(target, c, s)
            is_near = ca.fabs(configuration.sin4) < 1 + slack4
            if about is not None:
                is_near = ca.logic_and(is_near, ca.fabs(configuration.cos2 - about[0]) < about[1])
            bound = ca.if_else(is_near, f.value(c, s) - slack, ca.inf)
            return RoughRoll(bound, c, s, configuration.cos2 if value is None else value, code, side)

        return rough

    def _improve(self, polished: Callable[[Expression, RoughRoll], Point], count: int) -> Any:
        """Return the CasADi Function that refines `count` approximate rolls and returns the best of them and of `best`.

        (target, previous, rough, best) -> best. Rolls whose bound is not below the cost of the incumbent are skipped.
        """
        target, previous = _inputs(ca.SX)
        rough, first = ca.SX.sym("rough", len(RoughRoll._fields)), ca.SX.sym("best", INCUMBENT_SIZE)
        point = _record(RoughRoll, rough)
        candidate = Candidate(*polished(target, point), point.code)
        best, _, _ = self._compare(target, previous, [candidate], _record(Incumbent, first))
        sharpen = ca.Function("sharpen", [target, previous, rough, first], ca.cse([ca.vertcat(*best)]))

        target, previous = _inputs(ca.MX)
        first, rough = ca.MX.sym("best", INCUMBENT_SIZE), ca.MX.sym("rough", len(RoughRoll._fields), count)
        gate, column = evaluate_unless(sharpen), first
        for point in ca.horzsplit(rough):
            settled = _record(RoughRoll, point).bound >= _record(Incumbent, column).cost
            column = gate(settled, column, target, previous, point, column)
        return ca.Function("gates", [target, previous, rough, first], [column])

    def _stationary(self, target: Expression, rough: RoughRoll) -> Point:
        """Return the stationary point of the cost index near an approximate roll angle, by Newton's method."""
        slope = self._index(target).derivative()
        bend = slope.derivative()
        return polish((rough.c, rough.s), lambda c, s: (slope.value(c, s), bend.value(c, s)))

    def _compare(
        self, target: Expression, previous: Expression, points: Sequence[Candidate], best: Incumbent
    ) -> tuple[Incumbent, list[Evaluation], Expression]:
        """Compare given rolls with the best roll so far, `best`; return the new best roll and the given rolls' costs.

        The result is (Incumbent, list of Evaluation, least cost) with evaluations and least cost of the given rolls.
        """
        f = self._index(target)
        cost, c, s, code, below, above = best
        least, evaluations = ca.SX(ca.inf), []
        for point in points:
            value = f.value(point.c, point.s)
            if self.gain:
                value += self.gain * (unwrap_roll(self.rig, point.c, point.s, previous) - previous) ** 2
            configuration = self._configuration(target, point.c, point.s)
            check = check_constraints(self.rig, target, configuration, c=point.c, s=point.s)
            all_but_slide = check.all_but_slide()
            better = ca.logic_and(ca.logic_and(all_but_slide, check.slide()), value < cost)
            least = ca.fmin(least, value)
            evaluations.append(Evaluation(ca.if_else(check.is_pitch_reachable(), value, ca.inf), configuration.cos2))
            over = ca.if_else(all_but_slide, value, ca.inf)
            below = ca.fmin(below, ca.if_else(check.slide_lower, ca.inf, over))
            above = ca.fmin(above, ca.if_else(check.slide_upper, ca.inf, over))
            cost = ca.if_else(better, value, cost)
            c, s = ca.if_else(better, point.c, c), ca.if_else(better, point.s, s)
            code = ca.if_else(better, point.code, code)
        return Incumbent(cost, c, s, code, below, above), evaluations, least

    def _index(self, target: Expression) -> Harmonics:
        return index_harmonics(self.rig, self.tunnel, target)

    def _configuration(self, target: Expression, c: Expression, s: Expression) -> RigConfiguration:
        return configuration_at(self.rig, target, c, s, branch=self.branch)

    def _finish(self) -> Any:
        """Return the CasADi Function that computes the joint positions at the best roll angle that the search found."""
        target, previous = _inputs(ca.SX)
        best = ca.SX.sym("best", INCUMBENT_SIZE)
        answer = self._solution(target, previous, _record(Incumbent, best), 0)
        return ca.Function("finish", [target, previous, best], ca.cse([answer]))

    def _infeasible(self) -> Any:
        """Return the CasADi Function for infeasible targets; it returns nan joint positions and a reason as status."""
        target = ca.SX.sym("target", 5)
        result = RigSolution(ca.DM.ones(6) * np.nan, np.nan, 0, infeasibility_code(self.rig, target, self.branch))
        return ca.Function("infeasible", [target], ca.cse([ca.vertcat(*result)]))

    def _solution(self, target: Expression, previous: Expression, best: Incumbent, status: Expression) -> Expression:
        """Return the column, (9, 1), of joint positions, cost, active constraint and status at the best roll so far."""
        roll = unwrap_roll(self.rig, best.c, best.s, previous)
        joints = joints_of(self.rig, target, roll, self._configuration(target, best.c, best.s))
        spoilt = ca.if_else(ca.SX(status) == 0, 0, np.nan)
        return ca.vertcat(*RigSolution(joints + spoilt, best.cost + spoilt, best.code, status))


def _is_finite(target: Expression, previous: Expression) -> Expression:
    """Return whether all entries of the target and the previous roll angle are finite."""
    return ca.fabs(ca.sum1(target) + previous) < ca.inf


def evaluate_unless(alternative: Any, shape: tuple[int, int] = (INCUMBENT_SIZE, 1)) -> Any:
    """Return a CasADi Function that returns a known value if a condition holds, and otherwise calls another Function.

    (settled, known, *arguments) -> `known` if `settled` is true, else alternative(*arguments). The alternative is only
    evaluated if needed. casadi.if_else would also evaluate what its arguments depend on.
    """
    known = ca.MX.sym("known", *shape)
    inputs = [ca.MX.sym(f"x{i}", alternative.sparsity_in(i)) for i in range(alternative.n_in())]
    keep = ca.Function("keep", [known, *inputs], [known])
    call = ca.Function("call", [known, *inputs], alternative.call(inputs))
    return ca.Function.if_else("choose", keep, call)
