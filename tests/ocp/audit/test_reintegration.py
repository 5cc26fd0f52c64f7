"""Re-integration of the controls in steps that resolve events between the points of a plan."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from time import process_time
from typing import Any

import casadi as ca
import numpy as np
import pytest

from ocp import Collocation, MultipleShooting, Problem, Solution, solve
from ocp.audit.correction import corrected_motion
from ocp.audit.linearisation import Linearisation
from ocp.audit.reintegration import Reintegration, integrated_motion, reintegrate
from ocp.problem.formulation import Formulation
from tests.ocp.audit.drawn import of, random_program
from tests.ocp.problems import Array, van_der_pol

METHODS = {
    "radau": Collocation(20),
    "legendre": Collocation(20, scheme="legendre"),
    "held": MultipleShooting(50),
    "linear": MultipleShooting(50, control="linear"),
}
every_method = pytest.mark.parametrize("method", METHODS)


def again(problem: Problem, solution: Solution) -> Reintegration:
    return reintegrate(Linearisation(Formulation(problem), solution))


def driven(rate: Callable[[Any, Any, Any], Any], horizon: float = 1.0, control: Any = 0.0) -> tuple[Problem, Solution]:
    """x' = rate(x, u, t) from 0, and a plan drawn at rest, whatever the dynamics say."""
    problem = Problem("driven")
    x, u = problem.state("x", initial=0.0, lower=-1.0), problem.control("u")
    problem.dynamics(x, rate(x, u, problem.time))
    problem.horizon(horizon)
    problem.minimize(u**2)
    return problem, random_program(problem, {"x": lambda t: t}, {"u": control}, {"x": 0.0}, horizon)


# ---- the integration itself ------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("rate", "exact"),
    [
        (lambda x, u, t: u - x, lambda t: 1 - np.exp(-t)),
        (lambda x, u, t: 50 * ca.cos(50 * t) * u, lambda t: np.sin(50 * t)),
        (lambda x, u, t: 1 + x**2, np.tan),
        (lambda x, u, t: ca.if_else(t < 0.3337, 1.0, -1.0), lambda t: np.where(t < 0.3337, t, 0.6674 - t)),
        (lambda x, u, t: 1e4 * (ca.sin(t) - x) + ca.cos(t), np.sin),
    ],
    ids=["exponential", "fast", "nonlinear", "discontinuous", "stiff"],
)
def test_states_are_those_of_the_closed_form(rate: Any, exact: Callable[[Array], Array]) -> None:
    problem, plan = driven(rate, control=1.0)
    result = again(problem, plan)
    np.testing.assert_allclose(result.states[:, 0], exact(result.grid.t), atol=1e-9)
    assert result.breakdown_time is None


def test_a_motion_that_leaves_for_infinity_breaks_down_where_it_does() -> None:
    problem, plan = driven(lambda x, u, t: 1 + (2 * x) ** 2)  # x = tan(2 t) / 2
    result = again(problem, plan)
    assert result.breakdown_time == pytest.approx(np.pi / 4, abs=4e-3)
    assert np.isfinite(result.states[result.grid.t < np.pi / 4 - 4e-3]).all()
    assert not plan.audit().feasible


@pytest.mark.parametrize("rate", [1e6, 1e8])
def test_stiff_dynamics_follow_their_slow_motion(rate: float) -> None:
    """x' = r (sin t + u - x) from 0, with u = 1 held: x = 1 + sin t - cos t / r at times well beyond 1 / r."""
    problem, solution = driven(lambda x, u, t: rate * (ca.sin(t) + u - x), 3.0, control=1.0)
    motion = again(problem, solution)
    late = motion.grid.t > 0.1
    exact = 1 + np.sin(motion.grid.t) - np.cos(motion.grid.t) / rate
    np.testing.assert_allclose(motion.states[late, 0], exact[late], atol=1e-9)
    assert motion.cost == pytest.approx(3.0, rel=1e-9)
    assert motion.breakdown_time is None


@pytest.mark.parametrize("unit", [1e-9, 1.0, 1e9])
@pytest.mark.parametrize("time", [1e-6, 1.0, 1e5])
def test_the_integration_is_as_exact_in_any_unit(unit: float, time: float) -> None:
    problem = Problem("in other units")
    x, u = problem.state("x", initial=0.0), problem.control("u")
    problem.dynamics(x, (unit * ca.cos(9 * problem.time / time) * 9 - x) / time)
    problem.horizon(time)
    problem.minimize(u**2)
    plan = random_program(problem, {"x": lambda t: unit * t / time}, {"u": 1.0}, {"x": 0.0}, time)
    result = again(problem, plan)
    s = result.grid.t / time
    exact = 9 * (np.cos(9 * s) + 9 * np.sin(9 * s) - np.exp(-s)) / 82
    np.testing.assert_allclose(result.states[:, 0] / unit, exact, atol=1e-9)


@every_method
def test_the_running_cost_is_integrated_along(method: str) -> None:
    plan = solve(van_der_pol(), METHODS[method])
    result = again(van_der_pol(), plan)
    assert result.cost == pytest.approx(plan.cost, rel=1e-3)
    assert result.local_cost == pytest.approx(result.cost, rel=1e-3)


@every_method
def test_corrections_of_a_plan_lead_where_its_integration_does(method: str) -> None:
    along = Linearisation(Formulation(van_der_pol()), solve(van_der_pol(), METHODS[method]))
    near, exact = corrected_motion(along), integrated_motion(along)
    assert near is not None
    for name in ("local", "states"):
        np.testing.assert_allclose(getattr(near, name), getattr(exact, name), rtol=0, atol=2e-10)
    assert near.cost == pytest.approx(exact.cost, rel=1e-9)
    assert near.local_cost == pytest.approx(exact.local_cost, rel=1e-9)


@pytest.mark.parametrize("share", [0.0, 1e-8, 1e-5, 1e-3, 0.1])
def test_a_wrong_plan_is_corrected_or_left_to_the_integration(share: float) -> None:
    plan = solve(van_der_pol(), METHODS["radau"])
    curve = plan.control_interpolant
    wrong = replace(plan, control_interpolant=replace(curve, values=(1 + share) * curve.values))
    along = Linearisation(Formulation(van_der_pol()), wrong)
    exact, result = integrated_motion(along), again(van_der_pol(), wrong)
    np.testing.assert_allclose(result.states, exact.states.reshape(result.states.shape), rtol=0, atol=2e-10)
    np.testing.assert_allclose(result.local, exact.local.reshape(result.local.shape), rtol=0, atol=2e-10)
    assert result.cost == pytest.approx(exact.cost, rel=1e-9)


def test_jumps_of_the_plan_are_carried_on_by_its_dynamics() -> None:
    plan = solve(van_der_pol(), METHODS["legendre"])
    curve = plan.state_interpolant
    values = curve.values + 1e-4 * np.sin(np.arange(20))[:, None, None]
    along = Linearisation(Formulation(van_der_pol()), replace(plan, state_interpolant=replace(curve, values=values)))
    near, exact = corrected_motion(along), integrated_motion(along)
    assert near is not None
    np.testing.assert_allclose(near.states, exact.states, rtol=0, atol=2e-10)
    np.testing.assert_allclose(near.local, exact.local, rtol=0, atol=2e-10)


@pytest.mark.parametrize("half_cells", [1, 2, 3])
def test_oscillations_in_phase_with_the_grid_are_detected(half_cells: int) -> None:
    """20 intervals of 30 cells: at their ends and middles the push is nothing."""
    problem, plan = driven(lambda x, u, t: 1 - ca.cos(2 * np.pi * 1200 / half_cells * t))
    rest = replace(plan, state_interpolant=replace(plan.state_interpolant, values=0 * plan.state_interpolant.values))
    result = again(problem, rest)
    swing = 2 * np.pi * 1200 / half_cells
    np.testing.assert_allclose(result.states[:, 0], result.grid.t - np.sin(swing * result.grid.t) / swing, atol=1e-8)


# ---- between the points ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("at", [0.2503, 0.5125, 0.7777])
@pytest.mark.parametrize("shape", ["box", "bump"])
@every_method
def test_a_push_of_a_millisecond_between_the_nodes_is_felt(method: str, shape: str, at: float) -> None:
    """1 N s in 1 ms: the mass of 1 kg leaves with 1 m/s; the plan without it stands on another problem."""
    width = 1e-3

    def build(pushed: bool) -> Problem:
        problem = Problem("pushed")
        x, v = problem.state("x", initial=0.0, terminal=1.0), problem.state("v", initial=0.0, terminal=0.0)
        u = problem.control("u")
        place = (problem.time - at) / width
        form = ca.if_else(ca.fabs(place) < 0.5, 1, 0) * (1 if shape == "box" else 2 * ca.cos(np.pi * place) ** 2)
        problem.dynamics(x, v)
        problem.dynamics(v, u + (form / width if pushed else 0))
        problem.horizon(1.0)
        problem.minimize(u**2)
        return problem

    plan = solve(build(False), METHODS[method])
    assert plan.audit().feasible
    audit = of(plan, build(True)).audit()
    assert not audit["integration error of one interval"].passed
    assert audit.states["v"][-1, 0] == pytest.approx(1.0, abs=1e-6)


# ---- unstable dynamics -----------------------------------------------------------------------------------------------


def unstable(growth: float, horizon: float = 2.0) -> Problem:
    problem = Problem("unstable")
    x, u = problem.state("x", initial=1.0, terminal=0.0), problem.control("u")
    problem.dynamics(x, growth * x + u)
    problem.horizon(horizon)
    problem.minimize((x**2 + u**2) / 2)
    return problem


def test_divergence_of_unstable_dynamics_is_reported_and_intervals_are_checked() -> None:
    plan = solve(unstable(15.0), Collocation(60))
    audit = plan.audit()
    assert audit.feasible
    assert audit["integration error, relative"].value > 1e-3
    assert audit["integration error, relative"].limit is None
    assert "unstable" in audit["integration error, relative"].note
    assert audit["integration error of one interval"].limit == 1e-3


def test_errors_that_only_add_up_are_not_excused() -> None:
    """Each of 50 intervals leaves 4e-4 of the way; no dynamics make it grow."""
    problem = Problem("drifting")
    x, u = problem.state("x", initial=0.0, terminal=1.0), problem.control("u")
    problem.dynamics(x, 0.98 * u)
    problem.horizon(1.0)
    problem.minimize(u**2)
    plan = random_program(problem, {"x": lambda t: t}, {"u": 1.0}, {"x": 0.0}, 1.0, 50)
    audit = plan.audit()
    assert audit["integration error of one interval"].value == pytest.approx(4e-4, rel=1e-3)
    assert audit["integration error of one interval"].passed
    assert audit["integration error, relative"].value == pytest.approx(0.02, rel=1e-3)
    assert not audit["integration error, relative"].passed


@pytest.mark.parametrize("growth", [6.0, 15.0])
@pytest.mark.parametrize("share", [0.9, 1.1])
def test_a_wrong_control_of_unstable_dynamics_is_not_excused(growth: float, share: float) -> None:
    plan = solve(unstable(growth), Collocation(60))
    curve = plan.control_interpolant
    wrong = replace(plan, control_interpolant=replace(curve, values=share * curve.values))
    assert not wrong.audit().feasible


def test_a_jump_of_unstable_dynamics_is_not_excused() -> None:
    plan = solve(unstable(15.0), Collocation(60))
    curve = plan.state_interpolant
    values = curve.values.copy()
    values[30:] += 0.01
    assert not replace(plan, state_interpolant=replace(curve, values=values)).audit().feasible


# ---- constraints -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("form", ["square", "distance", "shifted square"])
@pytest.mark.parametrize("thick", [0.1, 0.01])
@pytest.mark.parametrize("unit", [1e-3, 1.0, 1e3])
def test_the_middle_of_an_obstacle_is_as_bad_however_its_distance_is_written(
    form: str, thick: float, unit: float
) -> None:
    def build(wall: bool) -> Problem:
        problem = Problem("wall")
        x, u = problem.state("x", initial=0.0, terminal=unit), problem.control("u")
        problem.dynamics(x, u)
        problem.horizon(1.0)
        if wall:
            square, room = (x - 0.52 * unit) ** 2, (thick * unit / 2) ** 2
            if form == "square":
                problem.path("wall", square, lower=room)
            elif form == "shifted square":
                problem.path("wall", square - room, lower=0.0)
            else:
                problem.path("wall", ca.sqrt(square + 1e-12 * unit**2), lower=np.sqrt(room))
        problem.minimize((u / unit) ** 2)
        return problem

    plan = solve(build(False), Collocation(10))
    assert plan.audit().feasible
    assert not of(plan, build(True)).audit()["wall"].passed


# ---- how long it takes -----------------------------------------------------------------------------------------------


def test_the_time_grows_no_faster_than_the_intervals() -> None:
    """Time of the processor, the least of several tries of both in turn: others at work lengthen some of them."""
    plans = [solve(van_der_pol(), Collocation(intervals)) for intervals in (100, 400)]
    least = [np.inf, np.inf]
    for _ in range(6):
        for k, plan in enumerate(plans):
            began = process_time()
            again(van_der_pol(), plan)
            least[k] = min(least[k], process_time() - began)
    assert least[1] < 1.2 * 4 * least[0]
