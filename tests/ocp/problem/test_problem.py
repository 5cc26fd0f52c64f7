"""Declaring: what is accepted, and that everything that cannot be right is named where it is said."""

from __future__ import annotations

import pickle
from collections.abc import Callable
from copy import copy
from typing import Any

import casadi as ca
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ocp import Collocation, Problem, ProblemError, solve
from ocp.problem.formulation import Formulation
from ocp.problem.values import constant
from tests.ocp.problems import SWING, energy, swing

nan, inf = np.nan, np.inf


def empty() -> Problem:
    return Problem("empty")


def half(symbols: Any = ca.SX) -> tuple[Problem, Any, Any]:
    """A problem with a state of two entries and a control, and their symbols."""
    problem = Problem("half", symbols)
    return problem, problem.state("x", 2), problem.control("u")


# ---- what is accepted ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("symbols", [ca.SX, ca.MX])
def test_declaring_returns_column_symbols(symbols: Any) -> None:
    problem = Problem("shapes", symbols)
    declared = [
        (problem.state("a"), 1),
        (problem.state("b", 3), 3),
        (problem.state("c", initial=[1.0, nan]), 2),
        (problem.control("d", upper=np.ones((4, 1))), 4),
        (problem.parameter("e", 2), 2),
        (problem.horizon(1.0), 1),
        (problem.time, 1),
        (problem.at_start("b"), 3),
    ]
    for symbol, size in declared:
        assert isinstance(symbol, symbols)
        assert symbol.shape == (size, 1)
        assert symbol.is_valid_input()


@given(size=st.integers(1, 6), lower=st.floats(-1e6, 1e6), width=st.floats(0.0, 1e6))
def test_scalars_stand_for_every_entry(size: int, lower: float, width: float) -> None:
    problem = empty()
    problem.state("x", size, lower=lower, upper=lower + width, initial=lower)
    declared = problem.declared.states["x"]
    for value, expected in ((declared.lower, lower), (declared.upper, lower + width), (declared.initial, lower)):
        np.testing.assert_array_equal(constant(value), np.full(size, expected))
    assert np.isnan(constant(declared.terminal)).all()


@pytest.mark.parametrize(
    "values",
    [[1.0, 2.0], (1, 2), np.array([1.0, 2.0]), np.array([[1.0], [2.0]]), ca.DM([1, 2]), ca.SX([1, 2]), [ca.SX(1), 2]],
    ids=["list", "tuple", "array", "column", "DM", "SX", "mixed list"],
)
def test_arrays_of_every_kind_are_values_and_give_the_size(values: Any) -> None:
    problem = empty()
    symbol = problem.state("x", initial=values, lower=-10.0)
    assert symbol.shape == (2, 1)
    np.testing.assert_array_equal(constant(problem.declared.states["x"].initial), [1.0, 2.0])
    other = empty()
    other.state("x", 2, upper=values)
    np.testing.assert_array_equal(constant(other.declared.states["x"].upper), [1.0, 2.0])


@pytest.mark.parametrize("guess", [0.5, [0.5, 0.5], ca.DM([0.5, 0.5]), np.array([0.5, 0.5]), lambda t: [t, 0.5]])
def test_guesses_of_every_kind_are_accepted(guess: Any) -> None:
    problem, x, u = half()
    b = problem.control("b", 2, guess=guess)
    problem.dynamics(x, ca.vertcat(u + b[0], u - b[1]))
    problem.horizon(1.0)
    problem.minimize(ca.sumsqr(x) + u**2 + ca.sumsqr(b))
    assert solve(problem, Collocation(2)).success


def test_declaring_is_inert_and_solving_changes_nothing() -> None:
    problem = swing()
    before = str(problem)
    for _ in range(2):
        solve(problem, Collocation(6), parameters=SWING)
        assert str(problem) == before


def test_later_declarations_do_not_reach_a_formulation() -> None:
    problem = energy()
    form = Formulation(problem)
    problem.path("late", problem.declared.states["q"].symbol, upper=0.5)
    assert len(form.path) == 0
    assert len(Formulation(problem).path) == 1


def test_a_formulation_is_kept_with_its_problem_until_more_is_declared() -> None:
    problem = energy()
    form = Formulation.of(problem)
    assert Formulation.of(problem) is form
    q = problem.declared.states["q"].symbol
    late: list[Any] = [
        lambda: problem.at_start("q"),
        lambda: problem.path("late", q, upper=0.5),
        lambda: problem.watch("seen", q, upper=0.5),
        lambda: problem.parameter("p"),
    ]
    for declare in late:
        declare()
        later = Formulation.of(problem)
        assert later is not form
        assert Formulation.of(problem) is later
        form = later
    assert form.path.names == ("late",)
    assert Formulation.of(copy(problem)) is not form
    assert Formulation.of(pickle.loads(pickle.dumps(problem))) is not form


def test_a_plan_is_audited_for_its_problem_as_it_stands() -> None:
    problem = energy()
    plan = solve(problem, Collocation(6))
    assert plan.audit().feasible
    problem.path("late", problem.declared.states["q"].symbol, upper=0.5)
    assert not plan.audit()["late"].passed


@pytest.mark.parametrize("symbols", [ca.SX, ca.MX])
def test_objects_cached_by_name_are_made_once(symbols: Any) -> None:
    form = Formulation(swing(symbols))
    results = []

    def outputs() -> list[Any]:
        results.append(1)
        return [form.f, form.x[0] * lam]

    lam = form.sym("lam")
    rng = np.random.default_rng(3)
    for count in (1, 31, 700):
        x, u, t = rng.normal(size=(count, form.nx)), rng.normal(size=(count, form.nu)), rng.normal(size=count)
        costate, p = rng.normal(size=count), rng.normal(size=form.np)
        own = form.sampled(outputs, x, u, t, 2.0, p, (lam, costate[:, None]), cache_as="both")
        anew = form.sampled([form.f, form.x[0] * lam], x, u, t, 2.0, p, (lam, costate[:, None]))
        for one, other in zip(own, anew, strict=True):
            np.testing.assert_array_equal(one, other)
        np.testing.assert_allclose(own[1][:, 0], x[:, 0] * costate, rtol=1e-15)
    assert results == [1]


@pytest.mark.parametrize("symbols", [ca.SX, ca.MX])
def test_variables_are_found_by_symbol_or_name(symbols: Any) -> None:
    problem, x, u = half(symbols)
    problem.dynamics("x", [u, x[0]])
    assert problem.declared.dynamics["x"].shape == (2, 1)
    assert problem.at_start(x) is problem.at_start("x")
    assert problem.at_start(u).shape == (1, 1)


def test_a_slice_of_everything_is_the_variable_itself() -> None:
    problem, x, u = half()
    problem.dynamics(x[:], ca.vertcat(u, x[0]))
    assert "x" in problem.declared.dynamics


def test_nan_frees_single_entries_of_the_ends() -> None:
    problem = empty()
    p = problem.parameter("p")
    x = problem.state("x", initial=[p, nan, 2.0], terminal=ca.vertcat(nan, 2 * p, nan))
    problem.dynamics(x, -x)
    problem.horizon(1.0)
    form = Formulation(problem)
    np.testing.assert_array_equal(form.initial_is_fixed, [True, False, True])
    lower, upper = form.bound_values(np.array([3.0]))
    first, last = (form.bounds.places[end] for end in ("initial", "terminal"))
    np.testing.assert_array_equal(lower[first], [3.0, -inf, 2.0])
    np.testing.assert_array_equal(upper[last], [inf, 6.0, inf])


def test_a_free_end_keeps_its_bounds() -> None:
    problem = energy()
    w = problem.state("w", 2, initial=[nan, 0.0], lower=[-1.0, -2.0], upper=3.0)
    problem.dynamics(w, -w)
    form = Formulation(problem)
    lower, upper = form.bound_values(np.zeros(0))
    place = form.bounds.places["initial"]
    np.testing.assert_array_equal(lower[place], [0.0, 0.0, -1.0, 0.0])
    np.testing.assert_array_equal(upper[place], [0.0, 0.0, 3.0, 0.0])


def test_names_of_one_problem_do_not_clash_with_those_of_another() -> None:
    first, second = energy(), energy()
    assert solve(first, Collocation(3)).cost == solve(second, Collocation(3)).cost


@pytest.mark.parametrize("symbols", [ca.SX, ca.MX])
@pytest.mark.parametrize("samples", [0, 1, 5])
def test_sampled_expressions_are_those_of_every_sample_alone(samples: int, symbols: Any) -> None:
    form = Formulation(swing(symbols))
    rng = np.random.default_rng(samples)
    x, u = rng.uniform(-1, 1, (samples, form.nx)), rng.uniform(-1, 1, (samples, form.nu))
    t, lam, p = np.linspace(0.0, 2.0, samples), rng.uniform(-1, 1, (samples, form.nx)), np.array([1.0, 1.1])
    costate, first = form.sym("lam", form.nx), np.array([0.3, -0.2, 0.1])
    outputs = [ca.jacobian(form.f, form.u), form.running + ca.dot(costate, form.f), form.x0 * form.T]
    result = form.sampled(outputs, x, u, t, 2.0, p, (costate, lam), (form.x0, first))
    assert [out.shape for out in result] == [(samples, form.nx * form.nu), (samples, 1), (samples, form.nx)]
    inputs = [form.x, form.u, form.t, form.T, form.p, costate, form.x0]
    alone = ca.Function("alone", inputs, [ca.densify(out) for out in outputs])
    for k in range(samples):
        for out, expected in zip(result, alone(x[k], u[k], t[k], 2.0, p, lam[k], first), strict=True):
            np.testing.assert_allclose(out[k], np.asarray(expected.full()).ravel(order="F"), atol=1e-14)


# ---- what is refused -------------------------------------------------------------------------------------------

Act = Callable[[], Any]


def on(act: Callable[[Problem, Any, Any], Any], symbols: Any = ca.SX) -> Act:
    """An act on a problem with a state x (2) and a control u."""
    return lambda: act(*half(symbols))


def twice(act: Callable[[], Any]) -> None:
    act()
    act()


def path_and_end(problem: Problem, x: Any) -> None:
    problem.path("c", x, 0)
    problem.end("c", x, 0)


VARIABLES: dict[str, tuple[Act, str]] = {
    "symbols by name": (lambda: Problem("p", symbols="SX"), "symbols must be casadi.SX or casadi.MX, not 'SX'"),
    "symbols DM": (lambda: Problem("p", symbols=ca.DM), "symbols must be"),
    "name not a string": (lambda: empty().state(3), "state name must be a non-empty string, not 3"),  # type: ignore[arg-type]
    "name empty": (lambda: empty().control(""), "control name must be a non-empty string"),
    "name reserved": (lambda: empty().parameter("t"), "parameter 't': this name is reserved"),
    "name horizon": (lambda: empty().state("horizon"), "reserved"),
    "name taken": (on(lambda p, x, u: p.control("x")), "control 'x': a state of this name exists already"),
    "name taken by a control": (on(lambda p, x, u: p.parameter("u")), "parameter 'u': a control of this name"),
    "size zero": (lambda: empty().state("q", 0), "state 'q': size must be a whole number, 1 to 1000000, not 0"),
    "size negative": (lambda: empty().control("q", -1), "size must be a whole number, 1 to 1000000, not -1"),
    "size broken": (lambda: empty().parameter("q", 1.5), "size must be a whole number, 1 to 1000000, not 1.5"),  # type: ignore[arg-type]
    "size a string": (lambda: empty().state("q", "2"), "size must be a whole number"),  # type: ignore[arg-type]
    "size a bool": (lambda: empty().state("q", True), "size must be a whole number"),
    "sizes differ": (lambda: empty().state("q", lower=[1, 2], upper=[3, 4, 5]), "lower has 2, upper has 3"),
    "size and array differ": (lambda: empty().state("q", 3, lower=[1, 2]), "state 'q': lower has 2 entries, 3 exp"),
    "empty array": (lambda: empty().state("q", initial=[]), "state 'q'"),
    "ragged array": (lambda: empty().state("q", initial=[[1, 2], [3]]), "state 'q'"),
    "a string": (lambda: empty().state("q", initial="a"), "state 'q': initial: numbers or expressions"),
    "a string of digits": (lambda: empty().state("q", initial="1"), "state 'q'"),
    "a dictionary": (lambda: empty().state("q", initial={}), "numbers or expressions are expected"),
    "a complex number": (lambda: empty().state("q", initial=1j), "numbers or expressions are expected"),
    "initial infinite": (lambda: empty().state("q", initial=inf), "state 'q': initial is not finite: inf"),
    "terminal infinite": (lambda: empty().state("q", terminal=[0, -inf]), r"terminal is not finite: -inf \(entry 1\)"),
    "initial outside": (
        lambda: empty().state("q", initial=2, upper=1),
        r"initial value 2 is outside the bounds \[-inf, 1\]",
    ),
    "terminal outside": (lambda: empty().state("q", 2, terminal=[0, -3], lower=-1), r"terminal value -3 .*entry 1"),
    "lower nan": (lambda: empty().state("q", lower=nan), "state 'q': lower is not a number"),
    "upper nan entry": (lambda: empty().control("q", upper=[1, nan]), "control 'q': upper is not a number"),
    "lower above upper": (lambda: empty().control("q", lower=2, upper=1), "lower bound 2 is above upper bound 1"),
    "lower infinite": (lambda: empty().state("q", lower=inf), "exclude everything"),
    "upper minus infinite": (lambda: empty().control("q", upper=-inf), "exclude everything"),
    "bound of a state": (on(lambda p, x, u: p.control("q", upper=x[0])), "control 'q': upper uses the symbol 'x_0'"),
    "bound of another problem": (lambda: empty().state("q", lower=empty().parameter("p")), "uses the symbol 'p'"),
    "guess not finite": (lambda: empty().state("q", guess=nan), "state 'q': guess is not finite"),
    "guess a string": (lambda: empty().control("q", guess="zero"), "control 'q': guess: numbers"),
    "guess of wrong size": (lambda: empty().state("q", 2, guess=[1, 2, 3]), "guess has 3 entries, 2 expected"),
    "guess symbolic": (on(lambda p, x, u: p.state("q", guess=x[0])), "state 'q': guess"),
}
HORIZONS: dict[str, tuple[Act, str]] = {
    "zero": (lambda: empty().horizon(0), "horizon must be positive and finite, not 0 s"),
    "negative": (lambda: empty().horizon(-1.0), "not -1 s"),
    "infinite": (lambda: empty().horizon(inf), "not inf s"),
    "nan": (lambda: empty().horizon(nan), "not a number"),
    "a string": (lambda: empty().horizon("soon"), "horizon: numbers"),
    "a string of digits": (lambda: empty().horizon("1"), "horizon"),
    "two": (lambda: empty().horizon([1, 2]), "horizon has 2 entries, 1 expected"),
    "lower zero": (lambda: empty().horizon(lower=0, upper=1), "lower must be positive and finite, not 0"),
    "lower above upper": (lambda: empty().horizon(lower=2, upper=1), "lower bound 2 is above upper bound 1"),
    "upper negative": (lambda: empty().horizon(upper=-1), "above upper bound -1"),
    "upper nan": (lambda: empty().horizon(upper=nan), "upper is not a number"),
    "value and bounds": (lambda: empty().horizon(1.0, lower=0.1), "not both"),
    "guess outside": (lambda: empty().horizon(lower=0.1, upper=1, guess=2), "guess value 2 is outside"),
    "guess nan": (lambda: empty().horizon(lower=0.1, upper=1, guess=nan), "guess"),
    "guess infinite": (lambda: empty().horizon(guess=inf), "guess must be positive and finite"),
    "guess a string": (lambda: empty().horizon(lower=0.1, guess="a"), "guess"),  # type: ignore[arg-type]
    "guess a list": (lambda: empty().horizon(lower=0.1, guess=[1, 2]), "guess"),  # type: ignore[arg-type]
    "guess a function": (lambda: empty().horizon(lower=0.1, guess=lambda t: 1.0), "guess"),  # type: ignore[arg-type]
    "of a state": (on(lambda p, x, u: p.horizon(x[0])), "horizon uses the symbol 'x_0'"),
    "twice": (on(lambda p, x, u: twice(lambda: p.horizon(1))), "horizon is declared twice"),
}
EQUATIONS: dict[str, tuple[Act, str]] = {
    "dynamics twice": (on(lambda p, x, u: twice(lambda: p.dynamics(x, x))), "state 'x': dynamics declared twice"),
    "dynamics of a control": (on(lambda p, x, u: p.dynamics(u, u)), "not a declared state"),
    "dynamics of an expression": (on(lambda p, x, u: p.dynamics(2 * x, x)), "not a declared state"),
    "dynamics of an entry": (on(lambda p, x, u: p.dynamics(x[0], u)), "not a declared state"),
    "dynamics of a number": (on(lambda p, x, u: p.dynamics(1.0, u)), "1.0 is not a declared state"),
    "dynamics of nothing": (on(lambda p, x, u: p.dynamics(None, u)), "None is not a declared state"),
    "dynamics of an unknown name": (on(lambda p, x, u: p.dynamics("y", u)), "variable in dynamics 'y' does not exist"),
    "dynamics of wrong size": (on(lambda p, x, u: p.dynamics(x, u)), "dynamics of 'x' has 1 entries, the state has 2"),
    "dynamics None": (on(lambda p, x, u: p.dynamics(x, None)), "a number or an expression is expected, not None"),
    "dynamics a string": (on(lambda p, x, u: p.dynamics(x, "u")), "not 'u'"),
    "dynamics nan": (on(lambda p, x, u: p.dynamics(x, [nan, 0])), "dynamics of 'x' is not finite"),
    "dynamics nan inside": (on(lambda p, x, u: p.dynamics(x, [x[0], nan])), "dynamics of 'x' is not finite"),
    "foreign symbol": (on(lambda p, x, u: p.dynamics(x, x + ca.SX.sym("z"))), "uses the symbol 'z'"),
    "symbol of another problem": (on(lambda p, x, u: p.dynamics(x, half()[1])), "not part of this problem"),
    "MX in SX": (on(lambda p, x, u: p.dynamics(x, ca.MX.sym("z", 2))), "made of MX symbols, the problem of SX"),
    "SX in MX": (on(lambda p, x, u: p.dynamics(x, ca.SX.sym("z", 2)), ca.MX), "made of SX symbols"),
    "mixed symbols": (on(lambda p, x, u: p.dynamics(x, [x[0], ca.MX.sym("z")])), "dynamics of 'x'"),
    "nested list": (on(lambda p, x, u: p.dynamics(x, [[x[0]], [u]])), "dynamics of 'x'"),
    "list with None": (on(lambda p, x, u: p.dynamics(x, [x[0], None])), "dynamics of 'x'"),
    "list with a string": (on(lambda p, x, u: p.dynamics(x, [x[0], "u"])), "dynamics of 'x'"),
    "start inside": (on(lambda p, x, u: p.dynamics(x, p.at_start(x))), "uses the symbol 'x_at_start"),
    "start of a parameter": (on(lambda p, x, u: p.at_start(p.parameter("k"))), "not a declared state or control"),
    "start of an expression": (on(lambda p, x, u: p.at_start(x + 1)), "not a declared state or control"),
    "path without bounds": (on(lambda p, x, u: p.path("c", x)), "path constraint 'c' has neither lower nor upper"),
    "path without name": (on(lambda p, x, u: p.path("", x, 0)), "name must be a non-empty string"),
    "path name a number": (on(lambda p, x, u: p.path(1, x, 0)), "name must be a non-empty string, not 1"),  # type: ignore[arg-type]
    "path twice": (on(lambda p, x, u: twice(lambda: p.path("c", x, 0))), "of this name exists already"),
    "end after path": (on(lambda p, x, u: path_and_end(p, x)), "end constraint 'c'.*exists"),
    "path bound size": (on(lambda p, x, u: p.path("c", x, lower=[1, 2, 3])), "lower has 3 entries, 2 expected"),
    "path bounds crossed": (on(lambda p, x, u: p.path("c", x, 2, [3, 1])), r"lower bound 2 is above .* \(entry 1\)"),
    "path bound nan": (on(lambda p, x, u: p.path("c", x, lower=nan)), "lower is not a number"),
    "path bound of a state": (on(lambda p, x, u: p.path("c", u, lower=x[0])), "lower uses the symbol 'x_0'"),
    "path at the start": (on(lambda p, x, u: p.path("c", p.at_start(x), 0)), "uses the symbol"),
    "path of nothing": (on(lambda p, x, u: p.path("c", ca.SX(0, 1), 0)), "path constraint 'c'"),
    "path of an empty list": (on(lambda p, x, u: p.path("c", [], 0)), "path constraint 'c'"),
    "start ties": (on(lambda p, x, u: p.start("c", p.at_start(x), 0)), "uses the symbol"),
    "end foreign": (on(lambda p, x, u: p.end("c", ca.SX.sym("z"), 0)), "uses the symbol 'z'"),
    "cost twice": (on(lambda p, x, u: twice(lambda: p.minimize(u))), "the cost is declared twice"),
    "cost a vector": (on(lambda p, x, u: p.minimize(x)), "running cost must be a scalar, it has 2 entries"),
    "cost empty": (on(lambda p, x, u: p.minimize(ca.SX(0, 0))), "running cost must be a scalar"),
    "cost None": (on(lambda p, x, u: p.minimize(None)), "running cost: a number or an expression"),
    "cost nan": (on(lambda p, x, u: p.minimize(nan)), "running cost is not finite"),
    "cost infinite": (on(lambda p, x, u: p.minimize(terminal=inf)), "terminal cost is not finite"),
    "terminal cost of a control": (on(lambda p, x, u: p.minimize(terminal=u)), "terminal cost uses the symbol 'u'"),
    "terminal cost a vector": (on(lambda p, x, u: p.minimize(0, x)), "terminal cost must be a scalar"),
}
POOLS = {"variable": VARIABLES, "horizon": HORIZONS, "equation": EQUATIONS}
ALL = {f"{kind} {name}": case for kind, pool in POOLS.items() for name, case in pool.items()}


@pytest.mark.parametrize("case", ALL)
def test_wrong_declarations_are_named_at_once(case: str) -> None:
    act, message = ALL[case]
    with pytest.raises(ProblemError, match=message):
        act()


@pytest.mark.parametrize(
    ("missing", "message"),
    [("states", "has no state"), ("dynamics", "state 'q' has no dynamics"), ("horizon", "has no horizon")],
)
def test_incomplete_problems_are_named_when_they_are_solved(missing: str, message: str) -> None:
    problem = empty()
    if missing != "states":
        q = problem.state("q", initial=0.0)
        if missing != "dynamics":
            problem.dynamics(q, 1.0)
    if missing != "horizon":
        problem.horizon(1.0)
    with pytest.raises(ProblemError, match=message):
        solve(problem, Collocation(2))


def test_a_refused_declaration_leaves_nothing_behind() -> None:
    problem, x, u = half()
    before = str(problem)
    for act in (
        lambda: problem.state("y", lower=2, upper=1),
        lambda: problem.control("y", guess=nan),
        lambda: problem.dynamics(x, u),
        lambda: problem.path("c", x, 2, 1),
        lambda: problem.minimize(u, x),
        lambda: problem.horizon(-1.0),
    ):
        with pytest.raises(ProblemError):
            act()
    assert str(problem) == before
    problem.state("y")
    problem.dynamics(x, ca.vertcat(u, u))
    problem.path("c", x, 1, 2)
    problem.minimize(u**2)
    problem.horizon(1.0)
