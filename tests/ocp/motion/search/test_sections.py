"""Ways with two free directions: no dearer than with a joint held, one cost however finely they are asked for."""

from __future__ import annotations

from functools import cache, partial
from typing import Any

import casadi as ca
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from models import Box, FixedBase
from models.checks import Array
from models.robot.rebuild import lock_joints
from ocp import Cost, DeadEnd, ProblemError, Scene, SolveError, Unreachable, Waypoints, plan
from ocp.motion.plan import waypoints
from ocp.motion.plan.waypoints import WaypointSettings
from ocp.motion.result.path_plan import PathPlan
from ocp.motion.search.reconfigurations import SectionSettings, section_values
from ocp.motion.search.search import SearchSettings
from tests.families import some
from tests.redundancy_benchmark import problem_of

STEP = 0.1
"""rad and m, of 40 waypoints."""


@given(st.booleans(), st.floats(-4, 4), st.floats(0, 8), st.floats(1e-3, 10))
def test_values_are_no_farther_apart_than_a_step_and_reach_the_limits(
    slides: bool, low: float, far: float, step: float
) -> None:
    values, most = section_values(slides, low, low + far, step), min(SectionSettings().spacing[not slides], step)
    ends = np.clip((low, low + far), -np.pi, np.pi)
    gap = float(np.diff(values).max(initial=0.0))
    assert gap <= most * (1 + 1e-9) or len(values) >= SectionSettings().values - 1
    assert len(values) <= SectionSettings().values
    assert values[0] == ends[0]
    if slides or np.ptp(ends) < 2 * np.pi - 1e-6:
        assert values[-1] == pytest.approx(ends[1])
    else:  # the last is as far from the first, all round, as from the one before
        assert values[0] + 2 * np.pi - values[-1] == pytest.approx(gap if len(values) > 1 else 2 * np.pi)


@pytest.mark.parametrize("slides", [True, False])
def test_a_joint_without_limits_is_held_all_round_or_about_where_it_is(slides: bool) -> None:
    values = section_values(slides, -np.inf, np.inf, np.inf)
    assert np.abs(values).max() <= np.pi
    assert len(np.unique(np.round(np.remainder(values, 2 * np.pi), 9))) == len(values) - slides


@cache
def task(count: int) -> tuple[Array, Array]:
    """An oval in front of the lifting arm, 0.4 m high, the hand level."""
    problem, s = problem_of("fetch__square"), np.linspace(0, 2 * np.pi, count)[:, None]
    place = np.array([0.75, 0.1, 0.9]) + s * 0
    place += 0.05 * np.sin(s) * (0, 1, 0) + 0.2 * (1 - np.cos(s)) * (0, 0, 0.5)
    return place, np.tile(problem.quaternions[0], (count, 1))


@cache
def planned(count: int, weights: tuple[float, ...] | None = None) -> PathPlan:
    machine, cost = problem_of("fetch__square").machine, Cost(velocity=0.0, length=1.0, weights=weights)
    return path(machine, Waypoints(*task(count), step=STEP * 39 / (count - 1)), cost=cost)


def path(machine: FixedBase, waypoints: Waypoints, **options: Any) -> PathPlan:
    """As `plan`, for paths of whatever the links may touch."""
    result = plan(machine, waypoints, scene=False, **options)
    assert isinstance(result, PathPlan)
    return result


def limit_charts(monkeypatch: pytest.MonkeyPatch, count: int) -> None:
    """Memory for so many charts."""
    own = WaypointSettings(search=SearchSettings(charts=count), sections=SectionSettings(charts=count))
    monkeypatch.setattr(waypoints, "_WaypointPlanner", partial(waypoints._WaypointPlanner, settings=own))


@pytest.mark.long
def test_a_path_meets_its_poses_and_costs_no_more_than_with_the_lift_fixed() -> None:
    machine, result = problem_of("fetch__square").machine, planned(40)
    tips = [np.array(ca.DM(machine.tip_pose((), q).position)).ravel() for q in result.joints]
    assert np.array(tips) == pytest.approx(task(40)[0], abs=1e-6)
    assert (result.steps <= STEP + 1e-9).all()
    assert result.bound is not None
    assert 0 < result.bound <= result.cost
    assert np.ptp(result.joints[:, 0]) > 0.1  # from one value to another
    for height in (0.0, 0.2, 0.38):
        arm = FixedBase(lock_joints(machine.robot, {machine.robot.joint_names[0]: height}))
        held = plan(arm, Waypoints(*task(40), step=STEP), scene=False)
        assert result.cost <= held.cost * (1 + 1e-6)


@pytest.mark.long
def test_poses_out_of_reach_at_a_fixed_height_are_reached_by_lifting() -> None:
    machine, count = problem_of("fetch__square").machine, 40
    places = np.column_stack([np.full(count, 0.75), np.zeros(count), np.linspace(0.2, 1.4, count)])
    turns = np.tile((1.0, 0.0, 0.0, 0.0), (count, 1))
    result = path(machine, Waypoints(places, turns, step=STEP))
    assert result.joints[-1, 0] > result.joints[0, 0] + 0.1
    for height in (0.0, 0.2, 0.38):
        arm = FixedBase(lock_joints(machine.robot, {machine.robot.joint_names[0]: height}))
        with pytest.raises(Unreachable):
            plan(arm, Waypoints(places, turns, step=STEP), scene=False)


@pytest.mark.long
def test_the_reversed_path_is_as_long_and_weights_increase_the_cost() -> None:
    machine, result = problem_of("fetch__square").machine, planned(40)
    places, turns = task(40)
    back = plan(machine, Waypoints(places[::-1], -turns[::-1], step=STEP), scene=False)
    assert back.cost == pytest.approx(result.cost, rel=0.03)
    heavy = planned(40, weights=(100.0, *np.ones(7)))
    assert np.abs(np.diff(heavy.joints[:, 0])).sum() < np.abs(np.diff(result.joints[:, 0])).sum()


@pytest.mark.long
@pytest.mark.parametrize("count", [20, 200, 1500])
def test_more_waypoints_of_one_path_change_little(count: int) -> None:
    assert planned(count).cost == pytest.approx(planned(40).cost, rel=0.03)


@pytest.mark.long
def test_where_there_are_more_charts_than_memory_is_for_fewer_waypoints_are_searched(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    limit_charts(monkeypatch, 4000)
    machine = problem_of("fetch__square").machine
    result = plan(machine, Waypoints(*task(40), step=STEP), scene=False)
    assert result.cost == pytest.approx(planned(40).cost, rel=0.1)
    limit_charts(monkeypatch, 10)
    with pytest.raises(ProblemError) as refused:
        plan(machine, Waypoints(*task(40), step=STEP), scene=False)
    assert refused.value.name == "configurations"


@pytest.mark.long
def test_obstacles_are_named_with_the_waypoint() -> None:
    machine = problem_of("fetch__square").machine
    places, turns = task(40)
    box = Box((0.1, 0.1, 0.1), tuple(places[20]))
    with pytest.raises(DeadEnd, match="the search does not rule one out: from waypoint") as refused:
        plan(
            machine,
            Waypoints(places, turns, step=STEP),
            scene=Scene(obstacles=[box], ignored=problem_of("fetch__square").ignored),
        )
    assert not refused.value.proven
    assert refused.value.time is not None
    assert refused.value.time < 20 <= refused.value.until + 10
    assert "obstacle 0" in str(refused.value)


@pytest.mark.long
@pytest.mark.parametrize("count", some([2, 5], [2]))
def test_a_handful_of_waypoints_may_be_as_far_apart_as_one_likes(count: int) -> None:
    places, turns = (rows[:count] for rows in task(40))
    machine = problem_of("fetch__square").machine
    result = path(machine, Waypoints(places, turns))
    tips = [np.array(ca.DM(machine.tip_pose((), q).position)).ravel() for q in result.joints]
    assert np.array(tips) == pytest.approx(places, abs=1e-6)
    assert result.cost == pytest.approx(np.abs(np.diff(result.joints, axis=0)).sum(), rel=1e-12)


def test_a_waypoint_out_of_reach_is_named_wherever_it_is_seen_first() -> None:
    """Also among the few that short ways are looked for at, and not among the many."""
    places, turns = task(40)
    number = 13
    away = places.copy()
    away[number] += (0.0, 0.0, 3.0)
    with pytest.raises(Unreachable, match=f"^waypoint {number} at") as refused:
        plan(problem_of("fetch__square").machine, Waypoints(away, turns, step=STEP), scene=False)
    assert refused.value.time == number


@pytest.mark.long
def test_where_nothing_is_clear_at_the_first_waypoint_none_begins() -> None:
    lifting, arm = problem_of("fetch__square"), problem_of("fetch_arm__s")
    for problem in (lifting, arm):
        places, turns = task(40)
        box = Box((0.1, 0.1, 0.1), tuple(places[0]))
        with pytest.raises(DeadEnd, match="none begins at waypoint 0"):
            plan(
                problem.machine,
                Waypoints(places, turns, step=STEP),
                scene=Scene(obstacles=[box], ignored=problem.ignored),
            )


def test_where_the_joint_is_held_at_no_value_that_does_the_waypoint_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(waypoints, "section_values", lambda *_, **__: np.array([10.0]))
    machine = problem_of("fetch__square").machine
    with pytest.raises(SolveError, match="at waypoint 0 on the sections of 'torso_lift_joint'") as refused:
        plan(machine, Waypoints(*task(40), step=STEP), scene=False)
    assert (refused.value.name, refused.value.time) == ("torso_lift_joint", 0.0)


@pytest.mark.long
def test_with_one_free_direction_fewer_waypoints_are_searched_too(monkeypatch: pytest.MonkeyPatch) -> None:
    machine = problem_of("fetch_arm__s").machine
    result = path(machine, Waypoints(*task(40), step=STEP))
    limit_charts(monkeypatch, 1000)  # there are some 300 at each of 9 waypoints
    again = path(machine, Waypoints(*task(40), step=STEP))
    assert again.cost == pytest.approx(result.cost, rel=0.02)
    assert again.gap is not None
    assert again.gap >= 0
