"""SCARA arms along smooth paths: joints as functions of arc length, checked for reach, singularities and limits."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import casadi as ca
import numpy as np

from models.arrays import Array, ArrayInput, checked_instance, checked_nonnegative
from models.errors import ModelError
from models.machines.scara import Elbow, Scara
from models.paths import SmoothPath
from models.spatial import FULL_TURN

__all__ = ["JointsAlong", "ScaraPath", "scara_along"]

ANGLES = [0, 1, 3]
"""Indices of the revolute joints."""


class JointsAlong(NamedTuple):
    """Joints along a path and their derivatives by arc length. Shape (M, 4) each, rad and m, per m, m^2, m^3."""

    position: Array
    first: Array
    second: Array
    third: Array


@dataclass(frozen=True, eq=False)
class ScaraPath:
    """Joints of a SCARA arm whose tool follows a path, from `scara_along`.

    Attributes:
        scara: The arm.
        path: Path of the tool.
        elbow: Side of the elbow along the whole path.
        rates: Function of the pose and its derivatives, see `Scara.inverse_rates`.
        table: Arc lengths (m) and continuous joints that resolve the turns. Shape (K,) and (K, 4).
        turns: Whole turns added to the joints so that they keep their limits. Shape (4,), rad.
    """

    scara: Scara
    path: SmoothPath
    elbow: Elbow
    rates: Any
    table: tuple[Array, Array]
    turns: Array

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the joints."""
        return self.scara.names

    def at(self, distance: ArrayInput) -> JointsAlong:
        """Return the joints, with continuous angles, and their derivatives at arc lengths. Shape (M,), m."""
        s = self.path.checked_distance(distance)
        values = [np.array(v).T for v in self.rates.map(len(s))(*_poses(self.path, s))]
        table_s, table_q = self.table
        for joint in ANGLES:  # make the angles continuous
            reference = np.interp(s, table_s, table_q[:, joint])
            values[0][:, joint] += FULL_TURN * np.round((reference - values[0][:, joint]) / FULL_TURN)
        values[0] = values[0] + self.turns
        return JointsAlong(*values)


def scara_along(scara: Scara, path: SmoothPath, elbow: Elbow = "left", *, clearance: float = 1e-3) -> ScaraPath:
    """Compute the joints of an arm along a path, with the elbow on one side.

    Args:
        scara: The arm.
        path: Path of the tool, which may rotate about the vertical only.
        elbow: "left" or "right".
        clearance: Least distance (m) from a stretched and a folded arm, where the joint rates are unbounded.

    Raises:
        ModelError: A path out of reach or within `clearance` of a singularity (the message says where); a tool that
            tilts; joint limits.
    """
    checked_instance(scara, Scara, "scara", "scara")
    checked_instance(path, SmoothPath, "scara", "path")
    checked_nonnegative(clearance, "scara", "clearance", "m")
    _check_reach(scara, path, clearance)
    rates = scara.inverse_rates(elbow)
    s = path.sample_distances(8, 16)
    turn = path.turn(s)
    tilt = np.abs(turn.quaternion[:, 1:3]).max(axis=1)
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
    """Return (x, y, z, yaw) and three derivatives at arc lengths of shape (M,). Shape (4, M) each."""
    position, orientation = path.at(s), path.turn(s)
    yaw = 2 * np.arctan2(orientation.quaternion[:, 3], orientation.quaternion[:, 0])
    angular = (yaw, orientation.rate[:, 2], orientation.acceleration[:, 2], orientation.jerk[:, 2])
    return [ca.DM(np.column_stack([linear, angle]).T) for linear, angle in zip(position, angular, strict=True)]


def _turns(joints_along: ScaraPath) -> Array:
    """Return the whole turns to add to the joints so that they keep their limits. Shape (4,), rad."""
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
    """Raise ModelError for a path out of reach, or too close to a singularity."""
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
    """Return place and value of the maximum (sign 1) or minimum (-1) of a function of arc length, also between samples.

    Args:
        function: Of arc lengths, shape (M,) to (M,).
        s, values: Samples that resolve it. Shape (K,).
        sign: 1 or -1.
    """
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
        best = max(
            best, (float(points[k, peak[k]]), float(sign * refined[k, peak[k]])), key=lambda pair: sign * pair[1]
        )
        low, high = points[row, np.maximum(peak - 1, 0)], points[row, np.minimum(peak + 1, 16)]
    return best
