"""The minimum principle of a declared problem, evaluated on trajectories: Hamiltonian, rates, end conditions."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import casadi as ca
import numpy as np

from ocp import Problem

from .case import Array, Extremal


def stack(values: Mapping[str, Array], names: list[str], samples: int) -> Array:
    """Arrays by name, each (M,) or (M, n), as one (M, sum of n) in the order of `names`."""
    if not names:
        return np.zeros((samples, 0))
    return np.hstack([np.reshape(values[name], (samples, -1)) for name in names])


def number(expression: Any) -> Array:
    """A casadi column without free symbols as a vector."""
    return np.asarray(ca.Function("number", [], [expression])()["o0"].full(), dtype=np.float64).ravel()


class Principle:
    """Functions of (state, control, costate, time, horizon) that the minimum principle speaks of.

    Equalities that tie states and algebraic controls (the rod of a pendulum) are adjoined with the multiplier that
    makes the Hamiltonian stationary in those controls.

    Attributes:
        states, controls: Names in the order of the vectors.
        algebraic: Indices of controls that an equality determines.
        rates, running, hamiltonian, costate_rates: casadi functions.
        terminal_by_state, terminal_by_horizon: Gradients of the terminal cost.
    """

    def __init__(self, problem: Problem) -> None:
        declared = problem.declared
        assert declared.horizon is not None
        self.problem = problem
        self.states, self.controls = list(declared.states), list(declared.controls)
        x = ca.vertcat(*[v.symbol for v in declared.states.values()])
        u = ca.vertcat(*[v.symbol for v in declared.controls.values()])
        costate = ca.SX.sym("costate", x.numel())
        f = ca.vertcat(*[declared.dynamics[name] for name in self.states])
        hamiltonian = declared.running + ca.dot(costate, f)
        tied = ca.vertcat(*[constraint.expression for constraint in declared.path.values()])
        by_control = ca.jacobian(tied, u)
        self.algebraic = sorted(set(by_control.sparsity().get_triplet()[1]))
        pull = ca.jacobian(hamiltonian, x).T
        if self.algebraic:
            square = by_control[:, self.algebraic]
            multiplier = -ca.solve(square.T, ca.jacobian(hamiltonian, u)[self.algebraic])
            pull += ca.jacobian(tied, x).T @ multiplier
        self._inputs = [x, u, costate, problem.time, declared.horizon.symbol]
        self.rates = self._function(f)
        self.running = self._function(declared.running)
        self.hamiltonian = self._function(hamiltonian)
        self.costate_rates = self._function(-pull)
        self.terminal_cost = self._function(declared.terminal)
        self.terminal_by_state = self._function(ca.gradient(declared.terminal, x))
        self.terminal_by_horizon = self._function(ca.jacobian(declared.terminal, declared.horizon.symbol))
        self.autonomous = not ca.depends_on(hamiltonian, problem.time)

    def _function(self, expression: Any) -> Any:
        return ca.Function("f", self._inputs, [ca.densify(expression)])

    def along(self, function: Any, t: Array, horizon: float, point: Extremal) -> Array:
        """A function at times (M,) of a trajectory. Shape (M, n)."""
        columns = function.map(t.size)(
            stack(point.state, self.states, t.size).T,
            stack(point.control, self.controls, t.size).T,
            stack(point.costate, self.states, t.size).T,
            t[None, :],
            np.full((1, t.size), horizon),
        )
        return np.asarray(columns.full(), dtype=np.float64).T

    def control_bounds(self) -> tuple[Array, Array]:
        """Lower and upper bounds of the stacked controls. Shape (n,) each."""
        controls = self.problem.declared.controls.values()
        lower = np.concatenate([number(v.lower) for v in controls])
        return lower, np.concatenate([number(v.upper) for v in controls])

    def ends(self) -> tuple[Array, Array]:
        """Initial and terminal values of the stacked states, nan where free. Shape (n,) each."""
        states = self.problem.declared.states.values()
        initial = np.concatenate([number(v.initial) for v in states])
        return initial, np.concatenate([number(v.terminal) for v in states])
