"""Joints that move no task frame, a gripper's fingers or the other arm: planned as without them, and standing still."""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np
import pytest

from models import FixedBase, FreeFloating, Link, Robot, Sphere, attach_tool, merge_robots, planar_chain
from models.robot.kinematics import link_frames
from ocp import Scene, TipTask, Waypoints, plan
from ocp.motion.local.closed_forms import closed_forms
from ocp.motion.local.ik_solver import ik_branches
from ocp.motion.tasks.checks import ignorable_joints
from ocp.motion.tasks.equations import bind
from tests.models.robot.pinocchio_robots import ROBOTS, urdf_file
from tests.models.robot.trees import Array
from tests.ocp.motion.local.test_closed_forms import chain_of
from tests.ocp.motion.tasks.space_tasks import PANDA_START, UR5_START, panda, ur5

PANDA_URDF = urdf_file(*ROBOTS["panda"][:2])
DURATION = 2.0

GRIPPER = """<robot name="gripper"><link name="palm"/>
<link name="left">
<collision><origin xyz="0 0 0.04"/><geometry><box size="0.01 0.02 0.06"/></geometry></collision></link>
<link name="right">
<collision><origin xyz="0 0 0.04"/><geometry><box size="0.01 0.02 0.06"/></geometry></collision></link>
<joint name="spread" type="revolute"><parent link="palm"/><child link="left"/><axis xyz="1 0 0"/>
<origin xyz="0 0.03 0"/><limit lower="0.2" upper="0.8" velocity="1" effort="5"/></joint>
<joint name="follow" type="revolute"><parent link="palm"/><child link="right"/><axis xyz="-1 0 0"/>
<origin xyz="0 -0.03 0"/><limit lower="0" upper="1" velocity="1" effort="5"/><mimic joint="spread" multiplier="0.9"/>
</joint></robot>"""


def handed(arm: Robot, hand: str | Robot) -> FixedBase:
    """An arm with a gripper on its tip, which stays the tip."""
    gripper = Robot.from_urdf(hand, tip="palm") if isinstance(hand, str) else hand
    return FixedBase(attach_tool(arm, gripper, arm.tip_link, arm.tip_translation, keep_tip=True))


def straight(machine: FixedBase, joints: Array, way: tuple[float, float, float], **more: Any) -> TipTask:
    """The tip goes along a line from where it is, turned as it is."""
    pose = machine.tip_pose((), joints)
    first = np.array(ca.DM(pose.position)).ravel()
    turn = np.array(ca.DM(pose.rotation))
    options = more or {"orientation": turn}
    return TipTask(position=lambda t: ca.DM(first) + t / DURATION * ca.DM(way), duration=DURATION, **options)


def three_links(fingers: int) -> FixedBase:
    """A planar arm of three links with fingers that slide and turn at its tip."""
    arm = planar_chain([0.4, 0.3, 0.2], [1.0] * 3)
    joints = "".join(
        f'<link name="f{k}"/><joint name="j{k}" type="{"prismatic" if k % 2 else "continuous"}"><parent link="palm"/>'
        f'<child link="f{k}"/><axis xyz="0 0 1"/><limit lower="-0.03" upper="0.01" velocity="1" effort="5"/></joint>'
        for k in range(fingers)
    )
    return handed(arm, f'<robot name="hand"><link name="palm"/>{joints}</robot>') if fingers else FixedBase(arm)


def names_of(machine: Any, idle: Any) -> list[str]:
    return [name for name, one in zip(machine.robot.joint_names, idle, strict=True) if one]


def test_the_joints_that_move_a_frame_follow_from_the_tree() -> None:
    """By path, by a follower on the path, by the reference of a task, by any of several tasks; of every kind."""
    hand = handed(planar_chain([0.4, 0.3], [1.0] * 2), GRIPPER)
    place: dict[str, Any] = {"position": (0.5, 0.1, 0.0), "rows": [3, 4]}
    assert names_of(hand, bind(hand, TipTask(**place)).idle) == ["spread"]
    assert names_of(hand, bind(hand, TipTask(link="right", **place)).idle) == []  # which follows the other finger
    assert names_of(hand, bind(hand, TipTask(relative_to="right", **place)).idle) == []
    assert names_of(hand, bind(hand, [TipTask(**place), TipTask(link="left", begin=1, **place)]).idle) == []
    arm = planar_chain([0.4, 0.3], [1.0] * 2)
    two = merge_robots(Link("body", 3.0), {"l_": arm, "r_": arm})
    for machine, idle in ((FixedBase(two), ["r_joint1", "r_joint2"]), (FreeFloating(two), [])):
        assert names_of(machine, bind(machine, TipTask(link="l_link2", **place)).idle) == idle
    equations = bind(hand, TipTask(**place))
    assert ignorable_joints(equations, np.zeros(0))[equations.idle].all()


@pytest.mark.parametrize("arm", [panda, ur5])
def test_a_gripper_leaves_the_closed_forms_of_its_arm(arm: Any) -> None:
    bare = arm()
    hand = handed(bare.robot, GRIPPER)
    forms, others = closed_forms(chain_of(hand)), closed_forms(chain_of(bare))
    assert forms
    kinds, expected = ([(one.kind, one.triple, one.redundant) for one in each] for each in (forms, others))
    assert kinds == expected
    n = bare.joint_size
    task = straight(hand, np.append(PANDA_START if n == 7 else UR5_START, 0.3), (0.1, 0, 0))
    results = []
    for machine in (hand, bare):
        equations = bind(machine, task)
        branches = ik_branches(equations, machine.robot.lower, machine.robot.upper)
        assert branches is not None
        results.append(branches.configurations(np.array(equations.target_function()(0.0)).ravel(), 16).joints)
    np.testing.assert_allclose(results[0][:, :n], results[1], atol=1e-9)
    np.testing.assert_allclose(results[0][:, n], 0.5)  # the middle of its limits


@pytest.mark.long
def test_fingers_cost_nothing_in_a_global_plan_of_a_whole_hand() -> None:
    """The file as it comes, fingers that slide, one of them a follower: cost and bound of the arm alone."""
    whole = FixedBase(Robot.from_urdf(PANDA_URDF, tip="panda_hand"))
    assert whole.joint_size == 8
    task = straight(panda(), PANDA_START, (0.15, 0.1, -0.05))
    bare = plan(panda(), task, search="global", scene=False)
    result = plan(whole, task, search="global", scene=False)
    assert result.cost == pytest.approx(bare.cost, rel=1e-6)
    assert result.bound == pytest.approx(bare.bound, rel=0.01)
    assert result.audit().passed
    np.testing.assert_allclose(result["joints"][:, 7], 0.02, atol=1e-9)


@pytest.mark.long
def test_a_start_fixes_the_positions_of_fingers() -> None:
    machine = three_links(3)
    start = np.array([0.4, 0.8, -0.5, 2.0, -0.01, -1.0])
    task = straight(machine, start, (-0.1, 0.15, 0), rows=[3, 4])
    bare = three_links(0)
    for cyclic in (False, True):
        there = task
        if cyclic:
            place = np.array(ca.DM(machine.tip_pose((), start).position)).ravel()[:2]

            def path(t: Any, place: Array = place) -> Any:
                return ca.DM(place) + 0.1 * ca.vertcat(ca.sin(np.pi * t), ca.cos(np.pi * t) - 1)

            there = TipTask(position=path, rows=[3, 4], duration=DURATION)
        result = plan(machine, there, start=start, search="global", scene=False, cyclic=cyclic)
        alone = plan(bare, there, start=start[:3], search="global", scene=False, cyclic=cyclic)
        assert result.cost == pytest.approx(alone.cost, rel=1e-6)
        assert result.bound == pytest.approx(alone.bound, rel=0.01)
        np.testing.assert_allclose(result["joints"][:, 3:], np.tile(start[3:], (len(result.t), 1)), atol=1e-9)


def test_the_other_arm_stands_still_while_one_works() -> None:
    arm = planar_chain([0.4, 0.3, 0.2], [1.0] * 3)
    two = FixedBase(merge_robots(Link("body", 3.0), {"l_": arm, "r_": arm}, translations={"r_": (0.0, 2.0, 0.0)}))
    start = np.array([0.4, 0.8, -0.5])
    task = straight(FixedBase(arm), start, (-0.1, 0.15, 0), rows=[3, 4])
    alone = plan(FixedBase(arm), task, search="global", scene=False)
    result = plan(
        two,
        TipTask(position=task.position, rows=[3, 4], duration=DURATION, link="l_link3", point=arm.tip_translation),
        search="global",
        scene=False,
    )
    assert result.cost == pytest.approx(alone.cost, rel=1e-6)
    assert result.bound == pytest.approx(alone.bound, rel=0.01)
    assert np.ptp(result["joints"][:, 3:], axis=0).max() < 1e-9


def test_configurations_that_differ_by_fingers_count_once() -> None:
    task = straight(ur5(), UR5_START, (0.1, 0.1, 0))
    bare = plan(ur5(), task, scene=False)
    result = plan(handed(ur5().robot, GRIPPER), task, scene=False)
    assert len(result.candidates) == len(bare.candidates)
    assert result.cost == pytest.approx(bare.cost, rel=1e-6)


@pytest.mark.long
def test_fingers_collide_where_they_stand() -> None:
    """A ball beside the cheapest motion, which a finger touches: a detour with the finger as it is."""
    machine = handed(planar_chain([0.4, 0.3, 0.2], [1.0] * 3), GRIPPER)
    start = np.array([0.4, 0.8, -0.5, 0.5])
    task = straight(machine, start, (-0.1, 0.15, 0), rows=[3, 4])
    free = plan(machine, task, search="global", scene=False)
    finger = link_frames(machine.robot, free.at(DURATION / 2)["joints"])["left"]
    there = np.array(ca.DM(finger.position)).ravel() + np.array(ca.DM(finger.rotation))[:, 2] * 0.04
    ball = Sphere(0.02, there - np.array([0.0107, 0.0344, 0.0]))
    result = plan(machine, task, search="global", scene=Scene(obstacles=[ball]))
    assert result.audit().passed
    assert np.ptp(result["joints"][:, 3]) < 1e-12
    assert result.cost == pytest.approx(0.0417135, rel=1e-4)  # with the fingers locked at 0.5 rad
    assert result.cost > free.cost * 1.01
    assert result.bound is not None
    assert result.bound <= result.cost


def test_a_task_of_the_fingers_counts_as_one() -> None:
    """Two fingers whose tips are asked for take no part in what stands still, as before."""
    machine = three_links(1)
    hand = TipTask(link="f0", orientation=np.eye(3), rows=[2], duration=DURATION)
    start = np.array([0.4, 0.8, -0.5])
    tip = straight(three_links(0), start, (-0.1, 0.15, 0), rows=[3, 4])
    result = plan(machine, [tip, hand], search="global", scene=False)
    assert result.bound is not None
    assert np.ptp(result["joints"][:, 3]) > 0.01


@pytest.mark.long
def test_waypoints_are_planned_with_a_hand() -> None:
    places = np.array([0.45, 0.1, 0.35]) + np.linspace(0, 1, 12)[:, None] * np.array([0.0, 0.2, 0.05])
    quaternion = np.tile([0.0, 1.0, 0.0, 0.0], (12, 1))
    whole = FixedBase(Robot.from_urdf(PANDA_URDF, tip="panda_hand"))
    bare, result = (plan(each, Waypoints(places, quaternion, step=0.3), scene=False) for each in (panda(), whole))
    assert result.cost == pytest.approx(bare.cost, rel=1e-3)
    assert result.bound == pytest.approx(bare.bound, rel=1e-2)
    np.testing.assert_allclose(result["joints"][:, 7], 0.02, atol=1e-9)
