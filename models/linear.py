"""Linear algebra of small symbolic matrices, element by element to keep expression graphs small."""

from __future__ import annotations

from itertools import combinations

import casadi as ca

from models.spatial import Expression, expression, on_scalars


@on_scalars
def solve_spd(matrix: Expression, right: Expression) -> Expression:
    """Solve matrix x = right for a small symmetric positive definite matrix.

    Shape (n, m) for `right` of (n, m).

    L D L' elimination without pivoting or square roots, meant for n <= 7; only the lower triangle is read.
    An indefinite matrix is not noticed, a singular one gives inf or nan.

    Instructions of the SX function of a dense matrix with one right-hand side, against ca.solve: n = 2: 16
    (20), 3: 38 (77), 4: 72 (200), 6: 184 (588), 7: 266 (896); with seven right-hand sides n = 6 takes 652
    (1272).
    """
    matrix, right = expression(matrix), expression(right)
    size = matrix.shape[0]
    factor: dict[tuple[int, int], Expression] = {}  # unit lower triangle L of matrix = L D L'
    scaled: dict[tuple[int, int], Expression] = {}  # L D
    inverse_pivot = []
    for j in range(size):
        for i in range(j, size):
            scaled[i, j] = matrix[i, j] - sum(scaled[i, k] * factor[j, k] for k in range(j))
        inverse_pivot.append(1 / scaled[j, j])
        for i in range(j + 1, size):
            factor[i, j] = scaled[i, j] * inverse_pivot[j]
    rows: list[Expression] = []
    for i in range(size):
        rows.append(right[i, :] - sum(factor[i, k] * rows[k] for k in range(i)))
    rows = [row * inverse_pivot[i] for i, row in enumerate(rows)]
    for i in reversed(range(size)):
        rows[i] = rows[i] - sum(factor[k, i] * rows[k] for k in range(i + 1, size))
    return ca.vertcat(*rows)


@on_scalars
def determinant(matrix: Expression) -> Expression:
    """Determinant of a small square matrix (n <= 7), without divisions: exact zeros stay finite.

    Shape (1, 1).

    Laplace expansion in which each minor of the first rows is written once: n 2^(n-1) products instead of the
    n! of the plain expansion. Instructions against ca.det: n = 4: 56 (74), 6: 337 (1977).
    """
    matrix = expression(matrix)
    size = matrix.shape[0]
    minors: dict[tuple[int, ...], Expression] = {(): ca.DM(1)}
    for row in range(size):
        minors = {
            columns: sum(
                (-1) ** (row + at) * matrix[row, column] * minors[columns[:at] + columns[at + 1 :]]
                for at, column in enumerate(columns)
            )
            for columns in combinations(range(size), row + 1)
        }
    return minors[tuple(range(size))]
