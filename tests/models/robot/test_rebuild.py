from __future__ import annotations

from typing import Any

import numpy as np
import pinocchio
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from models import (
    FreeFloating,
    Joint,
    Link,
    Robot,
    add_prefix,
    attach_tool,
    base_reaction,
    inverse_dynamics,
    link_frames,
    lock_joints,
    mass_matrix,
    merge_robots,
    momentum_matrix,
    mount_on_rail,
    move_tip,
    planar_chain,
    prune,
    reroot,
    robot_inertia,
    simplify,
    subtree,
    tip_jacobian,
    tip_pose,
    with_load,
)
from tests.models.robot.pinocchio_robots import ROBOTS, urdf_file
from tests.models.robot.trees import (
    Array,
    few,
    numeric,
    numeric_poses,
    random_frame,
    random_inertia,
    random_robot,
    random_rotation,
    refused,
    seeds,
)

fewer_still = settings(max_examples=10)
NEAR: Any = {"rtol": 1e-9, "atol": 1e-9}


def real_robot(name: str) -> Robot:
    package, ending, options = ROBOTS[name]
    return Robot.from_urdf(urdf_file(package, ending), **options)


def matrix(pose: tuple[Any, Any]) -> Array:
    """Homogeneous transform of a pose."""
    result = np.eye(4)
    result[:3, :3], result[:3, 3] = numeric(pose[0]), numeric(pose[1]).ravel()
    return result


def dynamics(robot: Robot, rng: np.random.Generator, place: Any) -> list[Array]:
    """Inertia, momentum per joint rate, tip, its Jacobian, torques and reaction of some motion."""
    q, qd, qdd = (rng.normal(size=robot.dof) for _ in range(3))
    motion, push = rng.normal(size=6), rng.normal(size=6)
    moving: Any = {"world_from_base": place, "base_motion": (motion, push)}
    outcome = [robot_inertia(robot, q, place), momentum_matrix(robot, q, place), *tip_pose(robot, q, place)]
    outcome += [tip_jacobian(robot, q, place), inverse_dynamics(robot, q, qd, qdd, **moving)]
    return [numeric(each) for each in (*outcome, base_reaction(robot, q, qd, qdd, **moving))]


def assert_same_dynamics(robot: Robot, other: Robot, seed: int) -> None:
    place = random_frame(np.random.default_rng(seed))
    both = (dynamics(each, np.random.default_rng(seed), place) for each in (robot, other))
    for result, expected in zip(*both, strict=True):
        np.testing.assert_allclose(result, expected, rtol=1e-10, atol=1e-10 * max(1.0, np.abs(expected).max(initial=0)))


@given(seeds, st.integers(2, 9))
@few
def test_locking_joints_preserves_the_dynamics_of_the_other_joints(seed: int, size: int) -> None:
    rng = np.random.default_rng(seed)
    robot = random_robot(rng, size)
    q, qd, qdd = (rng.normal(size=robot.dof) for _ in range(3))
    held = rng.random(robot.dof) < 0.5
    qd[held] = qdd[held] = 0.0
    positions = {name: q[i] for i, name in enumerate(robot.joint_names) if held[i]}
    fewer = lock_joints(robot, positions)
    assert fewer.joint_names == tuple(name for name in robot.joint_names if name not in positions)
    for name, pose in numeric_poses(robot, q).items():
        np.testing.assert_allclose(matrix(numeric_poses(fewer, q[~held])[name]), matrix(pose), **NEAR)
    torques = numeric(inverse_dynamics(robot, q, qd, qdd)).ravel()
    result = numeric(inverse_dynamics(fewer, q[~held], qd[~held], qdd[~held])).ravel()
    np.testing.assert_allclose(result, torques[~held], **NEAR)


def test_a_reduced_robot_is_that_of_pinocchio() -> None:
    robot = real_robot("panda")
    whole = pinocchio.buildModelFromUrdf(str(urdf_file(*ROBOTS["panda"][:2])))
    rng = np.random.default_rng(3)
    place = rng.normal(size=robot.dof)
    names = ["panda_joint3", "panda_finger_joint1", "panda_finger_joint2"]
    indices = [robot.joint_names.index(name) for name in names]
    reduced = pinocchio.buildReducedModel(whole, [whole.getJointId(name) for name in names], place)
    fewer = lock_joints(robot, {name: place[i] for name, i in zip(names, indices, strict=True)})
    assert list(fewer.joint_names) == list(reduced.names)[1:]
    for _ in range(20):
        q, qd, qdd = (rng.normal(size=fewer.dof) for _ in range(3))
        expected = pinocchio.rnea(reduced, reduced.createData(), q, qd, qdd)
        np.testing.assert_allclose(numeric(inverse_dynamics(fewer, q, qd, qdd)).ravel(), expected, rtol=0, atol=1e-10)


@given(seeds, st.integers(1, 9))
@few
def test_a_robot_hung_up_elsewhere_moves_the_same(seed: int, size: int) -> None:
    """Relative poses of all links, and what floats freely does not know its root: the generalized Jacobian."""
    rng = np.random.default_rng(seed)
    robot = random_robot(rng, size, followers=True)
    root = robot.links[int(rng.integers(len(robot.links)))].name
    turned = reroot(robot, root)
    assert turned.root == root
    assert turned.total_mass == pytest.approx(robot.total_mass)
    q, place = rng.normal(size=robot.dof), random_frame(rng)
    for joint in robot.moving_joints:
        again = turned.joint(joint.name)
        assert (again.kind, again.lower, again.upper) == (joint.kind, joint.lower, joint.upper)
    order = [robot.joint_names.index(name) for name in turned.joint_names]
    frames = numeric_poses(robot, q, place)
    result = numeric_poses(turned, q[order], frames[root])
    for name, pose in frames.items():
        np.testing.assert_allclose(matrix(result[name]), matrix(pose), **NEAR)

    def base(pose: tuple[Array, Array]) -> Array:
        return np.concatenate([pose[1], np.roll(Rotation.from_matrix(pose[0]).as_quat(), 1)])

    before = numeric(FreeFloating(robot).tip_jacobian(base(place), q))
    after = numeric(FreeFloating(turned).tip_jacobian(base(frames[root]), q[order]))
    np.testing.assert_allclose(after, before[:, order], **NEAR)


def test_rerooting_to_and_fro_adds_massless_frames_once_and_changes_no_motion() -> None:
    robot = real_robot("ur5")
    there = reroot(robot, "tool0")
    assert {joint.name for joint in robot.moving_joints} == {joint.name for joint in there.moving_joints}
    back = reroot(there, robot.root)
    again = reroot(reroot(back, "tool0"), robot.root)
    assert sorted(link.name for link in again.links) == sorted(link.name for link in there.links)
    q = np.linspace(-1, 1, 6)
    for each in (back, again):
        order = [robot.joint_names.index(name) for name in each.joint_names]
        np.testing.assert_allclose(matrix(tip_pose(each, q[order])), matrix(tip_pose(robot, q)), **NEAR)


@given(seeds, st.integers(1, 10))
@fewer_still
def test_a_simplified_robot_has_the_same_dynamics(seed: int, size: int) -> None:
    rng = np.random.default_rng(seed)
    robot = random_robot(rng, size, followers=True)
    fewer = simplify(robot)
    assert len(fewer.links) == len(robot.couplings) + 1
    assert fewer.joint_names == robot.joint_names
    assert_same_dynamics(robot, fewer, seed)
    kept = robot.links[int(rng.integers(1, len(robot.links)))].name
    named = simplify(robot, keep=[kept])
    assert_same_dynamics(robot, named, seed)
    q = rng.normal(size=robot.dof)
    np.testing.assert_allclose(
        matrix(numeric_poses(named, q)[kept]), matrix(numeric_poses(robot, q)[kept]), rtol=0, atol=1e-12
    )


@pytest.mark.parametrize("name", ROBOTS)
def test_a_simplified_real_robot_has_the_same_dynamics(name: str) -> None:
    robot = real_robot(name)
    fewer = simplify(robot)
    assert len(fewer.links) == robot.dof + 1
    assert_same_dynamics(robot, fewer, 5)


@given(seeds, st.integers(1, 5), st.integers(1, 4))
@few
def test_an_attached_robot_moves_as_it_does_alone_on_a_moving_base(seed: int, size: int, more: int) -> None:
    rng = np.random.default_rng(seed)
    robot, tool = random_robot(rng, size, followers=True), random_robot(rng, more, followers=True)
    link = robot.links[int(rng.integers(len(robot.links)))].name
    turn, shift = random_frame(rng)
    whole = attach_tool(robot, tool, link, shift, rotation=turn, prefix="tool_")
    q, own = rng.normal(size=robot.dof), rng.normal(size=tool.dof)
    together = np.concatenate([q, own])
    assert whole.joint_names == (*robot.joint_names, *(f"tool_{name}" for name in tool.joint_names))
    poses, result = numeric_poses(robot, q), numeric_poses(whole, together)
    carrier = matrix(poses[link]) @ matrix((turn, shift))
    alone = numeric_poses(tool, own, (carrier[:3, :3], carrier[:3, 3]))
    for name, pose in {**poses, **{f"tool_{name}": pose for name, pose in alone.items()}}.items():
        np.testing.assert_allclose(matrix(result[name]), matrix(pose), **NEAR)
    tip = tip_pose(tool, own, (carrier[:3, :3], carrier[:3, 3]))
    np.testing.assert_allclose(matrix(tip_pose(whole, together)), matrix(tip), **NEAR)
    inertia = numeric(robot_inertia(robot, q)) + numeric(robot_inertia(tool, own, (carrier[:3, :3], carrier[:3, 3])))
    np.testing.assert_allclose(numeric(robot_inertia(whole, together)), inertia, **NEAR)
    same = attach_tool(robot, tool, link, shift, rotation=turn, prefix="tool_", keep_tip=True)
    np.testing.assert_allclose(matrix(tip_pose(same, together)), matrix(tip_pose(robot, q)), **NEAR)


def test_a_tool_stands_at_the_tip_unless_a_link_is_named() -> None:
    arm = move_tip(
        planar_chain([1.0, 1.0], [1.0, 1.0]),
        "link2",
        (1.0, 0.0, 0.5),
        Rotation.from_euler("z", 90, degrees=True).as_matrix(),
    )
    whole = attach_tool(arm, Link("gripper", 0.5), translation=(0.0, -0.25, 0.0))
    assert (whole.tip, whole.joints[-1].name) == ("gripper", "gripper_mount")
    np.testing.assert_allclose(numeric(tip_pose(whole, [0.0, 0.0]).position).ravel(), [2.25, 0.0, 0.5], atol=1e-15)


@given(seeds, st.integers(1, 5))
@fewer_still
def test_a_load_is_a_link_that_is_fixed(seed: int, size: int) -> None:
    rng = np.random.default_rng(seed)
    robot = random_robot(rng, size, followers=True)
    link = robot.links[int(rng.integers(len(robot.links)))].name
    center, inertia = rng.normal(size=3), random_inertia(rng, 3.0)
    loaded = with_load(robot, link, 3.0, center, inertia=inertia)
    assert [each.name for each in loaded.links] == [each.name for each in robot.links]
    assert_same_dynamics(loaded, attach_tool(robot, Link("load", 3.0, center, inertia), link, keep_tip=True), seed)


def test_a_load_without_inertia_is_a_point() -> None:
    loaded = with_load(planar_chain([2.0], [1.0], [0.5]), "link1", 1.0, (2.0, 0.0, 0.0)).link("link1")
    np.testing.assert_allclose(loaded.center_of_mass, [1.5, 0, 0])
    assert loaded.inertia[2, 2] == pytest.approx(0.5 + 0.25 + 0.25)


@given(seeds, st.integers(1, 4))
@fewer_still
def test_a_rail_carries_the_whole_mass_along_its_axis(seed: int, size: int) -> None:
    rng = np.random.default_rng(seed)
    robot, axis = random_robot(rng, size), rng.normal(size=3)
    railed = mount_on_rail(robot, axis, -2.0, 3.0, velocity=0.5)
    q, along = rng.normal(size=robot.dof), axis / np.linalg.norm(axis)
    assert (railed.root, railed.joint_names) == ("rail", ("rail_joint", *robot.joint_names))
    assert (railed.lower[0], railed.upper[0], railed.velocity[0]) == (-2.0, 3.0, 0.5)
    there, here = numeric(tip_pose(railed, [1.5, *q]).position), numeric(tip_pose(robot, q).position)
    np.testing.assert_allclose((there - here).ravel(), 1.5 * along, atol=1e-12)
    inertia = numeric(mass_matrix(railed, [1.5, *q]))
    np.testing.assert_allclose(inertia[1:, 1:], numeric(mass_matrix(robot, q)), **NEAR)
    assert inertia[0, 0] == pytest.approx(sum(link.mass for link in robot.links))


def test_two_arms_on_one_base_move_as_each_does_alone() -> None:
    rng = np.random.default_rng(8)
    arm, other = real_robot("floating manipulator"), real_robot("ur5")
    body = Robot(
        (Link("satellite", 500.0, inertia=np.diag([90.0, 90.0, 90.0])), Link("mast", 1.0)),
        (Joint("yaw", "revolute", "satellite", "mast", (0, 0, 1)),),
    )
    turn, shift = random_rotation(rng), rng.normal(size=3)
    pair = merge_robots(
        body,
        {"left_": arm, "right_": other},
        links={"right_": "mast"},
        translations={"left_": shift},
        rotations={"right_": turn},
    )
    assert (pair.root, pair.tip, pair.dof) == ("satellite", f"left_{arm.tip}", 14)
    assert pair.total_mass == pytest.approx(501.0 + arm.total_mass + other.total_mass)
    q = rng.normal(size=14)
    result = numeric_poses(pair, q)
    mast = matrix(result["mast"])
    for prefix, robot, own, place in (
        ("left_", arm, q[1:8], (np.eye(3), shift)),
        ("right_", other, q[8:], (mast[:3, :3] @ turn, mast[:3, 3])),
    ):
        for name, pose in numeric_poses(robot, own, place).items():
            np.testing.assert_allclose(matrix(result[prefix + name]), matrix(pose), **NEAR)
        columns = [pair.joint_names.index(prefix + name) for name in robot.joint_names]
        np.testing.assert_allclose(
            numeric(momentum_matrix(pair, q))[:, columns], numeric(momentum_matrix(robot, own, place)), **NEAR
        )
    twins = merge_robots(Link("base"), {"a_": arm, "b_": arm})
    assert twins.name == "base"
    assert FreeFloating(move_tip(twins, "b_Link_7")).joint_size == 14


@given(seeds, st.integers(2, 9))
@few
def test_branches_are_cut_and_taken_out(seed: int, size: int) -> None:
    rng = np.random.default_rng(seed)
    robot = random_robot(rng, size)
    q = rng.normal(size=robot.dof)
    poses = numeric_poses(robot, q)
    other = robot.links[int(rng.integers(len(robot.links)))].name
    cut = prune(robot, other)
    paths = {robot.root, *(j.child for name in (robot.tip_link, other) for j in robot.path_to(name))}
    assert {link.name for link in cut.links} == paths
    chosen = q[[robot.joint_names.index(name) for name in cut.joint_names]]
    for name, pose in numeric_poses(cut, chosen).items():
        np.testing.assert_allclose(matrix(pose), matrix(poses[name]), **NEAR)
    part = subtree(robot, other, None if other in {j.parent for j in robot.path_to(robot.tip_link)} else other)
    assert part.root == other
    chosen = q[[robot.joint_names.index(name) for name in part.joint_names]]
    for name, pose in numeric_poses(part, chosen, poses[other]).items():
        np.testing.assert_allclose(matrix(pose), matrix(poses[name]), **NEAR)


def test_names_are_prefixed_everywhere() -> None:
    robot = add_prefix(planar_chain([1.0, 1.0], [1.0, 1.0]), "a_")
    assert [link.name for link in robot.links] == ["a_base", "a_link1", "a_link2"]
    assert (robot.joint_names, robot.tip, robot.root) == (("a_joint1", "a_joint2"), "a_link2", "a_base")
    assert list(link_frames(robot, [0.0, 0.0])) == ["a_base", "a_link1", "a_link2"]


def test_an_impossible_inertia_stays_marked_where_it_is_merged() -> None:
    odd = Link("odd", 1.0, inertia=np.diag([1.0, 1.0, 9.0]), any_inertia=True)
    robot = attach_tool(planar_chain([1.0], [1.0]), odd)
    assert [link.any_inertia for link in simplify(robot).links] == [False, True]
    with refused(r"inertia .* not symmetric"):
        Link("odd", 1.0, inertia=np.triu(np.ones((3, 3))), any_inertia=True)


ARM = planar_chain([1.0, 1.0], [1.0, 1.0])
PAIR: Any = {"joint1": [0.0, 1.0]}


@pytest.mark.parametrize(
    ("build", "message"),
    [
        (lambda: lock_joints(ARM, {"joint3": 0.0}), "joint 'joint3' does not exist; did you mean"),
        (lambda: lock_joints(lock_joints(ARM, {"joint1": 0.0}), {"joint1": 0.0}), "joint 'joint1' is fixed"),
        (lambda: lock_joints(ARM, {"joint1": np.inf}), "joint 'joint1': locked position must be .*, not inf"),
        (lambda: lock_joints(ARM, PAIR), "joint 'joint1': locked position must be a finite number, not"),
        (lambda: move_tip(ARM, "link3"), "link 'link3' does not exist; did you mean"),
        (lambda: move_tip(ARM, "link2", (1.0, 0.0)), "tip_translation has shape"),
        (lambda: reroot(ARM, "Base"), "link 'Base' does not exist; did you mean 'base'"),
        (lambda: with_load(ARM, "link3", 1.0), "link 'link3' does not exist"),
        (lambda: with_load(ARM, "link2", -1.0), "load of link2': mass must be .*, zero or above .*, not -1.0"),
        (lambda: with_load(ARM, "link2", 1.0, inertia=np.diag([1, 1, 3])), "load of link2': .* triangle inequality"),
        (lambda: attach_tool(ARM, Link("tool"), "link3"), "link 'link3' does not exist"),
        (lambda: attach_tool(ARM, ARM), "link name 'base' is used more than once"),
        (lambda: attach_tool(ARM, Link("tool"), translation=(0, 0)), "attached tool: translation has shape"),
        (lambda: attach_tool(ARM, Link("tool"), rotation=np.ones((3, 3))), "attached tool: rotation .* not a rotation"),
        (lambda: merge_robots(Link("base"), {}), "no arms are given"),
        (lambda: merge_robots(Link("base"), {"": ARM}), "link name 'base' is used more than once"),
        (lambda: merge_robots(Link("b"), {"a_": ARM}, links={"a_": "c"}), "link 'c' does not exist"),
        (lambda: merge_robots(Link("b"), {"a_": ARM}, translations={"A_": (0, 0, 0)}), r"\['A_'\] are no prefixes"),
        (lambda: prune(ARM, ["link3"]), "link 'link3' does not exist"),
        (lambda: subtree(ARM, "link3"), "link 'link3' does not exist"),
        (lambda: subtree(ARM, "link1", "base"), "tip link 'base' does not exist"),
        (lambda: simplify(ARM, ["link3"]), "link 'link3' does not exist"),
    ],
)
def test_impossible_rebuildings_are_refused(build: Any, message: str) -> None:
    with refused(message):
        build()
