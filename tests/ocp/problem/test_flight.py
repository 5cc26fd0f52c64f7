"""A quadrotor flies over a gate to its goal in least time, around a circle that it may not enter: SciPy flies it again.

The quadrotor moves in the vertical plane: p'' = (-sin a, cos a) (T1 + T2) / m - (0, g), J a'' = l (T2 - T1), 0 <= T <=
8 N. The gate is a point that it passes at any velocity; it is where the first of two phases ends.
"""

from __future__ import annotations

from functools import cache
from itertools import pairwise
from typing import Any

import casadi as ca
import numpy as np
import pytest
from scipy.integrate import solve_ivp

from models.checks import Array
from ocp import Collocation, Phases, Problem, Solution, solve, tighten

pytestmark = pytest.mark.long

GRAVITY, MASS, INERTIA, ARM, THRUST = 9.81, 1.0, 0.02, 0.2, 8.0
RADIUS = 0.6
CENTRE, GATE, GOAL = np.array([2.0, 0.1]), np.array([4.0, 0.0]), np.array([4.5, 2.0])


def rates(state: Any, thrust: Any, stack: Any, sine: Any, cosine: Any) -> Any:
    """Return the rates of position, velocity, tilt and its rate."""
    lift = (thrust[0] + thrust[1]) / MASS
    spin = ARM * (thrust[1] - thrust[0]) / INERTIA
    return stack(state[2], state[3], -sine(state[4]) * lift, cosine(state[4]) * lift - GRAVITY, state[5], spin)


def phase(name: str, begin: Array, end: Array, circle: bool, side: float) -> Problem:
    """Return one phase; nan where an end is free."""
    mirror = np.array([side, 1.0, side, 1.0, side, side])
    problem = Problem(name)
    x = problem.state("x", 6, initial=mirror * begin, terminal=mirror * end, lower=[-9, -9, -9, -9, -1.2, -9],
                      upper=[9, 9, 9, 9, 1.2, 9])  # fmt: skip
    thrust = problem.control("thrust", 2, lower=0.0, upper=THRUST, unit="N")
    problem.dynamics(x, rates(x, thrust, ca.vertcat, ca.sin, ca.cos))
    if circle:
        away = x[:2] - CENTRE * mirror[:2]
        problem.path("circle", ca.sumsqr(away), lower=RADIUS**2)
    problem.minimize(terminal=problem.horizon(lower=0.2, upper=6.0, guess=1.5))
    return problem


@cache
def flight(circle: bool = True, side: float = 1.0) -> Phases:
    free = np.full(4, np.nan)
    start, goal, gate = np.zeros(6), np.array([*GOAL, 0, 0, 0, 0]), np.array([*GATE, *free])
    legs = {
        "there": phase("there", start, gate, circle, side),
        "on": phase("on", np.full(6, np.nan), goal, circle, side),
    }
    phases = Phases("flight", legs)
    phases.join("there", "on")
    return phases


def flown(plan: Solution, name: str, start: Array) -> Array:
    """Return states (M, 6) of a phase, integrated from its thrusts alone."""
    leg = plan.phase(name)
    kinks = np.linspace(0.0, leg.horizon, 24 + 1)
    states = [start[:, None]]
    for begin, end in pairwise(kinks):

        def rate(t: float, state: Array, begin: float = begin, end: float = end) -> Any:
            thrust = leg.at(np.clip(t, begin + 1e-9, end - 1e-9))["thrust"]
            return rates(state, thrust, lambda *parts: np.array(parts), np.sin, np.cos)

        states.append(solve_ivp(rate, (begin, end), states[-1][:, -1], rtol=1e-7, atol=1e-9).y)
    return np.hstack(states).T


@cache
def planned(circle: bool = True, side: float = 1.0) -> Solution:
    return tighten(flight(circle, side), Collocation(24, 3))


def test_the_flight_keeps_its_limits_and_meets_gate_and_goal_by_another_integration() -> None:
    plan = planned()
    assert plan.audit().feasible
    there = flown(plan, "there", np.zeros(6))
    on = flown(plan, "on", there[-1])
    np.testing.assert_allclose(there[-1, :2], GATE, atol=2e-3)
    np.testing.assert_allclose(on[-1], [*GOAL, 0, 0, 0, 0], atol=2e-2)
    distances = np.linalg.norm(np.vstack([there, on])[:, :2] - CENTRE, axis=1)
    assert RADIUS - 1e-3 < distances.min() < RADIUS + 1e-2
    for name in plan.phases:
        thrust = plan.phase(name).at_fraction(np.linspace(0, 1, 2001))["thrust"]
        assert thrust.min() > -1e-6
        assert thrust.max() < THRUST + 1e-6


def test_the_circle_costs_time_and_the_mirrored_flight_takes_as_long() -> None:
    plan, free = planned(), planned(circle=False)
    assert free.cost < plan.cost * (1 - 1e-3)
    assert planned(side=-1.0).cost == pytest.approx(plan.cost, rel=1e-6)


def test_limits_between_the_points_cost_little() -> None:
    """The plan that keeps its limits only at the points is a relaxation, but for the mesh."""
    relaxed = solve(flight(), Collocation(48, 3))
    assert relaxed.cost * (1 - 1e-3) < planned().cost < 1.02 * relaxed.cost
