"""Whether a plan is a local minimum: its costates and multipliers found anew, what it loses, how the cost curves."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np

from ocp.audit.accessory import AccessoryProblem
from ocp.audit.costates import Adjoint, Ends, adjoint
from ocp.audit.curvature import Curvature, curvature
from ocp.audit.duality import best_multipliers
from ocp.audit.linearisation import Linearisation
from ocp.audit.principle import Hamiltonian, hamiltonian, lost, reduced_slope, turning
from ocp.audit.sizes import sizes
from ocp.problem.formulation import Bounds, Formulation
from ocp.solution import Solution
from ocp.tolerances import LIMIT_SHARE, RESOLVED_SHARE

__all__ = ["Optimality", "optimality"]


@dataclass(frozen=True)
class Optimality:
    """First and second order conditions along a plan.

    Attributes:
        lost: What the plan could cost less, to second order, in each interval; those at its ends in the first. (N,)
        cost_size: What it is judged against, in units of cost: the cost, or where that is next to nothing what
            changes of the controls that are just told apart would cost.
        error_size: What errors of the costates are judged against, in units of cost. They cost by their square.
        stationarity: Largest slope of the Hamiltonian that nothing holds at the Gauss points, relative to the sizes
            of its parts. t: their times, s. Both (N q,).
        known_to: Share of the cost up to which a transcription that loses as much in its controls knows its costates.
        unfit: Error of the costates reported, as a share of the cost, where others fit the plan better: their distance
            from these, or what they lose more, by its root. flat: Whether H does not curve along some control.
        adjoint: Costates and multipliers. hamiltonian: Along the plan. curvature: The second variation.
    """

    lost: np.ndarray
    cost_size: float
    error_size: float
    t: np.ndarray
    stationarity: np.ndarray
    adjoint: Adjoint
    hamiltonian: Hamiltonian
    curvature: Curvature
    known_to: float
    unfit: float
    flat: bool


def optimality(
    form: Formulation,
    solution: Solution,
    p: np.ndarray,
    bounds: Bounds,
    along: Linearisation | None = None,
    allowed: float = LIMIT_SHARE,
) -> Optimality:
    """Look for the multipliers of a plan, for what it loses and for how the cost curves.

    Args:
        form, p, bounds: The problem, its parameters and its bounds at these.
        solution: The plan. along: Its first derivatives, where they are known already.
        allowed: Share of the cost from which on it is worth looking for multipliers that fit the plan better than the
            costates reported.
    """
    along = along or Linearisation(form, solution, p, bounds, sizes(form, solution, p, bounds))
    if not (along.finite and np.isfinite(solution.cost)):
        return undefined(along, hamiltonian(form, solution, p))
    cost = abs(solution.cost) or along.slope_size or 1.0
    curved = _curved(along)
    first = adjoint(along, curved, cost)
    if first.lumps.any():
        found, told = first, _told(along, first, curved)
        for _ in range(4):  # each finds pushes at single nodes better by the width of an interval
            found = adjoint(along, curved, cost, found.lumps)
            now = _told(along, found, curved)
            if now >= told:
                break
            first, told = found, now
    accessory = AccessoryProblem(along, first)
    spread = accessory.spread
    cost = max(abs(solution.cost), LIMIT_SHARE * accessory.price, LIMIT_SHARE**2 * along.slope_size)
    cost = cost if cost > 0 else 1.0
    total = lost(along, first.costate, first.holding, accessory.curved)
    total, best = np.maximum(total, 0.0) + first.charge, first
    told, unfit = _won(total, first), 0.0
    several = along.several or bool(accessory.flat.any())
    if told > allowed * cost and several:
        fit = best_multipliers(along, first, accessory.curved, cost)
        if fit is not None and _won(fit.lost, fit.adjoint) < told:
            best = fit.adjoint
            total = np.maximum(fit.lost + turning(along, best.costate, accessory.curved), 0.0)
            unfit = min(fit.distance / cost, float(np.sqrt((told - _won(total, best)) / cost)))
            accessory = AccessoryProblem(along, best)
    total[0] += best.ends.charge
    loses = float(total.sum()) if unfit else told
    known_to = float(np.sqrt(loses / cost)) if np.isfinite(loses) else 0.0
    second = curvature(accessory)
    if second.upwards and second.won is not None:  # near a conjugate point states that follow win more
        more = float(second.won.sum() - total.sum())
        total += max(more, 0.0) * second.won / (float(second.won.sum()) or 1.0)
    total[0] += second.lost(accessory.start_slope)
    return Optimality(
        total,
        cost,
        max(float(np.sqrt(cost * max(cost, spread))), RESOLVED_SHARE**2 * accessory.magnitude),
        along.t,
        reduced_slope(along, best.costate, best.holding),
        best,
        hamiltonian(form, solution, p),
        second,
        known_to,
        unfit,
        bool(accessory.flat.any()),
    )


def _won(by_interval: np.ndarray, multipliers: Adjoint) -> float:
    """What a plan loses with these multipliers but for its start, in units of cost."""
    return float(by_interval.sum() + multipliers.ends.charge)


def _told(along: Linearisation, found: Adjoint, curved: np.ndarray | None) -> float:
    """What a plan loses and errs by with these multipliers, in units of cost."""
    assert curved is not None
    won = lost(along, found.costate, found.holding, curved).sum() + found.charge.sum() + found.ends.charge
    return float(won + found.total + found.ends.transversality)


def _curved(along: Linearisation) -> np.ndarray | None:
    """T H_uu at the points but for its path constraints, (M, nu, nu), where what pushes at single points needs it."""
    form = along.form
    near = along.stand.near.any() or along.node_stand.near.any()
    single = along.nodal and (along.mixed.size > 0 or near)
    if form.path.equality[along.mixed].all() and not single:
        return None
    lam = form.sym("lam", form.nx)

    def outputs() -> list[Any]:
        return [ca.hessian(along.scaled[0] + ca.dot(lam, along.scaled[1]), form.u)[0]]

    (curved,) = form.sampled(outputs, *along.here, (lam, along.costate), kept="curvature in the controls")
    return np.asarray(curved.reshape(-1, form.nu, form.nu))


def undefined(along: Linearisation, values: Hamiltonian) -> Optimality:
    """What is found where the problem is not a number along the plan: nothing that would pass."""
    (n, _), m = along.shape, len(along.s)
    nothing, form = np.full(n, np.inf), along.form
    ends = Ends(
        np.inf, np.inf, np.full(form.nx + 1, np.nan), np.inf, np.zeros(len(form.end)), np.zeros(len(form.start))
    )
    t = along.mesh * along.solution.horizon
    shapes = form.nx, along.hold_u.shape[1], along.stand_x.shape[1]
    costate, holding, standing = (np.full((m, k), np.nan) for k in shapes)
    curved = Curvature(np.nan, None, "the problem is not a number along the plan", None, along.t)
    return Optimality(
        nothing,
        1.0,
        1.0,
        along.t,
        np.full(m, np.inf),
        Adjoint(t, costate, holding, standing, nothing, np.inf, nothing, nothing, np.zeros((n + 1, form.nx)), ends),
        values,
        curved,
        0.0,
        0.0,
        False,
    )
