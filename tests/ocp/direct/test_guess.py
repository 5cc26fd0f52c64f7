"""Where the solver starts: every kind of guess, from every other grid and method, and every bad one by name."""

from __future__ import annotations

from functools import cache
from typing import Any

import casadi as ca
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ocp import Collocation, MultipleShooting, Problem, ProblemError, Solution, prepare, solve
from ocp.direct.guess import initial_point
from ocp.problem.formulation import Formulation
from tests.ocp.problems import EVERY_METHOD, METHODS, SOLVERS, Array, Method, energy, van_der_pol

pytestmark = pytest.mark.xdist_group("guesses")  # one process, so that every plan is solved once


def free_time(guess: float | None = None) -> Problem:
    """x (2) and u (1) over a free time."""
    problem = Problem("free time")
    x = problem.state("x", 2, initial=[0.0, 0.0], terminal=[1.0, 0.0])
    u = problem.control("u", lower=-1.0, upper=3.0)
    horizon = problem.horizon(lower=0.5, upper=8.0, guess=guess)
    problem.dynamics(x, ca.vertcat(x[1], u))
    problem.minimize(running=1 + u**2, terminal=0 * horizon)
    return problem


def start(problem: Problem, method: Method, guess: Any, *, staged: bool = False) -> tuple[Any, Array]:
    """The fragment and the values that the solver starts from."""
    form = Formulation(problem)
    transcription = method.transcribe(form, staged=staged)
    return transcription, initial_point(form, transcription, guess, form.bound_values(np.zeros(form.np)))


def entries(transcription: Any, point: Array, role: str, entry: int) -> tuple[Array, Array]:
    """Fractions and values of one entry of the states or controls."""
    mine = (transcription.variable_role == role) & (transcription.variable_entry == entry)
    return transcription.variable_fraction[mine], point[mine]


# ---- what a guess means -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("staged", [False, True], ids=["plain", "staged"])
@pytest.mark.parametrize("method", METHODS)
@given(horizon=st.floats(0.6, 7.0), level=st.floats(-5.0, 5.0), slope=st.floats(-5.0, 5.0))
@settings(max_examples=5)
def test_functions_of_time_are_read_at_every_variable(
    method: str, staged: bool, horizon: float, level: float, slope: float
) -> None:
    guess = {"x": lambda t: [level + slope * t, t**2], "u": lambda t: np.sin(t), "horizon": horizon}
    transcription, point = start(free_time(), METHODS[method], guess, staged=staged)
    for role, entry, curve in (
        ("state", 0, lambda t: level + slope * t),
        ("state", 1, lambda t: t**2),
        ("control", 0, np.sin),
    ):
        s, values = entries(transcription, point, role, entry)
        np.testing.assert_allclose(values, curve(s * horizon), atol=1e-12)
    assert np.all(point[transcription.variable_role == "horizon"] == horizon)
    assert set(transcription.variable_role) == {"state", "control", "horizon"}  # nothing is left to chance


@pytest.mark.parametrize("method", METHODS)
def test_samples_are_interpolated_over_their_times(method: str) -> None:
    t = np.array([0.0, 0.3, 1.1, 2.0])
    samples = np.column_stack([np.cos(t), t])
    guess = {"t": t, "x": samples, "u": np.array([[1.0], [2.0], [0.0], [1.0]]), "horizon": 2.0}
    transcription, point = start(free_time(), METHODS[method], guess)
    for role, entry, column in (("state", 0, samples[:, 0]), ("state", 1, t), ("control", 0, [1.0, 2.0, 0.0, 1.0])):
        s, values = entries(transcription, point, role, entry)
        np.testing.assert_allclose(values, np.interp(2.0 * s, t, column), atol=1e-12)


def test_samples_without_times_are_spread_over_the_horizon() -> None:
    transcription, point = start(free_time(), Collocation(3), {"x": np.array([[0.0, 1.0], [2.0, 3.0], [8.0, 5.0]])})
    s, values = entries(transcription, point, "state", 0)
    np.testing.assert_allclose(values, np.interp(s, [0.0, 0.5, 1.0], [0.0, 2.0, 8.0]), atol=1e-12)


@pytest.mark.parametrize("value", [[2.0, 3.0], np.array([2.0, 3.0]), np.array([[2.0], [3.0]]), ca.DM([2, 3])])
def test_values_of_every_kind_are_held(value: Any) -> None:
    transcription, point = start(free_time(), Collocation(3), {"x": value})
    for entry, expected in ((0, 2.0), (1, 3.0)):
        assert np.all(entries(transcription, point, "state", entry)[1] == expected)


def test_missing_guesses_are_lines_between_the_ends_or_the_middle_of_the_bounds() -> None:
    transcription, point = start(free_time(guess=3.0), Collocation(4), None)
    s, values = entries(transcription, point, "state", 0)
    np.testing.assert_allclose(values, s, atol=1e-14)
    assert np.all(entries(transcription, point, "control", 0)[1] == 1.0)
    assert point[transcription.horizon] == 3.0


def test_the_guess_of_the_call_comes_before_the_declared_one() -> None:
    problem = free_time()
    problem.state("z", guess=7.0)
    problem.dynamics("z", 0.0)
    transcription, point = start(problem, Collocation(2), None)
    assert np.all(entries(transcription, point, "state", 2)[1] == 7.0)
    transcription, point = start(problem, Collocation(2), {"z": -1.0, "u": None})
    assert np.all(entries(transcription, point, "state", 2)[1] == -1.0)


@pytest.mark.parametrize(
    ("lower", "upper", "expected"), [(2.0, np.inf, 2.0), (-np.inf, -3.0, -3.0), (None, None, 0.0), (-1.0, 5.0, 2.0)]
)
def test_bounded_variables_start_inside_their_bounds(lower: Any, upper: Any, expected: float) -> None:
    problem = van_der_pol(lower=lower, upper=upper)
    transcription, point = start(problem, Collocation(2), None)
    assert np.all(entries(transcription, point, "control", 0)[1] == expected)


# ---- earlier solutions ------------------------------------------------------------------------------------------


@cache
def solved(method: str) -> Solution:
    return solve(van_der_pol(), EVERY_METHOD[method])


@pytest.mark.parametrize("solver", SOLVERS)
@pytest.mark.parametrize("first", EVERY_METHOD)
@pytest.mark.parametrize("second", ["radau", "legendre-held", "rk4-linear"])
def test_a_solution_of_any_method_is_a_guess_for_any_other(first: str, second: str, solver: str) -> None:
    before = solved(first)
    after = solve(van_der_pol(), METHODS[second], guess=before, solver=solver)
    cold = solve(van_der_pol(), METHODS[second], solver=solver)
    assert after.cost == pytest.approx(cold.cost, abs=1e-8)
    assert after.iterations <= cold.iterations


@pytest.mark.parametrize("method", METHODS)
def test_a_solution_is_its_own_best_guess(method: str) -> None:
    solution = solve(free_time(), METHODS[method], options={"max_iter": 60})
    transcription, point = start(free_time(), METHODS[method], solution)
    np.testing.assert_allclose(point[transcription.nodes], solution.variables[transcription.nodes], atol=1e-9)
    again = solve(free_time(), METHODS[method], guess=solution)
    assert again.cost == pytest.approx(solution.cost, abs=1e-8)


def test_a_solution_is_stretched_over_another_horizon_and_started_from_its_own() -> None:
    solution = solve(van_der_pol(horizon=2.0), Collocation(10))
    transcription, point = start(van_der_pol(horizon=3.0), MultipleShooting(5), solution)
    s, values = entries(transcription, point, "state", 0)
    np.testing.assert_allclose(values, solution.at(2.0 * s)["x"][:, 0], atol=1e-12)

    free = solve(free_time(), Collocation(6))
    transcription, point = start(free_time(guess=7.0), Collocation(3), free)
    assert point[transcription.horizon] == pytest.approx(free.horizon)


def test_a_solution_of_another_problem_guesses_the_shared_variables() -> None:
    other = Problem("other")
    x = other.state("x", 2, initial=[1.0, 0.0])
    u, w = other.control("u"), other.control("w")
    other.dynamics(x, ca.vertcat(x[1] + w, u))
    other.horizon(1.0)
    other.minimize(u**2 + w**2 + ca.sumsqr(x))
    assert solve(other, Collocation(4), guess=solve(van_der_pol(), Collocation(6))).success


def test_an_unsuccessful_or_loaded_solution_is_a_guess_too(tmp_path: Any) -> None:
    short = solve(van_der_pol(), Collocation(8), options={"max_iter": 2}, check=False)
    assert not short.success
    short.save(tmp_path / "short.npz")
    prepared = prepare(van_der_pol(), Collocation(8))
    cold = prepared.solve()
    warm = prepared.solve(guess=Solution.load(tmp_path / "short.npz"))
    assert warm.cost == pytest.approx(cold.cost, abs=1e-9)
    assert warm.iterations <= cold.iterations


# ---- what is refused --------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("guess", "message"),
    [
        ({"z": 1.0}, "variable in guess 'z' does not exist"),
        ({"X": 1.0}, "variable in guess 'X' does not exist; did you mean 'x'"),
        ({3: 1.0}, "variable in guess 3 does not exist"),
        ([1.0], "guess must be a Solution, a dictionary or None, not list"),
        ("x", "guess must be a Solution, a dictionary or None, not str"),
        ({"x": [1.0, 2.0, 3.0]}, "guess of 'x' has 3 entries, 2 expected"),
        ({"x": lambda t: [1.0, 2.0, 3.0]}, "guess of 'x' has 3 entries, 2 expected"),
        ({"x": np.ones((4, 3))}, r"guess of 'x' has shape \(4, 3\), \(4, 2\) expected"),
        ({"x": np.ones((4, 2, 1))}, "guess of 'x' has 8 entries"),
        ({"x": np.nan}, "guess of 'x' is not finite at 0 s"),
        ({"x": [1.0, np.inf]}, "guess of 'x' is not finite"),
        ({"u": lambda t: np.log(-1.0 - 0 * t) if t > 9 else np.nan}, "guess of 'u' is not finite"),
        ({"u": lambda t: None}, "guess of 'u'"),
        ({"u": lambda t: "full"}, "guess of 'u': numbers or expressions are expected"),
        ({"u": "full"}, "guess of 'u': numbers"),
        ({"u": "1"}, "guess of 'u': numbers"),
        ({"u": {}}, "guess of 'u': numbers"),
        ({"u": [[1.0], [2.0, 3.0]]}, "guess of 'u': numbers"),
        ({"u": ca.SX.sym("z")}, "guess of 'u'"),
        ({"t": [0.0, 1.0], "x": np.ones((3, 2))}, r"guess of 'x' has shape \(3, 2\), \(2, 2\) expected"),
        ({"t": [0.0, 1.0, 1.0], "x": np.ones((3, 2))}, "its times 't' must be finite and increase"),
        ({"t": [0.0, 2.0, 1.0], "u": np.ones((3, 1))}, "its times 't' must be finite and increase"),
        ({"t": [0.0, np.nan, 1.0], "u": np.ones((3, 1))}, "its times 't' must be finite and increase"),
        ({"t": "abc", "u": np.ones((3, 1))}, "times 't'"),
        ({"x": [[0.0, 0.0], [np.nan, 0.0]]}, "guess of 'x' is not finite"),
        ({"horizon": 0.0}, "guess of the horizon must be one positive finite number"),
        ({"horizon": -1.0}, "guess of the horizon"),
        ({"horizon": np.inf}, "guess of the horizon"),
        ({"horizon": np.nan}, "guess of the horizon"),
        ({"horizon": None}, "guess of the horizon"),
        ({"horizon": []}, "guess of the horizon"),
        ({"horizon": [1.0, 2.0]}, "guess of the horizon"),
        ({"horizon": "2"}, "guess of the horizon"),
        ({"horizon": lambda t: 2.0}, "guess of the horizon"),
    ],
)
def test_bad_guesses_are_named(guess: Any, message: str) -> None:
    with pytest.raises(ProblemError, match=message):
        solve(free_time(), Collocation(3), guess=guess)


@pytest.mark.parametrize("value", [lambda t: [1.0, 2.0], lambda t: np.nan, lambda t: "a"])
def test_bad_declared_functions_are_named_when_they_are_called(value: Any) -> None:
    problem = Problem("bad guess")
    x = problem.state("x", guess=value)
    problem.dynamics(x, -x)
    problem.horizon(1.0)
    with pytest.raises(ProblemError, match="guess of 'x'"):
        solve(problem, Collocation(2))


def test_a_solution_that_shares_nothing_or_has_another_size_is_named() -> None:
    plan = solve(energy(), Collocation(3))
    for name, size, message in (
        ("z", 1, "'energy', shares no state or control with problem 'strange'"),
        ("q", 2, "guess of 'q' has 1 entries, 2 expected"),
    ):
        problem = Problem("strange")
        state = problem.state(name, size, initial=1.0)
        problem.dynamics(state, -state)
        problem.horizon(1.0)
        with pytest.raises(ProblemError, match=message):
            solve(problem, Collocation(2), guess=plan)


def test_a_plan_on_a_finer_mesh_keeps_its_control_on_both_sides_of_a_jump() -> None:
    """The last Radau point of an interval is its end, where the control of the next interval may be another one."""
    problem = Problem("least time")
    x, v = problem.state("x", initial=0.0, terminal=1.0), problem.state("v", initial=0.0, terminal=0.0)
    u = problem.control("u", lower=-4.0, upper=4.0)
    problem.dynamics(x, v)
    problem.dynamics(v, u)
    problem.minimize(terminal=problem.horizon(lower=0.1, upper=5.0, guess=1.0))
    method = Collocation(2, degree=3, scheme="radau")
    plan = solve(problem, method)
    assert plan.horizon == pytest.approx(1.0, abs=1e-5)
    finer, point = start(problem, method.halve(), plan)
    at, values = entries(finer, point, "control", 0)
    np.testing.assert_allclose(values, np.where(at <= 0.5, 4.0, -4.0), atol=1e-3)
