"""Partially separable nonlinear programs: small functions applied to many sets of variables, with exact derivatives.

A transcription states the variables, the small functions (*blocks*) with the variables that each application reads, and
the linear rows. The derivatives of a block are derived once, mapped over its applications and scattered by a constant
sparse matrix. Building a program therefore costs the same for 10 intervals as for 1000.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import casadi as ca
import numpy as np
import scipy

from ocp.console import check_time
from ocp.curves import PiecewisePolynomial
from ocp.problem.formulation import Formulation
from ocp.problem.values import symbols_of


@dataclass(frozen=True)
class Block:
    """Block of a nonlinear program: a small function that is evaluated at several sets of the program's variables.

    Attributes:
        function: casadi Function (v (n), d (nd), p) -> (cost, g (m)).
        variables: Variables of the program that each application reads. Shape (n, K).
        data: Constants of each application. Shape (nd, K).
        rows: Rows of the program that each application adds to. Shape (m, K).
        ends: Whether the block belongs to the ends of the horizon rather than to its inside.
    """

    function: Any
    variables: np.ndarray
    data: np.ndarray
    rows: np.ndarray
    ends: bool = False


@dataclass(frozen=True)
class Stages:
    """Numbers of states, controls and constraints in each stage of a program, for structure-exploiting solvers."""

    states: tuple[int, ...]
    controls: tuple[int, ...]
    rows: tuple[int, ...]


@dataclass(frozen=True)
class Interpolants:
    """Rule that builds the interpolants of states and controls from the variables of a nonlinear program.

    Attributes:
        breaks: Ends of the segments of the states, as fractions of the horizon; every interval has the same number of
            segments. Shape (K + 1,).
        nodes: Positions of the values in a segment. Shape (d,).
        variables: Variables that determine the states of each interval. Shape (n, N).
        mesh, control_nodes: Breaks and nodes of the controls, one segment per interval. Shapes (N + 1,), (c,).
        controls: Control variables of each interval, node by node. Shape (c nu, N).
        data: Constants of each interval. Shape (nd, N).
        values: casadi Function (v (n), data (nd), T, p) -> state values in the segments of an interval, (nx, .), node
            by node; None if the values are the variables.
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
        """Return the interpolants of states and controls for given values of the variables of a nonlinear program."""
        values = variables[self.variables].T
        if self.values is not None:
            inputs = variables[self.variables], self.data, horizon, parameters
            values = np.asarray(self.mapped(*inputs).full()).T
        states = values.reshape(len(self.breaks) - 1, len(self.nodes), -1)
        controls = variables[self.controls].T.reshape(len(self.mesh) - 1, len(self.control_nodes), -1)
        state_curve = PiecewisePolynomial(self.breaks, self.nodes, states)
        return state_curve, PiecewisePolynomial(self.mesh, self.control_nodes, controls)

    @cached_property
    def mapped(self) -> Any:
        """The casadi Function that computes the state values of all mesh intervals by one call."""
        return self.values.map("curves", "serial", self.variables.shape[1], [2, 3], [])


@dataclass(frozen=True)
class Transcription:
    """The nonlinear program that results from the transcription of a problem.

    Attributes:
        mesh: Ends of the intervals, as fractions of the horizon. Shape (N + 1,).
        size: Number of variables.
        variable_bounds, row_bounds: Index of each variable and row in the bound table.
        variable_role: ``state``, ``control`` or ``horizon`` for each variable. Length size.
        variable_entry, variable_fraction: Entry of the role, and fraction of the horizon, for guesses. Length size.
        row_labels, row_fractions: Description of each row, and its fraction of the horizon. Length n_rows.
        blocks: Nonlinear part of cost and rows.
        linear: Linear part of the rows as (rows, columns, values).
        horizon: Index of the horizon at the start, or None if it is fixed.
        report: Interval of every reported point, and its position there (0..1). Shape (M,) each.
        report_states: Indices of the states at the reported points. Shape (M, nx).
        nodes: Indices of the states at the nodes. Shape (nx, N + 1).
        row_stages: Interval of each row; -1 for rows that only involve the ends. Length n_rows.
        costate_rows: Rows whose multipliers are the costates at the reported points; -1 if the point is a node, whose
            costate follows from the intervals after it. Shape (M, nx).
        costate_scale: Factor from multiplier to costate. Shape (M,).
        interpolants: Construction of the interpolants.
        stages: Stage structure of a stage-ordered program, or None.
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
    costate_scale: np.ndarray
    interpolants: Interpolants
    stages: Stages | None

    @property
    def n_rows(self) -> int:
        """Number of scalar constraints of the program."""
        return len(self.row_labels)

    @property
    def start(self) -> np.ndarray:
        """Indices of the variables of the initial state. Shape (nx,)."""
        return self.nodes[:, 0]

    @property
    def end(self) -> np.ndarray:
        """Indices of the variables of the final state. Shape (nx,)."""
        return self.nodes[:, -1]

    def duration(self, form: Formulation, variables: np.ndarray, p: np.ndarray) -> float:
        """Return the horizon (final time), s, from its variable if the horizon is free, else from the parameters."""
        return float(form.horizon_at(p) if self.horizon is None else variables[self.horizon])

    def arguments(self, p: np.ndarray, bounds: tuple[np.ndarray, np.ndarray]) -> dict[str, np.ndarray]:
        """Return the solver arguments p, lbx, ubx, lbg, ubg from the parameters and the problem's numeric bounds."""
        lower, upper = bounds
        return {
            "p": p,
            "lbx": lower[self.variable_bounds],
            "ubx": upper[self.variable_bounds],
            "lbg": lower[self.row_bounds],
            "ubg": upper[self.row_bounds],
        }


@dataclass(frozen=True)
class FunctionSizes:
    """Thresholds for the number of instructions of a function, which decide how the function is built.

    Attributes:
        compared: Above this number, the search for common subexpressions takes longer than a solve without it.
        inlined: Up to this number, an interval of multiple shooting is one flat SX function.
        called: Up to this number, a call takes as long as the evaluation, and the function is not compiled.
    """

    compared: int = 50_000
    inlined: int = 3000
    called: int = 10


SIZES = FunctionSizes()


@dataclass(frozen=True)
class Program:
    """A nonlinear program: minimise f(x, p) subject to bounds on x and g(x, p).

    Attributes:
        nlp: The MX expressions x, p, f, g by name.
        gradient, jacobian, hessian: casadi Functions with the signatures of ``nlpsol``'s grad_f, jac_g and hess_lag.
        values: Function (x, p) -> (f, g).
        running_gradient: Function (x, p) -> gradient of the running cost, without the terminal cost.
        parametric: Function (x, p, lam_g) -> gradient of f + lam_g . g with respect to p.
    """

    nlp: dict[str, Any]
    gradient: Any
    jacobian: Any
    hessian: Any
    values: Any
    running_gradient: Any
    parametric: Any

    @cached_property
    def numbers(self) -> NumericDerivatives:
        """Evaluator of the program's cost, constraints and derivatives as NumPy and SciPy arrays."""
        return NumericDerivatives(self)

    @cached_property
    def jacobian_entries(self) -> tuple[np.ndarray, np.ndarray]:
        """Row and column of each nonzero of the Jacobian of the constraints."""
        return places_of(self.jacobian.sparsity_out(1))


class NumericDerivatives:
    """Evaluator of a nonlinear program's functions and derivatives as arrays, with a cache for the last point.

    CasADi converts its matrices to Python entry by entry, which takes longer than their evaluation. Here the functions
    write into arrays, and the sparsity patterns are read once.
    """

    def __init__(self, program: Program) -> None:
        functions = program.gradient, program.jacobian, program.hessian, program.running_gradient, program.parametric
        self._gradient, self._jacobian, self._hessian, self._running, self._parametric = map(ArrayFunction, functions)
        self._at: tuple[np.ndarray, np.ndarray] | None = None
        self._cached: tuple[Any, ...] = ()

    def _evaluate(self, x: np.ndarray, p: np.ndarray) -> tuple[Any, ...]:
        """Return the cost, its gradient, the values of the constraints and their Jacobian."""
        at = self._at
        if at is None or not (np.array_equal(at[0], x) and np.array_equal(at[1], p)):
            (cost, slope), (rows, jacobian) = self._gradient(x, p), self._jacobian(x, p)
            self._cached = float(cost[0]), slope, rows, jacobian
            self._at = x.copy(), p.copy()
        return self._cached

    def first(self, x: np.ndarray, p: np.ndarray) -> tuple[np.ndarray, scipy.sparse.csc_array]:
        """Return the gradient of the cost and the Jacobian of the constraints. Shapes (n,) and (m, n)."""
        _, slope, _, jacobian = self._evaluate(x, p)
        return slope, jacobian

    def values(self, x: np.ndarray, p: np.ndarray) -> tuple[float, np.ndarray]:
        """Return the cost and the values of the m constraints. Shape (m,)."""
        cost, _, rows, _ = self._evaluate(x, p)
        return cost, rows

    def gradient(self, x: np.ndarray, p: np.ndarray) -> np.ndarray:
        """Return the gradient of the cost without evaluating the constraints. Shape (n,)."""
        return np.asarray(self._gradient(x, p)[1])

    def second(self, x: np.ndarray, p: np.ndarray, sigma: float, lam: np.ndarray) -> scipy.sparse.csc_array:
        """Return the upper Hessian triangle (n, n) of ``sigma`` times the cost plus ``lam`` times the constraints."""
        upper: scipy.sparse.csc_array = self._hessian(x, p, np.array([sigma]), lam)[0]
        return upper

    def running_gradient(self, x: np.ndarray, p: np.ndarray) -> np.ndarray:
        """Return the gradient of the cost without its terminal part. Shape (n,)."""
        return np.asarray(self._running(x, p)[0])

    def parametric(self, x: np.ndarray, p: np.ndarray, lam: np.ndarray) -> np.ndarray:
        """Return the gradient of cost plus ``lam`` times constraints with respect to the parameters. Shape (n_p,)."""
        return np.asarray(self._parametric(x, p, lam)[0])


class ArrayFunction:
    """Evaluator of a casadi Function with NumPy arrays. With `kept` buffers only one thread may call it at a time."""

    def __init__(self, function: Any, *, kept: bool = False) -> None:
        self._function = function
        patterns = [function.sparsity_out(i) for i in range(function.n_out())]
        self._sizes, self._shapes = [each.nnz() for each in patterns], [each.shape for each in patterns]
        self._indices = [
            tuple(np.array(part, dtype=np.int32) for part in (each.row(), each.colind())) for each in patterns
        ]
        self._kept = self._allocate() if kept else None

    def _allocate(self) -> tuple[Any, Any, list[np.ndarray], list[np.ndarray]]:
        """Return casadi's buffer for an evaluation, the call that evaluates, and the arrays of inputs and outputs."""
        buffer, run = self._function.buffer()
        inputs = [np.zeros(self._function.nnz_in(i)) for i in range(self._function.n_in())]
        outputs = [np.zeros(size) for size in self._sizes]
        for pass_pointer, arrays in ((buffer.set_arg, inputs), (buffer.set_res, outputs)):
            for i, each in enumerate(arrays):
                pass_pointer(i, each.data)
        return buffer, run, inputs, outputs

    def __call__(self, *arguments: np.ndarray) -> list[Any]:
        """Return the outputs of the function, columns as arrays, others as sparse matrices, or raise RuntimeError."""
        buffer, run, inputs, outputs = self._kept or self._allocate()
        for own, each in zip(inputs, arguments, strict=True):
            own[:] = each.ravel()
        run()
        if buffer.ret():
            raise RuntimeError(f"{self._function.name()} cannot be evaluated")
        return [
            dense_column(data.copy() if self._kept else data, index[0], shape[0])
            if shape[1] == 1
            else scipy.sparse.csc_array((data, *index), shape=shape, copy=bool(self._kept))
            for data, index, shape in zip(outputs, self._indices, self._shapes, strict=True)
        ]


def dense_column(nonzeros: np.ndarray, rows: np.ndarray, size: int) -> np.ndarray:
    """Return a dense column from its nonzero entries. Shape (size,)."""
    if len(nonzeros) == size:
        return nonzeros
    column = np.zeros(size)
    column[rows] = nonzeros
    return column


class Derivatives(NamedTuple):
    """The function of a :class:`Block` and the derivatives of this function, as casadi Functions.

    Their arguments are the variables v, the data d (constants of the block) and the parameters p.

    Attributes:
        value: -> (cost, g).
        gradient: Of the cost, -> (1, n).
        jacobian: Of g, -> (m, n).
        hessian: (v, d, p, sigma, lam) -> upper triangle (n, n) of the Hessian of sigma cost + lam . g.
        slope: (v, d, p, lam) -> gradient (n_p, 1) of cost + lam . g with respect to the parameters.
    """

    value: Any
    gradient: Any
    jacobian: Any
    hessian: Any
    slope: Any


def assemble(transcription: Transcription, parameters: int, functions: Sequence[Derivatives] | None = None) -> Program:
    """Assemble a nonlinear program from its transcription and the derivatives of its blocks of cost and constraints.

    Raises:
        TimeLimitReached: The time limit is over.
    """
    blocks = transcription.blocks
    if functions is None:
        functions = [derivatives(block.function) for block in blocks]
    n, m = transcription.size, transcription.n_rows
    x, p = ca.MX.sym("x", n), ca.MX.sym("p", parameters)
    sigma, lam = ca.MX.sym("lam_f"), ca.MX.sym("lam_g", m)
    calls = [
        (block, function, [gather(x, block.variables), ca.MX(ca.DM(block.data)), p])
        for block, function in zip(blocks, functions, strict=True)
    ]

    outputs = [evaluate_block(function.value, block, call) for block, function, call in calls]
    f = sum((ca.sum2(out[0]) for out in outputs), ca.MX(0))
    nonlinear = scatter([block.rows.ravel(order="F") for block in blocks], [ca.densify(out[1]) for out in outputs], m)
    g = nonlinear + ca.mtimes(sparse(*transcription.linear, (m, n)), x)

    parts = [evaluate_block(function.gradient, block, call)[0] for block, function, call in calls]
    entries = [places_of(function.gradient.sparsity_out(0)) for _, function, _ in calls]
    places = [block.variables[column].ravel(order="F") for block, (_, column) in zip(blocks, entries, strict=True)]
    gradient = scatter(places, parts, n)
    inner = [i for i, block in enumerate(blocks) if not block.ends]
    inside = scatter([places[i] for i in inner], [parts[i] for i in inner], n)

    parts = [evaluate_block(function.jacobian, block, call)[0] for block, function, call in calls]
    entries = [places_of(function.jacobian.sparsity_out(0)) for _, function, _ in calls]
    entries = [
        (block.rows[row].ravel(order="F"), block.variables[column].ravel(order="F"))
        for block, (row, column) in zip(blocks, entries, strict=True)
    ]
    jac = _scatter_matrix(entries, parts, transcription.linear, (m, n))

    parts = []
    for block, function, call in calls:
        weights = ca.repmat(sigma, 1, block.variables.shape[1]), gather(lam, block.rows)
        parts += evaluate_block(function.hessian, block, [*call, *weights])
    no_constants = (np.zeros(0, int), np.zeros(0, int), np.zeros(0))
    upper = [hessian_at(function.hessian.sparsity_out(0), block) for block, function, _ in calls]
    hess = _scatter_matrix([at for at, _ in upper], parts, no_constants, (n, n), [factors for _, factors in upper])

    slope = ca.MX.zeros(parameters)
    for block, function, call in calls if parameters else ():
        slope += ca.sum2(evaluate_block(function.slope, block, [*call, gather(lam, block.rows)])[0])
    return Program(
        nlp={"x": x, "p": p, "f": f, "g": g},
        gradient=ca.Function("nlp_grad_f", [x, p], [f, gradient], ["x", "p"], ["f", "grad_f_x"]),
        jacobian=ca.Function("nlp_jac_g", [x, p], [g, jac], ["x", "p"], ["g", "jac_g_x"]),
        hessian=ca.Function(
            "nlp_hess_l", [x, p, sigma, lam], [hess], ["x", "p", "lam_f", "lam_g"], ["triu_hess_gamma_x_x"]
        ),
        values=ca.Function("values", [x, p], [f, g]),
        running_gradient=ca.Function("inside", [x, p], [inside]),
        parametric=ca.Function("parametric", [x, p, lam], [slope]),
    )


def derivatives(function: Any) -> Derivatives:
    """Return the function of a :class:`Block` and the exact symbolic derivatives of this function."""
    symbol = symbols_of(function).sym
    v, d, p = (symbol(name, function.numel_in(i)) for i, name in enumerate(("v", "d", "p")))
    cost, g = function(v, d, p)
    sigma, lam = symbol("sigma"), symbol("lam", g.numel())
    hessian = ca.triu(ca.hessian(sigma * cost + ca.dot(lam, g), v)[0])
    slope = ca.densify(ca.gradient(cost + ca.dot(lam, g), p))
    return Derivatives(
        build_function("value", [v, d, p], [cost, g]),
        build_function("gradient", [v, d, p], [ca.jacobian(cost, v)]),
        build_function("jacobian", [v, d, p], [ca.jacobian(g, v)]),
        build_function("hessian", [v, d, p, sigma, lam], [hessian]),
        build_function("slope", [v, d, p, lam], [slope]),
    )


def hessian_at(pattern: Any, block: Block) -> tuple[tuple[np.ndarray, np.ndarray], np.ndarray]:
    """Return row and column in the program's Hessian, and a factor, for each nonzero of a block's Hessian triangle."""
    first, second = places_of(pattern)
    where = block.variables
    upper = np.minimum(where[first], where[second]).ravel(order="F")
    lower = np.maximum(where[first], where[second]).ravel(order="F")
    # an off-diagonal entry of the block that falls on the diagonal counts for both triangles
    doubled = np.where((upper == lower) & np.tile(first != second, where.shape[1]), 2.0, 1.0)
    return (upper, lower), doubled


def places_of(pattern: Any) -> tuple[np.ndarray, np.ndarray]:
    """Return the row and column of each nonzero of a casadi sparsity pattern."""
    row, column = pattern.get_triplet()
    return np.array(row, dtype=int), np.array(column, dtype=int)


def build_function(name: str, arguments: list[Any], outputs: list[Any]) -> Any:
    """Return a casadi Function in which common subexpressions are eliminated, unless the function is large."""
    large = ca.Function(name, arguments, outputs).n_instructions() > SIZES.compared
    return ca.Function(name, arguments, outputs, {"cse": not large})


def gather(vector: Any, index: np.ndarray) -> Any:
    """Return the entries of a vector at an array of indices (n, K), as a matrix of the same shape."""
    if index.size == 0:
        return ca.MX(*index.shape)
    return ca.reshape(vector[index.ravel(order="F").tolist()], *index.shape)


def evaluate_block(function: Any, block: Block, arguments: list[Any]) -> Any:
    """Evaluate the function of a block for each column of the arguments; all columns share the parameters."""
    check_time()
    count = block.variables.shape[1]
    if count == 1:
        return function.call(arguments)
    # shared parameters are read once instead of being copied
    return function.map(function.name() + "_map", "serial", count, [2], []).call(arguments)


def nonzeros(matrices: list[Any]) -> Any:
    """Return the nonzeros of several matrices, concatenated in one vector."""
    flat = [ca.sparsity_cast(matrix, ca.Sparsity.dense(matrix.nnz(), 1)) for matrix in matrices]
    return ca.vertcat(ca.MX(0, 1), *flat)


def scatter(places: list[np.ndarray], matrices: list[Any], size: int) -> Any:
    """Return a vector of sums: each nonzero of ``matrices`` is added at its index in ``places``."""
    where = np.concatenate([np.zeros(0, int), *places])
    values = nonzeros(matrices)
    collect = sparse(where, np.arange(where.size), np.ones(where.size), (size, where.size))
    return ca.densify(ca.mtimes(collect, values))  # solvers ask for dense vectors


def _scatter_matrix(
    places: list[tuple[np.ndarray, np.ndarray]],
    matrices: list[Any],
    constant: tuple[np.ndarray, np.ndarray, np.ndarray],
    shape: tuple[int, int],
    factors: list[np.ndarray] | None = None,
) -> Any:
    """Return a sparse matrix to which constants and weighted nonzeros of ``matrices`` are added at given positions."""
    rows = np.concatenate([constant[0], *[at[0] for at in places]]).astype(int)
    columns = np.concatenate([constant[1], *[at[1] for at in places]]).astype(int)
    entries, number = np.unique(columns * shape[0] + rows, return_inverse=True)
    pattern = ca.Sparsity.triplet(*shape, (entries % shape[0]).tolist(), (entries // shape[0]).tolist())
    fixed = constant[0].size
    base = np.bincount(number[:fixed], weights=constant[2], minlength=entries.size)
    weights = np.ones(number.size - fixed) if factors is None else np.concatenate([np.zeros(0), *factors])
    collect = sparse(number[fixed:], np.arange(weights.size), weights, (entries.size, weights.size))
    values = nonzeros(matrices)
    return ca.MX(pattern, ca.mtimes(collect, values) + ca.MX(ca.DM(base)))


def sparse(rows: np.ndarray, columns: np.ndarray, values: np.ndarray, shape: tuple[int, int]) -> Any:
    """Return a constant sparse matrix from row indices, column indices and values; duplicate entries are summed."""
    check_time()
    entries, number = np.unique(columns.astype(np.int64) * shape[0] + rows, return_inverse=True)
    summed = np.bincount(number, weights=values, minlength=entries.size)
    pattern = ca.Sparsity.triplet(*shape, (entries % shape[0]).tolist(), (entries // shape[0]).tolist())
    return ca.DM(pattern, ca.DM(summed))
