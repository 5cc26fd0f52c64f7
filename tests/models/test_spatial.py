from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from models.spatial import (
    Frame,
    angular_velocity_from_quaternion,
    cross,
    expression,
    force_cross,
    force_transform,
    motion_cross,
    motion_transform,
    quaternion_about,
    quaternion_conjugate,
    quaternion_product,
    quaternion_rate,
    rotation,
    rotation_from_quaternion,
    rotation_from_rpy,
    skew,
    spatial_inertia,
)
from tests.models.robot.trees import (
    Array,
    numeric,
    random_frame,
    random_inertia,
    random_rotation,
    seeds,
    twist_by_differentiation,
    vee,
)

angles = st.floats(-10.0, 10.0)


def unit(rng: np.random.Generator, size: int) -> Array:
    vector = rng.normal(size=size)
    return vector / np.linalg.norm(vector)


def scipy_rotation(quaternion: Array) -> Rotation:
    return Rotation.from_quat(quaternion[[1, 2, 3, 0]])


@given(seeds)
def test_skew_and_cross_are_the_vector_product(seed: int) -> None:
    a, b = np.random.default_rng(seed).normal(size=(2, 3))
    np.testing.assert_allclose(numeric(skew(a)) @ b, np.cross(a, b), atol=1e-14)
    np.testing.assert_allclose(numeric(cross(a, b)).ravel(), np.cross(a, b), atol=1e-14)


@given(seeds, angles)
def test_rotation_agrees_with_scipy(seed: int, angle: float) -> None:
    axis = unit(np.random.default_rng(seed), 3)
    np.testing.assert_allclose(
        numeric(rotation(axis, angle)), Rotation.from_rotvec(axis * angle).as_matrix(), atol=1e-14
    )


@pytest.mark.parametrize("axis", [(1, 0, 0), (0, 1, 0), (0, 0, 1), (0, 0, -1)])
def test_rotation_about_a_coordinate_axis_has_five_entries_and_an_exact_one(axis: tuple[int, int, int]) -> None:
    angle = ca.SX.sym("angle")
    turn = rotation(axis, angle)
    along = int(np.flatnonzero(axis)[0])
    assert turn.nnz() == 5
    assert float(turn[along, along]) == 1.0


@given(angles, angles, angles)
def test_rpy_turns_about_fixed_axes_as_scipy(roll: float, pitch: float, yaw: float) -> None:
    expected = Rotation.from_euler("xyz", [roll, pitch, yaw]).as_matrix()
    np.testing.assert_allclose(numeric(rotation_from_rpy(roll, pitch, yaw)), expected, atol=1e-14)


@given(seeds, st.floats(0.01, 100.0))
def test_quaternion_of_any_norm_gives_the_rotation_of_its_direction(seed: int, norm: float) -> None:
    quaternion = unit(np.random.default_rng(seed), 4)
    expected = scipy_rotation(quaternion).as_matrix()
    np.testing.assert_allclose(numeric(rotation_from_quaternion(norm * quaternion)), expected, atol=1e-13)


@given(seeds)
def test_quaternion_product_composes_and_the_conjugate_inverts(seed: int) -> None:
    rng = np.random.default_rng(seed)
    a, b = unit(rng, 4), unit(rng, 4)
    product = numeric(quaternion_product(a, b)).ravel()
    np.testing.assert_allclose(
        numeric(rotation_from_quaternion(product)), (scipy_rotation(a) * scipy_rotation(b)).as_matrix(), atol=1e-14
    )
    np.testing.assert_allclose(
        numeric(quaternion_product(a, quaternion_conjugate(a))).ravel(), [1.0, 0, 0, 0], atol=1e-15
    )


@given(seeds, angles)
def test_quaternion_about_an_axis_is_the_rotation_about_it(seed: int, angle: float) -> None:
    axis = unit(np.random.default_rng(seed), 3)
    turn = rotation_from_quaternion(quaternion_about(axis, angle))
    np.testing.assert_allclose(numeric(turn), numeric(rotation(axis, angle)), atol=1e-14)


@given(seeds)
def test_quaternion_rate_gives_the_angular_velocity_of_the_rotation_and_keeps_the_norm(seed: int) -> None:
    rng = np.random.default_rng(seed)
    quaternion, omega = unit(rng, 4), rng.normal(size=3)
    symbol, rate = ca.SX.sym("quaternion", 4), quaternion_rate(quaternion, omega)
    twist = twist_by_differentiation(rotation_from_quaternion(symbol), ca.SX(3, 1), symbol, rate)
    found = numeric(ca.Function("f", [symbol], [twist])(quaternion)).ravel()
    np.testing.assert_allclose(found[0:3], omega, atol=1e-13)
    assert abs(float(ca.dot(rate, quaternion))) < 1e-15 * (1 + np.linalg.norm(omega))
    np.testing.assert_allclose(numeric(angular_velocity_from_quaternion(quaternion, rate)).ravel(), omega, atol=1e-14)


@given(seeds)
def test_force_transform_is_the_inverse_transpose_of_the_motion_transform(seed: int) -> None:
    frame = random_frame(np.random.default_rng(seed))
    product = numeric(force_transform(frame)).T @ numeric(motion_transform(frame))
    np.testing.assert_allclose(product, np.eye(6), atol=1e-13)


@given(seeds)
def test_motion_transforms_compose_as_frames_do(seed: int) -> None:
    rng = np.random.default_rng(seed)
    (r1, p1), (r2, p2) = random_frame(rng), random_frame(rng)
    both = numeric(motion_transform((r1 @ r2, p1 + r1 @ p2)))
    np.testing.assert_allclose(
        numeric(motion_transform((r1, p1))) @ numeric(motion_transform((r2, p2))), both, atol=1e-13
    )


@given(seeds)
def test_motion_cross_is_the_rate_of_the_motion_transform(seed: int) -> None:
    """A moving frame's transform obeys X' = (v x) X, with v the spatial velocity at the fixed origin."""
    rng = np.random.default_rng(seed)
    (turn, position), velocity = random_frame(rng), rng.normal(size=6)
    step = 1e-5

    def moved(time: float) -> Array:
        # Translation to first order only: enough for a central difference.
        turned = Rotation.from_rotvec(velocity[:3] * time).as_matrix()
        return numeric(motion_transform((turned @ turn, turned @ position + time * velocity[3:])))

    rate = (moved(step) - moved(-step)) / (2 * step)
    np.testing.assert_allclose(rate, numeric(motion_cross(velocity)) @ moved(0.0), atol=1e-7)


@given(seeds)
def test_force_cross_keeps_power_constant(seed: int) -> None:
    velocity, motion, force = np.random.default_rng(seed).normal(size=(3, 6))
    power_rate = (numeric(motion_cross(velocity)) @ motion) @ force + motion @ (numeric(force_cross(velocity)) @ force)
    assert abs(power_rate) < 1e-12
    np.testing.assert_allclose(numeric(motion_cross(velocity)) @ velocity, 0, atol=1e-14)


@given(seeds)
def test_spatial_inertia_gives_the_momentum_of_point_masses(seed: int) -> None:
    rng = np.random.default_rng(seed)
    masses, points, velocity = rng.uniform(0.1, 2, size=9), rng.normal(size=(9, 3)), rng.normal(size=6)
    center = masses @ points / masses.sum()
    inertia = sum(m * (r @ r * np.eye(3) - np.outer(r, r)) for m, r in zip(masses, points - center, strict=True))
    speeds = velocity[3:] + np.cross(velocity[:3], points)
    expected = np.concatenate([(masses[:, None] * np.cross(points, speeds)).sum(axis=0), masses @ speeds])
    found = numeric(spatial_inertia(masses.sum(), center, inertia)) @ velocity
    np.testing.assert_allclose(found, expected, atol=1e-12)


@given(seeds)
def test_spatial_inertia_transforms_as_a_map_from_motions_to_momenta(seed: int) -> None:
    rng = np.random.default_rng(seed)
    frame = Frame(*random_frame(rng))
    mass, center, inertia = 1.7, rng.normal(size=3), random_inertia(rng, 1.7)
    there = numeric(spatial_inertia(mass, center, inertia))
    here = spatial_inertia(mass, frame.point(center), frame.rotation @ inertia @ frame.rotation.T)
    to_here = numeric(force_transform(frame))
    np.testing.assert_allclose(numeric(here), to_here @ there @ to_here.T, atol=1e-12)


@pytest.mark.parametrize("symbols", [ca.SX, ca.MX])
def test_symbols_of_both_kinds_give_the_numeric_values(symbols: Any) -> None:
    rng = np.random.default_rng(7)
    a, b = rng.normal(size=6), rng.normal(size=6)
    turn = random_rotation(rng)

    def everything(x: Any, y: Any) -> list[Any]:
        frame = (turn, x[0:3])
        return [
            skew(x[0:3]),
            cross(x[0:3], y[0:3]),
            rotation((0, 0, 1), x[0]),
            rotation_from_rpy(x[0], x[1], y[0]),
            quaternion_product(x[0:4], y[0:4]),
            quaternion_conjugate(x[0:4]),
            quaternion_about((0, 1, 0), x[0]),
            rotation_from_quaternion(x[0:4]),
            quaternion_rate(x[0:4], y[0:3]),
            angular_velocity_from_quaternion(x[0:4], y[0:4]),
            motion_transform(frame),
            force_transform(frame),
            motion_cross(x),
            force_cross(x),
            spatial_inertia(2.0, x[0:3], np.eye(3)),
            vee(skew(x[0:3])),
        ]

    x, y = symbols.sym("x", 6), symbols.sym("y", 6)
    found = ca.Function("f", [x, y], everything(x, y))(a, b)
    for one, other in zip(found, everything(ca.DM(a), ca.DM(b)), strict=True):
        np.testing.assert_allclose(numeric(one), numeric(other), atol=1e-14)


@pytest.mark.parametrize("symbols", [ca.SX, ca.MX])
def test_lists_with_symbols_are_stacked_and_not_read_as_numbers(symbols: Any) -> None:
    a, b = symbols.sym("a"), symbols.sym("b", 2)

    def value(found: Any) -> Array:
        return numeric(ca.Function("f", [a, b], [found])(3.0, [5.0, 7.0]))

    assert value(expression([a, 0, 2.5])).ravel().tolist() == [3, 0, 2.5]
    assert value(expression((b, a))).ravel().tolist() == [5, 7, 3]
    assert value(expression(np.array([b[0], 1.0, a], dtype=object))).ravel().tolist() == [5, 1, 3]
    assert value(expression([[a, 1], [0, b[1]]])).tolist() == [[3, 1], [0, 7]]
    assert value(cross([a, 0, 0], (0, b[0], 0))).ravel().tolist() == [0, 0, 15]
    assert value(rotation((0, 0, 1), [a])).shape == (3, 3)
    assert expression([a, 0, 0]).sparsity().nnz() == 1


def test_a_list_of_casadi_numbers_is_a_matrix_of_them() -> None:
    assert numeric(expression([ca.DM(1), 2, ca.DM(3)])).ravel().tolist() == [1, 2, 3]
