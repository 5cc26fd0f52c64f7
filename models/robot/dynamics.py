"""What a motion takes: torques of the joints and the reaction of the ground, with forces from outside.

Recursive Newton-Euler (Luh, Walker, Paul 1980; Featherstone 2008, chapter 5), each link in its own axes, where its
inertia is constant: that takes less than half of the operations of world axes, and its derivatives a quarter. The base
stands still unless its motion is given; joint positions, velocities and accelerations are of shape (dof, 1) in the
order of `robot.joint_names`, as SX, MX, DM or numbers. Any algebra of one kind: a wrench of SX entries goes with SX
positions. All raise ModelError for wrong sizes, and for a wrench on a link that does not exist.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import casadi as ca
import numpy as np

from models.arrays import checked_array, checked_each, checked_instance, checked_name
from models.robot.kinematics import (
    Placement,
    by_joint_vector,
    checked_placement,
    checked_vector,
    constant,
    each_joint,
    frames_and_axes,
    joint_frames,
    link_frames,
    subtree_moments,
)
from models.robot.parts import Link
from models.robot.rebuild import simplify
from models.robot.robot import Robot
from models.spatial import Expression, Frame, cross, on_scalars, skew

GRAVITY = (0.0, 0.0, -9.81)
"""Acceleration of free fall in the world, z upwards, m/s^2."""


@dataclass(frozen=True, eq=False)
class Wrench:
    """A force and a moment that act on a link from outside.

    Attributes:
        link: Name of the link.
        force: In world axes. Shape (3,), N.
        moment: In world axes, besides that of the force. Shape (3,), N m.
        point: Where the force acts, in the link's frame. Shape (3,), m.

    Each part is a casadi vector, numbers, or a list of either; stored as a casadi column.

    Raises:
        ModelError: A part that is not of three entries, or not finite.
    """

    link: str
    force: Expression = (0.0, 0.0, 0.0)
    moment: Expression = (0.0, 0.0, 0.0)
    point: Expression = (0.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        checked_name(self.link, "wrench", "link")
        for part in ("force", "moment", "point"):
            given = getattr(self, part)
            owner = f"wrench on link {self.link!r}"
            value = checked_vector(given, 3, f"{owner}: {part}", "x, y and z")
            if isinstance(value, ca.DM):
                checked_array(np.array(value).ravel(), (3,), owner, part)
            object.__setattr__(self, part, value)


def inverse_dynamics(
    robot: Robot,
    q: Expression,
    qd: Expression,
    qdd: Expression,
    wrenches: Sequence[Wrench] = (),
    gravity: Expression = GRAVITY,
    world_from_base: Placement | None = None,
    *,
    base_twist: Expression | None = None,
    base_acceleration: Expression | None = None,
) -> Expression:
    """Torques (forces of prismatic joints) that the joints must give. Shape (dof, 1), N m or N.

    A joint with followers gives what moves them too: its own torque and multiplier times those of each of them.

    The base may move: `base_twist` and `base_acceleration` are (angular velocity, velocity of the origin of the root
    link's frame) and their time derivatives, world axes, shape (6, 1).
    """
    stacked, links = stacked_wrenches(robot, wrenches), tuple(wrench.link for wrench in wrenches)
    return _efforts(robot, q, qd, qdd, stacked, links, gravity, world_from_base, base_twist, base_acceleration)[0]


def base_reaction(
    robot: Robot,
    q: Expression,
    qd: Expression,
    qdd: Expression,
    wrenches: Sequence[Wrench] = (),
    gravity: Expression = GRAVITY,
    world_from_base: Placement | None = None,
    *,
    base_twist: Expression | None = None,
    base_acceleration: Expression | None = None,
) -> Expression:
    """What the ground must do to the root link: (moment about the world's origin, force). Shape (6, 1), N m and N.

    The rate of momentum less the weight of all links, the root link included, and less the wrenches. Of a base that
    moves, see inverse_dynamics, it is what drives it: zero where it floats freely.
    """
    stacked, links = stacked_wrenches(robot, wrenches), tuple(wrench.link for wrench in wrenches)
    return _efforts(robot, q, qd, qdd, stacked, links, gravity, world_from_base, base_twist, base_acceleration)[1]


@on_scalars
def mass_matrix(robot: Robot, q: Expression) -> Expression:
    """Joint-space inertia M of T = q'^T M q' / 2, the base standing still. Shape (dof, dof), kg m^2, kg m or kg.

    Composite rigid bodies (Featherstone 2008, 6.2): the momentum of all that joint j carries, per rate of j, along the
    axis of each joint i that carries j.
    """
    frames, axes = frames_and_axes(robot, q)
    moments = subtree_moments(robot, frames)
    below: dict[tuple[str, str], Expression] = {}
    for joint in robot.joints:
        if joint.moves:
            momentum = ca.vertcat(*moments[joint.child].momentum(*axes[joint.name]))
            for carrier in robot.path_to(joint.child):
                if carrier.moves:
                    entry = ca.dot(ca.vertcat(*axes[carrier.name]), momentum)
                    below[carrier.name, joint.name] = below[joint.name, carrier.name] = entry
    rows = {one: {other: below.get((one, other), ca.DM(1, 1)) for other in axes} for one in axes}
    columns = {one: ca.vertcat(ca.DM(0, 1), *by_joint_vector(robot, row)) for one, row in rows.items()}
    return ca.densify(ca.horzcat(ca.DM(robot.dof, 0), *by_joint_vector(robot, columns)))


def external_wrench(
    robot: Robot, q: Expression, wrenches: Sequence[Wrench], world_from_base: Placement | None = None
) -> Expression:
    """Sum of wrenches: (moment about the world's origin, force). Shape (6, 1)."""
    frames = link_frames(robot, q, world_from_base)
    total: Expression = ca.DM(6, 1)
    for column, wrench in enumerate(checked_wrenches(wrenches)):
        moment, force, point = _parts(stacked_wrenches(robot, wrenches), column)
        total = total + ca.vertcat(moment + cross(frames[wrench.link].point(point), force), force)
    return ca.densify(total)


def checked_wrenches(wrenches: Sequence[Wrench]) -> tuple[Wrench, ...]:
    """`wrenches` as a tuple; ModelError unless it is a list of them."""
    return checked_each(wrenches, Wrench, "dynamics", "wrenches")


def stacked_wrenches(robot: Robot, wrenches: Sequence[Wrench]) -> Expression:
    """Moment, force and point of every wrench in a column of its own. Shape (9, k)."""
    checked_instance(robot, Robot, "dynamics", "robot")
    columns = []
    for wrench in checked_wrenches(wrenches):
        robot.link(wrench.link)
        columns.append(ca.vertcat(wrench.moment, wrench.force, wrench.point))
    return ca.horzcat(ca.DM(9, 0), *columns)


def _parts(stacked: Expression, column: int) -> tuple[Expression, Expression, Expression]:
    """Moment, force and point of a wrench."""
    moment, force, point = (stacked[3 * i : 3 * i + 3, column] for i in range(3))
    return moment, force, point


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
    """Torques of the joints and reaction of the base.

    A point x of a link accelerates by a + U x, with U = [alpha x] + [omega x]^2 of the link and a of its origin, less
    free fall. So the link needs the force m a + U h and the moment h x a + sum of m x (x U x), which are twice the
    entries of the antisymmetric part of U J; h and J are the sums of m x and of m x x' (Atkeson, An, Hollerbach 1986
    have the same of the inertia).
    """
    ground = checked_placement(world_from_base)
    frames = link_frames(robot, q, world_from_base) if links else {}
    robot = simplify(robot, links)
    joints = joint_frames(robot, q)
    needed: dict[str, tuple[Expression, Expression]] = {}
    motions = _motions_in_links(robot, joints, qd, qdd, gravity, ground, base_twist, base_acceleration)
    for link in robot.links:
        push, field = motions[link.name]
        first, second = _mass_sums(link)
        turned = ca.mtimes(field, second)
        moment = ca.vertcat(turned[2, 1] - turned[1, 2], turned[0, 2] - turned[2, 0], turned[1, 0] - turned[0, 1])
        needed[link.name] = moment + cross(first, push), link.mass * push + ca.mtimes(field, first)
    for column, name in enumerate(links):
        moment, force, point = _parts(stacked, column)
        moment, force = (ca.mtimes(frames[name].rotation.T, part) for part in (moment, force))
        before = needed[name]
        needed[name] = before[0] - moment - cross(point, force), before[1] - force
    torques: dict[str, Expression] = {}
    for joint in reversed(robot.joints):
        moment, force = needed[joint.child]
        if joint.moves:
            torques[joint.name] = ca.dot(constant(joint.axis), force if joint.kind == "prismatic" else moment)
        turn, position = joints[joint.name]
        moment, force = (ca.mtimes(turn, part) for part in (moment, force))
        before = needed[joint.parent]
        needed[joint.parent] = before[0] + moment + cross(position, force), before[1] + force
    moment, force = (ca.mtimes(ground.rotation, part) for part in needed[robot.root])
    reaction = ca.vertcat(moment + cross(ground.position, force), force)
    return ca.densify(ca.vertcat(ca.DM(0, 1), *by_joint_vector(robot, torques))), reaction


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
    """Of each link a, less free fall, shape (3, 1), and U, shape (3, 3), in its own axes, by name; see _efforts."""
    rates, accelerations = each_joint(robot, qd, "qd"), each_joint(robot, qdd, "qdd")
    fall = checked_vector(gravity, 3, "gravity", "x, y and z")
    meaning = "angular, then of the origin of the root link's frame"
    twist, push = (
        ca.DM(6, 1) if given is None else checked_vector(given, 6, what, meaning)
        for given, what in ((base_twist, "base_twist"), (base_acceleration, "base_acceleration"))
    )
    # angular velocity and acceleration, acceleration of the origin
    spin, turning, acceleration = (
        ca.mtimes(ground.rotation.T, part) for part in (twist[0:3], push[0:3], push[3:6] - fall)
    )
    origin = {robot.root: (spin, turning, acceleration)}
    found = {robot.root: (acceleration, _field(spin, turning))}
    for joint in robot.joints:
        turn, position = joints[joint.name]
        spin, turning, acceleration = origin[joint.parent]
        acceleration = acceleration + ca.mtimes(found[joint.parent][1], position)
        spin, turning, acceleration = (ca.mtimes(turn.T, part) for part in (spin, turning, acceleration))
        if joint.moves:
            rate, push = (constant(joint.axis) * part[joint.name] for part in (rates, accelerations))
            if joint.kind == "prismatic":
                acceleration = acceleration + push + 2 * cross(spin, rate)
            else:
                turning = turning + push + cross(spin, rate)
                spin = spin + rate
        origin[joint.child] = (spin, turning, acceleration)
        found[joint.child] = (acceleration, _field(spin, turning))
    return found


def _mass_sums(link: Link) -> tuple[Expression, Expression]:
    """Sums of m x and of m x x' over a link, in its frame. Shapes (3, 1), kg m, and (3, 3), kg m^2."""
    center, inertia = link.center_of_mass, link.inertia
    about_center = np.trace(inertia) / 2 * np.eye(3) - inertia
    return constant(link.mass * center), constant(about_center + link.mass * np.outer(center, center))


def _field(spin: Expression, turning: Expression) -> Expression:
    """[alpha x] + [omega x]^2. Shape (3, 3)."""
    squares = ca.mtimes(spin, spin.T)
    return skew(turning) + squares - ca.trace(squares) * ca.DM.eye(3)
