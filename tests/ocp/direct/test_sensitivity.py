"""Derivatives of plans in parameters are the differences of plans solved again, as far as they say they reach."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import casadi as ca
import numpy as np
import pytest

from ocp import Collocation, Indirect, MultipleShooting, Problem, ProblemError, Sensitivity, Solution, prepare, solve
from tests.ocp.problems import MOVED, Method, energy, moved, relative, started_anywhere, swing, van_der_pol


def loaded(upper: float = np.inf) -> Problem:
    """An arm that lifts a payload, in a fixed time, its torque limited."""
    problem = Problem("loaded")
    payload = problem.parameter("payload")
    angle, rate = problem.state("angle", initial=0.0, terminal=1.0), problem.state("rate", initial=0.0, terminal=0.0)
    torque = problem.control("torque", lower=-upper, upper=upper)
    problem.dynamics(angle, rate)
    problem.dynamics(rate, (torque - 2.0 * payload * ca.cos(angle)) / (1.0 + payload))
    problem.horizon(1.5)
    problem.minimize(running=torque**2)
    return problem


def fastest() -> Problem:
    """To a place in least time, with drag that is a parameter and a limit that is another."""
    problem = Problem("fastest")
    drag, strength = problem.parameter("drag"), problem.parameter("strength")
    x, v = problem.state("x", initial=0.0, terminal=1.0), problem.state("v", initial=0.0, terminal=0.0)
    u = problem.control("u", lower=-strength, upper=strength)
    horizon = problem.horizon(lower=0.5, upper=5.0, guess=2.0)
    problem.dynamics(x, v)
    problem.dynamics(v, u - drag * v)
    problem.minimize(running=0.1 * u**2, terminal=horizon)
    return problem


def fenced() -> Problem:
    """A path row whose level is a parameter, and a start that is one."""
    problem = Problem("fenced")
    level, place = problem.parameter("level"), problem.parameter("place", 2)
    x = problem.state("x", 2, initial=place)
    u = problem.control("u", 2)
    problem.dynamics(x, u - 0.1 * x**3)
    problem.horizon(2.0)
    problem.path("fence", x[0] + 0.2 * x[1] ** 2, upper=level)
    problem.minimize(running=ca.sumsqr(u) + ca.sumsqr(x - ca.DM([1.0, 0.5])))
    return problem


CASES: dict[str, tuple[Callable[[], Problem], Method, dict[str, Any], str]] = {
    "payload": (loaded, Collocation(8), {"payload": 0.5}, "payload"),
    "payload, limited": (lambda: loaded(4.0), Collocation(8), {"payload": 0.5}, "payload"),
    "payload, shooting": (lambda: loaded(4.2), MultipleShooting(10, steps=2), {"payload": 0.4}, "payload"),
    "drag": (fastest, Collocation(8), {"drag": 0.3, "strength": 4.0}, "drag"),
    "strength": (fastest, Collocation(8, 2, control="held"), {"drag": 0.3, "strength": 1.5}, "strength"),
    "start": (started_anywhere, Collocation(6), {"x0": [1.0, 0.3]}, "x0"),
    "start, limited": (lambda: started_anywhere(upper=0.4), Collocation(6), {"x0": [1.0, 0.3]}, "x0"),
    "swing": (swing, MultipleShooting(12, steps=2, control="linear"), {"k": [1.0, 1.1]}, "k"),
    "way": (moved, Collocation(10, scheme="legendre"), MOVED, "way"),
    "duration": (moved, Collocation(10), MOVED, "duration"),
    "level": (fenced, Collocation(6), {"level": 0.5, "place": [0.0, 0.0]}, "level"),
    "place": (fenced, MultipleShooting(8), {"level": 0.5, "place": [0.0, 0.0]}, "place"),
}
STEPS = ((1.0, 8 / 12), (2.0, -1 / 12))  # of the central difference of fourth order


def sensitivities(plan: Solution) -> dict[str, np.ndarray]:
    return {**plan.states, **plan.controls, "horizon": np.array([plan.horizon])}


@pytest.mark.parametrize("case", CASES)
def test_derivatives_are_the_differences_of_plans_solved_again(case: str) -> None:
    build, method, parameters, name = CASES[case]
    prepared = prepare(build(), method)
    plan = prepared.solve(parameters)
    result = plan.sensitivity(name)
    assert isinstance(result, Sensitivity)
    for k in range(len(result.value)):
        room = min(result.value[k] - result.lower[k], result.upper[k] - result.value[k])
        assert room > 0
        h = min(2e-3, 0.4 * room)
        rates = {key: np.zeros_like(value) for key, value in sensitivities(plan).items()}
        cost = 0.0
        for steps, weight in STEPS:
            for sign in (1.0, -1.0):
                value = result.value.copy()
                value[k] += sign * steps * h
                other = prepared.solve({**parameters, name: value}, plan)
                cost += sign * weight / h * other.cost
                for key, values in sensitivities(other).items():
                    rates[key] += sign * weight / h * values
        assert result.cost[k] == pytest.approx(cost, rel=1e-6, abs=1e-6)
        for key, rate in rates.items():
            mine = result.horizon[[k]] if key == "horizon" else result[key][:, :, k]
            assert relative(mine, rate) < 1e-6, key


def pushing(plan: Solution, bound: float) -> np.ndarray:
    return np.asarray(np.abs(np.abs(plan["torque"][1:, 0]) - bound) < 1e-6)


def test_the_range_ends_where_the_limits_that_push_change() -> None:
    """Within the reported range the active torques stay the same, to first order; the next limit is named."""
    prepared = prepare(loaded(4.0), Collocation(8))
    plan = prepared.solve({"payload": 0.5})
    result = plan.sensitivity("payload")
    assert pushing(plan, 4.0).any()
    assert result.lower[0] < 0.5 < result.upper[0]
    inside = [result.value + 0.9 * (end - result.value) for end in (result.lower, result.upper)]
    outside = [result.value + 1.5 * (end - result.value) for end in (result.lower, result.upper)]
    now = pushing(plan, 4.0)
    for value in inside:
        assert np.array_equal(pushing(prepared.solve({"payload": value}), 4.0), now)
    for value in outside:
        assert not np.array_equal(pushing(prepared.solve({"payload": value}), 4.0), now)
    assert all("torque" in word for word in result.limits[0])
    assert f"payload = 0.5: same active limits from {result.lower[0]:.6g}" in str(result)


def test_a_linear_plan_moves_linearly_without_end() -> None:
    """x' = u, int u^2 from 0 to w in 1 s: u = w, whatever w."""
    problem = Problem("linear")
    path = problem.parameter("way")
    x, u = problem.state("x", initial=0.0, terminal=path), problem.control("u")
    problem.dynamics(x, u)
    problem.horizon(1.0)
    problem.minimize(running=u**2)
    result = solve(problem, Collocation(3), parameters={"way": 2.0}).sensitivity("way")
    np.testing.assert_allclose(result["u"], 1.0, atol=1e-9)
    np.testing.assert_allclose(result["x"][:, 0, 0], result.t, atol=1e-9)
    assert (result.lower[0], result.upper[0], result.limits[0]) == (-np.inf, np.inf, ("", ""))
    assert result.cost[0] == pytest.approx(4.0, abs=1e-8)
    assert result.horizon[0] == 0.0


def test_a_plan_that_was_saved_tells_how_it_moves(tmp_path: Any) -> None:
    plan = solve(loaded(4.0), Collocation(6), parameters={"payload": 0.5})
    plan.save(tmp_path / "plan.npz")
    result, again = (p.sensitivity("payload") for p in (plan, Solution.load(tmp_path / "plan.npz")))
    np.testing.assert_array_equal(result["torque"], again["torque"])


def test_solutions_without_derivatives_are_refused() -> None:
    plan = solve(loaded(), Collocation(4), parameters={"payload": 0.5})
    wrong: Any
    for wrong in ("payloat", None, ["payload"], 3):
        with pytest.raises(ProblemError, match="payload"):
            plan.sensitivity(wrong)
    with pytest.raises(ProblemError, match="sensitivities need a plan of Collocation"):
        solve(energy(), Indirect()).sensitivity("x")
    stopped = solve(van_der_pol(), Collocation(4), options={"max_iter": 1}, check=False)
    with pytest.raises(ProblemError, match="it is not an optimum"):
        stopped.sensitivity("x")
