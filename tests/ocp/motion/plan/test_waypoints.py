"""The shortest ways through waypoints: valid by other libraries, near their bounds, the same when turned round."""

from __future__ import annotations

import re
from collections.abc import Callable
from typing import Any

import casadi as ca
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from models import Box, CollisionScene, FixedBase
from models.checks import Array
from models.robot.rebuild import lock_joints
from models.spatial import quaternion_from_rotation
from ocp import Cost, DeadEnd, Limits, ProblemError, Scene, Unreachable, Waypoints, plan
from ocp.motion.local.collisions import distances_along
from ocp.motion.result.path_plan import PathPlan
from tests.ocp.motion.search.test_charts import planar
from tests.ocp.motion.tasks.space_tasks import PANDA_START, UR5_START, panda, ur5
from tests.redundancy_benchmark import problem_of
from tests.sweep.redundancy import faults, planned


def poses(machine: FixedBase, joints: Array, count: int) -> tuple[Array, Array]:
    """A bent way from a posture, the hand as it is there."""
    pose = machine.tip_pose((), joints)
    s = np.linspace(0, 1, count)[:, None]
    motion = s * (0.05, 0.1, -0.1) + 0.05 * np.sin(3 * s) * (0.0, 0.0, 1.0)
    turn = quaternion_from_rotation(np.array(ca.DM(pose.rotation))[None])[0]
    return np.array(ca.DM(pose.position)).ravel() + motion, np.tile(turn, (count, 1))


def path(machine: FixedBase, waypoints: Waypoints, **options: Any) -> PathPlan:
    """As `plan`, for paths of whatever the links may touch."""
    result = plan(machine, waypoints, **{"scene": False, **options})
    assert isinstance(result, PathPlan)
    return result


def gap(result: PathPlan) -> float:
    """The gap to the bound, which there is."""
    assert result.gap is not None
    return result.gap


@pytest.mark.long
def test_a_problem_of_the_benchmark_is_solved_by_its_rules_and_shorter_than_published() -> None:
    problem = problem_of("panda__1cube")
    result = planned(problem)
    assert problem.torm_length_rad is not None
    assert result.cost < problem.torm_length_rad
    assert 0.0 <= gap(result) <= 0.03
    assert result.cost == pytest.approx(np.abs(np.diff(result.joints, axis=0)).sum(), rel=1e-12)
    assert faults("panda__1cube", result.joints) == []
    assert faults("panda__1cube", result.joints + 1e-3)  # it finds some


@pytest.mark.parametrize(
    ("machine", "start"),
    [pytest.param(panda(), PANDA_START, marks=pytest.mark.long), (ur5(), UR5_START)],
    ids=["panda", "ur5"],
)
def test_the_reversed_path_is_as_long_and_weights_count(machine: FixedBase, start: Array) -> None:
    places, turns = poses(machine, start, 21)
    result = path(machine, Waypoints(places, turns))
    back = path(machine, Waypoints(places[::-1], -2.0 * turns[::-1]))
    weighted = Cost(velocity=0.0, length=1.0, weights=np.full(machine.joint_size, 3.0))
    heavy = path(machine, Waypoints(places, turns), cost=weighted)
    assert back.cost == pytest.approx(result.cost, rel=1e-3)
    assert heavy.cost == pytest.approx(3 * result.cost, rel=1e-3)
    for one in (result, back, heavy):
        assert 0.0 <= gap(one) <= 0.05
    tips = [np.array(ca.DM(machine.tip_pose((), q).position)).ravel() for q in result.joints]
    assert np.array(tips) == pytest.approx(places, abs=1e-8)
    assert (result.steps == np.abs(np.diff(result.joints, axis=0)).max(axis=0)).all()
    assert "lower bound" in str(result)


@pytest.mark.long
def test_an_additional_joint_never_lengthens_the_path() -> None:
    problem, some = problem_of("fetch__square"), slice(0, 60, 2)
    machine, report = problem.machine, (problem.positions[some], problem.quaternions[some])
    name = machine.robot.joint_names[0]
    middle = (machine.robot.lower[0] + machine.robot.upper[0]) / 2
    result = path(machine, Waypoints(*report))
    held = path(FixedBase(lock_joints(machine.robot, {name: middle})), Waypoints(*report))
    assert result.cost < held.cost
    assert result.steps[0] > 0
    tips = np.array([np.array(ca.DM(machine.tip_pose((), q).position)).ravel() for q in result.joints])
    assert tips == pytest.approx(report[0], abs=1e-8)


@pytest.mark.long
def test_length_time_and_largest_displacement_are_least_where_they_are_the_cost() -> None:
    """The sum of the largest displacements is the time at velocity limits of 1."""
    places, turns = poses(panda(), PANDA_START, 21)
    velocity = panda().robot.velocity
    timed = Cost(velocity=0.0, time=1.0)
    requests: dict[str, dict[str, Any]] = {
        "length": {"cost": None},
        "largest": {"cost": timed, "limits": Limits(velocity=1.0)},
        "time": {"cost": timed},
    }
    by_name = {cost: path(panda(), Waypoints(places, turns), **options) for cost, options in requests.items()}
    measures: dict[str, Callable[[Array], float]] = {
        "length": lambda paths: paths.sum(),
        "largest": lambda paths: (paths / np.minimum(velocity, 1.0)).max(axis=1).sum(),
        "time": lambda paths: (paths / velocity).max(axis=1).sum(),
    }
    for cost, measured in measures.items():
        by_plan = {name: measured(np.abs(np.diff(one.joints, axis=0))) for name, one in by_name.items()}
        assert by_name[cost].cost == pytest.approx(by_plan[cost], rel=1e-12)
        assert by_plan[cost] == min(by_plan.values())
        assert by_name[cost].bound is not None
        assert 0.0 <= gap(by_name[cost]) <= 0.1
    assert by_name["time"].horizon == pytest.approx(by_name["time"].cost, rel=1e-6)
    slow = path(panda(), Waypoints(places, turns), limits=Limits(velocity=velocity / 4), cost=timed)
    assert slow.cost == pytest.approx(4 * by_name["time"].cost, rel=1e-3)


@pytest.mark.long
def test_obstacles_lengthen_the_path_and_are_avoided() -> None:
    places, turns = poses(panda(), PANDA_START, 21)
    free = path(panda(), Waypoints(places, turns), scene=None)
    box = Box((0.1, 0.1, 0.1), (0.25, 0.1, 0.9))
    boxed = path(panda(), Waypoints(places, turns), scene=Scene(obstacles=[box]))
    assert free.bound is not None
    assert boxed.cost >= free.bound
    assert gap(boxed) >= 0.0
    # between the waypoints no sample is nearer than what is proven, and some is as near as what was found
    around = CollisionScene(panda(), [box])
    numbers = np.linspace(0, 20, 2001)
    joints = np.stack([np.interp(numbers, np.arange(21), column) for column in boxed.joints.T], axis=1)
    apart = distances_along(around, np.zeros(0), joints, numbers).min()
    proof = boxed.clearance()
    assert proof is not None
    worst = proof.worst
    assert worst is not None
    assert min(near.least for near in proof.pairs) <= apart + 1e-9
    assert apart == pytest.approx(worst.distance, abs=1e-3)
    assert worst.bodies[0] in boxed.audit()["clearance"].note
    assert path(panda(), Waypoints(places[:6], turns[:6])).clearance() is None


@pytest.mark.parametrize("seed", [9, 17, 47])
def test_a_waypoint_that_a_path_misses_is_searched_next_and_not_missed_again(seed: int) -> None:
    """The tool swings so far that paths through every fifth waypoint miss some between them."""
    random, machine, s = np.random.default_rng(seed), ur5(), np.linspace(0, 2 * np.pi, 11)[:, None]
    along, turn = random.normal(size=(2, 3))
    pose = machine.tip_pose((), UR5_START)
    rotation = Rotation.from_matrix(np.array(ca.DM(pose.rotation))) * Rotation.from_rotvec(np.sin(2 * s) * turn)
    places = np.array(ca.DM(pose.position)).ravel() + 0.1 * np.sin(s) * along / np.linalg.norm(along)
    result = path(machine, Waypoints(places, rotation.as_quat()[:, [3, 0, 1, 2]]))
    reasons = [str(candidate.reason) for candidate in result.candidates if candidate.reason is not None]
    missed = re.findall(r"waypoint \d+ is missed", "; ".join(reasons))
    assert missed
    assert len(set(missed)) == len(missed)


def test_infeasible_requests_are_refused() -> None:
    places, turns = poses(panda(), PANDA_START, 11)
    for report, name in (
        ((places[:1], turns[:1]), "positions"),
        ((places[:, :2], turns), "positions"),
        ((places * np.nan, turns), "positions"),
        ((places, turns[:-1]), "quaternions"),
        ((places, turns * 0), "quaternions"),
    ):
        with pytest.raises(ProblemError) as refused:
            plan(panda(), Waypoints(*report))
        assert refused.value.name == name
    with pytest.raises(ProblemError) as refused:
        plan(panda(), Waypoints(places, turns, step=0.0))
    assert refused.value.name == "step"
    for weights in (np.zeros(7), np.ones(3)):
        with pytest.raises(ProblemError) as refused:
            plan(panda(), Waypoints(places, turns), cost=Cost(velocity=0.0, length=1.0, weights=weights))
        assert refused.value.name == "weights"
    with pytest.raises(ProblemError, match="3 joints for the 6 rows"):
        plan(planar(np.array([0.5, 0.4, 0.3])), Waypoints(places, turns))
    with pytest.raises(Unreachable, match="waypoint 0 at"):
        plan(panda(), Waypoints(places + 3.0, turns))
    with pytest.raises(DeadEnd, match=r"none continues to waypoint 1; .* in one step, 0.0001 at most"):
        plan(panda(), Waypoints(places, turns, step=1e-4), limits=Limits(), scene=False)
