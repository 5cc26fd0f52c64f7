"""A partially separable nonlinear program: small functions repeated over many index sets, with exact derivatives.

A transcription states the variables, the small functions (*blocks*) with the variables that each application reads,
and the linear rows. The derivatives of a block are derived once, mapped over its applications and scattered by a
constant sparse matrix, so that building costs the same for 10 intervals and for 1000.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import casadi as ca
import numpy as np
import scipy.sparse as sp

from ocp.console import check_time
from ocp.curves import PiecewisePolynomial
from ocp.problem.values import symbols_of

__all__ = ["SIZES", "Block", "Derivatives", "Fragment", "Interpolants", "Program", "Stages", "assemble", "derivatives"]


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


@dataclass(frozen=True)
class FunctionSizes:
    """Numbers of instructions of a function.

    Attributes:
        compared: To look for equal ones among more takes longer than a solve with all of them.
        inlined: Up to so many, an interval of multiple shooting is one flat SX function.
        called: So few take as long to call as to do, and are not compiled.
    """

    compared: int = 50_000
    inlined: int = 3000
    called: int = 10


SIZES = FunctionSizes()


@dataclass(frozen=True)
class Program:
    """A nonlinear program: minimise f(x, p) subject to bounds on x and g(x, p).

    Attributes:
        nlp: Dictionary of the MX expressions x, p, f, g.
        gradient, jacobian, hessian: casadi Functions with the signatures that ``nlpsol`` asks of
            ``grad_f``, ``jac_g`` and ``hess_lag``.
        values: Function (x, p) -> (f, g).
        inside: Function (x, p) -> gradient of the cost inside the horizon, without the terminal cost.
        parametric: Function (x, p, lam_g) -> gradient of f + lam_g . g in p.
    """

    nlp: dict[str, Any]
    gradient: Any
    jacobian: Any
    hessian: Any
    values: Any
    inside: Any
    parametric: Any

    @cached_property
    def numbers(self) -> Numbers:
        """The derivatives as arrays."""
        return Numbers(self)

    @cached_property
    def jacobian_entries(self) -> tuple[np.ndarray, np.ndarray]:
        """Row and column of each nonzero of the Jacobian."""
        row, column = self.jacobian.sparsity_out(1).get_triplet()
        return np.array(row, dtype=np.int32), np.array(column, dtype=np.int32)


class Numbers:
    """Values and derivatives of a program as arrays of numpy and scipy; those at the last point are kept.

    CasADi hands its matrices to Python number by number, which takes longer than computing them: here functions write
    into arrays, and where the nonzeros stand is asked once.
    """

    def __init__(self, program: Program) -> None:
        functions = program.gradient, program.jacobian, program.hessian, program.inside, program.parametric
        self._gradient, self._jacobian, self._hessian, self._inside, self._parametric = map(Written, functions)
        self._at: tuple[np.ndarray, np.ndarray] | None = None
        self._found: tuple[Any, ...] = ()

    def _all(self, x: np.ndarray, p: np.ndarray) -> tuple[Any, ...]:
        """Cost, its gradient, rows and their Jacobian."""
        at = self._at
        if at is None or not (np.array_equal(at[0], x) and np.array_equal(at[1], p)):
            (cost, slope), (rows, jacobian) = self._gradient(x, p), self._jacobian(x, p)
            self._found = float(cost[0]), slope, rows, jacobian
            self._at = x.copy(), p.copy()
        return self._found

    def first(self, x: np.ndarray, p: np.ndarray) -> tuple[np.ndarray, sp.csc_array]:
        """Gradient of the cost (n,), and Jacobian of the rows (m, n)."""
        _, slope, _, jacobian = self._all(x, p)
        return slope, jacobian

    def values(self, x: np.ndarray, p: np.ndarray) -> tuple[float, np.ndarray]:
        """Cost and rows (m,)."""
        cost, _, rows, _ = self._all(x, p)
        return cost, rows

    def gradient(self, x: np.ndarray, p: np.ndarray) -> np.ndarray:
        """Gradient of the cost alone. Shape (n,)."""
        return np.asarray(self._gradient(x, p)[1])

    def second(self, x: np.ndarray, p: np.ndarray, sigma: float, lam: np.ndarray) -> sp.csc_array:
        """Upper triangle of the Hessian of sigma f + lam . g. Shape (n, n)."""
        found: sp.csc_array = self._hessian(x, p, np.array([sigma]), lam)[0]
        return found

    def inside(self, x: np.ndarray, p: np.ndarray) -> np.ndarray:
        """Gradient of the cost inside the horizon. Shape (n,)."""
        return np.asarray(self._inside(x, p)[0])

    def parametric(self, x: np.ndarray, p: np.ndarray, lam: np.ndarray) -> np.ndarray:
        """Gradient of f + lam . g in the parameters. Shape (n_p,)."""
        return np.asarray(self._parametric(x, p, lam)[0])


class Written:
    """A casadi Function of dense vectors that writes its outputs into arrays of their nonzeros."""

    def __init__(self, function: Any) -> None:
        self._function = function
        patterns = [function.sparsity_out(i) for i in range(function.n_out())]
        self._sizes, self._shapes = [each.nnz() for each in patterns], [each.shape for each in patterns]
        self._indices = [
            tuple(np.array(part, dtype=np.int32) for part in (one.row(), one.colind())) for one in patterns
        ]

    def __call__(self, *given: np.ndarray) -> list[Any]:
        """Its values: columns as arrays (n,), the others as matrices of their own.

        Raises:
            RuntimeError: The function fails, as an integrator does.
        """
        buffer, run = self._function.buffer()  # for this call: what it works in takes more memory than what it writes
        found = [np.zeros(size) for size in self._sizes]
        kept = [np.ascontiguousarray(each, dtype=float).ravel() for each in given]
        for i, each in enumerate(kept):
            buffer.set_arg(i, each.data)
        for i, each in enumerate(found):
            buffer.set_res(i, each.data)
        run()
        if buffer.ret():
            raise RuntimeError(f"{self._function.name()} cannot be evaluated")
        return [
            whole(data, index[0], shape[0]) if shape[1] == 1 else sp.csc_array((data, *index), shape=shape)
            for data, index, shape in zip(found, self._indices, self._shapes, strict=True)
        ]


def whole(nonzeros: np.ndarray, rows: np.ndarray, size: int) -> np.ndarray:
    """A column of its nonzeros. Shape (size,)."""
    if len(nonzeros) == size:
        return nonzeros
    column = np.zeros(size)
    column[rows] = nonzeros
    return column


class Derivatives(NamedTuple):
    """A block function with its derivatives, as casadi Functions of (v, d, p).

    Attributes:
        value: -> (cost, g). gradient: Of the cost, -> (1, n). jacobian: Of g, -> (m, n).
        hessian: (v, d, p, sigma, lam) -> upper triangle (n, n) of that of sigma cost + lam . g.
        slope: (v, d, p, lam) -> gradient (n_p, 1) of cost + lam . g in the parameters.
    """

    value: Any
    gradient: Any
    jacobian: Any
    hessian: Any
    slope: Any


def assemble(fragment: Fragment, parameters: int, functions: Sequence[Derivatives] | None = None) -> Program:
    """The program of a fragment, from the derivatives of its blocks, which are made where they are not given.

    Raises:
        TimeLimitReached: The time limit is over.
    """
    blocks = fragment.blocks
    if functions is None:
        functions = [derivatives(block.function) for block in blocks]
    n, m = fragment.size, fragment.n_rows
    x, p = ca.MX.sym("x", n), ca.MX.sym("p", parameters)
    sigma, lam = ca.MX.sym("lam_f"), ca.MX.sym("lam_g", m)
    calls = [(block, each, [*inputs(block, x), p]) for block, each in zip(blocks, functions, strict=True)]

    outputs = [mapped(each.value, block, call) for block, each, call in calls]
    f = sum((ca.sum2(out[0]) for out in outputs), ca.MX(0))
    nonlinear = scatter([block.rows.ravel(order="F") for block in blocks], [ca.densify(out[1]) for out in outputs], m)
    g = nonlinear + ca.mtimes(sparse(*fragment.linear, (m, n)), x)

    pieces = [mapped(each.gradient, block, call)[0] for block, each, call in calls]
    places = [gradient_at(each.gradient.sparsity_out(0), block) for block, each, _ in calls]
    gradient = scatter(places, pieces, n)
    inner = [i for i, block in enumerate(blocks) if not block.ends]
    inside = scatter([places[i] for i in inner], [pieces[i] for i in inner], n)

    pieces = [mapped(each.jacobian, block, call)[0] for block, each, call in calls]
    spots = [jacobian_at(each.jacobian.sparsity_out(0), block) for block, each, _ in calls]
    jac = scatter_matrix(spots, pieces, fragment.linear, (m, n))

    pieces = [
        mapped(each.hessian, block, [*call, repeat(sigma, block), gather(lam, block.rows)])[0]
        for block, each, call in calls
    ]
    nothing = (np.zeros(0, int), np.zeros(0, int), np.zeros(0))
    both = [hessian_at(each.hessian.sparsity_out(0), block) for block, each, _ in calls]
    hess = scatter_matrix([at for at, _ in both], pieces, nothing, (n, n), [factors for _, factors in both])

    slope = ca.MX.zeros(parameters)
    if parameters:
        slope += sum(ca.sum2(mapped(each.slope, b, [*call, gather(lam, b.rows)])[0]) for b, each, call in calls)
    return Program(
        nlp={"x": x, "p": p, "f": f, "g": g},
        gradient=ca.Function("nlp_grad_f", [x, p], [f, gradient], ["x", "p"], ["f", "grad_f_x"]),
        jacobian=ca.Function("nlp_jac_g", [x, p], [g, jac], ["x", "p"], ["g", "jac_g_x"]),
        hessian=ca.Function(
            "nlp_hess_l", [x, p, sigma, lam], [hess], ["x", "p", "lam_f", "lam_g"], ["triu_hess_gamma_x_x"]
        ),
        values=ca.Function("values", [x, p], [f, g]),
        inside=ca.Function("inside", [x, p], [inside]),
        parametric=ca.Function("parametric", [x, p, lam], [slope]),
    )


# ---- one block ---------------------------------------------------------------------------------------------------


def derivatives(function: Any) -> Derivatives:
    """A block function with its derivatives, exact and symbolic."""
    symbol = symbols_of(function).sym
    v, d, p = (symbol(name, function.numel_in(i)) for i, name in enumerate(("v", "d", "p")))
    cost, g = function(v, d, p)
    sigma, lam = symbol("sigma"), symbol("lam", g.numel())
    hessian = ca.triu(ca.hessian(sigma * cost + ca.dot(lam, g), v)[0])
    slope = ca.densify(ca.gradient(cost + ca.dot(lam, g), p))
    return Derivatives(
        without_repeats("value", [v, d, p], [cost, g]),
        without_repeats("gradient", [v, d, p], [ca.jacobian(cost, v)]),
        without_repeats("jacobian", [v, d, p], [ca.jacobian(g, v)]),
        without_repeats("hessian", [v, d, p, sigma, lam], [hessian]),
        without_repeats("slope", [v, d, p, lam], [slope]),
    )


def gradient_at(pattern: Any, block: Block) -> np.ndarray:
    """The variable of the program that each nonzero of a block's gradient is of, application by application."""
    return np.asarray(block.variables[places_of(pattern)[1]].ravel(order="F"))


def jacobian_at(pattern: Any, block: Block) -> tuple[np.ndarray, np.ndarray]:
    """Row and column in the program of each nonzero of a block's Jacobian, application by application."""
    row, column = places_of(pattern)
    return block.rows[row].ravel(order="F"), block.variables[column].ravel(order="F")


def hessian_at(pattern: Any, block: Block) -> tuple[tuple[np.ndarray, np.ndarray], np.ndarray]:
    """Row and column in the program's upper triangle of each nonzero of a block's, and its factor there."""
    first, second = places_of(pattern)
    where = block.variables
    upper = np.minimum(where[first], where[second]).ravel(order="F")
    lower = np.maximum(where[first], where[second]).ravel(order="F")
    # an off-diagonal entry of the block that falls on the diagonal stands for both its mirror images
    doubled = np.where((upper == lower) & np.tile(first != second, where.shape[1]), 2.0, 1.0)
    return (upper, lower), doubled


def places_of(pattern: Any) -> tuple[np.ndarray, np.ndarray]:
    """Row and column of each nonzero."""
    row, column = pattern.get_triplet()
    return np.array(row, dtype=int), np.array(column, dtype=int)


def without_repeats(name: str, given: list[Any], outputs: list[Any]) -> Any:
    """A casadi Function in which nothing is computed twice, unless it is large."""
    large = ca.Function(name, given, outputs).n_instructions() > SIZES.compared
    return ca.Function(name, given, outputs, {"cse": not large})


def inputs(block: Block, x: Any) -> list[Any]:
    return [gather(x, block.variables), ca.MX(ca.DM(block.data))]


def gather(vector: Any, index: np.ndarray) -> Any:
    """Entries ``index`` (n, K) of a vector as a matrix (n, K)."""
    if index.size == 0:
        return ca.MX(*index.shape)
    return ca.reshape(vector[index.ravel(order="F").tolist()], *index.shape)


def repeat(scalar: Any, block: Block) -> Any:
    return ca.repmat(scalar, 1, block.variables.shape[1])


def mapped(function: Any, block: Block, arguments: list[Any]) -> Any:
    """A block function over all its applications; the parameters (argument 2) are shared."""
    check_time()
    count = block.variables.shape[1]
    if count == 1:
        return function.call(arguments)
    # parameters are the same for all: casadi reads them once instead of making copies
    return function.map(function.name() + "_map", "serial", count, [2], []).call(arguments)


def nonzeros(pieces: list[Any]) -> Any:
    """The nonzeros of all pieces in one vector."""
    flat = [ca.sparsity_cast(piece, ca.Sparsity.dense(piece.nnz(), 1)) for piece in pieces]
    return ca.vertcat(ca.MX(0, 1), *flat)


def scatter(places: list[np.ndarray], pieces: list[Any], size: int) -> Any:
    """A vector with each entry of ``pieces`` added at its place."""
    where = np.concatenate([np.zeros(0, int), *places])
    values = nonzeros(pieces)
    collect = sparse(where, np.arange(where.size), np.ones(where.size), (size, where.size))
    return ca.densify(ca.mtimes(collect, values))  # solvers ask for dense vectors


def scatter_matrix(
    places: list[tuple[np.ndarray, np.ndarray]],
    pieces: list[Any],
    constant: tuple[np.ndarray, np.ndarray, np.ndarray],
    shape: tuple[int, int],
    factors: list[np.ndarray] | None = None,
) -> Any:
    """A sparse matrix with each entry of ``pieces`` (times its factor) added at its place, plus constant entries."""
    rows = np.concatenate([constant[0], *[at[0] for at in places]]).astype(int)
    columns = np.concatenate([constant[1], *[at[1] for at in places]]).astype(int)
    entries, number = np.unique(columns * shape[0] + rows, return_inverse=True)
    pattern = ca.Sparsity.triplet(*shape, (entries % shape[0]).tolist(), (entries // shape[0]).tolist())
    fixed = constant[0].size
    base = np.bincount(number[:fixed], weights=constant[2], minlength=entries.size)
    weights = np.ones(number.size - fixed) if factors is None else np.concatenate([np.zeros(0), *factors])
    collect = sparse(number[fixed:], np.arange(weights.size), weights, (entries.size, weights.size))
    values = nonzeros(pieces)
    return ca.MX(pattern, ca.mtimes(collect, values) + ca.MX(ca.DM(base)))


def sparse(rows: np.ndarray, columns: np.ndarray, values: np.ndarray, shape: tuple[int, int]) -> Any:
    """A constant sparse matrix from triplets, duplicates summed."""
    check_time()
    entries, number = np.unique(columns.astype(np.int64) * shape[0] + rows, return_inverse=True)
    summed = np.bincount(number, weights=values, minlength=entries.size)
    pattern = ca.Sparsity.triplet(*shape, (entries % shape[0]).tolist(), (entries // shape[0]).tolist())
    return ca.DM(pattern, ca.DM(summed))
