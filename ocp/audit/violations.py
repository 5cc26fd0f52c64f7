"""How far every bound and constraint of a problem is missed along a plan, between its points too.

A constraint is judged by its size along the plan, and where it is missed most by how it changes right there: the square
of a distance hardly changes near zero, and a plan that goes through the middle of a thing misses little of it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ocp.audit.reintegration import Reintegration
from ocp.audit.sizes import Sizes, changes, integral
from ocp.problem.formulation import Bounds, Formulation
from ocp.tolerances import LIMIT_SHARE, SOLVER_SHARE

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
    share: float,
    reported: np.ndarray,
) -> list[Violation]:
    """How far every bound and constraint is missed, along some states (M, nx) on the fine grid.

    A constraint that declares a tolerance counts as no larger than that this is the ``share`` of its size that is let
    pass, and is judged along the ``reported`` states (M, nx) too, which are what is run.
    """
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
                over = beyond(values[at][:, place][:, given], low[given], high[given])
                found.append(judged(f"{what} {name}", name, again.t[at], over, size[place][given]))
    begin = states[0], again.controls[0]
    entries = LIMIT_SHARE * np.concatenate([sizes.state, sizes.control])
    whole = slice(None)
    here = states, again.controls, again.t, horizon, p, (form.x0, begin[0]), (form.u0, begin[1])
    outputs = [form.path.expression, form.watch.expression]
    along = dict(zip(("path", "watch"), form.sampled(outputs, *here, kept="rows along a plan"), strict=True))
    for kind, at in (("path", whole), ("start", first), ("end", last), ("watch", whole)):
        rows, size = getattr(form, kind), getattr(sizes, kind)
        if len(rows) == 0:
            continue
        x, u, t = states[at], again.controls[at], again.t[at]
        if kind in along:
            g = along[kind]
        else:
            starts = (form.x0, begin[0]), (form.u0, begin[1])
            g = form.sampled([rows.expression], x, u, t, horizon, p, *starts, kept=(kind, "from the start"))[0]
        over = beyond(_integrated(form, kind, g, t), lower[rows.bounds], upper[rows.bounds])
        limited = np.isfinite(rows.tolerance)
        if kind in along and limited.any():
            told = form.sampled(outputs, reported, *here[1:], kept="rows along a plan")[kind == "watch"]
            missed = beyond(_integrated(form, kind, told, t), lower[rows.bounds], upper[rows.bounds])
            over = np.where(limited, np.maximum(over, missed), over)
        size = np.tile(size, (len(t), 1))
        worst = np.argmax(over, axis=0), np.arange(len(rows))
        if kind != "watch" and np.any(over[worst] > SOLVER_SHARE * size[worst]):  # judged by how it changes there
            change = changes(form, kind, (x[worst[0]], u[worst[0]], t[worst[0]]), begin, horizon, p, entries)[1]
            by = change.sum(axis=0)[worst[1], worst[1]] / LIMIT_SHARE
            size[worst] = np.clip(by, SOLVER_SHARE * size[worst], size[worst])
        with np.errstate(divide="ignore"):
            size = np.minimum(size, rows.tolerance / share)
        for name in rows.names:
            mine = rows.of(name)
            found.append(judged(name, name, t, over[:, mine], size[:, mine]))
    return found


def _integrated(form: Formulation, kind: str, g: np.ndarray, t: np.ndarray) -> np.ndarray:
    """Values of rows (K, m), of those that are watched as integrals their integrals over time."""
    return np.where(form.watch_integral, integral(g, t), g) if kind == "watch" else g


def beyond(values: np.ndarray, lower: np.ndarray, upper: np.ndarray) -> np.ndarray:
    """How far values (K, m) are beyond their bounds, at least 0; infinite where they are not a number."""
    return np.where(np.isnan(values), np.inf, np.maximum(np.maximum(lower - values, values - upper), 0.0))


def judged(label: str, name: str, t: np.ndarray, over: np.ndarray, sizes: np.ndarray) -> Violation:
    """What is missed (K, m), and as shares of sizes (m,) or (K, m), by most at each time."""
    shares = over / sizes
    most = np.argmax(shares, axis=1)[:, None]
    size = np.take_along_axis(np.broadcast_to(sizes, over.shape), most, axis=1)[:, 0]
    return Violation(label, name, t, over.max(axis=1), shares.max(axis=1), size)
