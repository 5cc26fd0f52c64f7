"""What is known before anything is solved: states that run by themselves, and limits that touch nothing else.

A clock kept as a state, c' = 1 from c(0) = 0, leaves a solver nothing to choose, so a limit on it, or its given end, is
one condition more than there are unknowns. Such limits are let go while solving, and looked at afterwards.
"""

from __future__ import annotations

from dataclasses import replace

import casadi as ca
import numpy as np

from ocp.direct.assembly import Program
from ocp.direct.fragment import Fragment
from ocp.direct.nlp import SOLVER_RESIDUAL, Outcome
from ocp.direct.scaling import Scales
from ocp.problem.formulation import Formulation
from ocp.status import SolverStatus

__all__ = ["Known"]


class Known:
    """Which variables of a program are known in advance, and which rows only look at such.

    What is joined to a given variable, as the end of the last interval is to a given end, is known too.
    """

    def __init__(self, form: Formulation, fragment: Fragment, program: Program) -> None:
        state = fragment.variable_role == "state"
        alone = self_running(form)
        self.variables = np.zeros(fragment.size, dtype=bool)
        self.variables[state] = alone[fragment.variable_entry[state]]
        self.later = self.variables & (fragment.variable_fraction > 0)
        self.declared = np.isin(
            fragment.row_bounds, np.concatenate([form.bounds.places[kind] for kind in ("path", "start", "end")])
        )
        self.rows, self.columns = program.jacobian_entries
        # rows of two variables, linear, as those that join the end of an interval to the next node
        linear, column, _ = fragment.linear
        alike = [np.bincount(index, minlength=fragment.n_rows)[linear] == 2 for index in (linear, self.rows)]
        both = np.flatnonzero(alike[0] & alike[1])
        pairs = both[np.argsort(linear[both], kind="stable")].reshape(-1, 2)
        self.joins, self.joined = linear[pairs[:, 0]], column[pairs]

    def relaxed(self, arguments: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
        """Arguments of a solver without the limits that only look at what is known."""
        given = arguments["lbx"] == arguments["ubx"]
        equal = arguments["lbg"][self.joins] == arguments["ubg"][self.joins]
        given[self.joined[equal & given[self.joined].any(axis=1)]] = True
        unknown = ~(self.variables | given)
        idle = self.declared & (np.bincount(self.rows, unknown[self.columns], len(self.declared)) == 0)
        own = dict(arguments)
        for key, mask in (("x", self.later), ("g", idle)):
            own[f"lb{key}"] = np.where(mask, -np.inf, arguments[f"lb{key}"])
            own[f"ub{key}"] = np.where(mask, np.inf, arguments[f"ub{key}"])
        return own

    def checked(self, outcome: Outcome, arguments: dict[str, np.ndarray], scales: Scales) -> Outcome:
        """An outcome held against the limits that were let go; no success where one is missed.

        Args:
            scales: By which a miss is judged.
        """
        v = outcome.variables
        inside = np.where(self.later, np.clip(v, arguments["lbx"], arguments["ubx"]), v)
        miss = np.abs(inside - v) / (scales.variables + np.abs(v))
        beyond = np.maximum(arguments["lbg"] - outcome.rows, outcome.rows - arguments["ubg"])
        beyond = np.where(self.declared, beyond, 0.0) / (scales.rows + np.abs(outcome.rows))
        if not outcome.success or max(miss.max(initial=0.0), beyond.max(initial=0.0)) <= SOLVER_RESIDUAL:
            return replace(outcome, variables=inside) if outcome.success else outcome
        return replace(outcome, status=SolverStatus.INFEASIBLE, message=SolverStatus.INFEASIBLE.message)


def self_running(form: Formulation) -> np.ndarray:
    """Which states follow from the start and the time alone, whatever the controls do. Shape (nx,), bool."""
    if form.horizon_is_free:
        return np.zeros(form.nx, dtype=bool)

    def uses(symbol: ca.SX | ca.MX) -> np.ndarray:
        pattern = np.asarray(ca.DM(ca.jacobian_sparsity(form.f, symbol), 1).full()) != 0
        return np.asarray(pattern.reshape(form.nx, -1))

    alone = form.initial_is_fixed & ~uses(form.u).any(axis=1)
    states = uses(form.x)
    while (waiting := alone & (states & ~alone).any(axis=1)).any():
        alone = alone & ~waiting
    return np.asarray(alone)
