"""Windows of a grid that are solved at once: their rows inside the intervals, and the usage of limits by a motion."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from ocp.motion.schedule.grid import Grid
from ocp.motion.schedule.limits import Rows, limit_rows, torque_rows
from ocp.motion.schedule.profile import Array, LineMotion, SpeedProfile, profile_through
from ocp.motion.schedule.settings import SETTINGS

__all__ = ["HELD", "INSIDE", "Ends", "Motion", "Stretch", "Window", "limit_usage", "motion_profile"]

INSIDE = (0.25, 0.5, 0.75)
"""Places in each interval where rows are evaluated between its ends, as shares of its length."""
HELD = (0, 1, 3, 4)
"""Places, ends included, where rows are enforced: not the middle, where the jerk of the motion may change."""

Ends: TypeAlias = tuple[tuple[float, float], tuple[float, float]]
"""Squared speed and its slope by distance, at the beginning and at the end."""
Motion: TypeAlias = tuple[Array, Array]
"""Squared speeds and their slopes at nodes. Shape (N + 1,) each."""


@dataclass(frozen=True, eq=False)
class Stretch:
    """Part of a grid between two nodes.

    Attributes:
        grid: The whole grid.
        first, last: Nodes.
        ends: Squared speed and its slope at either; rest where the path ends. Shape (2, 2).
    """

    grid: Grid
    first: int
    last: int
    ends: Ends = ((0.0, 0.0), (0.0, 0.0))


@dataclass(frozen=True, eq=False)
class Window(Stretch):
    """Stretch that is solved at once.

    Attributes:
        rows: Rows where intervals begin, `INSIDE` them, and where they end. Shape (N,) each.
        bends: Largest errors of parabolas through the rows of acceleration and of jerk at three of these places. Shape
            (N, L, 3) and (N, P, 3).
        close: Cache of rows at a finer spacing, by interval of the grid and whether with torques.
    """

    rows: tuple[Rows, ...] = ()
    bends: tuple[Array, Array] = (np.zeros((0, 0, 3)), np.zeros((0, 0, 3)))
    close: dict[tuple[int, bool], Rows] = field(default_factory=dict)

    @classmethod
    def build(cls, stretch: Stretch, first: int, last: int, ends: Ends) -> Window:
        """Return the window of a stretch between two nodes."""
        grid = stretch.grid
        begin, h = grid.distance[first:last], np.diff(grid.distance[first : last + 1])
        left, right = grid.ends(first, last)
        places = np.concatenate([begin + share * h for share in INSIDE])
        rows = limit_rows(grid.path, grid.limits, grid.joints, places)
        inside = [rows.take(slice(k * len(h), (k + 1) * len(h))) for k in range(len(INSIDE))]
        every = (left, *inside, right)
        bends = (
            _parabola_errors([each.acceleration for each in every]),
            _parabola_errors([each.jerk for each in every]),
        )
        return cls(grid, first, last, ends, every, bends)

    def fine_rows(self, intervals: NDArray[np.intp], torques: bool) -> Rows:
        """Return rows at the inner ends of the `fine` parts of some intervals, place by place.

        Shape ((SETTINGS.fine - 1) B,); with torques, which take longest, on request.
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
        """Slice of the rows of `limit_names` that are torques."""
        speed, acceleration, _ = (kind.shape[1] for kind in self.rows[0])
        count = torque_rows(self.grid.limits, self.grid.joints)
        return slice(speed + acceleration - count, speed + acceleration)

    @property
    def nodes(self) -> Array:
        """Distances of the nodes. Shape (N + 1,), m."""
        return self.grid.distance[self.first : self.last + 1]


def motion_profile(stretch: Stretch, x: Array, slope: Array | None) -> SpeedProfile:
    """Return the motion with squared speeds, and slopes with jerk limits, at the first nodes of a stretch."""
    s = stretch.grid.distance[stretch.first : stretch.first + len(x)]
    v = np.sqrt(x)
    if slope is not None:
        return profile_through(s, v, slope[: len(x)] / 2)
    t = np.concatenate([[0.0], np.cumsum(2 * np.diff(s) / (v[:-1] + v[1:]))])
    return SpeedProfile(t, s, v, np.append(np.diff(x) / (2 * np.diff(s)), 0.0), np.zeros(len(s) - 1))


def limit_usage(
    window: Window, profile: SpeedProfile, which: NDArray[np.intp], closely: bool = True
) -> tuple[Array, Array]:
    """Return rows over their limits in some intervals (B,): the largest in each direction, and those at `HELD` places.

    Shapes (2, N, K + L + P) and (4, N, K + L + P), zero in the other intervals.

    In either half of an interval each row is interpolated by a parabola through three places, whose vertex counts too.
    Where the interpolation error may matter, and if `closely`, more places are evaluated.
    """
    count, h = len(which), np.diff(window.nodes)[which]
    every, left = count == window.last - window.first, window.nodes[which]
    begin, before, here, after, end = window.rows if every else (rows.take(which) for rows in window.rows)
    each = len(profile.jerk) // (window.last - window.first)
    # the halves meet where the jerk changes, near the middle; the rows there are interpolated by a parabola
    at = profile.distance[1::2][which] if each == 2 else left + h / 2
    f = (at - left) / h
    x = (f - INSIDE[1]) / (INSIDE[1] - INSIDE[0])

    def between(a: Array, b: Array, c: Array) -> Array:
        y = x.reshape(-1, *(1,) * (a.ndim - 1))
        return np.asarray(b + y * ((c - a) / 2 + y * ((a + c) / 2 - b)))

    middle = Rows(*(between(*kinds) for kinds in zip(before, here, after, strict=True)))

    def states(place: NDArray[np.intp], jerk: Array) -> LineMotion:
        t, s, v, a = (kind[place] for kind in (profile.t, profile.distance, profile.speed, profile.acceleration))
        return LineMotion(t, s, v, a, jerk)

    first = states(each * which, profile.jerk[each * which])
    last = states(each * (which + 1), profile.jerk[each * (which + 1) - 1])
    if each == 1:  # the acceleration jumps at nodes; use the one before
        last = last._replace(acceleration=first.acceleration)
    zero = np.zeros(count)
    places = np.concatenate([left + INSIDE[0] * h, at, left + INSIDE[2] * h])
    inside = profile.at_distance(places)
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
        peak = _vertex(high[three], places_of[three])
        for side, value in zip(used, (peak, -peak), strict=True):
            side[at_row] = np.maximum(side[at_row], value)
    if closely:
        bends = window.bends if every else (window.bends[0][which], window.bends[1][which])
        missed = _inaccurate_rows(bends, used, (first, met, last))
        inaccurate, by_torques = missed.any(axis=1), missed[:, window.torques].any(axis=1)
        for torques, these in ((False, np.flatnonzero(inaccurate & ~by_torques)), (True, np.flatnonzero(by_torques))):
            if these.size:
                known = values[[0, 2, 3, 5]][:, these]
                finer = _fine_usage(window, profile, which[these], f[these], known, torques)
                if not torques:
                    finer[:, :, window.torques] = used[:, these, window.torques]
                used[:, these] = finer
    held_values = values[[0, 1, 4, 5]]
    if every:
        return used, held_values
    everywhere = [np.zeros((len(kind), window.last - window.first, kind.shape[2])) for kind in (used, held_values)]
    for kind, compact in zip(everywhere, (used, held_values), strict=True):
        kind[:, which] = compact
    return everywhere[0], everywhere[1]


def _parabola_errors(rows: list[Array]) -> Array:
    """Return the largest errors of parabolas through rows at three of five equidistant places. Shape (N, L, 3)."""
    a, b, c, d, e = rows
    # the third difference gives the cubic term; a parabola misses at most 1/(9 sqrt 3) of it
    return np.asarray(np.maximum(np.abs(d - a + 3 * (b - c)), np.abs(e - b + 3 * (c - d))) / (9 * np.sqrt(3)))


def _inaccurate_rows(bends: tuple[Array, Array], used: Array, motions: tuple[LineMotion, ...]) -> NDArray[np.bool_]:
    """Return rows that seem to be kept but may be violated between three places. Shape (N, K + L + P)."""
    v, a, j = (
        np.max([np.abs(getattr(motion, kind)) for motion in motions], axis=0)[:, None]
        for kind in ("speed", "acceleration", "jerk")
    )
    acceleration, jerk = bends
    errors = [
        np.zeros((len(v), used.shape[2] - acceleration.shape[1] - jerk.shape[1])),
        acceleration[:, :, 0] * a + acceleration[:, :, 1] * v**2 + acceleration[:, :, 2],
        jerk[:, :, 0] * j + jerk[:, :, 1] * v * a + jerk[:, :, 2] * v**3,
    ]
    error = np.concatenate(errors, axis=1)
    return np.asarray((error > SETTINGS.bend) & (used.max(axis=0) + error > 1))


def _fine_usage(
    window: Window, profile: SpeedProfile, intervals: NDArray[np.intp], f: Array, known: Array, torques: bool
) -> Array:
    """Return the largest usage in each direction in some intervals, from closely spaced places. Shape (2, B, R).

    Args:
        window, profile: As for `limit_usage`.
        intervals: The intervals. Shape (B,).
        f: Places in them where the jerk changes. Shape (B,).
        known: Usage at their beginning, before and after that change, and at their end. Shape (4, B, R).
        torques: Whether those of torques are evaluated.
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
            peak = _vertex(values[k : k + 3], [place[:, None] for place in at[k : k + 3]])
            used = np.maximum(used, [peak, -peak])
    return used


def _vertex(values: Array, places: list[Array]) -> Array:
    """Return the vertex of parabolas through three values if it lies between the first and the last, else the first."""
    (a, b, c), (at, inside, end) = values, places
    slope = (b - a) / (inside - at)
    with np.errstate(divide="ignore", invalid="ignore"):
        curvature = ((c - b) / (end - inside) - slope) / (end - at)
        vertex = (at + inside) / 2 - slope / (2 * curvature)
        within = (vertex - at) * (vertex - end) < 0
        return np.asarray(np.where(within, a + (vertex - at) * (slope + curvature * (vertex - inside)), a))
