"""Controllers with a receding horizon: optima of an independent solver, bounded work, true status, the same in C."""

from __future__ import annotations

import subprocess
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
import pytest
import scipy

from models.checks import Array
from ocp import Collocation, ControlStep, MultipleShooting, Problem, ProblemError, SolveError, prepare
from ocp.direct.controller import gauss_newton_hessian, split_squares
from ocp.direct.prepared import DirectMethod
from scripts.timing.measure import has_compiler

STRICT = "-O1 -ffp-contract=off -std=c99 -Wall -Wextra -Wno-unused-parameter -Werror"
METHODS: dict[str, DirectMethod] = {
    "shooting": MultipleShooting(12),
    "linear": MultipleShooting(12, steps=2, control="linear"),
    "radau": Collocation(8, 2, control="held"),
    "legendre": Collocation(8, 2, "legendre"),
}
START = [0.6, 0.2]


def pendulum() -> Problem:
    """A pendulum is brought upright (angle 0) by a limited torque, with a limited velocity."""
    problem = Problem("pendulum")
    now, aim = problem.parameter("now", 2), problem.parameter("aim")
    x = problem.state("x", 2, initial=now, lower=[-np.inf, -1.5], upper=[np.inf, 1.5])
    u = problem.control("u", lower=-3.0, upper=3.0)
    problem.dynamics(x, ca.vertcat(x[1], ca.sin(x[0]) + u))
    problem.horizon(1.2)
    problem.path("power", u * x[1], upper=2.0)
    miss = (ca.sin(x[0] - aim)) ** 2 + 0.1 * x[1] ** 2
    problem.minimize(running=5 * miss + 0.1 * u**2, terminal=3 * miss)
    return problem


def controller(method: DirectMethod = METHODS["shooting"], problem: Problem | None = None, **options: Any) -> Any:
    prepared: Any = prepare(problem or pendulum(), method)
    return prepared.controller(prepared.solve({"now": START, "aim": 0.0}), **options)


def closed_loop(of: Any, steps: int, seed: int = 0) -> list[ControlStep]:
    """Steps from random states near a loop that follows the predictions."""
    random, state, result = np.random.default_rng(seed), np.array(START), []
    for _ in range(steps):
        result.append(of.step({"now": state, "aim": random.uniform(-0.2, 0.2)}))
        predicted = result[-1].prediction
        state = predicted.at(predicted.horizon / 12)["x"] + random.uniform(-0.05, 0.05, 2)
    return result


# ---- optima ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("hessian", ["gauss-newton", "exact"])
@pytest.mark.parametrize("name", METHODS)
def test_converged_steps_have_the_optima_of_an_interior_point_method(name: str, hessian: str) -> None:
    prepared: Any = prepare(pendulum(), METHODS[name])
    p = {"now": START, "aim": 0.0}
    of = prepared.controller(prepared.solve(p), iterations=40, hessian=hessian, shift=0)
    random = np.random.default_rng(1)
    for _ in range(4):
        p = {"now": START + random.uniform(-0.2, 0.2, 2), "aim": random.uniform(-0.3, 0.3)}
        step, plan = of.step(p), prepared.solve(p)
        assert step.converged
        assert step.violation <= 1e-6
        assert step.cost == pytest.approx(plan.cost, rel=1e-7)
        np.testing.assert_allclose(step.prediction.states["x"], plan.states["x"], atol=1e-4)
        np.testing.assert_allclose(step.control["u"], plan.at(0.0)["u"], atol=1e-3)


def test_a_linear_problem_is_solved_in_one_iteration_and_has_the_gain_of_the_riccati_equation() -> None:
    problem = Problem("regulator")
    now = problem.parameter("now", 2)
    x = problem.state("x", 2, initial=now)
    u = problem.control("u")
    problem.dynamics(x, ca.vertcat(x[1], u))
    problem.horizon(12.0)
    problem.minimize(running=ca.sumsqr(x) + u**2)
    prepared: Any = prepare(problem, MultipleShooting(120))
    of = prepared.controller(prepared.solve({"now": [0.0, 0.0]}), iterations=2, shift=0)
    # the controls are constant on each interval, over which rk4 integrates these polynomials exactly
    h, free, acted = 0.1, np.array([[0.0, 1.0], [0.0, 0.0]]), np.array([[0.0], [1.0]])
    a, b = np.eye(2) + h * free, h * acted + h**2 / 2 * free @ acted
    nodes, gauss = np.polynomial.legendre.leggauss(4)
    moves = [np.hstack([np.eye(2) + t * free, t * acted + t**2 / 2 * free @ acted]) for t in (nodes + 1) * h / 2]
    weights = gauss * h / 2
    both = sum(weight * move.T @ move for weight, move in zip(weights, moves, strict=True))
    q, r, s = both[:2, :2], both[2:, 2:] + h, both[:2, 2:]
    value = scipy.linalg.solve_discrete_are(a, b, q, r, s=s)
    gain = np.linalg.solve(r + b.T @ value @ b, b.T @ value @ a + s.T)
    for state in ([1.0, 0.0], [0.3, -2.0]):
        step = of.step({"now": state})
        assert step.iterations == 1
        np.testing.assert_allclose(step.control["u"], -gain @ np.array(state), rtol=2e-4)


def test_the_shifted_result_is_a_better_start_than_the_result_itself() -> None:
    needed = {}
    for shift in (0, 1):
        of = controller(iterations=30, shift=shift)
        state, count = np.array(START), 0
        for _ in range(8):
            step = of.step({"now": state, "aim": 0.0})
            state, count = step.prediction.at(0.1)["x"], count + step.iterations
        needed[shift] = count
    assert needed[1] < needed[0]


# ---- bounded work and status -------------------------------------------------------------------------------------


@pytest.mark.parametrize("iterations", [1, 2, 3])
def test_the_number_of_iterations_is_bounded_and_the_status_is_true(iterations: int) -> None:
    of = controller(iterations=iterations)
    prepared = of._prepared
    for step in closed_loop(of, 10):
        assert step.iterations <= iterations
        plan = step.prediction
        p = prepared.formulation.parameter_vector(plan.parameters)
        limits = prepared.transcription.arguments(p, prepared.formulation.bound_values(p))
        _, rows = prepared.program.numbers.values(plan.variables, p)
        v = plan.variables
        excess = [limits["lbg"] - rows, rows - limits["ubg"], limits["lbx"] - v, v - limits["ubx"]]
        assert step.violation == pytest.approx(max(0.0, *(float(part.max()) for part in excess)), abs=1e-14)
        assert step.converged == (max(step.violation, step.residual) <= 1e-6) == plan.success
        assert np.all(np.abs(step.control["u"]) <= 3.0)


def test_a_problem_without_a_feasible_motion_says_so() -> None:
    of = controller(iterations=10)
    step = of.step({"now": [0.0, 2.5], "aim": 0.0})  # too fast to brake below 1.5 rad/s within an interval
    assert not step.converged
    assert step.violation > 0.1
    assert abs(step.control["u"][0]) <= 3.0
    again = controller(iterations=10)
    assert again.step({"now": START, "aim": 0.0}).converged


def test_a_step_that_is_not_finite_keeps_the_last_control() -> None:
    problem = Problem("root")
    now = problem.parameter("now")
    x = problem.state("x", initial=now)
    u = problem.control("u", lower=-5.0, upper=5.0)
    problem.dynamics(x, ca.sqrt(x) + u)
    problem.horizon(1.0)
    problem.minimize(running=(x - 1) ** 2 + u**2)
    prepared: Any = prepare(problem, MultipleShooting(5))
    of = prepared.controller(prepared.solve({"now": 1.2}), shift=0)
    before, broken = of.step({"now": 1.1}), of.step({"now": -1.0})
    assert broken.held
    assert not broken.converged
    np.testing.assert_array_equal(broken.control["u"], before.control["u"])
    assert of.step({"now": 1.1}).converged


def test_the_same_steps_give_the_same_numbers() -> None:
    one, other = (closed_loop(controller(), 6) for _ in range(2))
    for a, b in zip(one, other, strict=True):
        assert (a.cost, a.residual, a.iterations) == (b.cost, b.residual, b.iterations)
        np.testing.assert_array_equal(a.prediction.variables, b.prediction.variables)


def test_a_reset_controller_is_as_new() -> None:
    prepared: Any = prepare(pendulum(), MultipleShooting(12))
    plan = prepared.solve({"now": START, "aim": 0.0})
    of = prepared.controller(plan)
    first = of.step({"now": [0.5, 0.1], "aim": 0.1})
    of.step({"now": [0.1, 0.4], "aim": -0.1})
    of.reset(plan)
    again = of.step({"now": [0.5, 0.1], "aim": 0.1})
    np.testing.assert_array_equal(again.prediction.variables, first.prediction.variables)


@pytest.mark.skipif(not has_compiler(), reason="no C compiler")
def test_compiled_controllers_give_the_same_numbers() -> None:
    steps = []
    for compiled in (False, True):
        prepared: Any = prepare(pendulum(), MultipleShooting(12), compiled=compiled)
        steps.append(closed_loop(prepared.controller(prepared.solve({"now": START, "aim": 0.0})), 5))
    for a, b in zip(*steps, strict=True):
        np.testing.assert_array_equal(a.prediction.variables, b.prediction.variables)


# ---- Hessians ----------------------------------------------------------------------------------------------------


def test_squares_are_found_in_sums_and_products_and_the_rest_remains() -> None:
    v, p = ca.SX.sym("v", 3), ca.SX.sym("p", 2)
    cost = p[0] * (2 * ca.sumsqr(v[:2] - p) - (ca.sin(v[2]) * 3) ** 2 / p[1]) + v[0] * ca.exp(v[1]) + p[1] ** 2
    residuals, weights, remainder = split_squares(cost, v)
    assert len(residuals) == 3
    rebuilt = sum((w * r**2 for r, w in zip(residuals, weights, strict=True)), remainder)
    difference = ca.Function("difference", [v, p], [cost - rebuilt - p[1] ** 2])
    random = np.random.default_rng(0)
    for _ in range(5):
        assert abs(float(difference(random.normal(size=3), random.uniform(1, 2, 2)))) < 1e-12
    assert not any(ca.depends_on(weight, v) for weight in weights)


@pytest.mark.parametrize("name", METHODS)
def test_gauss_newton_hessians_are_positive_semidefinite_and_exact_for_linear_residuals(name: str) -> None:
    prepared: Any = prepare(pendulum(), METHODS[name])
    random = np.random.default_rng(2)
    for block in prepared.transcription.blocks:
        hessian, size = gauss_newton_hessian(block.function), block.function.size1_in(0)
        p, rows = np.array([0.3, 0.1, 0.2]), np.zeros(block.function.size1_out(1))
        for _ in range(5):
            upper = hessian(random.normal(size=size), block.data[:, 0], p, 1.0, rows)
            assert np.linalg.eigvalsh(np.array(ca.triu2symm(upper))).min() > -1e-12
    v, none = ca.SX.sym("v", 2), ca.SX.sym("none", 0)
    quadratic = ca.Function("f", [v, none, none], [ca.sumsqr(ca.vertcat(3 * v[0] - v[1], v[1])), ca.SX(0, 1)])
    np.testing.assert_allclose(
        np.array(ca.triu2symm(gauss_newton_hessian(quadratic)([0.0, 0.0], [], [], 1.0, []))), [[18, -6], [-6, 4]]
    )


# ---- bad input ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("parameters", "match"),
    [
        ({"now": [0.0], "aim": 0.0, "other": 1.0}, "'other' does not exist"),
        ({"now": [0.0, 0.0, 0.0], "aim": 0.0}, "'now' has 3 entries, 2 expected"),
        ({"now": [np.nan, 0.0], "aim": 0.0}, "'now' is not finite"),
        ({"now": [0.0, 0.0]}, "'aim' has no value"),
        ({"now": "here", "aim": 0.0}, "now"),
        (3, "parameters"),
    ],
)
def test_bad_parameters_are_refused_by_name(parameters: Any, match: str) -> None:
    of = controller()
    expected = controller().step({"now": START, "aim": 0.1})
    with pytest.raises(ProblemError, match=match):
        of.step(parameters)
    np.testing.assert_array_equal(of.step({"now": START, "aim": 0.1}).control["u"], expected.control["u"])


def test_crossed_bounds_are_refused_by_name() -> None:
    problem = Problem("crossed")
    now, top = problem.parameter("now"), problem.parameter("top")
    x = problem.state("x", initial=now, lower=0.0, upper=top)
    u = problem.control("u")
    problem.dynamics(x, u)
    problem.horizon(1.0)
    problem.minimize(running=u**2 + x**2)
    prepared: Any = prepare(problem, MultipleShooting(4))
    of = prepared.controller(prepared.solve({"now": 1.0, "top": 2.0}))
    with pytest.raises(ProblemError, match="'x'"):
        of.step({"now": 1.0, "top": -1.0})


@pytest.mark.parametrize(
    ("options", "match"),
    [
        ({"iterations": 0}, "iterations"),
        ({"qp_iterations": 1.5}, "qp_iterations"),
        ({"hessian": "bfgs"}, "hessian"),
        ({"tolerance": -1.0}, "tolerance"),
        ({"shift": 12}, "shift"),
        ({"shift": -1}, "shift"),
    ],
)
def test_bad_settings_are_refused_by_name(options: dict[str, Any], match: str) -> None:
    with pytest.raises(ProblemError, match=match):
        controller(**options)


def test_a_plan_of_another_problem_or_mesh_is_refused() -> None:
    other: Any = prepare(pendulum(), MultipleShooting(8))
    plan = other.solve({"now": START, "aim": 0.0})
    prepared: Any = prepare(pendulum(), MultipleShooting(12))
    for wrong in (plan, None, {"x": 0.0}):
        with pytest.raises(ProblemError, match="plan must be a solution of the prepared problem 'pendulum'"):
            prepared.controller(wrong)
    uneven: Any = prepare(pendulum(), MultipleShooting(2, mesh=(0.0, 0.2, 1.0)))
    with pytest.raises(ProblemError, match="equal intervals"):
        uneven.controller(uneven.solve({"now": START, "aim": 0.0}))


# ---- C -----------------------------------------------------------------------------------------------------------


def run_program(folder: Path, *numbers: Array | list[float]) -> subprocess.CompletedProcess[str]:
    words = "\n".join(" ".join(repr(float(number)) for number in part) for part in numbers)
    return subprocess.run([str(folder / "controller")], input=words, capture_output=True, text=True, check=False)


@pytest.mark.skipif(not has_compiler(), reason="no C compiler")
@pytest.mark.parametrize("name", METHODS)
def test_the_exported_c_controls_as_python_does(name: str, tmp_path: Path) -> None:
    of = controller(METHODS[name])
    folder = of.to_c(tmp_path / "new" / "folder")
    subprocess.run(["make", f"CFLAGS={STRICT}"], cwd=folder, check=True, capture_output=True)
    random = np.random.default_rng(3)
    data = [np.array([*(START + random.uniform(-0.1, 0.1, 2)), random.uniform(-0.2, 0.2)]) for _ in range(6)]
    done = run_program(folder, *data)
    assert done.returncode == 0
    head, *lines = done.stdout.splitlines()
    assert head == "u,cost,dynamics_violation,limit_violation,residual"
    for p, line in zip(data, lines, strict=True):
        step = of.step({"now": p[:2], "aim": p[2]})
        expected = [*step.control["u"], step.cost, step.dynamics_violation, step.limit_violation, step.residual]
        np.testing.assert_allclose([float(word) for word in line.split(",")], expected, rtol=1e-12, atol=1e-14)
    broken = run_program(folder, [0.1, 0.2])
    assert (broken.returncode, broken.stderr) == (2, "a number is missing for parameter aim\n")


def test_functions_without_c_code_are_refused(tmp_path: Path) -> None:
    prepared: Any = prepare(pendulum(), MultipleShooting(3, "cvodes"))
    of = prepared.controller(prepared.solve({"now": START, "aim": 0.0}))
    with pytest.raises(ProblemError, match="has no C"):
        of.to_c(tmp_path / "none")
    assert not (tmp_path / "none").exists()
    with pytest.raises(ProblemError, match="path"):
        of.to_c(3)


def test_a_first_step_that_is_not_finite_is_refused_by_name() -> None:
    problem = Problem("logarithm")
    x0 = problem.parameter("x0")
    x = problem.state("x", initial=x0)
    u = problem.control("u", lower=-1.0, upper=1.0)
    problem.dynamics(x, u)
    problem.horizon(1.0)
    problem.minimize(running=u**2 + ca.log(x0) * x**2)
    prepared = prepare(problem, MultipleShooting(4))
    controller = prepared.controller(prepared.solve({"x0": 2.0}))
    with pytest.raises(SolveError, match="not finite") as caught:
        controller.step({"x0": -1.0})
    assert caught.value.name == "logarithm"
    first = controller.step({"x0": 2.0})
    held = controller.step({"x0": -1.0})
    assert held.held
    np.testing.assert_array_equal(held.control["u"], first.control["u"])
