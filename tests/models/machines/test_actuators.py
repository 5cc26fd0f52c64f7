"""Reaction wheels: momentum and accelerations against MuJoCo."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import casadi as ca
import mujoco
import numpy as np
import pytest

from models import FreeFloating, Joint, Link, ModelError, Robot, Wrench, find_wheels, with_wheels
from ocp import ProblemError, joint_torques
from scripts.robots.simulation import mujoco_model
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
    assert find_wheels(robot) == pytest.approx({"wheel1": 0.02, "wheel2": 0.03, "wheel3": 0.02, "wheel4": 0.05})
    loose = Joint("loose", "continuous", "hub", "panel", axis=(0, 0, 1))
    for panel in (
        Link("panel", 1.0, (0.1, 0.0, 0.0), 0.1 * np.eye(3)),
        Link("panel", 1.0, (0.0, 0.0, 0.0), np.diag([0.1, 0.2, 0.2])),
    ):
        more = Robot((*robot.links, panel), (*robot.joints, loose), robot.tip)
        assert "loose" not in find_wheels(more)
    ring = Link("panel", 1.0, (0.0, 0.0, 0.3), np.diag([0.1, 0.1, 0.2]))
    more = Robot((*robot.links, ring), (*robot.joints, loose), robot.tip)
    assert "loose" in find_wheels(more)
    assert "loose" not in find_wheels(Robot(more.links, more.joints, "panel"))


@pytest.mark.parametrize("inertia", [1e-6, 0.02, 300.0])
def test_a_rotor_is_a_disc_and_its_symmetry_is_judged_by_its_size(inertia: float) -> None:
    """About its axis what is told, across it 0.6 of that; a part in a million beside that is no symmetry."""
    body = Robot((Link("hub", 80.0, (0, 0, 0), np.eye(3)),), ())
    disc = inertia * np.diag([0.6, 0.6, 1.0])
    wheel = with_wheels(body, [[0, 0, 2.0]], inertia)
    np.testing.assert_allclose(np.asarray(wheel.links[-1].inertia), disc, rtol=1e-14, atol=0)
    assert find_wheels(wheel) == pytest.approx({"wheel1": inertia})
    uneven = replace(wheel.links[-1], inertia=disc + inertia * np.diag([1e-6, 0.0, 0.0]))
    assert find_wheels(replace(wheel, links=(*wheel.links[:-1], uneven))) == {}


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


def test_wheels_arms_and_base_have_the_momentum_together() -> None:
    momentum = np.array([3.0, -2.0, 5.0, 4.0, 1.0, -6.0])
    machine = FreeFloating(wheeled(), conserved_momentum=momentum)
    base, joints, rates, _ = state(machine, 1)
    model, data = moving(machine, base, joints, 10 * rates)
    mujoco.mj_forward(model, data)
    mujoco.mj_subtreeVel(model, data)
    assert data.subtree_angmom[1] == pytest.approx(momentum[:3], abs=1e-8)
    assert machine.robot.total_mass * data.subtree_linvel[1] == pytest.approx(momentum[3:], abs=1e-8)
    rate = machine.base_rate(base, joints, rates)
    assert np.abs(np.array(ca.DM(machine.momentum_residual(base, joints, rate, rates)))).max() < 1e-10


@pytest.mark.parametrize("carried", [(0.0,) * 6, (1.0, 2.0, -3.0, 20.0, -10.0, 5.0)])
@pytest.mark.parametrize("arms", [1, 2])
def test_torques_accelerate_the_joints_as_in_mujoco(arms: int, carried: tuple[float, ...]) -> None:
    """Torques from accelerations here, accelerations from torques there, at rest or with momentum."""
    machine = FreeFloating(wheeled(arms), conserved_momentum=carried)
    base, joints, rates, accelerations = state(machine, 2)
    n = machine.joint_size
    b, q, v, a = (ca.SX.sym("z", size) for size in (7, n, n, n))
    result = ca.Function("t", [b, q, v, a], [joint_torques(machine, (b, q, v, a))])
    torques = np.array(result(base, joints, rates, accelerations)).ravel()
    model, data = moving(machine, base, joints, rates)
    order = [model.joint(name).dofadr[0] for name in machine.robot.joint_names]
    data.qfrc_applied[order] = torques
    mujoco.mj_forward(model, data)
    assert data.qacc[order] == pytest.approx(accelerations, rel=1e-8, abs=1e-8)
    call = [ca.MX.sym("z", size) for size in (7, n, n, n)]
    again = ca.Function("t", call, [joint_torques(machine, (*call,))])(base, joints, rates, accelerations)
    assert np.array(again).ravel() == pytest.approx(torques, rel=1e-12, abs=1e-12)


@pytest.mark.parametrize("report", [{"wrenches": [Wrench("hub", (1, 0, 0))]}, {"gravity": (0.0, 0.0, -1.6)}])
def test_nothing_acts_from_outside_on_a_machine_that_floats(report: dict[str, Any]) -> None:
    machine = FreeFloating(wheeled(1))
    n = machine.joint_size
    b, q, v, a = (ca.SX.sym("z", size) for size in (7, n, n, n))
    with pytest.raises(ProblemError, match="conserves its momentum") as caught:
        joint_torques(machine, (b, q, v, a), **report)
    assert caught.value.name == next(iter(report))


@pytest.mark.parametrize(
    ("report", "name"),
    [
        ({"axes": np.zeros((1, 3))}, "axes"),
        ({"axes": [1.0, 0.0, 0.0]}, "axes"),
        ({"inertia": -1.0}, "inertia"),
        ({"momentum": 0.0}, "momentum"),
        ({"link": "bus"}, "bus"),
    ],
)
def test_what_is_no_wheel_is_refused_by_name(report: dict[str, Any], name: str) -> None:
    with pytest.raises(ModelError) as caught:
        with_wheels(satellite(1), **{"axes": np.eye(3), "inertia": 0.02, **report})
    assert caught.value.name == name
