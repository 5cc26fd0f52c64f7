"""Roll of the captive trajectory rig planned over the whole trajectory: no lag behind what is to come, limits of rates.

The paper resolves each target by itself, with the change of roll since the last one in the index (38): the plan lags
behind what is to come. Here the integral of I1 and of the squared roll rate is least over all targets at once.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import casadi as ca
import numpy as np

from models import ModelError
from models.arrays import Array
from models.cts.best_roll import optimal_inverse
from models.cts.clearance import Radii, Surroundings, clearances, nearness
from models.cts.rig import HOME, Branch, Rig, Tunnel, joints_of, posture_at
from models.cts.roll import index_harmonics
from models.cts.table import checked_targets
from models.shapes.capsules import soft_minimum
from ocp.builders.cts_guess import least_course
from ocp.direct.guess import Samples
from ocp.errors import ProblemError
from ocp.problem.problem import Problem

__all__ = ["roll_plan", "spline_targets"]

Targets = Callable[[Any], Any]
REACH = 1 - 1e-9
GUESS_TIMES = 65
DEAR = 1e3  # of a violation in the guess: per m, rad or unit of a sine
GUESS_MARGIN = 2.0  # widths of the smooth minimum that the guess keeps beyond the clearance asked for


def spline_targets(times: Any, targets: Any) -> Targets:
    """Cubic spline through a table of targets, as a function of time for a problem with MX symbols.

    Args:
        times: Increasing, shape (samples,), s; at least 4.
        targets: Shape (samples, 5), m and rad.

    Raises:
        ProblemError: Fewer than 4 samples, times that do not increase, or targets of another shape or not finite.
    """
    t = np.asarray(times, dtype=float)
    try:
        rows = checked_targets(targets)
    except ModelError as error:
        raise ProblemError(str(error)) from error
    if t.shape != (len(rows),) or len(t) < 4 or not (np.diff(t) > 0).all():
        raise ProblemError(
            f"times of shape {t.shape} must increase, one for each of the {len(rows)} targets, 4 at least"
        )
    curve = ca.interpolant("targets", "bspline", [t], rows.ravel())
    return lambda time: curve(time)


def roll_plan(
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
    surroundings: Surroundings | None = None,
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
        surroundings: What to keep away from; None for nothing.
        clearance: Least distance from it, m; -inf for no constraint.
        clearance_weight, clearance_width: Of the term weight exp(-distance / width) of the index; width in m.
        softness: Width of the smooth minimum of all distances, m, see clearance.soft_minimum.
        radii: Of the rig's capsules.
        symbols: casadi.MX, or casadi.SX where the targets are plain expressions.

    Returns:
        The problem; its guess is the course of least cost on a grid of rolls and times, see cts_guess.

    Raises:
        ProblemError: Weights or limits that are negative, a horizon that is not positive, a target on the way that
            no roll reaches, a start outside the limits.
    """
    for name, value in (
        ("rate_weight", rate_weight),
        ("acceleration_weight", acceleration_weight),
        ("rate_limit", rate_limit),
        ("acceleration_limit", acceleration_limit),
        ("clearance_weight", clearance_weight),
    ):
        if not value >= 0:
            raise ProblemError(f"roll_plan: {name} {value} must not be negative")
    if not clearance_width > 0:
        raise ProblemError(f"roll_plan: clearance_width {clearance_width} m must be positive")
    if np.isnan(clearance) or clearance == np.inf:
        raise ProblemError(f"roll_plan: clearance {clearance} m must be a finite distance or -inf for none")
    if not (np.isfinite(horizon) and horizon > 0):
        raise ProblemError(f"roll_plan: horizon {horizon} s must be positive and finite")
    if start_roll is not None and not np.isfinite(start_roll):
        raise ProblemError(f"roll_plan: start_roll {start_roll} rad must be finite")
    x, phi = ca.SX.sym("target", 5), ca.SX.sym("roll")
    c, s = ca.cos(phi), ca.sin(phi)
    posture = posture_at(rig, x, c, s, branch)
    joints = joints_of(rig, x, phi, posture)
    held = [k for k in range(5) if np.isfinite([rig.lower[k], rig.upper[k]]).any()]
    limited = ca.vertcat(*[joints[k] for k in held])
    reached = ca.vertcat(posture.sin4, posture.cos2)
    index = index_harmonics(rig, tunnel, x).value(c, s)
    near: Any = 0.0
    short = _beyond(reached, -REACH, REACH) + _beyond(limited, rig.lower[held], rig.upper[held])
    if surroundings is not None:
        gap = soft_minimum(list(clearances(rig, joints, surroundings, radii).values()), softness)
        near = nearness(gap, clearance_weight, clearance_width)
        if np.isfinite(clearance):
            short += ca.fmax(clearance + GUESS_MARGIN * softness - gap, 0)
    curve = _curve(targets, symbols)
    price = index + ca.fmin(near, DEAR) + DEAR * short
    start, speed = _guess(
        rig,
        tunnel,
        branch,
        curve,
        ca.Function("price", [x, phi], [ca.cse(price)]),
        np.linspace(0, horizon, GUESS_TIMES),
        start=start_roll,
        rate_weight=rate_weight,
        acceleration_weight=acceleration_weight,
        rate_limit=rate_limit,
    )

    problem = Problem("roll plan", symbols=symbols)
    roll = problem.state("roll", 1, initial=start_roll, lower=rig.lower[5], upper=rig.upper[5], guess=start)
    rate = problem.state("rate", 1, initial=start_rate, lower=-rate_limit, upper=rate_limit, guess=speed)
    pull = problem.control("acceleration", 1, lower=-acceleration_limit, upper=acceleration_limit, guess=0.0)
    problem.horizon(horizon)
    problem.dynamics(roll, rate)
    problem.dynamics(rate, pull)
    target = _column(targets(problem.time))

    def along(name: str, value: Any) -> Any:
        """The value on the way."""
        return ca.Function(name, [x, phi], [value])(target, roll)

    problem.path("reach", along("reach", reached), -REACH, REACH)
    if held:
        problem.path("limits", along("joints", limited), rig.lower[held], rig.upper[held])
    if surroundings is not None and np.isfinite(clearance):
        problem.path("clearance", along("gap", gap), clearance)
    running = along("index", index + near)
    problem.minimize(running=running + rate_weight * rate**2 + acceleration_weight * pull**2)
    return problem


def _column(target: Any) -> Any:
    return ca.vertcat(*target) if isinstance(target, list | tuple) else target


def _curve(targets: Targets, symbols: Any) -> Any:
    """Function of time -> target."""
    time = symbols.sym("time")
    return ca.Function("target", [time], [_column(targets(time))])


def _beyond(value: Any, lower: Any, upper: Any) -> Any:
    """By how much the entries are outside their bounds, in total."""
    return ca.sum1(ca.fmax(lower - value, 0) + ca.fmax(value - upper, 0)) if value.numel() else 0.0


def _guess(
    rig: Rig,
    tunnel: Tunnel,
    branch: Branch,
    curve: Any,
    cost: Any,
    t: Array,
    **options: Any,
) -> tuple[Samples, Samples]:
    """Roll and rate over time by dynamic programming on a grid; see cts_guess."""
    rows = np.array(curve.map(len(t))(t[None]))
    status = np.array(optimal_inverse(rig, tunnel, branch).map(len(t))(rows, np.zeros((1, len(t))))[3])[0]
    if status.any():
        at = t[int(np.flatnonzero(status)[0])]
        raise ProblemError(f"roll_plan: no roll reaches the target at {at:.4g} s; see cts_table.solve_table")

    def costs(times: Any, rolls: Any) -> Array:
        return np.asarray(np.array(cost.map(len(rolls))(rows[:, times], rolls[None]))[0])

    roll = least_course(costs, t, lower=float(rig.lower[5]), upper=float(rig.upper[5]), **options)
    return Samples(t, roll[:, None]), Samples(t, np.gradient(roll, t)[:, None])
