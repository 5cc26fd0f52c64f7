"""Reaction wheels, which turn a spacecraft and keep its momentum.

A reaction wheel is a joint as any other: a rotor turns about an axis of the link that carries it, its motor's torque is
the limit of the joint's effort, and the momentum at which it saturates, h = I w, that of the joint's speed w. So
momentum, torques and limits follow from the robot, for FreeFloating machines and in every problem. The rotor is
symmetric: where it stands does not matter, and its angle winds on.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from models.arrays import ROUNDING, ArrayInput, checked_array, checked_instance, checked_text, one_for_each
from models.errors import ModelError
from models.robot.parts import Joint, Link
from models.robot.robot import Robot


def with_wheels(
    robot: Robot,
    axes: ArrayInput,
    inertia: ArrayInput,
    *,
    momentum: ArrayInput = np.inf,
    torque: ArrayInput = np.inf,
    mass: ArrayInput = 0.0,
    translations: ArrayInput | None = None,
    link: str | None = None,
    prefix: str = "wheel",
) -> Robot:
    """The robot with reaction wheels, whose joints "wheel1", ... come last; its tip stays.

    Args:
        axes: Of the wheels, in the link that carries them; of any length but zero. Shape (k, 3).
        inertia: Of each rotor about its axis, one number or (k,), kg m^2. It is a disc: 0.6 of it across. The
            carrier's own mass and inertia are those without the rotors.
        momentum: At which each saturates, relative to the carrier, one number or (k,), N m s. The joint's speed limit
            is this over the inertia.
        torque: Of each motor at most, one number or (k,), N m.
        mass: Of each rotor, one number or (k,), kg.
        translations: Places of the rotors in the link. Shape (k, 3), m; its origin if None.
        link: That carries them; the root if None.
        prefix: Of the names of joints, and with "_rotor" of links.

    Raises:
        ModelError: Sizes that differ, an axis of no length, numbers that are not positive, names that are taken.
    """
    owner = "reaction wheels"
    robot = checked_instance(robot, Robot, owner, "robot")
    along = checked_array(axes, ("wheels", 3), owner, "axes")
    for axis in along:
        if not np.linalg.norm(axis) > 0:
            raise ModelError(f"{owner}: axis {axis.tolist()} has no direction", name="axes", value=axis)
    count = len(along)
    checked_text(prefix, owner, "prefix")
    carrier = robot.root if link is None else robot.link(link).name
    moments = one_for_each(inertia, count, owner, "inertia", "wheels", positive=True)
    fastest = one_for_each(momentum, count, owner, "momentum", "wheels", finite=False, positive=True) / moments
    most = one_for_each(torque, count, owner, "torque", "wheels", finite=False, positive=True)
    masses = one_for_each(mass, count, owner, "mass", "wheels", least=0)
    places = np.zeros((count, 3)) if translations is None else translations
    places = checked_array(places, (count, 3), owner, "translations")
    links, joints = [*robot.links], [*robot.joints]
    for k in range(count):
        joint = Joint(f"{prefix}{k + 1}", "continuous", carrier, f"{prefix}{k + 1}_rotor", places[k], axis=along[k])
        joints.append(replace(joint, velocity=float(fastest[k]), effort=float(most[k])))
        across = np.eye(3) - np.outer(joint.axis, joint.axis)
        links.append(Link(joint.child, masses[k], (0.0, 0.0, 0.0), moments[k] * (np.eye(3) - (1 - 0.6) * across)))
    return replace(robot, links=tuple(links), joints=tuple(joints))


def wheels_of(robot: Robot) -> dict[str, float]:
    """Joints whose angle does not matter, and the inertia about each, kg m^2.

    Each turns without end one body alone, symmetric about its axis, on which its mass is; that carries neither the tip
    nor a shape that could touch anything.
    """
    robot = checked_instance(robot, Robot, "wheels", "robot")
    carrying = {joint.parent for joint in robot.joints} | {robot.tip}
    followed = {joint.mimic.joint for joint in robot.joints if joint.mimic is not None}
    found = {}
    for joint in robot.moving_joints:
        body = robot.link(joint.child)
        if joint.kind == "prismatic" or np.isfinite([joint.lower, joint.upper]).any():
            continue
        if body.name in carrying or body.collisions or joint.name in followed:
            continue
        axis, inertia = np.asarray(joint.axis), np.asarray(body.inertia)
        about = float(axis @ inertia @ axis)
        across = np.eye(3) - np.outer(axis, axis)
        ring = about * np.outer(axis, axis) + across * np.trace(across @ inertia) / 2
        away = np.linalg.norm(across @ np.asarray(body.center_of_mass))
        if about > 0 and np.abs(inertia - ring).max() <= ROUNDING * about and away**2 * body.mass <= ROUNDING * about:
            found[joint.name] = about
    return found
