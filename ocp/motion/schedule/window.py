"""What is solved at once: intervals of a grid with rows at places inside them, and what a motion demands there."""

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
"""Where each interval is looked at between its ends, as shares of its length."""
HELD = (0, 1, 3, 4)
"""Which of the places, ends included, rows are held at: not the middle, where the jerk of the motion may change."""

Ends: TypeAlias = tuple[tuple[float, float], tuple[float, float]]
"""Squared speed and its slope by the distance, at the beginning and at the end."""
Motion: TypeAlias = tuple[Array, Array]
"""Squared speeds and their slopes at nodes. Shape (N + 1,) each."""


@dataclass(frozen=True, eq=False)
class Stretch:
    """A part of a grid between two nodes.

    Attributes:
        grid: All of it.
        first, last: Nodes.
        ends: Squared speed and its slope at either; rest where the path ends. Shape (2, 2).
    """

    grid: Grid
    first: int
    last: int
    ends: Ends = ((0.0, 0.0), (0.0, 0.0))


@dataclass(frozen=True, eq=False)
class Window(Stretch):
    """A stretch that is solved at once.

    Attributes:
        rows: Where intervals begin, `INSIDE` them, and where they end. Shape (N,) each.
        bends: What parabolas through the rows of acceleration and of jerk at three of these places miss at most.
            Shape (N, L, 3) and (N, P, 3).
        close: Rows at places nearer to one another, of intervals of the grid that were looked at so, with or without
            those of torques.
    """

    rows: tuple[Rows, ...] = ()
    bends: tuple[Array, Array] = (np.zeros((0, 0, 3)), np.zeros((0, 0, 3)))
    close: dict[tuple[int, bool], Rows] = field(default_factory=dict)

    @classmethod
    def build(cls, stretch: Stretch, first: int, last: int, ends: Ends) -> Window:
        """Part of a stretch between two nodes."""
        grid = stretch.grid
        begin, h = grid.distance[first:last], np.diff(grid.distance[first : last + 1])
        left, right = grid.ends(first, last)
        places = np.concatenate([begin + share * h for share in INSIDE])
        rows = limit_rows(grid.path, grid.limits, grid.joints, places)
        inside = [rows.take(slice(k * len(h), (k + 1) * len(h))) for k in range(len(INSIDE))]
        all_of_them = (left, *inside, right)
        bends = _bends([each.acceleration for each in all_of_them]), _bends([each.jerk for each in all_of_them])
        return cls(grid, first, last, ends, all_of_them, bends)

    def closely(self, intervals: NDArray[np.intp], torques: bool) -> Rows:
        """Rows at the ends of the `fine` parts of some intervals but for their own, place by place.

        Shape ((SETTINGS.fine - 1) B,); those of torques, which take longest, where they are asked for.
        """
        parts = SETTINGS.fine
        new = [at for at in intervals.tolist() if (self.first + at, torques) not in self.close]
        if new:
            grid, begin, h = self.grid, self.nodes[new], np.diff(self.nodes)[new]
            places = begin[:, None] + np.arange(1, parts) / parts * h[:, None]
            rows = limit_rows(grid.path, grid.limits, grid.joints, places.ravel(), torques=torques)
            for k, at in enumerate(new):
                self.close[self.first + at, torques] = rows.take(
                    slice(k * (SETTINGS.fine - 1), (k + 1) * (SETTINGS.fine - 1))
                )
        found = [self.close[self.first + at, torques] for at in intervals.tolist()]
        return Rows(*(np.stack(kind, axis=1).reshape(-1, *kind[0].shape[1:]) for kind in zip(*found, strict=True)))

    @property
    def torques(self) -> slice:
        """Rows of `causes` that are torques."""
        speed, acceleration, _ = (kind.shape[1] for kind in self.rows[0])
        count = torque_rows(self.grid.limits, self.grid.joints)
        return slice(speed + acceleration - count, speed + acceleration)

    @property
    def nodes(self) -> Array:
        """Distances. Shape (N + 1,), m."""
        return self.grid.distance[self.first : self.last + 1]


def motion_profile(stretch: Stretch, x: Array, slope: Array | None) -> SpeedProfile:
    """The motion with squared speeds, and their slopes where jerks are limited, at the first nodes of a stretch."""
    s = stretch.grid.distance[stretch.first : stretch.first + len(x)]
    v = np.sqrt(x)
    if slope is not None:
        return profile_through(s, v, slope[: len(x)] / 2)
    t = np.concatenate([[0.0], np.cumsum(2 * np.diff(s) / (v[:-1] + v[1:]))])
    return SpeedProfile(t, s, v, np.append(np.diff(x) / (2 * np.diff(s)), 0.0), np.zeros(len(s) - 1))


def limit_usage(
    window: Window, profile: SpeedProfile, which: NDArray[np.intp], closely: bool = True
) -> tuple[Array, Array]:
    """Demands over their limits in some intervals (B,): the largest, upwards and downwards, and those at `HELD` places.

    Shape (2, N, K + L + P) and (4, N, K + L + P), none in the others.

    In either half of an interval each demand is a parabola through three places; its vertex counts too. Where that may
    miss what matters, and they are looked at `closely`, more places count.
    """
    count, h = len(which), np.diff(window.nodes)[which]
    every, left = count == window.last - window.first, window.nodes[which]
    begin, before, here, after, end = window.rows if every else (rows.take(which) for rows in window.rows)
    each = len(profile.jerk) // (window.last - window.first)
    # the halves meet where the jerk changes, near the middle: rows there are those of a parabola as well
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
    if each == 1:  # the acceleration jumps at nodes: it is that before them
        last = last._replace(acceleration=first.acceleration)
    zero = np.zeros(count)
    places = np.concatenate([left + INSIDE[0] * h, at, left + INSIDE[2] * h])
    inside = profile.at_distance(places)
    quarter, met, far = (LineMotion(*(kind[k * count : (k + 1) * count] for kind in inside)) for k in range(3))
    halves = (
        ((begin, first), (before, quarter), (middle, met._replace(jerk=first.jerk))),
        ((middle, met._replace(jerk=last.jerk)), (after, far), (end, last)),
    )
    values = np.stack([rows.demands(motion) for half in halves for rows, motion in half])
    used = np.stack([values.max(axis=0), -values.min(axis=0)])
    # a parabola is beyond the greatest of three of its values by at most a quarter of these
    at_row = np.nonzero(np.maximum(*used) > SETTINGS.looked)
    high = np.stack([value[at_row] for value in values])
    shares = (zero, INSIDE[0] + zero, f, f, INSIDE[2] + zero, zero + 1)
    places_of = [place[at_row[0]] for place in shares]
    for three in (slice(0, 3), slice(3, 6)):
        peak = _vertex(high[three], places_of[three])
        for side, value in zip(used, (peak, -peak), strict=True):
            side[at_row] = np.maximum(side[at_row], value)
    if closely:
        bends = window.bends if every else (window.bends[0][which], window.bends[1][which])
        missed = _missed(bends, used, (first, met, last))
        bent, heavy = missed.any(axis=1), missed[:, window.torques].any(axis=1)
        for torques, these in ((False, np.flatnonzero(bent & ~heavy)), (True, np.flatnonzero(heavy))):
            if these.size:
                known = values[[0, 2, 3, 5]][:, these]
                close = _closely(window, profile, which[these], f[these], known, torques)
                if not torques:
                    close[:, :, window.torques] = used[:, these, window.torques]
                used[:, these] = close
    found = values[[0, 1, 4, 5]]
    if every:
        return used, found
    everywhere = [np.zeros((len(kind), window.last - window.first, kind.shape[2])) for kind in (used, found)]
    for kind, own in zip(everywhere, (used, found), strict=True):
        kind[:, which] = own
    return everywhere[0], everywhere[1]


def _bends(rows: list[Array]) -> Array:
    """What parabolas through rows at three of five places in a line miss at most. Shape (N, L, 3) of five of them."""
    a, b, c, d, e = rows
    # the third difference tells the cubic that a parabola leaves, at most 1/(9 sqrt 3) of it
    return np.asarray(np.maximum(np.abs(d - a + 3 * (b - c)), np.abs(e - b + 3 * (c - d))) / (9 * np.sqrt(3)))


def _missed(bends: tuple[Array, Array], used: Array, motions: tuple[LineMotion, ...]) -> NDArray[np.bool_]:
    """Demands that seem to be kept and may be passed between three places. Shape (N, K + L + P)."""
    v, a, j = (
        np.max([np.abs(getattr(motion, kind)) for motion in motions], axis=0)[:, None]
        for kind in ("speed", "acceleration", "jerk")
    )
    of_a, of_j = bends
    miss = [
        np.zeros((len(v), used.shape[2] - of_a.shape[1] - of_j.shape[1])),
        of_a[:, :, 0] * a + of_a[:, :, 1] * v**2 + of_a[:, :, 2],
        of_j[:, :, 0] * j + of_j[:, :, 1] * v * a + of_j[:, :, 2] * v**3,
    ]
    missed = np.concatenate(miss, axis=1)
    return np.asarray((missed > SETTINGS.bend) & (used.max(axis=0) + missed > 1))


def _closely(
    window: Window, profile: SpeedProfile, bent: NDArray[np.intp], f: Array, known: Array, torques: bool
) -> Array:
    """Largest demands, upwards and downwards, of some intervals by places near one another. Shape (2, B, R).

    Args:
        window, profile: As of `demanded`.
        bent: The intervals. Shape (B,).
        f: Where in them the jerk changes. Shape (B,).
        known: Demands at their beginning, before and after that change, and at their end. Shape (4, B, R).
        torques: Whether those of torques are asked for.
    """
    parts, half = SETTINGS.fine, SETTINGS.fine // 2
    places = window.nodes[bent] + np.arange(1, parts)[:, None] / parts * np.diff(window.nodes)[bent]
    demands = window.closely(bent, torques).demands(profile.at_distance(places.ravel()))
    demands = demands.reshape(parts - 1, len(bent), -1)
    fine = np.arange(parts + 1)[:, None] / parts + np.zeros(len(bent))
    fine[half] = f
    begin, before, after, end = known[:, None]
    used = np.zeros((2, *begin.shape[1:]))
    for values, at in (
        (np.concatenate([begin, demands[: half - 1], before]), fine[: half + 1]),
        (np.concatenate([after, demands[half:], end]), fine[half:]),
    ):
        used = np.maximum(used, [values.max(axis=0), -values.min(axis=0)])
        for k in range(0, half, 2):
            peak = _vertex(values[k : k + 3], [place[:, None] for place in at[k : k + 3]])
            used = np.maximum(used, [peak, -peak])
    return used


def _vertex(values: Array, places: list[Array]) -> Array:
    """The vertex of parabolas through three values where it lies between the first and the last, else the first."""
    (a, b, c), (at, inside, end) = values, places
    slope = (b - a) / (inside - at)
    with np.errstate(divide="ignore", invalid="ignore"):
        bend = ((c - b) / (end - inside) - slope) / (end - at)
        vertex = (at + inside) / 2 - slope / (2 * bend)
        within = (vertex - at) * (vertex - end) < 0
        return np.asarray(np.where(within, a + (vertex - at) * (slope + bend * (vertex - inside)), a))
