"""Direct multiple shooting: every interval is integrated from its own start, and its end must meet the next start.

Bock, Plitt 1984. The multipliers of these continuity conditions are the costates at the nodes.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np

from ocp.curves import integrator, rk4_step
from ocp.direct.assembly import SIZES, Block, Interpolants, Transcription
from ocp.direct.prepared import DirectMethod
from ocp.direct.transcription import TranscriptionBuilder
from ocp.errors import require
from ocp.problem.formulation import Formulation
from ocp.problem.values import symbols_of

__all__ = ["MultipleShooting"]

THIRDS = np.linspace(0.0, 1.0, 4)  # nodes of a cubic


@dataclass(frozen=True)
class MultipleShooting(DirectMethod):
    """Multiple shooting on a mesh of intervals.

    Attributes:
        intervals: Number of intervals.
        integrator: ``rk4`` (classical Runge-Kutta, ``steps`` equal steps) or ``cvodes`` (variable step and order,
            tolerance 1e-10; for stiff dynamics; slow second derivatives).
        steps: Integration steps per interval; for cvodes the number of segments of the reported interpolant.
        control: ``held`` (constant on an interval) or ``linear`` (linear between nodes, continuous).
        mesh: Ends of the intervals as fractions 0..1, N + 1 of them; None for equal intervals.

    Raises:
        ProblemError: For a value outside these.
    """

    intervals: int
    integrator: str = "rk4"
    steps: int = 1
    control: str = "held"
    mesh: tuple[float, ...] | None = None

    def __post_init__(self) -> None:
        self._check_mesh("steps")
        require.choice("MultipleShooting: integrator", self.integrator, ("rk4", "cvodes"))
        require.choice("MultipleShooting: control", self.control, ("held", "linear"))

    @property
    def order(self) -> int:
        return 4

    @property
    def control_order(self) -> int:
        return 1 if self.control == "held" else 2

    def transcribe(self, form: Formulation, *, staged: bool = False) -> Transcription:
        return transcribe(self, form, staged)


def transcribe(method: MultipleShooting, form: Formulation, staged: bool) -> Transcription:
    """Transcribe a problem by multiple shooting."""
    nx, nu = form.nx, form.nu
    mesh = method.fractions
    n, width = len(mesh) - 1, np.diff(mesh)
    stages = np.arange(n)
    linear = method.control == "linear"
    build = TranscriptionBuilder(form, mesh, nu if linear else 0, 0 if linear else nu, staged)
    layout = build.layout
    first, last = layout.node[:nx, :-1], layout.node_end[:nx]
    if linear:
        controls = np.stack([layout.node[nx:, :-1], layout.node_end[nx:]])  # at both ends of the interval, (2, nu, n)
    else:
        build.variables("control", layout.interval, mesh[:-1] + 0.5 * width, "control")
        controls = layout.interval[None]

    # the end of every interval: x_end - F(x, u) = 0
    rows = build.rows(tuple(f"continuity of {name}" for name in form.state_labels), None, stages, mesh[1:])
    build.linear(rows, last, 1.0)
    variables = build.point(first, controls.reshape(-1, n), stages)
    data = np.vstack([mesh[:-1], width])
    build.blocks.append(Block(interval_function(form, method), variables, data, rows))

    # path constraints: at both ends of an interval where they contain a control, else at the nodes
    without_control = ~form.path.uses_control
    if linear:
        build.node_rows(form.path, layout.node[nx:])
        ends = (np.ones(1), np.ones(1))
        build.ends(ends, layout.node[nx:, 0][None], layout.node[nx:, -1][None], at_nodes=True)
    else:
        controls_inside = layout.interval
        build.path_rows(form.path.select(~without_control), first, controls_inside, stages, at=mesh[:-1])
        build.path_rows(
            form.path.select(~without_control & ~form.path.equality), last, controls_inside, stages, at=mesh[1:]
        )
        build.node_rows(form.path.select(without_control), np.column_stack([controls_inside, controls_inside[:, -1]]))
        build.ends((np.ones(1), np.ones(1)), controls_inside[:, 0][None], controls_inside[:, -1][None], at_nodes=False)

    report = (np.concatenate([stages, [n - 1]]), np.concatenate([np.zeros(n), [1.0]]))
    costate_rows = np.vstack([np.full((1, nx), -1), rows.T])
    costate_scale = np.concatenate([[1.0], np.full(n, -1.0)])
    breaks = np.append((mesh[:-1, None] + width[:, None] * np.arange(method.steps) / method.steps).ravel(), 1.0)
    inputs, control_nodes = np.vstack([first, *controls]), np.array([0.0, 1.0] if linear else [0.5])
    dense = dense_function(form, method)
    interpolants = Interpolants(breaks, THIRDS, inputs, mesh, control_nodes, np.vstack([*controls]), data, dense)
    nodes = np.arange(n + 1)
    return build.finish(
        report,
        layout.node[:nx].T,
        costate_rows,
        costate_nodes=nodes,
        costate_scale=costate_scale,
        interpolants=interpolants,
    )


# ---- integration of one interval -----------------------------------------------------------------------------


def n_controls_of(form: Formulation, method: MultipleShooting) -> int:
    """Return the number of control variables that act in an interval."""
    return form.nu * (2 if method.control == "linear" else 1)


def control_at(form: Formulation, method: MultipleShooting, w: Any, place: Any) -> Any:
    """Return the control at ``place`` 0..1 of an interval from its control variables ``w``."""
    if method.control == "held":
        return w
    return (1 - place) * w[: form.nu] + place * w[form.nu :]


def interval_function(form: Formulation, method: MultipleShooting) -> Any:
    """Return the block function of an interval: (v, d, p) -> (running cost, minus the state at its end)."""
    nw = n_controls_of(form, method)
    step, flat = step_function(form, method)
    sym = (ca.SX if flat else ca.MX).sym
    v, d = sym("v", form.nx + nw + form.horizon_is_free), sym("d", 2)
    p = sym("p", form.np)
    horizon = v[form.nx + nw] if form.horizon_is_free else form.horizon_at(p)
    x, w = v[: form.nx], v[form.nx : form.nx + nw, :]
    cost: Any = 0
    calls = method.steps if method.integrator == "rk4" else 1
    for i in range(calls):
        x, added = step(x, w, d, i, horizon, p)
        cost = cost + added
    return ca.Function("interval", [v, d, p], [cost, -x])


def step_function(form: Formulation, method: MultipleShooting) -> tuple[Any, bool]:
    """Return an integration step (x, w, d, step number, T, p) -> (x, cost), and whether it is to be inlined as SX."""
    if method.integrator == "cvodes":
        return cvodes(form, method, [1.0]), False
    function = form.function("f", [form.f, form.running], ["f", "running"])
    sym = symbols_of(function).sym  # MX if the dynamics need signals
    x, w, d, i = sym("x", form.nx), sym("w", n_controls_of(form, method)), sym("d", 2), sym("i")
    horizon, p = sym("T"), sym("p", form.np)
    h = d[1] * horizon / method.steps

    def slope(place: float, state: Any) -> Any:
        within = (i + place) / method.steps
        time = (d[0] + d[1] * within) * horizon
        return ca.vertcat(*function(state[: form.nx], control_at(form, method, w, within), time, horizon, p))

    result = rk4_step(slope, ca.vertcat(x, 0), h)
    outputs = [result[: form.nx], result[form.nx]]
    step = ca.Function("step", [x, w, d, i, horizon, p], outputs)
    flat = step.is_a("SXFunction") and step.n_instructions() * method.steps < SIZES.inlined
    return step, flat


def cvodes(form: Formulation, method: MultipleShooting, places: list[float]) -> Any:
    """Return the function (x, w, d, _, T, p) -> (states at ``places``, side by side, cost), integrated by CVODES."""
    sym = form.sym
    nw = n_controls_of(form, method)
    x, place, q = sym("x", form.nx), sym("place"), sym("q", nw + 3 + form.np)
    w, s, h, horizon, p = (q[:nw], q[nw], q[nw + 1], q[nw + 2], q[nw + 3 :])
    function = form.function("f", [form.f, form.running], ["f", "running"])
    rate, cost = function(x, control_at(form, method, w, place), (s + h * place) * horizon, horizon, p)
    dae = {"x": x, "t": place, "p": q, "ode": h * horizon * rate, "quad": h * horizon * cost}
    integrate = integrator("cvodes", dae, places, smooth=False)
    x, w, d, i = ca.MX.sym("x", form.nx), ca.MX.sym("w", nw), ca.MX.sym("d", 2), ca.MX.sym("i")
    horizon, p = ca.MX.sym("T"), ca.MX.sym("p", form.np)
    result = integrate(x0=x, p=ca.vertcat(w, d, horizon, p))
    return ca.Function("step", [x, w, d, i, horizon, p], [result["xf"], result["qf"]])


def dense_function(form: Formulation, method: MultipleShooting) -> Any:
    """Return the function ([x; w], d, T, p) -> states at the THIRDS of each step, by cubic Hermite interpolation."""
    v, d = ca.MX.sym("v", form.nx + n_controls_of(form, method)), ca.MX.sym("d", 2)
    x, w = v[: form.nx], v[form.nx :]
    horizon, p = ca.MX.sym("T"), ca.MX.sym("p", form.np)
    if method.integrator == "cvodes":
        places = (np.arange(1, method.steps + 1) / method.steps).tolist()
        knots = [x, *ca.horzsplit(cvodes(form, method, places)(x, w, d, 0, horizon, p)[0])]
    else:
        step, knots = step_function(form, method)[0], [x]
        for i in range(method.steps):
            knots.append(step(knots[-1], w, d, i, horizon, p)[0])
    rate = form.function("rate", [form.f], ["f"])
    h = d[1] * horizon / method.steps
    slopes = []
    for i, state in enumerate(knots):
        place = i / method.steps
        time = (d[0] + d[1] * place) * horizon
        slopes.append(h * rate(state, control_at(form, method, w, place), time, horizon, p))
    curves = []
    for a, b, da, db in zip(knots[:-1], knots[1:], slopes[:-1], slopes[1:], strict=True):
        for s in THIRDS:
            curves.append(
                (1 + 2 * s) * (1 - s) ** 2 * a + s * (1 - s) ** 2 * da + s**2 * (3 - 2 * s) * b - s**2 * (1 - s) * db
            )
    return ca.Function("dense", [v, d, horizon, p], [ca.horzcat(*curves)])
