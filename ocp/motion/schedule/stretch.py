"""The fastest motion over a stretch of a path: its limits as rows, solved, looked at between the nodes, and tightened.

A rough motion, under the rows at one place of every interval, tells which of them matter: few do. These are held at
both ends of the interval, and at that of its places where they use most. The motion under them is looked at; a row that
is passed is held there too, and where it was already, the bounds of the interval are lowered by as much. This is done
until none is passed, at last in the few intervals alone that still are, and those about them. Long stretches are solved
in windows: each comes to rest at its end, so that a motion beyond the next seam is known to exist.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter1d

from ocp.errors import ProblemError, SolveError
from ocp.motion.schedule.grid import reachable_bounds
from ocp.motion.schedule.limits import Rows
from ocp.motion.schedule.profile import Array, SpeedProfile, join_profiles
from ocp.motion.schedule.program import Program, Spline, SplineRows, least_time
from ocp.motion.schedule.ramps import reachability_passes
from ocp.motion.schedule.settings import SETTINGS
from ocp.motion.schedule.window import HELD, INSIDE, Ends, Motion, Stretch, Window, limit_usage, motion_profile
from ocp.tolerances import ROUNDING_SHARE

__all__ = ["fastest_profile"]


class _Margins(NamedTuple):
    """Share of the bounds of speed, and of each row of acceleration and jerk, that intervals may use.

    Shape (N,), (N, L) and (N, P).
    """

    speed: Array
    acceleration: Array
    jerk: Array

    @classmethod
    def all_of(cls, value: float, count: int, rows: Rows) -> _Margins:
        """The same in so many intervals, of rows like these."""
        shapes = (count,), (count, rows.acceleration.shape[1]), (count, rows.jerk.shape[1])
        return cls(*(np.full(shape, value) for shape in shapes))

    def take(self, part: slice) -> _Margins:
        """Those of some intervals, which change with these."""
        return _Margins(*(margin[part] for margin in self))

    def times(self, room: Array) -> _Margins:
        """Less by a share for each interval. Shape (N,)."""
        return _Margins(self.speed * room, self.acceleration * room[:, None], self.jerk * room[:, None])


@dataclass(eq=False)
class _Tight:
    """What the intervals of a window are held to.

    Attributes:
        margins: Lowered where bounds are passed although their rows are held there.
        times: How often they were.
        held: Rows at the `HELD` places of each interval, upwards and downwards. Shape (4, 2, N, K + L + P).
        speeds: At these places, over the speeds that the jerk there is proportional to. Shape (4, N).
        inherited: Intervals of the window before, which are held to what they were in that one.
    """

    margins: _Margins
    times: _Margins
    held: NDArray[np.bool_]
    speeds: Array
    inherited: int = 0

    @classmethod
    def of(cls, window: Window) -> _Tight:
        """What every window begins with."""
        count, rows = window.last - window.first, window.rows[0]
        margins, times = (_Margins.all_of(value, count, rows) for value in (1 - SETTINGS.room, 0.0))
        held = np.zeros((len(HELD), 2, count, rows.total), dtype=bool)
        return cls(margins, times, held, np.ones((len(HELD), count)))

    def part(self, first: int, last: int) -> _Tight:
        """That of some intervals, which changes with it."""
        part = slice(first, last)
        return _Tight(self.margins.take(part), self.times.take(part), self.held[:, :, part], self.speeds[:, part])

    def hold_near(self, used: Array, values: Array, jerks: Array) -> None:
        """Hold rows that come near their bounds, there and in the intervals beside, and some row of jerk in each.

        Args:
            used, values: What was demanded.
            jerks: Coefficients of the jerk in the rows of it. Shape (N, P).
        """
        near = used > SETTINGS.near
        near[:, 1:] |= near[:, :-1].copy()
        near[:, :-1] |= near[:, 1:].copy()
        self.held[[0, -1]] |= near
        self.hold(near, values)
        self.bend(jerks)

    def let_go(self, values: Array, jerks: Array, seam: int) -> None:
        """Of the rows that are held, keep those that came near their bounds, and some row of jerk in every interval.

        Where the window before or the next one is held to them too, all stay.
        """
        own = slice(self.inherited, seam)
        self.held[:, :, own] &= np.stack([values, -values], axis=1)[:, :, own] > SETTINGS.near
        self.bend(jerks)

    def bend(self, jerks: Array) -> None:
        """Hold some row of jerk in every interval: else the second derivative could be anything there."""
        first = self.held.shape[3] - jerks.shape[1]
        sign, free = np.nonzero(~self.held[:, :, :, first:].any(axis=(0, 3)))
        self.held[1, sign, free, first + np.abs(jerks[free]).argmax(axis=1)] = True

    def hold(self, which: NDArray[np.bool_], values: Array) -> NDArray[np.bool_]:
        """Hold some rows (2, N, K + L + P) where they use most; which of them are held there already."""
        same = np.zeros(which.shape, dtype=bool)
        sign, at, row = np.nonzero(which)
        place = (values[:, at, row] * (1 - 2 * sign)).argmax(axis=0)
        same[sign, at, row] = self.held[place, sign, at, row]
        self.held[place, sign, at, row] = True
        return same

    def lower(self, used: Array, held: NDArray[np.bool_], rows: Rows, seam: int) -> None:
        """Lower bounds that were passed by rows that are held, as those of speed always are: more the next time.

        Args:
            used, held: What was demanded, by rows that are held or not. Shape (2, N, K + L + P).
            rows: Of the window.
            seam: Interval at which the next window begins.
        """
        ends = np.cumsum([0, *(kind.shape[1] for kind in rows)])
        most = np.where(held, np.minimum(used, SETTINGS.lowered), 0.0).max(axis=0)
        most[:, : ends[1]] = np.minimum(used[0, :, : ends[1]], SETTINGS.lowered)
        for margin, times, (a, z) in zip(self.margins, self.times, pairwise(ends), strict=True):
            over = most[:, a:z] if margin.ndim == 2 else most[:, a:z].max(axis=1, initial=0.0)
            at = np.nonzero(over > 1)
            margin[at] /= np.minimum(1 + (over[at] - 1 + SETTINGS.room / 2) * 2.0 ** times[at], SETTINGS.lowered)
            times[at] += 1
            if margin.ndim == 2:
                # the next window begins on this motion, and has the margins: it must keep them at all places
                inherited = at[0] >= seam
                self.held[:, :, at[0][inherited], a + at[1][inherited]] = True


def fastest_profile(stretch: Stretch) -> SpeedProfile:
    """The fastest motion over a stretch, its distance that along the path.

    Raises:
        ProblemError: Limits that no motion keeps, by place.
    """
    if not stretch.grid.sharp:
        return _settled(Window.build(stretch, stretch.first, stretch.last, stretch.ends), stretch.last, None)[0]
    parts: list[SpeedProfile] = []
    begin, state, behind = stretch.first, stretch.ends[0], None
    while True:
        end = stretch.last if stretch.last - begin < SETTINGS.window + SETTINGS.overlap else begin + SETTINGS.window
        last = end == stretch.last
        seam = end if last else end - SETTINGS.overlap
        goal = stretch.ends[1] if last else (0.0, 0.0)
        window = Window.build(stretch, begin, end, (state, goal))
        part, state, behind = _settled(window, seam, behind)
        parts.append(part)
        if last:
            return join_profiles(parts)
        begin = seam


def _settled(window: Window, seam: int, before: _Tight | None) -> tuple[SpeedProfile, tuple[float, float], _Tight]:
    """The motion of a window up to its seam, tightened until it keeps all limits there and a good way behind.

    Args:
        window: What to plan.
        seam: Node at which the next window begins, or the last.
        before: What the window before was held to behind its seam.

    Returns:
        The motion, squared speed and slope at the seam, and what it is held to behind it.
    """
    tight = _Tight.of(window)
    if before is not None:
        for margin, own in zip(tight.margins, before.margins, strict=True):
            margin[: len(own)] = own
        tight.held[:, :, : before.held.shape[2]] = before.held
        tight.speeds[:, : before.held.shape[2]] = before.speeds
        tight.inherited = before.held.shape[2]
    kept, seen = seam - window.first, min(seam + SETTINGS.overlap // 2, window.last) - window.first
    x, slope = _tightened(window, tight, seam, seen)
    state = float(x[kept]), 0.0 if slope is None else float(slope[kept])
    return motion_profile(window, x[: kept + 1], slope), state, tight.part(kept, window.last - window.first)


def _tightened(window: Window, tight: _Tight, seam: int, seen: int) -> tuple[Array, Array | None]:
    """Squared speeds and, where jerks are limited, slopes at the nodes: those of a motion that keeps all limits.

    Where few intervals still pass them, these are planned again with their neighbours, between the motions beside.

    Args:
        window, seam: As of `_settled`.
        tight: What it is held to, changed in place.
        seen: Intervals of the window that must keep the limits: the first so many.
    """
    every = np.arange(window.last - window.first)
    sharp = window.grid.sharp
    accuracies = SETTINGS.accuracies if sharp else SETTINGS.accuracies[-1:]
    start, free = None, every
    for number in range(SETTINGS.rounds):
        accuracy = accuracies[min(number, len(accuracies) - 1)]
        try:
            x, slope = _solved(window, tight, seam, start, accuracy, free)
        except ProblemError:
            if len(free) == len(every):
                raise
            free = every  # too short to change the motion in
            continue
        used, values = limit_usage(window, motion_profile(window, x, slope), free, start is not None or not sharp)
        used /= _room(window, seam)[:, None]
        if start is None and slope is not None:
            tight.hold_near(used, values, window.rows[1].jerk[:, :, 0])
            start = x, slope
            continue
        passed = used > 1 + ROUNDING_SHARE
        over = np.asarray(passed.any(axis=(0, 2)))
        if not over[:seen].any() and accuracy == accuracies[-1]:
            return x, slope
        if slope is not None and number == 1:
            tight.let_go(values, window.rows[1].jerk[:, :, 0], seam - window.first)
        tight.lower(used, passed if slope is None else tight.hold(passed, values), window.rows[0], seam - window.first)
        if slope is None:
            continue
        start = x, slope
        near = np.flatnonzero(maximum_filter1d(over, 2 * SETTINGS.around + 1))
        free = near if accuracy == accuracies[-1] and len(near) < SETTINGS.few * len(every) else every
    worst = used[:, :seen].max(axis=(0, 2))
    place, most = float(window.nodes[worst.argmax()]), float(worst.max())
    message = f"the limits are passed by {most - 1:.2g} at {place:g} m, where the path or its joints bend sharply"
    raise ProblemError(message, name="limits", value=most, limit=1.0, time=place)


def _room(window: Window, seam: int) -> Array:
    """Share of the limits that the intervals of a window may use. Shape (N,)."""
    return np.where(np.arange(window.first, window.last) < seam, 1.0, SETTINGS.seam)


def _solved(
    window: Window, tight: _Tight, seam: int, start: Motion | None, accuracy: float, free: NDArray[np.intp]
) -> tuple[Array, Array | None]:
    """Squared speeds at the nodes, and their slopes where jerks are limited; new in the free intervals alone."""
    if window.grid.sharp:
        return _with_jerk(window, tight, seam, start, accuracy, free)
    return _without_jerk(window, tight.margins), None


def _without_jerk(window: Window, margins: _Margins) -> Array:
    grid = window.grid
    left, right = window.rows[0], window.rows[-1]
    h = np.diff(window.nodes)[:, None]
    caps = np.minimum(_beside(grid.requested) ** 2, _by_rows(window) * _beside(margins.speed) ** 2)
    of = left.acceleration, right.acceleration
    p = np.concatenate([of[0][:, :, 0], of[1][:, :, 0] + 2 * h * of[1][:, :, 1]], axis=1)
    q, rest = (np.concatenate([side[:, :, seat] for side in of], axis=1) for seat in (1, 2))
    bound = np.concatenate([margins.acceleration] * 2, axis=1)
    caps[[0, -1]] = 0.0
    return reachability_passes(window.nodes, caps, p, q, -bound - rest, bound - rest)


def _by_rows(window: Window) -> Array:
    """Squared speed that the rows of speed leave at nodes, on both sides."""
    left, right = (window.rows[k].speed.max(axis=1, initial=0.0) for k in (0, -1))
    with np.errstate(divide="ignore"):
        return np.asarray(np.maximum(np.append(left, 0.0), np.insert(right, 0, 0.0)) ** -2.0)


def _beside(of_intervals: Array) -> Array:
    """The lesser of both neighbours at the nodes."""
    return np.asarray(np.minimum(np.append(of_intervals, np.inf), np.insert(of_intervals, 0, np.inf)))


def _with_jerk(
    window: Window, tight: _Tight, seam: int, known: Motion | None, accuracy: float, free: NDArray[np.intp]
) -> Motion:
    """Squared speeds and slopes at the nodes of a window."""
    begin, end, ends, grid, nodes = window.first, window.last, window.ends, window.grid, window.nodes
    left, middle, right = (window.rows[k] for k in (0, 2, 4))
    at_rest = ends[0][0] == 0, ends[1][0] == 0
    room = _room(window, seam)
    shares = tight.margins.times(room)
    asked = grid.requested[begin:end] ** 2 * room**2
    caps = np.minimum(_beside(asked), _by_rows(window) * _beside(shares.speed) ** 2)
    up, rates = reachable_bounds(nodes, caps, left, right, at_rest)
    # from rest: the first interval, of constant jerk, is no part of the program
    low, high = int(at_rest[0]), len(nodes) - int(at_rest[1])
    rest = [0.0, 0.0]
    for side, resting in enumerate(at_rest):
        if resting:
            node, width = (1, nodes[1] - nodes[0]) if side == 0 else (-2, nodes[-1] - nodes[-2])
            rest[side] = float(width)
            outer, inside = (left, right) if side == 0 else (right, left)
            sharp = _from_rest(outer, inside, float(width), side, shares.jerk)
            caps[node] = min(caps[node], (9 * width**2 * sharp / 2) ** (2 / 3))
    inner = slice(low, high)
    cells = slice(low, high - 1)
    spline = Spline(nodes[inner])
    with np.errstate(divide="ignore"):
        between = (middle.speed.max(axis=1, initial=0.0) / shares.speed) ** -2.0
    most = np.concatenate([caps[inner][:1], np.minimum(asked, between)[cells], caps[inner][-1:]])
    held = tight.held
    if known is None:
        held = held.copy()
        start = _start(nodes, np.minimum(up, caps), left, right, ends)[inner]
        b = np.concatenate([start[:1], np.minimum(start[:-1], start[1:]), start[-1:]])
        held[1] |= _reached(window.rows[1], np.maximum(up[1:], up[:-1]), rates, shares)
    else:
        b = spline.through(known[0][inner], known[1][inner])
        b = np.maximum(b, 1e-9 * b.max())
        # what is not planned anew, and what a motion is known to keep from before, is held to what it was
        new = free[(free >= max(low, tight.inherited)) & (free < high - 1)]
        tight.speeds[:, new] = _speed_ratios(spline, b)[:, new - low]
    fixed: list[int] = []
    sides = ((0, 1, spline.h[0]), (len(b) - 1, len(b) - 2, -spline.h[-1]))
    for (x_end, slope_end), resting, (outermost, next_to, way) in zip(ends, at_rest, sides, strict=True):
        if not resting:
            b[outermost], b[next_to] = x_end, x_end + way * slope_end / 2
            most[[outermost, next_to]] = np.inf
            fixed += [outermost, next_to]
    own_shares = shares.take(cells)
    moving = (not at_rest[0], not at_rest[1])
    places = tuple(rows.take(cells) for rows in window.rows)
    with np.errstate(invalid="ignore"):
        implied = (1 - spline.share) * most[:-1] + spline.share * most[1:]
    rows = _rows(places, held[:, :, cells], caps[inner], implied, own_shares, tight.speeds[:, cells], moving)
    program = Program(spline, rows, most, (rest[0], rest[1]), np.array(fixed, dtype=np.intp))
    try:
        if known is None:
            b = least_time(program, b, accuracy=accuracy, center=SETTINGS.center)
        elif len(free) == end - begin:
            b = _again(program, b, accuracy)
        else:
            part, at = program.part(free[(free >= low) & (free < high - 1)] - low)
            b[at] = _again(part, b[at], accuracy)
    except SolveError as error:
        message = f"{error}; raise the limits, or keep the path away from singular arms"
        details = {"name": "limits", "value": error.value, "limit": error.limit, "time": error.time}
        raise ProblemError(message, **details) from error
    x, slope = np.zeros(len(nodes)), np.zeros(len(nodes))
    x[inner], slope[inner] = spline.at_nodes(b)
    return x, slope


def _again(program: Program, known: Array, accuracy: float) -> Array:
    """Solve a program from a solution of one like it; where that leads nowhere, from further inside."""
    free = np.ones(len(known), dtype=bool)
    free[program.fixed] = False
    start = np.where(free, SETTINGS.again, 1.0) * known
    try:
        return least_time(program, start, accuracy=accuracy, center=SETTINGS.center_again)
    except SolveError:
        start[free] *= SETTINGS.again_inside
        return least_time(program, start, accuracy=accuracy, center=SETTINGS.center)


def _start(nodes: Array, most: Array, left: Rows, right: Rows, ends: Ends) -> Array:
    """Squared speeds to start from, below greatest ones (N + 1,), that change no faster than jerks from rest allow.

    From rest x^(3/4) grows by the square root of 9/2 of the jerk times the distance; from a motion it may fall so too.
    """
    steady = np.minimum(left.steady()[0], right.steady()[0])
    y = (SETTINGS.start * np.minimum(most, _beside(steady) ** 2)) ** 0.75
    with np.errstate(divide="ignore"):
        sharp = 1 / np.maximum(*(np.abs(rows.jerk[:, :, 0]).max(axis=1) for rows in (left, right)))
    away = np.concatenate([[0.0], np.cumsum(np.sqrt(4.5 * sharp) * np.diff(nodes))])
    y[0], y[-1] = (x**0.75 for x, _ in ends)
    y = np.minimum.accumulate(y - away) + away
    y = np.minimum.accumulate((y + away)[::-1])[::-1] - away
    start = np.maximum(y, np.maximum(ends[0][0] ** 0.75 - away, ends[1][0] ** 0.75 - (away[-1] - away))) ** (4 / 3)
    return np.asarray(np.maximum(start, 1e-9 * start.max()))


def _from_rest(near: Rows, far: Rows, width: float, side: int, shares: Array) -> float:
    """Greatest jerk of the first (side 0) or last interval, which begins or ends at rest."""
    of = [near.jerk[0], far.jerk[0]] if side == 0 else [near.jerk[-1], far.jerk[-1]]
    sign, share = 1.0 - 2.0 * side, shares[0 if side == 0 else -1]
    ratio = 0.0
    for s in (0.0, width):
        for rows in of:
            jerk = rows[:, 0] + sign * 3 * s * rows[:, 1] + 4.5 * s * s * rows[:, 2]
            ratio = max(ratio, float((np.abs(jerk) / share).max(initial=0.0)))
    return 1 / ratio


def _rows(
    places: tuple[Rows, ...],
    held: NDArray[np.bool_],
    caps: Array,
    implied: Array,
    shares: _Margins,
    speeds: Array,
    moving: tuple[bool, bool],
) -> SplineRows:
    """Rows of a program: those that are held, and speeds at its nodes; inside intervals too, where they were tightened.

    Args:
        places: Rows where intervals begin, inside them, and where they end. Shape (N,) each.
        held: Which of them, at the `HELD` places. Shape (4, 2, N, K + L + P).
        caps, implied: Greatest squared speed at the nodes by the rows of speed, and by what the coefficients may be.
            Shape (N + 1,).
        shares: Of the bounds, in the intervals.
        speeds: At the `HELD` places, see `_Tight`. Shape (4, N).
        moving: Whether the program begins and ends with a known motion, whose own rows are left out.
    """
    count, first = len(caps) - 1, places[0].speed.shape[1]
    second = first + places[0].acceleration.shape[1]
    nodes = np.flatnonzero((caps < implied * (1 - ROUNDING_SHARE)) & np.isfinite(caps))
    nodes = nodes[(nodes >= int(moving[0])) & (nodes <= count - int(moving[1]))]
    parts = [_speeds(np.minimum(nodes, count - 1), (nodes == count).astype(float), 1 / caps[nodes])]
    slow = np.flatnonzero(shares.speed < SETTINGS.seam * (1 - SETTINGS.room))
    for inside, rows in zip(INSIDE, places[1:-1], strict=True):
        most = (rows.speed[slow].max(axis=1, initial=0.0) / shares.speed[slow]) ** 2
        parts.append(_speeds(slow, np.full(len(slow), inside), most))
    for which, at_place, speed in zip(held, HELD, speeds, strict=True):
        inside, rows, own = (0.0, *INSIDE, 1.0)[at_place], places[at_place], which[:, :, first:second].copy()
        if inside in (0.0, 1.0) and moving[int(inside)]:
            own[:, -int(inside)] = False
        sign, at, row = np.nonzero(own)
        p, q, r = rows.acceleration[at, row].T
        to, place = 1.0 - 2.0 * sign, np.full(len(at), inside)
        of = to[:, None] * np.stack([q, p / 2, np.zeros(len(at))], axis=1)
        parts.append(
            SplineRows(at, place, place, of, shares.acceleration[at, row] - to * r, np.zeros(len(at), dtype=bool))
        )
        sign, at, row = np.nonzero(which[:, :, second:])
        p, q, r = rows.jerk[at, row].T
        of = (1.0 - 2.0 * sign)[:, None] * np.stack([speed[at] * r, speed[at] * q / 2, p / 2], axis=1)
        root = np.full(len(at), _jerk_of(inside))
        parts.append(
            SplineRows(at, np.full(len(at), inside), root, of, shares.jerk[at, row], np.ones(len(at), dtype=bool))
        )
    return SplineRows(*(np.concatenate(kind) for kind in zip(*parts, strict=True)))


def _jerk_of(inside: float) -> float:
    """Where in an interval x''/2 v is the jerk that the motion holds over the half of it that a place lies in.

    With a = a0 + x''/2 (s - s0), two jerks of half the time T each lead to the speed and acceleration at its end where
    they are x''/2 (v0 + a0 T / 6) and x''/2 (v0 + a0 5 T / 6), but for terms of second order.
    """
    return 1 / 6 if inside < 0.5 else 5 / 6


def _speed_ratios(spline: Spline, b: Array) -> Array:
    """Speeds at the `HELD` places over those where the jerk is taken, during a motion. Shape (4, N)."""
    x, slope = spline.at_nodes(b)
    bend = np.diff(slope) / spline.h

    def at(inside: float) -> Array:
        way = inside * spline.h
        return np.asarray(np.maximum(x[:-1] + way * (slope[:-1] + way * bend / 2), SETTINGS.dive * x[:-1]))

    places = [(0.0, *INSIDE, 1.0)[k] for k in HELD]
    return np.sqrt([at(inside) / at(_jerk_of(inside)) for inside in places])


def _speeds(interval: NDArray[np.intp], fraction: Array, of: Array) -> SplineRows:
    """Squared speeds times so much that are at most one."""
    every, none = np.stack([of, 0 * of, 0 * of], axis=1), np.zeros(len(of), dtype=bool)
    return SplineRows(interval, fraction, fraction, every, np.ones(len(of)), none)


def _reached(rows: Rows, up: Array, rates: Array, shares: _Margins) -> NDArray[np.bool_]:
    """Rows of acceleration and jerk that a motion may reach. Shape (N, K + L + P).

    Args:
        rows: In N intervals.
        up: Greatest squared speed of any motion. Shape (N,).
        rates: Greatest acceleration. Shape (N,).
        shares: Of the bounds.
    """
    a, j, top = np.abs(rows.acceleration), np.abs(rows.jerk), np.sqrt(up)
    of_a = a[:, :, 0] * rates[:, None] + a[:, :, 1] * up[:, None] + a[:, :, 2]
    bent = j[:, :, 1] * (top * rates)[:, None] + j[:, :, 2] * (top**3)[:, None]
    with np.errstate(divide="ignore", invalid="ignore"):
        sharp = np.where(j[:, :, 0] > 0, (1 + bent) / j[:, :, 0], np.inf).min(axis=1, initial=np.inf)
        of_j = np.where(j[:, :, 0] > 0, j[:, :, 0] * sharp[:, None], 0.0) + bent
    none = np.zeros(rows.speed.shape, dtype=bool)
    most = SETTINGS.binding
    return np.concatenate([none, of_a > most * shares.acceleration, of_j > most * shares.jerk], axis=1)
