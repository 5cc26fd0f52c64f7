"""What the planning code asks of a machine, and the simplest one: a robot on a fixed base."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, fields, is_dataclass, replace
from typing import Protocol, cast

import casadi as ca
import numpy as np

from models.arrays import Array, ArrayInput, checked_array, checked_instance, checked_rotation
from models.errors import ModelError
from models.robot.indices import TWIST_SIZE, jacobian_manipulability
from models.robot.kinematics import checked_vector, joint_vector, tip_jacobian, tip_pose
from models.robot.robot import Robot
from models.spatial import Expression, Frame, expression, on_scalars


class Machine(Protocol):
    """A robot on some base that moves only as the joints make it move.

    `base` is the configuration of the base, shape (base_size, 1): nothing for a fixed base, (x, y, angle) for
    a planar one, position and unit quaternion [w, x, y, z] for a spatial one, in the world. `q` are the joint
    positions, shape (joint_size, 1). Both may be SX, MX, DM or numbers. Twists are (angular velocity,
    velocity of the tip's origin), world axes. Another kind of machine is made by writing these functions.

    `tip_twist` and `base_rate` are affine in the joint rates: a machine that carries momentum moves with its joints at
    rest too. Their value at zero rates is the drift; `tip_jacobian` is the linear part alone.
    """

    @property
    def robot(self) -> Robot:
        """The kinematic tree."""

    @property
    def base_size(self) -> int:
        """Length of the base configuration: 0, 3 or 7."""

    @property
    def joint_size(self) -> int:
        """Number of moving joints."""

    def base_home(self) -> Array:
        """Base configuration at the world's origin. Shape (base_size,)."""

    def world_from_base(self, base: Expression) -> Frame:
        """Placement of the root link's frame in the world."""

    def tip_pose(self, base: Expression, q: Expression) -> Frame:
        """Frame of the tip in the world: rotation (3, 3), position (3, 1) in m."""

    def tip_jacobian(self, base: Expression, q: Expression) -> Expression:
        """Joint rates to the tip's twist, with the motion of the base that they cause.

        Shape (6, joint_size).
        """

    def tip_twist(self, base: Expression, q: Expression, joint_rates: Expression) -> Expression:
        """tip_jacobian times joint_rates, in fewer operations, and the drift. Shape (6, 1)."""

    def base_rate(self, base: Expression, q: Expression, joint_rates: Expression) -> Expression:
        """Time derivative of the base configuration at these joint rates, with the drift. Shape (base_size, 1)."""

    def manipulability(self, base: Expression, q: Expression, rows: Sequence[int] = range(TWIST_SIZE)) -> Expression:
        """Manipulability of the task that fixes these rows of the tip's twist, as jacobian_manipulability.

        Shape (1, 1).
        """


@dataclass(frozen=True, eq=False)
class FixedBase:
    """A robot whose root link is fastened to the world. The base configuration is empty: shape (0, 1) or ().

    Attributes:
        robot: The kinematic tree.
        translation: Root link frame's origin in the world. Shape (3,), m.
        rotation: Root link frame's axes, as columns, in the world. Shape (3, 3).

    Raises:
        ModelError: No moving joint, wrong sizes, a rotation that is none.
    """

    robot: Robot
    translation: ArrayInput = (0.0, 0.0, 0.0)
    rotation: ArrayInput = field(default_factory=lambda: np.eye(3))

    def __post_init__(self) -> None:
        require_joints(self.robot)
        owner = "fixed base"
        object.__setattr__(self, "translation", checked_array(self.translation, (3,), owner, "translation"))
        object.__setattr__(self, "rotation", checked_rotation(self.rotation, owner, "rotation"))

    @property
    def base_size(self) -> int:
        """0."""
        return 0

    @property
    def joint_size(self) -> int:
        """Number of moving joints."""
        return self.robot.dof

    def base_home(self) -> Array:
        """Nothing. Shape (0,)."""
        return np.zeros(0)

    def world_from_base(self, base: Expression = ()) -> Frame:
        """Placement of the root link's frame in the world, a constant."""
        checked_vector(base, 0, "base", "a fixed base has no configuration")
        return Frame(expression(self.rotation), expression(self.translation))

    @on_scalars
    def tip_pose(self, base: Expression, q: Expression) -> Frame:
        """Frame of the tip in the world."""
        return Frame(*map(ca.densify, tip_pose(self.robot, q, self.world_from_base(base))))

    @on_scalars
    def tip_jacobian(self, base: Expression, q: Expression) -> Expression:
        """Geometric Jacobian of the tip. Shape (6, joint_size)."""
        return tip_jacobian(self.robot, q, self.world_from_base(base))

    @on_scalars
    def tip_twist(self, base: Expression, q: Expression, joint_rates: Expression) -> Expression:
        """Twist of the tip. Shape (6, 1)."""
        return ca.mtimes(self.tip_jacobian(base, q), joint_vector(self.robot, joint_rates, "joint_rates"))

    @on_scalars
    def base_rate(self, base: Expression, q: Expression, joint_rates: Expression) -> Expression:
        """Nothing, of the type of the joint rates. Shape (0, 1)."""
        return type(joint_vector(self.robot, joint_rates, "joint_rates"))(0, 1)

    def manipulability(self, base: Expression, q: Expression, rows: Sequence[int] = range(TWIST_SIZE)) -> Expression:
        """As jacobian_manipulability. Shape (1, 1)."""
        return jacobian_manipulability(self.tip_jacobian(base, q), rows)


def with_tip(
    machine: Machine, link: str, translation: ArrayInput = (0.0, 0.0, 0.0), rotation: ArrayInput | None = None
) -> Machine:
    """The same machine with another frame of interest: one fixed in any of its links, the root included.

    Args:
        machine: A FixedBase, a FreeFloating, or any frozen dataclass with a field `robot`.
        link: Name of the link that carries the frame.
        translation: The frame's origin in the link's frame. Shape (3,), m.
        rotation: The frame's axes, as columns, in the link's frame. Shape (3, 3); parallel if None.

    Raises:
        ModelError: Unknown link, wrong sizes, a machine that is no such dataclass.
    """
    if not is_dataclass(machine) or isinstance(machine, type) or "robot" not in {part.name for part in fields(machine)}:
        message = f"{type(machine).__name__} is no dataclass with a field 'robot': its tip cannot be moved"
        raise ModelError(message, name="machine", value=machine)
    turn = np.eye(3) if rotation is None else rotation
    robot = replace(machine.robot, tip=machine.robot.link(link).name, tip_translation=translation, tip_rotation=turn)
    return cast(Machine, replace(machine, robot=robot))


def require_joints(robot: Robot) -> None:
    """Raise ModelError when the robot has no moving joint, or is none."""
    checked_instance(robot, Robot, "machine", "robot")
    if robot.dof == 0:
        names = [link.name for link in robot.links]
        raise ModelError(f"the robot of the links {names} has no moving joint", name="robot", value=names)
