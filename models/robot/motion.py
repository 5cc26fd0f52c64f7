"""How the links of a robot move: accelerations, the centre of mass, momentum and its rate.

Written in world axes, so that what a planar machine does not do stays a structural zero. The base stands still; joint
positions, velocities and accelerations are of shape (dof, 1) in the order of `robot.joint_names`, as SX, MX, DM or
numbers; ModelError for one of a wrong size. Moments are about points at rest in the world.
"""

from __future__ import annotations

from typing import NamedTuple

import casadi as ca

from models.arrays import checked_instance
from models.robot.kinematics import Placement, checked_vector, each_joint, frames_and_axes
from models.robot.parts import Link, massless
from models.robot.robot import Robot
from models.spatial import Expression, Frame, cross, on_scalars


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
    return motions_of(robot, frames, axes, qd, qdd)


def center_of_mass_motion(
    robot: Robot, q: Expression, qd: Expression, qdd: Expression, world_from_base: Placement | None = None
) -> CenterOfMassMotion:
    """Position, velocity and acceleration of the centre of mass of the whole robot; ModelError if it has no mass."""
    if checked_instance(robot, Robot, "kinematics", "robot").total_mass == 0:
        raise massless("hence no centre of mass")
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
    motions = motions_of(robot, frames, axes, qd, ca.DM(robot.dof, 1))
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
    rates = momentum_rates(robot, frames, motions_of(robot, frames, axes, qd, qdd))
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


def motions_of(
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
