"""A second solver of another kind ends at the same plan."""

from __future__ import annotations

from typing import Any

import pytest

from ocp import Collocation, Indirect, MultipleShooting, ProblemError, certificate, solve
from tests.ocp.problems import SWING, energy, relative, swing, van_der_pol


@pytest.mark.parametrize("method", [Collocation(12), MultipleShooting(20, control="linear")], ids=["points", "linear"])
def test_an_active_set_method_confirms_a_plan(method: Any) -> None:
    problem = van_der_pol(upper=0.1)
    plan = solve(problem, method)
    result = certificate(problem, [plan], second_solver=True)
    row = result.comparisons[-1]
    assert row.name.endswith(", by sleqp")
    assert row.worst < 1e-6
    assert abs(row.cost - plan.cost) < 1e-8
    assert ", by sleqp" in str(result)


@pytest.mark.parametrize("problem", [energy, lambda: energy(lower=-5.0, upper=5.0), van_der_pol])
def test_an_active_set_method_finds_the_same_optimum_from_the_guess(problem: Any) -> None:
    a, b = (solve(problem(), Collocation(10), solver=solver) for solver in ("ipopt", "sleqp"))
    assert b.cost == pytest.approx(a.cost, abs=1e-8)
    assert relative(b["u"], a["u"]) < 1e-5


def test_a_plan_with_every_kind_of_constraint_is_confirmed() -> None:
    problem = swing()
    plan = solve(problem, Collocation(10), parameters=SWING)
    assert certificate(problem, {"plan": plan}, second_solver=True).comparisons[-1].worst < 1e-5


def test_a_second_solver_needs_a_direct_plan() -> None:
    problem = van_der_pol()
    with pytest.raises(ProblemError, match="there is none") as caught:
        certificate(problem, {"extremal": solve(problem, Indirect(8))}, second_solver=True)
    assert caught.value.name == "solutions"
