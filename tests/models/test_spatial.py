from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from models.spatial import (
    angular_velocity_from_quaternion,
    cross,
    determinant,
    expression,
    force_transform,
    least_rotation,
    motion_transform,
    quaternion_product,
    rotation,
    rotation_from_quaternion,
    rotation_from_rpy,
    rotation_matrices,
    skew,
    solve_spd,
)
from tests.models.robot.trees import Array, numeric, random_frame, random_rotation, seeds, twist_by_differentiation, vee

angles = st.floats(-10.0, 10.0)


def unit(rng: np.random.Generator, size: int) -> Array:
    vector = rng.normal(size=size)
    return vector / np.linalg.norm(vector)


def scipy_rotation(quaternion: Array) -> Rotation:
    return Rotation.from_quat(quaternion[[1, 2, 3, 0]])


def close(result: Any, expected: Any, tolerance: float = 1e-14) -> None:
    """Vectors are compared as vectors, whether they are columns or not."""
    known = np.asarray(expected)
    np.testing.assert_allclose(numeric(result).reshape(known.shape), known, atol=tolerance)


@given(seeds)
def test_skew_and_cross_are_the_vector_product(seed: int) -> None:
    a, b = np.random.default_rng(seed).normal(size=(2, 3))
    close(ca.mtimes(skew(a), b), np.cross(a, b))
    close(cross(a, b), np.cross(a, b))


@given(seeds, angles)
def test_rotation_agrees_with_scipy(seed: int, angle: float) -> None:
    axis = unit(np.random.default_rng(seed), 3)
    close(rotation(axis, angle), Rotation.from_rotvec(axis * angle).as_matrix())


@pytest.mark.parametrize("axis", [(1, 0, 0), (0, 1, 0), (0, 0, 1), (0, 0, -1)])
def test_rotation_about_a_coordinate_axis_has_five_entries_and_an_exact_one(axis: tuple[int, int, int]) -> None:
    angle = ca.SX.sym("angle")
    turn = rotation(axis, angle)
    along = int(np.flatnonzero(axis)[0])
    assert turn.nnz() == 5
    assert float(turn[along, along]) == 1.0


@given(angles, angles, angles)
def test_rpy_turns_about_fixed_axes_as_scipy(roll: float, pitch: float, yaw: float) -> None:
    close(rotation_from_rpy(roll, pitch, yaw), Rotation.from_euler("xyz", [roll, pitch, yaw]).as_matrix())


@given(seeds, st.floats(0.01, 100.0))
def test_quaternion_of_any_norm_gives_the_rotation_of_its_direction(seed: int, norm: float) -> None:
    quaternion = unit(np.random.default_rng(seed), 4)
    close(rotation_from_quaternion(norm * quaternion), scipy_rotation(quaternion).as_matrix(), 1e-13)


@given(seeds)
def test_quaternion_product_composes_and_the_conjugate_inverts(seed: int) -> None:
    rng = np.random.default_rng(seed)
    a, b = unit(rng, 4), unit(rng, 4)
    both = scipy_rotation(a) * scipy_rotation(b)
    close(rotation_from_quaternion(quaternion_product(a, b)), both.as_matrix())
    close(quaternion_product(a, a * [1, -1, -1, -1]), [1.0, 0, 0, 0], 1e-15)


@given(seeds)
def test_the_angular_velocity_is_that_of_the_rotation_of_a_changing_quaternion(seed: int) -> None:
    rng = np.random.default_rng(seed)
    quaternion, omega = unit(rng, 4), rng.normal(size=3)
    symbol, rate = ca.SX.sym("quaternion", 4), quaternion_product([0, *omega], quaternion) / 2
    twist = twist_by_differentiation(rotation_from_quaternion(symbol), ca.SX(3, 1), symbol, rate)
    close(ca.Function("f", [symbol], [twist])(quaternion)[0:3], omega, 1e-13)
    close(angular_velocity_from_quaternion(quaternion, rate), omega)


@given(seeds)
def test_force_transform_is_the_inverse_transpose_of_the_motion_transform(seed: int) -> None:
    frame = random_frame(np.random.default_rng(seed))
    close(ca.mtimes(force_transform(frame).T, motion_transform(frame)), np.eye(6), 1e-13)


@given(seeds)
def test_motion_transforms_compose_as_frames_do(seed: int) -> None:
    rng = np.random.default_rng(seed)
    (r1, p1), (r2, p2) = random_frame(rng), random_frame(rng)
    product = ca.mtimes(motion_transform((r1, p1)), motion_transform((r2, p2)))
    close(product, numeric(motion_transform((r1 @ r2, p1 + r1 @ p2))), 1e-13)


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
            rotation_from_quaternion(x[0:4]),
            angular_velocity_from_quaternion(x[0:4], y[0:4]),
            motion_transform(frame),
            force_transform(frame),
            vee(skew(x[0:3])),
        ]

    x, y = symbols.sym("x", 6), symbols.sym("y", 6)
    result = ca.Function("f", [x, y], everything(x, y))(a, b)
    for one, other in zip(result, everything(ca.DM(a), ca.DM(b)), strict=True):
        close(one, numeric(other))


@pytest.mark.parametrize("symbols", [ca.SX, ca.MX])
def test_lists_with_symbols_are_stacked_and_not_read_as_numbers(symbols: Any) -> None:
    a, b = symbols.sym("a"), symbols.sym("b", 2)

    def value(result: Any) -> Array:
        return numeric(ca.Function("f", [a, b], [result])(3.0, [5.0, 7.0]))

    assert value(expression([a, 0, 2.5])).ravel().tolist() == [3, 0, 2.5]
    assert value(expression((b, a))).ravel().tolist() == [5, 7, 3]
    assert value(expression(np.array([b[0], 1.0, a], dtype=object))).ravel().tolist() == [5, 1, 3]
    assert value(expression([[a, 1], [0, b[1]]])).tolist() == [[3, 1], [0, 7]]
    assert value(cross([a, 0, 0], (0, b[0], 0))).ravel().tolist() == [0, 0, 15]
    assert value(rotation((0, 0, 1), [a])).shape == (3, 3)
    assert expression([a, 0, 0]).sparsity().nnz() == 1


def test_a_list_of_casadi_numbers_is_a_matrix_of_them() -> None:
    assert numeric(expression([ca.DM(1), 2, ca.DM(3)])).ravel().tolist() == [1, 2, 3]


# ---- small matrices ---------------------------------------------------------------------------------------------


def random_spd(rng: np.random.Generator, size: int) -> Array:
    square = rng.normal(size=(size, size))
    return square @ square.T + 0.1 * np.eye(size)


@given(seeds, st.integers(1, 7), st.integers(1, 7))
def test_solve_spd_agrees_with_numpy(seed: int, size: int, columns: int) -> None:
    rng = np.random.default_rng(seed)
    matrix, right = random_spd(rng, size), rng.normal(size=(size, columns))
    expected = np.linalg.solve(matrix, right)
    np.testing.assert_allclose(numeric(solve_spd(matrix, right)), expected, rtol=1e-10, atol=1e-10)


@pytest.mark.parametrize("symbols", [ca.SX, ca.MX])
@pytest.mark.parametrize("size", range(1, 8))
def test_solve_spd_and_determinant_take_symbols(symbols: Any, size: int) -> None:
    rng = np.random.default_rng(size)
    matrix, right = random_spd(rng, size), rng.normal(size=(size, 3))
    a, b = symbols.sym("a", size, size), symbols.sym("b", size, 3)
    x, d = ca.Function("f", [a, b], [solve_spd(a, b), determinant(a)])(matrix, right)
    np.testing.assert_allclose(numeric(x), np.linalg.solve(matrix, right), rtol=1e-9, atol=1e-10)
    np.testing.assert_allclose(float(d), np.linalg.det(matrix), rtol=1e-10)


def test_solve_spd_derivative_is_minus_inverse_times_change_times_solution() -> None:
    rng = np.random.default_rng(3)
    matrix, right, change = random_spd(rng, 5), rng.normal(size=5), random_spd(rng, 5)
    step = ca.SX.sym("step")
    moved = solve_spd(ca.DM(matrix) + step * ca.DM(change), ca.DM(right))
    slope = numeric(ca.Function("f", [step], [ca.jacobian(moved, step)])(0)).ravel()
    solution = np.linalg.solve(matrix, right)
    np.testing.assert_allclose(slope, -np.linalg.solve(matrix, change @ solution), rtol=1e-9)


def test_structural_zeros_stay_zero_and_cost_nothing() -> None:
    a, b = ca.SX.sym("a", ca.Sparsity.diag(4)), ca.SX.sym("b", 4)
    x = solve_spd(a, b)
    assert ca.Function("f", [a, b], [x]).n_instructions() <= 4 * 5
    result = ca.Function("f", [a, b], [x])(ca.DM(np.diag([1.0, 2, 4, 8])).sparsity(), [1, 1, 1, 1])
    np.testing.assert_allclose(numeric(result).ravel(), 1.0)


@pytest.mark.parametrize("size", range(3, 8))
def test_solve_spd_takes_less_than_half_or_so_of_the_instructions_of_casadi(size: int) -> None:
    lower, right = ca.SX.sym("a", ca.Sparsity.lower(size)), ca.SX.sym("b", size)
    matrix = ca.tril2symm(lower)
    ours, theirs = (
        ca.Function("f", [lower, right], [x]).n_instructions()
        for x in (solve_spd(matrix, right), ca.solve(matrix, right))
    )
    assert ours < 0.5 * theirs


@given(seeds, st.integers(1, 7))
def test_determinant_agrees_with_numpy(seed: int, size: int) -> None:
    matrix = np.random.default_rng(seed).normal(size=(size, size))
    np.testing.assert_allclose(float(determinant(matrix)), np.linalg.det(matrix), rtol=1e-9, atol=1e-9)


@given(seeds, st.integers(2, 7))
def test_determinant_of_a_singular_matrix_is_finite_and_zero(seed: int, size: int) -> None:
    matrix = np.round(4 * np.random.default_rng(seed).normal(size=(size, size)))
    matrix[-1] = matrix[0]
    assert float(determinant(matrix)) == 0.0
    assert float(determinant(np.zeros((size, size)))) == 0.0


@given(seeds)
def test_rotation_matrices_are_those_of_scipy(seed: int) -> None:
    rng = np.random.default_rng(seed)
    vectors = rng.normal(size=(2, 4, 3)) * 10.0 ** rng.integers(-12, 2, (2, 4, 1))
    expected = Rotation.from_rotvec(vectors.reshape(-1, 3)).as_matrix()
    np.testing.assert_allclose(rotation_matrices(vectors).reshape(-1, 3, 3), expected, atol=1e-14)
    np.testing.assert_array_equal(rotation_matrices(np.zeros(3)), np.eye(3))


@given(seeds, st.floats(-16, 0), st.booleans())
def test_the_least_rotation_turns_one_vector_to_another_about_the_axis_across(
    seed: int, size: float, back: bool
) -> None:
    rng = np.random.default_rng(seed)
    first, step = rng.normal(size=(2, 3))
    second = (-first if back else first) + 10.0**size * step
    first, second = (vector / np.linalg.norm(vector) for vector in (first, second))
    for end in (second, -first, first):
        turn = least_rotation(first, end)
        np.testing.assert_allclose(turn @ first, end, atol=1e-14)
        np.testing.assert_allclose(turn.T @ turn, np.eye(3), atol=1e-14)
        assert np.linalg.det(turn) == pytest.approx(1.0)
        angle = np.linalg.norm(Rotation.from_matrix(turn).as_rotvec())
        assert angle == pytest.approx(np.arctan2(np.linalg.norm(np.cross(first, end)), first @ end), abs=1e-7)
