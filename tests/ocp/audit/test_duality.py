"""Multipliers with the smallest loss: it equals the excess cost of the plan, whatever costates it reports."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from ocp import Collocation, MultipleShooting, Problem, Solution, solve
from ocp.audit.accessory import AccessoryProblem
from ocp.audit.costates import adjoint
from ocp.audit.linearisation import Linearisation
from ocp.audit.optimality import Fit, best_multipliers
from ocp.curves import PiecewisePolynomial
from ocp.problem.formulation import Formulation

METHODS: dict[str, Any] = {
    "radau": Collocation(15),
    "radau, held": Collocation(24, control="held"),
    "held": MultipleShooting(31),
    "linear": MultipleShooting(17, control="linear"),
}
every_method = pytest.mark.parametrize("method", METHODS)


def declared_problem(declare: str, unit: float = 1.0, second: float = 1.0) -> Problem:
    """A metre (of so many units) in a second from rest to rest; the cost has no unit."""
    problem = Problem(declare)
    speed: dict[str, Any] = {"upper": 1.2 * unit / second} if declare == "speed limit" else {}
    q = problem.state("q", initial=0.0, terminal=unit)
    v = problem.state("v", initial=0.0, terminal=0.0, **speed)
    most = {"effort": 5.0, "speed limit": 30.0, "late": 6.0, "both ways": 6.0}[declare] * unit / second**2
    problem.dynamics(q, v)
    if declare == "both ways":
        forth = problem.control("forth", lower=0.0, upper=most)
        back = problem.control("back", lower=0.0, upper=most)
        problem.path("together", forth + back, upper=0.8 * most)
        problem.dynamics(v, forth - back)
        running = (forth + 2 * back) / most
    else:
        u = problem.control("u", lower=-most, upper=most)
        problem.dynamics(v, u)
        running = (u / most) ** 2
        if declare == "late":
            running = running / 1e4 + q / unit
    problem.horizon(second)
    problem.minimize(running / second)
    return problem


def fitted(plan: Solution) -> Fit:
    problem = plan.problem
    assert problem is not None
    along = Linearisation(Formulation(problem), plan)
    known = adjoint(
        along, None if along.form.path.equality.all() and not along.nodal else perturb(along), abs(plan.cost)
    )
    result = best_multipliers(along, known, AccessoryProblem(along, known).curved, abs(plan.cost))
    assert result is not None
    return result


def perturb(along: Linearisation) -> np.ndarray:
    return np.zeros((len(along.s), along.form.nu, along.form.nu))


def lost(result: Fit) -> float:
    return float(result.lost.sum()) + result.adjoint.ends.charge


def without_costates(plan: Solution) -> Solution:
    """Return the plan with zero costates and multipliers."""
    curve = plan.costate_interpolant
    nothing = PiecewisePolynomial(curve.breaks, curve.nodes, np.zeros_like(curve.values))
    return replace(
        plan, costates={name: np.zeros_like(part) for name, part in plan.costates.items()}, costate_interpolant=nothing
    )


CASES = ["effort", "speed limit", "late", "both ways"]


@pytest.mark.parametrize("declare", CASES)
@every_method
def test_the_loss_is_the_excess_cost_of_the_plan(declare: str, method: str) -> None:
    """Convex problems: the best multipliers leave no gap but that of the plan to the optimum.

    Where a limit begins to hold or a control switches within an interval, its points tell up to five times as much.
    """
    least = solve(declared_problem(declare), Collocation(400, 2)).cost
    plan = solve(declared_problem(declare), METHODS[method])
    more, result, rounded = plan.cost - least, lost(fitted(plan)), 3e-4 * abs(least)
    assert 0.85 * more - rounded <= result <= (1.15 if declare == "effort" else 5.0) * max(more, 0.0) + rounded


@pytest.mark.parametrize("declare", CASES)
@every_method
def test_it_does_not_matter_which_costates_are_reported(declare: str, method: str) -> None:
    plan = solve(declared_problem(declare), METHODS[method])
    before, after = fitted(plan), fitted(without_costates(plan))
    assert lost(after) == pytest.approx(lost(before), rel=1e-2, abs=1e-5 * abs(plan.cost))
    assert after.distance > 0.3 * abs(plan.cost)
    assert before.distance < after.distance


@pytest.mark.parametrize(("unit", "second"), [(1e3, 1.0), (1e-3, 60.0), (1.0, 1e-3)])
@pytest.mark.parametrize("declare", CASES)
def test_units_change_nothing(declare: str, unit: float, second: float) -> None:
    one, other = (
        fitted(solve(declared_problem(declare, *units), METHODS["held"])) for units in ((1.0, 1.0), (unit, second))
    )
    assert lost(other) == pytest.approx(lost(one), rel=2e-2, abs=1e-6)


def test_multipliers_have_their_sign_and_are_zero_away_from_limits() -> None:
    plan = solve(declared_problem("speed limit"), METHODS["radau"])
    result = fitted(plan).adjoint
    speed = result.state_multipliers[:, 1]
    assert speed.min() >= -1e-6
    at_limit = plan.state_interpolant(np.repeat(0.5, 1))[0, 1] > 1.2 - 1e-6
    assert at_limit
    middle = len(speed) // 2
    assert speed[middle] > 1e-3 * abs(plan.cost)
    assert abs(speed[0]) < 1e-6


def test_a_plan_far_from_the_best_loses_more() -> None:
    plan = solve(declared_problem("effort"), MultipleShooting(6))
    finer = solve(declared_problem("effort"), MultipleShooting(60))
    assert lost(fitted(plan)) > 20 * lost(fitted(finer))
