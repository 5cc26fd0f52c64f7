"""How far every bound and constraint of a problem is missed along a plan, between its points too."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ocp.audit.reintegration import Reintegration
from ocp.audit.sizes import Sizes
from ocp.problem.formulation import Bounds, Formulation

__all__ = ["Violation", "violations"]


@dataclass(frozen=True)
class Violation:
    """How far one bound or constraint is missed.

    Attributes:
        label: What it is, ``end of q``. name: Of the state, control or constraint.
        t: Times, s. Shape (K,).
        missed: Largest violation of its rows at each time, infinite for what is not a number. Shape (K,).
        shares: Largest violation relative to the size of the row. sizes: Of that row. Shape (K,) each.
    """

    label: str
    name: str
    t: np.ndarray
    missed: np.ndarray
    shares: np.ndarray
    sizes: np.ndarray


def violations(
    form: Formulation,
    again: Reintegration,
    states: np.ndarray,
    sizes: Sizes,
    bounds: Bounds,
    p: np.ndarray,
    horizon: float,
) -> list[Violation]:
    """How far every bound and constraint is missed, along some states (M, nx) on the fine grid."""
    lower, upper = bounds
    places = form.bounds.places
    found: list[Violation] = []
    first, last = slice(0, 1), slice(-1, None)
    for kind, pool, values, size, at, what in (
        ("state", form.states, states, sizes.state, slice(None), "bounds of"),
        ("control", form.controls, again.controls, sizes.control, slice(None), "bounds of"),
        ("initial", form.states, states, sizes.state, first, "start of"),
        ("terminal", form.states, states, sizes.state, last, "end of"),
    ):
        for name, place in pool.items():
            index = places[kind][place]
            low, high = lower[index], upper[index]
            given = np.isfinite(low) | np.isfinite(high)
            if kind in ("initial", "terminal"):
                given = low == high
            if np.any(given):
                miss = missed(values[at][:, place][:, given], low[given], high[given], size[place][given])
                found.append(Violation(f"{what} {name}", name, again.t[at], *miss))
    starts = (form.x0, states[0]), (form.u0, again.controls[0])
    for kind, at in (("path", slice(None)), ("start", first), ("end", last)):
        rows, size = getattr(form, kind), getattr(sizes, kind)
        if len(rows) == 0:
            continue
        g = form.sampled([rows.expression], states[at], again.controls[at], again.t[at], horizon, p, *starts)[0]
        for name in rows.names:
            mine = rows.of(name)
            miss = missed(g[:, mine], lower[rows.bounds[mine]], upper[rows.bounds[mine]], size[mine])
            found.append(Violation(name, name, again.t[at], *miss))
    return found


def missed(
    values: np.ndarray, lower: np.ndarray, upper: np.ndarray, sizes: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """At each of K points the largest violation, the largest share of a row's size, and that size. Shape (K,) each."""
    over = np.where(np.isnan(values), np.inf, np.maximum(np.maximum(lower - values, values - upper), 0.0))
    shares = over / sizes
    return over.max(axis=1), shares.max(axis=1), sizes[np.argmax(shares, axis=1)]
