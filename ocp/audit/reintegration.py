"""What the controls of a plan really do: integrated anew with tight tolerances, knowing nothing of the transcription.

And how far every bound and constraint of the problem is missed along the states that come out.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np

from ocp.console import quiet
from ocp.curves import integrator, lagrange_expressions
from ocp.problem.formulation import Bounds, Formulation
from ocp.solution import Solution

__all__ = ["Reintegration", "reintegrate", "violations"]

Check = tuple[str, str, np.ndarray, np.ndarray, float]  # label, name, violations (K,), times (K,), scale


@dataclass(frozen=True)
class Reintegration:
    """What the controls of a plan really do.

    Attributes:
        t: Times, s; every interval from its start to its end, so that interior mesh times stand twice. Shape (M,).
        interval: Interval of each time. Shape (M,).
        states: Integrated from the start to the end. Shape (M, nx). Nan behind a breakdown.
        controls: Of the plan, from the side of the interval. Shape (M, nu).
        local: Integrated over each interval from the plan's own state at its start. Shape (M, nx).
        plan: The plan's interpolated states. Shape (M, nx).
        cost: Running cost integrated along ``states``.
        broke_down: Time at which the integration could not go on, s, or None.
    """

    t: np.ndarray
    interval: np.ndarray
    states: np.ndarray
    controls: np.ndarray
    local: np.ndarray
    plan: np.ndarray
    cost: float
    broke_down: float | None


def reintegrate(form: Formulation, solution: Solution, p: np.ndarray, samples: int) -> Reintegration:
    """Integrate the controls of ``solution`` with ``samples`` points in every interval."""
    mesh, nodes = solution.control_interpolant.breaks, solution.control_interpolant.nodes
    values = solution.control_interpolant.values  # (n, c, nu)
    n = len(mesh) - 1
    places = np.linspace(0.0, 1.0, samples + 1)
    along = interval_integrator(form, nodes, places[1:])
    shared = np.tile(np.append(solution.horizon, p)[:, None], (1, n))
    constants = np.vstack([values.reshape(n, -1).T, mesh[:-1], np.diff(mesh), shared])
    piece, place = np.repeat(np.arange(n), samples + 1), np.tile(places, n)
    fractions = mesh[piece] + np.diff(mesh)[piece] * place
    plan = solution.state_interpolant(fractions)
    # at the end of an interval the plan's own value from the left, which differs where it jumps
    at_end = place == 1.0
    left = fractions[at_end] * (1 - 1e-15)
    plan[at_end] = solution.state_interpolant(left)
    starts = solution.state_interpolant(mesh[:-1])

    local = np.full((n, samples + 1, form.nx), np.nan)
    states = np.full((n, samples + 1, form.nx), np.nan)
    state, cost, broke_down = starts[0], 0.0, None
    for k in range(n):
        local[k, 0], states[k, 0] = starts[k], state
        try:
            with quiet():
                out = along(x0=starts[k], p=constants[:, k])
            local[k, 1:] = out["xf"].full().T
        except RuntimeError:
            local[k, 1:] = np.nan
        if broke_down is not None:
            continue
        try:
            with quiet():
                out = along(x0=state, p=constants[:, k])
            states[k, 1:] = out["xf"].full().T
            cost += float(out["qf"][-1])
        except RuntimeError:
            pass
        state = states[k, -1]
        if not np.all(np.isfinite(state)):
            broke_down = float(mesh[k] * solution.horizon)
    return Reintegration(
        fractions * solution.horizon,
        piece,
        states.reshape(-1, form.nx),
        solution.control_interpolant.within(piece, place),
        local.reshape(-1, form.nx),
        plan,
        cost if broke_down is None else float("nan"),
        broke_down,
    )


def interval_integrator(form: Formulation, nodes: np.ndarray, places: np.ndarray) -> Any:
    """Integrator over one interval, whose time is the place 0..1 in it; p = [control values, s, h, T, parameters]."""
    sym = form.sym
    nw = form.nu * len(nodes)
    x, place, q = sym("x", form.nx), sym("place"), sym("q", nw + 3 + form.np)
    controls = ca.reshape(q[:nw], form.nu, len(nodes))
    s, h, horizon, p = q[nw], q[nw + 1], q[nw + 2], q[nw + 3 :]
    u = ca.mtimes(controls, lagrange_expressions(nodes, place))
    function = form.function("f", [form.f, form.running], ["f", "running"])
    rate, cost = function(x, u, (s + h * place) * horizon, horizon, p)
    dae = {"x": x, "t": place, "p": q, "ode": h * horizon * rate, "quad": h * horizon * cost}
    return integrator("reintegrate", dae, places.tolist())


def violations(form: Formulation, again: Reintegration, bounds: Bounds, p: np.ndarray, horizon: float) -> list[Check]:
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
    starts = (form.x0, states[0]), (form.u0, again.controls[0])
    for rows, at in ((form.path, slice(None)), (form.start, first), (form.end, last)):
        if len(rows) == 0:
            continue
        g = form.sampled([rows.expression], states[at], again.controls[at], again.t[at], horizon, p, *starts)[0]
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
