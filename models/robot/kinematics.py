"""Kinematics of robots: frames, Jacobians, motion of the links, centre of mass, momentum and its rate.

Joint positions q, velocities qd and accelerations qdd have shape (dof, 1) in the order of `robot.joint_names`, as SX,
MX, DM or numbers; followers move with their leaders. `world_from_base` = (rotation, position) is the pose of the root
link in the world, the identity if None. The base is at rest unless stated otherwise, and moments are about points at
rest in the world.

Everything is written in world axes, so that what a planar machine cannot do stays a structural zero. All functions
raise ModelError for vectors of a wrong size and unknown links, and for a massless robot if they divide by its mass.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import casadi as ca
import numpy as np

from models.arrays import NOT_NUMBERS, Array, checked_instance
from models.errors import ModelError
from models.robot.parts import Link, massless_error
from models.robot.robot import Robot
from models.spatial import Expression, Frame, cross, expression, on_scalars, rotation, skew

Placement = tuple[Expression, Expression]


class _Turn(NamedTuple):
    """Rotation about consecutive parallel axes: orientation before the first, common axis, sum of angles."""

    before: Expression
    axis: Array
    angle: Expression


class MassMoments(NamedTuple):
    """Mass, first and second moments of a set of bodies about the world's origin: their spatial inertia in ten numbers.

    Attributes:
        mass: kg.
        first: Sum of m c. Shape (3, 1), kg m.
        second: Rotational inertia about the origin, lower triangle only. Shape (3, 3), kg m^2.
    """

    mass: float
    first: Expression
    second: Expression

    def plus(self, other: MassMoments) -> MassMoments:
        """Return the moments of the union of two sets of bodies."""
        return MassMoments(self.mass + other.mass, self.first + other.first, self.second + other.second)

    def momentum(self, angular: Expression, linear: Expression) -> tuple[Expression, Expression]:
        """Return (moment of momentum about the origin, linear momentum) for a common motion vector."""
        angular_momentum = ca.mtimes(ca.tril2symm(self.second), angular)
        return angular_momentum + cross(self.first, linear), self.mass * linear - cross(self.first, angular)

    def spatial_inertia(self) -> Expression:
        """Return the spatial inertia about the origin. Shape (6, 6)."""
        arm = skew(self.first)
        return ca.vertcat(ca.horzcat(ca.tril2symm(self.second), arm), ca.horzcat(arm.T, self.mass * ca.DM.eye(3)))


def joint_vector(robot: Robot, q: Expression, name: str = "q") -> Expression:
    """Return `q` as a column; raise ModelError unless it has one entry for each moving joint."""
    checked_instance(robot, Robot, "kinematics", "robot")
    return checked_vector(q, robot.dof, name, f"one entry for each of the joints {list(robot.joint_names)}")


def checked_vector(value: Expression, size: int, what: str, meaning: str) -> Expression:
    """Return `value` as a column of `size` entries.

    Args:
        what: Name of the argument, for messages, which may be preceded by its owner.
        meaning: Meaning of the entries, for messages.

    Raises:
        ModelError: Another size, or a value that is not numeric or not finite.
    """
    name, limit = what.rpartition(" ")[2], (size, 1)
    try:
        value = expression(value)
    except NOT_NUMBERS as error:
        message = f"{what} {value!r} is not numeric; {limit} expected: {meaning}"
        raise ModelError(message, name=name, value=value, limit=limit) from error
    if value.shape != limit and not (size == 0 and value.numel() == 0):
        message = f"{what} has shape {tuple(value.shape)}, expected {limit}: {meaning}"
        raise ModelError(message, name=name, value=tuple(value.shape), limit=limit)
    if isinstance(value, ca.DM) and not value.is_regular():
        raise ModelError(f"{what} {value} is not finite", name=name, value=np.array(value).ravel())
    return value


def checked_placement(placement: Placement | None) -> Frame:
    """Return the pose of the root link as a frame, the identity if None; raise ModelError if it is invalid."""
    if placement is None:
        return Frame(ca.DM.eye(3), ca.DM(3, 1))
    try:
        orientation, position = map(expression, placement)
    except NOT_NUMBERS as error:
        message = f"world_from_base must be (rotation, position), not {placement!r}"
        raise ModelError(message, name="world_from_base", value=placement) from error
    if orientation.shape != (3, 3) or position.shape != (3, 1):
        message = f"world_from_base has the shapes {orientation.shape}, {position.shape}; (3, 3), (3, 1) expected"
        raise ModelError(
            message, name="world_from_base", value=(orientation.shape, position.shape), limit=((3, 3), (3, 1))
        )
    if not all(part.is_regular() for part in (orientation, position) if isinstance(part, ca.DM)):
        message = f"world_from_base {placement!r} is not finite"
        raise ModelError(message, name="world_from_base", value=placement)
    return Frame(orientation, position)


def each_joint(robot: Robot, vector: Expression, what: str = "q") -> dict[str, Expression]:
    """Expand a joint vector to all moving joints, followers included, by name.

    Correct for rates and accelerations; for positions, the offsets of followers are not added.
    """
    vector = joint_vector(robot, vector, what)
    return {name: vector[k] if ratio == 1 else ratio * vector[k] for name, (k, ratio, _) in robot.couplings.items()}


def by_joint_vector(robot: Robot, by_joint: Mapping[str, Expression]) -> list[Expression]:
    """Reduce quantities of all moving joints, such as Jacobian columns or forces, to the entries of the joint vector.

    Each entry is that of the leader plus multiplier times those of its followers.
    """
    entries = [by_joint[name] for name in robot.joint_names]
    for joint in robot.joints:
        if joint.mimic is not None:
            column, multiplier, _ = robot.couplings[joint.name]
            entries[column] = entries[column] + multiplier * by_joint[joint.name]
    return entries


def link_frames(robot: Robot, q: Expression, world_from_base: Placement | None = None) -> dict[str, Frame]:
    """Return the frames of all links in the world, by link name, root first."""
    return frames_and_axes(robot, q, world_from_base)[0]


def tip_pose(robot: Robot, q: Expression, world_from_base: Placement | None = None) -> Frame:
    """Return the frame of the tip in the world."""
    return tip_frame(robot, link_frames(robot, q, world_from_base))


def tip_frame(robot: Robot, frames: dict[str, Frame]) -> Frame:
    """Return the frame of the tip in the world from the frames of the links."""
    link = frames[robot.tip_link]
    return Frame(ca.mtimes(link.rotation, constant(robot.tip_rotation)), link.point(robot.tip_translation))


def centers_of_mass(robot: Robot, q: Expression, world_from_base: Placement | None = None) -> dict[str, Expression]:
    """Return the centre of mass of each link in the world, by link name. Shape (3, 1) each, m."""
    frames = link_frames(robot, q, world_from_base)
    return {link.name: frames[link.name].point(link.center_of_mass) for link in robot.links}


def center_of_mass(robot: Robot, q: Expression, world_from_base: Placement | None = None) -> Expression:
    """Return the centre of mass of the whole robot in the world. Shape (3, 1), m."""
    frames = link_frames(robot, q, world_from_base)
    if robot.total_mass == 0:
        raise massless_error("hence no centre of mass")
    moment = sum(link.mass * frames[link.name].point(link.center_of_mass) for link in robot.links if link.mass)
    return ca.densify(moment / robot.total_mass)


def frame_jacobian(
    robot: Robot,
    q: Expression,
    link: str,
    point: Expression = (0.0, 0.0, 0.0),
    world_from_base: Placement | None = None,
) -> Expression:
    """Return the geometric Jacobian of a point fixed in a link.

    It maps joint rates to (angular velocity, velocity of the point) in world axes.

    Args:
        link: Name of the link.
        point: In the link's frame. Shape (3,), m.

    Returns:
        Shape (6, dof). Columns of joints that do not carry the link are zero.
    """
    frames, axes = frames_and_axes(robot, q, world_from_base)
    robot.link(link)
    place = frames[link].point(checked_vector(point, 3, "point", "x, y and z in the frame of the link"))
    return ca.densify(point_jacobian(robot, axes, link, place))


def link_jacobians(robot: Robot, q: Expression, world_from_base: Placement | None = None) -> dict[str, Expression]:
    """Return the Jacobians of the origins of all link frames, as frame_jacobian, by link name. Shape (6, dof) each."""
    frames, axes = frames_and_axes(robot, q, world_from_base)
    return {link: ca.densify(point_jacobian(robot, axes, link, frame.position)) for link, frame in frames.items()}


def tip_jacobian(robot: Robot, q: Expression, world_from_base: Placement | None = None) -> Expression:
    """Return the geometric Jacobian of the tip frame.

    It maps joint rates to (angular, linear) velocity in world axes. Shape (6, dof).
    """
    tip = checked_instance(robot, Robot, "kinematics", "robot").tip_link
    return frame_jacobian(robot, q, tip, robot.tip_translation, world_from_base)


def center_of_mass_jacobian(robot: Robot, q: Expression, world_from_base: Placement | None = None) -> Expression:
    """Return the Jacobian of the whole robot's centre of mass, world axes. Shape (3, dof)."""
    matrix = momentum_matrix(robot, q, world_from_base)
    if robot.total_mass == 0:
        raise massless_error("hence no centre of mass")
    return matrix[3:6, :] / robot.total_mass


def momentum_matrix(robot: Robot, q: Expression, world_from_base: Placement | None = None) -> Expression:
    """Return the map from joint rates to (moment of momentum about the world's origin, linear momentum).

    The base is at rest. Shape (6, dof).
    """
    frames, axes = frames_and_axes(robot, q, world_from_base)
    moments = subtree_moments(robot, frames)
    return ca.densify(joint_momenta(robot, axes, moments))


def robot_inertia(robot: Robot, q: Expression, world_from_base: Placement | None = None) -> Expression:
    """Return the spatial inertia with locked joints about the world's origin, world axes. Shape (6, 6)."""
    frames = link_frames(robot, q, world_from_base)
    return ca.densify(subtree_moments(robot, frames)[robot.root].spatial_inertia())


def subtree_moments(robot: Robot, frames: dict[str, Frame]) -> dict[str, MassMoments]:
    """Return the moments of each link with all links that it carries, by link name, about the world's origin."""
    moments: dict[str, MassMoments] = {}
    for link in robot.links:
        turn, center = frames[link.name].rotation, frames[link.name].point(link.center_of_mass)
        inertia: Expression = ca.mtimes(turn, constant(link.inertia))
        second = [[ca.mtimes(inertia[i, :], turn[j, :].T) for j in range(i + 1)] for i in range(3)]
        own = ca.vertcat(*(ca.horzcat(*row, ca.DM(1, 2 - i)) for i, row in enumerate(second)))
        arm = ca.dot(center, center) * ca.DM.eye(3) - ca.tril(ca.mtimes(center, center.T))
        moments[link.name] = MassMoments(link.mass, link.mass * center, own + link.mass * arm)
    for joint in reversed(robot.joints):
        moments[joint.parent] = moments[joint.parent].plus(moments[joint.child])
    return moments


def joint_momenta(
    robot: Robot, axes: dict[str, tuple[Expression, Expression]], moments: dict[str, MassMoments]
) -> Expression:
    """Return momentum_matrix from the axes of frames_and_axes and the moments of subtree_moments."""
    children = {joint.name: moments[joint.child] for joint in robot.joints if joint.moves}
    momenta = {name: ca.vertcat(*children[name].momentum(*axis)) for name, axis in axes.items()}
    return ca.horzcat(ca.DM(6, 0), *by_joint_vector(robot, momenta))


def point_jacobian(
    robot: Robot, axes: dict[str, tuple[Expression, Expression]], link: str, point: Expression
) -> Expression:
    """Return the Jacobian of a point in the world from the axes of frames_and_axes. Shape (6, dof)."""
    carriers = {joint.name for joint in robot.path_to(link)}
    columns = {
        name: ca.vertcat(angular, linear + cross(angular, point)) if name in carriers else ca.DM(6, 1)
        for name, (angular, linear) in axes.items()
    }
    return ca.horzcat(ca.DM(6, 0), *by_joint_vector(robot, columns))


def joint_frames(robot: Robot, q: Expression) -> dict[str, Frame]:
    """Return the frame of each joint's child link in its parent link, by joint name."""
    positions, frames = _positions(robot, q), {}
    for joint in robot.joints:
        orientation, position = constant(joint.rotation), constant(joint.translation)
        if joint.kind == "prismatic":
            position = position + ca.mtimes(orientation, constant(joint.axis)) * positions[joint.name]
        elif joint.moves:
            orientation = ca.mtimes(orientation, rotation(constant(joint.axis), positions[joint.name]))
        frames[joint.name] = Frame(orientation, position)
    return frames


def _positions(robot: Robot, q: Expression) -> dict[str, Expression]:
    """Return the positions of all moving joints, followers included, by name."""
    positions = each_joint(robot, q)
    for name, coupling in robot.couplings.items():
        if coupling.offset:
            positions[name] = positions[name] + coupling.offset
    return positions


def frames_and_axes(
    robot: Robot, q: Expression, world_from_base: Placement | None = None
) -> tuple[dict[str, Frame], dict[str, tuple[Expression, Expression]]]:
    """Return the frames of the links, and the motion vectors of all moving joints, followers included, both by name.

    A motion vector is (angular velocity, velocity at the world's origin) per unit rate of the joint, world axes.
    """
    positions = _positions(robot, q)
    frames: dict[str, Frame] = {robot.root: checked_placement(world_from_base)}
    axes: dict[str, tuple[Expression, Expression]] = {}
    turns: dict[str, _Turn] = {}
    for joint in robot.joints:
        parent, turn = frames[joint.parent], turns.get(joint.parent)
        frame = Frame(ca.mtimes(parent.rotation, constant(joint.rotation)), parent.point(joint.translation))
        if not np.array_equal(joint.rotation, np.eye(3)):
            turn = None
        if joint.kind == "prismatic":
            axis = ca.mtimes(frame.rotation, constant(joint.axis))
            axes[joint.name] = (ca.DM(3, 1), axis)
            frame = Frame(frame.rotation, frame.position + positions[joint.name] * axis)
        elif joint.moves:
            # Angles about consecutive parallel axes add up, which is cheaper than a product of rotations.
            if turn is not None and np.array_equal(turn.axis, joint.axis):
                turn = turn._replace(angle=turn.angle + positions[joint.name])
            else:
                turn = _Turn(frame.rotation, joint.axis, positions[joint.name])
            axis = ca.mtimes(turn.before, constant(joint.axis))
            axes[joint.name] = (axis, cross(frame.position, axis))
            turned = ca.mtimes(turn.before, rotation(constant(joint.axis), turn.angle))
            frame = Frame(turned, frame.position)
        frames[joint.child] = frame
        if turn is not None:
            turns[joint.child] = turn
    return frames, axes


def constant(array: Array) -> Expression:
    """Return an array as a DM without its zeros, including rounding residues such as cos(pi / 2)."""
    return ca.sparsify(ca.DM(array), 1e-15 * float(np.abs(array).max(initial=0.0)))


class LinkMotion(NamedTuple):
    """Motion of a link, world axes.

    Attributes:
        center: Position of its centre of mass. Shape (3, 1), m.
        velocity, acceleration: Of the centre of mass. Shape (3, 1).
        angular_velocity, angular_acceleration: Shape (3, 1).
    """

    center: Expression
    velocity: Expression
    acceleration: Expression
    angular_velocity: Expression
    angular_acceleration: Expression


class CenterOfMassMotion(NamedTuple):
    """Position (m), velocity and acceleration of the centre of mass of the whole robot. Shape (3, 1) each."""

    position: Expression
    velocity: Expression
    acceleration: Expression


def link_motions(
    robot: Robot, q: Expression, qd: Expression, qdd: Expression, world_from_base: Placement | None = None
) -> dict[str, LinkMotion]:
    """Return the motion of every link, by name, root first."""
    frames, axes = frames_and_axes(robot, q, world_from_base)
    return propagate_motions(robot, frames, axes, qd, qdd)


@on_scalars
def center_of_mass_motion(
    robot: Robot, q: Expression, qd: Expression, qdd: Expression, world_from_base: Placement | None = None
) -> CenterOfMassMotion:
    """Return the motion of the centre of mass; raise ModelError if the robot has no mass."""
    if checked_instance(robot, Robot, "kinematics", "robot").total_mass == 0:
        raise massless_error("hence no centre of mass")
    motions = link_motions(robot, q, qd, qdd, world_from_base)
    weighted = [[link.mass * part for part in motions[link.name][:3]] for link in robot.links]
    sums = (sum(parts, start=ca.DM(3, 1)) for parts in zip(*weighted, strict=True))
    return CenterOfMassMotion(*(ca.densify(part / robot.total_mass) for part in sums))


@on_scalars
def momentum(
    robot: Robot,
    q: Expression,
    qd: Expression,
    about: Expression = (0.0, 0.0, 0.0),
    world_from_base: Placement | None = None,
) -> Expression:
    """Return (moment of momentum about a point of the world, linear momentum). Shape (6, 1), N m s and N s."""
    frames, axes = frames_and_axes(robot, q, world_from_base)
    motions = propagate_motions(robot, frames, axes, qd, ca.DM(robot.dof, 1))
    place = checked_vector(about, 3, "about", "a point of the world")
    total: Expression = ca.DM(6, 1)
    for link in robot.links:
        motion, inertia = motions[link.name], inertia_in_world(link, frames)
        push = link.mass * motion.velocity
        spin = ca.mtimes(inertia, motion.angular_velocity)
        total = total + ca.vertcat(spin + cross(motion.center - place, push), push)
    return ca.densify(total)


@on_scalars
def momentum_rate(
    robot: Robot,
    q: Expression,
    qd: Expression,
    qdd: Expression,
    about: Expression = (0.0, 0.0, 0.0),
    world_from_base: Placement | None = None,
) -> Expression:
    """Return the time derivative of :func:`momentum` about a point at rest. Shape (6, 1), N m and N.

    It is the same about a point that moves with the centre of mass, whose velocity is parallel to the momentum.
    """
    frames, axes = frames_and_axes(robot, q, world_from_base)
    motions = propagate_motions(robot, frames, axes, qd, qdd)
    place = checked_vector(about, 3, "about", "a point of the world")
    total: Expression = ca.DM(6, 1)
    for link in robot.links:
        motion, inertia = motions[link.name], inertia_in_world(link, frames)
        spin = motion.angular_velocity
        force = link.mass * motion.acceleration
        moment = ca.mtimes(inertia, motion.angular_acceleration) + cross(spin, ca.mtimes(inertia, spin))
        total = total + ca.vertcat(moment + cross(motion.center, force), force)
    return ca.densify(ca.vertcat(total[0:3] - cross(place, total[3:6]), total[3:6]))


def propagate_motions(
    robot: Robot,
    frames: dict[str, Frame],
    axes: dict[str, tuple[Expression, Expression]],
    qd: Expression,
    qdd: Expression,
) -> dict[str, LinkMotion]:
    """Propagate the motion from the root outwards over the link frames, then to the centres of mass."""
    rates, accelerations = each_joint(robot, qd, "qd"), each_joint(robot, qdd, "qdd")
    # velocity and acceleration of the frame's origin, angular velocity, angular acceleration
    origin: dict[str, tuple[Expression, Expression, Expression, Expression]] = {robot.root: (ca.DM(3, 1),) * 4}
    for joint in robot.joints:
        velocity, acceleration, spin, turning = origin[joint.parent]
        arm = frames[joint.child].position - frames[joint.parent].position
        swing = cross(spin, arm)
        velocity, acceleration = velocity + swing, acceleration + cross(turning, arm) + cross(spin, swing)
        if joint.moves:
            angular, linear = axes[joint.name]
            rate, push = rates[joint.name], accelerations[joint.name]
            if joint.kind == "prismatic":
                velocity = velocity + linear * rate
                acceleration = acceleration + linear * push + 2 * cross(spin, linear * rate)
            else:
                turning = turning + angular * push + cross(spin, angular * rate)
                spin = spin + angular * rate
        origin[joint.child] = (velocity, acceleration, spin, turning)
    motions = {}
    for link in robot.links:
        velocity, acceleration, spin, turning = origin[link.name]
        center = frames[link.name].point(link.center_of_mass)
        arm = center - frames[link.name].position
        swing = cross(spin, arm)
        acceleration = acceleration + cross(turning, arm) + cross(spin, swing)
        motions[link.name] = LinkMotion(center, velocity + swing, acceleration, spin, turning)
    return motions


def inertia_in_world(link: Link, frames: dict[str, Frame]) -> Expression:
    """Return the rotational inertia about the centre of mass, world axes. Shape (3, 3)."""
    turn = frames[link.name].rotation
    return ca.mtimes([turn, ca.sparsify(ca.DM(link.inertia)), turn.T])
