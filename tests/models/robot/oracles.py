"""Machines of this library as models of Pinocchio and MuJoCo, with the root link on a free joint."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import mujoco
import numpy as np
import pinocchio

from models import Robot, Wrench
from scripts.robots.simulation import mujoco_model
from tests.models.robot.trees import Array, numeric_poses, random_inertia


def with_masses(robot: Robot, rng: np.random.Generator) -> Robot:
    """The robot with 1 kg on every massless link: MuJoCo takes no body without mass."""
    links = tuple(
        link if link.mass else replace(link, mass=1.0, inertia=random_inertia(rng, 1.0)) for link in robot.links
    )
    return replace(robot, links=links)


def pinocchio_dynamics(
    robot: Robot, q: Array, qd: Array, qdd: Array, wrenches: Sequence[Wrench], gravity: Array
) -> tuple[Array, Array]:
    """(torques, reaction of the ground (moment about the world's origin, force)), the root at the world's origin."""
    model = pinocchio.Model()
    model.gravity.linear = gravity
    root = model.addJoint(0, pinocchio.JointModelFreeFlyer(), pinocchio.SE3.Identity(), "root")
    carrier = {robot.root: (root, pinocchio.SE3.Identity())}
    for joint in robot.joints:
        parent, placement = carrier[joint.parent]
        place = placement * pinocchio.SE3(np.array(joint.rotation), np.array(joint.translation))
        if not joint.moves:
            carrier[joint.child] = (parent, place)
            continue
        slides = joint.kind == "prismatic"
        kind = pinocchio.JointModelPrismaticUnaligned if slides else pinocchio.JointModelRevoluteUnaligned
        index = model.addJoint(parent, kind(np.array(joint.axis)), place, joint.name)
        carrier[joint.child] = (index, pinocchio.SE3.Identity())
    for link in robot.links:
        inertia = pinocchio.Inertia(link.mass, np.array(link.center_of_mass), np.array(link.inertia))
        model.appendBodyToJoint(carrier[link.name][0], inertia, carrier[link.name][1])
    data = model.createData()
    configuration = np.concatenate([np.zeros(6), [1.0], q])
    velocity, acceleration = np.concatenate([np.zeros(6), qd]), np.concatenate([np.zeros(6), qdd])
    pinocchio.forwardKinematics(model, data, configuration)
    outside = [pinocchio.Force.Zero() for _ in range(model.njoints)]
    for wrench in wrenches:
        index, placement = carrier[wrench.link]
        point = (data.oMi[index] * placement).act(np.array(wrench.point).ravel())
        force, moment = np.array(wrench.force).ravel(), np.array(wrench.moment).ravel()
        outside[index] += data.oMi[index].actInv(pinocchio.Force(force, moment + np.cross(point, force)))
    needed = pinocchio.rnea(model, data, configuration, velocity, acceleration, outside)
    return np.array(needed[6:]), np.concatenate([needed[3:6], needed[0:3]])


def mujoco_dynamics(
    robot: Robot, q: Array, qd: Array, qdd: Array, wrenches: Sequence[Wrench], gravity: Array
) -> tuple[Array, Array]:
    """As pinocchio_dynamics."""
    model = mujoco_model(robot)
    model.opt.gravity[:] = gravity
    data = mujoco.MjData(model)
    order = [model.joint(name).dofadr[0] for name in robot.joint_names]
    places = [model.joint(name).qposadr[0] for name in robot.joint_names]
    data.qpos[3] = 1.0
    data.qpos[places], data.qvel[order], data.qacc[order] = q, qd, qdd
    mujoco.mj_inverse(model, data)
    needed = np.array(data.qfrc_inverse)
    poses = numeric_poses(robot, q)
    for wrench in wrenches:
        options = np.zeros(model.nv)
        turn, position = poses[wrench.link]
        point = position + turn @ np.array(wrench.point).ravel()
        body = model.body(wrench.link).id
        mujoco.mj_applyFT(
            model, data, np.array(wrench.force).ravel(), np.array(wrench.moment).ravel(), point, body, options
        )
        needed -= options
    return needed[order], np.concatenate([needed[3:6], needed[0:3]])
