"""Limits on predetermined variables are removed for the solve and checked afterwards."""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np
import pytest

from ocp import Collocation, MultipleShooting, Problem, SolveError, solve
from ocp.direct.scaling import uncontrolled_states
from ocp.problem.formulation import Formulation

METHODS: dict[str, Any] = {
    "radau": Collocation(10),
    "legendre": Collocation(10, scheme="legendre"),
    "held": Collocation(10, control="held"),
    "shooting": MultipleShooting(10),
    "linear": MultipleShooting(10, control="linear"),
}
EVERY = pytest.mark.parametrize("method", METHODS.values(), ids=METHODS)


def clocked(limit: str, end: float | None = None, upper: float | None = None, horizon: float = 1.0) -> Problem:
    """1 m with least energy beside a clock, c' = 1, that a limit looks at."""
    problem = Problem("clocked")
    q, c = problem.state("q", initial=0.0, terminal=1.0), problem.state("c", initial=0.0, terminal=end, upper=upper)
    u = problem.control("u")
    problem.dynamics(q, u)
    problem.dynamics(c, 1.0)
    problem.horizon(horizon)
    path = {"clock": (c, 0.0, horizon), "band": (q - c, -0.1, 0.1), "under": (q - c, None, 0.0), "none": (q, None, 2.0)}
    problem.path("limit", path[limit][0], *path[limit][1:])
    problem.minimize(running=u**2)
    return problem


@EVERY
@pytest.mark.parametrize("limit", ["clock", "band", "under", "none"])
@pytest.mark.parametrize("options", [{}, {"end": 1.0}, {"upper": 1.0}, {"end": 1.0, "upper": 1.0}], ids=str)
def test_time_as_a_state_changes_no_solution(method: Any, limit: str, options: Any) -> None:
    solution = solve(clocked(limit, **options), method)
    assert solution.start == "guess"
    assert solution.cost == pytest.approx(1.0, rel=1e-6)
    np.testing.assert_allclose(solution["c"][:, 0], solution.t, atol=1e-12)


def test_a_conflicting_end_time_of_a_clock_is_reported() -> None:
    with pytest.raises(SolveError, match=r"c is missed by 0\.5"):
        solve(clocked("none", end=1.5), Collocation(5))
    with pytest.raises(SolveError, match=r"limit is missed by 0\.5"):
        solve(late(), Collocation(5))


def late() -> Problem:
    """A limit of 0.5 on a clock that runs to 1."""
    problem = Problem("late")
    q, c = problem.state("q", initial=0.0, terminal=1.0), problem.state("c", initial=0.0)
    u = problem.control("u")
    problem.dynamics(q, u)
    problem.dynamics(c, 1.0)
    problem.horizon(1.0)
    problem.path("limit", c, upper=0.5)
    problem.minimize(running=u**2)
    return problem


def test_states_that_run_by_themselves_are_those_that_no_control_reaches() -> None:
    problem = Problem("chain")
    names = ("clock", "square", "driven", "after", "loose")
    a, b, c, d, e = (problem.state(name, initial=None if name == "loose" else 0.0) for name in names)
    u = problem.control("u")
    rates = (ca.SX(1), 2 * a, u + a, c, e)
    for state, rate in zip((a, b, c, d, e), rates, strict=True):
        problem.dynamics(state, rate)
    problem.horizon(1.0)
    np.testing.assert_array_equal(uncontrolled_states(Formulation(problem)), [True, True, False, False, False])
