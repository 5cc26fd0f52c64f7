"""Second order: conjugate points in closed form, the reduced Hessian of the program, and what must not change it."""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise
from typing import Any

import casadi as ca
import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.integrate import solve_ivp

from ocp import Collocation, Indirect, MultipleShooting, Problem, Solution, certificate, solve
from ocp.audit.accessory import AccessoryProblem
from ocp.audit.costates import adjoint
from ocp.audit.curvature import Curvature, curvature
from ocp.audit.linearisation import Linearisation
from ocp.audit.principle import balance
from ocp.problem.formulation import Formulation
from tests.ocp.audit.drawn import random_program
from tests.ocp.problems import Array

METHOD = Collocation(intervals=20, degree=3)


def second_order(problem: Problem, solution: Solution) -> Curvature:
    """Of a plan for a problem that it need not have been made for."""
    form = Formulation(problem)
    along = Linearisation(form, solution)
    return curvature(AccessoryProblem(along, adjoint(along, None, abs(solution.cost) or 1.0)))


def look(problem: Problem, method: Any = METHOD, **how: Any) -> tuple[Solution, Curvature]:
    solution = solve(problem, method, check=False, **how)  # as the solver leaves it
    return solution, second_order(problem, solution)


def inverse_of(rows: Array, active: NDArray[np.bool_]) -> Array:
    """Pseudo-inverses of matrices in which rows that are not active count as zero."""
    inverse = np.linalg.pinv(np.where(active[:, :, None], rows, 0.0))
    return np.asarray(np.where(active[:, None], inverse, 0.0))


def oscillator(horizon: float, stiffness: float = 1.0, unit: float = 1.0, price: float = 1.0) -> Problem:
    """min int u^2 - k x^2 from 0 to 0: a minimum until sqrt(k) T = pi, without one after it."""
    problem = Problem("oscillator")
    x = problem.state("x", initial=0.0, terminal=0.0)
    u = problem.control("u")
    problem.dynamics(x, u)
    problem.horizon(horizon)
    problem.minimize(price * (u**2 - stiffness * x**2) / unit**2)
    return problem


@pytest.mark.long
@given(st.floats(0.2, 8.0), st.floats(0.1, 30.0), st.sampled_from([1e-6, 1.0, 1e6]), st.sampled_from([1e-3, 1.0, 1e5]))
def test_a_plan_is_a_minimum_until_the_conjugate_point(share: float, k: float, unit: float, price: float) -> None:
    assume(abs(share - np.pi) >= 0.02)
    _, result = look(oscillator(share / np.sqrt(k), k, unit, price))
    assert result.upwards is (share < np.pi)
    if share > np.pi:  # the point conjugate to the end lies half a turn before it, in the interval that is named
        interval = share / np.sqrt(k) / 20
        assert result.time is not None
        assert -1e-9 <= (share - np.pi) / np.sqrt(k) - result.time <= interval * (1 + 1e-9)


def random_quadratic(rng: np.random.Generator, fixed: bool, bounded: bool) -> Problem:
    """An indefinite linear-quadratic problem whose plan is zero."""
    n, m = int(rng.integers(1, 5)), int(rng.integers(1, 3))
    a, b, q, f = rng.normal(size=(n, n)), rng.normal(size=(n, m)), rng.normal(size=(n, n)), rng.normal(size=(n, n))
    r, s = rng.normal(size=(m, m)), 0.3 * rng.normal(size=(n, m))
    problem = Problem("quadratic")
    x = problem.state("x", n, initial=np.zeros(n), terminal=np.zeros(n) if fixed else None, guess=0.0)
    u = problem.control("u", m, guess=0.0, lower=-1.0 if bounded else -np.inf, upper=1.0 if bounded else np.inf)
    problem.dynamics(x, ca.mtimes(a, x) + ca.mtimes(b, u))
    problem.horizon(float(rng.uniform(0.3, 3.0)))
    bend = 4.0 if fixed else 1.0  # an end that is given needs more of it to spoil a minimum
    running = bend * ca.bilin(ca.DM(q + q.T), x, x) / 2 + ca.bilin(ca.DM(r @ r.T + 0.3 * np.eye(m)), u, u) / 2
    problem.minimize(running + ca.dot(x, ca.mtimes(s, u)), ca.bilin(ca.DM(f + f.T), x, x) / 2)
    return problem


def reduced_hessian(problem: Problem) -> np.ndarray:
    """Eigenvalues of the program's Hessian along its equalities and active bounds, densely: an independent answer."""
    built = Collocation(intervals=8, degree=3).prepare(problem)
    solution = built.solve()
    v, transcription, program = solution.variables, built.transcription, built.program
    hessian = np.array(ca.triu2symm(program.hessian(v, [], 1.0, solution.multipliers)).full())
    low, high = built.formulation.bound_values(np.zeros(0))
    rows, columns = (low == high)[transcription.row_bounds], (low == high)[transcription.variable_bounds]
    active = np.vstack([np.array(program.jacobian(v, [])[1].full())[rows], np.eye(len(v))[columns]])
    _, sizes, directions = np.linalg.svd(active)
    basis = directions[int((sizes > 1e-10 * sizes[0]).sum()) :].T
    return np.asarray(np.linalg.eigvalsh(basis.T @ hessian @ basis))


@pytest.mark.parametrize("fixed", [True, False], ids=["to zero", "free end"])
@pytest.mark.parametrize("bounded", [True, False], ids=["bounded", "unbounded"])
def test_the_verdict_is_that_of_the_reduced_hessian(fixed: bool, bounded: bool) -> None:
    rng = np.random.default_rng(11)
    verdicts = []
    for _ in range(12):
        problem = random_quadratic(rng, fixed, bounded)
        _, result = look(problem)
        verdicts.append(result.upwards)
        assert result.upwards is bool(reduced_hessian(problem)[0] > 0)
    assert {True, False} <= set(verdicts)


@pytest.mark.long
def test_the_direction_that_is_returned_lowers_the_cost() -> None:
    rng = np.random.default_rng(3)
    seen = 0
    for fixed in (True, False) * 8:
        problem = random_quadratic(rng, fixed, False)
        solution, result = look(problem)
        if result.upwards:
            continue
        seen += 1
        assert result.direction is not None
        controls, states = result.direction
        np.testing.assert_allclose(states[0], 0, atol=1e-12)
        if fixed:
            np.testing.assert_allclose(states[-1], 0, atol=1e-7 * np.abs(states).max())
        form = Formulation(problem)
        # the cost of the linear system driven by this variation, by a Runge-Kutta method of its own
        rates = ca.Function("rates", [form.x, form.u], [form.f, form.running])
        x, cost, fractions = np.zeros(form.nx), 0.0, result.t.reshape(20, -1) / solution.horizon
        step = solution.horizon / 20 / 50
        for k, part in enumerate(controls.reshape(20, -1, form.nu)):
            places = fractions[k] * 20 - k
            for j in range(50):
                share = [(j + c) / 50 for c in (0.0, 0.5, 1.0)]
                u = [np.array([np.polyval(np.polyfit(places, part[:, i], len(places) - 1), c) for i in range(form.nu)])
                     for c in share]  # fmt: skip
                k1, k2 = rates(x, u[0]), None
                k2 = rates(x + step / 2 * np.array(k1[0]).ravel(), u[1])
                k3 = rates(x + step / 2 * np.array(k2[0]).ravel(), u[1])
                k4 = rates(x + step * np.array(k3[0]).ravel(), u[2])
                total = [np.array(a + 2 * b + 2 * c + d).ravel() / 6 for a, b, c, d in zip(k1, k2, k3, k4, strict=True)]
                x, cost = x + step * total[0], cost + step * float(total[1][0])
        np.testing.assert_allclose(x, states[-1], atol=1e-4 * np.abs(states).max())
        cost += float(ca.Function("end", [form.x], [form.terminal])(x))
        assert cost < 0
    assert seen >= 4


def double_integrator(**bounds: Any) -> Problem:
    problem = Problem("double integrator")
    q = problem.state("q", initial=0.0, terminal=1.0)
    v = problem.state("v", initial=0.0, terminal=0.0)
    u = problem.control("u", **bounds)
    problem.dynamics(q, v)
    problem.dynamics(v, u)
    problem.horizon(1.0)
    problem.minimize(u**2 / 2)
    return problem


@pytest.mark.parametrize(
    "method",
    [Collocation(20, control="held"), MultipleShooting(40), MultipleShooting(10, control="linear"), METHOD],
    ids=str,
)
def test_the_lost_cost_is_the_excess_of_a_piecewise_constant_control(method: Any) -> None:
    solution = solve(double_integrator(), method)
    audit = solution.audit()
    assert audit.optimality.curvature.upwards
    excess = solution.cost - 6.0
    assert audit.lost.sum() == pytest.approx(excess, rel=5e-3, abs=1e-9)  # the costates are those of the plan
    assert audit.passed is (excess < 6e-3)


def test_gradients_against_an_active_bound_are_no_loss() -> None:
    audit = solve(double_integrator(lower=-5.0, upper=5.0), Collocation(40)).audit()
    assert audit.optimality.curvature.upwards
    assert (audit.lost >= 0).all()
    assert audit.lost.sum() < 1e-4
    assert audit.passed, str(audit)


def test_a_maximum_in_the_control_is_named_where_it_is() -> None:
    problem = Problem("maximum")
    x = problem.state("x", initial=0.0, terminal=0.0)
    u = problem.control("u", lower=-1.0, upper=1.0)
    problem.dynamics(x, u)
    problem.horizon(1.0)
    problem.minimize(-(u**2))
    audit = solve(problem, METHOD, check=False).audit()
    assert audit.optimality.curvature.upwards is False
    assert [finding.name for finding in audit.failures] == ["curvature downwards, relative"]
    assert audit.feasible
    assert audit.optimal is False


def hurried(bend: float) -> Problem:
    """x from 0 to 1 in free T, at the cost int u^2 / 2 + (T - 1) / 2 - bend (T - 1)^2 / 2, stationary at T = 1."""
    problem = Problem("free horizon")
    x = problem.state("x", initial=0.0, terminal=1.0)
    u = problem.control("u")
    problem.dynamics(x, u)
    horizon = problem.horizon(lower=0.1, upper=10.0, guess=1.0)
    problem.minimize(u**2 / 2, (horizon - 1) / 2 - bend * (horizon - 1) ** 2 / 2)
    return problem


def test_a_free_horizon_may_turn_a_minimum_into_a_saddle() -> None:
    """The least cost over T is 1 / (2 T) + ..., whose second derivative at T = 1 is 1 - bend; its plan is the same."""
    plan = solve(hurried(0.0), METHOD)
    assert plan.horizon == pytest.approx(1.0, abs=1e-6)
    for bend, verdict in ((0.0, True), (0.9, True), (1.1, False)):
        assert second_order(hurried(bend), plan).upwards is verdict


def test_a_closed_path_may_drift_where_an_open_path_may_not() -> None:
    """x(T) = x(0) free: the constant variation costs -k x^2 T, whatever T; with the start given it does not exist."""
    for start, verdict in ((None, False), (0.0, True)):
        problem = Problem("cyclic")
        x = problem.state("x", initial=start, guess=0.0)
        u = problem.control("u", guess=0.0)
        problem.dynamics(x, u)
        problem.horizon(1.0)
        problem.end("closed", x - problem.at_start(x), 0.0, 0.0)
        problem.minimize(u**2 - 0.5 * x**2)
        _, result = look(problem)
        assert result.upwards is verdict


def test_the_conditions_at_the_end_count_with_their_multipliers() -> None:
    """The nearest and the farthest point of a circle from (c, 0): both stationary, one a minimum."""
    for side, verdict in ((1.0, True), (-1.0, False)):
        problem = Problem("to a circle")
        x = problem.state("x", initial=0.3, guess=0.3 + 0.7 * side)
        y = problem.state("y", initial=0.0)
        u, w = problem.control("u", guess=side), problem.control("w", guess=0.0)
        problem.dynamics(x, u)
        problem.dynamics(y, w)
        problem.horizon(1.0)
        problem.end("circle", x**2 + y**2, 1.0, 1.0)
        problem.minimize((u**2 + w**2) / 2)
        solution, result = look(problem, guess={"x": lambda t, s=side: 0.3 + (s - 0.3) * t, "u": side - 0.3})
        assert solution["x"][-1, 0] == pytest.approx(side)
        assert result.upwards is verdict


def test_multipliers_have_the_sign_of_the_bound_that_they_hold() -> None:
    """Three points at once: held from above, from below, from both sides."""
    gradient, eye = np.tile([-2.0, 3.0], (3, 1)), np.tile(np.eye(2), (3, 1, 1))
    lower = np.array([[False, False], [True, True], [True, True]])
    upper = np.array([[True, True], [False, False], [True, True]])
    expected = [[2.0, 0.0], [0.0, -3.0], [2.0, -3.0]]  # an upper bound pushes back only
    np.testing.assert_allclose(balance(gradient, eye, lower, upper, inverse=inverse_of(eye, lower | upper)), expected)


def test_multipliers_leave_the_least_that_their_signs_allow() -> None:
    """Against all subsets of the limits, each with the multipliers that least squares give it."""
    rng = np.random.default_rng(5)
    gradient, rows = rng.normal(size=(200, 3)), rng.normal(size=(200, 2, 3))
    upper = rng.random((200, 2)) < 0.7
    result = balance(gradient, rows, np.zeros_like(upper), upper, inverse=inverse_of(rows, upper))
    assert (result >= 0).all()
    assert (result[~upper] == 0).all()
    for k in range(200):
        best = np.inf
        for pattern in ([], [0], [1], [0, 1]):
            if not upper[k][pattern].all():
                continue
            y = np.linalg.lstsq(rows[k, pattern].T, -gradient[k], rcond=None)[0] if pattern else np.zeros(0)
            if (y >= 0).all():
                best = min(best, float(np.linalg.norm(gradient[k] + rows[k, pattern].T @ y)))
        assert np.linalg.norm(gradient[k] + rows[k].T @ result[k]) == pytest.approx(best, abs=1e-9)


METHODS = (METHOD, Collocation(20, 3, "legendre"), MultipleShooting(40, control="linear"), Indirect())


@pytest.mark.parametrize("method", METHODS, ids=str)
def test_no_method_passes_its_audit_with_a_plan_past_the_conjugate_point(method: Any) -> None:
    assert solve(oscillator(3.0), method).audit().passed
    audit = solve(oscillator(3.3), method, check=False).audit()
    assert [finding.name for finding in audit.failures] == ["curvature downwards, relative"]
    assert audit.optimality.curvature.upwards is False
    assert audit.feasible
    assert audit.optimal is False


def test_methods_that_agree_on_a_saddle_get_no_certificate() -> None:
    problem = oscillator(3.3)
    assert not certificate(problem, [solve(problem, method, check=False) for method in METHODS[::2]]).passed


def pan_tilt(turn: float) -> Problem:
    """A unit vector from one point of the equator to another along a great circle, at the least integral of speed^2."""
    problem = Problem("pan and tilt")
    pan = problem.state("pan", initial=0.0, terminal=turn)
    tilt = problem.state("tilt", initial=0.0, terminal=0.0)
    rates = problem.control("rates", 2)
    problem.dynamics(pan, rates[0])
    problem.dynamics(tilt, rates[1])
    problem.horizon(1.0)
    problem.minimize((ca.cos(tilt) * rates[0]) ** 2 + rates[1] ** 2)
    return problem


@pytest.mark.parametrize(("turn", "verdict"), [(3.0, True), (3.3, False), (5.5, False)])
def test_the_longer_great_circle_is_no_minimum(turn: float, verdict: bool) -> None:
    """Great circles are shortest up to half a turn (Jacobi); the equator is stationary for any turn."""
    guess = {"pan": lambda t: turn * t, "rates": [turn, 0.0]}
    plan = solve(pan_tilt(turn), METHOD, guess=guess, check=False)
    assert np.abs(plan["tilt"]).max() < 1e-6
    assert plan.audit().passed is verdict


def test_an_entry_that_stands_still_is_curved_as_its_neighbours_are() -> None:
    """The wrist that no task moves: its rate is rounding, and its cost curves upwards all the same."""
    problem = Problem("wrist")
    q = problem.state("q", 2, initial=np.zeros(2), terminal=[1.0, np.nan])
    rates = problem.control("rates", 2)
    problem.dynamics(q, rates + 1e-17 * ca.sin(7 * problem.time))
    problem.horizon(1.0)
    problem.minimize(ca.sumsqr(rates) * (1 + q[0] ** 2))
    solution, result = look(problem)
    assert np.abs(solution["rates"][:, 1]).max() < 1e-9
    assert result.upwards is True


# ---- what a plan loses where its variations hardly curve -------------------------------------------------------------


@pytest.mark.parametrize("bump", [0.05, 0.3])
@pytest.mark.parametrize("weight", [1.0, 7.0, 9.0, 9.6])
def test_near_a_conjugate_point_a_plan_loses_more_than_its_controls_alone_could_win(weight: float, bump: float) -> None:
    """Least int (u^2 - w x^2) / 2 from 1 to 0.5 in 1 s, w below pi^2; beside it by bump sin(pi t).

    The second variation says exactly what this costs more, bump^2 (pi^2 - w) / 4; it is bump^2 (pi - w / pi)^2 / 4
    by the slope of the Hamiltonian alone.
    """
    problem = Problem("nearly conjugate")
    x, u = problem.state("x", initial=1.0, terminal=0.5), problem.control("u")
    problem.dynamics(x, u)
    problem.horizon(1.0)
    problem.minimize((u**2 - weight * x**2) / 2 + 20)
    k = np.sqrt(weight)
    b = (0.5 - np.cos(k)) / np.sin(k)

    def place(t: Array) -> Array:
        return np.asarray(np.cos(k * t) + b * np.sin(k * t) + bump * np.sin(np.pi * t))

    def speed(t: Array) -> Array:
        return np.asarray(k * (b * np.cos(k * t) - np.sin(k * t)) + bump * np.pi * np.cos(np.pi * t))

    def costate(t: Array) -> Array:  # of lambda' = w x, zero mean of u + lambda
        path = (np.sin(k * t) + b * (1 - np.cos(k * t))) / k + bump * (1 - np.cos(np.pi * t)) / np.pi
        return np.asarray(weight * path - weight * bump / np.pi - k * b)

    plan = random_program(problem, {"x": place}, {"u": speed}, {"x": costate}, 1.0, 40)
    audit = plan.audit()
    more = bump**2 * (np.pi**2 - weight) / 4
    assert audit.feasible
    assert audit["cost lost, relative"].value * audit.optimality.cost_size == pytest.approx(more, rel=0.02)
    assert audit.optimal is (more < 1e-3 * audit.optimality.cost_size)


@pytest.mark.parametrize("intervals", [3, 5, 12])
def test_the_loss_is_the_excess_cost_on_few_intervals(intervals: int) -> None:
    """x' = u - x, min int (x^2 + u^2) / 2: the plan's controls integrated anew, beside the Riccati solution.

    What polynomials miss between their own points is seen at points of other places only.
    """
    horizon, root = 4.0, np.sqrt(2.0)
    least = np.sinh(root * horizon) / (root * np.cosh(root * horizon) + np.sinh(root * horizon)) / 2
    problem = Problem("regulator")
    x, u = problem.state("x", initial=1.0), problem.control("u")
    problem.horizon(horizon)
    problem.dynamics(x, u - x)
    problem.minimize(running=(x**2 + u**2) / 2)
    plan = solve(problem, Collocation(intervals, 3))
    curve = plan.control_interpolant
    spent = np.array([1.0, 0.0])
    for k, (begin, end) in enumerate(pairwise(curve.breaks)):
        power = np.polynomial.polynomial.polyfit(curve.nodes, curve.values[k, :, 0], len(curve.nodes) - 1)

        def rate(s: float, y: Array, begin: float = begin, end: float = end, power: Array = power) -> Array:
            push = np.polynomial.polynomial.polyval((s - begin) / (end - begin), power)
            return horizon * np.array([push - y[0], (y[0] ** 2 + push**2) / 2])

        spent = solve_ivp(rate, (begin, end), spent, rtol=1e-11, atol=1e-14).y[:, -1]
    assert float(plan.audit().lost.sum()) == pytest.approx(spent[1] - least, rel=0.05)


# ---- what the sweep does not decide ----------------------------------------------------------------------------------


def swing(running: Callable[[Any], Any] = lambda u: u**2) -> tuple[Problem, Any]:
    """A pendulum that swings to half a radian within a second."""
    problem = Problem("swing")
    angle = problem.state("angle", initial=0.0, terminal=0.5, lower=-2.0, upper=2.0)
    rate = problem.state("rate", initial=0.0, lower=-5.0, upper=5.0)
    torque = problem.control("torque", lower=-3.0, upper=3.0)
    problem.dynamics(angle, rate)
    problem.dynamics(rate, torque - ca.sin(angle))
    problem.horizon(1.0)
    problem.minimize(running(torque))
    return problem, torque


def test_a_control_in_a_condition_at_the_end_is_named() -> None:
    problem, torque = swing()
    problem.end("let go", torque, 0, 0)
    audit = solve(problem, Collocation(10)).audit()
    assert audit.feasible
    assert audit.optimal is None
    assert audit.undecided == "a control enters the conditions at an end"


def test_no_plan_costs_less_than_a_lower_bound_of_the_cost() -> None:
    """Torques up to 4 cost 1 a second, and there are none above 3: no plan is better, although nothing curves."""
    problem, _ = swing(lambda u: 1 + ca.fmax(u - 4, 0))
    audit = solve(problem, Collocation(10)).audit()
    assert audit.passed
    assert "global optimum" in audit["curvature downwards, relative"].note
