"""Tasks in pieces: as few as closed forms and brute force say, joined at the tasks' times, each audited."""

from __future__ import annotations

import pickle
from dataclasses import replace
from typing import Any

import casadi as ca
import numpy as np
import pytest

from models import CollisionShape, FixedBase, Path, Sphere, smooth
from models.checks import Array
from models.shapes.shapes import MovingObstacle
from ocp import DeadEnd, ProblemError, Scene, TipTask, plan
from ocp.motion.plan import sequence
from ocp.motion.plan.sequence import _task_between
from ocp.motion.result.segmented_plan import SegmentedPlan
from ocp.motion.search.task_search import TaskSearch
from tests.ocp.motion.search.test_charts import planar
from tests.ocp.motion.search.test_reconfigurations import limited

UPPER, LOWER = 0.5, 0.4
HIGH = np.array([0.9, 1.8])
SECONDS = 2.0


def arm() -> FixedBase:
    """Two links, the shoulder limited: on either side the elbow has to be on the other one."""
    return limited(planar(np.array([UPPER, LOWER]), speed=3.0), -HIGH, HIGH)


def line(reach: float) -> TipTask:
    """Across in front of the arm."""

    def position(t: Any) -> Any:
        return ca.vertcat(0.6, reach * (2 * t / SECONDS - 1))

    return TipTask(position=position, rows=[3, 4], duration=SECONDS)


def in_segments(machine: FixedBase, task: TipTask, **options: Any) -> SegmentedPlan:
    result = plan(machine, task, search="segments", **options)
    assert isinstance(result, SegmentedPlan)
    return result


def configuration(time: Array, reach: float, elbow: int) -> Array:
    """By the law of cosines. Shape (M, 2)."""
    x, y = 0.6, reach * (2 * time / SECONDS - 1)
    far = np.hypot(x, y)
    bend = elbow * np.arccos((far**2 - UPPER**2 - LOWER**2) / (2 * UPPER * LOWER))
    return np.column_stack(
        [np.arctan2(y, x) - np.arctan2(LOWER * np.sin(bend), UPPER + LOWER * np.cos(bend)), bend + 0 * y]
    )


def cost(first: float, last: float, reach: float, elbow: int) -> float:
    """Of the one motion that there is on a branch."""
    times = np.linspace(first, last, 4001)
    return float((np.diff(configuration(times, reach, elbow), axis=0) ** 2).sum() / 2 / (times[1] - times[0]))


@pytest.mark.long
def test_two_links_have_the_branches_as_segments_that_meet_at_least_cost(monkeypatch: pytest.MonkeyPatch) -> None:
    searches, reach, machine = list[TaskSearch](), 0.45, arm()

    class Recorded(TaskSearch):
        def __init__(self, request: Any, motions: Any) -> None:
            super().__init__(request, motions)
            searches.append(self)

    monkeypatch.setattr(sequence, "TaskSearch", Recorded)
    result = in_segments(machine, line(reach), scene=False)
    assert result.fewest == len(result.reconfigurations) == 1
    (where,) = result.reconfigurations
    assert result.start_times == (0.0, where.time)
    assert result.segments[0].horizon == where.time
    assert result.task_horizon == pytest.approx(SECONDS)
    spans = [(0.0, where.time, -1), (where.time, SECONDS, 1)]
    for segment, (begin, end, elbow) in zip(result.segments, spans, strict=True):
        assert segment.audit().passed
        expected = configuration(begin + segment.t, reach, elbow)
        assert (np.abs(expected) <= HIGH + 1e-6).all()
        np.testing.assert_allclose(segment["joints"], expected, atol=1e-6)
        assert segment.cost == pytest.approx(cost(begin, end, reach, elbow), rel=1e-5)
        assert segment.bound is not None
        assert segment.bound <= segment.cost
    # the elbow may change side at the samples of the search; at none of them that costs less
    inside = [t for t in searches[0].times if all(
        (np.abs(configuration(np.array([t]), reach, elbow)) <= HIGH).all() for elbow in (-1, 1)
    )]  # fmt: skip
    assert result.cost == pytest.approx(
        min(cost(0, t, reach, -1) + cost(t, SECONDS, reach, 1) for t in inside), rel=1e-4
    )
    np.testing.assert_allclose(where.before, configuration(np.array([where.time]), reach, -1)[0], atol=1e-6)
    np.testing.assert_allclose(where.after, configuration(np.array([where.time]), reach, 1)[0], atol=1e-6)
    assert where.motion is not None
    assert where.duration == pytest.approx(np.abs(where.after - where.before).max() / 3.0)
    assert result.horizon == pytest.approx(SECONDS + where.duration)
    np.testing.assert_allclose(where.motion.at([0.0, where.duration])["joints"], [where.before, where.after], atol=1e-9)
    assert "1 reconfiguration, the fewest possible" in str(result)
    assert f"at {where.time:.4g} s the arm reconfigures" in str(result)
    with pytest.raises(DeadEnd, match="search='segments'") as refused:
        plan(machine, line(reach), search="global", scene=False)
    assert refused.value.segments == pickle.loads(pickle.dumps(refused.value)).segments == 2


@pytest.mark.long
def test_a_feasible_task_has_one_segment_equal_to_the_plan() -> None:
    result = in_segments(arm(), line(0.1), scene=False)
    assert (len(result.segments), result.reconfigurations, result.fewest) == (1, (), 0)
    alone = plan(arm(), line(0.1), search="global", scene=False)
    assert result.cost == pytest.approx(alone.cost, rel=1e-9)
    assert result.horizon == result.task_horizon == SECONDS
    assert result.solution is result.segments[0].solution


def with_bodies() -> FixedBase:
    """The same arm, a capsule along each link."""
    machine = arm()
    along_x = np.array([[0.0, 0, 1], [0, 1, 0], [-1, 0, 0]])
    links = []
    for link in machine.robot.links:
        long = {"link0": UPPER, "link1": LOWER}.get(link.name)
        if long is not None:
            tube = CollisionShape("capsule", (0.02, long - 0.1), translation=(long / 2, 0, 0), rotation=along_x)
            link = replace(link, collisions=(tube,))
        links.append(link)
    return FixedBase(replace(machine.robot, links=tuple(links)))


@pytest.mark.long
@pytest.mark.parametrize("angle", [0.15, 0.2])
def test_a_reconfiguration_avoids_obstacles(angle: float) -> None:
    place = 0.85 * np.array([np.cos(angle), np.sin(angle)])
    machine, ball = with_bodies(), Sphere(0.03, (*place, 0.0))
    result = in_segments(machine, line(0.45), scene=Scene(obstacles=[ball], clearance=0.01))
    (where,) = result.reconfigurations
    assert all(segment.audit().passed for segment in result.segments)
    assert where.motion is not None, where.failure
    straight = np.abs(where.after - where.before).max() / 3.0
    assert where.duration >= straight * (1 - 1e-9)
    joints = where.motion.at(np.linspace(0, where.duration, 2001))["joints"]
    assert (np.abs(joints) <= HIGH + 1e-6).all()
    assert (np.abs(np.diff(joints, axis=0)) <= 3.0 * where.duration / 2000 * (1 + 1e-5)).all()
    # the ball from the axes of the capsules, by hand
    first = UPPER * np.column_stack([np.cos(joints[:, 0]), np.sin(joints[:, 0])])
    turn = joints.sum(axis=1)
    last = first + LOWER * np.column_stack([np.cos(turn), np.sin(turn)])
    for begin, end in ((0 * first, first), (first, last)):
        far, path = place - begin, end - begin
        short = 0.05 / np.linalg.norm(path[0])
        share = np.clip((far * path).sum(axis=1) / (path**2).sum(axis=1), short, 1 - short)
        assert np.linalg.norm(far - share[:, None] * path, axis=1).min() >= 0.03 + 0.02 + 0.01 - 1e-6


def test_a_part_of_a_task_asks_for_the_same_at_its_times() -> None:
    path = smooth(Path.through([[0.4, -0.3, 0.0], [0.6, 0.0, 0.0], [0.4, 0.3, 0.0]]), deviation=0.02)
    task = TipTask.along(path, 0.4, steady=True, rows=(3, 4), begin=0.5)
    end = task.end
    for first, last in ((0.0, 0.9), (0.9, 1.3), (1.3, end), (0.0, end)):
        part = _task_between(task, first, last)
        assert part is not None
        begin = max(first, 0.5)
        assert [part.begin, part.end] == pytest.approx([begin - first, last - first])
        assert part.position is not None
        assert task.position is not None
        t = ca.MX.sym("t")
        for request, report in ((task.position, part.position), (task.position.rate, part.position.rate)):
            one, other = (ca.Function("at", [t], [track(t)]).map(7) for track in (request, report))
            times = np.linspace(begin, last, 7)[None]
            np.testing.assert_allclose(one(times - 0.5), other(times - begin), atol=1e-12)
        inside = [t for t in task.begin + np.asarray(task.breaks) if begin < t < last]
        np.testing.assert_allclose(first + part.begin + np.asarray(part.breaks), inside)
    assert _task_between(task, 0.0, 0.5) is None
    assert _task_between(task, end, end + 1.0) is None


def test_a_horizon_of_which_the_task_is_no_part_is_refused() -> None:
    for search in ("segments", "global"):
        with pytest.raises(ProblemError, match="no task is active") as refused:
            plan(arm(), line(0.1), 1e12, start=configuration(np.zeros(1), 0.1, 1)[0], scene=False, search=search)
        assert refused.value.name == "horizon"


def test_obstacles_that_move_do_not_wait() -> None:
    ball = MovingObstacle(Sphere(0.03, (0.85, 0.0, 0.0)), lambda t: ca.vertcat(0.1 * t, 0, 0))
    with pytest.raises(ProblemError, match="wait") as refused:
        plan(with_bodies(), line(0.45), scene=Scene(obstacles=[ball]), search="segments")
    assert refused.value.name == "obstacles"
