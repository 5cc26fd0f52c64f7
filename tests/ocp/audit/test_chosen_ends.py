"""A start, a horizon or a parameter that the plan may choose and does not choose well: what that loses is told.

Each plan is solved with the thing given, and audited as a plan of the problem that leaves it open.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import casadi as ca
import pytest

from ocp import Collocation, MultipleShooting, Problem, solve
from ocp.audit.audit import audit
from tests.families import some

METHODS: dict[str, Any] = {
    "radau": Collocation(30),
    "legendre": Collocation(30, scheme="legendre"),
    "held": MultipleShooting(120),
    "linear": MultipleShooting(60, control="linear"),
}
every_method = pytest.mark.parametrize("method", METHODS)
LIMIT = 1e-3
"""Of the share of the cost that a plan may lose."""


def lasting(horizon: float | None = None) -> Problem:
    """From rest to rest at the least effort and time: 4 sqrt(6) at a horizon of sqrt(6), s."""
    problem = Problem("effort and time")
    q, v = problem.state("q", initial=0.0, terminal=1.0), problem.state("v", initial=0.0, terminal=0.0)
    u = problem.control("u")
    problem.dynamics(q, v)
    problem.dynamics(v, u)
    if horizon is None:
        problem.horizon(lower=0.5, upper=20.0, guess=3.0)
    else:
        problem.horizon(horizon)
    problem.minimize(u**2 + 1)
    return problem


def starting(place: float | None = None) -> Problem:
    """From anywhere, at rest, to 1; being away from zero costs."""
    problem = Problem("free start")
    q = problem.state("q", terminal=1.0, initial=place)
    v, u = problem.state("v", initial=0.0, terminal=0.0), problem.control("u")
    problem.dynamics(q, v)
    problem.dynamics(v, u)
    problem.horizon(2.0)
    problem.minimize(u**2 + q**2 / 2)
    return problem


def drifting(place: float | None = None) -> Problem:
    """A start that hardly moves along the best plan, which its own spread makes look small."""
    problem = Problem("hardly moving")
    x = problem.state("x", initial=place)
    y, u = problem.state("y", initial=0.0, terminal=3.0), problem.control("u")
    problem.dynamics(x, u)
    problem.dynamics(y, x)
    problem.horizon(3.0)
    problem.minimize(u**2 + 1 + ca.sin(y) / 5)
    return problem


def sprung(stiffness: float | None = None, unit: float = 1.0, zero: float = 0.0) -> Problem:
    """A mass on a spring with a free stiffness, stored as a constant state."""
    problem = Problem("sprung")
    q, v = problem.state("q", initial=1.0), problem.state("v", initial=0.0, terminal=0.0)
    options: dict[str, Any] = {} if stiffness is None else {"initial": (stiffness - zero) * unit}
    k, u = problem.state("k", guess=(5.0 - zero) * unit, **options), problem.control("u")
    stiff = k / unit + zero
    problem.dynamics(q, v)
    problem.dynamics(v, u - q * stiff)
    problem.dynamics(k, 0 * k)
    problem.horizon(2.0)
    problem.minimize(u**2 + q**2 + (stiff - 5) ** 2)
    return problem


def priced(stiffness: float | None = None, unit: float = 1.0, zero: float = 0.0) -> Problem:
    """The same with a choice that only enters the terminal cost."""
    problem = Problem("priced")
    q, v = problem.state("q", initial=1.0, terminal=0.0), problem.state("v", initial=0.0, terminal=0.0)
    options: dict[str, Any] = {} if stiffness is None else {"initial": (stiffness - zero) * unit}
    k, u = problem.state("k", guess=(5.0 - zero) * unit, **options), problem.control("u")
    problem.dynamics(q, v)
    problem.dynamics(v, u)
    problem.dynamics(k, 0 * k)
    problem.horizon(2.0)
    problem.minimize(u**2, terminal=(k / unit + zero - 4) ** 2)
    return problem


OPEN: dict[str, tuple[Callable[..., Problem], str, float]] = {
    "horizon": (lasting, "", 6**0.5),
    "start": (starting, "q", 0.735340),
    "start that hardly moves": (drifting, "x", 0.983672),
    "parameter of the dynamics": (sprung, "k", 4.423961),
    "parameter of the cost at the end": (priced, "k", 4.0),
}
"""What is left open, of which state it is the start, and its best value."""


@every_method
@pytest.mark.parametrize("what", OPEN)
def test_the_best_choice_passes(what: str, method: str) -> None:
    declare, state, best = OPEN[what]
    plan = solve(declare(), METHODS[method])
    assert plan.audit().passed
    assert (plan.states[state][0, 0] if state else plan.horizon) == pytest.approx(best, rel=2e-3)


@every_method
@pytest.mark.parametrize("off", some([-0.1, -0.05, -0.02, 0.01, 0.03, 0.08], [-0.02, 0.08]))
@pytest.mark.parametrize("what", OPEN)
def test_the_loss_of_a_worse_choice_is_its_excess_cost(what: str, off: float, method: str) -> None:
    declare, _, best = OPEN[what]
    least = solve(declare(), Collocation(60, scheme="legendre")).cost
    plan = solve(declare(best * (1 + off)), METHODS[method])
    result = audit(declare(), plan)
    more = plan.cost / least - 1
    assert result.feasible
    assert result["cost lost, relative"].value * plan.cost == pytest.approx(more * least, rel=0.3, abs=1e-5 * least)
    if more > 1.3 * LIMIT:
        assert result.optimal is False


@pytest.mark.parametrize("zero", [0.0, 2.0, -1e3])
@pytest.mark.parametrize("unit", [1e-6, 1.0, 1e6])
@pytest.mark.parametrize("declare", [sprung, priced])
def test_unit_and_origin_of_a_parameter_change_no_verdict(
    declare: Callable[..., Problem], unit: float, zero: float
) -> None:
    best = solve(declare(unit=unit, zero=zero), Collocation(20))
    assert best.audit().passed
    for stiffness in (3.0, 6.0):
        worse = solve(declare(stiffness, unit, zero), Collocation(20))
        assert audit(declare(unit=unit, zero=zero), worse).optimal is False


def test_a_parameter_along_which_the_cost_falls_is_no_minimum() -> None:
    problem = Problem("maximum")
    x, k, u = problem.state("x", initial=1.0), problem.state("k", guess=2.0), problem.control("u")
    problem.dynamics(x, u)
    problem.dynamics(k, 0 * k)
    problem.horizon(1.0)
    problem.minimize(u**2 + x**2, terminal=-((k - 2) ** 2))
    result = solve(problem, Collocation(20), check=False).audit()
    assert result.optimal is not True
