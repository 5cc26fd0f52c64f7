"""Where the solver stops at a plan that is no minimum, it starts again beside it."""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np
import pytest

from ocp import Collocation, MultipleShooting, Problem, SolveError, solve

METHODS: dict[str, Any] = {
    "points": Collocation(20),
    "held": Collocation(20, control="held"),
    "shooting": MultipleShooting(30),
}
EVERY = pytest.mark.parametrize("method", METHODS.values(), ids=METHODS)


def oscillator(horizon: float, limit: float = np.inf) -> Problem:
    """min int u^2 - x^2 from 0 to 0: zero is the minimum until T = pi."""
    problem = Problem("oscillator")
    x = problem.state("x", initial=0.0, terminal=0.0)
    u = problem.control("u", lower=-limit, upper=limit)
    problem.dynamics(x, u)
    problem.horizon(horizon)
    problem.minimize(running=u**2 - x**2)
    return problem


@EVERY
def test_a_minimum_is_left_where_it_is(method: Any) -> None:
    solution = solve(oscillator(3.0), method)
    assert (solution.start, solution.cost) == ("guess", 0.0)


@EVERY
def test_a_cost_without_a_least_is_no_success(method: Any) -> None:
    with pytest.raises(SolveError, match="stationary but no minimum") as caught:
        solve(oscillator(4.0), method)
    assert caught.value.solution is not None
    assert not caught.value.solution.success


def bounded_least(horizon: float) -> float:
    """min int u^2 - x^2, |u| <= 1, zero ends: u = 1 for s, then x = A cos(t - T/2), u from 1 to -1, then -1.

    Continuity of u at s: A sin(T/2 - s) = 1, of x: A cos(T/2 - s) = s.
    """
    candidates = np.linspace(1e-6, horizon / 2 - 1e-6, 400_001)
    value = candidates * np.sin(horizon / 2 - candidates) - np.cos(horizon / 2 - candidates)
    costs = [0.0]
    for k in np.flatnonzero(value[:-1] * value[1:] < 0):
        s = float(candidates[k] - value[k] * (candidates[k + 1] - candidates[k]) / (value[k + 1] - value[k]))
        rest = horizon / 2 - s
        size = 1 / np.sin(rest)
        # two ramps, and A^2 int (sin^2 - cos^2) over the middle
        costs.append(2 * (s - s**3 / 3) - size**2 * np.sin(2 * rest))
    return min(costs)


@EVERY
@pytest.mark.parametrize("horizon", [4.0, 6.0])
def test_with_bounds_on_the_control_the_minimum_is_found(method: Any, horizon: float) -> None:
    solution = solve(oscillator(horizon, 1.0), method)
    assert solution.start == "downhill"
    assert solution.cost == pytest.approx(bounded_least(horizon), rel=1e-2)


@EVERY
def test_a_body_at_rest_on_a_hilltop_rolls_down(method: Any) -> None:
    """x'' = x + u, |u| <= 1, from rest at 0, max x(T)^2: cosh T - 1 with full push one way."""
    problem = Problem("hilltop")
    x, v = problem.state("x", initial=0.0), problem.state("v", initial=0.0)
    u = problem.control("u", lower=-1.0, upper=1.0)
    problem.dynamics(x, v)
    problem.dynamics(v, x + u)
    problem.horizon(2.0)
    problem.minimize(terminal=-(x**2))
    solution = solve(problem, method)
    assert solution.start == "downhill"
    assert solution.cost == pytest.approx(-((np.cosh(2.0) - 1) ** 2), rel=1e-4)


@EVERY
def test_a_pan_tilt_head_turns_by_the_smaller_angle(method: Any) -> None:
    """Least int (cos(tilt) pan')^2 + tilt'^2 between directions on the equator, 4 rad apart the long way: a half turn
    of the sphere is passed, so a great circle the short way over a pole is cheaper."""
    problem = Problem("pan-tilt")
    pan = problem.state("pan", initial=0.0, terminal=4.0)
    tilt = problem.state("tilt", initial=0.0, terminal=0.0, lower=-1.4, upper=1.4)
    a, b = problem.control("a"), problem.control("b")
    problem.dynamics(pan, a)
    problem.dynamics(tilt, b)
    problem.horizon(1.0)
    problem.minimize(running=(ca.cos(tilt) * a) ** 2 + b**2)
    solution = solve(problem, method)
    assert solution.start == "downhill"
    assert solution.cost < 16.0 - 1.0  # along the equator
    assert solution.audit().passed or np.abs(solution["tilt"]).max() > 1.0


def test_without_check_nothing_is_tried_again() -> None:
    solution = solve(oscillator(4.0), Collocation(10), check=False)
    assert solution.success
    assert solution.regularised
    assert solution.start == "guess"
