"""Dynamics of robots: momentum, mass matrix, and the joint torques and base reaction of motions under external loads.

Joint positions, velocities and accelerations have shape (dof, 1) in the order of `robot.joint_names`, as SX, MX, DM or
numbers. The base is at rest unless its motion is given; moments are about points at rest in the world. All functions
raise ModelError for wrong sizes and for a wrench on an unknown link.

Inverse dynamics is the recursive Newton-Euler algorithm (Luh, Walker, Paul 1980; Featherstone 2008, chapter 5) in link
axes. Its arguments are of one kind: wrenches with SX entries need SX positions.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import casadi as ca
import numpy as np

from models.checks import require, set_fields
from models.robot.kinematics import (
    Placement,
    center_of_mass,
    checked_placement,
    checked_vector,
    constant,
    expand_joint_vector,
    frames_and_axes,
    joint_frames,
    joint_vector,
    link_frames,
    reduce_to_joint_vector,
)
from models.robot.parts import massless_error
from models.robot.rebuild import simplify
from models.robot.robot import Robot
from models.spatial import Expression, Frame, cross, on_scalars, skew

GRAVITY = (0.0, 0.0, -9.81)
"""Gravitational acceleration in the world, z upwards, m/s^2."""


@dataclass(frozen=True, eq=False)
class Wrench:
    """An external force and moment that act on a link of a robot.

    Each part is a CasADi vector, numbers, or a list of either; it is stored as a CasADi column.

    Attributes:
        link: Name of the link.
        force: In world axes. Shape (3,), N.
        moment: In world axes, in addition to that of the force. Shape (3,), N m.
        point: Point of application of the force, in the link's frame. Shape (3,), m.

    Raises:
        ModelError: A part that does not have three entries, or is not finite.
    """

    link: str
    force: Expression = (0.0, 0.0, 0.0)
    moment: Expression = (0.0, 0.0, 0.0)
    point: Expression = (0.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        require.name("wrench: link", self.link)
        owner = f"wrench on link {self.link!r}"
        for part in ("force", "moment", "point"):
            value = checked_vector(f"{owner}: {part}", getattr(self, part), 3, "x, y and z")
            if isinstance(value, ca.DM):
                require.array(f"{owner}: {part}", np.array(value).ravel(), (3,))
            set_fields(self, **{part: value})


def inverse_dynamics(
    robot: Robot,
    q: Expression,
    qd: Expression,
    qdd: Expression,
    *,
    wrenches: Sequence[Wrench] = (),
    gravity: Expression = GRAVITY,
    world_from_base: Placement | None = None,
    base_motion: tuple[Expression, Expression] | None = None,
) -> Expression:
    """Return the joint torques (forces of prismatic joints) that a motion requires. Shape (dof, 1), N m or N.

    A joint also drives the joints that mimic it: its entry is its own torque plus multiplier times each of theirs.

    Args:
        gravity: In world axes. Shape (3,), m/s^2.
        base_motion: Twist of the base, (angular velocity, velocity of the origin of the root link's frame), and its
            time derivative, world axes. Shape (6, 1) each; at rest if None.
    """
    stacked, links = stacked_wrenches(robot, wrenches), tuple(wrench.link for wrench in wrenches)
    return _efforts(robot, q, qd, qdd, stacked, links, gravity, world_from_base, *_twist_and_rate(base_motion))[0]


def base_reaction(
    robot: Robot,
    q: Expression,
    qd: Expression,
    qdd: Expression,
    *,
    wrenches: Sequence[Wrench] = (),
    gravity: Expression = GRAVITY,
    world_from_base: Placement | None = None,
    base_motion: tuple[Expression, Expression] | None = None,
) -> Expression:
    """Return the wrench that the ground exerts on the root link: (moment about the world's origin, force).

    It is the rate of momentum less the weight of all links, including the root link, and less the external wrenches.
    For a moving base (arguments as in inverse_dynamics) it is the wrench that drives it, zero for a floating base.
    Shape (6, 1), N m and N.
    """
    stacked, links = stacked_wrenches(robot, wrenches), tuple(wrench.link for wrench in wrenches)
    return _efforts(robot, q, qd, qdd, stacked, links, gravity, world_from_base, *_twist_and_rate(base_motion))[1]


@on_scalars
def mass_matrix(robot: Robot, q: Expression) -> Expression:
    """Return the joint-space mass matrix with the base at rest. Shape (dof, dof), kg m^2, kg m or kg.

    Composite rigid bodies (Featherstone 2008, 6.2): M_ij is the momentum of all links that joint j carries, per
    rate of j, along the axis of each joint i that carries j.
    """
    frames, axes = frames_and_axes(robot, q)
    moments = subtree_moments(robot, frames)
    matrix: dict[tuple[str, str], Expression] = {}
    for joint in robot.joints:
        if joint.moves:
            momentum = ca.vertcat(*moments[joint.child].momentum(*axes[joint.name]))
            for carrier in robot.path_to(joint.child):
                if carrier.moves:
                    entry = ca.dot(ca.vertcat(*axes[carrier.name]), momentum)
                    matrix[carrier.name, joint.name] = matrix[joint.name, carrier.name] = entry
    rows = {i: {j: matrix.get((i, j), ca.DM(1, 1)) for j in axes} for i in axes}
    columns = {i: ca.vertcat(ca.DM(0, 1), *reduce_to_joint_vector(robot, row)) for i, row in rows.items()}
    return ca.densify(ca.horzcat(ca.DM(robot.dof, 0), *reduce_to_joint_vector(robot, columns)))


def external_wrench(
    robot: Robot, q: Expression, wrenches: Sequence[Wrench], world_from_base: Placement | None = None
) -> Expression:
    """Return the resultant of external wrenches: (moment about the world's origin, force). Shape (6, 1)."""
    frames = link_frames(robot, q, world_from_base)
    total: Expression = ca.DM(6, 1)
    for wrench in checked_wrenches(wrenches):
        arm = frames[robot.link(wrench.link).name].point(wrench.point)
        total = total + ca.vertcat(wrench.moment + cross(arm, wrench.force), wrench.force)
    return ca.densify(total)


def checked_wrenches(wrenches: Sequence[Wrench]) -> tuple[Wrench, ...]:
    """Return a list of wrenches as a tuple; raise ModelError if an entry is not a `Wrench`."""
    return require.each("dynamics: wrenches", wrenches, Wrench)


def stacked_wrenches(robot: Robot, wrenches: Sequence[Wrench]) -> Expression:
    """Return k external wrenches as the columns (moment, force, point of application) of a matrix. Shape (9, k)."""
    require.instance("dynamics: robot", robot, Robot)
    columns = []
    for wrench in checked_wrenches(wrenches):
        robot.link(wrench.link)
        columns.append(ca.vertcat(wrench.moment, wrench.force, wrench.point))
    return ca.horzcat(ca.DM(9, 0), *columns)


def _parts(stacked: Expression, column: int) -> tuple[Expression, Expression, Expression]:
    """Return moment, force and point of application of one external wrench, a column of `stacked_wrenches`."""
    moment, force, point = (stacked[3 * i : 3 * i + 3, column] for i in range(3))
    return moment, force, point


def _twist_and_rate(base_motion: tuple[Expression, Expression] | None) -> tuple[Expression | None, Expression | None]:
    """Return the twist of a moving base and its time derivative, or (None, None) for a base at rest."""
    if base_motion is None:
        return None, None
    if not isinstance(base_motion, tuple | list) or len(base_motion) != 2:
        raise require.invalid("base_motion", "a pair (twist, acceleration)", base_motion)
    return base_motion[0], base_motion[1]


@on_scalars
def _efforts(
    robot: Robot,
    q: Expression,
    qd: Expression,
    qdd: Expression,
    stacked: Expression,
    links: tuple[str, ...],
    gravity: Expression,
    world_from_base: Placement | None,
    base_twist: Expression | None,
    base_acceleration: Expression | None,
) -> tuple[Expression, Expression]:
    """Return the joint torques and the base reaction of a motion by the recursive Newton-Euler algorithm.

    A point x of a link accelerates by a + U x, with U = [alpha x] + [omega x]^2 of the link and a of its origin, less
    gravity. So the link needs the force m a + U h and the moment cross(h, a) + sum of m cross(x, U x). The entries of
    that sum are twice those of the antisymmetric part of U J; h and J are the sums of m x and of m x x'.
    """
    ground = checked_placement(world_from_base)
    frames = link_frames(robot, q, world_from_base) if links else {}
    robot = simplify(robot, links)
    joints = joint_frames(robot, q)
    loads: dict[str, tuple[Expression, Expression]] = {}
    motions = _motions_in_links(robot, joints, qd, qdd, gravity, ground, base_twist, base_acceleration)
    for link in robot.links:
        acceleration, field = motions[link.name]
        center, about_center = link.center_of_mass, np.trace(link.inertia) / 2 * np.eye(3) - link.inertia
        first_moment = constant(link.mass * center)
        second_moment = constant(about_center + link.mass * np.outer(center, center))
        turned = ca.mtimes(field, second_moment)
        moment = ca.vertcat(turned[2, 1] - turned[1, 2], turned[0, 2] - turned[2, 0], turned[1, 0] - turned[0, 1])
        force = link.mass * acceleration + ca.mtimes(field, first_moment)
        loads[link.name] = moment + cross(first_moment, acceleration), force
    for column, name in enumerate(links):
        moment, force, point = _parts(stacked, column)
        moment, force = (ca.mtimes(frames[name].rotation.T, part) for part in (moment, force))
        load = loads[name]
        loads[name] = load[0] - moment - cross(point, force), load[1] - force
    torques: dict[str, Expression] = {}
    for joint in reversed(robot.joints):
        moment, force = loads[joint.child]
        if joint.moves:
            torques[joint.name] = ca.dot(constant(joint.axis), force if joint.kind == "prismatic" else moment)
        turn, position = joints[joint.name]
        moment, force = (ca.mtimes(turn, part) for part in (moment, force))
        load = loads[joint.parent]
        loads[joint.parent] = load[0] + moment + cross(position, force), load[1] + force
    moment, force = (ca.mtimes(ground.rotation, part) for part in loads[robot.root])
    reaction = ca.vertcat(moment + cross(ground.position, force), force)
    return ca.densify(ca.vertcat(ca.DM(0, 1), *reduce_to_joint_vector(robot, torques))), reaction


def _motions_in_links(
    robot: Robot,
    joints: dict[str, Frame],
    qd: Expression,
    qdd: Expression,
    gravity: Expression,
    ground: Frame,
    base_twist: Expression | None,
    base_acceleration: Expression | None,
) -> dict[str, tuple[Expression, Expression]]:
    """Return, by link name, the origin's acceleration minus gravity and [alpha x] + [omega x]^2, in link axes."""
    rates, accelerations = expand_joint_vector(robot, qd, "qd"), expand_joint_vector(robot, qdd, "qdd")
    g = checked_vector("gravity", gravity, 3, "x, y and z")
    meaning = "angular, then of the origin of the root link's frame"
    twist, twist_rate = (
        ca.DM(6, 1) if vector is None else checked_vector(name, vector, 6, meaning)
        for vector, name in ((base_twist, "base_twist"), (base_acceleration, "base_acceleration"))
    )
    # angular velocity, angular acceleration, acceleration of the origin less gravity
    parts = twist[0:3], twist_rate[0:3], twist_rate[3:6] - g
    omega, alpha, acceleration = (ca.mtimes(ground.rotation.T, part) for part in parts)
    origin = {robot.root: (omega, alpha, acceleration)}
    fields = {robot.root: (acceleration, _field(omega, alpha))}
    for joint in robot.joints:
        turn, position = joints[joint.name]
        omega, alpha, acceleration = origin[joint.parent]
        acceleration = acceleration + ca.mtimes(fields[joint.parent][1], position)
        omega, alpha, acceleration = (ca.mtimes(turn.T, part) for part in (omega, alpha, acceleration))
        if joint.moves:
            rate, joint_acceleration = (constant(joint.axis) * part[joint.name] for part in (rates, accelerations))
            if joint.kind == "prismatic":
                acceleration = acceleration + joint_acceleration + 2 * cross(omega, rate)
            else:
                alpha = alpha + joint_acceleration + cross(omega, rate)
                omega = omega + rate
        origin[joint.child] = (omega, alpha, acceleration)
        fields[joint.child] = (acceleration, _field(omega, alpha))
    return fields


def _field(omega: Expression, alpha: Expression) -> Expression:
    """Return the matrix [alpha x] + [omega x]^2, which maps body points to accelerations relative to the origin."""
    squares = ca.mtimes(omega, omega.T)
    return skew(alpha) + squares - ca.trace(squares) * ca.DM.eye(3)


class MassMoments(NamedTuple):
    """Mass and first and second mass moments of a set of bodies about the world's origin."""

    mass: float  # kg
    first: Expression  # sum of mass times centre of mass. Shape (3, 1), kg m.
    second: Expression  # rotational inertia about the origin, lower triangle only. Shape (3, 3), kg m^2.

    def plus(self, other: MassMoments) -> MassMoments:
        """Return the mass moments of the union of two disjoint sets of bodies."""
        return MassMoments(self.mass + other.mass, self.first + other.first, self.second + other.second)

    def momentum(self, angular: Expression, linear: Expression) -> tuple[Expression, Expression]:
        """Return angular (about the world's origin) and linear momentum of the bodies if all have the given twist."""
        angular_momentum = ca.mtimes(ca.tril2symm(self.second), angular)
        return angular_momentum + cross(self.first, linear), self.mass * linear - cross(self.first, angular)

    def spatial_inertia(self) -> Expression:
        """Return the spatial inertia of the bodies about the world's origin. Shape (6, 6)."""
        arm = skew(self.first)
        return ca.vertcat(ca.horzcat(ca.tril2symm(self.second), arm), ca.horzcat(arm.T, self.mass * ca.DM.eye(3)))


def center_of_mass_jacobian(robot: Robot, q: Expression, world_from_base: Placement | None = None) -> Expression:
    """Return the matrix, (3, dof), that maps joint rates to the velocity of the centre of mass, in world axes."""
    matrix = momentum_matrix(robot, q, world_from_base)
    if robot.total_mass == 0:
        raise massless_error("hence no centre of mass")
    return matrix[3:6, :] / robot.total_mass


def momentum_matrix(robot: Robot, q: Expression, world_from_base: Placement | None = None) -> Expression:
    """Return the matrix, (6, dof), that maps joint rates to (angular about the world's origin, linear) momentum."""
    frames, axes = frames_and_axes(robot, q, world_from_base)
    return ca.densify(joint_momenta(robot, axes, subtree_moments(robot, frames)))


def robot_inertia(robot: Robot, q: Expression, world_from_base: Placement | None = None) -> Expression:
    """Return the robot's spatial inertia with locked joints, about the world's origin in world axes. Shape (6, 6)."""
    return ca.densify(subtree_moments(robot, link_frames(robot, q, world_from_base))[robot.root].spatial_inertia())


def subtree_moments(robot: Robot, frames: dict[str, Frame]) -> dict[str, MassMoments]:
    """Return, by link name, the mass moments of each link and all links that it carries, about the world's origin."""
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
    """Return the matrix, (6, dof), that maps joint rates to momentum, from joint axes and `subtree_moments`."""
    children = {joint.name: moments[joint.child] for joint in robot.joints if joint.moves}
    momenta = {name: ca.vertcat(*children[name].momentum(*axis)) for name, axis in axes.items()}
    return ca.horzcat(ca.DM(6, 0), *reduce_to_joint_vector(robot, momenta))


@on_scalars
def momentum(
    robot: Robot,
    q: Expression,
    qd: Expression,
    *,
    about: Expression = (0.0, 0.0, 0.0),
    world_from_base: Placement | None = None,
) -> Expression:
    """Return the robot's angular momentum about a fixed point, and its linear momentum. Shape (6, 1), N m s and N s."""
    total = ca.mtimes(momentum_matrix(robot, q, world_from_base), joint_vector(robot, qd, "qd"))
    arm = checked_vector("about", about, 3, "a point of the world")
    return ca.densify(ca.vertcat(total[0:3] - cross(arm, total[3:6]), total[3:6]))


class CenterOfMassMotion(NamedTuple):
    """Position (m), velocity and acceleration of the centre of mass of the whole robot. Shape (3, 1) each."""

    position: Expression
    velocity: Expression
    acceleration: Expression


@on_scalars
def center_of_mass_motion(
    robot: Robot, q: Expression, qd: Expression, qdd: Expression, *, world_from_base: Placement | None = None
) -> CenterOfMassMotion:
    """Return position, velocity and acceleration of the robot's centre of mass; raise ModelError if it has no mass."""
    position = center_of_mass(robot, q, world_from_base)
    velocity = ca.mtimes(center_of_mass_jacobian(robot, q, world_from_base), joint_vector(robot, qd, "qd"))
    force = base_reaction(robot, q, qd, qdd, gravity=(0.0, 0.0, 0.0), world_from_base=world_from_base)[3:6]
    return CenterOfMassMotion(position, ca.densify(velocity), ca.densify(force / robot.total_mass))
