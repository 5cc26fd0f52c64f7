"""Where the links of a robot are and how they move: frames, Jacobians, centre of mass, momentum.

Every function takes the joint positions q, shape (dof, 1) in the order of `robot.joint_names`, as SX, MX, DM or
numbers, with which joints that follow others move too, and the placement of the root link in the world,
`world_from_base` = (rotation, position), the world's own frame if None. Velocities and momenta are those of the
joints alone: the base stands still unless said otherwise. All raise ModelError for a q of a wrong size, for a link that
does not exist, and, where they divide by it, for no mass.

How the links of a robot move: accelerations, the centre of mass, momentum and its rate.

Written in world axes, so that what a planar machine does not do stays a structural zero. The base stands still; joint
positions, velocities and accelerations are of shape (dof, 1) in the order of `robot.joint_names`, as SX, MX, DM or
numbers; ModelError for one of a wrong size. Moments are about points at rest in the world.
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
    before: Expression  # rotation of the link before the first of the parallel axes
    axis: Array
    angle: Expression


class MassMoments(NamedTuple):
    """Mass, first and second moments of a set of bodies about the world's origin.

    Their spatial inertia in ten numbers.

    Attributes:
        mass: kg.
        first: Sum of m c. Shape (3, 1), kg m.
        second: Rotational inertia about the origin, lower triangle only. Shape (3, 3), kg m^2.
    """

    mass: float
    first: Expression
    second: Expression

    def plus(self, other: MassMoments) -> MassMoments:
        """Moments of both sets of bodies together."""
        return MassMoments(self.mass + other.mass, self.first + other.first, self.second + other.second)

    def momentum(self, angular: Expression, linear: Expression) -> tuple[Expression, Expression]:
        """(Moment of momentum about the origin, linear momentum) when all bodies share one motion vector."""
        turned = ca.mtimes(ca.tril2symm(self.second), angular)
        return turned + cross(self.first, linear), self.mass * linear - cross(self.first, angular)

    def spatial_inertia(self) -> Expression:
        """Spatial inertia about the origin. Shape (6, 6)."""
        arm = skew(self.first)
        return ca.vertcat(ca.horzcat(ca.tril2symm(self.second), arm), ca.horzcat(arm.T, self.mass * ca.DM.eye(3)))


def joint_vector(robot: Robot, q: Expression, what: str = "q") -> Expression:
    """`q` as a column; ModelError unless it has one entry for each moving joint."""
    checked_instance(robot, Robot, "kinematics", "robot")
    return checked_vector(q, robot.dof, what, f"one entry for each of the joints {list(robot.joint_names)}")


def checked_vector(value: Expression, size: int, what: str, meaning: str) -> Expression:
    """`value` as a column of `size`; ModelError naming `what`, an argument, and `meaning` otherwise."""
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
    """A placement of the root link as a frame, the world's own if None; ModelError for anything else."""
    if placement is None:
        return Frame(ca.DM.eye(3), ca.DM(3, 1))
    try:
        turn, position = map(expression, placement)
    except NOT_NUMBERS as error:
        message = f"world_from_base must be (rotation, position), not {placement!r}"
        raise ModelError(message, name="world_from_base", value=placement) from error
    if turn.shape != (3, 3) or position.shape != (3, 1):
        message = f"world_from_base has the shapes {turn.shape}, {position.shape}; (3, 3), (3, 1) expected"
        raise ModelError(message, name="world_from_base", value=(turn.shape, position.shape), limit=((3, 3), (3, 1)))
    if not all(part.is_regular() for part in (turn, position) if isinstance(part, ca.DM)):
        message = f"world_from_base {placement!r} is not finite"
        raise ModelError(message, name="world_from_base", value=placement)
    return Frame(turn, position)


def each_joint(robot: Robot, vector: Expression, what: str = "q") -> dict[str, Expression]:
    """Rates or accelerations of all joints that move, followers included, by name, from those of the joint vector; of
    its positions, followers' lack their offsets. ModelError as of joint_vector.
    """
    vector = joint_vector(robot, vector, what)
    return {name: vector[k] if ratio == 1 else ratio * vector[k] for name, (k, ratio, _) in robot.couplings.items()}


def by_joint_vector(robot: Robot, given: Mapping[str, Expression]) -> list[Expression]:
    """What belongs to each entry of the joint vector, given what belongs to each joint that moves, by name.

    Columns of a Jacobian or forces: that of the joint, and multiplier times those of its followers.
    """
    found = [given[name] for name in robot.joint_names]
    for joint in robot.joints:
        if joint.mimic is not None:
            column, multiplier, _ = robot.couplings[joint.name]
            found[column] = found[column] + multiplier * given[joint.name]
    return found


def link_frames(robot: Robot, q: Expression, world_from_base: Placement | None = None) -> dict[str, Frame]:
    """Frames of all links in the world, by link name, root first."""
    return frames_and_axes(robot, q, world_from_base)[0]


def tip_pose(robot: Robot, q: Expression, world_from_base: Placement | None = None) -> Frame:
    """Frame of the tip in the world."""
    return tip_frame(robot, link_frames(robot, q, world_from_base))


def tip_frame(robot: Robot, frames: dict[str, Frame]) -> Frame:
    """Frame of the tip in the world, given the frames of the links."""
    link = frames[robot.tip_link]
    return Frame(ca.mtimes(link.rotation, constant(robot.tip_rotation)), link.point(robot.tip_translation))


def centers_of_mass(robot: Robot, q: Expression, world_from_base: Placement | None = None) -> dict[str, Expression]:
    """Centre of mass of each link in the world, by link name. Shape (3, 1) each, m."""
    frames = link_frames(robot, q, world_from_base)
    return {link.name: frames[link.name].point(link.center_of_mass) for link in robot.links}


def center_of_mass(robot: Robot, q: Expression, world_from_base: Placement | None = None) -> Expression:
    """Centre of mass of the whole robot in the world. Shape (3, 1), m."""
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
    """Geometric Jacobian of a point fixed in a link.

    Joint rates to (angular velocity, velocity of the point), world axes.

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
    """As frame_jacobian for the origins of all link frames, by link name. Shape (6, dof) each."""
    frames, axes = frames_and_axes(robot, q, world_from_base)
    return {link: ca.densify(point_jacobian(robot, axes, link, frame.position)) for link, frame in frames.items()}


def tip_jacobian(robot: Robot, q: Expression, world_from_base: Placement | None = None) -> Expression:
    """Geometric Jacobian of the tip: joint rates to (angular, linear) velocity of the tip frame, world axes.

    Shape (6, dof).
    """
    tip = checked_instance(robot, Robot, "kinematics", "robot").tip_link
    return frame_jacobian(robot, q, tip, robot.tip_translation, world_from_base)


def center_of_mass_jacobian(robot: Robot, q: Expression, world_from_base: Placement | None = None) -> Expression:
    """Jacobian of the whole robot's centre of mass. Shape (3, dof), world axes."""
    matrix = momentum_matrix(robot, q, world_from_base)
    if robot.total_mass == 0:
        raise massless_error("hence no centre of mass")
    return matrix[3:6, :] / robot.total_mass


def momentum_matrix(robot: Robot, q: Expression, world_from_base: Placement | None = None) -> Expression:
    """Joint rates to (moment of momentum about the world's origin, linear momentum), the base standing still.

    Shape (6, dof).
    """
    frames, axes = frames_and_axes(robot, q, world_from_base)
    moments = subtree_moments(robot, frames)
    return ca.densify(joint_momenta(robot, axes, moments))


def robot_inertia(robot: Robot, q: Expression, world_from_base: Placement | None = None) -> Expression:
    """Spatial inertia of the robot with locked joints about the world's origin, world axes. Shape (6, 6)."""
    frames = link_frames(robot, q, world_from_base)
    return ca.densify(subtree_moments(robot, frames)[robot.root].spatial_inertia())


def subtree_moments(robot: Robot, frames: dict[str, Frame]) -> dict[str, MassMoments]:
    """Moments of each link together with all links it carries, by link name, about the world's origin."""
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
    """As momentum_matrix, from the axes of frames_and_axes and the moments of subtree_moments."""
    children = {joint.name: moments[joint.child] for joint in robot.joints if joint.moves}
    momenta = {name: ca.vertcat(*children[name].momentum(*axis)) for name, axis in axes.items()}
    return ca.horzcat(ca.DM(6, 0), *by_joint_vector(robot, momenta))


def point_jacobian(
    robot: Robot, axes: dict[str, tuple[Expression, Expression]], link: str, point: Expression
) -> Expression:
    """As frame_jacobian, from the axes of frames_and_axes and a point in the world. Shape (6, dof)."""
    carriers = {joint.name for joint in robot.path_to(link)}
    columns = {
        name: ca.vertcat(angular, linear + cross(angular, point)) if name in carriers else ca.DM(6, 1)
        for name, (angular, linear) in axes.items()
    }
    return ca.horzcat(ca.DM(6, 0), *by_joint_vector(robot, columns))


def joint_frames(robot: Robot, q: Expression) -> dict[str, Frame]:
    """Frame of each joint's child in that of its parent, by the name of the joint."""
    positions, found = _positions(robot, q), {}
    for joint in robot.joints:
        turn, place = constant(joint.rotation), constant(joint.translation)
        if joint.kind == "prismatic":
            place = place + ca.mtimes(turn, constant(joint.axis)) * positions[joint.name]
        elif joint.moves:
            turn = ca.mtimes(turn, rotation(constant(joint.axis), positions[joint.name]))
        found[joint.name] = Frame(turn, place)
    return found


def _positions(robot: Robot, q: Expression) -> dict[str, Expression]:
    """Positions of all joints that move, followers included, by name."""
    found = each_joint(robot, q)
    for name, drive in robot.couplings.items():
        if drive.offset:
            found[name] = found[name] + drive.offset
    return found


def frames_and_axes(
    robot: Robot, q: Expression, world_from_base: Placement | None = None
) -> tuple[dict[str, Frame], dict[str, tuple[Expression, Expression]]]:
    """Frames of the links, and motion vectors of all joints that move, followers included, both by name.

    A motion vector is (angular velocity, velocity at the world's origin) per unit rate of that joint, world axes.
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
            # Parallel axes in a row: the angles add up, which is cheaper than a product of rotations.
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
    """An array without its zeros, and without what rounding leaves of cos(pi / 2), which would hide them."""
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
    """Motion of every link, by name, root first."""
    frames, axes = frames_and_axes(robot, q, world_from_base)
    return propagate_motions(robot, frames, axes, qd, qdd)


def center_of_mass_motion(
    robot: Robot, q: Expression, qd: Expression, qdd: Expression, world_from_base: Placement | None = None
) -> CenterOfMassMotion:
    """Position, velocity and acceleration of the centre of mass of the whole robot; ModelError if it has no mass."""
    if checked_instance(robot, Robot, "kinematics", "robot").total_mass == 0:
        raise massless_error("hence no centre of mass")
    return CenterOfMassMotion(*_center_of_mass_motion(robot, q, qd, qdd, world_from_base))


@on_scalars
def momentum(
    robot: Robot,
    q: Expression,
    qd: Expression,
    about: Expression = (0.0, 0.0, 0.0),
    world_from_base: Placement | None = None,
) -> Expression:
    """(Moment of momentum about a point of the world, linear momentum). Shape (6, 1), N m s and N s."""
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
    """Time derivative of :func:`momentum` about a point at rest. Shape (6, 1), N m and N.

    About a point that moves with the centre of mass it is the same, the velocity of that being along the momentum.
    """
    frames, axes = frames_and_axes(robot, q, world_from_base)
    rates = momentum_rates(robot, frames, propagate_motions(robot, frames, axes, qd, qdd))
    place = checked_vector(about, 3, "about", "a point of the world")
    total: Expression = sum(rates.values(), start=ca.DM(6, 1))
    return ca.densify(ca.vertcat(total[0:3] - cross(place, total[3:6]), total[3:6]))


@on_scalars
def _center_of_mass_motion(
    robot: Robot, q: Expression, qd: Expression, qdd: Expression, world_from_base: Placement | None
) -> tuple[Expression, ...]:
    motions = link_motions(robot, q, qd, qdd, world_from_base)
    weighted = [[link.mass * part for part in motions[link.name][:3]] for link in robot.links]
    sums = (sum(parts, start=ca.DM(3, 1)) for parts in zip(*weighted, strict=True))
    return tuple(ca.densify(part / robot.total_mass) for part in sums)


def propagate_motions(
    robot: Robot,
    frames: dict[str, Frame],
    axes: dict[str, tuple[Expression, Expression]],
    qd: Expression,
    qdd: Expression,
) -> dict[str, LinkMotion]:
    """Outward recursion over the origins of the link frames, then from these to the centres of mass."""
    rates, accelerations = each_joint(robot, qd, "qd"), each_joint(robot, qdd, "qdd")
    # of the frame's origin: velocity, acceleration, angular velocity, angular acceleration
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
    """Rotational inertia about the centre of mass, world axes. Shape (3, 3)."""
    turn = frames[link.name].rotation
    return ca.mtimes([turn, ca.sparsify(ca.DM(link.inertia)), turn.T])


def momentum_rates(robot: Robot, frames: dict[str, Frame], motions: dict[str, LinkMotion]) -> dict[str, Expression]:
    """d/dt of each link's momentum about the world's origin, by link name. Shape (6, 1) each."""
    rates = {}
    for link in robot.links:
        motion, inertia = motions[link.name], inertia_in_world(link, frames)
        spin = motion.angular_velocity
        force = link.mass * motion.acceleration
        moment = ca.mtimes(inertia, motion.angular_acceleration) + cross(spin, ca.mtimes(inertia, spin))
        rates[link.name] = ca.vertcat(moment + cross(motion.center, force), force)
    return rates
