"""What the planning code asks of a machine, and the simplest one: a robot on a fixed base.

Reaction wheels, which turn a spacecraft and keep its momentum.

A reaction wheel is a joint as any other: a rotor turns about an axis of the link that carries it, its motor's torque is
the limit of the joint's effort, and the momentum at which it saturates, h = I w, that of the joint's speed w. So
momentum, torques and limits follow from the robot, for FreeFloating machines and in every problem. The rotor is
symmetric: where it stands does not matter, and its angle winds on.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, fields, is_dataclass, replace
from typing import Protocol, cast

import casadi as ca
import numpy as np

from models.arrays import (
    ROUNDING,
    Array,
    ArrayInput,
    checked_array,
    checked_broadcast,
    checked_instance,
    checked_rotation,
    checked_text,
)
from models.errors import ModelError
from models.robot.indices import TWIST_SIZE, jacobian_manipulability
from models.robot.kinematics import checked_vector, joint_vector, tip_jacobian, tip_pose
from models.robot.parts import Joint, Link
from models.robot.robot import Robot
from models.spatial import Expression, Frame, expression, on_scalars


class Machine(Protocol):
    """A robot on some base that moves only as the joints make it move.

    `base` is the configuration of the base, shape (base_size, 1): nothing for a fixed base, (x, y, angle) for
    a planar one, position and unit quaternion [w, x, y, z] for a spatial one, in the world. `q` are the joint
    positions, shape (joint_size, 1). Both may be SX, MX, DM or numbers. Twists are (angular velocity,
    velocity of the tip's origin), world axes. Another kind of machine is made by writing these functions.

    `tip_twist` and `base_rate` are affine in the joint rates: a machine that carries momentum moves with its joints at
    rest too. Their value at zero rates is the drift; `tip_jacobian` is the linear part alone.
    """

    @property
    def robot(self) -> Robot:
        """The kinematic tree."""

    @property
    def base_size(self) -> int:
        """Length of the base configuration: 0, 3 or 7."""

    @property
    def joint_size(self) -> int:
        """Number of moving joints."""

    def base_home(self) -> Array:
        """Base configuration at the world's origin. Shape (base_size,)."""

    def world_from_base(self, base: Expression) -> Frame:
        """Placement of the root link's frame in the world."""

    def tip_pose(self, base: Expression, q: Expression) -> Frame:
        """Frame of the tip in the world: rotation (3, 3), position (3, 1) in m."""

    def tip_jacobian(self, base: Expression, q: Expression) -> Expression:
        """Joint rates to the tip's twist, with the motion of the base that they cause.

        Shape (6, joint_size).
        """

    def tip_twist(self, base: Expression, q: Expression, joint_rates: Expression) -> Expression:
        """tip_jacobian times joint_rates, in fewer operations, and the drift. Shape (6, 1)."""

    def base_rate(self, base: Expression, q: Expression, joint_rates: Expression) -> Expression:
        """Time derivative of the base configuration at these joint rates, with the drift. Shape (base_size, 1)."""

    def manipulability(self, base: Expression, q: Expression, rows: Sequence[int] = range(TWIST_SIZE)) -> Expression:
        """Manipulability of the task that fixes these rows of the tip's twist, as jacobian_manipulability.

        Shape (1, 1).
        """


@dataclass(frozen=True, eq=False)
class FixedBase:
    """A robot whose root link is fastened to the world. The base configuration is empty: shape (0, 1) or ().

    Attributes:
        robot: The kinematic tree.
        translation: Root link frame's origin in the world. Shape (3,), m.
        rotation: Root link frame's axes, as columns, in the world. Shape (3, 3).

    Raises:
        ModelError: No moving joint, wrong sizes, a rotation that is none.
    """

    robot: Robot
    translation: ArrayInput = (0.0, 0.0, 0.0)
    rotation: ArrayInput = field(default_factory=lambda: np.eye(3))

    def __post_init__(self) -> None:
        require_joints(self.robot)
        owner = "fixed base"
        object.__setattr__(self, "translation", checked_array(self.translation, (3,), owner, "translation"))
        object.__setattr__(self, "rotation", checked_rotation(self.rotation, owner, "rotation"))

    @property
    def base_size(self) -> int:
        """0."""
        return 0

    @property
    def joint_size(self) -> int:
        """Number of moving joints."""
        return self.robot.dof

    def base_home(self) -> Array:
        """Nothing. Shape (0,)."""
        return np.zeros(0)

    def world_from_base(self, base: Expression = ()) -> Frame:
        """Placement of the root link's frame in the world, a constant."""
        checked_vector(base, 0, "base", "a fixed base has no configuration")
        return Frame(expression(self.rotation), expression(self.translation))

    @on_scalars
    def tip_pose(self, base: Expression, q: Expression) -> Frame:
        """Frame of the tip in the world."""
        return Frame(*map(ca.densify, tip_pose(self.robot, q, self.world_from_base(base))))

    @on_scalars
    def tip_jacobian(self, base: Expression, q: Expression) -> Expression:
        """Geometric Jacobian of the tip. Shape (6, joint_size)."""
        return tip_jacobian(self.robot, q, self.world_from_base(base))

    @on_scalars
    def tip_twist(self, base: Expression, q: Expression, joint_rates: Expression) -> Expression:
        """Twist of the tip. Shape (6, 1)."""
        return ca.mtimes(self.tip_jacobian(base, q), joint_vector(self.robot, joint_rates, "joint_rates"))

    @on_scalars
    def base_rate(self, base: Expression, q: Expression, joint_rates: Expression) -> Expression:
        """Nothing, of the type of the joint rates. Shape (0, 1)."""
        return type(joint_vector(self.robot, joint_rates, "joint_rates"))(0, 1)

    def manipulability(self, base: Expression, q: Expression, rows: Sequence[int] = range(TWIST_SIZE)) -> Expression:
        """As jacobian_manipulability. Shape (1, 1)."""
        return jacobian_manipulability(self.tip_jacobian(base, q), rows)


def with_tip(
    machine: Machine, link: str, translation: ArrayInput = (0.0, 0.0, 0.0), rotation: ArrayInput | None = None
) -> Machine:
    """The same machine with another frame of interest: one fixed in any of its links, the root included.

    Args:
        machine: A FixedBase, a FreeFloating, or any frozen dataclass with a field `robot`.
        link: Name of the link that carries the frame.
        translation: The frame's origin in the link's frame. Shape (3,), m.
        rotation: The frame's axes, as columns, in the link's frame. Shape (3, 3); parallel if None.

    Raises:
        ModelError: Unknown link, wrong sizes, a machine that is no such dataclass.
    """
    if not is_dataclass(machine) or isinstance(machine, type) or "robot" not in {part.name for part in fields(machine)}:
        message = f"{type(machine).__name__} is no dataclass with a field 'robot': its tip cannot be moved"
        raise ModelError(message, name="machine", value=machine)
    turn = np.eye(3) if rotation is None else rotation
    robot = replace(machine.robot, tip=machine.robot.link(link).name, tip_translation=translation, tip_rotation=turn)
    return cast(Machine, replace(machine, robot=robot))


def require_joints(robot: Robot) -> None:
    """Raise ModelError when the robot has no moving joint, or is none."""
    checked_instance(robot, Robot, "machine", "robot")
    if robot.dof == 0:
        names = [link.name for link in robot.links]
        raise ModelError(f"the robot of the links {names} has no moving joint", name="robot", value=names)


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
    moments = checked_broadcast(inertia, count, owner, "inertia", "wheels", positive=True)
    fastest = checked_broadcast(momentum, count, owner, "momentum", "wheels", finite=False, positive=True) / moments
    most = checked_broadcast(torque, count, owner, "torque", "wheels", finite=False, positive=True)
    masses = checked_broadcast(mass, count, owner, "mass", "wheels", least=0)
    places = np.zeros((count, 3)) if translations is None else translations
    places = checked_array(places, (count, 3), owner, "translations")
    links, joints = [*robot.links], [*robot.joints]
    for k in range(count):
        joint = Joint(f"{prefix}{k + 1}", "continuous", carrier, f"{prefix}{k + 1}_rotor", places[k], axis=along[k])
        joints.append(replace(joint, velocity=float(fastest[k]), effort=float(most[k])))
        across = np.eye(3) - np.outer(joint.axis, joint.axis)
        links.append(Link(joint.child, masses[k], (0.0, 0.0, 0.0), moments[k] * (np.eye(3) - (1 - 0.6) * across)))
    return replace(robot, links=tuple(links), joints=tuple(joints))


def find_wheels(robot: Robot) -> dict[str, float]:
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
