"""How far every bound and constraint of a problem is missed along a re-integrated plan."""

from __future__ import annotations

import casadi as ca
import numpy as np

from ocp.audit.reintegration import Reintegration
from ocp.problem.formulation import Formulation

__all__ = ["violations"]

Check = tuple[str, str, np.ndarray, np.ndarray, float]  # label, name, violations (K,), times (K,), scale


def violations(
    form: Formulation,
    again: Reintegration,
    bounds: tuple[np.ndarray, np.ndarray],
    p: np.ndarray,
    horizon: float,
) -> list[Check]:
    """How far every bound and constraint is missed, at every point of the fine grid."""
    lower, upper = bounds
    places = form.bounds.places
    checks: list[Check] = []
    states = np.where(np.isfinite(again.states), again.states, np.nan)
    first, last = slice(0, 1), slice(-1, None)
    for kind, pool, values, at, what in (
        ("state", form.states, states, slice(None), "bounds of"),
        ("control", form.controls, again.controls, slice(None), "bounds of"),
        ("initial", form.states, states, first, "start of"),
        ("terminal", form.states, states, last, "end of"),
    ):
        for name, place in pool.items():
            index = places[kind][place]
            low, high = lower[index], upper[index]
            given = np.isfinite(low) | np.isfinite(high)
            if kind in ("initial", "terminal"):
                given = low == high
            if np.any(given):
                miss, size = missed(values[at][:, place][:, given], low[given], high[given])
                checks.append((f"{what} {name}", name, miss, again.t[at], size))
    form_symbols = [form.x, form.u, form.t, form.T, form.p, form.x0, form.u0]
    for rows, at in ((form.path, slice(None)), (form.start, first), (form.end, last)):
        if len(rows) == 0:
            continue
        function = ca.Function("rows", form_symbols, [rows.expression])
        m = len(again.t[at])
        ones = np.ones((1, m))
        inputs = (states[at].T, again.controls[at].T, again.t[at][None, :], horizon * ones, p[:, None] * ones,
                  states[0][:, None] * ones, again.controls[0][:, None] * ones)  # fmt: skip
        g = np.asarray(function.map(m, "serial").call([ca.DM(v) for v in inputs])[0].full()).T
        for name in rows.names:
            mine = rows.of(name)
            miss, size = missed(g[:, mine], lower[rows.bounds[mine]], upper[rows.bounds[mine]])
            checks.append((name, name, miss, again.t[at], size))
    return checks


def missed(values: np.ndarray, lower: np.ndarray, upper: np.ndarray) -> tuple[np.ndarray, float]:
    """Largest violation at each of K points (K,), and the scale of the bounds."""
    over = np.maximum(lower - values, values - upper)
    miss = np.where(np.isnan(values), np.inf, np.maximum(over, 0.0)).max(axis=1)
    with np.errstate(invalid="ignore"):
        width = np.where(np.isfinite(upper - lower), upper - lower, 0.0)
    bound = np.max(np.where(np.isfinite([lower, upper]), np.abs([lower, upper]), 0.0), axis=0)
    sizes = np.where(width > 0, width, bound)
    return miss, float(np.min(np.where(sizes > 0, sizes, 1.0)))
