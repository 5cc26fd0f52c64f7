"""Strong and weak minima, costs that vanish at the optimum, and limits to which a solver leaves a gap."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import casadi as ca
import numpy as np
import pytest

from ocp import Collocation, Problem, solve
from ocp.audit.audit import COST_LOST
from ocp.audit.principle import cost_bound
from tests.conformance.suite.brachistochrone import build as brachistochrone
from tests.ocp.audit.test_singular_arcs import along


def cubic(lower: float) -> Problem:
    """Least int u^2 + u^3 dt from 0 to 0.1 in 1 s: u = 0.1 is a minimum among all controls above -1.2."""
    problem = Problem("cubic")
    x, u = problem.state("x", initial=0.0, terminal=0.1), problem.control("u", lower=lower, upper=3.0, guess=0.1)
    problem.horizon(1.0)
    problem.dynamics(x, u)
    problem.minimize(running=u**2 + u**3)
    return problem


@pytest.mark.parametrize("lower", [-3.0, -2.0, -1.3])
def test_a_weak_minimum_loses_the_excess_of_weierstrass(lower: float) -> None:
    """The costate is -(2 u + 3 u^2), so that the excess per second is H(0.1) - H(lower)."""
    audit = solve(cubic(lower), Collocation(4)).audit()
    h_plan, h_lower = (v**2 + v**3 - 0.23 * v for v in (0.1, lower))
    assert audit.optimality.lost.sum() == pytest.approx(h_plan - h_lower, rel=1e-6)
    assert audit.optimal is False
    assert not audit[COST_LOST].passed
    assert audit["curvature downwards, relative"].passed


def test_a_minimum_over_all_admissible_controls_loses_nothing() -> None:
    assert solve(cubic(-1.1), Collocation(4)).audit().passed


def test_an_inadmissible_needle_is_no_loss() -> None:
    problem = cubic(-3.0)
    problem.path("floor", problem.declared.controls["u"].symbol, lower=-0.5)
    assert solve(problem, Collocation(4)).audit().passed


def test_the_weak_minimum_of_the_brachistochrone_is_no_minimum() -> None:
    """From the guess of its source, Radau points end along the bound of the angle, 2 ms later than the cycloid."""
    weak, strong = (solve(brachistochrone(), Collocation(20, 4, scheme)) for scheme in ("radau", "legendre"))
    assert weak.cost > strong.cost + 1e-3
    assert weak.audit().optimal is False
    assert strong.audit().passed


def target(value: float, unit: float = 1.0) -> Problem:
    """Squared distance from a target that is within reach, 1 s at a speed of at most 1."""
    problem = Problem("target")
    x = problem.state("x", 2, initial=0.0)
    u = problem.control("u", 2, lower=-1.0, upper=1.0, guess=0.3)
    problem.horizon(1.0)
    problem.dynamics(x, u)
    problem.minimize(terminal=unit * ca.sumsqr(x - value))
    return problem


@pytest.mark.parametrize("unit", [1e-6, 1.0, 1e6])
def test_a_cost_of_squares_that_vanishes_is_a_global_minimum_in_every_unit(unit: float) -> None:
    audit = solve(target(0.5, unit), Collocation(6)).audit()
    assert audit.passed, audit
    assert "global optimum" in audit["curvature downwards, relative"].note


@pytest.mark.parametrize("unit", [1e-6, 1.0, 1e6])
def test_a_plan_beside_a_target_that_it_could_reach_is_not_optimal(unit: float) -> None:
    plan = solve(target(0.5, unit), Collocation(6)).with_problem(target(0.6, unit))
    audit = replace(plan, cost=0.02 * unit).audit()
    assert audit.feasible
    assert audit.optimal is False


def bounded(running: Any = 0.0, terminal: Any = 0.0) -> Problem:
    problem = Problem("bounded")
    x = problem.state("x", initial=0.5, lower=-1.0, upper=2.0)
    u = problem.control("u", lower=-3.0, upper=1.0)
    problem.horizon(lower=2.0, upper=4.0)
    problem.dynamics(x, u)
    problem.minimize(running=running(x, u), terminal=terminal(x))
    return problem


@pytest.mark.parametrize(
    ("running", "terminal", "bound"),
    [
        (lambda x, u: x**2 + 3, lambda x: 0, 6.0),  # the shortest horizon
        (lambda x, u: x - u**2, lambda x: 0, -40.0),  # the longest one
        (lambda x, u: 0, lambda x: ca.exp(x), np.exp(-1.0)),
        (lambda x, u: u**2, lambda x: -x, -2.0),
        (lambda x, u: ca.erf(x), lambda x: 0, -4 * np.inf),
    ],
)
def test_the_bound_of_the_cost_is_the_least_value_over_all_bounds(running: Any, terminal: Any, bound: float) -> None:
    start = solve(bounded(lambda x, u: u**2, lambda x: 0), Collocation(3))
    assert cost_bound(along(start.with_problem(bounded(running, terminal)))) == pytest.approx(bound, rel=1e-12)


def test_a_limit_with_a_small_multiplier_is_active_though_the_solver_leaves_a_gap() -> None:
    """e ((1.2 - 1.4 t) u - u^2 / 2) is least at u = 0 until 0.5 s and at u = 1 afterwards; it curves downwards in u."""
    problem = Problem("gap")
    x = problem.state("x", initial=0.0)
    u, v = problem.control("u", lower=0.0, upper=1.0), problem.control("v", lower=-1.0, upper=1.0)
    problem.horizon(1.0)
    problem.dynamics(x, v)
    problem.minimize(running=3e-6 * ((1.2 - 1.4 * problem.time) * u - u**2 / 2) + v**2, terminal=-x)
    plan = solve(problem, Collocation(20, 3, "legendre"), guess={"u": lambda t: 0.1 if t < 0.5 else 0.9})
    assert 1e-4 < plan["u"][plan.t < 0.45].max() < 1e-2  # the gap
    audit = plan.audit()
    assert audit.passed, audit


def test_a_stationary_start_of_a_problem_without_controls_that_is_no_minimum() -> None:
    """cos x is stationary at x = 0, where it is greatest; x' = -x / 10 for 1 s."""
    problem = Problem("start")
    x = problem.state("x", lower=-2.0, upper=2.0, guess=0.0)
    problem.horizon(1.0)
    problem.dynamics(x, -x / 10)
    problem.minimize(terminal=ca.cos(x))
    summit = solve(problem, Collocation(4), check=False, options={"max_iter": 0})
    audit = replace(summit, success=True).audit()
    assert audit.feasible
    assert audit.optimal is False
