"""Algorithms 1-4 against automatic differentiation of link frames, which shares nothing with them.

Errors are relative to the greatest entry of what is compared. The printed forms of the corrected equations stand here,
on the same data as the corrected ones, beside a proof that they fail.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import casadi as ca
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from models import FreeFloating, Joint, Link, ModelError, Robot
from scripts.papers.free_floating.costates import generalized_jacobian
from scripts.papers.free_floating.recursion import D, J, dD, dJ
from scripts.papers.free_floating.virtual_chain import VirtualChain, joint_transform, motion_cross, transforms
from tests.models.robot.chains import CLEARLY, TOLERANCE, Case, by_index, error, every_case, example, spatial_case
from tests.models.robot.trees import Array, numeric, vee


@every_case
def test_transforms_place_the_tip_where_the_tree_does(build: Any, size: int) -> None:
    """(12): EX_0 = [R, 0; -R [r_E x], R]."""
    case = build(size)
    X = case.chain.X_tip @ np.linalg.multi_dot(transforms(case.chain, case.x)[::-1])
    R, r = (numeric(part) for part in case.truth(case.x)[4:6])
    assert error(X[:3, :3], R) < TOLERANCE
    assert error(X[3:, 3:], R) < TOLERANCE
    assert error(X[3:, :3], -R @ numeric(ca.skew(r))) < TOLERANCE
    assert not X[:3, 3:].any()


def test_partials_of_a_joint_transform_are_the_papers() -> None:
    """(41): dX/dq = -[S x] X, by the exponential series of -[S x] q."""
    rng = np.random.default_rng(1)
    axis = rng.normal(size=3)
    axis /= np.linalg.norm(axis)
    for S in (np.concatenate([axis, np.zeros(3)]), np.concatenate([np.zeros(3), axis])):
        term = series = np.eye(6)
        for power in range(1, 40):
            term = term @ motion_cross(S) * (-1.3 / power)
            series = series + term
        assert error(joint_transform(S, 1.3), series) < TOLERANCE


def test_virtual_links_are_massless_and_the_last_is_the_satellite() -> None:
    case = example()
    assert case.chain.N == 6
    assert case.chain.n == 3
    assert not case.chain.H[:2].any()
    assert case.chain.H[2, 3:, 3:].tolist() == (100.0 * np.eye(3)).tolist()
    assert case.chain.H[2, 2, 2] == 66.67
    assert sum(H[5, 5] for H in spatial_case(7).chain.H) == pytest.approx(spatial_case(7).machine.robot.total_mass)


# Algorithms 1-4


@every_case
def test_algorithm_1_is_the_momentum_of_differentiated_frames(build: Any, size: int) -> None:
    case = build(size)
    assert error(D(case.chain, case.x), numeric(case.truth(case.x)[0])) < TOLERANCE


@every_case
def test_algorithm_1_is_the_momentum_matrices_in_virtual_coordinates(build: Any, size: int) -> None:
    """E1, E2 of the models take a base twist; the rates of the virtual joints make that twist."""
    case = build(size)
    n, x1 = case.chain.n, case.x[: case.chain.n]
    if n == 3:
        base, twist_of_rates = x1, np.eye(3)[[2, 0, 1]]
    else:
        turn = Rotation.from_euler("XYZ", x1[3:])
        base = np.concatenate([x1[:3], turn.as_quat(scalar_first=True)])
        first = Rotation.from_euler("X", x1[3]).as_matrix()
        axes = [np.eye(3)[0], first[:, 1], turn.as_matrix()[:, 2]]
        twist_of_rates = np.block([[np.zeros((3, 3)), np.column_stack(axes)], [np.eye(3), np.zeros((3, 3))]])
    E1, E2 = (numeric(part) for part in case.machine.momentum_matrices(base, case.x[n:]))
    result = D(case.chain, case.x)[case.chain.momentum_rows]
    assert error(result, np.hstack([E1 @ twist_of_rates, E2])) < TOLERANCE
    expected = numeric(case.machine.tip_jacobian(base, case.x[n:]))
    assert error(generalized_jacobian(case.chain, case.x), expected) < TOLERANCE


@every_case
def test_algorithm_2_is_the_derivative_of_the_tip_frame(build: Any, size: int) -> None:
    case = build(size)
    assert error(J(case.chain, case.x), numeric(case.truth(case.x)[1])) < TOLERANCE


@every_case
def test_algorithm_3_is_the_derivative_of_the_momentum_matrix(build: Any, size: int) -> None:
    case = build(size)
    expected = by_index(case.truth(case.x)[2], (6, case.chain.N))
    assert error(dD(case.chain, case.x), expected) < TOLERANCE


@every_case
def test_algorithm_4_is_the_derivative_of_the_tip_jacobian(build: Any, size: int) -> None:
    case = build(size)
    expected = by_index(case.truth(case.x)[3], (6, case.chain.N))
    assert error(dJ(case.chain, case.x), expected) < TOLERANCE


# The equations that do not hold as printed


@pytest.mark.parametrize("size", [3, 7])
def test_equation_21_as_printed_is_minus_the_velocity_in_end_effector_axes(size: int) -> None:
    case = spatial_case(size)
    truth = case.truth(case.x)
    omega, R = numeric(truth[1])[:3], numeric(truth[4])
    R_x = by_index(truth[6], (3, 3))
    corrected = np.column_stack([numeric(vee(-R.T @ partial)) for partial in R_x])
    printed = np.column_stack([numeric(vee(partial @ R.T)) for partial in R_x])
    assert error(corrected, omega) < TOLERANCE
    assert error(printed, -R @ omega) < TOLERANCE
    assert error(printed, omega) > 0.5
    # A planar turn looks the same from both axes: there the printed form has the wrong sign only.
    truth = example().truth(example().x)
    R, R_x = numeric(truth[4]), by_index(truth[6], (3, 3))
    printed = np.column_stack([numeric(vee(partial @ R.T)) for partial in R_x])
    assert error(printed, -numeric(truth[1])[:3]) < TOLERANCE


@pytest.mark.parametrize("build", [lambda: spatial_case(7), example], ids=["6+7", "example"])
def test_equations_20_to_22_hold_for_the_inertial_velocity_only(build: Any) -> None:
    """Extracted in the axes of (21) as printed, those of the end effector, or about another point, v_E is no column."""
    case = build()
    truth = case.truth(case.x)
    linear, R, r = numeric(truth[1])[3:], numeric(truth[4]), numeric(ca.skew(truth[5]))
    R_x, lower_x = by_index(truth[6], (3, 3)), by_index(truth[8], (3, 3))
    inertial, end_effector, other_point = (np.zeros((3, case.chain.N)) for _ in range(3))
    for i in range(case.chain.N):
        Y = np.block([[R_x[i], np.zeros((3, 3))], [lower_x[i], R_x[i]]])  # (20), by automatic differentiation
        extracted = -R.T @ (Y[3:, :3] + Y[:3, :3] @ r)
        assert np.abs(extracted + extracted.T).max() < TOLERANCE * np.abs(Y).max()  # it is a [v x]
        inertial[:, i] = numeric(vee(extracted)).ravel()
        end_effector[:, i] = numeric(vee(-(Y[3:, :3] + Y[:3, :3] @ r) @ R.T)).ravel()
        other_point[:, i] = numeric(vee(-R.T @ Y[3:, :3])).ravel()
    assert error(inertial, linear) < TOLERANCE
    assert error(end_effector, R @ linear) < TOLERANCE
    assert error(end_effector, linear) > 0.5
    assert error(other_point, linear) > CLEARLY


@pytest.mark.parametrize("size", [3, 7])
def test_equation_51_as_printed_differentiates_equation_21_as_printed(size: int) -> None:
    case = spatial_case(size)
    N, truth = case.chain.N, case.truth(case.x)
    omega, omega_x = numeric(truth[1])[:3], by_index(truth[3], (6, N))[:, :3]
    R, R_x = numeric(truth[4]), by_index(truth[6], (3, 3))
    R_xx = numeric(truth[7]).T.reshape(N, N, 3, 3).transpose(0, 1, 3, 2)  # [k, i]
    corrected, printed, of_printed = (np.zeros((N, 3, N)) for _ in range(3))
    for k in range(N):
        for i in range(N):
            corrected[k, :, i] = numeric(vee(-(R_x[k].T @ R_x[i] + R.T @ R_xx[k, i]))).ravel()
            printed[k, :, i] = numeric(vee(R_xx[k, i] @ R.T + R_x[i] @ R_x[k].T)).ravel()
        of_printed[k] = -(R_x[k] @ omega + R @ omega_x[k])
    assert error(corrected, omega_x) < TOLERANCE
    assert error(printed, of_printed) < TOLERANCE
    assert error(printed, omega_x) > 0.5


def momentum_partials(case: Case, printed: bool) -> Array:
    """Algorithm 3 with (43) as printed, third term X~^T B X~, or corrected. Shape (N, 6, N)."""
    chain, N = case.chain, case.chain.N
    X = transforms(chain, case.x)
    result = np.zeros((N, 6, N))
    for k in range(N):
        X_ = [-motion_cross(chain.S[i]) @ X[i] if i == k else np.zeros((6, 6)) for i in range(N)]
        A, A_ = [X[0].T], [X_[0].T]
        for i in range(1, N):
            A_.append(A_[-1] @ X[i].T + A[-1] @ X_[i].T)
            A.append(A[-1] @ X[i].T)
        B, B_ = chain.H[-1], np.zeros((6, 6))
        for i in reversed(range(N)):
            if i < N - 1:
                left = X_[i + 1].T if printed else X[i + 1].T
                B_ = X_[i + 1].T @ B @ X[i + 1] + X[i + 1].T @ B_ @ X[i + 1] + left @ B @ X_[i + 1]
                B = chain.H[i] + X[i + 1].T @ B @ X[i + 1]
            result[k, :, i] = (A_[i] @ B + A[i] @ B_) @ chain.S[i]
    return result


@pytest.mark.parametrize("build", [lambda: spatial_case(7), example], ids=["6+7", "example"])
def test_equation_43_as_printed_misses_a_term(build: Any) -> None:
    case = build()
    expected = by_index(case.truth(case.x)[2], (6, case.chain.N))
    assert error(momentum_partials(case, printed=False), expected) < TOLERANCE
    assert error(momentum_partials(case, printed=True), expected) > CLEARLY


# What is refused


def test_arms_that_are_not_serial_are_refused() -> None:
    links = tuple(Link(name, 1.0, (0.2, 0, 0), np.eye(3)) for name in "abc")
    fork = Robot(links, (Joint("j", "revolute", "a", "b"), Joint("k", "revolute", "a", "c")), tip="c")
    with pytest.raises(ModelError, match="joint 'k' starts a branch at link 'a'"):
        VirtualChain.from_machine(FreeFloating(fork))
    early = Robot(links, (Joint("j", "revolute", "a", "b"), Joint("k", "revolute", "b", "c")), tip="b")
    with pytest.raises(ModelError, match="tip is on link 'b', before the joint 'k'"):
        VirtualChain.from_machine(FreeFloating(early))


def test_impossible_chains_are_refused() -> None:
    chain = example().chain
    with pytest.raises(ModelError, match="n = 4 virtual joints"):
        replace(chain, n=4)
    with pytest.raises(ModelError, match="3 joints, 3 of them virtual"):
        replace(chain, S=chain.S[:3])
    with pytest.raises(ModelError, match=r"H has shape \(5, 6, 6\), expected \(6, 6, 6\)"):
        replace(chain, H=chain.H[1:])


def test_coordinates_of_a_wrong_size_are_refused() -> None:
    chain, x = example().chain, example().x
    for function in (D, J, dD, dJ, generalized_jacobian):
        with pytest.raises(ModelError, match=r"q has shape \(5,\), expected \(6,\)"):
            function(chain, x[:5])
    with pytest.raises(ModelError, match=r"q .* is not finite"):
        D(chain, x * np.nan)
