"""Followers: a robot with mimic joints is the robot without them, restricted by the couplings."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from models import (
    FixedBase,
    FreeFloating,
    Joint,
    Link,
    Mimic,
    Robot,
    Wrench,
    base_reaction,
    center_of_mass,
    center_of_mass_jacobian,
    center_of_mass_motion,
    frame_jacobian,
    inverse_dynamics,
    lock_joints,
    mass_matrix,
    momentum,
    momentum_matrix,
    prune,
    robot_inertia,
    subtree,
    tip_jacobian,
    tip_pose,
)
from tests.models.robot.trees import (
    few,
    joint_positions,
    numeric,
    numeric_poses,
    random_base,
    random_frame,
    random_robot,
    refused,
    seeds,
    ties,
    untied,
)

sizes = st.integers(2, 8)
NEAR: Any = {"rtol": 1e-11, "atol": 1e-11}


@pytest.mark.long
@few
@given(seeds, sizes)
def test_a_robot_with_followers_is_the_free_one_restricted_to_the_ties(seed: int, size: int) -> None:
    """q_free = A q + b: columns go with A, forces with A', inertia with both."""
    rng = np.random.default_rng(seed)
    robot = random_robot(rng, size, followers=True)
    free, (A, b), place = untied(robot), ties(robot), random_frame(rng)
    q, qd, qdd = rng.normal(size=(3, robot.dof))
    own, all_of = (q, qd, qdd), (A @ q + b, A @ qd, A @ qdd)
    moved: Any = {"world_from_base": place}
    for name, pose in numeric_poses(free, all_of[0], place).items():
        np.testing.assert_allclose(np.c_[numeric_poses(robot, q, place)[name]], np.c_[pose], **NEAR)
    wrench = Wrench(robot.tip_link, rng.normal(size=3), rng.normal(size=3), rng.normal(size=3))
    about = rng.normal(size=3)

    def agree(function: Any, change: Any = lambda value: value) -> None:
        result, expected = function(robot, *own), change(numeric(function(free, *all_of)))
        np.testing.assert_allclose(numeric(result), expected, **NEAR)

    for columns in (tip_jacobian, momentum_matrix, center_of_mass_jacobian):
        agree(lambda r, q, *_, f=columns: f(r, q, place), lambda value: value @ A)
    agree(lambda r, q, *_: frame_jacobian(r, q, "link1", point=about, world_from_base=place), lambda value: value @ A)
    agree(lambda r, q, *_: mass_matrix(r, q), lambda value: A.T @ value @ A)
    agree(lambda r, q, v, a: inverse_dynamics(r, q, v, a, wrenches=[wrench], **moved), lambda value: A.T @ value)
    agree(lambda r, q, v, a: base_reaction(r, q, v, a, wrenches=[wrench], **moved))
    agree(lambda r, q, *_: robot_inertia(r, q, place))
    agree(lambda r, q, *_: center_of_mass(r, q, place))
    agree(lambda r, q, qd, _: momentum(r, q, qd, about=about, world_from_base=place))
    agree(lambda r, *motion: np.hstack([numeric(part) for part in center_of_mass_motion(r, *motion, **moved)]))
    base = random_base(rng, "spatial")
    floating, loose = FreeFloating(robot), FreeFloating(free)
    np.testing.assert_allclose(
        numeric(floating.tip_jacobian(base, q)), numeric(loose.tip_jacobian(base, all_of[0])) @ A, rtol=1e-8, atol=1e-8
    )
    np.testing.assert_allclose(
        numeric(floating.base_rate(base, q, qd)), numeric(loose.base_rate(base, *all_of[:2])), rtol=1e-8, atol=1e-8
    )


@given(seeds, sizes)
def test_the_limits_of_the_joint_vector_are_those_at_which_the_first_joint_reaches_its_own(
    seed: int, size: int
) -> None:
    rng = np.random.default_rng(seed)
    robot = random_robot(rng, size, followers=True)
    at = joint_positions(robot, rng.normal(size=robot.dof))  # a position at which all joints are within limits
    joints = []
    for joint in robot.joints:
        if joint.moves:
            joint = replace(joint, velocity=rng.uniform(1, 2), effort=rng.uniform(1, 2))
        if joint.moves and joint.kind != "continuous":
            joint = replace(joint, lower=at[joint.name] - rng.uniform(0, 2), upper=at[joint.name] + rng.uniform(0, 2))
        joints.append(joint)
    robot = replace(robot, joints=tuple(joints))
    moving = {joint.name: joint for joint in joints if joint.moves}
    middle = np.array([at[name] for name in robot.joint_names])
    A, _ = ties(robot)
    for column, bounds in enumerate(zip(robot.lower, robot.upper, strict=True)):
        for bound in (bound for bound in bounds if np.isfinite(bound)):
            reached = middle.copy()
            reached[column] = bound
            room = [min(moving[n].upper - x, x - moving[n].lower) for n, x in joint_positions(robot, reached).items()]
            assert min(room) == pytest.approx(0.0, abs=1e-12)
    fastest = np.abs(A) / np.array([[moving[name].velocity] for name in untied(robot).joint_names])
    np.testing.assert_allclose(fastest.max(axis=0) * robot.velocity, 1.0)
    np.testing.assert_array_equal(robot.effort, [moving[name].effort for name in robot.joint_names])


@few
@given(seeds, sizes)
def test_followers_are_locked_where_the_joint_that_they_follow_is(seed: int, size: int) -> None:
    rng = np.random.default_rng(seed)
    robot = random_robot(rng, size, followers=True)
    q, held = rng.normal(size=robot.dof), rng.random(robot.dof) < 0.5
    fewer = lock_joints(robot, {name: q[i] for i, name in enumerate(robot.joint_names) if held[i]})
    assert fewer.joint_names == tuple(name for i, name in enumerate(robot.joint_names) if not held[i])
    assert fewer.couplings.keys() == {name for name, drive in robot.couplings.items() if not held[drive.column]}
    for name, pose in numeric_poses(robot, q).items():
        np.testing.assert_allclose(np.c_[numeric_poses(fewer, q[~held])[name]], np.c_[pose], **NEAR)
    np.testing.assert_allclose(numeric(mass_matrix(fewer, q[~held])), numeric(mass_matrix(robot, q))[~held][:, ~held])


@few
@given(seeds, sizes)
def test_a_truncated_tree_keeps_its_remaining_couplings(seed: int, size: int) -> None:
    rng = np.random.default_rng(seed)
    robot = random_robot(rng, size, followers=True)
    other = robot.links[int(rng.integers(len(robot.links)))].name
    q = rng.normal(size=robot.dof)
    at, poses = joint_positions(robot, q), numeric_poses(robot, q)
    for part in (prune(robot, other), subtree(robot, other)):
        own = [at[name] for name in part.joint_names]
        assert joint_positions(part, own) == pytest.approx({name: at[name] for name in part.couplings})
        leaders = {robot.couplings[name].column for name in part.couplings}
        assert part.dof == len(leaders)
        for name, pose in numeric_poses(part, own, poses[part.root]).items():
            np.testing.assert_allclose(np.c_[pose], np.c_[poses[name]], **NEAR)


def gripper(*mimics: Mimic | None, kinds: str = "ppp", **limits: float) -> Robot:
    """Fingers j0, j1.. on one palm, each sliding along z."""
    kind: dict[str, Any] = {"p": "prismatic", "f": "fixed"}
    links = [Link("palm", 1.0), *(Link(f"l{i}", 1.0) for i in range(len(mimics)))]
    joints = [
        Joint(f"j{i}", kind[kinds[i]], "palm", f"l{i}", mimic=tie, **(limits if kinds[i] == "p" else {}))
        for i, tie in enumerate(mimics)
    ]
    return Robot(tuple(links), tuple(joints))


def test_a_follower_that_is_locked_follows_no_more_and_one_of_a_fixed_joint_stands_at_its_offset() -> None:
    robot = gripper(None, Mimic("j0", 2.0, 0.5), Mimic("j1", 1.0, 1.0))
    assert robot.joint_names == ("j0",)
    by_hand = lock_joints(robot, {"j1": 3.0})
    assert by_hand.joint_names == ("j0",)
    assert [by_hand.joint(name).translation[2] for name in ("j1", "j2")] == [3.0, 4.0]
    assert lock_joints(robot, {"j0": 0.25}).joint("j2").translation[2] == 2.0
    still = gripper(None, Mimic("j0", 2.0, 0.5), Mimic("j1", 1.0, 1.0), kinds="fpp")
    assert still.dof == 0
    assert [joint.translation[2] for joint in still.joints] == [0.0, 0.5, 1.5]
    never = gripper(None, Mimic("j0", 0.0, 0.5), None)
    assert never.joint_names == ("j0", "j2")
    assert never.joint("j1").translation[2] == 0.5


def test_a_gripper_that_closes_weighs_both_fingers_on_its_one_drive() -> None:
    robot = gripper(None, Mimic("j0", -1.0), lower=-1.0, upper=0.5, velocity=2.0, effort=3.0)
    np.testing.assert_allclose(numeric(mass_matrix(robot, [0.1])), [[2.0]])
    assert [*robot.lower, *robot.upper, *robot.velocity, *robot.effort] == [-0.5, 0.5, 2.0, 3.0]
    assert FixedBase(replace(robot, tip="l1")).joint_size == 1
    np.testing.assert_allclose(numeric(tip_pose(replace(robot, tip="l1"), [0.1]).position).ravel(), [0, 0, -0.1])
    assert "j1 (prismatic, -1 x j0, -1 .. 0.5 m" in str(robot)


@pytest.mark.parametrize(
    ("build", "message"),
    [
        (lambda: gripper(None, Mimic("J0")), "joint 'j1': mimicked joint 'J0' does not exist; did you mean 'j0'"),
        (lambda: gripper(Mimic("j0")), r"joints \['j0'\] mimic each other in a ring"),
        (lambda: gripper(Mimic("j1"), Mimic("j2"), Mimic("j0")), r"\['j0', 'j1', 'j2'\] mimic each other in a ring"),
        (lambda: gripper(None, Mimic("j0"), kinds="pf"), "joint 'j1' is fixed and cannot follow joint 'j0'"),
        (lambda: Mimic("j0", np.inf), "mimic of joint 'j0': multiplier must be a finite number, not inf"),
        (
            lambda: gripper(None, Mimic("j0", -1.0), lower=0.25, upper=0.5),
            r"joint 'j1' follows 'j0'.* only where that is in -0.5 .. -0.25, which its own limits 0.25 .. 0.5",
        ),
    ],
)
def test_ties_that_cannot_be_are_refused_by_name(build: Any, message: str) -> None:
    with refused(message):
        build()
