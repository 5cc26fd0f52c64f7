"""Optimal control of the roll, the redundant angle of the captive trajectory rig, along a whole tool trajectory.

The paper, Lee, Lee 2017, resolves each target by itself; its roll lags behind the targets. Here the integral of the
index I1, see `models.cts.roll`, and of the squared roll rate is minimised over all targets together. The first guess
chooses the homotopy class: dynamic programming over a grid of rolls and times finds the roll of least total cost, with
penalties for targets out of reach, limits and clearance, and is refined on finer grids about it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import casadi as ca
import numpy as np

from models.checks import Array, real
from models.cts.best_roll import optimal_inverse
from models.cts.clearance import Avoidance
from models.cts.rig import HOME, Branch, Rig, Tunnel, checked_branch, configuration_at, joints_of
from models.cts.roll import index_harmonics
from models.cts.table import checked_targets
from models.spatial import FULL_TURN
from ocp.console import interruptible
from ocp.direct.guess import Samples
from ocp.errors import ProblemError, problem_errors, require
from ocp.motion.tasks.tracks import track_expression
from ocp.problem.problem import Problem

Targets = Callable[[Any], Any]
LARGEST_SINE = 1 - 1e-9  # largest magnitude of the sine of q4 and the cosine of q2: the rig is just within reach


@dataclass(frozen=True)
class RollGuessSettings:
    """Settings of the search for an initial guess of the roll on finer and finer grids of times and roll angles."""

    times: int = 65  # number of times of the grid
    price: float = 1e3  # cost of a violation, per m, rad or unit of a sine
    margin: float = 2.0  # distance beyond the clearance, in widths of the smooth minimum
    rolls: int = 120  # number of rolls of the grid in a full turn
    tube_side: int = 8  # number of rolls of a finer grid on each side of the last path
    tube_finer: int = 4  # factor by which each finer grid has smaller steps
    tube_levels: int = 3  # number of finer grids
    largest_roll: float = 2 * FULL_TURN  # largest distance from the start at which a roll with limits is searched, rad
    steps_by_rate: float = 2.0  # grid steps that the rate limit should allow from one time to the next


SEARCH = RollGuessSettings()


@interruptible
def spline_targets(times: Any, targets: Any) -> Targets:
    """Return the cubic spline through a table of tool targets as a function of time, for problems with MX symbols.

    Args:
        times: At least 4 increasing times. Shape (samples,), s.
        targets: Position, yaw and pitch of the tool. Shape (samples, 5), m and rad.

    Raises:
        ProblemError: There are fewer than 4 samples, the times do not increase, or the targets have another shape or
            are not finite.
    """
    t = require.array("times", times)
    with problem_errors():
        rows = checked_targets(targets)
    if t.shape != (len(rows),) or len(t) < 4 or not (np.diff(t) > 0).all():
        message = f"times of shape {t.shape} must increase, one for each of the {len(rows)} targets, 4 at least"
        raise ProblemError(message, name="times", value=t, limit=(len(rows),))
    curve = ca.interpolant("targets", "bspline", [t], rows.ravel())
    return lambda time: curve(time)


@dataclass(frozen=True, eq=False)
class RollSettings:
    """Settings of `roll_problem`: cost weights, limits, and the branch of the inverse kinematics of the rig.

    Attributes:
        rate_weight, acceleration_weight: Weights w, s^2, and v, s^4, of the cost; v keeps the control smooth.
        rate_limit, acceleration_limit: Limits of the roll, rad/s and rad/s^2.
        branch: One of the four branches of inverse kinematics.
        symbols: casadi.MX, or casadi.SX if the targets are plain expressions.

    Raises:
        ProblemError: A weight or limit is negative, or another value is invalid.
    """

    rate_weight: float = 0.05
    acceleration_weight: float = 1e-4
    rate_limit: float = np.inf
    acceleration_limit: float = np.inf
    branch: Branch = HOME
    symbols: Any = ca.MX

    def __post_init__(self) -> None:
        for name in ("rate_weight", "acceleration_weight", "rate_limit", "acceleration_limit"):
            entries: Any = "finite" if name.endswith("weight") else "numbers"
            require.array(f"roll_problem: {name}", getattr(self, name), (), entries=entries, sign="nonnegative")
        with problem_errors("roll_problem: "):
            object.__setattr__(self, "branch", checked_branch(self.branch))
        if self.symbols not in (ca.SX, ca.MX):
            words = f"roll_problem: symbols must be casadi.SX or casadi.MX, not {self.symbols!r}"
            raise ProblemError(words, name="symbols", value=self.symbols)


@interruptible
def roll_problem(
    rig: Rig,
    tunnel: Tunnel,
    targets: Targets,
    horizon: float,
    *,
    start_roll: float | None = None,
    start_rate: float | None = None,
    settings: RollSettings | None = None,
    avoidance: Avoidance | None = None,
) -> Problem:
    """Declare the optimal control problem of the rig's redundant angle (roll) along a trajectory of tool targets.

    The cost is the integral of I1 + w rate^2 + v acceleration^2, with the index I1 and the weights w and v. The states
    are "roll" (rad) and "rate" (rad/s), the control is "acceleration" (rad/s^2). The path constraints "reach" (sin q4
    and cos q2), "limits" and "clearance" keep the rig within its reach and joint limits and away from obstacles. The
    guess is the roll of least cost on a grid of rolls and times.

    Args:
        targets: Function of `problem.time` (s) that returns the target, shape (5, 1): expressions, or spline_targets.
        horizon: Final time, s.
        start_roll, start_rate: Roll (rad) and rate (rad/s) at time 0; free if None.
        settings: Weights and limits.
        avoidance: Obstacles to avoid; None for none.

    Raises:
        ProblemError: The horizon is not positive; no roll reaches one of the targets; the start is outside the limits.
    """
    require.positive("roll_problem: horizon", horizon)
    for name, number in (("start_roll", start_roll), ("start_rate", start_rate)):
        if number is not None and not np.isfinite(real(number)):
            raise ProblemError(f"roll_problem: {name} {number!r} must be a finite number", name=name, value=number)
    require.instance("roll_problem: rig", rig, Rig)
    require.instance("roll_problem: tunnel", tunnel, Tunnel)
    settings = RollSettings() if settings is None else require.instance("settings", settings, RollSettings)
    if avoidance is not None:
        require.instance("avoidance", avoidance, Avoidance)
    symbols, largest, fastest = settings.symbols, settings.acceleration_limit, settings.rate_limit
    x, phi = ca.SX.sym("target", 5), ca.SX.sym("roll")
    c, s = ca.cos(phi), ca.sin(phi)
    solution = configuration_at(rig, x, c, s, branch=settings.branch)
    joints = joints_of(rig, x, phi, solution)
    bounded = [k for k in range(5) if np.isfinite([rig.lower[k], rig.upper[k]]).any()]
    limited = ca.vertcat(*[joints[k] for k in bounded])
    reach = ca.vertcat(solution.sin4, solution.cos2)
    index = index_harmonics(rig, tunnel, x).value(c, s)
    proximity: Any = 0.0
    violation = _violation(reach, -LARGEST_SINE, LARGEST_SINE)
    violation += _violation(limited, rig.lower[bounded], rig.upper[bounded])
    if avoidance is not None:
        gap = avoidance.gap(rig, joints)
        proximity = avoidance.cost(gap)
        if np.isfinite(avoidance.clearance):
            violation += ca.fmax(avoidance.clearance + SEARCH.margin * avoidance.softness - gap, 0)
    t = np.linspace(0, horizon, SEARCH.times)
    time = symbols.sym("time")
    target_at = track_expression(targets, time, (5, 1), label="targets")
    rows = np.array(ca.Function("target", [time], [target_at]).map(len(t))(t[None]))
    status = np.array(optimal_inverse(rig, tunnel, settings.branch).map(len(t))(rows, np.zeros((1, len(t))))[3])[0]
    if status.any():
        first = int(np.flatnonzero(status)[0])
        message = f"roll_problem: no roll reaches the target at {t[first]:.4g} s; see solve_table"
        raise ProblemError(message, name="target", value=rows[:, first], time=float(t[first]))
    price = ca.Function(
        "price", [x, phi], [ca.cse(index + ca.fmin(proximity, SEARCH.price) + SEARCH.price * violation)]
    )

    def price_at(times: Array, values: Array) -> Array:
        return np.asarray(np.array(price.map(len(values))(rows[:, times], values[None]))[0])

    limits = rig.limit(6, False), rig.limit(6, True)
    rolls = least_cost_roll(price_at, t, limits, first_roll=start_roll, settings=settings)
    start, speed = Samples(t, rolls[:, None]), Samples(t, np.gradient(rolls, t)[:, None])

    problem = Problem("roll plan", symbols=symbols)
    roll = problem.state("roll", 1, initial=start_roll, lower=rig.lower[5], upper=rig.upper[5], guess=start, unit="rad")
    rate = problem.state("rate", 1, initial=start_rate, lower=-fastest, upper=fastest, guess=speed, unit="rad/s")
    acceleration = problem.control("acceleration", 1, lower=-largest, upper=largest, guess=0.0, unit="rad/s^2")
    problem.horizon(horizon)
    problem.dynamics(roll, rate)
    problem.dynamics(rate, acceleration)
    target = track_expression(targets, problem.time, (5, 1), label="targets")

    def along(name: str, value: Any) -> Any:
        """Replace the symbols of target and roll in an expression by the problem's target over time and its roll."""
        return ca.Function(name, [x, phi], [value])(target, roll)

    problem.path("reach", along("reach", reach), -LARGEST_SINE, LARGEST_SINE)
    if bounded:
        unit = ", ".join(dict.fromkeys("rad" if k else "m" for k in bounded))  # the first joint slides
        problem.path("limits", along("joints", limited), rig.lower[bounded], rig.upper[bounded], unit=unit)
    if avoidance is not None and np.isfinite(avoidance.clearance):
        problem.path("clearance", along("gap", gap), avoidance.clearance, unit="m")
    running = along("index", index + proximity)
    running = running + settings.rate_weight * rate**2 + settings.acceleration_weight * acceleration**2
    problem.minimize(running=running)
    return problem


def _violation(value: Any, lower: Any, upper: Any) -> Any:
    """Return by how much the values of an expression exceed lower and upper bounds, summed over the values."""
    return ca.sum1(ca.fmax(lower - value, 0) + ca.fmax(value - upper, 0)) if value.numel() else 0.0


def least_cost_roll(
    cost: Any, t: Array, limits: tuple[float, float], *, first_roll: float | None, settings: RollSettings
) -> Array:
    """Return the rig's roll, rad, at equally spaced times (samples,) with the least integral of cost and squared rate.

    Dynamic programming minimises the integral of `cost`, a function of (indices of times, rolls), both (n,), and of the
    weighted squared rate. A grid of rolls does not resolve accelerations. Their weight is replaced by a weight of the
    rate with which a change of roll in its optimal time costs the same. Without limits all rolls of a turn are
    searched, and the roll may wind. The first grid may exceed the rate limit by one step.
    """
    (lower, upper), rate_weight, rate_limit = limits, settings.rate_weight, settings.rate_limit
    count, about = len(t), float(np.clip(0.0, lower, upper)) if first_roll is None else first_roll
    step = FULL_TURN / SEARCH.rolls
    circle = not np.isfinite([lower, upper]).any()
    if circle:
        rolls = about + step * np.arange(SEARCH.rolls) - np.pi
    else:
        first, last = max(lower, about - SEARCH.largest_roll), min(upper, about + SEARCH.largest_roll)
        rolls = np.linspace(first, last, int(np.ceil((last - first) / step)) + 1) if first < last else np.array([about])
    table = cost(np.repeat(np.arange(count), len(rolls)), np.tile(rolls, count)).reshape(count, -1)
    gain = float(np.median(np.median(table, axis=1) - table.min(axis=1)))  # gain of the best roll over a typical one
    longest = (36 * settings.acceleration_weight / max(gain, 1e-12)) ** 0.25  # minimises gain span + 12 v/span^3
    span = min(t[-1] - t[0], longest)
    if span > 0:
        rate_weight += 12 * settings.acceleration_weight / span**2
    if first_roll is not None:
        table[0, np.arange(len(rolls)) != int(np.abs(rolls - about).argmin())] = np.inf
    # a slow roll needs a coarse grid of times, else a grid step exceeds the rate limit
    ticks = int(np.clip((t[-1] - t[0]) * min(rate_limit, 1e6) / (SEARCH.steps_by_rate * step), 8, count))
    groups = np.array_split(np.arange(count), ticks)
    stage = np.array([table[group].mean(axis=0) for group in groups])
    at = np.array([t[group].mean() for group in groups])
    away = rolls[None, :] - rolls[:, None]
    if circle:
        away = (away + np.pi) % FULL_TURN - np.pi
    path = _lowest_cost_path(stage, [away] * (ticks - 1), np.diff(at), rate_weight, rate_limit, step)
    moves = [away[i, k] for i, k in pairwise(path)]
    roll = np.interp(t, at, rolls[path[0]] + np.concatenate([[0.0], np.cumsum(moves)]))
    for _ in range(SEARCH.tube_levels):
        step /= SEARCH.tube_finer
        offsets = step * np.arange(-SEARCH.tube_side, SEARCH.tube_side + 1)
        tube = np.clip(roll[:, None] + offsets, lower, upper)
        if first_roll is not None:
            tube[0] = first_roll
        stage = cost(np.repeat(np.arange(count), len(offsets)), tube.ravel()).reshape(count, -1)
        away_by_time = [b[None, :] - a[:, None] for a, b in pairwise(tube)]
        path = _lowest_cost_path(stage, away_by_time, np.diff(t), rate_weight, rate_limit, step)
        roll = tube[np.arange(count), path]
    return np.asarray(roll)


def _lowest_cost_path(stage: Array, away: Any, spans: Array, rate_weight: float, rate_limit: float, step: float) -> Any:
    """Return the index of the roll at each time on the lowest-cost path through a grid of times and rolls, in which
    rates beyond the limit are penalised.
    """
    weights = np.convolve(np.append(spans, 0), [0.5, 0.5])[: len(stage)]
    weights[[0, -1]] = np.maximum(weights[[0, -1]], spans[[0, -1]] / 2)
    penalty = 1e3 * (np.ptp(stage[np.isfinite(stage)]) + rate_weight + 1e-9)
    total, back = weights[0] * stage[0], []
    for k, span in enumerate(spans):
        excess = np.maximum(np.abs(away[k]) - max(rate_limit * span, step), 0.0)
        costs = total[:, None] + rate_weight * away[k] ** 2 / span + penalty * excess
        best = costs.argmin(axis=0)
        back.append(best)
        total = costs[best, np.arange(costs.shape[1])] + weights[k + 1] * stage[k + 1]
    path = [int(total.argmin())]
    for best in reversed(back):
        path.append(int(best[path[-1]]))
    return np.array(path[::-1])
