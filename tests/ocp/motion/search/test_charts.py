"""All postures of a task: what covers them, and how far the set strays from its charts."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import casadi as ca
import numpy as np
import pytest

from models import FixedBase, Joint, Link, Robot
from models.checks import Array
from ocp import IkOptions, ProblemError, TipTask, inverse_kinematics
from ocp.motion.search.charts import Charts, SelfMotionManifolds
from ocp.motion.search.joint_space import JointSpace
from ocp.motion.tasks.equations import bind
from tests.families import some
from tests.ocp.motion.tasks.space_tasks import PANDA_START, UR5_START, panda, ur5

SECONDS, TIME_SAMPLES, RADIUS = 4.0, 6, 0.05


def planar(lengths: Array, limit: float = 2.8, speed: float = 3.0) -> FixedBase:
    """An arm in a plane."""
    n = len(lengths)
    links = [Link("base", 1.0), *(Link(f"link{i}", 1.0) for i in range(n)), Link("tip", 0.1)]
    places = [0.0, *lengths[:-1]]
    parents = ["base", *(f"link{i}" for i in range(n))]
    span: dict[str, Any] = {"lower": -limit, "upper": limit, "velocity": speed}
    joints = [
        Joint(
            f"joint{i}",
            kind="revolute",
            parent=parents[i],
            child=f"link{i}",
            translation=(places[i], 0, 0),
            axis=(0, 0, 1),
            **span,
        )
        for i in range(n)
    ]
    joints.append(Joint("flange", parent=f"link{n - 1}", child="tip", kind="fixed", translation=(lengths[-1], 0, 0)))
    return FixedBase(Robot(tuple(links), tuple(joints), tip="tip"))


def moved(machine: FixedBase, joints: Array, rows: str) -> TipTask:
    """A bent way from where joints are, the whole pose held, the axis alone, or the place in the plane."""
    pose = machine.tip_pose((), joints)
    at, turn = (np.array(ca.DM(part)) for part in (pose.position, pose.rotation))
    first = at.ravel()

    def where(t: Any) -> Any:
        return ca.DM(first) + ca.vertcat(0.1 * t / SECONDS, 0.15 * ca.sin(2 * t / SECONDS), -0.1 * t / SECONDS)

    if rows == "pose":
        return TipTask(position=where, orientation=turn, duration=SECONDS)
    if rows == "axis":
        return TipTask(position=where, direction=turn[:, 2], duration=SECONDS)
    return TipTask(
        position=lambda t: (ca.DM(first) + 0.5 * (where(t) - ca.DM(first)))[:2], rows=[3, 4], duration=SECONDS
    )


def sets_of(machine: FixedBase, task: TipTask) -> tuple[SelfMotionManifolds, Array]:
    equations, times = bind(machine, task), np.linspace(0.0, SECONDS, TIME_SAMPLES)
    robot = machine.robot
    space = JointSpace(machine, robot.lower, robot.upper, np.ones(robot.dof))
    return SelfMotionManifolds(
        space, equations, np.array(equations.target_function().map(TIME_SAMPLES)(times[None])).T
    ), times


def solution_sets(machine: FixedBase, task: TipTask, times: Array, starts: int, seed: int) -> tuple[Any, Array]:
    rows = [
        (k, one.joints)
        for k, t in enumerate(times)
        for one in inverse_kinematics(
            machine, task, time=float(t), starts=starts, seed=seed + k, options=IkOptions(apart=1e-2)
        )
    ]
    return np.array([k for k, _ in rows]), np.array([joints for _, joints in rows])


CASES: dict[str, Any] = {
    "panda pose": (panda, PANDA_START, "pose"),
    "ur5 axis": (ur5, UR5_START, "axis"),
    "ur5 pose": (ur5, UR5_START, "pose"),
    "planar 3": (lambda: planar(np.array([0.5, 0.4, 0.3])), np.array([0.5, 1.2, -1.4]), "place"),
    "planar 4": (lambda: planar(np.array([0.4, 0.3, 0.3, 0.2]), 2.0), np.array([0.5, 1.2, -1.4, 0.9]), "place"),
}


@pytest.mark.parametrize("case", some(CASES, 3))
def test_every_solution_of_inverse_kinematics_lies_in_a_chart(case: str) -> None:
    make, start, rows = CASES[case]
    machine = make()
    task = moved(machine, start, rows)
    sets, times = sets_of(machine, task)
    charts = sets.cover(*solution_sets(machine, task, times, 16, 0), 4 * RADIUS if sets.size == 2 else RADIUS, 50_000)
    layer, joints = solution_sets(machine, task, times, 128, 1000)
    assert sets.size == machine.joint_size - bind(machine, task).size
    assert not sets.lost
    assert sets.is_covered(charts, layer, joints).all()


@pytest.mark.parametrize("case", ["panda pose", "planar 3", "planar 4"])
def test_task_errors_of_configurations_in_a_chart_grow_quadratically_within_their_bound(case: str) -> None:
    make, start, rows = CASES[case]
    machine = make()
    sets, times = sets_of(machine, moved(machine, start, rows))
    layer, joints = solution_sets(machine, moved(machine, start, rows), times, 16, 0)
    rng = np.random.default_rng(0)
    radii = np.full(len(layer), 0.04)
    charts, _ = sets.charts_at(layer, joints, radii)
    place = rng.uniform(-1, 1, (len(layer), sets.size)) * charts.radii[:, None]
    flat = charts.centers + np.einsum("nir,nr->ni", charts.tangents, place)
    on, good = sets.project(layer, flat)
    deviation = np.linalg.norm(charts.deviations, axis=2).max(axis=1)
    assert good.all()
    assert np.abs(sets.linearize(layer, on)[0]).max() < 1e-9
    assert (np.linalg.norm(on - flat, axis=1) <= 1.1 * deviation + 1e-9).all()
    half = sets.charts_at(layer, joints, charts.radii / 2, charts.tangents)[0]
    ratio = deviation / np.linalg.norm(half.deviations, axis=2).max(axis=1)
    assert np.median(ratio) == pytest.approx(4.0, rel=0.05)
    orthonormal = np.einsum("nir,nis->nrs", charts.tangents, charts.tangents)
    assert np.abs(orthonormal - np.eye(sets.size)).max() < 1e-12


@pytest.mark.long
def test_halves_cover_their_chart() -> None:
    machine = panda()
    task = moved(machine, PANDA_START, "pose")
    sets, times = sets_of(machine, task)
    charts = sets.cover(*solution_sets(machine, task, times, 16, 0), 0.07, 50_000)
    layer, joints = solution_sets(machine, task, times, 64, 99)
    covered = sets.is_covered(charts, layer, joints)  # not those on small components that the seeds missed
    layer, joints = layer[covered], joints[covered]
    assert covered.mean() > 0.95
    for _ in range(3):
        charts = sets.split(charts).charts
        assert sets.is_covered(charts, layer, joints).all()
    assert np.median(charts.radii) < 0.07 / 8 * 1.1


def test_parts_are_of_the_charts_that_they_lie_in() -> None:
    machine = planar(np.array([0.4, 0.3, 0.3, 0.2]), 2.0)
    task = TipTask(position=[0.6, 0.2], rows=[3, 4], duration=1.0)
    sets, times = sets_of(machine, task)
    charts = sets.cover(*solution_sets(machine, task, times, 16, 0), 0.2, 50_000)
    parts = sets.split(charts)
    owners = charts.select(parts.owners)
    assert (parts.low >= owners.low).all()
    assert (parts.high <= owners.high).all()
    assert (parts.low <= parts.high).all()
    middle = (parts.low + parts.high) / 2
    flat = owners.centers + np.einsum("knr,kr->kn", owners.tangents, middle)
    on, good = sets.project(owners.layer, flat)
    path = sets.space.difference(on, parts.charts.centers) * sets.space.scale
    place = np.einsum("kn,knr->kr", path, parts.charts.tangents * sets.space.scale[:, None])
    whole = ((owners.low < 0) & (owners.high > 0)).all(axis=1) & (parts.high - parts.low > 0).all(axis=1)
    assert good.all()
    assert (np.abs(place) <= parts.charts.radii[:, None])[whole].all()


@pytest.mark.parametrize(
    ("machine", "task", "radius"),
    [
        (planar(np.array([0.4, 0.3, 0.3, 0.2]), 2.0), TipTask(position=[0.6, 0.2], rows=[3, 4], duration=1.0), 0.2),
        (planar(np.array([0.5, 0.4, 0.3])), TipTask(position=[0.6, 0.2], rows=[3, 4], duration=1.0), 0.07),
        (panda(), moved(panda(), PANDA_START, "pose"), 0.07),
    ],
    ids=["two", "one", "panda"],
)
def test_points_of_a_chart_lie_in_its_halves(machine: FixedBase, task: TipTask, radius: float) -> None:
    sets, times = sets_of(machine, task)
    charts = sets.cover(*solution_sets(machine, task, times, 16, 0), radius, 50_000)
    r, scale = charts.tangents.shape[2], sets.space.scale
    wide = replace(charts, low=np.full((len(charts), r), -1e9), high=np.full((len(charts), r), 1e9))
    parts = sets.split(wide)
    order = np.lexsort((*(parts.high > 1e6).T[::-1], parts.owners))
    whole = np.flatnonzero(np.bincount(parts.owners, minlength=len(charts)) == 2**r)  # no part is beyond the limits
    of_whole = order[np.isin(parts.owners[order], whole)].reshape(len(whole), 2**r)
    assert parts.charts.radii.max() < 0.55 * charts.radii.max()
    rng, owners, seen = np.random.default_rng(0), charts.select(whole), 0
    for _ in range(10):
        shift = rng.uniform(-1, 1, (len(whole), r)) * owners.radii[:, None]
        on, good = sets.project(owners.layer, owners.centers + np.einsum("knr,kr->kn", owners.tangents, shift))
        place = np.einsum("kn,knr->kr", (on - owners.centers) * scale, owners.tangents * scale[:, None])
        good &= (np.abs(place) <= owners.radii[:, None]).all(axis=1)
        own = parts.charts.select(of_whole[np.arange(len(whole)), (place > 0) @ 2 ** np.arange(r)[::-1]])
        there = np.einsum("kn,knr->kr", (on - own.centers) * scale, own.tangents * scale[:, None])
        assert (np.abs(there) <= own.radii[:, None])[good].all()
        seen += int(good.sum())
    assert seen > 5 * len(whole)


def test_parts_of_a_parabola_reach_its_ends_and_hardly_farther() -> None:
    """Of (t, bend t^2 / 2): along the tangent at half the radius its end is as far away as is told in closed form."""
    sets, _ = sets_of(planar(np.array([0.5, 0.4, 0.3])), TipTask(position=[0.6, 0.2], rows=[3, 4], duration=1.0))
    radius, bend = 0.2, 3.0
    sets.space.scale[:] = 1.0
    tangents, deviations = np.zeros((1, 3, 1)), np.zeros((1, 2, 3))
    tangents[0, 0], deviations[0, :, 1] = 1.0, bend * radius**2 / 2
    ends = np.array([[-radius]]), np.array([[radius]])
    whole = Charts(np.zeros(1, dtype=np.intp), np.zeros((1, 3)), tangents, np.array([radius]), *ends, deviations)
    lean, half = bend * radius / 2, radius / 2
    exact = (half + lean * bend * (radius**2 - half**2) / 2) / np.sqrt(1 + lean**2)
    for result in sets._split_radii(whole, np.array([[-0.5], [0.5]])):
        assert exact <= result <= 1.003 * exact


def test_boxes_end_at_the_limits_of_the_joints() -> None:
    machine = panda()
    task = moved(machine, PANDA_START, "pose")
    sets, times = sets_of(machine, task)
    charts = sets.cover(*solution_sets(machine, task, times, 16, 0), 0.07, 50_000)
    limits = sets.space.lower, sets.space.upper
    deviation = np.abs(charts.deviations).max(axis=1)
    for end, whole in ((charts.low, -charts.radii[:, None]), (charts.high, charts.radii[:, None])):
        at = charts.centers + np.einsum("nir,nr->ni", charts.tangents, end)
        cut = (end != whole).all(axis=1)
        beyond = np.maximum(at - limits[1], limits[0] - at)
        assert (beyond <= deviation + 1e-9).all()
        assert np.abs((beyond - deviation)[cut].max(axis=1)).max() < 1e-9  # and not before
        assert cut.any()


def test_excessive_requests_are_refused() -> None:
    machine = planar(np.array([0.5, 0.4, 0.3]))
    task = moved(machine, np.array([0.5, 1.2, -1.4]), "place")
    sets, times = sets_of(machine, task)
    with pytest.raises(ProblemError, match="more than 10 charts") as refused:
        sets.cover(*solution_sets(machine, task, times, 16, 0), 0.05, 10)
    assert refused.value.limit == 10


def test_joints_that_turn_without_end_come_round() -> None:
    machine = ur5()
    space = JointSpace(machine, machine.robot.lower, machine.robot.upper, np.full(6, 4.0))
    assert space.periodic.tolist() == [True, True, False, True, True, True]
    path = space.difference(np.full((1, 6), 3.0), np.full((1, 6), -3.0))
    assert path[0] == pytest.approx([6 - 2 * np.pi, 6 - 2 * np.pi, 6.0, *[6 - 2 * np.pi] * 3])
    assert space.length(np.ones(6)) == pytest.approx(2 * np.sqrt(6))
    near, _ = space.tree(np.full((1, 6), 3.1)).query(
        space.tree_points(np.full((1, 6), 3.1 - 2 * np.pi) * [1, 1, -1, 1, 1, 1])
    )
    assert np.isfinite(near).all()
