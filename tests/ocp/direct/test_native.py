"""The interior-point method over the stages: the optimum of ipopt with its multipliers."""

from __future__ import annotations

import os
import threading
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
import pytest

from models import FixedBase
from ocp import Collocation, MultipleShooting, Problem, ProblemError, SolveError, inverse_kinematics, prepare, solve
from ocp.builders.redundancy import minimum_velocity_problem
from ocp.direct import native
from ocp.direct.guess import initial_point, later
from ocp.direct.kkt import conditions
from ocp.direct.nlp import Outcome
from ocp.direct.prepared import Prepared
from ocp.direct.scaling import unscaled
from ocp.direct.stages import Tables
from scripts.robots.panda import HOME, LAP, circling
from scripts.robots.robots import PANDA
from tests.ocp.direct.test_nlp import INTERRUPTED, obstacle, run, soft_lander, too_far
from tests.ocp.problem.flights import two_burns
from tests.ocp.problems import METHODS, SWING, Method, energy, relative, swing, van_der_pol

FINE: dict[str, Method] = {
    "radau": Collocation(10),
    "radau-held": Collocation(10, 2, control="held"),
    "legendre": Collocation(10, scheme="legendre"),
    "rk4-held": MultipleShooting(12, steps=2),
    "rk4-linear": MultipleShooting(12, steps=2, control="linear"),
}


def moved() -> Problem:
    """Bounds, an end and a horizon that are parameters; a cost of the end."""
    problem = Problem("moved")
    x, v = problem.state("x", initial=0.0), problem.state("v", initial=0.0, upper=problem.parameter("fastest"))
    u = problem.control("u", lower=-problem.parameter("strength"), upper=2.0)
    problem.dynamics(x, v)
    problem.dynamics(v, u - 0.3 * v * ca.fabs(v) - ca.sin(x))
    problem.horizon(problem.parameter("duration"))
    way = problem.parameter("way")
    problem.end("there", x, way, way)
    problem.path("power", u * v, upper=0.8)
    problem.minimize(running=u**2, terminal=v**2)
    return problem


MOVED = {"fastest": 0.75, "strength": 1.0, "duration": 3.0, "way": 1.4}
PROBLEMS: dict[str, tuple[Any, dict[str, Any]]] = {
    "lander": (soft_lander, {}),
    "obstacle": (obstacle, {}),
    "swing": (swing, SWING),
    "moved": (moved, MOVED),
    "van der pol": (van_der_pol, {}),
    "energy": (lambda: energy(lower=-5.0, upper=5.0), {}),
}
every_problem = pytest.mark.parametrize("name", PROBLEMS)
every_method = pytest.mark.parametrize("method", FINE)


def built(problem: Problem, method: Method, **options: Any) -> Prepared:
    prepared = prepare(problem, method, solver="native", **options)
    assert isinstance(prepared, Prepared)
    return prepared


# ---- the optimum -------------------------------------------------------------------------------------------------


@every_problem
@every_method
def test_the_optimum_and_its_multipliers_are_those_of_ipopt(name: str, method: str) -> None:
    problem, parameters = PROBLEMS[name]
    a, b = (solve(problem(), FINE[method], solver=s, parameters=parameters) for s in ("ipopt", "native"))
    assert b.solver == "native"
    assert b.cost == pytest.approx(a.cost, rel=1e-9, abs=1e-9)
    assert b.horizon == pytest.approx(a.horizon, rel=1e-7)
    for pool in ("states", "controls", "costates", "cost_gradients"):
        for entry, values in getattr(a, pool).items():
            assert relative(getattr(b, pool)[entry], values) < 1e-5, f"{pool} {entry}"


@every_problem
@every_method
def test_what_is_found_is_stationary_and_feasible_in_the_program(name: str, method: str) -> None:
    """Against the derivatives that other solvers are given: no table of stages is in between."""
    problem, parameters = PROBLEMS[name]
    prepared = built(problem(), FINE[method])
    plan = prepared.solve(parameters)
    form, fragment = prepared.formulation, prepared.fragment
    p = form.parameter_vector(parameters)
    low, high = form.bound_values(p)
    arguments = {"p": p}
    for kind, index in (("x", fragment.variable_bounds), ("g", fragment.row_bounds)):
        arguments |= {f"lb{kind}": low[index], f"ub{kind}": high[index]}
    rows = np.asarray(prepared.program.values(plan.variables, p)[1].full()).ravel()
    outcome = Outcome(plan.variables, plan.cost, rows, plan.multipliers, True, "", 0, 0.0)
    at = conditions(prepared.program, outcome, arguments, unscaled(fragment))
    for value, push, lower, upper in (
        (plan.variables, at.of_bounds, arguments["lbx"], arguments["ubx"]),
        (rows, at.of_rows, arguments["lbg"], arguments["ubg"]),
    ):
        assert np.all(value >= lower - 1e-9)
        assert np.all(value <= upper + 1e-9)
        given = lower == upper
        # what pushes stands at its limit, and at the right one
        assert np.all(np.maximum(push, 0)[~given] * np.minimum(1.0, (upper - value)[~given]) < 1e-8)
        assert np.all(np.maximum(-push, 0)[~given] * np.minimum(1.0, (value - lower)[~given]) < 1e-8)


@pytest.mark.parametrize("name", ["lander", "swing", "moved"])
def test_plans_pass_their_audit(name: str) -> None:
    problem, parameters = PROBLEMS[name]
    method = Collocation(40, control="held") if name == "lander" else Collocation(24)
    by = {s: solve(problem(), method, parameters=parameters, solver=s) for s in ("ipopt", "native")}
    assert by["native"].solver == "native"
    audits = {s: plan.audit() for s, plan in by.items()}
    assert audits["native"].passed == audits["ipopt"].passed
    assert audits["native"].feasible == audits["ipopt"].feasible


@pytest.mark.parametrize("method", ["cvodes-held", "points"])
def test_functions_that_are_no_expressions_are_solved(method: str) -> None:
    transcription = MultipleShooting(3, integrator="cvodes") if method == "cvodes-held" else Collocation(5, 9)
    a, b = (solve(van_der_pol(), transcription, solver=s) for s in ("ipopt", "native"))
    assert b.solver == "native"
    assert b.cost == pytest.approx(a.cost, rel=1e-8)


@pytest.mark.parametrize("method", METHODS)
def test_a_stage_has_its_states_and_controls_and_what_its_dynamics_define_is_inside(method: str) -> None:
    prepared = built(van_der_pol(), METHODS[method])
    tables, fragment = prepared._solver.tables, prepared.fragment
    form = prepared.formulation
    # a control of an interval, held, at its points, or at its end; never a state
    free = np.bincount(tables.stage[fragment.variable_role == "control"], minlength=len(tables.nx))
    carried = tables.nx - form.nx - form.horizon_is_free
    np.testing.assert_array_equal(tables.nu, free - carried)
    inside = len(fragment.interpolants.nodes) - ("radau" in method or "rk4" in method)
    assert np.all(tables.nz[:-1] == form.nx * (1 if "rk4" in method else inside))
    assert tables.nz[-1] == 0


def test_units_of_states_controls_rows_and_cost_do_not_matter() -> None:
    rng, by_native = np.random.default_rng(0), 0
    for scale, strength, price in 10.0 ** rng.uniform(-5, 5, (6, 3)):
        problem = Problem("in units")
        q, w = problem.state("q", initial=0.0, terminal=scale), problem.state("w", initial=0.0, terminal=0.0)
        u = problem.control("u", lower=-5 * strength, upper=5 * strength)
        problem.dynamics(q, w)
        problem.dynamics(w, u * scale / strength)
        problem.path("effort", w + u * scale / strength, upper=8 * scale)
        problem.horizon(1.0)
        problem.minimize(running=price * (u / strength) ** 2)
        a, prepared = solve(problem, Collocation(8)), built(problem, Collocation(8))
        b = prepared.solve()
        assert b.cost == pytest.approx(a.cost, rel=1e-7)
        assert relative(b.costates["q"], a.costates["q"]) < 1e-5
        for name in ("q", "w", "u"):
            assert relative(b[name], a[name]) < 1e-5
        if b.solver == "ipopt":  # its tolerance is absolute, and missed by little in some units
            continue
        by_native += 1
        p = np.zeros(0)
        bounds = prepared.formulation.bound_values(p)
        found = prepared._attempt("", b.variables, set(), prepared._arguments(p, bounds), bounds).outcome
        rows = prepared.program.numbers.values(found.variables, p)[1]
        assert float(np.abs(rows).max()) > scale
        np.testing.assert_allclose(found.rows, rows, rtol=1e-9, atol=1e-9 * scale)
    assert by_native >= 3


@pytest.mark.parametrize("end", [0.2, 0.8])
def test_states_inside_intervals_are_sought_from_the_guess(end: float) -> None:
    """One step of Euler backwards along x' = x^2 / s has two ends, x = x0 + x^2 / s: s / 5 and 4 s / 5."""
    size = 1e6
    problem = Problem("two ends")
    x, u = problem.state("x", initial=0.16 * size), problem.control("u")
    problem.dynamics(x, x**2 / size + u)
    problem.horizon(1.0)
    problem.minimize(running=(u / size) ** 2)
    plan = built(problem, Collocation(1, 1)).solve(guess={"x": 1.01 * end * size}, check=False)
    assert plan.solver == "native"
    assert plan["x"][-1] == pytest.approx(end * size, rel=1e-9)


def test_other_parameters_may_make_equalities_of_limits() -> None:
    """A control that a parameter pins down, and one that it lets go again: each has a solver of its own."""
    problem = Problem("pinned")
    x = problem.state("x", initial=1.0)
    reach = problem.parameter("reach")
    u = problem.control("u", 2, lower=ca.vertcat(-1.0, -reach), upper=ca.vertcat(1.0, reach))
    problem.dynamics(x, u[0] + u[1])
    problem.horizon(1.0)
    problem.minimize(running=x**2 + 0.1 * ca.sumsqr(u))
    prepared, other = built(problem, Collocation(6)), prepare(problem, Collocation(6))
    for value in (0.0, 0.5, 0.0, 50.0, 0.5):
        found = prepared.solve({"reach": value})
        assert found.solver == "native"
        assert found.cost == pytest.approx(other.solve({"reach": value}).cost, rel=1e-9)
        if value == 0.0:
            np.testing.assert_allclose(found["u"][:, 1], 0.0, atol=1e-12)


# ---- where it cannot ---------------------------------------------------------------------------------------------


def test_ipopt_takes_over_by_name_where_controls_at_the_end_are_tied() -> None:
    method = FINE["rk4-held"]
    plan = solve(swing(control_ties=True), method, solver="native", parameters=SWING)
    assert plan.solver == "ipopt"
    assert plan.cost == pytest.approx(solve(swing(control_ties=True), method, parameters=SWING).cost, rel=1e-12)


@pytest.mark.parametrize("compiler", ["false", "no-such-compiler"])
def test_ipopt_takes_over_by_name_without_a_compiler(
    compiler: str, tmp_path: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("CC", compiler)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    native.library.cache_clear()
    try:
        prepared = built(van_der_pol(), Collocation(5), options={"tol": 1e-9})
        assert prepared.solver_name == "ipopt"
        assert prepared.solve().solver == "ipopt"
    finally:
        monkeypatch.undo()
        native.library.cache_clear()


def test_ipopt_takes_over_by_name_where_the_guess_defines_no_states() -> None:
    """A step of Euler backwards from .3, x = .3 + x^2 + u, has no x where u is zero, as in the guess."""
    problem = Problem("beyond")
    x, u = problem.state("x", initial=0.3), problem.control("u")
    problem.dynamics(x, x**2 + u)
    problem.horizon(1.0)
    problem.minimize(running=(x - 0.2) ** 2 + u**2)
    method = Collocation(1, 1)
    prepared = built(problem, method)
    plan, alone = prepared.solve(), solve(problem, method, solver="ipopt")
    assert plan.solver == "ipopt"
    # by the program that ipopt has alone, not by that of the stages
    assert plan.iterations == alone.iterations
    np.testing.assert_array_equal(plan.variables, alone.variables)
    # where the controls of a guess are those of a plan there are states
    again = built(problem, method).solve(guess={"x": plan["x"], "u": plan["u"], "t": plan.t})
    assert again.solver == "native"
    assert again.cost == pytest.approx(plan.cost, rel=1e-9)
    assert prepared.solve(guess=plan).cost == pytest.approx(plan.cost, rel=1e-9)


def test_a_plan_that_has_moved_on_is_handed_over_as_it_is() -> None:
    """Where native does not get on, ipopt begins at what the plan has so many intervals later, as native did."""
    problem, method, ahead = van_der_pol(), Collocation(10, 3), 2
    prepared, other = built(problem, method), prepare(problem, method, solver="ipopt")
    assert isinstance(other, Prepared)
    plan = prepared.solve()
    moved = prepared._moved(plan.variables[later(prepared.fragment, ahead)[0]], np.zeros(0))
    # the control at the start is that of the interval behind it, at other nodes that of the one before
    for name, first in (("x", 0), ("u", 1)):
        np.testing.assert_allclose(moved[name][first : -3 * ahead], plan[name][3 * ahead + first :], atol=1e-12)
    form, fragment = other.formulation, other.fragment
    start = initial_point(form, fragment, moved, form.bound_values(np.zeros(0)))
    np.testing.assert_allclose(other._moved(start, np.zeros(0))["x"], moved["x"], atol=1e-12)

    prepared._solver.options["max_iter"] = 0
    found = prepared.solve(guess=replace(plan, regularised=True), shift=ahead)  # which no steps of Newton's begin from
    assert found.solver == "ipopt"
    np.testing.assert_array_equal(found.variables, other.solve(guess=moved).variables)


def test_the_ceiling_that_leaves_no_freedom_is_reached() -> None:
    """Bryson-Denham's, in contact on the nodes: its bound does not push there."""
    problem = Problem("Bryson-Denham")
    x, v = problem.state("x", initial=0.0, terminal=0.0, upper=1 / 9), problem.state("v", initial=1.0, terminal=-1.0)
    u = problem.control("u")
    problem.dynamics(x, v)
    problem.dynamics(v, u)
    problem.horizon(1.0)
    problem.minimize(running=u**2 / 2)
    prepared = built(problem, Collocation(12))
    plan = prepared.solve()
    assert plan.solver == "native"
    assert plan.cost == pytest.approx(4.0, abs=2e-3)
    assert prepared.solve(guess=plan).cost == pytest.approx(plan.cost, rel=1e-9)
    assert prepared.solve(guess=plan, shift=2).success


def test_a_transfer_by_two_burns_is_solved_from_a_coarser_plan() -> None:
    """Phases of free length, and curvature that must be shifted on the way: fatrop did that for ever."""
    coarse = solve(two_burns(), Collocation(20, 5), solver="ipopt")
    a, b = (solve(two_burns(), Collocation(40, 4), guess=coarse, solver=s) for s in ("ipopt", "native"))
    assert b.solver == "native"
    assert b.cost == pytest.approx(a.cost, rel=1e-9)


def test_a_closed_lap_whose_end_its_task_nearly_implies_is_solved() -> None:
    """Of seven joints that come back six follow from the tip's way, but for what the intervals miss."""
    machine = FixedBase(PANDA.read())
    start = inverse_kinematics(machine, circling(), near=HOME, starts=0)[0].joints
    problem = minimum_velocity_problem(
        machine, task=circling(), start_joints=start, horizon=LAP, cyclic=True, free_start=True
    )
    a, b = (solve(problem, Collocation(10), solver=s) for s in ("ipopt", "native"))
    assert b.solver == "native"
    assert b.cost == pytest.approx(a.cost, rel=1e-9)


def test_auto_is_native_where_it_is_at_hand_and_ipopt_where_options_are_given() -> None:
    assert not native.why_not()  # else there is no compiler here
    problem, method = van_der_pol(), Collocation(5)
    assert solve(problem, method).solver == "native"
    assert solve(problem, method, options={"max_iter": 50}).solver == "ipopt"


@pytest.mark.long
def test_auto_is_ipopt_while_the_driver_is_compiled(tmp_path: Any) -> None:
    code = f"""
    import os, time
    os.environ["XDG_CACHE_HOME"] = {str(tmp_path)!r}
    from ocp import Collocation, solve
    from ocp.direct.native import is_at_hand
    from tests.ocp.problems import van_der_pol
    print(solve(van_der_pol(), Collocation(5)).solver)
    while not is_at_hand():
        time.sleep(0.1)
    print(solve(van_der_pol(), Collocation(5)).solver)
    """
    assert run(code).stdout.split() == ["ipopt", "native"]


def test_curvature_over_stages_is_left_to_ipopt(monkeypatch: pytest.MonkeyPatch) -> None:
    def apart(self: Tables) -> None:
        raise ProblemError("a stage-ordered program cannot couple stages that are apart; use ipopt")

    monkeypatch.setattr(Tables, "_check", apart)
    prepared = built(van_der_pol(), Collocation(5))
    assert prepared.solver_name == "ipopt"
    assert prepared.solve().solver == "ipopt"


def test_more_equalities_in_a_stage_than_variables_are_refused_and_do_not_end_the_process() -> None:
    problem = Problem("crowded")
    x, u = problem.state("x", initial=0.0), problem.control("u")
    problem.dynamics(x, u)
    problem.horizon(1.0)
    problem.path("rate", u, 1.0, 1.0)
    problem.path("twice", 2 * u, 2.0, 2.0)
    problem.path("place", x - problem.time, 0.0, 0.0)
    problem.minimize(running=u**2)
    with pytest.raises(SolveError, match="Not_Enough_Degrees_Of_Freedom"):
        solve(problem, Collocation(4), solver="native")


@pytest.mark.parametrize("method", ["radau", "rk4-held"])
def test_infeasible_problems_are_refused_as_by_ipopt(method: str) -> None:
    told = {}
    for solver in ("ipopt", "native"):
        with pytest.raises(SolveError) as caught:
            solve(too_far(), METHODS[method], solver=solver)
        told[solver] = caught.value
    assert "problem 'too far': ipopt ended with " in str(told["native"])
    names = {s: [(c.label, round(c.amount, 5)) for c in error.conflicts] for s, error in told.items()}
    assert names["native"] == names["ipopt"]
    assert names["native"]


def test_what_is_no_number_is_told_and_what_grows_beyond_all_numbers_is_left_to_ipopt() -> None:
    """In a process of its own, for what could loop for ever."""
    code = """
    import casadi as ca
    from ocp import Collocation, MultipleShooting, Problem, SolveError, solve
    from tests.ocp.direct.test_nlp import rooted
    try:
        solve(rooted(), Collocation(3), solver="native")
    except SolveError as error:
        print("told:", error)
    problem = Problem("stiff")
    x, u = problem.state("x", initial=1.0), problem.control("u", lower=-1.0, upper=1.0)
    problem.dynamics(x, u - 1000 * (x - ca.cos(problem.time)))
    problem.horizon(1.0)
    problem.minimize(running=x**2 + u**2)
    # far beyond where the steps of Runge and Kutta are stable
    plan = solve(problem, MultipleShooting(10, steps=2), solver="native", time_limit=20.0)
    print(plan.solver, plan.success)
    """
    done = run(code, timeout=60)
    assert "told: problem 'rooted'" in done.stdout, done.stderr
    assert "ipopt True" in done.stdout, done.stderr


@pytest.mark.parametrize("solver", ["ipopt", "native"])
def test_one_interval_of_one_state(solver: str) -> None:
    """From .1 to 0 in 1 s by a force that is held: exp(-1) / 10 + (1 - exp(-1)) u = 0."""
    problem = Problem("one")
    x, u = problem.state("x", initial=0.1, terminal=0.0), problem.control("u", lower=-3.0, upper=3.0)
    problem.dynamics(x, u - x)
    problem.horizon(1.0)
    problem.minimize(running=u**2)
    plan = solve(problem, MultipleShooting(1, steps=20), solver=solver)
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
    plan = built(problem, FINE[method]).solve(check=False)
    assert plan.solver == "native"
    assert float(np.abs(plan["angle"]).max()) < 1e-9
    assert plan.regularised == (share > 1.0)


def test_a_stationary_plan_that_is_no_minimum_is_left() -> None:
    """x'' = x + u from rest at 0, max x(T)^2: to stay at rest is stationary, and the worst there is."""
    problem = Problem("hilltop")
    x, v = problem.state("x", initial=0.0), problem.state("v", initial=0.0)
    u = problem.control("u", lower=-1.0, upper=1.0)
    problem.dynamics(x, v)
    problem.dynamics(v, x + u)
    problem.horizon(2.0)
    problem.minimize(terminal=-(x**2))
    plan = solve(problem, Collocation(10), solver="native")
    assert plan.start == "downhill"
    assert plan.cost == pytest.approx(-((np.cosh(2.0) - 1) ** 2), rel=1e-4)


@pytest.mark.parametrize(
    "options", [{"max_itr": 5}, {"max_iter": "many"}, {1: 2}, {"max_iter": 2.5}, {"tol": np.nan}, {"tol": None}]
)
def test_options_that_it_does_not_take_are_named(options: Any) -> None:
    with pytest.raises(ProblemError, match="native does not take this option"):
        solve(energy(), Collocation(2), solver="native", options=options)


# ---- to be stopped -----------------------------------------------------------------------------------------------


def test_ctrl_c_stops_a_solve_and_carries_the_last_iterate() -> None:
    # with check, what is interrupted may be ipopt's build; earlier, on a busy machine, what comes before the solver
    code = INTERRUPTED.replace("(False, True)", "(False, False)").replace("sleep 0.05", "sleep 0.2")
    done = run(f"SOLVER = 'native'\n{code}")
    assert done.stdout.splitlines() == [
        "False User_Requested_Stop: interrupted (2401, 2)",
        "restored True",
        "False User_Requested_Stop: interrupted (2401, 2)",
        "restored True",
        "afterwards True",
        "Ctrl-C works as before",
    ], done.stdout + done.stderr


def test_a_time_limit_stops_a_solve() -> None:
    prepared = built(van_der_pol(), Collocation(300, 4))
    began = time.monotonic()
    with pytest.raises(SolveError, match="Maximum_WallTime_Exceeded"):
        prepared.solve(time_limit=0.01)
    assert time.monotonic() - began < 5
    assert prepared.solve().solver == "native"


def test_options_reach_it() -> None:
    plan = solve(van_der_pol(), Collocation(5), solver="native", options={"max_iter": 2}, check=False)
    assert not plan.success
    assert plan.status.startswith("Maximum_Iterations_Exceeded")
    assert plan.solver == "native"
    assert plan.iterations <= 3


def test_two_threads_solve_at_once() -> None:
    prepared = [built(van_der_pol(), Collocation(n)) for n in (20, 30)]
    expected = [one.solve().cost for one in prepared]
    found: list[list[float]] = [[], []]

    def work(i: int) -> None:
        for _ in range(10):
            found[i].append(built(van_der_pol(), Collocation((20, 30)[i])).solve().cost)
            found[i].append(prepared[i].solve().cost)

    threads = [threading.Thread(target=work, args=(i,)) for i in range(2)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert [set(costs) for costs in found] == [{cost} for cost in expected]


def test_memory_is_given_back() -> None:
    """Solvers that are thrown away take their memory in C with them."""

    def resident() -> int:
        return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")

    def work(n: int) -> None:
        for _ in range(n):
            prepared._solver._handles.clear()
            prepared.solve()

    prepared = built(van_der_pol(), Collocation(100))
    work(5)
    before = resident()
    work(20)
    assert resident() - before < 20e6  # one of them has 4e6
