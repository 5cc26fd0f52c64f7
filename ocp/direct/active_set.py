"""Newton's method on the first-order conditions near a known plan, with the active limits of the plan as equalities.

If the active limits are known, an optimum is the root of a smooth system, and a neighbouring plan is a good start: one
factorisation and a few back-substitutions, Newton steps whose matrix is kept while they converge well. The matrix is
the Hessian plus a penalty on the active constraints (method of multipliers: Hestenes 1969, Powell 1969). It is a narrow
band, and dependent limits are harmless. If it is positive definite, the cost curves upwards along all free directions,
so that the result is a minimum and no saddle point.

The module also holds the first-order conditions as a linear system (Nocedal, Wright 2006, Numerical Optimization,
chapters 12 and 16) and the Cholesky factorisation of banded matrices with a border. Stages couple only to their
neighbours. Variables that all of them share, such as a free horizon, and one end of periodic constraints form the
border.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from typing import TypeAlias

import numpy as np
import scipy

from ocp.console import reason_to_stop
from ocp.direct.assembly import Program, Transcription, places_of
from ocp.direct.nlp import SOLVER_RESIDUAL, Outcome
from ocp.direct.scaling import Scales
from ocp.errors import SolverStatus
from ocp.tolerances import ROUNDING_SHARE

Sides: TypeAlias = dict[str, np.ndarray]
"""Active limit of each variable (x) and each constraint row (g) of a program: -1 lower, 1 upper, 0 none."""
RESOLVED = 10 * SOLVER_RESIDUAL
"""Tolerance, in the solver's scaled units, of gradients, of residuals of linear systems and of distances to limits. The
square of the gradient along free directions is the excess cost. A limit at a smaller distance is active even without a
multiplier."""


@dataclass(frozen=True)
class Conditions:
    """Scaled terms of the first-order optimality conditions at a solution: derivatives, multipliers and active limits.

    Attributes:
        hessian: Hessian of the Lagrangian, both triangles. Shape (n, n).
        jacobian: Jacobian of the rows. Shape (m, n).
        of_bounds, of_rows: Multipliers of the bounds of the variables (n,) and of the rows (m,).
        held, fixed: Which rows (m,) and variables (n,) are equalities or at a limit with a multiplier.
    """

    hessian: scipy.sparse.csc_array
    jacobian: scipy.sparse.csr_array
    of_bounds: np.ndarray
    of_rows: np.ndarray
    held: np.ndarray
    fixed: np.ndarray


def conditions(program: Program, outcome: Outcome, arguments: dict[str, np.ndarray], scales: Scales) -> Conditions:
    """Return the terms of the first-order optimality conditions at a solver's result, for given data and bounds."""
    v, lam, p = outcome.variables, outcome.multipliers, arguments["p"]
    a = scales.variables
    jacobian = scipy.sparse.csr_array(scale_matrix(program.numbers.first(v, p)[1], 1 / scales.rows, a))
    half = scale_matrix(program.numbers.second(v, p, 1.0, lam), a / scales.cost, a)
    hessian = scipy.sparse.csc_array(half + scipy.sparse.triu(half, 1).T)
    values = scaled_values(program, outcome, arguments, scales)
    held, fixed = (at_limit(*values[kind]) for kind in "gx")
    return Conditions(hessian, jacobian, values["x"][3], values["g"][3], held, fixed)


def scaled_values(
    program: Program, outcome: Outcome, arguments: dict[str, np.ndarray], scales: Scales
) -> dict[str, tuple[np.ndarray, ...]]:
    """Return values, limits and multipliers of all variables (x) and constraints (g) in the solver's scaled units."""
    v, lam = outcome.variables, outcome.multipliers
    slope, jacobian = program.numbers.first(v, arguments["p"])
    parts = {"x": (v, scales.variables, -(slope + jacobian.T @ lam)), "g": (outcome.rows, scales.rows, lam)}
    return {
        kind: (value / unit, arguments[f"lb{kind}"] / unit, arguments[f"ub{kind}"] / unit, force * unit / scales.cost)
        for kind, (value, unit, force) in parts.items()
    }


def active_sides(program: Program, outcome: Outcome, arguments: dict[str, np.ndarray], scales: Scales) -> Sides:
    """Return which limit of each variable (x) and constraint (g) is active: -1 lower, 1 upper, 0 neither."""
    sides = {}
    for kind, (value, low, high, multiplier) in scaled_values(program, outcome, arguments, scales).items():
        active = at_limit(value, low, high, multiplier)
        sides[kind] = np.where(active & (low < high), np.sign(multiplier), 0.0)
    return sides


def next_active_set(
    program: Program,
    outcome: Outcome,
    arguments: dict[str, np.ndarray],
    scales: Scales,
    *,
    sides: Sides,
    tolerance: float,
) -> Sides | None:
    """Return the next active set: violated limits, and active limits whose multipliers have the right sign.

    The active set is right if it does not change. None if the cost still falls along free directions, as when rounding
    ended the solve too early. Primal-dual active set strategy (Hintermueller, Ito, Kunisch 2002).
    """
    values = scaled_values(program, outcome, arguments, scales)
    free = (sides["x"] == 0) & (arguments["lbx"] < arguments["ubx"])
    if not np.all(np.abs(values["x"][3][free]) <= RESOLVED):  # also for nan
        return None
    result = {}
    for kind, (value, low, high, multiplier) in values.items():
        slack = tolerance * np.maximum(1.0, np.abs(value))
        # others have the wrong sign or are redundant
        remaining = np.where(multiplier * sides[kind] > SOLVER_RESIDUAL, sides[kind], 0.0)
        violated = np.where(low < high, 1.0 * (value > high + slack) - (value < low - slack), 0.0)
        result[kind] = np.where(violated != 0, violated, remaining)
    return result


def at_limit(value: np.ndarray, lower: np.ndarray, upper: np.ndarray, multipliers: np.ndarray) -> np.ndarray:
    """Return which values have equal limits, or a limit whose multiplier is larger than the distance to the limit."""
    with np.errstate(invalid="ignore"):
        below = (multipliers < -SOLVER_RESIDUAL) & (value - lower < -multipliers)
        above = (multipliers > SOLVER_RESIDUAL) & (upper - value < multipliers)
    return np.asarray((lower == upper) | below | above)


def scale_matrix(matrix: scipy.sparse.csc_array, rows: np.ndarray, columns: np.ndarray) -> scipy.sparse.csc_array:
    """Return a sparse matrix with rows and columns multiplied by given factors."""
    factors = rows[matrix.indices] * np.repeat(columns, np.diff(matrix.indptr))
    return scipy.sparse.csc_array((matrix.data * factors, matrix.indices, matrix.indptr), shape=matrix.shape)


@dataclass(frozen=True)
class NewtonSettings:
    """Settings of the convergence and termination of Newton's method.

    Attributes:
        tolerance: Tolerance of gradients, relative to the largest multiplier over ``multipliers``; of rows, relative to
            the largest variable; of the cost of their violation, relative to the cost. References are at least 1.
        multipliers: Divisor of the largest multiplier in the tolerance of gradients, as s_max of ipopt.
        sets: Largest number of active sets.
        steps: Largest number of steps in all. Beyond it an interior-point method from the guess is as fast.
        exact: Relative residual of a step in its linear system, unless a pass gains less than ``gain``.
        gain: Largest ratio of successive residuals for which the matrix is kept.
        price: Penalty relative to the largest curvature: as large as rounding allows.
    """

    tolerance: float = 1e-10
    multipliers: float = 100.0
    sets: int = 8
    steps: int = 24
    exact: float = 1e-6
    gain: float = 0.1
    price: float = 1e6


SETTINGS = NewtonSettings()


class Newton:
    """Newton's method for a nonlinear program, with the variables in an order that makes the Newton matrix banded.

    Args:
        program, transcription: The nonlinear program, and the transcription from which it is assembled.
    """

    def __init__(self, program: Program, transcription: Transcription) -> None:
        self._program = program
        n, m = transcription.size, transcription.n_rows
        row, column = places_of(program.jacobian.sparsity_out(1))
        first, second = places_of(program.hessian.sparsity_out(0))
        self._row, self._column, self._first, self._second = row, column, first, second
        slopes = scipy.sparse.csr_array((np.ones(len(row)), (row, column)), shape=(m, n))
        both = (slopes.T @ slopes).tocoo()
        self._order = Bordered(np.concatenate([both.row, first]), np.concatenate([both.col, second]), n)
        place = self._order.place
        i, j = place[first], place[second]
        self._hessian_at = self._order.at(np.maximum(i, j), np.minimum(i, j))
        self._diagonal_at = self._order.at(place, place)
        # the Jacobian in this order, by rows and by columns
        at = place[column]
        self._by_row, self._by_column = np.lexsort((at, row)), np.lexsort((row, at))
        self._starts = tuple(np.searchsorted(np.sort(each), np.arange(k + 1)) for each, k in ((row, m), (at, n)))
        self._within = at[self._by_row], row[self._by_column]

    def solve_near(
        self, start: Outcome, sides: Sides, arguments: dict[str, np.ndarray], scales: Scales
    ) -> Outcome | None:
        """Return the optimum for changed parameters or bounds, computed from a nearby plan; None without convergence.

        The active limits of the plan are equalities at first. The result determines the next active set (Hintermueller,
        Ito, Kunisch 2002).

        Args:
            start: The plan: its variables and multipliers.
            sides: Active limit of each variable (x) and row (g).
            arguments: p and the bounds.
            scales: Units in which residuals and multipliers are judged.
        """
        began, earlier, steps = time.monotonic(), list[Sides](), 0
        while len(earlier) < SETTINGS.sets and not any(_is_same_set(sides, each) for each in earlier):
            earlier.append(sides)
            root = self._root(start, sides, arguments, scales, SETTINGS.steps - steps)
            if root is None:
                return None
            steps, start = steps + root.iterations, root
            next_sides = next_active_set(self._program, root, arguments, scales, sides=sides, tolerance=ROUNDING_SHARE)
            if next_sides is None:
                return None
            if _is_same_set(next_sides, sides):
                v, lam, p = root.variables, root.multipliers, arguments["p"]
                which = _fixed_entries(sides, arguments)
                if self._matrix(v, p, lam, which, scales, local=True) is None:  # a saddle point
                    return None
                return replace(root, iterations=steps, seconds=time.monotonic() - began)
            sides = next_sides
        return None

    def _root(
        self, start: Outcome, sides: Sides, arguments: dict[str, np.ndarray], scales: Scales, max_steps: int
    ) -> Outcome | None:
        """Return the result of at most ``max_steps`` Newton steps for a fixed active set; None without convergence."""
        a, b, c, p = scales.variables, scales.rows, scales.cost, arguments["p"]
        fixed, held = _fixed_entries(sides, arguments)
        target = np.where(sides["x"] > 0, arguments["ubx"], arguments["lbx"])
        row_target = np.where(sides["g"] > 0, arguments["ubg"], arguments["lbg"])
        v, lam = np.where(fixed, target, start.variables), np.where(held, start.multipliers, 0.0)
        before, is_new, matrix = np.inf, False, None
        for step in range(max_steps + 1):
            slope, jacobian = self._program.numbers.first(v, p)
            cost, rows = self._program.numbers.values(v, p)
            along = np.bincount(self._column, jacobian.data * lam[self._row], minlength=len(v))
            gradient = np.where(fixed, 0.0, (slope + along) * (a / c))
            residual = np.where(held, rows - row_target, 0.0) / b
            multipliers = np.abs(lam * b / c)
            error = max(
                np.abs(gradient).max(initial=0.0) / max(1.0, multipliers.max(initial=0.0) / SETTINGS.multipliers),
                np.abs(residual).max(initial=0.0) / np.abs(v / a).max(initial=1.0),
                float(multipliers @ np.abs(residual)) / max(1.0, abs(cost / c)),  # the cost of the row residuals
            )
            stalls = is_new and SETTINGS.gain * before < error <= SOLVER_RESIDUAL  # limited by rounding
            if error <= SETTINGS.tolerance or stalls:
                status = SolverStatus.SOLVED
                return Outcome(v, cost, rows, lam, status, str(status), step, 0.0, False, "newton")
            if step == max_steps or not error < np.inf or (is_new and error > before and step > 1) or reason_to_stop():
                return None
            is_new = matrix is None or error > SETTINGS.gain * before
            if is_new:
                matrix = self._matrix(v, p, lam, (fixed, held), scales)
            if matrix is None:
                return None
            before = error
            step_x, step_g = matrix.step(gradient, residual)
            v, lam = v + step_x * a, lam + step_g * (c / b)
        return None

    def _matrix(
        self,
        v: np.ndarray,
        p: np.ndarray,
        lam: np.ndarray,
        which: tuple[np.ndarray, np.ndarray],
        scales: Scales,
        local: bool = False,
    ) -> _Matrix | None:
        """Return the factorised Newton matrix of scaled variables and constraints; None if it is not positive definite.

        ``which`` variables are fixed and which rows held. With ``local`` the penalty of a row is relative to the
        curvature of its own variables, so that rounding does not hide small variables. For a sufficient penalty the
        matrix is positive definite exactly if the cost curves upwards along the free directions (Finsler's lemma).
        """
        a, b, c = scales.variables, scales.rows, scales.cost
        fixed, held = which
        free = np.where(fixed, 0.0, a)
        curvature = self._program.numbers.second(v, p, 1.0 / c, lam / c).data * free[self._first] * free[self._second]
        of_held = np.where(held, 1.0 / b, 0.0)[self._row]
        slopes = self._program.numbers.first(v, p)[1].data * of_held * free[self._column]
        if not np.all(np.isfinite(curvature)) or not np.all(np.isfinite(slopes)):
            return None
        size = np.sqrt(np.bincount(self._row, slopes**2, minlength=len(b)))
        n, m = len(a), len(b)
        of_variable, of_row = np.zeros(n), np.zeros(m)
        for index in (self._first, self._second):
            np.maximum.at(of_variable, index, np.abs(curvature))
        largest = float(of_variable.max(initial=0.0)) or 1.0
        if local:
            np.maximum.at(of_row, self._row, np.where(slopes != 0, of_variable[self._column], 0.0))
        weight = np.divide(np.sqrt(np.where(of_row > 0, of_row / largest, 1.0)), size, out=np.zeros(m), where=size > 0)
        slopes *= weight[self._row]
        penalty = SETTINGS.price * largest
        by_row = scipy.sparse.csr_array((slopes[self._by_row], self._within[0], self._starts[0]), shape=(m, n))
        by_column = scipy.sparse.csr_array((slopes[self._by_column], self._within[1], self._starts[1]), shape=(n, m))
        penalty_matrix = by_column @ by_row
        i, j = np.repeat(np.arange(n), np.diff(penalty_matrix.indptr)), penalty_matrix.indices.astype(np.int64)
        lower = np.flatnonzero(i >= j)
        values = np.zeros(self._order.length)
        values[self._order.at(i[lower], j[lower])] = penalty * penalty_matrix.data[lower]
        values[self._hessian_at] += curvature
        values[self._diagonal_at] *= 1.0 + 4 * np.finfo(float).eps  # curvature at this level may be rounding
        values[self._diagonal_at[fixed]] = 1.0
        factors = self._order.cholesky(values)
        return None if factors is None else _Matrix(factors, by_row, by_column, weight, penalty)


@dataclass(frozen=True)
class _Matrix:
    """Factorised Newton matrix at one point of a nonlinear program, with a penalty on the active constraints.

    Attributes:
        factors: Factors of the Hessian plus penalty.
        by_row, by_column: Jacobian of the constraint rows, (m, n), and its transpose, in the order of the factors.
        weight: Scaling of each row to unit length (m,).
        price: Penalty of rows of unit length.
    """

    factors: Cholesky
    by_row: scipy.sparse.csr_array
    by_column: scipy.sparse.csr_array
    weight: np.ndarray
    price: float

    def step(self, gradient: np.ndarray, residual: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Compute the Newton step of the scaled variables and of the multipliers by the method of multipliers."""
        place, residual = self.factors.place, self.weight * residual
        side = np.empty_like(gradient)
        side[place] = gradient
        multipliers, tolerance, last = np.zeros_like(residual), 0.0, np.inf
        while True:
            move = -self.factors.solve(side + self.by_column @ (multipliers + self.price * residual))
            violation = self.by_row @ move + residual
            multipliers = multipliers + self.price * violation
            largest = float(np.abs(violation).max(initial=0.0))
            tolerance = tolerance or SETTINGS.exact * max(largest, float(np.abs(residual).max(initial=0.0)))
            if not tolerance < largest < (1 - SETTINGS.gain) * last:
                break
            last = largest
        return move[place], self.weight * multipliers


def _fixed_entries(sides: Sides, arguments: dict[str, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Return which variables and constraints are fixed, by equal limits or by an active limit. Shapes (n,), (m,)."""
    fixed, held = ((arguments[f"lb{kind}"] == arguments[f"ub{kind}"]) | (sides[kind] != 0) for kind in "xg")
    return fixed, held


def _is_same_set(sides: Sides, other_sides: Sides) -> bool:
    """Return whether two active sets contain the same limits of variables and constraints."""
    return all(np.array_equal(side, other_sides[kind]) for kind, side in sides.items())


class Bordered:
    """An order of variables in which a symmetric matrix is banded, except for a border of a few variables at the end.

    Attributes:
        place: Position of each variable. Shape (n,).
        inner: Number of variables before the border.
        width: Width of the band below the diagonal.

    Args:
        row, column: Positions of nonzeros in the order of declaration; one triangle or both.
        size: Number of variables n.
    """

    def __init__(self, row: np.ndarray, column: np.ndarray, size: int) -> None:
        distance = np.abs(row - column)
        border = _border(row, column, distance, size)
        self.inner = size - len(border)
        self.place = np.empty(size, dtype=np.int64)
        self.place[np.concatenate([np.setdiff1d(np.arange(size), border), border])] = np.arange(size)
        i, j = self.place[row], self.place[column]
        self.width = int(np.abs(i - j)[np.maximum(i, j) < self.inner].max(initial=0))
        self._size = size

    def at(self, first: np.ndarray, second: np.ndarray) -> np.ndarray:
        """Return the indices of matrix entries (row ``first``, column ``second``) in the input of :meth:`cholesky`."""
        band = second * self.width + first
        below = (self.width + 1) * self.inner + (first - self.inner) * self._size + second
        return np.asarray(np.where(first < self.inner, band, below))

    @property
    def length(self) -> int:
        """Length of the input vector of :meth:`cholesky`, which contains the matrix entries."""
        return (self.width + 1) * self.inner + (self._size - self.inner) * self._size

    def cholesky(self, values: np.ndarray) -> Cholesky | None:
        """Return the Cholesky factors of a bordered banded matrix; None if it is not positive definite or not finite.

        Args:
            values: Lower triangle, each entry at the index of :meth:`at`, and 0 elsewhere. Overwritten.
        """
        if not np.all(np.isfinite(values)):
            return None
        n, k = self.inner, self._size - self.inner
        band = values[: (self.width + 1) * n].reshape(n, self.width + 1).T
        border = values[(self.width + 1) * n :].reshape(k, self._size)
        below, corner = border[:, :n], border[:, n:]
        try:
            lower = scipy.linalg.cholesky_banded(band, overwrite_ab=True, lower=True, check_finite=False) if n else band
            solved = scipy.linalg.cho_solve_banded((lower, True), below.T, check_finite=False) if n and k else below.T
            if k:
                corner = scipy.linalg.cholesky(corner - below @ solved, lower=True, check_finite=False)
        except np.linalg.LinAlgError:
            return None
        return Cholesky(self.place, lower, below, solved, corner)


@dataclass(frozen=True)
class Cholesky:
    """Cholesky factors of a banded, positive definite matrix with a border of k variables.

    Attributes:
        place: Position of each variable.
        lower: Factor of the band, in LAPACK's layout.
        below: Rows of the border (k, n).
        solved: Solutions of the banded system for these rows (n, k).
        corner: Lower factor of the Schur complement of the border (k, k).
    """

    place: np.ndarray
    lower: np.ndarray
    below: np.ndarray
    solved: np.ndarray
    corner: np.ndarray

    def solve(self, right: np.ndarray) -> np.ndarray:
        """Solve the linear system for a right-hand side whose order of variables is that of `Bordered`. Shape (n,)."""
        n = self.below.shape[1]
        inner = scipy.linalg.cho_solve_banded((self.lower, True), right[:n], check_finite=False) if n else right[:n]
        if not len(self.below):
            return np.asarray(inner)
        last = scipy.linalg.cho_solve((self.corner, True), right[n:] - self.below @ inner, check_finite=False)
        return np.concatenate([inner - self.solved @ last, last])


def _border(row: np.ndarray, column: np.ndarray, distance: np.ndarray, size: int) -> np.ndarray:
    """Choose the variables that form the border of a banded matrix, so that its factorisation takes little work."""
    degree = np.bincount(row, minlength=size) + np.bincount(column, minlength=size)
    is_border, border, least_work, count = np.zeros(size, dtype=bool), list[int](), np.inf, 0
    for k in np.argsort(-distance, kind="stable"):
        i, j = row[k], column[k]
        if is_border[i] or is_border[j]:
            continue
        # the work is proportional to (width + 2 border)^2
        if distance[k] + 2 * len(border) < least_work:
            least_work, count = distance[k] + 2 * len(border), len(border)
        if 2 * len(border) >= least_work:
            break
        border.append(int(i if degree[i] >= degree[j] else j))
        is_border[border[-1]] = True
    return np.sort(np.array(border[:count], dtype=np.int64))
