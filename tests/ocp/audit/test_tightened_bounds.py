"""A plan solved under tightened bounds costs too much: the audit prices that, whatever the plan says of itself."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path

import casadi as ca
import numpy as np
import pytest

from ocp import Collocation, MultipleShooting, Problem, Solution, solve, tighten
from tests.ocp.problems import double_integrator

METHODS = [Collocation(20), MultipleShooting(40, control="linear")]
FREE = 6.0  # least cost of a unit step of the double integrator in unit time, where its push of 6 is allowed


def push(limit: float) -> Problem:
    problem, _, _, u = double_integrator("push", limit=limit)
    problem.minimize(running=u**2 / 2)
    return problem


@cache
def under(limit: float, method: Collocation | MultipleShooting, declared: float = 10.0) -> Solution:
    """The plan of a smaller limit that claims to be one of the declared limit, tightened."""
    plan = solve(push(limit), method)
    tightening = np.zeros((2, method.intervals, 3))
    tightening[:, :, 2] = declared - limit
    return replace(plan, problem=push(declared), bound_tightening=tightening)


def without_multipliers(plan: Solution) -> Solution:
    """Return the plan with zero costates and multipliers."""
    curve = plan.costate_interpolant
    return replace(
        plan,
        multipliers=np.zeros_like(plan.multipliers),
        costates={name: np.zeros_like(values) for name, values in plan.costates.items()},
        costate_interpolant=replace(curve, values=np.zeros_like(curve.values)),
    )


@pytest.mark.parametrize("method", METHODS, ids=str)
@pytest.mark.parametrize("limit", [4.1, 4.5, 5.0])
def test_a_bound_tightened_far_is_no_bound(limit: float, method: Collocation) -> None:
    audit = (plan := under(limit, method)).audit()
    assert audit.feasible
    assert not audit.passed
    assert audit["cost lost, relative"].value * plan.cost >= plan.cost - FREE


@pytest.mark.parametrize("method", METHODS, ids=str)
@pytest.mark.parametrize("declared", [4.6, 4.8, 5.1])
def test_the_cost_of_a_tightened_bound_follows_from_its_multipliers(declared: float, method: Collocation) -> None:
    """The problem is convex: the price is an upper bound, and no more than a first-order one is too large by."""
    plan, best = under(4.5, method, declared), solve(push(declared), method)
    loss = plan.audit()["cost lost, relative"]
    assert not loss.passed
    assert 0.99 <= loss.value * plan.cost / (plan.cost - best.cost) <= 1.0 + (declared - 4.5)


@pytest.mark.parametrize("method", METHODS, ids=str)
def test_forged_multipliers_do_not_hide_the_price(method: Collocation) -> None:
    forged = without_multipliers(under(4.1, method))
    assert not forged.audit()["cost lost, relative"].passed


def test_a_file_does_not_hide_the_price(tmp_path: Path) -> None:
    under(4.1, METHODS[0]).save(tmp_path / "plan.npz")
    assert not Solution.load(tmp_path / "plan.npz").audit().passed


def test_a_bound_that_is_hardly_tightened_costs_hardly_anything() -> None:
    """Multiplier times tightening: a thousandth of the marginal cost of a limit of 4.5."""
    method = MultipleShooting(40, control="linear")
    plan, declared = under(4.5, method, 4.5 + 1e-4), solve(push(4.5 + 1e-4), method)
    audit = plan.audit()
    assert audit.passed
    assert audit["cost lost, relative"].value >= (plan.cost - declared.cost) / plan.cost
    assert audit["cost lost, relative"].value <= 1e-4


@pytest.mark.parametrize("intervals", [10, 20, 40, 80])
def test_tightening_costs_no_more_than_its_price(intervals: int) -> None:
    """The true optimum under a ceiling of 1/9 is 4 (Bryson, Denham): the price bounds what is lost to it."""
    problem, _, _, u = double_integrator("ceiling", (0.0, 1.0), (0.0, -1.0), ceiling=1 / 9)
    problem.minimize(running=u**2 / 2)
    plan = tighten(problem, Collocation(intervals))
    audit = plan.audit()
    share = audit["cost lost, relative"].value
    assert share * plan.cost >= plan.cost - 4.0 - 1e-5
    assert audit.passed == (share <= 1e-3)


@pytest.mark.parametrize("width", [1e-2, 1e-4, 1e-6])
def test_a_tightened_bound_makes_no_minimum_of_a_maximum(width: float) -> None:
    """At u = 0 the cost (1 - u^2)^2 is largest; with bounds so near there is hardly a push to be priced."""

    def hump(limit: float) -> Problem:
        problem = Problem("hump")
        x = problem.state("x", initial=0.0)
        u = problem.control("u", lower=-limit, upper=limit, guess=lambda t: limit * np.sign(0.5 - t))
        problem.dynamics(x, u)
        problem.horizon(1.0)
        pull = 4e-4 * ca.if_else(problem.time < 0.5, 1, -1)
        problem.minimize(running=(1 - u**2) ** 2 - pull * u)
        return problem

    plan = solve(hump(width), Collocation(10, control="held"))
    tightening = np.zeros((2, 10, 2))
    tightening[:, :, 1] = 1.5 - width
    assert replace(plan, problem=hump(width)).audit().feasible
    assert not replace(plan, problem=hump(1.5), bound_tightening=tightening).audit().passed


def test_tightening_without_the_path_rows_is_none_of_these() -> None:
    """A hand-made plan may lack the tightening of path rows: their declared limits count."""
    problem, _, v, u = double_integrator("rows", limit=10.0)
    problem.path("power", u * v, upper=100.0)
    problem.minimize(running=u**2 / 2)
    plan = solve(problem, Collocation(20))
    assert replace(plan, bound_tightening=np.zeros((2, 20, 3))).audit().passed


@pytest.mark.parametrize("cost", [np.nan, np.inf, -np.inf])
def test_a_cost_that_is_no_number_fails_by_name(cost: float) -> None:
    """Beside active limits of the states, too, whose multipliers are weighed by the cost."""
    problem, _, _, u = double_integrator("ceiling", (0.0, 1.0), (0.0, -1.0), ceiling=1 / 9)
    problem.minimize(running=u**2 / 2)
    audit = replace(solve(problem, Collocation(12)), cost=cost).audit()
    assert not audit.feasible
    assert not audit["cost, relative"].passed
    assert audit.optimal is False
