"""The maximum velocity curve of a path: the line speed that its limits permit, on a grid that resolves it.

It leaves line acceleration aside: a steady speed below it keeps the limits of centripetal acceleration and of the
joints. The grid is fine where the curve changes and near its minima.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ocp.errors import ProblemError
from ocp.schedule.limits import JointPath, LineLimits, PathLike, curvature_along, line_demands, rates_along
from ocp.schedule.profile import Array, piece_of

__all__ = ["Grid", "make_grid"]

KEPT_BACK = 2e-4
"""Share of the permitted speed kept back for what lies between two points of the grid."""
MINIMUM_ERROR = 2e-4
"""Largest relative error of a minimum of the permitted speed, estimated by its second difference."""
LARGEST_CHANGE = 0.1
"""Largest relative change of it between two points; the lower one counts for what lies between."""
HALVINGS = 12
"""Of an interval, at most."""
SMALLEST_INTERVAL = 1e-12
"""Intervals below this share of the path are not cut further."""
JUST_BEFORE = 1e-9
"""What "just before" means, over the length of the path."""
PER_CELL, PER_SEGMENT = 8, 64
"""Points of the first grid."""


class Grid(NamedTuple):
    """The speed that the limits permit, line acceleration aside, at points of a path.

    Attributes:
        distance: Every bound between pieces is among them. Shape (G,), m.
        permitted: Shape (G,), m/s; inf where nothing limits it.
        cause: Row of `cause_names` that limits it most. Shape (G,).
        asked: In each interval. Shape (G - 1,), m/s.
        before: Places just before the bounds between pieces, where a third derivative may be another. Shape (B,), m.
    """

    distance: Array
    permitted: Array
    cause: NDArray[np.intp]
    asked: Array
    before: Array


def make_grid(path: PathLike, limits: LineLimits, joints: JointPath | None) -> Grid:
    """Sample the permitted speed until neighbours agree, where it matters.

    Raises:
        ProblemError: A joint limit that no speed can keep, because the path's curvature jumps.
    """
    asked, bounds = path.by_piece(limits.speed), np.asarray(path.bounds, dtype=float)
    limited = joints if limits.joints is not None else None
    if limited is None and not np.isfinite(limits.centripetal):
        return Grid(bounds, np.full(len(bounds), np.inf), np.zeros(len(bounds), dtype=np.intp), asked, bounds[:0])
    if limited is not None:
        _check_smooth(path, limits, len(limited.names))
    s = np.unique(np.concatenate([path.dense(PER_CELL, PER_SEGMENT if limited is not None else 2), bounds]))
    permitted, cause = _permitted(path, limits, limited, s)
    inner = bounds[1:-1]
    before = inner - np.minimum(JUST_BEFORE * path.length, np.diff(bounds)[:-1] / 2)
    if before.size:
        left, why = _permitted(path, limits, limited, before)
        at = np.searchsorted(s, inner)
        cause[at] = np.where(left < permitted[at], why, cause[at])
        permitted[at] = np.minimum(left, permitted[at])
    for _ in range(HALVINGS):
        cut = np.flatnonzero(_uneven(path, s, permitted, asked))
        if not cut.size:
            break
        middle = (s[cut] + s[cut + 1]) / 2
        more, why = _permitted(path, limits, limited, middle)
        s = np.insert(s, cut + 1, middle)
        permitted, cause = np.insert(permitted, cut + 1, more), np.insert(cause, cut + 1, why)
    return Grid(s, permitted * (1 - KEPT_BACK), cause, _asked(path, s, asked), before)


def _permitted(
    path: PathLike, limits: LineLimits, joints: JointPath | None, s: Array
) -> tuple[Array, NDArray[np.intp]]:
    """Greatest steady speed at distances (M,), and the row of `cause_names` that limits it."""
    curvature = curvature_along(path, s) if np.isfinite(limits.centripetal) else None
    demand, power = line_demands(limits, curvature, None if joints is None else rates_along(joints, s))
    with np.errstate(divide="ignore"):
        speeds = (1 / demand) ** (1 / power[:, None])
    return speeds.min(axis=0), speeds.argmin(axis=0)


def _asked(path: PathLike, s: Array, asked: Array) -> Array:
    """Asked speed in each interval of a grid, from that of the pieces."""
    return np.asarray(asked[piece_of(path.bounds, (s[:-1] + s[1:]) / 2)])


def _uneven(path: PathLike, s: Array, permitted: Array, asked: Array) -> NDArray[np.bool_]:
    """Which intervals do not resolve the permitted speed, where that is near or below the asked one."""
    low = np.minimum(permitted[:-1], permitted[1:])
    matters = (low < 1.1 * _asked(path, s, asked)) & (np.diff(s) > SMALLEST_INTERVAL * path.length)
    value = np.log(np.minimum(permitted, 2 * asked.max()))
    step, slope = np.diff(s), np.diff(value) / np.diff(s)
    bend = np.zeros(len(s))
    bend[1:-1] = 2 * np.abs(np.diff(slope)) / (step[:-1] + step[1:])
    least = np.zeros(len(s), dtype=bool)
    least[1:-1] = (slope[:-1] <= 0) & (slope[1:] >= 0) & (bend[1:-1] > 0)
    error = np.where(least[:-1] | least[1:], step**2 / 8 * np.maximum(bend[:-1], bend[1:]), 0.0)
    return np.asarray(matters & ((np.abs(np.diff(value)) > LARGEST_CHANGE) | (error > MINIMUM_ERROR)))


def _check_smooth(path: PathLike, limits: LineLimits, count: int) -> None:
    """Refuse limits of joint jerk on a path whose curvature jumps."""
    if not np.isfinite(limits.of_joints(count)[2]).any():
        return
    jumps = path.curvature_jumps()
    if not jumps.size:
        return
    at = int(jumps.argmax())
    if jumps[at] > 1e-9 * (1 + float(path.curvature(path.bounds).max())):
        place, jump = float(path.bounds[at + 1]), float(jumps[at])
        message = (
            f"a joint jerk limit cannot be kept at {place:g} m, where the path's curvature jumps by "
            f"{jump:.3g} /m and the joint accelerations with it; round the corners with kind='quintic'"
        )
        raise ProblemError(message, name="curvature", value=jump, time=place)
