"""Wheels and thrusters: momentum and accelerations as MuJoCo has them, whatever acts from outside."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import casadi as ca
import mujoco
import numpy as np
import pytest

from models import (
    FreeFloating,
    Joint,
    Link,
    ModelError,
    Robot,
    Thruster,
    center_of_mass,
    gyro_matrix,
    gyros_of,
    link_frames,
    wheels_of,
    with_gyros,
    with_wheels,
)
from ocp import ProblemError, joint_torques
from tests.models.robot.oracles import mujoco_model
from tests.models.robot.trees import Array

AXES = np.array([[1.0, 0.2, 0.0], [0.0, 2.0, 0.3], [0.0, 0.1, 1.0], [1.0, 1.0, 1.0]])


def satellite(arms: int = 2) -> Robot:
    """A hub with arms of three joints each, at its sides."""
    links, joints = [Link("hub", 120.0, (0.02, 0.0, -0.05), np.diag([20.0, 25.0, 22.0]))], []
    for arm in range(arms):
        side, above = 1.0 - 2.0 * arm, "hub"
        shift = (0.6 * side, 0.1, 0.4)
        for k, axis in enumerate([(0, 0, 1), (0, 1, 0), (0, 1, 0.2)]):
            name = f"arm{arm}_link{k}"
            inertia = np.diag([0.02, 0.4, 0.4])
            links.append(Link(name, 4.0 - k, (0.4 * side, 0.0, 0.02), inertia))
            joints.append(Joint(f"arm{arm}_joint{k}", "revolute", above, name, shift, axis=axis, lower=-3, upper=3))
            above, shift = name, (0.8 * side, 0.0, 0.05)
    return Robot(tuple(links), tuple(joints), tip="arm0_link2", tip_translation=(0.8, 0.0, 0.0))


def wheeled(arms: int = 2) -> Robot:
    places = 0.1 * np.arange(12.0).reshape(4, 3)
    return with_wheels(
        satellite(arms), AXES, [0.02, 0.03, 0.02, 0.05], momentum=6.0, torque=0.6, mass=1.5, translations=places
    )


def test_limits_of_a_wheel_are_those_of_its_joint() -> None:
    robot = wheeled()
    assert robot.joint_names[-4:] == ("wheel1", "wheel2", "wheel3", "wheel4")
    assert robot.velocity[-4:] == pytest.approx([300.0, 200.0, 300.0, 120.0])
    assert robot.effort[-4:] == pytest.approx(0.6)
    assert robot.tip == satellite().tip


def test_wheels_are_known_by_their_symmetry() -> None:
    """What has a shape of its own, or carries the tip, or is not balanced, is none."""
    robot = wheeled()
    assert wheels_of(robot) == pytest.approx({"wheel1": 0.02, "wheel2": 0.03, "wheel3": 0.02, "wheel4": 0.05})
    loose = Joint("loose", "continuous", "hub", "panel", axis=(0, 0, 1))
    for panel in (
        Link("panel", 1.0, (0.1, 0.0, 0.0), 0.1 * np.eye(3)),
        Link("panel", 1.0, (0.0, 0.0, 0.0), np.diag([0.1, 0.2, 0.2])),
    ):
        more = Robot((*robot.links, panel), (*robot.joints, loose), robot.tip)
        assert "loose" not in wheels_of(more)
    ring = Link("panel", 1.0, (0.0, 0.0, 0.3), np.diag([0.1, 0.1, 0.2]))
    more = Robot((*robot.links, ring), (*robot.joints, loose), robot.tip)
    assert "loose" in wheels_of(more)
    assert "loose" not in wheels_of(Robot(more.links, more.joints, "panel"))


@pytest.mark.parametrize("inertia", [1e-6, 0.02, 300.0])
def test_a_rotor_is_a_disc_and_its_symmetry_is_judged_by_its_size(inertia: float) -> None:
    """About its axis what is told, across it 0.6 of that; a part in a million beside that is no symmetry."""
    body = Robot((Link("hub", 80.0, (0, 0, 0), np.eye(3)),), ())
    disc = inertia * np.diag([0.6, 0.6, 1.0])
    wheel = with_wheels(body, [[0, 0, 2.0]], inertia)
    gyro = with_gyros(body, [[0, 1, 0]], [[0, 0, -1]], 1.0, inertia)
    for robot, name in ((wheel, "wheel1"), (gyro, "gyro1_rotor")):
        np.testing.assert_allclose(np.asarray(robot.links[-1].inertia), disc, rtol=1e-14, atol=0)
        assert wheels_of(robot) == pytest.approx({name: inertia})
        uneven = replace(robot.links[-1], inertia=disc + inertia * np.diag([1e-6, 0.0, 0.0]))
        assert wheels_of(replace(robot, links=(*robot.links[:-1], uneven))) == {}


def pyramid_axes() -> tuple[Array, Array]:
    """Of the gimbals and rotors of four gyros on the sides of a pyramid, whose momenta cancel at zero."""
    tilt = np.arctan(np.sqrt(2.0))
    angles = np.arange(4) * np.pi / 2
    out = np.stack([np.cos(angles), np.sin(angles), np.zeros(4)], axis=1)
    side = np.stack([-np.sin(angles), np.cos(angles), np.zeros(4)], axis=1)
    return np.sin(tilt) * out + np.cos(tilt) * np.array([0.0, 0.0, 1.0]), side


def pyramid(**limits: Any) -> Robot:
    """A body with four gyros on the sides of a pyramid."""
    gimbals, side = pyramid_axes()
    body = Link("hub", 80.0, (0, 0, 0), [[20.0, 1.0, 0.5], [1.0, 25.0, -0.8], [0.5, -0.8, 22.0]])
    places = 0.1 * np.arange(12.0).reshape(4, 3)
    robot = with_gyros(Robot((body,), ()), gimbals, side, 5.0, 0.05, mass=0.5, translations=places, **limits)
    links = [replace(link, mass=0.2) if link.name.endswith("gimbal") else link for link in robot.links]
    return replace(robot, links=tuple(links))


SPINNING = np.array([0.0, 100.0] * 4)


def test_gyros_turn_their_momentum() -> None:
    """Columns of their matrix are the derivatives of all rotors' momentum by the gimbals' angles."""
    robot = pyramid(rate=0.8, torque=3.0)
    gyros = gyros_of(robot)
    assert [gyro.gimbal for gyro in gyros] == ["gyro1", "gyro2", "gyro3", "gyro4"]
    assert [gyro.momentum for gyro in gyros] == pytest.approx([5.0] * 4)
    assert robot.velocity == pytest.approx([0.8, 100.0] * 4)
    machine, q = FreeFloating(robot), ca.SX.sym("q", 8)
    held = ca.mtimes(machine.momentum_matrices(ca.DM(machine.base_home()), q)[1], ca.DM(SPINNING))[:3]
    slopes = ca.Function("slopes", [q], [ca.jacobian(held, q)[:, ::2], gyro_matrix(robot, q)])
    for seed in range(3):
        found, given = slopes(np.random.default_rng(seed).uniform(-3, 3, 8))
        np.testing.assert_allclose(np.array(given), np.array(found), atol=1e-12)


def test_a_pyramid_of_gyros_has_no_torque_along_an_axis_where_it_is_singular() -> None:
    """Gimbals at (-90, 0, 90, 0) degrees, the known inner singularity of a pyramid: nothing along x."""
    robot = pyramid()
    singular = np.zeros(8)
    singular[[0, 4]] = -np.pi / 2, np.pi / 2
    at, beside = (np.array(ca.DM(gyro_matrix(robot, ca.DM(angles)))) for angles in (singular, np.zeros(8)))
    assert np.abs(at[0]).max() < 1e-12
    assert np.linalg.matrix_rank(at) == 2
    assert np.linalg.svd(beside, compute_uv=False)[-1] > 1.0


def test_what_is_no_gyro_is_refused_by_name() -> None:
    body = Robot((Link("hub", 80.0, (0, 0, 0), np.eye(3)),), ())
    wrong: list[tuple[Any, Any, float, str]] = [
        ([[0, 0, 1]], [[0, 1, 1]], 1.0, "rotors"),
        ([[0, 0, 0]], [[0, 1, 0]], 1.0, "gimbals"),
        ([[0, 0, 1]], [[0, 1, 0], [1, 0, 0]], 1.0, "rotors"),
        ([[0, 0, 1]], [[0, 1, 0]], 0.0, "momentum"),
    ]
    for gimbals, rotors, momentum, name in wrong:
        with pytest.raises(ModelError) as caught:
            with_gyros(body, gimbals, rotors, momentum, 0.1)
        assert caught.value.name == name
    assert gyros_of(wheeled()) == ()


def state(machine: FreeFloating, seed: int) -> tuple[Array, Array, Array, Array]:
    """Pose, joints, rates and accelerations."""
    rng = np.random.default_rng(seed)
    turn = rng.normal(size=4)
    n = machine.joint_size
    pose = np.concatenate([rng.normal(size=3), turn / np.linalg.norm(turn)])
    return pose, rng.uniform(-2, 2, n), rng.normal(size=n), rng.normal(size=n)


def moving(machine: FreeFloating, base: Array, joints: Array, rates: Array) -> tuple[Any, Any]:
    """MuJoCo's model and data with the base moving as the momentum makes it."""
    model = mujoco_model(machine.robot)
    model.opt.gravity[:] = 0.0
    data = mujoco.MjData(model)
    order = [model.joint(name).dofadr[0] for name in machine.robot.joint_names]
    places = [model.joint(name).qposadr[0] for name in machine.robot.joint_names]
    twist = np.array(ca.DM(machine.base_twist(base, joints, rates))).ravel()
    data.qpos[:7], data.qpos[places] = base[:7], joints
    turn = np.array(ca.DM(machine.world_from_base(base).rotation))
    data.qvel[:3], data.qvel[3:6], data.qvel[order] = twist[3:], turn.T @ twist[:3], rates
    return model, data


def test_gyros_and_base_have_the_momentum_together() -> None:
    """In MuJoCo, whose rotors spin."""
    momentum = np.array([3.0, -2.0, 5.0, 4.0, 1.0, -6.0])
    machine = FreeFloating(pyramid(), conserved_momentum=momentum)
    pose, joints, rates, _ = state(machine, 2)
    model, data = moving(machine, pose, joints, np.where(SPINNING > 0, SPINNING, rates))
    mujoco.mj_forward(model, data)
    mujoco.mj_subtreeVel(model, data)
    assert data.subtree_angmom[1] == pytest.approx(momentum[:3], abs=1e-8)
    assert machine.robot.total_mass * data.subtree_linvel[1] == pytest.approx(momentum[3:], abs=1e-8)


@pytest.mark.parametrize("carried", ["conserved", "a state"])
def test_wheels_arms_and_base_have_the_momentum_together(carried: str) -> None:
    momentum = np.array([3.0, -2.0, 5.0, 4.0, 1.0, -6.0])
    machine = FreeFloating(wheeled(), conserved_momentum=momentum if carried == "conserved" else None)
    pose, joints, rates, _ = state(machine, 1)
    base = pose if carried == "conserved" else np.concatenate([pose, momentum])
    model, data = moving(machine, base, joints, 10 * rates)
    mujoco.mj_forward(model, data)
    mujoco.mj_subtreeVel(model, data)
    assert data.subtree_angmom[1] == pytest.approx(momentum[:3], abs=1e-8)
    assert machine.robot.total_mass * data.subtree_linvel[1] == pytest.approx(momentum[3:], abs=1e-8)
    rate = machine.base_rate(base, joints, rates)
    assert np.abs(np.array(ca.DM(machine.momentum_residual(base, joints, rate, rates)))).max() < 1e-10


@pytest.mark.parametrize("arms", [1, 2])
def test_torques_and_thrust_accelerate_the_joints_as_in_mujoco(arms: int) -> None:
    """Torques from accelerations here, accelerations from torques there; thrusters, gravity and all."""
    machine = FreeFloating(wheeled(arms))
    thrusters = [
        Thruster("hub", (1, 0, 1), 20.0, (-0.5, 0.3, 0.0)),
        Thruster("arm0_link1", (0, 1, 0), 5.0, (0.2, 0, 0)),
    ]
    thrust, fall = np.array([12.0, 3.0]), np.array([0.1, -0.2, -1.6])
    pose, joints, rates, accelerations = state(machine, 2)
    momentum = np.array([1.0, 2.0, -3.0, 20.0, -10.0, 5.0])
    n = machine.joint_size
    b, q, v, a = (ca.SX.sym("z", size) for size in (13, n, n, n))
    frames = link_frames(machine.robot, q, machine.world_from_base(b))
    pushes = [each.wrench(frames, f) for each, f in zip(thrusters, thrust, strict=True)]
    found = joint_torques(machine, b, q, v, a, wrenches=pushes, gravity=fall)
    base = np.concatenate([pose, momentum])
    torques = np.array(ca.Function("t", [b, q, v, a], [found])(base, joints, rates, accelerations)).ravel()
    model, data = moving(machine, base, joints, rates)
    model.opt.gravity[:] = fall
    order = [model.joint(name).dofadr[0] for name in machine.robot.joint_names]
    mujoco.mj_fwdPosition(model, data)
    data.qfrc_applied[order] = torques
    for each, f in zip(thrusters, thrust, strict=True):
        body = model.body(each.link).id
        turn = data.xmat[body].reshape(3, 3)
        point = data.xpos[body] + turn @ np.asarray(each.point)
        push = f * turn @ np.asarray(each.direction)
        mujoco.mj_applyFT(model, data, push, np.zeros(3), point, body, data.qfrc_applied)
    mujoco.mj_forward(model, data)
    assert data.qacc[order] == pytest.approx(accelerations, rel=1e-8, abs=1e-8)


def test_the_momentum_changes_by_what_acts_from_outside() -> None:
    """About the centre of mass: a force through it turns nothing."""
    machine = FreeFloating(wheeled())
    pose, joints, *_ = state(machine, 3)

    center = np.array(ca.DM(center_of_mass(machine.robot, joints, machine.world_from_base(pose)))).ravel()
    force, moment = np.array([1.0, -2.0, 0.5]), np.array([0.3, 0.2, -0.1])
    wrench = np.concatenate([np.cross(center, force) + moment, force])
    rate = np.array(ca.DM(machine.momentum_rate(pose, joints, wrench))).ravel()
    assert rate == pytest.approx([*moment, *force], abs=1e-12)


def test_what_acts_on_a_floating_machine_needs_its_momentum() -> None:
    machine = FreeFloating(wheeled(1))
    n = machine.joint_size
    b, q, v, a = (ca.SX.sym("z", size) for size in (7, n, n, n))
    push = Thruster("hub", (1, 0, 0), 1.0).wrench(link_frames(machine.robot, q, machine.world_from_base(b)), 1.0)
    with pytest.raises(ProblemError, match="changes its momentum"):
        joint_torques(machine, b, q, v, a, wrenches=[push])


@pytest.mark.parametrize(
    ("told", "name"),
    [
        ({"axes": np.zeros((1, 3))}, "axes"),
        ({"axes": [1.0, 0.0, 0.0]}, "axes"),
        ({"inertia": -1.0}, "inertia"),
        ({"momentum": 0.0}, "momentum"),
        ({"link": "bus"}, "bus"),
    ],
)
def test_what_is_no_wheel_is_refused_by_name(told: dict[str, Any], name: str) -> None:
    with pytest.raises(ModelError) as caught:
        with_wheels(satellite(1), **{"axes": np.eye(3), "inertia": 0.02, **told})
    assert caught.value.name == name
