"""SCARA arms, and their joint positions along smooth paths of the tool.

A SCARA arm has two parallel links in a horizontal plane, a quill and a wrist about the same vertical direction. Its
joint vector is (shoulder, elbow, quill, wrist): rad, rad, m, rad. In the frame of the mount

    x = l1 cos q1 + l2 cos(q1 + q2),  y likewise,  z = q3,  yaw = q1 + q2 + q4.

The determinant of the planar Jacobian is l1 l2 sin q2: the arm is singular when stretched (reach l1 + l2) or folded
(|l1 - l2|, the shoulder axis if both links are equal).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Literal, NamedTuple, TypeAlias, get_args

import casadi as ca
import numpy as np

from models.checks import Array, ArrayInput, require, set_fields, warn_of_degrees, warn_of_millimetres
from models.errors import ModelError
from models.paths import SmoothPath
from models.robot.kinematics import checked_vector
from models.robot.parts import Joint, Link
from models.robot.robot import Robot
from models.spatial import FULL_TURN, Expression, Frame, rotation

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
            length = require.positive(f"scara: {field}", getattr(self, field), unit="m")
            set_fields(self, **{field: length})
            warn_of_millimetres(f"scara: {field}", length)
        set_fields(self, mount=require.array("scara: mount", self.mount, (3,)))
        for field in ("lower", "upper"):
            set_fields(self, **{field: require.array(f"scara: {field}", getattr(self, field), (4,), entries="numbers")})
        names = () if isinstance(self.names, str) else require.each("scara: names", self.names, str)
        if len(set(names) - {""}) != 4 or len(names) != 4:
            message = f"scara: joint names {list(self.names)} must be four that differ"
            raise ModelError(message, name="names", value=self.names)
        for name, low, high in zip(self.names, self.lower, self.upper, strict=True):
            if low > high or low == np.inf or high == -np.inf:
                message = f"scara: joint {name!r} has limits {low:g} .. {high:g}, which leave it no position"
                raise ModelError(message, name=name, value=low, limit=high)
        for joint, name in enumerate(self.names):
            if joint != QUILL:
                warn_of_degrees(f"scara: limit of {name!r}", (self.lower[joint], self.upper[joint]), name)

    @property
    def outer(self) -> float:
        """Largest distance of the arm's tool from its shoulder axis, m."""
        return self.upper_arm + self.forearm

    @property
    def inner(self) -> float:
        """Smallest distance of the arm's tool from its shoulder axis, m."""
        return abs(self.upper_arm - self.forearm)

    @cached_property
    def robot(self) -> Robot:
        """Kinematic tree of the arm, whose links have no mass."""
        links = tuple(Link(name) for name in ("base", "upper arm", "forearm", "quill", "tool"))
        origins = (tuple(self.mount), (self.upper_arm, 0.0, 0.0), (self.forearm, 0.0, 0.0), (0.0, 0.0, 0.0))
        kinds: tuple[Any, ...] = ("revolute", "revolute", "prismatic", "revolute")
        joints = []
        for i, (name, kind) in enumerate(zip(self.names, kinds, strict=True)):
            ends = links[i].name, links[i + 1].name
            joints.append(Joint(name, kind, *ends, origins[i], lower=self.lower[i], upper=self.upper[i]))
        return Robot(links, tuple(joints))

    def forward(self, joints: Expression) -> Frame:
        """Return the pose of the tool in the world for joint positions, numbers or a CasADi matrix of shape (4,)."""
        q = checked_vector("joints", joints, 4, f"one entry for each of {list(self.names)}")
        bend = q[0] + q[1]
        x = self.upper_arm * ca.cos(q[0]) + self.forearm * ca.cos(bend)
        y = self.upper_arm * ca.sin(q[0]) + self.forearm * ca.sin(bend)
        return Frame(rotation((0, 0, 1), bend + q[3]), ca.DM(self.mount) + ca.vertcat(x, y, q[2]))

    def inverse(self, position: ArrayInput, yaw: float = 0.0, elbow: Elbow = "left") -> Array:
        """Return the joint positions that put the tool at a given point with a given yaw. Shape (4,).

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
        point = require.array("scara: position", position, (3,))
        angle = require.number("scara: yaw", yaw)
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
        """Return the multiple of 2 pi (0 for the quill) that shifts the range `least` to `most` into a joint's limits.

        Return None if no multiple does; the tolerance is 1e-9 rad or m.
        """
        low, high = float(self.lower[joint]) - 1e-9, float(self.upper[joint]) + 1e-9
        turn = 0.0
        if joint != QUILL and least < low:
            turn = FULL_TURN * float(np.ceil((low - least) / FULL_TURN))
        elif joint != QUILL and most > high:
            turn = -FULL_TURN * float(np.ceil((most - high) / FULL_TURN))
        return turn if low <= least + turn and most + turn <= high else None

    def inverse_expression(self, pose: Expression, elbow: Elbow = "left") -> Expression:
        """Return closed-form joint positions of the arm for a tool pose (x, y, z, yaw) in the world. Shape (4, 1).

        Reach and limits are not checked. sin q2 is computed from the product of the distances to both ends of the
        reach, which is accurate near them.
        """
        require.choice("scara: elbow", elbow, get_args(Elbow))
        p = checked_vector("pose", pose, 4, "x, y, z and yaw")
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
        """Return the CasADi Function from tool pose and three derivatives to joint positions and three derivatives."""
        inputs = [ca.SX.sym(name, 4) for name in ("pose", "first", "second", "third")]
        at = ca.SX.sym("at")
        pose = inputs[0] + at * (inputs[1] + at * (inputs[2] / 2 + at * inputs[3] / 6))
        outputs = [self.inverse_expression(pose, elbow)]
        for _ in range(3):
            outputs.append(ca.jacobian(outputs[-1], at))
        here = ca.substitute(outputs, [at], [ca.SX(0)])
        return ca.Function("inverse_rates", inputs, ca.cse([ca.densify(ca.simplify(value)) for value in here]))

    def check_reach(self, radius: float, place: str) -> None:
        """Raise ModelError naming `place` unless the arm reaches the distance `radius` (m) from its shoulder axis."""
        if not self.inner * (1 - 1e-12) <= radius <= self.outer * (1 + 1e-12):
            message = (
                f"scara: {place} is {radius:g} m from the shoulder axis, unreachable: the arm reaches from "
                f"{self.inner:g} to {self.outer:g} m"
            )
            raise ModelError(message, name="radius", value=radius, limit=(self.inner, self.outer))


ANGLES = [0, 1, 3]
"""Indices of the revolute joints of a SCARA arm."""


class JointsAlong(NamedTuple):
    """Joint positions at M points of a path, with three derivatives with respect to arc length. Shape (M, 4) each."""

    position: Array
    first: Array
    second: Array
    third: Array


@dataclass(frozen=True, eq=False)
class ScaraPath:
    """Joint positions of a SCARA arm along a path of its tool, computed by `scara_along`."""

    scara: Scara  # the arm
    path: SmoothPath  # path of the tool
    elbow: Elbow  # side of the elbow along the whole path
    rates: Any  # function of the pose and its derivatives, see `Scara.inverse_rates`
    table: tuple[Array, Array]  # arc lengths (K,), m, and continuous joints (K, 4), dense enough to tell turns
    turns: Array  # whole turns added to the joints so that they keep their limits. Shape (4,), rad.

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the arm's joints."""
        return self.scara.names

    def at(self, distance: ArrayInput) -> JointsAlong:
        """Return joint positions with continuous angles, and three derivatives, at M arc lengths (m) along the path."""
        s = self.path.checked_distance(distance)
        values = [np.array(v).T for v in self.rates.map(len(s))(*_poses(self.path, s))]
        table_s, table_q = self.table
        for joint in ANGLES:  # make the angles continuous
            reference = np.interp(s, table_s, table_q[:, joint])
            values[0][:, joint] += FULL_TURN * np.round((reference - values[0][:, joint]) / FULL_TURN)
        values[0] = values[0] + self.turns
        return JointsAlong(*values)


def scara_along(scara: Scara, path: SmoothPath, elbow: Elbow = "left", *, clearance: float = 1e-3) -> ScaraPath:
    """Compute the joint positions of a SCARA arm along a path of its tool, keeping the elbow on one side.

    Args:
        path: Path of the tool, which may rotate about the vertical only.
        elbow: "left" or "right".
        clearance: Least distance (m) from a stretched and a folded arm, where the joint rates are unbounded.

    Raises:
        ModelError: A path out of reach or within `clearance` of a singularity (the message says where); a tool that
            tilts; joint limits.
    """
    require.instance("scara: scara", scara, Scara)
    require.instance("scara: path", path, SmoothPath)
    require.nonnegative("scara: clearance", clearance, unit="m")
    _check_reach(scara, path, clearance)
    rates = scara.inverse_rates(elbow)
    s = path.sample_distances(8, 16)
    tilt = np.abs(path.turn(s).quaternion[:, 1:3]).max(axis=1)
    if tilt.max() > 1e-9:
        at = s[int(tilt.argmax())]
        message = f"scara: the path tilts its tool at {at:g} m, a SCARA turns it about the vertical only"
        raise ModelError(message, name="path", value=float(tilt.max()), limit=1e-9)

    def inverse(lengths: Array) -> Array:
        return np.array(rates.map(len(lengths))(*_poses(path, lengths))[0]).T

    q = inverse(s)
    for _ in range(40):
        change = np.diff(q[:, ANGLES], axis=0)
        coarse = np.flatnonzero((np.abs((change + np.pi) % FULL_TURN - np.pi) > 0.3).any(axis=1))
        if not coarse.size:
            break
        middle = (s[coarse] + s[coarse + 1]) / 2
        s, q = np.insert(s, coarse + 1, middle), np.insert(q, coarse + 1, inverse(middle), axis=0)
    q[:, ANGLES] = np.unwrap(q[:, ANGLES], axis=0)
    result = ScaraPath(scara, path, elbow, rates, (s, q), np.zeros(4))
    return replace(result, turns=_turns(result))


def _poses(path: SmoothPath, s: Array) -> list[Any]:
    """Return the tool poses (x, y, z, yaw) at M arc lengths of a path, with three derivatives. Shape (4, M) each."""
    position, orientation = path.at(s), path.turn(s)
    yaw = 2 * np.arctan2(orientation.quaternion[:, 3], orientation.quaternion[:, 0])
    angular = (yaw, orientation.rate[:, 2], orientation.acceleration[:, 2], orientation.jerk[:, 2])
    return [ca.DM(np.column_stack([linear, angle]).T) for linear, angle in zip(position, angular, strict=True)]


def _turns(joints_along: ScaraPath) -> Array:
    """Return the multiples of 2 pi that bring joint positions along a path into the joint limits. Shape (4,), rad."""
    turns, scara, (s, q) = np.zeros(4), joints_along.scara, joints_along.table
    for joint, (name, low, high) in enumerate(zip(scara.names, scara.lower, scara.upper, strict=True)):
        if np.isneginf(low) and np.isposinf(high):
            continue

        def joint_at(lengths: Array, joint: int = joint) -> Array:
            return joints_along.at(lengths).position[:, joint]

        ends = [_extreme(joint_at, s, q[:, joint], sign) for sign in (-1.0, 1.0)]
        smallest, largest = ends[0][1], ends[1][1]
        turn = scara.whole_turn(joint, smallest, largest)
        if turn is None:
            at, value = max(ends, key=lambda end: max(low - end[1], end[1] - high))
            message = (
                f"scara: joint {name!r} goes from {smallest:g} to {largest:g} along the path, at {value:g} at "
                f"{at:g} m, outside its limits {low:g} .. {high:g}; take the other elbow or move the path"
            )
            raise ModelError(message, name=name, value=value, limit=(low, high))
        turns[joint] = turn
    return turns


def _check_reach(scara: Scara, path: SmoothPath, clearance: float) -> None:
    """Raise ModelError if a path is out of the arm's reach or too close to a singularity."""
    s = path.sample_distances(8, 32)

    def radius(lengths: Array) -> Array:
        return np.asarray(np.linalg.norm((path.at(lengths).position - scara.mount)[:, :2], axis=1))

    r = radius(s)
    for sign, bound, arm in ((1.0, scara.outer, "stretched"), (-1.0, scara.inner, "folded")):
        at, extreme = _extreme(radius, s, r, sign)
        place = f"path at {at:g} m, {path.at([at]).position[0].tolist()} m,"
        scara.check_reach(extreme, place)
        if sign * (bound - extreme) < clearance:
            boundary = "the singular column about the shoulder axis" if sign < 0 else "its greatest reach"
            message = (
                f"scara: {place} passes {abs(bound - extreme):.3g} m from {boundary}, where the {arm} arm is singular "
                f"and joint rates grow without bound; keep {clearance:g} m away or lower the clearance"
            )
            raise ModelError(message, name="path", value=abs(bound - extreme), limit=clearance)


def _extreme(function: Callable[[Array], Array], s: Array, values: Array, sign: float) -> tuple[float, float]:
    """Return the arc length at which a sampled function is largest (`sign` 1) or smallest (-1), and the value there."""
    padded = np.concatenate([[-np.inf], sign * values, [-np.inf]])
    peaks = np.flatnonzero((padded[1:-1] >= padded[:-2]) & (padded[1:-1] >= padded[2:]))
    # a resolved peak exceeds its sample by less than the sample differs from its neighbours
    change = np.pad(np.abs(np.diff(values)), 1)
    peaks = peaks[sign * values[peaks] + (change[:-1] + change[1:])[peaks] >= (sign * values).max()]
    best = (float(s[peaks[0]]), float(values[peaks[0]]))
    low, high = s[np.maximum(peaks - 1, 0)], s[np.minimum(peaks + 1, len(s) - 1)]
    fractions = np.linspace(0, 1, 17)
    for _ in range(9):
        points = low[:, None] + (high - low)[:, None] * fractions
        refined = sign * function(points.ravel()).reshape(points.shape)
        peak = refined.argmax(axis=1)
        row = np.arange(len(peak))
        k = int(refined[row, peak].argmax())
        refined_peak = float(points[k, peak[k]]), float(sign * refined[k, peak[k]])
        best = max(best, refined_peak, key=lambda pair: sign * pair[1])
        low, high = points[row, np.maximum(peak - 1, 0)], points[row, np.minimum(peak + 1, 16)]
    return best
