"""Inverse kinematics: all postures of known arms, limits, the nearest miss, and what is refused."""

from __future__ import annotations

import pickle
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from models import FixedBase, Joint, Link, Machine, Robot, planar_chain
from ocp import IkOptions, ProblemError, TipTask, Unreachable, inverse_kinematics
from ocp.motion.local.inverse_kinematics import inverse_kinematics_at, sample_starts
from ocp.motion.tasks.equations import bind
from tests.models.robot.trees import seeds
from tests.ocp.motion.local.arms import build
from tests.ocp.motion.tasks.space_tasks import (
    BASE,
    PANDA_START,
    UR5_START,
    floating_panda,
    panda,
    pose,
    two_pandas,
    ur5,
)

POINT = TipTask(position=(0.0, 0.0, 0.0))


def assert_poses(machine: Machine, joints: Any, rotation: Any, position: Any, base: Any = ()) -> None:
    """The tip is there; of the turn only the tool axis where `rotation` is one direction."""
    turn, place = pose(machine, base, joints)
    np.testing.assert_allclose(place, position, atol=1e-9)
    np.testing.assert_allclose(turn if np.ndim(rotation) == 2 else turn[:, 2], rotation, atol=1e-9)


def test_a_six_joint_arm_has_its_eight_branches() -> None:
    rotation, position = pose(ur5(), (), UR5_START)
    solutions = inverse_kinematics(ur5(), TipTask(position=position, orientation=rotation))
    assert len(solutions) == 8
    assert [configuration.quality for configuration in solutions] == sorted(
        (p.quality for p in solutions), reverse=True
    )
    for configuration in solutions:
        assert_poses(ur5(), configuration.joints, rotation, position)
    nearest = min(np.abs(np.sin((configuration.joints - UR5_START) / 2)).max() for configuration in solutions)
    assert nearest < 1e-9


def test_random_starts_make_up_for_samples_outside_narrow_limits() -> None:
    """Of an arm on a gantry whose tool may roll, hardly any sample of the three free parameters keeps the limits."""
    machine, rng = build("CRX on a gantry"), np.random.default_rng(5)
    middle = np.concatenate([np.zeros(2), rng.uniform(-1, 1, 6)])
    narrow = [
        replace(joint, kind="revolute", lower=q - 0.4, upper=q + 0.4) if joint.kind == "continuous" else joint
        for joint, q in zip(machine.robot.moving_joints, middle, strict=True)
    ]
    joints = (*narrow, *(joint for joint in machine.robot.joints if not joint.moves))
    arm = FixedBase(Robot(machine.robot.links, joints, tip="tip"))
    rotation, position = pose(arm, (), middle)
    solutions = inverse_kinematics(arm, TipTask(position=position, direction=rotation[:, 2]), starts=64)
    assert len(solutions) >= 48
    for solution in solutions:
        assert_poses(arm, solution.joints, rotation[:, 2], position)
        assert ((solution.joints >= arm.robot.lower) & (solution.joints <= arm.robot.upper)).all()


@pytest.mark.parametrize("limits", [True, False])
def test_iterations_from_equations_and_targets_reach_the_poses(limits: bool) -> None:
    """Again and again with one set of functions."""
    rng, options, robot = (
        np.random.default_rng(3),
        dict[str, Any](starts=8, options=IkOptions(limits=limits)),
        panda().robot,
    )
    equations = None
    for seed in range(3):
        rotation, position = pose(panda(), (), rng.uniform(robot.lower, robot.upper))
        task = TipTask(position=position, orientation=rotation)
        equations = equations or bind(panda(), task)
        targets = np.concatenate([position, np.zeros(3), rotation.T.ravel(), np.zeros(3)])
        solutions = inverse_kinematics_at(equations, targets, seed=seed, **options)
        assert [each.quality for each in solutions] == sorted((each.quality for each in solutions), reverse=True)
        for solution in solutions:
            assert_poses(panda(), solution.joints, rotation, position)
            assert not limits or ((solution.joints >= robot.lower) & (solution.joints <= robot.upper)).all()
    with pytest.raises(Unreachable):
        inverse_kinematics_at(bind(panda(), task), targets + 5.0, seed=0, **options)


def test_a_two_link_arm_has_two_elbows_in_closed_form() -> None:
    machine = FixedBase(planar_chain([1.0, 0.7], [1.0, 1.0]))
    solutions = inverse_kinematics(machine, TipTask(position=(0.9, 0.6, 0.0), rows=(3, 4)), starts=16)
    elbow = np.arccos((0.9**2 + 0.6**2 - 1 - 0.49) / 1.4)
    assert sorted(
        np.round([np.remainder(p.joints[1] + np.pi, 2 * np.pi) - np.pi for p in solutions], 8)
    ) == pytest.approx([-elbow, elbow], abs=1e-7)


@settings(max_examples=5)
@given(seeds, st.booleans())
def test_reachable_poses_are_solved_within_the_limits(seed: int, free_roll: bool) -> None:
    rng = np.random.default_rng(seed)
    robot = panda().robot
    joints = rng.uniform(robot.lower, robot.upper)
    rotation, position = pose(panda(), (), joints)
    request: dict[str, Any] = {"direction": rotation[:, 2]} if free_roll else {"orientation": rotation}
    for configuration in inverse_kinematics(panda(), TipTask(position=position, **request)):
        assert (configuration.joints >= robot.lower).all()
        assert (configuration.joints <= robot.upper).all()
        assert_poses(panda(), configuration.joints, rotation[:, 2] if free_roll else rotation, position)


def test_the_base_may_float_and_two_arms_may_hold_one_thing() -> None:
    machine = floating_panda()
    rotation, position = pose(machine, BASE, PANDA_START)
    best = inverse_kinematics(machine, TipTask(position=position, orientation=rotation), options=IkOptions(base=BASE))[
        0
    ]
    np.testing.assert_allclose(pose(machine, BASE, best.joints)[1], position, atol=1e-9)
    both = two_pandas()
    tasks = [
        TipTask(position=(0.9, 0.0, 0.5), direction=(0.0, -1.0, 0.0), link="left_panda_hand"),
        TipTask(
            position=(0.0, 0.0, 0.4), direction=(0.0, 0.0, -1.0), link="right_panda_hand", relative_to="left_panda_hand"
        ),
    ]
    configuration = inverse_kinematics(both, tasks)[0]
    assert configuration.pose_error < 1e-10
    assert configuration.joints.shape == (14,)


def test_a_start_that_is_near_is_kept_and_seeds_repeat() -> None:
    rotation, position = pose(ur5(), (), UR5_START)
    task = TipTask(position=position, orientation=rotation)
    (only,) = inverse_kinematics(ur5(), task, starts=0, near=UR5_START + 0.05)
    np.testing.assert_allclose(only.joints, UR5_START, atol=1e-8)
    one, other = (inverse_kinematics(ur5(), task, seed=4, starts=8) for _ in range(2))
    np.testing.assert_array_equal([p.joints for p in one], [p.joints for p in other])


@pytest.mark.parametrize("limited", ["below", "above", "nowhere"])
def test_random_starts_of_joints_without_two_limits_are_spread_over_one_turn_within_them(limited: str) -> None:
    middle, unlimited = np.random.default_rng(3).uniform(-9, 9, 6), np.full(6, np.inf)
    lower, upper = middle if limited == "below" else -unlimited, middle if limited == "above" else unlimited
    starts = sample_starts(ur5(), lower, upper, 400, seed=0)
    assert ((lower <= starts) & (starts <= upper)).all()
    assert (np.ptp(starts, axis=0) <= 2 * np.pi).all()
    angles = np.sort(starts, axis=0)
    gaps = np.diff(np.vstack([angles, angles[:1] + 2 * np.pi]), axis=0)
    assert gaps.max() < 0.2


def test_the_nearest_miss_is_reported_and_pickled() -> None:
    machine = FixedBase(planar_chain([1.0, 0.7], [1.0, 1.0]))
    with pytest.raises(Unreachable, match=r"nearest miss is 0\.3 ") as caught:
        inverse_kinematics(machine, TipTask(position=(2.0, 0.0, 0.0), rows=(3, 4)))
    assert caught.value.pose_error == pytest.approx(0.3, abs=1e-6)
    np.testing.assert_allclose(np.sin(caught.value.joints), 0.0, atol=1e-3)
    again = pickle.loads(pickle.dumps(caught.value))
    assert (type(again), str(again)) == (Unreachable, str(caught.value))
    assert (again.name, again.value, again.pose_error) == ("link2", caught.value.pose_error, caught.value.pose_error)
    np.testing.assert_array_equal(again.joints, caught.value.joints)


def test_limits_refuse_forbidden_poses_and_name_the_joint() -> None:
    hinge = Joint("hinge", "revolute", "post", "door", lower=-0.5, upper=0.5)
    machine = FixedBase(Robot((Link("post"), Link("door")), (hinge,), tip_translation=(1.0, 0.0, 0.0)))
    task = TipTask(position=(np.cos(1.0), np.sin(1.0), 0.0), rows=(3, 4))
    with pytest.raises(Unreachable, match=r"\['hinge'\] at their limits"):
        inverse_kinematics(machine, task)
    assert inverse_kinematics(machine, task, options=IkOptions(limits=False))[0].joints[0] == pytest.approx(1.0)


def test_an_orientation_half_a_turn_away_is_no_solution() -> None:
    """The axial part of the error vanishes there: sin(pi) = 0."""
    pin = Joint("pin", "revolute", "post", "door", lower=-0.1, upper=0.1)
    machine = FixedBase(Robot((Link("post"), Link("door")), (pin,)))
    with pytest.raises(Unreachable) as caught:
        inverse_kinematics(machine, TipTask(orientation=np.diag([-1.0, -1.0, 1.0])))
    assert caught.value.pose_error > 1.0


@pytest.mark.parametrize(
    ("task", "changes", "message"),
    [
        (TipTask(rows=(3,), velocity=(0.0,)), {}, "need a pose"),
        (POINT, {"starts": -1}, "starts must be a whole number"),
        (POINT, {"starts": 0}, "no start"),
        (POINT, {"options": {"tolerance": 1e-6}}, "options must be"),
        (POINT, {"near": (0.0, 0.0)}, r"near has shape \(1, 2\)"),
        (TipTask(position=(0.0, 0.0, np.nan)), {}, "position .* not finite"),
        (TipTask(position=(0.0, 0.0)), {}, r"position has shape \(2, 1\)"),
        (TipTask(position=(0.0, 0.0, 0.0), link="tool1"), {}, "tool1"),
        ([], {}, "empty list"),
        (["left"], {}, "must be a TipTask"),
    ],
)
def test_requests_that_cannot_be_right_are_refused(task: Any, changes: dict[str, Any], message: str) -> None:
    with pytest.raises(ProblemError, match=message) as caught:
        inverse_kinematics(ur5(), task, **changes)
    assert (caught.value.name or "unnamed") in str(caught.value)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"tolerance": 0.0}, "tolerance must be positive"),
        ({"apart": -1.0}, "apart must be positive"),
        ({"iterations": 0}, "iterations must be a whole number"),
        ({"limits": "no"}, "limits must be"),
    ],
)
def test_options_that_cannot_be_right_are_refused(options: dict[str, Any], message: str) -> None:
    with pytest.raises(ProblemError, match=message):
        IkOptions(**options)
