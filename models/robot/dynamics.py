"""What a motion takes: torques of the joints and the reaction of the ground, with forces from outside.

Recursive Newton-Euler (Luh, Walker, Paul 1980; Featherstone 2008, chapter 5) written in world axes. The base stands
still unless its motion is given; joint positions, velocities and accelerations are of shape (dof, 1) in the order of
`robot.joint_names`, as SX, MX, DM or numbers. Any algebra of one kind: a wrench of SX entries goes with SX positions.
All raise ModelError for wrong sizes, and for a wrench on a link that does not exist.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import casadi as ca
import numpy as np

from models.arrays import checked_array, checked_each, checked_instance, checked_name
from models.robot.kinematics import Placement, by_joint_vector, checked_vector, frames_and_axes, subtree_moments
from models.robot.motion import LinkMotion, momentum_rates, motions_of
from models.robot.robot import Robot
from models.spatial import Expression, Frame, cross, on_scalars

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
    frames, _ = frames_and_axes(robot, q, world_from_base)
    stacked = stacked_wrenches(robot, wrenches)
    given = _given_wrenches(frames, stacked, tuple(w.link for w in wrenches))
    return ca.densify(sum((wrench for _, wrench in given), start=ca.DM(6, 1)))


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
    """Torques of the joints and reaction of the base."""
    frames, axes = frames_and_axes(robot, q, world_from_base)
    motions = motions_of(robot, frames, axes, qd, qdd, base_twist, base_acceleration)
    needed = _needed_wrenches(robot, frames, motions, gravity)
    given = _given_wrenches(frames, stacked, links)
    total: Expression = sum(needed.values(), start=ca.DM(6, 1))
    reaction = total - sum((wrench for _, wrench in given), start=ca.DM(6, 1))
    for link, wrench in given:
        needed[link] = needed[link] - wrench
    for joint in reversed(robot.joints):
        needed[joint.parent] = needed[joint.parent] + needed[joint.child]
    torques = {j.name: ca.dot(ca.vertcat(*axes[j.name]), needed[j.child]) for j in robot.joints if j.moves}
    return ca.densify(ca.vertcat(ca.DM(0, 1), *by_joint_vector(robot, torques))), reaction


def _needed_wrenches(
    robot: Robot, frames: dict[str, Frame], motions: dict[str, LinkMotion], gravity: Expression
) -> dict[str, Expression]:
    """Rate of momentum less weight of each link, about the world's origin, by link name. Shape (6, 1) each."""
    fall = checked_vector(gravity, 3, "gravity", "x, y and z")
    needed = momentum_rates(robot, frames, motions)
    for link in robot.links:
        weight = link.mass * fall
        needed[link.name] = needed[link.name] - ca.vertcat(cross(motions[link.name].center, weight), weight)
    return needed


def _given_wrenches(
    frames: dict[str, Frame], stacked: Expression, links: tuple[str, ...]
) -> list[tuple[str, Expression]]:
    """Link and wrench about the world's origin, shape (6, 1), of every column of `stacked`."""
    given = []
    for column, link in enumerate(links):
        moment, force, point = (stacked[3 * i : 3 * i + 3, column] for i in range(3))
        given.append((link, ca.vertcat(moment + cross(frames[link].point(point), force), force)))
    return given
