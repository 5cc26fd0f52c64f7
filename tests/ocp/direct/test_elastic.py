from __future__ import annotations

import math
import re
from dataclasses import replace
from typing import Any

import casadi as ca
import pytest

from ocp import Collocation, MultipleShooting, Problem, SolveError, solve
from ocp.direct import diagnosis as elastic
from tests.ocp.problems import plant

METHODS = [Collocation(8), Collocation(8, scheme="legendre"), Collocation(8, control="held"), MultipleShooting(8)]
NUMBER = r"(-?[\d.]+(?:e[+-]?\d+)?)"


def conflicts(problem: Problem, method: Any, **settings: Any) -> list[tuple[str, float, float, float | None]]:
    """(label, amount, bound, time) of every line of the error."""
    with pytest.raises(SolveError) as caught:
        solve(problem, method, **settings)
    pattern = rf"^  (.+) would have to go {NUMBER} beyond its \w+ bound {NUMBER}(?: at {NUMBER} s)?$"
    result = re.findall(pattern, str(caught.value), re.MULTILINE)
    return [(name, float(amount), float(bound), float(at) if at else None) for name, amount, bound, at in result]


def drive(distance: float = 1.0, push: float = 1.0, **bounds: Any) -> tuple[Problem, Any, Any]:
    """Rest to rest by a bounded force; requires a force of 4 distance / T^2."""
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
def test_a_low_control_limit_is_named_with_its_deficit(method: Any, solver: str) -> None:
    problem, _, _ = drive()
    problem.horizon(1.0)
    (result,) = conflicts(problem, method, solver=solver)
    assert result[0] == "u"
    assert result[1] == pytest.approx(3.0, abs=0.07)  # 4 less 1, on a grid
    assert abs(result[2]) == 1.0


@pytest.mark.parametrize("method", METHODS, ids=str)
def test_a_low_state_limit_is_named_with_deficit_and_time(method: Any) -> None:
    """1 m in 1 s at 0.5 m/s with all the push one likes: 0.5 m/s lack."""
    problem, _, _ = drive(push=1e3, upper=0.5)
    problem.horizon(1.0)
    (result,) = conflicts(problem, replace(method, intervals=40))
    assert result[0] == "v"
    assert result[1] == pytest.approx(0.5, abs=0.04)
    assert result[2] == 0.5
    assert result[3] is not None
    assert 0 < result[3] < 1


def test_a_blocking_path_constraint_is_named_with_its_place() -> None:
    """A wall at 0.7 m between 0.4 and 0.6 of the way, while a gate asks for 0.9 m in the middle."""
    problem, q, _ = drive(push=1e3)
    time = problem.time
    problem.path("wall", q - 0.7 - 100 * (time - 0.5) ** 2, upper=0.0)
    problem.path("gate", q - 0.9 + 100 * (time - 0.5) ** 2, lower=0.0)
    problem.horizon(1.0)
    result = conflicts(problem, Collocation(20))
    assert {name for name, *_ in result} <= {"wall", "gate"}
    assert sum(amount for _, amount, _, _ in result) == pytest.approx(0.2, abs=0.01)
    assert all(at is not None and 0.4 < at < 0.6 for *_, at in result)


def test_a_final_time_that_is_too_short_is_named() -> None:
    """A speed of 1 m/s and at most 0.9 s for 1 m; the speed cannot be relaxed, since it is part of the dynamics."""
    problem, q, u = plant("race", state="q", initial=0.0, terminal=1.0, u={"lower": -1.0, "upper": 1.0}, horizon=None)
    problem.dynamics(q, u / (1 + u**4))  # at most 0.5699 m/s, wherever u goes
    final = problem.horizon(lower=0.1, upper=0.9, guess=0.5)
    problem.minimize(terminal=final)
    result = conflicts(problem, MultipleShooting(10))
    assert result[0][0] == "horizon"
    assert result[0][1] == pytest.approx(1 / 0.5699 - 0.9, abs=5e-3)
    assert result[0][3] is None


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
def test_a_condition_on_both_ends_or_a_limit_is_relaxed(solver: str) -> None:
    problem, q, u = plant("tied", state="q", u={"lower": -1.0, "upper": 1.0})
    far = problem.parameter("far")
    problem.dynamics(q, u)
    problem.start("from", q, lower=0.0, upper=0.0)
    problem.end("far", q - problem.at_start(q), lower=far)
    problem.minimize(running=u**2)
    with pytest.raises(SolveError) as caught:
        solve(problem, Collocation(6), parameters={"far": 1.5}, solver=solver)
    search = re.search(rf"^  u would have to go {NUMBER} beyond", str(caught.value), re.MULTILINE)
    assert search is not None
    assert float(search[1]) == pytest.approx(0.5, abs=1e-3)


def between(scale: float = 1.0, draw: float = 0.0, wall: float | None = None, gate: float | None = None) -> Problem:
    """A wall at 0.7 m while a gate asks for 0.9 m, at half the time only; the cost draws towards a place.

    Each is told in a unit of its own, so that its size is its place; without one, with bound 0, so that its size is 1.
    """
    problem = Problem("between")
    q = problem.state("q", initial=0.0, terminal=1.0)
    v = problem.state("v", initial=0.0, terminal=0.0)
    u = problem.control("u", lower=-1e3, upper=1e3)
    problem.dynamics(q, v)
    problem.dynamics(v, u)
    aside = 100 * (problem.time - 0.5) ** 2
    problem.path("wall", (q - 0.7 if wall is None else wall * q) - (wall or 1.0) * aside, upper=0.7 * (wall or 0.0))
    problem.path("gate", (q - 0.9 if gate is None else gate * q) + (gate or 1.0) * aside, lower=0.9 * (gate or 0.0))
    problem.horizon(1.0)
    problem.minimize(running=scale * ((q - draw) ** 2 + 1e-3 * u**2))
    return problem


@pytest.mark.parametrize("scale", [1.0, 1e3, 1e6])
@pytest.mark.parametrize(("draw", "name"), [(0.0, "gate"), (3.0, "wall")])
def test_of_two_equal_relaxations_the_one_against_the_cost_is_chosen(draw: float, name: str, scale: float) -> None:
    """Whatever the unit of the cost."""
    result = conflicts(between(scale, draw), Collocation(20))
    assert (result[0][0], result[0][2]) == (name, 0.0)
    assert (result[0][1], result[0][3]) == pytest.approx((0.2, 0.5), abs=1e-3)
    assert all(amount < 1e-3 for _, amount, _, _ in result[1:])


@pytest.mark.parametrize("draw", [0.0, 3.0])
@pytest.mark.parametrize("wall", [1e-4, 1.0, 1e4])
@pytest.mark.parametrize("gate", [1e-4, 1.0, 1e4])
def test_units_of_constraints_scale_their_deficit_alone(gate: float, wall: float, draw: float) -> None:
    """The gate is relaxed: 0.2 m is a smaller share of its 0.9 m than of the wall's 0.7 m, whatever the cost."""
    result = conflicts(between(1.0, draw, wall, gate), Collocation(20))
    assert result[0][0] == "gate"
    assert result[0][1] == pytest.approx(0.2 * gate, rel=5e-3)
    assert result[0][2] == pytest.approx(0.9 * gate)
    assert all(amount < 1e-3 * wall for _, amount, _, _ in result[1:])


@pytest.mark.parametrize(("limit", "name", "amount"), [(0.5, "v", 0.5), (0.2, "v", 0.8), (0.08, "far", 0.92)])
def test_tasks_are_relaxed_only_for_a_limit_a_tenth_as_large(limit: float, name: str, amount: float) -> None:
    """1 m is asked in 1 s at the limit: whichever gives way, the same lacks of it."""
    problem = Problem("asked")
    q = problem.state("q", initial=0.0)
    v = problem.control("v", upper=limit)
    problem.dynamics(q, v)
    problem.horizon(1.0)
    problem.end("far", q, lower=1.0, upper=1.0)
    problem.minimize(running=v**2)
    result = conflicts(problem, MultipleShooting(6))
    assert [line[0] for line in result] == [name]
    assert result[0][1] == pytest.approx(amount, abs=1e-4)


@pytest.mark.parametrize("unit", [1e-2, 1.0, 1e2])
def test_conflicts_that_have_nothing_to_do_with_each_other_are_all_named_the_largest_share_first(unit: float) -> None:
    """Three axes at most at 1 m/s for 1 s and asked for more, or less: shares 1/2, 1/3, 1/5 of the speed's 2 m/s."""
    problem = Problem("axes")
    speeds = {"a": 0.4, "b": -1.0, "c": -2 / 3}
    cost: Any = 0.0
    for i, (name, lack) in enumerate(speeds.items()):
        by = unit if i == 1 else 1.0
        q = problem.state(f"q{name}", initial=0.0)
        u = problem.control(f"u{name}", lower=-by, upper=by)
        problem.dynamics(q, u)
        request = (lack + 1 if lack > 0 else lack - 1) * by
        problem.end(f"far {name}", q, lower=request, upper=request)
        cost += (u / by) ** 2
    problem.horizon(1.0)
    problem.minimize(running=cost)
    result = conflicts(problem, Collocation(4))
    assert [line[0] for line in result] == ["ub", "uc", "ua"]
    assert [line[1] for line in result] == pytest.approx([unit, 2 / 3, 0.4], rel=2e-3)
    assert [line[2] for line in result] == pytest.approx([-unit, -1.0, 1.0])


@pytest.mark.parametrize("unit", [1e-5, 1.0, 1e3])
@pytest.mark.parametrize("method", [Collocation(20), MultipleShooting(20)], ids=str)
def test_a_distance_too_short_by_drag_is_named_in_any_unit_of_force(method: Any, unit: float) -> None:
    """v' = u - v^2 from rest with u = 1 gets ln cosh T far, and a push for more would be the larger share."""
    problem = Problem("drag")
    q, v = problem.state("q", initial=0.0), problem.state("v", initial=0.0)
    u = problem.control("u", lower=-unit, upper=unit)
    problem.dynamics(q, v)
    problem.dynamics(v, u / unit - v**2)
    problem.horizon(1.0)
    problem.end("far", q, lower=4.0)
    problem.minimize(running=(u / unit) ** 2)
    (result,) = conflicts(problem, method)
    assert (result[0], result[2]) == ("far", 4.0)
    assert result[1] == pytest.approx(4 - math.log(math.cosh(1)), abs=6e-3)


@pytest.mark.parametrize("unit", [1e-4, 1.0, 1e3])
@pytest.mark.parametrize("turn", [math.pi / 2, 1.5 * math.pi])
@pytest.mark.parametrize("method", [Collocation(20), MultipleShooting(20)], ids=str)
def test_a_turn_on_half_the_least_radius_lacks_twice_and_is_solved_in_few_steps(
    method: Any, turn: float, unit: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The length is just that of the arc, so that nothing else leads there; Newton's steps need exact derivatives."""
    monkeypatch.setitem(elastic.ELASTIC_IPOPT, "max_iter", 18)
    problem = Problem("turn")
    x = problem.state("x", initial=0.0, terminal=math.sin(turn) / 2)
    y = problem.state("y", initial=0.0, terminal=(1 - math.cos(turn)) / 2)
    heading = problem.state("heading", initial=0.0, terminal=turn)
    curvature = problem.control("curvature", lower=-unit, upper=unit)
    problem.dynamics(x, ca.cos(heading))
    problem.dynamics(y, ca.sin(heading))
    problem.dynamics(heading, curvature / unit)
    problem.horizon(turn / 2)
    problem.minimize(running=(curvature / unit) ** 2)
    (result,) = conflicts(problem, method)
    assert result[0] == "curvature"
    assert result[1:3] == pytest.approx((unit, unit), rel=1e-3)
