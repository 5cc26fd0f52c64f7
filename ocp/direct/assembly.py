"""From a fragment to a nonlinear program with exact, ready-made derivatives.

Gradient, Jacobian and Hessian of each small block are derived once, mapped over its applications, and scattered into
the whole by a constant sparse matrix. No colouring of the whole program, no graph that grows with the mesh.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np

from ocp.direct.fragment import Block, Fragment
from ocp.problem.values import symbols_of

__all__ = ["Program", "assemble"]

LARGE = 50_000
"""Instructions: to look for equal ones among more takes longer than a solve with all of them."""


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


@dataclass(frozen=True)
class Derived:
    """A block with its derivative functions (nonzeros only) and where the nonzeros belong."""

    block: Block
    value: Any
    gradient: Any
    jacobian: Any
    hessian: Any
    gradient_at: np.ndarray
    jacobian_at: tuple[np.ndarray, np.ndarray]
    hessian_at: tuple[np.ndarray, np.ndarray, np.ndarray]


def assemble(fragment: Fragment, parameters: int, options: dict[str, Any] | None = None) -> Program:
    """Derive and assemble. ``options`` go to the casadi Functions of the blocks, for example to compile them."""
    derived = [derive(block, options or {}) for block in fragment.blocks]
    n, m = fragment.size, fragment.n_rows
    x, p = ca.MX.sym("x", n), ca.MX.sym("p", parameters)
    sigma, lam = ca.MX.sym("lam_f"), ca.MX.sym("lam_g", m)

    calls = [(d, inputs(d.block, x)) for d in derived]
    rows = [np.asarray(d.block.rows).ravel(order="F") for d in derived]
    outputs = [mapped(d.value, d.block, [*call, p]) for d, call in calls]
    f = sum((ca.sum2(out[0]) for out in outputs), ca.MX(0))
    nonlinear = scatter(rows, [out[1] for out in outputs], m)
    g = nonlinear + ca.mtimes(sparse(*fragment.linear, (m, n)), x)

    def gradient(part: list[tuple[Derived, list[Any]]]) -> Any:
        pieces = [mapped(d.gradient, d.block, [*call, p])[0] for d, call in part]
        return scatter([d.gradient_at for d, _ in part], pieces, n)

    jac_pieces = [mapped(d.jacobian, d.block, [*call, p])[0] for d, call in calls]
    jac = scatter_matrix([d.jacobian_at for d in derived], jac_pieces, fragment.linear, (m, n))

    hess_pieces = [
        mapped(d.hessian, d.block, [*call, p, repeat(sigma, d.block), gather(lam, d.block.rows)])[0]
        for d, call in calls
    ]
    nothing = (np.zeros(0, int), np.zeros(0, int), np.zeros(0))
    factors = [d.hessian_at[2] for d in derived]
    hess = scatter_matrix([d.hessian_at[:2] for d in derived], hess_pieces, nothing, (n, n), factors)

    inside = [(d, call) for d, call in calls if not d.block.ends]
    return Program(
        nlp={"x": x, "p": p, "f": f, "g": g},
        gradient=ca.Function("nlp_grad_f", [x, p], [f, gradient(calls)], ["x", "p"], ["f", "grad_f_x"]),
        jacobian=ca.Function("nlp_jac_g", [x, p], [g, jac], ["x", "p"], ["g", "jac_g_x"]),
        hessian=ca.Function(
            "nlp_hess_l", [x, p, sigma, lam], [hess], ["x", "p", "lam_f", "lam_g"], ["triu_hess_gamma_x_x"]
        ),
        values=ca.Function("values", [x, p], [f, g]),
        inside=ca.Function("inside", [x, p], [gradient(inside)]),
        parametric=ca.Function("parametric", [x, p, lam], [parametric(fragment, x, p, lam)]),
    )


def parametric(fragment: Fragment, x: Any, p: Any, lam: Any) -> Any:
    """Gradient in the parameters, block by block."""
    total = ca.MX.zeros(p.numel())
    if p.numel() == 0:
        return total
    for block in fragment.blocks:
        function = block.function
        symbol = symbols_of(function).sym
        v, d, q = (symbol(name, function.numel_in(i)) for i, name in enumerate(("v", "d", "p")))
        cost, g = function(v, d, q)
        mu = symbol("mu", g.numel())
        slope = ca.Function("slope", [v, d, q, mu], [ca.densify(ca.gradient(cost + ca.dot(mu, g), q))])
        total += ca.sum2(mapped(slope, block, [*inputs(block, x), p, gather(lam, block.rows)])[0])
    return total


def derive(block: Block, options: dict[str, Any]) -> Derived:
    """Derivatives of one block, exact and symbolic."""
    function = block.function
    symbol = symbols_of(function).sym
    v, d, p = (symbol(name, function.numel_in(i)) for i, name in enumerate(("v", "d", "p")))
    cost, g = function(v, d, p)
    sigma, lam = symbol("sigma"), symbol("lam", g.numel())
    gradient = ca.jacobian(cost, v)
    jacobian = ca.jacobian(g, v)
    hessian = ca.triu(ca.hessian(sigma * cost + ca.dot(lam, g), v)[0])

    _, gradient_at = (np.array(part, dtype=int) for part in gradient.sparsity().get_triplet())
    row, column = (np.array(part, dtype=int) for part in jacobian.sparsity().get_triplet())
    first, second = (np.array(part, dtype=int) for part in hessian.sparsity().get_triplet())
    where, rows = block.variables, block.rows
    upper = np.minimum(where[first], where[second]).ravel(order="F")
    lower = np.maximum(where[first], where[second]).ravel(order="F")
    # an off-diagonal entry of the block that falls on the diagonal stands for both its mirror images
    doubled = np.where((upper == lower) & np.tile(first != second, where.shape[1]), 2.0, 1.0)
    return Derived(
        block,
        without_repeats("value", [v, d, p], [cost, g], options),
        without_repeats("gradient", [v, d, p], [gradient.nz[:]], options),
        without_repeats("jacobian", [v, d, p], [jacobian.nz[:]], options),
        without_repeats("hessian", [v, d, p, sigma, lam], [hessian.nz[:]], options),
        where[gradient_at].ravel(order="F"),
        (rows[row].ravel(order="F"), where[column].ravel(order="F")),
        (upper, lower, doubled),
    )


def without_repeats(name: str, given: list[Any], outputs: list[Any], options: dict[str, Any]) -> Any:
    """A casadi Function in which nothing is computed twice, unless it is LARGE."""
    large = ca.Function(name, given, outputs).n_instructions() > LARGE
    return ca.Function(name, given, outputs, {"cse": not large, **options})


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
    count = block.variables.shape[1]
    if count == 1:
        return function.call(arguments)
    # parameters are the same for all: casadi reads them once instead of making copies
    return function.map(function.name() + "_map", "serial", count, [2], []).call(arguments)


def scatter(places: list[np.ndarray], pieces: list[Any], size: int) -> Any:
    """A vector with each entry of ``pieces`` added at its place."""
    where = np.concatenate([np.zeros(0, int), *places])
    values = ca.vertcat(ca.MX(0, 1), *[ca.vec(piece) for piece in pieces])
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
    values = ca.vertcat(ca.MX(0, 1), *[ca.vec(piece) for piece in pieces])
    return ca.MX(pattern, ca.mtimes(collect, values) + ca.MX(ca.DM(base)))


def sparse(rows: np.ndarray, columns: np.ndarray, values: np.ndarray, shape: tuple[int, int]) -> Any:
    """A constant sparse matrix from triplets, duplicates summed."""
    entries, number = np.unique(columns.astype(np.int64) * shape[0] + rows, return_inverse=True)
    summed = np.bincount(number, weights=values, minlength=entries.size)
    pattern = ca.Sparsity.triplet(*shape, (entries % shape[0]).tolist(), (entries // shape[0]).tolist())
    return ca.DM(pattern, ca.DM(summed))
