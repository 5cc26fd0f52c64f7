"""A plan solved again beside itself: Newton's method on the conditions of first order, with the limits held that push.

With the limits known that push, an optimum is the root of a smooth system, and the plan beside it is a good start: one
factorization and a few back-substitutions, which are Newton's steps with its matrix kept while they still gain. Rows
that others imply may be missed a little (Wright 1998, stabilized sequential quadratic programming): so limits that
repeat each other are no matter, and what is found meets them all the same.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.sparse as sp
import scipy.sparse.linalg as sla

from ocp.console import reason_to_stop
from ocp.direct.assembly import Program
from ocp.direct.fragment import Fragment
from ocp.direct.kkt import Sides, corrected, curves_upwards, scaled
from ocp.direct.nlp import ROUNDING, Outcome
from ocp.direct.scaling import Scales

__all__ = ["Newton"]

TOLERANCE = 1e-10
"""Of slopes, relative to a hundredth of the largest multiplier, of rows, relative to the largest variable, and of the
cost, by what rows are missed; all relative to 1 at least."""
ROOM = 1e-9  # by which limits that are let go may be passed, relative to the value and at least to 1
MOST_SETS = 8  # of limits held in turn
MOST_STEPS = 24  # in all: more, and an interior point from the guess is as quick
MOST_BORDERS = 16  # limits that are held or let go without making the matrix anew
GAIN = 0.1  # of what is missed, by each step at least: else the matrix is made anew
SOFTENED = 1e-10
"""By which rows may be missed while solving, relative to their own size and to the curvature."""
WEIGHT = 100.0  # of multipliers, as ipopt judges slopes by them
TINY = 1e-300
WIDE = 0.5  # of all variables: rows that reach farther stand last


class Newton:
    """Newton's method for one program, its system in the order of the horizon.

    Args:
        program, fragment: What is solved.
    """

    def __init__(self, program: Program, fragment: Fragment) -> None:
        self._program = program
        n, m = fragment.size, fragment.n_rows
        row, column = (np.array(part, dtype=int) for part in program.jacobian.sparsity_out(1).get_triplet())
        first, second = (np.array(part, dtype=int) for part in program.hessian.sparsity_out(0).get_triplet())
        # a row stands behind its variables; the horizon, and rows that tie both ends, last
        local = column != (-1 if fragment.horizon is None else fragment.horizon)
        last, least = np.zeros(m), np.full(m, float(n))
        np.maximum.at(last, row[local], column[local])
        np.minimum.at(least, row[local], column[local])
        behind = np.where(last - least > WIDE * n, n, last) + 0.5
        place = np.empty(n + m, dtype=int)
        place[np.argsort(np.concatenate([np.arange(n), behind]), kind="stable")] = np.arange(n + m)
        of_x, of_g = place[:n], place[n:]
        off = first != second
        self._entries = row, column, first, second, off
        rows = np.concatenate([of_x[first], of_x[second[off]], of_g[row], of_x[column], of_x, of_g])
        columns = np.concatenate([of_x[second], of_x[first[off]], of_x[column], of_g[row], of_x, of_g])
        where, self._number = np.unique(columns * (n + m) + rows, return_inverse=True)
        self._indices = (where % (n + m)).astype(np.int32)
        self._starts = np.searchsorted(where // (n + m), np.arange(n + m + 1)).astype(np.int32)
        self._place = place

    def beside(self, start: Outcome, sides: Sides, arguments: dict[str, np.ndarray], scales: Scales) -> Outcome | None:
        """The optimum near a plan, of other parameters or bounds; None where it is not found at once.

        First the limits are held that push in the plan, and the others let go; then what comes out of it says which
        (Hintermueller, Ito, Kunisch 2002).

        Args:
            start: The plan: its variables and multipliers.
            sides: On which side each variable (x) and row (g) is held: -1 below, 1 above, 0 at none.
            arguments: p and the bounds. scales: By which misses and multipliers are judged.
        """
        began, tried, steps, factors = time.monotonic(), list[Sides](), 0, None
        while len(tried) < MOST_SETS and not any(_same(sides, each) for each in tried):
            tried.append(sides)
            at = self._held(start, sides, arguments, scales, factors, MOST_STEPS - steps)
            steps, factors = steps + at.steps, at.factors
            if not at.found:
                return None
            start = Outcome(at.v, 0.0, at.rows, at.lam, True, "Solve_Succeeded", steps, 0.0, False, "newton")
            after = corrected(self._program, start, arguments, scales, sides, ROOM)
            if after is None:
                return None
            if _same(after, sides):
                cost, _ = self._program.numbers.values(at.v, arguments["p"])
                if not curves_upwards(self._program, start, arguments, scales):  # it is a saddle, or nearly one
                    return None
                seconds = time.monotonic() - began
                return Outcome(at.v, cost, at.rows, at.lam, True, start.status, steps, seconds, False, "newton")
            sides = after
        return None

    def _held(
        self,
        start: Outcome,
        sides: Sides,
        arguments: dict[str, np.ndarray],
        scales: Scales,
        factors: _Factors | None,
        most: int,
    ) -> _End:
        """So many of Newton's steps at most, with some limits held and the others let go.

        With the factors of other limits as long as these do.
        """
        a, b, c, p = scales.variables, scales.rows, scales.cost, arguments["p"]
        low, high = arguments["lbx"], arguments["ubx"]
        fixed, goal = (low == high) | (sides["x"] != 0), np.where(sides["x"] > 0, high, low)
        v = np.where(fixed, goal, start.variables)
        low, high = arguments["lbg"], arguments["ubg"]
        held, aim = (low == high) | (sides["g"] != 0), np.where(sides["g"] > 0, high, low)
        lam = np.where(held, start.multipliers, 0.0)
        border = None if factors is None else factors.border(fixed, held)
        before, is_new, last = np.inf, False, (v, lam)
        for step in range(most + 1):
            slope, jacobian = self._program.numbers.first(v, p)
            cost, rows = self._program.numbers.values(v, p)
            falls = np.where(fixed, 0.0, (slope + jacobian.T @ lam) * (a / c))
            gaps = np.where(held, rows - aim, 0.0) / b
            push = np.abs(lam * b / c)
            missed = max(
                np.abs(falls).max(initial=0.0) / max(1.0, push.max(initial=0.0) / WEIGHT),
                np.abs(gaps).max(initial=0.0) / np.abs(v / a).max(initial=1.0),
                float(push @ np.abs(gaps)) / max(1.0, abs(cost / c)),  # what the gaps are worth
            )
            if missed <= TOLERANCE or (is_new and GAIN * before < missed <= ROUNDING):  # rounding leaves no more
                return _End(True, step, v, rows, lam, factors)
            if border is not None and border.columns.size and not missed <= GAIN * before:  # it is of little use
                border, before, (v, lam) = None, np.inf, last
                continue
            if step == most or not missed < np.inf or (is_new and missed > before and step > 1) or reason_to_stop():
                break
            is_new = factors is None or border is None or missed > GAIN * before
            if is_new:
                try:
                    factors = self._factors(v, p, lam, jacobian, (fixed, held), scales)
                except RuntimeError:  # it is singular
                    break
                border = factors.border(fixed, held)
            assert factors is not None
            assert border is not None
            before, last = missed, (v, lam)
            of_x, of_g = factors.step(falls, gaps, border)
            v, lam = v + of_x * a, lam + of_g * (c / b)
        return _End(False, step, v, rows, lam, factors)

    def _factors(
        self,
        v: np.ndarray,
        p: np.ndarray,
        lam: np.ndarray,
        jacobian: sp.csc_array,
        which: tuple[np.ndarray, np.ndarray],
        scales: Scales,
    ) -> _Factors:
        """The system's factors, of scaled variables and rows; ``which`` variables are fixed and which rows held.

        Raises:
            RuntimeError: It is singular.
        """
        (row, column, first, second, off), (fixed, held) = self._entries, which
        a, b, c = scales.variables, scales.rows, scales.cost
        free = np.where(fixed, 0.0, a)
        curves = self._program.numbers.second(v, p, 1.0 / c, lam / c).data * free[first] * free[second]
        slopes = jacobian.data * np.where(held, 1.0 / b, 0.0)[row] * free[column]
        size = np.bincount(row, slopes**2, minlength=len(b))
        steepest = max(float(np.abs(curves).max(initial=0.0)), TINY)
        soft = np.where(size > 0, -SOFTENED * size / steepest, 1.0)
        parts = curves, curves[off], slopes, slopes, 1.0 * fixed, soft
        values = np.bincount(self._number, np.concatenate(parts), minlength=len(self._indices))
        system = sp.csc_array((values, self._indices, self._starts), shape=(len(self._place),) * 2, copy=True)
        system.eliminate_zeros()
        factors = sla.splu(system, permc_spec="NATURAL", relax=1, panel_size=4)
        return _Factors(factors, self._place, scaled(jacobian, 1.0 / b, free), fixed, held)


@dataclass(frozen=True)
class _Border:
    """What makes a system with some limits held one with others: rows and columns behind its own.

    Attributes:
        columns: In the order of variables and rows. Shape (n + m, k). solved: The system's solutions for them.
        inner: What is left to solve. Shape (k, k). new: Rows that are held now, the last of the columns.
    """

    columns: np.ndarray
    solved: np.ndarray
    inner: np.ndarray
    new: np.ndarray


@dataclass(frozen=True)
class _Factors:
    """The factors of the system at a point, and of which it was made.

    Attributes:
        own: Of SuperLU. place: Where each variable and row stands there. slopes: Scaled, of all rows (m, n).
        fixed, held: Variables (n,) and rows (m,).
    """

    own: Any
    place: np.ndarray
    slopes: sp.csc_array
    fixed: np.ndarray
    held: np.ndarray

    def solve(self, right: np.ndarray) -> np.ndarray:
        """For right sides (n + m, ...)."""
        moved = np.empty_like(right)
        moved[self.place] = right
        return np.asarray(self.own.solve(moved)[self.place])

    def border(self, fixed: np.ndarray, held: np.ndarray) -> _Border | None:
        """What is to be added where other limits are held; None where it is as little work to begin anew."""
        n, m = len(fixed), len(held)
        stopped, released = np.flatnonzero(fixed & ~self.fixed), np.flatnonzero(self.held & ~held)
        new = np.flatnonzero(held & ~self.held)
        if np.any(self.fixed & ~fixed) or len(stopped) + len(released) + len(new) > MOST_BORDERS:
            return None
        columns = np.zeros((n + m, len(stopped) + len(released) + len(new)))
        if columns.size:
            alone = np.concatenate([stopped, n + released])
            columns[alone, np.arange(len(alone))] = 1.0
            columns[:n, len(alone) :] = self.slopes[new].T.toarray()
        solved = self.solve(columns) if columns.size else columns
        return _Border(columns, solved, columns.T @ solved, new)

    def step(self, falls: np.ndarray, gaps: np.ndarray, border: _Border) -> tuple[np.ndarray, np.ndarray]:
        """Newton's step of variables and multipliers, scaled; not finite where there is none."""
        n, right = len(falls), -np.concatenate([falls, gaps])
        right[n + border.new] = 0.0
        change = self.solve(right)
        if border.columns.size:
            aims = np.zeros(border.columns.shape[1])
            aims[len(aims) - len(border.new) :] = -gaps[border.new]
            try:
                forces = np.linalg.solve(border.inner, border.columns.T @ change - aims)
            except np.linalg.LinAlgError:
                forces = np.full(len(aims), np.nan)
            change = change - border.solved @ forces
            change[n + border.new] = forces[len(aims) - len(border.new) :]
        return change[:n], change[n:]


@dataclass(frozen=True)
class _End:
    """Where Newton's steps ended: whether at a root, after how many, variables, rows and multipliers, last factors."""

    found: bool
    steps: int
    v: np.ndarray
    rows: np.ndarray
    lam: np.ndarray
    factors: _Factors | None


def _same(sides: Sides, others: Sides) -> bool:
    """Whether the same limits are held."""
    return all(np.array_equal(side, others[kind]) for kind, side in sides.items())
