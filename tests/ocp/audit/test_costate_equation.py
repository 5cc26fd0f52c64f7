"""The audit's costate equation and end conditions: closed forms pass, tampered costates do not."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from typing import Any

import casadi as ca
import numpy as np
import pytest

from ocp import Audit, Collocation, Indirect, MultipleShooting, Problem, Solution, solve
from ocp.curves import PiecewisePolynomial
from tests.ocp.indirect.extremals import EXTREMA
from tests.ocp.problems import SOLVERS, Method, energy, plant, started_anywhere, van_der_pol

pytestmark = pytest.mark.xdist_group("costate equation")  # one process, so that every plan is solved once

LOST, EQUATION, ENDS, HORIZON = (
    "cost lost, relative",
    "costate equation, relative",
    "transversality, relative",
    "condition of the free horizon, relative",
)

DIRECT: dict[str, Method] = {
    "radau": Collocation(30),
    "legendre": Collocation(30, scheme="legendre"),
    "radau-held": Collocation(60, control="held"),
    "rk4-linear": MultipleShooting(60, steps=2, control="linear"),
    "rk4-held": MultipleShooting(60, steps=2),
}
every_method = pytest.mark.parametrize("method", DIRECT)
both_solvers = pytest.mark.parametrize("solver", SOLVERS)


@cache
def free_end(method: str, solver: str = "ipopt") -> Solution:
    return solve(started_anywhere(1.5), DIRECT[method], parameters={"x0": [0.8, -0.3]}, solver=solver)


def bolza(**ends: Any) -> Problem:
    """x' = u, x: 0 -> 1 in a free time, min T + int u^2/2: T = 1/sqrt 2, H = -1."""
    problem, x, u = plant("Bolza", initial=0.0, **ends, u={"guess": 1.0}, horizon=None)
    horizon = problem.horizon(lower=0.1, upper=5.0, guess=1.0)
    problem.dynamics(x, u)
    problem.minimize(running=u**2 / 2, terminal=horizon)
    return problem


def tampered(solution: Solution, change: Any) -> Solution:
    """The plan with costates changed: ``change`` takes fractions (M, 1) and costates (M, nx) stacked."""
    old = solution.costate_interpolant
    places = (old.breaks[:-1, None] + np.diff(old.breaks)[:, None] * old.nodes)[..., None]
    values = change(places, old.values)
    fractions = (solution.t / solution.horizon)[:, None]
    stacked = change(fractions, np.hstack(list(solution.costates.values())))
    cuts = np.cumsum([v.shape[1] for v in solution.costates.values()])[:-1]
    names = dict(zip(solution.costates, np.split(stacked, cuts, axis=1), strict=True))
    return replace(solution, costates=names, costate_interpolant=PiecewisePolynomial(old.breaks, old.nodes, values))


def failed(audit: Audit) -> set[str]:
    return {finding.name for finding in audit.failures}


@both_solvers
@every_method
def test_costates_of_direct_solutions_obey_their_own_equation(method: str, solver: str) -> None:
    audit = free_end(method, solver).audit()
    assert audit.passed, str(audit)
    assert audit[EQUATION].value < 2e-3
    assert audit[ENDS].value < 1e-6


def test_the_integrated_costates_converge_with_the_mesh() -> None:
    """Radau-3 costates are of fifth order at the nodes; three halvings gain well over a factor of a hundred."""
    errors = []
    for n in (4, 8, 16, 32):
        plan = solve(started_anywhere(1.5), Collocation(n), parameters={"x0": [0.8, -0.3]})
        errors.append(plan.audit().optimality.adjoint.total)
    assert np.all(np.diff(errors) < 0)
    assert errors[-1] < errors[0] / 100


def test_the_integrated_costates_are_the_closed_form() -> None:
    """Double integrator, least energy: lambda = (-12, 12 t - 6)."""
    optimality = solve(energy(), Collocation(10)).audit().optimality
    adjoint, t = optimality.adjoint, optimality.t
    np.testing.assert_allclose(adjoint.costate, np.column_stack([-12 + 0 * t, 12 * t - 6]), atol=1e-8)
    np.testing.assert_allclose(adjoint.t, np.linspace(0, 1, 11), atol=1e-12)
    assert adjoint.error == pytest.approx(0, abs=1e-8)
    assert adjoint.between == pytest.approx(0, abs=1e-8)
    assert adjoint.ends.transversality == pytest.approx(0, abs=1e-8)
    assert adjoint.ends.horizon == 0
    assert not adjoint.control_multipliers.any()
    assert not adjoint.state_multipliers.any()


def test_an_error_of_a_costate_reported_inside_an_interval_is_one_of_this_interval() -> None:
    plan = solve(energy(), Collocation(10))
    fractions = plan.t / plan.horizon
    inside = np.abs(10 * fractions - np.round(10 * fractions)) > 1e-6
    errors = np.arange(1.0, 11.0)
    by_sample = np.where(inside, errors[np.minimum((10 * fractions).astype(int), 9)], 0.0)[:, None]
    costates = {name: values + by_sample for name, values in plan.costates.items()}
    between = replace(plan, costates=costates).audit().optimality.adjoint.between
    assert between[0] > 0
    np.testing.assert_allclose(between / between[0], errors, rtol=1e-6)


@every_method
def test_scaled_shifted_or_perturbed_costates_fail(method: str) -> None:
    plan = free_end(method)
    assert failed(tampered(plan, lambda s, lam: 1.1 * lam).audit()) & {EQUATION, ENDS, LOST}
    shifted = tampered(plan, lambda s, lam: lam + 0.1 * np.max(np.abs(lam))).audit()
    assert ENDS in failed(shifted)
    perturbed = tampered(plan, lambda s, lam: lam + 0.1 * np.max(np.abs(lam)) * np.sin(np.pi * s)).audit()
    assert EQUATION in failed(perturbed)
    assert ENDS not in failed(perturbed)  # both ends are left alone


def test_costates_of_the_other_sign_fail() -> None:
    audit = tampered(solve(van_der_pol(), Collocation(20)), lambda s, lam: -lam).audit()
    assert not audit.passed
    assert EQUATION in failed(audit)


@every_method
def test_costates_are_free_at_fixed_ends_and_the_gradient_of_the_cost_at_free_ends(method: str) -> None:
    options = solve(energy(), DIRECT[method]).audit()
    assert options[ENDS].value == pytest.approx(0, abs=1e-7)
    plan = free_end(method)
    x = plan["x"][-1]
    np.testing.assert_allclose(plan.costate("x")[-1], [4 * x[0], np.cos(x[1])], atol=1e-5)


def constrained(what: str) -> Problem:
    """Two states, an end on a circle or beyond it, a start on a line, or ends tied together."""
    problem = Problem(what)
    x = problem.state("x", 2, initial=None if what in ("line", "cycle") else [0.6, 0.0], guess=[0.5, 0.5])
    u = problem.control("u", 2)
    problem.horizon(1.0)
    problem.dynamics(x, ca.vertcat(x[1] + u[0], u[1] - ca.sin(x[0]) + ca.cos(2 * np.pi * problem.time)))
    if what == "circle":
        problem.end("circle", ca.sumsqr(x), 1.0, 1.0)
    elif what == "beyond":
        problem.end("circle", ca.sumsqr(x), lower=1.0)
    elif what == "slack":
        problem.end("circle", ca.sumsqr(x), upper=100.0)
    elif what == "line":
        problem.start("line", x[0] + 2 * x[1], 1.0, 1.0)
    elif what == "cycle":
        problem.end("cycle", x - problem.at_start(x), 0, 0)
    problem.minimize(running=ca.sumsqr(u) / 2 + (x[0] - 0.5) ** 2, terminal=ca.sumsqr(x) if what != "cycle" else 0)
    return problem


@both_solvers
@pytest.mark.parametrize("what", ["circle", "beyond", "slack", "line", "cycle"])
def test_end_conditions_explain_the_costates_at_the_ends(what: str, solver: str) -> None:
    """And only along their own slopes: a push aside of the circle's is found."""
    plan = solve(constrained(what), Collocation(20), solver=solver)
    audit = plan.audit()
    assert audit.passed, str(audit)
    assert audit[ENDS].value < 1e-6
    size = np.max(np.abs(np.hstack(list(plan.costates.values()))))
    end = plan["x"][-1]
    aside = np.array([-end[1], end[0]]) / np.linalg.norm(end)
    if what in ("circle", "beyond"):
        along = tampered(plan, lambda s, lam: lam + 0.2 * size * s**8 * end / np.linalg.norm(end)).audit()
        assert along[ENDS].value < 1e-6
    sideways = tampered(plan, lambda s, lam: lam + 0.2 * size * s**8 * aside).audit()
    assert ENDS in failed(sideways)


@pytest.mark.parametrize("what", ["line", "cycle"])
def test_conditions_at_the_start_are_checked(what: str) -> None:
    plan = solve(constrained(what), Collocation(20))
    size = np.max(np.abs(plan.costate("x")))
    aside = np.array([2.0, -1.0]) / np.sqrt(5)  # off the slope (1, 2) of the line
    audit = tampered(plan, lambda s, lam: lam + 0.2 * size * (1 - s) ** 8 * aside).audit()
    assert ENDS in failed(audit)


@pytest.mark.parametrize("method", ["radau", "legendre", "radau-held"])
def test_a_path_constraint_active_at_the_end_is_a_condition_there(method: str) -> None:
    """x' = u under a ceiling that it meets at 0.31 s and follows to the end: the costate there is the multiplier's."""
    problem, x, u = plant("ceiling", initial=0.0)
    problem.dynamics(x, u)
    problem.path("ceiling", x, upper=0.6)
    problem.minimize(running=(x - 2 * problem.time) ** 2 + 0.01 * u**2)
    plan = solve(problem, DIRECT[method])
    assert plan["x"][-1, 0] == pytest.approx(0.6, abs=1e-6)
    assert plan.audit()[ENDS].passed


@both_solvers
@every_method
def test_a_free_horizon_balances_the_hamiltonian(method: str, solver: str) -> None:
    plan = solve(bolza(terminal=1.0), DIRECT[method], solver=solver)
    audit = plan.audit()
    assert audit.passed
    assert audit.optimality.adjoint.ends.horizon < 1e-6
    assert plan.horizon == pytest.approx(1 / np.sqrt(2), abs=1e-7)
    wrong = tampered(plan, lambda s, lam: 1.2 * lam).audit()
    assert HORIZON in failed(wrong)
    # H = u^2/2 + 1.2 lambda u, u = sqrt 2 = -lambda, is off by 0.2 * 2, for T
    assert wrong.optimality.adjoint.ends.horizon == pytest.approx(0.4 * plan.horizon, abs=1e-5)


@every_method
def test_a_horizon_at_its_bound_balances_nothing(method: str) -> None:
    """Held at 1/2: H(T) + 1 = 1 - u^2/2 = -1 there."""

    def short(lower: float, upper: float) -> Problem:
        problem, x, u = plant("short", initial=0.0, terminal=1.0, u={"guess": 1.0}, horizon=None)
        horizon = problem.horizon(lower=lower, upper=upper, guess=(lower + upper) / 2)
        problem.dynamics(x, u)
        problem.minimize(running=u**2 / 2, terminal=horizon)
        return problem

    plan = solve(short(0.1, 0.5), DIRECT[method])
    assert plan.horizon == pytest.approx(0.5, abs=1e-6)
    audit = plan.audit()
    assert audit.passed, str(audit)
    assert audit[HORIZON].value < 1e-6
    assert HORIZON in failed(plan.audit(short(0.1, 5.0)))
    other_side = plan.audit(short(plan.horizon, 5.0))  # the bound below would have to pull
    assert HORIZON in failed(other_side)
    assert other_side.feasible


def test_the_end_constraint_may_move_with_the_horizon() -> None:
    """x' = u to the moving target 1 + T: the multiplier enters the balance of the horizon as well."""
    problem, x, u = plant("moving target", initial=0.0, u={"guess": 2.0}, horizon=None)
    horizon = problem.horizon(lower=0.1, upper=5.0, guess=1.0)
    problem.dynamics(x, u)
    problem.end("meet", x - 1 - horizon, 0, 0)
    problem.minimize(running=u**2 / 2, terminal=horizon / 2)
    for by in (Collocation(10), MultipleShooting(10), Indirect()):
        plan = solve(problem, by)
        # u = (1 + T)/T; d/dT of (1 + T)^2 / (2 T) + T/2 vanishes at T = 1/sqrt 2
        assert plan.horizon == pytest.approx(1 / np.sqrt(2), abs=1e-7)
        audit = plan.audit()
        assert audit.passed
        assert audit.optimality.adjoint.ends.horizon < 1e-6
    assert HORIZON in failed(tampered(plan, lambda s, lam: 1.2 * lam).audit())


@pytest.mark.parametrize("upper", [1.2, 5.0], ids=["active", "never active"])
def test_the_costate_equation_is_checked_with_path_constraints(upper: float) -> None:
    problem, x, u = plant("corridor", size=2, initial=[0.0, 0.0], terminal=[1.0, 0.0])
    problem.dynamics(x, ca.vertcat(x[1], u))
    problem.path("speed", x[1], upper=upper)
    problem.minimize(running=u**2 / 2)
    plan = solve(problem, Collocation(20))
    audit = plan.audit()
    assert audit.passed, str(audit)
    adjoint = audit.optimality.adjoint
    pushes = adjoint.state_multipliers[:, -1]  # of the corridor, after those of the bounds of both states
    assert (pushes >= 0).all()
    assert pushes.any() == (upper < 1.5)
    np.testing.assert_allclose(adjoint.costate[:, 1], -plan.control_interpolant(audit.optimality.t)[:, 0], atol=0.02)
    perturbed = tampered(plan, lambda s, lam: lam + 2.0 * np.sin(np.pi * s) * [1.0, 0.0]).audit()
    assert EQUATION in failed(perturbed)


@pytest.mark.parametrize("name", ["everything", "coupled", "mixed", "tabulated"])
def test_costates_of_the_indirect_method_are_taken_to_task_too(name: str) -> None:
    case = EXTREMA[name]
    plan = solve(case.build(), Indirect(), parameters=case.parameters)
    audit = plan.audit()
    assert audit[EQUATION].value < 1e-6
    assert audit[ENDS].value < 1e-7
    size = np.max(np.abs(plan.costate_interpolant.values))
    perturbed = tampered(plan, lambda s, lam: lam + 0.1 * size * np.sin(np.pi * s))
    assert EQUATION in failed(perturbed.audit(costates=1e-2))
    assert not perturbed.audit().passed


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_costates_that_are_no_numbers_fail(value: float) -> None:
    plan = solve(constrained("circle"), Collocation(20))
    audit = tampered(plan, lambda s, lam: lam + np.where(s > 0.5, value, 0.0)).audit()
    assert not audit.passed
    assert {EQUATION, ENDS} <= failed(audit)
