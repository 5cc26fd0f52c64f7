"""Alternative starts after a failed guess, and the report if all of them fail."""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np
import pytest

from ocp import Collocation, MultipleShooting, Problem, Solution, SolveError, prepare, solve
from ocp.direct.guess import roll_out
from tests.ocp.problems import EVERY_METHOD, double_integrator, plant, van_der_pol


def shortest(q0: float, v0: float, q1: float, v1: float) -> float:
    """Least time of q'' = u, |u| <= 1 between two states: one switch, at speed vs with vs^2 = s (q1 - q0) + mean."""
    times = []
    for s in (1.0, -1.0):
        square = s * (q1 - q0) + (v0**2 + v1**2) / 2
        for vs in (np.sqrt(square), -np.sqrt(square)) if square >= 0 else ():
            before, after = s * (vs - v0), s * (vs - v1)
            if before >= -1e-12 and after >= -1e-12:
                times.append(before + after)
    return float(min(times))


def race(rng: np.random.Generator) -> tuple[Problem, float]:
    """A minimum-time double integrator with random ends, the exact time as guess, and that time."""
    q0, v0, q1, v1 = rng.uniform(-3, 3, 4)
    least = shortest(q0, v0, q1, v1)
    problem, *_ = double_integrator("race", (q0, v0), (q1, v1), None, limit=1.0)
    problem.minimize(terminal=problem.horizon(lower=1e-3, upper=50.0, guess=least))
    return problem, least


@pytest.mark.parametrize("method", [Collocation(20), MultipleShooting(40)], ids=["collocation", "shooting"])
def test_minimum_time_between_random_states_is_found_from_the_exact_time(method: Any) -> None:
    rng, starts = np.random.default_rng(7), []
    for _ in range(30):
        problem, least = race(rng)
        solution = solve(problem, method)
        starts.append(solution.start)
        assert -3e-4 <= solution.horizon / least - 1 <= 5e-3
    assert {"guess", "zeros"} <= set(starts)


def swing_up(**guess: Any) -> Problem:
    """A pendulum swung up by a torque of a third of its weight, from a guess."""
    problem = Problem("swing-up")
    angle = problem.state("angle", initial=0.0, terminal=np.pi, guess=guess.get("angle"))
    rate = problem.state("rate", initial=0.0, terminal=0.0, guess=guess.get("rate"))
    torque = problem.control("torque", lower=-0.35, upper=0.35, guess=guess.get("torque"))
    problem.dynamics(angle, rate)
    problem.dynamics(rate, torque - ca.sin(angle))
    problem.horizon(14.0)
    problem.minimize(running=torque**2)
    return problem


@pytest.mark.parametrize("method", [Collocation(40), MultipleShooting(60)], ids=["collocation", "shooting"])
def test_a_swing_up_is_found_whatever_the_guess(method: Any) -> None:
    for guess in ({}, {"angle": 40.0, "rate": -30.0}):
        solution = solve(swing_up(**guess), method)
        assert solution["angle"][-1, 0] == pytest.approx(np.pi, abs=1e-9)


def test_the_successful_start_is_reported_and_saved(tmp_path: Any) -> None:
    rng = np.random.default_rng(7)
    matches = [solve(race(rng)[0], Collocation(20)) for _ in range(6)]
    other = next(plan for plan in matches if plan.start != "guess")
    other.save(tmp_path / "plan.npz")
    assert Solution.load(tmp_path / "plan.npz").start == other.start
    assert solve(van_der_pol(), Collocation(5)).start == "guess"


def test_an_error_reports_the_outcome_of_every_start() -> None:
    problem, x, u = plant("too far", initial=0.5, terminal=2.0, u={"lower": -0.1, "upper": 0.1, "guess": 0.05})
    problem.dynamics(x, u)
    problem.minimize(running=u**2)
    with pytest.raises(SolveError) as caught:
        solve(problem, Collocation(5))
    lines = [line for line in str(caught.value).splitlines() if line.startswith("from the ")]
    assert [line.split(":")[0].removeprefix("from the ") for line in lines] == [
        "guess", "displaced guess", "zeros", "roll-out", "elastic plan"
    ]  # fmt: skip
    assert all(line.endswith("iterations") for line in lines)


def test_without_check_the_solver_runs_once() -> None:
    rng = np.random.default_rng(7)
    plans = [prepare(race(rng)[0], Collocation(20)).solve(check=False) for _ in range(6)]
    assert {plan.start for plan in plans} == {"guess"}
    assert {plan.success for plan in plans} == {True, False}


def test_other_starts_take_no_more_iterations_together_than_one_may() -> None:
    with pytest.raises(SolveError) as caught:
        solve(swing_up(), Collocation(40), options={"max_iter": 3})
    lines = [line for line in str(caught.value).splitlines() if line.startswith("from the ")]
    assert len(lines) == 2  # the guess and one more, which took them all


@pytest.mark.parametrize("method", EVERY_METHOD)
def test_a_roll_out_obeys_the_dynamics(method: str) -> None:
    """x' = -x + 1 from 0: 1 - exp(-t)."""
    problem, x, u = plant("relaxing", initial=0.0, u={"guess": 1.0}, horizon=0.5)
    problem.dynamics(x, u - x)
    built = EVERY_METHOD[method].prepare(problem)
    transcription = built.transcription
    point = np.where(transcription.variable_role == "control", 1.0, 0.3)
    point[transcription.start] = 0.0
    rolled = roll_out(built.formulation, transcription, point, np.zeros(0))
    state = transcription.variable_role == "state"
    np.testing.assert_allclose(rolled[state], 1 - np.exp(-0.5 * transcription.variable_fraction[state]), atol=2e-5)
    np.testing.assert_array_equal(rolled[~state], point[~state])


def test_a_roll_out_that_breaks_down_stands_still_from_there() -> None:
    problem, x, u = plant("blow-up", initial=1.0, horizon=60.0)
    problem.dynamics(x, x**3 + u)
    built = Collocation(30).prepare(problem)
    rolled = roll_out(built.formulation, built.transcription, np.ones(built.transcription.size), np.zeros(0))
    assert np.isfinite(rolled).all()
