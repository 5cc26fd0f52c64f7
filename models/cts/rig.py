"""Kinematics of a captive trajectory rig, whose six joints (P-R-R-R-R-R) move a store model on a goose-neck sting.

Source: Lee, Lee 2017. Equation numbers are the paper's; misprints are corrected by comparison with the D-H product.
Joints 2 and 3 produce yaw, 4 and 5 pitch, and 6 alone roll. The task does not specify the roll, the rotation about the
tool axis. It is a functional redundancy: it moves the corner P_G of the goose-neck without changing the task.

World is the rig's base frame: x along the prismatic joint towards the nose of the store, z up. A *target* is
(x, y, z, yaw, pitch) of the tool frame in world, shape (5,), m and rad; a *pose* is a target and its roll, shape (6,).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import casadi as ca
import numpy as np

from models.checks import Array, ArrayInput, Sign, require, set_fields, warn_of_degrees, warn_of_millimetres
from models.errors import ModelError
from models.spatial import FULL_TURN, Expression, Frame, expression, rotation

INCH = 0.0254
LENGTHS = ("yaw_link_1", "yaw_link_2", "yaw_offset", "pitch_link", "sting", "goose_neck")


@dataclass(frozen=True, eq=False)
class Rig:
    """Dimensions and joint limits of a captive trajectory rig, whose six joints move a model in a wind tunnel.

    Attributes:
        yaw_link_1, yaw_link_2: Ly1 and Ly2, the links after joints 2 and 3. m.
        yaw_offset: Lm, sideways from joint 3's link to joint 4. m.
        pitch_link: Lp1, from joint 4 to joint 5. m.
        sting: Lp2, from the goose-neck's corner along the tool axis to the store. m.
        goose_neck: Lg, from the sting's axis to the axis of joint 6. m.
        lower, upper: Joint limits, m for the first and rad for the others. Shape (6,). A revolute joint has both limits
            or none. Its angles are equivalent modulo a full turn; positions are given in the turn nearest to its
            mid-range.

    Raises:
        ModelError: A length is not positive, limits are crossed, or a revolute joint has only one limit.
    """

    yaw_link_1: float
    yaw_link_2: float
    yaw_offset: float
    pitch_link: float
    sting: float
    goose_neck: float
    lower: ArrayInput = (-np.inf,) * 6
    upper: ArrayInput = (np.inf,) * 6

    def __post_init__(self) -> None:
        for name in LENGTHS:
            length = require.positive(f"rig: {name}", getattr(self, name), unit="m")
            set_fields(self, **{name: length})
            warn_of_millimetres(f"rig: {name}", length)
        for name in ("lower", "upper"):
            set_fields(self, **{name: require.array(f"rig: {name}", getattr(self, name), (6,), entries="numbers")})
        for joint, (low, high) in enumerate(zip(self.lower, self.upper, strict=True), 1):
            if not low < high:
                message = f"rig: joint {joint} has lower limit {low} not below its upper limit {high}"
                raise ModelError(message, name=f"joint {joint}", value=low, limit=high)
            if joint > 1 and np.isfinite(low) != np.isfinite(high):
                message = f"rig: joint {joint} has limits {low} .. {high}; give a revolute joint both or none"
                raise ModelError(message, name=f"joint {joint}", limit=(low, high))
            if joint > 1:
                warn_of_degrees(f"rig: limit of joint {joint}", (low, high), f"joint {joint}")

    def limited(self, joint: int) -> bool:
        """Return whether the limits of a revolute joint (number 2 to 6) are less than a full turn apart."""
        return bool(self.upper[joint - 1] - self.lower[joint - 1] < FULL_TURN)

    def limit(self, joint: int, upper: bool) -> float:
        """Return the lower or upper limit of a joint (number 1 to 6), m or rad; infinite if there is no limit."""
        return float((self.upper if upper else self.lower)[joint - 1])

    def middle_and_half(self, joint: int) -> tuple[float, float]:
        """Return the middle and half-width of the range of a joint (number 1 to 6) that has both limits, m or rad."""
        low, high = self.limit(joint, False), self.limit(joint, True)
        return (low + high) / 2, (high - low) / 2

    def unlimited(self) -> Rig:
        """Return a copy of the rig without joint limits."""
        return Rig(*(getattr(self, name) for name in LENGTHS))


@dataclass(frozen=True, eq=False)
class Tunnel:
    """Wind tunnel data for the cost, the weighted squared distance of the goose-neck's corner from the tunnel's centre.

    Attributes:
        center: P_C of equation (35) in the world. Shape (3,), m.
        ranges: P_M - P_m, the useful extent along x, y, z. Shape (3,), m.
        weights: w1, w2, w3. Shape (3,).

    Raises:
        ModelError: A range is not positive, a weight is negative, or a shape is wrong.
    """

    center: ArrayInput
    ranges: ArrayInput
    weights: ArrayInput = (1.0, 1.0, 1.0)

    def __post_init__(self) -> None:
        signs: dict[str, Sign] = {"center": "any", "ranges": "positive", "weights": "nonnegative"}
        for name, sign in signs.items():
            set_fields(self, **{name: require.array(f"tunnel: {name}", getattr(self, name), (3,), sign=sign)})

    @property
    def scale(self) -> Array:
        """Diagonal of the weight matrix of the squared distance in the cost: weights / ranges^2. Shape (3,), 1/m^2."""
        return np.asarray(self.weights / self.ranges**2)


class Branch(NamedTuple):
    """One of the four branches of the rig's inverse kinematics, given by the signs of sin q2 and cos q4 (joint angles).

    Attributes:
        yaw: Sign of sin q2: +1 for q2 = +acos(.) in equation (25), -1 for -acos(.), the side of the home position.
        pitch: Sign of cos q4: +1 for the principal asin in equation (23), -1 for pi minus it.
    """

    yaw: int = -1
    pitch: int = 1


BRANCHES = (Branch(-1, 1), Branch(-1, -1), Branch(1, 1), Branch(1, -1))
HOME = BRANCHES[0]


def checked_branch(branch: Branch) -> Branch:
    """Return a branch of inverse kinematics after checking that it is one of the four in BRANCHES."""
    return Branch(*require.choice("rig: branch", branch, BRANCHES))


class RigConfiguration(NamedTuple):
    """Joint positions q1, q2, q4 and position of the goose-neck's corner for a target, a roll angle and a branch.

    Attributes:
        corner: Position P_G of the goose-neck's corner in the world. Shape (3, 1), m.
        sin4, cos4, sin2, cos2: Sines and cosines of joint angles 4 and 2. If the target is out of reach, sin4 or cos2
            is outside [-1, 1], and cos4 or sin2, respectively, is nearly 0.
        q1: Position of the prismatic joint, m.
    """

    corner: Expression
    sin4: Expression
    cos4: Expression
    sin2: Expression
    cos2: Expression
    q1: Expression


def dh_frames(rig: Rig, q: Expression) -> list[Frame]:
    """Return link frames 0 to 6 and the tool frame in the world as products of Denavit-Hartenberg transformations.

    Equations (1) to (4) of the paper, without joint offsets.

    Args:
        q: Joint positions. Shape (6, 1).
    """
    q = expression(q)
    rows = (
        (0.0, q[0], 0.0, -np.pi / 2),
        (q[1], 0.0, rig.yaw_link_1, 0.0),
        (q[2], 0.0, rig.yaw_link_2, -np.pi / 2),
        (q[3], rig.yaw_offset, rig.pitch_link, 0.0),
        (q[4], 0.0, 0.0, np.pi / 2),
        (q[5], rig.sting, rig.goose_neck, 0.0),
    )
    frames = [Frame(ca.DM([[0, 0, 1], [1, 0, 0], [0, 1, 0]]), ca.DM.zeros(3))]
    for theta, d, a, alpha in rows:
        turn = ca.mtimes(rotation((0, 0, 1), theta), rotation((1, 0, 0), alpha))
        shift = ca.vertcat(a * ca.cos(theta), a * ca.sin(theta), d)
        last = frames[-1]
        frames.append(Frame(ca.mtimes(last.rotation, turn), last.point(shift)))
    tool = ca.mtimes(frames[-1].rotation, rotation((0, 1, 0), -np.pi / 2))
    return [*frames, Frame(tool, frames[-1].position)]


def forward(rig: Rig, q: Expression) -> Expression:
    """Return the pose (x, y, z, yaw, pitch, roll) of the tool in the world at joint positions q. Shape (6, 1), m, rad.

    Equations (16) to (22) of the paper. Yaw and pitch are the sums of the joint angles, not reduced to one turn.
    """
    q = expression(q)
    (c23, s23), (c45, s45), (c6, s6) = ((ca.cos(x), ca.sin(x)) for x in (q[1] + q[2], q[3] + q[4], q[5]))
    along = rig.yaw_link_2 + rig.pitch_link * ca.cos(q[3]) + rig.sting * s45 + rig.goose_neck * c45 * c6
    sideways = rig.yaw_offset + rig.goose_neck * s6
    return ca.vertcat(
        q[0] - rig.yaw_link_1 * ca.sin(q[1]) - s23 * along - c23 * sideways,
        rig.yaw_link_1 * ca.cos(q[1]) + c23 * along - s23 * sideways,
        rig.sting * c45 - rig.pitch_link * ca.sin(q[3]) - rig.goose_neck * s45 * c6,
        q[1] + q[2] + np.pi / 2,
        q[3] + q[4] - np.pi / 2,
        q[5],
    )


def task_jacobian(rig: Rig, q: Expression) -> Expression:
    """Return the Jacobian (Table 3 of Lee, Lee 2017) of the target coordinates with respect to the joint positions.

    The target coordinates are (x, y, z, yaw, pitch). Shape (5, 6).
    """
    joints = ca.SX.sym("q", 6)
    return ca.Function("task_jacobian", [joints], [ca.jacobian(forward(rig, joints)[:5], joints)])(q)


def goose_neck_corner(rig: Rig, target: Expression, roll: Expression) -> Expression:
    """Return the position of the goose-neck's corner in the world for a target and a roll angle. Shape (3, 1), m.

    Equations (32) to (34) of the paper.
    """
    roll = expression(roll)
    return corner_of_roll(rig, expression(target), ca.cos(roll), ca.sin(roll))


def corner_of_roll(rig: Rig, target: Expression, c: Expression, s: Expression) -> Expression:
    """Return the goose-neck corner's world position for a target and a roll (cosine c and sine s). Shape (3, 1), m."""
    axle, cosine_part, sine_part = corner_circle(rig, target)
    return axle + rig.goose_neck * (c * cosine_part + s * sine_part)


def corner_circle(rig: Rig, target: Expression) -> tuple[Expression, Expression, Expression]:
    """Return the circle that the goose-neck's corner describes over all rolls: its centre (m) and two unit axes.

    The corner is centre + goose_neck (cos(roll) first axis + sin(roll) second axis). Shape (3, 1) each.
    """
    c_yaw, s_yaw = ca.cos(target[3]), ca.sin(target[3])
    c_pitch, s_pitch = ca.cos(target[4]), ca.sin(target[4])
    axle = target[:3] - rig.sting * ca.vertcat(c_yaw * c_pitch, s_yaw * c_pitch, -s_pitch)
    return axle, ca.vertcat(c_yaw * s_pitch, s_yaw * s_pitch, c_pitch), ca.vertcat(s_yaw, -c_yaw, target[0] * 0)


def configuration_at(rig: Rig, target: Expression, c: Expression, s: Expression, *, branch: Branch) -> RigConfiguration:
    """Return the joint positions of the rig for a tool pose and a roll angle about the tool axis, in closed form."""
    corner = corner_of_roll(rig, target, c, s)
    c_yaw, s_yaw = ca.cos(target[3]), ca.sin(target[3])
    sin4 = -corner[2] / rig.pitch_link
    cos4 = branch.pitch * ca.sqrt(ca.fmax((1 - sin4) * (1 + sin4), 1e-32))
    along = rig.yaw_link_2 + rig.pitch_link * cos4
    cos2 = (corner[1] - along * s_yaw - rig.yaw_offset * c_yaw) / rig.yaw_link_1
    sin2 = branch.yaw * ca.sqrt(ca.fmax((1 - cos2) * (1 + cos2), 1e-32))
    q1 = corner[0] - along * c_yaw + rig.yaw_offset * s_yaw + rig.yaw_link_1 * sin2
    return RigConfiguration(corner, sin4, cos4, sin2, cos2, q1)


def inverse(rig: Rig, target: Expression, roll: Expression, branch: Branch = HOME) -> tuple[Expression, Expression]:
    """Return the joint positions for a target and a roll angle, and the reach margins of the yaw and pitch links.

    Equations (23) to (27) of the paper.

    Args:
        target: (x, y, z, yaw, pitch) in world. Shape (5, 1), m and rad.
        roll: rad.
        branch: One of the four branches.

    Returns:
        Joint positions, shape (6, 1), and reach margins, shape (2, 1): 1 - |sin q4| and 1 - |cos q2|. If a margin is
        negative the pose is out of reach, and the finite positions do not attain it. q2 and q4 lie in (-pi, pi];
        q3, q5 complete the target's yaw and pitch, unless the limits require another turn.
    """
    target, roll = expression(target), expression(roll)
    configuration = configuration_at(rig, target, ca.cos(roll), ca.sin(roll), branch=branch)
    reach = ca.vertcat(1 - ca.fabs(configuration.sin4), 1 - ca.fabs(configuration.cos2))
    return joints_of(rig, target, roll, configuration), reach


def joints_of(rig: Rig, target: Expression, roll: Expression, configuration: RigConfiguration) -> Expression:
    """Return the joint positions, (6, 1), of a rig configuration; full turns bring each angle close to mid-range."""
    q2 = ca.atan2(configuration.sin2, configuration.cos2)
    q4 = ca.atan2(configuration.sin4, configuration.cos4)
    angles = [q2, target[3] - q2 - np.pi / 2, q4, target[4] - q4 + np.pi / 2]
    for k, angle in enumerate(angles):
        if np.isfinite(rig.limit(k + 2, False)):
            angles[k] = nearest_turn(angle, rig.middle_and_half(k + 2)[0])
    return ca.vertcat(configuration.q1, *angles, roll)


def nearest_turn(angle: Expression, middle: Expression) -> Expression:
    """Return the angle nearest to `middle` that differs from `angle` by full turns, rad."""
    return angle - FULL_TURN * ca.floor((angle - middle) / FULL_TURN + 0.5)


def first_turn_after(angle: Expression, start: Expression) -> Expression:
    """Return the smallest angle at or beyond `start` that differs from `angle` by full turns, rad."""
    return angle + FULL_TURN * ca.ceil((start - angle) / FULL_TURN)
