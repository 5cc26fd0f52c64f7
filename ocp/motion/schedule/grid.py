"""Nodes along a path that resolve its limits, and the limits there as rows.

The bounds between pieces are nodes. Intervals are halved until every row's demand at the fastest steady speed changes
evenly from node to node, and are short enough for the jerk to change at the right time: a part of the time that the
acceleration takes to build up. Towards rest, where v ~ s^(2/3), they shrink in proportion to the distance.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ocp.errors import ProblemError
from ocp.motion.schedule.limits import JointPath, LineLimits, PathLike, Rows, check_smooth, limit_names, limit_rows
from ocp.motion.schedule.profile import Array, segment_index
from ocp.motion.schedule.settings import SETTINGS
from ocp.tolerances import ROUNDING_SHARE

__all__ = ["Grid", "coarse_grid", "make_grid", "reachable_bounds"]


@dataclass(frozen=True, eq=False)
class Grid:
    """Nodes along a path, and the limits at them.

    Attributes:
        path, limits, joints: Of the schedule.
        distance: Of the nodes, from 0 to the path's length. Shape (N + 1,), m.
        requested: Requested speed in each interval. Shape (N,), m/s.
        jumps: Nodes where the path's pieces meet. Shape (B,).
        before: Distances just before these. Shape (B,), m.
        sharp: Whether jerks are limited anywhere.
    """

    path: PathLike
    limits: LineLimits
    joints: JointPath | None
    distance: Array
    requested: Array
    jumps: NDArray[np.intp]
    before: Array
    sharp: bool = True

    def ends(self, first: int, last: int) -> tuple[Rows, Rows]:
        """Rows at the first and at the last place of the intervals between two nodes. Shape (N,) each.

        They are made when they are asked for: all of a long path would fill the memory.
        """
        at = np.flatnonzero((self.jumps > first) & (self.jumps <= last))
        places = np.concatenate([self.distance[first : last + 1], self.before[at]])
        rows = limit_rows(self.path, self.limits, self.joints, places)
        count = last - first
        right = np.arange(1, count + 1)
        right[self.jumps[at] - first - 1] = count + 1 + np.arange(len(at))
        return rows.take(slice(count)), rows.take(right)

    def parts(self) -> list[tuple[int, int]]:
        """First and last nodes of parts of bounded length."""
        ends = [*range(0, len(self.requested), SETTINGS.block), len(self.requested)]
        return list(pairwise(ends))


class _Cells(NamedTuple):
    """Intervals that resolve the limits. Shape (N,) each.

    Attributes:
        begin: Where they begin, m.
        top: Fastest steady speed, m/s.
        rates: Acceleration that no motion exceeds, m/s^2.
        most, sharp: Greatest acceleration and jerk of the line at rest, m/s^2 and m/s^3.
    """

    begin: Array
    top: Array
    rates: Array
    most: Array
    sharp: Array


def make_grid(path: PathLike, limits: LineLimits, joints: JointPath | None) -> Grid:
    """Nodes of a path.

    Args:
        path, limits: Of the schedule.
        joints: None where none are limited.

    Raises:
        ProblemError: A jerk limit that no speed can keep, because the path's curvature jumps; a singular arm.
    """
    check_smooth(path, limits, joints)
    asked, bounds = path.by_piece(limits.speed), np.asarray(path.bounds, dtype=float)
    # a piece that is next to nothing has no interval of its own
    some = np.concatenate([[True], np.diff(bounds)[:-1] > SETTINGS.shortest * path.length, [True]])
    some[-2] &= len(bounds) == 2 or bounds[-1] - bounds[-2] > SETTINGS.shortest * path.length
    nodes = bounds[some]
    first = _apart(np.concatenate([path.dense(SETTINGS.cells, max(1, SETTINGS.segments // len(bounds))), nodes]), nodes)
    parts = [
        _halved(path, limits, joints, first[begin : begin + SETTINGS.block + 1], (bounds, asked))
        for begin in range(0, len(first) - 1, SETTINGS.block)
    ]
    cells = _Cells(*(np.concatenate(kind) for kind in zip(*parts, strict=True)))
    s = _apart(np.concatenate([_in_time(cells, path.length), nodes]), nodes)
    inner = nodes[1:-1]
    before = inner - np.minimum(ROUNDING_SHARE * path.length, np.diff(nodes)[:-1] / 2)
    of_interval = np.asarray(asked[segment_index(bounds, (s[:-1] + s[1:]) / 2)])
    sharp = bool(np.isfinite(cells.sharp).any())
    return Grid(path, limits, joints, s, of_interval, np.searchsorted(s, inner), before, sharp)


def _halved(
    path: PathLike, limits: LineLimits, joints: JointPath | None, s: Array, asked: tuple[Array, Array]
) -> _Cells:
    """Intervals between places, halved until their rows change evenly.

    Args:
        path, limits, joints: As of `make_grid`.
        s: Places. Shape (M + 1,), m.
        asked: Bounds of the path's pieces, and the speed in each.
    """
    rows = limit_rows(path, limits, joints, s)
    _check_rest(rows, s, limit_names(limits, joints))
    new = np.arange(len(s) - 1)
    for _ in range(SETTINGS.halvings):
        middle = (s[new] + s[new + 1]) / 2
        between = limit_rows(path, limits, joints, middle)
        wide = _uneven(rows.take(new), between, rows.take(new + 1), _top(rows, s, *asked)[new])
        wide &= s[new + 1] - s[new] > SETTINGS.shortest * path.length
        if not wide.any():
            break
        cut = new[wide]
        s = np.insert(s, cut + 1, middle[wide])
        rows = Rows(*(np.insert(a, cut + 1, b[wide], axis=0) for a, b in zip(rows, between, strict=True)))
        new = np.sort(np.concatenate([cut + np.arange(len(cut)), cut + np.arange(len(cut)) + 1]))
    top, left, right = _top(rows, s, *asked), rows.take(slice(-1)), rows.take(slice(1, None))
    with np.errstate(divide="ignore"):
        sharp = 1 / np.maximum(np.abs(left.jerk[:, :, 0]), np.abs(right.jerk[:, :, 0])).max(axis=1, initial=0.0)
    most = 1 / np.maximum(np.abs(left.acceleration[:, :, 0]), np.abs(right.acceleration[:, :, 0])).max(axis=1)
    return _Cells(s[:-1], top, _rates(left, right, top**2, top**2), most, sharp)


def coarse_grid(path: PathLike, limits: LineLimits) -> Grid:
    """The first nodes of a path, no interval halved: enough to say where the line binds."""
    bounds = np.asarray(path.bounds, dtype=float)
    s = np.unique(np.concatenate([path.dense(SETTINGS.cells, 1), bounds]))
    asked = np.asarray(path.by_piece(limits.speed)[segment_index(bounds, (s[:-1] + s[1:]) / 2)])
    return Grid(path, limits, None, s, asked, np.zeros(0, dtype=np.intp), np.zeros(0))


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
        near = np.minimum(np.append(gap, np.inf), np.insert(gap, 0, np.inf)) < SETTINGS.closest * beside
        near &= ~np.isin(s, nodes)
        near[1:] &= ~near[:-1]  # of two that are close one stays
        if not near.any():
            break
        s = s[~near]
    return s


def _top(rows: Rows, s: Array, bounds: Array, asked: Array) -> Array:
    """Fastest steady speed in each interval, m/s."""
    steady = rows.steady()[0]
    return np.asarray(
        np.minimum(np.minimum(steady[:-1], steady[1:]), asked[segment_index(bounds, (s[:-1] + s[1:]) / 2)])
    )


def _uneven(left: Rows, middle: Rows, right: Rows, top: Array) -> NDArray[np.bool_]:
    """Which intervals' middles differ from what their ends say, at the top speed. Shape (N,)."""
    sides = left, middle, right
    kinds = (
        # by the squared speed, as the rows of speed are in the program
        ([rows.speed**2 for rows in sides], top**2, 2 * SETTINGS.uneven_speed),
        ([rows.acceleration[:, :, 1] for rows in sides], top**2, SETTINGS.uneven),
        ([rows.jerk[:, :, 2] for rows in sides], top**3, SETTINGS.uneven),
    )
    wide = np.zeros(len(top), dtype=bool)
    for (first, between, last), scale, most in kinds:
        bent = np.abs(between - (first + last) / 2) * scale[:, None]
        wide |= bent.max(axis=1, initial=0.0) > most
    return wide


def reachable_bounds(
    distance: Array, caps: Array, left: Rows, right: Rows, at_rest: tuple[bool, bool]
) -> tuple[Array, Array]:
    """Squared speeds that no motion exceeds, and accelerations of the line that none exceeds.

    Args:
        distance: Nodes. Shape (N + 1,), m.
        caps: Greatest squared speed at each. Shape (N + 1,).
        left, right: Rows at both ends of each interval. Shape (N,).
        at_rest: Whether the motion begins and ends at rest.

    Returns:
        Squared speeds at the nodes (N + 1,), accelerations in the intervals (N,).
    """
    rates = _rates(left, right, caps[:-1], caps[1:])
    return _reached(distance, caps, rates, at_rest), rates


def _rates(left: Rows, right: Rows, first: Array, last: Array) -> Array:
    """Accelerations that none exceeds in intervals, by the greatest squared speeds at their ends. Shape (N,) each."""
    rates = np.full(len(first), np.inf)
    for side, most in ((left, first), (right, last)):
        of = np.abs(side.acceleration)
        with np.errstate(divide="ignore", invalid="ignore"):
            one = (1 + of[:, :, 1] * most[:, None] + of[:, :, 2]) / of[:, :, 0]
        rates = np.minimum(rates, np.where(of[:, :, 0] > 0, one, np.inf).min(axis=1, initial=np.inf))
    return rates


def _reached(distance: Array, caps: Array, rates: Array, at_rest: tuple[bool, bool]) -> Array:
    """Squared speeds at nodes that keep to caps and to accelerations in the intervals."""
    gain = np.concatenate([[0.0], np.cumsum(2 * rates * np.diff(distance))])
    up = caps.copy()
    up[[i for i, rest in zip((0, -1), at_rest, strict=True) if rest]] = 0.0
    up = np.minimum.accumulate(up - gain) + gain
    up = np.minimum.accumulate((up + gain)[::-1])[::-1] - gain
    return np.asarray(np.maximum(up, 0.0))


def _in_time(cells: _Cells, length: float) -> Array:
    """Nodes that cut intervals into such that are short in time as well, and shrink towards both ends."""
    _, top, rates, most, sharp = cells
    s = np.append(cells.begin, length)
    caps = np.minimum(np.append(top, np.inf), np.insert(top, 0, np.inf)) ** 2
    up = _reached(s, caps, rates, (True, True))
    ramp = top / most
    with np.errstate(invalid="ignore"):
        build_up = np.minimum(most / sharp, np.sqrt(top / sharp))
    duration = np.minimum(np.maximum(SETTINGS.build_up * build_up, SETTINGS.ramp * ramp), SETTINGS.turn * ramp)
    duration = np.maximum(duration, SETTINGS.least_build_up * build_up)
    speed = np.sqrt(np.maximum(np.maximum(up[:-1], up[1:]), 0.0))
    longest = np.minimum(speed * duration, length)
    # what is a whole number but for rounding is one: the unit of length must not change the nodes
    parts = np.clip(np.ceil(np.diff(s) / longest * (1 - ROUNDING_SHARE)), 1, SETTINGS.parts).astype(np.intp)
    nodes = np.append(np.repeat(s[:-1], parts) + np.repeat(np.diff(s) / parts, parts) * _count(parts), length)
    near: list[Array] = [np.zeros(0), np.zeros(0)]
    for end in (0, -1):
        away = nodes if end == 0 else length - nodes
        build = max(float(build_up[end]), 1e-3 * float(ramp[end]))
        room = float(s[1] if end == 0 else length - s[-2])
        first = min(float(most[end]) / build * (SETTINGS.first * build) ** 3 / 6, room / 4)
        # intervals in proportion to the distance from rest, until they are as long as the others
        steps = np.diff(np.sort(away))[:3].max(initial=0.0)
        reached = min(max(steps * SETTINGS.growth / (SETTINGS.growth - 1), first), length / 2)
        count = max(int(np.ceil(np.log(reached / first) / np.log(SETTINGS.growth))), 1)
        near[end] = np.asarray(first * SETTINGS.growth ** np.arange(count + 1), dtype=float)
        # what resolves a limit more finely than these, as a bend near the end, stays beside them
        gap = np.diff(nodes)
        finest = np.minimum(np.append(gap, np.inf), np.insert(gap, 0, np.inf))
        stays = finest < away * (1 - 1 / SETTINGS.growth)
        nodes = nodes[(away == 0) | stays | (away >= near[end][-1] * (1 + (SETTINGS.growth - 1) / 2))]
    merged = np.unique(np.concatenate([nodes, near[0], length - near[1]]))
    return merged


def _count(parts: NDArray[np.intp]) -> NDArray[np.intp]:
    """0, 1, ... in each group of so many."""
    return np.arange(parts.sum()) - np.repeat(np.cumsum(parts) - parts, parts)
