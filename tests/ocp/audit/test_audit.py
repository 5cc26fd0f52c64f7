"""The audit: good plans of every method pass, and every kind of wrong one is found where it is wrong."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cache
from itertools import pairwise
from typing import Any

import casadi as ca
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ocp import Audit, Collocation, MultipleShooting, Problem, ProblemError, Solution, solve
from ocp.curves import PiecewisePolynomial
from ocp.errors import SolverStatus
from tests.ocp.problems import (
    SWING,
    Array,
    LogarithmicRegulator,
    Method,
    double_integrator,
    energy,
    plant,
    swing,
    van_der_pol,
)

pytestmark = pytest.mark.xdist_group("audits")  # one process, so that every plan is solved once

FINE: dict[str, Method] = {
    "radau": Collocation(20),
    "radau-held": Collocation(60, control="held"),
    "legendre": Collocation(20, scheme="legendre"),
    "legendre-held": Collocation(60, scheme="legendre", control="held"),
    "rk4-held": MultipleShooting(60),
    "rk4-linear": MultipleShooting(60, control="linear"),
    "cvodes-linear": MultipleShooting(20, integrator="cvodes", steps=3, control="linear"),
}
INTEGRATION = "integration error, relative"
COST = "cost, relative"
LOST = "cost lost, relative"
EQUATION = "costate equation, relative"
BETWEEN = "costates between the nodes, relative"
CURVATURE = "curvature downwards, relative"
STATIONARITY = "stationarity, relative"
DRIFT = "Hamiltonian drift, relative"


@cache
def plan(method: str) -> Solution:
    return solve(van_der_pol(), FINE[method])


def failed(audit: Audit) -> set[str]:
    """Names of the findings beyond their limits."""
    feasible, optimal = (
        all(f.passed for f in audit.findings if f.verdict == verdict) for verdict in ("feasible", "optimal")
    )
    assert {finding.verdict for finding in audit.findings} == {"feasible", "optimal"}
    assert audit.feasible is feasible
    assert audit.optimal is (False if not optimal else None if audit.undecided else True)
    assert audit.passed is (feasible and audit.optimal is True)
    return {finding.name for finding in audit.failures}


every_method = pytest.mark.parametrize("method", FINE)


# ---- what passes -------------------------------------------------------------------------------------------------


@every_method
def test_good_plans_pass(method: str) -> None:
    audit = plan(method).audit()
    assert failed(audit) == set()
    assert audit.integration_error < 1e-3
    assert audit.local_errors.shape == (FINE[method].intervals,)
    assert audit.local_errors.max() < 1e-3
    assert audit.passed
    assert audit.lost.shape == (FINE[method].intervals,)
    assert (audit.lost >= 0).all()


@every_method
def test_the_feasibility_alone_has_the_findings_of_the_whole_audit(method: str) -> None:
    for solution in (plan(method), TAMPERED["states shifted"][0](plan(method))):
        whole, part = solution.audit(), solution.audit(only_feasible=True)
        assert part.findings == tuple(f for f in whole.findings if f.verdict == "feasible")
        assert part.feasible is whole.feasible
        assert (part.optimal, part.passed, part.lost.size) == (None, False, 0)
        assert "optimal: not decided" in str(part)


@every_method
def test_the_reported_loss_is_the_excess_over_the_optimum(method: str) -> None:
    best = solve(van_der_pol(), Collocation(60, 5, "legendre")).cost
    solution = plan(method)
    assert solution.audit().lost.sum() == pytest.approx(solution.cost - best, rel=0.05, abs=2e-6 * best)


@pytest.mark.parametrize("solver", ["ipopt", "fatrop"])
def test_a_plan_with_everything_in_it_passes(solver: str) -> None:
    audit = solve(swing(), Collocation(40), parameters=SWING, solver=solver).audit()
    assert failed(audit) == set()
    assert set(audit.constraints) == {"x", "w", "u", "b", "speed", "place", "balance", "push", "cyclic"}


@every_method
def test_a_plan_without_cost_is_optimal_if_it_is_feasible(method: str) -> None:
    problem, x, u = plant("indifferent", initial=1.0, terminal=0.0, u={"lower": -3.0, "upper": 3.0})
    problem.dynamics(x, u)
    assert failed(solve(problem, FINE[method]).audit()) == set()


@every_method
def test_a_plan_without_control_passes(method: str) -> None:
    problem = Problem("falling")
    x = problem.state("x", 2, initial=[1.0, 0.0])
    problem.dynamics(x, ca.vertcat(x[1], -ca.sin(x[0])))
    problem.horizon(2.0)
    problem.minimize(running=ca.sumsqr(x))
    assert failed(solve(problem, FINE[method]).audit()) == set()


@every_method
def test_the_reintegrated_plan_is_that_of_another_integrator(method: str) -> None:
    """scipy integrates the controls of the plan once more."""
    from scipy.integrate import solve_ivp

    solution = plan(method)
    audit = solution.audit()
    mesh = solution.control_interpolant.breaks * solution.horizon
    state = solution["x"][0]
    for k, (a, b) in enumerate(pairwise(mesh)):

        def rate(t: float, y: Array, k: int = k, a: float = a, b: float = b) -> list[float]:
            place = np.clip(np.array([(t - a) / (b - a)]), 0.0, 1.0)
            u = solution.control_interpolant.within(np.array([k]), place)[0, 0]
            return [y[1], (1 - y[0] ** 2) * y[1] - y[0] + u]

        state = solve_ivp(rate, (a, b), state, rtol=1e-10, atol=1e-12).y[:, -1]
    np.testing.assert_allclose(audit.states["x"][-1], state, atol=1e-8)


@given(unit=st.floats(-6.0, 6.0), time=st.floats(-2.0, 3.0))
@settings(max_examples=15)
def test_the_verdict_does_not_depend_on_units(unit: float, time: float) -> None:
    """Distances of a micrometre to a thousand kilometres, 10 ms to a quarter of an hour."""
    unit, time = 10.0**unit, 10.0**time

    def scaled(terminal: float) -> Problem:
        problem = Problem("in other units")
        q = problem.state("q", initial=0.0, terminal=terminal * unit)
        v = problem.state("v", initial=0.0, terminal=0.0)
        u = problem.control("u")
        problem.dynamics(q, v)
        problem.dynamics(v, u * unit / time**2)
        problem.horizon(time)
        problem.minimize(running=u**2 / (2 * time))
        return problem

    solution = solve(scaled(1.0), Collocation(6))
    assert failed(solution.audit()) == set()
    values = solution.control_interpolant.values.copy()
    values[0] *= 1.2  # where the control is largest: 1.4e-2 of the cost are lost
    bad = replace(solution, control_interpolant=replace(solution.control_interpolant, values=values))
    assert {INTEGRATION, LOST} <= failed(bad.audit())
    assert "end of q" in failed(solution.audit(scaled(1.1)))


# ---- what is tampered with ---------------------------------------------------------------------------------------


def edited(curve: PiecewisePolynomial, edit: Callable[[Array], Any]) -> PiecewisePolynomial:
    values = curve.values.copy()
    edit(values)
    return replace(curve, values=values)


def add(amount: float, *where: Any) -> Callable[[Array], None]:
    def edit(values: Array) -> None:
        values[where if where else ...] += amount

    return edit


def scale(factor: float, *where: Any) -> Callable[[Array], None]:
    def edit(values: Array) -> None:
        values[where if where else ...] *= factor

    return edit


def states(edit: Callable[[Array], None]) -> Callable[[Solution], Solution]:
    return lambda s: replace(s, state_interpolant=edited(s.state_interpolant, edit))


def controls(edit: Callable[[Array], None]) -> Callable[[Solution], Solution]:
    return lambda s: replace(s, control_interpolant=edited(s.control_interpolant, edit))


JUMP, REPORTED = "state jump, relative", "reported values, relative"
TAMPERED: dict[str, tuple[Callable[[Solution], Solution], set[str]]] = {
    "states shifted": (states(add(0.05)), {INTEGRATION, "start of x"}),
    "one state node shifted": (states(add(0.05, 7, 1)), {INTEGRATION}),
    "a jump between intervals": (states(add(0.2, slice(10, None), slice(None), 0)), {INTEGRATION, JUMP}),
    "control of one interval shifted": (controls(add(0.3, 7)), {INTEGRATION, LOST}),
    "all controls scaled": (controls(scale(1.1)), {INTEGRATION, LOST}),
    "control nan": (controls(add(np.nan, 5)), {INTEGRATION, COST, LOST, EQUATION, BETWEEN}),
    "control infinite": (controls(add(np.inf, 5)), {INTEGRATION, COST, LOST, EQUATION, BETWEEN}),
    "state nan": (states(add(np.nan, 5)), {INTEGRATION, LOST, EQUATION, BETWEEN}),
    "state nan at the start": (states(add(np.nan, 0)), {INTEGRATION, LOST, EQUATION, BETWEEN}),
    "cost one per cent better": (lambda s: replace(s, cost=0.99 * s.cost), {COST}),
    "cost of other sign": (lambda s: replace(s, cost=-s.cost), {COST}),
    "cost nan": (lambda s: replace(s, cost=np.nan), {COST}),
    "horizon longer": (lambda s: replace(s, horizon=1.1 * s.horizon, t=1.1 * s.t), {INTEGRATION, COST, "horizon"}),
    "reported states shifted": (lambda s: replace(s, states={"x": s["x"] + 0.05}), {REPORTED}),
    "reported control shifted": (lambda s: replace(s, controls={"u": s["u"] + 0.05}), {REPORTED}),
    "reported state nan": (lambda s: replace(s, states={"x": s["x"] * np.nan}), {REPORTED}),
    "reported costates shifted": (lambda s: replace(s, costates={"x": s.costate("x") + 0.1}), {REPORTED}),
}  # fmt: skip


@every_method
@pytest.mark.parametrize("how", TAMPERED)
def test_tampered_plans_fail_where_they_are_wrong(method: str, how: str, capfd: pytest.CaptureFixture[str]) -> None:
    tamper, expected = TAMPERED[how]
    assert expected <= failed(tamper(plan(method)).audit())
    capfd.readouterr()  # the integrator complains of what is not a number


@every_method
@pytest.mark.parametrize("factor", [0.0, -1.0, 1.2, np.nan])
def test_wrong_costates_fail(method: str, factor: float) -> None:
    solution = plan(method)
    wrong = replace(
        solution,
        costates={"x": factor * solution.costate("x")},
        costate_interpolant=edited(solution.costate_interpolant, scale(factor)),
    )
    audit = wrong.audit()
    assert failed(audit) & {LOST, EQUATION}
    assert audit.feasible is bool(np.isfinite(factor))
    assert audit.optimal is False


@every_method
def test_a_plan_that_its_solver_does_not_call_solved_is_not_decided(method: str) -> None:
    audit = replace(plan(method), success=False, status=SolverStatus.RESTORATION_FAILED).audit()
    assert failed(audit) == set()
    assert audit.feasible
    assert audit.optimal is None
    assert not audit.passed
    assert audit.undecided == "the solver says Restoration_Failed"


def test_a_costate_that_no_control_sees_is_checked_by_its_own_equation() -> None:
    """With time in the cost the Hamiltonian may change, and the costate of q does not enter stationarity."""
    problem = energy()
    problem.declared.running = problem.declared.running + problem.time * problem.declared.states["q"].symbol
    solution = solve(problem, Collocation(8))
    assert failed(solution.audit()) == set()
    wrong = replace(
        solution,
        costates={**solution.costates, "q": 1.2 * solution.costate("q")},
        costate_interpolant=edited(solution.costate_interpolant, scale(1.2, slice(None), slice(None), 0)),
    )
    assert EQUATION in failed(wrong.audit())


# ---- plans for another problem -----------------------------------------------------------------------------------


@every_method
def test_a_wrong_start_or_end_fails_by_name(method: str) -> None:
    assert "start of x" in failed(plan(method).audit(van_der_pol(initial=(1.05, 0.0))))
    assert "end of x" in failed(plan(method).audit(van_der_pol(terminal=[0.5, np.nan])))


@every_method
def test_a_plan_to_a_fixed_end_is_no_optimum_of_a_free_end(method: str) -> None:
    """Stationary, with a constant Hamiltonian, and yet no extremal: transversality tells."""
    pinned = solve(van_der_pol(terminal=[0.2, np.nan]), FINE[method])
    assert failed(pinned.audit()) == set()
    assert failed(pinned.audit(van_der_pol())) == {"transversality, relative"}


@every_method
@pytest.mark.parametrize("duration", [0.5, 1.0, 1.5])
def test_a_plan_of_another_duration_is_no_optimum_of_a_free_time(method: str, duration: float) -> None:
    """Bolza's problem has its optimum at 1/sqrt 2 s."""

    def bolza(*fixed: float) -> Problem:
        problem, x, u = plant("Bolza", initial=0.0, terminal=1.0, u={"guess": 1.0}, horizon=None)
        horizon = problem.horizon(*fixed) if fixed else problem.horizon(lower=0.1, upper=5.0, guess=1.0)
        problem.dynamics(x, u)
        problem.minimize(running=u**2 / 2, terminal=horizon)
        return problem

    assert failed(solve(bolza(), FINE[method]).audit()) == set()
    plan_of = solve(bolza(duration), FINE[method])
    assert failed(plan_of.audit()) == set()
    assert failed(plan_of.audit(bolza())) == {LOST, "condition of the free horizon, relative"}


@every_method
def test_a_feasible_plan_that_is_not_optimal_fails_by_the_minimum_principle_alone(method: str) -> None:
    prescribed = van_der_pol()
    u = prescribed.declared.controls["u"].symbol
    prescribed.path("prescribed", u - ca.sin(3 * prescribed.time), 0, 0)
    result = failed(solve(prescribed, FINE[method]).audit(van_der_pol()))
    assert LOST in result
    assert not result & {INTEGRATION, COST, "start of x", "state jump, relative"}


def test_a_different_cost_is_detected() -> None:
    other = van_der_pol()
    other.declared.running = other.declared.running + 0.2 * other.declared.controls["u"].symbol ** 2
    assert {COST, LOST} <= failed(plan("radau").audit(other))


def test_different_dynamics_are_detected() -> None:
    other = van_der_pol()
    x = other.declared.states["x"].symbol
    other.declared.dynamics["x"] = other.declared.dynamics["x"] + ca.vertcat(0, 0.1 * x[1])
    assert INTEGRATION in failed(plan("legendre").audit(other))


@pytest.mark.parametrize("method", ["radau", "rk4-held"])
def test_a_violated_bound_is_detected(method: str) -> None:
    audit = plan(method).audit(van_der_pol(upper=0.5))
    assert "bounds of u" in failed(audit)
    excess = plan(method)["u"].max() - 0.5
    assert audit.constraints["u"] == pytest.approx(excess, abs=1e-2)
    assert audit["bounds of u"].time == pytest.approx(plan(method).t[np.argmax(plan(method)["u"])], abs=0.1)


# ---- between the nodes -------------------------------------------------------------------------------------------


@pytest.mark.parametrize("scheme", ["radau", "legendre"])
def test_a_control_that_overshoots_its_bound_between_points_fails(scheme: str) -> None:
    """Polynomials over a switch: inside the bounds at every point, outside between them."""
    problem, *_ = double_integrator("minimum time", horizon=None, limit=1.0)
    problem.minimize(terminal=problem.horizon(lower=0.5, upper=5.0, guess=2.5))
    solution = solve(problem, Collocation(5, 4, scheme))
    assert np.abs(solution.control_interpolant.values).max() <= 1.0
    audit = solution.audit()
    assert "bounds of u" in failed(audit)
    assert audit.constraints["u"] > 0.05


def round_a_disc(intervals: int, margin: float = 0.0) -> Solution:
    """A point that passes a disc of radius 1/2: on a coarse mesh it cuts across between the nodes."""
    problem = Problem("disc")
    x = problem.state("x", 2, initial=[0.0, 0.0], terminal=[2.0, 0.0], guess=lambda t: [t, 0.8 * np.sin(np.pi * t / 2)])
    u = problem.control("u", 2)
    problem.dynamics(x, u)
    problem.horizon(2.0)
    problem.path("disc", ca.sumsqr(x - ca.DM([1.0, 0.0])), lower=(0.5 + margin) ** 2)
    problem.minimize(running=ca.sumsqr(u))
    return solve(problem, MultipleShooting(intervals))


def test_a_constraint_that_is_cut_between_nodes_fails() -> None:
    solution = round_a_disc(3)
    nodes = np.linalg.norm(solution["x"] - [1.0, 0.0], axis=1)
    assert nodes.min() >= 0.5 - 1e-8
    audit = solution.audit()
    assert "disc" in failed(audit)
    nearest = np.linalg.norm(audit.states["x"] - [1.0, 0.0], axis=1).min()
    assert audit.constraints["disc"] == pytest.approx(0.25 - nearest**2, abs=1e-3)
    assert "disc" not in failed(round_a_disc(100).audit())


def test_a_plan_that_jumps_over_a_singularity_fails() -> None:
    """x' = u, but the optimum would leave through 1/x: the coarse plan steps from one side to the other."""
    problem, x, u = plant("pole", initial=-1.0, terminal=1.0)
    problem.dynamics(x, u)
    problem.path("near", x**2, lower=0.04)
    problem.minimize(running=u**2)
    solution = solve(problem, MultipleShooting(3))
    audit = solution.audit()
    assert solution.success
    assert "near" in failed(audit)


def test_unstable_dynamics_on_a_coarse_mesh_fail() -> None:
    problem, x, u = plant("unstable", initial=0.01, horizon=2.0)
    problem.dynamics(x, 12 * x + u)
    problem.minimize(running=x**2 + u**2)
    assert INTEGRATION in failed(solve(problem, Collocation(4, 2)).audit())


def test_a_breakdown_of_the_integrator_is_reported(capfd: pytest.CaptureFixture[str]) -> None:
    """x' = x^2 + u escapes to infinity before the end when its control is taken away."""
    problem, x, u = plant("escape", initial=1.0, horizon=2.0)
    problem.dynamics(x, x**2 + u)
    problem.minimize(running=x**2 + 0.1 * u**2)
    solution = solve(problem, Collocation(10))
    assert failed(solution.audit()) == set()
    audit = controls(scale(0.0))(solution).audit()
    assert {INTEGRATION, COST} <= failed(audit)
    assert audit[INTEGRATION].value == np.inf
    assert "the integration broke down at" in audit[INTEGRATION].note
    assert "FAILED" in str(audit)
    capfd.readouterr()


# ---- the table, limits and names ---------------------------------------------------------------------------------


def test_the_table_shows_every_finding_under_its_verdict() -> None:
    audit = plan("radau").audit()
    lines = str(audit).splitlines()
    assert lines[0] == "Audit of 'van der Pol': passed"
    by_verdict = [[f for f in audit.findings if f.verdict == verdict] for verdict in ("feasible", "optimal")]
    at = 1
    for verdict, findings in zip(("feasible", "optimal"), by_verdict, strict=True):
        assert lines[at].split() == [f"{verdict}:", "yes", "value", "limit", "unit", "at,", "s"]
        for line, finding in zip(lines[at + 1 :], findings, strict=False):
            assert line.startswith(f"  {finding.name} ")
            assert f"{finding.value:.2e}" in line
            assert (" ok" in line) == (finding.limit is not None)
            assert line == line.rstrip()
        at += 1 + len(findings)
    assert len(lines) == at + 1
    assert lines[-1].startswith("The plan may be run; no better motion is near it")
    assert "reported 1.047" in str(audit)


@pytest.mark.parametrize(
    ("how", "marked", "titles", "sentence"),
    [
        (lambda s: s.audit(), set(), ("yes", "yes"), "may be run; no better motion is near it"),
        (
            lambda s: replace(s, success=False, status=SolverStatus.RESTORATION_FAILED).audit(),
            set(),
            ("yes", "not decided"),
            "may be run; whether it is a local minimum is not decided: the solver says Restoration_Failed.",
        ),
        (
            lambda s: s.audit(lost=0.0),
            {LOST},
            ("yes", "NO"),
            "may be run, but is no local minimum: cost lost, relative is",
        ),
        (
            lambda s: replace(s, cost=2 * s.cost).audit(),
            {COST},
            ("NO", "yes"),
            "must not be run: cost, relative is 0.5,",
        ),
    ],
    ids=["good", "not solved", "not optimal", "not feasible"],
)
def test_the_table_ends_with_the_verdict(
    how: Callable[[Solution], Audit], marked: set[str], titles: tuple[str, str], sentence: str
) -> None:
    audit = how(plan("radau"))
    lines = str(audit).splitlines()
    assert lines[0].endswith({("yes", "yes"): "passed", ("yes", "not decided"): "not decided"}.get(titles, "FAILED"))
    names = {f.name for f in audit.findings for line in lines if line.startswith(f"  {f.name} ") and "FAILED" in line}
    assert names == marked == failed(audit)
    for title, verdict in zip(titles, ("feasible", "optimal"), strict=True):
        assert [line for line in lines if line.startswith(f"  {verdict}: {title} ")]
    assert f"The plan {sentence}" in lines[-1]


def test_findings_are_found_by_name() -> None:
    audit = plan("radau").audit()
    assert audit[LOST].passed
    with pytest.raises(ProblemError, match=r"finding 'integratoin' does not exist"):
        audit["integratoin"]


def test_limits_of_the_audit_are_those_requested() -> None:
    solution = plan("rk4-linear")
    assert failed(solution.audit(integration=1e-12)) >= {INTEGRATION}
    assert failed(solution.audit(lost=1e-12)) == {LOST}
    assert EQUATION in failed(solution.audit(costates=1e-12))
    assert solution.audit()[STATIONARITY].limit is None
    assert solution.audit()[DRIFT].limit is None
    coarse = round_a_disc(3)
    assert "disc" not in failed(coarse.audit(constraints=1e6))
    assert "disc" not in failed(coarse.audit(tolerances={"disc": 1.0}))
    assert coarse.audit(tolerances={"disc": 0.015})["disc"].limit == 0.015
    assert "disc" in failed(coarse.audit(tolerances={"disc": 0.0}))


def test_an_exact_optimum_passes_strict_limits() -> None:
    solution = solve(LogarithmicRegulator(2.0).build(), Collocation(24, 5, "legendre"))
    limits = {"integration": 1e-7, "constraints": 1e-7, "lost": 1e-9}
    strict = solution.audit(**limits, costates=1e-6)
    assert failed(strict) == set()
    assert max(strict[STATIONARITY].value, strict[DRIFT].value) < 1e-6


@pytest.mark.parametrize(
    "settings_",
    [
        {"integration": "a"},
        {"integration": -1.0},
        {"constraints": np.nan},
        {"lost": None},
        {"lost": np.nan},
        {"lost": True},
        {"costates": -1.0},
        {"costates": [1.0]},
        {"tolerances": {"x": "a"}},
        {"tolerances": {"x": -1.0}},
        {"tolerances": {"y": 1.0}},
        {"tolerances": {"X": 1.0}},
        {"tolerances": 3},
        {"tolerances": [("x", 1.0)]},
    ],
)
def test_bad_limits_are_named(settings_: dict[str, Any]) -> None:
    with pytest.raises(ProblemError, match="tolerance"):
        plan("radau").audit(**settings_)


@pytest.mark.parametrize("problem", [energy, lambda: swing()])
def test_a_plan_of_another_problem_is_refused(problem: Callable[[], Problem]) -> None:
    with pytest.raises(ProblemError, match="plan 'van der Pol' has states"):
        plan("radau").audit(problem())
    more = van_der_pol()
    more.parameter("extra")
    with pytest.raises(ProblemError, match="parameter 'extra' has no value"):
        plan("radau").audit(more)
    wide = van_der_pol()
    wide.control("extra", 2)
    with pytest.raises(ProblemError, match="has controls"):
        plan("radau").audit(wide)


def test_auditing_changes_nothing() -> None:
    solution = plan("radau")
    before = solution.variables.copy()
    first, second = solution.audit(), solution.audit()
    assert str(first) == str(second)
    np.testing.assert_array_equal(solution.variables, before)


HELD_MIXED = [MultipleShooting(40), MultipleShooting(320), Collocation(40, control="held")]


@pytest.mark.parametrize("method", HELD_MIXED, ids=str)
def test_a_held_control_that_keeps_a_mixed_constraint_all_along_loses_its_excess(method: Any) -> None:
    """It may not follow the constraint inside its interval: of 40 each costs 5.5e-3 more, of 320 each 6.2e-4."""
    problem, q, _, u = double_integrator("mixed")
    problem.path("mixed", u - 4 * q, upper=3.0)
    problem.minimize(running=u**2 / 2)
    solution = solve(problem, method)
    excess = solution.cost - solve(problem, Collocation(200)).cost
    audit = solution.audit()
    assert audit.lost.sum() == pytest.approx(excess, rel=0.03)
    assert audit.feasible
    assert audit.passed is (method.intervals == 320), str(audit)


# ---- what belongs to a plan ------------------------------------------------------------------------------------------


def lifted(horizon: float, order: str = "ab", **free: Any) -> Problem:
    """Two integrators from 0 to 1 and to 2, declared in an order, at the least integral of squared rates."""
    problem = Problem("lifted")
    ends = {"a": 1.0, "b": 2.0}
    states = {name: problem.state(name, initial=0.0, terminal=ends[name]) for name in order}
    rates = {name: problem.control(f"rate of {name}") for name in order}
    for name in order:
        problem.dynamics(states[name], rates[name])
    problem.horizon(**free) if free else problem.horizon(horizon)
    problem.minimize(sum(rate**2 for rate in rates.values()))
    return problem


@pytest.mark.parametrize(
    ("requested", "free", "passes"),
    [(1.0, {}, False), (2.0, {}, True), (0.0, {"lower": 1.0, "upper": 2.0}, True), (0.0, {"upper": 1.9}, False)],
    ids=["shorter", "its own", "at its bound", "beyond its bound"],
)
def test_a_plan_of_another_horizon_fails(requested: float, free: dict[str, Any], passes: bool) -> None:
    plan = solve(lifted(2.0), Collocation(10))
    audit = plan.audit(lifted(requested, **free))
    assert audit["horizon"].passed is passes
    assert audit.passed is passes


@pytest.mark.parametrize("broken", [{"horizon": 3.0}, {"t": np.linspace(0.0, 1.5, 31)}], ids=["horizon", "times"])
def test_times_that_do_not_end_at_the_horizon_fail(broken: dict[str, Any]) -> None:
    plan = solve(lifted(1.0), Collocation(10))
    assert not replace(plan, **broken).audit()["horizon"].passed


def test_a_plan_is_read_by_the_names_of_its_states() -> None:
    plan = solve(lifted(1.0, "ab"), Collocation(10))
    assert plan.audit(lifted(1.0, "ba")).passed
    swapped = lifted(1.0, "ba")
    swapped.end(
        "the other way round", ca.vertcat(*(v.symbol for v in swapped.declared.states.values())), [1, 2], [1, 2]
    )
    assert not plan.audit(swapped).passed


@pytest.mark.parametrize(
    ("field", "change", "part"),
    [
        ("t", lambda t: t[::-1], "t"),
        ("horizon", lambda _: np.nan, "horizon"),
        ("success", lambda _: "no", "success"),
        ("cost", lambda _: "cheap", "cost"),
        ("states", lambda pool: {name: values[1:] for name, values in pool.items()}, "state 'a'"),
        ("states", lambda pool: {name: values[:, 0] for name, values in pool.items()}, "state 'a'"),
        ("states", lambda pool: {name: values + 0j for name, values in pool.items()}, "state 'a'"),
        ("state_interpolant", lambda curve: replace(curve, breaks=curve.breaks / 2), "state_interpolant.breaks"),
        ("control_interpolant", lambda curve: replace(curve, nodes=curve.nodes[::-1]), "control_interpolant.nodes"),
        ("costate_interpolant", lambda curve: replace(curve, values=curve.values[1:]), "costate_interpolant.values"),
        ("costates", lambda pool: {"a": pool["a"]}, "costates"),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_a_plan_that_is_not_whole_is_refused_by_the_name_of_the_part(field: str, change: Any, part: str) -> None:
    problem = lifted(1.0)
    plan = solve(problem, Collocation(10))
    broken: dict[str, Any] = {field: change(getattr(plan, field))}
    with pytest.raises(ProblemError) as caught:
        replace(plan, **broken).audit(problem)
    assert caught.value.name == part
