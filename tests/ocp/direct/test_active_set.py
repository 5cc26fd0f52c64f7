"""Plans solved again beside themselves: the optimum of a solve from afar, in a few steps, and no other."""

from __future__ import annotations

import dataclasses
import time

import casadi as ca
import numpy as np
import pytest

from ocp import Collocation, MultipleShooting, Problem, ProblemError, prepare
from ocp.direct.guess import shifted_indices
from ocp.direct.prepared import Prepared
from tests.ocp.problems import FINE, MOVED, SOLVERS, Method, moved, relative, van_der_pol


def ready(problem: Problem, method: Method, solver: str = "ipopt") -> Prepared:
    prepared = prepare(problem, method, solver=solver)
    assert isinstance(prepared, Prepared)
    return prepared


@pytest.mark.parametrize("name", ["fastest", "strength", "duration", "way"])
@pytest.mark.parametrize("method", ["radau", "rk4-linear"])
def test_from_the_last_plan_a_few_steps_lead_to_the_next(name: str, method: str) -> None:
    """A few Newton steps suffice for small changes; larger changes lead to the same optimum as a cold start."""
    prepared = ready(moved(), FINE[method])
    plan = prepared.solve(MOVED)
    for factor in (1.0005, 0.9995, 1.04, 0.9):
        parameters = {**MOVED, name: MOVED[name] * factor}
        plan, reference = prepared.solve(parameters, plan), prepared.solve(parameters)
        assert plan.cost == pytest.approx(reference.cost, rel=1e-9)
        assert not plan.regularised
        for pool in ("states", "controls", "costates"):
            for entry, values in getattr(reference, pool).items():
                assert relative(getattr(plan, pool)[entry], values) < 1e-5, f"{pool} {entry}"
        if abs(factor - 1) < 1e-3:
            assert plan.iterations <= 5
            assert plan.solver == "newton"


@pytest.mark.parametrize("change", [{"fastest": 0.7}, {"strength": 0.5}, {"way": 1.2}, {"fastest": 0.8}], ids=str)
def test_neighbouring_plans_with_other_active_limits_follow_by_newton_steps(change: dict[str, float]) -> None:
    prepared = ready(moved(), FINE["radau"])
    near = prepared.solve(MOVED)
    cold = prepared.solve(MOVED | change)
    began = time.monotonic()
    warm = prepared.solve(MOVED | change, near)
    assert warm.solver == "newton"
    assert 0.0 < warm.seconds["solve"] <= time.monotonic() - began
    assert warm.cost == pytest.approx(cold.cost, rel=1e-9)
    assert warm["v"].max() <= (MOVED | change)["fastest"] + 1e-9
    pushed = {bool(plan["v"].max() > (MOVED | change)["fastest"] - 1e-6) for plan in (warm, cold)}
    assert len(pushed) == 1


def test_limits_that_repeat_each_other_are_no_matter() -> None:
    def repeated(times: int) -> Problem:
        problem = moved()
        v = problem.declared.states["v"].symbol
        for k in range(times):
            problem.path(f"again {k}", (k + 2) * v, upper=(k + 2) * problem.declared.parameters["fastest"].symbol)
        return problem

    costs = []
    for times in (0, 2):
        prepared = ready(repeated(times), FINE["radau"])
        plan = prepared.solve({**MOVED, "fastest": 0.7}, prepared.solve(MOVED))
        assert plan.solver == "newton"
        costs.append(plan.cost)
    assert costs[1] == pytest.approx(costs[0], rel=1e-9)


@pytest.mark.parametrize("stiffness", [8.0, 10.5, 15.0, 30.0])
def test_a_saddle_beside_a_plan_is_none(stiffness: float) -> None:
    """A rod that buckles: from about pi^2 on, the only solution becomes a saddle point between two."""
    problem = Problem("rod")
    k, x, u = problem.parameter("k"), problem.state("x", initial=[0.0]), problem.control("u")
    problem.dynamics(x, u)
    problem.horizon(1.0)
    problem.end("held", x, lower=0.0, upper=0.0)
    problem.minimize(running=u**2 - k * x**2 + x**4 - 0.05 * x)
    prepared = ready(problem, Collocation(20))
    beside = prepared.solve({"k": stiffness}, prepared.solve({"k": 5.0}))
    bowed = prepared.solve({"k": stiffness}, {"x": 0.3})
    assert beside.cost == pytest.approx(bowed.cost, rel=1e-7)
    assert beside.solver == ("newton" if stiffness < np.pi**2 else "ipopt")


def test_a_saddle_to_which_curved_steps_lead_is_none() -> None:
    """The cost curves upwards in y while |x| < pi: where Newton's steps begin, not where they end; y has no size."""
    problem = Problem("away")
    level = problem.parameter("level")
    x = problem.state("x", initial=level, terminal=level)
    y = problem.state("y", initial=0.0, terminal=0.0)
    a, b = problem.control("a"), problem.control("b")
    problem.dynamics(x, a)
    problem.dynamics(y, b)
    problem.horizon(1.0)
    problem.minimize(running=a**2 + x**2 + b**2 - x**2 * y**2)
    prepared = ready(problem, Collocation(20))
    plan = prepared.solve({"level": 2.0}, {"x": 1.0, "y": 0.1})
    assert prepared.solve({"level": 3.0}, plan).solver == "newton"
    assert prepared.solve({"level": 3.8}, plan, check=False).solver == "ipopt"


def test_units_of_states_controls_and_cost_do_not_matter() -> None:
    """With scales of powers of two nothing is rounded: the same steps lead to the same plan."""
    by_name = {}
    for scale, strength, price in ((1.0, 1.0, 1.0), (2.0**20, 1.0, 1.0), (2.0**-18, 2.0**15, 2.0**17)):
        problem = Problem("in units")
        end = problem.parameter("end")
        x = problem.state("x", 2, initial=[0.0, 0.0], terminal=ca.vertcat(end, 0.0))
        u = problem.control("u", lower=-5 * strength, upper=5 * strength)
        problem.dynamics(x, ca.vertcat(x[1], u * scale / strength - 0.2 * x[1] * ca.fabs(x[1]) / scale))
        problem.horizon(1.0)
        problem.path("speed", x[1], upper=1.4 * scale)
        problem.minimize(running=price * (u / strength) ** 2)
        prepared = ready(problem, Collocation(12))
        near, plan = prepared.solve({"end": scale}), prepared.solve({"end": 0.98 * scale})
        again = prepared.solve({"end": 0.98 * scale}, near)
        assert again.solver == "newton"
        assert again.cost == pytest.approx(plan.cost, rel=1e-9)
        assert relative(again["x"], plan["x"]) < 1e-7
        by_name[scale] = again.iterations
    assert len(set(by_name.values())) == 1, by_name


def test_one_of_several_equal_optima_is_found() -> None:
    """Two motors of which the sum counts alone: rounding says whether the cost curves along their difference."""
    problem = Problem("two motors")
    x = problem.state("x", initial=[0.0], terminal=problem.parameter("end"))
    one, other = problem.control("one"), problem.control("other")
    problem.dynamics(x, one + other)
    problem.horizon(1.0)
    problem.minimize(running=(one + other) ** 2 + 0.1 * x**4)
    prepared = ready(problem, Collocation(15))
    plan = prepared.solve({"end": 1.0})
    plan = dataclasses.replace(plan, regularised=False)  # which ipopt says of a plan beside others as good
    for end in np.linspace(1.0, 1.5, 6):
        plan = prepared.solve({"end": float(end)}, plan)
        assert plan.solver == "newton"
        assert plan.cost == pytest.approx(prepared.solve({"end": float(end)}).cost, rel=1e-9)


def test_limits_that_hardly_differ_are_no_matter() -> None:
    """A speed that is limited twice, by rows that differ by a thousandth."""
    problem = Problem("nearly the same")
    fast = problem.parameter("fast")
    x, u = problem.state("x", 2, initial=[0.0, 0.0], terminal=[1.0, 0.0]), problem.control("u")
    problem.dynamics(x, ca.vertcat(x[1], u))
    problem.horizon(1.0)
    problem.path("speed", x[1], upper=fast)
    problem.path("nearly speed", x[1] + 1e-3 * (x[1] - fast) * ca.cos(5 * x[0]), upper=fast)
    problem.minimize(running=u**2)
    prepared = ready(problem, Collocation(10))
    plan = prepared.solve({"fast": 1.3})
    for fast_now in (1.29, 1.25, 1.2):
        again, cold = prepared.solve({"fast": fast_now}, plan), prepared.solve({"fast": fast_now})
        assert again.solver == "newton"
        assert again.cost == pytest.approx(cold.cost, rel=1e-8)


def test_rows_are_met_so_well_that_the_cost_is_that_of_the_optimum() -> None:
    """Its slope in a limit that 27 points stand at, by small differences, is the sum of their multipliers."""
    problem = Problem("limits")
    speed = problem.parameter("speed")
    x, u = problem.state("x", 2, initial=[0.0, 0.0]), problem.control("u")
    problem.horizon(lower=0.5, upper=1.0, guess=0.9)
    problem.dynamics(x, ca.vertcat(x[1], u))
    problem.path("speed", x[1], upper=speed)
    problem.end("reach", x[0], lower=1.0)
    problem.minimize(running=u**2 / 2)
    prepared = ready(problem, Collocation(20))
    plan = prepared.solve({"speed": 1.23})
    for step in (1e-3, 1e-4, 1e-5):
        up, down = (prepared.solve({"speed": 1.23 + sign * step}, plan) for sign in (1, -1))
        assert {up.solver, down.solver} == {"newton"}
        assert (up.cost - down.cost) / (2 * step) == pytest.approx(float(plan.cost_gradient("speed")[0]), rel=1e-6)


def test_solutions_of_other_programs_are_ordinary_guesses() -> None:
    prepared = ready(moved(), FINE["radau"])
    plan = prepared.solve(MOVED)
    other = ready(moved(), Collocation(14)).solve(MOVED)
    loose = prepared.solve({**MOVED, "way": 1.0})
    for guess in (other, {"x": 0.5}, prepared.solve(MOVED, check=False)):
        assert prepared.solve(MOVED, guess).cost == pytest.approx(plan.cost, rel=1e-9)
    assert prepared.solve(MOVED, other).solver == "ipopt"
    assert prepared.solve({**MOVED, "way": 1.0}, plan).cost == pytest.approx(loose.cost, rel=1e-9)


def receding(method: Method) -> Problem:
    """A mass that is steered back to rest from where it is, with little force."""
    problem = Problem("receding")
    x = problem.state("x", 2, initial=problem.parameter("now", 2))
    u = problem.control("u", lower=-1.0, upper=1.0)
    problem.dynamics(x, ca.vertcat(x[1], u - 0.1 * x[1] ** 3))
    problem.horizon(6.0)
    problem.minimize(running=ca.sumsqr(x) + 0.1 * u**2, terminal=5 * ca.sumsqr(x))
    return problem


@pytest.mark.parametrize("method", [Collocation(30), MultipleShooting(30)], ids=["radau", "rk4"])
def test_a_horizon_that_recedes_goes_on_from_the_plan_moved_on(method: Method) -> None:
    """The next problem starts at the plan's state one interval later: the rest of the plan is nearly its solution."""
    prepared = ready(receding(method), method)
    plan = prepared.solve({"now": [3.0, 1.0]})
    steps = {0: 0, 1: 0}
    for _ in range(8):
        now = {"now": plan.at(6.0 / 30)["x"].ravel()}
        by_name = {shift: prepared.solve(now, plan, shift=shift) for shift in steps}
        cold = prepared.solve(now)
        for shift, each in by_name.items():
            steps[shift] += each.iterations
            assert each.cost == pytest.approx(cold.cost, rel=1e-9)
        assert by_name[1].solver == "newton"
        plan = by_name[1]
    assert steps[1] < steps[0]


@pytest.mark.parametrize("method", FINE)
@pytest.mark.parametrize("solver", SOLVERS)
def test_later_rows_are_the_first_rows_shifted_by_intervals(method: str, solver: str) -> None:
    transcription = ready(van_der_pol(), FINE[method], solver).transcription
    n = len(transcription.mesh) - 1
    of_x, of_g = shifted_indices(transcription, 3)
    labels = np.array(transcription.row_labels)
    for index, fractions, meanings in (
        (of_x, transcription.variable_fraction, (transcription.variable_role, transcription.variable_entry)),
        (of_g, transcription.row_fractions, (labels,)),
    ):
        for meaning in meanings:
            assert np.array_equal(meaning[index], meaning)
        moves = fractions[index] - fractions
        still = index == np.arange(len(index))
        np.testing.assert_allclose(moves[~still], 3 / n, atol=1e-9)
        # rows of the ends, the horizon and what stands in the last intervals alone have nothing later
        inner = np.isin(np.arange(len(index)), still.nonzero()[0]) & (fractions < 1 - 3.01 / n)
        assert np.mean(inner) < 0.2


@pytest.mark.parametrize("shift", [-1, 1.5, 12, "one", True, 10**400])
def test_a_shift_that_is_none_is_refused(shift: object) -> None:
    prepared = ready(van_der_pol(), Collocation(10))
    plan = prepared.solve()
    with pytest.raises(ProblemError, match="shift"):
        prepared.solve(guess=plan, shift=shift)  # type: ignore[arg-type]
    with pytest.raises(ProblemError, match="shift"):
        prepared.solve(shift=1)
    uneven = ready(van_der_pol(), Collocation(2, mesh=(0.0, 0.3, 1.0)))
    with pytest.raises(ProblemError, match="equal intervals"):
        uneven.solve(guess=uneven.solve(), shift=1)
