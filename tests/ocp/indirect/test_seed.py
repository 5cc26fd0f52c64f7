"""From a direct solution to arcs: signs without noise, times of nodes, known switches, and seeds that are refused."""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ocp import Collocation, Indirect, Problem, SolveError, solve
from ocp.indirect.seed import ControlArcs, signs
from tests.ocp.problems import double_integrator


def test_a_sign_that_noise_hides_is_that_of_the_next_clear_one() -> None:
    slope = np.array([[1e-9, 0.0], [2.0, 3.0], [-1e-8, -1.0], [1e-8, -2.0], [-1.0, 1e-9], [1e-9, 0.0]])
    np.testing.assert_array_equal(signs(slope).T, [[1, 1, -1, -1, -1, -1], [1, 1, -1, -1, -1, -1]])


@given(st.lists(st.floats(0.01, 1.0), min_size=1, max_size=5), st.lists(st.integers(2, 6), min_size=5, max_size=5))
def test_times_of_nodes_part_every_arc_evenly(widths: list[float], counts: list[int]) -> None:
    ends = np.cumsum(widths) / np.sum(widths)
    segments = tuple(counts[: len(widths)])
    arcs = ControlArcs(ends[:-1], (0,) * (len(widths) - 1), segments, np.zeros((sum(segments), 1)))
    times = arcs.times(3.0)
    assert len(times) == sum(segments) + 1
    assert (times[0], times[-1]) == (0.0, 3.0)
    np.testing.assert_allclose(times[arcs.nodes], 3.0 * ends[:-1])
    for begin, count, first, last in zip(np.cumsum((0, *segments)), segments, (0.0, *ends[:-1]), ends, strict=False):
        np.testing.assert_allclose(np.diff(times[begin : begin + count + 1]), 3.0 * (last - first) / count, rtol=1e-9)


@pytest.mark.parametrize(("distance", "most"), [(1.0, 1.0), (3.0, 0.5), (-2.0, 2.0)])
def test_rest_to_rest_in_least_time_switches_half_way(distance: float, most: float) -> None:
    """Full ahead, then full back: T = 2 sqrt(distance / most), from a seed of eight intervals."""
    problem, _, _, _ = double_integrator("rest to rest", end=(distance, 0.0), horizon=None, limit=most)
    time = 2 * np.sqrt(abs(distance) / most)
    horizon = problem.horizon(lower=0.5 * time, upper=2 * time, guess=1.2 * time)
    problem.minimize(terminal=horizon)
    solution = solve(problem, Indirect(), guess=solve(problem, Collocation(8, control="held")))
    assert solution.horizon == pytest.approx(time, rel=1e-9)
    assert solution.method["switches"] == pytest.approx([time / 2], rel=1e-9)
    np.testing.assert_allclose(np.abs(solution["u"]), most, rtol=1e-12)


def test_a_singular_arc_is_refused_with_the_control_and_its_time() -> None:
    """x' = u, |u| <= 1, from 1: least int x^2 over 3 s runs to 0 in 1 s and rests there, where H does not tell u."""
    problem = Problem("rest at zero")
    x = problem.state("x", initial=1.0)
    u: Any = problem.control("push", lower=-1.0, upper=1.0)
    problem.dynamics(x, u)
    problem.horizon(3.0)
    problem.minimize(running=ca.sumsqr(x))
    with pytest.raises(SolveError, match="'push' has a singular arc from") as caught:
        solve(problem, Indirect(), guess=solve(problem, Collocation(30, control="held")))
    assert caught.value.name == "push"
    assert caught.value.time == pytest.approx(1.0, abs=0.2)
