"""Arms on an unactuated, freely floating base with conserved momentum, zero by default (Kim and Kim 2011).

The base moves so that E1 x1' + E2 x2' = 0 (equation 24), with x1' the base twist and x2' the joint rates; the tip moves
with F1 x1' + F2 x2' = G x2', G = F2 - F1 E1^-1 E2 being the generalized Jacobian (25). A non-zero momentum adds the
twist of the whole machine as one rigid body: both become affine in the joint rates.

The base motion is computed about the centre of mass, where linear and angular momentum decouple, and in base axes,
where nothing depends on the base's own pose. So only one rotational inertia, of size 3 (1 if planar), is inverted
instead of E1. A machine in which some base motion carries no momentum is rejected.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, NamedTuple, TypeAlias, get_args

import casadi as ca
import numpy as np

from models.checks import Array, ArrayInput, require, set_fields
from models.errors import ModelError
from models.robot.dynamics import inverse_dynamics, joint_momenta, robot_inertia, subtree_moments
from models.robot.dynamics import momentum_matrix as joint_momentum_matrix
from models.robot.kinematics import (
    TWIST_SIZE,
    center_of_mass,
    checked_vector,
    frames_and_axes,
    jacobian_manipulability,
    joint_vector,
    point_jacobian,
    tip_frame,
)
from models.robot.parts import massless_error
from models.robot.robot import Robot
from models.spatial import (
    Expression,
    Frame,
    angular_velocity_from_quaternion,
    cross,
    force_transform,
    motion_transform,
    on_scalars,
    quaternion_product,
    rotation,
    rotation_from_quaternion,
    skew,
    solve_spd,
)

BaseKind: TypeAlias = Literal["planar", "spatial"]

PLANAR_ROWS = [2, 3, 4]
"""Indices of the twist components of planar motion (z = constant): rotation about z, translation along x and y."""


@dataclass(frozen=True, eq=False)
class FreeFloating:
    """A robot whose root link floats freely with conserved total momentum.

    The configuration of the base is the pose of the root link's frame in an inertial world: (x, y, angle) for
    a planar base, (x, y, z, qw, qx, qy, qz) for a spatial one, with a unit quaternion. A base twist is
    (angular velocity, velocity of the root frame's origin) in world axes, shape (6, 1); for a planar base
    (angular velocity, vx, vy), shape (3, 1).

    Attributes:
        robot: Kinematic tree; a single body without joints tumbles according to its momentum.
        base: "planar" or "spatial".
        conserved_momentum: (Angular about the centre of mass, N m s; linear, N s), world axes, shape (6,);
            (Lz, Px, Py), shape (3,), if planar. Zero if None.

    Raises:
        ModelError: Unknown kind of base, no mass, no rotational inertia, a joint that would move a
            planar machine out of its plane, or a momentum of a wrong size or not finite.
    """

    robot: Robot
    base: BaseKind = "spatial"
    conserved_momentum: ArrayInput | None = None

    def __post_init__(self) -> None:
        require.choice("free-floating machine: base", self.base, get_args(BaseKind))
        require.instance("machine: robot", self.robot, Robot)
        if self.base == "planar":
            _require_planar(self.robot)
        _require_inertia(self.robot, self.twist_rows)
        size = len(self.twist_rows)
        momentum = np.zeros(size) if self.conserved_momentum is None else self.conserved_momentum
        momentum = require.array(f"{self.base} free-floating base: conserved_momentum", momentum, (size,))
        set_fields(self, conserved_momentum=momentum)

    @property
    def base_size(self) -> int:
        """Number of coordinates of the base: 3 for a planar base (x, y, angle), 7 for a spatial one (pose)."""
        return 3 if self.base == "planar" else 7

    @property
    def joint_size(self) -> int:
        """Number of independently moving joints."""
        return self.robot.dof

    @property
    def twist_rows(self) -> list[int]:
        """Indices of the twist components in which the base moves: (rotation about z, x, y) if planar, else all six."""
        return PLANAR_ROWS if self.base == "planar" else list(range(6))

    def base_home(self) -> Array:
        """Return the base configuration in which root frame and world frame coincide. Shape (base_size,)."""
        return np.zeros(3) if self.base == "planar" else np.array([0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0])

    def world_from_base(self, base: Expression) -> Frame:
        """Return the pose of the root link's frame in the world."""
        base = self._checked_base(base)
        if self.base == "planar":
            return Frame(rotation((0, 0, 1), base[2]), ca.vertcat(base[0:2], type(base)(1, 1)))
        return Frame(rotation_from_quaternion(base[3:7]), base[0:3])

    @on_scalars
    def tip_pose(self, base: Expression, q: Expression) -> Frame:
        """Return the pose of the tip frame in the world: rotation (3, 3), position (3, 1) in m."""
        world_from_base = self.world_from_base(base)
        tip = tip_frame(self.robot, frames_and_axes(self.robot, q)[0])
        turned = ca.mtimes(world_from_base.rotation, tip.rotation)
        return Frame(ca.densify(turned), ca.densify(world_from_base.point(tip.position)))

    @on_scalars
    def tip_jacobian(self, base: Expression, q: Expression) -> Expression:
        """Return the generalized Jacobian, (6, joint_size), from joint rates to the tip's twist without momentum drift.

        Equation (25) of Kim and Kim (2011).
        """
        return self._tip_motion(base, self._reaction(q, None, tip=True))

    @on_scalars
    def tip_twist(self, base: Expression, q: Expression, joint_rates: Expression) -> Expression:
        """Return the tip's twist: generalized Jacobian times joint rates, plus drift due to momentum. Shape (6, 1)."""
        rates = joint_vector(self.robot, joint_rates, "joint_rates")
        return self._tip_motion(base, self._reaction(q, rates, self._momentum_in_base(base), tip=True))

    @on_scalars
    def base_twist(self, base: Expression, q: Expression, joint_rates: Expression) -> Expression:
        """Return the base twist that follows from joint rates and conserved momentum. Shape (6, 1) or (3, 1).

        Equation (24) of Kim and Kim (2011): E1^-1 (momentum - E2 joint_rates) with the `momentum_matrices` E1, E2.
        """
        reaction = self._reaction(q, joint_vector(self.robot, joint_rates, "joint_rates"), self._momentum_in_base(base))
        turn = self.world_from_base(base).rotation
        twist = ca.vertcat(ca.mtimes(turn, reaction.base_angular), ca.mtimes(turn, reaction.base_linear))
        return ca.densify(twist)[self.twist_rows, :]

    @on_scalars
    def base_rate(self, base: Expression, q: Expression, joint_rates: Expression) -> Expression:
        """Return the time derivative of the base configuration under the conserved momentum. Shape (base_size, 1)."""
        twist = self.base_twist(base, q, joint_rates)
        if self.base == "planar":
            return ca.vertcat(twist[1:3], twist[0])
        spin = ca.vertcat(type(twist)(1, 1), twist[0:3])
        return ca.densify(ca.vertcat(twist[3:6], quaternion_product(spin, self._checked_base(base)[3:7]) / 2))

    @on_scalars
    def twist_of_rate(self, base: Expression, base_rate: Expression) -> Expression:
        """Return the base twist for a given time derivative of the base configuration. Shape (6, 1) or (3, 1)."""
        rate = checked_vector("base_rate", base_rate, self.base_size, "the derivative of the base configuration")
        base = self._checked_base(base)
        if self.base == "planar":
            return ca.vertcat(rate[2], rate[0:2])
        return ca.vertcat(angular_velocity_from_quaternion(base[3:7], rate[3:7]), rate[0:3])

    @on_scalars
    def momentum_matrices(self, base: Expression, q: Expression) -> tuple[Expression, Expression]:
        """Return matrices E1, E2 of the total momentum E1 base_twist + E2 joint_rates, eq. (24) of Kim and Kim (2011).

        Shapes (6, 6) and (6, joint_size), rows (moment of momentum about the world's origin, linear momentum), world
        axes; (3, 3) and (3, joint_size) with the rows (Lz, Px, Py) for a planar base.
        """
        to_world = force_transform(self.world_from_base(base))
        turn = motion_transform((self.world_from_base(base).rotation, ca.DM(3, 1)))
        locked = ca.mtimes([to_world, robot_inertia(self.robot, q), turn.T])
        joints = ca.mtimes(to_world, joint_momentum_matrix(self.robot, q))
        rows = self.twist_rows
        return ca.densify(locked)[rows, rows], ca.densify(joints)[rows, :]

    @on_scalars
    def momentum(self, base: Expression, q: Expression, base_twist: Expression, joint_rates: Expression) -> Expression:
        """Return the total momentum: angular about the world's origin, then linear. Shape (6, 1); (3, 1) if planar.

        For a planar base the rows are (Lz, Px, Py).
        """
        locked, joints = self.momentum_matrices(base, q)
        twist = checked_vector("base_twist", base_twist, len(self.twist_rows), "angular velocity, then linear")
        return ca.mtimes(locked, twist) + ca.mtimes(joints, joint_vector(self.robot, joint_rates, "joint_rates"))

    @on_scalars
    def joint_torques(
        self, base: Expression, q: Expression, joint_rates: Expression, accelerations: Expression
    ) -> Expression:
        """Return the joint torques (or forces) of a motion without external wrenches. Shape (n, 1), N m or N.

        They are computed in base axes. The pose of the base enters only through the conserved momentum h, whose
        components change as these axes rotate with the angular velocity w: h' = -w x h. The arguments are symbols,
        because the base twist is differentiated in them.
        """
        carried, plane = self._spatial_momentum(), ca.DM.eye(TWIST_SIZE)[:, self.twist_rows]
        momentum = ca.SX.sym("momentum", 0 if carried is None else TWIST_SIZE)
        in_base = None if carried is None else (momentum[:3], momentum[3:])
        reaction = self._reaction(q, joint_rates, in_base)
        twist = ca.mtimes(plane, ca.vertcat(reaction.base_angular, reaction.base_linear)[self.twist_rows])
        spin = twist[0:3]
        turning = ca.vertcat(ca.DM(0, 1), *(-cross(spin, part) for part in in_base or ()))
        along = ca.vertcat(turning, joint_rates, accelerations)
        second = ca.mtimes(plane.T, ca.jtimes(twist, ca.vertcat(momentum, q, joint_rates), along))
        second = ca.mtimes(plane, second) + ca.vertcat(ca.DM(3, 1), cross(spin, twist[3:6]))
        zero = (0.0, 0.0, 0.0)
        torques = inverse_dynamics(self.robot, q, joint_rates, accelerations, gravity=zero, base_motion=(twist, second))
        if carried is None:
            return torques
        values = ca.SX(ca.vertcat(*(self._momentum_in_base(base) or ())))
        return ca.substitute(torques, momentum, ca.densify(values))

    @on_scalars
    def momentum_residual(
        self, base: Expression, q: Expression, base_rate: Expression, joint_rates: Expression
    ) -> Expression:
        """Return the momentum at given rates minus the conserved momentum: zero for every possible motion."""
        momentum = self.momentum(base, q, self.twist_of_rate(base, base_rate), joint_rates)
        carried = self._spatial_momentum()
        if carried is None:
            return momentum
        angular, linear = carried
        center = center_of_mass(self.robot, q, self.world_from_base(base))
        return momentum - ca.densify(ca.vertcat(angular + cross(center, linear), linear))[self.twist_rows, :]

    @on_scalars
    def jacobians(self, base: Expression, q: Expression) -> tuple[Expression, Expression]:
        """Return the matrices F1, F2 of the tip's twist F1 base_twist + F2 joint_rates, eq. (25) of Kim and Kim (2011).

        Shapes (6, 6), or (6, 3) for a planar base, and (6, joint_size).
        """
        turn = self.world_from_base(base).rotation
        frames, axes = frames_and_axes(self.robot, q)
        tip = tip_frame(self.robot, frames).position
        lever = motion_transform((ca.DM.eye(3), -ca.mtimes(turn, tip)))
        joints = point_jacobian(self.robot, axes, self.robot.tip_link, tip)
        both = motion_transform((turn, ca.DM(3, 1)))
        return ca.densify(lever)[:, self.twist_rows], ca.densify(ca.mtimes(both, joints))

    def manipulability(self, base: Expression, q: Expression, rows: Sequence[int] = range(TWIST_SIZE)) -> Expression:
        """Return Yoshikawa's manipulability of selected rows of the generalized Jacobian. Shape (1, 1)."""
        return jacobian_manipulability(self.tip_jacobian(base, q), rows)

    def _tip_motion(self, base: Expression, reaction: _Reaction) -> Expression:
        turn = self.world_from_base(base).rotation
        angular, linear = ca.mtimes(turn, reaction.tip_angular), ca.mtimes(turn, reaction.tip_linear)
        return ca.densify(ca.vertcat(angular, linear))

    def _checked_base(self, base: Expression) -> Expression:
        """Return the base configuration as a column; raise ModelError if its size is wrong."""
        meaning = "(x, y, angle)" if self.base == "planar" else "(x, y, z, qw, qx, qy, qz)"
        return checked_vector("base", base, self.base_size, meaning)

    def _spatial_momentum(self) -> tuple[Expression, Expression] | None:
        """Return the conserved momentum (angular about the centre of mass, linear) in world axes, or None if zero."""
        momentum = np.asarray(self.conserved_momentum)
        if not momentum.any():
            return None
        spatial = np.zeros(TWIST_SIZE)
        spatial[self.twist_rows] = momentum
        return ca.DM(spatial[:3]), ca.DM(spatial[3:])

    def _momentum_in_base(self, base: Expression) -> tuple[Expression, Expression] | None:
        """Return the conserved momentum as angular and linear part in the axes of the base, or None if it is zero."""
        momentum = self._spatial_momentum()
        if momentum is None:
            return None
        turn = self.world_from_base(base).rotation
        return ca.mtimes(turn.T, momentum[0]), ca.mtimes(turn.T, momentum[1])

    def _reaction(
        self,
        q: Expression,
        joint_rates: Expression | None,
        carried: tuple[Expression, Expression] | None = None,
        tip: bool = False,
    ) -> _Reaction:
        """Return the velocities of base and, if `tip`, of the tip that follow from joint rates and conserved momentum.

        Joint rates of None stand for a unit rate of each joint. `carried` is the conserved momentum (angular about the
        centre of mass, linear) in base axes, zero if None.
        """
        frames, axes = frames_and_axes(self.robot, q)
        moments = subtree_moments(self.robot, frames)
        total = moments[self.robot.root]
        center = total.first / total.mass
        momentum = joint_momenta(self.robot, axes, moments)
        if joint_rates is not None:
            momentum = ca.mtimes(momentum, joint_rates)
        if carried is not None:
            momentum = momentum - ca.vertcat(carried[0] + cross(center, carried[1]), carried[1])

        arm = ca.dot(center, center) * ca.DM.eye(3) - ca.tril(ca.mtimes(center, center.T))
        inertia = total.second - total.mass * arm  # about the centre of mass
        about_center = momentum[0:3, :] - ca.mtimes(skew(center), momentum[3:6, :])
        if self.base == "planar":
            turning = ca.vertcat(ca.DM(2, about_center.shape[1]), -about_center[2, :] / inertia[2, 2])
        else:
            turning = -solve_spd(inertia, about_center)
        # The conserved momentum alone gives the velocity of the centre of mass, which fixes that of the base's origin.
        linear = ca.mtimes(skew(center), turning) - momentum[3:6, :] / total.mass
        if not tip:
            return _Reaction(turning, linear)
        place = tip_frame(self.robot, frames).position
        joints = point_jacobian(self.robot, axes, self.robot.tip_link, place)
        if joint_rates is not None:
            joints = ca.mtimes(joints, joint_rates)
        tip_linear = ca.mtimes(skew(center - place), turning) - momentum[3:6, :] / total.mass + joints[3:6, :]
        return _Reaction(turning, linear, turning + joints[0:3, :], tip_linear)


class _Reaction(NamedTuple):
    """Velocities of base and tip in base axes: one column for given joint rates, or one per joint for unit rates."""

    base_angular: Expression
    base_linear: Expression
    tip_angular: Expression = None
    tip_linear: Expression = None


def _require_planar(robot: Robot) -> None:
    """Raise ModelError for a joint that moves the robot out of the plane z = constant of its root link."""
    _, axes = frames_and_axes(robot, np.zeros(robot.dof))
    for joint in (joint for joint in robot.joints if joint.moves):
        angular, linear = (np.array(part).ravel() for part in axes[joint.name])
        if joint.kind == "prismatic" and abs(linear[2]) > 1e-9:
            message = f"joint {joint.name!r} moves along {linear.tolist()} of the base link, out of the plane of "
            raise ModelError(f"{message}a planar base; use base='spatial'", name=joint.name, value=linear)
        if joint.kind != "prismatic" and np.hypot(angular[0], angular[1]) > 1e-9:
            message = f"joint {joint.name!r} turns about {angular.tolist()} of the base link, not about z as a "
            raise ModelError(f"{message}planar base needs; use base='spatial'", name=joint.name, value=angular)


def _require_inertia(robot: Robot, rows: list[int]) -> None:
    """Raise ModelError if, for lack of inertia, conserved momentum does not determine the base motion of a robot."""
    if robot.total_mass == 0:
        raise massless_error("without which no momentum tells how its base floats")
    # A stretched chain of point masses lacks inertia about one axis in a single configuration, so several are tried.
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
    names = [link.name for link in robot.links]
    message = (
        f"the links {names} have no rotational inertia about some axis, "
        f"so that the momentum does not fix the motion of the base; give the base link an inertia{hint}"
    )
    raise ModelError(message, name="links", value=names)
