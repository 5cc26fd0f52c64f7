"""What is solved at once: intervals of a grid with rows at places inside them, and what a motion demands there."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from ocp.schedule.grid import Grid
from ocp.schedule.limits import JointPath, LineLimits, PathLike
from ocp.schedule.profile import Array, LineMotion, SpeedProfile, through
from ocp.schedule.rows import Rows, rows_at

__all__ = ["INSIDE", "ROOM", "Ends", "Motion", "Stretch", "Window", "demanded", "profile_of"]

ROOM = 3e-4
"""Share of the limits that is left for what lies between the places looked at."""
INSIDE = (0.25, 0.5, 0.75)
"""Where each interval is looked at between its ends, as shares of its length."""
BETWEEN = tuple(k / 16 for k in range(1, 16) if k % 4)
"""Where those are looked at too whose rows bend sharply."""

Ends: TypeAlias = tuple[tuple[float, float], tuple[float, float]]
"""Squared speed and its slope by the distance, at the beginning and at the end."""
Motion: TypeAlias = tuple[Array, Array]
"""Squared speeds and their slopes at nodes. Shape (N + 1,) each."""


@dataclass(frozen=True, eq=False)
class Stretch:
    """A part of a grid between two nodes.

    Attributes:
        path, limits, joints: Of the schedule.
        grid: All of it.
        first, last: Nodes.
        ends: Squared speed and its slope at either; rest where the path ends. Shape (2, 2).
    """

    path: PathLike
    limits: LineLimits
    joints: JointPath | None
    grid: Grid
    first: int
    last: int
    ends: Ends = ((0.0, 0.0), (0.0, 0.0))


@dataclass(frozen=True, eq=False)
class Window(Stretch):
    """A stretch that is solved at once.

    Attributes:
        rows: Where intervals begin, `INSIDE` them, and where they end. Shape (N,) each.
        bent: Intervals in which rows bend more sharply than these show. Shape (B,).
        between: Rows at places `BETWEEN` of those. Shape (B,) each.
    """

    rows: tuple[Rows, ...] = ()
    bent: NDArray[np.intp] = field(default_factory=lambda: np.zeros(0, dtype=np.intp))
    between: tuple[Rows, ...] = ()

    @classmethod
    def of(cls, stretch: Stretch, first: int, last: int, ends: Ends) -> Window:
        """Part of a stretch between two nodes."""
        begin, h = stretch.grid.distance[first:last], np.diff(stretch.grid.distance[first : last + 1])
        left, right = stretch.grid.ends(first, last)
        places = np.concatenate([begin + share * h for share in INSIDE])
        rows = rows_at(stretch.path, stretch.limits, stretch.joints, places)
        inside = [rows.of(slice(k * len(h), (k + 1) * len(h))) for k in range(len(INSIDE))]
        all_of_them = (left, *inside, right)
        bent = _bent(all_of_them, stretch.grid.asked[first:last])
        between = tuple(
            rows_at(stretch.path, stretch.limits, stretch.joints, begin[bent] + share * h[bent]) for share in BETWEEN
        )
        return cls(
            stretch.path, stretch.limits, stretch.joints, stretch.grid, first, last, ends, all_of_them, bent, between
        )

    def part(self, first: int, last: int, x: Array, slope: Array) -> Window:
        """Its intervals between two nodes, given squared speeds and slopes at all of them. Shape (N + 1,)."""
        own = [(float(x[node]), float(slope[node])) for node in (first, last)]
        ends = (self.ends[0] if first == 0 else own[0], self.ends[1] if last == len(x) - 1 else own[1])
        rows = tuple(rows.of(slice(first, last)) for rows in self.rows)
        here = (self.bent >= first) & (self.bent < last)
        bent, between = self.bent[here] - first, tuple(rows.of(np.flatnonzero(here)) for rows in self.between)
        begin, end = self.first + first, self.first + last
        return replace(self, first=begin, last=end, ends=ends, rows=rows, bent=bent, between=between)

    @property
    def nodes(self) -> Array:
        """Distances. Shape (N + 1,), m."""
        return self.grid.distance[self.first : self.last + 1]


def profile_of(stretch: Stretch, x: Array, slope: Array | None) -> SpeedProfile:
    """The motion with squared speeds, and their slopes where jerks are limited, at the first nodes of a stretch."""
    s = stretch.grid.distance[stretch.first : stretch.first + len(x)]
    v = np.sqrt(x)
    if slope is not None:
        return through(s, v, slope[: len(x)] / 2)
    t = np.concatenate([[0.0], np.cumsum(2 * np.diff(s) / (v[:-1] + v[1:]))])
    return SpeedProfile(t, s, v, np.append(np.diff(x) / (2 * np.diff(s)), 0.0), np.zeros(len(s) - 1))


def demanded(window: Window, profile: SpeedProfile) -> Array:
    """Largest demands over their limits in each interval, upwards and downwards. Shape (2, N, K + L + P).

    In either half of an interval each demand is a parabola through three places; its vertex counts too.
    """
    begin, before, here, after, end = window.rows
    nodes, h = window.nodes, np.diff(window.nodes)
    count = len(h)
    each = len(profile.jerk) // count
    # the halves meet where the jerk changes, near the middle: rows there are those of a parabola as well
    at = profile.distance[1::2] if each == 2 else nodes[:-1] + h / 2
    f = (at - nodes[:-1]) / h
    x = (f - INSIDE[1]) / (INSIDE[1] - INSIDE[0])

    def between(a: Array, b: Array, c: Array) -> Array:
        y = x.reshape(-1, *(1,) * (a.ndim - 1))
        return np.asarray(b + y * ((c - a) / 2 + y * ((a + c) / 2 - b)))

    middle = Rows(*(between(*kinds) for kinds in zip(before, here, after, strict=True)))

    def states(part: slice, jerk: Array) -> LineMotion:
        t, s, v, a = (kind[part] for kind in (profile.t, profile.distance, profile.speed, profile.acceleration))
        return LineMotion(t, s, v, a, jerk)

    first = states(slice(0, -1, each), profile.jerk[::each])
    last = states(slice(each, None, each), profile.jerk[each - 1 :: each])
    if each == 1:  # the acceleration jumps at nodes: it is that before them
        last = last._replace(acceleration=first.acceleration)
    met = profile.at_distance(at)
    zero, one = np.zeros(count), np.ones(count)
    halves = (
        ((begin, first, zero), (before, profile.at_distance(nodes[:-1] + INSIDE[0] * h), INSIDE[0] * one), first.jerk),
        ((end, last, one), (after, profile.at_distance(nodes[:-1] + INSIDE[2] * h), INSIDE[2] * one), last.jerk),
    )
    used = np.full((2, count, begin.total), -np.inf)
    for outer, inner, jerk in halves:
        places = (outer, inner, (middle, met._replace(jerk=jerk), f))
        values = [rows.demands(motion) for rows, motion, _ in places]
        _add_extremes(used, values, [place[:, None] for *_, place in places])
    for share, rows in zip(BETWEEN, window.between, strict=True):
        value = rows.demands(profile.at_distance(nodes[window.bent] + share * h[window.bent]))
        used[:, window.bent] = np.maximum(used[:, window.bent], [value, -value])
    return used


def _bent(rows: tuple[Rows, ...], asked: Array) -> NDArray[np.intp]:
    """Intervals in which parabolas through three of five places miss what lies between them, at the top speed."""
    top = np.minimum(asked, np.minimum(rows[0].steady()[0], rows[-1].steady()[0]))
    kinds = ([each.acceleration[:, :, 1] for each in rows], [each.jerk[:, :, 2] for each in rows])
    sharp = np.zeros(len(asked), dtype=bool)
    for values, scale in zip(kinds, (top**2, top**3), strict=True):
        for a, b, c, d in (values[:4], values[1:]):
            # the third difference tells the cubic that a parabola leaves, at most 1/(9 sqrt 3) of it
            miss = np.abs(d - a + 3 * (b - c)).max(axis=1, initial=0.0) / (9 * np.sqrt(3))
            sharp |= miss * scale > ROOM
    return np.flatnonzero(sharp)


def _add_extremes(used: Array, values: list[Array], places: list[Array]) -> None:
    """Raise what is used to the greatest and the least value of parabolas through three values, in place."""
    (a, b, c), (at, inside, end) = values, places
    slope = (b - a) / (inside - at)
    with np.errstate(divide="ignore", invalid="ignore"):
        bend = ((c - b) / (end - inside) - slope) / (end - at)
        vertex = (at + inside) / 2 - slope / (2 * bend)
        within = (vertex - at) * (vertex - end) < 0
        peak = np.where(within, a + (vertex - at) * (slope + bend * (vertex - inside)), a)
    for value in (a, b, c, peak):
        np.maximum(used[0], value, out=used[0])
        np.maximum(used[1], -value, out=used[1])
