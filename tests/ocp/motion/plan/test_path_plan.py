"""Paths through waypoints as plans: audited by their poses, steps, limits and bodies, whatever their files say."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
import pytest

from models import CollisionScene, FixedBase, MovingObstacle, Sphere
from ocp import ClearanceConstraints, Cost, Limits, Plan, ProblemError, Scene, Waypoints, plan
from ocp.motion.local.collisions import distances_along
from ocp.motion.result.path_plan import PathPlan
from ocp.motion.search.shortening import PathPoses
from tests.models.robot.trees import Array
from tests.ocp.motion.plan.test_waypoints import poses
from tests.ocp.motion.tasks.space_tasks import UR5_START, ur5

pytestmark = pytest.mark.xdist_group("path plan")  # one process, so that it is planned once

COUNT = 9


@cache
def path() -> PathPlan:
    result = plan(ur5(), Waypoints(*poses(ur5(), UR5_START, COUNT)), scene=Scene())
    assert isinstance(result, PathPlan)
    return result


@cache
def arrays() -> dict[str, Array]:
    return path().arrays("path.npz")


def poses_of(result: PathPlan) -> PathPoses:
    assert result.poses is not None
    return result.poses


def with_poses(**poses: Any) -> PathPlan:
    return replace(path(), poses=poses_of(path())._replace(**poses), _audits={})


def changed(number: int, joint: int, by: float) -> PathPlan:
    joints = path().joints.copy()
    joints[number, joint] += by
    return replace(path(), joints=joints, _audits={})


def failures(result: Plan) -> set[str]:
    return {finding.name.partition(",")[0] for finding in result.audit().failures}


def test_the_path_passes_and_may_be_run() -> None:
    audit = path().audit()
    assert audit.feasible
    assert audit.optimal is True
    assert f"it may cost {path().gap:.2g} too much" in audit.sentence


# ---- time ------------------------------------------------------------------------------------------------------------


def test_at_the_velocity_limits_it_is_as_fast_as_its_slowest_joint_of_each_step() -> None:
    result, velocity = path(), ur5().robot.velocity
    durations = (np.abs(np.diff(result.joints, axis=0)) / velocity).max(axis=1)
    np.testing.assert_allclose(result.t, np.r_[0.0, np.cumsum(durations)], atol=1e-12)
    assert result.horizon == result.t[-1]
    rates = result.at((result.t[1:] + result.t[:-1]) / 2)["rates"]
    np.testing.assert_allclose((np.abs(rates) / velocity).max(axis=1), 1.0, rtol=1e-12)


def test_between_waypoints_it_is_straight() -> None:
    result, rng = path(), np.random.default_rng(0)
    shares, numbers = rng.random(50), rng.integers(0, COUNT - 1, 50)
    at = result.at(result.t[numbers] + shares * np.diff(result.t)[numbers])
    before, step = result.joints[numbers], np.diff(result.joints, axis=0)[numbers]
    np.testing.assert_allclose(at["joints"], before + shares[:, None] * step, atol=1e-12)
    np.testing.assert_allclose(at["rates"] * np.diff(result.t)[numbers][:, None], step, atol=1e-12)
    np.testing.assert_array_equal(result.at(result.t)["joints"], result.joints)


def test_a_path_that_stands_still_has_times_that_increase() -> None:
    still = replace(path(), joints=np.repeat(path().joints[:1], COUNT, axis=0))
    assert (np.diff(still.t) > 0).all()
    assert still.horizon < 1e-6
    assert (still["rates"] == 0).all()
    assert replace(still, bound=0.0).gap == 0.0


# ---- audit -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("number", range(COUNT))
def test_a_waypoint_whose_joints_were_moved_is_missed_and_named(number: int) -> None:
    joint = number % 6
    audit = changed(number, joint, 1e-4).audit()
    assert not audit.feasible
    names = {finding.name for finding in audit.failures}
    assert names <= {"positions of the tip", "orientations of the tip"}
    assert {finding.note for finding in audit.failures} == {f"waypoint {number}"}
    assert {finding.time for finding in audit.failures} == {changed(number, joint, 1e-4).t[number]}
    assert changed(number, joint, 1e-9).audit().feasible


def test_poses_are_missed_by_as_much_as_they_were_moved() -> None:
    moved = with_poses(positions=poses_of(path()).positions + np.array([0.0, 0.003, 0.0]))
    assert moved.audit()["positions of the tip"].value == pytest.approx(0.003, abs=1e-8)
    turn = np.array([[np.cos(0.02), -np.sin(0.02), 0.0], [np.sin(0.02), np.cos(0.02), 0.0], [0.0, 0.0, 1.0]])
    turned = with_poses(rotations=poses_of(path()).rotations @ turn)
    assert turned.audit()["orientations of the tip"].value == pytest.approx(0.02, abs=1e-8)
    assert failures(turned) == {"orientations of the tip"}


def test_a_step_beyond_the_largest_fails_by_the_excess() -> None:
    steps = path().steps
    assert failures(with_poses(step=steps + 1e-9)) == set()
    for joint in range(6):
        narrow = with_poses(step=np.where(np.arange(6) == joint, steps - 1e-3, np.inf))
        (finding,) = narrow.audit().failures
        assert finding.name == f"steps beyond the largest, {path().names[joint]!r}"
        assert finding.value == pytest.approx(1e-3, abs=1e-12)


def test_a_joint_beyond_its_limit_fails_by_the_excess() -> None:
    joint, robot = 2, ur5().robot
    highest = float(path().joints[:, joint].max())
    joints = [
        replace(each, upper=highest - 0.01) if each.name == path().names[joint] else each for each in robot.joints
    ]
    narrow = replace(path(), machine=FixedBase(replace(robot, joints=tuple(joints))), constraints=None, _audits={})
    (finding,) = narrow.audit().failures
    assert finding.name == f"joints beyond their limits, {path().names[joint]!r}"
    assert finding.value == pytest.approx(0.01, abs=1e-12)
    assert finding.time is not None
    assert narrow.at(finding.time)["joints"][joint] == highest
    assert replace(narrow, limits=Limits(joints=False), _audits={}).audit().feasible


def test_the_clearance_between_waypoints_is_proven_and_an_obstacle_there_is_named_with_its_time() -> None:
    result, machine = path(), path().machine
    between = (result.t[4] + result.t[5]) / 2
    ball = Sphere(0.005, result.sampled(between).tip[0, :3])
    scene = CollisionScene(machine, [ball])
    finding = replace(result, constraints=ClearanceConstraints(scene), _audits={}).audit()["clearance"]
    assert not finding.passed
    assert "obstacle 0" in finding.note
    assert finding.time is not None
    times = np.linspace(0.0, result.horizon, 161)
    nearest = distances_along(scene, np.zeros(0), result.at(times)["joints"], times).min(axis=1)
    assert distances_along(scene, np.zeros(0), result.at([finding.time])["joints"], np.array([0.0])).min() == (
        pytest.approx(nearest.min(), abs=1e-3)
    )
    assert f"at {finding.time:.4g} s" in finding.note
    assert "clearance" not in {row.name for row in replace(result, constraints=None, _audits={}).audit().findings}


def test_a_reconfiguration_counts_neither_as_a_step_nor_for_clearance() -> None:
    result, number = path(), 4
    steps = np.abs(np.diff(result.joints, axis=0))
    broken = replace(result, reconfigurations=(number,), _audits={})
    np.testing.assert_array_equal(broken.steps, np.delete(steps, number, axis=0).max(axis=0))
    ball = Sphere(0.005, result.sampled((result.t[number] + result.t[number + 1]) / 2).tip[0, :3])
    constraints = ClearanceConstraints(CollisionScene(result.machine, [ball]))
    proofs = [replace(each, constraints=constraints).clearance() for each in (result, broken)]
    whole, without = ({pair.bodies: pair for pair in proof.pairs} for proof in proofs if proof)
    assert all(pair.distance >= whole[bodies].distance - 1e-9 for bodies, pair in without.items())
    assert any(pair.distance > whole[bodies].distance + 1e-4 for bodies, pair in without.items())
    assert not any(result.t[number] < pair.time < result.t[number + 1] for pair in without.values())
    assert f"after waypoint {number}" in str(broken)


def test_the_audit_has_no_settings_and_the_path_no_solution() -> None:
    with pytest.raises(ProblemError, match="'lost'"):
        path().audit(lost=1.0)
    with pytest.raises(ProblemError, match=r"plan\.joints"):
        _ = path().solution
    assert path().solved_parts(path().t) == []


def test_obstacles_that_move_are_refused() -> None:
    ball = MovingObstacle(Sphere(0.01, (2.0, 0.0, 0.0)), lambda time: ca.vertcat(0.1 * time, 0, 0))
    with pytest.raises(ProblemError, match="static") as refused:
        plan(ur5(), Waypoints(*poses(ur5(), UR5_START, 3)), scene=Scene([ball]))
    assert refused.value.name == "obstacles"
    moving = replace(path(), constraints=ClearanceConstraints(CollisionScene(path().machine, [ball])))
    with pytest.raises(ProblemError, match="move"):
        PathPlan.of_arrays("moving.npz", moving.arrays("moving.npz"))


# ---- cost ------------------------------------------------------------------------------------------------------------


def test_the_gap_is_the_share_of_the_cost_above_the_bound() -> None:
    result = path()
    assert result.bound is not None
    assert result.gap == pytest.approx(1 - result.bound / result.cost)
    assert replace(result, bound=None).gap is None


@pytest.mark.parametrize("cost", [Cost(velocity=0, length=2, weights=[1.0, 2, 3, 4, 5, 6]), Cost(velocity=0, time=3)])
def test_the_cost_is_that_of_its_joints(cost: Cost) -> None:
    result = plan(ur5(), Waypoints(*poses(ur5(), UR5_START, 4)), scene=False, cost=cost)
    steps = np.abs(np.diff(result["joints"], axis=0))
    if cost.time:
        assert result.cost == pytest.approx(cost.time * result.horizon, rel=1e-9)
    else:
        assert result.cost == pytest.approx(2 * (steps * cost.weights).sum(), rel=1e-12)


# ---- files -----------------------------------------------------------------------------------------------------------


def test_a_path_is_read_as_it_was_written(tmp_path: Path) -> None:
    result = replace(with_poses(step=np.r_[path().steps[:5], 0.7]), reconfigurations=(3,))
    result.save(tmp_path / "path.npz")
    again = Plan.load(tmp_path / "path.npz")
    assert isinstance(again, PathPlan)
    for name in ("joints", "t"):
        np.testing.assert_array_equal(getattr(again, name), getattr(result, name))
    for own, stored in zip(poses_of(again), poses_of(result), strict=True):
        np.testing.assert_array_equal(own, stored)
    for name in ("cost", "bound", "gap", "horizon", "reconfigurations", "names"):
        assert getattr(again, name) == getattr(result, name)
    assert str(again) == str(result)
    assert str(again.audit()) == str(result.audit())
    assert [str(each) for each in again.candidates] == [str(each) for each in result.candidates]
    again.write_csv(tmp_path / "path.csv", 0.05)
    rows = np.loadtxt(tmp_path / "path.csv", delimiter=",", skiprows=1)
    np.testing.assert_array_equal(rows[:, 1:7], result.at(rows[:, 0])["joints"])


def test_a_changed_file_is_audited() -> None:
    numbers = arrays()["path.numbers"]
    joints = path().joints.ravel()
    (at,) = (k for k in range(len(numbers)) if np.array_equal(numbers[k : k + len(joints)], joints))
    forged = numbers.copy()
    forged[at + 7] += 0.01
    again = PathPlan.of_arrays("forged.npz", {**arrays(), "path.numbers": forged})
    assert failures(again) == {"positions of the tip", "orientations of the tip"}


@pytest.mark.parametrize("wrong", [np.zeros(0), np.full(10**4, np.nan), np.zeros((3, 3))], ids=["empty", "nan", "2d"])
def test_a_file_of_other_numbers_is_refused(wrong: Array) -> None:
    with pytest.raises(ProblemError):
        PathPlan.of_arrays("forged.npz", {**arrays(), "path.numbers": wrong})


@pytest.mark.parametrize("name", ["path.numbers", "path.integers"])
def test_a_file_without_numbers_is_refused(name: str) -> None:
    with pytest.raises(ProblemError):
        PathPlan.of_arrays("forged.npz", {key: array for key, array in arrays().items() if key != name})
