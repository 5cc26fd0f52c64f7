"""The indirect method on the paper's example, on arms, and on every shape of problem, against fine direct solutions."""

from __future__ import annotations

import time
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
import pytest

from models import FixedBase, FreeFloating, Machine, paper_example
from ocp import (
    Collocation,
    Indirect,
    Limits,
    MultipleShooting,
    Problem,
    Solution,
    TipTask,
    minimum_velocity_problem,
    prepare,
    solve,
)
from ocp.problem.formulation import Formulation
from scripts.papers.free_floating import formulations
from tests.families import some
from tests.models.robot.trees import numeric, seven_joint_arm
from tests.ocp.indirect.extremals import EXTREMA
from tests.ocp.problems import Array, energy, plant

pytestmark = pytest.mark.xdist_group("indirect")  # one process, so that every problem is solved once

PAPER_COST = 1.735114311245  # two independent methods, to twelve digits
PAPER_START = np.deg2rad([45.0, 60.0, -60.0])
FORMULATIONS = ("rates", "null_space")
SHOOTINGS = ("multiple", "backward")

every_extremum = pytest.mark.parametrize("name", some(EXTREMA, 8))


def paper_problem(formulation: Any = "rates", machine: Machine | None = None, horizon: float = 5.0) -> Problem:
    declare = formulations.problem if formulation == "rates" else formulations.null_space_problem
    return declare(horizon, machine=machine)


@cache
def paper_direct(formulation: str) -> Solution:
    return solve(paper_problem(formulation), Collocation(100, 3, "legendre"))


@cache
def paper_indirect(formulation: str, shooting: str) -> Solution:
    return solve(paper_problem(formulation), Indirect(shooting=shooting), guess=paper_direct(formulation))


@cache
def solved(name: str) -> tuple[Solution, Solution]:
    """Indirect (which seeds itself) and direct solution of a problem."""
    case = EXTREMA[name]
    parameters = dict(case.parameters)
    return (
        solve(case.build(), Indirect(), parameters=parameters),
        solve(case.build(), case.direct, parameters=parameters),
    )


def stacked(solution: Solution) -> tuple[Array, Array, Array]:
    """States, costates and controls at the reported times, columns side by side."""
    x, lam = (np.hstack([pool[name] for name in solution.states]) for pool in (solution.states, solution.costates))
    return x, lam, np.hstack([np.zeros((len(solution.t), 0)), *solution.controls.values()])


def hamiltonian(solution: Solution, problem: Problem) -> Array:
    """H = L + lambda . f at the reported times, from the declared expressions alone. Shape (M,)."""
    declared = problem.declared
    assert declared.horizon is not None
    x, lam, u = stacked(solution)
    columns = [ca.vertcat(*[v.symbol for v in pool.values()]) for pool in (declared.states, declared.controls)]
    f = ca.vertcat(*[declared.dynamics[name] for name in declared.states])
    parameters = ca.vertcat(problem.symbols(0, 1), *[v.symbol for v in declared.parameters.values()])
    symbols = [*columns, problem.time, declared.horizon.symbol, parameters]
    function = ca.Function("h", symbols, [declared.running, f])
    p = np.concatenate([np.zeros(0), *solution.parameters.values()])
    ones = np.ones((1, len(solution.t)))
    running, rate = function.map(len(solution.t))(
        x.T, u.T, solution.t[None, :], solution.horizon * ones, p[:, None] * ones
    )
    values: Array = np.asarray(running.full()).ravel() + np.einsum("km,mk->m", np.asarray(rate.full()), lam)
    return values


# ---- the paper's example -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("shooting", SHOOTINGS)
@pytest.mark.parametrize("formulation", FORMULATIONS)
def test_the_paper_example_has_its_known_cost(formulation: str, shooting: str) -> None:
    solution = paper_indirect(formulation, shooting)
    assert abs(solution.cost - PAPER_COST) < 1e-9
    assert solution.success
    assert solution.iterations <= 10
    assert solution.audit().passed


@pytest.mark.parametrize("shooting", SHOOTINGS)
@pytest.mark.parametrize("formulation", FORMULATIONS)
def test_the_hamiltonian_of_the_paper_example_is_constant_and_its_costates_end_at_zero(
    formulation: str, shooting: str
) -> None:
    solution = paper_indirect(formulation, shooting)
    assert np.ptp(hamiltonian(solution, paper_problem(formulation))) < 1e-9
    for name in solution.states:
        assert np.max(np.abs(solution.costate(name)[-1])) < 1e-9


@pytest.mark.parametrize("formulation", FORMULATIONS)
def test_the_joint_rates_of_the_paper_follow_from_the_costates(formulation: str) -> None:
    """(26), (31): x2' = (1 - G# G) u* + G# v with u* = E2' E1^-T lambda1 - lambda2, whichever form was solved."""
    machine, solution = paper_example(), paper_indirect(formulation, "multiple")
    for k in range(0, len(solution.t), 17):
        base, joints = solution["base"][k], solution["joints"][k]
        reaction = np.column_stack([numeric(machine.base_rate(base, joints, e)).ravel() for e in np.eye(3)])
        u = -reaction.T @ solution.costate("base")[k] - solution.costate("joints")[k]
        task = numeric(machine.tip_jacobian(base, joints))[3:5]
        inverse = np.linalg.pinv(task)
        own, push = u - inverse @ (task @ u), inverse @ [-1.0, -1.0]
        rates = solution["rates"][k] if formulation == "rates" else solution["null"][k] + push
        np.testing.assert_allclose(rates, own + push, atol=1e-9)


@pytest.mark.parametrize("formulation", FORMULATIONS)
def test_costates_of_the_paper_example_agree_with_those_of_collocation(formulation: str) -> None:
    direct, indirect = paper_direct(formulation), paper_indirect(formulation, "multiple")
    places = direct.t / direct.horizon
    mine, other = indirect.costate_interpolant(places), stacked(direct)[1]
    assert np.max(np.abs(mine - other)) < 1e-5 * np.max(np.abs(other))


@pytest.mark.parametrize(
    ("shooting", "seed"), [("multiple", Collocation(12)), ("backward", MultipleShooting(25))], ids=SHOOTINGS
)
def test_a_coarse_seed_is_enough_for_the_paper_example(shooting: str, seed: Collocation | MultipleShooting) -> None:
    problem = paper_problem()
    solution = solve(problem, Indirect(shooting=shooting), guess=solve(problem, seed))
    assert abs(solution.cost - PAPER_COST) < 1e-9
    assert solution.iterations <= 10


@pytest.mark.long
def test_rate_limits_of_the_paper_example_hold_exactly_beside_its_task() -> None:
    """Bounds and a path equality on one control: the free optimum has 1.36 rad/s, here all of 1.25 is used."""
    base = paper_example()
    joints = tuple(replace(joint, velocity=1.25) for joint in base.robot.joints)
    problem = paper_problem(machine=replace(base, robot=replace(base.robot, joints=joints)))
    direct = solve(problem, Collocation(60))
    solution = solve(problem, Indirect(segments=10), guess=direct)
    assert solution.method["control"] == "iterated"
    assert np.max(np.abs(solution["rates"])) == pytest.approx(1.25, abs=1e-9)
    assert solution.cost > PAPER_COST + 1e-4
    assert solution.cost == pytest.approx(direct.cost, abs=1e-5)
    assert np.ptp(hamiltonian(solution, problem)) < 1e-7
    # a rate meets its bound within a step: what the audit integrates has a corner there
    audit = solution.audit(costates=1e-5)
    assert audit.passed
    assert audit["stationarity, relative"].value < 1e-6


# ---- spatial arms ------------------------------------------------------------------------------------------------

ARM_START = np.array([0.3, 0.6, -0.2, 1.2, 0.4, 0.9, -0.3])


@pytest.mark.parametrize(
    ("machine", "horizon", "segments"),
    [(FixedBase(seven_joint_arm()), 1.5, 8), (FreeFloating(seven_joint_arm(), base="spatial"), 0.5, 2)],
    ids=["fixed", "floating"],
)
@pytest.mark.parametrize("shooting", some(SHOOTINGS, ["multiple"]))
def test_spatial_arms_agree_with_collocation(machine: Machine, horizon: float, segments: int, shooting: str) -> None:
    problem = minimum_velocity_problem(
        machine,
        TipTask(rows=[3, 4, 5], velocity=[0.1, 0.1, -0.05]),
        horizon,
        start=ARM_START,
        limits=Limits(velocity=np.inf, joints=False),
    )
    direct = solve(problem, Collocation(20, 3, "legendre"))
    solution = solve(problem, Indirect(segments=segments, shooting=shooting), guess=direct)
    assert solution.cost == pytest.approx(direct.cost, abs=1e-10)
    places = direct.t / direct.horizon
    np.testing.assert_allclose(solution.state_interpolant(places), stacked(direct)[0], atol=1e-8)
    np.testing.assert_allclose(solution.costate_interpolant(places), stacked(direct)[1], atol=1e-8)
    assert np.ptp(hamiltonian(solution, problem)) < 1e-9
    assert max(np.max(np.abs(lam[-1])) for lam in solution.costates.values()) < 1e-10
    assert solution.audit().passed


# ---- every shape of problem --------------------------------------------------------------------------------------


@every_extremum
def test_indirect_agrees_with_a_fine_direct_solution(name: str) -> None:
    case = EXTREMA[name]
    indirect, direct = solved(name)
    assert abs(indirect.cost - direct.cost) < case.cost
    assert abs(indirect.horizon - direct.horizon) < case.state
    places = direct.t / direct.horizon
    x, lam, _ = stacked(direct)
    assert np.max(np.abs(indirect.state_interpolant(places) - x)) < case.state
    assert np.max(np.abs(indirect.costate_interpolant(places) - lam)) < case.costate


@every_extremum
def test_the_control_law_is_of_the_kind_that_the_problem_has(name: str) -> None:
    case, solution = EXTREMA[name], solved(name)[0]
    assert solution.method["control"] == case.how
    assert len(solution.method["switches"]) == case.switches


@every_extremum
def test_an_indirect_solution_passes_a_strict_audit(name: str) -> None:
    """On more segments: the audit looks between the points of each, where the plan is a polynomial."""
    case = EXTREMA[name]
    fine = solve(case.build(), Indirect(segments=40), parameters=case.parameters)
    limits = {"integration": 1e-6, "constraints": 1e-6, "lost": 1e-8}
    audit = fine.audit(**limits, costates=1e-6)
    assert audit.passed, str(audit)
    reported = ("stationarity, relative", "Hamiltonian drift, relative")
    assert max(finding.value for finding in audit.findings if finding.name in reported) < 1e-6


@every_extremum
def test_the_hamiltonian_is_constant_where_time_does_not_enter(name: str) -> None:
    solution, problem = solved(name)[0], EXTREMA[name].build()
    form = Formulation(problem)
    values = hamiltonian(solution, problem)
    if form.autonomous:
        assert np.ptp(values) < 1e-6 * max(1.0, np.max(np.abs(values)))
    else:  # then its total rate is its partial one: dH/dt by the integral of the declared dependence on time
        change = values[-1] - values[0]
        assert change == pytest.approx(integral_of_time_slope(solution, problem), abs=1e-6)


def integral_of_time_slope(solution: Solution, problem: Problem) -> float:
    """Integral of dH/dt (time's own part, path equalities with multipliers of least squares) over the plan."""
    form = Formulation(problem)
    nodes, weights = np.polynomial.legendre.leggauss(8)
    breaks = solution.control_interpolant.breaks
    half = np.diff(breaks)[:, None] / 2
    places = (breaks[:-1, None] + half * (1 + nodes)).ravel()
    w = (half * weights).ravel() * solution.horizon
    lam = problem.symbols.sym("lam", form.nx)
    value = form.running + ca.dot(lam, form.f)
    outputs = [ca.gradient(value, form.t), ca.gradient(value, form.u), ca.jacobian(form.path.expression, form.u)]
    outputs += [ca.jacobian(form.path.expression, form.t)]
    function = ca.Function("s", [form.x, form.u, lam, form.t, form.T, form.p], [ca.densify(o) for o in outputs])
    p = form.parameter_vector(solution.parameters)
    total = 0.0
    for s, weight in zip(places, w, strict=True):
        at = np.array([s])
        point = [pool(at)[0] for pool in (solution.state_interpolant, solution.control_interpolant)]
        costate = solution.costate_interpolant(at)[0]
        parts = function(*point, costate, s * solution.horizon, solution.horizon, p)
        by_time, by_control, rows, rows_by_time = (np.asarray(part.full()) for part in parts)
        mu = np.linalg.lstsq(rows.T, -by_control.ravel(), rcond=None)[0] if len(rows) else np.zeros(0)
        total += float(weight) * (float(by_time[0, 0]) + float(mu @ rows_by_time.ravel()))
    return total


def test_a_free_horizon_meets_its_condition_with_the_horizon_in_every_place() -> None:
    """H(T) + dPhi/dT + integral of dH/dT = 0: the cost does not change to first order with the horizon held anew."""
    free = solved("free horizon")[0]

    def held(horizon: float) -> float:
        problem, x, u = plant("held", initial=1.0, horizon=None)
        T = problem.horizon(horizon)
        problem.dynamics(x, u * ca.exp(-0.2 * T) - x * problem.time / T)
        problem.end("gate", x - 0.2 * T, -0.1, -0.1)
        problem.minimize(running=u**2 / 2 + 0.3 * T * x**2, terminal=ca.log(1 + T**2) * x + 0.3 * T)
        return solve(problem, Indirect(), guess=free).cost

    ahead, here, behind = (held(free.horizon + d) for d in (0.01, 0.0, -0.01))
    assert here == pytest.approx(free.cost, abs=1e-11)
    assert min(ahead, behind) > free.cost
    assert (ahead - behind) / 0.02 == pytest.approx(0.0, abs=1e-4)


@pytest.mark.long
def test_backward_shooting_meets_multiple_shooting() -> None:
    """At the corners of saturated controls the integrator's error is some hundred times its tolerance of 1e-12."""
    for name in ("fixed horizon", "saturated", "coupled"):
        case = EXTREMA[name]
        forward = solved(name)[0]
        backward = solve(case.build(), Indirect(shooting="backward"), parameters=case.parameters, guess=forward)
        assert backward.cost == pytest.approx(forward.cost, abs=1e-9)
        places = np.linspace(0, 1, 50)
        for a, b in (
            (backward.state_interpolant, forward.state_interpolant),
            (backward.costate_interpolant, forward.costate_interpolant),
            (backward.control_interpolant, forward.control_interpolant),
        ):
            np.testing.assert_allclose(a(places), b(places), atol=1e-7)


# ---- closed forms ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("segments", [1, 2, 20])
def test_least_energy_is_exact(segments: int) -> None:
    solution = solve(energy(), Indirect(segments=segments))
    t = solution.t[:, None]
    assert solution.cost == pytest.approx(6, abs=1e-11)
    np.testing.assert_allclose(solution["u"], 6 - 12 * t, atol=1e-10)
    np.testing.assert_allclose(solution["q"], 3 * t**2 - 2 * t**3, atol=1e-11)
    np.testing.assert_allclose(solution.costate("q"), -12 + 0 * t, atol=1e-10)
    np.testing.assert_allclose(solution.costate("v"), 12 * t - 6, atol=1e-10)


def test_a_quartic_cost_gives_the_cube_root_of_the_costate() -> None:
    """min int u^4/4 of x' = u - x, 0 -> 1 in 1 s: lambda = -c e^t, u = (c e^t)^(1/3); x(1) = 1 gives c."""
    problem, x, u = plant("cube root", initial=0.0, terminal=1.0)
    problem.dynamics(x, u - x)
    problem.minimize(running=u**4 / 4)
    solution = solve(problem, Indirect())
    root = np.exp(1) / (0.75 * (np.exp(4 / 3) - 1))  # c^(1/3), from int e^(t/3) e^(t-1) dt = 1 / c^(1/3)
    np.testing.assert_allclose(solution["u"][:, 0], root * np.exp(solution.t / 3), atol=1e-8)
    np.testing.assert_allclose(solution.costate("x")[:, 0], -(root**3) * np.exp(solution.t), rtol=1e-8)
    assert solution.cost == pytest.approx(root**4 / 4 * 0.75 * (np.exp(4 / 3) - 1), rel=1e-9)


def test_a_heading_across_still_water_is_straight() -> None:
    case = EXTREMA["heading"]
    solution = solve(case.build(), Indirect(), parameters={"shear": 0.0})
    assert solution.horizon == pytest.approx(np.hypot(3, 2), abs=1e-10)
    heading = np.stack([np.cos(solution["angle"]), np.sin(solution["angle"])])[:, :, 0].T
    np.testing.assert_allclose(heading, np.tile([-3, 2] / np.hypot(3, 2), (len(heading), 1)), atol=1e-9)
    np.testing.assert_allclose(solution.costate("x"), -heading, atol=1e-9)


def test_two_controls_that_switch_at_once() -> None:
    """x_i' = u_i, min int cos(t) (x1 + x2) over 5 s: both costates are sin 5 - sin t, zero at 3 pi - 5."""
    problem, x, u = plant("at once", size=2, initial=[0.0, 0.0], u={"size": 2, "lower": -1, "upper": 1}, horizon=5.0)
    problem.dynamics(x, u)
    problem.minimize(running=ca.cos(problem.time) * (x[0] + x[1]))
    solution = solve(problem, Indirect())
    at = 3 * np.pi - 5
    np.testing.assert_allclose(solution.method["switches"], [at, at], atol=1e-9)
    np.testing.assert_allclose(solution.costate("x")[:, 0], np.sin(5) - np.sin(solution.t), atol=1e-10)
    np.testing.assert_allclose(solution["u"][solution.t < at - 1e-6], 1.0)
    np.testing.assert_allclose(solution["u"][solution.t > at + 1e-6], -1.0)
    assert np.all(np.diff(solution.t) > 0)
    assert solution.audit().passed


@pytest.mark.parametrize("noise", [-1e-9, 0.0, 1e-9])
def test_a_switching_function_that_vanishes_at_a_free_start_is_no_switch(noise: float) -> None:
    """q'' = u from q = 1, v free, min q(2)^2 + (v(2) - 5)^2: lambda_v = -lambda_q t, so u = 1, v(0) = -0.6, cost 16.2.

    The costate of the free initial velocity is zero: the sign of the seed's noise there must not start the plan.
    """
    problem, x, u = plant("free start, bang", size=2, initial=[1.0, np.nan], u={"lower": -1, "upper": 1}, horizon=2.0)
    problem.dynamics(x, ca.vertcat(x[1], u))
    problem.minimize(terminal=x[0] ** 2 + (x[1] - 5) ** 2)
    seed = solve(problem, Collocation(40, control="held"))
    costates = seed.costate("x").copy()
    costates[0, 1] = noise
    solution = solve(problem, Indirect(), guess=replace(seed, costates={"x": costates}))
    assert solution.method["switches"] == []
    assert solution.cost == pytest.approx(16.2, rel=1e-10)
    assert solution["x"][0, 1] == pytest.approx(-0.6, abs=1e-10)
    np.testing.assert_allclose(solution["u"], 1.0)
    np.testing.assert_allclose(solution.costate("x")[:, 1], -3.6 * solution.t, atol=1e-9)


def test_least_time_to_rest_of_an_oscillator_switches_every_half_period() -> None:
    problem = Problem("oscillator")
    x = problem.state("x", 2, initial=[3.0, 1.0], terminal=[0.0, 0.0])
    u = problem.control("u", lower=-1.0, upper=1.0)
    horizon = problem.horizon(lower=4.0, upper=9.0, guess=6.0)
    problem.dynamics(x, ca.vertcat(x[1], -x[0] + u))
    problem.minimize(terminal=horizon)
    seed = solve(problem, Collocation(60, control="held"), guess={"x": oscillation(), "u": 0.0, "horizon": 6.0})
    solution = solve(problem, Indirect(), guess=seed)
    switches = np.array(solution.method["switches"])
    np.testing.assert_allclose(np.diff(switches), np.pi, atol=1e-9)
    assert len(switches) >= 1
    assert solution.horizon == pytest.approx(solution.cost, abs=1e-10)
    np.testing.assert_allclose(hamiltonian(solution, problem), -1.0, atol=1e-9)
    assert solution.horizon <= seed.horizon + 1e-8


def oscillation() -> Array:
    t = np.linspace(0, 6, 50)
    return np.stack([3 * np.cos(t) * (1 - t / 6), -3 * np.sin(t) * (1 - t / 6)]).T


# ---- what the solution says and keeps ----------------------------------------------------------------------------


def test_the_status_says_that_it_seeded_itself() -> None:
    problem = energy()
    own = solve(problem, Indirect(seed=Collocation(7)))
    assert "seeded by its own direct solution (Collocation, 7 intervals)" in own.message
    options = solve(problem, Indirect(), guess=solve(problem, Collocation(7)))
    assert "seeded" not in options.message
    assert "seeded" in solve(problem, Indirect(), guess={"q": 0.3}).message


def test_an_indirect_solution_seeds_another() -> None:
    first = solved("bang-bang")[0]
    case = EXTREMA["bang-bang"]
    again = solve(case.build(), Indirect(), parameters=case.parameters, guess=first)
    assert again.iterations <= 2
    assert again.cost == pytest.approx(first.cost, abs=1e-10)
    np.testing.assert_allclose(again.method["switches"], first.method["switches"], atol=1e-8)


def test_a_prepared_problem_is_solved_at_several_parameters() -> None:
    case = EXTREMA["mixed"]
    prepared = prepare(case.build(), Indirect())
    for b in (0.5, 0.7):
        solution = prepared.solve({"b": b})
        assert solution.cost == pytest.approx(solve(case.build(), Indirect(), parameters={"b": b}).cost, abs=1e-12)
    assert prepared.solve({"b": 0.7}).cost < prepared.solve({"b": 0.5}).cost


@pytest.mark.parametrize("name", ["everything", "bang-bang", "coupled"])
def test_a_saved_solution_loads_whole_and_passes_its_audit(name: str, tmp_path: Path) -> None:
    solution = solved(name)[0]
    solution.save(tmp_path / "plan.npz")
    loaded = Solution.load(tmp_path / "plan.npz")
    assert loaded.method == solution.method
    assert loaded.cost == solution.cost
    assert loaded.status is solution.status
    assert loaded.message == solution.message
    for mine, other in ((loaded.costates, solution.costates), (loaded.cost_gradients, solution.cost_gradients)):
        assert list(mine) == list(other)
        for key in mine:
            np.testing.assert_array_equal(mine[key], other[key])
    assert loaded.audit(EXTREMA[name].build()).passed
    again = solve(EXTREMA[name].build(), Indirect(), parameters=EXTREMA[name].parameters, guess=loaded)
    assert again.cost == pytest.approx(solution.cost, abs=1e-10)


def test_settings_of_numpy_type_can_be_saved(tmp_path: Path) -> None:
    solution = solve(energy(), Indirect(segments=np.int64(4), tolerance=np.float64(1e-11)))  # type: ignore[arg-type]
    solution.save(tmp_path / "plan.npz")
    assert Solution.load(tmp_path / "plan.npz").method["segments"] == 4


def test_the_solver_of_the_seed_can_be_chosen() -> None:
    assert solve(energy(), Indirect(), solver="fatrop").cost == pytest.approx(6, abs=1e-10)


def test_reported_times_and_interpolants_belong_together() -> None:
    for name in ("everything", "bang-bang", "saturated"):
        solution = solved(name)[0]
        assert solution.t[0] == 0
        assert solution.t[-1] == solution.horizon
        assert np.all(np.diff(solution.t) > 0)
        x, lam, _ = stacked(solution)
        places = solution.t / solution.horizon
        np.testing.assert_allclose(solution.state_interpolant(places), x, atol=1e-9)
        np.testing.assert_allclose(solution.costate_interpolant(places), lam, atol=1e-9)


def test_the_reported_durations_of_building_and_solving_are_parts_of_the_call() -> None:
    began = time.monotonic()
    seconds = solve(energy(), Indirect()).seconds
    assert min(seconds.values()) > 0.0
    assert sum(seconds.values()) <= time.monotonic() - began
