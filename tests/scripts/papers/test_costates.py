"""The minimum principle of the recursion against automatic differentiation of a Hamiltonian written without it.

Errors are relative to the greatest entry of what is compared. The printed forms of the corrected equations stand here,
on the same data as the corrected ones, beside a proof that they fail.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import assume, given, settings

from models import ModelError
from scripts.papers.free_floating.costates import (
    costate_rate,
    generalized_jacobian,
    hamiltonian,
    optimal_control,
    partials,
    resolution,
    state_rate,
)
from scripts.papers.free_floating.recursion import D, J
from tests.models.robot.chains import (
    CLEARLY,
    TOLERANCE,
    Case,
    by_index,
    error,
    every_case,
    example,
    planar_case,
    spatial_case,
)
from tests.models.robot.trees import Array, numeric, seeds


@every_case
def test_hamiltonian_is_the_least_over_all_rates_that_do_the_task(build: Any, size: int) -> None:
    """(25), (26), (31), (32) against the optimality system of the pointwise minimisation."""
    case = build(size)
    least, u, G, Gamma, Phi, rates = (numeric(part) for part in case.principle(case.x, case.lam, case.v))
    at = resolution(case.chain, case.x, case.v, case.rows)
    assert error(hamiltonian(*case.task), least[0, 0]) < TOLERANCE
    assert error(optimal_control(case.chain, case.x, case.lam), u[:, 0]) < TOLERANCE
    assert error(at.G, G) < TOLERANCE
    assert error(at.Gamma, Gamma) < TOLERANCE
    assert error(at.Phi, Phi[:, 0]) < TOLERANCE
    assert error(state_rate(*case.task)[case.chain.n :], rates[:, 0]) < TOLERANCE


@every_case
def test_state_rate_keeps_momentum_zero_and_does_the_task(build: Any, size: int) -> None:
    case = build(size)
    rate = state_rate(*case.task)
    momentum = D(case.chain, case.x)
    flow = (momentum @ rate)[case.chain.momentum_rows]
    assert np.abs(flow).max() < TOLERANCE * np.abs(momentum).max() * np.abs(rate).max()
    assert error((J(case.chain, case.x) @ rate)[case.rows], case.v) < 10 * TOLERANCE


@every_case
def test_partials_are_those_of_automatic_differentiation(build: Any, size: int) -> None:
    """(36)-(39), corrected."""
    case = build(size)
    joints = case.chain.N - case.chain.n
    u = optimal_control(case.chain, case.x, case.lam)
    u_x, Phi_x, Gamma_x, G_x = case.derivatives(case.x, case.lam, case.v, u)[3:]
    result = partials(*case.task)
    assert error(result.u, by_index(u_x, (joints, 1))[:, :, 0]) < TOLERANCE
    assert error(result.Phi, by_index(Phi_x, (joints, 1))[:, :, 0]) < TOLERANCE
    assert error(result.Gamma, by_index(Gamma_x, (joints, joints))) < TOLERANCE
    assert error(result.G, by_index(G_x, (len(case.rows), joints))) < TOLERANCE


@every_case
def test_costate_rate_is_minus_the_derivative_of_the_hamiltonian(build: Any, size: int) -> None:
    """(33), with the minimising rates substituted before differentiation, and by the envelope theorem at fixed u*."""
    case = build(size)
    u = optimal_control(case.chain, case.x, case.lam)
    total, envelope, by_costates = (numeric(part)[:, 0] for part in case.derivatives(case.x, case.lam, case.v, u)[:3])
    assert error(costate_rate(*case.task), total) < TOLERANCE
    assert error(costate_rate(*case.task), envelope) < TOLERANCE
    assert error(state_rate(*case.task), by_costates) < TOLERANCE


@settings(max_examples=40)
@given(seeds)
def test_costate_rate_is_right_wherever_the_papers_example_may_be(seed: int) -> None:
    case, rng = example(), np.random.default_rng(seed)
    x = rng.uniform(-3, 3, size=6)
    assume(np.linalg.cond(generalized_jacobian(case.chain, x)[case.rows]) < 20)
    lam, v = rng.normal(size=6), rng.normal(size=2)
    u = optimal_control(case.chain, x, lam)
    expected = numeric(case.derivatives(x, lam, v, u)[0])[:, 0]
    assert error(costate_rate(case.chain, x, lam, v, case.rows), expected) < TOLERANCE


@every_case
def test_costates_of_the_base_position_are_constant(build: Any, size: int) -> None:
    """Space is the same everywhere, so the Hamiltonian does not contain the base position."""
    case = build(size)
    position = slice(0, 2 if case.chain.n == 3 else 3)
    rate = costate_rate(*case.task)
    assert np.abs(rate[position]).max() < TOLERANCE * np.abs(rate).max()


# The equations that do not hold as printed


def basic_partials(case: Case) -> tuple[Array, Array, Array, Array]:
    """E1, E2, F1, F2 by each coordinate, by automatic differentiation."""
    N, n = case.chain.N, case.chain.n
    truth = case.truth(case.x)
    E_x = by_index(truth[2], (6, N))[:, case.chain.momentum_rows]
    F_x = by_index(truth[3], (6, N))[:, case.rows]
    return E_x[..., :n], E_x[..., n:], F_x[..., :n], F_x[..., n:]


@pytest.mark.parametrize("build", [lambda: spatial_case(6), lambda: planar_case(3), example])
def test_equation_39_holds_with_F1_not_the_printed_F2(build: Any) -> None:
    """With as many joints as base coordinates, so that the printed product exists."""
    case = build()
    at = resolution(case.chain, case.x, case.v, case.rows)
    u = optimal_control(case.chain, case.x, case.lam)
    expected = by_index(case.derivatives(case.x, case.lam, case.v, u)[6], at.G.shape)
    E1_inverse = np.linalg.inv(at.E1)

    def equation_39(F: Array) -> Array:
        return np.array(
            [
                F2_x - F1_x @ at.reaction + F @ E1_inverse @ (E1_x @ at.reaction - E2_x)
                for E1_x, E2_x, F1_x, F2_x in zip(*basic_partials(case), strict=True)
            ]
        )

    assert error(equation_39(at.F1), expected) < TOLERANCE
    assert error(equation_39(at.F2), expected) > CLEARLY


def test_equation_39_as_printed_has_no_meaning_when_joints_and_base_coordinates_differ_in_number() -> None:
    at = resolution(spatial_case(7).chain, spatial_case(7).x, spatial_case(7).v, spatial_case(7).rows)
    assert at.F1.shape[1] == len(at.E1)
    assert at.F2.shape[1] != len(at.E1)


@pytest.mark.parametrize("speed", [0.4, -2.0])
def test_equation_37_needs_the_velocity_behind_the_whole_bracket(speed: float) -> None:
    """A task of one row, where the printed difference of a matrix and a vector exists."""
    case = spatial_case(5)
    chain, x, lam, rows = case.chain, case.x, case.lam, [4]
    at = resolution(chain, x, [speed], rows)
    by = partials(chain, x, lam, [speed], rows)
    inverse = np.linalg.inv(at.G @ at.G.T)
    corrected, printed = [], []
    for G_x in by.G:
        first = G_x.T @ inverse
        second = at.G_pinv @ (G_x @ at.G.T + at.G @ G_x.T) @ inverse
        corrected.append((first - second) @ [speed])
        printed.append(first[:, 0] - second @ [speed])
        assert first.shape == (5, 1)  # (n2, m): no vector when the task has more rows
    step = 1e-5
    offsets = step * np.eye(chain.N)
    differences = [
        (resolution(chain, x + dx, [speed], rows).Phi - resolution(chain, x - dx, [speed], rows).Phi) / (2 * step)
        for dx in offsets
    ]
    assert error(corrected, by.Phi) < TOLERANCE
    assert error(corrected, differences) < 1e-7
    assert error(printed, by.Phi) > CLEARLY


def test_equation_38_as_printed_repeats_terms_outside_its_braces() -> None:
    """A task that leaves no freedom, where the printed sum exists: Gamma is zero everywhere, its partials too."""
    case = example()
    rows = [2, 3, 4]
    v = np.array([0.3, -1.0, -1.0])
    at = resolution(case.chain, case.x, v, rows)
    by = partials(case.chain, case.x, case.lam, v, rows)
    scale = np.abs(by.G).max() * np.abs(at.G_pinv).max()
    assert np.abs(at.Gamma).max() < 1e-14 * scale
    assert np.abs(by.Gamma).max() < 1e-13 * scale
    printed = []
    for G_x in by.G:
        braces = (G_x @ at.G.T + at.G @ G_x.T) @ at.G_pinv.T - G_x
        printed.append(
            -G_x.T @ at.G_pinv.T + at.G @ G_x.T @ at.G_pinv.T - G_x + at.G_pinv @ braces  # as printed
        )
    assert np.abs(printed).max() > CLEARLY * scale
    # With freedom left the printed sum adds (m, n2) to (n2, n2).
    free = resolution(case.chain, case.x, case.v, case.rows)
    assert free.G.shape != free.Gamma.shape


# What is refused


def test_wrong_sizes_and_rows_are_named() -> None:
    chain, x, lam, v, rows = example().task
    for function in (costate_rate, state_rate, hamiltonian, partials):
        with pytest.raises(ModelError, match=r"q has shape \(5,\), expected \(6,\)"):
            function(chain, x[:5], lam, v, rows)
        with pytest.raises(ModelError, match=r"lam has shape \(3,\), expected \(6,\)"):
            function(chain, x, lam[:3], v, rows)
        with pytest.raises(ModelError, match=r"tip_velocity has shape \(2,\), expected \(1,\)"):
            function(chain, x, lam, v, [3])
        with pytest.raises(ModelError, match=r"rows \[3, 6\] are not all among"):
            function(chain, x, lam, v, [3, 6])
    with pytest.raises(ModelError, match=r"lam has shape \(3,\), expected \(6,\)"):
        optimal_control(chain, x, lam[:3])


def test_singular_tasks_are_named() -> None:
    """Along a stretched arm in line with the base the tip cannot move; three joints do three rows at most."""
    case = example()
    with pytest.raises(ModelError, match=r"task of rows \[3, 4\] is singular at x = \[0.0, 0.0, 0.7, 0.0, 0.0, 0.0\]"):
        resolution(case.chain, [0.0, 0.0, 0.7, 0.0, 0.0, 0.0], case.v, case.rows)
    with pytest.raises(ModelError, match=r"task of rows \[1, 2, 3, 4\] is singular"):
        resolution(case.chain, case.x, np.ones(4), [1, 2, 3, 4])


def test_the_singularity_of_the_base_angles_is_named() -> None:
    case = spatial_case(3)
    x = case.x.copy()
    x[4] = np.pi / 2
    for function in (generalized_jacobian, lambda chain, x: optimal_control(chain, x, case.lam)):
        with pytest.raises(ModelError, match=r"E1 is singular at the base coordinates .* Euler angle at \+-pi/2"):
            function(case.chain, x)
