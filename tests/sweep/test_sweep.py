"""A sample of the sweep, and what its truths rest on."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import linprog

from ocp import Collocation, solve
from tests.families import some
from tests.sweep.judging import OPTIMA, QUADRATIC, judged, table
from tests.sweep.optima import FAMILIES, fastest, miss
from tests.sweep.quadratics import least_curvature, random_quadratic


@pytest.mark.parametrize("seed", some(range(16), 5))
def test_no_extremal_that_is_no_minimum_passes_and_the_minima_do(seed: int) -> None:
    result = judged(QUADRATIC, seed, ["drawn"])
    assert {verdict.outcome for verdict in result} <= {"pass", "fail"}, table(result)


@pytest.mark.parametrize("family", some(OPTIMA, 2))
def test_no_plan_passes_whose_cost_is_off_and_the_optima_do(family: str) -> None:
    matches = [verdict for seed in (0, 3, 10) for verdict in judged(family, seed, ["held", "linear", "radau"])]
    assert {verdict.outcome for verdict in matches} <= {"pass", "fail"}, table(matches)


@pytest.mark.long
def test_conjugate_points_are_those_of_the_dense_second_variation() -> None:
    """Two truths that share nothing: the argument of a Lagrangian frame, and the eigenvalues of a large matrix."""
    for seed in (0, 8, 12, 20):
        quadratic, minimum, _ = random_quadratic(seed)
        assert (least_curvature(quadratic, quadratic.plan(quadratic.problem())) > 0) is minimum
        assert (quadratic.conjugate_points(quadratic.horizon) == 0) is minimum


def test_the_least_time_is_that_of_a_linear_program() -> None:
    """The least number of steps of 1 / 100 in which piecewise constant controls reach the end."""
    rng = np.random.default_rng(3)
    for _ in range(4):
        ends = rng.uniform(-1, 1, size=4)
        least = fastest(*ends)
        for factor, feasible in ((1.01, True), (0.99, False)):
            n = 400
            step = factor * least / n
            left = step * (n - np.arange(n) - 0.5)  # s, from the middle of each step to the end
            rows = np.array([step * left, np.full(n, step)])
            free = np.array([ends[0] + ends[1] * factor * least, ends[1]])
            result = linprog(np.zeros(n), A_eq=rows, b_eq=ends[2:] - free, bounds=(-1, 1))
            assert result.success is feasible


def test_a_plan_that_is_moved_misses_by_as_much() -> None:
    known = FAMILIES["regulator"](1)
    plan = solve(known.problem, Collocation(20, 5))
    assert miss(known, plan) < 1e-6
    curve = plan.control_interpolant
    assert miss(known, replace(plan, control_interpolant=replace(curve, values=curve.values + 0.5))) > 1e-3
