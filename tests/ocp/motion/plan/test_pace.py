"""How fast a motion is: tasks of any slowness, and times that the plan finds itself, with the laws of both."""

from __future__ import annotations

from functools import cache
from itertools import pairwise
from typing import Any

import casadi as ca
import numpy as np
import pytest

from models import Path, smooth
from ocp import Cost, Limits, TipTask
from ocp.motion.plan import Plan
from ocp.motion.tasks.tip_task import retime_task
from tests.families import some
from tests.models.robot.trees import Array
from tests.ocp.motion.plan.motions import DOWN, angled_ur5, angled_ur5_arm, plan_bare
from tests.ocp.motion.plan.replay import deviation_of

pytestmark = pytest.mark.xdist_group("pace")  # one process, so that every motion is planned once

CURVED_PATH = smooth(Path.through([(0.45, -0.1, 0.25), (0.45, 0.1, 0.25), (0.55, 0.1, 0.3)]), deviation=0.004)
FAST = 5.0
"""m/s: faster than any pace that these plans find."""
UNLIMITED = Limits(velocity=np.full(6, 1e3))


def task_at(speed: float, **options: Any) -> TipTask:
    return TipTask.along(CURVED_PATH, speed, steady=True, direction=DOWN, **options)


@cache
def first() -> Array:
    """Where all these motions start: where the best of a free start does."""
    return np.asarray(plan_bare(angled_ur5(), task_at(0.05), search="start")["joints"][0])


@cache
def fixed(speed: float) -> Plan:
    return plan_bare(angled_ur5(), task_at(speed), start=first(), search="start")


@cache
def free(time_cost: float, speed: float = FAST, limited: bool = False) -> Plan:
    limits = None if limited else UNLIMITED
    options: dict[str, Any] = {"search": "start", "cost": Cost(time=time_cost), "start": first(), "limits": limits}
    return plan_bare(angled_ur5(), task_at(speed), "free", **options)


def effort(result: Plan, time_cost: float) -> float:
    """What the joint rates cost, by quadrature of what the plan says of them."""
    nodes, weights = np.polynomial.legendre.leggauss(12)
    share = result.solution.state_interpolant.breaks
    kinks = result.solution.at_fraction(share)["clock"][:, 0]
    half = np.diff(kinks) / 2
    times = (kinks[:-1] + half)[:, None] + half[:, None] * nodes
    rates = result.at(times.ravel())["rates"].reshape(*times.shape, -1)
    spent = float(np.einsum("k,g,kgn->", half, weights, rates**2) / 2)
    assert result.cost == pytest.approx(spent + time_cost * result.horizon, rel=1e-6)
    return spent


# ---- slow motions ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("slower", [*(pytest.param(each, marks=pytest.mark.long) for each in (10.0, 1e5)), 1e3])
def test_a_motion_may_be_as_slow_as_one_likes(slower: float) -> None:
    """From 6 s to a week: the same way, its cost divided, on a mesh as coarse."""
    one, other = fixed(0.05), fixed(0.05 / slower)
    assert other.audit().passed
    assert other.horizon == pytest.approx(slower * one.horizon)
    assert other.cost == pytest.approx(one.cost / slower, rel=1e-6)
    assert len(other.t) == len(one.t)
    share = np.linspace(0.0, 1.0, 101)
    moved = other.at(share * other.horizon)["joints"] - one.at(share * one.horizon)["joints"]
    np.testing.assert_allclose(moved, 0.0, atol=1e-4)


def test_a_slow_tip_is_where_its_task_says() -> None:
    """At a tenth of a millimetre a second, most of an hour."""
    result, speed = fixed(0.05 / 500), 0.05 / 500
    times = np.linspace(0.0, result.horizon, 402)[:-1] + 1e-3
    off = deviation_of(result, angled_ur5_arm(), CURVED_PATH, lambda t: speed * t, times=times, direction=DOWN)
    assert max(off.position, off.axis) < 1e-6


def test_a_gap_is_closed_as_fast_as_the_task_says_however_long_it_lasts() -> None:
    """e' = -gain e of a tip that begins a millimetre beside its place."""
    place = np.array([0.45, -0.1, 0.251])
    task = TipTask(position=place, rows=(5,), gain=2.0, start_gap=0.01, duration=40.0)
    result = plan_bare(angled_ur5(), task, start=first(), search="start")
    times = np.array([0.0, 0.5, 1.0, 2.0])
    height = angled_ur5_arm().tips(result, times)[0][:, 2]
    np.testing.assert_allclose(height - place[2], -1e-3 * np.exp(-2.0 * times), atol=1e-6)


# ---- times that the plan finds ---------------------------------------------------------------------------------------

TIME_COSTS = (0.1, 0.2, 0.4)


@pytest.mark.parametrize("time_cost", some(TIME_COSTS, 1))
def test_without_limits_the_effort_equals_the_time_cost_at_all_times(time_cost: float) -> None:
    """A clock that may run as it likes makes the Hamiltonian zero: 1/2 |rates|^2 = time_cost."""
    result = free(time_cost)
    assert result.audit().passed
    rates = result.at(np.linspace(0.0, result.horizon, 201))["rates"]
    np.testing.assert_allclose((rates**2).sum(axis=1) / 2, time_cost, rtol=3e-3)
    assert effort(result, time_cost) == pytest.approx(time_cost * result.horizon, rel=1e-6)


@pytest.mark.long
def test_a_time_cost_four_times_as_high_halves_the_time_and_keeps_the_path() -> None:
    one, other = free(0.1), free(0.4)
    assert other.horizon == pytest.approx(one.horizon / 2, rel=1e-6)
    assert other.cost == pytest.approx(2 * one.cost, rel=1e-6)
    share = np.linspace(0.0, 1.0, 101)
    np.testing.assert_allclose(
        other.at(share * other.horizon)["joints"], one.at(share * one.horizon)["joints"], atol=1e-5
    )


def test_a_given_speed_is_an_upper_limit() -> None:
    """Twice as fast a task, where neither binds, is the same motion."""
    one, other = free(0.1), free(0.1, 2 * FAST)
    assert other.horizon == pytest.approx(one.horizon, rel=1e-6)
    assert other.cost == pytest.approx(one.cost, rel=1e-6)


def test_a_task_slower_than_is_best_is_done_at_its_own_speed() -> None:
    """The pace is 1 all along: the plan is that of the fixed horizon, and its time is paid beside it."""
    slow, result = fixed(0.05), free(1.0, 0.05)
    assert result.horizon == pytest.approx(slow.horizon, rel=1e-9)
    assert result.cost == pytest.approx(slow.cost + slow.horizon, rel=1e-6)


def test_at_the_pace_that_was_found_the_plan_of_a_fixed_horizon_costs_as_much() -> None:
    """The same task with the clock that was found, written as a function of time."""
    time_cost = 0.1
    result = free(time_cost)
    breaks = result.solution.state_interpolant.breaks
    share = np.unique(np.concatenate([np.linspace(a, b, 41) for a, b in pairwise(breaks)]))
    clock = result.solution.at_fraction(share)["clock"][:, 0]
    clock[0] = 0.0
    run = ca.interpolant("run", "bspline", [clock], share * result.solution.horizon)
    task = task_at(FAST)
    kinks = result.solution.at_fraction(task.breaks / task.duration)["clock"][:, 0]
    again = plan_bare(
        angled_ur5(),
        retime_task(
            TipTask(position=task.position, direction=task.direction, duration=result.horizon, breaks=kinks), run
        ),
        start=first(),
        search="start",
        limits=UNLIMITED,
    )
    assert again.cost == pytest.approx(effort(result, time_cost), rel=1e-5)


def test_at_constant_speed_the_same_time_costs_more() -> None:
    """The pace is worth something: the task run evenly in the time that was found."""
    result = free(0.1)
    even = plan_bare(
        angled_ur5(), task_at(CURVED_PATH.length / result.horizon), start=first(), search="start", limits=UNLIMITED
    )
    assert even.horizon == pytest.approx(result.horizon)
    assert even.cost > 1.01 * effort(result, 0.1)


def costs(limited: bool) -> tuple[Array, list[Plan]]:
    """Of rising time costs, with limits those where some bind, without them those where none does."""
    prices = np.array([0.5, 1.0, 2.0, 200.0] if limited else TIME_COSTS)
    return prices, [free(price, 1.0 if limited else FAST, limited) for price in prices]


@pytest.mark.long
@pytest.mark.parametrize("limited", [False, pytest.param(True, marks=pytest.mark.long)])
def test_a_higher_time_cost_is_never_slower_and_the_cost_rises_with_it_by_the_time(limited: bool) -> None:
    """The least of functions linear in the time cost is concave in it, and its slope is the time."""
    prices, plans = costs(limited)
    times, totals = np.array([plan.horizon for plan in plans]), np.array([plan.cost for plan in plans])
    spent = np.array([effort(plan, price) for plan, price in zip(plans, prices, strict=True)])
    assert (np.diff(times) < 0).all()
    assert (np.diff(spent) > 0).all()
    slope = np.diff(totals) / np.diff(prices)
    assert (slope <= times[:-1] * (1 + 1e-6)).all()
    assert (slope >= times[1:] * (1 - 1e-6)).all()


@pytest.mark.long
def test_towards_least_time_a_joint_or_the_task_itself_is_at_its_limit_everywhere() -> None:
    """Where neither were, that piece could be done faster."""
    result = free(200.0, 1.0, True)
    most = angled_ur5().robot.velocity
    share = np.linspace(0.0, 1.0, 301)
    times = result.solution.at_fraction(share)["clock"][:, 0]
    used = np.abs(result.at(np.clip(times, 0.0, result.horizon))["rates"]) / most
    pace = result.solution.at_fraction(share)["pace"][:, 0]
    assert (used <= 1 + 1e-3).all()
    assert (pace >= 1 - 1e-3).all()
    np.testing.assert_array_less(0.97, np.maximum(used.max(axis=1), 1 / pace))
