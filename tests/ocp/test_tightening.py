"""Limits hold between the points too, and the plan keeps the bounds that it was solved under."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
import pytest

from models import FixedBase, planar_chain
from ocp import Collocation, MultipleShooting, Problem, ProblemError, Solution, SolveError, solve, tighten
from ocp.direct.prepared import Prepared
from ocp.problem.formulation import Formulation
from ocp.solution_data import NODE_TOLERANCE, match_order
from tests.ocp.problems import double_integrator, plant, van_der_pol

pytestmark = pytest.mark.xdist_group("tightening")  # one process, so that every plan is tightened once

METHODS = [
    Collocation(10, degree=3),
    Collocation(10, degree=3, scheme="legendre"),
    Collocation(12, degree=2, control="held"),
    MultipleShooting(12),
    MultipleShooting(12, control="linear"),
]


def walled() -> Problem:
    """The double integrator under a ceiling of 1/9 (Bryson, Denham) with a moving limit of its push."""
    problem, _, v, u = double_integrator("walled", (0.0, 1.0), (0.0, -1.0), limit=9.0, ceiling=1 / 9)
    problem.path("power", u * v, lower=-4.5, upper=4.5)
    problem.minimize(running=u**2 / 2)
    return problem


def beyond(solution: Solution) -> float:
    """Worst excess of the ceiling, the push and the power, between the points too."""
    s = np.linspace(0.0, 1.0, 5003)
    at = solution.at_fraction(s)
    power = at["u"] * at["v"]
    return float(max((at["q"] - 1 / 9).max(), (np.abs(at["u"]) - 9).max(), (np.abs(power) - 4.5).max()))


@cache
def tightened(method: Any) -> Solution:
    return tighten(walled(), method)


def tightening_at(bound_tightening: np.ndarray, mesh: np.ndarray, at: np.ndarray) -> np.ndarray:
    """Return the amounts by which the bounds of a plan were tightened at M horizon fractions. Shape (2, M, m).

    ``bound_tightening`` (2, N, m) holds them for each interval; at a node between two intervals the larger one counts.
    """
    last = len(mesh) - 2
    sides = (np.clip(np.searchsorted(mesh, at + slip) - 1, 0, last) for slip in (-NODE_TOLERANCE, NODE_TOLERANCE))
    left, right = (bound_tightening[:, side] for side in sides)
    return np.asarray(np.maximum(left, right))


@pytest.mark.parametrize("method", METHODS, ids=str)
def test_limits_hold_between_the_points(method: Any) -> None:
    plain, tight = solve(walled(), method), tightened(method)
    assert beyond(plain) > 5e-5
    assert beyond(tight) <= 1.001e-6
    assert plain.cost <= tight.cost <= plain.cost * 1.2
    assert not [f for f in tight.audit().failures if f.name.startswith(("bounds", "power"))]


@pytest.mark.parametrize("method", METHODS, ids=str)
def test_the_plan_stores_the_tightening_of_its_bounds(method: Any) -> None:
    """States q, v, control u, path row power: at its own points the plan is within what was left of their bounds."""
    tight = tightened(method)
    mesh = tight.control_interpolant.breaks
    assert tight.bound_tightening is not None
    assert tight.bound_tightening.shape == (2, len(mesh) - 1, 4)
    assert (tight.bound_tightening >= 0).all()
    assert tight.bound_tightening[1, :, 0].max() > 0  # the ceiling
    assert not tight.bound_tightening[:, :, 1].any()  # a speed without bounds
    lower, upper = np.array([-np.inf, -np.inf, -9, -4.5]), np.array([1 / 9, np.inf, 9, 4.5])
    curve = tight.control_interpolant
    owner = np.repeat(np.arange(len(mesh) - 1), len(curve.nodes))
    at = mesh[owner] + np.diff(mesh)[owner] * np.tile(curve.nodes, len(mesh) - 1)
    u = curve.values.reshape(-1, 1)
    shared = tightening_at(tight.bound_tightening, mesh, at)
    states = np.hstack([tight.at_fraction(at)["q"], tight.at_fraction(at)["v"]])
    values = np.hstack([states, u, u * states[:, 1:]])
    jumps = [False, False, *[getattr(method, "control", "") != "linear"] * 2]
    below, above = np.where(jumps, tight.bound_tightening[:, owner], shared)
    points = isinstance(method, Collocation) and method.control == "points"  # where all of it is asked
    checked = slice(None) if points else slice(2, 3)
    inside = (at > 0) & (at < 1)  # the ends of q and v are given
    assert (values >= lower + below - 1e-7)[inside, checked].all()
    assert (values <= upper - above + 1e-7)[inside, checked].all()


@pytest.mark.parametrize("method", METHODS, ids=str)
def test_an_active_limit_is_met_at_its_tightened_value(method: Any) -> None:
    tight = tightened(method)
    assert tight.bound_tightening is not None
    at = tight.t / tight.horizon
    _, above = tightening_at(tight.bound_tightening, tight.control_interpolant.breaks, at)[:, :, 0]
    assert (tight["q"][:, 0] <= 1 / 9 - above + 1e-7)[1:-1].all()
    reached = np.isclose(tight["q"][:, 0], 1 / 9 - above, rtol=0, atol=1e-6)
    assert (reached & (above > 1e-5)).any()


def test_a_control_that_may_jump_is_tightened_in_its_own_interval_alone() -> None:
    """Van der Pol's control leaves its limit in one interval, and only there its polynomial goes beyond."""
    tight = tighten(van_der_pol(lower=-0.5, upper=0.3, horizon=4.0), Collocation(10))
    assert tight.bound_tightening is not None
    assert np.argwhere(tight.bound_tightening)[:, 1:].tolist() == [[7, 2]]


@pytest.mark.parametrize("method", METHODS, ids=str)
def test_few_solves_are_enough(method: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    solved = []
    once = Prepared.solve

    def counted(self: Prepared, *arguments: Any, **named: Any) -> Solution:
        solved.append(self)
        return once(self, *arguments, **named)

    monkeypatch.setattr(Prepared, "solve", counted)
    tighten(walled(), method)
    assert len(solved) <= 4


def test_a_limit_violated_between_points_is_tightened_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """A gate so narrow that all points have 0.2 of room: straight on the way would pass 0.01 beyond it."""
    problem = Problem("gate")
    x, u = problem.state("x", initial=0.0, terminal=1.0), problem.control("u")
    problem.dynamics(x, u)
    problem.horizon(1.0)
    gate = 0.21 * ca.exp(-(((problem.time - 0.365) / 0.014) ** 2))
    problem.path("gate", x - problem.time + gate, upper=0.2)
    problem.minimize(running=u**2)
    solves = []
    run = Prepared.solve

    def counted(*args: Any, **named: Any) -> Solution:
        solves.append(run(*args, **named))
        return solves[-1]

    monkeypatch.setattr(Prepared, "solve", counted)
    tight = tighten(problem, Collocation(5, degree=3))
    t = np.linspace(0.3, 0.43, 1301)
    room = 0.2 - 0.21 * np.exp(-(((t - 0.365) / 0.014) ** 2)) - (tight.at_fraction(t)["x"].ravel() - t)
    assert -1e-5 <= room.min() < 2e-3
    assert len(solves) <= 5


def test_a_node_is_tightened_by_the_larger_of_both_sides() -> None:
    tightening = np.zeros((2, 3, 1))
    tightening[0, :, 0], tightening[1, :, 0] = [1.0, 3.0, 2.0], [0.0, 0.0, 5.0]
    mesh = np.array([0.0, 0.2, 0.7, 1.0])
    below, above = tightening_at(tightening, mesh, np.array([0.0, 0.1, 0.2, 0.5, 0.7, 0.9, 1.0]))[:, :, 0]
    assert below.tolist() == [1, 1, 3, 3, 3, 2, 2]
    assert above.tolist() == [0, 0, 0, 0, 5, 5, 5]


def test_tightened_bounds_are_read_from_a_file(tmp_path: Path) -> None:
    tight = tightened(METHODS[0])
    tight.save(tmp_path / "plan.npz")
    loaded = Solution.load(tmp_path / "plan.npz")
    assert loaded.bound_tightening is not None
    assert tight.bound_tightening is not None
    assert loaded.bound_tightening.tobytes() == tight.bound_tightening.tobytes()
    solve(walled(), METHODS[0]).save(tmp_path / "plan.npz")
    assert Solution.load(tmp_path / "plan.npz").bound_tightening is None


@pytest.mark.parametrize("damage", ["intervals", "entries", "negative", "nan", "inf", "words", "flat"])
def test_a_damaged_file_of_tightened_bounds_is_refused(damage: str, tmp_path: Path) -> None:
    tightening = tightened(METHODS[0]).bound_tightening
    assert tightening is not None
    bad = {
        "intervals": tightening[:, 1:],
        "entries": tightening[:, :, :2],
        "negative": tightening - 1.0,
        "nan": tightening * np.nan,
        "inf": tightening + np.inf,
        "words": tightening.astype(str),
        "flat": tightening[0],
    }[damage]
    replace(tightened(METHODS[0]), bound_tightening=bad).save(tmp_path / "plan.npz")
    with pytest.raises(ProblemError, match="bound_tightening") as caught:
        Solution.load(tmp_path / "plan.npz")
    assert caught.value.name == "bound_tightening"


def test_tightened_bounds_follow_the_order_of_the_problem() -> None:
    tight = tightened(METHODS[0])
    assert tight.bound_tightening is not None
    other = Problem("walled, declared in another order")
    v, q = other.state("v"), other.state("q", upper=1 / 9)
    u = other.control("u")
    other.dynamics(q, v)
    other.dynamics(v, u)
    other.path("power", u * v, lower=-4.5, upper=4.5)
    other.horizon(1.0)
    moved = match_order(Formulation(other), tight)
    assert moved.bound_tightening is not None
    np.testing.assert_array_equal(moved.bound_tightening, tight.bound_tightening[:, :, [1, 0, 2, 3]])


def round_a_disc() -> Problem:
    """A point that goes round a disc: a curved path inequality of the states."""
    problem = Problem("round a disc")
    x = problem.state("x", 2, initial=[-1.0, 0.01], terminal=[1.0, 0.0])
    u = problem.control("u", 2)
    problem.dynamics(x, u)
    problem.horizon(1.0)
    problem.path("clear", ca.sumsqr(x), lower=0.25)
    problem.minimize(running=ca.sumsqr(u) / 2)
    return problem


def weak_motor() -> Problem:
    """A pendulum swung up in a given time by a torque that does not hold it, its power limited too."""
    problem = Problem("weak motor")
    angle = problem.state("angle", initial=0.0, terminal=2.0)
    rate = problem.state("rate", initial=0.0, terminal=0.0, upper=1.1)
    torque = problem.control("torque", lower=-2.0, upper=2.0)
    problem.dynamics(angle, rate)
    problem.dynamics(rate, torque - ca.sin(angle))
    problem.path("power", torque * rate, upper=0.9)
    problem.horizon(2.5)
    problem.minimize(running=torque**2 / 2)
    return problem


def hurried() -> Problem:
    """A carriage whose speed is limited, in a free time with a little effort."""
    problem, _, v, u = double_integrator("hurried", horizon=None, limit=4.0)
    final = problem.horizon(lower=0.1, upper=5.0, guess=1.0)
    problem.path("speed", v, upper=0.7)
    problem.minimize(terminal=final, running=0.02 * u**2)
    return problem


def slow_elbow() -> Problem:
    """An arm of three joints that draws an arc, its joint rates limited: path equalities beside limits of controls."""
    machine = FixedBase(planar_chain([1.0, 0.8, 0.6], [1.0] * 3))
    problem = Problem("slow elbow")
    joints = problem.state("joints", 3, initial=np.deg2rad([30.0, 40.0, 50.0]))
    rates = problem.control("rates", 3, lower=-0.18, upper=0.18)
    problem.dynamics(joints, rates)
    problem.horizon(2.0)
    tip = ca.mtimes(machine.tip_jacobian(np.zeros(0), joints)[[3, 4], :], rates)
    speed = 0.4 * ca.sin(np.pi * problem.time / 2)
    problem.path("task", tip - ca.vertcat(-speed, 0.3 * speed), 0, 0)
    problem.minimize(running=ca.sumsqr(rates) / 2)
    return problem


PANEL: dict[str, Callable[[], Problem]] = {
    "walled": walled,
    "limited control": lambda: van_der_pol(lower=-0.5, upper=0.3, horizon=4.0),
    "round a disc": round_a_disc,
    "weak motor": weak_motor,
    "hurried": hurried,
    "slow elbow": slow_elbow,
}
PANEL_METHODS = [
    Collocation(30),
    Collocation(30, 4, "legendre"),
    Collocation(40, control="held"),
    MultipleShooting(40, steps=2),
    MultipleShooting(40, steps=2, control="linear"),
]


@pytest.mark.parametrize("method", PANEL_METHODS, ids=str)
@pytest.mark.parametrize("name", PANEL)
def test_a_tightened_plan_meets_its_task_and_is_audited_with_its_bounds(name: str, method: Any) -> None:
    """Where the plan was an optimum before its limits were drawn in, it is one under these."""
    plain, tight = solve(PANEL[name](), method).audit(), tighten(PANEL[name](), method).audit()
    missed = {finding.name for finding in tight.failures if finding.verdict == "feasible"}
    equalities = {"task"}  # are not touched, and held controls miss them between the points
    assert missed <= equalities & {finding.name for finding in plain.failures}, str(tight)
    if plain.passed or method.control == "points":
        assert tight.passed, str(tight)


def test_a_plan_that_exceeds_nothing_is_left_as_it_is() -> None:
    problem, q, u = plant("free", state="q", initial=0.0, terminal=1.0, lower=-1.0, upper=2.0, u={"upper": 5.0})
    problem.dynamics(q, u)
    problem.minimize(running=u**2)
    tight = tighten(problem, Collocation(4))
    assert tight.cost == solve(problem, Collocation(4)).cost
    assert tight.bound_tightening is None


def test_it_takes_parameters_and_a_free_horizon() -> None:
    problem = Problem("fast")
    top, q = problem.parameter("top"), problem.state("q", initial=0.0, terminal=1.0)
    v = problem.state("v", initial=0.0, terminal=0.0, upper=top)
    u = problem.control("u", lower=-4.0, upper=4.0)
    problem.dynamics(q, v)
    problem.dynamics(v, u)
    final = problem.horizon(lower=0.1, upper=5.0, guess=1.0)
    problem.minimize(terminal=final, running=1e-3 * u**2)
    solution = tighten(problem, Collocation(12, degree=4), parameters={"top": 0.7})
    at = solution.at_fraction(np.linspace(0, 1, 3001))
    assert at["v"].max() <= 0.7 + 1.001e-6
    assert np.abs(at["u"]).max() <= 4 + 1.001e-6
    assert solution.horizon > 1 / 0.7 + 0.7 / 4  # bang, coast, bang


def test_bounds_that_cannot_be_met_are_named() -> None:
    """A bump in time alone, which no plan can avoid and nodes do not see."""
    problem, q, u = plant("bump", state="q", initial=0.0, terminal=1.0)
    problem.dynamics(q, u)
    problem.path("bump", ca.sin(20 * np.pi * problem.time) ** 2 + 0 * q, upper=0.5)
    problem.minimize(running=u**2)
    assert solve(problem, MultipleShooting(20)).success
    with pytest.raises(SolveError, match=r"bump would have to go"):
        tighten(problem, MultipleShooting(20))


@pytest.mark.parametrize(
    ("changes", "message"),
    [({"tolerance": 0.0}, "tolerance must be positive"), ({"method": "collocation"}, "is expected")],
)
def test_requests_that_cannot_be_right_are_refused(changes: dict[str, Any], message: str) -> None:
    arguments = {"problem": walled(), "method": Collocation(4), **changes}
    with pytest.raises(ProblemError, match=message):
        tighten(**arguments)
