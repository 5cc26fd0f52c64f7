"""Direct collocation: orders of convergence, exactness, and where constraints are imposed."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import casadi as ca
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ocp import Collocation, Problem, ProblemError, Solution, solve
from ocp.curves import quadrature_weights
from ocp.problem.formulation import Formulation
from tests.ocp.problems import (
    Array,
    LogarithmicRegulator,
    double_integrator,
    energy,
    order,
    plant,
    relative,
    van_der_pol,
)

TIGHT = {"tol": 1e-13, "constr_viol_tol": 1e-13, "dual_inf_tol": 1e-11}
# degree: horizon and meshes on which the error is asymptotic and far above rounding
MESHES = {1: (1.0, (16, 24, 32, 48)), 2: (1.0, (8, 12, 16, 24)), 3: (2.0, (8, 10, 12, 16)), 4: (3.0, (8, 10, 12, 16))}
ORDER: dict[str, Callable[[int], int]] = {"radau": lambda d: 2 * d - 1, "legendre": lambda d: 2 * d}
SCHEMES = tuple(ORDER)


@pytest.mark.parametrize("scheme", SCHEMES)
@pytest.mark.parametrize("degree", MESHES)
def test_order_of_convergence_of_cost_end_state_and_costate(scheme: str, degree: int) -> None:
    horizon, meshes = MESHES[degree]
    exact = LogarithmicRegulator(horizon)
    errors = []
    for n in meshes:
        solution = solve(exact.build(), Collocation(n, degree, scheme), options=TIGHT)
        end, first = solution["y"][-1, 0], solution.costate("y")[0, 0]
        errors.append([solution.cost - exact.cost, end - exact.state(horizon), first - exact.costate(0.0)])
    widths = 1.0 / np.array(meshes)
    for name, error in zip(("cost", "end state", "costate"), np.abs(errors).T, strict=True):
        assert error.min() > 5e-13, name  # rounding does not speak here
        assert order(widths, error) == pytest.approx(ORDER[scheme](degree), abs=0.3), name


@pytest.mark.parametrize("scheme", SCHEMES)
def test_order_of_convergence_of_cost_at_degree_five(scheme: str) -> None:
    exact = LogarithmicRegulator(4.0)
    meshes = (6, 7, 8, 9)
    errors = [abs(solve(exact.build(), Collocation(n, 5, scheme), options=TIGHT).cost - exact.cost) for n in meshes]
    assert order(1.0 / np.array(meshes), np.array(errors)) == pytest.approx(ORDER[scheme](5), abs=0.6)


@pytest.mark.parametrize("scheme", SCHEMES)
def test_held_control_costs_second_order(scheme: str) -> None:
    exact = LogarithmicRegulator()
    meshes = (8, 12, 16, 24)
    errors = [solve(exact.build(), Collocation(n, 3, scheme, "held")).cost - exact.cost for n in meshes]
    assert min(errors) > 0  # held controls are admissible, so they can only cost more
    assert order(1.0 / np.array(meshes), np.array(errors)) == pytest.approx(2.0, abs=0.05)


@pytest.mark.parametrize("scheme", SCHEMES)
def test_piecewise_constant_controls_of_the_double_integrator_have_their_exact_cost(scheme: str) -> None:
    """The best N held controls cost 6 N^2 / (N^2 - 1)."""
    for n in (2, 3, 7):
        cost = solve(energy(), Collocation(n, 3, scheme, "held")).cost
        assert cost == pytest.approx(6 * n**2 / (n**2 - 1), abs=1e-9)


@pytest.mark.parametrize("scheme", SCHEMES)
@pytest.mark.parametrize("degree", range(3, 10))
def test_polynomial_optimum_is_reproduced_exactly(scheme: str, degree: int) -> None:
    """q is a cubic, v a quadratic, u a line: every degree from 3 holds them, on one interval or on uneven ones."""
    for method in (Collocation(1, degree, scheme), Collocation(3, degree, scheme, mesh=(0.0, 0.1, 0.7, 1.0))):
        solution = solve(energy(), method)
        t = solution.t
        assert solution.cost == pytest.approx(6.0, abs=1e-9)
        np.testing.assert_allclose(solution["q"][:, 0], 3 * t**2 - 2 * t**3, atol=1e-9)
        np.testing.assert_allclose(solution["v"][:, 0], 6 * t - 6 * t**2, atol=1e-9)
        np.testing.assert_allclose(solution["u"][:, 0], 6 - 12 * t, atol=1e-7)
        np.testing.assert_allclose(solution.costate("q")[:, 0], -12.0, atol=1e-7)
        np.testing.assert_allclose(solution.costate("v")[:, 0], 12 * t - 6, atol=1e-7)


@pytest.mark.parametrize("scheme", SCHEMES)
@pytest.mark.parametrize("degree", range(1, 10))
def test_quadrature_weights_integrate_polynomials_of_the_highest_degree(scheme: str, degree: int) -> None:
    points = np.array(ca.collocation_points(degree, scheme))
    weights = quadrature_weights(points)
    exact = 2 * degree - (2 if scheme == "radau" else 1)
    for power in range(exact + 1):
        assert weights @ points**power == pytest.approx(1.0 / (power + 1), abs=1e-13)
    assert abs(weights @ points ** (exact + 1) - 1.0 / (exact + 2)) > 1e-13


@pytest.mark.parametrize("scheme", SCHEMES)
@pytest.mark.parametrize("control", ["points", "held"])
@given(
    degree=st.integers(1, 6),
    steps=st.lists(st.floats(0.2, 5.0), min_size=1, max_size=5),
    time_scale=st.floats(0.1, 50.0),
)
@settings(max_examples=15)
def test_states_obey_the_dynamics_at_every_collocation_point(
    scheme: str, control: str, degree: int, steps: list[float], time_scale: float
) -> None:
    """On any mesh the derivative of the state polynomial equals f at the points, and the pieces join."""
    mesh = np.concatenate([[0.0], np.cumsum(steps)[:-1] / np.sum(steps), [1.0]])
    problem, x, u = plant("linear", size=2, initial=[1.0, -0.5], horizon=time_scale)
    problem.dynamics(x, ca.vertcat(x[1], -x[0] - 0.3 * x[1] + u + 0.2 * problem.time / time_scale) / time_scale)
    problem.minimize(running=ca.sumsqr(x) + u**2)
    method = Collocation(len(steps), degree, scheme, control, tuple(mesh.tolist()))
    solution = solve(problem, method)

    interpolant = solution.state_interpolant
    points = np.array(ca.collocation_points(degree, scheme))
    segment, place = np.repeat(np.arange(len(steps)), degree), np.tile(points, len(steps))
    x_at, slopes = interpolant.within(segment, place), slope(solution, mesh, points)
    t = (mesh[:-1, None] + np.diff(mesh)[:, None] * points).ravel() * time_scale
    u_at = solution.control_interpolant.within(segment, place)[:, 0]
    pull = -x_at[:, 0] - 0.3 * x_at[:, 1] + u_at + 0.2 * t / time_scale
    expected = np.column_stack([x_at[:, 1], pull])  # over the fraction, the horizon cancels the time scale
    np.testing.assert_allclose(slopes, expected, atol=1e-6 * max(1.0, float(np.abs(expected).max())))
    inner = np.arange(len(steps) - 1)
    left, right = interpolant.within(inner, np.ones(len(inner))), interpolant.within(inner + 1, np.zeros(len(inner)))
    np.testing.assert_allclose(left, right, atol=1e-8)


def slope(solution: Solution, mesh: Array, points: Array) -> Array:
    """Derivatives over the fraction of the state polynomials at the points, by fitting them in monomials."""
    interpolant = solution.state_interpolant
    rows = []
    for k in range(len(mesh) - 1):
        for j in range(len(points)):
            columns = [
                np.polynomial.Polynomial.fit(interpolant.nodes, interpolant.values[k, :, i], len(interpolant.nodes) - 1)
                for i in range(interpolant.values.shape[2])
            ]
            rows.append([float(p.deriv()(points[j])) / (mesh[k + 1] - mesh[k]) for p in columns])
    return np.array(rows)


# ---- where constraints are imposed ---------------------------------------------------------------------------


def imposed(method: Any, label: str, problem: Problem, *, staged: bool = False) -> Array:
    """Fractions of the horizon at which a constraint has a row, sorted."""
    transcription = method.transcribe(Formulation(problem), staged=staged)
    at = [s for name, s in zip(transcription.row_labels, transcription.row_fractions, strict=True) if name == label]
    return np.sort(np.array(at))


def constrained(initial: Any = (1.0, 0.0)) -> Problem:
    """Path rows of every kind: with and without control, equality and inequality."""
    problem = van_der_pol(initial=initial)
    x, u = problem.declared.states["x"].symbol, problem.declared.controls["u"].symbol
    slack = problem.control("slack", 2)
    problem.path("mixed", x[0] + u, upper=5.0)
    problem.path("state", x[1], lower=-0.4)
    problem.path("tie", slack[0] - u - x[0], 0, 0)
    return problem


@pytest.mark.parametrize("staged", [False, True])
@pytest.mark.parametrize("scheme", SCHEMES)
@pytest.mark.parametrize("control", ["points", "held"])
@pytest.mark.parametrize("degree", [1, 2, 4])
def test_path_rows_stand_at_the_points_and_where_they_bind_between(
    scheme: str, control: str, degree: int, staged: bool
) -> None:
    n = 3
    mesh = np.linspace(0.0, 1.0, n + 1)
    points = (mesh[:-1, None] + np.diff(mesh)[:, None] * np.array(ca.collocation_points(degree, scheme))).ravel()
    method = Collocation(n, degree, scheme, control)
    expected = {
        # mixed rows: at the points; a held control meets other states at both ends of its interval
        "mixed": [points],
        # rows of states alone: at the points and the nodes, but not where the given start settles them
        "state": [points, [] if scheme == "radau" else mesh[1:]],
        "tie": [points],
    }
    if control == "held":
        expected["mixed"] += [mesh[:-1], [] if scheme == "radau" else mesh[1:]]
        expected["tie"] = [mesh[:-1]]  # a held control can meet an equality once an interval
    for label, places in expected.items():
        at = imposed(method, label, constrained(), staged=staged)
        np.testing.assert_allclose(at, np.sort(np.concatenate(places)), atol=1e-12, err_msg=label)
    loose = imposed(method, "state", constrained(initial=[np.nan, np.nan]), staged=staged)
    assert loose[0] == 0.0  # nothing settles a free start


@pytest.mark.parametrize("scheme", SCHEMES)
@pytest.mark.parametrize("control", ["points", "held"])
def test_active_path_constraints_are_kept_where_they_are_imposed(scheme: str, control: str) -> None:
    solution = solve(constrained(), Collocation(12, 3, scheme, control))
    free = solve(van_der_pol(), Collocation(12, 3, scheme, control))
    assert free["x"][:, 1].min() < -0.45  # the constraint binds
    assert solution["x"][:, 1].min() == pytest.approx(-0.4, abs=1e-7)
    tie = solution["slack"][:, 0] - solution["u"][:, 0] - solution["x"][:, 0]
    points = np.array(ca.collocation_points(3, scheme))
    mesh = np.linspace(0.0, 1.0, 13)
    fractions = (mesh[:-1, None] + np.diff(mesh)[:, None] * points).ravel()
    at = solution.t / solution.horizon
    is_point = np.array([np.min(np.abs(fractions - s)) < 1e-9 for s in at])
    if control == "points":
        np.testing.assert_allclose(tie[is_point & (at > 0)], 0.0, atol=1e-8)
    else:
        held = solution.control_interpolant.values[:, 0]
        starts = solution.state_interpolant(mesh[:-1])
        sampled = held[:, 1] - held[:, 0] - starts[:, 0]
        np.testing.assert_allclose(sampled, 0.0, atol=1e-8)


@pytest.mark.parametrize("scheme", SCHEMES)
def test_bounds_of_states_hold_at_every_reported_point(scheme: str) -> None:
    problem, _, _, u = double_integrator("bounded", (0.0, 1.0), (0.0, -1.0), ceiling=1 / 9)
    problem.minimize(running=u**2 / 2)
    solution = solve(problem, Collocation(12, 3, scheme))
    assert solution["q"].max() <= 1 / 9 + 1e-9
    assert solution["q"].max() == pytest.approx(1 / 9, abs=1e-6)


def test_radau_and_legendre_agree_on_a_fine_mesh() -> None:
    radau, legendre = (solve(van_der_pol(), Collocation(12, 4, scheme)) for scheme in SCHEMES)
    assert radau.cost == pytest.approx(legendre.cost, abs=1e-9)
    s = np.linspace(0.0, 1.0, 37)
    assert relative(radau.at_fraction(s)["x"], legendre.at_fraction(s)["x"]) < 1e-6


@pytest.mark.parametrize("scheme", SCHEMES)
def test_degree_may_be_a_numpy_integer_and_the_mesh_an_array(scheme: str) -> None:
    method = Collocation(np.int64(2), np.int64(3), scheme, mesh=np.array([0.0, 0.4, 1.0]))  # type: ignore[arg-type]
    assert solve(energy(), method).cost == pytest.approx(6.0, abs=1e-9)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((0,), "intervals must be a whole number, 1 to 1000000, not 0"),
        ((-3,), "intervals"),
        ((2.5,), "intervals"),
        (("4",), "intervals"),
        ((True,), "intervals"),
        ((None,), "intervals"),
        ((3, 0), "degree must be 1 to 9, not 0"),
        ((3, 10), "degree"),
        ((3, 2.0), "degree"),
        ((3, True), "degree"),
        ((3, None), "degree"),
        ((3, "3"), "degree"),
        ((3, 3, "lobatto"), "scheme must be 'radau' or 'legendre', not 'lobatto'"),
        ((3, 3, None), "scheme"),
        ((3, 3, "radau", "linear"), "control must be 'points' or 'held', not 'linear'"),
        ((2, 3, "radau", "points", (0.0, 1.0)), "mesh has 2 entries, 3 expected"),
        ((2, 3, "radau", "points", (0.0, 1.5, 1.0)), "mesh must increase from 0 to 1"),
        ((2, 3, "radau", "points", (0.0, 0.0, 1.0)), "mesh must increase"),
        ((2, 3, "radau", "points", (0.1, 0.5, 1.0)), "mesh must increase"),
        ((2, 3, "radau", "points", (0.0, 0.5, 2.0)), "mesh must increase"),
        ((2, 3, "radau", "points", (0.0, np.nan, 1.0)), "mesh must increase"),
        ((2, 3, "radau", "points", "abc"), "mesh"),
        ((2, 3, "radau", "points", (0.0, (0.2, 0.3), 1.0)), "mesh"),
    ],
)
def test_bad_settings_are_named(arguments: tuple[Any, ...], message: str) -> None:
    with pytest.raises(ProblemError, match=message):
        Collocation(*arguments)
