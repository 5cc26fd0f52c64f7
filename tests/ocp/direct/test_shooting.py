"""Multiple shooting: orders of convergence, the integrated rows, and where constraints are imposed."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import casadi as ca
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ocp import MultipleShooting, Problem, ProblemError, solve
from ocp.direct.assembly import assemble
from ocp.problem.formulation import Formulation
from tests.ocp.direct.test_collocation import constrained, imposed
from tests.ocp.problems import Array, LogarithmicRegulator, energy, order, plant, van_der_pol

CONTROLS = ("held", "linear")
TIGHT = {"tol": 1e-13, "constr_viol_tol": 1e-13, "dual_inf_tol": 1e-11}


def fading(horizon: float) -> Problem:
    """y' = -2 t y^2, y(0) = 1: y = 1/(1 + t^2), with integral arctan t. Time enters; there is no control."""
    problem = Problem("fading")
    y = problem.state("y", initial=1.0, guess=1.0)
    problem.dynamics(y, -2 * problem.time * y**2)
    problem.horizon(horizon)
    problem.minimize(running=y)
    return problem


@pytest.mark.parametrize("refined", ["intervals", "steps"])
def test_runge_kutta_is_of_fourth_order(refined: str) -> None:
    counts = np.array([8, 12, 16, 24])
    errors = []
    for n in counts:
        method = MultipleShooting(int(n)) if refined == "intervals" else MultipleShooting(2, steps=int(n))
        solution = solve(fading(2.0), method, options=TIGHT)
        errors.append([solution["y"][-1, 0] - 1 / 5, solution.cost - np.arctan(2.0)])
    for name, error in zip(("end state", "cost"), np.abs(errors).T, strict=True):
        assert error.min() > 1e-10, name
        assert order(1.0 / counts, error) == pytest.approx(4.0, abs=0.5), name


@pytest.mark.parametrize(("control", "expected"), [("held", 2), ("linear", 4)])
@pytest.mark.parametrize("steps", [1, 3])
def test_order_of_the_cost_is_that_of_the_control(control: str, expected: int, steps: int) -> None:
    exact = LogarithmicRegulator()
    counts = np.array([8, 12, 16, 24])
    errors = []
    for n in counts:
        method = MultipleShooting(int(n), steps=steps, control=control)
        errors.append(solve(exact.build(), method, options=TIGHT).cost - exact.cost)
    assert order(1.0 / counts, np.abs(errors)) == pytest.approx(expected, abs=0.1)
    assert control == "linear" or min(errors) > 0  # held controls are admissible, so they can only cost more


@pytest.mark.parametrize("control", CONTROLS)
def test_costates_of_shooting_converge(control: str) -> None:
    exact = LogarithmicRegulator()
    counts = np.array([8, 12, 16, 24])
    errors = []
    for n in counts:
        solution = solve(exact.build(), MultipleShooting(int(n), control=control), options=TIGHT)
        errors.append(np.abs(solution.costate("y")[:, 0] - exact.costate(solution.t)).max())
    assert order(1.0 / counts, np.array(errors)) > 1.8


@pytest.mark.parametrize("n", [2, 5, 50])
def test_piecewise_constant_controls_of_the_double_integrator_have_their_exact_cost(n: int) -> None:
    """The best N held controls cost 6 N^2 / (N^2 - 1)."""
    assert solve(energy(), MultipleShooting(n)).cost == pytest.approx(6 * n**2 / (n**2 - 1), abs=1e-9)


@pytest.mark.parametrize("control", CONTROLS)
def test_cvodes_integrates_to_its_tolerance(control: str) -> None:
    """What is left of the error belongs to the control: cvodes and many Runge-Kutta steps agree."""
    exact = LogarithmicRegulator()
    by_steps = solve(exact.build(), MultipleShooting(4, steps=40, control=control))
    by_cvodes = solve(exact.build(), MultipleShooting(4, integrator="cvodes", control=control))
    assert by_cvodes.cost == pytest.approx(by_steps.cost, abs=1e-8)
    np.testing.assert_allclose(by_cvodes["y"], by_steps["y"], atol=1e-7)
    np.testing.assert_allclose(by_cvodes.costate("y"), by_steps.costate("y"), atol=1e-7)


def test_cvodes_holds_stiff_dynamics_that_runge_kutta_cannot() -> None:
    """x' = -1e4 (x - cos t) - sin t, x(0) = 1: x = cos t."""
    problem = Problem("stiff")
    x = problem.state("x", initial=1.0)
    problem.dynamics(x, -1e4 * (x - ca.cos(problem.time)) - ca.sin(problem.time))
    problem.horizon(2.0)
    problem.minimize(running=x**2)
    solution = solve(problem, MultipleShooting(4, integrator="cvodes", steps=4))
    np.testing.assert_allclose(solution["x"][:, 0], np.cos(solution.t), atol=1e-8)
    assert solution.cost == pytest.approx(1.0 + np.sin(4.0) / 4, abs=1e-7)


@pytest.mark.parametrize("control", CONTROLS)
@pytest.mark.parametrize("free_horizon", [False, True])
@given(intervals=st.integers(1, 4), steps=st.integers(1, 3), seed=st.integers(0, 2**32 - 1), width=st.floats(0.2, 3.0))
@settings(max_examples=10)
def test_continuity_rows_are_runge_kutta_steps(
    control: str, free_horizon: bool, intervals: int, steps: int, seed: int, width: float
) -> None:
    """At random variables the rows and the cost equal the textbook method, written down here once more."""
    rng = np.random.default_rng(seed)
    problem, x, u = plant("anything", size=2, u={"size": 2}, horizon=None)
    p = problem.parameter("p")
    horizon = problem.horizon(lower=0.1, upper=9.0) if free_horizon else problem.horizon(width)
    problem.dynamics(x, ca.vertcat(x[1] * ca.cos(u[0]) + problem.time, p * x[0] - u[1] ** 2 / horizon))
    problem.minimize(running=x[0] ** 2 + u[0] * problem.time)

    mesh = np.concatenate([[0.0], np.sort(rng.uniform(0.05, 0.95, intervals - 1)), [1.0]])
    method = MultipleShooting(intervals, steps=steps, control=control, mesh=tuple(mesh.tolist()))
    form = Formulation(problem)
    transcription = method.transcribe(form)
    values, parameter = rng.normal(size=transcription.size), rng.normal()
    total = float(values[transcription.horizon]) if transcription.horizon is not None else width
    cost, rows = (np.asarray(v.full()).ravel() for v in assemble(transcription, 1).values(values, [parameter]))

    states = values[transcription.nodes].T  # (N + 1, 2)
    role, at = transcription.variable_role, transcription.variable_fraction
    controls = values[role == "control"].reshape(-1, 2)
    assert list(at[role == "control"]) == sorted(at[role == "control"])

    def rate(t: float, y: Array, w: Array) -> Array:
        return np.array([y[1] * np.cos(w[0]) + t, parameter * y[0] - w[1] ** 2 / total, y[0] ** 2 + w[0] * t])

    expected_cost, expected = 0.0, []
    for k in range(intervals):
        ends = controls[[k, k]] if control == "held" else controls[[k, k + 1]]
        end, part = runge_kutta(rate, states[k], ends, mesh[k] * total, (mesh[k + 1] - mesh[k]) * total, steps)
        expected_cost += part
        expected.append(states[k + 1] - end)
    continuity = [label.startswith("continuity") for label in transcription.row_labels]
    np.testing.assert_allclose(rows[continuity], np.ravel(expected), rtol=1e-9, atol=1e-9)
    assert cost[0] == pytest.approx(expected_cost, rel=1e-9, abs=1e-9)


def runge_kutta(
    rate: Callable[[float, Array, Array], Array], start: Array, ends: Array, t: float, width: float, steps: int
) -> tuple[Array, float]:
    """The classical method over one interval, control linear between its ends: end state and integral."""
    y, h = np.append(start, 0.0), width / steps
    for i in range(steps):

        def control(place: float, i: int = i) -> Array:
            within = (i + place) / steps
            return np.asarray((1 - within) * ends[0] + within * ends[1])

        k1 = rate(t, y, control(0.0))
        k2 = rate(t + h / 2, y + h / 2 * k1, control(0.5))
        k3 = rate(t + h / 2, y + h / 2 * k2, control(0.5))
        k4 = rate(t + h, y + h * k3, control(1.0))
        y = y + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
        t += h
    return y[:-1], float(y[-1])


@pytest.mark.parametrize("integrator", ["rk4", "cvodes"])
def test_linear_controls_are_continuous_and_held_ones_constant(integrator: str) -> None:
    linear = solve(van_der_pol(), MultipleShooting(5, integrator, steps=2, control="linear"))
    s = np.linspace(0.0, 1.0, 51)
    at_nodes = linear.at_fraction(np.linspace(0.0, 1.0, 6))["u"][:, 0]
    expected = np.interp(s, np.linspace(0.0, 1.0, 6), at_nodes)
    np.testing.assert_allclose(linear.at_fraction(s)["u"][:, 0], expected, atol=1e-12)

    held = solve(van_der_pol(), MultipleShooting(5, integrator, steps=2))
    values = held.at_fraction((np.arange(50) + 0.5) / 50)["u"].reshape(5, 10)
    assert np.all(values == values[:, :1])
    assert len(np.unique(values[:, 0])) == 5


@pytest.mark.parametrize("control", CONTROLS)
def test_interpolant_follows_the_integrator_between_nodes(control: str) -> None:
    """With many steps the reported curve is the trajectory of the controls, also between the nodes."""
    solution = solve(van_der_pol(), MultipleShooting(4, steps=25, control=control))
    audit = solution.audit()
    assert audit.integration_error < 1e-7


@pytest.mark.parametrize("staged", [False, True])
@pytest.mark.parametrize("control", CONTROLS)
def test_path_rows_stand_at_the_nodes_and_at_both_ends_of_held_controls(control: str, staged: bool) -> None:
    nodes = np.linspace(0.0, 1.0, 4)
    method = MultipleShooting(3, control=control)
    mixed = np.sort(np.concatenate([nodes[:-1], nodes[1:]])) if control == "held" else nodes
    tie = nodes[:-1] if control == "held" else nodes
    for label, expected in (("mixed", mixed), ("state", nodes[1:]), ("tie", tie)):
        at = imposed(method, label, constrained(), staged=staged)
        np.testing.assert_allclose(at, expected, atol=1e-12, err_msg=label)
    assert imposed(method, "state", constrained(initial=[np.nan, np.nan]), staged=staged)[0] == 0.0


@pytest.mark.parametrize("integrator", ["rk4", "cvodes"])
@pytest.mark.parametrize("control", CONTROLS)
def test_active_path_constraints_are_kept_where_they_are_imposed(integrator: str, control: str) -> None:
    problem = van_der_pol(initial=(1.0, 0.5))
    x, u = problem.declared.states["x"].symbol, problem.declared.controls["u"].symbol
    problem.path("mixed", x[0] - u, lower=-2.0, upper=1.1)
    problem.path("state", x[1], lower=-0.3)
    solution = solve(problem, MultipleShooting(8, integrator, control=control))
    states, controls = solution["x"], solution.control_interpolant.values
    sides = [states[:-1, 0] - controls[:, 0, 0], states[1:, 0] - controls[:, -1, 0]]  # held: one value for both ends
    assert max(side.max() for side in sides) == pytest.approx(1.1, abs=1e-7)
    assert states[:, 1].min() == pytest.approx(-0.3, abs=1e-7)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((0,), "intervals must be a whole number, 1 to 1000000, not 0"),
        ((1.0,), "intervals"),
        ((3, "euler"), "integrator must be 'rk4' or 'cvodes', not 'euler'"),
        ((3, None), "integrator"),
        ((3, "rk4", 0), "steps must be a whole number, 1 to 1000000, not 0"),
        ((3, "rk4", 2.0), "steps"),
        ((3, "rk4", True), "steps"),
        ((3, "rk4", None), "steps"),
        ((3, "rk4", 1, "points"), "control must be 'held' or 'linear', not 'points'"),
        ((3, "rk4", 1, "held", (0.0, 1.0)), "mesh has 2 entries, 4 expected"),
        ((2, "rk4", 1, "held", (0.0, -0.5, 1.0)), "mesh must increase"),
    ],
)
def test_bad_settings_are_named(arguments: tuple[Any, ...], message: str) -> None:
    with pytest.raises(ProblemError, match=message):
        MultipleShooting(*arguments)
