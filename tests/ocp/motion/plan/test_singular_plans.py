"""Motions through singular configurations, the end of the reach, and the reasons of refusals."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import casadi as ca
import numpy as np
import pytest

from models import FixedBase, planar_chain
from models.checks import Array
from ocp import IkOptions, SolveError, TipTask, Unreachable, inverse_kinematics, plan
from ocp.errors import ProblemError
from ocp.motion.builders.tool_motion import ERRORS
from ocp.motion.result.solved_plan import SolvedPlan
from ocp.motion.tasks.checks import CHECKS, clip_to_limits
from ocp.motion.tasks.equations import bind
from tests.families import some
from tests.ocp.motion.plan.motions import plan_bare
from tests.sweep.global_plans import random_task
from tests.sweep.singular import PERTURBED, Motion, damped_cost, machine, motions, result

DAILY = (
    Motion("ur5", "straight", "in", False, 3.0),
    Motion("ur5", "elbow", "both", False, 3.0),
    Motion("panda", "wrist", "out", True, 3.0),
)


@pytest.mark.parametrize("motion", some([*motions()], DAILY), ids=lambda motion: motion.name)
def test_singular_motions_cost_no_more_than_damped_ones_and_the_same_if_moved_by_rounding(motion: Motion) -> None:
    row = result(motion, 2 if motion in DAILY else PERTURBED)
    assert row["wrong"] == []
    if motion in DAILY:
        assert "damped" in row


@pytest.mark.long
def test_damped_least_squares_does_at_least_forty_of_the_motions() -> None:
    assert sum(np.isfinite(damped_cost(motion)) for motion in motions()) >= 40


def test_a_relaxed_motion_does_its_task_within_the_bound() -> None:
    """|S|^2 / 2 integrates to no more than the cost of a motion that does the task, here that of the plan itself."""
    motion = Motion("ur5", "straight", "in", False, 3.0)
    task = motion.task(motion.joints, motion.displacement)
    instance = plan_bare(machine("ur5"), task, start=motion.joints)
    assert ERRORS in instance.solution.controls
    t = np.linspace(0.0, 3.0, 101)
    errors = bind(machine("ur5"), task).errors(t, None, instance.at(t)["joints"])
    assert np.abs(errors).max() <= 1e-5 * np.sqrt(2 * instance.cost * 3.0)
    assert np.abs(errors).max() < 1e-7


def cost_of_rates(motion: SolvedPlan) -> float:
    """The integral of half the squared joint rates."""
    points, weights = np.polynomial.legendre.leggauss(6)
    ends = np.unique(motion.t)
    t = ends[:-1, None] + np.diff(ends)[:, None] * (points + 1) / 2
    squares = (motion.at(t.ravel())["rates"] ** 2).sum(axis=1).reshape(t.shape)
    return float(np.diff(ends) @ squares @ weights) / 4


def test_the_cost_of_a_plan_does_not_contain_deviations_from_relaxed_tasks() -> None:
    motion = Motion("ur5", "straight", "in", False, 3.0)
    task = motion.task(motion.joints, motion.displacement)
    instance = plan_bare(machine("ur5"), task, start=motion.joints)
    assert instance.cost == pytest.approx(cost_of_rates(instance), rel=1e-9)
    assert instance.cost < instance.solution.cost
    assert next(each for each in instance.candidates if each.passed).cost == instance.cost


@pytest.mark.long
def test_the_cost_of_a_plan_at_its_velocity_limits_is_that_of_its_rates() -> None:
    """The limits are so low that the tasks can only be done with a deviation, within their tolerance."""
    arm, task = random_task("slow", 86)
    result = plan(arm, task, search="global", scene=False)
    assert isinstance(result, SolvedPlan)
    assert result.cost == pytest.approx(cost_of_rates(result), rel=1e-6)
    assert result.solution.cost > 100 * result.cost


@pytest.mark.long
def test_a_free_start_at_a_singularity_is_planned() -> None:
    """The tool points along the plane's normal, the wrist is singular all along."""
    motion = Motion("ur5", "straight", "in", True, 3.0)
    task = motion.task(motion.joints, motion.displacement)
    fixed = plan_bare(machine("ur5"), task, start=motion.joints)
    free = plan_bare(machine("ur5"), task)
    assert free.audit().passed
    assert free.cost <= fixed.cost * (1 + 1e-6)


# ---- the end of the reach --------------------------------------------------------------------------------------------


def leaving(arm: str, start: Array, displacement: Any, held: bool) -> TipTask:
    motion = Motion(arm, "wrist", "in", held, 2.0)
    return motion.task(np.asarray(start), np.asarray(displacement, dtype=float))


OUTWARDS = [
    ("ur5", (0.3, -1.2, 1.5, -0.9, 0.5, 0.4), (0.8, 0.2, 0.3), True),
    ("panda", (0.3, -0.5, 0.0, -1.8, 0.4, 1.2, 0.3), (0.8, 0.0, 0.0), False),
]


@pytest.mark.long
@pytest.mark.parametrize(("arm", "start", "displacement", "held"), OUTWARDS, ids=["ur5", "panda"])
def test_the_end_of_the_reach_is_the_one_of_a_dense_sweep_for_every_search(
    arm: str, start: Any, displacement: Any, held: bool
) -> None:
    """Inverse kinematics from many starts finds poses right before the end, and none right behind it."""
    task, ends = leaving(arm, start, displacement, held), list[float]()
    searches: tuple[dict[str, Any], ...] = (
        {"start": np.array(start)},
        {"start": np.array(start), "search": "global"},
        {},
    )
    for searche in searches:
        with pytest.raises(Unreachable, match="the reach ends") as caught:
            plan_bare(machine(arm), task, **searche)
        outcome = caught.value
        assert outcome.time is not None
        assert outcome.distance > 0
        assert np.isfinite(outcome.angle)
        ends.append(outcome.time)
    assert np.ptp(ends) < 1e-4
    options: dict[str, Any] = {"near": outcome.joints, "starts": 256, "options": IkOptions(tolerance=1e-6)}
    for time in outcome.time - np.geomspace(1e-3, 0.3, 5):
        assert inverse_kinematics(machine(arm), task, time=float(time), **options)
    for time in outcome.time + np.geomspace(1e-3, 0.1, 5):
        with pytest.raises(Unreachable):
            inverse_kinematics(machine(arm), task, time=float(time), **options)


def test_a_joint_at_its_limit_ends_the_reach_where_it_says() -> None:
    """Two links whose elbow bends by half a radian at least reach |l1 + l2 exp(i/2)|, a closed form."""
    robot = planar_chain([1.0, 0.8], [1.0, 1.0])
    shoulder, elbow = robot.joints
    perturbed = FixedBase(replace(robot, joints=(shoulder, replace(elbow, lower=0.5, upper=2.5))))
    task = TipTask(
        position=lambda t: np.array([1.0, 0.2, 0.0]) + t * np.array([1.0, 0.0, 0.0]), rows=(3, 4), duration=1.0
    )
    farthest = np.sqrt(1.0 + 0.64 + 1.6 * np.cos(0.5))
    with pytest.raises(Unreachable, match=f"'{elbow.name}' is at its limit 0.5 rad") as caught:
        plan_bare(perturbed, task)
    assert caught.value.time == pytest.approx(np.sqrt(farthest**2 - 0.04) - 1.0, abs=1e-5)
    assert (caught.value.name, caught.value.limit) == (elbow.name, 0.5)
    assert caught.value.angle == 0.0


def turning(angle: float, duration: float) -> TipTask:
    """A panda's tool that turns about itself, its axis and position held, from a comfortable configuration."""
    joints = np.array([0.3, -0.5, 0.0, -1.8, 0.4, 1.6, 0.3])
    pose = machine("panda").tip_pose(np.zeros(0), joints)
    position, rotation = np.array(pose.position).ravel(), np.array(pose.rotation)

    def orientation(t: Any) -> Any:
        c, s = ca.cos(angle * t / duration), ca.sin(angle * t / duration)
        turned = ca.vertcat(ca.horzcat(c, -s, 0), ca.horzcat(s, c, 0), ca.horzcat(0, 0, 1))
        return ca.mtimes(ca.DM(rotation), turned)

    return TipTask(position=position, orientation=orientation, duration=duration)


# ---- reasons ---------------------------------------------------------------------------------------------------------


@pytest.mark.long
@pytest.mark.parametrize(
    ("angle", "duration"), [(np.radians(170), 0.4), pytest.param(np.radians(100), 0.2, marks=pytest.mark.long)]
)
def test_a_tool_that_turns_too_fast_names_joint_time_and_limit(angle: float, duration: float) -> None:
    with pytest.raises(SolveError) as caught:
        plan_bare(machine("panda"), turning(angle, duration), search="start")
    outcome, robot = caught.value, machine("panda").robot
    assert outcome.name in robot.joint_names
    assert outcome.limit is not None
    assert outcome.time is not None
    assert 0 <= outcome.time <= duration
    assert "Exceeded" not in str(outcome)
    assert "max_iter" not in str(outcome)


@pytest.mark.parametrize("bound", [(-2.0, 2.0), (-0.0175, 3.7525), (-np.inf, 0.5), (0.0, 0.04)])
def test_values_beyond_a_limit_by_rounding_are_clipped_and_others_named(bound: tuple[float, float]) -> None:
    low, high = np.array([bound[0]]), np.array([bound[1]])
    size = bound[1] - bound[0] if np.isfinite(bound[0]) else 1.0
    pendulum = FixedBase(planar_chain([1.0], [1.0]))
    assert clip_to_limits(pendulum, high + 0.5 * CHECKS.rounding * size, low, high, label="start")[0] == bound[1]
    with pytest.raises(ProblemError, match="'joint1' starts at") as caught:
        clip_to_limits(pendulum, high + 3 * CHECKS.rounding * size, low, high, label="start")
    shown = str(caught.value).split("starts at ")[1].split(",")[0]
    assert shown != f"{bound[1]:.6g}"
