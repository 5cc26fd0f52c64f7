"""Windows (parts of a path grid that are solved at once), the limits enforced there, and the ratios to the limits."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from typing import NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from models.checks import Array
from ocp.motion.schedule.grid import Grid
from ocp.motion.schedule.limits import Rows, limit_rows, torque_rows
from ocp.motion.tasks.speed_profile import LineMotion, SpeedProfile, profile_through


@dataclass(frozen=True)
class WindowSettings:
    """Settings for enforcing and checking limits in a window (part of a path grid that is solved at once).

    Shares are fractions of the limits.

    Attributes:
        room: Share of the limits reserved for what happens between the positions where they are enforced.
        near: Once a motion is known, limits of which it uses less than this share in an interval and beside it are left
            out.
        lowered: Largest factor by which a limit is lowered in a round.
        bend: Share of the limits by which a row may deviate from a parabola before more positions are evaluated.
        vertex_usage: Share of a limit used at one of three positions above which the vertex between them is evaluated:
            a parabola exceeds the greatest of three values by a quarter at most.
        fine: Parts into which an interval is split for that evaluation; even, so that the middle is an end of one.
    """

    room: float = 1e-4
    near: float = 0.9
    lowered: float = 1.5
    bend: float = 1e-4
    vertex_usage: float = 0.75
    fine: int = 16


SETTINGS = WindowSettings()

INSIDE = (0.25, 0.5, 0.75)
"""Positions inside each interval at which limits are evaluated, as fractions of the length of the interval."""
ENFORCED_AT = (0, 1, 3, 4)
"""Indices in (0, *INSIDE, 1) of the positions where limits are enforced: all but the middle, where the jerk may jump.
"""

Ends: TypeAlias = tuple[tuple[float, float], tuple[float, float]]
"""Squared speed and its derivative with respect to distance, at the beginning and at the end of a stretch."""
Motion: TypeAlias = tuple[Array, Array]
"""Squared speeds and their derivatives with respect to distance (slopes) at nodes. Shape (N + 1,) each."""


@dataclass(frozen=True, eq=False)
class Stretch:
    """Part of a path grid between two nodes.

    Attributes:
        grid: The whole grid.
        first, last: Indices of the two nodes.
        ends: Squared speed and its slope at either node; rest where the path ends. Shape (2, 2).
    """

    grid: Grid
    first: int
    last: int
    ends: Ends = ((0.0, 0.0), (0.0, 0.0))


@dataclass(frozen=True, eq=False)
class Window(Stretch):
    """Part of a path grid that is solved as one optimisation problem.

    Attributes:
        rows: Limit rows where intervals begin, `INSIDE` them, and where they end. Shape (N,) each.
        bends: Largest errors of parabolas through the limit rows at three of these positions, 0 for speed. Shape (N,).
        close: Cache of limit rows at a finer spacing, by interval of the grid and whether with torques.
    """

    rows: tuple[Rows, ...] = field(kw_only=True)
    bends: Rows = field(kw_only=True)
    close: dict[tuple[int, bool], Rows] = field(default_factory=dict)

    @classmethod
    def build(cls, stretch: Stretch, first: int, last: int, ends: Ends) -> Window:
        """Return the window between two nodes of a path grid, with the coefficients of all limit inequalities in it."""
        grid = stretch.grid
        begin, h = grid.distance[first:last], np.diff(grid.distance[first : last + 1])
        left, right = grid.ends(first, last)
        places = np.concatenate([begin + share * h for share in INSIDE])
        rows = limit_rows(grid.path, grid.limits, grid.joints, places)
        inside = [rows.take(slice(k * len(h), (k + 1) * len(h))) for k in range(len(INSIDE))]
        every = (left, *inside, right)
        kinds = ([each.acceleration for each in every], [each.jerk for each in every])
        bends = Rows(np.zeros_like(left.speed), *map(_parabola_errors, kinds))
        return cls(grid, first, last, ends, rows=every, bends=bends)

    def fine_rows(self, intervals: NDArray[np.intp], torques: bool) -> Rows:
        """Return the coefficients of all limits at closely spaced points in intervals, sorted by point, then interval.

        The points divide each interval into SETTINGS.fine parts. Torque limits, slowest to compute, are optional.
        """
        parts = SETTINGS.fine
        missing = [at for at in intervals.tolist() if (self.first + at, torques) not in self.close]
        if missing:
            grid, begin, h = self.grid, self.nodes[missing], np.diff(self.nodes)[missing]
            places = begin[:, None] + np.arange(1, parts) / parts * h[:, None]
            rows = limit_rows(grid.path, grid.limits, grid.joints, places.ravel(), torques=torques)
            for k, at in enumerate(missing):
                self.close[self.first + at, torques] = rows.take(slice(k * (parts - 1), (k + 1) * (parts - 1)))
        rows_of = [self.close[self.first + at, torques] for at in intervals.tolist()]
        return Rows(*(np.stack(kind, axis=1).reshape(-1, *kind[0].shape[1:]) for kind in zip(*rows_of, strict=True)))

    @property
    def torques(self) -> slice:
        """Slice that selects the torque limits among all limits, in the order of `limit_names`."""
        speed, acceleration, _ = (kind.shape[1] for kind in self.rows[0])
        count = torque_rows(self.grid.limits, self.grid.joints)
        return slice(speed + acceleration - count, speed + acceleration)

    @property
    def nodes(self) -> Array:
        """Distances of the window's nodes along the path. Shape (N + 1,), m."""
        return self.grid.distance[self.first : self.last + 1]


class Margins(NamedTuple):
    """Fractions of the speed, acceleration and jerk limits that the motion may use in each interval.

    Shape (N,), (N, L) and (N, P).
    """

    speed: Array
    acceleration: Array
    jerk: Array

    def take(self, part: slice | NDArray[np.intp]) -> Margins:
        """Return the usable fractions of the limits in selected intervals; a slice selects views of the same memory."""
        return Margins(*(margin[part] for margin in self))

    def times(self, share: Array) -> Margins:
        """Return a copy in which the fractions of the limits are multiplied by one factor for each interval (N,)."""
        return Margins(self.speed * share, self.acceleration * share[:, None], self.jerk * share[:, None])


@dataclass(eq=False)
class EnforcedRows:
    """Limits enforced in a window (part of a path solved at once), and the fractions of the limits that may be used.

    Attributes:
        margins: Usable shares of the limits, lowered where limits are violated although they are enforced there.
        times: Number of reductions of each margin.
        mask: Which rows are enforced at the `ENFORCED_AT` positions of each interval, upwards and downwards.
            Shape (4, 2, N, K + L + P).
        ratios: Ratio of the speed at the beginning of each interval to its mean; see `Spline`. Shape (N,).
        inherited: Number of intervals taken over from the previous window.
    """

    margins: Margins
    times: Margins
    mask: NDArray[np.bool_]
    ratios: Array
    inherited: int = 0

    @classmethod
    def build(cls, window: Window) -> EnforcedRows:
        """Return the limits of a part of the path (window), none of them enforced yet, with initial margins."""
        count, rows = window.last - window.first, window.rows[0]
        shapes = (count,), (count, rows.acceleration.shape[1]), (count, rows.jerk.shape[1])
        margins, times = (Margins(*(np.full(shape, x) for shape in shapes)) for x in (1 - SETTINGS.room, 0.0))
        mask = np.zeros((len(ENFORCED_AT), 2, count, rows.total), dtype=bool)
        return cls(margins, times, mask, np.ones(count))

    def take(self, part: slice | NDArray[np.intp]) -> EnforcedRows:
        """Return the enforced limits in selected intervals; a slice selects views of the same memory."""
        margins, times = self.margins.take(part), self.times.take(part)
        return EnforcedRows(margins, times, self.mask[:, :, part], self.ratios[part], self.inherited)

    def split(self, parts: NDArray[np.intp]) -> EnforcedRows:
        """Return the enforced limits after each interval is split into a number of equal parts (N,).

        Splines before the split remain possible. Split intervals may use the limits fully: what happens between nodes
        decreases with their distance, and a motion from the previous window keeps the limits there.
        """
        rows, count = self.take(np.repeat(np.arange(len(parts)), parts)), np.repeat(parts, parts)
        rows.inherited = int(parts[: self.inherited].sum())
        for margin, times in zip(rows.margins, rows.times, strict=True):
            margin[count > 1], times[count > 1] = 1 - SETTINGS.room, 0.0
        number = np.arange(len(count)) - np.repeat(np.cumsum(parts) - parts, parts)
        first, last = (np.sqrt(rows.ratios**2 + 4 * (1 - rows.ratios) * (number + k) / count) for k in (0, 1))
        rows.ratios = 2 * first / (first + last)
        return rows

    def enforce_near(self, used: Array, values: Array, jerks: Array) -> None:
        """Enforce limits that a motion nearly reaches, also in adjacent intervals, and a jerk limit in each interval.

        `used` and `values` are those of `limit_usage`, `jerks` (N, P) the coefficients of the jerk in its limits.
        """
        close = used > SETTINGS.near
        close[:, 1:] |= close[:, :-1].copy()
        close[:, :-1] |= close[:, 1:].copy()
        self.mask[[0, -1]] |= close
        self.enforce(close, values)
        self.enforce_jerk(jerks)

    def release(self, values: Array, jerks: Array, seam: int) -> None:
        """Stop enforcing limits that a motion does not come near, but keep at least one jerk limit in each interval.

        Intervals shared with the previous or next window keep all rows.
        """
        own = slice(self.inherited, seam)
        self.mask[:, :, own] &= np.stack([values, -values], axis=1)[:, :, own] > SETTINGS.near
        self.enforce_jerk(jerks)

    def enforce_jerk(self, jerks: Array) -> None:
        """Enforce at least one jerk limit in every interval, to bound the second derivative of the squared speed."""
        first = self.mask.shape[3] - jerks.shape[1]
        sign, free = np.nonzero(~self.mask[:, :, :, first:].any(axis=(0, 3)))
        self.mask[1, sign, free, first + np.abs(jerks[free]).argmax(axis=1)] = True

    def enforce(self, rows: NDArray[np.bool_], values: Array) -> NDArray[np.bool_]:
        """Enforce each limit at its point of highest usage in an interval; return which limits already were enforced.

        `rows` and the result are masks of shape (2, N, K + L + P).
        """
        already = np.zeros(rows.shape, dtype=bool)
        sign, at, row = np.nonzero(rows)
        place = (values[:, at, row] * (1 - 2 * sign)).argmax(axis=0)
        already[sign, at, row] = self.mask[place, sign, at, row]
        self.mask[place, sign, at, row] = True
        return already

    def lower(self, used: Array, mask: NDArray[np.bool_], rows: Rows, seam: int) -> None:
        """Reduce the usable share of each enforced limit that the computed motion still exceeds, by more at each call.

        `used` is the usage of the limits and `mask` tells which are enforced. Shape (2, N, K + L + P). The next window
        begins at the interval `seam`.
        """
        ends = np.cumsum([0, *(kind.shape[1] for kind in rows)])
        largest = np.where(mask, np.minimum(used, SETTINGS.lowered), 0.0).max(axis=0)
        largest[:, : ends[1]] = np.minimum(used[0, :, : ends[1]], SETTINGS.lowered)
        for margin, times, (a, z) in zip(self.margins, self.times, pairwise(ends), strict=True):
            ratio = largest[:, a:z] if margin.ndim == 2 else largest[:, a:z].max(axis=1, initial=0.0)
            at = np.nonzero(ratio > 1)
            margin[at] /= np.minimum(1 + (ratio[at] - 1 + SETTINGS.room / 2) * 2.0 ** times[at], SETTINGS.lowered)
            times[at] += 1
            if margin.ndim == 2:
                # the next window starts on this motion with these margins and must keep them at all positions
                inherited = at[0] >= seam
                self.mask[:, :, at[0][inherited], a + at[1][inherited]] = True


def motion_profile(stretch: Stretch, x: Array, slope: Array) -> SpeedProfile:
    """Return the speed profile through the first nodes of a path part, from squared speeds and their slopes there."""
    s = stretch.grid.distance[stretch.first : stretch.first + len(x)]
    return profile_through(s, np.sqrt(x), slope[: len(x)] / 2)


def limit_usage(
    window: Window, profile: SpeedProfile, which: NDArray[np.intp], closely: bool = True
) -> tuple[Array, Array]:
    """Return the largest ratio of each quantity to its limit in given intervals, and those at the enforced points.

    Shapes (2, N, K + L + P), upwards and downwards, and (4, N, K + L + P), zero in the other intervals.

    In either half of an interval each row is interpolated by a parabola through three places, whose vertex counts too.
    Where the interpolation error may matter, and if `closely`, more places are evaluated.
    """
    count, h = len(which), np.diff(window.nodes)[which]
    every, left = count == window.last - window.first, window.nodes[which]
    begin, before, here, after, end = window.rows if every else (rows.take(which) for rows in window.rows)
    # the halves meet where the jerk changes, near the middle; the rows there are interpolated by a parabola
    at = profile.distance[1::2][which]
    f = (at - left) / h
    x = (f - INSIDE[1]) / (INSIDE[1] - INSIDE[0])

    def between(a: Array, b: Array, c: Array) -> Array:
        y = x.reshape(-1, *(1,) * (a.ndim - 1))
        return np.asarray(b + y * ((c - a) / 2 + y * ((a + c) / 2 - b)))

    middle = Rows(*(between(*kinds) for kinds in zip(before, here, after, strict=True)))

    def states(place: NDArray[np.intp], jerk: Array) -> LineMotion:
        t, s, v, a = (kind[place] for kind in (profile.t, profile.distance, profile.speed, profile.acceleration))
        return LineMotion(t, s, v, a, jerk)

    first = states(2 * which, profile.jerk[2 * which])
    last = states(2 * which + 2, profile.jerk[2 * which + 1])
    zero = np.zeros(count)
    inside = profile.at_distance(np.concatenate([left + INSIDE[0] * h, at, left + INSIDE[2] * h]))
    quarter, met, three_quarter = (
        LineMotion(*(kind[k * count : (k + 1) * count] for kind in inside)) for k in range(3)
    )
    halves = (
        ((begin, first), (before, quarter), (middle, met._replace(jerk=first.jerk))),
        ((middle, met._replace(jerk=last.jerk)), (after, three_quarter), (end, last)),
    )
    values = np.stack([rows.usage(motion) for half in halves for rows, motion in half])
    used = np.stack([values.max(axis=0), -values.min(axis=0)])
    # a parabola exceeds the greatest of three of its values by at most a quarter
    at_row = np.nonzero(np.maximum(*used) > SETTINGS.vertex_usage)
    high = np.stack([value[at_row] for value in values])
    shares = (zero, INSIDE[0] + zero, f, f, INSIDE[2] + zero, zero + 1)
    places_of = [place[at_row[0]] for place in shares]
    for three in (slice(0, 3), slice(3, 6)):
        peak = parabola_peak(high[three], places_of[three])
        for side, value in zip(used, (peak, -peak), strict=True):
            side[at_row] = np.maximum(side[at_row], value)
    if closely:
        bends = window.bends if every else window.bends.take(which)
        error = bends.usage(LineMotion(*np.abs((first, met, last)).max(axis=0)))
        missed = (error > SETTINGS.bend) & (used.max(axis=0) + error > 1)
        inaccurate, by_torques = missed.any(axis=1), missed[:, window.torques].any(axis=1)
        for torques, these in ((False, np.flatnonzero(inaccurate & ~by_torques)), (True, np.flatnonzero(by_torques))):
            if these.size:
                known = values[[0, 2, 3, 5]][:, these]
                finer = _fine_usage(window, profile, which[these], f[these], known, torques)
                if not torques:
                    finer[:, :, window.torques] = used[:, these, window.torques]
                used[:, these] = finer
    point_values = values[[0, 1, 4, 5]]
    if every:
        return used, point_values
    everywhere = [np.zeros((len(kind), window.last - window.first, kind.shape[2])) for kind in (used, point_values)]
    for kind, compact in zip(everywhere, (used, point_values), strict=True):
        kind[:, which] = compact
    return everywhere[0], everywhere[1]


def _parabola_errors(rows: list[Array]) -> Array:
    """Return the largest error of parabolas through three of five equidistant samples of coefficients.

    Shape (N, L, 3).
    """
    a, b, c, d, e = rows
    # the third difference gives the cubic term; a parabola misses at most 1/(9 sqrt 3) of it
    return np.asarray(np.maximum(np.abs(d - a + 3 * (b - c)), np.abs(e - b + 3 * (c - d))) / (9 * np.sqrt(3)))


def _fine_usage(
    window: Window, profile: SpeedProfile, intervals: NDArray[np.intp], f: Array, known: Array, torques: bool
) -> Array:
    """Return the largest fraction used of each limit in B intervals, in both directions, at closely spaced points.

    The jerk changes at the fraction `f` (B,) of each interval. `known` contains the usage at the beginning of each
    interval, before and after that change, and at the end. Shape (4, B, R). The result has shape (2, B, R).
    """
    parts, half = SETTINGS.fine, SETTINGS.fine // 2
    places = window.nodes[intervals] + np.arange(1, parts)[:, None] / parts * np.diff(window.nodes)[intervals]
    usage = window.fine_rows(intervals, torques).usage(profile.at_distance(places.ravel()))
    usage = usage.reshape(parts - 1, len(intervals), -1)
    fine = np.arange(parts + 1)[:, None] / parts + np.zeros(len(intervals))
    fine[half] = f
    begin, before, after, end = known[:, None]
    used = np.zeros((2, *begin.shape[1:]))
    for values, at in (
        (np.concatenate([begin, usage[: half - 1], before]), fine[: half + 1]),
        (np.concatenate([after, usage[half:], end]), fine[half:]),
    ):
        used = np.maximum(used, [values.max(axis=0), -values.min(axis=0)])
        for k in range(0, half, 2):
            peak = parabola_peak(values[k : k + 3], [place[:, None] for place in at[k : k + 3]])
            used = np.maximum(used, [peak, -peak])
    return used


def parabola_peak(values: Array, places: Sequence[Array | float]) -> Array:
    """Return the extreme value of a parabola through three points if it lies between these, else the first value."""
    (a, b, c), (at, inside, end) = values, places
    slope = (b - a) / (inside - at)
    with np.errstate(divide="ignore", invalid="ignore"):
        curvature = ((c - b) / (end - inside) - slope) / (end - at)
        vertex = (at + inside) / 2 - slope / (2 * curvature)
        within = (vertex - at) * (vertex - end) < 0
        return np.asarray(np.where(within, a + (vertex - at) * (slope + curvature * (vertex - inside)), a))
