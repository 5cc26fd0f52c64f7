"""Solutions are optima of the program: by its conditions, in any units, of closed form; a saddle is left."""

from __future__ import annotations

import threading
from typing import Any

import casadi as ca
import numpy as np
import pytest

from ocp import Collocation, MultipleShooting, Problem, SolveError, prepare, solve
from ocp.direct.active_set import conditions
from ocp.direct.nlp import Outcome
from ocp.direct.prepared import Prepared
from ocp.direct.scaling import unit_scales
from tests.ocp.direct.test_nlp import obstacle, soft_lander
from tests.ocp.problems import FINE, MOVED, SOLVERS, SWING, energy, moved, relative, swing, van_der_pol

PROBLEMS: dict[str, tuple[Any, dict[str, Any]]] = {
    "lander": (soft_lander, {}),
    "obstacle": (obstacle, {}),
    "swing": (swing, SWING),
    "moved": (moved, MOVED),
    "van der pol": (van_der_pol, {}),
    "energy": (lambda: energy(lower=-5.0, upper=5.0), {}),
}
every_method = pytest.mark.parametrize("method", FINE)


@pytest.mark.parametrize("name", PROBLEMS)
@every_method
def test_solutions_are_stationary_and_feasible_in_the_program(name: str, method: str) -> None:
    problem, parameters = PROBLEMS[name]
    prepared = prepare(problem(), FINE[method])
    assert isinstance(prepared, Prepared)
    plan = prepared.solve(parameters)
    form, transcription = prepared.formulation, prepared.transcription
    p = form.parameter_vector(parameters)
    low, high = form.bound_values(p)
    arguments = {"p": p}
    for kind, index in (("x", transcription.variable_bounds), ("g", transcription.row_bounds)):
        arguments |= {f"lb{kind}": low[index], f"ub{kind}": high[index]}
    rows = np.asarray(prepared.program.values(plan.variables, p)[1].full()).ravel()
    outcome = Outcome(plan.variables, plan.cost, rows, plan.multipliers, plan.status, "", 0, 0.0)
    at = conditions(prepared.program, outcome, arguments, unit_scales(transcription))
    for value, push, lower, upper in (
        (plan.variables, at.of_bounds, arguments["lbx"], arguments["ubx"]),
        (rows, at.of_rows, arguments["lbg"], arguments["ubg"]),
    ):
        assert np.all(value >= lower - 1e-9)
        assert np.all(value <= upper + 1e-9)
        options = lower == upper
        # what pushes stands at its limit, and at the right one
        assert np.all(np.maximum(push, 0)[~options] * np.minimum(1.0, (upper - value)[~options]) < 1e-8)
        assert np.all(np.maximum(-push, 0)[~options] * np.minimum(1.0, (value - lower)[~options]) < 1e-8)


@pytest.mark.parametrize("name", ["swing", "moved"])
def test_plans_pass_their_audit(name: str) -> None:
    problem, parameters = PROBLEMS[name]
    by = {s: solve(problem(), Collocation(24), parameters=parameters, solver=s).audit() for s in SOLVERS}
    assert by["ipopt"].feasible
    assert by["fatrop"].feasible
    assert by["ipopt"].passed == by["fatrop"].passed


def test_units_of_states_controls_rows_and_cost_do_not_matter() -> None:
    def in_units(scale: float, strength: float, price: float) -> Problem:
        problem = Problem("in units")
        q, w = problem.state("q", initial=0.0, terminal=scale), problem.state("w", initial=0.0, terminal=0.0)
        u = problem.control("u", lower=-5 * strength, upper=5 * strength)
        problem.dynamics(q, w)
        problem.dynamics(w, u * scale / strength)
        problem.path("effort", w + u * scale / strength, upper=8 * scale)
        problem.horizon(1.0)
        problem.minimize(running=price * (u / strength) ** 2)
        return problem

    plain = solve(in_units(1.0, 1.0, 1.0), Collocation(8))
    for scale, strength, price in 10.0 ** np.random.default_rng(0).uniform(-5, 5, (6, 3)):
        plan = solve(in_units(scale, strength, price), Collocation(8))
        assert plan.cost == pytest.approx(price * plain.cost, rel=1e-7)
        assert relative(plan.costates["q"], price / scale * plain.costates["q"]) < 1e-5
        for name, unit in (("q", scale), ("w", scale), ("u", strength)):
            assert relative(plan[name], unit * plain[name]) < 1e-5


def test_other_parameters_may_make_equalities_of_limits() -> None:
    """A control that a parameter pins down, and one that it lets go again."""
    problem = Problem("pinned")
    x = problem.state("x", initial=1.0)
    reach = problem.parameter("reach")
    u = problem.control("u", 2, lower=ca.vertcat(-1.0, -reach), upper=ca.vertcat(1.0, reach))
    problem.dynamics(x, u[0] + u[1])
    problem.horizon(1.0)
    problem.minimize(running=x**2 + 0.1 * ca.sumsqr(u))
    prepared = prepare(problem, Collocation(6))
    for value in (0.0, 0.5, 0.0, 50.0, 0.5):
        result, anew = prepared.solve({"reach": value}), solve(problem, Collocation(6), parameters={"reach": value})
        assert result.cost == pytest.approx(anew.cost, rel=1e-9)
        if value == 0.0:
            np.testing.assert_allclose(result["u"][:, 1], 0.0, atol=1e-12)


def test_the_ceiling_that_leaves_no_freedom_is_reached() -> None:
    """Bryson-Denham problem with contact at the nodes: the bound has no multiplier there."""
    problem = Problem("Bryson-Denham")
    x, v = problem.state("x", initial=0.0, terminal=0.0, upper=1 / 9), problem.state("v", initial=1.0, terminal=-1.0)
    u = problem.control("u")
    problem.dynamics(x, v)
    problem.dynamics(v, u)
    problem.horizon(1.0)
    problem.minimize(running=u**2 / 2)
    prepared = prepare(problem, Collocation(12))
    assert isinstance(prepared, Prepared)
    plan = prepared.solve()
    assert plan.cost == pytest.approx(4.0, abs=2e-3)
    assert prepared.solve(guess=plan).cost == pytest.approx(plan.cost, rel=1e-9)
    assert prepared.solve(guess=plan, shift=2).success


def test_more_equalities_in_an_interval_than_variables_are_refused() -> None:
    problem = Problem("crowded")
    x, u = problem.state("x", initial=0.0), problem.control("u")
    problem.dynamics(x, u)
    problem.horizon(1.0)
    problem.path("rate", u, 1.0, 1.0)
    problem.path("twice", 2 * u, 2.0, 2.0)
    problem.path("place", x - problem.time, 0.0, 0.0)
    problem.minimize(running=u**2)
    with pytest.raises(SolveError, match="Not_Enough_Degrees_Of_Freedom"):
        solve(problem, Collocation(4))


def test_what_grows_beyond_all_numbers_on_the_way_is_solved() -> None:
    """Far beyond where the steps of Runge and Kutta are stable."""
    problem = Problem("stiff")
    x, u = problem.state("x", initial=1.0), problem.control("u", lower=-1.0, upper=1.0)
    problem.dynamics(x, u - 1000 * (x - ca.cos(problem.time)))
    problem.horizon(1.0)
    problem.minimize(running=x**2 + u**2)
    assert solve(problem, MultipleShooting(10, steps=2)).success


def test_one_interval_of_one_state() -> None:
    """From .1 to 0 in 1 s by a force that is held: exp(-1) / 10 + (1 - exp(-1)) u = 0."""
    problem = Problem("one")
    x, u = problem.state("x", initial=0.1, terminal=0.0), problem.control("u", lower=-3.0, upper=3.0)
    problem.dynamics(x, u - x)
    problem.horizon(1.0)
    problem.minimize(running=u**2)
    plan = solve(problem, MultipleShooting(1, steps=20))
    assert plan["u"][0] == pytest.approx(-0.1 / (np.e - 1), rel=1e-6)


@every_method
@pytest.mark.parametrize("share", [0.95, 1.05])
def test_a_straight_rod_is_the_least_of_energy_up_to_its_buckling_load(share: float, method: str) -> None:
    """Clamped at both ends it stays straight up to 4 pi^2 of its stiffness over its length squared (Euler)."""
    problem = Problem("rod")
    angle = problem.state("angle", initial=0.0, terminal=0.0)
    aside = problem.state("aside", initial=0.0, terminal=0.0)
    bend = problem.control("bend", lower=-10.0, upper=10.0)
    problem.dynamics(angle, bend)
    problem.dynamics(aside, ca.sin(angle))
    problem.horizon(1.0)
    problem.minimize(running=bend**2 / 2 + share * 4 * np.pi**2 * ca.cos(angle))
    plan = solve(problem, FINE[method], check=False)
    assert float(np.abs(plan["angle"]).max()) < 1e-9
    if share > 1.0:
        assert plan.regularised


def test_a_stationary_plan_that_is_no_minimum_is_left() -> None:
    """x'' = x + u from rest at 0, max x(T)^2: to stay at rest is stationary, and the worst there is."""
    problem = Problem("hilltop")
    x, v = problem.state("x", initial=0.0), problem.state("v", initial=0.0)
    u = problem.control("u", lower=-1.0, upper=1.0)
    problem.dynamics(x, v)
    problem.dynamics(v, x + u)
    problem.horizon(2.0)
    problem.minimize(terminal=-(x**2))
    plan = solve(problem, Collocation(10))
    assert plan.start == "downhill"
    assert plan.cost == pytest.approx(-((np.cosh(2.0) - 1) ** 2), rel=1e-4)


def test_two_threads_solve_at_once() -> None:
    prepared = [prepare(van_der_pol(), Collocation(n)) for n in (20, 30)]
    expected = [one.solve().cost for one in prepared]
    results: list[list[float]] = [[], []]

    def work(i: int) -> None:
        for _ in range(5):
            results[i].append(prepare(van_der_pol(), Collocation((20, 30)[i])).solve().cost)
            results[i].append(prepared[i].solve().cost)

    threads = [threading.Thread(target=work, args=(i,)) for i in range(2)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert [set(costs) for costs in results] == [{cost} for cost in expected]
