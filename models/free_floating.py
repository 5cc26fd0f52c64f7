"""Arms on an unactuated, freely floating base whose momentum is conserved, zero unless given (Kim, Kim 2011).

The base moves so that E1 x1' + E2 x2' = 0 (24), with x1' the base twist and x2' the joint rates; the tip
moves with F1 x1' + F2 x2' = G x2', G = F2 - F1 E1^-1 E2 being the generalized Jacobian (25). A momentum that is
not zero adds the twist of the whole machine as one rigid body: both become affine in the joint rates.

The reaction is computed about the centre of mass of the machine, where linear and angular momentum decouple,
and in the axes of the base, where nothing depends on the base's own pose: one rotational inertia, of size 3
(1 when planar), is left to invert instead of E1 of size 6 (3). Instructions of the SX function of G, against
the same through solve_spd(E1, E2) and ca.solve(E1, E2): spatial base and seven joints 1721 (3451, 4191), the
paper's planar example 177 (337, 389); of the base twist for given joint rates 1230 (2532, 3056) and 127 (240,
292).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, TypeAlias

import casadi as ca
import numpy as np

from models.arrays import Array, ArrayInput, checked_array
from models.errors import ModelError
from models.kinematics import (
    center_of_mass,
    checked_vector,
    frames_and_axes,
    joint_vector,
    point_jacobian,
    robot_inertia,
    tip_frame,
)
from models.kinematics import momentum_matrix as joint_momentum_matrix
from models.machine import TWIST_SIZE, jacobian_manipulability, require_joints
from models.parts import Link
from models.reaction import Reaction, reaction, require_inertia, require_planar
from models.robot import Robot, planar_chain
from models.spatial import (
    Expression,
    Frame,
    angular_velocity_from_quaternion,
    cross,
    expression,
    force_transform,
    motion_transform,
    on_scalars,
    quaternion_product,
    rotation,
    rotation_from_quaternion,
)

BaseKind: TypeAlias = Literal["planar", "spatial"]

PLANAR_ROWS = [2, 3, 4]
"""Of a spatial vector, what a motion in the plane z = constant has:

Rotation about z, translation along x and y.
"""


@dataclass(frozen=True, eq=False)
class FreeFloating:
    """A robot whose root link floats freely, the total momentum being conserved.

    The configuration of the base is the pose of the root link's frame in an inertial world: (x, y, angle) for
    a planar base, (x, y, z, qw, qx, qy, qz) for a spatial one, with a unit quaternion. A base twist is
    (angular velocity, velocity of the root frame's origin) in world axes, shape (6, 1); for a planar base
    (angular velocity, vx, vy), shape (3, 1).

    Attributes:
        robot: The kinematic tree.
        base: "planar" or "spatial".
        conserved_momentum: (Angular about the centre of mass, N m s; linear, N s), world axes, shape (6,);
            (Lz, Px, Py), shape (3,), if planar. Zero if None.

    Raises:
        ModelError: Unknown kind of base, no moving joint, no mass, no rotational inertia, a joint that would move a
            planar machine out of its plane, or a momentum of a wrong size or not finite.
    """

    robot: Robot
    base: BaseKind = "spatial"
    conserved_momentum: ArrayInput | None = None

    def __post_init__(self) -> None:
        if self.base not in ("planar", "spatial"):
            raise ModelError(f"unknown kind of base {self.base!r}; use 'planar' or 'spatial'")
        require_joints(self.robot)
        if self.base == "planar":
            require_planar(self.robot)
        require_inertia(self.robot, self.twist_rows)
        given = np.zeros(len(self.twist_rows)) if self.conserved_momentum is None else self.conserved_momentum
        momentum = checked_array(
            given, (len(self.twist_rows),), f"{self.base} free-floating base", "conserved_momentum"
        )
        object.__setattr__(self, "conserved_momentum", momentum)

    @property
    def base_size(self) -> int:
        """3 for a planar base, 7 for a spatial one."""
        return 3 if self.base == "planar" else 7

    @property
    def joint_size(self) -> int:
        """Number of moving joints."""
        return self.robot.dof

    @property
    def twist_rows(self) -> list[int]:
        """Which rows of a spatial twist or momentum the base has:

        (rotation z, x, y) if planar, else all six.
        """
        return PLANAR_ROWS if self.base == "planar" else list(range(6))

    def base_home(self) -> Array:
        """Base at the world's origin, axes parallel. Shape (base_size,)."""
        return np.zeros(3) if self.base == "planar" else np.array([0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0])

    def world_from_base(self, base: Expression) -> Frame:
        """Placement of the root link's frame in the world."""
        meaning = "(x, y, angle)" if self.base == "planar" else "(x, y, z, qw, qx, qy, qz)"
        base = checked_vector(base, self.base_size, "base", meaning)
        if self.base == "planar":
            return Frame(rotation((0, 0, 1), base[2]), ca.vertcat(base[0:2], type(base)(1, 1)))
        return Frame(rotation_from_quaternion(base[3:7]), base[0:3])

    @on_scalars
    def tip_pose(self, base: Expression, q: Expression) -> Frame:
        """Frame of the tip in the world."""
        world_from_base = self.world_from_base(base)
        tip = tip_frame(self.robot, frames_and_axes(self.robot, q)[0])
        turned = ca.mtimes(world_from_base.rotation, tip.rotation)
        return Frame(ca.densify(turned), ca.densify(world_from_base.point(tip.position)))

    @on_scalars
    def tip_jacobian(self, base: Expression, q: Expression) -> Expression:
        """Generalized Jacobian G (25), the linear part of the tip's twist. Shape (6, joint_size)."""
        return self._tip_motion(base, self._reaction(q, None))

    @on_scalars
    def tip_twist(self, base: Expression, q: Expression, joint_rates: Expression) -> Expression:
        """Twist of the tip, G joint_rates (25) and what the conserved momentum adds. Shape (6, 1)."""
        rates = joint_vector(self.robot, joint_rates, "joint_rates")
        return self._tip_motion(base, self._reaction(q, rates, base))

    @on_scalars
    def base_twist(self, base: Expression, q: Expression, joint_rates: Expression) -> Expression:
        """Twist of the base that conserves the momentum, E1^-1 (momentum - E2 joint_rates) (24).

        Shape (6, 1) or (3, 1).
        """
        reaction = self._reaction(q, joint_vector(self.robot, joint_rates, "joint_rates"), base)
        turn = self.world_from_base(base).rotation
        twist = ca.vertcat(ca.mtimes(turn, reaction.base_angular), ca.mtimes(turn, reaction.base_linear))
        return ca.densify(twist)[self.twist_rows, :]

    @on_scalars
    def base_rate(self, base: Expression, q: Expression, joint_rates: Expression) -> Expression:
        """Time derivative of the base configuration that conserves the momentum. Shape (base_size, 1)."""
        if self.base == "planar":
            twist = self.base_twist(base, q, joint_rates)
            return ca.vertcat(twist[1:3], twist[0])
        base = expression(base)
        reaction = self._reaction(q, joint_vector(self.robot, joint_rates, "joint_rates"), base)
        turn = self.world_from_base(base).rotation
        quaternion, spin = base[3:7], reaction.base_angular
        turning = quaternion_product(quaternion, ca.vertcat(type(spin)(1, 1), spin)) / 2  # in base axes: no rotation
        return ca.densify(ca.vertcat(ca.mtimes(turn, reaction.base_linear), turning))

    @on_scalars
    def twist_of_rate(self, base: Expression, base_rate: Expression) -> Expression:
        """Twist of a base whose configuration changes with `base_rate`. Shape (6, 1), or (3, 1) if planar."""
        rate = checked_vector(base_rate, self.base_size, "base_rate", "the derivative of the base configuration")
        base = checked_vector(base, self.base_size, "base", "the base configuration")
        if self.base == "planar":
            return ca.vertcat(rate[2], rate[0:2])
        return ca.vertcat(angular_velocity_from_quaternion(base[3:7], rate[3:7]), rate[0:3])

    @on_scalars
    def momentum_matrices(self, base: Expression, q: Expression) -> tuple[Expression, Expression]:
        """E1 and E2 of (24): momentum = E1 base_twist + E2 joint_rates.

        Returns:
            E1 of shape (6, 6), E2 of shape (6, joint_size), rows (moment of momentum about the world's
            origin, linear momentum), world axes; (3, 3) and (3, joint_size) with the rows (Lz, Px, Py) for a
            planar base.
        """
        to_world = force_transform(self.world_from_base(base))
        turn = motion_transform((self.world_from_base(base).rotation, ca.DM(3, 1)))
        locked = ca.mtimes([to_world, robot_inertia(self.robot, q), turn.T])
        joints = ca.mtimes(to_world, joint_momentum_matrix(self.robot, q))
        rows = self.twist_rows
        return ca.densify(locked)[rows, rows], ca.densify(joints)[rows, :]

    @on_scalars
    def momentum(self, base: Expression, q: Expression, base_twist: Expression, joint_rates: Expression) -> Expression:
        """Total (moment of momentum about the world's origin, linear momentum); (Lz, Px, Py) if planar.

        Shape (6, 1) or (3, 1).
        """
        locked, joints = self.momentum_matrices(base, q)
        twist = checked_vector(base_twist, len(self.twist_rows), "base_twist", "angular velocity, then linear")
        return ca.mtimes(locked, twist) + ca.mtimes(joints, joint_vector(self.robot, joint_rates, "joint_rates"))

    @on_scalars
    def momentum_residual(
        self, base: Expression, q: Expression, base_rate: Expression, joint_rates: Expression
    ) -> Expression:
        """Momentum, as above, of a motion given by its configuration's derivatives, less the conserved one:

        Zero if the motion is possible.
        """
        found = self.momentum(base, q, self.twist_of_rate(base, base_rate), joint_rates)
        return found - self._momentum_about_origin(base, q) if self._moves_by_itself else found

    @on_scalars
    def jacobians(self, base: Expression, q: Expression) -> tuple[Expression, Expression]:
        """F1 and F2 of (25).

        Tip twist = F1 base_twist + F2 joint_rates, base and joints taken as independent.

        Returns:
            F1 of shape (6, 6), (6, 3) for a planar base; F2 of shape (6, joint_size).
        """
        turn = self.world_from_base(base).rotation
        frames, axes = frames_and_axes(self.robot, q)
        tip = tip_frame(self.robot, frames).position
        tip_from_base: Expression = ca.mtimes(turn, tip)
        lever = motion_transform((ca.DM.eye(3), -tip_from_base))
        joints = point_jacobian(self.robot, axes, str(self.robot.tip), tip)
        both = motion_transform((turn, ca.DM(3, 1)))
        return ca.densify(lever)[:, self.twist_rows], ca.densify(ca.mtimes(both, joints))

    def manipulability(self, base: Expression, q: Expression, rows: Sequence[int] = range(TWIST_SIZE)) -> Expression:
        """Of the generalized Jacobian, as jacobian_manipulability. Shape (1, 1)."""
        return jacobian_manipulability(self.tip_jacobian(base, q), rows)

    def _tip_motion(self, base: Expression, reaction: Reaction) -> Expression:
        turn = self.world_from_base(base).rotation
        angular, linear = ca.mtimes(turn, reaction.tip_angular), ca.mtimes(turn, reaction.tip_linear)
        return ca.densify(ca.vertcat(angular, linear))

    @property
    def _moves_by_itself(self) -> bool:
        return bool(np.any(self.conserved_momentum))

    def _spatial_momentum(self) -> tuple[Expression, Expression]:
        """(Angular about the centre of mass, linear), world axes. Shape (3, 1) each."""
        full = np.zeros(6)
        full[self.twist_rows] = self.conserved_momentum
        return expression(full[:3]), expression(full[3:])

    def _momentum_about_origin(self, base: Expression, q: Expression) -> Expression:
        angular, linear = self._spatial_momentum()
        center = center_of_mass(self.robot, q, self.world_from_base(base))
        return ca.densify(ca.vertcat(angular + cross(center, linear), linear))[self.twist_rows, :]

    def _reaction(self, q: Expression, joint_rates: Expression | None, base: Expression = None) -> Reaction:
        """As `models.reaction.reaction`, with the conserved momentum in the base's axes where rates are given."""
        carried = None
        if joint_rates is not None and self._moves_by_itself:
            turn = self.world_from_base(base).rotation
            angular, push = (ca.mtimes(turn.T, part) for part in self._spatial_momentum())
            carried = angular, push
        return reaction(self.robot, q, joint_rates, carried, planar=self.base == "planar")


def paper_example() -> FreeFloating:
    """The planar three-joint machine of Kim, Kim 2011, section 5.

    Printed: base 100 kg and 66.67 kg m^2 (a plate of 2 m x 2 m), links of 2 kg and 0.7083 kg m^2 (plates of
    2 m x 0.5 m). Not printed, identified from the pattern of Table 1 and therefore assumptions: links 2 m
    long, arm mounted at (1, 0) m of the base, centres of mass at mid-link. The paper starts it from base pose
    0 and joints at 45, 60, -60 deg, with the tip moving at (-1, -1) m/s and its orientation free.
    """
    base = Link("base", 100.0, inertia=np.diag([33.335, 33.335, 66.67]))
    robot = planar_chain([2.0] * 3, [2.0] * 3, [0.7083] * 3, mount=(1.0, 0.0), base=base)
    return FreeFloating(robot, base="planar")
