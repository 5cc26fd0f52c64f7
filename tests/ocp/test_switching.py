"""Nodes where plans switch: those of closed forms, and what they win."""

from __future__ import annotations

import numpy as np
import pytest

from ocp import Collocation, Problem, solve
from ocp.switching import locate_switches, solve_at_switches


def pushed(push: float = 1.0, brake: float = 3.0) -> Problem:
    """A mass that is at 1 in the least time, pushed by `push` and braked by `brake`: it switches at b / (a + b) T."""
    problem = Problem("pushed")
    horizon = problem.horizon(lower=0.1, upper=9.0, guess=2.0)
    place = problem.state("place", initial=0.0, terminal=1.0)
    speed = problem.state("speed", initial=0.0, terminal=0.0)
    force = problem.control("force", lower=-brake, upper=push)
    problem.dynamics(place, speed)
    problem.dynamics(speed, force)
    problem.minimize(terminal=horizon)
    return problem


@pytest.mark.parametrize("scheme", ["legendre", "radau"])
def test_a_node_comes_to_where_the_plan_switches(scheme: str) -> None:
    """sqrt(2 d (1/a + 1/b)) s, exactly on a mesh with a node at 3/4 of it."""
    problem, method = pushed(), Collocation(7, 4, scheme)
    rough = solve(problem, method)
    plan = solve_at_switches(problem, method, rough)
    assert rough.horizon > plan.horizon * (1 + 1e-6)
    assert plan.horizon == pytest.approx(np.sqrt(8 / 3), rel=1e-7)
    assert np.abs(plan.control_interpolant.breaks - 0.75).min() < 1e-5
    assert len(plan.control_interpolant.breaks) <= 9
    assert plan.audit().passed


def test_arcs_that_meet_without_a_jump_have_a_node_where_they_meet() -> None:
    """The least u^2 from rest to rest, |u| <= 1: a line that is cut off at both ends. The nodes need not be exact."""
    problem = Problem("soft")
    problem.horizon(1.0)
    place = problem.state("place", initial=0.0, terminal=0.2)
    speed = problem.state("speed", initial=0.0, terminal=0.0)
    force = problem.control("force", lower=-1.0, upper=1.0)
    problem.dynamics(place, speed)
    problem.dynamics(speed, force)
    problem.minimize(running=force**2)
    method = Collocation(9, 3)
    plan = solve_at_switches(problem, method, solve(problem, method))
    # u = 1 up to c, then linear to -1 at 1 - c: place = (1 + 2 c - 2 c^2) / 6
    c = (1 - np.sqrt(1 - 2 * (6 * 0.2 - 1))) / 2
    nodes = plan.control_interpolant.breaks
    assert np.abs(nodes - c).min() < 2e-4
    assert np.abs(nodes - (1 - c)).min() < 2e-4
    assert plan.cost == pytest.approx(2 * c + (1 - 2 * c) / 3, rel=1e-8)


def test_limits_of_a_control_that_depend_on_the_state_switch_where_constant_ones_do() -> None:
    """The control is the force times 2 + place: bounds of the force are path constraints of the state and control."""
    problem = Problem("geared")
    horizon = problem.horizon(lower=0.1, upper=9.0, guess=2.0)
    place = problem.state("place", initial=0.0, terminal=1.0)
    speed = problem.state("speed", initial=0.0, terminal=0.0)
    torque = problem.control("torque")
    force = torque / (2 + place)
    problem.path("force", force, lower=-3.0, upper=1.0)
    problem.dynamics(place, speed)
    problem.dynamics(speed, force)
    problem.minimize(terminal=horizon)
    plan = solve(problem, Collocation(7, 4))
    assert locate_switches(problem, plan).fractions == pytest.approx([0.75], abs=2e-4)
    assert locate_switches(pushed(), solve(pushed(), Collocation(7, 4))).fractions == pytest.approx([0.75], abs=2e-4)


def test_a_plan_that_does_not_switch_stays_as_it_is() -> None:
    problem, method = Problem("soft"), Collocation(4, 3)
    problem.horizon(1.0)
    speed = problem.state("speed", initial=0.0, terminal=1.0)
    force = problem.control("force", lower=-9.0, upper=9.0)
    problem.dynamics(speed, force - speed)
    problem.minimize(running=force**2)
    plan = solve(problem, method)
    assert not locate_switches(problem, plan).fractions.size
    assert solve_at_switches(problem, method, plan) is plan
