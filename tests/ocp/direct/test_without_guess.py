"""Solves without a guess: sizes at which derivatives vanish, symmetric guesses, and dependent conditions."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest

from ocp import Collocation, Problem, solve
from ocp.direct.diagnosis import dependent_rows
from ocp.problem.formulation import Formulation
from ocp.problem.invariants import bounds_to_solve


def glide(speed: float = 1.0) -> Problem:
    """A point that turns from heading 90 degrees as far as possible to the north, at constant speed."""
    problem = Problem("glide")
    north = problem.state("north", initial=0.0, lower=-1e6, upper=1e6)
    heading = problem.state("heading", initial=np.pi / 2, lower=-np.pi, upper=np.pi)
    turn = problem.control("turn", lower=-1.0, upper=1.0)
    problem.dynamics(north, speed * ca.cos(heading))
    problem.dynamics(heading, turn)
    problem.horizon(2.0)
    problem.minimize(turn**2, -north / speed)
    return problem


@pytest.mark.parametrize("speed", [1.0, 25600.0])
def test_a_state_that_the_guess_leaves_at_rest_takes_its_size_from_motions_beside_the_guess(speed: float) -> None:
    # heading 90 degrees: the cosine is the rounding of zero along the whole guess, which gave a size of 1e-13
    solution = solve(glide(speed), Collocation(20))
    assert solution.start == "guess"
    assert solution.cost == pytest.approx(solve(glide(), Collocation(20)).cost, rel=1e-7)


def test_a_guess_where_a_derivative_does_not_exist_is_displaced() -> None:
    # the distance from the origin has no derivative at the origin, where the default guess rests
    problem = Problem("distance")
    x = problem.state("x", 2, initial=0.0, lower=-3.0, upper=3.0)
    u = problem.control("u", 2, lower=-1.0, upper=1.0)
    problem.dynamics(x, u)
    problem.horizon(2.0)
    problem.end("distance", ca.norm_2(x), 1.0, 1.0)
    problem.minimize(ca.sumsqr(u))
    solution = solve(problem, Collocation(10))
    assert solution.start == "displaced guess"
    assert solution.cost == pytest.approx(0.5, rel=1e-6)  # distance^2 / time


def reorientation(*, fourth_is_control: bool) -> Problem:
    """Turn an asymmetric body by 150 degrees in the least time: 28.63041 s (PSOPT, trapezoidal, own tolerance 1e-4).

    The fourth entry of the quaternion is a state, or a control that the unit length determines.
    """
    problem, angle = Problem("reorientation"), np.radians(75.0)
    inertia, final = np.array([5621.0, 4547.0, 2364.0]), (np.sin(angle), 0.0, 0.0, np.cos(angle))
    w = problem.state("w", 3, initial=0.0, terminal=0.0, lower=-0.5, upper=0.5)
    torque = problem.control("torque", 3, lower=-50.0, upper=50.0, guess=50.0)
    n = 3 if fourth_is_control else 4
    q = problem.state("q", n, initial=(0.0, 0.0, 0.0, 1.0)[:n], terminal=final[:n], lower=-1.0, upper=1.0)
    fourth = problem.control("fourth", lower=-1.0, upper=1.0) if fourth_is_control else q[3]
    rate = (w * fourth + ca.cross(q[:3], w)) / 2
    problem.dynamics(q, rate if fourth_is_control else ca.vertcat(rate, -ca.dot(w, q[:3]) / 2))
    problem.dynamics(w, (torque - ca.cross(w, w * inertia)) / inertia)
    problem.minimize(0, problem.horizon(lower=25.0, upper=35.0, guess=30.0))
    if fourth_is_control:
        problem.path("unit", ca.sumsqr(q) + fourth**2, 1.0, 1.0)
        problem.start("fourth at the start", fourth, 1.0, 1.0)
        problem.end("fourth at the end", fourth, final[3], final[3])
    return problem


def test_conditions_on_a_control_that_path_equalities_imply_are_dropped_from_the_solve() -> None:
    problem = reorientation(fourth_is_control=True)
    form = Formulation.of(problem)
    low, high = bounds_to_solve(form, np.zeros(0))
    at_end = np.concatenate([form.bounds.places[kind] for kind in ("terminal", "end")])
    for index in (form.bounds.places["start"], at_end):  # of a unit quaternion one entry, at either end
        assert np.sum(low[index] < high[index]) == 1
    solution = solve(problem, Collocation(30))
    other = solve(reorientation(fourth_is_control=False), Collocation(30))
    assert solution.cost == pytest.approx(other.cost, rel=1e-5)
    assert solution.cost == pytest.approx(28.63041, rel=1e-4)
    assert solution["fourth"][-1, 0] == pytest.approx(np.cos(np.radians(75.0)), abs=1e-5)


def test_a_condition_on_a_control_that_nothing_else_implies_stays() -> None:
    problem = Problem("free control")
    x = problem.state("x", initial=0.0, terminal=1.0)
    u, v = problem.control("u"), problem.control("v")
    problem.dynamics(x, u + v)
    problem.horizon(1.0)
    problem.path("sum", u + 2 * v, 1.0, 1.0)
    problem.end("end of u", u, 0.5, 0.5)
    problem.minimize(u**2)
    form = Formulation.of(problem)
    np.testing.assert_array_equal(bounds_to_solve(form, np.zeros(0)), form.bound_values(np.zeros(0)))


def test_dependent_conditions_are_named() -> None:
    problem = Problem("twice")
    x = problem.state("x", 2, initial=0.0)
    u = problem.control("u", 2)
    problem.dynamics(x, u)
    problem.horizon(1.0)
    problem.end("sum", x[0] + x[1], 1.0, 1.0)
    problem.end("difference", x[0] - x[1], 0.3, 0.3)
    problem.end("double sum", 2 * x[0] + 2 * x[1], 2.0, 2.0)
    problem.minimize(ca.sumsqr(u))
    prepared = Collocation(4).prepare(problem)
    solution = prepared.solve()
    form = prepared.formulation
    arguments = prepared.transcription.arguments(np.zeros(0), form.bound_values(np.zeros(0)))
    assert set(dependent_rows(prepared, solution.variables, arguments)) == {"sum", "double sum"}
