"""Held joints: plans with joints that no task moves, against the same machine with these joints locked by hand."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
import pytest

from models import CollisionShape, FixedBase, Joint, Link, ModelWarning, Robot, Sphere, attach_tool, lock_joints
from ocp import Cost, Limits, ProblemError, Scene, TipTask, inverse_kinematics, plan
from ocp.motion.result.plan import Plan
from ocp.motion.search.held_joints import all_joints
from tests.families import some
from tests.models.robot.pinocchio_robots import ROBOTS, urdf_file
from tests.models.robot.trees import Array
from tests.ocp.motion.tasks.space_tasks import PANDA_START, panda

DURATION = 2.0
PLANE: dict[str, Any] = {"rows": (3, 4)}
FINGERS = (("left", 0.1), ("right", -0.1))
BALL = CollisionShape("sphere", (0.05,))


def person(lengths: tuple[float, ...] = (0.4, 0.3, 0.2), torso: int = 1, ball: bool = False) -> FixedBase:
    """A planar arm and a head on a torso of some joints; all joints turn about z, and the arm carries the tip."""
    far = (CollisionShape("sphere", (0.05,), translation=(-2.0, 0, 0)),)  # else head and tip count as adjacent
    links, joints = [Link("floor", collisions=far if ball else ())], list[Joint]()

    def add(name: str, parent: str, x: float, y: float = 0.0, **options: Any) -> str:
        links.append(Link(f"{name}_link", 1.0, (0.1, 0, 0), np.diag([0.01, 0.02, 0.02]), **options))
        limits: dict[str, Any] = {"lower": -2.5, "upper": 2.5, "velocity": 3.0, "effort": 500.0}
        axis = (0.0, 0.0, 1.0)
        joints.append(Joint(name, "revolute", parent, f"{name}_link", translation=(x, y, 0), axis=axis, **limits))
        return f"{name}_link"

    end = "floor"
    for k in range(torso):
        end = add(f"torso{k + 1}", end, 0.1)
    add("head", end, 0.0, 0.3, collisions=(CollisionShape("sphere", (0.05,), translation=(0.3, 0, 0)),) if ball else ())
    for k, length in enumerate((0.1, *lengths[:-1])):
        end = add(f"arm{k + 1}", end, length)
    links.append(Link("tip", collisions=(BALL,) if ball else ()))
    joints.append(Joint("tip_fixed", "fixed", end, "tip", translation=(lengths[-1], 0, 0)))
    return FixedBase(Robot(tuple(links), tuple(joints), "tip", name="person"))


def straight(machine: FixedBase, joints: Array, way: tuple[float, float], **options: Any) -> TipTask:
    first = np.array(ca.DM(machine.tip_pose((), joints).position)).ravel()[:2]
    return TipTask(position=lambda t: ca.DM(first) + t / DURATION * ca.DM(way), duration=DURATION, **PLANE, **options)


def whole_panda() -> FixedBase:
    return FixedBase(Robot.from_urdf(urdf_file(*ROBOTS["panda"][:2]), tip="panda_hand"))


def panda_seam() -> TipTask:
    pose = panda().tip_pose((), PANDA_START)
    first, axis = np.array(ca.DM(pose.position)).ravel(), np.array(ca.DM(pose.rotation))[:, 2]
    return TipTask(position=lambda t: ca.DM(first) + t * ca.DM([0, 0.06, 0]), direction=axis, duration=DURATION)


@pytest.mark.long
@pytest.mark.parametrize("search", some(["configurations", "global"], ["configurations"]))
def test_a_gripper_that_is_locked_by_hand_gives_the_same_plan(search: Any) -> None:
    whole = whole_panda()
    locked = FixedBase(lock_joints(whole.robot, {"panda_finger_joint1": 0.02}))
    left, by_hand = (plan(machine, panda_seam(), search=search, scene=False) for machine in (whole, locked))
    assert left.held == {"panda_finger_joint1": 0.02}
    assert by_hand.held == {}
    assert (left.cost, left.bound) == (by_hand.cost, by_hand.bound)
    np.testing.assert_array_equal(left["joints"][:, :7], by_hand["joints"])
    assert "joints" in left.solution.states
    assert left.solution["joints"].shape[1] == 7  # the finger is no variable
    assert [len(candidate.start) for candidate in left.candidates] == [8] * len(left.candidates)
    assert "held: panda_finger_joint1 at 0.02" in str(left)


def test_a_plan_with_held_joints_is_saved_and_audited_again(tmp_path: Path) -> None:
    machine = person(ball=True)
    start = np.array([0.2, 0.7, 0.3, 1.1, 0.8])
    ball = Sphere(0.05, (-0.6, -0.6, 0.0))
    result = plan(machine, straight(machine, start, (-0.1, 0.15)), start=start, scene=Scene(obstacles=[ball]))
    result.save(tmp_path / "plan.npz")
    again = Plan.load(tmp_path / "plan.npz")
    assert again.held == result.held == {"head": 0.7}
    np.testing.assert_array_equal(again["joints"], result["joints"])
    assert again.audit().passed
    sample = again.sample(0.1)
    np.testing.assert_array_equal(sample.joints[:, 1], 0.7)
    assert not sample.rates[:, 1].any()
    assert not sample.accelerations[:, 1].any()


@pytest.mark.long
def test_limits_of_each_joint_keep_their_joint_when_others_are_held() -> None:
    machine = person()
    start = np.array([0.2, 0.7, 0.3, 1.1, 0.8])
    task = straight(machine, start, (-0.1, 0.15))
    limits = Limits(velocity=[0.02, 5, 2, 2, 2], acceleration=[1, 5, 2, 3, 4])
    weights = np.array([1.0, 100.0, 2.0, 3.0, 4.0])
    result = plan(machine, task, start=start, limits=limits, cost=Cost(weights=weights))
    locked = FixedBase(lock_joints(machine.robot, {"head": 0.7}))
    own = Limits(velocity=[0.02, 2, 2, 2], acceleration=[1, 2, 3, 4])
    expected = plan(locked, task, start=np.delete(start, 1), limits=own, cost=Cost(weights=np.delete(weights, 1)))
    assert result.cost == expected.cost
    assert np.abs(result["rates"][:, 0]).max() <= 0.02 * (1 + 1e-6)


@pytest.mark.long
def test_a_global_search_holds_the_torso_and_says_so() -> None:
    """Two torso joints and three of the arm for a position: three free, the one at the root is held."""
    machine = person(torso=2)
    start = np.array([0.2, 0.1, 0.7, 0.3, 1.1, 0.8])
    task = straight(machine, start, (-0.1, 0.15))
    result = plan(machine, task, start=start, search="global")
    assert result.held == {"head": 0.7, "torso1": 0.2}
    locked = plan(
        FixedBase(lock_joints(machine.robot, {"head": 0.7, "torso1": 0.2})),
        task,
        start=start[[1, 3, 4, 5]],
        search="global",
    )
    assert (result.cost, result.bound) == (locked.cost, locked.bound)
    free = plan(machine, task, start=start)
    assert free.held == {"head": 0.7}
    assert free.cost <= result.cost * (1 + 1e-6)
    searched = plan(machine, task, search="global")
    assert {*searched.held} == {"head", "torso1"}
    assert searched.bound is not None
    assert searched.bound <= searched.cost


def test_the_error_about_freedom_names_the_joints() -> None:
    machine = person((0.3, 0.2, 0.2, 0.1, 0.1), torso=0)
    task = straight(machine, np.array([0.7, 0.4, 0.8, -0.5, 0.2, 0.1]), (-0.1, 0.1))
    with pytest.raises(ProblemError, match="leave 3 degrees of freedom") as caught:
        plan(machine, task, search="segments")
    words = str(caught.value)
    assert "arm1, arm2, arm3, arm4, arm5 (head are held)" in words
    assert "lock_joints(robot, {NAME: POSITION})" in words


def test_a_blocking_head_is_placed_at_the_nearest_free_position() -> None:
    """In the middle of its range the head touches the tip at the start; turned away it does not."""
    machine = person(torso=0, ball=True)
    line = TipTask(position=lambda t: ca.DM([0.3, 0.25]) - 0.05 * t * ca.DM([0, 1]), duration=DURATION, **PLANE)
    result = plan(machine, line)
    assert result.audit().passed
    assert 0 < abs(result.held["head"]) < 1.5


def test_a_head_that_blocks_the_path_is_moved_aside() -> None:
    """The middle of its range is free at the start, but the way leads through it."""
    machine = person(torso=0, ball=True)
    line = TipTask(position=lambda t: ca.DM([0.34, 0.05]) + 0.25 * t * ca.DM([0, 1]), duration=DURATION, **PLANE)
    result = plan(machine, line)
    assert result.audit().passed
    assert abs(result.held["head"]) > 0.1


def test_a_blocking_head_leaves_its_initial_position() -> None:
    machine = person(torso=0, ball=True)
    line = TipTask(position=lambda t: ca.DM([0.36, 0.0]) + 0.15 * t * ca.DM([0, 1]), duration=DURATION, **PLANE)
    start = inverse_kinematics(machine, line, near=np.array([0.0, 0.2, 1.2, 0.9]), starts=0)[0].joints
    result = plan(machine, line, start=np.append(0.0, start[1:]))
    assert result.audit().passed
    assert result.held == {}
    assert np.ptp(result["joints"][:, 0]) > 0.1


def test_an_obstacle_at_a_held_body_is_an_error_and_a_closed_gripper_a_warning() -> None:
    machine = person(torso=0, ball=True)
    start = np.array([0.0, -0.4, 0.8, -0.5])
    task = straight(machine, start, (-0.1, -0.1))
    with pytest.raises(ProblemError, match="'head' stays at 0") as caught:
        plan(machine, task, start=start, scene=Scene(obstacles=[Sphere(0.05, (0.3, 0.3, 0.0))]))
    assert caught.value.name == "head_link and obstacle 0"
    fingers = [
        Link(name, collisions=(CollisionShape("sphere", (0.05,), translation=(x, 0, 0)),)) for name, x in FINGERS
    ]
    palm = Link("palm", collisions=(CollisionShape("sphere", (0.01,), translation=(0, 0, 0.5)),))
    joints = [
        Joint(f"{name}_grip", "revolute", "palm", name, translation=(x, 0, 0), lower=-1.0, upper=1.0)
        for name, x in (("left", 0.0), ("right", 0.2))
    ]
    hand = Robot((palm, *fingers), tuple(joints), "palm")
    closed = FixedBase(attach_tool(machine.robot, hand, "head_link", (0.2, 0.5, 0), keep_tip=True))
    closed_start = np.zeros(6)
    closed_start[[closed.robot.joint_names.index(f"arm{k}") for k in (1, 2, 3)]] = start[1:]
    with pytest.warns(ModelWarning, match="'left_grip' stays at 0, 'right_grip' stays at 0"):
        result = plan(closed, straight(closed, closed_start, (-0.1, -0.1)), start=closed_start)
    assert result.audit().passed


def test_values_of_all_joints_are_put_together_in_order() -> None:
    robot = person().robot
    values = np.arange(8.0).reshape(2, 4)
    whole = all_joints(robot, {"head": 0.5}, values)
    assert whole.shape == (2, 5)
    np.testing.assert_array_equal(whole[:, 1], 0.5)
    np.testing.assert_array_equal(np.delete(whole, 1, axis=1), values)
    np.testing.assert_array_equal(all_joints(robot, {"head": 0.5}, values, rates=True)[:, 1], 0.0)
    assert all_joints(robot, {}, values) is values
