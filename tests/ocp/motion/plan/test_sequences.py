"""Goals and tasks in sequence: approach, task, retreat as one plan with continuous joints."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from itertools import pairwise
from pathlib import Path as FilePath
from typing import Any

import casadi as ca
import numpy as np
import pytest

from models import FixedBase, FreeFloating, Link, MovingObstacle, Path, Sphere, example_robot, planar_chain, smooth
from models.paths import rest_to_rest
from ocp import Goal, Limits, Plan, ProblemError, Scene, TipTask, Unreachable, Waypoints, plan
from ocp.motion.result.segmented_plan import SequencePlan
from ocp.motion.tasks.equations import task_errors
from tests.ocp.motion.sampling.sliders import slider

ARM = FixedBase(planar_chain([0.5, 0.4, 0.3], [2.0, 1.5, 1.0]))
HOME, AWAY = np.array([0.3, 0.8, 0.4]), np.array([1.0, 0.5, -0.3])


def seam(share: Callable[[Any], Any] = lambda t: t, seconds: float = 1.0, x: float = 0.6) -> TipTask:
    """A straight line of 0.4 m, at a share of it that is a function of time."""
    return TipTask(
        position=lambda t: ca.vertcat(x, -0.2 + 0.4 * share(t / seconds), 0.0), rows=(3, 4), duration=seconds
    )


RESTING = seam(rest_to_rest, 2.0)


def in_sequence(parts: Any, **options: Any) -> SequencePlan:
    planned = plan(ARM, parts, **{"start": HOME, "scene": False, "time_limit": 3600.0, **options})
    assert isinstance(planned, SequencePlan)
    return planned


@cache
def weld() -> SequencePlan:
    return in_sequence([Goal(joints=AWAY, name="clear"), seam(), Goal(joints=HOME, name="home")])


def test_the_arm_goes_to_the_seam_along_it_and_home() -> None:
    planned = weld()
    assert planned.phases == ("clear", "approach to task 2", "task 2", "home")
    assert planned.audit().passed
    assert planned.cost == pytest.approx(sum(part.cost for part in planned.parts))
    assert planned.horizon == pytest.approx(sum(part.horizon for part in planned.parts))
    for time, joints in ((0.0, HOME), (planned.pieces[1].begin, AWAY), (planned.horizon, HOME)):
        np.testing.assert_allclose(planned.at(time)["joints"], joints, atol=1e-9)
    begin = planned.pieces[2].begin
    local = np.linspace(0.0, 1.0, 101)
    errors = task_errors(ARM, seam(), local, planned.at(begin + np.clip(local, 0.0, 1 - 1e-9))["joints"])
    assert np.abs(errors).max() < 1e-6


def test_joints_are_continuous_and_each_part_is_its_own_plan() -> None:
    planned = weld()
    for before, after in pairwise(planned.pieces):
        assert np.abs(planned.at(after.begin - 1e-9)["joints"] - planned.at(after.begin)["joints"]).max() < 1e-6
        assert after.begin == pytest.approx(before.begin + before.plan.horizon)
    alone = plan(ARM, seam(), start=planned.parts[2].at(0.0)["joints"], scene=False)
    assert planned.parts[2].cost == pytest.approx(alone.cost, rel=1e-6)
    times = np.linspace(0.0, planned.horizon, 201)
    sample = planned.sampled(times)
    assert np.abs(np.diff(sample.joints, axis=0)).max() < 1.0 * (times[1] - times[0]) * (1 + 1e-6)
    assert "home" in str(planned)


def test_the_start_of_a_task_is_chosen_for_the_way_to_it_and_the_task_together() -> None:
    """A wrist that may be turned about: the task costs the same from several starts, the way to them does not."""
    machine, home = FixedBase(example_robot("six_axis")), np.array([0.0, -0.6, 1.2, 0.0, 0.9, 0.0])
    path = smooth(Path.through([(0.4, -0.1, 0.3), (0.4, 0.1, 0.3)]), deviation=0.002)
    task = TipTask.along(path, 0.1, steady=True, direction=(0, 0, -1))
    planned = plan(machine, [task, Goal(joints=home)], start=home, scene=False)
    alone = plan(machine, task, scene=False)
    to_alone = plan(machine, Goal(joints=alone.at(0.0)["joints"]), start=home, scene=False)
    assert isinstance(planned, SequencePlan)
    approach, along, _ = planned.parts
    assert approach.cost + along.cost <= (to_alone.cost + alone.cost) * (1 + 1e-6)
    others = [c.start for c in alone.candidates]
    nearest = min(float(((start - home) ** 2).sum()) for start in others)
    assert ((along.at(0.0)["joints"] - home) ** 2).sum() <= 1.5 * nearest


def test_goals_at_which_the_arm_rests_cost_what_their_motions_cost_alone() -> None:
    planned = in_sequence([Goal(joints=AWAY), Goal(joints=HOME, duration=3.0), Goal(joints=AWAY, name="again")])
    starts = HOME, AWAY, HOME
    goals = (Goal(joints=AWAY), Goal(joints=HOME, duration=3.0), Goal(joints=AWAY))
    alone = [plan(ARM, goal, start=start, scene=False) for goal, start in zip(goals, starts, strict=True)]
    assert planned.cost == pytest.approx(sum(each.cost for each in alone), rel=1e-9)
    assert planned.parts[1].horizon == pytest.approx(3.0)
    assert planned.phases == ("goal 1", "goal 2", "again")
    passing = [Goal(joints=AWAY, velocity="free", duration=1.0), Goal(joints=HOME, duration=1.0)]
    assert not isinstance(plan(ARM, passing, start=HOME, scene=False), SequencePlan)
    timed = [Goal(joints=[0.1, 0.0], duration=1.0), Goal(joints=[0.0, 0.0], duration=1.0)]
    among_moving = plan(slider(), timed, start=[0.0, 0.0], scene=MOVING)  # whose obstacle needs one clock
    assert not isinstance(among_moving, SequencePlan)
    assert among_moving.audit().feasible


def test_a_goal_at_the_start_of_the_seam_takes_its_configuration() -> None:
    planned = in_sequence([Goal(position=(0.6, -0.2, 0.0)), seam(), Goal(joints=HOME)])
    assert planned.phases == ("goal 1", "task 2", "goal 3")
    assert planned.audit().passed
    joints = planned.parts[1].at(0.0)["joints"]
    fixed = in_sequence([Goal(joints=joints), seam()])
    assert fixed.phases == ("goal 1", "task 2")
    np.testing.assert_allclose(fixed.parts[1].at(0.0)["joints"], joints, atol=1e-9)


def test_a_sequence_may_begin_with_a_task_and_do_two_of_them() -> None:
    free = in_sequence([[seam()], [seam(x=0.7)]], start=None)
    assert free.phases == ("task 1", "approach to task 2", "task 2")
    led = in_sequence([seam(), Goal(joints=HOME)])
    assert led.phases == ("approach to task 1", "task 1", "goal 2")
    np.testing.assert_allclose(led.at(0.0)["joints"], HOME, atol=1e-12)


@pytest.mark.long
def test_within_actuator_limits_velocities_are_continuous_and_tips_at_rest_mean_joints_at_rest() -> None:
    limits = Limits(acceleration=4.0)
    planned = in_sequence([Goal(joints=AWAY), RESTING, Goal(joints=HOME)], limits=limits)
    assert planned.smooth
    assert planned.audit().passed
    for piece in planned.pieces[1:]:
        for time in (piece.begin - 1e-9, piece.begin):
            assert np.abs(planned.at(time)["rates"]).max() < 1e-5
    times = np.linspace(0.0, planned.horizon, 2001)
    accelerations = np.diff(planned.at(times)["rates"], axis=0) / np.diff(times)[:, None]
    assert np.abs(accelerations).max() < 4.0 * 1.01


@pytest.mark.long
def test_a_task_that_moves_at_once_is_entered_at_its_velocity_if_the_goal_may_be_passed() -> None:
    limits, at_start = Limits(acceleration=8.0), (0.6, -0.2, 0.0)
    passed = in_sequence([Goal(position=at_start, velocity="free"), seam(), Goal(joints=HOME)], limits=limits)
    assert passed.phases == ("goal 1", "task 2", "goal 3")
    assert passed.audit().feasible
    begin = passed.pieces[1].begin
    assert np.abs(passed.at(begin)["rates"]).max() > 0.1
    np.testing.assert_allclose(passed.at(begin - 1e-9)["rates"], passed.at(begin)["rates"], atol=1e-5)
    with pytest.raises(ProblemError, match=r"task 2: .*velocity='free'") as refused:
        in_sequence([Goal(position=at_start), seam(), Goal(joints=HOME)], limits=limits)
    assert refused.value.name == "velocity"


def test_a_file_holds_the_sequence(tmp_path: FilePath) -> None:
    weld().save(tmp_path / "weld.npz")
    again = Plan.load(tmp_path / "weld.npz")
    assert isinstance(again, SequencePlan)
    assert (again.phases, again.smooth, again.cost) == (weld().phases, weld().smooth, weld().cost)
    times = np.linspace(0.0, weld().horizon, 51)
    np.testing.assert_array_equal(again.sampled(times).tip, weld().sampled(times).tip)
    assert again.audit().passed


def test_a_changed_motion_is_found_by_the_audit() -> None:
    parts = weld().parts
    shuffled = replace(weld(), parts=(parts[1], parts[0], *parts[2:]), _audits={})
    assert not shuffled.audit().feasible
    assert any(finding.name.startswith("joints between motions") for finding in shuffled.audit().failures)
    assert any(f.name.startswith("rates between") for f in replace(weld(), smooth=True, _audits={}).audit().failures)


@pytest.mark.parametrize(
    "change",
    [
        lambda head: head.pop("phases"),
        lambda head: head.update(phases=["a"] * 7),
        lambda head: head.update(phases=[]),
        lambda head: head.update(smooth="no"),
    ],
)
def test_a_damaged_file_is_refused(change: Callable[[dict[str, Any]], Any]) -> None:
    arrays = weld().arrays("weld.npz")
    head = json.loads(arrays["sequence"].tobytes())
    change(head)
    with pytest.raises(ProblemError, match=r"weld\.npz"):
        SequencePlan.of_arrays("weld.npz", {**arrays, "sequence": np.frombuffer(json.dumps(head).encode(), np.uint8)})


FAR = TipTask(position=lambda t: ca.vertcat(2.0 + t, 0.0, 0.0), rows=(3, 4), duration=1.0)
WAY = Waypoints([[0.6, 0.0, 0.0], [0.6, 0.1, 0.0]], [[1.0, 0.0, 0.0, 0.0]] * 2)
MOVING = Scene([MovingObstacle(Sphere(0.1, (0.0, 0.0, 0.0)), position=lambda t: ca.vertcat(3.0, t, 0.0))])
BAD: dict[str, tuple[Any, dict[str, Any], str]] = {
    "no start": ([Goal(joints=HOME), seam()], {"start": None}, "start"),
    "waypoints": ([Goal(joints=HOME), WAY], {}, "part 2"),
    "a number": ([Goal(joints=HOME), 3.0], {}, "part 2"),
    "no tasks": ([Goal(joints=HOME), []], {}, "part 2"),
    "a horizon": ([Goal(joints=HOME), seam()], {"horizon": 3.0}, "horizon"),
    "cyclic": ([Goal(joints=HOME), seam()], {"cyclic": True}, "cyclic"),
    "a goal of another size": ([Goal(joints=[0.0]), seam()], {}, "goal"),
}


@pytest.mark.parametrize("name", BAD)
def test_what_cannot_be_done_in_sequence_is_refused_by_name(name: str) -> None:
    parts, options, named = BAD[name]
    with pytest.raises(ProblemError) as refused:
        in_sequence(parts, **options)
    assert refused.value.name == named


def test_the_part_that_cannot_be_done_is_named() -> None:
    with pytest.raises(Unreachable, match=r"^task 2: "):
        in_sequence([Goal(joints=AWAY), FAR])
    with pytest.raises(Unreachable, match=r"^out: "):
        in_sequence([Goal(position=(3.0, 0.0, 0.0), name="out"), seam()])


def test_obstacles_that_move_are_refused_since_parts_have_no_times_before_they_are_planned() -> None:
    arm = FixedBase(example_robot("six_axis"))
    with pytest.raises(ProblemError) as refused:
        plan(arm, [Goal(joints=np.zeros(6)), [seam()]], start=np.zeros(6), scene=MOVING)
    assert refused.value.name == "obstacles"


def test_on_a_floating_base_the_task_begins_where_the_goal_is_reached() -> None:
    satellite = Link("base", 20.0, (0.0, 0.0, 0.0), np.eye(3) * 2.0)
    machine = FreeFloating(planar_chain([0.5, 0.4, 0.3], [2.0, 1.5, 1.0], base=satellite), "planar")
    turn = TipTask(rows=(2,), velocity=(0.1,), duration=0.5)
    goal = Goal(joints=HOME + 0.1, duration=1.0)
    planned = plan(machine, [goal, turn], start=HOME, scene=False)
    assert planned.audit().feasible
    begin = planned.pieces[1].begin  # type: ignore[attr-defined]
    for name in ("joints", "base"):
        np.testing.assert_allclose(planned.at(begin - 1e-9)[name], planned.at(begin)[name], atol=1e-6)
