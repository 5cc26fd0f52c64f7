"""Grids of nodes along a path that are fine enough to resolve how the limits vary along the path.

The bounds between the segments of the path are nodes. Intervals are halved until every limit row varies almost linearly
between nodes at the fastest steady speed, or at the fastest speed that a motion can reach there. They also last only a
fraction of the time in which the acceleration builds up, so that the jerk can change at the right time. Towards rest,
where v ~ s^(2/3), they shrink in proportion to the distance.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from models.checks import Array
from ocp.errors import ProblemError
from ocp.motion.schedule.limits import (
    BLOCK_SIZE,
    JointPath,
    LineLimits,
    PathLike,
    Rows,
    check_smooth,
    limit_names,
    limit_rows,
)
from ocp.motion.tasks.speed_profile import segment_index
from ocp.tolerances import ROUNDING_SHARE


@dataclass(frozen=True)
class GridSettings:
    """Settings for placing the nodes along a path at which the limits are evaluated.

    Attributes:
        halvings: Largest number of halvings of an interval of the first grid.
        shortest: Fraction of the path length below which a segment is merged with the next, and no interval is halved.
        uneven, uneven_speed: Largest interpolation error between two nodes of a limited quantity, over its limit, and
            of a limit of speed, which is enforced at nodes only.
        cells, segments: Number of intervals of the first grid in each cell (part) of a blend, and least number on all
            segments together.
        closest: Ratio of neighbouring intervals below which their node is dropped, unless segments meet there.
        build_up, ramp: Duration of an interval over the time in which the acceleration builds up, or, if longer, over
            that in which the top speed is reached.
        ramp_without_jerk: The latter without jerk limits, where the passes refine the grid.
        turn, least_build_up: Upper bound as a share of the ramp time, since the speed must not change much in an
            interval; lower bound as a share of the build-up, since with low jerks no motion gets near the acceleration
            limits.
        parts: Largest number of parts into which an interval that resolves the limits is split.
        growth: Ratio of neighbouring distances from rest, where the speed grows as their power 2/3.
        rise: Largest growth of the squared speed in half a cell, over its least value.
        first: Duration of the first and last interval, of constant jerk, over that of the build-up.
    """

    halvings: int = 8
    shortest: float = 1e-7
    uneven: float = 0.05
    uneven_speed: float = 0.02
    cells: int = 4
    segments: int = 64
    closest: float = 0.05
    build_up: float = 0.25
    ramp: float = 0.05
    ramp_without_jerk: float = 0.1
    turn: float = 0.25
    least_build_up: float = 0.05
    parts: int = 32
    growth: float = 1.2
    rise: float = 2.0
    first: float = 0.3


SETTINGS = GridSettings()

GAUSS = (0.5 - 12**-0.5, 0.5 + 12**-0.5)
"""Gauss points of an interval, at which limits are compared besides its ends and its middle: a wave may have equal
phases at equidistant places."""


@dataclass(frozen=True, eq=False)
class Grid:
    """Nodes along a path at which the limits of a motion along the path are evaluated.

    Attributes:
        path, limits, joints: As of the schedule.
        distance: Distances of the nodes, from 0 to the length of the path. Shape (N + 1,), m.
        requested: Requested speed in each interval. Shape (N,), m/s.
        jumps: Indices of the nodes where segments of the path meet. Shape (B,).
        before: Distances just before these nodes. Shape (B,), m.
        sharp: Whether any jerk is limited.
    """

    path: PathLike
    limits: LineLimits
    joints: JointPath | None
    distance: Array
    requested: Array
    jumps: NDArray[np.intp]
    before: Array
    sharp: bool = True

    @cached_property
    def rows(self) -> Rows:
        """Coefficients of all limits at all nodes, then also just before each node where path segments meet."""
        return limit_rows(self.path, self.limits, self.joints, np.concatenate([self.distance, self.before]))

    def ends(self, first: int, last: int) -> tuple[Rows, Rows]:
        """Return the coefficients of all limits at both ends of each of the N intervals between two nodes of the grid.

        The rows of a long path are evaluated on request: all of them would fill the memory.
        """
        at = np.flatnonzero((self.jumps > first) & (self.jumps <= last))
        count, nodes = last - first, len(self.distance)
        used = np.concatenate([np.arange(first, last + 1), nodes + at])
        if nodes <= BLOCK_SIZE:
            rows = self.rows.take(used)
        else:
            places = np.concatenate([self.distance, self.before])[used]
            rows = limit_rows(self.path, self.limits, self.joints, places)
        right = np.arange(1, count + 1)
        right[self.jumps[at] - first - 1] = count + 1 + np.arange(len(at))
        return rows.take(slice(count)), rows.take(right)

    def split(self, first: int, parts: NDArray[np.intp]) -> Grid:
        """Return the grid of the N intervals after a node, each split into a given number of equal parts (N,)."""
        last, ends = first + len(parts), np.append(0, np.cumsum(parts))
        s = np.interp(np.arange(ends[-1] + 1), ends, self.distance[first : last + 1])
        own = (self.jumps > first) & (self.jumps <= last)
        jumps, requested = ends[self.jumps[own] - first], np.repeat(self.requested[first:last], parts)
        return Grid(self.path, self.limits, self.joints, s, requested, jumps, self.before[own], self.sharp)

    def blocks(self) -> list[tuple[int, int]]:
        """Divide the grid into consecutive blocks of bounded size; return the first and last node of each block."""
        return list(pairwise([*range(0, len(self.requested), BLOCK_SIZE), len(self.requested)]))


class _Cells(NamedTuple):
    """Intervals of a path, short enough to resolve the limits, and bounds of speed and acceleration in each interval.

    Attributes:
        begin: Distances at which the intervals begin. Shape (N,) like all others, m.
        top: Fastest steady speeds, m/s.
        rates: Upper bounds of the acceleration of any motion, m/s^2.
        acceleration, jerk: Largest acceleration and jerk along the path at rest, m/s^2 and m/s^3.
    """

    begin: Array
    top: Array
    rates: Array
    acceleration: Array
    jerk: Array


def make_grid(path: PathLike, limits: LineLimits, joints: JointPath | None) -> Grid:
    """Return a grid of nodes along a path that is fine enough to resolve how the limits vary along the path.

    Args:
        path, limits: As of the schedule.
        joints: None if no joint is limited.

    Raises:
        ProblemError: A jerk limit cannot be kept because the curvature jumps, or the arm is singular.
    """
    check_smooth(path, limits, joints)
    requested, bounds = path.by_piece(limits.speed), np.asarray(path.bounds, dtype=float)
    # a negligible segment has no interval of its own
    kept = np.concatenate([[True], np.diff(bounds)[:-1] > SETTINGS.shortest * path.length, [True]])
    kept[-2] &= len(bounds) == 2 or bounds[-1] - bounds[-2] > SETTINGS.shortest * path.length
    nodes = bounds[kept]
    sample_distances = path.sample_distances(SETTINGS.cells, max(1, SETTINGS.segments // len(bounds)))
    first = _separate(np.concatenate([sample_distances, nodes]), nodes)
    inner = nodes[1:-1]
    before = inner - np.minimum(16 * np.spacing(path.length), np.diff(nodes)[:-1] / 2)  # beyond rounding of a bound
    parts = [
        _halve_intervals(
            path, limits, joints, first[begin : begin + BLOCK_SIZE + 1], (bounds, requested), (inner, before)
        )
        for begin in range(0, len(first) - 1, BLOCK_SIZE)
    ]
    cells = _Cells(*(np.concatenate(kind) for kind in zip(*parts, strict=True)))
    s = _separate(np.concatenate([_time_nodes(cells, path.length), nodes]), nodes)
    of_interval = np.asarray(requested[segment_index(bounds, (s[:-1] + s[1:]) / 2)])
    sharp = bool(np.isfinite(cells.jerk).any())
    return Grid(path, limits, joints, s, of_interval, np.searchsorted(s, inner), before, sharp)


def _halve_intervals(
    path: PathLike,
    limits: LineLimits,
    joints: JointPath | None,
    s: Array,
    requested: tuple[Array, Array],
    jumps: tuple[Array, Array],
) -> _Cells:
    """Halve the intervals between distances `s` along a path until all limits vary almost linearly in each interval.

    `requested` contains the bounds of the segments of the path, and the requested speed in each segment; `jumps` the
    distances where limits may jump and those just before.
    """
    at = np.flatnonzero((jumps[0] > s[0]) & (jumps[0] <= s[-1]))
    places = np.concatenate([s, jumps[1][at]])
    rows = limit_rows(path, limits, joints, places)
    _check_rest(rows, places, limit_names(limits, joints))
    left, right = np.arange(len(s) - 1), np.arange(1, len(s))
    right[np.searchsorted(s, jumps[0][at]) - 1] = len(s) + np.arange(len(at))
    new, shares, steady = left, np.array([[0.5], [GAUSS[0]], [GAUSS[1]]]), rows.steady()
    at_rest = s[0] == 0, s[-1] == path.length
    for number in range(SETTINGS.halvings + 1):
        begin, end, width = rows.take(left), rows.take(right), np.diff(s)
        most = requested[1][segment_index(requested[0], (s[:-1] + s[1:]) / 2)]
        top = np.minimum(np.minimum(steady[left], steady[right]), most)  # fastest steady speed
        rates = acceleration_bounds(begin, end, top**2, top**2)
        if number == SETTINGS.halvings or not new.size:
            break
        # a motion that is slow beside an interval is not fast inside it, where limits then need no finer nodes
        squares = reachable_squares(s, node_minimum(top) ** 2, rates, at_rest)
        inside = np.sqrt(np.minimum(top**2, (squares[:-1] + squares[1:]) / 2 + rates * width))
        # a wave may have equal phases at both ends and in the middle: other places tell
        places = (s[new] + shares * width[new]).ravel()
        between = limit_rows(path, limits, joints, places)
        uneven = _uneven_intervals((begin.take(new), between, end.take(new)), shares, inside[new])
        uneven &= width[new] > SETTINGS.shortest * path.length
        cut, middle = new[uneven], np.flatnonzero(uneven)
        s, middle = np.insert(s, cut + 1, places[middle]), len(rows.speed) + middle
        left, right = np.insert(left, cut + 1, middle), np.insert(right, cut, middle)
        rows = Rows(*(np.concatenate(kinds) for kinds in zip(rows, between, strict=True)))
        steady = np.append(steady, between.steady())
        new = np.sort(np.concatenate([cut + np.arange(len(cut)), cut + np.arange(len(cut)) + 1]))
    with np.errstate(divide="ignore"):
        jerk = 1 / np.maximum(np.abs(begin.jerk[:, :, 0]), np.abs(end.jerk[:, :, 0])).max(axis=1, initial=0.0)
    acceleration = 1 / np.maximum(np.abs(begin.acceleration[:, :, 0]), np.abs(end.acceleration[:, :, 0])).max(axis=1)
    return _Cells(s[:-1], top, rates, acceleration, jerk)


def coarse_grid(path: PathLike, limits: LineLimits) -> Grid:
    """Return a coarse grid of nodes along a path that is fine enough to find where limits are active."""
    bounds = np.asarray(path.bounds, dtype=float)
    s = np.unique(np.concatenate([path.sample_distances(SETTINGS.cells, 1), bounds]))
    requested = np.asarray(path.by_piece(limits.speed)[segment_index(bounds, (s[:-1] + s[1:]) / 2)])
    return Grid(path, limits, None, s, requested, np.zeros(0, dtype=np.intp), np.zeros(0))


def _check_rest(rows: Rows, s: Array, names: tuple[str, ...]) -> None:
    """Raise ProblemError if a limit is violated at rest, for example if a torque limit does not support the load."""
    usages = np.abs(rows.acceleration[:, :, 2])
    at, row = np.unravel_index(int(usages.argmax()), usages.shape)
    if usages[at, row] >= 1:
        place, usage, cause = float(s[at]), float(usages[at, row]), names[rows.speed.shape[1] + int(row)]
        message = f"{cause} does not hold the load at {place:g} m: {usage:.3g} times the limit is needed; raise it"
        raise ProblemError(message, name=cause, value=usage, limit=1.0, time=place)


def _separate(places: Array, nodes: Array) -> Array:
    """Sort positions on a path, and remove positions that are too close to another one unless they are in `nodes`."""
    s = np.unique(places)
    for _ in range(3):
        gap = np.diff(s)
        close = node_minimum(gap) < SETTINGS.closest * np.maximum(np.append(gap, 0.0), np.insert(gap, 0, 0.0))
        close &= ~np.isin(s, nodes)
        close[1:] &= ~close[:-1]  # of two close positions, keep one
        if not close.any():
            break
        s = s[~close]
    return s


def _uneven_intervals(places: tuple[Rows, Rows, Rows], fractions: Array, top: Array) -> NDArray[np.bool_]:
    """Return which intervals are too long, because a limit varies too nonlinearly with distance in them. Shape (N,).

    `places` contains the limits at the beginning, at fractions (F, 1) of the length, first those of all intervals at
    the first fraction, and at the end of each interval. `top` are the fastest steady speeds (N,), m/s.
    """
    kinds = (
        # by the squared speed, as the rows of speed are in the program
        ([rows.speed**2 for rows in places], top**2, 2 * SETTINGS.uneven_speed),
        ([rows.acceleration[:, :, 1] for rows in places], top**2, SETTINGS.uneven),
        ([rows.jerk[:, :, 2] for rows in places], top**3, SETTINGS.uneven),
    )
    uneven, share = np.zeros(len(top), dtype=bool), fractions[:, :, None]
    for (first, inside, last), scale, tolerance in kinds:
        deviation = np.abs(inside.reshape(len(share), *first.shape) - (1 - share) * first - share * last)
        uneven |= deviation.max(axis=(0, 2), initial=0.0) * scale > tolerance
    return uneven


def acceleration_bounds(left: Rows, right: Rows, first: Array, last: Array) -> Array:
    """Return upper bounds of the acceleration in each interval, given the squared speeds at both ends. Shape (N,).

    `left` and `right` are the limits at both ends of each interval.
    """
    rates = np.full(len(first), np.inf)
    for side, most in ((left, first), (right, last)):
        rows = np.abs(side.acceleration)
        with np.errstate(divide="ignore", invalid="ignore"):
            bound = (1 + rows[:, :, 1] * most[:, None] + rows[:, :, 2]) / rows[:, :, 0]
        rates = np.minimum(rates, np.where(rows[:, :, 0] > 0, bound, np.inf).min(axis=1, initial=np.inf))
    return rates


def reachable_squares(distance: Array, caps: Array, rates: Array, at_rest: tuple[bool, bool]) -> Array:
    """Return squared speeds at nodes (N + 1,) that no motion exceeds under speed caps and acceleration bounds.

    `caps` are the greatest permitted squared speeds at the nodes, `rates` bound the accelerations in the intervals, and
    `at_rest` tells whether the motion begins and ends at rest.
    """
    gain = np.concatenate([[0.0], np.cumsum(2 * rates * np.diff(distance))])
    squares = caps.copy()
    squares[[i for i, rest in zip((0, -1), at_rest, strict=True) if rest]] = 0.0
    return np.maximum(limit_slope(squares, gain), 0.0)


def limit_slope(values: Array, gain: Array) -> Array:
    """Lower values (N,) as little as possible so that no difference between neighbours exceeds that of `gain`."""
    lowered = np.minimum.accumulate(values - gain) + gain
    return np.asarray(np.minimum.accumulate((lowered + gain)[::-1])[::-1] - gain)


def node_minimum(of_intervals: Array) -> Array:
    """Return at each node the smaller of the values of the two intervals that meet there. Shape (N + 1,)."""
    return np.asarray(np.minimum(np.append(of_intervals, np.inf), np.insert(of_intervals, 0, np.inf)))


def subdivide(nodes: Array, parts: NDArray[np.intp]) -> Array:
    """Divide each of the N intervals of a mesh into a given number of equal parts; return the nodes of the new mesh."""
    step = np.arange(parts.sum()) - np.repeat(np.cumsum(parts) - parts, parts)
    return np.append(np.repeat(nodes[:-1], parts) + np.repeat(np.diff(nodes) / parts, parts) * step, nodes[-1])


def _time_nodes(cells: _Cells, length: float) -> Array:
    """Return grid nodes such that the motion passes every interval in a short time, refined towards the path's ends."""
    for _ in range(2 * SETTINGS.halvings):
        begin, top, rates, acceleration, jerk = cells
        s = np.append(begin, length)
        squares = reachable_squares(s, node_minimum(top) ** 2, rates, (True, True))
        # away from slow places the speed may grow manifold in a cell; next to rest, nodes are added below
        gain = np.minimum(rates * np.diff(s), top**2)
        steep = gain > SETTINGS.rise * np.minimum(squares[:-1], squares[1:])
        steep[[0, -1]], unlimited = False, np.isinf(jerk).all()
        if unlimited or not steep.any():
            break
        cells = _Cells(*(np.repeat(kind, 1 + steep) for kind in cells))
        cells.begin[np.cumsum(1 + steep)[steep] - 1] += (np.diff(s) / 2)[steep]
    ramp = top / acceleration
    with np.errstate(invalid="ignore"):
        build_up = np.minimum(acceleration / jerk, np.sqrt(top / jerk))
    share = SETTINGS.ramp_without_jerk if unlimited else SETTINGS.ramp
    duration = np.minimum(np.maximum(SETTINGS.build_up * build_up, share * ramp), SETTINGS.turn * ramp)
    duration = np.maximum(duration, SETTINGS.least_build_up * build_up)
    speed = np.sqrt(np.maximum(np.maximum(squares[:-1], squares[1:]), 0.0))
    longest = np.minimum(speed * duration, length)
    # ceil with a margin for rounding: the unit of length must not change the nodes
    parts = np.clip(np.ceil(np.diff(s) / longest * (1 - ROUNDING_SHARE)), 1, SETTINGS.parts).astype(np.intp)
    nodes = subdivide(s, parts)
    if unlimited:  # the squared speed grows in proportion to the distance from rest
        return nodes
    near: list[Array] = [np.zeros(0), np.zeros(0)]
    for end in (0, -1):
        away = nodes if end == 0 else length - nodes
        build = max(float(build_up[end]), 1e-3 * float(ramp[end]))
        available = float(s[1] if end == 0 else length - s[-2])
        first = min(float(acceleration[end]) / build * (SETTINGS.first * build) ** 3 / 6, available / 4)
        # geometric intervals from rest, until they are as long as the others
        steps = np.diff(np.sort(away))[:3].max(initial=0.0)
        geometric_range = min(max(steps * SETTINGS.growth / (SETTINGS.growth - 1), first), length / 2)
        count = max(int(np.ceil(np.log(geometric_range / first) / np.log(SETTINGS.growth))), 1)
        near[end] = np.asarray(first * SETTINGS.growth ** np.arange(count + 1), dtype=float)
        # finer nodes, which resolve a limit such as a bend near the end, are kept
        finer = node_minimum(np.diff(nodes)) < away * (1 - 1 / SETTINGS.growth)
        nodes = nodes[(away == 0) | finer | (away >= near[end][-1] * (1 + (SETTINGS.growth - 1) / 2))]
    return np.unique(np.concatenate([nodes, near[0], length - near[1]]))
