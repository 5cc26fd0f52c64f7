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
from ocp.tolerances import FLAT_SHARE, MACHINE_SHARE, ROUNDING_SHARE, SOLVER_SHARE

__all__ = [
    "Hamiltonian",
    "balance",
    "groups",
    "hamiltonian",
    "holders",
    "inverse_of",
    "inverses",
    "lost",
    "nonnegative",
    "reduced_slope",
    "slope",
    "turning",
]


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
    here = x, u, solution.t, solution.horizon, p, (lam, costate)
    parts = form.sampled(lambda: [form.running, lam * form.f], *here, cache_as="Hamiltonian")
    running, products = parts
    scale = float(np.max(np.abs(running[:, 0]) + np.abs(products).sum(axis=1), initial=0.0))
    return Hamiltonian(solution.t, running[:, 0] + products.sum(axis=1), scale or 1.0)


def holders(
    along: Linearisation, costate: np.ndarray, curved: np.ndarray | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Multipliers of the limits that hold the controls, for costates (M, nx) at the points.

    Those that make T H most nearly stationary, controls in units of their sizes. What a plan meets at single points of
    an interval only, as with held controls, pushes over the gap elsewhere, where that loses less than the slope does.

    Args:
        along: The plan. costate: (M, nx).
        curved: T H_uu, (M, nu, nu); None where it is not known yet, and nothing pushes over a gap.

    Returns:
        multipliers: Per unit of s. Shape (M, nu + r + a).
        across: At which points some push over a gap. Shape (M,), bool.
    """
    unit, hold, mixed = along.control_size, along.hold, along.mixed.size
    gradient, directions = slope(along, costate) * unit, along.hold_u * unit
    inverse = inverse_of(along, hold.near)
    found = balance(gradient, directions, hold.lower, hold.upper, inverse)
    across = np.zeros(len(found), bool)
    if curved is None or along.form.path.equality[along.mixed].all():
        return found, across
    left = np.abs(gradient + np.einsum("kmu,km->ku", directions, found)).max(axis=1)
    steep = float(np.abs(gradient).max())
    for k in np.flatnonzero(left > SOLVER_SHARE * steep):
        bend = curved[k] * unit * unit[:, None]
        values, vectors = np.linalg.eigh((bend + bend.T) / 2)
        least = FLAT_SHARE * (np.abs(gradient[k]).max() + np.abs(values).max())
        root = vectors / np.sqrt(np.maximum(values, least))
        sides = []
        for i in range(len(found[k])):
            both = hold.lower[k, i] and hold.upper[k, i]
            if both:
                sides.append((i, 1.0, 0.0, True))
            elif i < len(unit) + mixed:
                sides += [(i, 1.0, hold.above[k, i], False), (i, -1.0, hold.below[k, i], False)]
        sides = [side for side in sides if np.isfinite(side[2]) and np.abs(directions[k, side[0]]).max() > 0]
        which, sign, gap, free = (np.array(part) for part in zip(*sides, strict=True))
        rows = directions[k, which] * sign[:, None]
        size = np.abs(rows).max(axis=1)
        pushed = nonnegative((rows / size[:, None] @ root).T, -gradient[k] @ root, gap / size, free.astype(bool))
        found[k] = 0.0
        np.add.at(found[k], which, sign * pushed / size)
        across[k] = True
    return found, across


def slope(along: Linearisation, costate: np.ndarray) -> np.ndarray:
    """Derivative of T (L + costate . f) in the controls at the points. Shape (M, nu)."""
    of = along.form.nx + 1
    return np.asarray(along.cost_y[:, of:] + np.einsum("kiu,ki->ku", along.rate_y[:, :, of:], costate))


def inverse_of(along: Linearisation, held: np.ndarray) -> np.ndarray:
    """Pseudo-inverse of the derivatives of the limits that hold, (M, m) bool, in controls in units of their sizes.

    Shape (M, nu, m). It is kept with the plan, for the same limits hold it whatever its costates.
    """
    key = np.packbits(held).tobytes()
    if key not in along.inverses:
        along.inverses[key] = inverses(along.hold_u * along.control_size, held)
    return along.inverses[key]


def inverses(rows: np.ndarray, held: np.ndarray) -> np.ndarray:
    """Pseudo-inverses (M, n, m) of those of the rows (M, m, n) that are ``held`` (M, m), bool; zero for the others."""
    m, count, n = rows.shape
    found = np.zeros((m, n, count))
    for pattern, members in groups(held):
        if pattern.any():
            inverse = np.linalg.pinv(rows[members][:, pattern], rcond=ROUNDING_SHARE)
            found[members[:, None], :, np.flatnonzero(pattern)] = inverse.transpose(0, 2, 1)
    return found


def balance(
    gradient: np.ndarray, directions: np.ndarray, lower: np.ndarray, upper: np.ndarray, inverse: np.ndarray
) -> np.ndarray:
    """Multipliers (M, m) of limits that make gradient (M, n) + directions (M, m, n)' multipliers least at each point.

    At least zero where only ``upper`` (M, m) may push, at most zero where only ``lower`` may, free where both may.
    ``inverse`` is that of the directions which may push, (M, n, m).
    """
    multipliers = -np.einsum("knm,kn->km", inverse, gradient)
    sign, free, active = np.where(upper, 1.0, -1.0), lower & upper, lower | upper
    wrong = (sign * multipliers < 0) & active & ~free
    for k in np.flatnonzero(wrong.any(axis=1)):  # the signs hold some of them back
        own = np.flatnonzero(active[k])
        columns = (directions[k, own] * sign[k, own, None]).T
        multipliers[k, own] = sign[k, own] * nonnegative(columns, -gradient[k], np.zeros(len(own)), free[k, own])
    return np.asarray(multipliers)


def reduced_slope(along: Linearisation, costate: np.ndarray, multipliers: np.ndarray) -> np.ndarray:
    """Largest entry of the Hamiltonian's slope that no multiplier explains, relative to the parts of it. (M,)."""
    form = along.form
    if not form.nu:
        return np.zeros(len(along.s))
    unit, of = along.control_size, form.nx + 1
    left = (slope(along, costate) + np.einsum("kmu,km->ku", along.hold_u, multipliers)) * unit
    parts = np.abs(along.cost_y[:, of:]) + np.einsum("kiu,ki->ku", np.abs(along.rate_y[:, :, of:]), np.abs(costate))
    size = float((parts * unit).max(initial=0.0)) or 1.0
    return np.asarray(np.abs(left).max(axis=1, initial=0.0) / size)


def nonnegative(matrix: np.ndarray, target: np.ndarray, price: np.ndarray, free: np.ndarray) -> np.ndarray:
    """The y (m,) of least |matrix y - target|^2 / 2 + price . y, at least zero but where it is ``free`` (m,), bool.

    By active sets (Lawson, Hanson 1974, chapter 23); of the free ones the least that do it.
    """
    y = np.zeros(matrix.shape[1])
    bound = ~free
    if free.any():
        inverse = np.linalg.pinv(matrix[:, free], rcond=ROUNDING_SHARE)
        rest = matrix[:, bound] - matrix[:, free] @ (inverse @ matrix[:, bound])
        left = target - matrix[:, free] @ (inverse @ target)
        y[bound] = nonnegative(rest, left, price[bound], np.zeros(int(bound.sum()), bool))
        y[free] = inverse @ (target - matrix[:, bound] @ y[bound])
        return y
    normal, right = matrix.T @ matrix, matrix.T @ target - price
    passive = np.zeros(len(y), bool)
    small = 1e-13 * max(float(np.abs(right).max(initial=0.0)), float(np.finfo(float).tiny))
    for _ in range(3 * len(y)):
        pull = np.where(passive, -np.inf, right - normal @ y)
        if pull.max() <= small:
            break
        passive[np.argmax(pull)] = True
        while True:
            index = np.flatnonzero(passive)
            best = np.linalg.lstsq(normal[np.ix_(index, index)], right[index], rcond=1e-12)[0]
            falling = best <= 0
            if not falling.any():
                y[index] = best
                break
            ratio = y[index][falling] / np.maximum(y[index][falling] - best[falling], np.finfo(float).tiny)
            y[index] += float(np.clip(ratio.min(), 0.0, 1.0)) * (best - y[index])
            drop = index[falling & (y[index] <= 1e-15 * np.abs(y).max())]
            drop = drop if drop.size else index[falling][:1]
            y[drop], passive[drop] = 0.0, False
    return y


def groups(patterns: np.ndarray) -> list[tuple[np.ndarray, np.ndarray]]:
    """Distinct rows of patterns (M, m), bool, each with the indices of its members."""
    if not patterns.size:
        return [(np.zeros(patterns.shape[1], bool), np.arange(len(patterns)))] if len(patterns) else []
    packed = np.ascontiguousarray(np.packbits(patterns, axis=1))
    if (packed == packed[0]).all():
        return [(patterns[0], np.arange(len(patterns)))]
    keys = packed.view(np.dtype((np.void, packed.shape[1]))).ravel()
    _, first, member = np.unique(keys, return_index=True, return_inverse=True)
    order = np.argsort(member, kind="stable")
    cuts = np.searchsorted(member[order], np.arange(1, len(first)))
    return list(zip(patterns[first], np.split(order, cuts), strict=True))


def lost(along: Linearisation, costate: np.ndarray, multipliers: np.ndarray, curved: np.ndarray) -> np.ndarray:
    """What the controls could win in each interval within their limits, to second order, in units of cost. (N,).

    Args:
        along: The plan. costate: (M, nx).
        multipliers: Of the limits of the controls, (M, nu + r + a). What these win over the gaps to their limits
            counts.
        curved: T H_uu. Shape (M, nu, nu).

    A control moves within its limits, and by its size at most where the Hamiltonian does not curve along it. Rows that
    push stay where they are.
    """
    nu, n = along.form.nu, along.shape[0]
    if not nu:
        return np.zeros(n)
    unit = along.control_size
    won = along.hold.charge(multipliers).sum(axis=1)
    gradient = slope(along, costate) + np.einsum("kmu,km->ku", along.hold_u, multipliers)
    gradient, curved_u, curved = gradient * unit, curved, curved * (unit * unit[:, None])
    low, high = (np.clip((side - along.u) / unit, -1e3, 1e3) for side in (along.low, along.high))
    low, high = np.minimum(low, 0.0), np.maximum(high, 0.0)
    scale = float(np.abs(curved).max(initial=0.0)) or 1.0
    size = np.abs(along.hold_u * unit).max(axis=2)
    pushes = (np.abs(multipliers) * size > FLAT_SHARE * np.abs(multipliers * size).max(initial=0.0)) | along.hold.equal
    fixed = pushes | (along.hold.lower & along.hold.upper & (size > 0))
    best = np.zeros(len(won))
    while True:  # a control that rests on its limit and would go beyond stays: at most nu rounds
        blocked, inverse = fixed.copy(), inverse_of(along, fixed)
        for pattern, members in groups(fixed):
            rows = along.hold_u[members][:, pattern] * unit
            projector = np.eye(nu) - inverse[members][:, :, pattern] @ rows
            step = _step(gradient[members], curved[members], projector, scale)
            with np.errstate(divide="ignore", invalid="ignore"):
                room = np.where(step > 0, high[members] / step, np.where(step < 0, low[members] / step, np.inf))
            step = np.clip(room.min(axis=1, initial=1.0), 0.0, 1.0)[:, None] * step
            change = np.einsum("ku,ku->k", gradient[members], step)
            change += np.einsum("ku,kuv,kv->k", step, curved[members], step) / 2
            best[members] = np.maximum(best[members], -change)
            blocked[members, :nu] |= room <= ROUNDING_SHARE
        if (blocked == fixed).all():
            break
        fixed = blocked
    return np.asarray(((won + best) * along.share).reshape(n, -1).sum(axis=1) + turning(along, costate, curved_u))


def turning(along: Linearisation, costate: np.ndarray, curved: np.ndarray) -> np.ndarray:
    """What a quadrature misses of intervals in which the slope along a control that does not curve turns. Shape (N,).

    The loss there is that of max(slope, 0) and max(-slope, 0) times the ways to both limits. Args as of `lost`.
    """
    (n, q), unit = along.shape, along.control_size
    pull, bends = slope(along, costate) * unit, curved * (unit * unit[:, None])
    largest = max(float(np.abs(bends).max(initial=0.0)), float(np.abs(pull).max(initial=0.0)))
    flat = np.abs(bends).max(axis=(0, 2), initial=0.0) <= FLAT_SHARE * largest
    if along.mixed.size or not flat.any():
        return np.zeros(n)
    m, pull = int(flat.sum()), pull[:, flat].reshape(n, q, -1)
    down, up = (
        np.maximum(sign * (side - along.u) / unit, 0.0)[:, flat] for sign, side in ((-1, along.low), (1, along.high))
    )
    turns = (pull.min(axis=1) < 0) & (pull.max(axis=1) > 0)
    off = along.places - along.weight @ along.places
    steep = np.einsum("j,kjm->km", along.weight * off, pull) / (along.weight @ off**2)
    mean = np.einsum("j,kjm->km", along.weight, pull)
    line = mean[:, None] + steep[:, None] * off[:, None]
    first, last = mean + steep * (0.0 - along.weight @ along.places), mean + steep * (1.0 - along.weight @ along.places)
    missed = np.zeros((n, m))
    with np.errstate(divide="ignore", invalid="ignore"):
        for sign, room in ((1.0, down), (-1.0, up)):
            a, b = np.maximum(sign * first, 0.0), np.maximum(sign * last, 0.0)
            exact = (b**2 - a**2) / (2 * sign * (last - first))
            seen = np.einsum("j,kjm->km", along.weight, np.maximum(sign * line, 0.0))
            width = np.minimum(room.reshape(n, q, m).mean(axis=1), 1.0)
            missed += np.where(turns, width * (exact - seen), 0.0)
    return np.asarray(along.width * missed.sum(axis=1))


def _step(gradient: np.ndarray, curved: np.ndarray, projector: np.ndarray, scale: float) -> np.ndarray:
    """The least of gradient . d + d curved d / 2 over projected d at each point; |d| about 1 where it does not curve.

    Shapes (k, nu), (k, nu, nu), (k, nu, nu). ``scale``: the largest curvature.
    """
    nu = gradient.shape[1]
    pull = np.einsum("kuv,kv->ku", projector, gradient)
    # held directions are as stiff as the stiffest, so that rounding does not move along them
    inside = projector @ curved @ projector + scale * (np.eye(nu) - projector)
    values, vectors = np.linalg.eigh((inside + inside.transpose(0, 2, 1)) / 2)
    along = np.einsum("kuv,ku->kv", vectors, pull)
    solid = values > FLAT_SHARE * scale
    step = np.where(solid, -along / np.where(solid, values, 1.0), -np.sign(along))
    step = np.where(np.abs(along) > MACHINE_SHARE * np.abs(gradient).max(axis=1, keepdims=True), step, 0.0)
    return np.asarray(projector @ np.einsum("kuv,kv->ku", vectors, step)[..., None])[..., 0]
