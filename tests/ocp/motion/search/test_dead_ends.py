"""Where there is no motion: the place, what stops all motions there, and what would do if the task gave way."""

from __future__ import annotations

import pickle
from typing import Any

import casadi as ca
import numpy as np
import pytest

from models import Box, FixedBase
from models.checks import Array
from ocp import DeadEnd, Limits, Scene, TipTask, Waypoints, plan
from tests.families import some
from tests.ocp.motion.plan.test_waypoints import poses
from tests.ocp.motion.search.test_charts import planar
from tests.ocp.motion.tasks.space_tasks import PANDA_START, panda

LENGTHS = np.array([0.5, 0.4, 0.3])


def tip(machine: FixedBase, joints: Array) -> Array:
    return np.array(ca.DM(machine.tip_pose((), joints).position)).ravel()[:2]


def straight(first: Array, way: Array, seconds: float) -> Any:
    return lambda t: ca.DM(first) + t / seconds * ca.DM(way)


def wanted(task: TipTask, time: float) -> Array:
    assert task.position is not None
    return np.array(ca.DM(task.position(time))).ravel()


def between(seed: int) -> tuple[FixedBase, TipTask]:
    """An arm of random limits and a straight way between two of its postures."""
    rng = np.random.default_rng(seed)
    machine = planar(LENGTHS, limit=rng.uniform(0.8, 1.6), speed=rng.uniform(0.4, 1.5))
    most = machine.robot.upper[0]
    first, last = (tip(machine, rng.uniform(-most, most, 3)) for _ in range(2))
    return machine, TipTask(position=straight(first, last - first, 2.0), rows=[3, 4], duration=2.0)


@pytest.mark.parametrize("seed", some([16, 23, 25, 37, 38], [16, 25]))
def test_the_obstruction_is_reported_and_the_relaxed_task_is_met(seed: int) -> None:
    machine, task = between(seed)
    with pytest.raises(DeadEnd) as refused:
        plan(machine, task, search="global", scene=False)
    end = refused.value
    assert end.time is not None
    assert 0 <= end.time < end.until <= 2.0
    assert end.proven == ("no motion does the tasks" in str(end))
    first = end.obstructions[0]
    assert (end.name, end.value, end.limit) == (first.name, first.value, first.limit)
    assert first.kind in ("step", "limit")
    assert [stop.excess for stop in end.obstructions] == sorted(stop.excess for stop in end.obstructions)
    seconds, velocity = end.until - end.time, machine.robot.velocity
    for stop in end.obstructions:
        assert tip(machine, stop.before) == pytest.approx(wanted(task, end.time), abs=1e-8)
        joint = machine.robot.joint_names.index(stop.name)
        if stop.kind == "step":
            assert abs(stop.after - stop.before)[joint] == pytest.approx(stop.value)
            assert stop.limit == pytest.approx(velocity[joint] * seconds)
            assert stop.value > stop.limit
    (gives,) = end.relaxations
    assert gives.kind == "deviation"
    assert (np.abs(gives.joints) <= machine.robot.upper + 1e-9).all()
    assert (np.abs(np.diff(gives.joints, axis=0)) <= velocity * np.diff(gives.times)[:, None] + 1e-7).all()
    off = [np.linalg.norm(tip(machine, q) - wanted(task, t)) for t, q in zip(gives.times, gives.joints, strict=True)]
    assert max(off) == pytest.approx(gives.amount, rel=1e-6)
    assert f"{gives.amount:.3g} m off" in str(end)
    again = pickle.loads(pickle.dumps(end))
    fields = ("time", "until", "name", "proven", "segments")
    assert (str(again), *(getattr(again, each) for each in fields)) == (
        str(end),
        *(getattr(end, each) for each in fields),
    )
    # no joint is faster than twice what the stop says it would have to be: so much faster there is a motion
    if all(stop.kind == "step" for stop in end.obstructions):
        fast = 2 * max(stop.value / stop.limit for stop in end.obstructions)
        assert plan(machine, task, search="global", scene=False, limits=Limits(velocity=fast * velocity)).bound


@pytest.mark.parametrize("seed", [24, 36, 37])
def test_a_tool_that_turns_too_fast_may_lean_instead(seed: int) -> None:
    rng = np.random.default_rng(seed)
    machine = planar(LENGTHS, limit=rng.uniform(1.0, 1.6), speed=2.0)
    most = machine.robot.upper[0]
    first, last = rng.uniform(-most, most, (2, 3))

    def angle(t: Any) -> Any:
        return first.sum() + t / 2.0 * (last - first).sum()

    def turn(t: Any) -> Any:
        c, s = ca.cos(angle(t)), ca.sin(angle(t))
        return ca.vertcat(ca.horzcat(c, -s, 0), ca.horzcat(s, c, 0), ca.horzcat(0, 0, 1))

    begin = tip(machine, first)
    place = straight(begin, tip(machine, last) - begin, 2.0)
    task = TipTask(position=place, orientation=turn, rows=[2, 3, 4], duration=2.0)
    with pytest.raises(DeadEnd) as refused:
        plan(machine, task, search="global", scene=False)
    deviation, lean = refused.value.relaxations
    assert (deviation.kind, lean.kind) == ("deviation", "rotation")
    assert f"turned by {np.degrees(lean.amount):.3g} deg" in str(refused.value)
    for give in (deviation, lean):
        off = [tip(machine, q) - wanted(task, t) for t, q in zip(give.times, give.joints, strict=True)]
        turned = np.abs(give.joints.sum(axis=1) - angle(give.times))
        assert np.linalg.norm(off, axis=1).max() == pytest.approx(give.amount if give is deviation else 0.0, abs=1e-6)
        assert turned.max() == pytest.approx(give.amount if give is lean else 0.0, abs=1e-6)
        assert (np.abs(np.diff(give.joints, axis=0)) <= 2.0 * np.diff(give.times)[:, None] + 1e-7).all()


@pytest.mark.long
def test_failing_waypoints_are_reported_with_their_bodies() -> None:
    places, turns = poses(panda(), PANDA_START, 21)
    with pytest.raises(DeadEnd) as refused:
        plan(
            panda(),
            Waypoints(places, turns),
            scene=Scene(obstacles=[Box((0.02, 0.5, 0.5), (places[-1] + [0.03, 0.0, 0.2]))]),
        )
    end = refused.value
    assert end.until == int(end.until)
    assert end.time in (end.until - 1, 0.0)
    assert any(stop.kind == "collision" and "obstacle 0" in stop.name for stop in end.obstructions)
    assert f"waypoint {end.until:g}" in str(end)
    (clearance,) = (give for give in end.relaxations if give.kind == "clearance")
    assert clearance.amount < 0
    assert clearance.joints.shape[1] == 7
