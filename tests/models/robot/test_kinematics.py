from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from models import (
    Frame,
    Joint,
    Link,
    Robot,
    center_of_mass,
    center_of_mass_jacobian,
    centers_of_mass,
    frame_jacobian,
    link_frames,
    momentum_matrix,
    planar_chain,
    robot_inertia,
    tip_jacobian,
    tip_pose,
)
from tests.models.robot.trees import (
    Base,
    directional,
    few,
    momentum_by_differentiation,
    numeric,
    numeric_poses,
    random_frame,
    random_robot,
    random_rotation,
    refused,
    seeds,
    twist_by_differentiation,
)

sizes = st.integers(1, 8)
bases = st.sampled_from(["planar", "spatial"])


@few
@given(seeds, sizes)
def test_frames_follow_the_joints_one_by_one(seed: int, size: int) -> None:
    """Child = parent, placed, moved:

    Each joint alone, with numbers, scipy-free and without the chain's shortcuts.
    """
    rng = np.random.default_rng(seed)
    robot = random_robot(rng, size)
    q, (turn, position) = rng.normal(size=robot.dof), random_frame(rng)
    poses = numeric_poses(robot, q, (turn, position))
    np.testing.assert_allclose(poses[robot.root][0], turn)
    np.testing.assert_allclose(poses[robot.root][1], position)
    value = dict(zip(robot.joint_names, q, strict=True))
    for joint in robot.joints:
        (turn, position), (child_turn, child_position) = poses[joint.parent], poses[joint.child]
        place = position + turn @ joint.translation
        axis = turn @ joint.rotation @ joint.axis
        if joint.kind == "prismatic":
            place = place + value[joint.name] * axis
        moved = joint.rotation
        if joint.kind in ("revolute", "continuous"):
            a, angle = joint.axis, value[joint.name]
            k = np.array([[0, -a[2], a[1]], [a[2], 0, -a[0]], [-a[1], a[0], 0]])
            moved = joint.rotation @ (np.eye(3) + np.sin(angle) * k + (1 - np.cos(angle)) * k @ k)
        np.testing.assert_allclose(child_position, place, atol=1e-13)
        np.testing.assert_allclose(child_turn, turn @ moved, atol=1e-13)


@few
@given(seeds, sizes, bases)
def test_jacobian_of_any_link_point_is_the_derivative_of_its_frame(seed: int, size: int, base: Base) -> None:
    rng = np.random.default_rng(seed)
    robot = random_robot(rng, size, base)
    world_from_base, point = random_frame(rng), rng.normal(size=3)
    q, rates = ca.SX.sym("q", robot.dof), ca.SX.sym("rates", robot.dof)
    frames = link_frames(robot, q, world_from_base)
    result, expected = [], []
    for link in robot.links:
        frame = frames[link.name]
        result.append(ca.mtimes(frame_jacobian(robot, q, link.name, point, world_from_base), rates))
        expected.append(twist_by_differentiation(frame.rotation, frame.point(point), q, rates))
    tip = tip_pose(robot, q, world_from_base)
    result.append(ca.mtimes(tip_jacobian(robot, q, world_from_base), rates))
    expected.append(twist_by_differentiation(tip.rotation, tip.position, q, rates))
    error = ca.Function("f", [q, rates], [ca.horzcat(*result) - ca.horzcat(*expected)])
    np.testing.assert_allclose(numeric(error(rng.normal(size=robot.dof), rng.normal(size=robot.dof))), 0, atol=1e-12)


@few
@given(seeds, sizes)
def test_tip_jacobian_agrees_with_finite_differences(seed: int, size: int) -> None:
    rng = np.random.default_rng(seed)
    robot = random_robot(rng, size)
    world_from_base, q, step = random_frame(rng), rng.normal(size=robot.dof), 1e-5
    jacobian = numeric(tip_jacobian(robot, q, world_from_base))
    turn = numeric(tip_pose(robot, q, world_from_base).rotation)
    for i, direction in enumerate(np.eye(robot.dof)):
        after, before = (tip_pose(robot, q + s * step * direction, world_from_base) for s in (1, -1))
        turning = numeric(after.rotation - before.rotation) / (2 * step) @ turn.T
        omega = [turning[2, 1], turning[0, 2], turning[1, 0]]
        speed = numeric(after.position - before.position).ravel() / (2 * step)
        np.testing.assert_allclose(jacobian[:, i], [*omega, *speed], atol=1e-8)


@few
@given(seeds, sizes, bases)
def test_momentum_matrix_is_the_sum_over_the_links(seed: int, size: int, base: Base) -> None:
    rng = np.random.default_rng(seed)
    robot = random_robot(rng, size, base)
    world_from_base = random_frame(rng)
    q, rates = ca.SX.sym("q", robot.dof), ca.SX.sym("rates", robot.dof)
    expected = momentum_by_differentiation(robot, link_frames(robot, q, world_from_base), q, rates)
    result = ca.mtimes(momentum_matrix(robot, q, world_from_base), rates)
    error = ca.Function("f", [q, rates], [result - expected])
    np.testing.assert_allclose(numeric(error(rng.normal(size=robot.dof), rng.normal(size=robot.dof))), 0, atol=1e-11)


@few
@given(seeds, sizes)
def test_center_of_mass_is_the_weighted_mean_and_its_jacobian_its_derivative(seed: int, size: int) -> None:
    rng = np.random.default_rng(seed)
    robot = random_robot(rng, size)
    world_from_base = random_frame(rng)
    q, rates = ca.SX.sym("q", robot.dof), ca.SX.sym("rates", robot.dof)
    point = rng.normal(size=robot.dof)
    centers = centers_of_mass(robot, point, world_from_base)
    mean = sum(link.mass * numeric(centers[link.name]) for link in robot.links) / robot.total_mass
    np.testing.assert_allclose(numeric(center_of_mass(robot, point, world_from_base)), mean, atol=1e-13)
    result = ca.mtimes(center_of_mass_jacobian(robot, q, world_from_base), rates)
    expected = directional(center_of_mass(robot, q, world_from_base), q, rates)
    error = ca.Function("f", [q, rates], [result - expected])
    np.testing.assert_allclose(numeric(error(point, rng.normal(size=robot.dof))), 0, atol=1e-12)


@few
@given(seeds, sizes)
def test_locked_robot_moves_as_a_rigid_body(seed: int, size: int) -> None:
    """Spatial inertia times a twist = sum of the links' momenta when the whole tree shares that twist."""
    rng = np.random.default_rng(seed)
    robot = random_robot(rng, size)
    world_from_base, q, twist = random_frame(rng), rng.normal(size=robot.dof), rng.normal(size=6)
    poses = numeric_poses(robot, q, world_from_base)
    expected = np.zeros(6)
    for link in robot.links:
        turn, position = poses[link.name]
        center = position + turn @ link.center_of_mass
        push = link.mass * (twist[3:] + np.cross(twist[:3], center))
        expected += [*(np.cross(center, push) + turn @ link.inertia @ turn.T @ twist[:3]), *push]
    inertia = numeric(robot_inertia(robot, q, world_from_base))
    np.testing.assert_allclose(inertia @ twist, expected, atol=1e-11)
    np.testing.assert_allclose(inertia, inertia.T, atol=1e-12)


@few
@given(seeds, sizes)
def test_a_moved_base_moves_everything_with_it(seed: int, size: int) -> None:
    rng = np.random.default_rng(seed)
    robot = random_robot(rng, size)
    base, q = Frame(*random_frame(rng)), rng.normal(size=robot.dof)
    here, there = numeric_poses(robot, q), numeric_poses(robot, q, base)
    for link in robot.links:
        np.testing.assert_allclose(there[link.name][0], base.rotation @ here[link.name][0], atol=1e-13)
        np.testing.assert_allclose(there[link.name][1], numeric(base.point(here[link.name][1])).ravel(), atol=1e-13)


def test_planar_chain_has_the_textbook_position() -> None:
    lengths, q = np.array([1.0, 0.7, 0.4]), np.array([0.3, -1.1, 2.0])
    angles = np.cumsum(q)
    robot = planar_chain(lengths, np.ones(3), mount=(0.2, 0.1))
    expected = [0.2 + lengths @ np.cos(angles), 0.1 + lengths @ np.sin(angles), 0.0]
    np.testing.assert_allclose(numeric(tip_pose(robot, q).position).ravel(), expected, atol=1e-15)
    assert np.isclose(numeric(tip_pose(robot, q).rotation)[1, 0], np.sin(angles[-1]))


def test_parallel_axes_turned_upside_down_are_not_added_up() -> None:
    """The shortcut for parallel axes must not skip a rotation between the joints or a reversed axis."""
    flip = np.diag([1.0, -1.0, -1.0])
    links = tuple(Link(name) for name in "abcd")
    joints = (
        Joint("j", "revolute", "a", "b"),
        Joint("k", "revolute", "b", "c", (1, 0, 0), flip),
        Joint("l", "revolute", "c", "d", (1, 0, 0), axis=(0, 0, -1)),
    )
    robot = Robot(links, joints, tip_translation=(1, 0, 0))
    turned = np.cumsum([0.3, -0.5, 0.9])
    position = numeric(tip_pose(robot, [0.3, 0.5, 0.9]).position).ravel()
    np.testing.assert_allclose(position[:2], [np.cos(turned).sum(), np.sin(turned).sum()], atol=1e-15)


@pytest.mark.parametrize("symbols", [ca.SX, ca.MX])
def test_symbols_of_both_kinds_give_the_numeric_values(symbols: Any) -> None:
    rng = np.random.default_rng(11)
    robot = random_robot(rng, 6)
    frame = random_frame(rng)

    def everything(q: Any) -> list[Any]:
        return [
            *(part for link in link_frames(robot, q, frame).values() for part in link),
            *tip_pose(robot, q, frame),
            tip_jacobian(robot, q, frame),
            frame_jacobian(robot, q, "link2", (0.1, 0.2, 0.3), frame),
            center_of_mass(robot, q, frame),
            center_of_mass_jacobian(robot, q, frame),
            momentum_matrix(robot, q, frame),
            robot_inertia(robot, q, frame),
        ]

    q, values = symbols.sym("q", robot.dof), rng.normal(size=robot.dof)
    for one, other in zip(ca.Function("f", [q], everything(q))(values), everything(values), strict=True):
        np.testing.assert_allclose(numeric(one), numeric(other), atol=1e-14)


def test_a_rounded_right_angle_costs_no_more_than_an_exact_one() -> None:
    def robot(turn: Any) -> Robot:
        links = tuple(Link(name, 1.0) for name in "abc")
        joints = (Joint("j", "revolute", "a", "b"), Joint("k", "revolute", "b", "c", (0.0, 0.0, 0.5), turn))
        return Robot(links, joints, tip_translation=(0.3, 0, 0))

    exact = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
    c, s = np.cos(np.pi / 2), np.sin(np.pi / 2)
    rounded = np.array([[1.0, 0, 0], [0, c, -s], [0, s, c]])
    q = ca.SX.sym("q", 2)
    counts = [ca.Function("f", [q], [tip_jacobian(robot(turn), q)]).n_instructions() for turn in (exact, rounded)]
    assert counts[0] == counts[1]


def test_requests_that_do_not_fit_are_refused() -> None:
    robot = planar_chain([1.0, 1.0], [1.0, 1.0])
    with refused(r"q has shape \(3, 1\), expected \(2, 1\): .*'joint1', 'joint2'"):
        tip_pose(robot, np.zeros(3))
    with refused("link 'wrist' does not exist"):
        frame_jacobian(robot, np.zeros(2), "wrist")
    massless = Robot((Link("a"), Link("b")), (Joint("j", "revolute", "a", "b"),))
    for function in (center_of_mass, center_of_mass_jacobian):
        with refused("no mass"):
            function(massless, np.zeros(1))


def test_a_robot_without_joints_stands_still() -> None:
    robot = Robot((Link("a", 2.0, (1, 0, 0)),), tip_translation=(1, 2, 3))
    turn = random_rotation(np.random.default_rng(0))
    np.testing.assert_allclose(numeric(tip_pose(robot, [], (turn, (0, 0, 0))).position).ravel(), turn @ [1, 2, 3])
    assert tip_jacobian(robot, []).shape == (6, 0)
    assert momentum_matrix(robot, []).shape == (6, 0)
