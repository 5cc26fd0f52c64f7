"""Piecewise polynomials given by values at nodes, such as the interpolants of a solution, and integrators of ODEs."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np
import scipy


@dataclass(frozen=True)
class PiecewisePolynomial:
    """A piecewise polynomial, given in every interval by its values at the same relative positions (nodes).

    Attributes:
        breaks: Ends of the intervals, increasing. Shape (K + 1,).
        nodes: Positions of the values in an interval, in 0..1. Shape (d,); one node gives a piecewise constant.
        values: Values at the nodes of each interval. Shape (K, d, n).
    """

    breaks: np.ndarray
    nodes: np.ndarray
    values: np.ndarray

    def __post_init__(self) -> None:
        # a uniform memory layout makes sums round identically
        object.__setattr__(self, "values", np.ascontiguousarray(self.values))

    def __repr__(self) -> str:
        intervals, nodes, columns = self.values.shape
        return f"<PiecewisePolynomial of {intervals} intervals of {nodes} nodes, {columns} columns>"

    def __call__(self, at: np.ndarray) -> np.ndarray:
        """Evaluate the polynomial at M positions: right limits at breaks, end values beyond the ends. Shape (M, n)."""
        interval = np.clip(np.searchsorted(self.breaks, at, side="right") - 1, 0, len(self.breaks) - 2)
        start, end = self.breaks[interval], self.breaks[interval + 1]
        return self.within(interval, np.clip((at - start) / (end - start), 0.0, 1.0))

    def derivative(self) -> PiecewisePolynomial:
        """Return the derivative of the piecewise polynomial with respect to position, in the unit of the breaks."""
        if len(self.nodes) == 1:
            return PiecewisePolynomial(self.breaks, self.nodes, np.zeros_like(self.values))
        slopes = np.einsum("ij,kjn->kin", differentiation_matrix(self.nodes), self.values)
        return PiecewisePolynomial(self.breaks, self.nodes, slopes / np.diff(self.breaks)[:, None, None])

    def within(self, interval: np.ndarray, place: np.ndarray) -> np.ndarray:
        """Evaluate the polynomial at relative positions 0..1 in given intervals, with one-sided limits at their ends.

        Shape (M, n) for ``interval`` and ``place`` of shape (M,).
        """
        return np.asarray(np.einsum("md,mdn->mn", lagrange(self.nodes, place), self.values[interval]))


def barycentric_weights(nodes: np.ndarray) -> np.ndarray:
    """Return the d weights of barycentric Lagrange interpolation (Berrut, Trefethen 2004, eq 3.2). Shape (d,)."""
    difference = nodes[:, None] - nodes[None, :]
    np.fill_diagonal(difference, 1.0)
    return np.asarray(1.0 / difference.prod(axis=1))


def lagrange(nodes: np.ndarray, at: np.ndarray) -> np.ndarray:
    """Return the Lagrange basis polynomials of d ``nodes`` at M positions, by the barycentric formula. Shape (M, d)."""
    at = np.asarray(at, dtype=float)
    if len(nodes) == 1:
        return np.ones((len(at), 1))
    distance = at[:, None] - nodes[None, :]
    hit = np.abs(distance) < np.sqrt(np.finfo(float).tiny)  # closer to a node, its weight would overflow
    terms = barycentric_weights(nodes) / np.where(hit, 1.0, distance)
    on_node = hit.any(axis=1, keepdims=True)
    total = np.where(on_node, 1.0, terms.sum(axis=1, keepdims=True))
    return np.where(on_node, hit.astype(float), terms / total)


def differentiation_matrix(nodes: np.ndarray) -> np.ndarray:
    """Return the derivatives of the Lagrange basis polynomials (columns) at their nodes (rows). Shape (d, d)."""
    weights = barycentric_weights(nodes)
    difference = nodes[:, None] - nodes[None, :]
    np.fill_diagonal(difference, 1.0)
    matrix = weights[None, :] / weights[:, None] / difference
    np.fill_diagonal(matrix, 0.0)
    np.fill_diagonal(matrix, -matrix.sum(axis=1))
    return np.asarray(matrix)


def gauss_points(breaks: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the points and weights of Gauss quadrature, ``count`` in each of K intervals. Shape (K, count) each."""
    points, weights = np.polynomial.legendre.leggauss(count)
    half = np.diff(breaks)[:, None] / 2
    return breaks[:-1, None] + half * (points + 1), half * weights


def quadrature_weights(points: np.ndarray) -> np.ndarray:
    """Return the interpolatory quadrature weights of d ``points`` for integrals over 0..1. Shape (d,)."""
    gauss, weight = np.polynomial.legendre.leggauss(len(points))
    return np.asarray(0.5 * weight @ lagrange(points, 0.5 * (gauss + 1.0)))


def newton_coefficients(nodes: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Return the coefficients (divided differences) of K interpolation polynomials in Newton's form. Shape (K, d, n).

    The polynomial is c0 + (s - node 0) (c1 + (s - node 1) (c2 + ...)), which takes the fewest operations. ``values``
    (K, d, n) are those at ``nodes`` (d,).
    """
    coefficients = np.array(values, dtype=float)
    for i in range(1, len(nodes)):
        width = (nodes[i:] - nodes[:-i])[None, :, None]
        coefficients[:, i:] = (coefficients[:, i:] - coefficients[:, i - 1 : -1]) / width
    return coefficients


def rk4_step(slope: Callable[[float, Any], Any], x: Any, h: Any) -> Any:
    """Integrate dx/dt = ``slope`` from the state ``x`` over one step of width ``h`` (classical Runge-Kutta method).

    ``slope(place, x)`` is dx/dt at the position 0, 1/2 or 1 of the step. States are arrays or expressions.
    """
    k1 = slope(0.0, x)
    k2 = slope(0.5, x + h / 2 * k1)
    k3 = slope(0.5, x + h / 2 * k2)
    k4 = slope(1.0, x + h * k3)
    return x + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)


def dormand_prince_step(slope: Callable[[float, Any], Any], x: Any, h: Any) -> tuple[Any, Any]:
    """Return the state after a Runge-Kutta step of order 5, with an estimate of its error (Dormand, Prince 1980).

    ``slope(place, x)`` is dx/dt at a position 0..1 of the step, which starts at ``x`` and has the width ``h``. The
    error is estimated as the difference from the embedded step of order 4.
    """
    slopes: list[Any] = []
    table: Any = scipy.integrate.RK45

    def sum_of(weights: Any) -> Any:
        return sum(h * weight * value for weight, value in zip(weights, slopes, strict=False) if weight)

    for place, weights in zip(table.C.tolist(), table.A.tolist(), strict=True):
        slopes.append(slope(place, x + sum_of(weights)))
    after = x + sum_of(table.B.tolist())
    slopes.append(slope(1.0, after))
    return after, sum_of((-table.E).tolist())


def integrator(
    name: str,
    dae: dict[str, Any],
    places: Sequence[float] = (1.0,),
    *,
    tolerance: float = 1e-12,
    max_steps: int = 100_000,
    smooth: bool = True,
    start: float = 0.0,
) -> Any:
    """Return a casadi integrator of differential equations by CVODES, with variable step width and order.

    ``dae`` is casadi's dictionary: x, t, p, ode and, if any, quad, which is under error control too. ``start`` is the
    initial time, and ``places`` are the times at which the integrator returns the states, with at most ``max_steps``
    steps between two of them. ``tolerance`` is that of the local error, relative and absolute. Adams formulas are used
    for ``smooth`` dynamics that are not stiff, else backward differentiation formulas.
    """
    options: dict[str, Any] = {
        "reltol": tolerance,
        "abstol": tolerance,
        "max_num_steps": max_steps,
        "quad_err_con": True,
        "show_eval_warnings": False,  # of failed trial steps
        "disable_internal_warnings": True,
        "linear_multistep_method": "adams" if smooth else "bdf",
    }
    return ca.integrator(name, "cvodes", dae, start, list(places), options)
