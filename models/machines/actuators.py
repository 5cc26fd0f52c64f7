"""What turns and pushes a spacecraft: wheels and gyros, which keep its momentum, and thrusters, which change it.

A reaction wheel is a joint as any other: a rotor turns about an axis of the link that carries it, its motor's torque is
the limit of the joint's effort, and the momentum at which it saturates, h = I w, that of the joint's speed w. So
momentum, torques and limits follow from the robot, for FreeFloating machines and in every problem. The rotor is
symmetric: where it stands does not matter, and its angle winds on.

A control-moment gyro is a rotor of constant speed in a gimbal, two joints: turning the gimbal about g, across the
rotor's axis s, turns the momentum h s and gives the carrier the torque -h g x s times the gimbal's rate, much for
little. So what limits it is that rate, and where the gimbals stand: no torque is had along what is across all of g x s,
a singularity.

A thruster is a wrench from outside, fixed in its link, between nothing and what it gives at most.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import NamedTuple

import casadi as ca
import numpy as np

from models.arrays import (
    Array,
    ArrayInput,
    checked_array,
    checked_instance,
    checked_name,
    checked_nonnegative,
    checked_text,
    one_for_each,
)
from models.errors import ModelError
from models.robot.dynamics import Wrench
from models.robot.kinematics import joint_vector, link_frames
from models.robot.parts import Joint, Link
from models.robot.robot import Robot
from models.spatial import Expression, Frame, on_scalars

ACROSS = 0.6
"""Of the moment of a rotor about its axis; of a thin ring it is a half."""
SQUARE = 1e-9
"""Cosine of the angle between axes that are at right angles."""
SYMMETRY = 1e-9
"""Relative: of the moments and of the place of the mass of a body whose angle does not matter."""


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
        inertia: Of each rotor about its axis, one number or (k,), kg m^2. It is a disc: ACROSS of it across. The
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
    along = _directions(axes, "wheels", owner, "axes")
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
        links.append(_rotor(joint, moments[k], masses[k]))
    return replace(robot, links=tuple(links), joints=tuple(joints))


def _directions(axes: ArrayInput, count: int | str, owner: str, what: str) -> Array:
    """Axes of some length each. Shape (count, 3)."""
    given = checked_array(axes, (count, 3), owner, what)
    for axis in given:
        if not np.linalg.norm(axis) > 0:
            raise ModelError(f"{owner}: axis {axis.tolist()} has no direction", name=what, value=axis)
    return given


def _rotor(joint: Joint, inertia: float, mass: float) -> Link:
    """The disc that a joint turns."""
    across = np.eye(3) - np.outer(joint.axis, joint.axis)
    disc = inertia * (ACROSS * across + (np.eye(3) - across))
    return Link(joint.child, mass, (0.0, 0.0, 0.0), disc)


def with_gyros(
    robot: Robot,
    gimbals: ArrayInput,
    rotors: ArrayInput,
    momentum: ArrayInput,
    inertia: ArrayInput,
    *,
    gimbal_inertia: ArrayInput = 0.01,
    rate: ArrayInput = np.inf,
    torque: ArrayInput = np.inf,
    mass: ArrayInput = 0.0,
    translations: ArrayInput | None = None,
    link: str | None = None,
    prefix: str = "gyro",
) -> Robot:
    """The robot with control-moment gyros of one gimbal; its tip stays.

    Two joints each, the last of the robot: "gyro1" of the gimbal and "gyro1_rotor". A plan keeps the rotors' speed,
    momentum over inertia, which is their joints' limit, where it is told to start with it and that they are steady,
    see `ocp.dynamics_problem`.

    Args:
        gimbals, rotors: Axes g of the gimbals, and s of the rotors where the gimbals stand at zero, in the link that
            carries them, at right angles to each other. Shape (k, 3) each.
        momentum: Of each rotor relative to its gimbal, h, one number or (k,), N m s.
        inertia: Of each rotor about its axis, one number or (k,), kg m^2, a disc as of `with_wheels`.
        gimbal_inertia: Of each gimbal without its rotor, about any axis, one number or (k,), kg m^2.
        rate, torque: Of each gimbal at most, one number or (k,), rad/s and N m.
        mass: Of each rotor, one number or (k,), kg.
        translations, link, prefix: As of `with_wheels`.

    Raises:
        ModelError: As of `with_wheels`; axes that are not at right angles.
    """
    owner = "control-moment gyros"
    robot = checked_instance(robot, Robot, owner, "robot")
    about = _directions(gimbals, "gyros", owner, "gimbals")
    count = len(about)
    along = _directions(rotors, count, owner, "rotors")
    checked_text(prefix, owner, "prefix")
    carrier = robot.root if link is None else robot.link(link).name
    frames = one_for_each(gimbal_inertia, count, owner, "gimbal_inertia", "gyros", positive=True)
    rates = one_for_each(rate, count, owner, "rate", "gyros", finite=False, positive=True)
    most = one_for_each(torque, count, owner, "torque", "gyros", finite=False, positive=True)
    held, moments, masses = (
        one_for_each(value, count, owner, what, "gyros", **check)
        for value, what, check in (
            (momentum, "momentum", {"positive": True}),
            (inertia, "inertia", {"positive": True}),
            (mass, "mass", {"least": 0}),
        )
    )
    places = np.zeros((count, 3)) if translations is None else translations
    places = checked_array(places, (count, 3), owner, "translations")
    links, joints = [*robot.links], [*robot.joints]
    for k in range(count):
        name = f"{prefix}{k + 1}"
        gimbal = Joint(name, "continuous", carrier, f"{name}_gimbal", places[k], axis=about[k])
        rotor = Joint(f"{name}_rotor", "continuous", gimbal.child, f"{name}_rotor", axis=along[k])
        if not abs(np.asarray(gimbal.axis) @ np.asarray(rotor.axis)) <= SQUARE:
            message = f"{owner}: the rotor of {name!r} turns about {along[k].tolist()}, not across its gimbal's axis"
            raise ModelError(f"{message} {about[k].tolist()}", name="rotors", value=along[k], limit=about[k])
        joints.append(replace(gimbal, velocity=float(rates[k]), effort=float(most[k])))
        joints.append(replace(rotor, velocity=float(held[k] / moments[k])))
        links.append(Link(gimbal.child, 0.0, (0.0, 0.0, 0.0), frames[k] * np.eye(3)))
        links.append(_rotor(rotor, moments[k], masses[k]))
    return replace(robot, links=tuple(links), joints=tuple(joints))


class Gyro(NamedTuple):
    """A control-moment gyro of a robot.

    Attributes:
        gimbal, rotor: Names of its joints. momentum: Of the rotor at its speed, N m s.
    """

    gimbal: str
    rotor: str
    momentum: float


def gyros_of(robot: Robot) -> tuple[Gyro, ...]:
    """Wheels of a finite speed that a joint without end carries alone, across its axis, in the order of the joints."""
    wheels = wheels_of(robot)
    found, moving = [], {joint.child: joint for joint in robot.moving_joints}
    for name, inertia in wheels.items():
        wheel = robot.joint(name)
        gimbal = moving.get(wheel.parent)
        if gimbal is None or gimbal.kind != "continuous" or not 0 < wheel.velocity < np.inf:
            continue
        alone = [joint.name for joint in robot.joints if joint.parent == wheel.parent] == [name]
        axis = np.asarray(wheel.rotation) @ np.asarray(wheel.axis)
        if alone and robot.tip_link != wheel.parent and abs(axis @ np.asarray(gimbal.axis)) <= SQUARE:
            found.append(Gyro(gimbal.name, name, inertia * wheel.velocity))
    return tuple(found)


@on_scalars
def gyro_matrix(robot: Robot, q: Expression) -> Expression:
    """How gyros turn their momentum: columns h g x s, in the axes of the root. Shape (3, k).

    Its product with the rates of the gimbals is what the carrier gets the other way, N m. At a singularity its rank is
    less than 3.

    Args:
        q: Joint positions. Shape (dof, 1).
    """
    gyros, joints = gyros_of(robot), joint_vector(robot, q)
    frames, columns = link_frames(robot, joints), []
    for gyro in gyros:
        gimbal, wheel = robot.joint(gyro.gimbal), robot.joint(gyro.rotor)
        axis = np.asarray(wheel.rotation) @ np.asarray(wheel.axis)
        crossed = gyro.momentum * np.cross(np.asarray(gimbal.axis), axis)
        columns.append(ca.mtimes(frames[gimbal.child].rotation, ca.DM(crossed)))
    return ca.densify(ca.horzcat(type(joints)(3, 0), *columns))


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
        if about > 0 and np.abs(inertia - ring).max() <= SYMMETRY * about and away**2 * body.mass <= SYMMETRY * about:
            found[joint.name] = about
    return found


@dataclass(frozen=True, eq=False)
class Thruster:
    """A force fixed in a link, in one direction alone, from nothing to what it gives at most.

    Attributes:
        link: Name of the link that carries it.
        direction: Of the force on the link, in the link's frame; stored with unit length. Shape (3,).
        force: At most, N.
        point: Where the force acts, in the link's frame. Shape (3,), m.

    Raises:
        ModelError: No direction, a force that is not positive, wrong sizes.
    """

    link: str
    direction: ArrayInput
    force: float
    point: ArrayInput = (0.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        owner = f"thruster on link {checked_name(self.link, 'thruster', 'link')!r}"
        direction = checked_array(self.direction, (3,), owner, "direction")
        length = float(np.linalg.norm(direction))
        if not length > 0:
            raise ModelError(f"{owner}: direction {direction.tolist()} is none", name="direction", value=direction)
        force = checked_nonnegative(self.force, owner, "force", "N")
        if not force > 0:
            raise ModelError(f"{owner}: force must be positive, not {force}", name="force", value=force, limit=0.0)
        object.__setattr__(self, "direction", checked_array(direction / length, (3,), owner, "direction"))
        object.__setattr__(self, "force", force)
        object.__setattr__(self, "point", checked_array(self.point, (3,), owner, "point"))

    def wrench(self, frames: Mapping[str, Frame], thrust: Expression) -> Wrench:
        """What it does to its link.

        Args:
            frames: Of the links in the world, by name, as of `link_frames`.
            thrust: N. Shape (1, 1).
        """
        along = ca.mtimes(frames[self.link].rotation, ca.DM(np.asarray(self.direction)))
        return Wrench(self.link, along * thrust, point=self.point)
