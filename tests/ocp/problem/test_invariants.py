"""End conditions that the dynamics keep already: every method solves as if one of them had not been asked.

Reference is the same problem with one condition less, or a closed form: a body of equal moments turns about a fixed
axis, a double integrator of the angle.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import casadi as ca
import numpy as np
import pytest

from ocp import Collocation, Indirect, MultipleShooting, Phases, Problem, solve
from ocp.problem.formulation import Formulation
from ocp.problem.invariants import bounds_to_solve
from tests.ocp.problems import Array, double_integrator

METHODS: list[Any] = [
    Collocation(10),
    Collocation(10, scheme="legendre"),
    Collocation(40, degree=2, control="held"),
    MultipleShooting(20, control="linear"),
    MultipleShooting(10, steps=4, control="linear"),
    Indirect(),
]
AXIS = np.array([1.0, 2.0, 3.0]) / np.sqrt(14.0)
TIME = 3.0


def turned(angle: float) -> Array:
    return np.append(np.cos(angle / 2), np.sin(angle / 2) * AXIS)


def quaternion_rate(q: Any, w: Any) -> Any:
    return ca.vertcat(-ca.dot(q[1:], w), q[0] * w + ca.cross(q[1:], w)) / 2


def body(name: str, angle: float, inertia: Any = (1.0, 1.0, 1.0), terminal: Any = "all", free: bool = False) -> Problem:
    """A rigid body from rest to rest at another attitude, with the least squared torque."""
    problem = Problem(name)
    report = turned(angle) if isinstance(terminal, str) else terminal
    q = problem.state("q", 4, initial=[1, 0, 0, 0], terminal=report, guess=lambda t: turned(angle * t / TIME))
    w, u = problem.state("w", 3, initial=0.0, terminal=0.0), problem.control("u", 3)
    point_data = ca.diag(ca.DM(inertia))
    problem.dynamics(q, quaternion_rate(q, w))
    problem.dynamics(w, ca.mtimes(ca.inv(point_data), u - ca.cross(w, ca.mtimes(point_data, w))))
    if free:
        problem.horizon(lower=0.5, upper=10.0, guess=TIME)
    else:
        problem.horizon(TIME)
    problem.minimize(running=ca.sumsqr(u) + (1 if free else 0))
    return problem


def let_go(problem: Problem) -> dict[str, list[int]]:
    """Which entries of the ends are not held while solving."""
    form = Formulation.of(problem)
    p = np.ones(form.np)
    moved = np.flatnonzero(form.bound_values(p)[0] != bounds_to_solve(form, p)[0])
    return {kind: np.flatnonzero(np.isin(form.bounds.places[kind], moved)).tolist() for kind in ("terminal", "end")}


@pytest.mark.parametrize("method", METHODS, ids=str)
@pytest.mark.parametrize("angle", [2.0, np.pi, -1.0])
def test_a_whole_quaternion_at_the_end(method: Any, angle: float) -> None:
    """Equal moments: cost 12 angle^2 / T^3. At half a turn the scalar entry is zero, and says nothing."""
    plan = solve(body("body", angle), method)
    assert plan.cost == pytest.approx(12 * angle**2 / TIME**3, rel=2e-3)
    np.testing.assert_allclose(plan["q"][-1], turned(angle), atol=2e-4)
    audit = plan.audit()
    assert not [f for f in audit.failures if f.name != "cost lost, relative"], str(audit)
    if getattr(method, "control", "") != "held":
        assert audit.passed, str(audit)
    assert "end of q" in [finding.name for finding in audit.findings]


@pytest.mark.parametrize("method", METHODS[:5], ids=str)
def test_it_costs_as_much_as_with_one_entry_less(method: Any) -> None:
    report = turned(2.0)
    report[3] = np.nan
    inertia = (1.0, 1.5, 2.0)
    whole, less = (solve(body("body", 2.0, inertia, end), method) for end in ("all", report))
    assert whole.cost == pytest.approx(less.cost, rel=1e-9)
    assert np.abs(whole.multipliers).max() < 10 * np.abs(less.multipliers).max()


def test_the_entry_that_says_least_is_let_go() -> None:
    """The largest of a quaternion; no other, and none of what is free anyway."""
    assert let_go(body("a", 0.5)) == {"terminal": [0], "end": []}
    assert let_go(body("b", np.pi)) == {"terminal": [3], "end": []}
    assert let_go(body("c", 2.0, terminal=[np.nan, *turned(2.0)[1:]])) == {"terminal": [], "end": []}


def test_a_free_horizon_and_few_digits() -> None:
    """Four digits of a quaternion contradict its length by 1e-5: the plan ends where it can."""
    assert solve(body("free", 2.0, free=True), METHODS[0]).audit().passed
    plan = solve(body("digits", 2.0, terminal=np.round(turned(2.0), 4)), METHODS[0])
    assert plan.audit().passed
    np.testing.assert_allclose(plan["q"][-1], turned(2.0), atol=1e-4)


def test_constraints_contradicting_the_start_are_kept_as_declared() -> None:
    assert let_go(body("long", 2.0, terminal=1.2 * turned(2.0))) == {"terminal": [], "end": []}


def rotation() -> Problem:
    """All nine entries of a rotation matrix, of which six follow."""
    problem = Problem("rotation")
    k = np.cross(np.eye(3), -AXIS)
    report = np.eye(3) + np.sin(1.0) * k + (1 - np.cos(1.0)) * k @ k
    r = problem.state("r", 9, initial=np.eye(3).ravel(), terminal=report.ravel(order="F"))
    w, u = problem.state("w", 3, initial=0.0, terminal=0.0), problem.control("u", 3)
    problem.dynamics(r, ca.vec(ca.mtimes(ca.reshape(r, 3, 3), ca.skew(w))))
    problem.dynamics(w, u)
    problem.horizon(TIME)
    problem.minimize(running=ca.sumsqr(u))
    return problem


def wheels() -> Problem:
    """A body turned by wheels, whose momentum is that of both: of ten conditions four follow."""
    problem = Problem("wheels")
    q = problem.state("q", 4, initial=[1, 0, 0, 0], terminal=turned(1.0))
    w, h = problem.state("w", 3, initial=0.0, terminal=0.0), problem.state("h", 3, initial=0.0, terminal=0.0)
    u = problem.control("u", 3)
    problem.dynamics(q, quaternion_rate(q, w))
    problem.dynamics(w, -u - ca.cross(w, w + h))
    problem.dynamics(h, u)
    problem.horizon(TIME)
    problem.minimize(running=ca.sumsqr(u))
    return problem


def tanks() -> Problem:
    """What flows from one to the next: the sum stays."""
    problem = Problem("tanks")
    x = problem.state("x", 3, initial=[1.0, 0.0, 0.0], terminal=[0.2, 0.3, 0.5])
    u = problem.control("u", 2)
    problem.dynamics(x, ca.vertcat(-u[0], u[0] - u[1], u[1]))
    problem.horizon(1.0)
    problem.minimize(running=ca.sumsqr(u))
    return problem


def in_rows() -> Problem:
    """The whole quaternion as a named condition."""
    problem = body("rows", 1.0, terminal=np.full(4, np.nan))
    problem.end("attitude", problem.declared.states["q"].symbol - turned(1.0), 0.0, 0.0)
    return problem


def returning() -> Problem:
    """A whole quaternion that comes back to where it began, kept busy by its cost."""
    problem = body("returning", 0.0, terminal=np.full(4, np.nan))
    q = problem.declared.states["q"].symbol
    problem.end("cyclic", q - problem.at_start(q), 0.0, 0.0)
    problem.declared.running = None
    u, w = (problem.declared.controls["u"].symbol, problem.declared.states["w"].symbol)
    problem.minimize(running=ca.sumsqr(u) + ca.sumsqr(w - ca.vertcat(ca.cos(problem.time), 1, 0)))
    return problem


def in_phases() -> Phases:
    """Two phases joined by the whole state, the whole quaternion told at the end of the second."""
    parts = {}
    for name, ends in (("first", ([1, 0, 0, 0], None)), ("second", (None, turned(1.0)))):
        problem = Problem(name)
        q = problem.state("q", 4, initial=ends[0], terminal=ends[1], guess=turned(0.5))
        rest = [None if end is None else 0.0 for end in ends]
        w, u = problem.state("w", 3, initial=rest[0], terminal=rest[1]), problem.control("u", 3)
        problem.dynamics(q, quaternion_rate(q, w))
        problem.dynamics(w, u)
        problem.horizon(TIME / 2)
        problem.minimize(running=ca.sumsqr(u))
        parts[name] = problem
    phases = Phases("phases", parts)
    phases.join("first", "second", {name: phases["first"].at_end(name) for name in ("q", "w")})
    return phases


FOLLOW: list[tuple[Callable[[], Problem], int]] = [
    (rotation, 6),
    (wheels, 4),
    (tanks, 1),
    (in_rows, 1),
    (returning, 1),
    (in_phases, 1),
]


@pytest.mark.parametrize(("make", "count"), FOLLOW, ids=lambda value: getattr(value, "__name__", ""))
def test_other_conditions_that_follow(make: Callable[[], Problem], count: int) -> None:
    gone = let_go(make())
    assert len(gone["terminal"]) + len(gone["end"]) == count
    costs = []
    methods: list[Any] = [Collocation(16), MultipleShooting(30, control="linear")]
    for method in methods:
        plan = solve(make(), method)
        assert plan.audit().passed, str(plan.audit())
        costs.append(plan.cost)
    assert costs[0] == pytest.approx(costs[1], rel=1e-3)


def test_no_constraint_on_controlled_states_is_dropped() -> None:
    problem, _, _, u = double_integrator("plain")
    problem.minimize(running=u**2)
    assert let_go(problem) == {"terminal": [], "end": []}
