from __future__ import annotations

import re
from dataclasses import replace
from typing import Any

import casadi as ca
import pytest

from ocp import Collocation, MultipleShooting, Problem, SolveError, solve

METHODS = [Collocation(8), Collocation(8, scheme="legendre"), Collocation(8, control="held"), MultipleShooting(8)]
NUMBER = r"(-?[\d.]+(?:e-?\d+)?)"


def conflicts(problem: Problem, method: Any, **settings: Any) -> list[tuple[str, float, float, float | None]]:
    """(label, amount, bound, time) of every line of the error."""
    with pytest.raises(SolveError) as caught:
        solve(problem, method, **settings)
    pattern = rf"^  (.+) would have to go {NUMBER} beyond its \w+ bound {NUMBER}(?: at {NUMBER} s)?$"
    found = re.findall(pattern, str(caught.value), re.MULTILINE)
    return [(name, float(amount), float(bound), float(at) if at else None) for name, amount, bound, at in found]


def drive(distance: float = 1.0, push: float = 1.0, **bounds: Any) -> tuple[Problem, Any, Any]:
    """Rest to rest by a bounded push; takes a push of 4 distance / T^2."""
    problem = Problem("drive")
    q = problem.state("q", initial=0.0, terminal=distance)
    v = problem.state("v", initial=0.0, terminal=0.0, **bounds)
    u = problem.control("u", lower=-push, upper=push)
    problem.dynamics(q, v)
    problem.dynamics(v, u)
    problem.minimize(running=u**2)
    return problem, q, v


@pytest.mark.parametrize("solver", ["ipopt", "fatrop"])
@pytest.mark.parametrize("method", METHODS, ids=str)
def test_a_control_limit_that_is_too_low_is_named_with_what_lacks(method: Any, solver: str) -> None:
    problem, _, _ = drive()
    problem.horizon(1.0)
    (found,) = conflicts(problem, method, solver=solver)
    assert found[0] == "u"
    assert found[1] == pytest.approx(3.0, abs=0.07)  # 4 less 1, on a grid
    assert abs(found[2]) == 1.0


@pytest.mark.parametrize("method", METHODS, ids=str)
def test_a_state_limit_that_is_too_low_is_named_with_what_lacks_and_when(method: Any) -> None:
    """1 m in 1 s at 0.5 m/s with all the push one likes: 0.5 m/s lack."""
    problem, _, _ = drive(push=1e3, upper=0.5)
    problem.horizon(1.0)
    (found,) = conflicts(problem, replace(method, intervals=40))
    assert found[0] == "v"
    assert found[1] == pytest.approx(0.5, abs=0.04)
    assert found[2] == 0.5
    assert found[3] is not None
    assert 0 < found[3] < 1


def test_a_path_constraint_in_the_way_is_named_where_it_stands() -> None:
    """A wall at 0.7 m between 0.4 and 0.6 of the way, while a gate asks for 0.9 m in the middle."""
    problem, q, _ = drive(push=1e3)
    time = problem.time
    problem.path("wall", q - 0.7 - 100 * (time - 0.5) ** 2, upper=0.0)
    problem.path("gate", q - 0.9 + 100 * (time - 0.5) ** 2, lower=0.0)
    problem.horizon(1.0)
    found = conflicts(problem, Collocation(20))
    assert {name for name, *_ in found} <= {"wall", "gate"}
    assert sum(amount for _, amount, _, _ in found) == pytest.approx(0.2, abs=0.01)
    assert all(at is not None and 0.4 < at < 0.6 for *_, at in found)


def test_a_final_time_that_is_too_short_is_named() -> None:
    """A speed of 1 m/s and at most 0.9 s for 1 m; the speed may not give way, for it stands in the dynamics."""
    problem = Problem("race")
    q = problem.state("q", initial=0.0, terminal=1.0)
    u = problem.control("u", lower=-1.0, upper=1.0)
    problem.dynamics(q, u / (1 + u**4))  # at most 0.5699 m/s, wherever u goes
    final = problem.horizon(lower=0.1, upper=0.9, guess=0.5)
    problem.minimize(terminal=final)
    found = conflicts(problem, MultipleShooting(10))
    assert found[0][0] == "horizon"
    assert found[0][1] == pytest.approx(1 / 0.5699 - 0.9, abs=5e-3)
    assert found[0][3] is None


def test_a_plan_that_exists_is_not_called_impossible() -> None:
    problem = Problem("pendulum")
    angle, rate = problem.state("angle", initial=0.0, terminal=3.1), problem.state("rate", initial=0.0, terminal=0.0)
    torque = problem.control("torque", lower=-30.0, upper=30.0)
    problem.dynamics(angle, rate)
    problem.dynamics(rate, torque - 9.81 * ca.sin(angle))
    problem.path("wavy", ca.cos(3 * angle) * rate, upper=6.0)
    problem.horizon(1.5)
    problem.minimize(running=torque**2)
    with pytest.raises(SolveError, match="all constraints can hold together at the points of this grid"):
        solve(problem, Collocation(8), options={"max_iter": 2})


@pytest.mark.parametrize("solver", ["ipopt", "fatrop"])
def test_a_condition_that_ties_both_ends_gives_way_or_makes_a_limit_do_so(solver: str) -> None:
    problem = Problem("tied")
    q = problem.state("q")
    u = problem.control("u", lower=-1.0, upper=1.0)
    far = problem.parameter("far")
    problem.dynamics(q, u)
    problem.horizon(1.0)
    problem.start("from", q, lower=0.0, upper=0.0)
    problem.end("far", q - problem.at_start(q), lower=far)
    problem.minimize(running=u**2)
    with pytest.raises(SolveError) as caught:
        solve(problem, Collocation(6), parameters={"far": 1.5}, solver=solver)
    found = re.search(rf"^  u would have to go {NUMBER} beyond", str(caught.value), re.MULTILINE)
    assert found is not None
    assert float(found[1]) == pytest.approx(0.5, abs=1e-3)
