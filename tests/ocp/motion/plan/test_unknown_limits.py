"""A velocity or an effort of 0 in a URDF says that the limit is unknown: plans are those of a robot without a limit."""

from __future__ import annotations

import pathlib
import re
import warnings
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from tempfile import TemporaryDirectory
from typing import Any, Literal

import casadi as ca
import numpy as np
import pytest

from models import FixedBase, Machine, Mimic, ModelWarning, Path, Robot, planar_chain, smooth
from models.spatial import quaternion_from_rotation
from ocp import (
    Collocation,
    Cost,
    Goal,
    Limits,
    ProblemError,
    TipTask,
    Waypoints,
    inverse_kinematics,
    joint_path,
    minimum_velocity_problem,
    plan,
    solve,
)
from ocp.app.check.verdict import check_trajectory
from ocp.app.files import read_trajectory
from ocp.motion.result.segmented_plan import SegmentedPlan
from ocp.motion.schedule import JointLimits, LineLimits, schedule
from tests.families import some
from tests.ocp.motion.goal_solves import solve_goals
from tests.ocp.motion.tasks.space_tasks import UR5_START, ur5

START = np.array([0.4, 0.9, -0.6])
END = np.array([0.2, 1.1, -0.5])
UnknownLimit = Literal["zero", "nothing"]


def urdf(message: UnknownLimit) -> str:
    """An arm of three links whose file gives positions alone, or 0 of velocity and effort besides."""
    robot = planar_chain([0.5, 0.4, 0.3], [2.0, 1.5, 1.0])
    joints = tuple(replace(joint, lower=-2.5, upper=2.5, velocity=7.0, effort=7.0) for joint in robot.joints)
    text = replace(robot, joints=joints).to_urdf()
    options = ' effort="0" velocity="0.0"' if message == "zero" else ""
    changed, count = re.subn(r' effort="7.0" velocity="7.0"', options, text)
    assert count == 3
    return changed


def arm(message: UnknownLimit) -> FixedBase:
    return FixedBase(Robot.from_urdf(urdf(message)))


def task(machine: Machine, duration: float = 1.0) -> TipTask:
    first = ca.DM(machine.tip_pose((), START).position)
    return TipTask(position=lambda time: first + time * ca.DM([-0.2, 0.15, 0.0]), rows=(3, 4), duration=duration)


def planned(machine: FixedBase, **options: Any) -> Any:
    return plan(machine, task(machine), **options).cost


def plan_segments(machine: FixedBase) -> Any:
    result = plan(machine, task(machine), search="segments")
    assert isinstance(result, SegmentedPlan)
    return [segment.cost for segment in result.segments]


def least_velocities(machine: FixedBase) -> Any:
    velocity = np.array([-0.2, 0.15])
    problem = minimum_velocity_problem(machine, tasks=TipTask(rows=(3, 4), velocity=velocity), start=START, horizon=1.0)
    return solve(problem, Collocation(5)).cost


def moved(machine: FixedBase, **options: Any) -> Any:
    solution = solve_goals(machine, Goal(joints=END), 1.0, start=START, **options)
    return solution.cost


def move_to_goal(machine: FixedBase, **options: Any) -> Any:
    return plan(machine, Goal(joints=END), start=START, **options).cost


def check_plan(machine: FixedBase) -> Any:
    with TemporaryDirectory() as folder:
        file = pathlib.Path(folder) / "plan.csv"
        plan(machine, task(machine), start=START, limits=Limits(velocity=np.inf)).write_csv(file)
        check = check_trajectory(machine, read_trajectory(file))
    assert not check.faults
    return [row.name for row in check.rows]


def schedule_plan(machine: FixedBase) -> Any:
    """A plan along a path becomes a joint path, whose timing obeys the velocity limits of the robot."""
    path = smooth(Path.through([(0.5, 0.5, 0.0), (0.4, 0.6, 0.0), (0.2, 0.6, 0.0)]), deviation=0.01)
    result = plan(machine, TipTask.along(path, 0.05, rows=(3, 4)), limits=Limits(velocity=np.inf))
    joints = JointLimits(velocity=machine.robot.velocity)
    limits = LineLimits(0.1, 2.0, 50.0, joints=joints)
    return schedule(path, limits, joints=joint_path(machine, result, path)).duration


REQUESTS: dict[str, tuple[Callable[[FixedBase], Any], set[str]]] = {
    "start": (partial(planned, search="start", start=START), {"velocity"}),
    "configurations": (planned, {"velocity"}),
    "global": (partial(planned, search="global"), {"velocity"}),
    "free horizon": (partial(planned, horizon="free", start=START), {"velocity"}),
    "own velocities": (partial(planned, start=START, limits=Limits(velocity=5.0)), set()),
    "no velocities": (partial(planned, start=START, limits=Limits(velocity=np.inf)), set()),
    "accelerations": (partial(planned, start=START, limits=Limits(acceleration=30.0)), {"velocity", "torque"}),
    "no torques": (partial(planned, start=START, limits=Limits(torque=np.inf)), {"velocity"}),
    "dynamics": (moved, {"velocity", "torque"}),
    "dynamics, own": (partial(moved, limits=Limits(velocity=5.0, torque=200.0)), set()),
    "goal": (move_to_goal, {"velocity"}),
    "goal in least time": (
        partial(move_to_goal, limits=Limits(acceleration=30.0), cost=Cost(velocity=0.0, time=1.0)),
        {"velocity", "torque"},
    ),
    "check": (check_plan, set()),
    "schedule": (schedule_plan, set()),
    "pieces": (plan_segments, {"velocity"}),
    "inverse kinematics": (lambda machine: str(inverse_kinematics(machine, task(machine))), set()),
    "least velocities": (least_velocities, {"velocity"}),
}
"""What is asked, and of which unknown limits there is a warning."""


@pytest.mark.parametrize("request_", some([pytest.param(call, id=name) for name, call in REQUESTS.items()], 6))
def test_zero_limits_plan_as_unlimited_and_are_reported(request_: tuple[Callable[[FixedBase], Any], set[str]]) -> None:
    ask, warned = request_
    expected = ask(arm("nothing"))
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("default")
        result = ask(arm("zero"))
    assert result == expected
    matches = [str(warning.message) for warning in caught if issubclass(warning.category, ModelWarning)]
    assert {re.findall(r"a (\w+) limit of 0", words)[0] for words in matches} == warned
    assert len(matches) == len(warned)
    assert all("joint1, joint2, joint3" in words for words in matches)


def test_waypoints_are_passed_whatever_is_unknown() -> None:
    """A way in the joints uses no torque, and no velocity unless its cost is time."""
    machine = ur5()
    joints = tuple(replace(joint, velocity=0.0, effort=0.0) for joint in machine.robot.joints)
    unknown = replace(machine, robot=replace(machine.robot, joints=joints))
    step = np.array([0.05, 0.05, -0.05, 0.0, 0.05, 0.05])
    poses = [machine.tip_pose((), UR5_START + k * step) for k in range(3)]
    places = np.array([ca.DM(pose.position).full().ravel() for pose in poses])
    turns = quaternion_from_rotation(np.array([ca.DM(pose.rotation).full() for pose in poses]))
    path = plan(unknown, Waypoints(places, turns), scene=False)
    assert path.cost == plan(machine, Waypoints(places, turns), scene=False).cost
    untimed = pytest.raises(ProblemError, match="give a joint a velocity limit")
    with untimed, pytest.warns(ModelWarning, match="velocity"):
        plan(unknown, Waypoints(places, turns), scene=False, cost=Cost(velocity=0.0, time=1.0))
    limits = Limits(velocity=machine.robot.velocity)
    timed = plan(unknown, Waypoints(places, turns), scene=False, limits=limits, cost=Cost(velocity=0.0, time=1.0))
    assert timed.cost == plan(machine, Waypoints(places, turns), scene=False, cost=Cost(velocity=0.0, time=1.0)).cost


def test_a_follower_of_unknown_speed_does_not_slow_its_leader() -> None:
    robot = planar_chain([0.5, 0.4], [2.0, 1.5])
    for own, follower, expected in ((4.0, 0.0, 4.0), (0.0, 6.0, 3.0), (0.0, 0.0, np.inf)):
        first = replace(robot.joints[0], velocity=own, effort=0.0)
        second = replace(robot.joints[1], velocity=follower, effort=5.0, mimic=Mimic("joint1", 2.0))
        tied = replace(robot, joints=(first, second))
        assert tied.velocity.tolist() == [expected]
        assert tied.effort.tolist() == [np.inf]


def test_zero_limits_of_a_file_are_kept_and_shown_as_unlimited() -> None:
    robot = Robot.from_urdf(urdf("zero"))
    assert [(joint.velocity, joint.effort) for joint in robot.moving_joints] == [(0.0, 0.0)] * 3
    assert Robot.from_urdf(robot.to_urdf()).joints[0].velocity == 0.0
    assert "rad/s" not in str(robot)
    assert "N m" not in str(robot)
    assert "-2.5 .. 2.5 rad" in str(robot)


def test_a_joint_with_one_position_keeps_it() -> None:
    """Unlike a velocity of 0, equal limits say what they say."""
    machine = arm("zero")
    first, *others = machine.robot.joints
    held = replace(machine, robot=replace(machine.robot, joints=(replace(first, lower=0.4, upper=0.4), *others)))
    result = plan(held, task(machine, 0.2), start=START, limits=Limits(velocity=np.inf))
    assert np.abs(result["joints"][:, 0] - 0.4).max() < 1e-8
