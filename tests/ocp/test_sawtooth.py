from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from ocp import Collocation, MultipleShooting, Problem, Solution, solve

METHODS = [
    Collocation(40),
    Collocation(30, scheme="legendre"),
    Collocation(40, control="held"),
    MultipleShooting(60, control="linear"),
    MultipleShooting(60),
    MultipleShooting(40, steps=2),
]


def chase(
    sign: float = 1.0, rate: float = 2.0, effort: float = 0.01, gain: float = 0.0, terminal: Any = None
) -> Problem:
    """Follow a ramp that runs beyond a bound of 0.6; a free end at the bound. Mirrored for sign -1."""
    problem = Problem("chase")
    lower, upper = (-np.inf, 0.6) if sign > 0 else (-0.6, np.inf)
    q = problem.state("q", initial=0.0, terminal=terminal, lower=lower, upper=upper)
    u = problem.control("u")
    problem.dynamics(q, u)
    problem.horizon(1.0)
    problem.minimize(running=(q - sign * rate * problem.time) ** 2 + effort * u**2, terminal=-gain * sign * q)
    return problem


@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize("method", METHODS, ids=str)
def test_a_bound_that_is_active_at_a_free_end_is_no_fault(method: Any, sign: float) -> None:
    audit = solve(chase(sign), method).audit()
    assert audit.passed, str(audit)
    assert audit["stationarity, relative"].value < 1e-2


@pytest.mark.parametrize("method", METHODS, ids=str)
def test_a_final_cost_that_presses_on_the_bound_is_no_fault(method: Any) -> None:
    """The costate before the end is that of the bound's own force, far from the gradient of the final cost."""
    if method.control == "held":  # a held control is judged in the middle of its interval, to first order of its width
        method = replace(method, intervals=120)
    audit = solve(chase(gain=1.0), method).audit()
    assert audit.passed, str(audit)


@pytest.mark.parametrize(
    "other",
    [{"rate": 1.6}, {"effort": 0.02}, {"rate": 2.2, "effort": 0.012}],
    ids=str,
)
@pytest.mark.parametrize("method", METHODS, ids=str)
def test_the_plan_of_another_problem_does_not_pass(method: Any, other: dict[str, float]) -> None:
    """It ends at the same bound."""
    plan = solve(chase(**other), method)
    assert plan["q"][-1] == pytest.approx(0.6, abs=1e-6)
    assert not plan.audit(chase()).passed


@pytest.mark.parametrize("method", METHODS, ids=str)
def test_a_plan_forced_to_the_bound_does_not_pass_where_the_end_is_free(method: Any) -> None:
    """The ramp is left behind on the way to 0.6: the bound would have to pull."""
    plan = solve(chase(rate=0.2, terminal=0.6), method)
    assert plan.audit().passed
    assert not plan.audit(chase(rate=0.2)).passed


def shifted(plan: Solution, amount: float) -> Solution:
    """The same plan with costates that are off by a constant while it is at the bound."""
    costates = plan.costates["q"] + amount * (plan["q"] > 0.6 - 1e-6)
    interpolant = plan.costate_interpolant
    at = interpolant.breaks[:-1, None] + np.diff(interpolant.breaks)[:, None] * interpolant.nodes
    on_bound = plan.at_fraction(at.ravel())["q"].reshape(interpolant.values.shape) > 0.6 - 1e-6
    values = interpolant.values + amount * on_bound
    return replace(plan, costates={"q": costates}, costate_interpolant=replace(interpolant, values=values))


@pytest.mark.parametrize("amount", [0.02, -0.02])
@pytest.mark.parametrize("method", METHODS, ids=str)
def test_costates_that_are_wrong_along_the_bound_do_not_pass(method: Any, amount: float) -> None:
    plan = shifted(solve(chase(), method), amount)
    assert not plan.audit(chase()).passed
