from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np
import pytest

from ocp import Collocation, MultipleShooting, Problem, ProblemError, Solution, SolveError, solve, tighten
from tests.ocp.problems import double_integrator, plant

METHODS = [
    Collocation(10, degree=3),
    Collocation(10, degree=3, scheme="legendre"),
    Collocation(12, degree=2, control="held"),
    MultipleShooting(12),
    MultipleShooting(12, control="linear"),
]


def walled() -> Problem:
    """The double integrator under a ceiling of 1/9 (Bryson, Denham) with a moving limit of its push."""
    problem, _, v, u = double_integrator("walled", (0.0, 1.0), (0.0, -1.0), limit=9.0, ceiling=1 / 9)
    problem.path("power", u * v, lower=-4.5, upper=4.5)
    problem.minimize(running=u**2 / 2)
    return problem


def beyond(solution: Solution) -> float:
    """Worst excess of the ceiling, the push and the power, between the points too."""
    s = np.linspace(0.0, 1.0, 5003)
    at = solution.at_fraction(s)
    power = at["u"] * at["v"]
    return float(max((at["q"] - 1 / 9).max(), (np.abs(at["u"]) - 9).max(), (np.abs(power) - 4.5).max()))


@pytest.mark.parametrize("method", METHODS, ids=str)
def test_limits_hold_between_the_points(method: Any) -> None:
    plain, tight = solve(walled(), method), tighten(walled(), method)
    assert beyond(plain) > 5e-5
    assert beyond(tight) <= 1.001e-6
    assert plain.cost <= tight.cost <= plain.cost * 1.2
    assert not [f for f in tight.audit().failures if f.name.startswith(("bounds", "power"))]


def test_a_plan_that_exceeds_nothing_is_left_as_it_is() -> None:
    problem, q, u = plant("free", state="q", initial=0.0, terminal=1.0, lower=-1.0, upper=2.0, u={"upper": 5.0})
    problem.dynamics(q, u)
    problem.minimize(running=u**2)
    assert tighten(problem, Collocation(4)).cost == solve(problem, Collocation(4)).cost


def test_it_takes_parameters_and_a_free_horizon() -> None:
    problem = Problem("fast")
    top, q = problem.parameter("top"), problem.state("q", initial=0.0, terminal=1.0)
    v = problem.state("v", initial=0.0, terminal=0.0, upper=top)
    u = problem.control("u", lower=-4.0, upper=4.0)
    problem.dynamics(q, v)
    problem.dynamics(v, u)
    final = problem.horizon(lower=0.1, upper=5.0, guess=1.0)
    problem.minimize(terminal=final, running=1e-3 * u**2)
    found = tighten(problem, Collocation(12, degree=4), parameters={"top": 0.7})
    at = found.at_fraction(np.linspace(0, 1, 3001))
    assert at["v"].max() <= 0.7 + 1.001e-6
    assert np.abs(at["u"]).max() <= 4 + 1.001e-6
    assert found.horizon > 1 / 0.7 + 0.7 / 4  # bang, coast, bang


def test_what_cannot_be_held_is_named() -> None:
    """A bump in time alone, which no plan can avoid and nodes do not see."""
    problem, q, u = plant("bump", state="q", initial=0.0, terminal=1.0)
    problem.dynamics(q, u)
    problem.path("bump", ca.sin(20 * np.pi * problem.time) ** 2 + 0 * q, upper=0.5)
    problem.minimize(running=u**2)
    assert solve(problem, MultipleShooting(20)).success
    with pytest.raises(SolveError, match=r"bump would have to go"):
        tighten(problem, MultipleShooting(20))


@pytest.mark.parametrize(
    ("changes", "message"),
    [({"tolerance": 0.0}, "tolerance must be positive"), ({"method": "collocation"}, "is expected")],
)
def test_requests_that_cannot_be_right_are_refused(changes: dict[str, Any], message: str) -> None:
    arguments = {"problem": walled(), "method": Collocation(4), **changes}
    with pytest.raises(ProblemError, match=message):
        tighten(**arguments)
