"""Ways in pieces: as few reconfigurations as brute force over all postures finds, and then as short."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from typing import Any, Literal

import casadi as ca
import numpy as np
import pytest
from scipy.spatial.transform import Rotation, Slerp

from models import FixedBase
from models.checks import Array
from models.robot.rebuild import lock_joints
from ocp import DeadEnd, ProblemError, Scene, TipTask, Waypoints, inverse_kinematics, plan
from ocp.audit.clearance import ClosestPair
from ocp.motion.local.closed_forms import closed_forms
from ocp.motion.result.path_plan import PathPlan
from ocp.motion.search.charts import SelfMotionManifolds, TimeSample
from ocp.motion.search.joint_space import JointSpace
from ocp.motion.search.lengths import PathLength
from ocp.motion.search.reconfigurations import fewest_segments, segment_ends
from ocp.motion.search.search import AtlasSearch
from ocp.motion.search.steps import Steps
from ocp.motion.tasks.equations import bind
from tests.ocp.motion.local.test_closed_forms import chain_of
from tests.ocp.motion.search.test_charts import planar
from tests.ocp.motion.search.test_values import reached
from tests.ocp.motion.tasks.space_tasks import ur5
from tests.redundancy_benchmark import problem_of

COUNT = 9
FULL_TURN = 2 * np.pi


def fewest(nodes: list[Array], step: Any, gap: int = 1) -> tuple[int, float]:
    """The fewest reconfigurations, and the least length with these, over all sequences of nodes, the first first.

    They lead to the next instant, or, without a gap, to another posture of the same one.
    """
    best = [(0, 0.0)] * len(nodes[0])
    for here, there in pairwise(nodes):
        paths = np.abs(there[:, None] - here)
        near, length = (paths <= step).all(axis=2), paths.sum(axis=2)
        jump = (min(best)[0] + 1, min(best)[1])
        if not gap:
            best, jump = [min(one, jump) for one in best], (10**6, np.inf)
        counts, lengths = (np.array(part) for part in zip(*best, strict=True))
        after = []
        for row, own in zip(near, length, strict=True):
            some = np.flatnonzero(row)
            order = np.lexsort(((lengths + own)[some], counts[some]))
            first = [(int(counts[i]), float(lengths[i] + own[i])) for i in some[order[:1]]]
            after.append(min([jump, *first]))
        best = after
    return min(best)


def limited(machine: FixedBase, lower: Array, upper: Array) -> FixedBase:
    """The machine with other limits of its joints."""
    names = machine.robot.joint_names
    joints = [
        replace(joint, lower=lower[names.index(joint.name)], upper=upper[names.index(joint.name)])
        if joint.name in names
        else joint
        for joint in machine.robot.joints
    ]
    return FixedBase(replace(machine.robot, joints=tuple(joints)))


def of_six_joints(seed: int) -> tuple[FixedBase, Array, Array, float, list[Array]]:
    """An arm with random limits, a straight way from one pose to another, a step, and all postures there."""
    rng = np.random.default_rng(seed)
    middle, half = rng.uniform(-1.5, 1.5, 6), rng.uniform(1.0, 2.2, 6)
    machine = limited(ur5(), middle - half, middle + half)
    ends = [machine.tip_pose((), rng.uniform(middle - 0.8 * half, middle + 0.8 * half)) for _ in range(2)]
    first, last = (np.array(ca.DM(pose.position)).ravel() for pose in ends)
    places = np.linspace(first, last, COUNT)
    turns = Slerp([0, 1], Rotation.from_matrix([np.array(ca.DM(pose.rotation)) for pose in ends]))(
        np.linspace(0, 1, COUNT)
    )
    (form,) = closed_forms(chain_of(machine))
    (own, joints, _), _ = form.solve(places, turns.as_matrix(), np.zeros((COUNT, 0)))
    joints = middle + np.remainder(joints - middle + np.pi, FULL_TURN) - np.pi  # less than two turns within the limits
    more = [joints]
    for j in range(6):
        more = [part + side * FULL_TURN * np.eye(6)[j] for part in more for side in (-1, 0, 1)]
        more = [np.where((np.abs(part - middle) <= half + 1e-9)[:, [j]], part, np.nan) for part in more]
    nodes = []
    for k in range(COUNT):
        here = np.concatenate([part[own == k] for part in more])
        nodes.append(here[np.isfinite(here).all(axis=1)])
    quaternions = turns.as_quat()[:, [3, 0, 1, 2]]
    return machine, places, quaternions, float(rng.uniform(0.3, 0.9)), nodes


@pytest.mark.parametrize(("seed", "count"), [(0, 1), (16, 4), (23, 0), (39, 2)])
def test_segments_of_six_joints_equal_those_of_brute_force(seed: int, count: int) -> None:
    machine, places, quaternions, step, nodes = of_six_joints(seed)
    result = path(machine, Waypoints(places, quaternions, step, "counted"), False)
    expected = fewest(nodes, step)
    after = result.reconfigurations
    assert (len(after), expected[0]) == (count, count)
    assert result.cost == pytest.approx(expected[1], rel=1e-6)
    assert result.gap is not None
    assert result.gap >= 0
    steps = np.abs(np.diff(result.joints, axis=0))
    assert (np.flatnonzero((steps > step + 1e-9).any(axis=1)) == after).all()
    assert result.cost == pytest.approx(np.delete(steps, after, axis=0).sum(), rel=1e-9)
    assert (result.steps <= step + 1e-9).all()
    assert ("reconfigures" in str(result)) == bool(count)
    if count == 1:
        assert f"after waypoint {after[0]}" in str(result)
        with pytest.raises(DeadEnd):
            plan(machine, Waypoints(places, quaternions, step), scene=False)


def path(machine: FixedBase, waypoints: Waypoints, scene: Scene | Literal[False]) -> PathPlan:
    result = plan(machine, waypoints, scene=scene)
    assert isinstance(result, PathPlan)
    return result


def closest(result: PathPlan) -> ClosestPair:
    proof = result.clearance()
    assert proof is not None
    assert proof.worst is not None
    return proof.worst


def search_of(seed: int) -> tuple[AtlasSearch, list[Array], Array]:
    """A planar arm of three joints whose tip goes a bent way, and postures nearly everywhere."""
    rng = np.random.default_rng(seed)
    lengths, limit = rng.uniform(0.25, 0.6, 3), rng.uniform(0.9, 1.5)
    machine = planar(lengths, limit)
    poses = [machine.tip_pose((), rng.uniform(-limit, limit, 3)) for _ in range(2)]
    ends = np.array([np.array(ca.DM(pose.position)).ravel() for pose in poses])
    places = np.linspace(ends[0, :2], ends[1, :2], COUNT)
    return searched(machine, places, 0.3), [reached(lengths, place, limit, 700) for place in places], np.full(3, 0.3)


def searched(machine: FixedBase, places: Array, step: float) -> AtlasSearch:
    """Of ways of three joints through places in a plane."""
    space = JointSpace(machine, machine.robot.lower, machine.robot.upper, np.ones(3))
    sets = SelfMotionManifolds(
        space,
        bind(machine, TipTask(position=[*places[0]], rows=[3, 4])),
        np.array([np.r_[place, 0.0, 0.0, 0.0, 0.0] for place in places]),
    )

    def seeds(k: int) -> Array:
        task = TipTask(position=[*places[k]], rows=[3, 4])
        return np.array([one.joints for one in inverse_kinematics(machine, task, starts=16, seed=k)])

    far = np.full((len(places) - 1, 3), step)
    time_samples, times = [TimeSample(sets, k) for k in range(len(places))], np.linspace(0, 1, len(places))
    return AtlasSearch(space, time_samples, Steps(times, PathLength(np.ones(3)), far), seeds=seeds)


@pytest.mark.parametrize(("reach", "count"), [(0.45, 1), pytest.param(0.1, 0, marks=pytest.mark.long)])
def test_segments_meet_at_one_time_where_the_path_waits_and_are_minimal(reach: float, count: int) -> None:
    lengths, high, step = np.array([0.5, 0.3, 0.1]), np.array([0.9, 1.8, 0.3]), 0.4
    machine = limited(planar(lengths), -high, high)
    places = np.column_stack([np.full(COUNT, 0.6), np.linspace(-reach, reach, COUNT)])
    nodes = [reached(lengths, place, 1.8, 900) for place in places]
    nodes = [own[(np.abs(own) <= high).all(axis=1)] for own in nodes]
    search = searched(machine, places, step)
    result = fewest_segments(search, 0)
    assert result is not None
    segments, bound = result
    expected = fewest(nodes, step, 0)
    assert (len(segments) - 1, expected[0]) == (count, count)
    assert [segment.first for segment in segments] == [0, *(segment.last for segment in segments[:-1])]
    assert segments[-1].last == COUNT - 1
    cost = sum(segment.cost for segment in segments)
    assert bound <= min(cost, expected[1] + 1e-9)
    assert cost <= 1.002 * expected[1]
    for gap in (0, 1):
        assert len(segment_ends(search, gap, ruled_out=bool(gap))) == len(segments)
    first, last = segments[0].first, segments[0].last
    again = fewest_segments(search, 0, [(first, last)])  # what is barred is no piece, nor what holds it
    assert again is None or not any(segment.first <= first and last <= segment.last for segment in again[0])


@pytest.mark.parametrize(("seed", "count"), [(2, 1), (18, 1), (26, 8), (35, 1)])
def test_with_a_free_direction_no_sequence_of_configurations_has_fewer_segments_or_is_shorter(
    seed: int, count: int
) -> None:
    search, nodes, step = search_of(seed)
    result = fewest_segments(search)
    assert result is not None
    segments, bound = result
    expected = fewest(nodes, step)
    assert (len(segments) - 1, expected[0]) == (count, count)
    assert [segment.first for segment in segments] == [0, *(segment.last + 1 for segment in segments[:-1])]
    assert segments[-1].last == COUNT - 1
    cost = sum(segment.cost for segment in segments)
    assert bound <= min(cost, expected[1] + 1e-9)
    assert bound >= 0.97 * cost
    assert cost <= 1.002 * expected[1]
    for segment in segments:
        paths = np.abs(np.diff(segment.joints, axis=0))
        assert (paths <= step + 1e-9).all()
        assert segment.cost == pytest.approx(paths.sum(), rel=1e-9)


def test_distant_parts_of_a_path_are_segments_as_if_planned_alone() -> None:
    problem = problem_of("panda__1cube")
    machine = FixedBase(lock_joints(problem.machine.robot, {"panda_joint4": -1.8}))
    rows, turns = [], []
    for begin in ([0.4, 0.3, -0.2, 0.3, 1.4, 0.5], [-1.8, 0.5, 0.6, -0.4, 1.9, -0.6]):
        for k in range(3):
            pose = machine.tip_pose((), np.array(begin) + 0.05 * k)
            rows.append(np.array(ca.DM(pose.position)).ravel())
            turns.append(Rotation.from_matrix(np.array(ca.DM(pose.rotation))).as_quat()[[3, 0, 1, 2]])
    scene = Scene(obstacles=problem.boxes, ignored=problem.ignored)
    exclusive = [path(machine, Waypoints(rows[k : k + 3], turns[k : k + 3], 0.12), scene) for k in (0, 3)]
    result = path(machine, Waypoints(rows, turns, 0.12, "counted"), scene)
    assert result.reconfigurations == (2,)
    assert result.cost == pytest.approx(sum(one.cost for one in exclusive), rel=1e-6)
    worst, *nearest = (closest(one) for one in (result, *exclusive))
    assert worst.distance == pytest.approx(min(one.distance for one in nearest), abs=1e-6)
    assert not result.t[2] < worst.time < result.t[3]


def test_segments_are_counted_with_one_free_direction_at_most() -> None:
    problem = problem_of("fetch__square")
    report = (problem.positions[:3], problem.quaternions[:3])
    with pytest.raises(ProblemError, match="at most") as refused:
        plan(problem.machine, Waypoints(*report, reconfigurations="counted"), scene=False)
    assert refused.value.name == "reconfigurations"
    with pytest.raises(ProblemError, match="reconfigurations") as refused:
        plan(problem.machine, Waypoints(*report, reconfigurations="few"))  # type: ignore[arg-type]
    assert refused.value.name == "reconfigurations"
