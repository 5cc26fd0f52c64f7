"""Chasers with wheels and arms, in the plane and in space, and bodies that tumble before them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import fields
from typing import Any

import casadi as ca
import mujoco
import numpy as np

from models import FreeFloating, Joint, Link, Robot, planar_chain, with_wheels
from models.paths.splines import exponential
from ocp import Capture, Cone, Cost, FreeTime, Grasp, Solution
from ocp.motion.builders.space.pair import join_target, pair_momentum
from scripts.robots.simulation import mujoco_model
from tests.models.robot.trees import Array

PLANAR_START = np.array([1.2, -2.0, 0.6, 0.0])
START = np.array([-0.9, -1.3, 2.3, -1.0, 0.0, 0.0, 0.0, 0.0, 0.0])
CONE, GRASP = Cone((-1, 0, 0), 0.4, 0.25), Grasp(force=20.0, moment=10.0)
FREE = FreeTime(5.0, 40.0, 10.0)


def planar_chaser(momentum: float = 6.0) -> FreeFloating:
    """An arm of three joints on a hub with one wheel, which takes a momentum, N m s."""
    chain = planar_chain([0.8, 0.7, 0.3], [4.0, 3.0, 1.0], base=Link("hub", 60.0, (0, 0, 0), 6.0 * np.eye(3)))
    return FreeFloating(with_wheels(chain, [[0, 0, 1]], 0.02, momentum=momentum, torque=1.0, mass=0.2), "planar")


def planar_target(spin: float = 0.15, inertia: float = 3.0, velocity: Any = (0.0, 0.0)) -> FreeFloating:
    """30 kg that turn (rad/s), grasped at the side towards the chaser."""
    body = Link("target", 30.0, (0, 0, 0), inertia * np.eye(3))
    robot = Robot((body,), (), tip="target", tip_translation=(-0.4, 0, 0), name="target")
    momentum = np.concatenate([[inertia * spin], 30.0 * np.asarray(velocity)])
    return FreeFloating(robot, "planar", conserved_momentum=momentum)


def planar_capture() -> dict[str, Any]:
    """What is asked in the plane."""
    return {
        "chaser": planar_chaser(), "target": planar_target(), "start": PLANAR_START, "approach": FREE,
        "detumble": FREE, "target_base": [1.9, 0.3, 0.0], "cone": CONE, "grasp": GRASP,
        "cost": Cost(velocity=0.0, effort=1.0, acceleration=[1.0] * 3 + [0.0], time=0.05),
    }  # fmt: skip


def chaser(momentum: float = 4.0) -> FreeFloating:
    """An arm of six joints on a hub with three wheels that take a momentum each, N m s."""
    links, joints = [Link("hub", 150.0, (0, 0, 0), np.diag([20.0, 25.0, 22.0]))], []
    above = "hub"
    chain: list[tuple[Any, Any, float, float]] = [
        ((0.5, 0, 0.5), (0, 0, 1), 0.1, 2.0),
        ((0, 0, 0.15), (0, 1, 0), 0.9, 5.0),
        ((0.9, 0, 0), (0, 1, 0), 0.8, 4.0),
        ((0.8, 0, 0), (0, 1, 0), 0.1, 1.5),
        ((0.1, 0, 0), (0, 0, 1), 0.1, 1.0),
        ((0.1, 0, 0), (1, 0, 0), 0.15, 1.0),
    ]
    for k, (shift, axis, length, mass) in enumerate(chain):
        across = mass * length**2 / 12 + 0.01
        center = (length / 2, 0, 0) if k else (0, 0, 0.07)
        links.append(Link(f"link{k}", mass, center, np.diag([0.02, across, across])))
        bounds: dict[str, Any] = {"lower": -3.0, "upper": 3.0, "velocity": 0.8, "effort": 20.0}
        joints.append(Joint(f"joint{k}", "revolute", above, f"link{k}", shift, axis=axis, **bounds))
        above = f"link{k}"
    robot = Robot(tuple(links), tuple(joints), tip=above, tip_translation=(0.15, 0, 0))
    return FreeFloating(with_wheels(robot, np.eye(3), 0.02, momentum=momentum, torque=0.5, mass=0.5))


def target(spin: Any, inertia: Any = (5.0, 8.0, 6.0)) -> FreeFloating:
    """60 kg that tumble (rad/s, axes of the body), grasped at the side towards the chaser."""
    moments = np.diag(inertia)
    body = Link("target", 60.0, (0.02, 0, -0.01), moments)
    robot = Robot((body,), (), tip="target", tip_translation=(-0.5, 0, 0), name="target")
    return FreeFloating(robot, conserved_momentum=[*(moments @ np.asarray(spin)), 0.0, 0.0, 0.0])


def capture(spin: Any, inertia: Any = (5.0, 8.0, 6.0)) -> dict[str, Any]:
    """What is asked in space."""
    return {
        "chaser": chaser(), "target": target(spin, inertia), "start": START, "approach": FREE,
        "detumble": FREE, "target_base": [2.5, 0.2, 0.6, 1.0, 0.0, 0.0, 0.0], "cone": CONE, "grasp": GRASP,
        "cost": Cost(velocity=0.0, effort=1.0, acceleration=[1.0] * 6 + [0.0] * 3, time=0.05),
    }  # fmt: skip


def called(function: Callable[..., Any], **request: Any) -> Any:
    """Call `capture_problem`, or a function that solves it, with the fields of a Capture beside the other arguments."""
    names = {field.name for field in fields(Capture)}
    capture = Capture(**{name: request.pop(name) for name in names & request.keys()})
    return function(request.pop("chaser"), capture, **request)


def turned(axis: Any, angle: float) -> Array:
    """Unit quaternion. Shape (4,)."""
    return exponential(angle * axis / np.linalg.norm(axis))


def replayed_momentum(request: dict[str, Any], plan: Solution, samples: int = 41) -> tuple[Array, Array]:
    """Momentum of chaser and target in MuJoCo along a plan, about their common centre of mass: (M, 6) in each phase.

    (Angular, linear). Before the grasp two robots that move beside each other, after it one.
    """
    one, other = request["chaser"], request["target"]
    begin, after = (plan.phase(name).at_fraction(np.linspace(0, 1, samples)) for name in ("approach", "detumble"))
    base, target, joints = (begin[name][0] for name in ("base", "target", "joints"))
    carried = np.array(ca.DM(pair_momentum(one, other, base=base, target_base=target, joints=joints))).ravel()
    pair = FreeFloating(join_target(one.robot, other.robot), one.base, conserved_momentum=carried)
    nothing = np.zeros((samples, 0))
    parts = [
        _momenta(one, begin["base"], begin["joints"], begin["velocities"]),
        _momenta(other, begin["target"], nothing, nothing),
    ]
    return _together(parts), _together([_momenta(pair, after["base"], after["joints"], after["velocities"])])


def _together(parts: list[tuple[Array, Array, float]]) -> Array:
    """Of momenta (M, 6) about centres (M, 3) of masses."""
    middle = sum(mass * center for _, center, mass in parts) / sum(mass for *_, mass in parts)
    result = np.sum([momentum for momentum, *_ in parts], axis=0)
    for momentum, center, _ in parts:
        result[:, :3] += np.cross(center - middle, momentum[:, 3:])
    return np.asarray(result)


def _momenta(machine: FreeFloating, bases: Array, joints: Array, rates: Array) -> tuple[Array, Array, float]:
    """Of one machine: momentum about its own centre of mass, (M, 6), that centre, (M, 3), and its mass."""
    model = mujoco_model(machine.robot)
    data = mujoco.MjData(model)
    names = machine.robot.joint_names
    order = [model.joint(name).dofadr[0] for name in names]
    places = [model.joint(name).qposadr[0] for name in names]
    spatial = np.eye(6)[:, machine.twist_rows]
    result, centers = [], []
    for base, angles, speeds in zip(bases, joints, rates, strict=True):
        frame = machine.world_from_base(base)
        twist = spatial @ np.array(ca.DM(machine.base_twist(base, angles, speeds))).ravel()
        turn = np.array(ca.DM(frame.rotation))
        data.qpos[:3] = np.array(ca.DM(frame.position)).ravel()
        mujoco.mju_mat2Quat(data.qpos[3:7], turn.ravel())
        data.qpos[places] = angles
        data.qvel[:3], data.qvel[3:6], data.qvel[order] = twist[3:], turn.T @ twist[:3], speeds
        mujoco.mj_forward(model, data)
        mujoco.mj_subtreeVel(model, data)
        result.append([*data.subtree_angmom[1], *(machine.robot.total_mass * data.subtree_linvel[1])])
        centers.append(data.subtree_com[1].copy())
    return np.array(result), np.array(centers), float(machine.robot.total_mass)
