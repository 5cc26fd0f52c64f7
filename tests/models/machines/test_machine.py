from __future__ import annotations

from collections.abc import Callable
from typing import Any

import casadi as ca
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from models import FixedBase, FreeFloating, Joint, Link, Machine, ModelError, Robot, paper_example, planar_chain
from models.robot.kinematics import jacobian_manipulability
from tests.models.robot.trees import (
    Base,
    few,
    numeric,
    random_base,
    random_frame,
    random_robot,
    seeds,
    twist_by_differentiation,
)

sizes = st.integers(1, 7)


@few
@given(seeds, sizes)
def test_fixed_base_moves_its_tip_as_its_jacobian_says_and_nothing_else(seed: int, size: int) -> None:
    rng = np.random.default_rng(seed)
    robot = random_robot(rng, size)
    turn, position = random_frame(rng)
    machine = FixedBase(robot, position, turn)
    q, rates = ca.SX.sym("q", robot.dof), ca.SX.sym("rates", robot.dof)
    pose = machine.tip_pose((), q)
    expected = twist_by_differentiation(pose.rotation, pose.position, q, rates)
    by_matrix = ca.mtimes(machine.tip_jacobian((), q), rates)
    errors = ca.Function("f", [q, rates], [by_matrix - expected, machine.tip_twist((), q, rates) - expected])
    for error in errors(rng.normal(size=robot.dof), rng.normal(size=robot.dof)):
        np.testing.assert_allclose(numeric(error), 0, atol=1e-12)
    assert machine.base_rate((), q, rates).shape == (0, 1)
    assert machine.base_size == 0
    assert machine.base_home().shape == (0,)
    assert machine.joint_size == robot.dof


@few
@given(seeds, st.integers(3, 7), st.sampled_from([None, "planar", "spatial"]))
def test_manipulability_is_the_product_of_the_singular_values(seed: int, size: int, base: Base | None) -> None:
    rng = np.random.default_rng(seed)
    robot = random_robot(rng, size, base or "spatial")
    machine: Machine = FixedBase(robot) if base is None else FreeFloating(robot, base)
    place = np.zeros(0) if base is None else random_base(rng, base)
    q = rng.normal(size=robot.dof)
    count = int(rng.integers(1, min(robot.dof, 6) + 1))
    rows = [int(row) for row in rng.permutation(6)[:count]]
    values = np.linalg.svd(numeric(machine.tip_jacobian(place, q))[rows], compute_uv=False)
    # The square root halves the digits where the determinant is rounded to zero.
    assert float(machine.manipulability(place, q, rows)) == pytest.approx(np.prod(values), rel=1e-6, abs=1e-6)


def test_manipulability_of_a_two_link_arm_is_the_area_it_spans() -> None:
    machine = FixedBase(planar_chain([1.0, 0.5], [1.0, 1.0]))
    for elbow in (0.0, 0.4, np.pi / 2, np.pi):
        expected = 0.5 * abs(np.sin(elbow))
        assert float(machine.manipulability((), [0.7, elbow], (3, 4))) == pytest.approx(expected, abs=1e-7)


def test_manipulability_at_an_exact_singularity_is_zero_not_nan() -> None:
    assert float(jacobian_manipulability(np.zeros((6, 7)))) == 0.0
    machine = FixedBase(planar_chain([1.0] * 3, [1.0] * 3))
    assert float(machine.manipulability((), np.zeros(3), (3, 4))) == 0.0
    assert float(machine.manipulability((), [0.3, 0.4, 0.5], (0, 3, 4))) == 0.0


@pytest.mark.parametrize("symbols", [ca.SX, ca.MX])
@pytest.mark.parametrize("kind", ["fixed", "planar", "spatial"])
def test_symbols_of_both_kinds_give_the_numeric_values(symbols: Any, kind: str) -> None:
    rng = np.random.default_rng(5)
    robot = random_robot(rng, 6, "planar" if kind == "planar" else "spatial")
    machine: Any = (
        FixedBase(robot) if kind == "fixed" else FreeFloating(robot, "planar" if kind == "planar" else "spatial")
    )
    place = np.zeros(0) if kind == "fixed" else random_base(rng, machine.base)
    numbers = (place, rng.normal(size=robot.dof), rng.normal(size=robot.dof))

    def everything(base: Any, q: Any, rates: Any) -> list[Any]:
        results = [
            *machine.tip_pose(base, q),
            machine.tip_jacobian(base, q),
            machine.tip_twist(base, q, rates),
            machine.base_rate(base, q, rates),
            machine.manipulability(base, q, (3, 4)),
        ]
        if kind != "fixed":
            twist = machine.base_twist(base, q, rates)
            results += [
                twist,
                *machine.momentum_matrices(base, q),
                *machine.jacobians(base, q),
                machine.momentum(base, q, twist + 1, rates),
                machine.twist_of_rate(base, machine.base_rate(base, q, rates)),
                machine.momentum_residual(base, q, machine.base_rate(base, q, rates), rates),
            ]
        return results

    variables = [symbols.sym("base", machine.base_size), symbols.sym("q", robot.dof), symbols.sym("rates", robot.dof)]
    result = ca.Function("f", variables, everything(*variables))(*numbers)
    for one, other in zip(result, everything(*numbers), strict=True):
        assert one.shape == other.shape
        np.testing.assert_allclose(numeric(one), numeric(other), atol=1e-12)


@pytest.mark.parametrize(
    ("rows", "message"),
    [
        ((), "rows is empty"),
        ((3, 3), r"rows \[3, 3\] name a twist row more than once"),
        ((3, 6), r"rows \[3, 6\] are not all among"),
        ((-1,), r"rows \[-1\] are not all among"),
    ],
)
def test_rows_that_are_no_task_are_refused(rows: tuple[int, ...], message: str) -> None:
    for machine in (FixedBase(planar_chain([1.0], [1.0])), paper_example()):
        with pytest.raises(ModelError, match=message):
            machine.manipulability(machine.base_home(), np.zeros(machine.joint_size), rows)


FIXED, FLOATING, ONE, TWO, THREE = FixedBase(planar_chain([1.0], [1.0])), paper_example(), *map(np.zeros, (1, 2, 3))


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: FIXED.tip_pose(THREE, ONE), r"base has shape \(3, 1\), expected \(0, 1\)"),
        (lambda: FIXED.tip_jacobian((), TWO), r"q has shape \(2, 1\), expected \(1, 1\)"),
        (lambda: FLOATING.base_rate(THREE, THREE, TWO), r"joint_rates has shape \(2, 1\), expected \(3, 1\)"),
        (lambda: FLOATING.tip_pose(np.zeros(7), THREE), r"base has shape \(7, 1\), expected \(3, 1\): \(x, y, angle\)"),
        (lambda: FLOATING.momentum(THREE, THREE, np.zeros(6), THREE), r"base_twist .*\(6, 1\), expected \(3, 1\)"),
        (lambda: FLOATING.momentum_residual(THREE, THREE, TWO, THREE), r"base_rate .*\(2, 1\), expected \(3, 1\)"),
        (lambda: FixedBase(FIXED.robot, rotation=np.ones((3, 3))), r"fixed base: rotation .* not a rotation matrix"),
    ],
)
def test_vectors_of_a_wrong_size_and_invalid_rotations_are_refused(call: Callable[[], Any], message: str) -> None:
    with pytest.raises(ModelError, match=message):
        call()


def test_a_fixed_base_without_a_moving_joint_is_refused_and_a_body_may_float() -> None:
    robot = Robot((Link("a", 1.0, inertia=np.eye(3)), Link("b")), (Joint("weld", "fixed", "a", "b"),))
    with pytest.raises(ModelError, match="no moving joint"):
        FixedBase(robot)
    assert FreeFloating(robot).joint_size == 0
