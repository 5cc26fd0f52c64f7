"""The fastest motion over a stretch of a path: its limits as rows, solved, looked at between the nodes, and tightened.

Rows hold at both ends of every interval. What they are passed by inside, where joints and curvature bend, is measured
on the motion itself; the bounds of these intervals are lowered by as much, and the stretch is solved again. Long
stretches are solved in windows: each comes to rest at its end, so that a motion beyond the next seam is known to exist.
"""

from __future__ import annotations

from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ocp.errors import ProblemError, SolveError
from ocp.schedule.grid import Grid, reach
from ocp.schedule.passes import passes
from ocp.schedule.profile import Array, SpeedProfile, joined
from ocp.schedule.program import End, Spline, SplineRows, least_time
from ocp.schedule.rows import Rows
from ocp.schedule.window import INSIDE, ROOM, Motion, Stretch, Window, demanded, profile_of

__all__ = ["fastest_over"]

KEPT = 1e-9
"""Limits count as kept up to this, relative."""
ROUNDS = 20
"""Of tightening."""
AROUND = 40
"""Intervals on either side of one that passes a limit, which are planned again with it."""
MOST, LEFT_OUT = 1.5, 1.02
"""Largest ratio by which a bound is lowered in a round, by a row that was kept to and by one that was left out."""
ROUGH, ACCURACY = 1e-3, 1e-10
"""Of the time of a window, relative: in the first round, which is to find what the rows miss, and afterwards."""
CENTER, CENTER_AGAIN = 1.0, 0.1
"""Where the interior point begins, the first time and from a solution."""
AGAIN = 0.9
"""Squared speed to start again from, over that of the solution."""
START = 0.3
"""Squared speed to start from, over that of a fastest steady motion that accelerates as it may."""
WINDOW, OVERLAP = 2000, 400
"""Intervals of a window, and those at its end that the next one plans again."""
SEAM = 1 - 1e-3
"""Share of the bounds that a window uses behind its seam, so that the next has room."""
NEVER = 0.98
"""Rows that reach less than this share of their bound whatever the motion are left out..."""
NEAR = 0.5
"""...and, once a motion is known, those that came less near to it in an interval or beside it."""


class _Margins(NamedTuple):
    """Share of the bounds of speed, acceleration and jerk that each interval of a stretch may use. Shape (N,) each."""

    speed: Array
    acceleration: Array
    jerk: Array


class _Tight(NamedTuple):
    """What the intervals of a window are held to.

    Attributes:
        margins: Lowered where bounds are passed between the places of the rows.
        times: How often they were, by the kind of bound. Shape (3, N).
        near: Rows that matter, upwards and downwards. Shape (2, N, K + L + P).
    """

    margins: _Margins
    times: Array
    near: NDArray[np.bool_]

    @classmethod
    def of(cls, window: Window) -> _Tight:
        """What every window begins with."""
        count = window.last - window.first
        margins = _Margins(*np.full((3, count), 1 - ROOM))
        return cls(margins, np.zeros((3, count)), np.ones((2, count, window.rows[0].total), dtype=bool))

    def part(self, first: int, last: int) -> _Tight:
        """That of some intervals, which changes with it."""
        part = slice(first, last)
        return _Tight(_Margins(*(margin[part] for margin in self.margins)), self.times[:, part], self.near[:, part])

    def lower(self, used: Array, rows: Rows) -> None:
        """Lower bounds that were passed: more, where that was not enough."""
        most = np.where(self.near, np.minimum(used, MOST), np.minimum(used, LEFT_OUT)).max(axis=0)
        ends = np.cumsum([0, *(kind.shape[1] for kind in rows)])
        for margin, times, (a, z) in zip(self.margins, self.times, pairwise(ends), strict=True):
            over = most[:, a:z].max(axis=1, initial=0.0)
            at = np.flatnonzero(over > 1)
            margin[at] /= np.minimum(1 + (over[at] - 1 + ROOM / 4) * 2.0 ** times[at], MOST)
            times[at] += 1


def fastest_over(stretch: Stretch) -> SpeedProfile:
    """The fastest motion over a stretch, its distance that along the path.

    Raises:
        ProblemError: Limits that no motion keeps, by place.
    """
    if not np.any(stretch.grid.rows.jerk[:, :, 0]):
        return _settled(Window.of(stretch, stretch.first, stretch.last, stretch.ends), stretch.last, None)[0]
    parts: list[SpeedProfile] = []
    begin, state, margins = stretch.first, stretch.ends[0], None
    while True:
        end = stretch.last if stretch.last - begin < WINDOW + OVERLAP else begin + WINDOW
        last = end == stretch.last
        seam = end if last else end - OVERLAP
        goal = stretch.ends[1] if last else (0.0, 0.0)
        window = Window.of(stretch, begin, end, (state, goal))
        part, state, margins = _settled(window, seam, margins)
        parts.append(part)
        if last:
            return joined(parts)
        begin = seam


def _settled(window: Window, seam: int, before: _Margins | None) -> tuple[SpeedProfile, tuple[float, float], _Margins]:
    """The motion of a window up to its seam, tightened until it keeps all limits there and a good way behind.

    Args:
        window: What to plan.
        seam: Node at which the next window begins, or the last.
        before: Margins that the window before found behind its seam.

    Returns:
        The motion, squared speed and slope at the seam, and the margins behind it.
    """
    tight = _Tight.of(window)
    if before is not None:
        for margin, own in zip(tight.margins, before, strict=True):
            margin[: len(own)] = own
    kept, seen = seam - window.first, min(seam + OVERLAP // 2, window.last) - window.first
    x, slope = _tightened(window, tight, seam, seen, None)
    state = float(x[kept]), 0.0 if slope is None else float(slope[kept])
    behind = _Margins(*(margin[kept:] for margin in tight.margins))
    return profile_of(window, x[: kept + 1], slope), state, behind


def _tightened(window: Window, tight: _Tight, seam: int, seen: int, start: Motion | None) -> tuple[Array, Array | None]:
    """Squared speeds and, where jerks are limited, slopes at the nodes: those of a motion that keeps all limits.

    Where few intervals still pass them, these are planned again with their neighbours, between the motions beside.

    Args:
        window, seam: As of `_settled`.
        tight: What it is held to, changed in place.
        seen: Intervals of the window that must keep the limits: the first so many.
        start: Squared speeds and slopes to start from, if a motion is known.
    """
    for _ in range(ROUNDS):
        x, slope = _solved(window, tight, seam, start)
        used = demanded(window, profile_of(window, x, slope))
        over = used[:, :seen].max(axis=(0, 2), initial=0.0) > 1 + KEPT
        rough = start is None and slope is not None
        if not over.any() and not rough:
            return x, slope
        tight.lower(used, window.rows[0])
        if slope is None:
            continue
        np.logical_or(used > NEAR, False if rough else tight.near, out=tight.near)
        start = x, slope
        parts = _about(np.flatnonzero(over), len(x) - 1)
        if rough or 2 * sum(last - first for first, last in parts) > len(x):
            continue
        try:
            for first, last in parts:
                part, own, nodes = window.part(first, last, x, slope), tight.part(first, last), slice(first, last + 1)
                x[nodes], slope[nodes] = _tightened(part, own, seam, min(seen, last) - first, (x[nodes], slope[nodes]))
        except ProblemError:
            continue  # too short to change the motion in
        return x, slope
    worst = used[:, :seen].max(axis=(0, 2))
    place, most = float(window.nodes[worst.argmax()]), float(worst.max())
    message = f"the limits are passed by {most - 1:.2g} at {place:g} m, where the path or its joints bend sharply"
    raise ProblemError(message, name="limits", value=most, limit=1.0, time=place)


def _about(intervals: NDArray[np.intp], count: int) -> list[tuple[int, int]]:
    """First and last nodes of stretches about some of so many intervals."""
    found: list[tuple[int, int]] = []
    for at in intervals.tolist():
        first, last = at - AROUND, at + 1 + AROUND
        first, last = (first if first > 1 else 0), (last if last < count - 1 else count)
        if found and first <= found[-1][1]:
            found[-1] = found[-1][0], last
        else:
            found.append((first, last))
    return found


def _solved(window: Window, tight: _Tight, seam: int, start: Motion | None) -> tuple[Array, Array | None]:
    """Squared speeds at the nodes, and their slopes where jerks are limited."""
    if np.any(window.grid.rows.jerk[:, :, 0]):
        return _with_jerk(window, tight, seam, start)
    return _without_jerk(window, tight.margins), None


def _without_jerk(window: Window, margins: _Margins) -> Array:
    grid = window.grid
    left, right = window.rows[0], window.rows[-1]
    h = np.diff(window.nodes)[:, None]
    caps = np.minimum(_beside(grid.asked) ** 2, _by_rows(grid, 0, len(h)) * _beside(margins.speed) ** 2)
    of = left.acceleration, right.acceleration
    p = np.concatenate([of[0][:, :, 0], of[1][:, :, 0] + 2 * h * of[1][:, :, 1]], axis=1)
    q, rest = (np.concatenate([side[:, :, seat] for side in of], axis=1) for seat in (1, 2))
    bound = margins.acceleration[:, None]
    caps[[0, -1]] = 0.0
    return passes(window.nodes, caps, p, q, -bound - rest, bound - rest)


def _by_rows(grid: Grid, begin: int, end: int) -> Array:
    """Squared speed that the rows of speed leave at nodes, on both sides."""
    most = grid.rows.speed[begin : end + 1].max(axis=1, initial=0.0)
    at = np.flatnonzero((grid.jumps >= begin) & (grid.jumps <= end))
    before = grid.before.speed[at].max(axis=1, initial=0.0)
    most[grid.jumps[at] - begin] = np.maximum(most[grid.jumps[at] - begin], before)
    with np.errstate(divide="ignore"):
        return np.asarray(most**-2.0)


def _beside(of_intervals: Array) -> Array:
    """The lesser of both neighbours at the nodes."""
    return np.asarray(np.minimum(np.append(of_intervals, np.inf), np.insert(of_intervals, 0, np.inf)))


def _with_jerk(window: Window, tight: _Tight, seam: int, known: Motion | None) -> Motion:
    """Squared speeds and slopes at the nodes of a window."""
    begin, end, ends, grid, nodes = window.first, window.last, window.ends, window.grid, window.nodes
    left, middle, right = (window.rows[k] for k in (0, 2, 4))
    at_rest = ends[0][0] == 0, ends[1][0] == 0
    room = np.where(np.arange(begin, end) < seam, 1.0, SEAM)
    shares = _Margins(*(margin * room for margin in tight.margins))
    asked = grid.asked[begin:end] ** 2 * room**2
    caps = np.minimum(_beside(asked), _by_rows(grid, begin, end) * _beside(shares.speed) ** 2)
    up, rates = reach(nodes, caps, left, right, at_rest)
    # from rest: the first interval, of constant jerk, is no part of the program
    low, high = int(at_rest[0]), len(nodes) - int(at_rest[1])
    states = [End(x=x, slope=slope) for x, slope in ends]
    for side, rest in enumerate(at_rest):
        if rest:
            node, width = (1, nodes[1] - nodes[0]) if side == 0 else (-2, nodes[-1] - nodes[-2])
            states[side] = End(rest=float(width))
            outer, inside = (left, right) if side == 0 else (right, left)
            sharp = _from_rest(outer, inside, float(width), side, shares.jerk)
            caps[node] = min(caps[node], (9 * width**2 * sharp / 2) ** (2 / 3))
    inner = slice(low, high)
    cells = slice(low, high - 1)
    spline = Spline(nodes[inner])
    with np.errstate(divide="ignore"):
        between = (middle.speed.max(axis=1, initial=0.0) / shares.speed) ** -2.0
    most = np.concatenate([caps[inner][:1], np.minimum(asked, between)[cells], caps[inner][-1:]])
    if known is None:
        start = _start(nodes, caps, up, at_rest)[inner]
        b = np.concatenate([start[:1], np.minimum(start[:-1], start[1:]), start[-1:]])
    else:
        b = spline.through(known[0][inner], known[1][inner])
        b = AGAIN * np.maximum(b, 1e-9 * b.max())
    for side, rest in enumerate(at_rest):
        if not rest:
            most[[0, 1] if side == 0 else [-1, -2]] = np.inf
    own_shares = _Margins(*(share[cells] for share in shares))
    moving = (not at_rest[0], not at_rest[1])
    places = tuple(rows.of(cells) for rows in window.rows)
    jumps = np.isin(np.arange(begin + low + 1, begin + high), grid.jumps)
    rows = _rows(places, tight.near[:, cells], jumps, caps[inner], up[inner], rates[cells], own_shares, moving)
    try:
        b = _coefficients(spline, rows, most, (states[0], states[1]), b, known is not None)
    except SolveError as error:
        message = f"{error}; raise the limits, or keep the path away from singular arms"
        details = {"name": "limits", "value": error.value, "limit": error.limit, "time": error.time}
        raise ProblemError(message, **details) from error
    x, slope = np.zeros(len(nodes)), np.zeros(len(nodes))
    x[inner], slope[inner] = spline.at_nodes(b)
    return x, slope


def _coefficients(
    spline: Spline, rows: SplineRows, most: Array, ends: tuple[End, End], start: Array, again: bool
) -> Array:
    """Solve a program, from its last solution if `again`; where that leads nowhere, from further inside."""
    if not again:
        return least_time(spline, rows, most, ends, start, accuracy=ROUGH, center=CENTER)
    try:
        return least_time(spline, rows, most, ends, start, accuracy=ACCURACY, center=CENTER_AGAIN)
    except SolveError:
        return least_time(spline, rows, most, ends, 0.3 * start, accuracy=ACCURACY, center=CENTER)


def _start(nodes: Array, caps: Array, up: Array, at_rest: tuple[bool, bool]) -> Array:
    """Squared speeds to start from."""
    away = np.inf * np.ones(len(nodes))
    for rest, s, node in ((at_rest[0], nodes - nodes[0], 1), (at_rest[1], nodes[-1] - nodes, -2)):
        if rest:
            away = np.minimum(away, caps[node] * (s / s[node]) ** (4 / 3))
    start = START * np.minimum(up, np.minimum(caps, away))
    return np.asarray(np.maximum(start, 1e-9 * start.max()))


def _from_rest(near: Rows, far: Rows, width: float, side: int, shares: Array) -> float:
    """Greatest jerk of the first (side 0) or last interval, which begins or ends at rest."""
    of = [near.jerk[0], far.jerk[0]] if side == 0 else [near.jerk[-1], far.jerk[-1]]
    sign, share = 1.0 - 2.0 * side, float(shares[0 if side == 0 else -1])
    ratio = 0.0
    for s in (0.0, width):
        for rows in of:
            jerk = rows[:, 0] + sign * 3 * s * rows[:, 1] + 4.5 * s * s * rows[:, 2]
            ratio = max(ratio, float(np.abs(jerk).max(initial=0.0)))
    return share / ratio


def _rows(
    places: tuple[Rows, ...],
    near: NDArray[np.bool_],
    jumps: NDArray[np.bool_],
    caps: Array,
    up: Array,
    rates: Array,
    shares: _Margins,
    moving: tuple[bool, bool],
) -> SplineRows:
    """Rows of a program: speeds at its nodes, accelerations there and before a jump, jerks at both ends of an interval.

    Intervals that were tightened have them in their middle, too, and those of speed wherever they are looked at.

    Args:
        places: Rows where intervals begin, inside them, and where they end. Shape (N,) each.
        near: Which of them matter, upwards and downwards. Shape (2, N, K + L + P).
        jumps: Whether rows jump at its end. Shape (N,).
        caps, up: Greatest squared speed at the nodes, by the rows of speed and by any motion. Shape (N + 1,).
        rates: Greatest acceleration in the intervals. Shape (N,).
        shares: Of the bounds, in the intervals.
        moving: Whether the program begins and ends with a known motion, whose own rows are left out.
    """
    count = len(rates)
    nodes = np.arange(count + 1)[int(moving[0]) : count + 1 - int(moving[1])]
    nodes = nodes[np.isfinite(caps[nodes])]
    speed = np.zeros((len(nodes), 3))
    speed[:, 0] = 1 / caps[nodes]
    interval, fraction = np.minimum(nodes, count - 1), (nodes == count).astype(float)
    parts = [_part(interval, fraction, fraction, speed, np.ones(len(nodes)), False)]
    slow = np.flatnonzero(shares.speed < SEAM * (1 - ROOM))
    for inside, rows in zip(INSIDE, places[1:-1], strict=True):
        speed = np.zeros((len(slow), 3))
        speed[:, 0] = (rows.speed[slow].max(axis=1, initial=0.0) / shares.speed[slow]) ** 2
        place = np.full(len(slow), inside)
        parts.append(_part(slow, place, place, speed, np.ones(len(slow)), False))

    near = near | np.roll(near, 1, axis=1) | np.roll(near, -1, axis=1)
    first, second = places[0].speed.shape[1], places[0].speed.shape[1] + places[0].acceleration.shape[1]
    near_a, near_j = near[:, :, first:second], near[:, :, second:]
    rate, share = -_beside(-rates), _beside(shares.acceleration)
    last = jumps | (np.arange(count) == count - 1)
    for side, rows in ((0, places[0]), (1, places[-1])):
        node = np.arange(count) + side
        here = (last if side else np.ones(count, dtype=bool)) & ((node > 0) | (not moving[0]))
        here &= (node < count) | (not moving[1])
        of = here[None, :, None] & near_a
        parts += _accelerations(rows, np.arange(count), float(side), share[node], rate[node], up[node], of)
        parts += _jerks(rows, np.arange(count), float(side), shares.jerk, rate[node], up[node], near_j)
    again = np.flatnonzero((shares.acceleration < SEAM * (1 - ROOM)) | (shares.jerk < SEAM * (1 - ROOM)))
    rows, top = places[2].of(again), np.maximum(up[again], up[again + 1])
    parts += _accelerations(rows, again, 0.5, shares.acceleration[again], rates[again], top, near_a[:, again])
    parts += _jerks(rows, again, 0.5, shares.jerk[again], rates[again], top, near_j[:, again])
    return SplineRows(*(np.concatenate(kind) for kind in zip(*parts, strict=True)))


def _part(interval: Any, fraction: Array, root: Array, of: Array, bound: Array, jerk: bool) -> SplineRows:
    return SplineRows(interval, fraction, root, of, bound, np.full(len(interval), jerk))


def _accelerations(
    rows: Rows, interval: Any, fraction: float, share: Array, rate: Array, up: Array, near: NDArray[np.bool_]
) -> list[SplineRows]:
    """Both sides of the rows of acceleration at one place of each interval, where a motion may reach them."""
    a = np.abs(rows.acceleration)
    reached = a[:, :, 0] * rate[:, None] + a[:, :, 1] * up[:, None] + a[:, :, 2] > NEVER * share[:, None]
    parts = []
    for sign, matters in zip((1.0, -1.0), near, strict=True):
        at, row = np.nonzero(reached & matters)
        p, q, r = rows.acceleration[at, row].T
        of, place = np.stack([q, p / 2, np.zeros(len(at))], axis=1), np.full(len(at), fraction)
        parts.append(_part(interval[at], place, place, sign * of, share[at] - sign * r, False))
    return parts


def _jerks(
    rows: Rows, interval: Any, fraction: float, share: Array, rate: Array, up: Array, near: NDArray[np.bool_]
) -> list[SplineRows]:
    """Both sides of the rows of jerk at one place of each interval, where a motion may reach them."""
    j, top = np.abs(rows.jerk), np.sqrt(up)
    bent = j[:, :, 1] * (top * rate)[:, None] + j[:, :, 2] * (top**3)[:, None]
    with np.errstate(divide="ignore", invalid="ignore"):
        sharp = np.where(j[:, :, 0] > 0, (1 + bent) / j[:, :, 0], np.inf).min(axis=1, initial=np.inf)
        reached = np.where(j[:, :, 0] > 0, j[:, :, 0] * sharp[:, None], 0.0) + bent > NEVER * share[:, None]
    parts = []
    for sign, matters in zip((1.0, -1.0), near, strict=True):
        at, row = np.nonzero(reached & matters)
        p, q, r = rows.jerk[at, row].T
        of = np.stack([r, q / 2, p / 2], axis=1)
        # the jerk that the motion holds over a half of the interval is that at its middle
        place, root = np.full(len(at), fraction), np.full(len(at), 0.25 + 0.5 * fraction)
        parts.append(_part(interval[at], place, root, sign * of, share[at], True))
    return parts
