"""Plans of unusual machines and tasks: no freedom left, slides, millimetres and cranes, singularities, leans alone."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import casadi as ca
import numpy as np
import pytest

from models import FixedBase, Machine, Path, Robot, SmoothPath, lock_joints, planar_chain, smooth
from ocp import ProblemError, SolveError, TipTask
from ocp.motion.plan import Plan
from ocp.motion.tasks.equations import bind, task_errors
from tests.families import some
from tests.models.robot.pinocchio_robots import ROBOTS, urdf_file
from tests.models.robot.trees import numeric
from tests.ocp.motion.plan.motions import DOWN, angled_ur5, plan_bare
from tests.ocp.motion.tasks.space_tasks import PANDA_START, floating_panda, panda, pose

PlanCase = tuple[Machine, Any, dict[str, Any]]


def line(*points: Any, deviation: float = 0.005) -> SmoothPath:
    return smooth(Path.through(points), deviation=deviation)


def chain(links: int, length: float = 0.5) -> FixedBase:
    return FixedBase(planar_chain([length] * links, [1.0] * links))


def in_the_plane(*points: Any, speed: float = 0.1, **options: Any) -> TipTask:
    return TipTask.along(line(*points, **options), speed, steady=True, rows=(3, 4))


def no_freedom_left() -> PlanCase:
    return chain(2), in_the_plane((0.5, 0.1, 0), (0.6, 0.5, 0)), {}


def through_its_own_foot() -> PlanCase:
    """Two links of one length fold over each other there."""
    return chain(2), in_the_plane((0.5, -0.2, 0), (0, 0, 0), (0.5, 0.2, 0), deviation=0.01), {}


def many_joints() -> PlanCase:
    return chain(8), in_the_plane((2.0, 0.1, 0), (1.6, 1.7, 0), speed=0.3), {}


def slide() -> PlanCase:
    robot = planar_chain([0.5, 0.4, 0.3], [1.0] * 3)
    first, *others = robot.joints
    rail = replace(first, kind="prismatic", axis=(0, 1, 0), lower=-1.0, upper=1.0)
    machine = FixedBase(replace(robot, joints=(rail, *others)))
    return machine, in_the_plane((0.7, -0.5, 0), (0.7, 0.6, 0), speed=0.2), {}


def kinova() -> PlanCase:
    package, ending, report = ROBOTS["anymal-kinova"]
    whole = Robot.from_urdf(urdf_file(package, ending), **report)
    machine = FixedBase(lock_joints(whole, {n: 0.0 for n in whole.joint_names if not n.startswith("j2s6")}))
    turn, at = pose(machine, (), [0.3, 2.5, 1.5, 0.4, 1.0, 0.2])
    corners = at, at + np.array([0.0, 0.1, 0.05]), at + np.array([0.05, 0.15, 0.0])
    return machine, TipTask.along(line(*corners), 0.05, steady=True, direction=turn[:, 2]), {}


def over_the_shoulder() -> PlanCase:
    return angled_ur5(), TipTask.along(line((0.4, 0, 0.5), (-0.4, 0, 0.5)), 0.1, steady=True, direction=DOWN), {}


def momentum_on_board() -> PlanCase:
    machine = floating_panda((0.05, -0.03, 0.04, 0.1, -0.2, 0.15))
    _, at = pose(machine, machine.base_home(), PANDA_START)
    return (
        machine,
        TipTask.along(line(at, at + np.array([0.05, -0.08, 0.06])), 0.05, steady=True),
        {"start": PANDA_START},
    )


def nothing_until_it_begins() -> PlanCase:
    task = TipTask.along(line((0.45, -0.1, 0.3), (0.45, 0.1, 0.3)), 0.1, steady=True, direction=DOWN, begin=2.0)
    return panda(), task, {"start": PANDA_START}


def rest_afterwards() -> PlanCase:
    task = TipTask.along(line((0.45, -0.1, 0.3), (0.45, 0.1, 0.3)), 0.1, steady=True, direction=DOWN)
    return panda(), task, {"horizon": 4.0}


def back_to_the_start_afterwards() -> PlanCase:
    machine, task, options = rest_afterwards()
    return machine, task, {**options, "cyclic": True}


def one_begins_while_another_goes_on() -> PlanCase:
    first = TipTask.along(line((0.45, -0.1, 0.3), (0.45, 0.1, 0.3)), 0.1, steady=True)
    return panda(), [first, TipTask(direction=DOWN, begin=1.0, duration=1.0)], {}


MOTIONS: list[Callable[[], PlanCase]] = [
    no_freedom_left,
    through_its_own_foot,
    many_joints,
    slide,
    kinova,
    over_the_shoulder,
    momentum_on_board,
    nothing_until_it_begins,
    rest_afterwards,
    back_to_the_start_afterwards,
    one_begins_while_another_goes_on,
]


@pytest.mark.parametrize("make", some(MOTIONS, 5))
def test_the_motion_passes_and_does_its_tasks(make: Callable[[], PlanCase]) -> None:
    machine, tasks, options = make()
    result = plan_bare(machine, tasks, search="start", **options)
    assert result.audit().passed
    for task in [tasks] if isinstance(tasks, TipTask) else tasks:
        times = np.linspace(task.begin, task.end, 401)[1:-1]
        at = result.at(times)
        errors = task_errors(machine, task, times, at["joints"], base=at.get("base"))
        assert np.linalg.norm(errors, axis=1).max() < 1e-6


@pytest.mark.parametrize("scale", [0.01, 40.0])
def test_a_plan_does_not_know_how_large_its_machine_is(scale: float) -> None:
    """Millimetres and cranes: all lengths and the speed times a number, joints as they were."""

    def moved(size: float) -> Plan:
        corners = size * np.array([(0.9, 0.1, 0), (0.6, 0.7, 0)])
        task = in_the_plane(*corners, speed=0.1 * size, deviation=0.005 * size)
        return plan_bare(chain(3, 0.5 * size), task, start=start, search="start")

    start = plan_bare(chain(3), in_the_plane((0.9, 0.1, 0), (0.6, 0.7, 0)), search="start")["joints"][0]
    one, other = moved(1.0), moved(scale)
    assert other.cost == pytest.approx(one.cost, rel=1e-6)
    np.testing.assert_allclose(other["joints"], one["joints"], atol=1e-6)


@pytest.mark.parametrize(
    "task",
    [
        TipTask(position=(0.5, 0.1, 0.4), duration=2.0),
        TipTask(direction=DOWN, duration=2.0),
        TipTask(direction=DOWN, rows=(), within=0.3, duration=2.0),
    ],
    ids=["a place", "an axis", "a lean"],
)
def test_rest_costs_zero(task: TipTask) -> None:
    result = plan_bare(panda(), task, search="start")
    assert result.audit().passed
    assert result.cost < 1e-12
    np.testing.assert_allclose(result["joints"], result["joints"][:1].repeat(len(result.t), axis=0), atol=1e-6)
    if task.within is not None:
        assert bind(panda(), task).cone_violations(result.t, None, result["joints"]).max() < 1e-6


def test_a_velocity_task_is_met_and_unneeded_joints_rest() -> None:
    """The last joint turns about the axis that the tip lies on: no velocity of the tip needs it."""
    request = TipTask(velocity=[0.05, 0.05, 0.0], rows=(3, 4, 5), duration=2.0)
    result = plan_bare(panda(), request, start=PANDA_START, search="start")
    assert result.audit().passed
    places = [numeric(panda().tip_pose((), q).position).ravel() for q in result.at([0.0, 1.0, 2.0])["joints"]]
    np.testing.assert_allclose(np.diff(places, axis=0), [[0.05, 0.05, 0.0]] * 2, atol=1e-6)
    np.testing.assert_allclose(result["joints"][:, 6], PANDA_START[6], atol=1e-9)


def moved_by_a_velocity() -> TipTask:
    return TipTask(velocity=[0.05, 0.05, 0.0], rows=(3, 4, 5), duration=2.0)


def moved_by_a_pose() -> TipTask:
    _, at = pose(panda(), (), PANDA_START)
    return TipTask(position=lambda t: ca.DM(at) + t * ca.DM([0.05, 0.05, 0.0]), duration=2.0)


@pytest.mark.long
@pytest.mark.parametrize("first", [moved_by_a_velocity, pytest.param(moved_by_a_pose, marks=pytest.mark.long)])
@pytest.mark.parametrize("rows", [(3, 4, 5), (3,), ()], ids=["the place", "one coordinate", "nothing"])
def test_holding_the_goal_costs_zero(first: Callable[[], TipTask], rows: tuple[int, ...]) -> None:
    """That the tip begins where it is held follows from what it did before: it is not asked twice."""
    _, at = pose(panda(), (), PANDA_START)
    still = [TipTask(position=at + np.array([0.1, 0.1, 0.0]), rows=rows, begin=2.0, duration=2.0)] if rows else []
    result = plan_bare(panda(), [first(), *still], 4.0, start=PANDA_START, search="start")
    assert result.audit().passed
    alone = plan_bare(panda(), first(), start=PANDA_START, search="start")
    assert result.cost == pytest.approx(alone.cost, rel=1e-6)
    np.testing.assert_allclose(result.at(4.0)["joints"], alone["joints"][-1], atol=1e-5)


@pytest.mark.long
def test_two_that_follow_each_other_with_a_rest_between_them_are_one_after_the_other() -> None:
    """A place held, a velocity, and the place it leads to: the cost is that of the velocity alone, from its start."""
    _, at = pose(panda(), (), PANDA_START)
    shift = np.array([0.1, 0.1, 0.0])
    before, after = (TipTask(position=p, duration=1.0) for p in (at, at + shift))
    tasks = [before, replace(moved_by_a_velocity(), begin=1.0), replace(after, begin=3.0)]
    result = plan_bare(panda(), tasks, start=PANDA_START, search="start")
    assert result.audit().passed
    tips = [numeric(panda().tip_pose((), q).position).ravel() for q in result.at([1.0, 3.0, 4.0])["joints"]]
    np.testing.assert_allclose(tips, [at, at + shift, at + shift], atol=1e-6)
    assert result.cost < plan_bare(panda(), moved_by_a_velocity(), start=PANDA_START, search="start").cost


@pytest.mark.long
def test_a_pose_unreachable_from_its_predecessor_is_refused_by_name() -> None:
    _, at = pose(panda(), (), PANDA_START)
    off = TipTask(position=at + np.array([0.1, 0.12, 0.0]), begin=2.0, duration=2.0)
    with pytest.raises(SolveError, match="task position 2") as caught:
        plan_bare(panda(), [moved_by_a_velocity(), off], start=PANDA_START, search="start")
    assert caught.value.name


@pytest.mark.parametrize(
    "root", [TipTask(link="panda_link0", position=(0, 0, 0)), TipTask(link="panda_link0", velocity=[0.0], rows=(2,))]
)
def test_to_hold_a_root_that_nothing_moves_is_refused(root: TipTask) -> None:
    with pytest.raises(ProblemError, match="no joint moves") as caught:
        plan_bare(panda(), [replace(moved_by_a_pose()), root], start=PANDA_START)
    assert caught.value.name == "rows"
