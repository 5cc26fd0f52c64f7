"""First integrals: what the dynamics keep whatever the controls do, such as the length of a quaternion.

An end condition that follows from the start and from first integrals is one condition more than there are unknowns. A
method keeps first integrals up to its own error alone, so that the multiplier of such a condition grows as that error
falls. It is therefore not held while solving; the audit checks it as any other.

First integrals are looked for among polynomials of the states: I is one where grad I(x) . f(x, u, t) = 0, which is
linear in its coefficients, at random samples of x, u and t. Invariants that are no polynomials are not found.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations_with_replacement
from math import comb

import casadi as ca
import numpy as np
import scipy.linalg
from scipy.sparse.csgraph import connected_components

from ocp.problem.formulation import Bounds, Formulation, is_free
from ocp.tolerances import ROUNDING_SHARE, SOLVER_SHARE

__all__ = ["bounds_to_solve"]

DEGREE = 3  # of the polynomials, at most


@dataclass(frozen=True)
class InvariantSettings:
    """What is looked for, and what counts as following from it.

    Attributes:
        monomials: The most of one coupled part of the dynamics.
        steps: Of Newton's method to a point that meets all conditions.
        contradiction: Share of its terms by which a condition may contradict a first integral: quaternions are given
            with few digits.
        leeway: Share of its terms by which a condition that is not held may be missed: -q is as long as q.
    """

    monomials: int = 300
    steps: int = 20
    contradiction: float = 1e-3
    leeway: float = 0.5


SETTINGS = InvariantSettings()


class FirstIntegrals:
    """Polynomials of the states that the dynamics keep.

    Attributes:
        monomials: Three of (1, x) each, whose product it is, (m, 3). factors: Of these in each integral, (r, m).
    """

    def __init__(self, form: Formulation) -> None:
        every, factors = [np.zeros((0, 3), int)], [np.zeros((0, 0))]
        for part in coupled_parts(form):
            own = monomials(part)
            x, rates = sampled_rates(form, 2 * len(own))
            if len(x) < 1.5 * len(own) or not len(own):
                continue
            # d/dt of every monomial, relative to the largest of its terms, which may cancel
            terms = slopes(own, x) * np.pad(rates, ((0, 0), (1, 0)))[:, own]
            size = np.abs(terms).sum(axis=2).max(axis=0)
            size[size == 0.0] = 1.0
            every.append(own)
            _, values, directions = np.linalg.svd(terms.sum(axis=2) / size, full_matrices=False)
            factors.append(directions[values <= ROUNDING_SHARE * values[0]] / size)
        self.monomials, self.factors = np.vstack(every), scipy.linalg.block_diag(*factors)

    def at(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Values (r,) and gradients (r, nx) at a state (nx,)."""
        gradients = np.zeros((len(self.monomials), len(x) + 1))
        np.add.at(gradients, (np.arange(len(gradients))[:, None], self.monomials), slopes(self.monomials, x[None])[0])
        return self.factors @ np.append(1.0, x)[self.monomials].prod(axis=1), self.factors @ gradients[:, 1:]


def coupled_parts(form: Formulation) -> list[np.ndarray]:
    """The states that first integrals of interest may contain, by coupled parts of the dynamics.

    Only those that end conditions refer to. And none that is driven alone: where f_i alone of these contains a control
    u_j, or another state, grad I . f = 0 for all u_j says that I does not contain x_i.
    """
    told = ~np.concatenate([is_free(state.terminal) for state in form.problem.declared.states.values()])
    told |= form.end.uses_state.any(axis=0)
    pattern = np.asarray(ca.DM(ca.jacobian_sparsity(form.f, ca.vertcat(form.x, form.u)), 1).full()) != 0
    while told.any():
        driving = np.append(~told, np.ones(form.nu, bool))
        alone = pattern[told][:, driving & (pattern[told].sum(axis=0) == 1)].any(axis=1)
        if not alone.any():
            break
        told[np.flatnonzero(told)[alone]] = False
    left = np.flatnonzero(told)
    own = pattern[left].astype(int)
    count, part = connected_components(own[:, left] + own @ own.T, directed=False)
    return [left[part == k] for k in range(count)]


def monomials(part: np.ndarray) -> np.ndarray:
    """All monomials of some states, of as high a degree as there may be; see `FirstIntegrals`. Shape (m, 3)."""
    degree = max(d for d in range(DEGREE + 1) if comb(len(part) + d, d) <= SETTINGS.monomials + 1)
    chosen = combinations_with_replacement([0, *(part + 1)], degree)
    return np.array([(0,) * (DEGREE - degree) + each for each in chosen if any(each)], int).reshape(-1, DEGREE)


def slopes(monomials: np.ndarray, x: np.ndarray) -> np.ndarray:
    """Derivatives of monomials (m, 3) in each of their three factors at states (K, nx). Shape (K, m, 3)."""
    factors = np.pad(x, ((0, 0), (1, 0)), constant_values=1.0)[:, monomials]
    return np.stack([factors[..., 1] * factors[..., 2], factors[..., 0] * factors[..., 2],
                     factors[..., 0] * factors[..., 1]], axis=-1)  # fmt: skip


def sampled_rates(form: Formulation, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Random states and their derivatives, where these are numbers. Shapes (K, nx), K at most ``count``."""
    rng = np.random.default_rng(0)
    x, u, t = (rng.normal(size=(count, n)) for n in (form.nx, form.nu, 1))
    horizon, p = 1.0, np.exp(0.3 * rng.normal(size=form.np))
    duration = float(form.horizon_at(p)) if form.signals else horizon
    (rates,) = form.sampled(
        [form.f], x, u, duration * (0.5 + np.arctan(t) / np.pi), duration, p, cache_as="rates alone"
    )
    good = np.isfinite(rates).all(axis=1)
    return x[good], rates[good]


def bounds_to_solve(form: Formulation, p: np.ndarray) -> Bounds:
    """The bound table at given parameters, without the end conditions that follow from the start and first integrals.

    Of a set of conditions of which one follows from the others, it is the one that says least: of a quaternion the
    largest entry. It is left a leeway. Raises as `Formulation.bound_values`.
    """
    lower, upper = form.bound_values(p)
    integrals = form.cached("first integrals", lambda: FirstIntegrals(form))
    if not len(integrals.factors):
        return lower, upper
    low, high = lower.copy(), upper.copy()
    for index, room in implied(form, integrals, (lower, upper), p):
        low[index], high[index] = lower[index] - room, upper[index] + room
    return low, high


def implied(form: Formulation, integrals: FirstIntegrals, bounds: Bounds, p: np.ndarray) -> list[tuple[int, float]]:
    """End conditions that follow from the start and first integrals: their places in the bound table, and a leeway."""
    nx, places = form.nx, form.bounds.places
    index = np.concatenate([places[kind] for kind in ("initial", "start", "terminal", "end")])
    low, high = (side[index] for side in bounds)
    equal, last = low == high, nx + len(form.start)
    if not equal[last:].any():
        return []
    rows = form.cached("rows of both ends", lambda: rows_of_ends(form))
    # a point that meets all conditions, by Newton's method from a random one
    z = np.random.default_rng(0).normal(size=2 * nx + 1)
    z[-1] = 1.0 if form.horizon_is_free else float(form.horizon_at(p))
    for _ in range(SETTINGS.steps):
        values, slope = (np.array(part) for part in rows(z, p))
        slope[:, -1] *= form.horizon_is_free
        (before, before_x), (after, after_x) = integrals.at(z[:nx]), integrals.at(z[nx:-1])
        kept = np.hstack([-before_x, after_x, np.zeros((len(before), 1))])
        conditions = slope[equal]
        left = np.concatenate([(values.ravel() - low)[equal], after - before])
        both = np.vstack([conditions, kept])
        if not (np.isfinite(both).all() and np.isfinite(left).all()):
            return []
        if np.abs(left).max() <= ROUNDING_SHARE * np.abs(z).max():
            break
        z = z - np.linalg.pinv(both, rcond=ROUNDING_SHARE) @ left
    if (np.abs(left) > SETTINGS.contradiction * (np.abs(both) @ np.abs(z)) + ROUNDING_SHARE * np.abs(z).max()).any():
        return []  # what is asked is not possible: the solver says so
    # what may be let go is an end condition of states that all conditions together determine
    loose = np.diag(projector(both)) > ROUNDING_SHARE
    own = (np.flatnonzero(equal) >= last) & ~conditions[:, loose].any(axis=1)
    others, ends = conditions[~own], conditions[own]
    if not own.any():
        return []
    say = (ends @ projector(np.vstack([others, kept]))).T
    triangle, order = scipy.linalg.qr(say, mode="r", pivoting=True)
    small = SOLVER_SHARE * np.abs(ends).max()
    rank = int((np.abs(np.diag(triangle)) > small).sum())
    if rank == np.linalg.matrix_rank(ends @ projector(others), tol=small):
        return []  # what follows from other conditions alone is held as it was asked
    room, at = SETTINGS.leeway * np.abs(ends) @ np.abs(z), index[equal][own]
    return [(int(at[k]), float(room[k]) or np.inf) for k in order[rank:]]


def projector(rows: np.ndarray) -> np.ndarray:
    """Onto what is orthogonal to rows (k, n). Shape (n, n)."""
    return np.asarray(np.eye(rows.shape[1]) - np.linalg.pinv(rows, rcond=ROUNDING_SHARE) @ rows)


def rows_of_ends(form: Formulation) -> ca.Function:
    """All that may be asked of both ends, and its derivatives, as a Function of (x0, x1, T) and p."""
    z = form.sym("z", 2 * form.nx + 1)
    x0, x1, horizon = z[: form.nx], z[form.nx : -1], z[-1]
    zero = form.problem.symbols(ca.DM.zeros(form.nu))
    begin = ca.substitute([form.start.expression], [form.x, form.u, form.t, form.T], [x0, zero, 0, horizon])[0]
    end = ca.substitute(
        [form.end.expression],
        [form.x, form.x0, form.u, form.u0, form.t, form.T],
        [x1, x0, zero, zero, horizon, horizon],
    )[0]
    rows = ca.vertcat(x0, begin, x1, end)
    return ca.Function("rows", [z, form.p], [ca.densify(rows), ca.densify(ca.jacobian(rows, z))])
