"""What a free base does when the joints move, and which robots leave that undetermined (Kim, Kim 2011, (24), (25))."""

from __future__ import annotations

from typing import NamedTuple

import casadi as ca
import numpy as np

from models.errors import ModelError
from models.kinematics import frames_and_axes, point_jacobian, subtree_moments, tip_frame
from models.parts import massless
from models.robot import Robot
from models.spatial import Expression, cross, skew, solve_spd


class Reaction(NamedTuple):
    """Motion of base and tip per unit joint rate, or for given joint rates; in base axes, one column each.

    The latter with what the conserved momentum adds.
    """

    base_angular: Expression
    base_linear: Expression
    tip_angular: Expression
    tip_linear: Expression


def reaction(
    robot: Robot,
    q: Expression,
    joint_rates: Expression | None = None,
    carried: tuple[Expression, Expression] | None = None,
    *,
    planar: bool = False,
) -> Reaction:
    """Reaction of a base that floats to unit rate of each joint (n columns), or to given joint rates (one column).

    Args:
        robot: The kinematic tree, its root link free.
        q: Joint positions. Shape (dof, 1).
        joint_rates: Shape (dof, 1); None for unit rates.
        carried: Momentum that the machine has, with given joint rates only: (angular about the centre of mass,
            linear), axes of the base. Shape (3, 1) each; none if None.
        planar: Whether the base moves in the plane z = constant only.
    """
    frames, axes = frames_and_axes(robot, q)
    moments = subtree_moments(robot, frames)
    total = moments[robot.root]
    center = total.first / total.mass
    columns = [moments[joint.child].momentum(*axes[joint.name]) for joint in robot.moving_joints]
    momentum: Expression = ca.horzcat(*(ca.vertcat(*column) for column in columns))
    tip = tip_frame(robot, frames).position
    joints = point_jacobian(robot, axes, str(robot.tip), tip)
    if joint_rates is not None:
        momentum, joints = ca.mtimes(momentum, joint_rates), ca.mtimes(joints, joint_rates)
    if carried is not None:
        momentum = momentum - ca.vertcat(carried[0] + cross(center, carried[1]), carried[1])

    arm = ca.dot(center, center) * ca.DM.eye(3) - ca.tril(ca.mtimes(center, center.T))
    inertia = total.second - total.mass * arm  # about the centre of mass
    about_center = momentum[0:3, :] - ca.mtimes(skew(center), momentum[3:6, :])
    if planar:
        turning = ca.vertcat(ca.DM(2, about_center.shape[1]), -about_center[2, :] / inertia[2, 2])
    else:
        turning = -solve_spd(inertia, about_center)
    # The centre of mass moves with the carried momentum alone, which fixes the velocity of the base's origin.
    linear = ca.mtimes(skew(center), turning) - momentum[3:6, :] / total.mass
    tip_linear = ca.mtimes(skew(center - tip), turning) - momentum[3:6, :] / total.mass + joints[3:6, :]
    return Reaction(turning, linear, turning + joints[0:3, :], tip_linear)


def require_planar(robot: Robot) -> None:
    """Raise ModelError for a joint that moves the robot out of the plane z = constant of its root link."""
    _, axes = frames_and_axes(robot, np.zeros(robot.dof))
    for joint in robot.moving_joints:
        angular, linear = (np.array(part).ravel() for part in axes[joint.name])
        if joint.kind == "prismatic" and abs(linear[2]) > 1e-9:
            raise ModelError(
                f"joint {joint.name!r} moves along {linear.tolist()} of the base link, out of the plane of "
                "a planar base; use base='spatial'"
            )
        if joint.kind != "prismatic" and np.hypot(angular[0], angular[1]) > 1e-9:
            raise ModelError(
                f"joint {joint.name!r} turns about {angular.tolist()} of the base link, not about z as a "
                "planar base needs; use base='spatial'"
            )


def require_inertia(robot: Robot, rows: list[int]) -> None:
    """Raise ModelError where the momentum in these rows of it does not fix the motion of the base.

    Whatever the units of mass and length: judged by the moments relative to each other.
    """
    if robot.total_mass == 0:
        raise massless("without which no momentum tells how its base floats")
    # A stretched chain of point masses can lack inertia about one axis in one configuration: try others too.
    spread = np.linspace(0.3, 1.1, robot.dof)
    angular = [row for row in rows if row < 3]
    for q in (np.zeros(robot.dof), spread, -2 * spread[::-1]):
        moments = subtree_moments(robot, frames_and_axes(robot, q)[0])[robot.root]
        center = np.array(ca.DM(moments.first)).ravel() / moments.mass
        second = np.array(ca.DM(ca.tril2symm(moments.second)))
        about_center = second - moments.mass * (center @ center * np.eye(3) - np.outer(center, center))
        if np.linalg.eigvalsh(about_center[np.ix_(angular, angular)])[0] > 1e-12 * np.linalg.norm(second):
            return
    bare = [link.name for link in robot.links if not link.mass]
    hint = f"; the links {bare} have no mass: in URDF, no <inertial>" if bare else ""
    raise ModelError(
        f"the links {[link.name for link in robot.links]} have no rotational inertia about some axis, "
        f"so that the momentum does not fix the motion of the base; give the base link an inertia{hint}"
    )
