"""Mesh refinement: it reaches what is asked, says where it does not, and puts its intervals where they are needed."""

from __future__ import annotations

import warnings
from typing import Any

import casadi as ca
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ocp import Collocation, MultipleShooting, Problem, ProblemError, RefinementWarning, SolveError, refine, solve
from ocp.refinement import MOST_PIECES, split
from tests.ocp.problems import SWING, Method, energy, plant, swing, van_der_pol

START: dict[str, Method] = {
    "radau": Collocation(3),
    "radau-held": Collocation(3, control="held"),
    "legendre": Collocation(3, 2, "legendre"),
    "rk4-held": MultipleShooting(4),
    "rk4-linear": MultipleShooting(4, control="linear"),
}


def layer(width: float = 0.01) -> Problem:
    """A target that rises within ``width`` at 0.7 s: smooth, but sharp there and nowhere else."""
    problem, x, u = plant("layer", initial=0.0)
    target = 0.5 * (1 + ca.tanh((problem.time - 0.7) / width))
    problem.dynamics(x, u + target / width * ca.exp(-(((problem.time - 0.7) / width) ** 2)))
    problem.minimize(running=(x - target) ** 2 + 0.1 * u**2)
    return problem


@pytest.mark.parametrize("method", START)
def test_the_tolerance_is_reached(method: str) -> None:
    solution = refine(van_der_pol(), START[method], tolerance=1e-6)
    assert solution.refinement is not None
    assert solution.refinement.reached
    assert solution.refinement.errors[-1] <= 1e-6
    assert solution.audit().integration_error == pytest.approx(solution.refinement.errors[-1], rel=1e-6)
    assert solution.refinement.intervals[0] == START[method].intervals
    assert solution.refinement.intervals[-1] == len(solution.control_interpolant.breaks) - 1
    assert list(solution.refinement.intervals) == sorted(set(solution.refinement.intervals))
    assert len(solution.refinement.errors) == len(solution.refinement.intervals)
    assert solution.refinement.tolerance == 1e-6


def test_a_tighter_tolerance_takes_more_intervals_and_brings_the_cost_nearer() -> None:
    exact = solve(van_der_pol(), Collocation(40, 5)).cost
    loose, tight = (refine(van_der_pol(), Collocation(2, 2), tolerance=t, max_intervals=900) for t in (1e-3, 1e-6))
    assert loose.refinement is not None
    assert tight.refinement is not None
    assert tight.refinement.intervals[-1] > loose.refinement.intervals[-1]
    assert abs(tight.cost - exact) < abs(loose.cost - exact)


def test_nothing_is_refined_that_is_good_already() -> None:
    solution = refine(energy(), Collocation(2, 4), tolerance=1e-8)
    assert solution.refinement is not None
    assert solution.refinement.intervals == (2,)
    assert solution.refinement.reached


@pytest.mark.parametrize("method", [Collocation(6), Collocation(6, scheme="legendre"), MultipleShooting(8)], ids=str)
def test_intervals_gather_where_the_solution_is_sharp(method: Method) -> None:
    solution = refine(layer(), method, tolerance=1e-5)
    assert solution.refinement is not None
    assert solution.refinement.reached
    mesh = solution.control_interpolant.breaks
    widths = np.diff(mesh)
    middle = mesh[:-1] + widths / 2
    inside, outside = widths[np.abs(middle - 0.7) < 0.03], widths[np.abs(middle - 0.7) > 0.15]
    assert np.median(inside) < np.median(outside) / 4
    assert mesh[0] == 0.0
    assert mesh[-1] == 1.0
    even = solve(layer(), type(method)(solution.refinement.intervals[-1]))
    assert even.audit().integration_error > 3 * solution.refinement.errors[-1]


def test_a_stop_at_the_cap_is_warned_of_and_told() -> None:
    with pytest.warns(RefinementWarning, match=r"'layer' stopped at \d+ of at most 12 intervals .*raise max_intervals"):
        solution = refine(layer(), Collocation(4), tolerance=1e-10, max_intervals=12)
    assert solution.refinement is not None
    assert not solution.refinement.reached
    assert solution.refinement.intervals[-1] <= 12
    assert solution.refinement.errors[-1] > 1e-10
    assert solution.success


def test_the_first_mesh_may_be_the_last() -> None:
    with pytest.warns(RefinementWarning):
        solution = refine(layer(), Collocation(4), tolerance=1e-10, max_intervals=4)
    assert solution.refinement is not None
    assert solution.refinement.intervals == (4,)


def test_everything_is_passed_on_to_the_solves() -> None:
    reference = solve(swing(), Collocation(40), parameters=SWING)
    solution = refine(
        swing(),
        Collocation(8),
        tolerance=1e-4,
        parameters=SWING,
        solver="fatrop",
        options={"max_iter": 200},
        guess=reference,
    )
    assert solution.solver == "fatrop"
    assert solution.cost == pytest.approx(reference.cost, rel=1e-4)


def test_an_uneven_first_mesh_is_kept_and_split() -> None:
    mesh = (0.0, 0.1, 0.55, 1.0)
    solution = refine(van_der_pol(), Collocation(3, 2, mesh=mesh), tolerance=1e-4)
    for node in mesh:
        assert np.min(np.abs(solution.control_interpolant.breaks - node)) < 1e-14


def test_a_round_that_fails_raises_what_solving_raises() -> None:
    with pytest.raises(SolveError):
        refine(van_der_pol(), Collocation(3), options={"max_iter": 1})


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"tolerance": 0.0}, "tolerance must be positive and finite, not 0"),
        ({"tolerance": -1e-6}, "tolerance"),
        ({"tolerance": np.nan}, "tolerance"),
        ({"tolerance": np.inf}, "tolerance"),
        ({"tolerance": None}, "tolerance"),
        ({"tolerance": "tight"}, "tolerance"),
        ({"max_intervals": 2}, "max_intervals 2 is below the 3 intervals given"),
        ({"max_intervals": "many"}, "max_intervals"),
        ({"max_intervals": np.nan}, "max_intervals"),
        ({"method": None}, "refine: .* expected, not None"),
        ({"method": Collocation}, "refine: .* expected"),
        ({"solver": "snopt"}, "solver must be"),
        ({"parameters": {"p": 1.0}}, "unknown parameter"),
    ],
)
def test_bad_arguments_are_named(arguments: dict[str, Any], message: str) -> None:
    given = {"method": Collocation(3), **arguments}
    with pytest.raises(ProblemError, match=message):
        refine(van_der_pol(), **given)


# ---- splitting ---------------------------------------------------------------------------------------------------


@given(
    errors=st.lists(st.one_of(st.floats(0.0, 1e3), st.just(float("inf"))), min_size=1, max_size=12),
    target=st.floats(1e-9, 1.0),
    order=st.integers(2, 10),
    room=st.integers(0, 60),
)
def test_split_meshes_are_finer_ordered_and_never_beyond_the_cap(
    errors: list[float], target: float, order: int, room: int
) -> None:
    n = len(errors)
    mesh = np.linspace(0.0, 1.0, n + 1)
    finer = split(mesh, np.array(errors), target, order, n + room)
    assert finer[0] == 0.0
    assert finer[-1] == 1.0
    assert np.all(np.diff(finer) > 0)
    assert n <= len(finer) - 1 <= min(n + room, MOST_PIECES * n)
    assert set(mesh) <= set(finer)
    if room >= MOST_PIECES * n:
        assert len(finer) > n + 1


def test_the_worst_interval_is_split_first() -> None:
    finer = split(np.linspace(0.0, 1.0, 5), np.array([1e-9, 1.0, 1e-3, 1e-9]), 1e-6, 4, 6)
    assert len(finer) == 7
    assert np.sum((finer > 0.25) & (finer < 0.5)) == 2


def test_a_sharp_start_does_not_hide_a_smooth_rest() -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error", RefinementWarning)
        solution = refine(layer(0.003), Collocation(4, 4), tolerance=1e-6)
    assert solution.audit().passed
