"""Bands with a border: factors are those of the whole matrix, and exist exactly if it is positive definite."""

from __future__ import annotations

import numpy as np
import pytest

from ocp.direct.active_set import Bordered


def coupled(rng: np.random.Generator, size: int, reach: int, shared: int, tied: int) -> np.ndarray:
    """A symmetric matrix of neighbours, with variables that all share and ties of both ends, at random places."""
    far = np.abs(np.subtract.outer(np.arange(size), np.arange(size)))
    pattern = far <= reach
    everywhere = rng.choice(size, shared, replace=False)
    pattern[everywhere] = pattern[:, everywhere] = True
    ends = np.arange(tied)
    pattern[ends, size - tied + ends] = pattern[size - tied + ends, ends] = True
    values = rng.normal(size=(size, size))
    return np.where(pattern, values + values.T, 0.0)


def order_of(matrix: np.ndarray) -> Bordered:
    row, column = np.nonzero(matrix)
    return Bordered(row, column, len(matrix))


def laid_out(order: Bordered, matrix: np.ndarray) -> np.ndarray:
    row, column = np.nonzero(matrix)
    i, j = order.place[row], order.place[column]
    values = np.zeros(order.length)
    values[order.at(i[i >= j], j[i >= j])] = matrix[row, column][i >= j]
    return values


@pytest.mark.parametrize(
    ("size", "reach", "shared", "tied"),
    [
        (60, 3, 0, 0),
        (60, 3, 2, 0),
        (60, 3, 0, 4),
        (60, 4, 1, 3),
        (1, 0, 0, 0),
        (5, 0, 0, 0),
        (6, 5, 0, 0),
        (6, 0, 6, 0),
    ],
)
def test_factors_solve_the_whole_matrix_and_tell_whether_it_is_positive_definite(
    size: int, reach: int, shared: int, tied: int
) -> None:
    rng = np.random.default_rng(0)
    matrix = coupled(rng, size, reach, shared, tied)
    order = order_of(matrix)
    assert np.array_equal(np.sort(order.place), np.arange(size))
    least = np.linalg.eigvalsh(matrix)[0]
    for above in (1e-6, 1.0, -1e-6, -1.0):
        shifted = matrix + (above - least) * np.eye(size)
        factors = order.cholesky(laid_out(order, shifted))
        assert (factors is not None) == (above > 0)
        if factors is not None:
            right = rng.normal(size=size)
            result = factors.solve(right[np.argsort(order.place)])[order.place]
            np.testing.assert_allclose(shifted @ result, right, atol=1e-8)


def test_shared_variables_and_one_end_of_a_coupling_are_last() -> None:
    """So that the band stays as narrow as neighbours are near, whatever the length."""
    for size in (40, 400):
        matrix = coupled(np.random.default_rng(1), size, 3, 2, 4)
        order = order_of(matrix)
        assert order.width <= 3
        assert size - order.inner <= 6


@pytest.mark.parametrize("what", [np.nan, np.inf, -np.inf])
def test_values_that_are_no_numbers_have_no_factors(what: float) -> None:
    matrix = 4 * np.eye(4) + np.eye(4, k=1) + np.eye(4, k=-1)
    order = order_of(matrix)
    matrix[2, 1] = what
    assert order.cholesky(laid_out(order, matrix)) is None
