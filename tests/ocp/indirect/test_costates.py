"""Costates are derivatives of the optimal cost: sign, start, nodes, end."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import casadi as ca
import numpy as np
import pytest

from ocp import prepare, solve
from tests.ocp.problems import (
    COLLOCATIONS,
    CVODES,
    EVERY_METHOD,
    METHODS,
    SOLVERS,
    Array,
    Method,
    energy,
    plant,
    started_anywhere,
)

START = np.array([0.8, -0.3])
STEP = 1e-4


def slope_of_cost(prepared: Any, start: Array, guess: Any = None) -> Array:
    """Central differences of the optimal cost over the initial state. Shape (2,)."""
    slopes = []
    for i in range(len(start)):
        shift = STEP * np.eye(len(start))[i]
        ahead, behind = (prepared.solve({"x0": start + sign * shift}, guess) for sign in (1, -1))
        slopes.append((ahead.cost - behind.cost) / (2 * STEP))
    return np.array(slopes)


@pytest.mark.parametrize("solver", SOLVERS)
@pytest.mark.parametrize("method", EVERY_METHOD)
def test_sign_and_size_on_the_double_integrator(method: str, solver: str) -> None:
    """lambda = d(optimal cost)/dx, so that H = L + lambda . f: -12 and -6, times what held controls cost more."""
    by = EVERY_METHOD[method]
    solution = solve(energy(), by, solver=solver)
    more = solution.cost / 6  # the cost is quadratic in the distance, with held controls too
    assert solution.costate("q")[0, 0] == pytest.approx(-12 * more, rel=1e-7)
    assert solution.costate("v")[0, 0] == pytest.approx(-6 * more, rel=1e-7)
    assert solution.costate("v")[-1, 0] == pytest.approx(6 * more, rel=1e-7)


@pytest.mark.parametrize("upper", [np.inf, 0.5], ids=["free", "bounded"])
@pytest.mark.parametrize("solver", SOLVERS)
@pytest.mark.parametrize("method", METHODS)
def test_costate_at_the_start_is_the_slope_of_the_optimal_cost(method: str, solver: str, upper: float) -> None:
    prepared = prepare(started_anywhere(upper=upper), METHODS[method], solver=solver)
    solution = prepared.solve({"x0": START})
    np.testing.assert_allclose(solution.costate("x")[0], slope_of_cost(prepared, START), rtol=2e-6, atol=2e-6)


@pytest.mark.parametrize("method", CVODES)
def test_costate_at_the_start_is_the_slope_of_the_optimal_cost_with_cvodes(method: str) -> None:
    prepared = prepare(started_anywhere(horizon=1.0), CVODES[method])
    solution = prepared.solve({"x0": START})
    slopes = slope_of_cost(prepared, START, solution)
    np.testing.assert_allclose(solution.costate("x")[0], slopes, rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("solver", SOLVERS)
@pytest.mark.parametrize("method", METHODS)
def test_costate_at_a_node_is_the_slope_of_the_cost_that_is_left(method: str, solver: str) -> None:
    """Bellman: from a node on, the rest of the plan is the optimum of the rest of the mesh."""
    by = METHODS[method]
    n, horizon = by.intervals, 2.0
    solution = solve(started_anywhere(horizon), by, parameters={"x0": START}, solver=solver)
    at = int(np.flatnonzero(np.isclose(solution.t, horizon / n * (n // 2)))[0])
    problem = started_anywhere(horizon * (n - n // 2) / n)
    if by.control == "linear":  # the control at the node belongs to the interval before it too, so it stays
        kept = solution["u"][at, 0]
        problem.start("kept", problem.declared.controls["u"].symbol, kept, kept)
    rest = prepare(problem, replace(by, intervals=n - n // 2), solver=solver)
    slopes = slope_of_cost(rest, solution["x"][at])
    np.testing.assert_allclose(solution.costate("x")[at], slopes, rtol=2e-6, atol=2e-6)


@pytest.mark.parametrize("solver", SOLVERS)
@pytest.mark.parametrize("method", EVERY_METHOD)
def test_costate_at_a_free_end_is_the_slope_of_the_terminal_cost(method: str, solver: str) -> None:
    solution = solve(started_anywhere(horizon=1.0), EVERY_METHOD[method], parameters={"x0": START}, solver=solver)
    x = solution["x"][-1]
    np.testing.assert_allclose(solution.costate("x")[-1], [4 * x[0], np.cos(x[1])], rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize("solver", SOLVERS)
@pytest.mark.parametrize("method", METHODS)
def test_costate_at_a_constrained_end_stands_on_the_constraint(method: str, solver: str) -> None:
    """With psi(x(T)) = 0 the costate is the slope of the terminal cost plus a multiple of the slope of psi."""
    problem = started_anywhere(horizon=1.0)
    x = problem.declared.states["x"].symbol
    problem.end("circle", ca.sumsqr(x), 0.25, 0.25)
    solution = solve(problem, METHODS[method], parameters={"x0": START}, solver=solver)
    end = solution["x"][-1]
    rest = solution.costate("x")[-1] - [4 * end[0], np.cos(end[1])]
    assert np.linalg.norm(end) == pytest.approx(0.5, abs=1e-8)
    assert np.linalg.norm(rest) > 0.1
    assert rest @ [-end[1], end[0]] == pytest.approx(0.0, abs=1e-6)


@pytest.mark.parametrize("solver", SOLVERS)
@pytest.mark.parametrize("method", METHODS)
def test_hamiltonian_is_constant_and_vanishes_on_a_free_horizon(method: str, solver: str) -> None:
    """Bolza: x' = u, x from 0 to 1 in a free time, min T + int u^2/2: cost sqrt 2, costate -sqrt 2, H = -1."""
    problem, x, u = plant("Bolza", initial=0.0, terminal=1.0, u={"guess": 1.0}, horizon=None)
    horizon = problem.horizon(lower=0.1, upper=5.0, guess=1.0)
    problem.dynamics(x, u)
    problem.minimize(running=u**2 / 2, terminal=horizon)
    solution = solve(problem, METHODS[method], solver=solver)
    assert solution.cost == pytest.approx(np.sqrt(2), abs=1e-8)
    assert solution.horizon == pytest.approx(1 / np.sqrt(2), abs=1e-6)
    np.testing.assert_allclose(solution.costate("x"), -np.sqrt(2), atol=1e-6)
    hamiltonian = solution["u"] ** 2 / 2 + solution.costate("x") * solution["u"]
    np.testing.assert_allclose(hamiltonian, -1.0, atol=1e-6)


@pytest.mark.parametrize("method", COLLOCATIONS)
def test_costates_with_active_path_constraints_make_the_hamiltonian_stationary_off_them(method: str) -> None:
    """u = -lambda_v wherever no constraint binds: min int u^2/2 with |u| <= 5."""
    by: Method = replace(METHODS[method], intervals=40)
    solution = solve(energy(lower=-5.0, upper=5.0), by)
    widths = solution.control_interpolant
    s = (widths.breaks[:-1, None] + np.diff(widths.breaks)[:, None] * widths.nodes).ravel()
    u = widths.values.reshape(-1)
    costate = np.interp(s, solution.t / solution.horizon, solution.costate("v")[:, 0])
    free = np.abs(u) < 4.5
    assert np.count_nonzero(~free) > 0
    np.testing.assert_allclose(u[free], -costate[free], atol=5e-3)
