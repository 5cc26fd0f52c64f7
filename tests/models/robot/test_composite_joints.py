"""Planar and floating joints of a URDF file, beside Pinocchio's joints of several degrees of freedom."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pinocchio
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from models import FixedBase, Robot
from models.robot.kinematics import link_frames
from models.robot.parts import Joint
from models.robot.tree import replace_planar
from ocp import TipTask, inverse_kinematics, plan
from tests.models.robot.trees import Array, few, random_rotation, seeds

BODY = '<inertial><mass value="2"/><inertia ixx="1" ixy="0" ixz="0" iyy="1" iyz="0" izz="1"/></inertial>'
ARM = "".join(
    f'<link name="l{k}">{BODY}</link><joint name="j{k}" type="revolute"><parent link="{"cart" if k == 1 else "l1"}"/>'
    f'<child link="l{k}"/><origin xyz="0.1 0 0.4"/><axis xyz="0 {k - 1} {2 - k}"/>'
    '<limit lower="-2" upper="2" velocity="1" effort="9"/></joint>'
    for k in (1, 2)
)


def cart(kind: str, origin: str = "", axis: str = "", root: str = "") -> str:
    """Return the URDF text of an arm of two joints on a cart that moves in the world."""
    joint = f'<joint name="base" type="{kind}"><parent link="world"/><child link="cart"/>{origin}{axis}</joint>'
    return f'<robot name="r"><link name="world">{root}</link><link name="cart">{BODY}</link>{joint}{ARM}</robot>'


def assert_same_frames(robot: Robot, q: Array, model: pinocchio.Model, configuration: Array) -> None:
    data = model.createData()
    pinocchio.framesForwardKinematics(model, data, configuration)
    for name, frame in link_frames(robot, q).items():
        if model.existFrame(name):
            place = data.oMf[model.getFrameId(name)]
            np.testing.assert_allclose(np.array(ca.DM(frame.position)).ravel(), place.translation, atol=1e-12)
            np.testing.assert_allclose(np.array(ca.DM(frame.rotation)), place.rotation, atol=1e-12)


@given(seeds)
@few
def test_a_planar_joint_moves_the_links_as_in_pinocchio(seed: int) -> None:
    rng = np.random.default_rng(seed)
    origin = f'<origin xyz="0.3 {rng.normal()} 0.2" rpy="{rng.normal()} 0.2 {rng.normal()}"/>'
    for axis in ("", '<axis xyz="0 0 1"/>', '<axis xyz="0 0 -2"/>'):  # either side is normal to the plane
        source = cart("planar", origin, axis)
        robot = Robot.from_urdf(source, tip="l2")
        assert robot.joint_names == ("base_x", "base_y", "base_angle", "j1", "j2")
        x, y, angle, *arm = q = rng.normal(size=5)
        configuration = np.array([x, y, np.cos(angle), np.sin(angle), *arm])
        assert_same_frames(robot, q, pinocchio.buildModelFromXML(source), configuration)


@given(seeds)
@few
def test_a_floating_joint_moves_the_links_as_in_pinocchio(seed: int) -> None:
    rng = np.random.default_rng(seed)
    source = cart("floating", f'<origin xyz="0.3 {rng.normal()} 0.2" rpy="{rng.normal()} 0.2 0"/>', root=BODY)
    robot = Robot.from_urdf(source, tip="l2")
    names = ("base_x", "base_y", "base_z", "base_yaw", "base_pitch", "base_roll", "j1", "j2")
    assert robot.joint_names == names
    q = rng.normal(size=8)
    quaternion = Rotation.from_euler("ZYX", q[3:6]).as_quat()
    assert_same_frames(robot, q, pinocchio.buildModelFromXML(source), np.concatenate([q[:3], quaternion, q[6:]]))


@given(seeds, st.floats(-1, 1))
@few
def test_a_plane_across_any_axis_contains_the_motion(seed: int, height: float) -> None:
    rng = np.random.default_rng(seed)
    axis, place = rng.normal(size=3), Joint("p", "fixed", "a", "b", rng.normal(size=3), random_rotation(rng))
    normal = axis / np.linalg.norm(axis)
    links, joints = replace_planar(place, axis, [], [place])
    assert [link.name for link in links] == ["p_x_link", "p_y_link"]
    axes = np.array([joint.axis for joint in joints])
    np.testing.assert_allclose(axes @ axes.T, np.eye(3), atol=1e-12)
    np.testing.assert_allclose(np.abs(axes @ normal), [0, 0, 1], atol=1e-12)
    assert np.linalg.det(axes) == pytest.approx(1.0)
    assert np.allclose(joints[0].translation, place.translation)


def test_a_written_planar_base_is_read_again() -> None:
    robot = Robot.from_urdf(cart("planar"), tip="l2")
    again = Robot.from_urdf(robot.to_urdf())
    q = np.array([0.3, -0.2, 0.5, 0.1, 0.4])
    pairs = zip(link_frames(robot, q).values(), link_frames(again, q).values(), strict=True)
    assert all(np.allclose(np.array(ca.DM(one.position)), np.array(ca.DM(other.position))) for one, other in pairs)


def test_an_arm_on_a_planar_base_is_planned_far_away() -> None:
    """The seam lies 2 m from the arm, which therefore drives: base and arm move together."""
    machine = FixedBase(Robot.from_urdf(cart("planar"), tip="l2", tip_translation=(0.3, 0.0, 0.0)))
    start = inverse_kinematics(machine, TipTask(position=(2.0, 1.0, 0.8)), near=np.zeros(5))[0].joints
    task = TipTask(position=lambda t: ca.vertcat(2.0 + 0.2 * t, 1.0, 0.8), duration=2.0)
    result = plan(machine, task, start=start)
    assert result.audit().passed
    assert np.ptp(result["joints"][:, 0]) > 0.05
