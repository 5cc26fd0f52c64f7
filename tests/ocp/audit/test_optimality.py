"""The loss of a plan is its excess cost over the optimum, exactly for linear-quadratic problems."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from ocp import Collocation, MultipleShooting, Problem, Solution, solve
from ocp.audit.linearisation import Linearisation
from ocp.audit.optimality import Optimality, optimality
from ocp.problem.formulation import Formulation
from tests.ocp.problems import double_integrator, energy

METHOD = Collocation(8)


def optimality_of(solution: Solution) -> Optimality:
    return optimality(Linearisation(Formulation.of(solution.problem), solution))


def swerved(size: float) -> tuple[Solution, float]:
    """A plan of `energy` whose control is off its optimum, 6 - 12 t, by size (6 t^2 - 6 t + 1), and what it costs more.

    That leaves both ends as they are; half its squared integral is size^2 / 10.
    """
    problem, _, _, u = double_integrator("swerved")
    t = problem.time
    problem.minimize(running=(u - (6 - 12 * t) - size * (6 * t**2 - 6 * t + 1)) ** 2 / 2)
    result, excess = solve(problem, METHOD), size**2 / 10
    assert result.cost == pytest.approx(0.0, abs=1e-12)
    best = solve(energy(), METHOD)
    costates: dict[str, Any] = {"costates": best.costates, "costate_interpolant": best.costate_interpolant}
    return replace(result, problem=energy(), cost=6 + excess, **costates), excess


def test_an_optimum_loses_nothing_and_its_costates_are_the_known_ones() -> None:
    result = optimality_of(solve(energy(), METHOD))
    assert result.lost.sum() == pytest.approx(0.0, abs=1e-10)
    assert result.cost_size == pytest.approx(6.0)
    assert result.stationarity.max() < 1e-7
    assert result.curvature.upwards
    np.testing.assert_allclose(result.adjoint.costate[:, 0], -12.0, atol=1e-5)
    np.testing.assert_allclose(result.adjoint.costate[:, 1], 12 * result.t - 6, atol=1e-5)


@pytest.mark.parametrize("size", [0.03, -0.3, 3.0])
def test_the_loss_is_the_excess_cost(size: float) -> None:
    plan, excess = swerved(size)
    result = optimality_of(plan)
    assert result.lost.sum() == pytest.approx(excess, rel=1e-6)
    assert result.costate_accuracy == pytest.approx(np.sqrt(excess / (6 + excess)), rel=1e-6)


def under(ceiling: float) -> Problem:
    """Up and down again in 1 s with least energy under a ceiling c, which costs 4 / (9 c) (Bryson, Denham)."""
    problem, _, _, u = double_integrator("ceiling", (0.0, 1.0), (0.0, -1.0), ceiling=ceiling)
    problem.minimize(running=u**2 / 2)
    return problem


@pytest.mark.parametrize("method", [Collocation(30), MultipleShooting(60, control="linear")], ids=str)
def test_the_loss_at_a_gap_from_the_ceiling_is_what_the_ceiling_saves(method: Collocation | MultipleShooting) -> None:
    plan = replace(solve(under(0.111), method), problem=under(1 / 9))
    assert optimality_of(plan).lost.sum() == pytest.approx(4 / (9 * 0.111) - 4, rel=1e-3)


def test_units_of_the_cost_scale_the_loss_and_keep_its_share() -> None:
    """On a mesh too coarse for the optimum."""

    def scaled(factor: float) -> Optimality:
        problem, q, _, u = double_integrator("far", limit=5.0)
        problem.minimize(running=factor * (u**2 / 2 + q**4))
        return optimality_of(solve(problem, Collocation(3, 2)))

    one, other = scaled(1.0), scaled(1e3)
    assert one.lost.sum() > 1e-6
    np.testing.assert_allclose(other.lost, 1e3 * one.lost, rtol=1e-3, atol=1e-9)
    assert other.cost_size == pytest.approx(1e3 * one.cost_size)
    assert other.costate_accuracy == pytest.approx(one.costate_accuracy, rel=1e-3)


@pytest.mark.parametrize(("horizon", "least"), [(3.0, True), (3.3, False)])
def test_the_cost_curves_upwards_as_far_as_the_conjugate_point(horizon: float, least: bool) -> None:
    """int (u^2 - x^2) / 2 with x' = u between zeros: rest is least up to T = pi (Jacobi), and stationary beyond."""
    problem = Problem("oscillator's action")
    x = problem.state("x", initial=0.0, terminal=0.0)
    u: Any = problem.control("u")
    problem.dynamics(x, u)
    problem.horizon(horizon)
    problem.minimize(running=(u**2 - x**2) / 2)
    result = optimality_of(solve(problem, METHOD, guess={"x": 0.0, "u": 0.0}, check=False))
    assert result.curvature.upwards is least
    assert result.stationarity.max() < 1e-7
