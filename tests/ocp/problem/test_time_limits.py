"""Limits that change in time: windows, bounds that move, rates of controls; and guesses as samples."""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np
import pytest

from ocp import Collocation, Phases, Problem, ProblemError, Solution, solve


def move(**window: Any) -> Problem:
    """From rest to rest over 1 m in 1 s at the least integral of the squared force, below a speed of 1.3 m/s."""
    problem, place, speed, _ = move_of("move")
    del place
    if window:
        problem.path("speed", speed, **window)
    return problem


def move_of(name: str) -> tuple[Problem, Any, Any, Any]:
    problem = Problem(name)
    place, speed = (problem.state(n, initial=0.0, terminal=end) for n, end in (("place", 1.0), ("speed", 0.0)))
    force = problem.control("force")
    problem.dynamics(place, speed)
    problem.dynamics(speed, force)
    problem.horizon(1.0)
    problem.minimize(running=force**2)
    return problem, place, speed, force


METHOD = Collocation(20).with_nodes_at([0.35, 0.65])


def test_a_window_that_holds_always_is_the_constraint_and_one_outside_the_peak_is_none() -> None:
    always = solve(move(upper=1.3), METHOD).cost
    free = solve(move(), METHOD).cost
    assert free == pytest.approx(12.0, rel=1e-9)
    assert solve(move(upper=1.3, during=(0.0, 1.0)), METHOD).cost == pytest.approx(always, rel=1e-7)
    assert solve(move(upper=1.3, during=(0.0, 0.2)), METHOD).cost == pytest.approx(free, rel=1e-7)


def test_a_window_limits_inside_and_only_there() -> None:
    """The speed of 6 t (1 - t) exceeds 1.3 from 0.32 to 0.68 s."""
    problem, method = move(upper=1.3, during=(0.48, 0.52)), Collocation(20).with_nodes_at([0.48, 0.52])
    solution = solve(problem, method)
    t, speed = solution.t, solution["speed"][:, 0]
    assert speed[(t >= 0.48) & (t <= 0.52)].max() <= 1.3 + 1e-7
    assert speed.max() > 1.3 + 1e-3
    assert 12.0 < solution.cost < solve(move(upper=1.3), METHOD).cost
    audit = solution.audit()
    assert audit.feasible
    assert audit.optimal is not False


def test_a_window_may_depend_on_a_parameter_and_be_saved(tmp_path: Any) -> None:
    problem, _, speed, _ = move_of("window")
    end = problem.parameter("end")
    problem.path("speed", speed, upper=1.3, during=(0.35, end))
    solution = solve(problem, METHOD, parameters={"end": 0.65})
    assert solution.cost == pytest.approx(solve(move(upper=1.3, during=(0.35, 0.65)), METHOD).cost, rel=1e-8)
    solution.save(tmp_path / "plan.npz")
    assert Solution.load(tmp_path / "plan.npz").audit().feasible


def test_bounds_that_move_are_those_of_the_difference() -> None:
    bounds = []
    for moving in (True, False):
        problem, place, _, _ = move_of("lane")
        low, high = problem.time**2 - 0.3, problem.time + 0.02
        if moving:
            problem.path("lane", place, low, high)
        else:
            problem.path("above", place - low, lower=0.0)
            problem.path("below", place - high, upper=0.0)
        bounds.append(solve(problem, Collocation(20)).cost)
    assert bounds[0] == pytest.approx(bounds[1], rel=1e-8)


def test_equal_moving_bounds_are_an_equality() -> None:
    problem, place, _, _ = move_of("track")
    problem.path("track", place, *2 * [3 * problem.time**2 - 2 * problem.time**3])
    solution = solve(problem, Collocation(12))
    assert solution.cost == pytest.approx(12.0, rel=1e-6)
    assert len(problem.declared.path) == 1


def test_a_rate_limit_is_a_control_of_the_rate() -> None:
    """A force of rate r at most from rest to rest in the least time: constant jerk, T = (32 d / r)^(1/3)."""
    problem = Problem("jerk")
    place, speed = (problem.state(n, initial=0.0, terminal=end) for n, end in (("place", 1.0), ("speed", 0.0)))
    force = problem.control("force", rate=2.0, unit="m/s^2")
    problem.start("no force", force, 0.0, 0.0)
    problem.end("no force at the end", force, 0.0, 0.0)
    problem.dynamics(place, speed)
    problem.dynamics(speed, force)
    problem.minimize(terminal=problem.horizon(lower=0.1, upper=9.0, guess=3.0))
    solution = solve(problem, Collocation(12).with_nodes_at([0.25, 0.75]))
    assert solution.horizon == pytest.approx((32 / 2.0) ** (1 / 3), rel=1e-6)
    assert np.abs(solution["force rate"]).max() <= 2.0 + 1e-6


def test_samples_are_a_guess() -> None:
    samples = np.column_stack([np.linspace(0.0, 1.0, 11), np.linspace(0.0, 1.0, 11) ** 2])
    rest = Problem("rest")
    pair = rest.state("pair", guess=samples)
    assert pair.shape == (2, 1)
    rest.dynamics(pair, np.zeros(2))
    rest.horizon(2.0)
    rest.minimize()
    point = Collocation(10).prepare(rest).solve(check=False)
    assert point.success
    whole = Phases("whole", {"only": rest})
    assert solve(whole, Collocation(5)).success


@pytest.mark.parametrize(
    ("declared", "message"),
    [
        ({"upper": 1.0, "during": (0.5, 0.2)}, "lower bound"),
        ({"lower": 1.0, "upper": 1.0, "during": (0.2, 0.5)}, "equality"),
        ({"during": (0.2, 0.5)}, "neither"),
    ],
)
def test_windows_that_are_none_are_refused(declared: dict[str, Any], message: str) -> None:
    with pytest.raises(ProblemError, match=message):
        move(**declared)


def test_a_bound_of_foreign_symbols_is_refused() -> None:
    with pytest.raises(ProblemError, match="foreign"):
        move(upper=ca.SX.sym("foreign"))


def test_a_negative_rate_is_refused() -> None:
    with pytest.raises(ProblemError, match="above upper bound"):
        Problem("jerk").control("force", rate=-1.0)
