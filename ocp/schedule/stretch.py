"""The fastest motion over a stretch of a path: its limits as rows, solved, looked at between the nodes, and tightened.

Rows hold at both ends of every interval. What they are passed by inside, where joints and curvature bend, is measured
on the motion itself; the bounds of these intervals are lowered by as much, and the stretch is solved again. Long
stretches are solved in windows: each comes to rest at its end, so that a motion beyond the next seam is known to exist.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ocp.errors import ProblemError, SolveError
from ocp.schedule.grid import Grid, reach
from ocp.schedule.limits import JointPath, LineLimits, PathLike
from ocp.schedule.passes import passes
from ocp.schedule.profile import Array, LineMotion, SpeedProfile, advanced, joined, through
from ocp.schedule.program import End, Spline, SplineRows, least_time
from ocp.schedule.rows import Rows, rows_at

__all__ = ["Stretch", "fastest_over"]

KEPT, ROOM = 1e-9, 3e-4
"""Limits count as kept up to the first, relative; the second is left for what lies between the places looked at."""
INSIDE = (0.25, 0.5, 0.75)
"""Where each constant jerk is looked at between its ends, as shares of its time."""
ROUNDS = 8
"""Of tightening."""
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
"""Rows that reach less than this share of their bound whatever the motion are left out."""


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
    ends: tuple[tuple[float, float], tuple[float, float]] = ((0.0, 0.0), (0.0, 0.0))


class _Window(NamedTuple):
    """Intervals of a program: the first node in the grid, the nodes (N + 1,), and rows at both ends of each (N,)."""

    begin: int
    nodes: Array
    left: Rows
    right: Rows


class _Margins(NamedTuple):
    """Share of the bounds of speed, acceleration and jerk that each interval of a stretch may use. Shape (N,) each."""

    speed: Array
    acceleration: Array
    jerk: Array


def fastest_over(stretch: Stretch) -> SpeedProfile:
    """The fastest motion over a stretch, its distance that along the path.

    Raises:
        ProblemError: Limits that no motion keeps, by place.
    """
    if not np.any(stretch.grid.rows.jerk[:, :, 0]):
        return _settled(stretch, stretch.last, None)[0]
    parts: list[SpeedProfile] = []
    begin, state, margins = stretch.first, stretch.ends[0], None
    while True:
        end = stretch.last if stretch.last - begin < WINDOW + OVERLAP else begin + WINDOW
        last = end == stretch.last
        seam = end if last else end - OVERLAP
        goal = stretch.ends[1] if last else (0.0, 0.0)
        window = replace(stretch, first=begin, last=end, ends=(state, goal))
        part, state, margins = _settled(window, seam, margins)
        parts.append(part)
        if last:
            return joined(parts)
        begin = seam


def _settled(window: Stretch, seam: int, before: _Margins | None) -> tuple[SpeedProfile, tuple[float, float], _Margins]:
    """The motion of a window up to its seam, tightened until it keeps all limits there and a good way behind.

    Args:
        window: What to plan.
        seam: Node at which the next window begins, or the last.
        before: Margins that the window before found behind its seam.

    Returns:
        The motion, squared speed and slope at the seam, and the margins behind it.
    """
    margins = _Margins(*np.full((3, window.last - window.first), 1 - ROOM))
    if before is not None:
        for margin, own in zip(margins, before, strict=True):
            margin[: len(own)] = own
    kept, seen = seam - window.first, min(seam + OVERLAP // 2, window.last)
    b: Array | None = None
    for number in range(ROUNDS):
        x, slope, b = _solved(window, margins, seam, b)
        profile = _profile(window, x[: seen - window.first + 1], slope)
        excess = _excess(window, seen, profile)
        if excess.max() <= 1 + KEPT and (number or slope is None):
            state = float(x[kept]), 0.0 if slope is None else float(slope[kept])
            behind = _Margins(*(margin[kept:] for margin in margins))
            return _profile(window, x[: kept + 1], slope), state, behind
        for margin, over in zip(margins, excess, strict=True):
            passed = np.flatnonzero(over > 1)
            margin[passed] /= np.minimum(1 + (over[passed] - 1 + ROOM / 4) * 2**number, 1.5)
    k = int(excess.max(axis=0).argmax())
    place, worst = float(window.grid.distance[window.first + k]), float(excess.max())
    message = f"the limits are passed by {worst - 1:.2g} at {place:g} m, where the path or its joints bend sharply"
    raise ProblemError(message, name="limits", value=worst, limit=1.0, time=place)


def _solved(window: Stretch, margins: _Margins, seam: int, b: Array | None) -> tuple[Array, Array | None, Array | None]:
    """Squared speeds at the nodes, their slopes where jerks are limited, and the coefficients that both come from."""
    if np.any(window.grid.rows.jerk[:, :, 0]):
        return _window(window, margins, seam, b)
    return _without_jerk(window, margins), None, None


def _without_jerk(stretch: Stretch, margins: _Margins) -> Array:
    grid = stretch.grid
    left, right = grid.ends()
    s, h = grid.distance, np.diff(grid.distance)[:, None]
    caps = np.minimum(_beside(grid.asked) ** 2, _by_rows(grid, 0, len(h)) * _beside(margins.speed) ** 2)
    of = left.acceleration, right.acceleration
    p = np.concatenate([of[0][:, :, 0], of[1][:, :, 0] + 2 * h * of[1][:, :, 1]], axis=1)
    q, rest = (np.concatenate([side[:, :, seat] for side in of], axis=1) for seat in (1, 2))
    bound = margins.acceleration[:, None]
    caps[[0, -1]] = 0.0
    return passes(s, caps, p, q, -bound - rest, bound - rest)


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


def _window(stretch: Stretch, margins: _Margins, seam: int, guess: Array | None) -> tuple[Array, Array, Array]:
    """Squared speeds and slopes at the nodes of a window, and the coefficients that they come from."""
    begin, end, ends = stretch.first, stretch.last, stretch.ends
    grid = stretch.grid
    at_rest = ends[0][0] == 0, ends[1][0] == 0
    nodes = grid.distance[begin : end + 1]
    room = np.where(np.arange(begin, end) < seam, 1.0, SEAM)
    shares = _Margins(*(margin * room for margin in margins))
    left, right = _sides(grid, begin, end)
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
            near, far = (left, right) if side == 0 else (right, left)
            sharp = _from_rest(near, far, float(width), side, shares.jerk)
            caps[node] = min(caps[node], (9 * width**2 * sharp / 2) ** (2 / 3))
    inner = slice(low, high)
    cells = slice(low, high - 1)
    spline = Spline(nodes[inner])
    with np.errstate(divide="ignore"):
        between = (grid.middle[begin:end].max(axis=1, initial=0.0) / shares.speed) ** -2.0
    most = np.concatenate([caps[inner][:1], np.minimum(asked, between)[cells], caps[inner][-1:]])
    if guess is None:
        start = _start(nodes, caps, up, at_rest)[inner]
        b = np.concatenate([start[:1], np.minimum(start[:-1], start[1:]), start[-1:]])
    else:
        b = AGAIN * guess
    for side, rest in enumerate(at_rest):
        if not rest:
            most[[0, 1] if side == 0 else [-1, -2]] = np.inf
    window = _Window(begin + low, nodes[inner], left.of(cells), right.of(cells))
    own_shares = _Margins(*(share[cells] for share in shares))
    moving = (not at_rest[0], not at_rest[1])
    rows = _rows(stretch, window, caps[inner], up[inner], rates[cells], own_shares, moving)
    try:
        b = _coefficients(spline, rows, most, (states[0], states[1]), b, guess is not None)
    except SolveError as error:
        message = f"{error}; raise the limits, or keep the path away from singular arms"
        details = {"name": "limits", "value": error.value, "limit": error.limit, "time": error.time}
        raise ProblemError(message, **details) from error
    x, slope = np.zeros(len(nodes)), np.zeros(len(nodes))
    x[inner], slope[inner] = spline.at_nodes(b)
    return x, slope, b


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


def _sides(grid: Grid, begin: int, end: int) -> tuple[Rows, Rows]:
    """Rows at the first and last place of intervals begin to end."""
    left = grid.rows.of(slice(begin, end))
    right = Rows(*(kind[begin + 1 : end + 1].copy() for kind in grid.rows))
    at = np.flatnonzero((grid.jumps > begin) & (grid.jumps <= end))
    for kind, before in zip(right, grid.before, strict=True):
        kind[grid.jumps[at] - begin - 1] = before[at]
    return left, right


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
    stretch: Stretch, window: _Window, caps: Array, up: Array, rates: Array, shares: _Margins, moving: tuple[bool, bool]
) -> SplineRows:
    """Rows of a program: speeds at its nodes, accelerations there and before a jump, jerks at both ends of an interval.

    Intervals that were tightened have all of them in their middle, too.

    Args:
        stretch, window: What it is of.
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

    rate, share = -_beside(-rates), _beside(shares.acceleration)
    grid, first = stretch.grid, window.begin
    jumps = np.isin(np.arange(first + 1, first + count + 1), grid.jumps) | (np.arange(count) == count - 1)
    for side, rows in enumerate((window.left, window.right)):
        node = np.arange(count) + side
        here = (jumps if side else np.ones(count, dtype=bool)) & ((node > 0) | (not moving[0]))
        here &= (node < count) | (not moving[1])
        parts += _accelerations(rows, np.arange(count), float(side), share[node], rate[node], up[node], here)
        parts += _jerks(rows, np.arange(count), float(side), shares.jerk, rate[node], up[node])
    again = np.flatnonzero((shares.acceleration < SEAM * (1 - ROOM)) | (shares.jerk < SEAM * (1 - ROOM)))
    middle = (window.nodes[again] + window.nodes[again + 1]) / 2
    rows = rows_at(stretch.path, stretch.limits, stretch.joints, middle)
    top = np.maximum(up[again], up[again + 1])
    every = np.ones(len(again), dtype=bool)
    parts += _accelerations(rows, again, 0.5, shares.acceleration[again], rates[again], top, every)
    parts += _jerks(rows, again, 0.5, shares.jerk[again], rates[again], top)
    return SplineRows(*(np.concatenate(kind) for kind in zip(*parts, strict=True)))


def _part(interval: Any, fraction: Array, root: Array, of: Array, bound: Array, jerk: bool) -> SplineRows:
    return SplineRows(interval, fraction, root, of, bound, np.full(len(interval), jerk))


def _accelerations(
    rows: Rows, interval: Any, fraction: float, share: Array, rate: Array, up: Array, here: Any
) -> list[SplineRows]:
    """Both sides of the rows of acceleration at one place of each interval, where any motion may reach them."""
    a = np.abs(rows.acceleration)
    reached = a[:, :, 0] * rate[:, None] + a[:, :, 1] * up[:, None] + a[:, :, 2]
    at, row = np.nonzero(here[:, None] & (reached > NEVER * share[:, None]))
    p, q, r = rows.acceleration[at, row].T
    of, place = np.stack([q, p / 2, np.zeros(len(at))], axis=1), np.full(len(at), fraction)
    return [_part(interval[at], place, place, sign * of, share[at] - sign * r, False) for sign in (1.0, -1.0)]


def _jerks(rows: Rows, interval: Any, fraction: float, share: Array, rate: Array, up: Array) -> list[SplineRows]:
    """Both sides of the rows of jerk at one place of each interval, where any motion may reach them."""
    j, top = np.abs(rows.jerk), np.sqrt(up)
    bent = j[:, :, 1] * (top * rate)[:, None] + j[:, :, 2] * (top**3)[:, None]
    with np.errstate(divide="ignore", invalid="ignore"):
        sharp = np.where(j[:, :, 0] > 0, (1 + bent) / j[:, :, 0], np.inf).min(axis=1, initial=np.inf)
        reached = np.where(j[:, :, 0] > 0, j[:, :, 0] * sharp[:, None], 0.0) + bent
    at, row = np.nonzero(reached > NEVER * share[:, None])
    p, q, r = rows.jerk[at, row].T
    of = np.stack([r, q / 2, p / 2], axis=1)
    # the jerk that the motion holds over a half of the interval is that at its middle
    place, root = np.full(len(at), fraction), np.full(len(at), 0.25 + 0.5 * fraction)
    return [_part(interval[at], place, root, sign * of, share[at], True) for sign in (1.0, -1.0)]


def _profile(stretch: Stretch, x: Array, slope: Array | None) -> SpeedProfile:
    """The motion with squared speeds, and their slopes where jerks are limited, at the first nodes of a stretch."""
    s = stretch.grid.distance[stretch.first : stretch.first + len(x)]
    v = np.sqrt(x)
    if slope is not None:
        return through(s, v, slope[: len(x)] / 2)
    t = np.concatenate([[0.0], np.cumsum(2 * np.diff(s) / (v[:-1] + v[1:]))])
    return SpeedProfile(t, s, v, np.append(np.diff(x) / (2 * np.diff(s)), 0.0), np.zeros(len(s) - 1))


def _excess(stretch: Stretch, seam: int, profile: SpeedProfile) -> Array:
    """Largest demand of speed, acceleration and jerk over its limit in each interval up to the seam. Shape (3, N)."""
    count = seam - stretch.first
    each = len(profile.jerk) // count
    found = np.zeros((3, count))
    left, right = _sides(stretch.grid, stretch.first, seam)
    duration = np.diff(profile.t)

    def look(rows: Rows, piece: NDArray[np.intp], share: float) -> None:
        t = share * duration[piece]
        _, v, a = advanced(profile.speed[piece], profile.acceleration[piece], profile.jerk[piece], t)
        over = rows.demands(LineMotion(t, t, v, a, profile.jerk[piece]))
        first, second = rows.speed.shape[1], rows.speed.shape[1] + rows.acceleration.shape[1]
        for kind, part in enumerate((over[:, :first], over[:, first:second], over[:, second:])):
            np.maximum(found[kind], part.max(axis=1, initial=0.0), out=found[kind])

    pieces = np.arange(count) * each
    look(left, pieces, 0.0)
    look(right, pieces + each - 1, 1.0)
    for at in range(each):
        piece = pieces + at
        for share in INSIDE:
            t = share * duration[piece]
            way = advanced(profile.speed[piece], profile.acceleration[piece], profile.jerk[piece], t)[0]
            place = profile.distance[piece] + way
            look(rows_at(stretch.path, stretch.limits, stretch.joints, place), piece, share)
        if at:
            rows = rows_at(stretch.path, stretch.limits, stretch.joints, profile.distance[piece])
            look(rows, piece - 1, 1.0)
            look(rows, piece, 0.0)
    return found
