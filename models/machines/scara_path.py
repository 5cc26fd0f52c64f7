"""A SCARA arm along a smooth path: joints as functions of the distance, checked for reach, singular arms and limits."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import casadi as ca
import numpy as np

from models.arrays import Array, ArrayInput, checked_instance, checked_nonnegative, checked_number
from models.errors import ModelError
from models.machines.scara import Elbow, Scara
from models.paths import SmoothPath
from models.spatial import FULL_TURN

__all__ = ["JointsAlong", "ScaraPath", "scara_along"]

ANGLES = [0, 1, 3]
"""The joints that turn."""


class JointsAlong(NamedTuple):
    """Joints along a path and their derivatives by the distance. Shape (M, 4) each, rad and m, per m, m^2, m^3."""

    position: Array
    first: Array
    second: Array
    third: Array


@dataclass(frozen=True, eq=False)
class ScaraPath:
    """Joints of an arm whose tool follows a path. Made by `scara_along`.

    Attributes:
        scara: The arm.
        path: The path of the tool.
        elbow: Which way it bends, all along.
    """

    scara: Scara
    path: SmoothPath
    elbow: Elbow
    rates: Any
    table: tuple[Array, Array]
    turns: Array

    @property
    def names(self) -> tuple[str, ...]:
        """Of the joints."""
        return self.scara.names

    def at(self, distance: ArrayInput) -> JointsAlong:
        """Joints and their derivatives at distances from the start. Shape (M,), m. Angles are continuous."""
        s = self.path.checked_distance(distance)
        values = [np.array(v).T for v in self.rates.map(len(s))(*_poses(self.path, s))]
        values[0] = _continuous(values[0], s, *self.table) + self.turns
        return JointsAlong(*values)


def scara_along(scara: Scara, path: SmoothPath, elbow: Elbow = "left", *, clearance: float = 1e-3) -> ScaraPath:
    """The arm along a path, its elbow bent one way.

    Args:
        scara: The arm.
        path: Of the tool, which may turn about the vertical only.
        elbow: "left" or "right".
        clearance: Distance (m) to keep from a stretched and a folded arm, where the joint rates have no bound.

    Raises:
        ModelError: A path out of reach, or within `clearance` of a singular arm (the message says where); a tool that
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

    def raw(places: Array) -> Array:
        return np.array(rates.map(len(places))(*_poses(path, places))[0]).T

    q = raw(s)
    for _ in range(40):
        change = np.diff(q[:, ANGLES], axis=0)
        wide = np.flatnonzero((np.abs((change + np.pi) % FULL_TURN - np.pi) > 0.3).any(axis=1))
        if not wide.size:
            break
        middle = (s[wide] + s[wide + 1]) / 2
        s, q = np.insert(s, wide + 1, middle), np.insert(q, wide + 1, raw(middle), axis=0)
    q[:, ANGLES] = np.unwrap(q[:, ANGLES], axis=0)
    along = ScaraPath(scara, path, elbow, rates, (s, q), np.zeros(4))
    return replace(along, turns=_turns(along))


def _poses(path: SmoothPath, s: Array) -> list[Any]:
    """(x, y, z, yaw) at distances (M,) and three derivatives by the distance. Shape (4, M) each."""
    place, turn = path.at(s), path.turn(s)
    yaw = 2 * np.arctan2(turn.quaternion[:, 3], turn.quaternion[:, 0])
    angular = (yaw, turn.rate[:, 2], turn.acceleration[:, 2], turn.jerk[:, 2])
    return [ca.DM(np.column_stack([linear, angle]).T) for linear, angle in zip(place, angular, strict=True)]


def _continuous(q: Array, s: Array, table_s: Array, table_q: Array) -> Array:
    """Angles of the turn that the table says."""
    for joint in ANGLES:
        near = np.interp(s, table_s, table_q[:, joint])
        q[:, joint] += FULL_TURN * np.round((near - q[:, joint]) / FULL_TURN)
    return q


def _turns(along: ScaraPath) -> Array:
    """Whole turns to add to the joints so that they keep their limits. Shape (4,)."""
    turns, scara, (s, q) = np.zeros(4), along.scara, along.table
    for joint, (name, low, high) in enumerate(zip(scara.names, scara.lower, scara.upper, strict=True)):
        if np.isneginf(low) and np.isposinf(high):
            continue

        def one(places: Array, joint: int = joint) -> Array:
            return along.at(places).position[:, joint]

        ends = [_extreme(one, s, q[:, joint], sign) for sign in (-1.0, 1.0)]
        least, most = ends[0][1], ends[1][1]
        turn = scara.whole_turn(joint, least, most)
        if turn is None:
            at, value = max(ends, key=lambda end: max(low - end[1], end[1] - high))
            message = (
                f"scara: joint {name!r} goes from {least:g} to {most:g} along the path, at {value:g} at "
                f"{at:g} m, outside its limits {low:g} .. {high:g}; take the other elbow or move the path"
            )
            raise ModelError(message, name=name, value=value, limit=(low, high))
        turns[joint] = turn
    return turns


def _check_reach(scara: Scara, path: SmoothPath, clearance: float) -> None:
    """Refuse a path beyond the reach, or too near to its ends."""
    if checked_number(clearance, "scara", "clearance") < 0:
        raise ModelError(f"scara: clearance {clearance!r} m is negative", name="clearance", value=clearance, limit=0.0)
    s = path.sample_distances(8, 32)

    def radius(places: Array) -> Array:
        return np.asarray(np.linalg.norm((path.at(places).position - scara.mount)[:, :2], axis=1))

    r = radius(s)
    for sign, bound, arm in ((1.0, scara.outer, "stretched"), (-1.0, scara.inner, "folded")):
        at, extreme = _extreme(radius, s, r, sign)
        where = f"path at {at:g} m, {path.at([at]).position[0].tolist()} m,"
        scara.check_reach(extreme, where)
        if sign * (bound - extreme) < clearance:
            what = "the singular column about the shoulder axis" if sign < 0 else "its greatest reach"
            message = (
                f"scara: {where} passes {abs(bound - extreme):.3g} m from {what}, where the {arm} arm is singular and "
                f"joint rates grow without bound; keep {clearance:g} m away or lower the clearance"
            )
            raise ModelError(message, name="path", value=abs(bound - extreme), limit=clearance)


def _extreme(function: Callable[[Array], Array], s: Array, values: Array, sign: float) -> tuple[float, float]:
    """Place and size of the largest (sign 1) or smallest (-1) value of a function of the distance, between samples too.

    Args:
        function: Of distances, shape (M,) to (M,).
        s, values: Samples that resolve it. Shape (K,).
        sign: 1 or -1.
    """
    padded = np.concatenate([[-np.inf], sign * values, [-np.inf]])
    peaks = np.flatnonzero((padded[1:-1] >= padded[:-2]) & (padded[1:-1] >= padded[2:]))
    # a peak that the samples resolve rises above them by less than they differ from their neighbours
    change = np.pad(np.abs(np.diff(values)), 1)
    peaks = peaks[sign * values[peaks] + (change[:-1] + change[1:])[peaks] >= (sign * values).max()]
    best = (float(s[peaks[0]]), float(values[peaks[0]]))
    low, high = s[np.maximum(peaks - 1, 0)], s[np.minimum(peaks + 1, len(s) - 1)]
    fractions = np.linspace(0, 1, 17)
    for _ in range(9):
        places = low[:, None] + (high - low)[:, None] * fractions
        inside = sign * function(places.ravel()).reshape(places.shape)
        top = inside.argmax(axis=1)
        row = np.arange(len(top))
        k = int(inside[row, top].argmax())
        best = max(best, (float(places[k, top[k]]), float(sign * inside[k, top[k]])), key=lambda pair: sign * pair[1])
        low, high = places[row, np.maximum(top - 1, 0)], places[row, np.minimum(top + 1, 16)]
    return best
