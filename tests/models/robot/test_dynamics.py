from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from models import (
    Wrench,
    base_reaction,
    center_of_mass,
    center_of_mass_motion,
    frame_jacobian,
    inverse_dynamics,
    link_frames,
    mass_matrix,
    momentum,
    momentum_matrix,
    planar_chain,
)
from models.robot.dynamics import external_wrench
from tests.models.robot.oracles import mujoco_dynamics, pinocchio_dynamics, with_masses
from tests.models.robot.trees import (
    Array,
    directional,
    few,
    momentum_by_differentiation,
    numeric,
    random_frame,
    random_robot,
    refused,
    seeds,
    twist_by_differentiation,
)

bases = st.sampled_from(["planar", "spatial"])
LIBRARY = 1e-9


def random_motion(rng: np.random.Generator, size: int) -> tuple[Array, Array, Array]:
    return rng.normal(size=size), rng.normal(size=size), rng.normal(scale=3.0, size=size)


def hand_wrench(rng: np.random.Generator, link: str) -> Wrench:
    return Wrench(link, rng.normal(scale=20, size=3), rng.normal(scale=5, size=3), rng.normal(scale=0.3, size=3))


def along(value: Any, q: Any, qd: Any, qdd: Any) -> Any:
    """d/dt of an expression of q and q'."""
    return directional(value, ca.vertcat(q, qd), ca.vertcat(qd, qdd))


@pytest.mark.parametrize("library", [pinocchio_dynamics, mujoco_dynamics])
@given(seeds, st.integers(1, 8), bases)
@few
def test_torques_and_reaction_equal_those_of_an_independent_library(
    library: Any, seed: int, size: int, base: Any
) -> None:
    rng = np.random.default_rng(seed)
    robot = with_masses(random_robot(rng, size, base), rng)
    q, qd, qdd = random_motion(rng, robot.dof)
    gravity = rng.normal(scale=9.0, size=3)
    wrenches = [hand_wrench(rng, robot.tip_link), hand_wrench(rng, robot.links[rng.integers(size + 1)].name)]
    torques, reaction = library(robot, q, qd, qdd, wrenches, gravity)
    np.testing.assert_allclose(
        numeric(inverse_dynamics(robot, q, qd, qdd, wrenches=wrenches, gravity=gravity)).ravel(),
        torques,
        rtol=0,
        atol=LIBRARY,
    )
    outcome = numeric(base_reaction(robot, q, qd, qdd, wrenches=wrenches, gravity=gravity)).ravel()
    np.testing.assert_allclose(outcome, reaction, rtol=0, atol=LIBRARY)


@given(seeds, st.integers(1, 6), bases)
@few
def test_power_of_the_torques_and_wrenches_is_the_rate_of_energy(seed: int, size: int, base: Any) -> None:
    """q' tau + wrench power = d/dt (sum m v^2 / 2 + w I w / 2 - m g c), by differentiation of link frames."""
    rng = np.random.default_rng(seed)
    robot = random_robot(rng, size, base)
    placement = random_frame(rng)
    gravity = rng.normal(scale=9.0, size=3)
    q, qd, qdd = (ca.SX.sym(name, robot.dof) for name in ("q", "qd", "qdd"))
    energy: Any = 0
    frames = link_frames(robot, q, placement)
    for link in robot.links:
        turn, position = frames[link.name]
        center = position + ca.mtimes(turn, ca.DM(link.center_of_mass))
        twist = twist_by_differentiation(turn, center, q, qd)
        inertia = ca.mtimes([turn, ca.DM(link.inertia), turn.T])
        energy += link.mass * ca.sumsqr(twist[3:6]) / 2 + ca.dot(twist[0:3], ca.mtimes(inertia, twist[0:3])) / 2
        energy -= link.mass * ca.dot(ca.DM(gravity), center)
    wrench = hand_wrench(rng, robot.tip_link)
    torques = inverse_dynamics(robot, q, qd, qdd, wrenches=[wrench], gravity=gravity, world_from_base=placement)
    jacobian = frame_jacobian(robot, q, wrench.link, point=wrench.point, world_from_base=placement)
    external_power = ca.dot(ca.vertcat(wrench.moment, wrench.force), ca.mtimes(jacobian, qd))
    balance = ca.Function("balance", [q, qd, qdd], [along(energy, q, qd, qdd), ca.dot(qd, torques) + external_power])
    rate, power = (float(value) for value in balance(*random_motion(rng, robot.dof)))
    assert rate == pytest.approx(power, rel=1e-9, abs=1e-8)


@given(seeds, st.integers(1, 6), bases)
@few
def test_momentum_its_rate_and_the_centre_of_mass_follow_from_the_frames(seed: int, size: int, base: Any) -> None:
    rng = np.random.default_rng(seed)
    robot = random_robot(rng, size, base)
    placement, about = random_frame(rng), rng.normal(size=3)
    q, qd, qdd = (ca.SX.sym(name, robot.dof) for name in ("q", "qd", "qdd"))
    truth = momentum_by_differentiation(robot, link_frames(robot, q, placement), q, qd)
    truth = ca.vertcat(truth[0:3] - ca.cross(ca.DM(about), truth[3:6]), truth[3:6])
    center = center_of_mass(robot, q, placement)
    expected = [truth, along(truth, q, qd, qdd), center, directional(center, q, qd)]
    expected.append(along(expected[3], q, qd, qdd))
    rate = base_reaction(robot, q, qd, qdd, gravity=(0.0, 0.0, 0.0), world_from_base=placement)
    rate = ca.vertcat(rate[0:3] - ca.cross(ca.DM(about), rate[3:6]), rate[3:6])
    outcome = [momentum(robot, q, qd, about=about, world_from_base=placement), rate]
    outcome += center_of_mass_motion(robot, q, qd, qdd, world_from_base=placement)
    function = ca.Function("both", [q, qd, qdd], [*expected, *outcome])
    values = [numeric(value) for value in function(*random_motion(rng, robot.dof))]
    for truth_value, value in zip(values[:5], values[5:], strict=True):
        np.testing.assert_allclose(value, truth_value, rtol=1e-9, atol=1e-9)
    point = random_motion(rng, robot.dof)
    at_origin = numeric(momentum(robot, point[0], point[1], world_from_base=placement))
    np.testing.assert_allclose(
        at_origin.ravel(), numeric(momentum_matrix(robot, point[0], placement)) @ point[1], atol=1e-9
    )


@given(seeds, st.integers(1, 6))
@few
def test_the_reaction_is_the_rate_of_momentum_less_weight_and_wrenches(seed: int, size: int) -> None:
    rng = np.random.default_rng(seed)
    robot = random_robot(rng, size)
    motion, placement = random_motion(rng, robot.dof), random_frame(rng)
    wrench, gravity = hand_wrench(rng, robot.tip_link), rng.normal(size=3)
    center = numeric(center_of_mass(robot, motion[0], placement)).ravel()
    weight = robot.total_mass * np.concatenate([np.cross(center, gravity), gravity])
    outside = numeric(external_wrench(robot, motion[0], [wrench], placement)).ravel()
    rate = base_reaction(robot, *motion, gravity=(0.0, 0.0, 0.0), world_from_base=placement)
    expected = numeric(rate).ravel() - weight - outside
    outcome = numeric(
        base_reaction(robot, *motion, wrenches=[wrench], gravity=gravity, world_from_base=placement)
    ).ravel()
    np.testing.assert_allclose(outcome, expected, rtol=1e-10, atol=1e-10)


@given(seeds, st.integers(1, 6))
@few
def test_the_mass_matrix_is_symmetric_and_gives_the_torques_of_accelerations_from_rest(seed: int, size: int) -> None:
    rng = np.random.default_rng(seed)
    robot = random_robot(rng, size, followers=True)
    q, rest, qdd = rng.normal(size=robot.dof), np.zeros(robot.dof), rng.normal(size=robot.dof)
    inertia = numeric(mass_matrix(robot, q))
    np.testing.assert_allclose(inertia, inertia.T, atol=1e-12)
    torques = numeric(inverse_dynamics(robot, q, rest, qdd, gravity=(0.0, 0.0, 0.0))).ravel()
    np.testing.assert_allclose(inertia @ qdd, torques, rtol=1e-10, atol=1e-10)


@pytest.mark.long
@settings(max_examples=10)
@given(seeds)
def test_mx_and_sx_symbols_give_the_same(seed: int) -> None:
    rng = np.random.default_rng(seed)
    robot = random_robot(rng, 4)
    motion, push, base_motion = random_motion(rng, robot.dof), rng.normal(size=3), rng.normal(size=(2, 6))
    results = []
    for symbols in (ca.SX, ca.MX):
        sizes = (*[robot.dof] * 3, 3, 6, 6)
        q, qd, qdd, force, twist, swing = (symbols.sym(name, size) for name, size in zip("abcdef", sizes, strict=True))
        moving = {"base_motion": (twist, swing)}
        wrenches = [Wrench(robot.tip_link, force)]
        outputs = [
            function(robot, q, qd, qdd, wrenches=wrenches, **moving) for function in (inverse_dynamics, base_reaction)
        ]
        outputs += [momentum(robot, q, qd), *center_of_mass_motion(robot, q, qd, qdd)]
        outputs.append(ca.vec(mass_matrix(robot, q)))
        values = ca.Function("all", [q, qd, qdd, force, twist, swing], outputs)(*motion, push, *base_motion)
        results.append(np.concatenate([numeric(value).ravel() for value in values]))
    np.testing.assert_allclose(results[0], results[1], rtol=1e-12, atol=1e-12)


def test_a_planar_machine_keeps_its_structural_zeros() -> None:
    robot = planar_chain([1.0, 1.0], [1.0, 1.0])
    q, qd, qdd = (ca.SX.sym(name, 2) for name in ("q", "qd", "qdd"))
    reaction = base_reaction(robot, q, qd, qdd, gravity=(0.0, -9.81, 0.0))
    assert reaction.sparsity().row() == [2, 3, 4]


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"q": np.zeros(3)}, "q has shape"),
        ({"qd": np.zeros(1)}, "qd has shape"),
        ({"qdd": np.zeros(5)}, "qdd has shape"),
        ({"wrenches": [Wrench("hand")]}, "link 'hand' does not exist"),
        ({"gravity": (0.0, -9.81)}, "gravity has shape"),
        ({"base_motion": (np.zeros(3), np.zeros(6))}, r"base_twist has shape \(3, 1\), expected \(6, 1\)"),
        ({"base_motion": (np.zeros(6), np.zeros(3))}, r"base_acceleration has shape \(3, 1\), expected \(6, 1\)"),
    ],
)
def test_arguments_that_do_not_fit_are_refused(changes: dict[str, Any], message: str) -> None:
    arguments: dict[str, Any] = {"q": np.zeros(2), "qd": np.zeros(2), "qdd": np.zeros(2), **changes}
    for function in (inverse_dynamics, base_reaction):
        with refused(message):
            function(planar_chain([1.0, 1.0], [1.0, 1.0]), **arguments)


def test_a_robot_without_mass_has_no_centre_of_mass_motion() -> None:
    with refused("no mass"):
        center_of_mass_motion(planar_chain([1.0], [0.0]), [0.0], [0.0], [0.0])


@pytest.mark.parametrize(
    ("parts", "message"),
    [
        ({"force": (1.0, 2.0)}, "wrench on link 'hand': force has shape"),
        ({"moment": (0.0, np.nan, 0.0)}, "wrench on link 'hand': moment .* not finite"),
    ],
)
def test_a_wrench_that_is_none_is_refused(parts: dict[str, Any], message: str) -> None:
    with refused(message):
        Wrench("hand", **parts)


def test_a_wrench_takes_a_list_of_expressions() -> None:
    time = ca.SX.sym("time")
    force = Wrench("hand", (0, 2 * time, 1)).force
    assert numeric(ca.Function("force", [time], [force])(3.0)).ravel().tolist() == [0, 6, 1]
