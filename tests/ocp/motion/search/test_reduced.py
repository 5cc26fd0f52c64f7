"""Kinematics of tasks in scaled joint rates: projections, steps along a task, and the correction of pose errors."""

from __future__ import annotations

import numpy as np
import pytest

from models import FixedBase, FreeFloating, example_robot
from ocp import TipTask
from ocp.motion.search.reduced import ReducedKinematics
from ocp.motion.tasks.equations import bind
from tests.models.robot.trees import numeric
from tests.ocp.problems import Array

ARM = FixedBase(example_robot("seven_axis"))
JOINTS = np.array([0.2, 0.5, -0.3, -1.4, 0.3, 1.1, 0.1])
WEIGHTS = np.array([1.0, 2.0, 1.0, 0.5, 1.0, 3.0, 1.0])


def line_task(velocity: Array) -> TipTask:
    tip = ARM.tip_pose((), JOINTS)
    place, turn = numeric(tip.position).ravel(), numeric(tip.rotation)
    return TipTask(position=lambda t: place + velocity * t, orientation=turn)


def kinematics(velocity: Array) -> ReducedKinematics:
    return ReducedKinematics(ARM, bind(ARM, line_task(velocity)), WEIGHTS)


def states(count: int, size: float) -> tuple[Array, Array]:
    """Return base coordinates and joint positions near the start of the task."""
    rng = np.random.default_rng(count)
    return np.zeros((count, 0)), JOINTS + size * rng.normal(size=(count, 7))


def test_rates_are_those_of_the_tasks_and_of_their_null_space() -> None:
    task = kinematics(np.zeros(3)).at(*states(5, 0.3), 0.0)
    rng = np.random.default_rng(1)
    required, rates = rng.normal(size=(5, 6)), rng.normal(size=(5, 7))
    least = task.least_rates(required)
    np.testing.assert_allclose(task.task_rates(least), required, atol=1e-9)
    free = task.null_rates(rates)
    np.testing.assert_allclose(task.task_rates(free), 0.0, atol=1e-9)
    np.testing.assert_allclose((least * free).sum(axis=1), 0.0, atol=1e-9)
    np.testing.assert_allclose(task.task_rates(rates - free), task.task_rates(rates), atol=1e-9)


@pytest.mark.parametrize("tolerance", [1e-4, 1e-10])
def test_pose_errors_are_corrected_to_the_tolerance_and_reported(tolerance: float) -> None:
    own = kinematics(np.zeros(3))
    base, joints = states(20, 0.02)
    before = np.abs(own.at(base, joints, 0.0).error).max(axis=1)
    assert before.min() > 1e-3
    _, corrected, reported = own.correct_poses(base, joints, 0.0, tolerance, max_steps=8)
    assert reported.max() <= tolerance
    np.testing.assert_allclose(reported, np.abs(own.at(base, corrected, 0.0).error).max(axis=1), atol=1e-15)
    moved = (corrected - joints) * own.root
    along_null = own.at(base, corrected, 0.0).null_rates(moved)
    assert np.linalg.norm(along_null, axis=1).max() < 0.1 * np.linalg.norm(moved, axis=1).min()


def test_a_bounded_number_of_corrections_is_made() -> None:
    own = kinematics(np.zeros(3))
    base, joints = states(20, 0.05)
    errors = []
    for steps in range(4):
        _, corrected, reported = own.correct_poses(base, joints, 0.0, 0.0, max_steps=steps)
        np.testing.assert_allclose(reported, np.abs(own.at(base, corrected, 0.0).error).max(axis=1), atol=1e-15)
        assert steps or (corrected == joints).all()
        errors.append(reported.max())
    assert errors[3] < 1e-2 * errors[0]


def test_a_step_follows_the_task_and_adds_self_motion() -> None:
    velocity = np.array([0.1, -0.05, 0.08])
    own = kinematics(velocity)
    base, joints = np.zeros((1, 0)), JOINTS[None]
    for duration in (0.2, 0.1):
        task = own.at(base, joints, 0.0)
        rates = task.least_rates(task.right) + task.null_rates(np.full((1, 7), 0.3))
        _, after, reported = own.step(base, joints, task, rates, interval=(0.0, duration), tolerance=1e-9)
        start, tip = (numeric(ARM.tip_pose((), each).position).ravel() for each in (JOINTS, after[0]))
        np.testing.assert_allclose(tip, start + velocity * duration, atol=1e-8)
        assert reported.max() <= 1e-9
        self_motion = task.null_rates((after - joints) * own.root / duration)
        assert np.abs(self_motion - task.null_rates(rates)).max() < 0.5 * duration


def test_the_base_of_a_floating_arm_moves_with_its_joints() -> None:
    machine = FreeFloating(example_robot("six_axis"))
    own = ReducedKinematics(machine, None, np.ones(6))
    rng = np.random.default_rng(3)
    base, joints = np.tile(machine.base_home(), (4, 1)), rng.uniform(-1, 1, (4, 6))
    rates = rng.normal(size=(4, 6))
    task = own.at(base, joints, 0.0)
    expected = [numeric(machine.base_rate(*state)).ravel() for state in zip(base, joints, rates, strict=True)]
    np.testing.assert_allclose(task.base_rates(rates) + task.drift, expected, atol=1e-12)
