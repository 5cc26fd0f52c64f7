"""A problem of a suite as rockit poses it, on the same mesh and from the same guess."""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np

from ocp import Collocation, Problem, prepare
from ocp.problem.formulation import Formulation

TOLERANCE = 1e-8
"""Of IPOPT, as by default in this package and in rockit."""


def rockit_cost(problem: Problem, method: Collocation) -> float:
    """Pose and solve a problem by rockit's collocation of Radau points on equal intervals; return the cost.

    Controls that are free at every point are algebraic variables there. Raises what rockit and CasADi raise.
    """
    import rockit as peer

    form = Formulation.of(problem)
    start = prepare(problem, method, options={"max_iter": 0}, scaling=False).solve(check=False)
    lower, upper = (np.asarray(side, dtype=float) for side in form.bound_values(np.zeros(0)))
    place = form.bounds.places
    low, high = lower[place["horizon"]], upper[place["horizon"]]
    ocp = peer.Ocp(T=peer.FreeTime(start.horizon) if form.horizon_is_free else float(start.horizon))
    x = ocp.state(form.nx)
    free = method.control != "held"
    u = (ocp.algebraic(form.nu) if free else ocp.control(form.nu)) if form.nu else ca.MX(0, 1)

    def function(name: str, value: Any) -> Any:
        return ca.Function(name, [form.x, form.u, form.t, form.T, form.x0, form.u0], [ca.densify(value)])

    clock = 0.0
    if not form.autonomous:  # rockit's own time is no argument of dynamics and algebraic equations
        clock = ocp.state()
        ocp.set_der(clock, 1)
        ocp.subject_to(ocp.at_t0(clock) == 0)
    here = (x, u, clock, 0, ca.MX(form.nx, 1), ca.MX(form.nu, 1))
    ocp.set_der(x, function("rates", form.f)(*here))
    ocp.add_objective(ocp.integral(function("running", form.running)(*here)))
    at_start = ocp.at_t0(x)
    at_end = (ocp.at_tf(x), ca.MX(form.nu, 1), ocp.T, ocp.T, at_start, ca.MX(form.nu, 1))
    ocp.add_objective(function("terminal", form.terminal)(*at_end))
    everywhere: dict[str, Any] = {"grid": "integrator_roots"}
    for kind, value in (("state", x), ("control", u)):
        for i, k in enumerate(place[kind]):
            _limit(ocp, lower[k], value[i], upper[k], everywhere)
    if form.horizon_is_free:
        _limit(ocp, low[0], ocp.T, high[0], {})
    for kind, value in (("initial", at_start), ("terminal", ocp.at_tf(x))):
        for i, k in enumerate(place[kind]):
            _limit(ocp, lower[k], value[i], upper[k], {})
    first = (at_start, ca.MX(form.nu, 1), 0, ocp.T, at_start, ca.MX(form.nu, 1))
    for rows, arguments, grid in ((form.path, here, everywhere), (form.start, first, {}), (form.end, at_end, {})):
        if not len(rows):
            continue
        values = function("rows", rows.expression)(*arguments)
        for i in range(len(rows)):
            k = rows.bounds[i]
            _limit(ocp, lower[k], values[i], upper[k], grid)
    nodes = np.linspace(0.0, 1.0, 20 * method.intervals + 1)
    curves = (
        ((x, start.state_interpolant), (u, start.control_interpolant)) if form.nu else ((x, start.state_interpolant),)
    )
    for value, curve in curves:
        table = ca.interpolant("guess", "linear", [nodes * start.horizon], np.asarray(curve(nodes)).ravel())
        ocp.set_initial(value, table(ocp.t))
    ocp.solver(
        "ipopt", {"print_time": False, "expand": True, "ipopt": {"print_level": 0, "sb": "yes", "tol": TOLERANCE}}
    )
    ocp.method(peer.DirectCollocation(N=method.intervals, degree=method.degree))
    solution = ocp.solve()
    return float(solution.value(ocp.objective))


def _limit(ocp: Any, lower: float, value: Any, upper: float, grid: dict[str, Any]) -> None:
    """Constrain a value between two bounds where they are finite."""
    if lower == upper:
        ocp.subject_to(value == lower, **grid)
    elif np.isfinite(lower) and np.isfinite(upper):
        ocp.subject_to((lower <= value) <= upper, **grid)
    elif np.isfinite(lower):
        ocp.subject_to(value >= lower, **grid)
    elif np.isfinite(upper):
        ocp.subject_to(value <= upper, **grid)
