"""Motions of several phases through `plan`: goals one after the other, steps, captures, and their files."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path

import casadi as ca
import numpy as np
import pytest

from models import FixedBase, Machine, planar_chain, with_load
from ocp import Cost, FreeTime, Goal, Limits, Plan, ProblemError, TipTask, Unreachable, Waypoints, plan
from ocp.motion.builders.space.capture import Capture
from ocp.motion.result.solved_plan import PhasedPlan
from scripts.robots.steps import crouched, planar_steps
from tests.ocp.motion.builders.bipeds import FRICTION
from tests.ocp.motion.builders.captures import planar_capture

MACHINE, START = FixedBase(planar_chain([0.5, 0.4], [2.0, 1.5])), np.array([0.2, 0.5])
COST = Cost(velocity=0.0, effort=1.0, acceleration=0.1)
GOALS = (Goal(joints=[1.2, -0.4], duration=1.0, velocity="free"), Goal(joints=[0.2, 0.5], duration=1.5))


def same(plan_: Plan, again: Plan) -> None:
    """Two plans have the same motion and the same audit."""
    times = np.linspace(0.0, plan_.horizon, 37)
    for name in ("joints", "rates"):
        np.testing.assert_array_equal(plan_.at(times)[name], again.at(times)[name])
    np.testing.assert_array_equal(plan_.sampled(times).tip, again.sampled(times).tip)
    findings = [(finding.name, finding.value) for finding in again.audit().findings]
    for (name, value), finding in zip(findings, plan_.audit().findings, strict=True):
        assert name == finding.name
        assert value == pytest.approx(finding.value, rel=1e-9, abs=1e-12)


@cache
def two_goals() -> PhasedPlan:
    planned = plan(MACHINE, GOALS, start=START, cost=COST, scene=False)
    assert isinstance(planned, PhasedPlan)
    return planned


def test_goals_are_reached_at_their_times_and_passed_where_they_are_free() -> None:
    planned = two_goals()
    assert planned.audit().passed
    assert planned.horizon == pytest.approx(2.5)
    assert planned.at(1.0)["joints"] == pytest.approx([1.2, -0.4], abs=1e-9)
    assert planned.at(2.5)["joints"] == pytest.approx([0.2, 0.5], abs=1e-9)
    assert np.abs(planned.at(1.0)["rates"]).max() > 0.1
    assert planned.at([0.0, 2.5])["rates"] == pytest.approx(0.0, abs=1e-9)


def test_rates_and_accelerations_of_all_phases_are_derivatives_of_the_joints() -> None:
    planned, step = two_goals(), 1e-5
    times = np.array([0.2, 0.7, 1.3, 2.2])
    difference = (planned.at(times + step)["joints"] - planned.at(times - step)["joints"]) / (2 * step)
    assert planned.at(times)["rates"] == pytest.approx(difference, abs=1e-6)
    difference = (planned.at(times + step)["rates"] - planned.at(times - step)["rates"]) / (2 * step)
    assert planned.sampled(times).accelerations == pytest.approx(difference, abs=1e-5)


def test_an_intermediate_stop_costs_more_and_a_shared_time_less() -> None:
    """Goals with free durations of the same total may be reached at better times."""
    stopping = plan(MACHINE, [replace(GOALS[0], velocity="rest"), GOALS[1]], start=START, cost=COST, scene=False)
    assert stopping.cost > two_goals().cost * (1 + 1e-3)
    free = [replace(goal, duration=FreeTime(0.3, 2.4, goal.duration)) for goal in GOALS]
    shared = plan(MACHINE, free, 2.5, start=START, cost=COST, scene=False)
    assert shared.horizon == pytest.approx(2.5)
    assert shared.cost < two_goals().cost * (1 - 1e-4)


def test_the_motion_backwards_costs_the_same_without_gravity_and_friction() -> None:
    """The planar arm moves across gravity: its dynamics are reversible."""
    back = [replace(GOALS[0], duration=1.5), Goal(joints=START, duration=1.0)]
    planned = plan(MACHINE, back, start=GOALS[1].joints, cost=COST, scene=False)
    assert planned.cost == pytest.approx(two_goals().cost, rel=1e-4)


def test_a_pose_is_reached_in_the_configuration_nearest_to_the_goal_before() -> None:
    end = np.array([1.2, -0.4])
    pose = MACHINE.tip_pose((), end)
    tip = TipTask(position=np.array(ca.DM(pose.position)).ravel(), rows=(3, 4))
    goal = Goal(position=tip.position, duration=1.0)
    planned = plan(MACHINE, [goal], start=end + 0.1, cost=COST, scene=False)
    reached = np.array(ca.DM(MACHINE.tip_pose((), planned.at(1.0)["joints"]).position)).ravel()
    assert reached == pytest.approx(np.asarray(tip.position), abs=1e-6)
    assert planned.at(1.0)["joints"] == pytest.approx(end, abs=1e-5)
    with pytest.raises(Unreachable):
        plan(MACHINE, [replace(goal, position=[9.0, 0.0, 0.0])], start=end, cost=COST, scene=False)


def test_a_load_is_carried_in_its_own_phase(tmp_path: Path) -> None:
    loaded = replace(MACHINE, robot=with_load(MACHINE.robot, MACHINE.robot.tip_link, 3.0))
    goals = [Goal(joints=[1.2, -0.4], duration=1.0), Goal(joints=[0.2, 0.5], duration=1.5, machine=loaded)]
    planned = plan(MACHINE, goals, start=START, cost=COST, scene=False)
    assert isinstance(planned, PhasedPlan)
    assert planned.machines[1].robot.total_mass == pytest.approx(MACHINE.robot.total_mass + 3.0)
    heavy = plan(loaded, goals, start=START, cost=COST, scene=False)
    assert heavy.cost > planned.cost
    planned.save(tmp_path / "plan.npz")
    again = Plan.load(tmp_path / "plan.npz")
    assert isinstance(again, PhasedPlan)
    assert again.machines[1].robot.total_mass == planned.machines[1].robot.total_mass
    same(planned, again)


@pytest.mark.long
def test_steps_are_planned_and_read_again_with_their_stances(tmp_path: Path) -> None:
    steps = replace(planar_steps(1, 0.8, 0.8), margin=0.01)
    stance = steps.stances[0]
    start = crouched(steps)[steps.order(stance)]
    planned = plan(stance, steps, start=start, limits=Limits(friction=FRICTION))
    assert planned.audit().feasible
    assert isinstance(planned, PhasedPlan)
    assert planned.phases == steps.names
    ends = [planned.at(part.end)["joints"] for part in planned.parts]
    for end, machine in zip(ends[1:], planned.machines[1:], strict=False):
        order = [planned.names.index(name) for name in machine.robot.joint_names]
        assert set(order) == set(range(len(planned.names)))
        assert np.isfinite(end[order]).all()
    planned.save(tmp_path / "steps.npz")
    same(planned, Plan.load(tmp_path / "steps.npz"))


@pytest.mark.long
def test_joints_of_all_stances_are_continuous_in_one_order() -> None:
    """The stances are rooted at different feet; in the order of the first one no joint jumps."""
    steps = replace(planar_steps(1, 0.8, 0.8), margin=0.01)
    start = crouched(steps)[steps.order(steps.stances[0])]
    planned = plan(steps.stances[0], steps, start=start, limits=Limits(friction=FRICTION))
    assert isinstance(planned, PhasedPlan)
    for part in planned.parts[:-1]:
        before, after = planned.at([part.end - 1e-7, part.end + 1e-7])["joints"]
        assert before == pytest.approx(after, abs=1e-5)


def test_a_capture_is_planned_and_read_again(tmp_path: Path) -> None:
    request = planar_capture()
    names = ("target", "target_base", "cone", "grasp")
    capture = Capture(approach=5.0, detumble=5.0, **{name: request[name] for name in names})
    planned = plan(request["chaser"], capture, start=request["start"], cost=request["cost"], scene=False)
    assert planned.audit().passed
    assert planned.horizon == pytest.approx(10.0)
    assert planned["base"].shape[1] == 3
    planned.save(tmp_path / "capture.npz")
    same(planned, Plan.load(tmp_path / "capture.npz"))


def other_machine() -> Machine:
    return FixedBase(MACHINE.robot, (1.0, 0.0, 0.0))


@pytest.mark.parametrize(
    ("arguments", "name", "words"),
    [
        ({"tasks": list(GOALS)}, "start", "start is missing"),
        ({"tasks": [GOALS[0], Goal(joints=[1.0, 0.0])], "start": START}, "duration", "needs a duration"),
        ({"tasks": [GOALS[0], replace(GOALS[1], joints=[9.0])], "start": START}, None, "2 numbers"),
        ({"tasks": list(GOALS), "start": START, "cyclic": True}, "cyclic", "takes no cyclic"),
        ({"tasks": planar_steps(1, 0.8, 0.8), "start": START}, "machine", "first stance"),
        ({"tasks": Waypoints(np.zeros((2, 3)), np.ones((2, 4))), "start": START}, "start", "takes no start"),
        (
            {"tasks": [GOALS[0], TipTask(rows=(3,), velocity=[0.1])], "start": START},
            "horizon",
            "task 2: horizon is missing",
        ),
    ],
)
def test_arguments_that_do_not_fit_are_named(arguments: dict[str, object], name: str | None, words: str) -> None:
    with pytest.raises(ProblemError, match=words) as caught:
        plan(MACHINE, scene=False, **arguments)  # type: ignore[arg-type]
    assert name is None or caught.value.name == name
