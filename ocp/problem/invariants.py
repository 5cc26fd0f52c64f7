"""First integrals: quantities that the dynamics conserve for all controls, such as the length of a quaternion.

An end condition that follows from the start and from first integrals is redundant, and its multiplier grows without
bound as the error of the method falls. So is a condition on a control at an end that follows from path equalities and
from the other conditions there. It is dropped from the solve, and the audit checks it like any other.

The first integrals sought are polynomials of the states: I is one if grad I(x) . f(x, u, t) = 0, which is linear in its
coefficients, at random samples of x, u and t.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations_with_replacement
from math import comb

import casadi as ca
import numpy as np
import scipy

from ocp.problem.formulation import Bounds, Formulation, is_free
from ocp.problem.values import dependence
from ocp.tolerances import ROUNDING_SHARE, SOLVER_SHARE

MAX_DEGREE = 3  # of the polynomials


@dataclass(frozen=True)
class InvariantSettings:
    """Settings of the search for first integrals and for the end conditions that they make redundant.

    Attributes:
        monomials: Maximum number of monomials for one coupled part of the dynamics.
        steps: Newton steps to a point that meets all conditions.
        contradiction: Residual, relative to its terms, by which a condition may contradict a first integral:
            quaternions are given with few digits.
        leeway: Violation allowed of a dropped condition, relative to its terms: it excludes -q, which is as long as q.
        control_weight: Weight of conditions on controls where one of several is dropped. The multiplier of a condition
            on a control at one time is an impulse of those of the path equalities, so conditions on states stay.
    """

    monomials: int = 300
    steps: int = 20
    contradiction: float = 1e-3
    leeway: float = 0.5
    control_weight: float = 1e-3


SETTINGS = InvariantSettings()


class FirstIntegrals:
    """Polynomials of the states that the dynamics conserve.

    Attributes:
        monomials: Indices of the three factors in (1, x) of each monomial. Shape (m, 3). factors: Coefficients of the
            monomials in each integral. Shape (r, m).
    """

    def __init__(self, form: Formulation) -> None:
        bases, factors = [np.zeros((0, 3), int)], [np.zeros((0, 0))]
        for part in coupled_parts(form):
            own = monomials(part)
            x, rates = sample_rates(form, 2 * len(own))
            if len(x) < 1.5 * len(own) or not len(own):
                continue
            # time derivative of every monomial, relative to its largest term, as the terms may cancel
            terms = factor_derivatives(own, x) * np.pad(rates, ((0, 0), (1, 0)))[:, own]
            size = np.abs(terms).sum(axis=2).max(axis=0)
            size[size == 0.0] = 1.0
            bases.append(own)
            _, values, directions = np.linalg.svd(terms.sum(axis=2) / size, full_matrices=False)
            factors.append(directions[values <= ROUNDING_SHARE * values[0]] / size)
        self.monomials, self.factors = np.vstack(bases), scipy.linalg.block_diag(*factors)

    def at(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the values and the gradients of the first integrals at a state. Shapes (r,) and (r, nx)."""
        gradients = np.zeros((len(self.monomials), len(x) + 1))
        np.add.at(
            gradients,
            (np.arange(len(gradients))[:, None], self.monomials),
            factor_derivatives(self.monomials, x[None])[0],
        )
        return self.factors @ np.append(1.0, x)[self.monomials].prod(axis=1), self.factors @ gradients[:, 1:]


def coupled_parts(form: Formulation) -> list[np.ndarray]:
    """Return the groups of coupled states in which to seek first integrals that make end conditions redundant.

    Only states with end conditions are relevant. If f_i is the only rate among these that contains a control u_j, or
    another state, then grad I . f = 0 for all u_j implies that I does not depend on x_i.
    """
    candidates = ~np.concatenate([is_free(state.terminal) for state in form.problem.declared.states.values()])
    candidates |= form.end.uses_state.any(axis=0)
    pattern = dependence(form.f, ca.vertcat(form.x, form.u))
    while candidates.any():
        driving = np.append(~candidates, np.ones(form.nu, bool))
        alone = pattern[candidates][:, driving & (pattern[candidates].sum(axis=0) == 1)].any(axis=1)
        if not alone.any():
            break
        candidates[np.flatnonzero(candidates)[alone]] = False
    states = np.flatnonzero(candidates)
    own = pattern[states].astype(int)
    count, part = scipy.sparse.csgraph.connected_components(own[:, states] + own @ own.T, directed=False)
    return [states[part == k] for k in range(count)]


def monomials(part: np.ndarray) -> np.ndarray:
    """Return all monomials of given states as triples of state numbers; 0 stands for the factor 1. Shape (m, 3)."""
    degree = max(d for d in range(MAX_DEGREE + 1) if comb(len(part) + d, d) <= SETTINGS.monomials + 1)
    rows = combinations_with_replacement([0, *(part + 1)], degree)
    return np.array([(0,) * (MAX_DEGREE - degree) + row for row in rows if any(row)], int).reshape(-1, MAX_DEGREE)


def factor_derivatives(monomials: np.ndarray, x: np.ndarray) -> np.ndarray:
    """Return the derivatives of monomials with respect to each of their three factors at K states. Shape (K, m, 3)."""
    factors = np.pad(x, ((0, 0), (1, 0)), constant_values=1.0)[:, monomials]
    return np.stack([factors[..., 1] * factors[..., 2], factors[..., 0] * factors[..., 2],
                     factors[..., 0] * factors[..., 1]], axis=-1)  # fmt: skip


def sample_rates(form: Formulation, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Return at most ``count`` random states and their time derivatives, which are finite. Shape (K, nx) each."""
    rng = np.random.default_rng(0)
    x, u, t = (rng.normal(size=(count, n)) for n in (form.nx, form.nu, 1))
    horizon, p = 1.0, np.exp(0.3 * rng.normal(size=form.np))
    duration = float(form.horizon_at(p)) if form.signals else horizon
    (rates,) = form.sampled(
        [form.f], x, u, duration * (0.5 + np.arctan(t) / np.pi), duration, p, cache_as="rates alone"
    )
    finite = np.isfinite(rates).all(axis=1)
    return x[finite], rates[finite]


def bounds_to_solve(form: Formulation, p: np.ndarray) -> Bounds:
    """Return the bounds of a problem, relaxed for those end conditions that first integrals make redundant.

    Of a redundant set the least informative condition is relaxed, of a quaternion its largest entry, up to a leeway.
    """
    lower, upper = form.bound_values(p)
    integrals = form.cached("first integrals", lambda: FirstIntegrals(form))
    if not len(integrals.factors) and not path_equalities(form).any():
        return lower, upper
    low, high = lower.copy(), upper.copy()
    for index, leeway in implied_conditions(form, integrals, (lower, upper), p):
        low[index], high[index] = lower[index] - leeway, upper[index] + leeway
    return low, high


def implied_conditions(
    form: Formulation, integrals: FirstIntegrals, bounds: Bounds, p: np.ndarray
) -> list[tuple[int, float]]:
    """Return the start and end conditions that first integrals or path equalities imply, and by how much to relax each.

    The conditions are indices of the bound table.
    """
    nx, n, places = form.nx, form.nx + form.nu, form.bounds.places
    index = np.concatenate([places[kind] for kind in ("initial", "start", "terminal", "end")])
    low, high = (side[index] for side in bounds)
    equal, first = low == high, nx if path_equalities(form).any() else nx + len(form.start)
    if not equal[first:].any():
        return []
    rows = form.cached("rows of both ends", lambda: rows_of_ends(form))
    on_path = bounds[0][places["path"][path_equalities(form)]]
    # find a point that meets all conditions, by Newton's method from a random one
    z = np.random.default_rng(0).normal(size=2 * n + 1)
    z[-1] = 1.0 if form.horizon_is_free else float(form.horizon_at(p))
    for _ in range(SETTINGS.steps):
        values, slope = (np.array(part) for part in rows(z, p))
        slope[:, -1] *= form.horizon_is_free
        (before, before_x), (after, after_x) = integrals.at(z[:nx]), integrals.at(z[n : n + nx])
        of_controls = np.zeros((len(before), form.nu))
        conserved = np.hstack([-before_x, of_controls, after_x, of_controls, np.zeros((len(before), 1))])
        invariance = np.vstack([conserved, slope[len(index) :]])
        conditions, on_rows = slope[: len(index)][equal], values.ravel()
        path_gap = on_rows[len(index) :] - np.tile(on_path, 2)
        residuals = np.concatenate([(on_rows[: len(index)] - low)[equal], after - before, path_gap])
        jacobian = np.vstack([conditions, invariance])
        if not (np.isfinite(jacobian).all() and np.isfinite(residuals).all()):
            return []
        if np.abs(residuals).max() <= ROUNDING_SHARE * np.abs(z).max():
            break
        z = z - np.linalg.pinv(jacobian, rcond=ROUNDING_SHARE) @ residuals
    if (
        np.abs(residuals) > SETTINGS.contradiction * (np.abs(jacobian) @ np.abs(z)) + ROUNDING_SHARE * np.abs(z).max()
    ).any():
        return []  # the conditions contradict each other: the solver reports it
    # only end conditions on states that all conditions together determine may be relaxed
    undetermined = np.diag(null_projector(jacobian)) > ROUNDING_SHARE
    own = (np.flatnonzero(equal) >= first) & ~conditions[:, undetermined].any(axis=1)
    others, ends = conditions[~own], conditions[own]
    if not own.any():
        return []
    independent = (ends @ null_projector(np.vstack([others, invariance]))).T
    of_controls = np.concatenate([np.arange(nx, n), np.arange(n + nx, 2 * n)])
    weight = np.where((ends[:, of_controls] != 0).any(axis=1), SETTINGS.control_weight, 1.0)
    triangle, order = scipy.linalg.qr(independent * weight, mode="r", pivoting=True)
    threshold = SOLVER_SHARE * np.abs(ends).max()
    rank = int((np.abs(np.diag(triangle)) > threshold).sum())
    if rank == np.linalg.matrix_rank(ends @ null_projector(others), tol=threshold):
        return []  # redundancy without first integrals stays as declared
    leeway, entries = SETTINGS.leeway * np.abs(ends) @ np.abs(z), index[equal][own]
    return [(int(entries[k]), float(leeway[k]) or np.inf) for k in order[rank:]]


def null_projector(rows: np.ndarray) -> np.ndarray:
    """Return the orthogonal projector onto the null space of a matrix with n columns. Shape (n, n)."""
    return np.asarray(np.eye(rows.shape[1]) - np.linalg.pinv(rows, rcond=ROUNDING_SHARE) @ rows)


def path_equalities(form: Formulation) -> np.ndarray:
    """Return a mask (rows,) of the path equalities that may imply the declared start or end conditions on controls."""
    ends = ca.vertcat(form.start.expression, form.end.expression)
    uses_control = not form.signals and form.nu > 0 and ca.depends_on(ends, ca.vertcat(form.u, form.u0))
    return np.asarray(form.path.equality & bool(uses_control))


def rows_of_ends(form: Formulation) -> ca.Function:
    """Return the casadi Function that evaluates all conditions on the start and end, and their Jacobian.

    Its arguments are start state and control, end state and control, and horizon in one column, and the parameters. The
    path equalities at the start and at the end come last.
    """
    n, nx = form.nx + form.nu, form.nx
    z = form.sym("z", 2 * n + 1)
    x0, u0, x1, u1, horizon = z[:nx], z[nx:n], z[n : n + nx], z[n + nx : -1], z[-1]
    path = form.path.select(path_equalities(form)).expression
    symbols = [form.x, form.u, form.x0, form.u0, form.t, form.T]
    begin = ca.substitute([form.start.expression, path], symbols, [x0, u0, x0, u0, 0, horizon])
    end = ca.substitute([form.end.expression, path], symbols, [x1, u1, x0, u0, horizon, horizon])
    rows = ca.vertcat(x0, begin[0], x1, end[0], begin[1], end[1])
    return ca.Function("rows", [z, form.p], [ca.densify(rows), ca.densify(ca.jacobian(rows, z))])
