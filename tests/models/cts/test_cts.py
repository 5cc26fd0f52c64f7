"""The captive trajectory rig: forward against the D-H product, inverse against forward, and the paper's misprints."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import casadi as ca
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from models import ModelError, Rig, Tunnel, reference_rig, reference_tunnel
from models.cts.rig import (
    BRANCHES,
    HOME,
    INCH,
    LENGTHS,
    Branch,
    dh_frames,
    forward,
    goose_neck_corner,
    inverse,
    task_jacobian,
)
from models.cts.roll import index_harmonics
from tests.models.cts.cts_oracle import Array, corner_by_rotation, index_by_geometry, joints_by_geometry, random_targets

RIG = reference_rig()
lengths = st.lists(st.floats(0.02, 3.0), min_size=6, max_size=6)
seeds = st.integers(0, 2**32 - 1)


def random_joints(seed: int) -> Array:
    rng = np.random.default_rng(seed)
    return np.concatenate([rng.uniform(-2, 2, 1), rng.uniform(-np.pi, np.pi, 5)])


def numeric(value: Any) -> Array:
    return np.array(ca.DM(value), dtype=float)


def pose_of(rig: Rig, q: Array) -> Array:
    return numeric(forward(rig, ca.DM(q))).ravel()


@given(lengths, seeds)
def test_closed_forward_is_the_dh_product(sizes: list[float], seed: int) -> None:
    rig, q = Rig(*sizes), random_joints(seed)
    position = numeric(dh_frames(rig, q)[-1].position).ravel()
    np.testing.assert_allclose(pose_of(rig, q)[:3], position, atol=1e-12)


@given(lengths, seeds)
def test_tool_rotation_is_yaw_pitch_roll_of_the_pose(sizes: list[float], seed: int) -> None:
    rig, q = Rig(*sizes), random_joints(seed)
    yaw, pitch, roll = pose_of(rig, q)[3:]
    cy, sy, cp, sp, cr, sr = np.cos(yaw), np.sin(yaw), np.cos(pitch), np.sin(pitch), np.cos(roll), np.sin(roll)
    turn_z = np.array([[cy, -sy, 0], [sy, cy, 0], [0, 0, 1]])
    turn_y = np.array([[cp, 0, sp], [0, 1, 0], [-sp, 0, cp]])
    turn_x = np.array([[1, 0, 0], [0, cr, -sr], [0, sr, cr]])
    np.testing.assert_allclose(numeric(dh_frames(rig, q)[-1].rotation), turn_z @ turn_y @ turn_x, atol=1e-12)


@pytest.mark.long
def test_inverse_of_forward_holds_the_joints_among_its_branches() -> None:
    """To 1e-10 wherever the pose, rounded to double, says so; near a stretched link it does not.

    There the rounding of the pose itself, 1e-16, is amplified by 1 / |cos q4 sin q2|: the inverse taken in extended
    precision is off by as much. Of 1e5 targets that is more than 1e-10 for a few with that product below 2e-5.
    """
    rig, count = reference_rig(), 100_000
    q = np.random.default_rng(6).uniform(-np.pi, np.pi, (6, count))
    perturbed = np.abs(np.cos(q[3]) * np.sin(q[1]))
    joints, x, roll = ca.SX.sym("q", 6), ca.SX.sym("x", 5), ca.SX.sym("roll")
    pose = np.array(ca.Function("f", [joints], [forward(rig, joints)]).map(count)(q))
    nearest, exact = np.full((2, count), np.inf)
    for branch in BRANCHES:
        result = ca.Function("i", [x, roll], [inverse(rig, x, roll, branch)[0]]).map(count)(pose[:5], pose[5:])
        nearest = np.minimum(nearest, np.abs(np.array(result) - q).max(axis=0))
        extended = joints_by_geometry(rig, pose[:5].astype(np.longdouble), pose[5].astype(np.longdouble), branch)[0]
        exact = np.fmin(exact, np.abs(extended - q).max(axis=0).astype(float))
    assert (nearest * perturbed).max() < 1e-14
    assert nearest[perturbed > 2e-5].max() < 1e-10
    assert np.mean(perturbed > 2e-5) > 0.9995
    assert np.mean(nearest > 1e-10) <= 1e-4
    assert nearest.max() < 3 * exact.max()


@given(lengths, seeds)
def test_forward_of_every_branch_is_the_target(sizes: list[float], seed: int) -> None:
    rig, q = Rig(*sizes), random_joints(seed)
    pose = pose_of(rig, q)
    for branch in BRANCHES:
        joints, reach = inverse(rig, ca.DM(pose[:5]), ca.DM(pose[5]), branch)
        if float(ca.mmin(reach)) >= 0:
            np.testing.assert_allclose(pose_of(rig, numeric(joints).ravel()), pose, atol=1e-10)
            assert np.sign(np.sin(float(joints[1]))) in (0, branch.yaw)
            assert np.sign(np.round(np.cos(float(joints[3])), 12)) in (0, branch.pitch)


@given(seeds, st.sampled_from(BRANCHES))
def test_inverse_is_that_of_plain_geometry(seed: int, branch: Branch) -> None:
    rig = reference_rig()
    rng = np.random.default_rng(seed)
    target, roll = random_targets(rng, 1), float(rng.uniform(-3, 3))
    joints, reach = inverse(rig, ca.DM(target), ca.DM(roll), branch)
    expected, reaches = joints_by_geometry(rig, target, roll, branch)
    assert (float(ca.mmin(reach)) >= 0) == bool(reaches[0])
    if reaches[0] and float(ca.mmin(reach)) > 1e-9:
        np.testing.assert_allclose(numeric(joints).ravel(), expected[:, 0], atol=1e-7)


@given(lengths, seeds)
def test_corner_is_the_end_of_the_pitch_link_in_the_dh_product(sizes: list[float], seed: int) -> None:
    rig, q = Rig(*sizes), random_joints(seed)
    pose = pose_of(rig, q)
    corner = numeric(goose_neck_corner(rig, ca.DM(pose[:5]), ca.DM(pose[5]))).ravel()
    np.testing.assert_allclose(corner, numeric(dh_frames(rig, q)[4].position).ravel(), atol=1e-12)
    np.testing.assert_allclose(corner, corner_by_rotation(rig, pose[:5, None], pose[5])[:, 0], atol=1e-12)


@given(lengths, seeds)
def test_index_has_two_harmonics(sizes: list[float], seed: int) -> None:
    rig = Rig(*sizes)
    rng = np.random.default_rng(seed)
    tunnel = Tunnel(rng.normal(size=3), rng.uniform(0.5, 2, 3), rng.uniform(0, 2, 3))
    target, roll = random_targets(rng, 1), rng.uniform(-3, 3)
    value = float(index_harmonics(rig, tunnel, ca.DM(target)).value(np.cos(roll), np.sin(roll)))
    assert value == pytest.approx(float(index_by_geometry(rig, tunnel, target, roll)[0]), rel=1e-11, abs=1e-12)


@given(seeds)
def test_jacobian_is_the_slope_of_forward(seed: int) -> None:
    rig, q, step = reference_rig(), random_joints(seed), 1e-6
    jacobian = numeric(task_jacobian(rig, ca.DM(q)))
    assert jacobian.shape == (5, 6)
    for k, direction in enumerate(np.eye(6)):
        slope = (pose_of(rig, q + step * direction) - pose_of(rig, q - step * direction))[:5] / (2 * step)
        np.testing.assert_allclose(jacobian[:, k], slope, atol=1e-8)


def test_limits_choose_the_turn_of_an_angle() -> None:
    rig = reference_rig(lower=(-9, -7.0, -9, -9, -9, -9), upper=(9, -4.0, 9, 9, 9, 9))
    target = ca.DM([100 * INCH, 6 * INCH, 0, 0, 0])
    free = numeric(inverse(reference_rig(), target, ca.DM(np.pi / 2), Branch(1, 1))[0]).ravel()
    turned = numeric(inverse(rig, target, ca.DM(np.pi / 2), Branch(1, 1))[0]).ravel()
    assert turned[1] == pytest.approx(free[1] - 2 * np.pi, abs=1e-12)
    np.testing.assert_allclose(pose_of(rig, turned)[:3], pose_of(rig, free)[:3], atol=1e-12)


@pytest.mark.parametrize("name", LENGTHS)
@pytest.mark.parametrize("value", [0.0, -0.1, np.nan, np.inf])
def test_a_length_that_is_not_positive_is_named(name: str, value: float) -> None:
    with pytest.raises(ModelError, match=name):
        Rig(**{**dict.fromkeys(LENGTHS, 1.0), name: value})


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: reference_rig(lower=(0, 0, 1, 0, 0, 0), upper=(1, 1, 0, 1, 1, 1)), "joint 3"),
        (lambda: reference_rig(lower=(0, -np.inf, 0, 0, 0, 0), upper=(1,) * 6), "joint 2"),
        (lambda: Tunnel((0, 0, 0), (1, 0, 1)), "ranges"),
        (lambda: Tunnel((0, 0, 0), (1, 1, 1), (1, -1, 1)), "weights"),
    ],
)
def test_limits_and_ranges_that_cannot_be_are_named(make: Callable[[], Any], message: str) -> None:
    with pytest.raises(ModelError, match=message):
        make()


# ---- the paper's misprints: each printed form fails, the corrected one holds -----------------------------------------


OFFSET = np.array([0, -np.pi / 2, 0, 0, np.pi / 2, 0])


@pytest.fixture(scope="module")
def sample() -> tuple[Array, Array, Any]:
    """Joints (6, n) and poses (6, n) of random configurations, and entry (i, k) of their tool rotations, (n,)."""
    q, symbol = OFFSET[:, None] + np.random.default_rng(17).uniform(-1.0, 1.0, (6, 200)), ca.SX.sym("q", 6)
    tool = dh_frames(RIG, symbol)[-1].rotation
    poses, turns = ca.Function("f", [symbol], [forward(RIG, symbol), ca.densify(ca.vec(tool.T))]).map(200)(q)
    return q, np.array(poses), lambda i, k: np.array(turns)[3 * i + k]


def misprint(right: Any, printed: Any, known: Any, least: float = 0.1) -> None:
    """The corrected form is the known value, the printed one far from it."""
    np.testing.assert_allclose(right, known, atol=1e-12)
    assert np.median(np.abs(printed - known)) > least


def test_home_values_of_table_1_are_not_offsets(sample: Any) -> None:
    for q, pose in zip(sample[0].T[:20], sample[1].T[:20], strict=True):
        taken, added = (numeric(dh_frames(RIG, joints)[-1].position).ravel() for joints in (q, q + OFFSET))
        np.testing.assert_allclose(taken, pose[:3], atol=1e-12)
        assert np.abs(added - pose[:3]).max() > 1e-2


def test_equation_8_lacks_a_cosine(sample: Any) -> None:
    q, _, turn = sample
    q23, rest = q[1] + q[2], np.cos(q[3] + q[4]) * np.sin(q[1] + q[2]) * np.cos(q[5])
    misprint(np.cos(q23) * np.sin(q[5]) + rest, q23 * np.sin(q[5]) + rest, turn(0, 2))


def test_equation_15_has_wrong_entries(sample: Any) -> None:
    _, pose, turn = sample
    (cy, cp, cr), (sy, sp, sr) = np.cos(pose[3:]), np.sin(pose[3:])
    misprint(-sy * cr + cy * sp * sr, -sy * cp + cy * sp * sr, turn(0, 1), 0.01)
    misprint(sy * sr + cy * sp * cr, sy * sp * cr + cy * sp * cr, turn(0, 2), 0.01)
    misprint(cy * cr + sy * sp * sr, cy * cp + sy * sp * sr, turn(1, 1), 0.01)
    misprint(-cy * sr + sy * sp * cr, -cy * sp * cr + sy * sp * cr, turn(1, 2), 0.01)


def test_equation_25_has_two_wrong_signs_and_equation_27_misses_the_tool_by_26_inches(sample: Any) -> None:
    q, pose, _ = sample
    (cy, cp), (sy, sp) = np.cos(pose[3:5]), np.sin(pose[3:5])
    c4, c6, s6 = np.cos(q[3]), np.cos(q[5]), np.sin(q[5])
    along = RIG.yaw_link_2 + RIG.sting * cp + RIG.pitch_link * c4 - RIG.goose_neck * sp * c6
    common, odd = pose[1] - sy * along, RIG.yaw_offset * cy + RIG.goose_neck * cy * s6
    misprint((common - odd) / RIG.yaw_link_1, (common + odd) / RIG.yaw_link_1, np.cos(q[1]))
    base = pose[0] + RIG.yaw_offset * sy + RIG.yaw_link_1 * np.sin(q[1]) + RIG.goose_neck * sy * s6
    misprint(base - cy * along, base + cy * along, q[0], 20 * INCH)


def test_equation_25_needs_the_branch_of_the_home_position() -> None:
    home = np.array([2.0, *OFFSET[1:]])
    target = ca.DM(pose_of(RIG, home)[:5])
    minus, plus = (numeric(inverse(RIG, target, ca.DM(0), branch)[0]).ravel() for branch in (HOME, Branch(1, 1)))
    np.testing.assert_allclose(minus, home, atol=1e-12)
    assert plus[1] == pytest.approx(np.pi / 2, abs=1e-12)


def test_equation_35_as_printed_does_not_depend_on_the_roll() -> None:
    rig, tunnel = RIG, reference_tunnel()
    roll = ca.SX.sym("roll")
    target = ca.DM([100 * INCH, 6 * INCH, 3 * INCH, 0.1, 0.1])
    corner = goose_neck_corner(rig, target, roll)
    right = ca.dot(tunnel.scale, (corner - tunnel.center) ** 2)
    printed = ca.SX(ca.dot(tunnel.scale, (ca.DM(tunnel.center) - ca.DM(tunnel.center)) ** 2))
    slopes = [float(ca.Function("g", [roll], [ca.gradient(f, roll)])(0.3)) for f in (right, printed)]
    assert abs(slopes[0]) > 1e-3
    assert slopes[1] == 0.0


def test_five_joints_would_not_do() -> None:
    """The text's P-R-R-R-R is a slip: without the sixth joint not every pose can be approached."""
    rig, q = reference_rig(), random_joints(3)
    joints = ca.SX.sym("q", 6)
    full = numeric(ca.Function("j", [joints], [ca.jacobian(forward(rig, joints), joints)])(q))
    assert np.linalg.matrix_rank(full) == 6
    assert np.linalg.matrix_rank(full[:, :5]) == 5
