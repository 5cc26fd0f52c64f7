"""The Hamiltonian system by automatic differentiation; what the indirect method refuses, and how it fails."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

import casadi as ca
import numpy as np
import pytest

from ocp import Collocation, Indirect, Problem, ProblemError, Solution, SolveError, prepare, solve
from ocp.indirect.hamiltonian import Hamiltonian
from ocp.problem.formulation import Formulation
from tests.ocp.indirect.extremals import EXTREMA, bang_bang
from tests.ocp.problems import Array, energy, plant, swing, van_der_pol

SMOOTH = [name for name, case in EXTREMA.items() if case.switches == 0]
RNG_SEED = 7


def system(problem: Problem) -> tuple[Formulation, Hamiltonian]:
    form = Formulation(problem)
    return form, Hamiltonian.of(form)


def point(form: Formulation, name: str, draw: int) -> list[Array]:
    """x, lam, t, T, p near where the problem lives, from a seed."""
    rng = np.random.default_rng(RNG_SEED + draw)
    p = form.parameter_vector(dict(EXTREMA[name].parameters))
    return [rng.uniform(0.2, 0.8, form.nx), rng.uniform(-0.8, -0.2, form.nx), np.array([0.4]), np.array([1.3]), p]


def guess_of(form: Formulation, ham: Hamiltonian) -> Array:
    return np.concatenate([np.full(len(ham.smooth), 0.3), np.zeros(len(form.path))])


# ---- the equations -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("draw", range(3))
@pytest.mark.parametrize("name", SMOOTH)
def test_the_costate_rate_is_minus_the_slope_of_the_least_hamiltonian(name: str, draw: int) -> None:
    """lambda' = -d(min over u of H)/dx and x' = d(min over u of H)/dlambda, by central differences (envelope)."""
    form, ham = system(EXTREMA[name].build())
    at = point(form, name, draw)
    tail = [np.zeros(0), guess_of(form, ham)]
    flow, outputs = ham.flow(), ham.outputs()

    def least(x: Array, lam: Array, T: Array) -> float:
        return float(outputs(x, lam, at[2], T, at[4], *tail)[2])

    matches = [np.asarray(out.full()).ravel() for out in flow(*at, *tail)]
    step = 1e-6
    for i, unit in enumerate(np.eye(form.nx)):
        by_x = (least(at[0] + step * unit, at[1], at[3]) - least(at[0] - step * unit, at[1], at[3])) / (2 * step)
        by_lam = (least(at[0], at[1] + step * unit, at[3]) - least(at[0], at[1] - step * unit, at[3])) / (2 * step)
        assert matches[1][i] == pytest.approx(-by_x, abs=1e-7)
        assert matches[0][i] == pytest.approx(by_lam, abs=1e-7)
    by_horizon = (least(at[0], at[1], at[3] + step) - least(at[0], at[1], at[3] - step)) / (2 * step)
    assert matches[3][0] == pytest.approx(by_horizon, abs=1e-7)


@pytest.mark.parametrize("name", SMOOTH)
def test_no_admissible_control_has_a_smaller_hamiltonian(name: str) -> None:
    """Random controls inside the bounds, projected on the path equalities, against the one that was found."""
    problem = EXTREMA[name].build()
    form, ham = system(problem)
    x, lam, t, T, p = point(form, name, 0)
    u, mu = (np.asarray(out.full()).ravel() for out in ham.outputs()(x, lam, t, T, p, [], guess_of(form, ham))[:2])
    index = form.bounds.places["control"]
    low, high = (bound[index] for bound in form.bound_values(p))
    assert np.all(u >= low - 1e-9)
    assert np.all(u <= high + 1e-9)
    values = ca.Function("h", [form.u], [ca.substitute(form.running + ca.dot(lam, form.f), *joined(form, x, t, T, p))])
    rows = ca.Function("g", [form.u], [ca.substitute(ham.rows, *joined(form, x, t, T, p))])
    assert mu.size == len(form.path)
    if len(form.path):
        assert np.max(np.abs(rows(u).full())) < 1e-10
    slope = ca.Function("a", [form.u], [ca.jacobian(rows(form.u), form.u)]) if len(form.path) else None
    rng = np.random.default_rng(RNG_SEED)
    tried = 0
    for _ in range(300):
        step = rng.uniform(-1.0, 1.0, form.nu) * rng.choice([0.05, 0.5])
        if slope is not None:
            a = np.asarray(slope(u).full())
            step -= np.linalg.pinv(a) @ (a @ step)
        other = u + step
        if np.all(other >= low) and np.all(other <= high):
            tried += 1
            assert float(values(other)) >= float(values(u)) - 1e-9
    assert tried > 10


def joined(form: Formulation, x: Array, t: Array, T: Array, p: Array) -> tuple[Any, Any]:
    sort = form.problem.symbols
    return ca.vertcat(form.x, form.t, form.T, form.p), sort(ca.DM(np.concatenate([x, t, T, p])))


@pytest.mark.parametrize("symbols", [ca.SX, ca.MX])
def test_smooth_and_linear_controls_are_distinguished(symbols: Any) -> None:
    problem, x, u = plant("kinds", symbols=symbols, initial=0.0, u={"size": 2, "lower": -1, "upper": 1})
    w = problem.control("w", 2)
    b = problem.control("b", lower=-1, upper=2)
    problem.dynamics(x, u[0] * ca.sin(x) + u[1] + w[0] - w[1] + b)
    problem.path("tie", w[1] - x, 0, 0)
    problem.minimize(running=u[1] ** 2 + ca.exp(w[0]) + b * x)
    ham = system(problem)[1]
    assert ham.smooth == (1, 2, 3)  # u[1], w[0] by their cost, w[1] by the path equality
    assert ham.linear == (0, 4)


# ---- what it cannot take -----------------------------------------------------------------------------------------


def declare(
    running: Callable[[Any, Any], Any], *, size: int = 1, lower: Any = None, upper: Any = None, name: str = "plain"
) -> Problem:
    """x' = v, v' = sum u from rest, 1 s, terminal cost (x - 1)^2."""
    problem, x, u = plant(name, size=2, initial=[0.0, 0.0], u={"size": size, "lower": lower, "upper": upper})
    problem.dynamics(x, ca.vertcat(x[1], ca.sum1(u)))
    problem.minimize(running=running(x, u), terminal=(x[0] - 1) ** 2)
    return problem


def quadratic() -> Problem:
    return declare(lambda x, u: ca.sumsqr(u))


def quadratic_and(more: Callable[[Problem, Any, Any], None]) -> Problem:
    """The quadratic problem with another declaration of its state and control."""
    problem = quadratic()
    more(problem, problem.declared.states["x"].symbol, problem.declared.controls["u"].symbol)
    return problem


def with_state_bounds() -> Problem:
    problem, x, u = plant("bounded state", initial=0.0, upper=2.0)
    problem.dynamics(x, u)
    problem.minimize(running=u**2)
    return problem


def with_cost_on_the_first_control() -> Problem:
    problem, x, u = plant("first control", initial=0.0)
    problem.dynamics(x, u)
    problem.minimize(running=u**2, terminal=problem.at_start(u) ** 2)
    return problem


CONSTRAINED: dict[str, tuple[Callable[[Problem, Any, Any], None], str]] = {
    "path inequality": (lambda p, x, u: p.path("corridor", x[1], upper=0.7), "path inequality 'corridor'"),
    "path equality without control": (
        lambda p, x, u: p.path("rail", x[0] - p.time, 0, 0),
        "path equality 'rail', which contains no control",
    ),
    "start inequality": (lambda p, x, u: p.start("above", x[1], lower=-1), "start inequality 'above'"),
    "end inequality": (lambda p, x, u: p.end("beyond", x[0], lower=0.9), "end inequality 'beyond'"),
    "end constraint on the control": (lambda p, x, u: p.end("rest", u, 0, 0), "end constraint 'rest' on the control"),
    "start constraint on the control": (
        lambda p, x, u: p.start("push", u, 0, 0),
        "start constraint 'push' on the control",
    ),
    "tie of the control": (
        lambda p, x, u: p.end("tie", x[0] - p.at_start(u), 0, 0),
        "end constraint 'tie' on the control",
    ),
}
REFUSED: dict[str, tuple[Callable[[], Problem], str]] = {
    **{kind: (partial(quadratic_and, more), message) for kind, (more, message) in CONSTRAINED.items()},
    "state bounds": (with_state_bounds, "bounds of state 'x'"),
    "cost on the first control": (with_cost_on_the_first_control, "terminal cost on the control at the start"),
    "linear in a free control": (lambda: declare(lambda x, u: x[0] ** 2), "linear in control 'u'"),
    "linear in a half-bounded control": (lambda: declare(lambda x, u: x[0] ** 2, lower=0.0), "linear in control 'u'"),
    "redundant controls": (lambda: declare(lambda x, u: ca.sum1(u) ** 2, size=2), "second derivative is singular"),
    "redundant bounded controls": (
        lambda: declare(lambda x, u: ca.sum1(u) ** 2, size=2, lower=-1, upper=1),
        "second derivative is singular",
    ),
}


@pytest.mark.parametrize("kind", REFUSED)
def test_a_problem_that_it_cannot_take_is_refused_by_name_before_it_is_solved(kind: str) -> None:
    build, message = REFUSED[kind]
    with pytest.raises(ProblemError, match=message) as caught:
        prepare(build(), Indirect())
    assert str(caught.value.name) in (message.split("'") if "'" in message else str(caught.value))


def test_the_first_obstacle_of_a_problem_with_many_is_named() -> None:
    with pytest.raises(ProblemError, match=r"bounds of state 'x'.*direct method"):
        prepare(swing(), Indirect())


def free_start() -> Problem:
    problem, x, u = plant("free start", size=2, initial=[1.0, np.nan])
    problem.dynamics(x, ca.vertcat(x[1], u))
    problem.minimize(running=u**2, terminal=ca.sumsqr(x))
    return problem


BACKWARD: dict[str, tuple[Callable[[], Problem], str]] = {
    "given end": (energy, "a state that is given at the end"),
    "free start": (free_start, "a state that is free at the start"),
    "free horizon": (EXTREMA["free horizon"].build, "a free horizon"),
    "end constraints": (EXTREMA["everything"].build, "end constraints"),
    "start constraints": (EXTREMA["everything"].build, "start constraints"),
    "ties": (EXTREMA["free start"].build, "a cost that ties both ends"),
    "switches": (bang_bang, "controls that switch"),
}


@pytest.mark.parametrize("kind", BACKWARD)
def test_backward_shooting_names_unsupported_problems(kind: str) -> None:
    build, message = BACKWARD[kind]
    with pytest.raises(ProblemError, match=rf"backward shooting does not support.*{message}.*shooting='multiple'"):
        prepare(build(), Indirect(shooting="backward"))


BAD_ARGUMENTS: list[tuple[dict[str, Any], str]] = [
    ({"segments": 0}, "segments must be a whole number, 1 to 1000000, not 0"),
    ({"segments": 2.0}, "segments"),
    ({"segments": True}, "segments"),
    ({"segments": "many"}, "segments"),
    ({"shooting": "sideways"}, "'multiple' or 'backward', not 'sideways'"),
    ({"shooting": None}, "shooting"),
    ({"tolerance": 0.0}, "tolerance must be between 0 and 1"),
    ({"tolerance": np.nan}, "tolerance"),
    ({"tolerance": "tight"}, "tolerance"),
    ({"residual": 1.0}, "residual must be between 0 and 1"),
    ({"residual": -1e-9}, "residual"),
    ({"seed": "coarse"}, r"seed must be a Collocation\(...\), not 'coarse'"),
    ({"seed": Indirect()}, "seed"),
]


@pytest.mark.parametrize(("arguments", "message"), BAD_ARGUMENTS)
def test_bad_settings_are_refused(arguments: dict[str, Any], message: str) -> None:
    with pytest.raises(ProblemError, match=message):
        Indirect(**arguments)


def test_invalid_problems_and_solvers_are_refused() -> None:
    with pytest.raises(ProblemError, match="a Problem is expected, not str"):
        prepare("energy", Indirect())  # type: ignore[arg-type]
    words = "solver must be 'ipopt' or 'fatrop' or 'sleqp', not 'snopt'"
    with pytest.raises(ProblemError, match=words):
        prepare(energy(), Indirect(), solver="snopt")
    with pytest.raises(ProblemError, match="parameters must be a dictionary"):
        solve(energy(), Indirect(), parameters=3)  # type: ignore[arg-type]
    with pytest.raises(ProblemError, match="parameter 'mass' does not exist"):
        solve(energy(), Indirect(), parameters={"mass": 1.0})


# ---- guesses -----------------------------------------------------------------------------------------------------


def other(states: str = "q", controls: str = "w", size: int = 1) -> Solution:
    problem = Problem("other")
    q = problem.state(states, size, initial=0.0)
    u = problem.control(controls, size)
    problem.horizon(1.0)
    problem.dynamics(q, u)
    problem.minimize(running=ca.sumsqr(u - 1))
    return solve(problem, Collocation(3))


def test_a_guess_of_another_problem_is_refused() -> None:
    for guess in (other(), other("x", "u"), other("x", "u", 2), other("q", "u", 2)):
        with pytest.raises(ProblemError, match=r"plan 'other' has states"):
            solve(energy(), Indirect(), guess=guess)


def test_a_guess_with_other_controls_is_refused() -> None:
    problem, q, u = plant("one state", state="q", initial=0.0, u={"size": 2})
    problem.dynamics(q, ca.sum1(u))
    problem.minimize(running=ca.sumsqr(u - 1))
    with pytest.raises(ProblemError, match=r"plan 'other' has controls \{'w': 1\}"):
        solve(problem, Indirect(), guess=other())


def test_a_guess_without_costates_is_refused() -> None:
    seed = solve(energy(), Collocation(5))
    with pytest.raises(ProblemError, match=r"plan 'energy', has no costates of q, v"):
        solve(energy(), Indirect(), guess=replace(seed, costates={}))
    with pytest.raises(ProblemError, match=r"has no costates of v"):
        solve(energy(), Indirect(), guess=replace(seed, costates={"q": seed.costates["q"]}))


@pytest.mark.parametrize(("guess", "message"), [(3, "guess must be"), ({"speed": 1.0}, "variable in guess")])
def test_invalid_guesses_are_refused(guess: Any, message: str) -> None:
    with pytest.raises(ProblemError, match=message):
        solve(energy(), Indirect(), guess=guess)


def test_variables_of_the_guess_may_be_declared_in_another_order() -> None:
    def build(names: tuple[str, str], controls: tuple[str, str]) -> Problem:
        problem = Problem("order")
        states = {name: problem.state(name, initial=1.0, terminal=0.0) for name in names}
        inputs = {name: problem.control(name, lower=-3, upper=3) for name in controls}
        horizon = problem.horizon(lower=0.2, upper=9.0, guess=1.0)
        problem.dynamics(states["a"], inputs["bang"])
        problem.dynamics(states["b"], inputs["smooth"] - states["a"])
        problem.minimize(running=inputs["smooth"] ** 2, terminal=horizon)
        return problem

    seed = solve(build(("b", "a"), ("smooth", "bang")), Collocation(40, control="held"))
    solution = solve(build(("a", "b"), ("bang", "smooth")), Indirect(), guess=seed)
    straight = solve(build(("b", "a"), ("smooth", "bang")), Indirect(), guess=seed)
    assert solution.cost == pytest.approx(straight.cost, abs=1e-10)
    np.testing.assert_allclose(solution.method["switches"], straight.method["switches"], atol=1e-9)
    for name in ("a", "b"):
        places = np.linspace(0, solution.horizon * (1 - 1e-9), 40)
        np.testing.assert_allclose(solution.at(places)[name], straight.at(places)[name], atol=1e-9)
    assert set(solution["bang"].ravel()) == {-3.0, 3.0}


# ---- failures ----------------------------------------------------------------------------------------------------


def singular_arc() -> Problem:
    """x' = u, |u| <= 1, int (x - t^2/4)^2: from 0.3 the state meets the curve and follows it."""
    problem, x, u = plant("follow", initial=0.3, u={"lower": -1, "upper": 1}, horizon=1.5)
    problem.dynamics(x, u)
    problem.minimize(running=(x - problem.time**2 / 4) ** 2)
    return problem


def chattering() -> Problem:
    """Fuller's problem."""
    problem = Problem("Fuller")
    x = problem.state("x", 2, initial=[0.0, 1.0], terminal=[0.0, 0.0])
    u = problem.control("u", lower=-1, upper=1)
    problem.horizon(3.0)
    problem.dynamics(x, ca.vertcat(x[1], u))
    problem.minimize(running=x[0] ** 2)
    return problem


@pytest.mark.parametrize("build", [singular_arc, chattering])
def test_singular_arcs_and_chattering_are_named(build: Callable[[], Problem]) -> None:
    with pytest.raises(SolveError, match=r"control 'u'.*singular arc.*direct method") as caught:
        solve(build(), Indirect())
    assert caught.value.solution is not None
    unsolved = solve(build(), Indirect(), check=False)
    assert not unsolved.success
    assert "singular arc" in unsolved.message


def test_chattering_is_distinguished_from_the_switches_of_the_seed() -> None:
    """A seed whose switching function changes sign at every other reported time."""
    problem = bang_bang()
    seed = solve(problem, Collocation(40, control="held"), parameters=EXTREMA["bang-bang"].parameters)
    costates = dict(seed.costates)
    costates["y"] = np.abs(costates["y"]) * np.where(np.arange(len(seed.t)) % 2 == 0, 1.0, -1.0)[:, None]
    with pytest.raises(SolveError, match=r"control 'u\[1\]' switches in every interval.*chattering"):
        solve(problem, Indirect(), parameters=EXTREMA["bang-bang"].parameters, guess=replace(seed, costates=costates))


def oscillator(horizon: float, rate: float) -> Problem:
    """min int x cos(rate t) of x'' = u - x: the costates do not depend on the plan, so nothing but signs is wrong."""
    problem, x, u = plant("oscillator", size=2, initial=[0.0, 0.0], u={"lower": -1, "upper": 1}, horizon=horizon)
    problem.dynamics(x, ca.vertcat(x[1], -x[0] + u))
    problem.minimize(running=x[0] * ca.cos(rate * problem.time))
    return problem


@pytest.mark.parametrize(("horizon", "rate"), [(1.0, 0.2), (8.0, 0.3)])
def test_switches_of_another_problem_are_detected(horizon: float, rate: float) -> None:
    """Newton's method converges all the same: only the sign of the switching function tells."""
    right = solve(oscillator(8.0, 1.7), Indirect())
    seed = solve(oscillator(horizon, rate), Collocation(40, control="held"))
    with pytest.raises(SolveError, match=r"'u' is at the wrong bound at .* s.*the seed has other switches"):
        solve(oscillator(8.0, 1.7), Indirect(), guess=seed)
    wrong = solve(oscillator(8.0, 1.7), Indirect(), guess=seed, check=False)
    assert not wrong.success
    assert wrong.cost > right.cost + 1e-3
    assert not wrong.audit().passed


def test_a_seed_of_other_bounds_is_no_singular_arc() -> None:
    """A control at the bound that it had when the seed was solved is at a bound, though not at the new one."""
    build = EXTREMA["mixed"].build
    seed = solve(build(), Indirect(), parameters={"b": 0.5})
    shifted = solve(build(), Indirect(), parameters={"b": 0.8}, guess=seed)
    own = solve(build(), Indirect(), parameters={"b": 0.8})
    np.testing.assert_allclose(np.abs(shifted["u"]), 0.8)
    assert shifted.cost == pytest.approx(own.cost, abs=1e-9)
    assert shifted.audit().passed


def test_switches_out_of_order_are_no_plan() -> None:
    """Two controls whose switches cross between the seed's parameter and the one asked for."""

    def build() -> Problem:
        problem = Problem("crossing")
        shift = problem.parameter("shift")
        x = problem.state("x", 2, initial=[0.0, 0.0])
        u = problem.control("u", 2, lower=-1, upper=1)
        problem.horizon(5.0)
        problem.dynamics(x, u)
        t = problem.time
        problem.minimize(running=ca.cos(t) * x[0] + ca.cos(t - shift) * x[1])
        return problem

    seed = solve(build(), Collocation(40, control="held"), parameters={"shift": -0.1})
    stale = replace(seed, parameters={"shift": np.array([0.1])})
    with pytest.raises(SolveError, match=r"switches are not in order within the horizon"):
        solve(build(), Indirect(), parameters={"shift": 0.1}, guess=stale)
    right = solve(build(), Indirect(), parameters={"shift": 0.1})
    first, second = right.method["switches"]
    assert first == pytest.approx(3 * np.pi - 5, abs=1e-9)
    assert second > first


def test_a_maximum_of_the_hamiltonian_is_no_extremal() -> None:
    """H = -u^2/2 + lambda u is stationary at u = lambda, where it is greatest."""
    problem, x, u = plant("concave", initial=0.0, u={"lower": -1, "upper": 2, "guess": 0.1})
    problem.dynamics(x, u)
    problem.minimize(running=-(u**2) / 2, terminal=x**2)
    with pytest.raises(SolveError, match="stationary but not minimal in control 'u'"):
        solve(problem, Indirect())


def test_a_saddle_of_the_hamiltonian_is_no_extremal() -> None:
    """H = u1^2/2 + 3 u1 u2 + u2^2/2 + lambda (u1 + u2) has one stationary point, a saddle."""
    problem = declare(lambda x, u: ca.sumsqr(u) / 2 + 3 * u[0] * u[1], size=2, name="saddle")
    seed = solve(declare(lambda x, u: ca.sumsqr(u), size=2), Collocation(10))
    with pytest.raises(SolveError, match="stationary but not minimal"):
        solve(problem, Indirect(), guess=seed)


def compass() -> Problem:
    """x' = sin a, min int cos a: H = cos a, for lambda = 0, is stationary at 0 too, where it is greatest."""
    problem, x, angle = plant("compass", initial=0.0, u={"name": "angle"})
    problem.dynamics(x, ca.sin(angle))
    problem.minimize(running=ca.cos(angle))
    return problem


def test_the_wrong_branch_of_a_heading_is_no_extremal() -> None:
    seed = solve(compass(), Collocation(10), guess={"angle": 3.0})
    right = solve(compass(), Indirect(), guess=seed)
    assert right.cost == pytest.approx(-1, abs=1e-10)
    np.testing.assert_allclose(right["angle"], np.pi, atol=1e-9)
    curve = seed.control_interpolant
    turned = replace(
        seed, controls={"angle": 0 * seed["angle"]}, control_interpolant=replace(curve, values=0 * curve.values)
    )
    with pytest.raises(SolveError, match="stationary but not minimal in control 'angle' at 0 s"):
        solve(compass(), Indirect(), guess=turned)


@pytest.mark.long
def test_costates_of_the_wrong_sign_are_mended_or_fail_with_words() -> None:
    case = EXTREMA["heading"]
    seed = solve(case.build(), case.direct, parameters=case.parameters)
    turned = replace(seed, costates={"x": -seed.costates["x"]})
    mended = solve(case.build(), Indirect(), parameters=case.parameters, guess=turned)
    assert mended.cost == pytest.approx(seed.cost, abs=1e-9)
    curve = seed.control_interpolant
    uphill = replace(
        turned,
        controls={"angle": seed["angle"] + np.pi},
        control_interpolant=replace(curve, values=curve.values + np.pi),
    )
    with pytest.raises(SolveError, match="the indirect method failed"):
        solve(case.build(), Indirect(), parameters=case.parameters, guess=uphill)
    assert not solve(case.build(), Indirect(), parameters=case.parameters, guess=uphill, check=False).success


def test_a_horizon_held_by_its_bound_is_not_passed_over() -> None:
    """Bolza: the best horizon is 1/sqrt 2, beyond the upper bound 1/2."""
    problem, x, u = plant("short", initial=0.0, terminal=1.0, u={"guess": 1.0}, horizon=None)
    horizon = problem.horizon(lower=0.1, upper=0.5, guess=0.4)
    problem.dynamics(x, u)
    problem.minimize(running=u**2 / 2, terminal=horizon)
    with pytest.raises(SolveError, match=r"horizon is 0\.707107 s, outside its bounds 0\.1 to 0\.5 s"):
        solve(problem, Indirect())


@pytest.mark.parametrize("bounds", [{"lower": 0.1, "upper": np.sqrt(0.5)}, {"lower": np.sqrt(0.5), "upper": 5.0}])
def test_bounds_at_the_best_horizon_leave_it_as_it_is(bounds: dict[str, float]) -> None:
    problem, x, u = plant("at its bound", initial=0.0, terminal=1.0, u={"guess": 1.0}, horizon=None)
    horizon = problem.horizon(**bounds, guess=sum(bounds.values()) / 2)
    problem.dynamics(x, u)
    problem.minimize(running=u**2 / 2, terminal=horizon)
    assert solve(problem, Indirect()).horizon == pytest.approx(np.sqrt(0.5), rel=1e-9)


def stiff(shove: float) -> Problem:
    problem, x, u = plant("stiff", size=2, initial=[1.0, 0.0], horizon=10.0)
    problem.dynamics(x, ca.vertcat(x[1], shove * (1 - x[0] ** 2) * x[1] - x[0] + u))
    problem.minimize(running=(ca.sumsqr(x) + u**2) / 2)
    return problem


@pytest.mark.long
@pytest.mark.parametrize("shooting", ["multiple", "backward"])
def test_newton_from_a_bad_guess_reports_failure_with_its_last_iterate(
    shooting: str, capfd: pytest.CaptureFixture[str]
) -> None:
    guess = solve(stiff(0.0), Collocation(5))
    by = Indirect(segments=1, shooting=shooting)
    with pytest.raises(SolveError, match=r"problem 'stiff': the indirect method failed:.*Newton") as caught:
        solve(stiff(8.0), by, guess=guess)
    assert caught.value.solution is not None
    unsolved = solve(stiff(8.0), by, guess=guess, check=False)
    assert not unsolved.success
    assert not unsolved.message.startswith("Converged")
    assert capfd.readouterr().err == ""


def test_a_guess_that_is_not_finite_is_a_failure_with_words() -> None:
    seed = solve(van_der_pol(), Collocation(5))
    broken = replace(seed, costates={"x": seed.costates["x"] * np.nan})
    with pytest.raises(SolveError, match="the integration fails at the seed"):
        solve(van_der_pol(), Indirect(), guess=broken)
    assert not solve(van_der_pol(), Indirect(), guess=broken, check=False).success


def unreachable() -> Problem:
    problem, x, u = plant("unreachable", initial=0.0, terminal=10.0, u={"lower": -1, "upper": 1})
    problem.dynamics(x, u)
    problem.minimize(running=u**2)
    return problem


def test_a_failure_of_its_own_seed_is_named_as_such() -> None:
    with pytest.raises(SolveError, match=r"direct solution for its seed failed: problem 'unreachable': ipopt"):
        solve(unreachable(), Indirect())
    unsolved = solve(unreachable(), Indirect(), check=False)
    assert not unsolved.success
    assert "seed" in unsolved.message


def test_a_plan_that_nothing_determines_is_an_extremal_with_a_word() -> None:
    """A cycle without a drive may stand still anywhere: Newton's matrix is singular at a root."""
    problem, x, u = plant("anywhere", size=2, horizon=2.0)
    problem.dynamics(x, ca.vertcat(x[1], u))
    problem.end("cyclic", x - problem.at_start(x), 0, 0)
    problem.minimize(running=u**2 / 2)
    solution = solve(problem, Indirect())
    assert solution.cost == pytest.approx(0, abs=1e-12)
    assert "not unique" in solution.message
