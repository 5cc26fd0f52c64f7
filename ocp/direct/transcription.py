"""What every transcription shares: the nonlinear program of one phase, collected piece by piece.

:class:`Layout` says where the variables of a phase stand in the vector of the program; :class:`FragmentBuilder`
collects variables, rows and blocks, imposes what is asked at nodes and at both ends, and numbers the rows.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import casadi as ca
import numpy as np

from ocp.direct.assembly import Block, Fragment, Interpolants, Stages
from ocp.errors import ProblemError
from ocp.problem.formulation import Formulation, Rows

__all__ = ["FragmentBuilder", "Layout"]


@dataclass(frozen=True)
class Layout:
    """Indices of the variables of one phase with N intervals.

    Nodes stand between intervals. In the plain layout the end of interval k *is* node k + 1 and the horizon is one
    variable. In the staged layout (for structure-exploiting solvers) each stage owns its copies of the end of its
    interval, of the horizon and of the start, and linear rows tie them to the next node.

    Attributes:
        size: Number of variables.
        node: Variables of each node. Shape (n, N + 1).
        node_end: Variables at the end of each interval. Shape (n, N).
        interval: Variables inside each interval. Shape (m, N).
        horizon: The horizon as each node sees it, or None where it is fixed. Shape (N + 1,).
        initial: Node variables at the start as the first and the last node see them. Shape (n, 2).
        joins: (next node, its source in the stage before), each of shape (carried, N); None in the plain layout.
        stage_controls: Number of variables of a stage that are not its node. 0 in the plain layout.
    """

    size: int
    node: np.ndarray
    node_end: np.ndarray
    interval: np.ndarray
    horizon: np.ndarray | None
    initial: np.ndarray
    joins: tuple[np.ndarray, np.ndarray] | None = None
    stage_controls: int = 0


def plain_layout(intervals: int, node_size: int, interval_size: int, free_horizon: bool) -> Layout:
    """Node 0, interval 0, node 1, ..., node N, horizon."""
    stride = node_size + interval_size
    grid = np.arange(intervals * stride).reshape(intervals, stride).T
    node = np.column_stack([grid[:node_size], intervals * stride + np.arange(node_size)])
    size = intervals * stride + node_size
    horizon = np.full(intervals + 1, size) if free_horizon else None
    initial = np.column_stack([node[:, 0], node[:, 0]])
    return Layout(size + free_horizon, node, node[:, 1:], grid[node_size:], horizon, initial)


def staged_layout(intervals: int, node_size: int, interval_size: int, free_horizon: bool, keep_initial: bool) -> Layout:
    """Stage k: node k with its copies of horizon and start, then interval k with the copy of its end."""
    carried = node_size + free_horizon + node_size * keep_initial
    inputs = interval_size + node_size
    stride = carried + inputs
    grid = np.arange(intervals * stride).reshape(intervals, stride).T
    full = np.column_stack([grid[:carried], intervals * stride + np.arange(carried)])
    node_end = grid[carried + interval_size :]
    own = full[node_size + free_horizon :] if keep_initial else full[:node_size]
    return Layout(
        intervals * stride + carried,
        full[:node_size],
        node_end,
        grid[carried : carried + interval_size],
        full[node_size] if free_horizon else None,
        own[:, [0, -1]],
        (full[:, 1:], np.vstack([node_end, full[node_size:, :-1]])),
        inputs,
    )


@dataclass
class FragmentBuilder:
    """Collects variables, rows and blocks of one phase; :meth:`finish` numbers the rows stage by stage.

    Args:
        formulation: The problem.
        mesh: Fractions of the horizon where intervals begin and end. Shape (N + 1,).
        node_controls: Number of control entries that stand at nodes (behind the states) rather than inside intervals.
        interval_size: Number of variables inside an interval.
        staged: Whether to lay the program out stage by stage for a structure-exploiting solver.
    """

    formulation: Formulation
    mesh: np.ndarray
    node_controls: int
    interval_size: int
    staged: bool
    blocks: list[Block] = field(default_factory=list)
    _linear: list[tuple[np.ndarray, np.ndarray, np.ndarray]] = field(default_factory=list)
    _labels: list[str] = field(default_factory=list)
    _row_bounds: list[np.ndarray] = field(default_factory=list)
    _fractions: list[np.ndarray] = field(default_factory=list)
    _order: list[np.ndarray] = field(default_factory=list)
    _inside: list[np.ndarray] = field(default_factory=list)

    def __post_init__(self) -> None:
        form = self.formulation
        size = form.nx + self.node_controls
        shape = (self.intervals, size, self.interval_size, form.horizon_is_free)
        self.layout: Layout = staged_layout(*shape, form.ties_ends) if self.staged else plain_layout(*shape)
        self.variable_bounds = np.full(self.layout.size, form.bounds.places["free"][0])
        self.variable_role = np.full(self.layout.size, "", dtype="<U8")
        self.variable_entry = np.zeros(self.layout.size, dtype=int)
        self.variable_fraction = np.zeros(self.layout.size)
        self._nodes()

    @property
    def intervals(self) -> int:
        return len(self.mesh) - 1

    # ---- variables -------------------------------------------------------------------------------------------

    def variables(self, role: str, index: np.ndarray, at: np.ndarray, bounds: str | None) -> None:
        """Variables ``index`` (n, K) are the entries of ``role`` at fractions ``at`` (K,), bounded as a place says."""
        self.variable_role[index] = role
        self.variable_entry[index] = np.arange(index.shape[0])[:, None]
        self.variable_fraction[index] = at[None, :]
        if bounds is not None:
            self.variable_bounds[index] = self.formulation.bounds.places[bounds][:, None]

    def _nodes(self) -> None:
        nx, lay, mesh = self.formulation.nx, self.layout, self.mesh
        both = np.array([0.0, 0.0])
        for role, part, bounds in (("state", slice(0, nx), "state"), ("control", slice(nx, None), "control")):
            self.variables(role, lay.initial[part], both, None)
            self.variables(role, lay.node_end[part], mesh[1:], None)
            if role == "state" or self.node_controls:
                self.variables(role, lay.node[part], mesh, bounds)
        self.variables("state", lay.node[:nx, :1], mesh[:1], "initial")
        self.variables("state", lay.node[:nx, -1:], mesh[-1:], "terminal")
        if lay.horizon is not None:
            self.variables("horizon", lay.horizon[None, :], mesh, None)
            self.variables("horizon", lay.horizon[None, :1], mesh[:1], "horizon")
        if lay.joins is not None:
            target, source = lay.joins
            names = tuple(f"stage variable {i}" for i in range(len(target)))
            rows = self.rows(names, None, np.arange(self.intervals), mesh[1:], joins=True)
            self.linear(rows, target, 1.0)
            self.linear(rows, source, -1.0)
            if self.formulation.ties_ends:
                n = len(lay.initial)
                ties = self.rows(tuple(f"start {i}" for i in range(n)), None, np.zeros(1, int), mesh[:1], ends=True)
                self.linear(ties, lay.initial[:, :1], 1.0)
                self.linear(ties, lay.node[:, :1], -1.0)

    def point(self, states: np.ndarray, controls: np.ndarray, stages: np.ndarray) -> np.ndarray:
        """Variables [x; u; T where free] of K points, from states (nx, K), controls (nu, K), stages (K,)."""
        horizon = [] if self.layout.horizon is None else [self.layout.horizon[stages][None, :]]
        return np.vstack([states, controls, *horizon])

    # ---- rows ------------------------------------------------------------------------------------------------

    def rows(
        self,
        labels: tuple[str, ...],
        bounds: np.ndarray | None,
        stages: np.ndarray,
        at: np.ndarray,
        *,
        joins: bool = False,
        ends: bool = False,
    ) -> np.ndarray:
        """Allocate rows ``labels`` (m) at K places; bounds None means equal to zero. Returns indices (m, K).

        ``joins``: they tie a stage to the next. ``ends``: they belong to the ends of the horizon, not to its inside.
        """
        m, places = len(labels), len(stages)
        zero = self.formulation.bounds.places["zero"][0]
        first = len(self._labels)
        self._labels += list(labels) * places
        self._row_bounds.append(np.tile(np.full(m, zero) if bounds is None else bounds, places))
        self._fractions.append(np.repeat(at, m))
        self._order.append(np.repeat(2 * stages + (0 if joins else 1), m))  # joins come first in a stage
        self._inside.append(np.full(m * places, not ends))
        return first + np.arange(m * places).reshape(places, m).T

    def linear(self, rows: np.ndarray, columns: np.ndarray, values: np.ndarray | float) -> None:
        """Add ``values * variable[columns]`` to ``rows``; the three are broadcast together."""
        at, which, filled = np.broadcast_arrays(rows, columns, values)
        self._linear.append((at.ravel(), which.ravel(), filled.ravel().astype(float)))

    def path_rows(
        self, rows: Rows, states: np.ndarray, controls: np.ndarray, stages: np.ndarray, at: np.ndarray
    ) -> None:
        """Impose path rows at K points of fractions ``at``: states (nx, K), controls (nu, K)."""
        if len(rows) == 0 or len(at) == 0:
            return
        point_data = self.formulation.point_data(at)
        d = self.formulation.sym("d", len(point_data))
        function = self.formulation.point_function("path", d, 0, rows.expression)
        index = self.rows(rows.labels, rows.bounds, stages, at)
        self.blocks.append(Block(function, self.point(states, controls, stages), point_data, index))

    def node_rows(self, rows: Rows, controls: np.ndarray, *, first_only: bool = False) -> None:
        """Impose rows at every node; at the first one only where it is not settled by fixed initial states.

        ``controls`` (nu, N + 1) are the variables to read there; rows free of controls may be given any.
        """
        nodes = np.arange(self.intervals + 1)
        states = self.layout.node[: self.formulation.nx]
        loose = (rows.uses_state & ~self.formulation.initial_is_fixed).any(axis=1) | rows.uses_control
        first = nodes[:1]
        self.path_rows(rows.select(loose), states[:, first], controls[:, first], first, self.mesh[first])
        if not first_only:
            self.path_rows(rows, states[:, 1:], controls[:, 1:], nodes[1:], self.mesh[1:])

    def ends(
        self, basis: tuple[np.ndarray, np.ndarray], first: np.ndarray, last: np.ndarray, *, at_nodes: bool
    ) -> None:
        """Impose start and end constraints and the terminal cost.

        Args:
            basis: Weights (c,) that make the control at the start (at the end) from those of the first (last) interval.
            first, last: Their variables, in the first and the last interval. Shape (c, nu).
            at_nodes: Whether the controls are node variables.
        """
        form, lay, nx = self.formulation, self.layout, self.formulation.nx
        if len(form.start):
            self._end_block(form.start, 0, lay.node[:nx, 0], (basis[0], first), None, 0)
        needs = ca.vertcat(form.end.expression, form.terminal)
        if self.staged and not at_nodes and (ca.depends_on(needs, form.u) or ca.depends_on(needs, form.u0)):
            words = "a stage-ordered program cannot constrain the control at the end; use ipopt"
            raise ProblemError(words, name="control")
        self._end_block(form.end, form.terminal, lay.node[:nx, -1], (basis[1], last), (basis[0], first), 1)

    def _end_block(
        self,
        rows: Rows,
        cost: Any,
        states: np.ndarray,
        controls: tuple[np.ndarray, np.ndarray],
        initial: tuple[np.ndarray, np.ndarray] | None,
        place: int,
    ) -> None:
        """One block at the start (place 0) or the end (place 1) of v = [x, controls, T, x0, controls at the start]."""
        form, lay = self.formulation, self.layout
        sym, nx, nu = form.sym, form.nx, form.nu
        stage = self.intervals if place else 0
        used = ca.vertcat(rows.expression, cost)
        # symbol of the problem, the variables that make it, and their weights
        pieces = [(form.x, states, np.ones(1))]
        if nu and ca.depends_on(used, form.u):
            pieces.append((form.u, controls[1], controls[0]))
        if initial is not None and ca.depends_on(used, form.x0):
            pieces.append((form.x0, lay.initial[:nx, place], np.ones(1)))
        if initial is not None and nu and ca.depends_on(used, form.u0):
            own = (lay.initial[nx:, place], np.ones(1)) if self.node_controls else initial[::-1]
            pieces.append((form.u0, *own))
        if lay.horizon is not None:
            pieces.append((form.T, lay.horizon[[stage]], np.ones(1)))
        variables = np.concatenate([index.ravel() for _, index, _ in pieces])
        v, d, offset = sym("v", len(variables)), sym("d", 1), 0
        old, new = [], []
        for symbol, index, weights in pieces:
            local = ca.reshape(v[offset : offset + index.size], symbol.numel(), len(weights))
            old.append(symbol)
            new.append(ca.mtimes(local, ca.DM(weights)))
            offset += index.size
        if lay.horizon is None:
            old.append(form.T)
            new.append(form.horizon_value)
        old.append(form.t)
        new.append(place * new[-1])
        outputs = ca.substitute([form.problem.symbols(cost), rows.expression], old, new)
        at = np.array([float(place)])
        labels = self.rows(rows.labels, rows.bounds, np.array([stage]), at, ends=True)
        function = ca.Function("end" if place else "start", [v, d, form.p], outputs)
        self.blocks.append(Block(function, variables[:, None], at[None, :], labels, ends=True))

    # ---- the whole -------------------------------------------------------------------------------------------

    def finish(
        self,
        report: tuple[np.ndarray, np.ndarray],
        report_states: np.ndarray,
        costate_rows: np.ndarray,
        costate_nodes: np.ndarray,
        costate_scale: np.ndarray,
        interpolants: Interpolants,
    ) -> Fragment:
        """Number the rows stage by stage and return the fragment."""
        order = np.concatenate(self._order)
        sequence = np.argsort(order, kind="stable")
        number = np.empty_like(sequence)
        number[sequence] = np.arange(len(sequence))
        blocks = tuple(Block(b.function, b.variables, b.data, number[b.rows], b.ends) for b in self.blocks)
        rows, columns, values = (np.concatenate(part) for part in zip(*self._linear, strict=True))
        nx, lay = self.formulation.nx, self.layout
        stages = None
        if lay.joins is not None:
            carried, n = len(lay.joins[0]), self.intervals
            counts = np.bincount(order[order % 2 == 1] // 2, minlength=n + 1)
            stages = Stages((carried,) * (n + 1), (lay.stage_controls,) * n + (0,), tuple(counts.tolist()))
        return Fragment(
            mesh=self.mesh,
            size=lay.size,
            variable_bounds=self.variable_bounds,
            row_bounds=np.concatenate(self._row_bounds)[sequence],
            variable_role=self.variable_role,
            variable_entry=self.variable_entry,
            variable_fraction=self.variable_fraction,
            row_labels=tuple(self._labels[i] for i in sequence),
            row_fractions=np.concatenate(self._fractions)[sequence],
            blocks=blocks,
            linear=(number[rows], columns, values),
            nodes=lay.node[:nx],
            row_stages=np.where(np.concatenate(self._inside), order // 2, -1)[sequence],
            horizon=None if lay.horizon is None else int(lay.horizon[0]),
            report=report,
            report_states=report_states,
            costate_rows=np.where(costate_rows < 0, -1, number[costate_rows]),
            costate_nodes=costate_nodes,
            costate_scale=costate_scale,
            interpolants=interpolants,
            stages=stages,
        )
