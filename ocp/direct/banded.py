"""Symmetric matrices that are a band but for a few variables, and whether they are positive definite.

Stages couple only to their neighbours; what all of them share, such as a free horizon, and one end of what is tied at
both ends, stand last, as a border.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import LinAlgError, cho_solve_banded, cholesky, cholesky_banded, solve_triangular

__all__ = ["Bordered", "Cholesky"]


class Bordered:
    """An order of variables in which entries lie near the diagonal, but for those of the last ones.

    Attributes:
        place: Where each variable stands. Shape (n,). inner: How many stand before the border.
        width: Of the band below the diagonal.

    Args:
        row, column: Where entries may be, in the order in which variables are declared; both halves or one.
        size: Number of variables n.
    """

    def __init__(self, row: np.ndarray, column: np.ndarray, size: int) -> None:
        apart = np.abs(row - column)
        last = _border(row, column, apart, size)
        self.inner = size - len(last)
        self.place = np.empty(size, dtype=np.int64)
        self.place[np.concatenate([np.setdiff1d(np.arange(size), last), last])] = np.arange(size)
        i, j = self.place[row], self.place[column]
        self.width = int(np.abs(i - j)[np.maximum(i, j) < self.inner].max(initial=0))
        self._size = size

    def at(self, first: np.ndarray, second: np.ndarray) -> np.ndarray:
        """Where :meth:`cholesky` asks for the entries at these places of the order, whose first is not before."""
        band = second * self.width + first
        below = (self.width + 1) * self.inner + (first - self.inner) * self._size + second
        return np.asarray(np.where(first < self.inner, band, below))

    @property
    def length(self) -> int:
        """Of the values that :meth:`cholesky` asks for."""
        return (self.width + 1) * self.inner + (self._size - self.inner) * self._size

    def cholesky(self, values: np.ndarray) -> Cholesky | None:
        """The factors of a matrix; None where it is not positive definite, or no number.

        Args:
            values: Of its lower half, each where :meth:`at` says, and 0 elsewhere. Overwritten.
        """
        if not np.all(np.isfinite(values)):
            return None
        n, k = self.inner, self._size - self.inner
        band = values[: (self.width + 1) * n].reshape(n, self.width + 1).T
        below = values[(self.width + 1) * n :].reshape(k, self._size)
        try:
            lower = cholesky_banded(band, overwrite_ab=True, lower=True, check_finite=False) if n else band
            solved = cho_solve_banded((lower, True), below[:, :n].T, check_finite=False) if n and k else below[:, :n].T
            corner = cholesky(below[:, n:] - below[:, :n] @ solved, lower=True, check_finite=False) if k else below
        except LinAlgError:
            return None
        return Cholesky(self.place, lower, below[:, :n], solved, corner)


@dataclass(frozen=True)
class Cholesky:
    """Factors of a positive definite matrix: of its band, and of what its border (k) adds.

    Attributes:
        place: Where each variable stands. lower: Of the band, as LAPACK keeps it. below: Rows of the border (k, n).
        solved: The band's solutions for them (n, k). corner: Lower factor of what is left of the border (k, k).
    """

    place: np.ndarray
    lower: np.ndarray
    below: np.ndarray
    solved: np.ndarray
    corner: np.ndarray

    def solve(self, right: np.ndarray) -> np.ndarray:
        """For a right side (n,), both in the order of :class:`Bordered`."""
        n = self.below.shape[1]
        found = cho_solve_banded((self.lower, True), right[:n], check_finite=False) if n else right[:n]
        if not len(self.below):
            return np.asarray(found)
        half = solve_triangular(self.corner, right[n:] - self.below @ found, lower=True, check_finite=False)
        last = solve_triangular(self.corner, half, trans=1, lower=True, check_finite=False)
        return np.concatenate([found - self.solved @ last, last])


def _border(row: np.ndarray, column: np.ndarray, apart: np.ndarray, size: int) -> np.ndarray:
    """The variables that stand last: those with most entries of what reaches far, so many that the work is least."""
    degree = np.bincount(row, minlength=size) + np.bincount(column, minlength=size)
    out, chosen, least, count = np.zeros(size, dtype=bool), list[int](), np.inf, 0
    for k in np.argsort(-apart, kind="stable"):
        i, j = row[k], column[k]
        if out[i] or out[j]:
            continue
        # the work is that of (width + 2 of the border)^2
        if apart[k] + 2 * len(chosen) < least:
            least, count = apart[k] + 2 * len(chosen), len(chosen)
        if 2 * len(chosen) >= least:
            break
        chosen.append(int(i if degree[i] >= degree[j] else j))
        out[chosen[-1]] = True
    return np.sort(np.array(chosen[:count], dtype=np.int64))
