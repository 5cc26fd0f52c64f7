"""Problems of many kinds by every method: interpolants, no controls, no cost, several states, one interval, scales."""

from __future__ import annotations

from typing import Any, cast

import casadi as ca
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ocp import Collocation, MultipleShooting, Problem, ProblemError, Solution, prepare, solve
from tests.ocp.problems import EVERY_METHOD, METHODS, SOLVERS, SWING, energy, plant, relative, swing, van_der_pol

every_method = pytest.mark.parametrize("method", EVERY_METHOD)
both_solvers = pytest.mark.parametrize("solver", SOLVERS)
both_symbols = pytest.mark.parametrize("symbols", [ca.SX, ca.MX], ids=["SX", "MX"])


def table() -> Any:
    """A B-spline through a parabola, which it holds exactly: y = 1 + x^2 / 2."""
    x = np.linspace(-3.0, 3.0, 13)
    return ca.interpolant("hill", "bspline", [x], 1 + x**2 / 2)


def driven(symbols: Any, hill: Any) -> Problem:
    problem, x, u = plant("over a hill", symbols=symbols, initial=0.0, terminal=1.5, u={"guess": 1.0})
    problem.dynamics(x, u / hill(x))
    problem.minimize(running=u**2 / 2)
    return problem


@both_solvers
@pytest.mark.parametrize("method", METHODS)
def test_an_interpolant_inside_the_dynamics_is_as_good_as_its_formula(method: str, solver: str) -> None:
    """The way has the length int (1 + x^2/2) dx = l, and the best speed along it is constant: cost l^2 / 2."""
    interpolated = solve(driven(ca.MX, table()), METHODS[method], solver=solver)
    formula = solve(driven(ca.SX, lambda x: 1 + x**2 / 2), METHODS[method], solver=solver)
    length = 1.5 + 1.5**3 / 6
    assert interpolated.cost == pytest.approx(formula.cost, abs=1e-8)
    assert interpolated.cost == pytest.approx(length**2 / 2, rel=2e-3)
    assert relative(interpolated["x"], formula["x"]) < 1e-7
    assert relative(interpolated.costate("x"), formula.costate("x")) < 1e-6
    assert "integration error, relative" not in {finding.name for finding in interpolated.audit().failures}


def test_an_interpolant_in_a_problem_of_sx_symbols_is_refused() -> None:
    problem = Problem("wrong")
    x = problem.state("x")
    with pytest.raises(ProblemError, match="made of MX symbols, the problem of SX symbols"):
        problem.dynamics(x, table()(ca.MX(1.0)))


@both_solvers
@pytest.mark.parametrize("method", METHODS)
def test_mx_and_sx_make_the_same_plan(method: str, solver: str) -> None:
    plan = solve(swing(ca.MX), METHODS[method], parameters=SWING, solver=solver)
    reference = solve(swing(), METHODS[method], parameters=SWING, solver=solver)
    assert plan.cost == pytest.approx(reference.cost, rel=1e-7)


@both_symbols
@both_solvers
@every_method
def test_a_problem_without_control_is_an_integration(method: str, solver: str, symbols: Any) -> None:
    problem = Problem("decay", symbols)
    rate = problem.parameter("rate")
    x = problem.state("x", initial=2.0)
    problem.dynamics(x, -rate * x)
    problem.horizon(1.0)
    problem.minimize(running=x, terminal=x**2)
    solution = solve(problem, EVERY_METHOD[method], parameters={"rate": 0.7}, solver=solver)
    np.testing.assert_allclose(solution["x"][:, 0], 2 * np.exp(-0.7 * solution.t), atol=2e-5)
    assert solution.cost == pytest.approx(2 * (1 - np.exp(-0.7)) / 0.7 + 4 * np.exp(-1.4), abs=2e-5)
    assert solution.controls == {}
    assert solution.control_interpolant(np.linspace(0, 1, 3)).shape == (3, 0)


@both_symbols
@both_solvers
@every_method
def test_a_single_state_with_constant_dynamics_is_a_problem_too(method: str, solver: str, symbols: Any) -> None:
    problem = Problem("ramp", symbols)
    x = problem.state("x", initial=1.0)
    problem.dynamics(x, 2.0)
    problem.horizon(3.0)
    solution = solve(problem, EVERY_METHOD[method], solver=solver)
    np.testing.assert_allclose(solution["x"][:, 0], 1 + 2 * solution.t, atol=1e-9)
    assert solution.cost == 0.0
    assert solution.audit().passed


@both_symbols
@both_solvers
@every_method
def test_a_problem_without_cost_finds_a_feasible_plan(method: str, solver: str, symbols: Any) -> None:
    problem = Problem("anywhere", symbols)
    x = problem.state("x", 2, initial=[0.0, 0.0], terminal=[1.0, 0.0], guess=0.3)
    u = problem.control("u", lower=-8.0, upper=8.0)
    problem.dynamics(x, ca.vertcat(x[1], u))
    problem.horizon(1.0)
    problem.path("slow", x[1], upper=1.9)
    solution = solve(problem, EVERY_METHOD[method], solver=solver)
    assert solution.cost == 0.0
    assert solution["x"][-1, 0] == pytest.approx(1.0, abs=1e-9)


@both_solvers
@pytest.mark.parametrize("method", METHODS)
def test_states_and_controls_of_several_sizes_keep_their_places(method: str, solver: str) -> None:
    """Six independent integrators with different targets: x_i goes straight to its own."""
    problem = Problem("many")
    targets = {"a": [1.0], "b": [2.0, -3.0], "c": [4.0, 5.0, -6.0]}
    states = {name: problem.state(name, initial=np.zeros(len(goal)), terminal=goal) for name, goal in targets.items()}
    left = problem.control("left", 4)
    right = problem.control("right", 2)
    speeds = ca.vertcat(right[1], left[2], left[0], right[0], left[3], left[1])
    offset = 0
    for state in states.values():
        problem.dynamics(state, speeds[offset : offset + state.numel()])
        offset += state.numel()
    problem.horizon(2.0)
    problem.minimize(running=ca.sumsqr(left) + ca.sumsqr(right))
    solution = solve(problem, METHODS[method], solver=solver)
    for name, goal in targets.items():
        np.testing.assert_allclose(solution[name], np.outer(solution.t / 2, goal), atol=1e-8)
        np.testing.assert_allclose(solution.costate(name), np.tile(-np.array(goal), (len(solution.t), 1)), atol=1e-6)
    ones = np.ones((len(solution.t), 1))
    np.testing.assert_allclose(solution["left"], 0.5 * ones * [-3.0, -6.0, 2.0, 5.0], atol=1e-7)
    np.testing.assert_allclose(solution["right"], 0.5 * ones * [4.0, 1.0], atol=1e-7)
    assert solution.cost == pytest.approx(91 / 2, rel=1e-9)


@both_solvers
@pytest.mark.parametrize(
    "method",
    [
        *(Collocation(1, d, scheme) for d in range(2, 10) for scheme in ("radau", "legendre")),
        MultipleShooting(1, steps=20, control="linear"),
        MultipleShooting(1, integrator="cvodes", control="linear"),
    ],
    ids=str,
)
def test_one_interval_is_enough_for_a_method_that_holds_the_optimum(method: Any, solver: str) -> None:
    assert solve(energy(), method, solver=solver).cost == pytest.approx(6.0, abs=1e-8)


@pytest.mark.parametrize("scheme", ["radau", "legendre"])
@pytest.mark.parametrize("control", ["points", "held"])
@pytest.mark.parametrize("degree", range(1, 10))
def test_every_degree_solves_a_nonlinear_problem(degree: int, scheme: str, control: str) -> None:
    solution = solve(van_der_pol(), Collocation(max(3, 30 // degree**2), degree, scheme, control))
    reference = 1.0478069082  # recomputed on fine grids by two methods; see the conformance problems
    assert solution.cost == pytest.approx(reference, rel=0.05)
    if control == "points" and degree >= 4:
        assert solution.cost == pytest.approx(reference, abs=2e-4)


@pytest.mark.parametrize("method", ["radau", "legendre", "rk4-linear"])
@given(unit=st.floats(-5.0, 5.0), force=st.floats(-5.0, 5.0), money=st.floats(-4.0, 4.0))
@settings(max_examples=25)
def test_units_of_states_controls_and_cost_do_not_matter(method: str, unit: float, force: float, money: float) -> None:
    """The double integrator in units of 1e-5 to 1e5: the cost scales, the plan does not change."""
    scale, strength, price = 10.0**unit, 10.0**force, 10.0**money
    solution = in_these_units(method, "ipopt", scale, strength, price)
    assert solution.cost == pytest.approx(6 * price, rel=1e-6)
    s = solution.t
    atol = 1e-3 if method == "rk4-linear" else 1e-6  # the reported cubics
    np.testing.assert_allclose(solution.at(s)["q"][:, 0] / scale, 3 * s**2 - 2 * s**3, atol=atol)
    np.testing.assert_allclose(solution.costate("q")[:, 0] * scale / price, -12.0, rtol=1e-5)


@pytest.mark.parametrize("method", ["radau", "legendre", "rk4-linear"])
@given(unit=st.floats(-2.0, 5.0), force=st.floats(-5.0, 1.0), money=st.floats(-1.0, 4.0))
@settings(max_examples=25)
def test_units_do_not_matter_to_fatrop_as_long_as_nothing_is_tiny(
    method: str, unit: float, force: float, money: float
) -> None:
    """Its tolerances are absolute and cannot be set; see the next test for what it does where they do not suffice."""
    scale, strength, price = 10.0**unit, 10.0**force, 10.0**money
    solution = in_these_units(method, "fatrop", scale, strength, price)
    assert solution.cost == pytest.approx(6 * price, rel=1e-6)
    np.testing.assert_allclose(solution.costate("q")[:, 0] * scale / price, -12.0, rtol=1e-5)


@pytest.mark.parametrize("method", ["radau", "legendre", "rk4-linear"])
def test_fatrop_does_not_call_a_plan_solved_that_misses_its_bounds(method: str) -> None:
    """A way of a tenth of a millimetre that starts and ends a hundredth of it aside is no solution."""
    prepared = prepare(in_units(), METHODS[method], solver="fatrop", options={"max_iter": 300})
    solution = prepared.solve({"scale": 1e-4, "strength": 1.0, "price": 1.0}, check=False)
    off = max(abs(solution["q"][0, 0]), abs(solution["q"][-1, 0] - 1e-4))
    assert solution.success == (off < 1e-8)


def in_these_units(method: str, solver: str, scale: float, strength: float, price: float) -> Solution:
    prepared = PREPARED.get((method, solver))
    if prepared is None:
        prepared = PREPARED[method, solver] = prepare(in_units(), METHODS[method], solver=solver)
    return cast(Solution, prepared.solve({"scale": scale, "strength": strength, "price": price}))


PREPARED: dict[tuple[str, str], Any] = {}


def in_units() -> Problem:
    problem = Problem("in units")
    scale, strength, price = (problem.parameter(name) for name in ("scale", "strength", "price"))
    q = problem.state("q", initial=0.0, terminal=scale)
    v = problem.state("v", initial=0.0, terminal=0.0)
    u = problem.control("u")
    problem.dynamics(q, v)
    problem.dynamics(v, u * scale / strength)
    problem.horizon(1.0)
    problem.minimize(running=price * (u / strength) ** 2 / 2)
    return problem


@both_solvers
@pytest.mark.parametrize("method", METHODS)
def test_the_place_of_time_and_horizon_is_right(method: str, solver: str) -> None:
    """x' = t + T, x(0) = 0 over a free time T that must bring x to 6: x(T) = 3 T^2 / 2, T = 2."""
    problem = Problem("clock")
    x = problem.state("x", initial=0.0, terminal=6.0)
    horizon = problem.horizon(lower=0.5, upper=5.0, guess=1.0)
    problem.dynamics(x, problem.time + horizon)
    problem.end("late", problem.time - horizon, 0.0, 0.0)  # at the end the time is the horizon
    problem.start("early", problem.time, upper=0.0)  # and zero at the start
    problem.minimize(running=problem.time**2, terminal=0 * x)
    solution = solve(problem, METHODS[method], solver=solver)
    assert solution.horizon == pytest.approx(2.0, abs=1e-8)
    assert solution.cost == pytest.approx(8 / 3, abs=1e-8)
    np.testing.assert_allclose(solution["x"][:, 0], solution.t**2 / 2 + 2 * solution.t, atol=1e-8)


@pytest.mark.parametrize("method", ["radau", "rk4-linear"])
def test_a_compiled_problem_makes_the_same_plan(method: str) -> None:
    plain = solve(van_der_pol(), METHODS[method])
    compiled = prepare(van_der_pol(), METHODS[method], compiled=True).solve()
    np.testing.assert_allclose(compiled["x"], plain["x"], atol=1e-9)
    assert compiled.cost == pytest.approx(plain.cost, abs=1e-11)
