"""Limits of MoveIt's joint_limits.yaml, and limits that a task does not use."""

from __future__ import annotations

import warnings
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from models import FixedBase, Mimic, ModelWarning, Robot, planar_chain
from ocp import Limits, ProblemError, TipTask, inverse_kinematics, plan
from ocp.app import check_trajectory
from ocp.app.files import read_joint_limits, read_trajectory

inf = np.inf
ARM = planar_chain([1.0, 1.0, 1.0], [1.0, 1.0, 1.0])
PANDA = """# Joint limits as MoveIt's assistant writes them
default_velocity_scaling_factor: 0.1
default_acceleration_scaling_factor: 0.5
joint_limits:
  joint1: {has_velocity_limits: true, max_velocity: 2.5, has_acceleration_limits: true, max_acceleration: 4.0}
  joint2:
    has_velocity_limits: true
    max_velocity: 2
    has_acceleration_limits: false
    max_acceleration: 0
    has_jerk_limits: true
    max_jerk: 100.0
  joint3: {has_velocity_limits: false, max_velocity: 0, has_jerk_limits: false}
"""


def limits_of(text: Any, folder: Path, robot: Robot = ARM, **options: Any) -> Limits:
    file = folder / "joint_limits.yaml"
    file.write_text(text if isinstance(text, str) else yaml.safe_dump(text), encoding="utf-8")
    return read_joint_limits(file, robot, **options)


def test_limits_of_moveit_are_those_of_the_joints_times_the_default_factors(tmp_path: Path) -> None:
    limits = limits_of(PANDA, tmp_path)
    np.testing.assert_allclose(limits.velocity, [0.25, 0.2, inf])
    np.testing.assert_allclose(limits.acceleration, [2.0, inf, inf])
    np.testing.assert_allclose(limits.jerk, [inf, 100.0, inf])
    assert limits.torque is None
    np.testing.assert_allclose(limits_of(PANDA, tmp_path, scaling=False).velocity, [2.5, 2.0, inf])
    tree = yaml.safe_load(PANDA)
    wrapped = {"/**": {"ros__parameters": {"robot_description_planning": tree}}}
    assert str(limits_of(wrapped, tmp_path)) == str(limits)
    del tree["joint_limits"]["joint2"]["max_jerk"], tree["joint_limits"]["joint2"]["has_jerk_limits"]
    assert limits_of(tree, tmp_path).jerk is None  # no joint has one


def test_the_description_and_mimic_joints_limit_what_the_file_does_not(tmp_path: Path) -> None:
    first, second, third = ARM.joints
    joints = (
        replace(first, velocity=3.0, effort=5.0),
        replace(second, mimic=Mimic("joint1", -2.0), velocity=0.0),
        replace(third, velocity=0.0),
    )
    robot = replace(ARM, joints=joints)
    assert limits_of({"joint_limits": {}}, tmp_path, robot) == Limits()
    tree: Any = {"joint_limits": {"joint2": {"max_velocity": 4.0, "max_acceleration": 6.0, "max_effort": 1.0}}}
    limits = limits_of(tree, tmp_path, robot)
    np.testing.assert_allclose(limits.velocity, [2.0, inf])  # 4 / 2; joint 3 has 0, which is unknown
    np.testing.assert_allclose(limits.acceleration, [3.0, inf])
    np.testing.assert_allclose(limits.torque, [5.0, inf])  # of the own actuator
    tree |= {"default_velocity_scaling_factor": 0.5}
    np.testing.assert_allclose(limits_of(tree, tmp_path, robot).velocity, [1.0, inf])


def test_unknown_joints_and_unused_entries_are_named_in_one_warning(tmp_path: Path) -> None:
    own = {"max_velocity": 1.0, "max_acceleraton": 2.0, "max_position": 1.0, "angle_wraparound": False}
    with pytest.warns(ModelWarning) as caught:
        limits = limits_of({"joint_limits": {"joint1": own, "elbow": {"max_velocity": 1.0}}}, tmp_path)
    words = str(caught[0].message)
    assert len(caught) == 1
    for part in (
        "joint 'elbow'",
        "max_acceleraton (did you mean max_acceleration?) of joint 'joint1'",
        "max_position of",
    ):
        assert part in words
    assert "wraparound" not in words
    np.testing.assert_allclose(limits.velocity, [1.0, inf, inf])


@pytest.mark.parametrize(
    ("tree", "name"),
    [
        ("[1, 2]", "joint_limits"),
        ("joint_limits: 3", "joint_limits"),
        ("joint_limits: {joint1: 3}", "joint1"),
        ("joint_limits: {joint1: {has_velocity_limits: true}}", "joint1"),
        ("joint_limits: {joint1: {has_velocity_limits: 'yes', max_velocity: 1}}", "joint1"),
        ("joint_limits: {joint1: {max_velocity: 0}}", "joint1"),
        ("joint_limits: {joint1: {max_jerk: -1}}", "joint1"),
        ("joint_limits: {joint1: {max_velocity: .nan}}", "joint1"),
        ("joint_limits: {joint1: {max_velocity: fast}}", "joint1"),
        ("joint_limits: {joint1: {max_velocity: true}}", "joint1"),
        ("{default_velocity_scaling_factor: 0, joint_limits: {}}", "default_velocity_scaling_factor"),
        ("{default_acceleration_scaling_factor: 1.5, joint_limits: {}}", "default_acceleration_scaling_factor"),
        ("joint_limits: !!python/object/apply:os.system ['true']", "file"),
    ],
)
def test_bad_limits_are_refused_by_name(tree: str, name: str, tmp_path: Path) -> None:
    with pytest.raises(ProblemError) as caught:
        limits_of(tree, tmp_path)
    assert caught.value.name == name


PIECES = st.sampled_from(
    ["", "0", ".nan", "-1", "~", ":", "\n", "  ", "[", "}", "&a ", "*a", "true", "1e999", "!x ", "'"]
)


@settings(max_examples=100, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.lists(st.tuples(st.floats(0, 1), st.integers(0, 12), PIECES), max_size=4))
def test_a_mutated_file_is_read_or_refused_with_an_error_of_the_package(
    tmp_path: Path, changes: list[tuple[float, int, str]]
) -> None:
    text = PANDA
    for share, removed, piece in changes:
        place = int(share * len(text))
        text = text[:place] + piece + text[place + removed :]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ModelWarning)
        try:
            limits = limits_of(text, tmp_path)
        except ProblemError as error:
            assert error.name is not None  # noqa: PT017
        else:
            limits.bounds(FixedBase(ARM))


def test_an_effort_of_zero_in_a_urdf_is_unknown_to_planner_and_check(tmp_path: Path) -> None:
    """The same plan and verdict, without a warning, as with limits that the task does not use."""
    joints = tuple(replace(joint, lower=-3.0, upper=3.0, velocity=9.0, effort=900.0) for joint in ARM.joints)
    text = replace(ARM, joints=joints).to_urdf()
    unknown = Robot.from_urdf(text.replace('effort="900.0"', 'effort="0"'))
    assert {joint.effort for joint in unknown.moving_joints} == {0.0}
    task = TipTask(position=lambda t: [2.0, 0.2 * t - 0.1, 0.0], rows=(3, 4))
    start = inverse_kinematics(FixedBase(ARM), task)[0].joints
    options: dict[str, Any] = {"start": start, "scene": False, "search": "start"}
    plans = [plan(FixedBase(robot), task, 1.0, **options) for robot in (unknown, Robot.from_urdf(text))]
    assert all(one.audit().passed for one in plans)
    np.testing.assert_allclose(plans[0].cost, plans[1].cost, rtol=1e-9)
    plans[0].write_csv(tmp_path / "a.csv")
    report = check_trajectory(unknown, read_trajectory(tmp_path / "a.csv"), scene=False)
    assert report.passed, report.sentence
