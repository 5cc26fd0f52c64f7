"""Parameters may stand everywhere, are checked at every solve, and the cost's slope in them is known."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import casadi as ca
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ocp import Collocation, MultipleShooting, Problem, ProblemError, prepare, solve
from tests.ocp.problems import EVERY_METHOD, METHODS, SOLVERS, energy

VALUES: dict[str, Any] = {
    "start": [0.2, -0.1],
    "goal": 1.3,
    "limit": 9.0,
    "wall": 1.7,
    "duration": 1.2,
    "mass": 0.8,
    "weight": 1.5,
    "floor": -0.5,
}


def everywhere(symbols: Any = ca.SX, values: dict[str, Any] | None = None) -> Problem:
    """A double integrator with a parameter in every place; with ``values`` the numbers themselves."""
    problem = Problem("everywhere", symbols)
    sizes = {name: int(np.size(value)) for name, value in VALUES.items()}
    p = {name: problem.parameter(name, n) if values is None else values[name] for name, n in sizes.items()}
    q = problem.state("q", initial=p["start"][0], terminal=p["goal"], upper=p["goal"] + 1)
    v = problem.state("v", initial=p["start"][1], lower=2 * p["floor"])
    u = problem.control("u", lower=-p["limit"], upper=p["limit"])
    horizon = problem.horizon(p["duration"])
    problem.dynamics(q, v)
    problem.dynamics(v, u / p["mass"] + 0.1 * problem.time)
    problem.path("wall", q + 0.2 * v, upper=p["wall"])
    problem.start("first", u, upper=p["limit"] - 1)
    problem.end("rest", v - p["floor"], 0.3, 0.3 + 0 * p["limit"])
    problem.minimize(running=p["weight"] * u**2 / 2 + v**2, terminal=p["mass"] * v**2 + horizon)
    return problem


@pytest.mark.parametrize("solver", SOLVERS)
@pytest.mark.parametrize("method", ["radau", "legendre", "rk4-linear"])
@pytest.mark.parametrize("symbols", [ca.SX, ca.MX], ids=["SX", "MX"])
def test_a_parameter_is_as_good_as_its_number(method: str, solver: str, symbols: Any) -> None:
    by = METHODS[method]
    problems = [everywhere(symbols), everywhere(symbols, VALUES)]
    late = solve(problems[0], by, parameters=VALUES, solver=solver)
    numbers = solve(problems[1], by, solver=solver)
    assert late.cost == pytest.approx(numbers.cost, abs=1e-10)
    assert late.horizon == numbers.horizon == 1.2
    for name in ("q", "v", "u"):
        np.testing.assert_allclose(late[name], numbers[name], atol=1e-8)
    assert late["q"][0, 0] == 0.2
    assert late["q"][-1, 0] == pytest.approx(1.3, abs=1e-12)
    assert late["v"][-1, 0] == pytest.approx(-0.2, abs=1e-9)


@pytest.mark.parametrize("method", ["radau", "rk4-held"])
def test_prepared_problems_are_solved_many_times_without_a_memory(method: str) -> None:
    prepared = prepare(everywhere(), METHODS[method])
    first = prepared.solve(VALUES)
    for goal in (0.9, 1.1, 1.5):
        values = {**VALUES, "goal": goal}
        again = prepared.solve(values)
        assert again.cost == solve(everywhere(), METHODS[method], parameters=values).cost
        assert again["q"][-1, 0] == pytest.approx(goal, abs=1e-12)
    last = prepared.solve(VALUES)
    assert last.cost == first.cost
    np.testing.assert_array_equal(last.variables, first.variables)
    with pytest.raises(ProblemError):
        prepared.solve({**VALUES, "duration": -1.0})
    assert prepared.solve(VALUES).cost == first.cost


@given(distance=st.floats(-100.0, 100.0), time=st.floats(0.1, 30.0), mass=st.floats(0.05, 50.0))
@settings(max_examples=25)
def test_the_double_integrator_scales_as_it_must(distance: float, time: float, mass: float) -> None:
    """Least energy over a distance d in a time T with mass m costs 6 m^2 d^2 / T^3."""
    solution = PREPARED.solve({"distance": distance, "duration": time, "mass": mass})
    expected = 6 * mass**2 * distance**2 / time**3
    assert solution.cost == pytest.approx(expected, rel=1e-7, abs=1e-9)
    assert solution.costate("q")[0, 0] == pytest.approx(
        -2 * expected / distance if distance else 0.0, rel=1e-6, abs=1e-6
    )


def scaled() -> Problem:
    problem = Problem("scaled")
    distance, time, mass = (problem.parameter(name) for name in ("distance", "duration", "mass"))
    q = problem.state("q", initial=0.0, terminal=distance)
    v = problem.state("v", initial=0.0, terminal=0.0)
    force = problem.control("force")
    problem.horizon(time)
    problem.dynamics(q, v)
    problem.dynamics(v, force / mass)
    problem.minimize(running=force**2 / 2)
    return problem


PREPARED = prepare(scaled(), Collocation(3))

Declare = Callable[[Problem, Any], Any]


@pytest.mark.parametrize(
    ("declare", "value", "message"),
    [
        (lambda m, p: m.state("x", initial=p, upper=1), 2.0, "state 'x': initial value 2 is outside the bounds"),
        (lambda m, p: m.state("x", terminal=p, lower=1), 0.0, "state 'x': terminal value 0 is outside"),
        (lambda m, p: m.state("x", initial=0, lower=p), 1.0, "state 'x': initial value 0 is outside"),
        (lambda m, p: m.state("x", lower=p, upper=1), 2.0, "state 'x': lower bound 2 is above upper bound 1"),
        (lambda m, p: m.control("c", lower=p, upper=1), 2.0, "control 'c': lower bound 2 is above upper bound 1"),
        (lambda m, p: m.control("c", lower=1 / p), 0.0, "control 'c': bounds .* exclude everything"),
        (lambda m, p: m.control("c", upper=ca.log(p)), -1.0, "a bound is not a number"),
        (lambda m, p: m.state("x", initial=ca.log(p)), -1.0, "not a number"),
        (lambda m, p: m.state("x", initial=1 / p), 0.0, "state 'x': initial is not finite"),
        (lambda m, p: m.horizon(p), -1.0, "horizon must be positive and finite, not -1 s"),
        (lambda m, p: m.horizon(p), 0.0, "horizon must be positive and finite, not 0 s"),
        (lambda m, p: m.horizon(1 / p), 0.0, "horizon must be positive and finite, not inf s"),
        (lambda m, p: m.horizon(ca.log(p)), -1.0, "(horizon|bound).* not"),
        (lambda m, p: m.horizon(lower=p, upper=1), 2.0, "horizon: lower bound 2 is above upper bound 1"),
        (lambda m, p: m.horizon(lower=p, upper=1), 0.0, "horizon must be positive"),
        (lambda m, p: m.path("c", m.control("w"), p, 1), 2.0, "constraint 'c': lower bound 2 is above upper bound 1"),
        (lambda m, p: m.start("c", m.control("w"), 2, p), 1.0, "constraint 'c': lower bound 2 is above upper bound 1"),
        (lambda m, p: m.end("c", m.time, 1 / p), 0.0, "constraint 'c': bounds .* exclude everything"),
        (lambda m, p: m.path("c", m.control("w"), ca.log(p), 1), -1.0, "not a number"),
    ],
)
def test_bounds_that_contradict_at_given_parameters_are_named(declare: Declare, value: float, message: str) -> None:
    problem = Problem("by parameter")
    declare(problem, problem.parameter("p"))
    if "x" not in problem.declared.states:
        problem.state("x", initial=0.0)
    if not problem.declared.controls:
        problem.control("w")
    problem.dynamics("x", next(iter(problem.declared.controls.values())).symbol)
    if problem.declared.horizon is None:
        problem.horizon(1.0)
    prepared = prepare(problem, Collocation(2))  # nothing is known yet
    with pytest.raises(ProblemError, match=message):
        prepared.solve({"p": value})


@pytest.mark.parametrize("method", [Collocation(4), Collocation(4, scheme="legendre"), MultipleShooting(6)], ids=str)
def test_the_slope_of_the_cost_in_every_parameter_is_that_of_finite_differences(method: Any) -> None:
    tight = {**VALUES, "wall": 1.35, "limit": 6.0}
    prepared = prepare(everywhere(), method, options={"tol": 1e-12})
    solution = prepared.solve(tight)
    step = 1e-5
    for name, value in tight.items():
        for i in range(np.size(value)):
            shift = step * np.eye(np.size(value))[i]
            ahead, behind = (prepared.solve({**tight, name: np.asarray(value) + s * shift}) for s in (1, -1))
            slope = (ahead.cost - behind.cost) / (2 * step)
            assert solution.cost_gradient(name)[i] == pytest.approx(slope, rel=1e-4, abs=1e-4), name


@pytest.mark.parametrize("method", EVERY_METHOD)
def test_a_parameter_that_nothing_uses_changes_nothing(method: str) -> None:
    problem = energy()
    problem.parameter("idle", 3)
    solution = solve(problem, EVERY_METHOD[method], parameters={"idle": [1.0, 2.0, 3.0]})
    assert solution.cost == pytest.approx(solve(energy(), EVERY_METHOD[method]).cost, abs=1e-9)
    np.testing.assert_allclose(solution.cost_gradient("idle"), 0.0, atol=1e-12)
    assert solution.audit(problem).findings
