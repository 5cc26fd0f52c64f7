"""Scaling by sizes: plans do not depend on units, results keep their units, and bad scaling is reported."""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np
import pytest

from ocp import Collocation, MultipleShooting, Problem, SolveError, prepare, solve
from ocp.direct.scaling import scaled_program
from tests.ocp.problems import SWING, swing

METHODS: dict[str, Any] = {"collocation": Collocation(20), "shooting": MultipleShooting(30)}
EVERY = pytest.mark.parametrize("method", METHODS.values(), ids=METHODS)
UNITS = [(1e9, 1.0), (1.0, 1e-6), (1e9, 1e-6), (1e-6, 1e3), (1e-9, 1e-6), (1e9, 1e4)]


def drive(metre: float, second: float, price: float = 1.0, push: float | None = None, order: int = 1) -> Problem:
    """A metre in a second from rest to rest with minimal energy, in other units of length and time."""
    problem = Problem("drive")
    bounds: dict[str, Any] = (
        {} if push is None else {"lower": -push * metre / second**2, "upper": push * metre / second**2}
    )
    ends = {"q": metre, "v": 0.0}
    names = list(ends)[::order]
    states = {name: problem.state(name, initial=0.0, terminal=ends[name]) for name in names}
    u = problem.control("u", **bounds)
    problem.dynamics(states["q"], states["v"])
    problem.dynamics(states["v"], u)
    problem.horizon(second)
    problem.minimize(running=price * u**2 / 2)
    return problem


def race(metre: float, second: float, guess: bool) -> Problem:
    """A metre from rest to rest with at most 1 m/s^2 in minimal time, 2 s."""
    problem = Problem("race")
    q, v = problem.state("q", initial=0.0, terminal=metre), problem.state("v", initial=0.0, terminal=0.0)
    u = problem.control("u", lower=-metre / second**2, upper=metre / second**2)
    problem.dynamics(q, v)
    problem.dynamics(v, u)
    report: dict[str, Any] = {"guess": second} if guess else {}
    problem.minimize(terminal=problem.horizon(lower=1e-3 * second, upper=100 * second, **report))
    return problem


def swing_up(metre: float, second: float) -> Problem:
    """A pendulum of a metre, 1 kg and gravity of 1 m/s^2 is swung up in 5 s."""
    problem = Problem("swing-up")
    angle, rate = problem.state("angle", initial=0.0, terminal=np.pi), problem.state("rate", initial=0.0, terminal=0.0)
    inertia = metre**2
    most = 2 * inertia / second**2
    torque = problem.control("torque", lower=-most, upper=most)
    problem.dynamics(angle, rate)
    problem.dynamics(rate, torque / inertia - ca.sin(angle) / second**2)
    problem.horizon(5 * second)
    problem.minimize(running=torque**2)
    return problem


@EVERY
@pytest.mark.parametrize(("metre", "second"), UNITS)
def test_plans_do_not_depend_on_units(method: Any, metre: float, second: float) -> None:
    for build, energy in ((lambda m, s: drive(m, s, push=5.0), metre**2 / second**3), (swing_up, metre**4 / second**3)):
        plain, other = solve(build(1.0, 1.0), method), solve(build(metre, second), method)
        assert other.start == "guess"
        assert other.cost == pytest.approx(plain.cost * energy, rel=1e-6)
        for name in plain.states:
            units = {"q": metre, "v": metre / second, "angle": 1.0, "rate": 1 / second}
            np.testing.assert_allclose(other[name] / units[name], plain[name], atol=2e-5)
            # cost per unit of the state
            size = np.abs(plain.costate(name)).max()
            np.testing.assert_allclose(
                other.costate(name) * units[name] / energy, plain.costate(name), atol=1e-4 * size
            )


@EVERY
@pytest.mark.parametrize("guess", [True, False], ids=["with a guess", "without"])
@pytest.mark.parametrize(("metre", "second"), UNITS)
def test_the_least_time_does_not_depend_on_units(method: Any, metre: float, second: float, guess: bool) -> None:
    assert solve(race(metre, second, guess), method).horizon == pytest.approx(2 * second, rel=2e-3)


@pytest.mark.parametrize("price", [1e-12, 1e-6, 1e6, 1e12])
def test_plans_do_not_depend_on_the_unit_of_the_cost(price: float) -> None:
    solution = solve(drive(1.0, 1.0, price), Collocation(10))
    assert solution.cost == pytest.approx(6 * price, rel=1e-8)
    np.testing.assert_allclose(solution.costate("q"), -12 * price, rtol=1e-6)


def test_plans_do_not_depend_on_the_order_of_declaration() -> None:
    a, b = (solve(drive(1e9, 1e-6, push=5.0, order=order), Collocation(20)) for order in (1, -1))
    np.testing.assert_allclose(b["q"], a["q"], rtol=1e-6, atol=1e3)
    assert b.cost == pytest.approx(a.cost, rel=1e-9)


@pytest.mark.parametrize("metre", [1.0, 1e9])
def test_gradients_of_the_cost_stay_in_the_units_of_the_problem(metre: float) -> None:
    """Cost 6 L^2 / T^3."""
    problem = Problem("far")
    far = problem.parameter("far")
    q, v = problem.state("q", initial=0.0, terminal=far), problem.state("v", initial=0.0, terminal=0.0)
    u = problem.control("u")
    problem.dynamics(q, v)
    problem.dynamics(v, u)
    problem.horizon(1.0)
    problem.minimize(running=u**2 / 2)
    solution = solve(problem, Collocation(10), parameters={"far": metre})
    assert solution.cost_gradient("far")[0] == pytest.approx(12 * metre, rel=1e-8)


def test_variables_near_one_are_not_scaled() -> None:
    a, b = (prepare(swing(), Collocation(8), scaling=scaling).solve(SWING) for scaling in (True, False))
    np.testing.assert_array_equal(a.variables, b.variables)
    np.testing.assert_array_equal(a.multipliers, b.multipliers)


def test_a_scaled_program_is_the_program_in_other_variables() -> None:
    rng = np.random.default_rng(5)
    program = MultipleShooting(3).prepare(swing()).program
    n, m = program.nlp["x"].numel(), program.nlp["g"].numel()
    a, b, c = np.exp2(rng.integers(-20, 20, n)), np.exp2(rng.integers(-20, 20, m)), 2.0**-7
    scaled, p = scaled_program(program), np.array(SWING["k"])
    x, lam = rng.uniform(0.5, 1.5, n), rng.normal(size=m)
    q = np.concatenate([p, a, b, [c]])
    slope = scaled.gradient(x / a, q)[1]
    np.testing.assert_allclose(slope.full()[:, 0], program.gradient(x, p)[1].full()[:, 0] * a / c, rtol=1e-14)
    g, jacobian = scaled.jacobian(x / a, q)
    rows, plain = program.jacobian(x, p)
    np.testing.assert_array_equal(g.full().ravel(), rows.full().ravel() / b)
    np.testing.assert_allclose(jacobian.full(), plain.full() * a / b[:, None], rtol=1e-14)
    curved = scaled.hessian(x / a, q, 1.5, lam).full()
    np.testing.assert_allclose(curved, program.hessian(x, p, 1.5 / c, lam / b).full() * a * a[:, None], rtol=1e-13)


def reported_scaling(problem: Problem, method: Any, scaling: bool = True) -> str:
    with pytest.raises(SolveError) as caught:
        prepare(problem, method, scaling=scaling).solve()
    return str(caught.value)


def test_only_badly_scaled_problems_are_reported_as_such() -> None:
    words = reported_scaling(drive(1e9, 1.0, push=5.0), Collocation(8), scaling=False)
    assert "badly scaled: " in words
    assert "leave scaling on" in words
    assert "meets all constraints" not in words
    assert "all constraints can hold together" not in words
    assert "would have to go" not in words


def test_infeasible_problems_are_not_reported_as_badly_scaled() -> None:
    words = reported_scaling(drive(1e9, 1.0, push=3.0), Collocation(8))
    assert "badly scaled" not in words
    assert "u would have to go" in words


def test_nothing_is_called_impossible_and_possible_at_once() -> None:
    for words in (
        reported_scaling(drive(1.0, 1.0, push=3.0), Collocation(8)),
        reported_scaling(drive(1e9, 1.0, push=3.0), Collocation(8)),
    ):
        assert not ("no point near the guess" in words and "\nall constraints can hold together" in words)


def test_conflicts_are_reported_in_the_units_of_the_problem() -> None:
    """4 m/s^2 are needed."""
    with pytest.raises(SolveError) as caught:
        solve(drive(1e9, 1.0, push=3.0), Collocation(20))
    (conflict,) = caught.value.conflicts
    assert conflict.label == "u"
    assert conflict.amount == pytest.approx(1e9, rel=0.02)
    assert abs(conflict.bound) == 3e9
