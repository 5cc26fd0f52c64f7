"""Roll of the captive trajectory rig planned over the whole trajectory: no lag behind what is to come, limits of rates.

The paper resolves each target by itself, with the change of roll since the last one in the index (38): the plan lags
behind what is to come. Here the integral of I1 and of the squared roll rate is least over all targets at once.

The first guess finds the way round. The roll of least index of each target by itself may lie inside an obstacle, or
jump from one side of it to the other; near such a guess there is no plan. So the whole course of least cost is found
by dynamic programming over a grid of rolls and times, with penalties for what is out of reach, beyond limits or too
near, and is then refined within a tube about itself that grows thinner.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import casadi as ca
import numpy as np

from models import ModelError
from models.arrays import Array
from models.cts.best_roll import optimal_inverse
from models.cts.clearance import CollisionScene, Radii, checked_clearance, clearances, proximity_cost
from models.cts.rig import HOME, Branch, Rig, Tunnel, checked_branch, configuration_at, joints_of
from models.cts.roll import index_harmonics
from models.cts.table import checked_targets
from models.shapes.distance import soft_minimum
from models.spatial import FULL_TURN, expression
from ocp.console import interruptible
from ocp.direct.guess import Samples
from ocp.errors import NOT_NUMBERS, ProblemError, checked_instance, checked_positive, floats, real
from ocp.problem.problem import Problem

__all__ = ["least_course", "roll_problem", "spline_targets"]

Targets = Callable[[Any], Any]
LARGEST_SINE = 1 - 1e-9  # of q4, and cosine of q2: short of the end of the reach


@dataclass(frozen=True)
class RollGuessSettings:
    """How the first guess of the roll is looked for: a shortest way over a grid of times and rolls, refined in a tube.

    Attributes:
        times: Of the grid.
        price: Of a violation, per m, rad or unit of a sine.
        margin: Widths of the smooth minimum that the guess keeps beyond the clearance asked for.
        rolls: Of the grid, to a turn.
        tube_side: Rolls of the tube to each side.
        tube_finer: How much finer each level of the tube is.
        tube_levels: Levels of the tube.
        largest_way: How far from its start a roll with limits is looked for, rad.
        steps_by_rate: Grid steps that the rate limit should allow from one time to the next.
    """

    times: int = 65
    price: float = 1e3
    margin: float = 2.0
    rolls: int = 120
    tube_side: int = 8
    tube_finer: int = 4
    tube_levels: int = 3
    largest_way: float = 2 * FULL_TURN
    steps_by_rate: float = 2.0


SEARCH = RollGuessSettings()


@interruptible
def spline_targets(times: Any, targets: Any) -> Targets:
    """Cubic spline through a table of targets, as a function of time for a problem with MX symbols.

    Args:
        times: Increasing, shape (samples,), s; at least 4.
        targets: Shape (samples, 5), m and rad.

    Raises:
        ProblemError: Fewer than 4 samples, times that do not increase, or targets of another shape or not finite.
    """
    try:
        t = floats(times)
    except NOT_NUMBERS as error:
        raise ProblemError(f"times {times!r} are not numeric", name="times", value=times) from error
    try:
        rows = checked_targets(targets)
    except ModelError as error:
        raise ProblemError(str(error), name=error.name, value=error.value) from error
    if t.shape != (len(rows),) or len(t) < 4 or not (np.diff(t) > 0).all():
        message = f"times of shape {t.shape} must increase, one for each of the {len(rows)} targets, 4 at least"
        raise ProblemError(message, name="times", value=t, limit=(len(rows),))
    curve = ca.interpolant("targets", "bspline", [t], rows.ravel())
    return lambda time: curve(time)


@interruptible
def roll_problem(
    rig: Rig,
    tunnel: Tunnel,
    targets: Targets,
    horizon: float,
    *,
    branch: Branch = HOME,
    rate_weight: float = 0.05,
    acceleration_weight: float = 1e-4,
    rate_limit: float = np.inf,
    acceleration_limit: float = np.inf,
    start_roll: float | None = None,
    start_rate: float | None = None,
    scene: CollisionScene | None = None,
    clearance: float = 0.0,
    clearance_weight: float = 0.0,
    clearance_width: float = 0.05,
    softness: float = 2e-3,
    radii: Radii | None = None,
    symbols: Any = ca.MX,
) -> Problem:
    """Roll over a whole trajectory of targets, of least integral of I1 + w rate^2 + v acceleration^2.

    States "roll" (rad) and "rate" (rad/s), control "acceleration" (rad/s^2). The path constraints "reach" (sin q4 and
    cos q2) and "limits" keep the rig within its reach and joint limits, "clearance" a distance from its surroundings.

    Args:
        targets: Function of `problem.time` (s) that returns the target, shape (5, 1): expressions, or spline_targets.
        horizon: s.
        branch: Which of the four joint sets.
        rate_weight, acceleration_weight: w in s^2 and v in s^4; v keeps the control smooth.
        rate_limit, acceleration_limit: rad/s and rad/s^2.
        start_roll, start_rate: At time 0; free where None.
        scene: What to keep away from; None for nothing.
        clearance: Least distance from it, m; -inf for no constraint.
        clearance_weight, clearance_width: Of the term weight exp(-distance / width) of the index; width in m.
        softness: Width of the smooth minimum of all distances, m, see soft_minimum.
        radii: Of the rig's capsules.
        symbols: casadi.MX, or casadi.SX where the targets are plain expressions.

    Returns:
        The problem; its guess is the course of least cost on a grid of rolls and times, see least_course.

    Raises:
        ProblemError: Weights or limits that are negative, a horizon that is not positive, a target on the way that
            no roll reaches, a start outside the limits.
    """
    weights = {"rate_weight": rate_weight, "acceleration_weight": acceleration_weight, "rate_limit": rate_limit}
    weights |= {"acceleration_limit": acceleration_limit, "clearance_weight": clearance_weight}
    for name, value in weights.items():
        number = real(value)
        if not number >= 0 or (np.isinf(number) and name.endswith("weight")):
            message = f"roll_problem: {name} must be a number that is not negative, not {value!r}"
            raise ProblemError(message, name=name, value=value, limit=0.0)
    checked_positive("roll_problem: clearance_width", clearance_width)
    try:
        checked_clearance(clearance)
        branch = checked_branch(branch)
    except ModelError as error:
        raise ProblemError(f"roll_problem: {error}", name=error.name, value=error.value) from error
    checked_positive("roll_problem: horizon", horizon)
    for name, given in (("start_roll", start_roll), ("start_rate", start_rate)):
        if given is not None and not np.isfinite(real(given)):
            raise ProblemError(f"roll_problem: {name} {given!r} must be a finite number", name=name, value=given)
    checked_instance("roll_problem: rig", rig, Rig)
    checked_instance("roll_problem: tunnel", tunnel, Tunnel)
    if radii is not None:
        checked_instance("roll_problem: radii", radii, Radii)
    checked_positive("roll_problem: softness", softness)
    if symbols not in (ca.SX, ca.MX):
        words = f"roll_problem: symbols must be casadi.SX or casadi.MX, not {symbols!r}"
        raise ProblemError(words, name="symbols", value=symbols)
    x, phi = ca.SX.sym("target", 5), ca.SX.sym("roll")
    c, s = ca.cos(phi), ca.sin(phi)
    posture = configuration_at(rig, x, c, s, branch)
    joints = joints_of(rig, x, phi, posture)
    held = [k for k in range(5) if np.isfinite([rig.lower[k], rig.upper[k]]).any()]
    limited = ca.vertcat(*[joints[k] for k in held])
    reached = ca.vertcat(posture.sin4, posture.cos2)
    index = index_harmonics(rig, tunnel, x).value(c, s)
    near: Any = 0.0
    short = _beyond(reached, -LARGEST_SINE, LARGEST_SINE) + _beyond(limited, rig.lower[held], rig.upper[held])
    if scene is not None:
        gap = soft_minimum(list(clearances(rig, joints, scene, radii).values()), softness)
        near = proximity_cost(gap, clearance_weight, clearance_width)
        if np.isfinite(clearance):
            short += ca.fmax(clearance + SEARCH.margin * softness - gap, 0)
    t = np.linspace(0, horizon, SEARCH.times)
    rows = np.array(_curve(targets, symbols).map(len(t))(t[None]))
    status = np.array(optimal_inverse(rig, tunnel, branch).map(len(t))(rows, np.zeros((1, len(t))))[3])[0]
    if status.any():
        missed = int(np.flatnonzero(status)[0])
        message = f"roll_problem: no roll reaches the target at {t[missed]:.4g} s; see solve_table"
        raise ProblemError(message, name="target", value=rows[:, missed], time=float(t[missed]))
    price = ca.Function("price", [x, phi], [ca.cse(index + ca.fmin(near, SEARCH.price) + SEARCH.price * short)])
    first = least_course(
        lambda times, rolls: np.asarray(np.array(price.map(len(rolls))(rows[:, times], rolls[None]))[0]),
        t,
        lower=rig.limit(6, False),
        upper=rig.limit(6, True),
        start=start_roll,
        rate_weight=rate_weight,
        acceleration_weight=acceleration_weight,
        rate_limit=rate_limit,
    )
    start, speed = Samples(t, first[:, None]), Samples(t, np.gradient(first, t)[:, None])

    problem = Problem("roll plan", symbols=symbols)
    roll = problem.state("roll", 1, initial=start_roll, lower=rig.lower[5], upper=rig.upper[5], guess=start, unit="rad")
    rate = problem.state("rate", 1, initial=start_rate, lower=-rate_limit, upper=rate_limit, guess=speed, unit="rad/s")
    pull = problem.control(
        "acceleration", 1, lower=-acceleration_limit, upper=acceleration_limit, guess=0.0, unit="rad/s^2"
    )
    problem.horizon(horizon)
    problem.dynamics(roll, rate)
    problem.dynamics(rate, pull)
    target = _column(targets, problem.time)

    def along(name: str, value: Any) -> Any:
        """The value on the way."""
        return ca.Function(name, [x, phi], [value])(target, roll)

    problem.path("reach", along("reach", reached), -LARGEST_SINE, LARGEST_SINE)
    if held:
        unit = ", ".join(dict.fromkeys("rad" if k else "m" for k in held))  # the first joint slides
        problem.path("limits", along("joints", limited), rig.lower[held], rig.upper[held], unit=unit)
    if scene is not None and np.isfinite(clearance):
        problem.path("clearance", along("gap", gap), clearance, unit="m")
    running = along("index", index + near)
    problem.minimize(running=running + rate_weight * rate**2 + acceleration_weight * pull**2)
    return problem


def _column(targets: Targets, time: Any) -> Any:
    """A target at a symbol of time, shape (5, 1); ProblemError where it is none, or the function fails."""
    try:
        target = expression(targets(time))
    except RuntimeError:  # what interpolants say of SX symbols
        raise
    except Exception as error:  # of the function's own
        words = f"roll_problem: targets must be a function of time that gives (5,), not {targets!r}: {error!r}"
        raise ProblemError(words, name="targets", value=targets) from error
    symbols = [] if isinstance(target, ca.DM) else ca.symvar(target)
    strange = [str(symbol) for symbol in symbols if not ca.is_equal(symbol, time, 1)]
    if target.shape != (5, 1) or strange or (isinstance(target, ca.DM) and not target.is_regular()):
        words = f"roll_problem: targets gives {target}, not five finite numbers or expressions of the time"
        raise ProblemError(words, name="targets", value=str(target), limit=(5, 1))
    return target


def _curve(targets: Targets, symbols: Any) -> Any:
    """Function of time -> target."""
    time = symbols.sym("time")
    return ca.Function("target", [time], [_column(targets, time)])


def _beyond(value: Any, lower: Any, upper: Any) -> Any:
    """By how much the entries are outside their bounds, in total."""
    return ca.sum1(ca.fmax(lower - value, 0) + ca.fmax(value - upper, 0)) if value.numel() else 0.0


def least_course(
    cost: Any,
    t: Array,
    *,
    lower: float,
    upper: float,
    start: float | None,
    rate_weight: float,
    acceleration_weight: float,
    rate_limit: float,
) -> Array:
    """Roll over time of least integral of cost + rate_weight rate^2, to the step of a grid. Shape (samples,), rad.

    Args:
        cost: Function (indices of times, rolls), both of shape (n,) -> costs, shape (n,), finite.
        t: Equally spaced times, shape (samples,), s.
        lower, upper: Of the roll, rad; infinite for none: then all rolls of a turn are looked at and the course
            winds as it likes.
        start: Roll at t[0]; None for a free one, which is then given in the turn nearest to 0.
        acceleration_weight: Of the squared acceleration, which a grid of rolls does not see: a weight of the rate that
            makes a change of roll as dear, in the time best for it, stands in its place.
        rate_limit: rad/s; the first grid may exceed it by one step.
    """
    count, about = len(t), float(np.clip(0.0, lower, upper)) if start is None else start
    step = FULL_TURN / SEARCH.rolls
    circle = not np.isfinite([lower, upper]).any()
    if circle:
        rolls = about + step * np.arange(SEARCH.rolls) - np.pi
    else:
        first, last = max(lower, about - SEARCH.largest_way), min(upper, about + SEARCH.largest_way)
        rolls = np.linspace(first, last, int(np.ceil((last - first) / step)) + 1) if first < last else np.array([about])
    table = cost(np.repeat(np.arange(count), len(rolls)), np.tile(rolls, count)).reshape(count, -1)
    gain = float(np.median(np.median(table, axis=1) - table.min(axis=1)))  # of the best roll over any
    span = min(t[-1] - t[0], (36 * acceleration_weight / max(gain, 1e-12)) ** 0.25)  # least gain span + 12 v / span^3
    if span > 0:
        rate_weight += 12 * acceleration_weight / span**2
    if start is not None:
        table[0, np.arange(len(rolls)) != int(np.abs(rolls - about).argmin())] = np.inf
    # a slow roll needs a coarse grid of times: else a step of the grid is faster than it may move
    ticks = int(np.clip((t[-1] - t[0]) * min(rate_limit, 1e6) / (SEARCH.steps_by_rate * step), 8, count))
    groups = np.array_split(np.arange(count), ticks)
    stage = np.array([table[group].mean(axis=0) for group in groups])
    at = np.array([t[group].mean() for group in groups])
    away = rolls[None, :] - rolls[:, None]
    if circle:
        away = (away + np.pi) % FULL_TURN - np.pi
    path = _cheapest(stage, [away] * (ticks - 1), np.diff(at), rate_weight, rate_limit, step)
    moves = [away[i, k] for i, k in pairwise(path)]
    roll = np.interp(t, at, rolls[path[0]] + np.concatenate([[0.0], np.cumsum(moves)]))
    for _ in range(SEARCH.tube_levels):
        step /= SEARCH.tube_finer
        offsets = step * np.arange(-SEARCH.tube_side, SEARCH.tube_side + 1)
        tube = np.clip(roll[:, None] + offsets, lower, upper)
        if start is not None:
            tube[0] = start
        stage = cost(np.repeat(np.arange(count), len(offsets)), tube.ravel()).reshape(count, -1)
        away_by_time = [b[None, :] - a[:, None] for a, b in pairwise(tube)]
        path = _cheapest(stage, away_by_time, np.diff(t), rate_weight, rate_limit, step)
        roll = tube[np.arange(count), path]
    return np.asarray(roll)


def _cheapest(stage: Array, away: Any, spans: Array, rate_weight: float, rate_limit: float, step: float) -> Any:
    """Indices of the rolls of the cheapest course, one for each time; moves beyond the rate limit cost dearly."""
    weights = np.convolve(np.append(spans, 0), [0.5, 0.5])[: len(stage)]
    weights[[0, -1]] = np.maximum(weights[[0, -1]], spans[[0, -1]] / 2)
    dear = 1e3 * (np.ptp(stage[np.isfinite(stage)]) + rate_weight + 1e-9)
    total, back = weights[0] * stage[0], []
    for k, span in enumerate(spans):
        over = np.maximum(np.abs(away[k]) - max(rate_limit * span, step), 0.0)
        costs = total[:, None] + rate_weight * away[k] ** 2 / span + dear * over
        best = costs.argmin(axis=0)
        back.append(best)
        total = costs[best, np.arange(costs.shape[1])] + weights[k + 1] * stage[k + 1]
    path = [int(total.argmin())]
    for best in reversed(back):
        path.append(int(best[path[-1]]))
    return np.array(path[::-1])
