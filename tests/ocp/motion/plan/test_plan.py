"""Plans of every kind of task: they pass, an independent replay agrees, limits hold, and costs obey their laws."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from models import FixedBase, Path, example_robot, smooth
from ocp import Cost, Limits, TipTask
from ocp.motion.local.inverse_kinematics import inverse_kinematics
from ocp.motion.plan import Plan
from ocp.motion.schedule import LineLimits, schedule
from tests.families import some
from tests.models.robot.trees import Array
from tests.ocp.motion.plan.motions import (
    CONE,
    DOWN,
    HELD,
    PLAN_CASES,
    angled_ur5,
    curved_seam,
    panda_peer,
    plan_bare,
    planned,
    raster,
)
from tests.ocp.motion.plan.replay import deviation_of
from tests.ocp.motion.tasks.space_tasks import panda

CLOSE = 1e-6
"""m and rad."""
DAILY = (
    *("three_lanes_panda", "seam_ur5", "seam_panda", "contour_panda", "contour_ur5", "contour_space_arm"),
    *("poses_ur5", "finishing_ur5", "helix_ur5", "poses_panda"),
)
EACH = some([pytest.param(name, marks=pytest.mark.xdist_group(f"plan {name}"), id=name) for name in PLAN_CASES], DAILY)
"""One process for each motion, so that it is planned once."""
every_motion = pytest.mark.parametrize("name", EACH)


def between(plan: Plan, count: int = 401) -> Array:
    """Times that are no nodes, and both ends, s."""
    return np.append(np.linspace(0.0, plan.horizon, count)[:-1] + 1e-4 * plan.horizon / count, plan.horizon)


# ---- the motions -----------------------------------------------------------------------------------------------------


@every_motion
def test_the_motion_passes_and_an_independent_replay_agrees(name: str) -> None:
    what, result = PLAN_CASES[name](), planned(name)
    assert result.audit().passed
    off = deviation_of(
        result,
        what.arm,
        what.path,
        lambda t: what.speed * t,
        times=between(result),
        direction=what.direction,
        tool_axis=what.tool_axis,
    )
    assert off.position < CLOSE
    if what.looks == "axis":
        assert off.axis < CLOSE
    if what.looks == "orientation":
        assert off.orientation < CLOSE
    if what.looks == "cone":
        assert off.axis < CONE + CLOSE


@every_motion
def test_joints_and_rates_keep_the_limits_and_joints_are_the_integral_of_rates(name: str) -> None:
    result, robot = planned(name), PLAN_CASES[name]().machine.robot
    at = result.at(between(result, 2001))
    assert (at["joints"] >= robot.lower - CLOSE).all()
    assert (at["joints"] <= robot.upper + CLOSE).all()
    assert (np.abs(at["rates"]) <= robot.velocity + CLOSE).all()
    nodes, weights = np.polynomial.legendre.leggauss(8)
    kinks = result.solution.state_interpolant.breaks * result.horizon
    half = np.diff(kinks) / 2
    times = (kinks[:-1] + half)[:, None] + half[:, None] * nodes
    rates = result.at(times.ravel())["rates"].reshape(*times.shape, -1)
    moved = np.einsum("k,g,kgn->kn", half, weights, rates)
    np.testing.assert_allclose(np.diff(result.at(kinks)["joints"], axis=0), moved, atol=1e-7)
    spent = np.einsum("k,g,kgn->", half, weights, rates**2) / 2
    assert result.cost == pytest.approx(spent, rel=1e-6)


@pytest.mark.parametrize("name", [each for each in EACH if each.values[0] in ("contour_panda", "contour_ur5")])
def test_a_closed_contour_ends_in_the_joints_it_began_with(name: str) -> None:
    result = planned(name)
    np.testing.assert_allclose(result["joints"][-1], result["joints"][0], atol=1e-7)


@pytest.mark.xdist_group("plan contour_space_arm")
def test_a_closed_contour_of_an_arm_that_floats_turns_its_base() -> None:
    """The joints are not asked to close: they end elsewhere, the tip where it began."""
    what, result = PLAN_CASES["contour_space_arm"](), planned("contour_space_arm")
    ends = np.array([0.0, result.horizon])
    position, _ = what.arm.tips(result, ends, what.arm.drift(result, ends))
    np.testing.assert_allclose(position[1], position[0], atol=CLOSE)
    assert np.abs(result["joints"][-1] - result["joints"][0]).max() > 1e-3
    assert np.abs(result["base"][-1] - result["base"][0]).max() > 1e-4


@pytest.mark.long
@pytest.mark.xdist_group("plan two_arms")
def test_the_hand_that_holds_stays_while_the_other_moves() -> None:
    result = planned("two_arms")
    position, turn = panda_peer(prefix="left_", place=(0.0, 0.3, 0.0)).tips(result, between(result))
    assert np.abs(position - HELD).max() < CLOSE
    down = Rotation.from_quat([1.0, 0.0, 0.0, 0.0])
    assert (down.inv() * Rotation.from_matrix(turn)).magnitude().max() < CLOSE
    moves = np.ptp(result["joints"], axis=0)
    names = np.array([name.startswith("right_") for name in result.names])
    assert moves[names].max() > 0.1


def assert_same_motion(result: Plan, other: Plan, *, back: bool = False) -> None:
    """The same joints at the same shares of the time, but for full turns."""
    share = np.linspace(0.0, 1.0, 101)
    one, two = result.at(share * result.horizon)["joints"], other.at(share * other.horizon)["joints"]
    apart = one - (two[::-1] if back else two)
    np.testing.assert_allclose(
        apart, np.broadcast_to(2 * np.pi * np.round(apart[0] / (2 * np.pi)), apart.shape), atol=1e-4
    )


# ---- laws of the cost ------------------------------------------------------------------------------------------------

SHORT = smooth(Path.through([(0.45, -0.1, 0.25), (0.45, 0.1, 0.25), (0.55, 0.1, 0.3)]), deviation=0.004)
START: dict[str, Any] = {"search": "start"}
RAMPS = {"speed": 0.1, "acceleration": 0.2, "jerk": 2.0}


def short_motion(machine: Any = None, path: Any = SHORT, speed: Any = 0.05, **arguments: Any) -> Plan:
    options = {key: arguments.pop(key) for key in ("cost", "limits", "start") if key in arguments}
    steady = not (hasattr(speed, "profile") or "acceleration" in arguments)
    task = TipTask.along(path, speed, steady=steady, **{"direction": DOWN, **arguments})
    return plan_bare(angled_ur5() if machine is None else machine, task, search="start", **options)


@pytest.fixture(scope="module")
def short() -> Plan:
    return short_motion()


@pytest.mark.xdist_group("plan short")
def test_the_cost_falls_with_time_as_its_inverse(short: Plan) -> None:
    """The same way at a c-th of the speed: rates are divided by c, time is multiplied."""
    slow = short_motion(speed=0.005)
    assert slow.cost == pytest.approx(short.cost / 10, rel=1e-6)
    assert_same_motion(slow, short)


@pytest.mark.long
@pytest.mark.xdist_group("plan short")
def test_the_world_may_be_turned_and_moved_with_all_that_is_in_it(short: Plan) -> None:
    turn, shift = Rotation.from_euler("xyz", [0.4, -0.7, 1.1]), np.array([1.0, -2.0, 0.5])
    corners = turn.apply([(0.45, -0.1, 0.25), (0.45, 0.1, 0.25), (0.55, 0.1, 0.3)]) + shift
    machine = FixedBase(angled_ur5().robot, translation=shift, rotation=turn.as_matrix())
    path = smooth(Path.through(corners), deviation=0.004)
    other = short_motion(machine, path, direction=turn.apply(DOWN))
    assert other.cost == pytest.approx(short.cost, rel=1e-6)
    assert_same_motion(other, short)


@pytest.mark.xdist_group("plan short")
def test_the_reversed_motion_has_the_same_cost(short: Plan) -> None:
    back = smooth(Path.through([(0.55, 0.1, 0.3), (0.45, 0.1, 0.25), (0.45, -0.1, 0.25)]), deviation=0.004)
    other = short_motion(path=back, start=short["joints"][-1])
    free = short_motion(path=back)
    # from that start it is the same motion in reverse; the best start costs no more
    assert other.cost == pytest.approx(short.cost, rel=1e-6)
    assert free.cost <= other.cost * (1 + 1e-6)
    assert_same_motion(other, short, back=True)


@pytest.mark.xdist_group("plan short")
def test_weights_scale_the_cost_and_a_heavily_weighted_joint_moves_less(short: Plan) -> None:
    tripled = short_motion(cost=Cost(weights=np.full(6, 3.0)))
    assert tripled.cost == pytest.approx(3 * short.cost, rel=1e-6)
    heavy = short_motion(cost=Cost(weights=[100.0, 1, 1, 1, 1, 1]))

    def effort(result: Plan) -> float:
        return float(np.trapezoid(result.at(between(result))["rates"][:, 0] ** 2, between(result)))

    assert effort(heavy) < effort(short)
    assert heavy.cost >= short.cost * (1 - 1e-6)


@pytest.mark.long
@pytest.mark.xdist_group("plan three_lanes_panda")
def test_more_freedom_never_costs_more() -> None:
    """From one start: a held axis, one that leans, none at all; and one that leans further."""
    held = planned("three_lanes_panda")
    start = held["joints"][0]
    costs = [held.cost]
    for options in ({"within": np.radians(2)}, {"within": np.radians(5)}, {}):
        request: dict[str, Any] = {"direction": DOWN, **options} if options else {}
        task = TipTask.along(raster(3), 0.05, steady=True, **request)
        costs.append(plan_bare(panda(), task, start=start, search="start").cost)
    assert (np.diff(costs) < 0).all()


@pytest.mark.parametrize(
    "robot",
    some(
        [pytest.param(one, marks=pytest.mark.xdist_group(f"plan finishing_{one}")) for one in ("panda", "ur5")], ["ur5"]
    ),
)
def test_a_cone_costs_less_than_a_fixed_axis_and_is_used_to_its_edge(robot: str) -> None:
    cone, name = planned(f"finishing_{robot}"), {"panda": "three_lanes_panda"}.get(robot)
    held = (
        planned(name)
        if name
        else plan_bare(angled_ur5(), TipTask.along(raster(3), 0.05, steady=True, direction=DOWN), search="start")
    )
    assert cone.cost < 0.9 * held.cost
    what = PLAN_CASES[f"finishing_{robot}"]()
    axis = what.arm.tips(cone, between(cone))[1][:, :, 2]
    lean = np.arccos(np.clip(-axis[:, 2], -1, 1))
    assert CONE - 1e-3 < lean.max() < CONE + CLOSE


# ---- schedules and intervals -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("by_schedule", [True, False])
def test_a_schedule_begins_and_ends_at_rest_on_its_path(by_schedule: bool) -> None:
    path = curved_seam()
    timing = schedule(path, LineLimits(speed=0.1, acceleration=0.2, jerk=2.0))
    result = short_motion(path=path, **({"speed": timing} if by_schedule else RAMPS))
    assert result.audit().remarks == ()
    assert result.audit().passed
    assert result.horizon == pytest.approx(timing.duration)
    ends = result.at([0.0, result.horizon])["rates"]
    assert np.abs(ends).max() < 1e-5
    off = deviation_of(
        result,
        PLAN_CASES["seam_ur5"]().arm,
        path,
        lambda t: timing.at(t).distance,
        times=between(result),
        direction=DOWN,
    )
    assert max(off.position, off.axis) < CLOSE


def test_joints_that_no_task_moves_rest_at_both_ends_if_their_accelerations_are_limited() -> None:
    """From a given start, a redundant arm begins to move at once, unless its velocities must be continuous."""
    machine = FixedBase(example_robot("seven_axis"))
    path = smooth(Path.through([(0.45, -0.1, 0.4), (0.45, 0.1, 0.4)]), deviation=0.002)
    task = TipTask.along(path, 0.1, direction=DOWN)
    start = inverse_kinematics(machine, [task], time=0.0, seed=3)[5].joints
    free, limited = (
        plan_bare(machine, task, start=start, limits=limits) for limits in (None, Limits(acceleration=5.0))
    )
    assert "starts at" in free.audit().sentence
    assert "at rest" in free.audit().sentence
    audit = limited.audit()
    assert audit.passed
    assert audit.remarks == ()
    assert np.abs(limited.at([0.0, limited.horizon])["rates"]).max() < 1e-6
    assert free.cost <= limited.cost * (1 + 1e-6) < 1.01 * free.cost


def two_lines(pause: float = 2.0) -> tuple[list[TipTask], list[Any]]:
    """Two straight lines and nothing asked between them."""
    first = smooth(Path.through([(0.45, -0.2, 0.3), (0.45, 0.0, 0.3)]), deviation=0.001)
    second = smooth(Path.through([(0.6, 0.2, 0.4), (0.6, 0.2, 0.2)]), deviation=0.001)
    tasks = [TipTask.along(first, 0.1, steady=True, direction=DOWN)]
    tasks.append(TipTask.along(second, 0.1, steady=True, direction=(1, 0, -1), begin=tasks[0].end + pause))
    return tasks, [first, second]


def run_since(begin: float, times: Array) -> Array:
    """m, at 0.1 m/s."""
    return 0.1 * (times - begin)


def test_between_two_tasks_joints_go_straight_at_constant_rate() -> None:
    """Each task is kept in its own interval; where nothing is asked the least velocity is the straight line."""
    tasks, paths = two_lines()
    result = plan_bare(panda(), tasks, search="start")
    assert result.audit().passed
    assert result.horizon == pytest.approx(tasks[1].end)
    for task, path, direction in zip(tasks, paths, (DOWN, (1, 0, -1)), strict=True):
        times = np.linspace(task.begin, task.end, 101)[1:-1]
        distance = partial(run_since, task.begin)
        off = deviation_of(result, panda_peer(), path, distance, times=times, direction=direction)
        assert max(off.position, off.axis) < CLOSE
    times = np.linspace(tasks[0].end, tasks[1].begin, 31)[1:-1]
    at = result.at(times)
    rate = (result.at(tasks[1].begin)["joints"] - at["joints"][0]) / (tasks[1].begin - times[0])
    np.testing.assert_allclose(at["rates"], np.broadcast_to(rate, at["rates"].shape), atol=1e-6)
    assert np.abs(rate).max() > 0.01


@pytest.mark.long
def test_a_task_in_two_segments_is_the_same_motion() -> None:
    """One task over the whole time, and two that follow each other: their union asks for the same."""
    path = smooth(Path.through([(0.45, -0.1, 0.25), (0.45, 0.1, 0.25)]), deviation=0.004)
    whole = TipTask.along(path, 0.05, steady=True, direction=DOWN)
    assert whole.duration is not None
    half = whole.duration / 2

    def later(track: Any) -> Any:
        return lambda t: track(t + half)

    first = replace(whole, duration=half, breaks=())
    second = replace(whole, position=later(whole.position), begin=half, duration=half, breaks=())
    one = plan_bare(angled_ur5(), whole, search="start")
    two = plan_bare(angled_ur5(), [first, second], start=one["joints"][0])
    assert two.audit().passed
    assert two.cost == pytest.approx(one.cost, rel=1e-6)
    times = between(one)
    np.testing.assert_allclose(two.at(times)["joints"], one.at(times)["joints"], atol=1e-5)


@pytest.mark.xdist_group("plan short")
def test_active_limits_hold_and_increase_the_cost(short: Plan) -> None:
    most = float(np.abs(short["rates"]).max())
    limited = short_motion(limits=Limits(velocity=0.9 * most))
    assert limited.audit().passed
    # between its points a polynomial may swing over, by less than what the audit lets pass
    assert np.abs(limited.at(between(limited))["rates"]).max() <= 0.9 * most * (1 + 1e-3)
    assert limited.cost >= short.cost * (1 - 1e-9)
