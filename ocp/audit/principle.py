"""The minimum principle along a plan: does any admissible control have a smaller Hamiltonian, and what would it win?

Nothing here trusts the multipliers of a solver: at each point those of the limits that hold the controls are found
anew, by least squares with the signs that the minimum principle demands (Bryson, Ho 1975, chapter 3). What is left of
the Hamiltonian's slope is judged by what it loses: the least of H_u du + du H_uu du / 2 over the controls within their
limits, integrated over the plan, in units of cost.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ocp.audit.linearisation import Linearisation
from ocp.problem.formulation import Formulation
from ocp.solution import Solution, stack

__all__ = ["FLAT", "Hamiltonian", "balance", "groups", "hamiltonian", "holders", "lost", "reduced_slope", "slope"]

DEPENDENT = 1e-9
"""Singular values below this share of the largest are none."""
FLAT = 1e-7
"""Curvature, relative to the largest of the plan, below which the cost counts as not curved."""


@dataclass(frozen=True)
class Hamiltonian:
    """The Hamiltonian along a plan.

    Attributes:
        t: Reported times of the plan, s. values: L + costate . f there, in cost per second. Both (M,).
        scale: Largest of |L| + sum |costate_i f_i|.
    """

    t: np.ndarray
    values: np.ndarray
    scale: float

    @property
    def drift(self) -> float:
        """Largest minus smallest value."""
        return float(np.ptp(self.values))


def hamiltonian(form: Formulation, solution: Solution, p: np.ndarray) -> Hamiltonian:
    """The Hamiltonian at the reported times of a plan."""
    pools = (solution.states, solution.controls, solution.costates)
    x, u, costate = (stack(pool, len(solution.t)) for pool in pools)
    lam = form.sym("lam", form.nx)
    parts = form.sampled([form.running, lam * form.f], x, u, solution.t, solution.horizon, p, (lam, costate))
    running, products = parts
    scale = float(np.max(np.abs(running[:, 0]) + np.abs(products).sum(axis=1), initial=0.0))
    return Hamiltonian(solution.t, running[:, 0] + products.sum(axis=1), scale or 1.0)


def holders(along: Linearisation, costate: np.ndarray) -> np.ndarray:
    """Multipliers of the limits that hold the controls, for costates (M, nx) at the points. Shape (M, nu + r).

    Those that make T H most nearly stationary, controls in units of their sizes.
    """
    unit = along.sizes.control
    hold = along.hold
    return balance(slope(along, costate) * unit, along.hold_u * unit, hold.lower, hold.upper)


def slope(along: Linearisation, costate: np.ndarray) -> np.ndarray:
    """Derivative of T (L + costate . f) in the controls at the points. Shape (M, nu)."""
    of = along.form.nx + 1
    return np.asarray(along.cost_y[:, of:] + np.einsum("kiu,ki->ku", along.rate_y[:, :, of:], costate))


def balance(gradient: np.ndarray, directions: np.ndarray, lower: np.ndarray, upper: np.ndarray) -> np.ndarray:
    """Multipliers (M, m) of limits that make gradient (M, n) + directions (M, m, n)' multipliers least at each point.

    At least zero where only ``upper`` (M, m) may push, at most zero where only ``lower`` may, free where both may.
    Wrongly signed ones are dropped one by one, the worst first.
    """
    found = np.zeros(lower.shape)
    active, both = lower | upper, lower & upper
    left = np.flatnonzero(active.any(axis=1))
    while left.size:
        wrong = []
        for pattern, members in groups(active[left]):
            mine = left[members]
            columns = directions[mine][:, pattern].transpose(0, 2, 1)
            multipliers = -np.einsum("kmn,kn->km", np.linalg.pinv(columns, rcond=DEPENDENT), gradient[mine])
            against = np.where(both[mine][:, pattern], 0.0, multipliers)
            against = np.where(upper[mine][:, pattern], -against, against)
            worst = np.argmax(against, axis=1)
            rows = np.arange(len(mine))
            bad = against[rows, worst] > 1e-12 * (1.0 + np.abs(multipliers).max(axis=1))
            good = mine[~bad]
            found[np.ix_(good, np.flatnonzero(pattern))] = multipliers[~bad]
            active[mine[bad], np.flatnonzero(pattern)[worst[bad]]] = False
            wrong.append(mine[bad])
        left = np.concatenate(wrong)
        left = left[active[left].any(axis=1)]
    return found


def reduced_slope(along: Linearisation, costate: np.ndarray, multipliers: np.ndarray) -> np.ndarray:
    """Largest entry of the Hamiltonian's slope that no multiplier explains, relative to the parts of it. (M,)."""
    form = along.form
    if not form.nu:
        return np.zeros(len(along.s))
    unit, of = along.sizes.control, form.nx + 1
    left = (slope(along, costate) + np.einsum("kmu,km->ku", along.hold_u, multipliers)) * unit
    parts = np.abs(along.cost_y[:, of:]) + np.einsum("kiu,ki->ku", np.abs(along.rate_y[:, :, of:]), np.abs(costate))
    size = float((parts * unit).max(initial=0.0)) or 1.0
    return np.asarray(np.abs(left).max(axis=1, initial=0.0) / size)


def groups(patterns: np.ndarray) -> list[tuple[np.ndarray, np.ndarray]]:
    """Distinct rows of patterns (M, m), bool, each with the indices of its members."""
    if not len(patterns):
        return []
    distinct, member = np.unique(patterns, axis=0, return_inverse=True)
    order = np.argsort(member.ravel(), kind="stable")
    cuts = np.searchsorted(member.ravel()[order], np.arange(1, len(distinct)))
    return list(zip(distinct, np.split(order, cuts), strict=True))


def lost(along: Linearisation, costate: np.ndarray, multipliers: np.ndarray, curved: np.ndarray) -> np.ndarray:
    """What the controls at each point could win within their limits, to second order, in cost per unit of s. (M,).

    Args:
        along: The plan. costate: (M, nx).
        multipliers: Of the limits of the controls, (M, nu + r); what these win over the gaps to their limits counts.
        curved: T H_uu. Shape (M, nu, nu).

    A control moves within its limits, and by its size at most where the Hamiltonian does not curve along it. Rows that
    push stay where they are.
    """
    nu = along.form.nu
    if not nu:
        return np.zeros(len(along.s))
    unit = along.sizes.control
    won = along.hold.charge(multipliers).sum(axis=1)
    gradient = slope(along, costate) + np.einsum("kmu,km->ku", along.hold_u, multipliers)
    gradient, curved = gradient * unit, curved * (unit * unit[:, None])
    low, high = (np.clip((side - along.u) / unit, -1e3, 1e3) for side in (along.low, along.high))
    low, high = np.minimum(low, 0.0), np.maximum(high, 0.0)
    scale = float(np.abs(curved).max(initial=0.0)) or 1.0
    size = np.abs(along.hold_u * unit).max(axis=2)
    pushes = (np.abs(multipliers) * size > FLAT * np.abs(multipliers * size).max(initial=0.0)) | along.hold.equal
    fixed = pushes.copy()
    best = np.zeros(len(won))
    while True:  # a control that rests on its limit and would go beyond stays: at most nu rounds
        blocked = fixed.copy()
        for pattern, members in groups(fixed):
            step = _step(gradient[members], curved[members], along.hold_u[members][:, pattern] * unit, scale)
            with np.errstate(divide="ignore", invalid="ignore"):
                room = np.where(step > 0, high[members] / step, np.where(step < 0, low[members] / step, np.inf))
            step = np.clip(room.min(axis=1, initial=1.0), 0.0, 1.0)[:, None] * step
            change = np.einsum("ku,ku->k", gradient[members], step)
            change += np.einsum("ku,kuv,kv->k", step, curved[members], step) / 2
            best[members] = np.maximum(best[members], -change)
            blocked[members, :nu] |= room <= DEPENDENT
        if (blocked == fixed).all():
            return np.asarray(won + best)
        fixed = blocked


def _step(gradient: np.ndarray, curved: np.ndarray, rows: np.ndarray, scale: float) -> np.ndarray:
    """The least of gradient . d + d curved d / 2 over rows d = 0 at each point, |d| about 1 where it does not curve."""
    k, nu = gradient.shape
    if rows.shape[1]:
        projector = np.eye(nu) - np.einsum("kun,knv->kuv", np.linalg.pinv(rows, rcond=DEPENDENT), rows)
    else:
        projector = np.broadcast_to(np.eye(nu), (k, nu, nu))
    pull = np.einsum("kuv,kv->ku", projector, gradient)
    inside = projector @ curved @ projector
    values, vectors = np.linalg.eigh((inside + inside.transpose(0, 2, 1)) / 2)
    along = np.einsum("kuv,ku->kv", vectors, pull)
    solid = values > FLAT * scale
    step = np.where(solid, -along / np.where(solid, values, 1.0), -np.sign(along))
    # the projector's own null directions have no pull
    step = np.where(np.abs(along) > 1e-14 * np.abs(gradient).max(axis=1, keepdims=True), step, 0.0)
    return np.asarray(np.einsum("kuv,kv->ku", vectors, step))
