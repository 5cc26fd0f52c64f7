"""Nodes along a path that resolve its limits, and the limits there as rows.

The bounds between pieces are nodes. Intervals are halved until every row's demand at the fastest steady speed changes
evenly from node to node, and are short enough for the jerk to change at the right time: a part of the time that the
acceleration takes to build up. Towards rest, where v ~ s^(2/3), they shrink in proportion to the distance.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ocp.errors import ProblemError
from ocp.schedule.limits import JointPath, LineLimits, PathLike, check_smooth
from ocp.schedule.profile import Array, piece_of
from ocp.schedule.rows import Rows, causes, rows_at

__all__ = ["Grid", "make_grid", "nodes_only", "reach"]

UNEVEN, UNEVEN_SPEED = 0.1, 0.005
"""Largest error of a demand between two nodes, over its limit, when it is taken as even; of the rows of speed, too."""
HALVINGS = 8
JUST_BEFORE = 1e-9
"""What "just before" means, over the length of the path."""
SHORTEST = 1e-7
"""Pieces shorter than this share of the path count with the next."""
CLOSE = 0.05
"""Ratio of neighbouring intervals below which their node goes, unless pieces meet there."""
PER_CELL, PER_PATH = 4, 64
"""Intervals of the first grid in each cell of a blend, and on all segments together at least."""
OF_BUILD_UP = 0.3
"""Duration of an interval over the time in which the acceleration builds up..."""
OF_RAMP = 1 / 30
"""...or over the time in which the top speed is reached, if that is more."""
OF_TURN = 0.25
"""...but no more of that time than this: the speed must not change much in an interval."""
GROWTH = 1.2
"""Ratio of neighbouring distances from rest."""
FIRST = 0.3
"""Duration of the first and last interval, of constant jerk, over that of the build-up."""


@dataclass(frozen=True, eq=False)
class Grid:
    """Limits at nodes.

    Attributes:
        distance: Of the nodes, from 0 to the path's length. Shape (N + 1,), m.
        asked: Speed in each interval. Shape (N,), m/s.
        rows: At the nodes, just after them where they jump. Shape (N + 1,).
        middle: Rows of speed in the middle of each interval. Shape (N, K).
        jumps: Nodes where the path's pieces meet. Shape (B,).
        before: Rows just before these. Shape (B,).
    """

    distance: Array
    asked: Array
    rows: Rows
    middle: Array
    jumps: NDArray[np.intp]
    before: Rows

    def ends(self) -> tuple[Rows, Rows]:
        """Rows at the first and at the last place of each interval. Shape (N,) each."""
        last = Rows(*(kind[1:].copy() for kind in self.rows))
        for kind, before in zip(last, self.before, strict=True):
            kind[self.jumps - 1] = before
        return self.rows.of(slice(-1)), last


def make_grid(path: PathLike, limits: LineLimits, joints: JointPath | None) -> Grid:
    """Nodes and rows of a path.

    Args:
        path, limits: Of the schedule.
        joints: None where none are limited.

    Raises:
        ProblemError: A jerk limit that no speed can keep, because the path's curvature jumps; a singular arm.
    """
    check_smooth(path, limits, joints)
    asked, bounds = path.by_piece(limits.speed), np.asarray(path.bounds, dtype=float)
    # a piece that is next to nothing has no interval of its own
    some = np.concatenate([[True], np.diff(bounds)[:-1] > SHORTEST * path.length, [True]])
    some[-2] &= len(bounds) == 2 or bounds[-1] - bounds[-2] > SHORTEST * path.length
    nodes = bounds[some]
    s = _apart(np.concatenate([path.dense(PER_CELL, max(1, PER_PATH // len(bounds))), nodes]), nodes)
    rows = rows_at(path, limits, joints, s)
    _check_rest(rows, s, causes(limits, joints))
    for _ in range(HALVINGS):
        top = _top(rows, s, bounds, asked)
        middle = (s[:-1] + s[1:]) / 2
        between = rows_at(path, limits, joints, middle)
        wide = np.flatnonzero(_uneven(rows, between, top) & (np.diff(s) > SHORTEST * path.length))
        if not wide.size:
            break
        s = np.insert(s, wide + 1, middle[wide])
        rows = Rows(*(np.insert(a, wide + 1, b[wide], axis=0) for a, b in zip(rows, between, strict=True)))
    s = _apart(np.concatenate([_in_time(s, rows, _top(rows, s, bounds, asked)), nodes]), nodes)
    rows = rows_at(path, limits, joints, s)
    inner = nodes[1:-1]
    before = inner - np.minimum(JUST_BEFORE * path.length, np.diff(nodes)[:-1] / 2)
    jumps = np.searchsorted(s, inner)
    of_interval = np.asarray(asked[piece_of(bounds, (s[:-1] + s[1:]) / 2)])
    middle = rows_at(path, limits, joints, (s[:-1] + s[1:]) / 2).speed
    return Grid(s, of_interval, rows, middle, jumps, rows_at(path, limits, joints, before))


def nodes_only(path: PathLike, limits: LineLimits) -> Grid:
    """Rows at the first nodes of a path, none halved: enough to say where the line binds."""
    bounds = np.asarray(path.bounds, dtype=float)
    s = np.unique(np.concatenate([path.dense(PER_CELL, 1), bounds]))
    rows = rows_at(path, limits, None, s)
    asked = np.asarray(path.by_piece(limits.speed)[piece_of(bounds, (s[:-1] + s[1:]) / 2)])
    none = np.zeros(0, dtype=np.intp)
    return Grid(s, asked, rows, rows.speed[:-1], none, rows.of(none))


def _check_rest(rows: Rows, s: Array, names: tuple[str, ...]) -> None:
    """Refuse what breaks a limit at rest: a torque that does not hold the load."""
    rest = np.abs(rows.acceleration[:, :, 2])
    at, row = np.unravel_index(int(rest.argmax()), rest.shape)
    if rest[at, row] >= 1:
        place, need, cause = float(s[at]), float(rest[at, row]), names[rows.speed.shape[1] + int(row)]
        message = f"{cause} does not hold the load at {place:g} m, it takes {need:.3g} times the limit; raise it"
        raise ProblemError(message, name=cause, value=need, limit=1.0, time=place)


def _apart(places: Array, nodes: Array) -> Array:
    """Places in order, without those that all but fall on one of the nodes or on one another."""
    s = np.unique(places)
    for _ in range(3):
        gap = np.diff(s)
        beside = np.maximum(np.append(gap, 0.0), np.insert(gap, 0, 0.0))
        near = np.minimum(np.append(gap, np.inf), np.insert(gap, 0, np.inf)) < CLOSE * beside
        near &= ~np.isin(s, nodes)
        near[1:] &= ~near[:-1]  # of two that are close one stays
        if not near.any():
            break
        s = s[~near]
    return s


def _top(rows: Rows, s: Array, bounds: Array, asked: Array) -> Array:
    """Fastest steady speed in each interval, m/s."""
    steady = rows.steady()[0]
    return np.asarray(np.minimum(np.minimum(steady[:-1], steady[1:]), asked[piece_of(bounds, (s[:-1] + s[1:]) / 2)]))


def _uneven(rows: Rows, between: Rows, top: Array) -> NDArray[np.bool_]:
    """Which intervals' middles differ from what their ends say, at the top speed. Shape (N,)."""
    wide = np.zeros(len(top), dtype=bool)
    kinds = zip(
        (rows.speed, rows.acceleration[:, :, 1], rows.jerk[:, :, 2]),
        (between.speed, between.acceleration[:, :, 1], between.jerk[:, :, 2]),
        (UNEVEN_SPEED, UNEVEN, UNEVEN),
        strict=True,
    )
    for power, (at, middle, most) in enumerate(kinds, start=1):
        bent = np.abs(middle - (at[:-1] + at[1:]) / 2) * top[:, None] ** power
        wide |= bent.max(axis=1, initial=0.0) > most
    return wide


def reach(distance: Array, caps: Array, left: Rows, right: Rows, at_rest: tuple[bool, bool]) -> tuple[Array, Array]:
    """Squared speeds that no motion exceeds, and accelerations of the line that none exceeds.

    Args:
        distance: Nodes. Shape (N + 1,), m.
        caps: Greatest squared speed at each. Shape (N + 1,).
        left, right: Rows at both ends of each interval. Shape (N,).
        at_rest: Whether the motion begins and ends at rest.

    Returns:
        Squared speeds at the nodes (N + 1,), accelerations in the intervals (N,).
    """
    rates = np.full(len(distance) - 1, np.inf)
    for side, most in ((left, caps[:-1]), (right, caps[1:])):
        of = np.abs(side.acceleration)
        with np.errstate(divide="ignore", invalid="ignore"):
            one = (1 + of[:, :, 1] * most[:, None] + of[:, :, 2]) / of[:, :, 0]
        rates = np.minimum(rates, np.where(of[:, :, 0] > 0, one, np.inf).min(axis=1, initial=np.inf))
    gain = np.concatenate([[0.0], np.cumsum(2 * rates * np.diff(distance))])
    up = caps.copy()
    up[[i for i, rest in zip((0, -1), at_rest, strict=True) if rest]] = 0.0
    up = np.minimum.accumulate(up - gain) + gain
    up = np.minimum.accumulate((up + gain)[::-1])[::-1] - gain
    return np.maximum(up, 0.0), rates


def _in_time(s: Array, rows: Rows, top: Array) -> Array:
    """Nodes cut into intervals that are short in time as well, and shrink towards both ends."""
    left, right = rows.of(slice(-1)), rows.of(slice(1, None))
    caps = np.minimum(np.append(top, np.inf), np.insert(top, 0, np.inf)) ** 2
    up = reach(s, caps, left, right, (True, True))[0]
    with np.errstate(divide="ignore"):
        sharp = 1 / np.maximum(np.abs(left.jerk[:, :, 0]), np.abs(right.jerk[:, :, 0])).max(axis=1, initial=0.0)
    most = 1 / np.maximum(np.abs(left.acceleration[:, :, 0]), np.abs(right.acceleration[:, :, 0])).max(axis=1)
    ramp = top / most
    with np.errstate(invalid="ignore"):
        build_up = np.minimum(most / sharp, np.sqrt(top / sharp))
    duration = np.minimum(np.maximum(OF_BUILD_UP * build_up, OF_RAMP * ramp), OF_TURN * ramp)
    length = float(s[-1])
    speed = np.sqrt(np.maximum(np.maximum(up[:-1], up[1:]), 0.0))
    longest = np.minimum(speed * duration, length)
    parts = np.maximum(np.ceil(np.diff(s) / longest), 1).astype(np.intp)
    nodes = np.append(np.repeat(s[:-1], parts) + np.repeat(np.diff(s) / parts, parts) * _count(parts), length)
    near: list[Array] = [np.zeros(0), np.zeros(0)]
    for end in (0, -1):
        away = nodes if end == 0 else length - nodes
        build = max(float(build_up[end]), 1e-3 * float(ramp[end]))
        room = float(s[1] if end == 0 else length - s[-2])
        first = min(float(most[end]) / build * (FIRST * build) ** 3 / 6, room / 4)
        # intervals in proportion to the distance from rest, until they are as long as the others
        steps = np.diff(np.sort(away))[:3].max(initial=0.0)
        reached = min(max(steps * GROWTH / (GROWTH - 1), first), length / 2)
        count = max(int(np.ceil(np.log(reached / first) / np.log(GROWTH))), 1)
        near[end] = np.asarray(first * GROWTH ** np.arange(count + 1), dtype=float)
        nodes = nodes[(away == 0) | (away >= near[end][-1] * (1 + (GROWTH - 1) / 2))]
    merged = np.unique(np.concatenate([nodes, near[0], length - near[1]]))
    return merged


def _count(parts: NDArray[np.intp]) -> NDArray[np.intp]:
    """0, 1, ... in each group of so many."""
    return np.arange(parts.sum()) - np.repeat(np.cumsum(parts) - parts, parts)
