"""Arms on rails, and positioners that carry the workpiece: tasks in the frame of a part that moves."""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np
import pytest

from models import (
    FixedBase,
    Joint,
    Link,
    Robot,
    attach_tool,
    example_robot,
    link_frames,
    lock_joints,
    merge_robots,
    tip_pose,
)
from ocp import Cost, TipTask, Waypoints, inverse_kinematics, plan
from tests.models.robot.trees import Array

DURATION = 2.0
SLIDE: dict[str, Any] = {"lower": -0.5, "upper": 0.5, "velocity": 1.0}
WEIGHTS = np.array([4.0, *[1.0] * 6])


def on_rail() -> Robot:
    """A six-axis arm on a rail along y."""
    joint = Joint("rail_joint", "prismatic", "rail", "carriage", axis=(0.0, 1.0, 0.0), **SLIDE)
    return attach_tool(Robot((Link("rail"), Link("carriage")), (joint,)), example_robot("six_axis"), "carriage")


def with_table() -> Robot:
    """A six-axis arm beside a turntable, 0.5 m in front of it, whose joint comes first."""
    joint = Joint("turn", "revolute", "stand", "table", lower=-2.0, upper=2.0, velocity=1.0)
    table = Robot((Link("stand"), Link("table")), (joint,))
    arms = {"table_": table, "arm_": example_robot("six_axis")}
    robot = merge_robots(Link("floor"), arms, translations={"table_": (0.5, 0.0, 0.1)})
    tip = example_robot("six_axis").tip_link
    return Robot(robot.links, robot.joints, f"arm_{tip}", name="cell")


def line(first: Array, way: Array, **options: Any) -> TipTask:
    def position(t: Any) -> Any:
        return ca.DM(first) + t / DURATION * ca.DM(way)

    return TipTask(position=position, direction=(0.0, 0.0, -1.0), duration=DURATION, **options)


@pytest.mark.long
def test_a_task_on_a_locked_table_is_the_same_task_in_the_world() -> None:
    robot, first, path = with_table(), np.array([0.0, -0.1, 0.2]), np.array([0.1, 0.2, 0.0])
    angle, place = 0.4, np.array([0.5, 0.0, 0.1])
    turn = np.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1.0]])
    locked = FixedBase(lock_joints(robot, {"table_turn": angle}))
    on_table = plan(locked, line(first, path, relative_to="table_table"), scene=False)
    in_world = plan(locked, line(place + turn @ first, turn @ path), scene=False)
    assert on_table.cost == pytest.approx(in_world.cost, rel=1e-5)


@pytest.mark.long
def test_a_table_that_turns_costs_no_more_than_one_that_is_locked() -> None:
    """The table has the start of the locked one and more freedom; its global bound holds for both."""
    robot, task = with_table(), line(np.array([0.0, -0.1, 0.2]), np.array([0.1, 0.2, 0.0]), relative_to="table_table")
    locked = plan(FixedBase(lock_joints(robot, {"table_turn": 0.0})), task, scene=False)
    machine = FixedBase(robot)
    free = plan(machine, task, scene=False, search="global")
    assert free.audit().passed
    assert free.bound is not None
    assert free.bound <= free.cost <= locked.cost * (1 + 1e-4)
    assert np.ptp(free["joints"][:, 0]) > 1e-3
    shares = np.linspace(0, DURATION, 9)
    for joints, t in zip(free.at(shares)["joints"], shares, strict=True):
        (tip, table) = (np.array(ca.DM(frame.position)).ravel() for frame in frames(robot, joints))
        rotation = np.array(ca.DM(frames(robot, joints)[1].rotation))
        expected = np.array([0.0, -0.1, 0.2]) + t / DURATION * np.array([0.1, 0.2, 0.0])
        np.testing.assert_allclose(rotation.T @ (tip - table), expected, atol=1e-6)


def frames(robot: Robot, joints: Array) -> tuple[Any, Any]:
    return tip_pose(robot, joints), link_frames(robot, joints)["table_table"]


def test_inverse_kinematics_reach_the_same_place_on_a_turned_table() -> None:
    machine = FixedBase(with_table())
    task = TipTask(position=(0.0, 0.1, 0.2), direction=(0.0, 0.0, -1.0), relative_to="table_table")
    solutions = inverse_kinematics(machine, task, starts=16)
    assert np.ptp([solution.joints[0] for solution in solutions]) > 0.5
    for solution in solutions[:4]:
        tip, table = frames(machine.robot, solution.joints)
        place = np.array(ca.DM(table.rotation)).T @ np.array(ca.DM(tip.position - table.position)).ravel()
        np.testing.assert_allclose(place, (0.0, 0.1, 0.2), atol=1e-9)


@pytest.mark.long
def test_a_rail_costs_no_more_than_one_that_is_locked() -> None:
    robot, task = on_rail(), line(np.array([0.4, -0.4, 0.3]), np.array([0.0, 0.8, 0.0]))
    machine = FixedBase(robot)
    free = plan(machine, task, scene=False, search="global", cost=Cost(weights=WEIGHTS))
    locked = plan(FixedBase(lock_joints(robot, {"rail_joint": 0.0})), task, scene=False)
    assert free.audit().passed
    assert free.bound is not None
    assert free.bound <= free.cost < 0.9 * locked.cost
    assert free.held == {}


def test_waypoints_are_planned_on_a_rail() -> None:
    places = np.array([0.4, -0.4, 0.3]) + np.linspace(0, 1, 8)[:, None] * np.array([0.0, 0.8, 0.0])
    quaternion = np.tile([0.0, 1.0, 0.0, 0.0], (8, 1))
    result = plan(FixedBase(on_rail()), Waypoints(places, quaternion, step=0.3), scene=False)
    assert result.bound is not None
    assert result.bound <= result.cost
