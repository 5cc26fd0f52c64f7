"""SCARA arms against an independent model: forward and inverse kinematics, limits and singularities."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import casadi as ca
import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from models import Arc, Line, ModelError, Path, Scara, scara_along, smooth, tip_jacobian, tip_pose
from models.machines.scara import ScaraPath
from ocp import ProblemError
from ocp.motion.schedule import JointLimits, LineLimits, schedule
from tests.models.paths.task_paths import random_arm_path, seeds, turned

pytestmark = pytest.mark.filterwarnings("ignore:overlap='shrink'")  # blends of random paths may overlap
EVEN = Scara(0.4, 0.4)
NAN = float("nan")


def number(value: Any) -> NDArray[np.float64]:
    return np.array(ca.DM(value))


def along(*points: Any, arm: Scara = EVEN, **options: Any) -> ScaraPath:
    return scara_along(arm, smooth(Path.through(points), 0.05), **options)


@given(seeds)
def test_forward_kinematics_are_those_of_the_arm_as_a_tree_of_links(seed: int) -> None:
    rng = np.random.default_rng(seed)
    arm = Scara(10 ** rng.uniform(-2, 1), 10 ** rng.uniform(-2, 1), mount=rng.normal(size=3))
    q = rng.uniform(-3, 3, 4)
    own, tree = arm.forward(q), tip_pose(arm.robot, q)
    assert number(own.position) == pytest.approx(number(tree.position), abs=1e-13 * (1 + arm.outer))
    assert number(own.rotation) == pytest.approx(number(tree.rotation), abs=1e-14)


@given(seeds, st.sampled_from(["left", "right"]), st.sampled_from(["inside", "stretched", "folded"]))
def test_the_inverse_leads_back_to_the_point_with_the_requested_elbow(seed: int, elbow: Any, where: str) -> None:
    rng = np.random.default_rng(seed)
    arm = Scara(10 ** rng.uniform(-1, 1), 10 ** rng.uniform(-1, 1), mount=rng.normal(size=3))
    radius = {"inside": rng.uniform(arm.inner, arm.outer), "stretched": arm.outer, "folded": arm.inner}[where]
    angle, yaw = rng.uniform(-np.pi, np.pi), rng.uniform(-9, 9)
    point = arm.mount + np.array([radius * np.cos(angle), radius * np.sin(angle), rng.normal()])
    q = arm.inverse(point, yaw, elbow)
    assert number(arm.forward(q).position).ravel() == pytest.approx(point, abs=1e-12 * (1 + arm.outer))
    assert q[0] + q[1] + q[3] == pytest.approx(yaw, abs=1e-12)
    assert q[1] >= -1e-15 if elbow == "left" else q[1] <= 1e-15 or q[1] == pytest.approx(np.pi)


def test_whole_turns_keep_joint_limits_where_they_can() -> None:
    arm = Scara(0.4, 0.4, lower=(0, -3, -1, 5), upper=(6, 3, 1, 12))
    q = arm.inverse((0.1, -0.5, 0), 0.3)
    assert (arm.lower <= q).all()
    assert (q <= arm.upper).all()
    assert number(arm.forward(q).position).ravel() == pytest.approx([0.1, -0.5, 0], abs=1e-14)
    assert np.sin((q[0] + q[1] + q[3] - 0.3) / 2) == pytest.approx(0, abs=1e-14)


@given(seeds, st.integers(0, 3))
def test_the_turn_is_the_smallest_that_brings_a_range_within_its_limits_and_none_for_the_quill(
    seed: int, joint: int
) -> None:
    rng = np.random.default_rng(seed)
    low = rng.uniform(-8, 4, 4)
    high = low + rng.uniform(0, 8, 4)
    arm = Scara(0.4, 0.4, lower=low, upper=high)
    least = float(rng.uniform(-20, 20))
    most = least + float(rng.uniform(0, 4))
    quill = arm.robot.moving_joints[joint].kind == "prismatic"
    turns = [0.0] if quill else sorted((2 * np.pi * k for k in range(-9, 10)), key=abs)
    held = [turn for turn in turns if low[joint] <= least + turn and most + turn <= high[joint]]
    result = arm.whole_turn(joint, least, most)
    assert result == (pytest.approx(held[0], abs=1e-12) if held else None)


@settings(max_examples=40)
@given(seeds)
def test_rates_along_a_path_are_differences_and_follow_the_tools_twist(seed: int) -> None:
    rng = np.random.default_rng(seed)
    arm = random_arm_path(rng)
    assume(arm is not None)
    assert arm is not None
    path = arm.path
    s = path.bounds[:-1] + rng.uniform(0.05, 0.95, len(path.piece_lengths)) * path.piece_lengths
    h = 1e-6 * path.piece_lengths
    before, here, after = (arm.at(s + k * h) for k in (-1, 0, 1))
    for order in range(3):
        difference = (after[order] - before[order]) / (2 * h[:, None])
        assert difference == pytest.approx(here[order + 1], rel=1e-4, abs=1e-4 * (1 + np.abs(here[order + 1]).max()))
    place, turn = path.at(s), path.turn(s)
    for k in range(len(s)):
        # independent: the tree's Jacobian, angular part first
        jacobian = number(tip_jacobian(arm.scara.robot, here.position[k]))
        twist = np.concatenate([turn.rate[k], place.tangent[k]])
        assert jacobian @ here.first[k] == pytest.approx(twist, abs=1e-9 * (1 + np.abs(twist).max()))
        tip = number(tip_pose(arm.scara.robot, here.position[k]).position).ravel()
        assert tip == pytest.approx(place.position[k], abs=1e-12)


def test_joints_are_continuous_where_their_angles_pass_half_a_turn() -> None:
    circle = Arc.about((0.5, 0, 0), (0, 0, 0), (0, 0, 1), 2 * np.pi)
    arm = scara_along(EVEN, smooth(Path((circle, Line((0.5, 0, 0), (0.5, 0.2, 0.1)))), 0.02))
    q = arm.at(np.linspace(0, arm.path.length, 5001)).position
    assert np.abs(np.diff(q, axis=0)).max() < 0.01
    assert np.ptp(q[:, 0]) > 2 * np.pi - 0.5


@pytest.mark.long
@settings(max_examples=10)
@given(seeds)
def test_a_joint_limit_that_only_a_place_between_samples_breaks_is_seen(seed: int) -> None:
    rng = np.random.default_rng(seed)
    y = rng.uniform(0.2, 0.6)
    path = smooth(Path.through([(-rng.uniform(0.2, 0.4), y, 0), (rng.uniform(0.2, 0.4), y, 0)]), 0.1)
    free = scara_along(EVEN, path)
    most = float(free.at(np.linspace(0, path.length, 20001)).position[:, 1].max())
    fits, stops = (Scara(0.4, 0.4, lower=(-9, -1, -1, -9), upper=(9, most + slack, 1, 9)) for slack in (1e-6, -1e-6))
    scara_along(fits, path)
    with pytest.raises(ModelError, match="'elbow'"):
        scara_along(stops, path)


def test_a_quill_limit_may_be_reached_exactly() -> None:
    arm = Scara(0.4, 0.4, mount=(0.1, 0.2, 0.3), lower=(-4, -4, -0.3, -9), upper=(4, 4, 0.1, 9))
    along((0.5, 0.2, 0.4), (0.6, 0.3, 0.0), (0.5, 0.4, 0.1), arm=arm)
    with pytest.raises(ModelError, match=r"'quill' at -0\.3000"):
        arm.inverse((0.5, 0.2, -1e-5))


TILTED = Path.through([(0.5, 0, 0), (0.5, 0.2, 0)], [turned((0, 0, 0)), turned((0.1, 0, 0))])


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Scara(0.0, 1.0), r"upper_arm must be positive and finite \(in m\), not 0.0"),
        (lambda: Scara(1.0, NAN), "forearm must be .*, not nan"),
        (lambda: Scara(1.0, 1.0, lower=(1, 0, 0, 0), upper=(0, 0, 0, 0)), "'shoulder'"),
        (lambda: Scara(1.0, 1.0, names=("a", "a", "b", "c")), "four that differ"),
        (lambda: EVEN.inverse((0.81, 0, 0)), "unreachable"),
        (lambda: Scara(0.4, 0.3).inverse((0.05, 0, 0)), r"unreachable.*from 0\.1 to 0\.7"),
        (lambda: EVEN.inverse((NAN, 0, 0)), "not finite"),
        (lambda: EVEN.inverse((0.5, 0, 0), NAN), "yaw"),
        (lambda: EVEN.inverse((0.5, 0, 0), 0.0, "up"), "elbow must be .*, not 'up'"),  # type: ignore[arg-type]
        (lambda: EVEN.forward((0, 0, 0)), r"joints has shape \(3, 1\)"),
        (lambda: along((0.5, 0, 0), (-0.5, 0, 0)), r"at 0\.5 m.*singular column"),
        (lambda: along((0.5, 5e-4, 0), (-0.5, 5e-4, 0)), "singular column"),
        (lambda: along((0.5, 0, 0), (0.9, 0, 0)), "unreachable"),
        (lambda: along((0.5, 0, 0), (0.8, 0, 0)), "stretched arm is singular"),
        (lambda: along((0.5, 0, 0), (0.5, 0.2, 0), clearance=NAN), "clearance must be .*, not nan"),
        (lambda: along((0.5, 0, 0), (0.5, 0.2, 0), elbow="up"), "elbow must be .*, not 'up'"),
        (lambda: scara_along(EVEN, smooth(TILTED, 0.1)), "tilts its tool"),
        (lambda: along((0.5, 0, 0), (0.5, 0.3, 0), (-0.5, -0.3 + 1e-5, 0)), "singular column"),  # between the samples
    ],
)
def test_infeasible_targets_of_the_arm_are_named_errors(make: Callable[[], Any], message: str) -> None:
    with pytest.raises(ModelError, match=message):
        make()


def test_a_schedule_of_a_path_that_ends_at_the_singular_reach_is_a_named_error() -> None:
    arm = along((0.3, 0, 0), (0.8, 0, 0), clearance=0.0)
    with pytest.raises(ProblemError, match=r"joint 'shoulder' is \w+, not finite, at 0\.5 m, the arm is singular"):
        schedule(arm.path, LineLimits(1.0, 5.0, 200.0, joints=JointLimits(1.0, 20.0)), joints=arm)
