"""Joints along a path from a plan: derivatives, order of the spline, torques, and schedules of any machine."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path as File
from types import SimpleNamespace
from typing import Any

import casadi as ca
import numpy as np
import pytest

from models import FixedBase, FreeFloating, Joint, Link, Path, Robot, SmoothPath, smooth
from models.robot.dynamics import inverse_dynamics
from ocp import Collocation, Goal, Plan, ProblemError, TipTask, joint_path, minimum_velocity_problem, plan, solve
from ocp.motion.builders.joint_spline import PlannedJoints
from ocp.motion.result.solved_plan import SolvedPlan
from ocp.motion.schedule import JointLimits, LineLimits, schedule
from tests.ocp.motion.schedule.check import dense, largest
from tests.ocp.problems import Array

REACH = 0.4
PATH = smooth(Path.through([(0.3, 0.0, 0.1), (0.5, 0.0, 0.3), (0.5, 0.0, 0.5)]), 0.05)


def arm() -> FixedBase:
    """Two rods in the x-z plane, under gravity."""
    links, joints = [Link("base", 1.0)], []
    for i in range(2):
        moment = 2.0 * REACH**2 / 12
        links.append(Link(f"rod{i}", 2.0, center_of_mass=(REACH / 2, 0, 0), inertia=np.diag([0, moment, moment])))
        mount = (REACH * i, 0.0, 0.0)
        joints.append(Joint(f"joint{i}", "revolute", links[-2].name, links[-1].name, mount, axis=(0, -1, 0)))
    return FixedBase(Robot(tuple(links), tuple(joints), tip_translation=(REACH, 0, 0)))


def angles(s: Array, path: SmoothPath = PATH) -> Array:
    """Of both joints, in closed form."""
    x, _, z = path.at(s).position.T
    elbow = -np.arccos((x**2 + z**2 - 2 * REACH**2) / (2 * REACH**2))
    return np.stack(
        [np.arctan2(z, x) - np.arctan2(REACH * np.sin(elbow), REACH + REACH * np.cos(elbow)), elbow], axis=1
    )


def sampled(count: int = 400) -> PlannedJoints:
    s = np.linspace(0, PATH.length, count)
    return joint_path(arm(), (s, angles(s)), PATH)


def test_the_tip_runs_along_the_path_and_the_derivatives_are_those_of_the_joints() -> None:
    joints = sampled()
    s, h = np.linspace(0.01, PATH.length - 0.01, 50), 1e-5
    along = joints.at(s)
    for q, place in zip(along.position, PATH.at(s).position, strict=True):
        assert np.array(arm().tip_pose((), q).position).ravel() == pytest.approx(place, abs=1e-6)
    before, after = joints.at(s - h), joints.at(s + h)
    for order in range(3):
        slope = (after[order] - before[order]) / (2 * h)
        assert slope == pytest.approx(along[order + 1], rel=1e-4, abs=1e-4 * np.abs(along[order + 1]).max())


def test_the_error_is_stated_and_falls_with_more_samples() -> None:
    few, many = sampled(100), sampled(800)
    fine = np.linspace(0, PATH.length, 3001)
    for joints in (few, many):
        assert np.abs(joints.at(fine).position - angles(fine)).max() <= joints.error
    assert many.error < few.error / 16


def test_samples_at_random_distances_are_interpolated_as_well() -> None:
    inside = np.random.default_rng(0).uniform(0, PATH.length, 1000)
    s = np.concatenate([[0.0], np.sort(inside), [PATH.length]])
    joints, fine = joint_path(arm(), (s, angles(s)), PATH), np.linspace(0, PATH.length, 3001)
    assert np.abs(joints.at(fine).position - angles(fine)).max() < 1e-6


def test_the_torque_is_a_linear_form_of_acceleration_and_squared_speed() -> None:
    machine, joints, s = arm(), sampled(), np.linspace(0, PATH.length, 20)
    along, torque = joints.at(s), joints.torques(s)
    rng = np.random.default_rng(1)
    for k, (v, a) in enumerate(rng.normal(size=(20, 2))):
        rate, acceleration = along.first[k] * v, along.second[k] * v**2 + along.first[k] * a
        whole = inverse_dynamics(machine.robot, *(ca.DM(x) for x in (along.position[k], rate, acceleration)))
        result = torque.inertia[k] * a + torque.drag[k] * v**2 + torque.rest[k]
        assert result == pytest.approx(np.array(whole).ravel(), abs=1e-9)


@pytest.mark.parametrize("jerk", [100.0, np.inf])
def test_a_schedule_keeps_the_torques_and_uses_them(jerk: float) -> None:
    joints, most = sampled(), np.array([8.4, 5.0])
    limits = LineLimits(1.0, 8.0, jerk, joints=JointLimits(6.0, 40.0, 800.0 if jerk < np.inf else np.inf, most))
    plan = schedule(PATH, limits, joints=joints)
    motion = dense(plan)
    torque = joints.torques(motion.distance)
    used = torque.inertia * motion.acceleration[:, None] + torque.drag * motion.speed[:, None] ** 2 + torque.rest
    assert 0.97 < np.abs(used / most).max() <= 1.001
    assert largest(plan, joints)[:2].max() <= 1.001
    with pytest.raises(ProblemError, match=r"joint 'joint0' torque does not hold the load at 0\.4"):
        schedule(PATH, LineLimits(1.0, 8.0, jerk, joints=JointLimits(torque=[5.0, 5.0])), joints=joints)


LINE = smooth(Path.through([(0.4, 0.0, 0.2), (0.5, 0.0, 0.35)]), 0.05)
SPEED = LINE.length / 2.0


def planned(tasks: TipTask | Sequence[Any], path: SmoothPath = LINE, **options: Any) -> Plan:
    return plan(arm(), tasks, start=angles(np.zeros(1), path)[0], scene=False, **options)


def halves() -> list[TipTask]:
    """The line in two tasks, one after the other."""
    middle = (0.45, 0.0, 0.275)
    ends = [(0.4, 0.0, 0.2), middle], [middle, (0.5, 0.0, 0.35)]
    lines = [smooth(Path.through(pair), 0.05) for pair in ends]
    return [
        TipTask.along(line, SPEED, steady=True, rows=(3, 5), begin=begin)
        for line, begin in zip(lines, (0.0, 1.0), strict=True)
    ]


@pytest.mark.parametrize("kind", ["one task", "from rest", "parts", "free horizon", "corner", "loaded"])
def test_a_plan_of_tasks_along_a_path_is_scheduled(kind: str, tmp_path: File) -> None:
    path = PATH if kind == "corner" else LINE
    task = TipTask.along(path, SPEED, steady=kind != "from rest", rows=(3, 5))
    result = planned(
        halves() if kind == "parts" else task, path, **({"horizon": "free"} if kind == "free horizon" else {})
    )
    if kind == "loaded":
        result.save(tmp_path / "plan.npz")
        result = Plan.load(tmp_path / "plan.npz")
    assert isinstance(result, SolvedPlan)
    assert len(result.parts) == (2 if kind == "parts" else 1)
    joints = joint_path(arm(), result, path)
    s = np.linspace(0, path.length, 50)
    assert joints.at(s).position == pytest.approx(angles(s, path), abs=1e-6)
    timed = schedule(path, LineLimits(0.5, 4.0, 100.0, joints=JointLimits(1.0, 5.0, 100.0)), joints=joints)
    assert timed.duration < result.horizon
    assert largest(timed, joints).max() <= 1.001


def test_a_plan_of_several_motions_is_refused() -> None:
    task = TipTask.along(LINE, SPEED, rows=(3, 5))
    whole = planned([task, Goal(joints=angles(np.zeros(1), LINE)[0])])
    with pytest.raises(ProblemError, match="several motions") as caught:
        joint_path(arm(), whole, LINE)
    assert caught.value.name == "plan"


def test_a_plan_whose_tasks_do_not_run_along_the_path_is_refused() -> None:
    later = TipTask.along(LINE, SPEED, steady=True, rows=(3, 5), begin=0.5)
    held = TipTask(position=(0.4, 0.0, 0.2), rows=(3, 5), duration=0.5)
    for tasks, path, words in (
        (TipTask.along(LINE, SPEED, steady=True, rows=(3, 5)), PATH, r"m off the path at"),
        ([held, later], LINE, "stand still"),
        (later, LINE, "have no position at 0 s"),
    ):
        with pytest.raises(ProblemError, match=words) as caught:
            joint_path(arm(), planned(tasks), path)
        assert caught.value.name == "plan"


def test_a_solution_at_constant_speed_is_scheduled() -> None:
    path, horizon = LINE, 2.0
    velocity = (np.array([0.5, 0.35]) - [0.4, 0.2]) / horizon
    start = angles(np.zeros(1), path)[0]
    problem = minimum_velocity_problem(
        arm(), tasks=TipTask(rows=(3, 5), velocity=velocity), start=start, horizon=horizon
    )
    solution = solve(problem, Collocation(intervals=20, degree=4))
    joints = joint_path(arm(), solution, path)
    s = np.linspace(0, path.length, 30)
    assert joints.at(s).position == pytest.approx(angles(s, path), abs=1e-6)
    timed = schedule(path, LineLimits(0.5, 4.0, 100.0, joints=JointLimits(1.0, 5.0, 100.0)), joints=joints)
    assert largest(timed, joints).max() <= 1.001


@pytest.mark.parametrize(
    ("plan", "words"),
    [
        ((np.linspace(0, 1, 50), np.zeros((50, 2))), "from 0 to"),
        ((np.linspace(0, PATH.length, 50), np.zeros((50, 3))), "shapes"),
        ((np.linspace(0, PATH.length, 5), np.zeros((5, 2))), "at least 13"),
        ((np.zeros(50), np.zeros((50, 2))), "increasing"),
        ((np.linspace(0, PATH.length, 50), np.full((50, 2), np.nan)), "finite"),
        ("plan", "plan"),
    ],
)
def test_samples_that_are_none_are_named_errors(plan: Any, words: str) -> None:
    with pytest.raises(ProblemError, match=words) as caught:
        joint_path(arm(), plan, PATH)
    assert caught.value.name == "plan"


@pytest.mark.parametrize("path", ["path", SimpleNamespace(length=PATH.length), SimpleNamespace(bounds=PATH.bounds)])
def test_a_path_without_length_or_bounds_is_a_named_error(path: Any) -> None:
    s = np.linspace(0, PATH.length, 50)
    with pytest.raises(ProblemError, match="has no length, or no bounds") as caught:
        joint_path(arm(), (s, angles(s)), path)
    assert caught.value.name == "path"


def test_torques_need_a_fixed_base() -> None:
    s = np.linspace(0, PATH.length, 50)
    floating = joint_path(FreeFloating(arm().robot, base="spatial"), (s, angles(s)), PATH)
    with pytest.raises(ProblemError, match="need a FixedBase"):
        floating.torques(s)
    for wrong in (np.nan, 9.0, "x"):
        with pytest.raises(ProblemError, match="distance"):
            floating.at(wrong)
