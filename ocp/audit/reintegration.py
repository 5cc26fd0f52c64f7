"""The controls of a plan, integrated anew with tight tolerances, knowing nothing of the transcription."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np

from ocp.console import quiet
from ocp.problem.formulation import Formulation
from ocp.solution import Solution

__all__ = ["TOLERANCE", "Reintegration", "reintegrate"]

TOLERANCE = 1e-12  # relative and absolute, of the local error of cvodes
OPTIONS = {
    "reltol": TOLERANCE,
    "abstol": TOLERANCE,
    "max_num_steps": 20_000,
    "quad_err_con": True,
    "linear_multistep_method": "adams",  # between jumps of the control a plan is smooth
    "show_eval_warnings": False,
    "disable_internal_warnings": True,
}


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
    integrator = interval_integrator(form, nodes, places[1:])
    constants = np.vstack(
        [
            values.reshape(n, -1).T,
            mesh[:-1],
            np.diff(mesh),
            np.full(n, solution.horizon),
            np.tile(p[:, None], (1, n)),
        ]
    )
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
                out = integrator(x0=starts[k], p=constants[:, k])
            local[k, 1:] = out["xf"].full().T
        except RuntimeError:
            local[k, 1:] = np.nan
        if broke_down is not None:
            continue
        try:
            with quiet():
                out = integrator(x0=state, p=constants[:, k])
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
    sym = form.problem.symbols.sym
    nw = form.nu * len(nodes)
    x, place, q = sym("x", form.nx), sym("place"), sym("q", nw + 3 + form.np)
    controls = ca.reshape(q[:nw], form.nu, len(nodes))
    s, h, horizon, p = q[nw], q[nw + 1], q[nw + 2], q[nw + 3 :]
    u = ca.mtimes(controls, ca.vertcat(*basis(nodes, place)))
    rate, cost = form.function("f", [form.f, form.running], ["f", "running"])(
        x, u, (s + h * place) * horizon, horizon, p
    )
    dae = {"x": x, "t": place, "p": q, "ode": h * horizon * rate, "quad": h * horizon * cost}
    return ca.integrator("reintegrate", "cvodes", dae, 0.0, places.tolist(), OPTIONS)


def basis(nodes: np.ndarray, place: Any) -> list[Any]:
    """Lagrange basis polynomials of ``nodes`` as expressions of ``place``."""
    polynomials = []
    for i, node in enumerate(nodes):
        product: Any = 1.0
        for j, other in enumerate(nodes):
            if j != i:
                product = product * (place - other) / (node - other)
        polynomials.append(product)
    return polynomials
