"""Discretisation of optimal control problems: direct collocation and direct multiple shooting.

Collocation: states are polynomials on every interval that satisfy the dynamics at the collocation points. The last
Radau point is the end of the interval (order 2d - 1, stiffly accurate); Legendre points are interior (order 2d), see
Hairer, Wanner, Solving Ordinary Differential Equations II, section IV.5. The costates are the multipliers of the
collocation equations divided by the quadrature weights; with them the Hamiltonian is stationary at every point.

Multiple shooting: every interval is integrated from its own start, and its end must meet the next start (Bock, Plitt
1984). The multipliers of these continuity conditions are the costates at the nodes.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np

from ocp.curves import differentiation_matrix, integrator, lagrange, quadrature_weights, rk4_step
from ocp.direct.assembly import SIZES, Block, Interpolants, Transcription
from ocp.direct.prepared import DirectMethod
from ocp.direct.transcription import TranscriptionBuilder
from ocp.errors import require
from ocp.problem.formulation import Formulation
from ocp.problem.values import symbols_of

THIRDS = np.linspace(0.0, 1.0, 4)  # nodes of a cubic polynomial: relative positions 0, 1/3, 2/3, 1


@dataclass(frozen=True)
class Collocation(DirectMethod):
    """Direct collocation on a mesh of intervals.

    Attributes:
        intervals: Number of intervals.
        degree: Degree of the state polynomials and number of collocation points per interval, 1 to 9.
        scheme: ``radau`` or ``legendre``.
        control: ``points`` (a free value at every collocation point: polynomials of degree - 1, which may overshoot
            bounds between points where the control switches) or ``held`` (one value per interval).
        mesh: Ends of the intervals as fractions 0..1, N + 1 of them; None for equal intervals.

    Raises:
        ProblemError: For a value outside these.
    """

    intervals: int
    degree: int = 3
    scheme: str = "radau"
    control: str = "points"
    mesh: tuple[float, ...] | None = None

    def __post_init__(self) -> None:
        self._check_mesh("degree", largest=9)
        require.choice("Collocation: scheme", self.scheme, ("radau", "legendre"))
        require.choice("Collocation: control", self.control, ("points", "held"))

    @property
    def order(self) -> int:
        return self.degree + 1

    @property
    def control_order(self) -> int:
        return 1 if self.control == "held" else self.degree

    def transcribe(self, form: Formulation, *, staged: bool = False) -> Transcription:
        d, nx, nu = self.degree, form.nx, form.nu
        radau, piecewise_constant = self.scheme == "radau", self.control == "held"
        mesh = self.fractions
        n, width = len(mesh) - 1, np.diff(mesh)
        stages = np.arange(n)
        points = np.array(ca.collocation_points(d, self.scheme))
        nodes = np.concatenate([[0.0], points])  # places of the state values in an interval
        samples = np.array([0.5]) if piecewise_constant else points  # places of the control values
        weights = quadrature_weights(points)
        n_inner = d - 1 if radau else d  # Radau's last point is the end of the interval

        build = TranscriptionBuilder(form, mesh, 0, n_inner * nx + len(samples) * nu, staged)
        layout = build.layout
        point_at = mesh[:-1, None] + width[:, None] * points  # fractions of the points, (n, d)
        control_at = mesh[:-1, None] + width[:, None] * samples

        # variables: states[k, j, i], entry i at place j of interval k, and controls[k, j, i]
        inside = layout.interval[: n_inner * nx].T.reshape(n, n_inner, nx)
        end = layout.node_end.T.reshape(n, 1, nx)
        states = np.concatenate([layout.node[:, :-1].T.reshape(n, 1, nx), inside, *([end] if radau else [])], axis=1)
        controls = layout.interval[n_inner * nx :].T.reshape(n, len(samples), nu)
        for j in range(n_inner):
            build.variables("state", states[:, j + 1].T, point_at[:, j], "state")
        for j in range(len(samples)):
            build.variables("control", controls[:, j].T, control_at[:, j], "control")

        # the dynamics at every point: sum_i l_i'(tau_j) X_i - h T f(X_j, u_j, t_j) = 0
        stage_of, at = np.repeat(stages, d), point_at.ravel()
        dynamics = build.state_rows("dynamics", stage_of, at)
        derivative = differentiation_matrix(nodes)[1:]
        for i in range(d + 1):
            build.linear(dynamics, np.repeat(states[:, i], d, axis=0).T, np.tile(derivative[:, i], n)[None, :])
        path, equality, with_control = form.path, form.path.equality, form.path.uses_control
        # with a piecewise constant control an equality is imposed once per interval
        rows = path.select(~equality | (not piecewise_constant))
        index = build.rows(rows.labels, rows.bounds, stage_of, at)
        at_controls = np.repeat(controls[:, 0], d, axis=0) if piecewise_constant else controls.reshape(n * d, nu)
        at_point = build.point(states[:, 1:].reshape(n * d, nx).T, at_controls.T, stage_of)
        numbers = np.vstack([form.point_data(at), np.repeat(width, d), np.outer(width, weights).ravel()])
        data = form.sym("d", len(numbers))  # fraction and signals, width, weight
        residuals = ca.vertcat(-data[-2] * form.T * form.f, rows.expression)
        function = form.point_function("point", data, data[-1] * form.T * form.running, residuals)
        build.blocks.append(Block(function, at_point, numbers, np.vstack([dynamics, index])))

        # the other places of the path constraints
        nearest = np.concatenate([controls[:, 0], controls[-1:, 0]]).T  # arbitrary controls, for rows without controls
        if piecewise_constant:
            start = controls[:, 0].T
            build.path_rows(path.select(with_control), layout.node[:, :-1], start, stages, at=mesh[:-1])
            build.node_rows(path.select(~with_control & equality), nearest)
            if not radau:
                build.path_rows(path.select(with_control & ~equality), layout.node_end, start, stages, at=mesh[1:])
        build.node_rows(path.select(~with_control & ~equality), nearest, first_only=radau)
        if not piecewise_constant:
            build.node_rows(path.select(~with_control & equality), nearest, first_only=True)

        # the end of the interval, where it is not a point
        at_one = lagrange(nodes, np.array([1.0]))[0]
        continuity = dynamics[:, :0]
        if not radau:
            continuity = build.state_rows("continuity", stages, mesh[1:])
            build.linear(continuity, layout.node_end, 1.0)
            for i in range(d + 1):
                build.linear(continuity, states[:, i].T, -at_one[i])

        at_start, at_end = lagrange(samples, np.array([0.0, 1.0]))
        build.ends((controls[0], at_start), (controls[-1], at_end))

        # reported points: start, collocation points, and for Legendre the ends of intervals
        by_interval = dynamics.T.reshape(n, d, nx)
        scale = np.tile(-1.0 / weights, (n, 1))
        if radau:
            report = (np.concatenate([[0], stage_of]), np.concatenate([[0.0], np.tile(points, n)]))
            report_states = np.vstack([states[0, :1], states[:, 1:].reshape(-1, nx)])
            costate_rows = np.vstack([np.full((1, nx), -1), by_interval.reshape(-1, nx)])
            costate_rows[::d] = -1  # at nodes the value of the next interval is more accurate
            costate_scale = np.concatenate([[1.0], scale.ravel()])
        else:
            report = (np.concatenate([np.repeat(stages, d + 1), [n - 1]]), np.concatenate([np.tile(nodes, n), [1.0]]))
            report_states = np.vstack([states.reshape(-1, nx), layout.node[:, -1]])
            before = np.vstack([np.full((1, nx), -1), continuity.T[:-1]])[:, None, :]
            costate_rows = np.vstack([np.concatenate([before, by_interval], axis=1).reshape(-1, nx), continuity.T[-1:]])
            at_nodes = np.full((n, 1), -1.0)
            costate_scale = np.concatenate([np.hstack([at_nodes, scale]).ravel(), [-1.0]])

        by_point, by_sample = states.reshape(n, -1).T, controls.reshape(n, -1).T
        interpolants = Interpolants(mesh, nodes, by_point, mesh, samples, by_sample, np.zeros((0, n)))
        return build.finish(report, report_states, costate_rows, costate_scale=costate_scale, interpolants=interpolants)


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
        nx, nu = form.nx, form.nu
        mesh = self.fractions
        n, width = len(mesh) - 1, np.diff(mesh)
        stages = np.arange(n)
        linear = self.control == "linear"
        build = TranscriptionBuilder(form, mesh, nu if linear else 0, 0 if linear else nu, staged)
        layout = build.layout
        first, last = layout.node[:nx, :-1], layout.node_end[:nx]
        if linear:
            # at both ends of every interval, (2, nu, n)
            controls = np.stack([layout.node[nx:, :-1], layout.node_end[nx:]])
            at_nodes = layout.node[nx:]
        else:
            build.variables("control", layout.interval, mesh[:-1] + 0.5 * width, "control")
            controls = layout.interval[None]
            at_nodes = np.column_stack([layout.interval, layout.interval[:, -1]])

        # the end of every interval: x_end - F(x, u) = 0
        rows = build.state_rows("continuity", stages, mesh[1:])
        build.linear(rows, last, 1.0)
        variables = build.point(first, controls.reshape(-1, n), stages)
        data = np.vstack([mesh[:-1], width])
        build.blocks.append(Block(interval_function(form, self), variables, data, rows))

        # path constraints: at both ends of an interval where they contain a control, else at the nodes
        path, with_control = form.path, form.path.uses_control
        if linear:
            build.node_rows(path, at_nodes)
        else:
            build.path_rows(path.select(with_control), first, layout.interval, stages, at=mesh[:-1])
            build.path_rows(path.select(with_control & ~path.equality), last, layout.interval, stages, at=mesh[1:])
            build.node_rows(path.select(~with_control), at_nodes)
        build.ends((at_nodes[:, :1].T, np.ones(1)), (at_nodes[:, -1:].T, np.ones(1)))

        report = (np.concatenate([stages, [n - 1]]), np.concatenate([np.zeros(n), [1.0]]))
        costate_rows = np.vstack([np.full((1, nx), -1), rows.T])
        costate_scale = np.concatenate([[1.0], np.full(n, -1.0)])
        breaks = np.append((mesh[:-1, None] + width[:, None] * np.arange(self.steps) / self.steps).ravel(), 1.0)
        inputs, control_nodes = np.vstack([first, *controls]), np.array([0.0, 1.0] if linear else [0.5])
        dense = dense_function(form, self)
        interpolants = Interpolants(breaks, THIRDS, inputs, mesh, control_nodes, np.vstack([*controls]), data, dense)
        return build.finish(
            report, layout.node[:nx].T, costate_rows, costate_scale=costate_scale, interpolants=interpolants
        )


# ---- integration of one interval -----------------------------------------------------------------------------


def control_at(form: Formulation, method: MultipleShooting, w: Any, place: Any) -> Any:
    """Return the control at a relative position 0..1 of an interval, from the interval's control variables ``w``."""
    if method.control == "held":
        return w
    return (1 - place) * w[: form.nu] + place * w[form.nu :]


def interval_function(form: Formulation, method: MultipleShooting) -> Any:
    """Return the casadi Function that integrates dynamics and running cost over one interval of multiple shooting.

    Its values are the running cost and minus the end state. It is the function of a :class:`Block` with variables v,
    data d (start and width of the interval) and parameters p.
    """
    nw = form.nu * method.control_order
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
    """Return the casadi Function of one integration step, and whether the step is to be inlined as an SX function.

    It maps (x, w, d, step number, T, p) to the next state and the running cost of the step. Its arguments are state,
    control variables, start and width of the interval as fractions of the horizon, step number, horizon and parameters.
    """
    if method.integrator == "cvodes":
        return cvodes(form, method, [1.0]), False
    function = form.function("f", [form.f, form.running], ["f", "running"])
    sym = symbols_of(function).sym  # MX if the dynamics need signals
    x, w, d, i = sym("x", form.nx), sym("w", form.nu * method.control_order), sym("d", 2), sym("i")
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
    """Return the casadi Function that integrates dynamics and running cost over one mesh interval by CVODES.

    The arguments are those of :func:`step_function`; the step number is not used. The states are those at ``places``
    (0..1) of the interval, side by side.
    """
    sym = form.sym
    nw = form.nu * method.control_order
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
    """Return the casadi Function that computes states inside a mesh interval by cubic Hermite interpolation.

    It maps ([x; w], d, T, p), as in :func:`step_function`, to the states at the `THIRDS` of each integration step.
    """
    v, d = ca.MX.sym("v", form.nx + form.nu * method.control_order), ca.MX.sym("d", 2)
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
    curves = [
        (1 + 2 * s) * (1 - s) ** 2 * a + s * (1 - s) ** 2 * da + s**2 * (3 - 2 * s) * b - s**2 * (1 - s) * db
        for a, b, da, db in zip(knots[:-1], knots[1:], slopes[:-1], slopes[1:], strict=True)
        for s in THIRDS
    ]
    return ca.Function("dense", [v, d, horizon, p], [ca.horzcat(*curves)])
