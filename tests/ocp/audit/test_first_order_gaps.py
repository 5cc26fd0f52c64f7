"""Feasible plans that are no extremals, with costates forged to look like one: none passes."""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise
from typing import Any

import casadi as ca
import numpy as np
import pytest

from models import FixedBase, Joint, Link, Robot
from ocp import Collocation, MultipleShooting, Problem, Solution, TipTask, minimum_velocity_problem, resolve, solve
from tests.ocp.audit.drawn import holds, is_no_minimum, is_no_proven_minimum, of, random_program
from tests.ocp.problems import Array, double_integrator

pytestmark = pytest.mark.filterwarnings("ignore::models.errors.ModelWarning")  # arms of a kilometre are meant

METHODS: dict[str, Any] = {
    "radau": Collocation(20),
    "legendre": Collocation(20, scheme="legendre"),
    "held": MultipleShooting(60),
    "linear": MultipleShooting(60, control="linear"),
}
every_method = pytest.mark.parametrize("method", METHODS)
Declare = Callable[[Problem, Any, Any, Any], None]


# ---- constraints that hold nothing -----------------------------------------------------------------------------------


def least_effort(declare: Declare, timed: float = 0.0, **bounds: Any) -> Problem:
    """Double integrator from (0, 0) to (1, 0) in 1 s at the least int u^2 / 2, which is 6; more is declared."""
    problem, q, v, u = double_integrator("least effort", **bounds)
    problem.minimize(u**2 / 2 + timed * problem.time)
    declare(problem, q, v, u)
    return problem


def detour(problem: Problem, bump: float, mesh: int = 40) -> Solution:
    """The optimal q plus bump t^2 (1 - t)^2, with costates that make H stationary and follow its equation for v."""

    def q(t: Array) -> Array:
        return np.asarray(3 * t**2 - 2 * t**3 + bump * t**2 * (1 - t) ** 2)

    def v(t: Array) -> Array:
        return np.asarray(6 * t - 6 * t**2 + bump * (2 * t - 6 * t**2 + 4 * t**3))

    def u(t: Array) -> Array:
        return np.asarray(6 - 12 * t + bump * (2 - 12 * t + 12 * t**2))

    def slope(t: Array) -> Array:
        return np.asarray(-12 + bump * (24 * t - 12))

    return random_program(problem, {"q": q, "v": v}, {"u": u}, {"q": slope, "v": lambda t: -u(t)}, 1.0, mesh)


NEVER_ACTIVE: dict[str, Declare] = {
    "a ceiling of the control": lambda p, q, v, u: p.path("roof", u, upper=1e3),
    "a ceiling of a state": lambda p, q, v, u: p.path("roof", q, upper=50.0),
    "a mixed one": lambda p, q, v, u: p.path("mixed", u + q + v, -1e3, 1e3),
    "a curved one": lambda p, q, v, u: p.path("disc", (q - 3) ** 2 + v**2, lower=0.1),
    "two": lambda p, q, v, u: p.path("two", ca.vertcat(u, v), lower=-100.0, upper=100.0),
}


@pytest.mark.parametrize("declared", NEVER_ACTIVE)
@pytest.mark.parametrize("timed", [0.0, 1.0], ids=["autonomous", "in time"])
def test_an_inactive_constraint_hides_no_false_costates(declared: str, timed: float) -> None:
    """A bump of 1 costs 0.4 of 6, one of 5 costs 10."""
    problem = least_effort(NEVER_ACTIVE[declared], timed)
    holds(detour(problem, 0.0).audit())
    for bump in (1.0, 5.0):
        is_no_minimum(detour(problem, bump).audit())


@every_method
def test_the_same_problem_passes_by_every_method(method: str) -> None:
    for declare in NEVER_ACTIVE.values():
        plan = solve(least_effort(declare), METHODS[method])
        assert plan.cost == pytest.approx(6.0, rel=1e-3)
        holds(plan.audit())


@pytest.mark.parametrize("as_path", [True, False], ids=["path", "state"])
def test_a_state_at_its_bound_at_one_point_hides_no_false_costates(as_path: bool) -> None:
    """The detour's own greatest speed is made the bound of the speed."""
    for bump in (1.5, 4.0):
        bare = detour(least_effort(lambda *_: None, timed=1.0), bump, 80)
        most = float(bare["v"].max())
        problem = Problem("touched")
        q = problem.state("q", initial=0.0, terminal=1.0)
        v = problem.state("v", initial=0.0, terminal=0.0, upper=None if as_path else most)
        u = problem.control("u")
        problem.dynamics(q, v)
        problem.dynamics(v, u)
        problem.horizon(1.0)
        if as_path:
            problem.path("speed", v, upper=most)
        problem.minimize(u**2 / 2 + problem.time)
        is_no_minimum(of(bare, problem).audit())


def test_an_optimum_at_its_bound_at_one_point_passes() -> None:
    """v of least effort has its greatest value 3/2 at 1/2: with that as its bound nothing changes."""
    problem = Problem("touching")
    q, v = problem.state("q", initial=0.0, terminal=1.0), problem.state("v", initial=0.0, terminal=0.0, upper=1.5)
    u = problem.control("u")
    problem.dynamics(q, v)
    problem.dynamics(v, u)
    problem.horizon(1.0)
    problem.minimize(u**2 / 2)
    holds(detour(problem, 0.0).audit())


@pytest.mark.parametrize("ceiling", ["state", "path"])
@pytest.mark.parametrize("pull", [0.0, 60.0])
def test_a_costate_jump_at_an_active_bound_has_the_sign_of_its_multiplier(pull: float, ceiling: str) -> None:
    """From rest at 0 to rest at 0 in 1 s, touching q = 0.1 at 1/2: the least int u^2 / 2 through that point.

    Without a wish to go up standing still costs nothing, and the costate of q jumps up at the ceiling, by 19.2; a cost
    of - 60 int q pulls it beyond the ceiling, to 0.156, and there the costate jumps down, by 10.8.
    """
    problem, q, _, u = double_integrator("touch", end=(0.0, 0.0), ceiling=0.1 if ceiling == "state" else None)
    if ceiling == "path":
        problem.path("ceiling", q, upper=0.1)
    problem.minimize(u**2 / 2 - pull * q)
    # through the point: on either side of it u is a cubic polynomial's second derivative plus what the pull bends
    through = solve(problem, Collocation(2, degree=5, scheme="legendre"))
    free, fq, _, fu = double_integrator("free", end=(0.0, 0.0))
    free.minimize(fu**2 / 2 - pull * fq)
    peak = pull / 24 / 16  # of q = pull t^2 (1 - t)^2 / 24, the free optimum
    assert float(solve(free, Collocation(10, 5))["q"].max()) == pytest.approx(peak, abs=1e-6)
    assert (peak > 0.1) == (pull > 50)
    if pull:
        holds(solve(problem, Collocation(20)).audit())
    rest = 0.1 - peak  # of a cubic on each side, added to the free optimum

    def side(t: Array) -> Array:
        return np.minimum(t, 1 - t) * 2

    def sign(t: Array) -> Array:
        return np.where(t < 0.5, 1.0, -1.0)

    plan = random_program(
        problem,
        {
            "q": lambda t: rest * side(t) ** 2 * (3 - 2 * side(t)) + pull * t**2 * (1 - t) ** 2 / 24,
            "v": lambda t: rest * sign(t) * 12 * (side(t) - side(t) ** 2) + pull * (2 * t - 6 * t**2 + 4 * t**3) / 24,
        },
        {"u": lambda t: rest * 24 * (1 - 2 * side(t)) + pull * (2 - 12 * t + 12 * t**2) / 24},
        {
            "q": lambda t: -rest * 96 * sign(t) + pull * (t - 0.5),
            "v": lambda t: -rest * 24 * (1 - 2 * side(t)) - pull * (2 - 12 * t + 12 * t**2) / 24,
        },
        1.0,
        40,
    )
    if pull:
        assert plan.cost == pytest.approx(through.cost, rel=1e-6)
    (holds if pull else is_no_minimum)(plan.audit())


def test_a_control_at_its_bound_with_a_path_equality_hides_no_false_costates() -> None:
    """w is tied to v; u saturates for a moment; q and v take a detour."""
    for bump in (1.0, 5.0):
        problem, _, v, u = double_integrator("tied")
        w = problem.control("w")
        problem.path("tie", w - v, 0.0, 0.0)
        problem.minimize(u**2 / 2 + 0 * w)
        bare = detour(least_effort(lambda *_: None), bump)
        most = float(np.abs(bare["u"]).max())
        bounded, _, bv, bu = double_integrator("tied", limit=most)
        bw = bounded.control("w")
        bounded.path("tie", bw - bv, 0.0, 0.0)
        bounded.minimize(bu**2 / 2)
        along = {name: (lambda t, n=name, b=bare: b.at(t)[n][:, 0]) for name in ("q", "v", "u")}
        costates = {n: (lambda t, n=n, b=bare: np.interp(t, b.t, b.costate(n)[:, 0])) for n in ("q", "v")}
        plan = random_program(
            bounded, {n: along[n] for n in ("q", "v")}, {"u": along["u"], "w": along["v"]}, costates, 1.0, 40
        )
        is_no_minimum(plan.audit())


# ---- the pseudo-inverse ----------------------------------------------------------------------------------------------


def planar(lengths: Any) -> FixedBase:
    """A planar arm whose joints turn about z."""
    links, joints = [Link("base", 1.0)], []
    for i, length in enumerate(lengths):
        links.append(Link(f"link{i}", 1.0, (length / 2, 0, 0), np.diag([0.01, 0.1, 0.1])))
        mount = (0.0 if i == 0 else lengths[i - 1], 0, 0)
        joints.append(Joint(f"joint{i}", "revolute", links[i].name, links[i + 1].name, mount, axis=(0, 0, 1)))
    return FixedBase(Robot(tuple(links), tuple(joints), tip_translation=(lengths[-1], 0, 0)))


MOTIONS = {  # start, rad, and direction of the tip; what the pseudo-inverse costs more than the optimum
    "three joints, 4 %": ([0.688, -1.202, 1.768], [0.249, -0.865], 1.04),
    "three joints, 2 %": ([-0.382, -1.206, -1.637], [-0.75, 0.498], 1.02),
    "four joints, 7 %": ([-1.405, 1.891, 1.56, 1.289], [-0.622, -0.65], 1.07),
    "four joints, 12 %": ([0.516, 1.709, -0.238, 1.818], [0.729, -0.528], 1.13),
}


@pytest.mark.parametrize("size", [1e-3, 1.0, 1e4])
@pytest.mark.parametrize("motion", MOTIONS)
def test_the_pseudo_inverse_is_no_optimum_of_the_whole_motion(size: float, motion: str) -> None:
    """Smallest rates at each time, with costates of minus the rates: stationary, but costlier than the optimum."""
    start, path, costlier = MOTIONS[motion]
    machine = planar([size] * len(start))
    task = TipTask(rows=(3, 4), velocity=size * np.array(path))
    local = resolve(machine, task, 2.0, start=start)
    assert local.stopped is None
    for bound in (None, 99.0):
        problem = minimum_velocity_problem(machine, task, 2.0, start=start)
        if bound:  # never active
            problem.path("far", problem.declared.states["joints"].symbol[0], -bound, bound)
        optimum = solve(problem, Collocation(20))
        assert local.cost[-1] / optimum.cost == pytest.approx(costlier, abs=0.015)
        holds(optimum.audit())

        def joint_positions(t: Array) -> Array:
            return np.array([local.at(time)["joints"] for time in t])

        def rates(t: Array) -> Array:
            return np.array([[np.interp(time, local.t, c) for c in local.joint_rates.T] for time in t])

        plan = random_program(
            problem, {"joints": joint_positions}, {"rates": rates}, {"joints": lambda t: -rates(t)}, 2.0, 60
        )
        is_no_minimum(plan.audit())


# ---- multipliers have a sign -----------------------------------------------------------------------------------------

SIDES = {"start": (0.0, -2.0), "end": (1.0, 2.0)}


@every_method
@pytest.mark.parametrize("place", ["end", "path", "state", "two ends"])
def test_a_multiplier_of_an_end_inequality_has_one_sign(method: str, place: str) -> None:
    """min int u^2 / 2 - 2 x(1) from 0: -2 at x(1) = 2, -1.5 at x(1) = 1, on which no lower bound of 1 holds it."""

    def build(low: Any, high: Any) -> Problem:
        problem = Problem("reaching")
        state = {"lower": None, "upper": high} if place == "state" and low is None else {}
        x, u = problem.state("x", initial=0.0, **state), problem.control("u")
        problem.dynamics(x, u)
        problem.horizon(1.0)
        problem.minimize(u**2 / 2, -2 * x)
        if place == "path":
            after = problem.time - 1  # at the end x >= 1, before it something that is always so
            problem.path("wall", x - 50 * after, None if low is None else low, None)
        elif place == "two ends":
            problem.end("wall", ca.vertcat(x, -x), [low if low is not None else -9, -9], [9, 9])
        elif place == "end":
            problem.end("wall", x, low, high)
        return problem

    pinned = Problem("reaching")
    x, u = pinned.state("x", initial=0.0, terminal=1.0), pinned.control("u")
    pinned.dynamics(x, u)
    pinned.horizon(1.0)
    pinned.minimize(u**2 / 2, -2 * x)
    plan = solve(pinned, METHODS[method])
    assert plan.cost == pytest.approx(-1.5)
    if place != "state":
        is_no_minimum(of(plan, build(1.0, None)).audit())
        holds(solve(build(1.0, None), METHODS[method]).audit())
    if place in ("end", "state"):  # from above it does push back
        holds(of(plan, build(None, 1.0)).audit())


@every_method
@pytest.mark.parametrize("unit", [1e-3, 1.0, 1e4])
def test_a_multiplier_of_a_start_inequality_has_one_sign(method: str, unit: float) -> None:
    """min int u^2 / 2 + 2 x(0) - ... to 0: the free start is -2, a start held at -1 from below is right, above not."""

    def build(low: Any, high: Any, start: Any = None) -> Problem:
        problem = Problem("leaving")
        x, u = problem.state("x", initial=start, terminal=0.0), problem.control("u")
        problem.dynamics(x, u)
        problem.horizon(1.0)
        problem.minimize((u / unit) ** 2 / 2, 2 * problem.at_start(x) / unit)
        if start is None:
            problem.start("gate", x, low, high)
        return problem

    plan = solve(build(None, None, -unit), METHODS[method])
    assert plan.cost == pytest.approx(-1.5)
    is_no_minimum(of(plan, build(None, -unit)).audit())
    holds(of(plan, build(-unit, None)).audit())
    holds(solve(build(-5 * unit, None), METHODS[method]).audit())


def test_each_of_several_multipliers_has_its_own_sign() -> None:
    """Three coordinates wish to go to 2; one is held at 1 by a bound from above, one by nothing, one from below."""
    problem = Problem("three")
    x, u = problem.state("x", 3, initial=0.0), problem.control("u", 3)
    problem.dynamics(x, u)
    problem.horizon(1.0)
    problem.minimize(ca.sumsqr(u) / 2, -2 * ca.sum1(x))
    problem.end("walls", x, [-9.0, -9.0, 1.0], [1.0, 9.0, 9.0])
    for last, verdict in ((2.0, holds), (1.0, is_no_minimum)):
        ends = np.array([1.0, 2.0, last])
        plan = random_program(
            problem, {"x": lambda t, e=ends: np.outer(t, e)}, {"u": ends.tolist()}, {"x": (-ends).tolist()}, 1.0
        )
        verdict(plan.audit())


@every_method
@pytest.mark.parametrize(("held", "passes"), [(10.0, False), (0.2, False), (1 / np.sqrt(2), True)])
def test_a_multiplier_of_a_horizon_bound_has_one_sign(method: str, held: float, passes: bool) -> None:
    """min T + int u^2 / 2 from 0 to 1: 1.414 at T = 0.707; 10.05 at 10 s, 2.7 at 0.2 s."""

    def build(**horizon: Any) -> Problem:
        problem = Problem("in free time")
        x, u = problem.state("x", initial=0.0, terminal=1.0), problem.control("u")
        problem.dynamics(x, u)
        if "value" in horizon:
            problem.horizon(horizon["value"])
            problem.minimize(1 + u**2 / 2)
        else:
            problem.horizon(**horizon)
            problem.minimize(1 + u**2 / 2)
        return problem

    plan = solve(build(value=held), METHODS[method])
    for bounds in ({"lower": min(held, 0.5), "upper": max(held, 2.0)}, {"lower": 0.01, "upper": 100.0}):
        (holds if passes else is_no_minimum)(of(plan, build(**bounds, guess=held)).audit())
    right = {"lower": held, "upper": 30.0} if held > 0.71 else {"lower": 0.01, "upper": held}
    holds(of(plan, build(**right, guess=held)).audit())


# ---- the symbol of the horizon ---------------------------------------------------------------------------------------

IN_HORIZON: dict[str, tuple[Callable[[Any, Any, Any, Any], tuple[Any, Any, Any]], float | None]] = {
    # (derivative, running, terminal) of (x, u, T, t), and the optimal T
    "running": (lambda x, u, T, t: (u, u**2 / 2 + T, 0), 0.25 ** (1 / 3)),
    "dynamics": (lambda x, u, T, t: (u / T, u**2 / 2, 1 / T), np.sqrt(2.0)),
    "both": (lambda x, u, T, t: (u / T, u**2 / 2 * T, T ** (-2)), 2**0.25),
    "with time": (lambda x, u, T, t: (u, u**2 / 2 + 2 * t / T + T, 0), None),  # int 2 t / T dt = T
}


@pytest.mark.parametrize("where", IN_HORIZON)
@pytest.mark.parametrize("method", ["radau", "linear"])
def test_the_horizon_may_stand_anywhere_and_its_condition_is_not_left_out(where: str, method: str) -> None:
    declare, best = IN_HORIZON[where]

    def build(value: float | None = None) -> Problem:
        problem = Problem("horizon inside")
        x, u = problem.state("x", initial=0.0, terminal=1.0), problem.control("u")
        T = problem.horizon(value) if value else problem.horizon(lower=0.05, upper=20.0, guess=1.0)
        derivative, running, terminal = declare(x, u, T, problem.time)
        problem.dynamics(x, derivative)
        problem.minimize(running, terminal)
        return problem

    optimum = solve(build(), METHODS[method])
    if best is not None:
        assert optimum.horizon == pytest.approx(best, rel=1e-4)
    holds(optimum.audit())
    for factor in (0.25, 0.7, 1.5, 5.0):
        wrong = solve(build(factor * optimum.horizon), METHODS[method])
        assert wrong.cost > optimum.cost * 1.02
        is_no_minimum(of(wrong, build()).audit())


# ---- cost that is lost -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("slope", [0.0, 100.0, 1e4, -1e6])
def test_parts_of_the_cost_that_cancel_hide_no_loss(slope: float) -> None:
    """min int u^2 + c u from 0 to 0: c x(1) - c x(0) is nothing; forth and back at 1/2 costs 1/4."""
    problem = Problem("cancelling")
    x, u = problem.state("x", initial=0.0, terminal=0.0), problem.control("u")
    problem.dynamics(x, u)
    problem.horizon(1.0)
    problem.minimize(u**2 + slope * u)
    plan = random_program(
        problem,
        {"x": lambda t: 0.5 * np.minimum(t, 1 - t)},
        {"u": lambda t: np.where(t < 0.5, 0.5, -0.5)},
        {"x": -slope},
        1.0,
    )
    is_no_minimum(plan.audit())
    holds(random_program(problem, {"x": 0.0}, {"u": 0.0}, {"x": -slope}, 1.0).audit())


@pytest.mark.parametrize(
    "make", [MultipleShooting, lambda n: Collocation(n, control="held")], ids=["shooting", "radau"]
)
def test_held_controls_on_a_coarse_mesh_do_not_pass_for_the_optimum(make: Callable[[int], Any]) -> None:
    """Least effort with N held controls costs 6 N^2 / (N^2 - 1): 7 % too much on 4 intervals, 0.03 % on 60."""
    problem, _, _, u = double_integrator("held")
    problem.minimize(u**2 / 2)
    for intervals, verdict in ((4, is_no_minimum), (5, is_no_minimum), (10, is_no_minimum), (60, holds)):
        plan = solve(problem, make(intervals))
        assert plan.cost == pytest.approx(6 * intervals**2 / (intervals**2 - 1), rel=1e-6)
        verdict(plan.audit())


@pytest.mark.parametrize("seed", range(6))
def test_held_controls_pass_where_they_cost_less_than_a_thousandth_too_much(seed: int) -> None:
    """A random regulator by ever finer held controls: dearer than 1.003 never passes, nearer than 1.0003 does."""
    rng = np.random.default_rng(seed)
    a, b = rng.normal(size=(2, 2)), rng.normal(size=(2, 1))

    def build() -> Problem:
        problem = Problem("regulator")
        x, u = problem.state("x", 2, initial=[1.0, -0.5]), problem.control("u")
        problem.dynamics(x, ca.mtimes(a, x) + ca.mtimes(b, u))
        problem.horizon(3.0)
        problem.minimize((ca.sumsqr(x) + 0.2 * u**2) / 2)
        return problem

    best = solve(build(), Collocation(30, 5)).cost
    for intervals in (4, 8, 16, 32, 64, 128):
        plan = solve(build(), MultipleShooting(intervals, steps=4))
        share = plan.cost / best - 1
        audit = plan.audit()
        if share > 3e-3:
            is_no_minimum(audit)
        if share < 3e-4:
            holds(audit)


def test_losses_of_singular_arcs_are_not_tolerated() -> None:
    """min int x^2 with |u| <= 1 from 1: at once to 0 and there; a plan that lingers at 1/2 first is dearer."""
    problem = Problem("singular")
    x, u = problem.state("x", initial=1.0), problem.control("u", lower=-1.0, upper=1.0)
    problem.dynamics(x, u)
    problem.horizon(3.0)
    problem.minimize(x**2)
    mesh = [0, 1 / 6, 1 / 3, 1 / 2, 2 / 3, 1]
    knots, places = np.array([0.0, 0.5, 1.5, 2.0, 3.0]), np.array([1.0, 0.5, 0.5, 0.0, 0.0])
    rates = [-1.0, 0.0, -1.0, 0.0]
    plan = random_program(
        problem,
        {"x": lambda t: np.interp(t, knots, places)},
        {"u": lambda t: np.choose(np.clip(np.searchsorted(knots, t, side="right") - 1, 0, 3), rates)},
        {"x": 0.0},
        3.0,
        sorted({*mesh, *(k / 3 for k in knots)}),
    )
    is_no_proven_minimum(plan.audit())
    assert len(list(pairwise(knots))) == 4
