"""The assembled derivatives against casadi's own, on random points of many kinds of program."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import casadi as ca
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ocp import Collocation, MultipleShooting, Problem
from ocp.curves import differentiation_matrix, lagrange
from ocp.direct.assembly import Program, assemble
from ocp.problem.formulation import Formulation
from tests.ocp.problems import EVERY_METHOD, METHODS, Array, Method, plant, swing, van_der_pol

KINDS: dict[str, Callable[[Any], Problem]] = {
    "swing": lambda symbols: swing(symbols),
    "swing with tied controls": lambda symbols: swing(symbols, control_ties=True),
    "fixed horizon by a parameter": lambda symbols: scheduled(symbols),
    "no control": lambda symbols: drifting(symbols),
}
ONE_INTERVAL: dict[str, Method] = {
    "radau 1": Collocation(1, 2),
    "legendre 1 of degree 1": Collocation(1, 1, "legendre"),
    "held 1": Collocation(1, 3, control="held"),
    "shooting 1": MultipleShooting(1),
    "linear 1": MultipleShooting(1, control="linear", steps=2),
}


def scheduled(symbols: Any) -> Problem:
    """A fixed horizon, bounds and ends by parameters, time in everything."""
    problem = Problem("scheduled", symbols)
    p = problem.parameter("p", 2)
    x = problem.state("x", 2, initial=ca.vertcat(p[0], 0.0), terminal=[np.nan, 0.0], upper=p[1] + 9)
    u = problem.control("u", lower=-p[1] - 20, upper=20)
    problem.horizon(1 + p[1] ** 2)
    problem.dynamics(x, ca.vertcat(ca.sin(x[1]) * problem.time, u * p[0] + x[0] ** 2))
    problem.path("wall", x[0] * u + problem.time**2, lower=-50 - p[0], upper=50.0)
    problem.end("last", x[0] * u, upper=100.0)
    problem.start("first", x[1] ** 2 + u, upper=30.0)
    problem.minimize(running=(u * problem.time) ** 2 + x[0] ** 3, terminal=x[0] * problem.at_start(x)[1] * p[1])
    return problem


def drifting(symbols: Any) -> Problem:
    """One state, no control, a free time."""
    problem = Problem("drifting", symbols)
    p = problem.parameter("p", 2)
    x = problem.state("x", initial=1.0)
    horizon = problem.horizon(lower=0.1, upper=4.0, guess=1.0)
    problem.dynamics(x, -p[0] * x**2 + p[1])
    problem.minimize(running=x**2, terminal=(x - 0.5) ** 2 + 0.01 * horizon)
    return problem


def casadis_own(program: Program) -> ca.Function:
    """(x, p, sigma, lambda) -> f, g, gradient, Jacobian, upper half of the Hessian, all by casadi."""
    nlp = program.nlp
    sigma, lam = ca.MX.sym("sigma"), ca.MX.sym("lam", nlp["g"].numel())
    lagrangian = sigma * nlp["f"] + ca.dot(lam, nlp["g"])
    outputs = [
        nlp["f"],
        nlp["g"],
        ca.gradient(nlp["f"], nlp["x"]),
        ca.jacobian(nlp["g"], nlp["x"]),
        ca.triu(ca.hessian(lagrangian, nlp["x"])[0]),
    ]
    return ca.Function("own", [nlp["x"], nlp["p"], sigma, lam], outputs)


def assert_derivatives_agree(program: Program, seed: int) -> None:
    rng = np.random.default_rng(seed)
    n, m, n_p = (program.nlp[key].numel() for key in ("x", "g", "p"))
    own = casadis_own(program)
    for _ in range(3):
        x, p = rng.uniform(0.3, 1.7, n), rng.uniform(0.3, 1.7, n_p)
        sigma, lam = rng.normal(), rng.normal(size=m)
        f, g, gradient, jacobian, hessian = (np.asarray(out.full()) for out in own(x, p, sigma, lam))
        ours = [*program.gradient(x, p), *program.jacobian(x, p), program.hessian(x, p, sigma, lam)]
        for name, mine, theirs in zip(
            ("f", "gradient", "g", "jacobian", "hessian"), ours, (f, gradient, g, jacobian, hessian), strict=True
        ):
            scale = max(1.0, float(np.abs(theirs).max(initial=0.0)))
            np.testing.assert_allclose(np.asarray(mine.full()), theirs, atol=1e-10 * scale, rtol=0, err_msg=name)
        assert program.hessian.sparsity_out(0).is_triu()


def takes(method: Method, kind: str, staged: bool) -> bool:
    """Return whether the layout supports the problem: a staged one needs node controls at the end."""
    at_nodes = isinstance(method, MultipleShooting) and method.control == "linear"
    return at_nodes or not staged or kind not in ("swing with tied controls", "fixed horizon by a parameter")


CASES = [
    pytest.param(kind, method, staged, id=f"{kind}: {name}{' staged' if staged else ''}")
    for kind in KINDS
    for name, method in {**METHODS, **ONE_INTERVAL}.items()
    for staged in (False, True)
    if takes(method, kind, staged)
]


@pytest.mark.parametrize("symbols", [ca.SX, ca.MX], ids=["SX", "MX"])
@pytest.mark.parametrize(("kind", "method", "staged"), CASES)
def test_assembled_derivatives_are_casadis_own(symbols: Any, kind: str, method: Method, staged: bool) -> None:
    form = Formulation(KINDS[kind](symbols))
    assert_derivatives_agree(assemble(method.transcribe(form, staged=staged), form.np), seed=method.intervals)


@given(
    intervals=st.integers(1, 4),
    degree=st.integers(1, 4),
    scheme=st.sampled_from(["radau", "legendre"]),
    control=st.sampled_from(["points", "held"]),
    seed=st.integers(0, 2**32 - 1),
)
@settings(max_examples=15)
def test_derivatives_agree_on_random_meshes(intervals: int, degree: int, scheme: str, control: str, seed: int) -> None:
    cuts = np.sort(np.random.default_rng(seed).uniform(0.05, 0.95, intervals - 1))
    method = Collocation(intervals, degree, scheme, control, (0.0, *cuts.tolist(), 1.0))
    form = Formulation(swing(control_ties=True))
    assert_derivatives_agree(assemble(method.transcribe(form), form.np), seed)


@pytest.mark.parametrize("method", EVERY_METHOD)
def test_jacobian_and_hessian_agree_with_finite_differences(method: str) -> None:
    """Independent of casadi's differentiation, and the only reference for the integrator inside cvodes shooting."""
    form = Formulation(van_der_pol(initial=None))
    program = assemble(EVERY_METHOD[method].transcribe(form), 0)
    rng = np.random.default_rng(3)
    n, m = program.nlp["x"].numel(), program.nlp["g"].numel()
    x, lam, direction, step = rng.uniform(0.3, 1.2, n), rng.normal(size=m), rng.normal(size=n), 1e-5
    f_plus, g_plus = program.values(x + step * direction, [])
    f_minus, g_minus = program.values(x - step * direction, [])
    gradient, jacobian = program.gradient(x, [])[1].full().ravel(), program.jacobian(x, [])[1].full()
    assert gradient @ direction == pytest.approx(float(f_plus - f_minus) / (2 * step), rel=1e-5, abs=1e-6)
    slope = (g_plus - g_minus).full().ravel() / (2 * step)
    np.testing.assert_allclose(jacobian @ direction, slope, rtol=1e-5, atol=1e-6)

    def lagrangian_gradient(at: Array) -> Array:
        rows = program.jacobian(at, [])[1].full()
        return np.asarray(0.7 * program.gradient(at, [])[1].full().ravel() + rows.T @ lam)

    upper = program.hessian(x, [], 0.7, lam).full()
    hessian = upper + np.triu(upper, 1).T
    change = (lagrangian_gradient(x + step * direction) - lagrangian_gradient(x - step * direction)) / (2 * step)
    np.testing.assert_allclose(hessian @ direction, change, rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("scheme", ["radau", "legendre"])
@pytest.mark.parametrize("control", ["points", "held"])
def test_collocation_rows_are_the_textbook_equations(scheme: str, control: str) -> None:
    """At random variables: sum_i l_i'(tau_j) x_i = h T f(x_j, u_j, t_j), with the quadrature of the running cost."""
    degree, mesh = 3, np.array([0.0, 0.3, 1.0])
    problem, x, u = plant("anything", size=2, horizon=None)
    p = problem.parameter("p")
    horizon = problem.horizon(lower=0.1, upper=9.0)
    problem.dynamics(x, ca.vertcat(x[1] * ca.cos(u) + problem.time, p * x[0] - u**2 / horizon))
    problem.minimize(running=x[0] ** 2 + u * problem.time, terminal=horizon * x[1])
    transcription = Collocation(2, degree, scheme, control, tuple(mesh.tolist())).transcribe(Formulation(problem))
    rng = np.random.default_rng(7)
    values, parameter = rng.normal(size=transcription.size), 0.7
    assert transcription.horizon is not None
    total = float(values[transcription.horizon])
    cost, rows = (np.asarray(v.full()).ravel() for v in assemble(transcription, 1).values(values, [parameter]))

    states, controls = transcription.interpolants(values, np.array([parameter]), total)
    points = np.array(ca.collocation_points(degree, scheme))
    nodes = np.concatenate([[0.0], points])
    gauss, weight = np.polynomial.legendre.leggauss(degree)
    weights = 0.5 * weight @ lagrange(points, 0.5 * (gauss + 1))
    expected_cost, equations, joints = total * values[transcription.end[1]], [], []
    for k, h in enumerate(np.diff(mesh)):
        y = states.values[k]
        w = controls.values[k, :, 0] if control == "points" else np.repeat(controls.values[k, 0, 0], degree)
        t = (mesh[k] + h * points) * total
        rate = np.column_stack([y[1:, 1] * np.cos(w) + t, parameter * y[1:, 0] - w**2 / total])
        equations.append(differentiation_matrix(nodes)[1:] @ y - h * total * rate)
        expected_cost += h * total * weights @ (y[1:, 0] ** 2 + w * t)
        joints.append(values[transcription.nodes[:, k + 1]] - lagrange(nodes, np.array([1.0]))[0] @ y)
    labels = np.array([label.split()[0] for label in transcription.row_labels])
    np.testing.assert_allclose(rows[labels == "dynamics"], np.ravel(equations), atol=1e-12)
    np.testing.assert_allclose(rows[labels == "continuity"], np.ravel(joints)[: 4 * (scheme == "legendre")], atol=1e-12)
    assert cost[0] == pytest.approx(expected_cost, rel=1e-12)
