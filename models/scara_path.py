"""A SCARA arm along a smooth path: joints as functions of the distance, checked for reach, singular arms and limits."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import casadi as ca
import numpy as np

from models.errors import ModelError
from models.parts import Array, ArrayInput
from models.paths import SmoothPath
from models.scara import Elbow, Scara

__all__ = ["JointsAlong", "ScaraPath", "scara_along"]

CLEARANCE = 1e-3
"""m that the path keeps from both ends of the reach unless told otherwise."""
TILT = 1e-9
STEP = 0.3
"""Largest change (rad) of an angle between two entries of the table that tells its turn."""
ROUNDS = 40


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


def scara_along(scara: Scara, path: SmoothPath, elbow: Elbow = "left", *, clearance: float = CLEARANCE) -> ScaraPath:
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
    _check_reach(scara, path, clearance)
    rates = scara.inverse_rates(elbow)
    s = path.dense(8, 16)
    turn = path.turn(s)
    tilt = np.abs(turn.quaternion[:, 1:3]).max()
    if tilt > TILT:
        at = s[int(np.abs(turn.quaternion[:, 1:3]).max(axis=1).argmax())]
        raise ModelError(f"scara: the path tilts its tool at {at:g} m, a SCARA turns it about the vertical only")

    def raw(places: Array) -> Array:
        return np.array(rates.map(len(places))(*_poses(path, places))[0]).T

    q = raw(s)
    for _ in range(ROUNDS):
        change = np.diff(q, axis=0)
        change[:, [0, 1, 3]] = _wrapped(change[:, [0, 1, 3]])
        wide = np.flatnonzero((np.abs(change[:, [0, 1, 3]]) > STEP).any(axis=1))
        if not wide.size:
            break
        middle = (s[wide] + s[wide + 1]) / 2
        s, q = np.insert(s, wide + 1, middle), np.insert(q, wide + 1, raw(middle), axis=0)
    for joint in (0, 1, 3):
        q[:, joint] = np.unwrap(q[:, joint])
    return ScaraPath(scara, path, elbow, rates, (s, q), _turns(scara, s, q))


def _poses(path: SmoothPath, s: Array) -> list[Any]:
    place, turn = path.at(s), path.turn(s)
    yaw = 2 * np.arctan2(turn.quaternion[:, 3], turn.quaternion[:, 0])
    angular = (yaw, turn.rate[:, 2], turn.acceleration[:, 2], turn.jerk[:, 2])
    return [ca.DM(np.column_stack([linear, angle]).T) for linear, angle in zip(place, angular, strict=True)]


def _wrapped(angle: Array) -> Array:
    return np.asarray((angle + np.pi) % (2 * np.pi) - np.pi)


def _continuous(q: Array, s: Array, table_s: Array, table_q: Array) -> Array:
    """Angles of the turn that the table says."""
    for joint in (0, 1, 3):
        near = np.interp(s, table_s, table_q[:, joint])
        q[:, joint] += 2 * np.pi * np.round((near - q[:, joint]) / (2 * np.pi))
    return q


def _turns(scara: Scara, s: Array, q: Array) -> Array:
    """Whole turns to add to the joints so that they keep their limits. Shape (4,)."""
    turns = np.zeros(4)
    for joint, name in enumerate(scara.names):
        low, high = float(scara.lower[joint]), float(scara.upper[joint])
        choices = (0.0,) if joint == 2 else (0.0, 2 * np.pi, -2 * np.pi, 4 * np.pi, -4 * np.pi)
        least, most = float(q[:, joint].min()), float(q[:, joint].max())
        fitting = [turn for turn in choices if low <= least + turn and most + turn <= high]
        if not fitting:
            beyond = np.maximum(low - q[:, joint], q[:, joint] - high)
            at = int(beyond.argmax())
            raise ModelError(
                f"scara: joint {name!r} goes from {least:g} to {most:g} along the path, at {q[at, joint]:g} at "
                f"{s[at]:g} m, outside its limits {low:g} .. {high:g}; take the other elbow or move the path"
            )
        turns[joint] = fitting[0]
    return turns


def _check_reach(scara: Scara, path: SmoothPath, clearance: float) -> None:
    if not (np.isfinite(clearance) and clearance >= 0):
        raise ModelError(f"scara: clearance {clearance!r} m must not be negative")
    s = path.dense(8, 32)
    for sign, bound, arm in ((1.0, scara.outer, "stretched"), (-1.0, scara.inner, "folded")):
        at, radius = _extreme(scara, path, s, sign)
        where = f"path at {at:g} m, {path.at([at]).position[0].tolist()} m,"
        scara.check_reach(radius, where)
        if sign * (bound - radius) < clearance:
            what = "the singular column about the shoulder axis" if sign < 0 else "its greatest reach"
            raise ModelError(
                f"scara: {where} passes {abs(bound - radius):.3g} m from {what}, where the {arm} arm is singular and "
                f"joint rates grow without bound; keep {clearance:g} m away or lower the clearance"
            )


def _extreme(scara: Scara, path: SmoothPath, s: Array, sign: float) -> tuple[float, float]:
    """Place and size of the largest (sign 1) or smallest (-1) distance from the shoulder axis, between samples too."""

    def radius(places: Array) -> Array:
        return np.asarray(np.linalg.norm((path.at(places).position - scara.mount)[:, :2], axis=1))

    r = radius(s)
    padded = np.concatenate([[-np.inf], sign * r, [-np.inf]])
    peaks = np.flatnonzero((padded[1:-1] >= padded[:-2]) & (padded[1:-1] >= padded[2:]))
    # the radius changes by no more than the distance does: only peaks that may win are refined
    step = np.diff(s).max()
    peaks = peaks[sign * r[peaks] >= (sign * r).max() - step]
    best = (float(s[peaks[0]]), float(r[peaks[0]]))
    low, high = s[np.maximum(peaks - 1, 0)], s[np.minimum(peaks + 1, len(s) - 1)]
    fractions = np.linspace(0, 1, 17)
    for _ in range(9):
        places = low[:, None] + (high - low)[:, None] * fractions
        values = sign * radius(places.ravel()).reshape(places.shape)
        top = values.argmax(axis=1)
        row = np.arange(len(top))
        k = int(values[row, top].argmax())
        best = (float(places[k, top[k]]), float(sign * values[k, top[k]]))
        low, high = places[row, np.maximum(top - 1, 0)], places[row, np.minimum(top + 1, 16)]
    return best
