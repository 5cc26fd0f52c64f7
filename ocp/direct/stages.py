"""A stage-ordered program as a stage-wise solver reads it: where its variables, rows and numbers stand.

Such a solver wants the controls of a stage before its states, and rows x_next = F(x, u) apart from those inside a
stage. What a stage only copies from the end of its interval is no variable of its own here: the row that defines the
copy defines the next state.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ocp.direct.assembly import Derivatives, gradient_at, hessian_at, jacobian_at
from ocp.direct.fragment import Fragment
from ocp.errors import ProblemError
from ocp.problem.formulation import Formulation

__all__ = ["Entries", "Tables"]


@dataclass(frozen=True)
class Entries:
    """Where numbers stand in a matrix of the program: number ``source`` at (``row``, ``column``), each (E,)."""

    row: np.ndarray
    column: np.ndarray
    source: np.ndarray


class Tables:
    """A stage-ordered program as stages: variables in fatrop's order, and where the numbers of its blocks belong.

    Attributes:
        nx, nu: States and controls of each stage. Shape (N + 1,).
        place: Where each variable of the program stands in fatrop's vector; a copy stands with what it is copied to.
        own: Which variables are no copies. stage, local: Stage of each, and its place (controls, states) there.
        row_stage: Stage of each row. dynamics: Entry of the next state that a row defines, -1 for other rows.
            twin: For each row that only copies, the row that takes its part; -1 for others.
        counts: Numbers of all blocks by kind. jacobian, hessian: Their entries, the constant ones of the Jacobian last.
    """

    def __init__(self, form: Formulation, fragment: Fragment, functions: Sequence[Derivatives]) -> None:
        assert fragment.stages is not None
        sizes = fragment.stages.states, fragment.stages.controls, fragment.stages.rows
        states, controls, rows = (np.array(part) for part in sizes)
        free, zero = (int(form.bounds.places[kind][0]) for kind in ("free", "zero"))
        self.fragment, self.functions = fragment, functions
        n, m, last = fragment.size, fragment.n_rows, len(states) - 1
        first = np.concatenate([[0], np.cumsum(states + controls)])
        self.stage = np.repeat(np.arange(last + 1), states + controls)
        local = np.arange(n) - first[self.stage]
        joins = np.append(states[1:], 0)
        row_first = np.concatenate([[0], np.cumsum(joins + rows)])
        self.row_stage = np.repeat(np.arange(last + 1), joins + rows)
        within = np.arange(m) - row_first[self.row_stage]
        join = within < joins[self.row_stage]

        # what a row copies from: x_next - source = 0
        at, column, value = fragment.linear
        minus = join[at] & (value < 0)
        source, onto = np.full(m, -1), np.full(m, -1)
        source[at[minus]] = column[minus]
        onto[at[join[at] & (value > 0)]] = column[join[at] & (value > 0)]

        # a copy that one row defines, with factor one, and that nothing else reads or bounds
        is_control = local >= states[self.stage]
        read = np.zeros(n, dtype=bool)
        for block in fragment.blocks:
            read[block.variables] = True
        copied = np.zeros(n, dtype=bool)
        copied[source[source >= 0]] = True
        copied &= is_control & ~read & (fragment.variable_bounds == free) & (np.bincount(column, minlength=n) == 2)
        defines = ~join[at] & (value == 1.0) & copied[column] & (fragment.row_bounds[at] == zero)
        definer = np.full(n, -1)
        definer[column[defines]] = at[defines]
        often = np.bincount(definer[definer >= 0], minlength=m) > 1  # a row defines one copy at most
        definer[(definer >= 0) & often[definer]] = -1
        self.own = definer < 0

        self.nx = states
        self.nu = np.bincount(self.stage[self.own & is_control], minlength=last + 1)
        self.first = np.concatenate([[0], np.cumsum(self.nx + self.nu)])
        rank = np.cumsum(self.own & is_control) - 1
        before = np.concatenate([[0], np.cumsum(self.nu)])[self.stage]
        self.local = np.where(is_control, rank - before, self.nu[self.stage] + local)
        self.local[~self.own] = -1
        self.place = self.first[self.stage] + self.local
        self.dynamics = np.where(join, within, -1)
        self.twin = np.full(m, -1)
        copying = np.flatnonzero(source >= 0)
        gone = copying[~self.own[source[copying]]]
        by = definer[source[gone]]
        self.twin[gone], self.dynamics[by], self.dynamics[gone] = by, within[gone], -1
        # a copy stands with the next state, in its units
        self.standing = np.arange(n)
        self.standing[source[gone]] = onto[gone]
        self.place = self.place[self.standing]
        self.onto = onto
        self.onto[by] = onto[gone]

        self._numbers()
        self._check()

    def _check(self) -> None:
        """Raise ProblemError where a row or a curvature reaches over stages."""
        row, column = self.jacobian.row, self.jacobian.column
        ahead = (self.dynamics[row] >= 0) | (self.twin[row] >= 0)
        apart = self.stage[column] - self.row_stage[row]
        if np.any((apart != 0) & ~(ahead & (apart == 1))) or np.any(
            self.stage[self.hessian.row] != self.stage[self.hessian.column]
        ):
            raise ProblemError("a stage-ordered program cannot couple stages that are apart; use ipopt")

    def _numbers(self) -> None:
        """Where the numbers of all blocks belong."""
        counts = [0] * 4
        value_rows, slope_of, jac, hess = [], [], [], []
        for block, of in zip(self.fragment.blocks, self.functions, strict=True):
            k = block.variables.shape[1]
            cost, inner = of.value.sparsity_out(0).nnz(), np.array(of.value.sparsity_out(1).row(), dtype=int)
            rows = np.vstack([np.full((cost, k), -1), block.rows[inner]])
            value_rows.append(rows.ravel(order="F"))
            slope_of.append(gradient_at(of.gradient.sparsity_out(0), block))
            jac.append(jacobian_at(of.jacobian.sparsity_out(0), block))
            hess.append(hessian_at(of.hessian.sparsity_out(0), block))
            sizes = rows.size, slope_of[-1].size, jac[-1][0].size, hess[-1][1].size
            counts = [count + size for count, size in zip(counts, sizes, strict=True)]
        self.counts = counts
        nothing = np.zeros(0, dtype=int)
        self.value_row = np.concatenate([nothing, *value_rows])
        self.slope_of = np.concatenate([nothing, *slope_of])
        at, column, _ = self.fragment.linear
        row = np.concatenate([nothing, *(a for a, _ in jac), at])
        where = np.concatenate([nothing, *(b for _, b in jac), column])
        self.jacobian = Entries(row, where, np.arange(row.size))
        upper = np.concatenate([nothing, *(at[0] for at, _ in hess)])
        lower = np.concatenate([nothing, *(at[1] for at, _ in hess)])
        doubled = np.concatenate([np.zeros(0), *(twice for _, twice in hess)])
        number = np.arange(upper.size)
        # both halves; what stands for both its mirror images on the diagonal comes twice
        mirrored = (upper != lower) | (doubled == 2.0)
        self.hessian = Entries(
            np.concatenate([upper, lower[mirrored]]),
            np.concatenate([lower, upper[mirrored]]),
            np.concatenate([number, number[mirrored]]),
        )
