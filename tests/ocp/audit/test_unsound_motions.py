"""Plans with an infeasible motion: wrong horizon, scale, order or bound, or a force pulse between the samples."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
import pytest

from models import FixedBase, Joint, Link, Robot, standing_example
from ocp import (
    Collocation,
    IndexAtLeast,
    InFoot,
    MultipleShooting,
    Problem,
    ProblemError,
    Solution,
    TipTask,
    minimum_velocity_problem,
    solve,
    standing_problem,
)
from tests.ocp.audit.drawn import holds, is_no_minimum, of, random_program, violates_its_task
from tests.ocp.problems import Array, double_integrator

pytestmark = pytest.mark.filterwarnings("ignore::models.errors.ModelWarning")  # arms of a kilometre are meant

METHODS = {
    "radau": Collocation(20),
    "legendre": Collocation(20, scheme="legendre"),
    "held": MultipleShooting(60),
    "linear": MultipleShooting(60, control="linear"),
}
every_method = pytest.mark.parametrize("method", METHODS)


def least_effort(horizon: Any = 1.0, distance: float = 1.0, **free: Any) -> Problem:
    """From rest at 0 to rest at a distance, at the least int u^2 / 2."""
    problem, _, _, u = double_integrator("least effort", end=(distance, 0.0), horizon=None if free else horizon)
    if free:
        problem.horizon(**free)
    problem.minimize(u**2 / 2)
    return problem


# ---- another horizon -------------------------------------------------------------------------------------------------


@every_method
@pytest.mark.parametrize(("own", "requested"), [(10.0, 1.0), (2.0, 3.0), (1.0, 1.001), (1e-3, 1.0)])
def test_a_plan_of_another_horizon_violates_its_task(method: str, own: float, requested: float) -> None:
    plan = solve(least_effort(own), METHODS[method])
    holds(plan.audit())
    violates_its_task(of(plan, least_effort(requested)).audit())
    if own > requested:
        violates_its_task(of(plan, least_effort(lower=0.1 * requested, upper=requested)).audit())


def test_a_plan_that_is_loaded_is_held_to_the_horizon_of_the_task(tmp_path: Path) -> None:
    solve(least_effort(2.0), METHODS["radau"]).save(tmp_path / "plan.npz")
    plan = Solution.load(tmp_path / "plan.npz")
    holds(plan.audit(least_effort(2.0)))
    violates_its_task(plan.audit(least_effort(3.0)))


def test_a_plan_of_another_horizon_fails_where_parameters_say_the_horizon() -> None:
    def build() -> Problem:
        problem = Problem("asked for")
        T = problem.parameter("T")
        x, u = problem.state("x", initial=0.0, terminal=1.0), problem.control("u")
        problem.dynamics(x, u)
        problem.horizon(T)
        problem.minimize(u**2)
        return problem

    plan = solve(build(), METHODS["radau"], parameters={"T": 4.0})
    holds(plan.audit())
    violates_its_task(replace(plan, parameters={"T": np.array([2.0])}).audit())


def arm(size: float = 1.0, joints: int = 3) -> FixedBase:
    links, result = [Link("base", 1.0)], []
    for i in range(joints):
        links.append(Link(f"link{i}", 1.0, (size / 2, 0, 0), np.diag([0.01, 0.1, 0.1]) * size**2))
        mount = (0.0 if i == 0 else size, 0, 0)
        result.append(Joint(f"joint{i}", "revolute", links[i].name, links[i + 1].name, mount, axis=(0, 0, 1)))
    return FixedBase(Robot(tuple(links), tuple(result), tip_translation=(size, 0, 0)))


START = np.array([0.3, 0.8, 0.9])


def circle(machine: FixedBase, radius: float, period: float) -> TipTask:
    x, y, _ = np.array(ca.DM(machine.tip_pose((), START).position)).ravel()
    turn = 2 * np.pi / period
    return TipTask(position=lambda t: [x + radius * (1 - ca.cos(turn * t)), y - radius * ca.sin(turn * t)], rows=(3, 4))


def test_one_lap_does_not_pass_for_two() -> None:
    machine = arm()
    one, two = (
        minimum_velocity_problem(machine, tasks=circle(machine, 0.2, 2.0), start=START, horizon=time)
        for time in (2.0, 4.0)
    )
    plan = solve(one, Collocation(20))
    holds(plan.audit())
    violates_its_task(of(plan, two).audit())
    # nor stretched over the time of two
    violates_its_task(replace(of(plan, two), horizon=4.0, t=2 * plan.t).audit())


@pytest.mark.parametrize(
    "beyond",
    [
        lambda s: replace(s, t=np.append(s.t[:-1], 1.5 * s.t[-1])),
        lambda s: replace(s, t=s.t * 1.01),
        lambda s: replace(s, t=s.t + 1e-3),
        lambda s: replace(s, t=s.t[::-1].copy()),
        lambda s: replace(s, t=np.where(np.arange(len(s.t)) == 5, np.nan, s.t)),
        lambda s: replace(s, state_interpolant=replace(s.state_interpolant, breaks=2 * s.state_interpolant.breaks)),
        lambda s: replace(
            s, control_interpolant=replace(s.control_interpolant, breaks=s.control_interpolant.breaks - 0.1)
        ),
        lambda s: replace(
            s, control_interpolant=replace(s.control_interpolant, breaks=s.control_interpolant.breaks**3)
        ),
        lambda s: replace(s, horizon=1.02 * s.horizon),
    ],
    ids=[
        "last t",
        "all t",
        "t late",
        "t backwards",
        "t nan",
        "breaks to 2",
        "breaks from -0.1",
        "breaks moved",
        "horizon",
    ],
)
def test_times_and_breaks_outside_the_plan_are_refused(beyond: Callable[[Solution], Solution]) -> None:
    plan = solve(least_effort(), METHODS["radau"])
    try:
        audit = beyond(plan).audit()
    except ProblemError:
        return
    violates_its_task(audit)


# ---- small things ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("path", [9e-4, 1e-5, 1e-9])
@pytest.mark.parametrize("where", ["initial", "terminal", "end", "path"])
def test_a_plan_at_rest_does_not_reach_a_near_goal(path: float, where: str) -> None:
    """A distance below a millimetre counts: resting costs nothing, moving costs distance^2 / 2."""

    def build() -> Problem:
        problem = Problem("small way")
        x = problem.state(
            "x", initial=path if where == "initial" else 0.0, terminal={"initial": 0.0, "terminal": path}.get(where)
        )
        u = problem.control("u")
        problem.dynamics(x, u)
        problem.horizon(1.0)
        if where == "end":
            problem.end("there", x - path, 0.0, 0.0)
        if where == "path":
            problem.path("pace", u - path, 0.0, 0.0)
        problem.minimize(u**2 / 2)
        return problem

    back = -1.0 if where == "initial" else 1.0
    going: dict[str, Any] = {"x": lambda t: path * (1 - t) if where == "initial" else path * t}
    holds(
        random_program(build(), going, {"u": back * path}, {"x": 0.0 if where == "path" else -back * path}, 1.0).audit()
    )
    for place in (0.0, path):
        plan = random_program(build(), {"x": place}, {"u": 0.0}, {"x": 0.0}, 1.0)
        violates_its_task(plan.audit())


@pytest.mark.parametrize("size", [3e-3, 1e-5, 1.0, 1e4])
def test_an_arm_that_never_moves_does_no_task_however_small_it_is(size: float) -> None:
    """Links of a size draw a circle of a fifth of it."""
    machine = arm(size)
    task = replace(circle(machine, size / 5, 2.0), tolerance=(2e-4 * size, 1e-3))
    problem = minimum_velocity_problem(machine, tasks=task, start=START, horizon=2.0)
    holds(solve(problem, Collocation(20)).audit())
    still = {"joints": START.tolist()}
    violates_its_task(random_program(problem, still, {"rates": 0 * START}, {"joints": 0 * START}, 2.0).audit())


@pytest.mark.parametrize("size", [1e-3, 1.0])
@pytest.mark.parametrize("drift", [1e-2, 5e-3])
def test_a_drifting_tip_is_detected(size: float, drift: float) -> None:
    """A tip to move 0.05 link lengths a second drifts sideways by a share of it: 1e-4 m/s for 0.2 m links."""
    machine = arm(size)
    velocity = np.array([0.05, -0.02]) * size
    aside = drift * np.array([0.02, 0.05]) * size
    task, wrong = (TipTask(rows=(3, 4), velocity=each) for each in (velocity, velocity + aside))
    problem = minimum_velocity_problem(machine, task, 3.0, start=START)
    holds(solve(problem, Collocation(20)).audit())
    drifting = solve(minimum_velocity_problem(machine, wrong, 3.0, start=START), Collocation(20))
    violates_its_task(of(drifting, problem).audit())


def test_a_small_thing_beside_a_large_one_is_not_drowned_in_it() -> None:
    """The entries of one state, of the ends and of one constraint are judged each by its own size."""
    for large in (1e3, 1e6):
        problem = Problem("large and small")
        x, u = problem.state("x", 2, initial=[0.0, 0.0], terminal=[large, 1.0]), problem.control("u", 2)
        problem.dynamics(x, u)
        problem.horizon(1.0)
        problem.path("both", u, [large, 0.5], [large, 1.5])
        problem.minimize((u[0] / large) ** 2 + u[1] ** 2)
        costates = {"x": [-2 / large, -2.0]}
        holds(
            random_program(
                problem, {"x": lambda t, g=large: np.outer(t, [g, 1.0])}, {"u": [large, 1.0]}, costates, 1.0
            ).audit()
        )
        for wrong in (0.0, 0.6, 0.9):  # the small one stops short, or its motion is not that of its control
            for rate in (wrong, 1.0):
                plan = random_program(
                    problem, {"x": lambda t, w=wrong, g=large: np.outer(t, [g, w])}, {"u": [large, rate]}, costates, 1.0
                )
                violates_its_task(plan.audit())


@pytest.mark.parametrize("away", [1e2, 1e6])
@every_method
def test_the_place_of_the_origin_hides_no_error(method: str, away: float) -> None:
    """A distance of 1 far from the origin: the plan violates its dynamics, or its end, by a tenth of it."""

    def build(end: float = 1.0) -> Problem:
        problem, _, _, u = double_integrator("far away", start=(away, 0.0), end=(away + end, 0.0))
        problem.minimize(u**2 / 2)
        return problem

    plan = solve(build(), METHODS[method])
    holds(plan.audit())
    violates_its_task(of(solve(build(0.9), METHODS[method]), build()).audit())
    curve = plan.control_interpolant
    violates_its_task(replace(plan, control_interpolant=replace(curve, values=0.9 * curve.values)).audit())


def test_a_false_costate_of_a_small_cost_is_detected_beside_a_large_one() -> None:
    """Two independent motions, one with 100 times the cost; the other has a needless bend: b^2 / 6 of 50.5."""
    for price in (1.0, 100.0):
        problem = Problem("two prices")
        x, y = problem.state("x", initial=0.0, terminal=1.0), problem.state("y", initial=0.0, terminal=1.0)
        u, w = problem.control("u"), problem.control("w")
        problem.dynamics(x, u)
        problem.dynamics(y, w)
        problem.horizon(1.0)
        problem.minimize(price * u**2 / 2 + w**2 / 2)
        for bend, verdict in ((0.0, holds), (1.0, is_no_minimum), (2.0, is_no_minimum)):
            plan = random_program(
                problem,
                {"x": lambda t: t, "y": lambda t, b=bend: t + b * t * (1 - t)},
                {"u": 1.0, "w": lambda t, b=bend: 1 + b * (1 - 2 * t)},
                {"x": -price, "y": lambda t, b=bend: -1 - b * (1 - 2 * t)},
                1.0,
            )
            verdict(plan.audit())


# ---- ranges ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("wide", [10.0, 1e4, 1e6, 1e9])
@pytest.mark.parametrize("where", ["state", "path", "end"])
def test_the_width_of_a_range_excuses_nothing(wide: float, where: str) -> None:
    """0 <= q on the way from 1 to 1 with a push downwards: without the floor the plan dips to -1.5."""

    def build(floor: bool) -> Problem:
        problem = Problem("floor")
        bounds: dict[str, Any] = {"lower": 0.0, "upper": wide} if floor and where == "state" else {}
        q = problem.state("q", initial=1.0, terminal=None if where == "end" else 1.0, **bounds)
        v = problem.state("v", initial=0.0)
        u = problem.control("u")
        problem.dynamics(q, v)
        problem.dynamics(v, u)
        problem.horizon(2.0)
        if floor and where == "path":
            problem.path("floor", q, 0.0, wide)
        if floor and where == "end":
            problem.end("floor", q, 0.0, wide)
        problem.minimize(u**2 / 2 + 20 * q)
        return problem

    dipping = solve(build(False), Collocation(20))
    assert dipping["q"].min() < -0.5
    violates_its_task(of(dipping, build(True)).audit())
    holds(solve(build(True), Collocation(30)).audit())


@pytest.mark.parametrize("wide", [1e3, 1e9])
def test_the_width_of_a_range_of_a_control_excuses_nothing(wide: float) -> None:
    """A motor that only pulls: u >= 0; the plan brakes with -2."""

    def build(floor: bool) -> Problem:
        problem, _, _, u = double_integrator("pulling")
        problem.minimize(u**2 / 2)
        if floor:
            problem.declared.controls["u"] = replace(
                problem.declared.controls["u"], lower=ca.SX(0.0), upper=ca.SX(wide)
            )
        return problem

    violates_its_task(of(solve(build(False), Collocation(20)), build(True)).audit())


@pytest.mark.parametrize("limit", [1e-3, 5e-6, 1e-9])
@every_method
def test_a_bound_of_a_narrow_range_is_not_active_everywhere(limit: float, method: str) -> None:
    """|u| <= limit, least int 1 + (u / limit - 0.2 - 0.6 t)^2: half of what it shall follow costs 7 hundredths more."""

    def build(share: float) -> Problem:
        problem = Problem("narrow")
        x, u = problem.state("x", initial=0.0), problem.control("u", lower=-limit, upper=limit)
        problem.dynamics(x, u)
        problem.horizon(1.0)
        problem.minimize(1 + (u / limit - share * (0.2 + 0.6 * problem.time)) ** 2)
        return problem

    holds(solve(build(1.0), METHODS[method]).audit())
    other = solve(build(0.5), METHODS[method])
    is_no_minimum(replace(of(other, build(1.0)), cost=1 + 0.25 * (0.2**2 + 0.2 * 0.6 + 0.6**2 / 3)).audit())


@pytest.mark.parametrize("limit", [1e-3, 1e-6, 1e-9])
def test_half_the_push_that_is_allowed_is_not_the_fastest(limit: float) -> None:
    """Least time with |u| <= limit; with half of it the way takes 1.41 times as long."""

    problem, *_ = double_integrator("fastest", horizon=None, end=(limit, 0.0), limit=limit)
    problem.minimize(terminal=problem.horizon(lower=0.1, upper=10.0, guess=3.0))
    for share, verdict in ((1.0, holds), (0.5, is_no_minimum)):
        half = 1 / np.sqrt(share)  # s; of the way, in which it pushes
        push = share * limit
        plan = random_program(
            problem,
            {
                "q": lambda t, a=push, h=half: np.where(t < h, a * t**2 / 2, limit - a * (2 * h - t) ** 2 / 2),
                "v": lambda t, a=push, h=half: a * np.minimum(t, 2 * h - t),
            },
            {"u": lambda t, a=push, h=half: np.where(t < h, a, -a)},
            {"q": -1 / (push * half), "v": lambda t, a=push, h=half: (t - h) / (a * h)},
            2 * half,
        )
        verdict(plan.audit())


# ---- by name ---------------------------------------------------------------------------------------------------------


def several(order: str, ends: dict[str, float]) -> Problem:
    """Integrators with their own prices, declared in an order, controls in the reverse one."""
    problem = Problem("several")
    rates = {name: problem.control(f"rate of {name}") for name in reversed(order)}
    for name in order:
        problem.dynamics(problem.state(name, initial=0.0, terminal=ends[name]), rates[name])
    problem.horizon(1.0)
    problem.minimize(sum((1 + "abc".index(name)) * rates[name] ** 2 for name in order))
    return problem


@pytest.mark.parametrize("order", ["bac", "cab", "cba"])
@pytest.mark.parametrize("loaded", [False, True], ids=["kept", "loaded"])
def test_states_and_controls_are_read_by_name_in_whatever_order(order: str, loaded: bool, tmp_path: Path) -> None:
    ends = {"a": 1.0, "b": 2.0, "c": -3.0}
    plan = solve(several("abc", ends), METHODS["radau"])
    if loaded:
        plan.save(tmp_path / "plan.npz")
        plan = Solution.load(tmp_path / "plan.npz")
    holds(plan.audit(several(order, ends)))
    swapped = dict(zip(order, ends.values(), strict=True))  # what reading by position would call right
    violates_its_task(plan.audit(several(order, swapped)))


# ---- between the samples ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("shape", "width"), [("bell", 1e-3), ("bell", 1e-2), ("box", 1e-3)])
@pytest.mark.parametrize("at", [0.31, 0.5003, 0.777])
@every_method
def test_a_push_between_the_nodes_is_not_stepped_over(shape: str, width: float, at: float, method: str) -> None:
    """A pulse of 1 N s within a millisecond: without a reaction the final speed is 1, not 0."""

    def build(push: float) -> Problem:
        problem = Problem("pushed")
        q, v = problem.state("q", initial=0.0, terminal=1.0), problem.state("v", initial=0.0, terminal=0.0)
        u = problem.control("u")
        problem.dynamics(q, v)
        off = (problem.time - at) / width
        density = ca.exp(-(off**2)) / np.sqrt(np.pi) if shape == "bell" else ca.fabs(off) < 0.5
        problem.dynamics(v, u + push * density / width)
        problem.horizon(1.0)
        problem.minimize(u**2 / 2)
        return problem

    violates_its_task(of(solve(build(0.0), METHODS[method]), build(1.0)).audit())


@pytest.mark.parametrize("at", [0.31, 0.777])
def test_a_cost_between_the_nodes_is_not_stepped_over(at: float) -> None:
    """A toll of 1 within a millisecond on whoever is beyond 0.1 then."""

    def build(toll: float) -> Problem:
        problem = Problem("toll")
        x, u = problem.state("x", initial=0.0, terminal=1.0), problem.control("u")
        problem.dynamics(x, u)
        bell = ca.exp(-(((problem.time - at) / 1e-3) ** 2)) / (1e-3 * np.sqrt(np.pi))
        problem.horizon(1.0)
        problem.minimize(u**2 / 2 + toll * bell * x**2)
        return problem

    assert not of(solve(build(0.0), METHODS["radau"]), build(5.0)).audit().passed


@pytest.mark.parametrize("thick", [5e-2, 2e-2, 1e-2])
def test_a_wall_as_thick_as_the_samples_are_apart_is_not_gone_through(thick: float) -> None:
    """From 0 to 1 through |x - 0.52| >= thick / 2: the nodes lie on either side of it."""

    def build(wall: bool) -> Problem:
        problem = Problem("wall")
        x, u = problem.state("x", initial=0.0, terminal=1.0), problem.control("u")
        problem.dynamics(x, u)
        problem.horizon(1.0)
        if wall:
            problem.path("wall", (x - 0.52) ** 2, lower=(thick / 2) ** 2)
        problem.minimize(u**2 / 2)
        return problem

    violates_its_task(of(solve(build(False), MultipleShooting(10)), build(True)).audit())


# ---- files and margins -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("word", ["no", "yes", 1, 0, None, [], "True", 1.0])
def test_success_is_true_or_false(word: Any, tmp_path: Path) -> None:
    plan = solve(least_effort(), METHODS["radau"])
    with pytest.raises(ProblemError) as caught:
        replace(plan, success=word).audit()
    assert caught.value.name == "success"
    file = tmp_path / "plan.npz"
    plan.save(file)
    with np.load(file) as archive:
        arrays = dict(archive)
    head = json.loads(arrays["head"].tobytes().decode())
    head["success"] = word
    arrays["head"] = np.frombuffer(json.dumps(head).encode(), dtype=np.uint8)
    np.savez_compressed(file, **arrays)
    with pytest.raises(ProblemError):
        Solution.load(file)


@pytest.mark.parametrize("margin", [-0.3, -1e-9, -np.inf, np.nan])
def test_the_zero_moment_point_has_no_margin_outside_the_foot(margin: float) -> None:
    with pytest.raises(ProblemError) as caught:
        InFoot(margin=margin)
    assert caught.value.name == "margin"


def test_no_rule_lets_the_zero_moment_point_leave_the_foot() -> None:
    """A stability index below zero is a point outside the ellipse; the foot bounds it all the same."""
    machine = standing_example()
    for value in (-0.5, -100.0):
        start = np.array([0.6, 0.5, 0.5, 0.3, 0.3])
        try:
            rule = IndexAtLeast(value)
            problem = standing_problem(
                machine, TipTask(velocity=lambda t: [0.0 * t, 0.1 + 0.0 * t], rows=(4, 5)), 1.0, start=start, zmp=rule
            )
        except ProblemError:
            continue
        names = list(problem.declared.path)
        assert any("foot" in name or "support" in name or "zero moment" in name for name in names), names


def test_the_helpers_draw_their_quantities() -> None:
    """A plan sampled from the optimum has its cost, and its arrays and curves agree."""

    def q(t: Array) -> Array:
        return 3 * t**2 - 2 * t**3

    plan = random_program(
        least_effort(),
        {"q": q, "v": lambda t: 6 * t - 6 * t**2},
        {"u": lambda t: 6 - 12 * t},
        {"q": -12.0, "v": lambda t: -6 + 12 * t},
        1.0,
    )
    assert plan.cost == pytest.approx(6.0, abs=1e-9)
    np.testing.assert_allclose(plan["q"][:, 0], q(plan.t), atol=1e-12)
    holds(plan.audit())
