"""Singular and control-linear plans: convex problems are decided, of others the Legendre-Clebsch condition is told."""

from __future__ import annotations

from typing import Any

import casadi as ca
import pytest

from ocp import Collocation, Problem, refine, solve
from ocp.audit.linearisation import Linearisation
from ocp.audit.principle import clebsch, is_convex
from ocp.problem.formulation import Formulation
from ocp.solution import Solution
from tests.ocp.test_refinement import fishing


def along(solution: Solution) -> Linearisation:
    return Linearisation(Formulation.of(solution.problem), solution)


def store() -> Problem:
    """The largest stock over 4 s below 1, filled and emptied at 2 per second at most: a linear program in time."""
    problem = Problem("store")
    stock = problem.state("stock", initial=0.0, terminal=0.0, upper=1.0)
    rate = problem.control("rate", lower=-2.0, upper=2.0)
    problem.horizon(4.0)
    problem.dynamics(stock, rate)
    problem.minimize(running=-stock)
    return problem


def test_a_linear_program_in_time_is_decided_to_be_a_global_optimum() -> None:
    solution = refine(store(), Collocation(9))
    assert solution.cost == pytest.approx(-3.5, rel=1e-6)  # a trapezium: 0.5 s up, 3 s full, 0.5 s down
    audit = solution.audit()
    assert audit.passed
    assert "global optimum" in audit["curvature downwards, relative"].note


def test_a_plan_of_a_convex_problem_that_loses_cost_is_not_optimal() -> None:
    problem = store()
    solution = solve(problem, Collocation(9))
    late = Problem("late")
    stock = late.state("stock", initial=0.0, terminal=0.0, upper=0.8)
    rate = late.control("rate", lower=-2.0, upper=2.0)
    late.horizon(4.0)
    late.dynamics(stock, rate)
    late.minimize(running=-stock)
    other = solve(late, Collocation(9)).with_problem(problem)
    assert other.cost > solution.cost
    assert other.audit().optimal is False


def curve(cost: Any = 1.0, rate: Any = 0.0, limit: Any = 0.0) -> Problem:
    problem = Problem("curve")
    x, u = problem.state("x", initial=0.1, terminal=0.2), problem.control("u", lower=-2.0, upper=2.0)
    problem.horizon(1.0)
    problem.dynamics(x, u + x + rate * x**2)
    problem.minimize(running=cost * (x - u) ** 2)
    problem.path("limit", x + u + limit * u**2, None, 9.0)
    return problem


@pytest.mark.parametrize(
    ("parts", "convex"),
    [({}, True), ({"cost": -1.0}, False), ({"rate": 0.1}, False), ({"limit": 1.0}, True), ({"limit": -1.0}, False)],
)
def test_convexity_is_that_of_costs_dynamics_and_limits(parts: dict[str, float], convex: bool) -> None:
    solution = solve(curve(), Collocation(5)).with_problem(curve(**parts))
    assert is_convex(along(solution)) is convex


@pytest.mark.parametrize("weight", [3.0, -3.0])
def test_the_legendre_clebsch_term_of_the_double_integrator(weight: float) -> None:
    """With the cost w v^2 + x^2 and x'' = u the second derivative of H_u = costate of v is 2 x - 2 w u."""
    problem = Problem("double integrator")
    x, v = problem.state("x", initial=1.0), problem.state("v", initial=0.0)
    u = problem.control("u", lower=-1.0, upper=1.0)
    problem.horizon(1.0)
    problem.dynamics(x, v)
    problem.dynamics(v, u)
    problem.minimize(running=weight * v**2 + x**2)
    plan = along(solve(problem, Collocation(8)))
    assert clebsch(plan, plan.costate, 0) == pytest.approx(2 * weight, rel=1e-9)


def test_an_undetermined_singular_plan_tells_the_legendre_clebsch_condition() -> None:
    solution = solve(fishing(), Collocation(40, 4, "legendre"))
    term = clebsch(along(solution), along(solution).costate, 0)
    t = along(solution).t
    assert (term[(t > 4.5) & (t < 10.0)] > 0).all()  # the singular arc is a minimum (Sager 2005)
    audit = solution.audit()
    assert audit.optimal is True or "Legendre-Clebsch" in audit.undecided


def test_a_control_without_any_effect_has_a_degenerate_condition() -> None:
    problem = store()
    idle = problem.control("idle", lower=-1.0, upper=1.0)
    twin = problem.state("twin", initial=0.0)
    problem.dynamics(twin, ca.sin(twin) * idle)
    plan = along(solve(problem, Collocation(9)))
    assert clebsch(plan, plan.costate, 1) == pytest.approx(0.0, abs=1e-9)
