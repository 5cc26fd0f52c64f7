"""A plan solved again beside itself: Newton's method on the conditions of first order, with the limits held that push.

With the limits known that push, an optimum is the root of a smooth system, and the plan beside it is a good start: one
factorization and a few back-substitutions, which are Newton's steps with its matrix kept while they still gain. The
matrix is the Hessian with what misses the limits at a price (Hestenes 1969, Powell 1969, method of multipliers): it
is a narrow band, limits that repeat each other are no matter, and where it is positive definite the cost curves upwards
along all that the limits leave free, so what is found is a plan and no saddle.

The conditions of first order at an optimum as a linear system: which limits push.

Nocedal, Wright 2006, Numerical Optimization, chapters 12 and 16.

Symmetric matrices that are a band but for a few variables, and whether they are positive definite.

Stages couple only to their neighbours; what all of them share, such as a free horizon, and one end of what is tied at
both ends, stand last, as a border.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
import scipy.sparse as sp
from scipy.linalg import LinAlgError, cho_solve_banded, cholesky, cholesky_banded, solve_triangular

from ocp.console import reason_to_stop
from ocp.direct.assembly import Program, Transcription
from ocp.direct.nlp import SOLVER_RESIDUAL, Outcome
from ocp.direct.scaling import Scales
from ocp.status import SolverStatus
from ocp.tolerances import ROUNDING_SHARE

__all__ = [
    "RESOLVED",
    "Bordered",
    "Cholesky",
    "Conditions",
    "Newton",
    "Sides",
    "active_sides",
    "conditions",
    "corrected",
    "scaled",
]

Sides: TypeAlias = dict[str, np.ndarray]
"""On which side each variable (x) and row (g) is held: -1 below, 1 above, 0 at none."""
RESOLVED = 10 * SOLVER_RESIDUAL
"""In units of the solver: the largest slope along what no limit holds, a plan costs the square of it too much; the
distance to a limit at which it is touched though it does not push; and what a linear system may be missed by."""


@dataclass(frozen=True)
class Conditions:
    """First and second derivatives of a program at a plan, in units of the solver.

    Attributes:
        hessian: Of the Lagrangian, both halves. Shape (n, n). jacobian: Of the rows. Shape (m, n).
        of_bounds: Multipliers of the bounds of the variables (n,). of_rows: Of the rows (m,).
        held, fixed: Which rows and which variables stand at a limit that pushes, or are given.
    """

    hessian: sp.csc_array
    jacobian: sp.csr_array
    of_bounds: np.ndarray
    of_rows: np.ndarray
    held: np.ndarray
    fixed: np.ndarray


def conditions(program: Program, outcome: Outcome, arguments: dict[str, np.ndarray], scales: Scales) -> Conditions:
    """The conditions at what a solver found under these arguments (p and bounds)."""
    v, lam, p = outcome.variables, outcome.multipliers, arguments["p"]
    a, b, c = scales.variables, scales.rows, scales.cost
    slope, jacobian = program.numbers.first(v, p)
    slope, jacobian = slope * a / c, scaled(jacobian, 1 / b, a)
    half = scaled(program.numbers.second(v, p, 1.0, lam), a / c, a)
    hessian = half + sp.triu(half, 1).T
    of_rows = lam * b / c
    of_bounds = -(slope + jacobian.T @ of_rows)
    held = at_limit(outcome.rows / b, arguments["lbg"] / b, arguments["ubg"] / b, of_rows)
    fixed = at_limit(v / a, arguments["lbx"] / a, arguments["ubx"] / a, of_bounds)
    return Conditions(sp.csc_array(hessian), sp.csr_array(jacobian), of_bounds, of_rows, held, fixed)


def pushes(program: Program, outcome: Outcome, p: np.ndarray, scales: Scales) -> tuple[np.ndarray, np.ndarray]:
    """Multipliers of the bounds of the variables (n,) and of the rows (m,), in units of the solver."""
    v, lam = outcome.variables, outcome.multipliers
    slope, jacobian = program.numbers.first(v, p)
    return -(slope + jacobian.T @ lam) * scales.variables / scales.cost, lam * scales.rows / scales.cost


def active_sides(program: Program, outcome: Outcome, arguments: dict[str, np.ndarray], scales: Scales) -> Sides:
    """On which side each variable (x) and row (g) stands at a limit that pushes: -1 below, 1 above, 0 at none."""
    push = dict(zip("xg", pushes(program, outcome, arguments["p"], scales), strict=True))
    values, units = {"x": outcome.variables, "g": outcome.rows}, {"x": scales.variables, "g": scales.rows}
    sides = {}
    for kind, unit in units.items():
        low, high = arguments[f"lb{kind}"] / unit, arguments[f"ub{kind}"] / unit
        held = at_limit(values[kind] / unit, low, high, push[kind])
        sides[kind] = np.where(held & (low < high), np.sign(push[kind]), 0.0)
    return sides


def corrected(
    program: Program, outcome: Outcome, arguments: dict[str, np.ndarray], scales: Scales, sides: Sides, tolerance: float
) -> Sides | None:
    """Which limits to hold next, after some were held and the others let go: those that push, and those missed.

    Where these are the same as before, what was found is right. None where the cost still falls along what is free,
    as where rounding ended the solve too early. Hintermueller, Ito, Kunisch 2002, The primal-dual
    active set strategy as a semismooth Newton method.
    """
    push = dict(zip("xg", pushes(program, outcome, arguments["p"], scales), strict=True))
    values, units = {"x": outcome.variables, "g": outcome.rows}, {"x": scales.variables, "g": scales.rows}
    free = (sides["x"] == 0) & (arguments["lbx"] < arguments["ubx"])
    if not np.all(np.abs(push["x"][free]) <= RESOLVED):  # nor where it is no number
        return None
    found = {}
    for kind, unit in units.items():
        value, side = values[kind] / unit, sides[kind]
        low, high = arguments[f"lb{kind}"] / unit, arguments[f"ub{kind}"] / unit
        room = tolerance * np.maximum(1.0, np.abs(value))
        kept = np.where(push[kind] * side > SOLVER_RESIDUAL, side, 0.0)  # the others pull, or more do their work
        missed = np.where(low < high, 1.0 * (value > high + room) - (value < low - room), 0.0)
        found[kind] = np.where(missed != 0, missed, kept)
    return found


def at_limit(value: np.ndarray, lower: np.ndarray, upper: np.ndarray, push: np.ndarray) -> np.ndarray:
    """Which values are given, or held by a limit that pushes more than it is away."""
    with np.errstate(invalid="ignore"):
        below = (push < -SOLVER_RESIDUAL) & (value - lower < -push)
        above = (push > SOLVER_RESIDUAL) & (upper - value < push)
    return np.asarray((lower == upper) | below | above)


def scaled(matrix: sp.csc_array, rows: np.ndarray, columns: np.ndarray) -> sp.csc_array:
    """A matrix with its rows and its columns times factors."""
    by = rows[matrix.indices] * np.repeat(columns, np.diff(matrix.indptr))
    return sp.csc_array((matrix.data * by, matrix.indices, matrix.indptr), shape=matrix.shape)


@dataclass(frozen=True)
class NewtonSettings:
    """When Newton's method has ended, and when it gives up.

    Attributes:
        tolerance: Of slopes, relative to the largest multiplier over ``multipliers``, of rows, relative to the largest
            variable, and of the cost, by what rows are missed; all relative to 1 at least.
        multipliers: By which ipopt, too, divides the largest multiplier to judge slopes (its s_max).
        sets: The most sets of limits that are held in turn.
        steps: The most steps in all: more, and an interior point from the guess is as quick.
        exact: Share of what a step misses in its linear system that is left, unless a pass gains less than ``gain``.
        gain: Share of what is missed that each step leaves at most: else the matrix is made anew.
        price: Of what misses the limits, against the largest curvature: as much as rounding allows.
    """

    tolerance: float = 1e-10
    multipliers: float = 100.0
    sets: int = 8
    steps: int = 24
    exact: float = 1e-6
    gain: float = 0.1
    price: float = 1e6


class Newton:
    """Newton's method for one program, its matrix in an order in which it is a band.

    Args:
        program, transcription: What is solved.
    """

    def __init__(
        self, program: Program, transcription: Transcription, settings: NewtonSettings = NewtonSettings()
    ) -> None:
        self._program, self._settings = program, settings
        n, m = transcription.size, transcription.n_rows
        row, column = (np.array(part, dtype=np.int64) for part in program.jacobian.sparsity_out(1).get_triplet())
        first, second = (np.array(part, dtype=np.int64) for part in program.hessian.sparsity_out(0).get_triplet())
        self._row, self._column, self._first, self._second = row, column, first, second
        slopes = sp.csr_array((np.ones(len(row)), (row, column)), shape=(m, n))
        both = (slopes.T @ slopes).tocoo()
        self._order = Bordered(np.concatenate([both.row, first]), np.concatenate([both.col, second]), n)
        place = self._order.place
        i, j = place[first], place[second]
        self._of_hessian = self._order.at(np.maximum(i, j), np.minimum(i, j))
        self._of_diagonal = self._order.at(place, place)
        # the rows' slopes in this order, row by row and column by column
        at = place[column]
        self._by_row, self._by_column = np.lexsort((at, row)), np.lexsort((row, at))
        self._starts = tuple(np.searchsorted(np.sort(each), np.arange(k + 1)) for each, k in ((row, m), (at, n)))
        self._within = at[self._by_row], row[self._by_column]

    def beside(self, start: Outcome, sides: Sides, arguments: dict[str, np.ndarray], scales: Scales) -> Outcome | None:
        """The optimum near a plan, of other parameters or bounds; None where it is not found at once.

        First the limits are held that push in the plan, and the others let go; then what comes out of it says which
        (Hintermueller, Ito, Kunisch 2002).

        Args:
            start: The plan: its variables and multipliers.
            sides: On which side each variable (x) and row (g) is held: -1 below, 1 above, 0 at none.
            arguments: p and the bounds. scales: By which misses and multipliers are judged.
        """
        began, tried, steps = time.monotonic(), list[Sides](), 0
        while len(tried) < self._settings.sets and not any(_same(sides, each) for each in tried):
            tried.append(sides)
            at = self._root(start, sides, arguments, scales, self._settings.steps - steps)
            if at is None:
                return None
            steps += at.steps
            start = Outcome(at.v, 0.0, at.rows, at.lam, SolverStatus.SOLVED, "", steps, 0.0, False, "newton")
            after = corrected(self._program, start, arguments, scales, sides, ROUNDING_SHARE)
            if after is None:
                return None
            if _same(after, sides):
                cost, _ = self._program.numbers.values(at.v, arguments["p"])
                which = _held(sides, arguments)
                if self._matrix(at.v, arguments["p"], at.lam, which, scales, local=True) is None:  # it is a saddle
                    return None
                seconds = time.monotonic() - began
                return Outcome(
                    at.v, cost, at.rows, at.lam, start.status, str(start.status), steps, seconds, False, "newton"
                )
            sides = after
        return None

    def _root(
        self, start: Outcome, sides: Sides, arguments: dict[str, np.ndarray], scales: Scales, most: int
    ) -> _Root | None:
        """``most`` of Newton's steps, with some limits held and the others let go; None where they lead nowhere."""
        a, b, c, p, own = scales.variables, scales.rows, scales.cost, arguments["p"], self._settings
        fixed, held = _held(sides, arguments)
        goal = np.where(sides["x"] > 0, arguments["ubx"], arguments["lbx"])
        aim = np.where(sides["g"] > 0, arguments["ubg"], arguments["lbg"])
        v, lam = np.where(fixed, goal, start.variables), np.where(held, start.multipliers, 0.0)
        before, is_new, matrix = np.inf, False, None
        for step in range(most + 1):
            slope, jacobian = self._program.numbers.first(v, p)
            cost, rows = self._program.numbers.values(v, p)
            along = np.bincount(self._column, jacobian.data * lam[self._row], minlength=len(v))
            falls = np.where(fixed, 0.0, (slope + along) * (a / c))
            gaps = np.where(held, rows - aim, 0.0) / b
            push = np.abs(lam * b / c)
            missed = max(
                np.abs(falls).max(initial=0.0) / max(1.0, push.max(initial=0.0) / own.multipliers),
                np.abs(gaps).max(initial=0.0) / np.abs(v / a).max(initial=1.0),
                float(push @ np.abs(gaps)) / max(1.0, abs(cost / c)),  # what the gaps are worth
            )
            stalls = is_new and own.gain * before < missed <= SOLVER_RESIDUAL  # rounding leaves no more
            if missed <= own.tolerance or stalls:
                return _Root(step, v, rows, lam)
            if step == most or not missed < np.inf or (is_new and missed > before and step > 1) or reason_to_stop():
                return None
            is_new = matrix is None or missed > own.gain * before
            if is_new:
                matrix = self._matrix(v, p, lam, (fixed, held), scales)
            if matrix is None:
                return None
            before = missed
            of_x, of_g = matrix.step(falls, gaps)
            v, lam = v + of_x * a, lam + of_g * (c / b)
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
        """Newton's matrix, of scaled variables and rows; None where it is not positive definite.

        ``which`` variables are fixed and which rows held. ``local``: The price of a row is against the curvature of its
        own variables alone: so rounding hides nothing of those that are small.

        That it is so exactly if the cost curves upwards along what is free, once the price is high enough, is Finsler's
        lemma.
        """
        a, b, c = scales.variables, scales.rows, scales.cost
        fixed, held = which
        free = np.where(fixed, 0.0, a)
        curves = self._program.numbers.second(v, p, 1.0 / c, lam / c).data * free[self._first] * free[self._second]
        slopes = (
            self._program.numbers.first(v, p)[1].data * np.where(held, 1.0 / b, 0.0)[self._row] * free[self._column]
        )
        if not np.all(np.isfinite(curves)) or not np.all(np.isfinite(slopes)):
            return None
        size = np.sqrt(np.bincount(self._row, slopes**2, minlength=len(b)))
        n, m = len(a), len(b)
        own, among = np.zeros(n), np.zeros(m)
        for index in (self._first, self._second):
            np.maximum.at(own, index, np.abs(curves))
        largest = float(own.max(initial=0.0)) or 1.0
        if local:
            np.maximum.at(among, self._row, np.where(slopes != 0, own[self._column], 0.0))
        weight = np.divide(np.sqrt(np.where(among > 0, among / largest, 1.0)), size, out=np.zeros(m), where=size > 0)
        slopes *= weight[self._row]
        price = self._settings.price * largest
        by_row = sp.csr_array((slopes[self._by_row], self._within[0], self._starts[0]), shape=(m, n))
        by_column = sp.csr_array((slopes[self._by_column], self._within[1], self._starts[1]), shape=(n, m))
        missing = by_column @ by_row
        i, j = np.repeat(np.arange(n), np.diff(missing.indptr)), missing.indices.astype(np.int64)
        lower = np.flatnonzero(i >= j)
        values = np.zeros(self._order.length)
        values[self._order.at(i[lower], j[lower])] = price * missing.data[lower]
        values[self._of_hessian] += curves
        values[self._of_diagonal] *= 1.0 + 4 * np.finfo(float).eps  # what is as flat may be rounding
        values[self._of_diagonal[fixed]] = 1.0
        factors = self._order.cholesky(values)
        return None if factors is None else _Matrix(factors, by_row, by_column, weight, price, self._settings)


@dataclass(frozen=True)
class _Matrix:
    """Newton's matrix at a point: that of its conditions, in which missing the limits has a price.

    Attributes:
        factors: Of the Hessian and the price times what is missed. price: Of rows of unit length.
        by_row, by_column: Slopes of the rows, (m, n) and (n, m), in the factors' order. weight: Of each row (m,).
    """

    factors: Cholesky
    by_row: sp.csr_array
    by_column: sp.csr_array
    weight: np.ndarray
    price: float
    settings: NewtonSettings

    def step(self, falls: np.ndarray, gaps: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Newton's step of variables and multipliers, scaled.

        Each pass pays the price for what the last one missed.
        """
        place, gaps = self.factors.place, self.weight * gaps
        right = np.empty_like(falls)
        right[place] = falls
        push, goal, last = np.zeros_like(gaps), 0.0, np.inf
        while True:
            move = -self.factors.solve(right + self.by_column @ (push + self.price * gaps))
            missed = self.by_row @ move + gaps
            push = push + self.price * missed
            worst = float(np.abs(missed).max(initial=0.0))
            goal = goal or self.settings.exact * max(worst, float(np.abs(gaps).max(initial=0.0)))
            if not goal < worst < (1 - self.settings.gain) * last:
                break
            last = worst
        return move[place], self.weight * push


@dataclass(frozen=True)
class _Root:
    """Where Newton's steps ended at a root: after how many, its variables, rows and multipliers."""

    steps: int
    v: np.ndarray
    rows: np.ndarray
    lam: np.ndarray


def _held(sides: Sides, arguments: dict[str, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Which variables (n,) and rows (m,) are given, or held at a limit."""
    fixed, held = ((arguments[f"lb{kind}"] == arguments[f"ub{kind}"]) | (sides[kind] != 0) for kind in "xg")
    return fixed, held


def _same(sides: Sides, others: Sides) -> bool:
    """Whether the same limits are held."""
    return all(np.array_equal(side, others[kind]) for kind, side in sides.items())


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
