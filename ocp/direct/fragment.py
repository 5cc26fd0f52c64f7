"""A partially separable nonlinear program: few small functions, each repeated over many index sets.

A transcription says which variables exist, which small function (a *block*) reads which of them how many times, and
which rows are linear. :mod:`ocp.direct.assembly` derives the derivatives of every block once and scatters them,
so building costs the same for 10 intervals and for 1000. Fragments of several phases can be joined at their ends.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from ocp.curves import PiecewisePolynomial

__all__ = ["Block", "Fragment", "Interpolants", "Stages"]


@dataclass(frozen=True)
class Block:
    """One small function and where it is applied.

    Attributes:
        function: casadi Function (v (n), d (nd), p) -> (cost, g (m)).
        variables: Which variables of the program each application reads. Shape (n, K).
        data: Constants of each application. Shape (nd, K).
        rows: Which rows of the program each application adds to. Shape (m, K).
        ends: Whether it belongs to the ends of the horizon rather than to its inside.
    """

    function: Any
    variables: np.ndarray
    data: np.ndarray
    rows: np.ndarray
    ends: bool = False


@dataclass(frozen=True)
class Stages:
    """Sizes of a stage-ordered program, as structure-exploiting solvers ask for them. Each of length N + 1."""

    states: tuple[int, ...]
    controls: tuple[int, ...]
    rows: tuple[int, ...]


@dataclass(frozen=True)
class Interpolants:
    """States and controls over fractions of the horizon, piece by piece, as the variables of a phase make them.

    Attributes:
        breaks: Where the pieces of the states begin and end, the same number in every interval. Shape (K + 1,).
        nodes: Places of the values in a piece. Shape (d,).
        variables: What the states of each interval are made of. Shape (n, N).
        mesh, control_nodes: The same of the controls, a piece an interval. Shapes (N + 1,), (c,).
        controls: Values of the controls of each interval, node by node. Shape (c nu, N).
        data: Constants of each interval. Shape (nd, N).
        values: casadi Function (v (n), data (nd), T, p) -> values of the states in the pieces of an interval, (nx, .),
            node by node; None where they are the variables.
    """

    breaks: np.ndarray
    nodes: np.ndarray
    variables: np.ndarray
    mesh: np.ndarray
    control_nodes: np.ndarray
    controls: np.ndarray
    data: np.ndarray
    values: Any = None

    def __call__(
        self, variables: np.ndarray, parameters: np.ndarray, horizon: float
    ) -> tuple[PiecewisePolynomial, PiecewisePolynomial]:
        """The curves of states and controls at the variables of a program."""
        found = variables[self.variables].T
        if self.values is not None:
            inputs = variables[self.variables], self.data, horizon, parameters
            found = np.asarray(self.mapped(*inputs).full()).T
        states = found.reshape(len(self.breaks) - 1, len(self.nodes), -1)
        controls = variables[self.controls].T.reshape(len(self.mesh) - 1, len(self.control_nodes), -1)
        by_state = PiecewisePolynomial(self.breaks, self.nodes, states)
        return by_state, PiecewisePolynomial(self.mesh, self.control_nodes, controls)

    @cached_property
    def mapped(self) -> Any:
        """``values`` of all intervals side by side."""
        return self.values.map("curves", "serial", self.variables.shape[1], [2, 3], [])


@dataclass(frozen=True)
class Fragment:
    """The nonlinear program of a problem.

    Attributes:
        mesh: Fractions of the horizon where intervals begin and end. Shape (N + 1,).
        size: Number of variables.
        variable_bounds, row_bounds: Index of each variable and row in the bound table.
        variable_role: ``state``, ``control`` or ``horizon`` of each variable; variable_entry: which entry of it;
            variable_fraction: at which fraction of the horizon. Used for guesses. Each of length size.
        row_labels, row_fractions: What each row says, and where. Each of length n_rows.
        blocks: Nonlinear parts. linear: linear part as (rows, columns, values).
        horizon: Index of the horizon at the start, or None where it is fixed.
        report: Interval and place in it (0..1) of every reported point. Each of shape (M,).
        report_states: Indices of the states at the reported points. Shape (M, nx).
        nodes: Indices of the states at the nodes. Shape (nx, N + 1).
        row_stages: Interval that each row belongs to; -1 for what only ties or bounds the ends. Length n_rows.
        costate_rows: Rows whose multipliers are the costates at the reported points; -1 where a point is the node
            that ``costate_nodes`` (M,) names and its costate is what the next intervals say. Shape (M, nx).
        costate_scale: Factor from multiplier to costate. Shape (M,).
        interpolants: The curves that the variables make.
        stages: Stage structure, where the program is stage-ordered.
    """

    mesh: np.ndarray
    size: int
    variable_bounds: np.ndarray
    row_bounds: np.ndarray
    variable_role: np.ndarray
    variable_entry: np.ndarray
    variable_fraction: np.ndarray
    row_labels: tuple[str, ...]
    row_fractions: np.ndarray
    blocks: tuple[Block, ...]
    linear: tuple[np.ndarray, np.ndarray, np.ndarray]
    horizon: int | None
    report: tuple[np.ndarray, np.ndarray]
    report_states: np.ndarray
    nodes: np.ndarray
    row_stages: np.ndarray
    costate_rows: np.ndarray
    costate_nodes: np.ndarray
    costate_scale: np.ndarray
    interpolants: Interpolants
    stages: Stages | None

    @property
    def n_rows(self) -> int:
        return len(self.row_labels)

    @property
    def start(self) -> np.ndarray:
        """Indices of the first state. Shape (nx,)."""
        return self.nodes[:, 0]

    @property
    def end(self) -> np.ndarray:
        """Indices of the last state. Shape (nx,)."""
        return self.nodes[:, -1]

    def arguments(self, p: np.ndarray, bounds: tuple[np.ndarray, np.ndarray]) -> dict[str, np.ndarray]:
        """Parameters, and the bounds of variables and rows from those of the bound table, as a solver takes them."""
        lower, upper = bounds
        return {
            "p": p,
            "lbx": lower[self.variable_bounds],
            "ubx": upper[self.variable_bounds],
            "lbg": lower[self.row_bounds],
            "ubg": upper[self.row_bounds],
        }
