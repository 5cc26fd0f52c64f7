"""Optimal plans that an audit is tempted to fail: at rest, without cost, straight, tiny, huge, unstable, tightened."""

from __future__ import annotations

import warnings
from dataclasses import replace
from typing import Any

import casadi as ca
import numpy as np
import pytest

from ocp import (
    Collocation,
    Indirect,
    InFoot,
    MultipleShooting,
    Problem,
    RefinementSettings,
    minimum_velocity_problem,
    refine,
    solve,
    tighten,
)
from tests.ocp.audit.drawn import holds, is_no_minimum, of, random_program
from tests.ocp.audit.test_unsound_motions import START, arm, circle
from tests.ocp.motion.builders.standing_tasks import table_plan
from tests.ocp.problems import double_integrator
from tests.ocp.test_tightening import walled

pytestmark = pytest.mark.filterwarnings("ignore::models.errors.ModelWarning")  # arms of a kilometre are meant

METHODS: dict[str, Any] = {
    "radau": Collocation(20),
    "radau-held": Collocation(80, control="held"),
    "legendre": Collocation(20, scheme="legendre"),
    "held": MultipleShooting(60),
    "linear": MultipleShooting(60, control="linear"),
    "indirect": Indirect(),
}
every_method = pytest.mark.parametrize("method", METHODS)
direct_methods = pytest.mark.parametrize("method", [name for name in METHODS if name != "indirect"])


# ---- never used ------------------------------------------------------------------------------------------------------


def pushed(price: float, most: float = 0.2) -> Problem:
    """From rest to rest by a drive, which a push from outside relieves at a price."""
    problem = Problem("pushed")
    q, v = problem.state("q", initial=0.0, terminal=1.0), problem.state("v", initial=0.0, terminal=0.0)
    a, f = problem.control("a"), problem.control("f", lower=0.0, upper=most)
    problem.dynamics(q, v)
    problem.dynamics(v, a)
    problem.horizon(1.0)
    problem.minimize((a - 0.3 * f) ** 2 + price * f)
    return problem


@pytest.mark.parametrize("most", [0.2, 1e-3, np.inf])
def test_a_costly_force_stays_at_its_limit(most: float) -> None:
    """It is off but for the solver's tolerance, and shows no size but that; where it would pay it is missed."""
    plan = solve(pushed(10.0, most), Collocation(8, degree=4, scheme="legendre"))
    assert np.abs(plan["f"]).max() < 1e-6
    assert plan.cost == pytest.approx(12.0)
    holds(plan.audit())
    if most == 0.2:
        is_no_minimum(of(plan, pushed(-1.0)).audit())


# ---- without cost ----------------------------------------------------------------------------------------------------


@every_method
@pytest.mark.parametrize("pace", [1.0, 1e-3, 1e5])
def test_a_control_that_costs_nothing_where_it_should_be_passes(method: str, pace: float) -> None:
    """min int (u - pace)^2: the cost is rounding."""
    for end in (None, 2 * pace):
        problem = Problem("pace")
        x, u = problem.state("x", initial=0.0, terminal=end), problem.control("u")
        problem.dynamics(x, u)
        problem.horizon(2.0)
        problem.minimize((u / pace - 1) ** 2)
        plan = solve(problem, METHODS[method])
        assert plan.cost < 1e-12
        holds(plan.audit())


@every_method
def test_perfect_tracking_passes(method: str) -> None:
    problem = Problem("tracking")
    q, v = problem.state("q", initial=0.0), problem.state("v", initial=1.0)
    u = problem.control("u")
    problem.dynamics(q, v)
    problem.dynamics(v, u)
    problem.horizon(2.0)
    problem.minimize((q - problem.time) ** 2 + (v - 1) ** 2 + u**2)
    plan = solve(problem, METHODS[method])
    assert plan.cost < 1e-12
    holds(plan.audit())


@every_method
@pytest.mark.parametrize("size", [1, 3])
def test_rest_without_a_task_passes(method: str, size: int) -> None:
    for place in (0.0, 3.0):
        problem = Problem("at rest")
        x, u = problem.state("x", size, initial=place, terminal=place), problem.control("u", size)
        problem.dynamics(x, u)
        problem.horizon(1.0)
        problem.minimize(ca.sumsqr(u))
        holds(solve(problem, METHODS[method]).audit())


# ---- beside zero -----------------------------------------------------------------------------------------------------


@direct_methods
@pytest.mark.parametrize("heading", [0.0, np.pi / 2, 1.0])
def test_a_straight_motion_of_a_unicycle_passes(method: str, heading: float) -> None:
    """Its way aside is rounding: 1e-20 m."""
    problem = Problem("unicycle")
    c, s = np.cos(heading), np.sin(heading)
    x, y = problem.state("x", initial=0.0, terminal=c), problem.state("y", initial=0.0, terminal=s)
    turned = problem.state("heading", initial=heading)
    v, w = problem.control("v", guess=1.0), problem.control("w")
    problem.dynamics(x, v * ca.cos(turned))
    problem.dynamics(y, v * ca.sin(turned))
    problem.dynamics(turned, w)
    problem.horizon(1.0)
    problem.minimize(v**2 + w**2)
    guess = {"x": lambda t: c * t, "y": lambda t: s * t, "heading": heading, "v": 1.0}
    plan = solve(problem, METHODS[method], guess=guess)
    assert plan.cost == pytest.approx(1.0, abs=1e-6)
    holds(plan.audit())


@every_method
@pytest.mark.parametrize("almost", [float(np.sin(np.pi)), 1e-20, -1e-17])
def test_an_end_that_is_zero_but_for_rounding_passes(method: str, almost: float) -> None:
    problem = Problem("almost zero")
    x, u = problem.state("x", 2, initial=[0.0, almost], terminal=[1.0, almost]), problem.control("u", 2)
    problem.dynamics(x, u)
    problem.horizon(1.0)
    problem.minimize(ca.sumsqr(u))
    holds(solve(problem, METHODS[method]).audit())


# ---- unstable --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("growth", [4.0, 8.0, 15.0])
@pytest.mark.parametrize("method", ["radau", "legendre", "linear"])
def test_a_plan_of_an_unstable_system_is_judged_interval_by_interval(growth: float, method: str) -> None:
    """x' = a x + u over 2 s: a local error grows by exp(2 a), 1e13 at most, whatever the mesh."""
    methods = {
        "radau": Collocation(60, 5),
        "legendre": Collocation(60, 4, "legendre"),
        "linear": MultipleShooting(240, control="linear"),
    }
    problem = Problem("unstable")
    x, u = problem.state("x", initial=1.0, terminal=0.0), problem.control("u")
    problem.dynamics(x, growth * x + u)
    problem.horizon(2.0)
    problem.minimize((x**2 + u**2) / 2)
    holds(solve(problem, methods[method]).audit())


def test_a_balanced_pole_passes() -> None:
    problem = Problem("pole")
    a, w = problem.state("a", initial=0.3), problem.state("w", initial=0.0)
    u = problem.control("u")
    problem.dynamics(a, w)
    problem.dynamics(w, 40 * ca.sin(a) - u)
    problem.horizon(4.0)
    problem.minimize(a**2 + 0.1 * w**2 + 0.01 * u**2)
    holds(solve(problem, Collocation(60, 4)).audit())


# ---- scales ----------------------------------------------------------------------------------------------------------


@every_method
@pytest.mark.parametrize("length", [0.01, 1.0, 1e3])
def test_pendulums_of_any_length_pass(method: str, length: float) -> None:
    """From hanging at rest to 1 rad at rest, in two of its own times."""
    problem = Problem("pendulum")
    a, w = problem.state("a", initial=0.0, terminal=1.0), problem.state("w", initial=0.0, terminal=0.0)
    torque = problem.control("torque")  # N m, of 1 kg
    problem.dynamics(a, w)
    problem.dynamics(w, -9.81 / length * ca.sin(a) + torque / length**2)
    problem.horizon(float(2 * np.sqrt(length)))
    problem.minimize(torque**2)
    holds(solve(problem, METHODS[method]).audit())


@pytest.mark.parametrize("size", [1e-5, 3e-3, 1.0, 1e4])
def test_arms_of_any_size_pass(size: float) -> None:
    machine = arm(size)
    task = replace(circle(machine, size / 5, 2.0), tolerance=(2e-4 * size, 1e-3))
    problem = minimum_velocity_problem(machine, tasks=task, start=START, horizon=2.0)
    holds(solve(problem, Collocation(20)).audit())


@direct_methods
@pytest.mark.parametrize(("time", "length"), [(1e-6, 1.0), (1e-6, 1e-9), (1.0, 1e9), (1e5, 1e9), (1e-3, 1e-6)])
def test_horizons_of_a_microsecond_and_paths_of_a_million_kilometres_pass(
    method: str, time: float, length: float
) -> None:
    for limit in (None, 5.0):
        problem = Problem("in other units")
        q = problem.state("q", initial=0.0, terminal=length)
        v = problem.state("v", initial=0.0, terminal=0.0)
        most = None if limit is None else limit * length / time**2
        u = problem.control("u", lower=None if most is None else -most, upper=most)
        problem.dynamics(q, v)
        problem.dynamics(v, u)
        problem.horizon(time)
        problem.minimize((u * time**2 / length) ** 2 / 2 / time)
        plan = solve(problem, METHODS[method])
        assert plan.cost == pytest.approx(6.0 if limit is None else 6.0450277563, rel=3e-3)
        if limit is None:  # the corners of the other lie between the nodes
            holds(plan.audit())


@pytest.mark.parametrize("ratio", [1e-4, 1e4])
def test_states_of_very_different_size_pass(ratio: float) -> None:
    problem = Problem("mixed sizes")
    x, y = problem.state("x", initial=0.0, terminal=1.0), problem.state("y", initial=0.0, terminal=ratio)
    u, w = problem.control("u"), problem.control("w")
    problem.dynamics(x, u - 0.1 * x)
    problem.dynamics(y, w - 0.1 * y + 0.1 * ratio * x)
    problem.horizon(1.0)
    problem.minimize(u**2 + (w / ratio) ** 2)
    for method in (METHODS["radau"], METHODS["linear"]):
        holds(solve(problem, method).audit())


# ---- machines and limits ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize("intervals", [40, pytest.param(80, marks=pytest.mark.long)])
def test_a_standing_plan_with_a_fixed_tip_fails_by_its_loss_alone(intervals: int) -> None:
    """An inequality with a held control is active at one end of an interval; its multiplier is not inside it.

    These meshes cost 5 and 2 thousandths more than the optimum, -0.7093.
    """
    audit = solve(table_plan(1, InFoot(0.02)), MultipleShooting(intervals, control="held")).audit()
    assert audit.feasible, str(audit)
    assert {finding.name for finding in audit.failures} <= {"cost lost, relative"}, str(audit)


@pytest.mark.parametrize("intervals", [40, 80])
def test_a_standing_plan_near_its_limits_passes_with_its_tip_held_by_accelerations(intervals: int) -> None:
    problem = table_plan(1, InFoot(0.02), tip_level="acceleration")
    holds(solve(problem, Collocation(intervals, scheme="legendre")).audit())


TIGHT = [
    Collocation(20),
    Collocation(40, scheme="legendre"),
    Collocation(160, 2, control="held"),
    MultipleShooting(160),
    MultipleShooting(60, control="linear"),
]


WALLED = 4.03972  # least cost of `walled`, of 160 Legendre intervals


@pytest.mark.parametrize("method", TIGHT, ids=str)
def test_a_tightened_plan_with_an_active_limit_passes(method: Any) -> None:
    """The bound that is drawn in holds it: neither free of it nor beyond the problem's own; what it costs is told."""
    ceiling, *_, u = double_integrator("ceiling", (0.0, 1.0), (0.0, -1.0), ceiling=1 / 9)
    ceiling.minimize(u**2 / 2)
    holds(tighten(ceiling, method).audit())
    tight = tighten(walled(), method)
    audit, extra = tight.audit(), tight.cost / WALLED - 1
    if extra < 1e-3:
        holds(audit)
    else:
        assert {finding.name for finding in audit.failures} == {"cost lost, relative"}, str(audit)
    assert audit["cost lost, relative"].value == pytest.approx(extra, rel=0.1, abs=3e-4)


@pytest.mark.parametrize("seed", range(4))
def test_a_random_tightened_plan_passes(seed: int) -> None:
    """A point that passes a disc in the plane at a bounded speed."""
    rng = np.random.default_rng(seed)
    problem = Problem("round a disc")
    aside = float(rng.uniform(0.05, 0.2))
    radius = float(rng.uniform(0.3, 0.5))
    guess = lambda t: [t, (radius + 0.2) * np.sin(np.pi * t / 2)]  # noqa: E731
    x = problem.state("x", 2, initial=[0.0, 0.0], terminal=[2.0, 0.0], guess=guess)
    u = problem.control("u", 2)
    problem.dynamics(x, u)
    problem.horizon(2.0)
    problem.path("disc", ca.sumsqr(x - ca.DM([1.0, -aside])), lower=radius**2)
    problem.minimize(ca.sumsqr(u))
    for method in (Collocation(20), MultipleShooting(40, control="linear")):
        holds(tighten(problem, method).audit())


# ---- problems that are feasible --------------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", range(8))
def test_the_fastest_motion_between_random_ends_is_found_from_the_exact_time(seed: int) -> None:
    """x'' = u, |u| <= 1: the time is known in closed form."""
    rng = np.random.default_rng(seed)
    q0, v0, q1, v1 = rng.uniform(-2, 2, size=4)
    fastest = min(
        (a + b, a, b)
        for sign in (1.0, -1.0)
        # v turns by sign a, then by -sign b; the top speed w has w^2 = (v0^2 + v1^2) / 2 + sign (q1 - q0)
        for w2 in [(v0**2 + v1**2) / 2 + sign * (q1 - q0)]
        if w2 >= 0
        for w in (np.sqrt(w2), -np.sqrt(w2))
        for a, b in [(w - sign * v0, w - sign * v1)]
        if a >= -1e-12 and b >= -1e-12
    )[0]
    problem, *_ = double_integrator("fastest", (q0, v0), (q1, v1), horizon=None, limit=1.0)
    problem.minimize(terminal=problem.horizon(lower=0.01, upper=50.0, guess=fastest))
    plan = solve(problem, Collocation(40, control="held"))
    assert plan.horizon == pytest.approx(fastest, rel=5e-3)


@direct_methods
def test_a_swing_up_with_little_torque_is_found(method: str) -> None:
    problem = Problem("swing up")
    a, w = problem.state("a", initial=0.0, terminal=np.pi), problem.state("w", initial=0.0, terminal=0.0)
    u = problem.control("u", lower=-4.0, upper=4.0)
    problem.dynamics(a, w)
    problem.dynamics(w, -9.81 * ca.sin(a) + u)
    problem.horizon(5.0)
    problem.minimize(u**2)
    plan = solve(problem, METHODS[method])
    assert plan.success


def test_a_refined_plan_says_that_it_is_reached_only_where_its_audit_passes() -> None:
    machine = arm()
    problem = minimum_velocity_problem(machine, tasks=circle(machine, 0.4, 2.0), start=START, horizon=2.0)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        for method in (Collocation(4), MultipleShooting(8), Collocation(6, 2, control="held")):
            plan = refine(problem, method, tolerance=1e-4, settings=RefinementSettings(max_intervals=160))
            assert plan.refinement is not None
            if plan.refinement.reached:
                holds(plan.audit())


# ---- textbook ----------------------------------------------------------------------------------------------------


def test_a_bang_bang_plan_with_its_switch_on_a_node_passes() -> None:
    problem, *_ = double_integrator("fastest", horizon=None, limit=1.0)
    problem.minimize(terminal=problem.horizon(lower=0.1, upper=10.0, guess=3.0))
    for method in (Collocation(20, control="held"), MultipleShooting(20), Indirect()):
        plan = solve(problem, method)
        assert plan.horizon == pytest.approx(2.0, abs=1e-6)
        holds(plan.audit())


def test_a_cost_that_is_negative_or_zero_at_its_optimum_passes() -> None:
    """int u^2 / 2 - c x(1), shifted by a constant so that the least cost is 0, less or more."""
    for shift in (0.0, 0.5, 2.0):
        problem = Problem("shifted")
        x, u = problem.state("x", initial=0.0), problem.control("u")
        problem.dynamics(x, u)
        problem.horizon(1.0)
        problem.minimize(u**2 / 2 + shift, -x)
        holds(random_program(problem, {"x": lambda t: t}, {"u": 1.0}, {"x": -1.0}, 1.0).audit())
        for method in METHODS.values():
            holds(solve(problem, method).audit())
