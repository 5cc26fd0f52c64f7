"""Derivatives of the optimal cost in the parameters: against closed forms and against re-solves, by every method."""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
import pytest

from ocp import Collocation, Indirect, MultipleShooting, Problem, ProblemError, Solution, prepare, solve
from tests.families import some
from tests.ocp.indirect.extremals import EXTREMA, regulator
from tests.ocp.problems import EVERY_METHOD, SOLVERS, SWING, Array, plant, swing

pytestmark = pytest.mark.xdist_group("cost gradients")  # one process, so that every plan is solved once

STEP = 1e-4

METHODS: dict[str, Any] = {
    "radau": Collocation(12),
    "legendre": Collocation(12, scheme="legendre"),
    "radau-held": Collocation(12, control="held"),
    "rk4-linear": MultipleShooting(12, steps=2, control="linear"),
    "rk4-held": MultipleShooting(12, steps=2),
}


def differences(prepared: Any, solution: Solution, parameters: dict[str, Any]) -> dict[str, Array]:
    """Central differences of the optimal cost in every parameter."""
    by_name = {}
    for name, value in parameters.items():
        entries = np.atleast_1d(np.asarray(value, dtype=float))
        slopes = []
        for shift in STEP * np.eye(entries.size):
            ahead, behind = (prepared.solve({**parameters, name: entries + s * shift}, solution) for s in (1, -1))
            slopes.append((ahead.cost - behind.cost) / (2 * STEP))
        by_name[name] = np.array(slopes)
    return by_name


def assert_gradients(prepared: Any, parameters: dict[str, Any], tolerance: float) -> Solution:
    solution: Solution = prepared.solve(parameters)
    for name, expected in differences(prepared, solution, parameters).items():
        assert solution.cost_gradient(name).shape == expected.shape
        size = max(1.0, float(np.max(np.abs(expected))))
        np.testing.assert_allclose(solution.cost_gradient(name), expected, atol=tolerance * size, err_msg=name)
    return solution


# ---- every place a parameter can stand ---------------------------------------------------------------------------


def places() -> Problem:
    """One parameter in each place; entries of ``bound`` stand at active and inactive bounds of both sides."""
    problem = Problem("places")
    stiff, weight, end_weight = (problem.parameter(name) for name in ("dynamics", "running", "final"))
    bound = problem.parameter("bound", 4)
    initial, terminal = problem.parameter("initial", 2), problem.parameter("terminal")
    horizon, level = problem.parameter("horizon_value"), problem.parameter("level")
    start_level, end_level = problem.parameter("start_level"), problem.parameter("end_level")
    x = problem.state("x", 3, initial=ca.vertcat(initial[0] * initial[1], initial[1], np.nan))
    y = problem.state("y", initial=0.3, terminal=2 * terminal)
    u = problem.control("u", lower=-bound[0], upper=bound[1])
    v = problem.control("v", lower=-bound[2], upper=bound[3])
    w = problem.control("w", 2)
    T = problem.horizon(horizon)
    problem.dynamics(x, ca.vertcat(x[1], u - stiff * ca.sin(x[0]), w[1] - x[2]))
    problem.dynamics(y, v + w[0] * (1 + 0.2 * T) - 0.1 * x[2])
    problem.path("task", w[0] + w[1] * (2 + ca.cos(y)), level**2, level**2)
    problem.start("tie", x[2] + x[0], start_level, start_level)
    problem.end("gate", x[2] + 0.5 * x[0], 3 * end_level, 3 * end_level)
    problem.minimize(
        running=weight * u**2 / 2 + v**2 / 2 + ca.sumsqr(w) + ca.sumsqr(x) + 0.1 * problem.time * y,
        terminal=end_weight * (x[0] - 0.2) ** 2 + 0.1 * T,
    )
    return problem


PLACES: dict[str, Any] = {
    "dynamics": 1.2,
    "running": 0.2,
    "final": 3.0,
    "bound": [0.8, 5.0, 4.0, 0.15],
    "initial": [1.4, 0.7],
    "terminal": 0.5,
    "horizon_value": 1.6,
    "level": 0.5,
    "start_level": 1.1,
    "end_level": 0.05,
}


@cache
def placed(method: str, solver: str) -> tuple[Solution, dict[str, Array]]:
    prepared = prepare(places(), METHODS[method], solver=solver)
    solution = prepared.solve(PLACES)
    return solution, differences(prepared, solution, PLACES)


@pytest.mark.parametrize("solver", SOLVERS)
@pytest.mark.parametrize("method", METHODS)
def test_gradients_in_every_place_by_direct_methods(method: str, solver: str) -> None:
    solution, expected = placed(method, solver)
    for name, slopes in expected.items():
        size = max(1.0, float(np.max(np.abs(slopes))))
        np.testing.assert_allclose(solution.cost_gradient(name), slopes, atol=3e-6 * size, err_msg=name)


@cache
def placed_indirectly() -> tuple[Any, Solution]:
    prepared = prepare(places(), Indirect(segments=4))
    return prepared, prepared.solve(PLACES)


@pytest.mark.parametrize("draw", some(range(3), 1))
def test_gradients_in_every_place_by_the_indirect_method(draw: int) -> None:
    """Along random directions of all parameters at once: a re-solve here costs a second."""
    prepared, solution = placed_indirectly()
    assert solution.method["control"] == "iterated"
    rng = np.random.default_rng(draw)
    direction = {name: rng.uniform(-1, 1, np.size(value)) for name, value in PLACES.items()}
    costs = []
    for sign in (1, -1):
        moved = {name: np.atleast_1d(value) + sign * STEP * direction[name] for name, value in PLACES.items()}
        costs.append(prepared.solve(moved, solution).cost)
    slope = sum(float(solution.cost_gradient(name) @ direction[name]) for name in PLACES)
    assert slope == pytest.approx((costs[0] - costs[1]) / (2 * STEP), rel=1e-6, abs=1e-6)


def test_gradients_in_every_place_agree_with_those_of_a_fine_mesh() -> None:
    """To the square of its width: the mesh does not know the corners of the controls."""
    fine = solve(places(), Collocation(200, 2), parameters=PLACES)
    for name in PLACES:
        mine, other = placed_indirectly()[1].cost_gradient(name), fine.cost_gradient(name)
        np.testing.assert_allclose(mine, other, atol=3e-5 * max(1.0, np.max(np.abs(other))), err_msg=name)


def test_active_bounds_push_and_inactive_ones_do_not() -> None:
    """u is at its lower bound only, v at its upper one only; to widen an active bound lowers the cost."""
    for solution in (placed("radau", "ipopt")[0], placed_indirectly()[1]):
        push = solution.cost_gradient("bound")
        assert push[0] < -1e-3
        assert push[3] < -1e-3
        np.testing.assert_allclose(push[[1, 2]], 0.0, atol=1e-7)


def test_gradients_of_direct_methods_converge_to_those_of_the_indirect_one() -> None:
    case = EXTREMA["everything"]
    exact = solve(case.build(), Indirect(), parameters=case.parameters)
    fine = solve(case.build(), case.direct, parameters=case.parameters)
    for name in case.parameters:
        np.testing.assert_allclose(fine.cost_gradient(name), exact.cost_gradient(name), rtol=1e-8, atol=1e-8)


# ---- the indirect method -----------------------------------------------------------------------------------------

QUICK = ("everything", "fixed horizon", "free horizon", "cyclic", "free period", "free start", "heading", "bang-bang",
         "mixed", "bounded task", "saturated")  # fmt: skip


@pytest.mark.parametrize("name", QUICK)
def test_gradients_of_the_indirect_method(name: str) -> None:
    case = EXTREMA[name]
    tolerance = 1e-5 if case.switches or case.how == "projected" else 1e-6  # corners add to the differences' error
    assert_gradients(prepare(case.build(), Indirect(segments=10)), dict(case.parameters), tolerance)


def test_gradients_of_backward_shooting() -> None:
    case = EXTREMA["fixed horizon"]
    assert_gradients(prepare(case.build(), Indirect(shooting="backward")), dict(case.parameters), 1e-6)


# ---- closed form -------------------------------------------------------------------------------------------------


def riccati(a: float, horizon: float) -> float:
    """P of x' = a x + u, min int (x^2 + u^2)/2 over the horizon: optimal cost P x0^2 / 2."""
    r = np.hypot(a, 1.0)
    return float(np.sinh(r * horizon) / (r * np.cosh(r * horizon) - a * np.sinh(r * horizon)))


@pytest.mark.parametrize("method", [Indirect(), Indirect(shooting="backward"), Collocation(20, 4, "legendre")], ids=str)
def test_gradients_of_a_regulator_are_those_of_its_riccati_solution(method: Any) -> None:
    a, x0, horizon = 0.5, 1.3, 1.2
    solution = solve(regulator(), method, parameters={"a": a, "x0": x0, "h": horizon})
    p = riccati(a, horizon)
    assert solution.cost == pytest.approx(p * x0**2 / 2, abs=1e-10)
    assert solution.cost_gradient("x0") == pytest.approx(p * x0, abs=1e-9)
    by_horizon = (1 + 2 * a * p - p**2) * x0**2 / 2  # the Riccati equation in the time that is left
    assert solution.cost_gradient("h") == pytest.approx(by_horizon, abs=1e-9)
    by_a = (riccati(a + 1e-5, horizon) - riccati(a - 1e-5, horizon)) / 2e-5 * x0**2 / 2
    assert solution.cost_gradient("a") == pytest.approx(by_a, abs=1e-8)


# ---- direct problems that the indirect method cannot take --------------------------------------------------------


@pytest.mark.parametrize("solver", SOLVERS)
@pytest.mark.parametrize("method", ["radau", "legendre-held", "rk4-linear"])
def test_gradients_with_inequalities_and_state_bounds(method: str, solver: str) -> None:
    prepared = prepare(swing(), EVERY_METHOD[method], solver=solver)
    assert_gradients(prepared, dict(SWING), 3e-5)


@pytest.mark.parametrize("solver", SOLVERS)
def test_gradients_in_levels_of_active_inequalities(solver: str) -> None:
    """Speed limit, end inequality and the bounds of a free horizon, each a parameter and each active.

    The cost on a mesh has a kink in its slope where another point of the mesh meets the limit: at a speed of 1.2, say.
    """
    problem = Problem("limits")
    speed, reach, latest = problem.parameter("speed"), problem.parameter("reach"), problem.parameter("latest")
    floor = problem.parameter("floor")
    x = problem.state("x", 2, initial=[0.0, 0.0], lower=ca.vertcat(-1, floor))
    u = problem.control("u")
    problem.horizon(lower=0.5, upper=latest, guess=0.9)
    problem.dynamics(x, ca.vertcat(x[1], u))
    problem.path("speed", x[1], upper=speed)
    problem.end("reach", x[0], lower=reach)
    problem.minimize(running=u**2 / 2)
    parameters = {"speed": 1.23, "reach": 1.0, "latest": 1.0, "floor": -3.0}
    solution = assert_gradients(prepare(problem, Collocation(20), solver=solver), parameters, 1e-5)
    signs = [float(np.sign(solution.cost_gradient(name)[0])) for name in ("speed", "reach", "latest")]
    assert signs == [-1, 1, -1]
    assert abs(solution.cost_gradient("floor")[0]) < 1e-6


# ---- the accessor ------------------------------------------------------------------------------------------------


def test_an_unknown_parameter_is_an_error_that_names_the_near_ones() -> None:
    solution = solve(regulator(), Indirect(), parameters={"a": 0.5, "x0": 1.0, "h": 1.0})
    with pytest.raises(ProblemError, match=r"parameter 'x00' does not exist; did you mean 'x0'\?"):
        solution.cost_gradient("x00")
    with pytest.raises(ProblemError, match="unknown parameter"):
        solution.cost_gradient("x")  # a state


@pytest.mark.parametrize("method", [None, Collocation(10)], ids=["indirect", "direct"])
def test_gradients_survive_save_and_load(method: Collocation | None, tmp_path: Path) -> None:
    solution = placed_indirectly()[1] if method is None else solve(places(), method, parameters=PLACES)
    solution.save(tmp_path / "plan.npz")
    loaded = Solution.load(tmp_path / "plan.npz")
    assert list(loaded.cost_gradients) == list(PLACES)
    for name in PLACES:
        np.testing.assert_array_equal(loaded.cost_gradient(name), solution.cost_gradient(name))
        assert loaded.cost_gradient(name).shape == np.atleast_1d(PLACES[name]).shape


def test_a_problem_without_parameters_has_no_gradients() -> None:
    problem, x, u = plant("plain", initial=1.0)
    problem.dynamics(x, u)
    problem.minimize(running=x**2 + u**2)
    for method in (Indirect(), Collocation(5)):
        assert solve(problem, method).cost_gradients == {}
