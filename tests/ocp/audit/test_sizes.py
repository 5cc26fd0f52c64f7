"""Sizes along a plan: the spread of each quantity, independent of unit, origin and bounds."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import casadi as ca
import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from ocp import Collocation, Problem, Solution, solve
from ocp.audit.sizes import Sizes, fine_grid, sizes
from ocp.problem.formulation import Formulation
from ocp.tolerances import ROUNDING_SHARE, STANDSTILL
from tests.ocp.problems import double_integrator


def sizes_of(problem: Problem, solution: Solution) -> Sizes:
    form = Formulation(problem)
    p = form.parameter_vector(solution.parameters)
    return sizes(form, fine_grid(solution, p), form.bound_values(p))


def travel(
    length: float = 1.0, time: float = 1.0, origin: float = 0.0, upper: float = np.inf, force: float = 1.0
) -> tuple[Problem, Any]:
    """A cart that goes a length from rest to rest, its control in units of 1/force."""
    problem = Problem("travel")
    q = problem.state("q", initial=origin, terminal=origin + length, lower=-upper, upper=upper)
    v = problem.state("v", initial=0.0, terminal=0.0)
    u = problem.control("u")
    problem.dynamics(q, v)
    problem.dynamics(v, u * length / time**2 / force)
    problem.horizon(time)
    problem.minimize(u**2)
    return problem, q


def test_the_scale_of_a_state_is_its_range() -> None:
    problem, _ = travel(2.0)
    result = sizes_of(problem, solve(problem, Collocation(8)))
    np.testing.assert_allclose(result.state, [2.0, 3.0], rtol=1e-3)  # v peaks at 3/2 of the mean
    np.testing.assert_allclose(result.control, [12.0], rtol=1e-3)


@given(*(st.floats(-9.0, 9.0) for _ in range(3)))
@settings(max_examples=6)
def test_sizes_follow_the_units(length: float, force: float, time: float) -> None:
    """The plan of 1 m in 1 s, written in other units: no solver has a part in it."""
    length, force, time = 10.0**length, 10.0**force, 10.0**time
    least, most = sorted((length, 1.5 * length / time))
    assume(least > max(2 * ROUNDING_SHARE * most, STANDSTILL))  # else it rests at zero but for rounding
    solution = solve(travel()[0], Collocation(8))
    states, controls = solution.state_interpolant, solution.control_interpolant
    solution = replace(
        solution,
        horizon=time,
        state_interpolant=replace(states, values=states.values * [length, length / time]),
        control_interpolant=replace(controls, values=controls.values * force),
    )
    problem, q = travel(length, time, force=force)
    problem.end("arrive", q - length, 0, 0)
    problem.path("way", q, upper=1e12)
    result = sizes_of(problem, solution)
    np.testing.assert_allclose(result.state, [length, 1.5 * length / time], rtol=1e-3)
    np.testing.assert_allclose(result.control, [12.0 * force], rtol=1e-2)
    np.testing.assert_allclose([result.end[0], result.path[0]], length, rtol=1e-3)


@pytest.mark.parametrize("upper", [2e3, 1e6, 1e12])
@pytest.mark.parametrize("origin", [0.0, 1e3])
def test_neither_the_bounds_nor_the_origin_have_a_say(upper: float, origin: float) -> None:
    problem, q = travel(origin=origin, upper=upper)
    problem.path("room", q, lower=-upper, upper=upper)
    result = sizes_of(problem, solve(problem, Collocation(8)))
    np.testing.assert_allclose([result.state[0], result.path[0]], 1.0, rtol=1e-3)


def test_each_entry_is_measured_by_itself() -> None:
    problem = Problem("apart")
    a = problem.state("a", 2, initial=[0.0, 0.0], terminal=[1.0, np.sin(np.pi)])
    b = problem.state("b", initial=0.0, terminal=1e-7)
    u, w = problem.control("u", 2), problem.control("w")
    problem.dynamics(a, u)
    problem.dynamics(b, w)
    problem.horizon(1.0)
    problem.minimize(ca.sumsqr(u) + w**2)
    result = sizes_of(problem, solve(problem, Collocation(4)))
    np.testing.assert_allclose(result.state, [1.0, 1e-6, 1e-7], rtol=1e-6)


def test_a_state_at_rest_has_the_scale_of_its_required_displacement() -> None:
    request, _ = travel(0.9e-3)
    standing, _, _, u = double_integrator("standing", end=(0.0, 0.0))
    standing.minimize(u**2)
    result = sizes_of(request, solve(standing, Collocation(4)))
    assert result.state[0] == pytest.approx(0.9e-3)


def test_zero_states_get_a_least_scale_that_does_not_affect_others() -> None:
    problem = Problem("straight")
    x = problem.state("x", initial=0.0, terminal=1e-3)
    y = problem.state("y", initial=0.0, terminal=0.0)
    turn = problem.state("turn", initial=0.0, lower=-np.pi, upper=np.pi)
    v, w = problem.control("v"), problem.control("w")
    problem.dynamics(x, v * ca.cos(turn))
    problem.dynamics(y, v * ca.sin(turn))
    problem.dynamics(turn, w)
    problem.end("ahead", x - 1e-3 + 1e3 * y, 0, 0)
    problem.end("aside", y, 0, 0)
    problem.horizon(1.0)
    problem.minimize(v**2 + w**2)
    result = sizes_of(problem, solve(problem, Collocation(4)))
    assert result.state[0] == pytest.approx(1e-3)
    assert np.all((result.state[1:] > 0) & (result.state[1:] <= 1e-6))
    np.testing.assert_allclose(result.end, [1e-3, result.state[1]], rtol=1e-3)


@pytest.mark.parametrize("noise", [0.0, 1e-20, 1e-14])
def test_where_nothing_moves_nothing_is_smaller_than_a_millionth(noise: float) -> None:
    problem, q, v, u = double_integrator("at rest", end=(0.0, 0.0))
    problem.minimize(u**2)
    problem.path("rest", q + v, 0, 0)
    solution = solve(problem, Collocation(4))
    curve = solution.state_interpolant
    values = curve.values + noise * np.random.default_rng(1).normal(size=curve.values.shape)
    result = sizes_of(problem, replace(solution, state_interpolant=replace(curve, values=values)))
    np.testing.assert_allclose([*result.state, *result.control, result.path[0]], [1e-6, 1e-6, 1e-6, 2e-6])


def test_the_scale_of_an_equality_is_that_of_its_terms() -> None:
    """A plan that meets it has no spread of it; the tip of a short arm moves by millimetres."""
    length = 3e-3
    problem = Problem("short arm")
    q = problem.state("q", 2, initial=[0.3, 0.5])
    u = problem.control("u", 2)
    problem.dynamics(q, u)
    tip = length * ca.vertcat(ca.cos(q[0]) + ca.cos(q[0] + q[1]), ca.sin(q[0]) + ca.sin(q[0] + q[1]))
    goal = length * np.array([0.6, 1.4])
    problem.end("tip", tip - goal, 0, 0)
    problem.horizon(1.0)
    problem.minimize(ca.sumsqr(u))
    result = sizes_of(problem, solve(problem, Collocation(8)))
    assert np.all((result.end > length / 10) & (result.end < 4 * length))


def test_the_cyclic_end_is_as_large_as_both_of_its_sides() -> None:
    problem, q, _, u = double_integrator("there and back", end=(np.nan, np.nan))
    problem.end("turned", q - problem.at_start(q), 0.5, 0.5)
    problem.minimize(u**2 + q)
    solution = solve(problem, Collocation(8))
    result = sizes_of(problem, solution)
    assert result.end[0] == pytest.approx(2 * result.state[0])


def test_infinite_values_do_not_affect_the_scale() -> None:
    problem, _ = travel()
    solution = solve(problem, Collocation(8))
    values = solution.state_interpolant.values.copy()
    values[3, 1] = [np.inf, np.nan]
    broken = replace(solution, state_interpolant=replace(solution.state_interpolant, values=values))
    result = sizes_of(problem, broken)
    np.testing.assert_allclose(result.state, [1.0, 1.5], rtol=1e-2)


def test_the_fine_grid_stands_on_both_sides_of_a_break() -> None:
    problem, _ = travel()
    solution = solve(problem, Collocation(5))
    grid = fine_grid(solution, np.zeros(0))
    assert len(grid.t) == 5 * grid.samples == 5 * 31
    np.testing.assert_allclose(grid.t.reshape(5, -1)[1:, 0], grid.t.reshape(5, -1)[:-1, -1])
    np.testing.assert_allclose(grid.states[:, 0], solution.at(np.minimum(grid.t, 1.0))["q"][:, 0], atol=1e-12)
