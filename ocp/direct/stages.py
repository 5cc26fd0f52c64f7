"""A stage-ordered program as a stage-wise solver reads it: where its variables, rows and numbers stand.

Such a solver wants the controls of a stage before its states, and rows x_next = F(x, u) apart from those inside a
stage. What the dynamics inside an interval define, its states at points and at its end, are inner variables: the
solver never sees them, nor the rows that define them.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from ocp.direct.assembly import Derivatives, gradient_at, hessian_at, jacobian_at
from ocp.direct.fragment import Fragment
from ocp.errors import ProblemError
from ocp.problem.formulation import Formulation

__all__ = ["Entries", "Tables"]


class Entries(NamedTuple):
    """Where numbers stand in a matrix of the program: number ``source`` at (``row``, ``column``), each (E,)."""

    row: np.ndarray
    column: np.ndarray
    source: np.ndarray

    def select(self, which: np.ndarray) -> Entries:
        """Those at some places, in their order."""
        return Entries(*(part[which] for part in self))

    def followed_by(self, others: Entries) -> Entries:
        """These and others."""
        return Entries(*(np.concatenate(pair) for pair in zip(self, others, strict=True)))


class Tables:
    """A stage-ordered program as stages: variables in the solver's order, and where the numbers of its blocks belong.

    Attributes:
        nx, nu, nz: States, controls and inner variables of each stage. Shape (N + 1,).
        place: Where each variable of the program stands in the solver's vector; -1: an inner one.
        stage, local: Stage of each, and its place there: controls, states, inner ones.
        inner, inner_rows: The inner variables, and the rows that define them, stage by stage.
        row_stage: Stage of each row. dynamics: Entry of the next state that a row defines, -1 for other rows.
        onto: The variable that this is. position: Of each inner row among those of its stage; -1 for others.
        plain: Whether no block reads an inner variable.
        counts: Numbers of all blocks by kind. jacobian, hessian: Their entries, the constant ones of the Jacobian last,
            of the Hessian one triangle; half: of each of these 1, on the diagonal 1/2.
    """

    def __init__(self, form: Formulation, fragment: Fragment, functions: Sequence[Derivatives]) -> None:
        assert fragment.stages is not None
        sizes = fragment.stages.states, fragment.stages.controls, fragment.stages.rows
        states, others, rows = (np.array(part) for part in sizes)
        self.fragment, self.functions = fragment, functions
        n, m, stages = fragment.size, fragment.n_rows, len(states)
        first = np.concatenate([[0], np.cumsum(states + others)])
        self.stage = np.repeat(np.arange(stages), states + others)
        local = np.arange(n) - first[self.stage]
        is_state = local < states[self.stage]
        joins = np.append(states[1:], 0)
        row_first = np.concatenate([[0], np.cumsum(joins + rows)])
        self.row_stage = np.repeat(np.arange(stages), joins + rows)
        within = np.arange(m) - row_first[self.row_stage]
        join = within < joins[self.row_stage]
        self.dynamics = np.where(join, within, -1)
        self.onto = np.full(m, -1)
        self.onto[join] = (first[self.row_stage + 1] + within)[join]

        # states inside an interval, and the rows that are zero there
        inner = (fragment.variable_role == "state") & ~is_state
        inner_row = ~join & (fragment.row_bounds == form.bounds.places["zero"][0]) & (fragment.row_stages >= 0)
        self.inner, self.inner_rows = np.flatnonzero(inner), np.flatnonzero(inner_row)
        self.nx, self.nz = states, self._count(inner)
        self.nu = others - self.nz
        if np.any(np.bincount(self.row_stage[inner_row], minlength=stages) != self.nz):
            raise ProblemError("a stage-ordered program has other rows of its dynamics than states; use ipopt")
        self.first = np.concatenate([[0], np.cumsum(self.nx + self.nu)])
        self.position = self._ranks(inner_row, self.row_stage)
        control = ~is_state & ~inner
        self.local = np.where(is_state, self.nu[self.stage] + local, self._ranks(control, self.stage))
        self.local[inner] = (self.nu + self.nx)[self.stage[inner]] + self._ranks(inner, self.stage)[inner]
        self.place = np.where(inner, -1, self.first[self.stage] + self.local)
        self.plain = not any(inner[block.variables].any() for block in fragment.blocks)

        self._numbers()
        self._check()

    def _count(self, which: np.ndarray) -> np.ndarray:
        """Variables of some kind of each stage."""
        return np.bincount(self.stage[which], minlength=self.stage[-1] + 1)

    @staticmethod
    def _ranks(which: np.ndarray, stage: np.ndarray) -> np.ndarray:
        """Of those that are meant how many stand before each in its stage; -1 of the others."""
        before = np.concatenate([[0], np.cumsum(np.bincount(stage[which], minlength=stage[-1] + 1))])
        return np.where(which, np.cumsum(which) - 1 - before[stage], -1)

    def _check(self) -> None:
        """Raise ProblemError where a row or a curvature reaches over stages."""
        row, column = self.jacobian.row, self.jacobian.column
        apart = self.stage[column] - self.row_stage[row]
        if np.any((apart != 0) & ~((self.dynamics[row] >= 0) & (apart == 1))) or np.any(
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
        self.value_row = np.concatenate([nothing, *value_rows], dtype=np.int32)
        self.slope_of = np.concatenate([nothing, *slope_of], dtype=np.int32)
        at, column, _ = self.fragment.linear
        row = np.concatenate([nothing, *(a for a, _ in jac), at], dtype=np.int32)
        where = np.concatenate([nothing, *(b for _, b in jac), column], dtype=np.int32)
        self.jacobian = Entries(row, where, np.arange(row.size, dtype=np.int32))
        upper = np.concatenate([nothing, *(at[0] for at, _ in hess)], dtype=np.int32)
        lower = np.concatenate([nothing, *(at[1] for at, _ in hess)], dtype=np.int32)
        doubled = np.concatenate([np.zeros(0), *(twice for _, twice in hess)])
        by_stage = np.argsort(self.stage[upper], kind="stable")
        self.hessian = Entries(upper, lower, np.arange(upper.size, dtype=np.int32)).select(by_stage)
        # what stands for both its mirror images on the diagonal comes twice
        self.half = np.where((upper == lower) & (doubled == 1.0), 0.5, 1.0)[by_stage]
