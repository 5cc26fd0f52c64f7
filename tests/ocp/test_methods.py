"""One call that solves, by every kind of method: the same optimum, the same refusals, and a way off a saddle."""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np
import pytest

from ocp import Collocation, Indirect, MultipleShooting, Problem, ProblemError, prepare, solve
from tests.ocp.problems import LogarithmicRegulator, energy, started_anywhere

METHODS: dict[str, Any] = {
    "collocation": Collocation(12),
    "legendre": Collocation(12, scheme="legendre"),
    "shooting": MultipleShooting(24, control="linear"),
    "indirect": Indirect(),
}
every_method = pytest.mark.parametrize("method", METHODS.values(), ids=METHODS)


@every_method
def test_every_method_finds_the_known_optimum(method: Any) -> None:
    case = LogarithmicRegulator()
    solution = solve(case.build(), method)
    assert solution.success
    assert solution.cost == pytest.approx(case.cost, rel=1e-3 if isinstance(method, MultipleShooting) else 1e-6)
    np.testing.assert_allclose(solution["y"].ravel(), case.state(solution.t), rtol=1e-3)


@every_method
def test_a_prepared_problem_solves_as_a_new_one(method: Any) -> None:
    problem = started_anywhere()
    prepared = prepare(problem, method)
    for x0 in ([1.0, 0.0], [0.3, -0.2]):
        assert prepared.solve({"x0": x0}).cost == pytest.approx(
            solve(problem, method, parameters={"x0": x0}).cost, rel=1e-7
        )


@pytest.mark.parametrize("method", ["collocation", Collocation, 3])
def test_invalid_methods_are_refused(method: Any) -> None:
    with pytest.raises(ProblemError, match="a method such as Collocation") as caught:
        solve(energy(), method)
    assert caught.value.name == "method"


def test_a_stationary_plan_that_is_no_minimum_is_improved() -> None:
    """x' = u, least int u^2 / 2 - 3 x^2 + x^4: x = 0 is stationary, the cost falls on both sides of it.

    Over pi > pi / sqrt(6) s the rest at 0 is past its conjugate point (Jacobi).
    """
    problem = Problem("double well")
    x = problem.state("x", initial=0.0, terminal=0.0)
    u: Any = problem.control("u")
    problem.dynamics(x, u)
    problem.horizon(float(np.pi))
    problem.minimize(running=u**2 / 2 - 3 * x**2 + ca.sumsqr(x**2))
    rest = {"x": 0.0, "u": 0.0}
    assert solve(problem, Collocation(12), guess=rest, check=False).cost == pytest.approx(0.0, abs=1e-9)
    solution = solve(problem, Collocation(12), guess=rest)
    assert (solution.start, solution.cost < -1.0) == ("downhill", True)
    assert np.abs(solution["x"]).max() > 0.5
