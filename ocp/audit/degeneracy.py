"""Which of many costates: where the controls of a plan all rest on their limits, they do not say.

A plan that switches from limit to limit only where its mesh allows it fits a whole set of costates; a solver reports
the middle of it, whose switching functions need not have their zeros where the plan switches (dual degeneracy). What
such a plan loses is the least over that set: a convex problem in the multipliers of the given final states, solved here
by least squares with weights that follow the loss.
"""

from __future__ import annotations

import numpy as np

from ocp.audit.costates import Backwards
from ocp.audit.linearisation import Linearisation
from ocp.audit.principle import DEPENDENT, slope

__all__ = ["better_costates"]

ROUNDS = 50
"""Of least squares; each halves the width over which a hinge is rounded off."""


def better_costates(along: Linearisation, costate: np.ndarray, holding: np.ndarray, flat: np.ndarray) -> np.ndarray:
    """Costates (M, nx) of the same plan that meet the same equation and ends, and fit its switches best.

    Args:
        along: The plan. costate, holding: What it reports and what holds its controls there, (M, nx), (M, nu + r + a).
        flat: Controls along which the Hamiltonian does not curve. Shape (nu,), bool.
    """
    moves = _moves(along, holding)
    nu, of = along.form.nu, along.form.nx + 1
    unit = along.sizes.control[flat]
    pull = slope(along, costate)[:, flat] * unit
    answer = np.einsum("kiu,kid->kud", along.rate_y[:, :, of:][:, :, flat], moves) * unit[:, None]
    size = np.sqrt(np.einsum("kud,kud,k->d", answer, answer, along.share))
    kept = size > DEPENDENT * size.max(initial=0.0)
    if not kept.any():
        return costate
    answer = answer[:, :, kept] / size[kept]
    # what a control may move by, down where the pull is positive and up where it is negative
    down, up = (np.minimum(gap[:, :nu][:, flat] / unit, 1.0) for gap in (along.hold.below, along.hold.above))
    best, step = np.zeros(len(size[kept])), np.zeros(len(size[kept]))
    least = np.inf
    for k in range(ROUNDS):  # the loss, a sum of hinges, by least squares whose weights follow it
        now = pull + answer @ step
        room = np.where(now > 0, down, up)
        value = float(along.share @ (np.abs(now) * room).sum(axis=1))
        if value < least:
            least, best = value, step
        blur = np.abs(pull).max() * 0.5**k
        weight = along.share[:, None] * np.where(room > DEPENDENT, room, 0.0) / np.maximum(np.abs(now), blur)
        normal = np.einsum("kud,kue,ku->de", answer, answer, weight)
        normal += DEPENDENT * (np.trace(normal) or 1.0) * np.eye(len(step))
        step = np.linalg.solve(normal, -np.einsum("kud,ku,ku->d", answer, pull, weight))
    return np.asarray(costate + moves[:, :, kept] @ (best / size[kept]))


def _moves(along: Linearisation, holding: np.ndarray) -> np.ndarray:
    """How the costates at the points may move without leaving their equations, (M, nx, d).

    That is with the multipliers of given final states, where initial states are given and a free horizon keeps its
    condition.
    """
    form, (low, high), places = along.form, along.bounds, along.form.bounds.places
    (n, q), nx = along.shape, form.nx
    given = low[places["terminal"]] == high[places["terminal"]]
    back = Backwards(along, holding, np.zeros(len(holding), bool))
    end = np.eye(nx)[:, given]
    points = np.zeros((n, q, nx, end.shape[1]))
    answer, flow = back.flow
    for k in reversed(range(n)):
        points[k] = answer[k] @ end
        end = flow[k] @ end
    moves = points.reshape(n * q, nx, -1)
    conditions = [end[low[places["initial"]] < high[places["initial"]]]]
    if form.horizon_is_free:
        conditions.append(np.einsum("k,ki,kid->d", along.share, along.rate_y[:, :, nx], moves)[None])
    rows = np.vstack(conditions)
    if len(rows):
        length = np.linalg.norm(rows, axis=1, keepdims=True)
        _, sizes, right = np.linalg.svd(rows / np.where(length > 0, length, 1.0))
        free = right[int(np.sum(sizes > 1e-9)) :].T
        moves = moves @ free
    return np.asarray(moves)
