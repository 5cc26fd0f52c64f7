"""Direct collocation: states are polynomials on every interval that satisfy the dynamics at the collocation points.

The last Radau point is the end of the interval (order 2d - 1, stiffly accurate); Legendre points are interior (order
2d). Hairer, Wanner, Solving Ordinary Differential Equations II, section IV.5. The costates are the multipliers of the
collocation equations divided by the quadrature weights; with them the Hamiltonian is stationary at every point.
"""

from __future__ import annotations

from dataclasses import dataclass

import casadi as ca
import numpy as np

from ocp.curves import differentiation_matrix, lagrange, quadrature_weights
from ocp.direct.assembly import Block, Interpolants, Transcription
from ocp.direct.prepared import DirectMethod
from ocp.direct.transcription import TranscriptionBuilder
from ocp.errors import require
from ocp.problem.formulation import Formulation

__all__ = ["Collocation"]


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
        return transcribe(self, form, staged)


def transcribe(method: Collocation, form: Formulation, staged: bool) -> Transcription:
    """Transcribe a problem by collocation."""
    d, nx, nu = method.degree, form.nx, form.nu
    radau, piecewise_constant = method.scheme == "radau", method.control == "held"
    mesh = method.fractions
    n, width = len(mesh) - 1, np.diff(mesh)
    stages = np.arange(n)
    points = np.array(ca.collocation_points(d, method.scheme))
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
    dynamics = build.rows(tuple(f"dynamics of {name}" for name in form.state_labels), None, stage_of, at)
    derivative = differentiation_matrix(nodes)[1:]
    for i in range(d + 1):
        build.linear(dynamics, np.repeat(states[:, i], d, axis=0).T, np.tile(derivative[:, i], n)[None, :])
    at_points = np.ones(len(form.path), dtype=bool)
    if piecewise_constant:  # with a piecewise constant control an equality is imposed once per interval
        at_points = ~form.path.equality
    rows = form.path.select(at_points)
    index = build.rows(rows.labels, rows.bounds, stage_of, at)
    at_point = build.point(
        states[:, 1:].reshape(n * d, nx).T,
        (np.repeat(controls[:, 0], d, axis=0) if piecewise_constant else controls.reshape(n * d, nu)).T,
        stage_of,
    )
    numbers = np.vstack([form.point_data(at), np.repeat(width, d), np.outer(width, weights).ravel()])
    data = form.sym("d", len(numbers))  # fraction and signals, width, weight
    function = form.point_function(
        "point", data, data[-1] * form.T * form.running, ca.vertcat(-data[-2] * form.T * form.f, rows.expression)
    )
    build.blocks.append(Block(function, at_point, numbers, np.vstack([dynamics, index])))

    # the other places of the path constraints
    without_control = ~form.path.uses_control
    nearest = np.concatenate([controls[:, 0], controls[-1:, 0]]).T  # arbitrary controls, for rows without controls
    if piecewise_constant:
        start = controls[:, 0].T
        build.path_rows(form.path.select(~without_control), layout.node[:, :-1], start, stages, at=mesh[:-1])
        build.node_rows(form.path.select(without_control & form.path.equality), nearest)
        if not radau:
            build.path_rows(
                form.path.select(~without_control & ~form.path.equality), layout.node_end, start, stages, at=mesh[1:]
            )
    inequality = form.path.select(without_control & ~form.path.equality)
    build.node_rows(inequality, nearest, first_only=radau)
    if not piecewise_constant:
        build.node_rows(form.path.select(without_control & form.path.equality), nearest, first_only=True)

    # the end of the interval, where it is not a point
    at_one = lagrange(nodes, np.array([1.0]))[0]
    continuity = dynamics[:, :0]
    if not radau:
        continuity = build.rows(tuple(f"continuity of {name}" for name in form.state_labels), None, stages, mesh[1:])
        build.linear(continuity, layout.node_end, 1.0)
        for i in range(d + 1):
            build.linear(continuity, states[:, i].T, -at_one[i])

    ends = (lagrange(samples, np.array([0.0]))[0], lagrange(samples, np.array([1.0]))[0])
    build.ends(ends, controls[0], controls[-1], at_nodes=False)

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
    costate_nodes = report[0] + (report[1] == 1.0)
    return build.finish(
        report,
        report_states,
        costate_rows,
        costate_nodes=costate_nodes,
        costate_scale=costate_scale,
        interpolants=interpolants,
    )
