"""SCARA arms: two parallel links in a horizontal plane, a quill and a wrist about the same vertical direction.

Joint vector (shoulder, elbow, quill, wrist): rad, rad, m, rad. In the frame of the mount

    x = l1 cos q1 + l2 cos(q1 + q2),  y likewise,  z = q3,  yaw = q1 + q2 + q4.

The determinant of the planar Jacobian is l1 l2 sin q2: the arm is singular when stretched (reach l1 + l2) or folded
(|l1 - l2|, the shoulder axis if both links are equal).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any, Literal, TypeAlias, get_args

import casadi as ca
import numpy as np

from models.arrays import (
    Array,
    ArrayInput,
    checked_array,
    checked_choice,
    checked_each,
    checked_number,
    warn_of_degrees,
    warn_of_millimetres,
)
from models.errors import ModelError
from models.robot.kinematics import checked_vector
from models.robot.parts import Joint, Link
from models.robot.robot import Robot
from models.spatial import FULL_TURN, Expression, Frame, rotation

__all__ = ["Elbow", "Scara"]

Elbow: TypeAlias = Literal["left", "right"]
QUILL = 2


@dataclass(frozen=True, eq=False)
class Scara:
    """A SCARA arm with its shoulder axis vertical (world z).

    Attributes:
        upper_arm, forearm: Link lengths l1, l2, m.
        mount: Origin of the quill position on the shoulder axis, in world. Shape (3,), m.
        lower, upper: Joint limits. Shape (4,), rad and m.
        names: Names of the joints.

    Raises:
        ModelError: A length that is not positive, limits that are nan or out of order, names that are not four distinct
            ones.
    """

    upper_arm: float
    forearm: float
    mount: ArrayInput = (0.0, 0.0, 0.0)
    lower: ArrayInput = (-np.inf,) * 4
    upper: ArrayInput = (np.inf,) * 4
    names: tuple[str, str, str, str] = ("shoulder", "elbow", "quill", "wrist")

    def __post_init__(self) -> None:
        for field in ("upper_arm", "forearm"):
            length = checked_number(getattr(self, field), "scara", field, positive=True, unit="m")
            object.__setattr__(self, field, length)
            warn_of_millimetres(length, "scara", field, field)
        object.__setattr__(self, "mount", checked_array(self.mount, (3,), "scara", "mount"))
        for field in ("lower", "upper"):
            object.__setattr__(self, field, checked_array(getattr(self, field), (4,), "scara", field, finite=False))
        names = () if isinstance(self.names, str) else checked_each(self.names, str, "scara", "names")
        if len(set(names) - {""}) != 4 or len(names) != 4:
            message = f"scara: joint names {list(self.names)} must be four that differ"
            raise ModelError(message, name="names", value=self.names)
        for name, low, high in zip(self.names, self.lower, self.upper, strict=True):
            if low > high or low == np.inf or high == -np.inf:
                message = f"scara: joint {name!r} has limits {low:g} .. {high:g}, which leave it no position"
                raise ModelError(message, name=name, value=low, limit=high)
        for joint, name in enumerate(self.names):
            if joint != QUILL:
                warn_of_degrees((self.lower[joint], self.upper[joint]), "scara", name, f"limit of {name!r}")

    @property
    def outer(self) -> float:
        """Largest reach, m."""
        return self.upper_arm + self.forearm

    @property
    def inner(self) -> float:
        """Smallest reach, m."""
        return abs(self.upper_arm - self.forearm)

    @cached_property
    def robot(self) -> Robot:
        """Kinematic tree of the arm, without mass."""
        links = tuple(Link(name) for name in ("base", "upper arm", "forearm", "quill", "tool"))
        origins = (tuple(self.mount), (self.upper_arm, 0.0, 0.0), (self.forearm, 0.0, 0.0), (0.0, 0.0, 0.0))
        kinds: tuple[Any, ...] = ("revolute", "revolute", "prismatic", "revolute")
        joints = []
        for i, (name, kind) in enumerate(zip(self.names, kinds, strict=True)):
            ends = links[i].name, links[i + 1].name
            joints.append(Joint(name, kind, *ends, origins[i], lower=self.lower[i], upper=self.upper[i]))
        return Robot(links, tuple(joints))

    def forward(self, joints: Expression) -> Frame:
        """Return the frame of the tool in world. `joints` has shape (4,), CasADi or numbers."""
        q = checked_vector(joints, 4, "joints", f"one entry for each of {list(self.names)}")
        bend = q[0] + q[1]
        x = self.upper_arm * ca.cos(q[0]) + self.forearm * ca.cos(bend)
        y = self.upper_arm * ca.sin(q[0]) + self.forearm * ca.sin(bend)
        return Frame(rotation((0, 0, 1), bend + q[3]), ca.DM(self.mount) + ca.vertcat(x, y, q[2]))

    def inverse(self, position: ArrayInput, yaw: float = 0.0, elbow: Elbow = "left") -> Array:
        """Return the joints that put the tool at a point with a yaw. Shape (4,).

        Shoulder and elbow are within (-pi, pi] and wrist = yaw - shoulder - elbow; whole turns are added only where a
        limit requires them. At both ends of the reach the two elbows agree; on the shoulder axis the shoulder is
        arbitrary.

        Args:
            position: In world. Shape (3,), m.
            yaw: Of the tool about the world's z, rad.
            elbow: "left" bends the elbow counter-clockwise (q2 >= 0), "right" clockwise.

        Raises:
            ModelError: nan, a point out of reach (the message gives the distance), joint limits.
        """
        point = checked_array(position, (3,), "scara", "position")
        angle = checked_number(yaw, "scara", "yaw")
        self.check_reach(float(np.hypot(*(point - self.mount)[:2])), f"point {point.tolist()} m")
        q = np.array(ca.DM(self.inverse_expression(np.append(point, angle), elbow))).ravel()
        for joint, name in enumerate(self.names):
            turn = self.whole_turn(joint, q[joint], q[joint])
            if turn is None:
                limits = float(self.lower[joint]), float(self.upper[joint])
                message = (
                    f"scara: point {point.tolist()} m needs joint {name!r} at {q[joint]:g}, outside its limits "
                    f"{limits[0]:g} .. {limits[1]:g}; take the other elbow, another yaw or point"
                )
                raise ModelError(message, name=name, value=float(q[joint]), limit=limits)
            q[joint] += turn
        return q

    def whole_turn(self, joint: int, least: float, most: float) -> float | None:
        """Return the smallest multiple of 2 pi that moves a joint's range within its limits (to 1e-9), or None.

        It is always 0 for the quill.

        Args:
            joint: Index.
            least, most: The range, rad or m.
        """
        low, high = float(self.lower[joint]) - 1e-9, float(self.upper[joint]) + 1e-9
        turn = 0.0
        if joint != QUILL and least < low:
            turn = FULL_TURN * float(np.ceil((low - least) / FULL_TURN))
        elif joint != QUILL and most > high:
            turn = -FULL_TURN * float(np.ceil((most - high) / FULL_TURN))
        return turn if low <= least + turn and most + turn <= high else None

    def inverse_expression(self, pose: Expression, elbow: Elbow = "left") -> Expression:
        """Return the closed-form inverse kinematics of (x, y, z, yaw) in world, without checks. Shape (4, 1).

        sin q2 is computed from the product of the distances to both ends of the reach, which is accurate near them.
        """
        checked_choice(elbow, get_args(Elbow), "scara", "elbow")
        p = checked_vector(pose, 4, "pose", "x, y, z and yaw")
        x, y, z = (p[i] - float(self.mount[i]) for i in range(3))
        a, b = self.upper_arm, self.forearm
        square = x**2 + y**2
        cosine = (square - a**2 - b**2) / (2 * a * b)
        # rounding may put a point of the boundary outside
        product = (self.outer**2 - square) * (square - self.inner**2)
        sine = ca.sqrt(ca.fmax(product, 0)) / (2 * a * b) * (1 if elbow == "left" else -1)
        along, across = a + b * cosine, b * sine
        shoulder = ca.atan2(y * along - x * across, x * along + y * across)
        bend = ca.atan2(sine, cosine)
        return ca.vertcat(shoulder, bend, z, p[3] - shoulder - bend)

    def inverse_rates(self, elbow: Elbow = "left") -> Any:
        """Return the CasADi Function from a pose (x, y, z, yaw) and its first three derivatives to those of the joints.

        All derivatives are by the same parameter; inputs and outputs have 4 entries each.
        """
        inputs = [ca.SX.sym(name, 4) for name in ("pose", "first", "second", "third")]
        at = ca.SX.sym("at")
        pose = inputs[0] + at * (inputs[1] + at * (inputs[2] / 2 + at * inputs[3] / 6))
        joints = self.inverse_expression(pose, elbow)
        outputs = [joints]
        for _ in range(3):
            outputs.append(ca.jacobian(outputs[-1], at))
        here = ca.substitute(outputs, [at], [ca.SX(0)])
        return ca.Function("inverse_rates", inputs, ca.cse([ca.densify(ca.simplify(value)) for value in here]))

    def check_reach(self, radius: float, what: str) -> None:
        """Raise ModelError naming `what` unless the arm reaches points at `radius` (m) from the shoulder axis."""
        if not self.inner * (1 - 1e-12) <= radius <= self.outer * (1 + 1e-12):
            message = (
                f"scara: {what} is {radius:g} m from the shoulder axis, unreachable: the arm reaches from "
                f"{self.inner:g} to {self.outer:g} m"
            )
            raise ModelError(message, name="radius", value=radius, limit=(self.inner, self.outer))
