"""Common parts of all transcriptions: the order of the variables, and the construction of the nonlinear program.

:class:`Layout` contains the indices of the variables of the program. :class:`TranscriptionBuilder` collects
variables, rows and blocks, imposes conditions at nodes and ends, and numbers the rows.
"""

from __future__ import annotations

import dataclasses
from abc import ABC, abstractmethod
from dataclasses import dataclass, field
from typing import Any, Self, TypeAlias

import casadi as ca
import numpy as np

from models.files import INPUT_LIMITS
from ocp.direct.assembly import Block, Interpolants, Stages, Transcription
from ocp.errors import ProblemError, error_names, require
from ocp.problem.formulation import Formulation, Rows
from ocp.problem.values import numeric
from ocp.tolerances import ROUNDING_SHARE

WeightedControls: TypeAlias = tuple[np.ndarray, np.ndarray]
"""Indices of control variables, shape (c, nu), and the weights of their sum, shape (c,)."""


@dataclass(frozen=True)
class Layout:
    """Indices of the variables of a nonlinear program on a mesh of N intervals.

    Nodes lie between intervals. In the plain layout the end of interval k *is* node k + 1, and the horizon is one
    variable. In the staged layout, for structure-exploiting solvers, each stage has copies of the end of its interval,
    of the horizon and of the start, and linear rows tie them to the next node.

    Attributes:
        size: Number of variables.
        node: Variables of each node. Shape (n, N + 1).
        node_end: Variables at the end of each interval. Shape (n, N).
        interval: Variables inside each interval. Shape (m, N).
        horizon: Horizon variable of each node, or None if it is fixed. Shape (N + 1,).
        initial: Variables of the start in the copies of the first and of the last node. Shape (n, 2).
        joins: (next node, its source in the stage before), each of shape (carried, N); None in the plain layout.
        stage_controls: Number of variables of a stage other than its node. 0 in the plain layout.
    """

    size: int
    node: np.ndarray
    node_end: np.ndarray
    interval: np.ndarray
    horizon: np.ndarray | None
    initial: np.ndarray
    joins: tuple[np.ndarray, np.ndarray] | None = None
    stage_controls: int = 0


def variable_layout(
    intervals: int, node_size: int, interval_size: int, free_horizon: bool, *, staged: bool, keep_initial: bool
) -> Layout:
    """Return the layout of the variables of a program, in the order node 0, interval 0, node 1, ..., node N.

    The plain layout ends with a free horizon. In the staged layout each node also carries the horizon and, with
    ``keep_initial``, the start, and each interval a copy of its end.
    """
    carried = node_size + staged * (free_horizon + node_size * keep_initial)
    inputs = interval_size + staged * node_size
    stride = carried + inputs
    size = intervals * stride + carried
    grid = np.arange(intervals * stride).reshape(intervals, stride).T
    nodes = np.column_stack([grid[:carried], intervals * stride + np.arange(carried)])
    node, interval = nodes[:node_size], grid[carried : carried + interval_size]
    if not staged:
        horizon = np.full(intervals + 1, size) if free_horizon else None
        return Layout(size + free_horizon, node, node[:, 1:], interval, horizon, node[:, [0, 0]])
    horizon = nodes[node_size] if free_horizon else None
    node_end = grid[carried + interval_size :]
    initial = (nodes[node_size + free_horizon :] if keep_initial else node)[:, [0, -1]]
    joins = nodes[:, 1:], np.vstack([node_end, nodes[node_size:, :-1]])
    return Layout(size, node, node_end, interval, horizon, initial, joins, inputs)


@dataclass
class TranscriptionBuilder:
    """Builder of the nonlinear program of a problem, to which variables and constraints are added step by step.

    Args:
        formulation: The problem.
        mesh: Ends of the intervals as fractions of the horizon. Shape (N + 1,).
        node_controls: Number of control entries at the nodes, after the states, rather than inside intervals.
        interval_size: Number of variables inside an interval.
        staged: Whether to order the program by stages for a structure-exploiting solver.
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
        sizes, ties = (self.intervals, size, self.interval_size), form.ties_ends
        self.layout = variable_layout(*sizes, form.horizon_is_free, staged=self.staged, keep_initial=ties)
        self.variable_bounds = np.full(self.layout.size, form.bounds.places["free"][0])
        self.variable_role = np.full(self.layout.size, "", dtype="<U8")
        self.variable_entry = np.zeros(self.layout.size, dtype=int)
        self.variable_fraction = np.zeros(self.layout.size)
        self._nodes()

    @property
    def intervals(self) -> int:
        """Number of intervals of the mesh."""
        return len(self.mesh) - 1

    # ---- variables -------------------------------------------------------------------------------------------

    def variables(self, role: str, index: np.ndarray, at: np.ndarray, bounds: str | None) -> None:
        """Declare that variables of given indices represent a state, control or the horizon, and set their bounds.

        Args:
            role: ``state``, ``control`` or ``horizon``.
            index, at: Indices of n entries at K points (n, K), and the fractions of the horizon of the points (K,).
            bounds: Name of their bounds in the bound table, such as ``initial``; None leaves them as they are.
        """
        self.variable_role[index] = role
        self.variable_entry[index] = np.arange(index.shape[0])[:, None]
        self.variable_fraction[index] = at[None, :]
        if bounds is not None:
            self.variable_bounds[index] = self.formulation.bounds.places[bounds][:, None]

    def _nodes(self) -> None:
        """Declare the variables at the nodes and, in the staged layout, the constraints that join stages."""
        nx, layout, mesh = self.formulation.nx, self.layout, self.mesh
        start = np.array([0.0, 0.0])
        for role, part, bounds in (("state", slice(0, nx), "state"), ("control", slice(nx, None), "control")):
            self.variables(role, layout.initial[part], start, None)
            self.variables(role, layout.node_end[part], mesh[1:], None)
            if role == "state" or self.node_controls:
                self.variables(role, layout.node[part], mesh, bounds)
        self.variables("state", layout.node[:nx, :1], mesh[:1], "initial")
        self.variables("state", layout.node[:nx, -1:], mesh[-1:], "terminal")
        if layout.horizon is not None:
            self.variables("horizon", layout.horizon[None, :], mesh, None)
            self.variables("horizon", layout.horizon[None, :1], mesh[:1], "horizon")
        if layout.joins is not None:
            target, source = layout.joins
            names = tuple(f"stage variable {i}" for i in range(len(target)))
            rows = self.rows(names, None, np.arange(self.intervals), mesh[1:], joins=True)
            self.linear(rows, target, 1.0)
            self.linear(rows, source, -1.0)
            if self.formulation.ties_ends:
                n = len(layout.initial)
                ties = self.rows(tuple(f"start {i}" for i in range(n)), None, np.zeros(1, int), mesh[:1], ends=True)
                self.linear(ties, layout.initial[:, :1], 1.0)
                self.linear(ties, layout.node[:, :1], -1.0)

    def point(self, states: np.ndarray, controls: np.ndarray, stages: np.ndarray) -> np.ndarray:
        """Stack the variable indices of the states (nx, K), controls (nu, K) and free horizon of K points."""
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
        """Allocate scalar constraints with given labels at each of K points, and return their indices. Shape (m, K).

        Args:
            bounds: Indices of the bounds of the m rows in the bound table; None for rows that are equal to zero.
            stages, at: Interval of each point, and its fraction of the horizon. Shape (K,).
            joins: Whether the rows tie a stage to the next.
            ends: Whether the rows belong to the ends of the horizon rather than to its inside.
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

    def state_rows(self, kind: str, stages: np.ndarray, at: np.ndarray) -> np.ndarray:
        """Allocate equations of one kind, such as "dynamics", for all states at each of K points; see :meth:`rows`."""
        return self.rows(tuple(f"{kind} of {label}" for label in self.formulation.state_labels), None, stages, at)

    def linear(self, rows: np.ndarray, columns: np.ndarray, values: np.ndarray | float) -> None:
        """Add linear terms ``values * variable[columns]`` to the constraints ``rows``; the arrays are broadcast."""
        targets, variables, entries = np.broadcast_arrays(rows, columns, values)
        self._linear.append((targets.ravel(), variables.ravel(), entries.ravel().astype(float)))

    def path_rows(
        self, rows: Rows, states: np.ndarray, controls: np.ndarray, stages: np.ndarray, *, at: np.ndarray
    ) -> None:
        """Declare path constraints at K points, given the variable indices of states (nx, K) and controls (nu, K)."""
        if len(rows) == 0 or len(at) == 0:
            return
        point_data = self.formulation.point_data(at)
        d = self.formulation.sym("d", len(point_data))
        function = self.formulation.point_function("path", d, 0, rows.expression)
        index = self.rows(rows.labels, rows.bounds, stages, at)
        self.blocks.append(Block(function, self.point(states, controls, stages), point_data, index))

    def node_rows(self, rows: Rows, controls: np.ndarray, *, first_only: bool = False) -> None:
        """Declare path constraints at all mesh nodes; at the first, omit those that initial states determine.

        ``controls`` (nu, N + 1) are variable indices of the controls at the nodes; rows without controls ignore them.
        """
        nodes = np.arange(self.intervals + 1)
        states = self.layout.node[: self.formulation.nx]
        undetermined = (rows.uses_state & ~self.formulation.initial_is_fixed).any(axis=1) | rows.uses_control
        first = nodes[:1]
        self.path_rows(rows.select(undetermined), states[:, first], controls[:, first], first, at=self.mesh[first])
        if not first_only:
            self.path_rows(rows, states[:, 1:], controls[:, 1:], nodes[1:], at=self.mesh[1:])

    def ends(self, first: WeightedControls, last: WeightedControls) -> None:
        """Declare the start and end constraints and the terminal cost.

        Args:
            first, last: Control variables of the first and the last interval, and the weights with which they give the
                control at the start and at the end.
        """
        form = self.formulation
        if len(form.start):
            self._end_block(form.start, 0, 0, first, first)
        controls = ca.vertcat(form.u, form.u0)
        is_constrained = ca.depends_on(ca.vertcat(form.end.expression, form.terminal), controls)
        if self.staged and not self.node_controls and is_constrained:
            text = "a stage-ordered program cannot constrain the control at the end; use ipopt"
            raise ProblemError(text, name="control")
        self._end_block(form.end, form.terminal, 1, last, first)

    def _end_block(
        self, rows: Rows, cost: Any, place: int, controls: WeightedControls, initial: WeightedControls
    ) -> None:
        """Add the block of the constraints and the cost at the start (place 0) or the end (place 1) of the horizon.

        Its variables are the state, the controls, the start state and start controls, and the horizon, as far as used.
        """
        form, layout = self.formulation, self.layout
        sym, nx, nu = form.sym, form.nx, form.nu
        stage = self.intervals if place else 0
        used = ca.vertcat(rows.expression, cost)
        # symbol of the problem, its variables, and their weights
        inputs = [(form.x, layout.node[:nx, stage], np.ones(1))]
        if nu and ca.depends_on(used, form.u):
            inputs.append((form.u, *controls))
        if ca.depends_on(used, form.x0):
            inputs.append((form.x0, layout.initial[:nx, place], np.ones(1)))
        if nu and ca.depends_on(used, form.u0):
            start_controls = (layout.initial[nx:, place], np.ones(1)) if self.node_controls else initial
            inputs.append((form.u0, *start_controls))
        if layout.horizon is not None:
            inputs.append((form.T, layout.horizon[[stage]], np.ones(1)))
        variables = np.concatenate([index.ravel() for _, index, _ in inputs])
        v, d, offset = sym("v", len(variables)), sym("d", 1), 0
        old, new = [], []
        for symbol, index, weights in inputs:
            local = ca.reshape(v[offset : offset + index.size], symbol.numel(), len(weights))
            old.append(symbol)
            new.append(ca.mtimes(local, ca.DM(weights)))
            offset += index.size
        if layout.horizon is None:
            old.append(form.T)
            new.append(form.horizon_value)
        old.append(form.t)
        new.append(place * new[-1])
        outputs = ca.substitute([form.problem.symbols(cost), rows.expression], old, new)
        at = np.array([float(place)])
        labels = self.rows(rows.labels, rows.bounds, np.array([stage]), at, ends=True)
        function = ca.Function("end" if place else "start", [v, d, form.p], outputs)
        self.blocks.append(Block(function, variables[:, None], at[None, :], labels, ends=True))

    # ---- result -------------------------------------------------------------------------------------------

    def finish(
        self,
        report: tuple[np.ndarray, np.ndarray],
        report_states: np.ndarray,
        costate_rows: np.ndarray,
        *,
        costate_scale: np.ndarray,
        interpolants: Interpolants,
    ) -> Transcription:
        """Number the constraints stage by stage and return the transcription."""
        order = np.concatenate(self._order)
        sequence = np.argsort(order, kind="stable")
        number = np.empty_like(sequence)
        number[sequence] = np.arange(len(sequence))
        blocks = tuple(Block(b.function, b.variables, b.data, number[b.rows], b.ends) for b in self.blocks)
        rows, columns, values = (np.concatenate(part) for part in zip(*self._linear, strict=True))
        nx, layout = self.formulation.nx, self.layout
        stages = None
        if layout.joins is not None:
            carried, n = len(layout.joins[0]), self.intervals
            counts = np.bincount(order[order % 2 == 1] // 2, minlength=n + 1)
            stages = Stages((carried,) * (n + 1), (layout.stage_controls,) * n + (0,), tuple(counts.tolist()))
        return Transcription(
            mesh=self.mesh,
            size=layout.size,
            variable_bounds=self.variable_bounds,
            row_bounds=np.concatenate(self._row_bounds)[sequence],
            variable_role=self.variable_role,
            variable_entry=self.variable_entry,
            variable_fraction=self.variable_fraction,
            row_labels=tuple(self._labels[i] for i in sequence),
            row_fractions=np.concatenate(self._fractions)[sequence],
            blocks=blocks,
            linear=(number[rows], columns, values),
            nodes=layout.node[:nx],
            row_stages=np.where(np.concatenate(self._inside), order // 2, -1)[sequence],
            horizon=None if layout.horizon is None else int(layout.horizon[0]),
            report=report,
            report_states=report_states,
            costate_rows=np.where(costate_rows < 0, -1, number[costate_rows]),
            costate_scale=costate_scale,
            interpolants=interpolants,
            stages=stages,
        )


class MeshedMethod(ABC):
    """Base class of methods that turn a problem into a nonlinear program on a mesh of intervals.

    Attributes:
        intervals: Number of intervals.
        control: Shape of the controls inside an interval.
        mesh: Ends of the intervals as fractions 0..1, N + 1 of them; None for equal intervals.
    """

    intervals: int
    control: str
    mesh: tuple[float, ...] | None

    @property
    @abstractmethod
    def order(self) -> int:
        """Order of the integration error of one interval with respect to its width."""

    @property
    @abstractmethod
    def control_order(self) -> int:
        """Order of the interpolation error of a smooth control with respect to the width of an interval."""

    @abstractmethod
    def transcribe(self, form: Formulation, *, staged: bool = False) -> Transcription:
        """Return a problem's nonlinear program; if ``staged``, ordered for a structure-exploiting solver."""

    @property
    def settings(self) -> dict[str, Any]:
        """The method as a solution stores it: the name of the class, and all attributes that are not None."""
        values = {k: v for k, v in dataclasses.asdict(self).items() if v is not None}  # type: ignore[call-overload]
        return {"type": type(self).__name__, **values}

    @property
    def fractions(self) -> np.ndarray:
        """Ends of the intervals as fractions of the horizon. Shape (N + 1,)."""
        return np.linspace(0.0, 1.0, self.intervals + 1) if self.mesh is None else np.asarray(self.mesh, dtype=float)

    def with_mesh(self, mesh: np.ndarray) -> Self:
        """Return the method on another mesh, given by the ends (N + 1,) of its intervals."""
        return dataclasses.replace(self, intervals=len(mesh) - 1, mesh=tuple(mesh.tolist()))  # type: ignore[type-var]

    def halve(self) -> Self:
        """Return the method with a mesh on which every interval is halved."""
        if self.mesh is None:
            return dataclasses.replace(self, intervals=2 * self.intervals)  # type: ignore[type-var]
        nodes = self.fractions
        return self.with_mesh(np.union1d(nodes, (nodes[1:] + nodes[:-1]) / 2))

    def with_nodes_at(self, fractions: Any) -> Self:
        """Return the method with more mesh nodes at fractions 0..1 of the horizon, for example at jumps of a limit.

        A given mesh keeps its nodes. Without one the intervals between the fractions are equal and no wider than
        before.

        Raises:
            ProblemError: The fractions are not numbers from 0 to 1.
        """
        details: dict[str, Any] = {"name": "fractions", "value": fractions}
        with error_names("fractions"):
            added = numeric("with_nodes_at: fractions", fractions)
        if not np.all((added >= 0.0) & (added <= 1.0)):
            raise ProblemError(f"with_nodes_at: fractions must be numbers from 0 to 1, not {fractions!r}", **details)
        if not added.size:
            return self
        nodes = np.array([0.0, 1.0]) if self.mesh is None else self.fractions
        is_node = np.abs(added[:, None] - nodes).min(axis=1) < ROUNDING_SHARE
        added = np.unique(added[~is_node])
        nodes = np.union1d(nodes, added[np.diff(added, prepend=-1.0) >= ROUNDING_SHARE])
        if self.mesh is None:
            counts = np.maximum(np.ceil(np.diff(nodes) * self.intervals - ROUNDING_SHARE), 1).astype(int)
            segments = [np.linspace(a, b, n + 1)[:-1] for a, b, n in zip(nodes[:-1], nodes[1:], counts, strict=True)]
            nodes = np.concatenate([*segments, [1.0]])
        return self.with_mesh(nodes)

    def _check_mesh(self, count: str, largest: int = INPUT_LIMITS.count) -> None:
        """Check the mesh and the integer attribute named ``count``, and convert both to plain Python for storage.

        Raises:
            ProblemError: A number is no positive integer, or the mesh does not increase from 0 to 1 in so many
                intervals.
        """
        name_of_method = type(self).__name__
        for name, most in (("intervals", INPUT_LIMITS.count), (count, largest)):
            object.__setattr__(self, name, require.count(f"{name_of_method}: {name}", getattr(self, name), most=most))
        if self.mesh is None:
            return
        details: dict[str, Any] = {"name": "mesh", "value": self.mesh}
        with error_names("mesh"):
            mesh = numeric(f"{name_of_method}: mesh", self.mesh)
        if mesh.shape != (self.intervals + 1,):
            text = f"{name_of_method}: mesh has {mesh.size} entries, {self.intervals + 1} expected (fractions 0 to 1)"
            raise ProblemError(text, **details)
        if not (mesh[0] == 0.0 and mesh[-1] == 1.0 and np.all(np.diff(mesh) > 0)):
            raise ProblemError(f"{name_of_method}: mesh must increase from 0 to 1, not {mesh.tolist()}", **details)
        object.__setattr__(self, "mesh", tuple(mesh.tolist()))


def check_meshed(caller: str, method: Any, tolerance: Any) -> None:
    """Raise ProblemError unless a method has a mesh of intervals, and the tolerance is positive and finite."""
    if not isinstance(method, MeshedMethod):
        words = f"{caller}: Collocation(...) or MultipleShooting(...) is expected, not {method!r}"
        raise ProblemError(words, name="method", value=method)
    require.positive(f"{caller}: tolerance", tolerance)
