"""Whole turns of joints with wide limits: all that fit are considered, and a motion is the same from each of them."""

from __future__ import annotations

from itertools import product
from typing import Any

import casadi as ca
import numpy as np
import pytest

from models import Joint, Link, Mimic, Robot
from ocp import TipTask, plan
from ocp.motion.search.joint_space import all_turns, turning_joints, whole_turns_between, whole_turns_into
from tests.ocp.motion.tasks.space_tasks import ur5

TURN = 2 * np.pi
DURATION = 4.0


def spin(total: float) -> TipTask:
    """A task in which the tool of the UR5 turns about its own axis, which joint 6 alone can do at least cost."""
    pose = ur5().tip_pose((), np.array([0.3, -1.2, 1.5, -1.9, -1.55, 2.0]))

    def orientation(t: Any) -> Any:
        cosine, sine = ca.cos(total * t / DURATION), ca.sin(total * t / DURATION)
        turn = ca.vertcat(ca.horzcat(cosine, -sine, 0), ca.horzcat(sine, cosine, 0), ca.horzcat(0, 0, 1))
        return ca.mtimes(pose.rotation, turn)

    return TipTask(position=np.array(pose.position).ravel(), orientation=orientation)


@pytest.mark.parametrize("total", [2.9 * np.pi, -2.9 * np.pi])
def test_a_joint_begins_in_the_turn_from_which_it_reaches_the_end(total: float) -> None:
    """Between limits of -2 pi and 2 pi a joint can turn by 2.9 pi, but not from the middle."""
    machine = ur5()
    result = plan(machine, spin(total), DURATION, scene=False)
    assert result.audit().passed
    assert result.cost == pytest.approx(total**2 / DURATION / 2, rel=1e-8)
    joints = result["joints"]
    assert (joints >= machine.robot.lower - 1e-9).all()
    assert (joints <= machine.robot.upper + 1e-9).all()
    assert joints[-1, 5] - joints[0, 5] == pytest.approx(total, abs=1e-6)
    assert all(np.isfinite(candidate.start).all() for candidate in result.candidates)


@pytest.mark.parametrize("seed", range(20))
def test_a_motion_fits_if_any_turn_of_it_does_and_is_then_farthest_from_the_limits(seed: int) -> None:
    rng = np.random.default_rng(seed)
    lower = rng.uniform(-9, 0, 3)
    upper = lower + TURN + rng.uniform(0, 9, 3)
    motions = np.cumsum(rng.normal(scale=0.7, size=(10, 20, 3)), axis=1) + rng.uniform(-20, 20, 3)
    turns, fits = whole_turns_into(motions, lower, upper)
    assert turns / TURN == pytest.approx(np.round(turns / TURN), abs=1e-12)
    for k, j in product(range(10), range(3)):
        rooms = []
        for turn in TURN * np.arange(-20, 21):
            moved = motions[k, :, j] + turn
            rooms.append(min(moved.min() - lower[j], upper[j] - moved.max()))
        assert fits[k, j] == (max(rooms) >= 0)
        moved = motions[k, :, j] + turns[k, j]
        assert min(moved.min() - lower[j], upper[j] - moved.max()) == pytest.approx(max(rooms), abs=1e-9)


def test_with_one_limit_there_is_always_room_on_the_other_side() -> None:
    motions = np.linspace(0.0, 30.0, 50)[None, :, None] * np.ones(2)
    turns, fits = whole_turns_into(motions, np.array([5.0, -np.inf]), np.array([np.inf, -5.0]))
    assert fits.all()
    assert turns[0, 0] >= 5.0
    assert turns[0, 1] <= -35.0


def test_a_motion_that_diverges_fits_nowhere() -> None:
    motions = np.array([[[0.0], [np.nan]], [[0.0], [np.inf]]])
    assert not whole_turns_into(motions, np.array([-7.0]), np.array([7.0]))[1].any()


def test_all_turns_are_the_product_of_those_of_each_joint() -> None:
    lower, upper = np.array([-TURN, -3.2, -TURN, -TURN]), np.array([TURN, 3.2, TURN, TURN])
    angles, known = np.array([0.5, 3.15, -1.0, 0.0]), np.array([np.nan, np.nan, 5.0, np.nan])
    listed = all_turns(angles, known, lower, upper)
    expected = product([0.5 - TURN, 0.5], [3.15 - TURN, 3.15], [5.0], [-TURN, 0.0, TURN])
    assert listed[np.lexsort(listed.T[::-1])] == pytest.approx(np.array(sorted(expected)))
    for low, high, both in ((0.0, np.inf, [1.0, 1.0 + TURN]), (-np.inf, 0.0, [1.0 - 2 * TURN, 1.0 - TURN])):
        listed = all_turns(np.array([1.0]), np.array([np.nan]), np.array([low]), np.array([high]))
        assert listed.ravel() == pytest.approx(both)


def test_turns_between_angles_keep_limits() -> None:
    start, end = np.array([1.0, 1.0, -6.0]), np.array([14.0, 14.0, 6.2])
    assert whole_turns_between(start, end) == pytest.approx([2 * TURN, 2 * TURN, 2 * TURN])
    assert whole_turns_between(start, end, -TURN, TURN) == pytest.approx([0.0, 0.0, TURN])


def test_joints_turn_that_are_revolute_limited_wide_and_lead_no_other() -> None:
    bounds = {"wide": (-TURN, TURN), "narrow": (-3.0, 3.0), "leader": (-TURN, TURN), "whole": (-np.pi, np.pi)}
    names = [*bounds, "slide", "free", "follower"]
    joints = []
    for k, name in enumerate(names):
        lower, upper = bounds.get(name, (-9.0, 9.0))
        kind: Any = {"slide": "prismatic", "free": "continuous"}.get(name, "revolute")
        limits = {} if kind == "continuous" else {"lower": lower, "upper": upper}
        mimic = Mimic("leader", 0.5) if name == "follower" else None
        joints.append(Joint(name, kind, f"l{k}", f"l{k + 1}", axis=(0, 0, 1), mimic=mimic, **limits))
    robot = Robot(tuple(Link(f"l{k}") for k in range(len(names) + 1)), tuple(joints), tip=f"l{len(names)}")
    chosen = turning_joints(robot, robot.lower, robot.upper)
    assert [robot.joint_names[k] for k in chosen] == ["wide", "whole"]
