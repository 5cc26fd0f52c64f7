"""Lower bounds of the cost of joint paths and motions from the motion of the tool alone."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from typing import Any

import casadi as ca
import numpy as np
import pytest

from models import FixedBase, Joint, Link, Robot
from models.checks import Array
from models.robot.parts import Kind
from models.robot.rebuild import lock_joints, mount_on_rail
from ocp import Cost, Limits, ProblemError, TipTask, Waypoints, plan
from ocp.motion.plan.planner import PlanOptions, checked_request
from ocp.motion.result.path_plan import PathPlan
from ocp.motion.result.solved_plan import SolvedPlan
from ocp.motion.search.lengths import Homogeneous, LargestMotion, PathLength
from ocp.motion.search.shortening import PathPoses
from ocp.motion.search.task_search import _ToolLevers, tool_motion_bound, tool_rate_bound
from tests.models.robot.trees import random_robot
from tests.ocp.motion.plan.test_waypoints import poses
from tests.ocp.motion.tasks.space_tasks import PANDA_START, panda_arm

COSTS = (PathLength, LargestMotion)


def at_tip(machine: FixedBase, path: Array) -> PathPoses:
    """The poses of the tip along a joint path."""
    tips = [machine.tip_pose((), q) for q in path]
    positions = np.array([np.array(ca.DM(tip.position)).ravel() for tip in tips])
    return PathPoses(positions, np.array([np.array(ca.DM(tip.rotation)) for tip in tips]), np.ones(path.shape[1]))


def bound(machine: FixedBase, poses: PathPoses, cost: Homogeneous) -> float:
    return tool_motion_bound(machine, poses, cost, Limits().bounds(machine))


def random_arm(seed: int, size: int = 7) -> FixedBase:
    """A tree of joints that turn, slide and follow others."""
    robot = random_robot(np.random.default_rng(seed), size, followers=True)
    joints = [replace(each, lower=-6.0, upper=6.0) if each.kind == "prismatic" else each for each in robot.joints]
    return FixedBase(replace(robot, joints=tuple(joints)))


def joint_path(machine: FixedBase, rng: np.random.Generator, count: int = 9) -> Array:
    """A random walk within the limits."""
    n = machine.joint_size
    low, high = np.maximum(machine.robot.lower, -2.0), np.minimum(machine.robot.upper, 2.0)
    start = low + rng.uniform(0.3, 0.7, n) * (high - low)
    return np.asarray(np.clip(start + np.cumsum(rng.normal(scale=0.1, size=(count, n)), axis=0), low, high))


@pytest.mark.parametrize("seed", range(20))
@pytest.mark.parametrize("kind", COSTS)
def test_no_joint_path_costs_less(seed: int, kind: type[Homogeneous]) -> None:
    """Nor does a bound through fewer of the poses exceed that through all; joints that cost nothing may be there."""
    machine, rng = random_arm(seed), np.random.default_rng(seed)
    weights = rng.uniform(0.2, 2.0, machine.joint_size) * (rng.random(machine.joint_size) < 0.8)
    path, cost = joint_path(machine, rng), kind(np.maximum(weights, 1e-3 * (seed % 2)))
    positions, rotations, step = at_tip(machine, path)
    least = bound(machine, PathPoses(positions, rotations, step), cost)
    assert 0.0 <= least <= cost.evaluate(np.diff(path, axis=0), 1.0).sum() * (1 + 1e-9)
    assert bound(machine, PathPoses(positions[::2], rotations[::2], step), cost) <= least * (1 + 1e-9)
    assert bound(machine, PathPoses(positions[::-1], rotations[::-1], step), cost) == pytest.approx(least, rel=1e-9)
    assert bound(machine, PathPoses(positions, rotations, step), kind(3 * cost.weights)) == pytest.approx(3 * least)


@pytest.mark.parametrize("kind", COSTS)
def test_a_locked_joint_never_lowers_the_bound(kind: type[Homogeneous]) -> None:
    robot = mount_on_rail(panda_arm(), (0, 1, 0), -1.0, 1.0)
    whole, rng = FixedBase(robot), np.random.default_rng(3)
    for name in robot.joint_names[:5]:
        held = FixedBase(lock_joints(robot, {name: 0.4}))
        tips = at_tip(held, joint_path(held, rng))
        assert bound(held, tips, kind(np.ones(7))) >= bound(whole, tips, kind(np.ones(8))) * (1 - 1e-9) > 0


@pytest.mark.parametrize("kind", ["prismatic", "revolute"])
def test_of_a_single_joint_the_bound_is_exact(kind: Kind) -> None:
    joint = Joint("joint", kind, "base", "tool", (0.1, 0.0, 0.3), axis=(0.0, 0.6, 0.8), lower=-3.0, upper=3.0)
    machine = FixedBase(Robot((Link("base"), Link("tool")), (joint,), "tool", (0.3, -0.2, 0.1)))
    path = joint_path(machine, np.random.default_rng(5))
    for each in COSTS:
        cost = each(np.array([1.7]))
        length = cost.evaluate(np.diff(path, axis=0), 1.0).sum()
        assert bound(machine, at_tip(machine, path), cost) == pytest.approx(length, rel=1e-6)


def random_chain(seed: int) -> FixedBase:
    """Seven joints in series, most of which turn."""
    rng, names = np.random.default_rng(seed), ["base", *"abcdef", "tool"]
    joints = []
    for k, (below, above) in enumerate(pairwise(names)):
        kind: Kind = "prismatic" if rng.random() < 0.2 else "revolute"
        axis, place = rng.normal(size=3), rng.uniform(-0.3, 0.3, 3)
        joints.append(Joint(f"joint{k}", kind, below, above, (*place,), axis=(*axis,), lower=-1.5, upper=2.0))
    return FixedBase(Robot(tuple(Link(name) for name in names), tuple(joints), "tool", (0.1, -0.05, 0.2)))


TASK_KINDS = ("pose", "position", "direction", "coordinate", "rotation")


@pytest.mark.parametrize("seed", range(8))
@pytest.mark.parametrize("kind", TASK_KINDS)
def test_no_motion_that_does_the_tasks_costs_less(seed: int, kind: str) -> None:
    """The tasks are what the tip does in a known motion, whose cost is an integral in closed form."""
    machine, rng = random_chain(seed), np.random.default_rng([seed, TASK_KINDS.index(kind)])
    low, high = machine.robot.lower, machine.robot.upper
    n, horizon, middle = machine.joint_size, 2.0, (low + high) / 2
    swing, weights = rng.uniform(-0.15, 0.15, n) * (high - low), rng.uniform(0.3, 2.0, n)

    def tip(t: ca.SX) -> Any:
        return machine.tip_pose((), middle + swing * ca.sin(2 * np.pi / horizon * t))

    tracks: dict[str, dict[str, Any]] = {
        "pose": {"position": lambda t: tip(t).position, "orientation": lambda t: tip(t).rotation},
        "position": {"position": lambda t: tip(t).position},
        "direction": {"position": lambda t: tip(t).position, "direction": lambda t: tip(t).rotation[:, 2]},
        "coordinate": {"position": lambda t: tip(t).position, "rows": [4]},
        "rotation": {"orientation": lambda t: tip(t).rotation},
    }
    task = TipTask(**tracks[kind], duration=horizon)
    options = PlanOptions(search="global", cost=Cost(velocity=1.0, weights=weights))
    least = tool_rate_bound(checked_request(machine, task, None, options))
    cost = float(weights @ swing**2) / 2 * (2 * np.pi / horizon) ** 2 * horizon / 2
    assert 0.0 <= least <= cost * (1 + 1e-9)


def test_the_distances_of_a_task_are_those_of_its_path_and_of_its_turn() -> None:
    """The tool moves along y and turns about z: an axis of the tool at the angle b from z turns by a smaller angle."""
    levers, times = _ToolLevers.of(random_chain(1), Limits().bounds(random_chain(1))), np.linspace(0.0, 1.0, 6)
    turn, lean = 0.4, 0.3
    path: dict[str, Any] = {"position": lambda t: ca.vertcat(0.1, 0.5 * t, 0.2)}

    def rotation(t: Any) -> Any:
        c, s = ca.cos(2 * t), ca.sin(2 * t)
        return ca.vertcat(ca.horzcat(c, -s, 0), ca.horzcat(s, c, 0), ca.horzcat(0, 0, 1))

    axis = ca.DM([np.sin(lean), 0.0, np.cos(lean)])
    leaning = np.arccos(np.sin(lean) ** 2 * np.cos(turn) + np.cos(lean) ** 2)
    for task, first, last in (
        (TipTask(**path), 0.1, 0.0),
        (TipTask(**path, rows=[4]), 0.1, 0.0),
        (TipTask(**path, rows=[3, 5]), 0.0, 0.0),
        (TipTask(**path, orientation=rotation), 0.1, turn),
        (TipTask(orientation=rotation), 0.0, turn),
        (TipTask(direction=lambda t: ca.mtimes(rotation(t), axis)), 0.0, leaning),
        (TipTask(direction=lambda t: ca.mtimes(rotation(t), axis), within=0.1), 0.0, 0.0),
    ):
        distances = levers.task_distances(task, times)
        assert distances[:, 0] == pytest.approx(first * np.ones(5), abs=1e-12)
        assert distances[:, -1] == pytest.approx(last * np.ones(5), abs=1e-9)


def test_tasks_relative_to_a_link_bound_nothing() -> None:
    machine = random_chain(0)
    task = TipTask(position=[0.1, 0.0, 0.2], relative_to="a", duration=1.0)
    assert tool_rate_bound(checked_request(machine, task, None, PlanOptions(search="global"))) == 0.0


def test_with_parallel_rails_the_bound_of_motions_in_time_is_exact() -> None:
    """Four rails share the motion in inverse proportion to their weights, and the plan costs what the bound says."""
    names = ("first", "second", "third", "fourth")
    joints = [
        Joint(name, "prismatic", below, link, (0.0, 0.0, 0.1), axis=(1.0, 0.0, 0.0), lower=-2.0, upper=2.0)
        for name, below, link in zip(names, ("base", "a", "b", "c"), ("a", "b", "c", "tool"), strict=True)
    ]
    machine = FixedBase(Robot(tuple(Link(name) for name in ("base", "a", "b", "c", "tool")), tuple(joints), "tool"))
    weights, seconds = np.array([1.0, 2.0, 0.5, 4.0]), 2.0
    task = TipTask(position=lambda t: ca.vertcat(0.3 * t, 0, 0.4), rows=[3], duration=seconds)
    result = plan(machine, task, search="global", cost=Cost(velocity=1.0, weights=weights), scene=False)
    assert isinstance(result, SolvedPlan)
    assert result.bound is not None
    exact = 0.3**2 * seconds / 2 / (1 / weights).sum()
    assert result.cost == pytest.approx(exact, rel=1e-6)
    assert result.bound == pytest.approx(exact, rel=1e-6)


@pytest.mark.long
def test_a_global_search_with_three_redundant_joints_has_a_bound_and_costs_no_more_than_others() -> None:
    machine = FixedBase(panda_arm())
    first = np.array(ca.DM(machine.tip_pose((), PANDA_START).position)).ravel()
    task = TipTask(position=lambda t: ca.DM(first) + 0.1 * ca.vertcat(t, 0, -t), duration=1.0)
    result, other = (plan(machine, task, search=each, scene=False) for each in ("global", "configurations"))
    assert result.bound is not None
    assert 0.0 < result.bound <= result.cost <= other.cost * (1 + 1e-6)


@pytest.mark.long
def test_a_path_of_three_redundant_joints_costs_no_more_than_with_one_held_and_has_a_bound() -> None:
    held = FixedBase(mount_on_rail(panda_arm(), (0, 1, 0), -1.0, 1.0))
    machine = FixedBase(mount_on_rail(held.robot, (1, 0, 0), -0.5, 0.5, name="gantry"))
    places, turns = poses(machine, np.append((0.0, 0.0), PANDA_START), 9)
    result, other = (plan(each, Waypoints(places, turns), scene=False) for each in (machine, held))
    assert isinstance(result, PathPlan)
    assert result.bound is not None
    assert 0 < result.bound <= result.cost <= other.cost * (1 + 1e-3)
    tips = [np.array(ca.DM(machine.tip_pose((), q).position)).ravel() for q in result.joints]
    assert np.array(tips) == pytest.approx(places, abs=1e-6)


def test_four_redundant_joints_are_refused() -> None:
    robot = panda_arm()
    for name, axis in (("rail", (0, 1, 0)), ("gantry", (1, 0, 0)), ("lift", (0, 0, 1))):
        robot = mount_on_rail(robot, axis, -0.5, 0.5, name=name)
    machine = FixedBase(robot)
    places, turns = poses(machine, np.append((0.0, 0.0, 0.0), PANDA_START), 5)
    with pytest.raises(ProblemError, match="at most 3 degrees of freedom"):
        plan(machine, Waypoints(places, turns), scene=False)
