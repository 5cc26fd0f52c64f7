"""Captive trajectory rig: six joints P-R-R-R-R-R that hold a store model on a goose-neck sting (Lee, Lee 2017).

Yaw comes from joints 2 and 3, pitch from 4 and 5, roll from 6 alone. The task leaves the roll open, so that roll is a
functional redundancy: it moves the corner P_G of the goose-neck and nothing else of the task. Equation numbers are the
paper's; several are misprinted there and stand here corrected, as the D-H product demands.

World is the rig's base frame: x along the prismatic joint towards the nose of the store, z up. A *target* is
(x, y, z, yaw, pitch) of the tool frame in world, shape (5,), m and rad; a *pose* is a target and its roll, shape (6,).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import casadi as ca
import numpy as np

from models.arrays import (
    Array,
    ArrayInput,
    checked_array,
    checked_choice,
    checked_number,
    warn_of_degrees,
    warn_of_millimetres,
)
from models.errors import ModelError
from models.spatial import FULL_TURN, Expression, Frame, expression, rotation

INCH = 0.0254
LENGTHS = ("yaw_link_1", "yaw_link_2", "yaw_offset", "pitch_link", "sting", "goose_neck")


@dataclass(frozen=True, eq=False)
class Rig:
    """Lengths and joint limits.

    Attributes:
        yaw_link_1, yaw_link_2: Ly1 and Ly2, the links after joints 2 and 3. m.
        yaw_offset: Lm, sideways from joint 3's link to joint 4. m.
        pitch_link: Lp1, from joint 4 to joint 5. m.
        sting: Lp2, from the goose-neck's corner along the tool axis to the store. m.
        goose_neck: Lg, from the sting's axis to the axis of joint 6. m.
        lower, upper: Of the joints, m for the first and rad for the others. Shape (6,). A revolute joint has both
            limits or none; an angle is the same after a full turn, so a position is taken in the turn nearest to the
            middle of the limits.

    Raises:
        ModelError: A length that is not positive, limits that are crossed, or one limit of a revolute joint alone.
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
            length = checked_number(getattr(self, name), "rig", name, positive=True, unit="m")
            object.__setattr__(self, name, length)
            warn_of_millimetres(length, "rig", name, name)
        for name in ("lower", "upper"):
            object.__setattr__(self, name, checked_array(getattr(self, name), (6,), "rig", name, finite=False))
        for joint, (low, high) in enumerate(zip(self.lower, self.upper, strict=True), 1):
            if not low < high:
                message = f"rig: joint {joint} has lower limit {low} not below its upper limit {high}"
                raise ModelError(message, name=f"joint {joint}", value=low, limit=high)
            if joint > 1 and np.isfinite(low) != np.isfinite(high):
                message = f"rig: joint {joint} has limits {low} .. {high}; give a revolute joint both or none"
                raise ModelError(message, name=f"joint {joint}", limit=(low, high))

            if joint > 1:
                warn_of_degrees((low, high), "rig", f"joint {joint}", f"limit of joint {joint}")

    def limited(self, joint: int) -> bool:
        """Whether revolute joint 2..6 (counted from 1) has limits less than a full turn apart."""
        return bool(self.upper[joint - 1] - self.lower[joint - 1] < FULL_TURN)

    def limit(self, joint: int, upper: bool) -> float:
        """One limit of joint 1..6, m or rad; infinite where there is none."""
        return float((self.upper if upper else self.lower)[joint - 1])

    def middle_and_half(self, joint: int) -> tuple[float, float]:
        """Middle and half width of the limits of a joint that has them."""
        low, high = self.limit(joint, False), self.limit(joint, True)
        return (low + high) / 2, (high - low) / 2

    def unlimited(self) -> Rig:
        """The same lengths without joint limits."""
        return Rig(*(getattr(self, name) for name in LENGTHS))


@dataclass(frozen=True, eq=False)
class Tunnel:
    """What the index I1 measures the goose-neck's corner against, (35).

    Attributes:
        center: P_C in world. Shape (3,), m.
        ranges: P_M - P_m, the useful extent along x, y, z. Shape (3,), m.
        weights: w1, w2, w3. Shape (3,).

    Raises:
        ModelError: A range that is not positive, a negative weight, wrong shapes.
    """

    center: ArrayInput
    ranges: ArrayInput
    weights: ArrayInput = (1.0, 1.0, 1.0)

    def __post_init__(self) -> None:
        for name in ("center", "ranges", "weights"):
            positive = name == "ranges"
            value = checked_array(getattr(self, name), (3,), "tunnel", name, positive=positive, unit="m")
            object.__setattr__(self, name, value)
        if not (self.weights >= 0).all():
            message = f"tunnel: weights {self.weights.tolist()} must not be negative"
            raise ModelError(message, name="weights", value=self.weights, limit=0.0)

    @property
    def scale(self) -> Array:
        """Diagonal of D, w / range^2. Shape (3,), 1/m^2."""
        return np.asarray(self.weights / self.ranges**2)


class Branch(NamedTuple):
    """One of the four ways to reach a pose.

    Attributes:
        yaw: Sign of sin q2: +1 for q2 = +acos(.) in (25), -1 for -acos(.), the side of the home position.
        pitch: Sign of cos q4: +1 for the principal asin in (23), -1 for pi minus it.
    """

    yaw: int = -1
    pitch: int = 1


BRANCHES = (Branch(-1, 1), Branch(-1, -1), Branch(1, 1), Branch(1, -1))
HOME = BRANCHES[0]


def checked_branch(branch: Branch) -> Branch:
    """The branch itself; ModelError unless it is one of the four."""
    return Branch(*checked_choice(branch, BRANCHES, "rig", "branch"))


class RigConfiguration(NamedTuple):
    """What a target, a roll and a branch make of the rig; scalar expressions unless said otherwise.

    Attributes:
        corner: P_G in world. Shape (3, 1), m.
        sin4, cos4, sin2, cos2: Of the joint angles. sin4 and cos2 leave [-1, 1] where the pose is out of reach, and
            their partners are as good as 0 there.
        q1: Position of the prismatic joint, m.
    """

    corner: Expression
    sin4: Expression
    cos4: Expression
    sin2: Expression
    cos2: Expression
    q1: Expression


# ---- forward ---------------------------------------------------------------------------------------------------


def dh_frames(rig: Rig, q: Expression) -> list[Frame]:
    """Frames 0..6 and the tool in world by the D-H product (1)-(4), Table 1 with q2 and q5 taken as they are.

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


def tool_frame(rig: Rig, q: Expression) -> Frame:
    """Tool frame in world by the closed expressions (6)-(14), (19)-(21)."""
    q = expression(q)
    (c23, s23), (c45, s45), (c6, s6) = _cosines_and_sines(q)
    turn = ca.vertcat(
        ca.horzcat(-s23 * s45, c45 * s23 * s6 - c23 * c6, c23 * s6 + c45 * s23 * c6),
        ca.horzcat(c23 * s45, -s23 * c6 - c23 * c45 * s6, s23 * s6 - c23 * c45 * c6),
        ca.horzcat(c45, s45 * s6, s45 * c6),
    )
    return Frame(turn, forward(rig, q)[:3])


def forward(rig: Rig, q: Expression) -> Expression:
    """Pose (x, y, z, yaw, pitch, roll) of the tool in world, (16)-(22). Shape (6, 1), m and rad.

    Yaw and pitch are the sums of the joint angles, not folded into one turn.
    """
    q = expression(q)
    (c23, s23), (c45, s45), (c6, s6) = _cosines_and_sines(q)
    along = rig.yaw_link_2 + rig.pitch_link * ca.cos(q[3]) + rig.sting * s45 + rig.goose_neck * c45 * c6
    aside = rig.yaw_offset + rig.goose_neck * s6
    return ca.vertcat(
        q[0] - rig.yaw_link_1 * ca.sin(q[1]) - s23 * along - c23 * aside,
        rig.yaw_link_1 * ca.cos(q[1]) + c23 * along - s23 * aside,
        rig.sting * c45 - rig.pitch_link * ca.sin(q[3]) - rig.goose_neck * s45 * c6,
        q[1] + q[2] + np.pi / 2,
        q[3] + q[4] - np.pi / 2,
        q[5],
    )


def _cosines_and_sines(q: Expression) -> list[tuple[Expression, Expression]]:
    """Of the sums of joints 2 and 3 and of 4 and 5, and of joint 6."""
    return [(ca.cos(angle), ca.sin(angle)) for angle in (q[1] + q[2], q[3] + q[4], q[5])]


def task_jacobian(rig: Rig, q: Expression) -> Expression:
    """Derivative of the target (x, y, z, yaw, pitch) by the joints, the Jacobian of Table 3. Shape (5, 6)."""
    joints = ca.SX.sym("q", 6)
    jacobian = ca.Function("task_jacobian", [joints], [ca.jacobian(forward(rig, joints)[:5], joints)])
    return jacobian(q)


# ---- inverse ---------------------------------------------------------------------------------------------------


def goose_neck_corner(rig: Rig, target: Expression, roll: Expression) -> Expression:
    """P_G = p - Lp2 x + Lg z in tool axes, (32)-(34), in world. Shape (3, 1), m."""
    roll = expression(roll)
    return corner_at(rig, expression(target), ca.cos(roll), ca.sin(roll))


def corner_at(rig: Rig, target: Expression, c: Expression, s: Expression) -> Expression:
    """P_G for a roll given by its cosine and sine. Shape (3, 1), m."""
    axle, cosine_part, sine_part = corner_circle(rig, target)
    return axle + rig.goose_neck * (c * cosine_part + s * sine_part)


def corner_circle(rig: Rig, target: Expression) -> tuple[Expression, Expression, Expression]:
    """Circle on which roll moves P_G: its centre (m, in world), and the axes e_c, e_s of cosine and sine. (3, 1)."""
    c_yaw, s_yaw = ca.cos(target[3]), ca.sin(target[3])
    c_pitch, s_pitch = ca.cos(target[4]), ca.sin(target[4])
    axle = target[:3] - rig.sting * ca.vertcat(c_yaw * c_pitch, s_yaw * c_pitch, -s_pitch)
    zero = target[0] * 0
    return axle, ca.vertcat(c_yaw * s_pitch, s_yaw * s_pitch, c_pitch), ca.vertcat(s_yaw, -c_yaw, zero)


def configuration_at(rig: Rig, target: Expression, c: Expression, s: Expression, branch: Branch) -> RigConfiguration:
    """Joint angles but for their arcs, for a roll given by its cosine and sine: (23), (25), (27)."""
    corner = corner_at(rig, target, c, s)
    c_yaw, s_yaw = ca.cos(target[3]), ca.sin(target[3])
    sin4 = -corner[2] / rig.pitch_link
    cos4 = branch.pitch * ca.sqrt(ca.fmax((1 - sin4) * (1 + sin4), 1e-32))
    along = rig.yaw_link_2 + rig.pitch_link * cos4
    cos2 = (corner[1] - along * s_yaw - rig.yaw_offset * c_yaw) / rig.yaw_link_1
    sin2 = branch.yaw * ca.sqrt(ca.fmax((1 - cos2) * (1 + cos2), 1e-32))
    q1 = corner[0] - along * c_yaw + rig.yaw_offset * s_yaw + rig.yaw_link_1 * sin2
    return RigConfiguration(corner, sin4, cos4, sin2, cos2, q1)


def inverse(rig: Rig, target: Expression, roll: Expression, branch: Branch = HOME) -> tuple[Expression, Expression]:
    """Joints that hold a target with a given roll, (23)-(27).

    Args:
        target: (x, y, z, yaw, pitch) in world. Shape (5, 1), m and rad.
        roll: rad.
        branch: Which of the four joint sets.

    Returns:
        The joints, shape (6, 1), and the reach left, shape (2, 1): 1 - |sin q4| and 1 - |cos q2|. Where one of them is
        negative the pose is out of reach and the joints, though finite, do not hold it. q2 and q4 lie in (-pi, pi] and
        q3, q5 make up the yaw and pitch of the target, unless limits ask for another turn.
    """
    target, roll = expression(target), expression(roll)
    posture = configuration_at(rig, target, ca.cos(roll), ca.sin(roll), branch)
    return joints_of(rig, target, roll, posture), reach_of(posture)


def reach_of(posture: RigConfiguration) -> Expression:
    """1 - |sin q4| and 1 - |cos q2|, negative out of reach. Shape (2, 1)."""
    return ca.vertcat(1 - ca.fabs(posture.sin4), 1 - ca.fabs(posture.cos2))


def joints_of(rig: Rig, target: Expression, roll: Expression, posture: RigConfiguration) -> Expression:
    """Joint positions of a posture, each in the turn nearest to the middle of its limits. Shape (6, 1)."""
    q2 = ca.atan2(posture.sin2, posture.cos2)
    q4 = ca.atan2(posture.sin4, posture.cos4)
    angles = [q2, target[3] - q2 - np.pi / 2, q4, target[4] - q4 + np.pi / 2]
    for k, angle in enumerate(angles):
        if np.isfinite(rig.limit(k + 2, False)):
            angles[k] = in_nearest_turn(angle, rig.middle_and_half(k + 2)[0])
    return ca.vertcat(posture.q1, *angles, roll)


def in_nearest_turn(angle: Expression, middle: Expression) -> Expression:
    """The angle plus the whole turns that bring it nearest to `middle`, rad."""
    return angle - FULL_TURN * ca.floor((angle - middle) / FULL_TURN + 0.5)


def in_turn_after(angle: Expression, start: Expression) -> Expression:
    """The angle plus the least number of whole turns that bring it to `start` or beyond, rad."""
    return angle + FULL_TURN * ca.ceil((start - angle) / FULL_TURN)
