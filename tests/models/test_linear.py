from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from models.spatial import determinant, solve_spd
from tests.models.robot.trees import Array, numeric, seeds


def random_spd(rng: np.random.Generator, size: int) -> Array:
    square = rng.normal(size=(size, size))
    return square @ square.T + 0.1 * np.eye(size)


@given(seeds, st.integers(1, 7), st.integers(1, 7))
def test_solve_spd_agrees_with_numpy(seed: int, size: int, columns: int) -> None:
    rng = np.random.default_rng(seed)
    matrix, right = random_spd(rng, size), rng.normal(size=(size, columns))
    expected = np.linalg.solve(matrix, right)
    np.testing.assert_allclose(numeric(solve_spd(matrix, right)), expected, rtol=1e-10, atol=1e-10)


@pytest.mark.parametrize("symbols", [ca.SX, ca.MX])
@pytest.mark.parametrize("size", range(1, 8))
def test_solve_spd_and_determinant_take_symbols(symbols: Any, size: int) -> None:
    rng = np.random.default_rng(size)
    matrix, right = random_spd(rng, size), rng.normal(size=(size, 3))
    a, b = symbols.sym("a", size, size), symbols.sym("b", size, 3)
    x, d = ca.Function("f", [a, b], [solve_spd(a, b), determinant(a)])(matrix, right)
    np.testing.assert_allclose(numeric(x), np.linalg.solve(matrix, right), rtol=1e-9, atol=1e-10)
    np.testing.assert_allclose(float(d), np.linalg.det(matrix), rtol=1e-10)


def test_solve_spd_derivative_is_minus_inverse_times_change_times_solution() -> None:
    rng = np.random.default_rng(3)
    matrix, right, change = random_spd(rng, 5), rng.normal(size=5), random_spd(rng, 5)
    step = ca.SX.sym("step")
    moved = solve_spd(ca.DM(matrix) + step * ca.DM(change), ca.DM(right))
    slope = numeric(ca.Function("f", [step], [ca.jacobian(moved, step)])(0)).ravel()
    solution = np.linalg.solve(matrix, right)
    np.testing.assert_allclose(slope, -np.linalg.solve(matrix, change @ solution), rtol=1e-9)


def test_structural_zeros_stay_zero_and_cost_nothing() -> None:
    a, b = ca.SX.sym("a", ca.Sparsity.diag(4)), ca.SX.sym("b", 4)
    x = solve_spd(a, b)
    assert ca.Function("f", [a, b], [x]).n_instructions() <= 4 * 5
    found = ca.Function("f", [a, b], [x])(ca.DM(np.diag([1.0, 2, 4, 8])).sparsity(), [1, 1, 1, 1])
    np.testing.assert_allclose(numeric(found).ravel(), 1.0)


@pytest.mark.parametrize("size", range(3, 8))
def test_solve_spd_takes_less_than_half_or_so_of_the_instructions_of_casadi(size: int) -> None:
    lower, right = ca.SX.sym("a", ca.Sparsity.lower(size)), ca.SX.sym("b", size)
    matrix = ca.tril2symm(lower)
    ours, theirs = (
        ca.Function("f", [lower, right], [x]).n_instructions()
        for x in (solve_spd(matrix, right), ca.solve(matrix, right))
    )
    assert ours < 0.5 * theirs


@given(seeds, st.integers(1, 7))
def test_determinant_agrees_with_numpy(seed: int, size: int) -> None:
    matrix = np.random.default_rng(seed).normal(size=(size, size))
    np.testing.assert_allclose(float(determinant(matrix)), np.linalg.det(matrix), rtol=1e-9, atol=1e-9)


@given(seeds, st.integers(2, 7))
def test_determinant_of_a_singular_matrix_is_finite_and_zero(seed: int, size: int) -> None:
    matrix = np.round(4 * np.random.default_rng(seed).normal(size=(size, size)))
    matrix[-1] = matrix[0]
    assert float(determinant(matrix)) == 0.0
    assert float(determinant(np.zeros((size, size)))) == 0.0
