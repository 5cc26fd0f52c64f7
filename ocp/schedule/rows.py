"""Every limit of a schedule as rows in the speed v, the acceleration a and the jerk j of the line, at places of a path.

    speed          k v <= 1
    acceleration   -1 <= p a + q v^2 + r <= 1
    jerk           |p j + q v a + r v^3| <= 1

Joint velocities, accelerations and jerks give (q'), (q', q'') and (q', 3 q'', q''') over their limits, centripetal
acceleration and the turn rate of the tool a speed, torques (m, b, c) of m(s) a + b(s) v^2 + c(s), and acceleration and
jerk of the tool those of its directions (`ToolLimits`).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ocp.schedule.limits import JointPath, LineLimits, PathLike, curvature_along, rates_along, tool_along, torques_along
from ocp.schedule.profile import Array, LineMotion
from ocp.schedule.settings import SETTINGS

__all__ = ["Rows", "causes", "rows_at", "torque_rows"]


class Rows(NamedTuple):
    """Limits at S places.

    Attributes:
        speed: Shape (S, K), s/m.
        acceleration: p, q and r of each row. Shape (S, L, 3).
        jerk: p, q and r of each row. Shape (S, P, 3).
    """

    speed: Array
    acceleration: Array
    jerk: Array

    def of(self, places: NDArray[np.intp] | slice) -> Rows:
        """Those at some of the places."""
        return Rows(self.speed[places], self.acceleration[places], self.jerk[places])

    def steady(self) -> tuple[Array, NDArray[np.intp]]:
        """Greatest steady speed (m/s) at each place, and the row of `causes` that limits it. Shape (S,) each."""
        with np.errstate(divide="ignore", invalid="ignore"):
            room = 1 - np.sign(self.acceleration[:, :, 1]) * self.acceleration[:, :, 2]
            speeds = np.concatenate(
                [
                    1 / self.speed,
                    np.sqrt(np.maximum(room, 0) / np.abs(self.acceleration[:, :, 1])),
                    np.cbrt(1 / np.abs(self.jerk[:, :, 2])),
                ],
                axis=1,
            )
        speeds[np.isnan(speeds)] = np.inf
        if not speeds.shape[1]:
            return np.full(len(speeds), np.inf), np.zeros(len(speeds), dtype=np.intp)
        return speeds.min(axis=1), speeds.argmin(axis=1)

    @property
    def total(self) -> int:
        """Of rows at a place."""
        return sum(kind.shape[1] for kind in self)

    def demands(self, motion: LineMotion) -> Array:
        """Each row of `causes` over its limit, with its sign, during a motion at these places. Shape (S, K + L + P)."""
        v, a, j = (value[:, None] for value in (motion.speed, motion.acceleration, motion.jerk))
        of_a, of_j = self.acceleration, self.jerk
        return np.concatenate(
            [
                self.speed * v,
                of_a[:, :, 0] * a + of_a[:, :, 1] * v**2 + of_a[:, :, 2],
                of_j[:, :, 0] * j + of_j[:, :, 1] * v * a + of_j[:, :, 2] * v**3,
            ],
            axis=1,
        )


def causes(limits: LineLimits, joints: JointPath | None) -> tuple[str, ...]:
    """What each row limits, in the order of `Rows.demands`."""
    return tuple(name for kind in _kinds(limits, joints) for name in kind)


def _kinds(limits: LineLimits, joints: JointPath | None) -> tuple[list[str], list[str], list[str]]:
    speed, acceleration, jerk = ["centripetal acceleration"], ["line acceleration"], []
    if np.isfinite(limits.jerk):
        jerk = ["line jerk"]
    if limits.tool is not None:
        speed += ["tool turn rate"]
        acceleration += [f"tool acceleration along {axis}" for axis in "xyz"]
        jerk += [f"tool jerk along {axis}" for axis in "xyz"]
    if joints is not None:
        names = joints.names
        speed += [f"joint {name!r} velocity" for name in names]
        acceleration += [f"joint {name!r} acceleration" for name in names]
        jerk += [f"joint {name!r} jerk" for name in names]
        if torque_rows(limits, joints):
            acceleration += [f"joint {name!r} torque" for name in names]
    return speed, acceleration, jerk


def torque_rows(limits: LineLimits, joints: JointPath | None) -> int:
    """Rows of acceleration that are torques: the last so many."""
    if joints is None or not np.isfinite(limits.torques(len(joints.names))).any():
        return 0
    return len(joints.names)


def rows_at(
    path: PathLike, limits: LineLimits, joints: JointPath | None, distance: Array, *, torques: bool = True
) -> Rows:
    """Rows of all limits at distances (S,) of a path, those of `causes`; zeros for torques that are not asked for.

    Raises:
        ProblemError: A curvature or joints that are not finite, as at a singular arm, or of a wrong shape.
    """
    if len(distance) <= SETTINGS.block:
        return _rows_at(path, limits, joints, distance, torques)
    # into memory that is there: the parts of a long path and the whole would be twice as much
    speed, acceleration, jerk = (len(kind) for kind in _kinds(limits, joints))
    shapes = ((speed,), (acceleration, 3), (jerk, 3))
    all_of_them = Rows(*(np.empty((len(distance), *shape)) for shape in shapes))
    for first in range(0, len(distance), SETTINGS.block):
        part = _rows_at(path, limits, joints, distance[first : first + SETTINGS.block], torques)
        for kind, own in zip(all_of_them, part, strict=True):
            kind[first : first + SETTINGS.block] = own
    return all_of_them


def _rows_at(path: PathLike, limits: LineLimits, joints: JointPath | None, s: Array, torques: bool) -> Rows:
    speed, acceleration, jerk = (np.zeros((len(s), len(kind), 3)) for kind in _kinds(limits, joints))
    if not s.size:
        return Rows(speed[:, :, 0], acceleration, jerk)
    if np.isfinite(limits.centripetal):
        speed[:, 0, 0] = np.sqrt(curvature_along(path, s) / limits.centripetal)
    acceleration[:, 0, 0] = 1 / limits.acceleration
    lines = int(np.isfinite(limits.jerk))
    jerk[:, :lines, 0] = 1 / limits.jerk
    k, m, p = 1, 1, lines
    if limits.tool is not None:
        tangent, bend, rate, turn = tool_along(path, s)
        speed[:, 1, 0] = np.linalg.norm(turn, axis=1) / limits.tool.turn_rate
        most, jerks = (np.broadcast_to(value, (3,)) for value in (limits.tool.acceleration, limits.tool.jerk))
        acceleration[:, 1:4, 0], acceleration[:, 1:4, 1] = tangent / most, bend / most
        jerk[:, p : p + 3] = np.stack([tangent, 3 * bend, rate], axis=2) / jerks[:, None]
        k, m, p = 2, 4, p + 3
    if joints is not None:
        n = len(joints.names)
        rates, (velocities, most, jerks) = rates_along(joints, s), limits.of_joints(n)
        first, second, third = (np.asarray(values, dtype=float) for values in (rates.first, rates.second, rates.third))
        speed[:, k:, 0] = np.abs(first) / velocities
        acceleration[:, m : m + n, 0], acceleration[:, m : m + n, 1] = first / most, second / most
        jerk[:, p:] = np.stack([first, 3 * second, third], axis=2) / jerks[:, None]
        if torques and torque_rows(limits, joints):
            along = torques_along(joints, s)
            values = np.stack([along.inertia, along.drag, along.rest], axis=2)
            acceleration[:, m + n :] = values / limits.torques(n)[:, None]
    return Rows(speed[:, :, 0], acceleration, jerk)
