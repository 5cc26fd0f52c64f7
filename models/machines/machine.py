"""The machine protocol that planners use, the robot on a fixed base as its simplest case, and reaction wheels.

A reaction wheel is an ordinary joint with a symmetric rotor. The motor's torque is the joint's effort limit, and the
momentum h = I w at which the wheel saturates gives its speed limit w.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, fields, is_dataclass, replace
from functools import cached_property
from typing import Any, Protocol, TypeAlias, cast

import casadi as ca
import numpy as np

from models.checks import ROUNDING, Array, ArrayInput, require, set_fields, short_repr
from models.errors import ModelError
from models.robot.dynamics import Wrench, checked_wrenches
from models.robot.kinematics import (
    TWIST_SIZE,
    checked_vector,
    jacobian_manipulability,
    joint_vector,
    tip_jacobian,
    tip_pose,
)
from models.robot.parts import Joint, Link
from models.robot.rebuild import lock_joints, move_tip
from models.robot.robot import Robot
from models.spatial import Expression, Frame, cross, expression, on_scalars


class Machine(Protocol):
    """A robot whose base is fixed, or moves only as a consequence of joint motion and conserved momentum.

    `base` is the configuration of the base in the world, shape (base_size, 1): empty for a fixed base, (x, y, angle)
    for a planar one, position and unit quaternion [w, x, y, z] for a spatial one. `q` are the joint positions, shape
    (joint_size, 1). Both may be SX, MX, DM or numbers. Twists are (angular velocity, velocity of the tip's origin),
    world axes. Implement these members to define another kind of machine.

    `tip_twist` and `base_rate` are affine in the joint rates, because a machine with momentum moves even with its
    joints at rest. Their value at zero rates is the drift; `tip_jacobian` is the linear part alone.
    """

    @property
    def robot(self) -> Robot:
        """Kinematic tree of the machine's links and joints."""

    @property
    def base_size(self) -> int:
        """Length of the base configuration: 0 (fixed), 3 (planar) or 7 (spatial)."""

    @property
    def joint_size(self) -> int:
        """Number of independently moving joints."""

    def base_home(self) -> Array:
        """Return the base configuration with root and world frame equal, empty for a fixed base. Shape (base_size,)."""

    def world_from_base(self, base: Expression) -> Frame:
        """Return the pose of the root link's frame in the world."""

    def tip_pose(self, base: Expression, q: Expression) -> Frame:
        """Return the pose of the tip frame in the world: rotation (3, 3), position (3, 1) in m."""

    def tip_jacobian(self, base: Expression, q: Expression) -> Expression:
        """Return the matrix, (6, joint_size), from joint rates to the tip's twist, which includes the base motion."""

    def tip_twist(self, base: Expression, q: Expression, joint_rates: Expression) -> Expression:
        """Return the tip's twist (6, 1): tip_jacobian times joint_rates plus the drift due to conserved momentum."""

    def base_rate(self, base: Expression, q: Expression, joint_rates: Expression) -> Expression:
        """Return the time derivative of the base configuration, including momentum drift. Shape (base_size, 1)."""

    def manipulability(self, base: Expression, q: Expression, rows: Sequence[int] = range(TWIST_SIZE)) -> Expression:
        """Return Yoshikawa's manipulability of the given rows of the tip Jacobian. Shape (1, 1)."""


@dataclass(frozen=True, eq=False)
class FixedBase:
    """A robot whose root link is fixed in the world. Its base configuration is empty: shape (0, 1) or ().

    Attributes:
        robot: Kinematic tree.
        translation: Root link frame's origin in the world. Shape (3,), m.
        rotation: Root link frame's axes, as columns, in the world. Shape (3, 3).

    Raises:
        ModelError: No moving joint, wrong sizes, an invalid rotation.
    """

    robot: Robot
    translation: ArrayInput = (0.0, 0.0, 0.0)
    rotation: ArrayInput = field(default_factory=lambda: np.eye(3))

    __repr__ = short_repr

    def __post_init__(self) -> None:
        if require.instance("machine: robot", self.robot, Robot).dof == 0:
            names = [link.name for link in self.robot.links]
            raise ModelError(f"the robot of the links {names} has no moving joint", name="robot", value=names)
        owner = "fixed base"
        set_fields(self, translation=require.array(f"{owner}: translation", self.translation, (3,)))
        set_fields(self, rotation=require.rotation(f"{owner}: rotation", self.rotation))

    @property
    def base_size(self) -> int:
        """Length of the base configuration: 0, because the base is fixed."""
        return 0

    @property
    def joint_size(self) -> int:
        """Number of independently moving joints."""
        return self.robot.dof

    def base_home(self) -> Array:
        """Return the base configuration, which is empty because the base is fixed. Shape (0,)."""
        return np.zeros(0)

    def world_from_base(self, base: Expression = ()) -> Frame:
        """Return the constant pose of the root link's frame in the world."""
        checked_vector("base", base, 0, "a fixed base has no configuration")
        return Frame(expression(self.rotation), expression(self.translation))

    def tip_pose(self, base: Expression, q: Expression) -> Frame:
        """Return the pose of the tip frame in the world: rotation (3, 3), position (3, 1) in m."""
        self.world_from_base(base)
        return Frame(*self._pose_function(joint_vector(self.robot, q)))

    def tip_jacobian(self, base: Expression, q: Expression) -> Expression:
        """Return the geometric Jacobian of the tip in world axes. Shape (6, joint_size)."""
        self.world_from_base(base)
        return self._jacobian_function(joint_vector(self.robot, q))

    @cached_property
    def _pose_function(self) -> Any:
        """CasADi Function from joint positions to the tip's pose, built once."""
        q = ca.SX.sym("q", self.joint_size)
        return ca.Function("tip_pose", [q], [*map(ca.densify, tip_pose(self.robot, q, self.world_from_base()))])

    @cached_property
    def _jacobian_function(self) -> Any:
        """CasADi Function from joint positions to the geometric Jacobian of the tip, built once."""
        q = ca.SX.sym("q", self.joint_size)
        return ca.Function("tip_jacobian", [q], [tip_jacobian(self.robot, q, self.world_from_base())])

    @on_scalars
    def tip_twist(self, base: Expression, q: Expression, joint_rates: Expression) -> Expression:
        """Return the tip's twist (angular, linear) in world axes, tip_jacobian times joint_rates. Shape (6, 1)."""
        return ca.mtimes(self.tip_jacobian(base, q), joint_vector(self.robot, joint_rates, "joint_rates"))

    @on_scalars
    def base_rate(self, base: Expression, q: Expression, joint_rates: Expression) -> Expression:
        """Return the time derivative of the base configuration, empty because the base is fixed. Shape (0, 1)."""
        return type(joint_vector(self.robot, joint_rates, "joint_rates"))(0, 1)

    def manipulability(self, base: Expression, q: Expression, rows: Sequence[int] = range(TWIST_SIZE)) -> Expression:
        """Return Yoshikawa's manipulability of the given rows of the tip Jacobian. Shape (1, 1)."""
        return jacobian_manipulability(self.tip_jacobian(base, q), rows)


def with_tip(machine: Machine, link: str, translation: ArrayInput = (0.0, 0.0, 0.0)) -> Machine:
    """Return the machine with its tip at a frame in the axes of one of its links.

    Args:
        machine: A FixedBase, a FreeFloating, or any frozen dataclass with a field `robot`.
        link: Name of the link that carries the frame.
        translation: The frame's origin in the link's frame. Shape (3,), m.

    Raises:
        ModelError: Unknown link, wrong sizes, a machine that is not such a dataclass.
    """
    return cast(Machine, replace(_with_robot(machine), robot=move_tip(machine.robot, link, translation)))


def hold_joints(machine: Machine, positions: Mapping[str, float]) -> Machine:
    """Return the machine with some joints, and those that mimic them, locked at given positions (rad or m, by name).

    Raises:
        ModelError: As `models.robot.rebuild.lock_joints` and `with_tip`.
    """
    return cast(Machine, replace(_with_robot(machine), robot=lock_joints(machine.robot, positions)))


def _with_robot(machine: Machine) -> Any:
    """Return the machine after checking that it is a dataclass whose field `robot` can be replaced."""
    if not is_dataclass(machine) or isinstance(machine, type) or "robot" not in {each.name for each in fields(machine)}:
        message = f"{type(machine).__name__} is no dataclass with a field 'robot', which cannot be replaced"
        raise ModelError(message, name="machine", value=machine)
    return machine


def base_twists(world_from_base: Frame, base: Expression) -> Expression:
    """Return the base's twist (angular, linear at the world's origin) per unit rate of each coordinate, (6, size)."""
    orientation, position = (ca.SX(part) for part in world_from_base)
    twists = []
    for k in range(base.numel()):
        spin = ca.mtimes(ca.reshape(ca.jacobian(ca.vec(orientation), base[k]), 3, 3), orientation.T)
        angular = ca.vertcat(spin[2, 1] - spin[1, 2], spin[0, 2] - spin[2, 0], spin[1, 0] - spin[0, 1]) / 2
        twists.append(ca.vertcat(angular, ca.jacobian(position, base[k]) + cross(position, angular)))
    return ca.horzcat(ca.SX(6, 0), *twists)


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
) -> Robot:
    """Return the robot with reaction wheels mounted on one of its links.

    Their joints come last, and the tip is unchanged. The joints are called "wheel1", ..., without names that exist
    already, and the links "wheel1_rotor", ...

    Args:
        axes: Axes of the wheels in the link that carries them, of any non-zero length. Shape (k, 3).
        inertia: Inertia of each rotor about its axis, one number or (k,), kg m^2. The transverse inertia is 0.6 of it,
            as of a disc. The carrier's own mass and inertia exclude the rotors.
        momentum: Saturation momentum of each wheel relative to the carrier, one number or (k,), N m s. The joint's
            speed limit is this over the inertia.
        torque: Torque limit of each motor, one number or (k,), N m.
        mass: Mass of each rotor, one number or (k,), kg.
        translations: Positions of the rotors in the link. Shape (k, 3), m; its origin if None.
        link: Link that carries them; the root if None.

    Raises:
        ModelError: Sizes that differ, an axis of zero length, numbers that are not positive.
    """
    owner = "reaction wheels"
    robot = require.instance(f"{owner}: robot", robot, Robot)
    directions = require.array(f"{owner}: axes", axes, ("wheels", 3))
    for axis in directions:
        if not np.linalg.norm(axis) > 0:
            raise ModelError(f"{owner}: axis {axis.tolist()} has no direction", name="axes", value=axis)
    count = len(directions)
    carrier = robot.root if link is None else robot.link(link).name
    inertias = require.broadcast(f"{owner}: inertia", inertia, count, "wheels", sign="positive")
    momenta = require.broadcast(f"{owner}: momentum", momentum, count, "wheels", entries="numbers", sign="positive")
    torques = require.broadcast(f"{owner}: torque", torque, count, "wheels", entries="numbers", sign="positive")
    masses = require.broadcast(f"{owner}: mass", mass, count, "wheels")
    positions = np.zeros((count, 3)) if translations is None else translations
    positions = require.array(f"{owner}: translations", positions, (count, 3))
    links, joints = [*robot.links], [*robot.joints]
    taken = {joint.name for joint in joints}
    names = (name for name in map("wheel{}".format, itertools.count(1)) if name not in taken)
    for k, name in zip(range(count), names, strict=False):
        joint = Joint(name, "continuous", carrier, f"{name}_rotor", positions[k], axis=directions[k])
        joints.append(replace(joint, velocity=float(momenta[k] / inertias[k]), effort=float(torques[k])))
        transverse = np.eye(3) - np.outer(joint.axis, joint.axis)
        links.append(Link(joint.child, masses[k], (0.0, 0.0, 0.0), inertias[k] * (np.eye(3) - (1 - 0.6) * transverse)))
    return replace(robot, links=tuple(links), joints=tuple(joints))


WrenchFunction: TypeAlias = Callable[[Expression, Expression], Sequence[Wrench]]
Wrenches: TypeAlias = Sequence[Wrench] | WrenchFunction
"""External wrenches: a list, or a function that returns one from the time, s, and the position of the tip in the world,
shape (3, 1), m. A wrench names its link and has its force in world axes and its point of application in the link."""


def wrenches_at(
    wrenches: Wrenches, machine: Machine, base: Expression, q: Expression, *, time: Expression
) -> tuple[Wrench, ...]:
    """Return the external wrenches on a machine at a configuration and a time; raise ModelError for anything else."""
    if not callable(wrenches):
        return checked_wrenches(wrenches)
    return checked_wrenches(require.call("wrenches", wrenches, time, machine.tip_pose(base, q).position))


def find_wheels(robot: Robot) -> dict[str, float]:
    """Return the rotor inertias (kg m^2), by joint, of reaction wheels: joints whose angle does not affect dynamics.

    Such a joint is unbounded and moves a single body, symmetric about the joint axis with its centre of mass on it,
    that carries neither the tip nor a collision shape.
    """
    robot = require.instance("wheels: robot", robot, Robot)
    carriers = {joint.parent for joint in robot.joints} | {robot.tip}
    leaders = {joint.mimic.joint for joint in robot.joints if joint.mimic is not None}
    wheels = {}
    for joint in robot.moving_joints:
        body = robot.link(joint.child)
        if joint.kind == "prismatic" or np.isfinite([joint.lower, joint.upper]).any():
            continue
        if body.name in carriers or body.collisions or joint.name in leaders:
            continue
        axis, inertia = np.asarray(joint.axis), np.asarray(body.inertia)
        axial = float(axis @ inertia @ axis)
        transverse = np.eye(3) - np.outer(axis, axis)
        symmetric = axial * np.outer(axis, axis) + transverse * np.trace(transverse @ inertia) / 2
        offset = np.linalg.norm(transverse @ np.asarray(body.center_of_mass))
        asymmetry, tolerance = np.abs(inertia - symmetric).max(), ROUNDING * axial
        if axial > 0 and asymmetry <= tolerance and offset**2 * body.mass <= tolerance:
            wheels[joint.name] = axial
    return wheels
