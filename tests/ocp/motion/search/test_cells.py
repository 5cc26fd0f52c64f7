"""Search over exact states of machines whose base moves by itself."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import casadi as ca
import numpy as np
import pytest

from models import FreeFloating, Link, center_of_mass, planar_chain, with_wheels
from models.examples import paper_example
from ocp import Candidate, Cost, Plan, SolveError, TipTask, Unreachable, console, plan
from ocp.motion.plan.candidate_solver import CandidateSolver
from ocp.motion.plan.planner import PlanOptions, checked_request
from ocp.motion.result.candidate import Reason, Rejection, Stage
from ocp.motion.result.solved_plan import SolvedPlan
from ocp.motion.search.cells import CellSearch
from ocp.motion.search.dead_end import DeadEnd
from ocp.motion.tasks.equations import task_errors
from tests.families import some
from tests.sweep.passages import passage, planned

START = np.radians([45.0, 60.0, -60.0])
EXTREMALS = {  # results/free_floating/extremals.csv: from 19 first guesses, by collocation and the minimum principle
    3.5: (1.23315249, 1.32543741, 2.69529795),
    4.0: (1.36393276, 1.49336890, 2.77068723, 3.15128, 10.63120808),
    5.0: (1.73511431, 1.74669072, 1.83951153, 3.31955, 7.473465),
    6.0: (1.94938717, 2.10995430, 2.18323629, 3.5177),
}


def example(horizon: float) -> TipTask:
    return TipTask(velocity=[-1.0, -1.0], rows=[3, 4], duration=horizon)


@pytest.mark.long
@pytest.mark.parametrize(
    "horizon", [each if each == 3.5 else pytest.param(each, marks=pytest.mark.long) for each in EXTREMALS]
)
def test_from_the_start_alone_every_extremal_known_of_the_paper_is_found(horizon: float) -> None:
    result = plan(paper_example(), example(horizon), start=START, search="global", scene=False)
    known = EXTREMALS[horizon]
    assert result.cost == pytest.approx(known[0], rel=1e-7)
    costs = np.array([one.cost for one in result.candidates if np.isfinite(one.cost)])
    for cost in known:
        assert np.abs(costs / cost - 1).min() < 5e-5  # those told last are of one mesh
    assert result.bound is None  # exact states in cells prove nothing
    passing = np.sort([one.cost for one in result.candidates if one.stage is Stage.AUDITED and not is_duplicate(one)])
    assert (np.diff(passing) > 1e-5 * passing[:-1]).all()
    assert result.audit().passed


def is_duplicate(candidate: Candidate) -> bool:
    return candidate.reason is not None and candidate.reason.kind is Rejection.DUPLICATE


def farthest_from_center() -> float:
    """How far the paper's tip can be from its centre of mass at most, m: stretched, by a grid of its joints."""
    machine = paper_example()
    q = ca.SX.sym("q", 3)
    pose, center = machine.tip_pose(np.zeros(3), q).position, center_of_mass(machine.robot, q)
    far = ca.Function("far", [q], [ca.norm_2((pose - center)[:2])])
    grid = np.stack(np.meshgrid(*[np.linspace(-np.pi, np.pi, 25)] * 3), axis=-1).reshape(-1, 3)
    return float(np.array(far.map(len(grid))(grid.T)).max())


@pytest.mark.parametrize("search", ["global", "configurations"])
@pytest.mark.parametrize("report", some(["velocity", "place"], ["place"]))
def test_paths_out_of_reach_are_refused_with_their_time(search: Any, report: str) -> None:
    machine = paper_example()
    first = np.array(ca.DM(machine.tip_pose(np.zeros(3), START).position)).ravel()
    center = np.array(ca.DM(center_of_mass(machine.robot, START))).ravel()
    path = np.array([0.5, 0.5, 0.0])
    task = {
        "velocity": TipTask(velocity=path[:2], rows=[3, 4], duration=8.0),
        "place": TipTask(position=lambda t: ca.DM(first) + t * ca.DM(path), rows=[3, 4], duration=8.0),
    }[report]
    times = np.linspace(0.0, 8.0, 8001)
    gone = times[np.linalg.norm(first - center + np.outer(times, path), axis=1) > farthest_from_center()][0]
    with pytest.raises(Unreachable, match="no joint positions put") as caught:
        plan(machine, task, start=START, search=search, scene=False)
    assert caught.value.time == pytest.approx(gone, abs=0.01)
    assert caught.value.name == "link3"


@pytest.mark.long
def test_limits_that_stop_a_motion_are_named() -> None:
    robot = paper_example().robot
    slow = tuple(replace(joint, velocity=0.6) for joint in robot.joints)
    with pytest.raises(DeadEnd, match=r"is at its rate limit -?0\.6") as caught:
        plan(FreeFloating(replace(robot, joints=slow), base="planar"), example(5.0), start=START, scene=False)
    assert (caught.value.name, caught.value.limit) in {(joint.name, s) for joint in slow for s in (-0.6, 0.6)}
    narrow = tuple(replace(joint, lower=-1.3, upper=1.3) for joint in robot.joints)
    with pytest.raises(Unreachable, match="at their limits") as lost:
        plan(FreeFloating(replace(robot, joints=narrow), base="planar"), example(5.0), start=START, scene=False)
    assert 0 < lost.value.time < 5.0


@pytest.mark.long
@pytest.mark.parametrize("momentum", [None, (30.0, 5.0, -5.0)], ids=["at rest", "with momentum"])
@pytest.mark.parametrize("report", some(["velocity", "place"], ["velocity"]))
def test_every_motion_does_its_task_within_limits_and_conserves_momentum(report: str, momentum: Any) -> None:
    robot = paper_example().robot
    joints = tuple(replace(joint, lower=-2.0, upper=2.0, velocity=1.5) for joint in robot.joints)
    machine = FreeFloating(replace(robot, joints=joints), base="planar", conserved_momentum=momentum)
    first = np.array(ca.DM(machine.tip_pose(np.zeros(3), START).position)).ravel()
    path = np.array([-0.5, -0.5, 0.0])
    place = TipTask(position=lambda t: ca.DM(first) + t * ca.DM(path), rows=[3, 4], duration=4.0)
    task = TipTask(velocity=path[:2], rows=[3, 4], duration=4.0) if report == "velocity" else place
    request = checked_request(machine, task, None, PlanOptions(start=START, search="global"))
    b, q, u = (ca.SX.sym(name, 3) for name in "bqu")
    center = ca.Function("center", [b, q], [center_of_mass(machine.robot, q, machine.world_from_base(b))])
    rate = ca.Function("rate", [b, q, u], [machine.base_rate(b, q, u)])
    pushed = np.zeros(2) if momentum is None else np.array(momentum[1:]) / robot.total_mass
    for (result,) in CellSearch(request, START[None]).local_motions():
        count, times = len(result.cost), result.t
        for base, at, rates in zip(result.base, result.joints, result.rates, strict=True):
            assert np.abs(task_errors(machine, place, times, at, base=base)).max() < 5e-3
            assert (np.abs(at) <= 2.0).all()
            assert np.abs(rates).max() < 1.5 * 1.1  # a limit is kept by the rates that a step begins with
            drift = np.array(center.map(len(times))(base.T, at.T))[:2].T - np.outer(times, pushed)
            assert np.abs(drift - drift[0]).max() < 0.02
            half = (base[1:] + base[:-1]) / 2, (at[1:] + at[:-1]) / 2
            turned = np.array(rate.map(len(times) - 1)(half[0].T, half[1].T, rates[:-1].T)).T
            assert np.abs(np.diff(base, axis=0) - turned * np.diff(times)[:, None]).max() < 5e-3
        assert count >= 1
        steps = np.diff(result.joints, axis=1) ** 2 / (2 * np.diff(times)[:, None])
        assert result.cost == pytest.approx(steps.sum(axis=(1, 2)))


@pytest.mark.long
@pytest.mark.parametrize("seed", [1, 3])
def test_paths_past_singularities_that_can_be_done_are_planned(seed: int) -> None:
    options = passage(seed)
    result = planned(options)
    assert isinstance(result, Plan), result
    assert result.audit().passed
    assert result.cost < options.cost


@pytest.mark.long
def test_tasks_one_after_the_other_are_searched_together() -> None:
    machine = paper_example()
    first = np.array(ca.DM(machine.tip_pose(np.zeros(3), START).position)).ravel()
    lines = [
        TipTask(position=lambda t: ca.DM(first) - t * ca.DM([0.4, 0.3, 0.0]), rows=[3, 4], duration=2.0),
        TipTask(position=ca.DM(first) - ca.DM([1.0, 0.4, 0.0]), rows=[3, 4], begin=3.0, duration=1.0),
    ]
    result = plan(machine, lines, start=START, search="global", scene=False)
    local = plan(machine, lines, start=START, search="start", scene=False)
    assert result.cost <= local.cost * (1 + 1e-6)
    assert isinstance(result, SolvedPlan)
    assert len(result.parts) == 3


@pytest.mark.long
def test_of_failing_motions_a_few_of_each_search_are_tried_and_the_others_reported(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    machine, task, tried = paper_example(), example(4.0), list[float]()
    request = checked_request(machine, task, None, PlanOptions(start=START))
    sizes = [len(paths[0].cost) for paths in CellSearch(request, START[None]).local_motions()]

    def fails(solver: CandidateSolver, candidate: Candidate) -> list[Candidate]:
        tried.append(solver.settings.max_refinements)
        return [candidate.with_rejection(Reason(Rejection.AUDIT, "fails"))]

    monkeypatch.setattr(CandidateSolver, "advance", fails)
    with pytest.raises(SolveError, match="fails") as caught:
        plan(machine, task, start=START, scene=False)
    count = sum(min(size, 8) for size in sizes)
    assert tried in ([2] * count, [6] + [2] * count)  # the local motion at first
    rest = sum(sizes) - count
    assert f"{rest} of {len(tried) + rest} candidates: not tried: the 8 lowest-cost motions of its search fail" in str(
        caught.value
    )


def test_the_search_ends_at_its_time_limit() -> None:
    request = checked_request(paper_example(), example(3.5), None, PlanOptions(start=START))
    with console.time_limited(0.0), pytest.raises(console.TimeLimitReached):
        CellSearch(request, START[None])


def test_a_light_wheel_that_turns_far_is_searched_as_a_heavy_one_that_turns_little() -> None:
    """With a share of the inertia it turns inversely as far, for the same cost if its weight has the squared share."""
    start, costs, samples = np.array([0.4, -0.9, 0.0]), list[float](), list[int]()
    for share in (1.0, 1e-3):
        chain = planar_chain([0.8, 0.6], [4.0, 3.0], base=Link("hub", 40.0, (0, 0, 0), 4.0 * np.eye(3)))
        machine = FreeFloating(with_wheels(chain, [[0, 0, 1]], 0.001 * share), "planar")
        reach = TipTask(velocity=[0.1], rows=[4], duration=4.0)
        hold = TipTask(link="hub", velocity=[0.0], rows=[2], duration=4.0)
        cost = Cost(weights=[1.0, 1.0, 1e-6 * share**2])
        request = checked_request(machine, [reach, hold], None, PlanOptions(start=start, cost=cost))
        ((motion,), *_) = CellSearch(request, start[None]).local_motions()
        costs.append(float(motion.cost.min()))
        samples.append(len(motion.t))
        assert np.ptp(motion.joints[0, :, 2]) > 50.0 / share
    assert samples[0] == samples[1]
    assert costs[1] == pytest.approx(costs[0], rel=1e-2)
