"""The fastest motion over a stretch (a part of a path) under all limits.

A rough motion, under the limit rows at one point of every interval, shows the few rows that matter. These are enforced
at both ends of the interval and where they are used most. The motion under them is evaluated between the nodes: a
violated row is enforced there too; if it already was, the bounds of the interval are lowered by the violation. This is
repeated until no row is violated, in the end only for the few intervals that still violate one and their neighbours.
Long stretches are solved in windows; each comes to rest at its end, so that a motion beyond the next seam exists.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy
from numpy.typing import NDArray

from models.checks import Array
from ocp.errors import ProblemError, SolveError
from ocp.motion.schedule.grid import GAUSS, Grid, acceleration_bounds, limit_slope, node_minimum, reachable_squares
from ocp.motion.schedule.grid import SETTINGS as GRID_SETTINGS
from ocp.motion.schedule.limits import Rows, limit_rows
from ocp.motion.schedule.program import Program, Spline, SplineRows, least_time
from ocp.motion.schedule.ramps import reachability_passes
from ocp.motion.schedule.window import (
    ENFORCED_AT,
    INSIDE,
    Ends,
    EnforcedRows,
    Margins,
    Motion,
    Stretch,
    Window,
    limit_usage,
    motion_profile,
    parabola_peak,
)
from ocp.motion.schedule.window import SETTINGS as WINDOW_SETTINGS
from ocp.motion.tasks.speed_profile import SpeedProfile, integrate_jerk, join_profiles, profile_between
from ocp.tolerances import ROUNDING_SHARE

ACTIVE_SHARE = 0.98
"""Fraction of a limit above which it counts as active; limits that no motion can activate are left out at first."""

HALF_ERROR = 0.16
"""Deviation of a cubic from parabolas through end, Gauss point and middle of an interval, over that of the parabola
through both ends and the middle, which is largest at the Gauss points."""


@dataclass(frozen=True)
class StretchSettings:
    """Settings of the search for the fastest motion along part of a path.

    Attributes:
        rounds: Largest number of rounds of tightening the limits.
        unused: Share of the time by which intervals are longer whose middle uses no limit up though an end does, above
            which they are halved.
        lost: Predicted share of the time that a motion loses because its jerk is constant in each interval: the
            promised accuracy.
        exceeded: Share by which a motion without jerk limits may exceed limits between nodes: half of the promised
            accuracy of 1e-3.
        parts: Largest number of parts into which an interval is split at once.
        accuracies: Relative accuracy of the travel time of a window in each round, no finer than the enforced limits
            still change; the last value serves all later rounds.
        around, few: Intervals on either side of a violated one that are planned again with it; only these are planned
            if their share is at most `few`.
        window, overlap: Number of intervals of a window, which bounds the memory, and of those at its end that the next
            one plans again.
        seam: Share of the limits that a window uses beyond the start of the next one, so that the next has freedom.
        start, again: Initial squared speed over that of a fastest steady motion with bounded acceleration, and over
            that of the solution of a similar program.
        again_inside: Further factor if that start fails.
        center, center_again: Initial complementarity over the time for these starts.
    """

    rounds: int = 20
    unused: float = 1e-4
    lost: float = 1e-3
    exceeded: float = 5e-4
    parts: int = 8
    accuracies: tuple[float, ...] = (0.05, 1e-3, 1e-5, 1e-8)
    around: int = 40
    few: float = 1 / 6
    window: int = 2000
    overlap: int = 200
    seam: float = 0.999
    start: float = 0.5
    again: float = 0.9
    again_inside: float = 0.3
    center: float = 1.0
    center_again: float = 0.1


SETTINGS = StretchSettings()


def fastest_profile(stretch: Stretch) -> SpeedProfile:
    """Return the fastest motion along part of a path; distances count from the start of the whole path.

    Raises:
        ProblemError: No motion keeps the limits, with the distance at fault.
    """
    if not stretch.grid.sharp:
        return _solve_without_jerk(stretch.grid)  # a path without jerk limits is one stretch
    parts: list[SpeedProfile] = []
    begin, state, behind = stretch.first, stretch.ends[0], None
    while True:
        end = stretch.last if stretch.last - begin < SETTINGS.window + SETTINGS.overlap else begin + SETTINGS.window
        last = end == stretch.last
        seam = end if last else end - SETTINGS.overlap
        window = Window.build(stretch, begin, end, (state, stretch.ends[1] if last else (0.0, 0.0)))
        enforced = EnforcedRows.build(window)
        if behind is not None:
            enforced.inherited = part = len(behind.ratios)
            for margin, previous in zip(enforced.margins, behind.margins, strict=True):
                margin[:part] = previous
            enforced.mask[:, :, :part], enforced.ratios[:part] = behind.mask, behind.ratios
        x, slope, window, enforced, at = _tighten(window, enforced, seam)
        parts.append(motion_profile(window, x[: at + 1], slope))
        if last:
            return join_profiles(parts)
        begin, state, behind = seam, (float(x[at]), float(slope[at])), enforced.take(slice(at, None))


def _tighten(window: Window, enforced: EnforcedRows, seam: int) -> tuple[Array, Array, Window, EnforcedRows, int]:
    """Tighten the enforced limits until the computed motion satisfies the original limits; return the motion.

    Intervals are split once, as the second motion requires; the window, its limits and the number of intervals before
    the seam are returned after the split. If few intervals still violate limits, these are planned again with their
    neighbours, between fixed motions. The first intervals beyond the seam must keep the limits as well.
    """
    every = np.arange(window.last - window.first)
    accuracies, start, free = SETTINGS.accuracies, None, every
    for number in range(SETTINGS.rounds):
        checked = min(seam + SETTINGS.overlap // 2, window.last) - window.first
        accuracy = accuracies[min(number, len(accuracies) - 1)]
        try:
            x, slope = _solve_with_jerk(window, enforced, seam, start, accuracy, free)
        except ProblemError:
            if len(free) == len(every):
                raise
            free = every  # too short for the change of motion
            continue
        profile = motion_profile(window, x, slope)
        used, values = limit_usage(window, profile, free, start is not None)
        used /= _seam_shares(window, seam)[:, None]
        start = x, slope
        if number == 0:
            enforced.enforce_near(used, values, window.rows[1].jerk[:, :, 0])
            continue
        violated = used > 1 + ROUNDING_SHARE
        affected = np.asarray(violated.any(axis=(0, 2)))
        if not affected[:checked].any() and accuracy == accuracies[-1]:
            return x, slope, window, enforced, seam - window.first
        if number == 1:
            enforced.release(values, window.rows[1].jerk[:, :, 0], seam - window.first)
        enforced.lower(used, enforced.enforce(violated, values), window.rows[0], seam - window.first)
        near = np.flatnonzero(scipy.ndimage.maximum_filter1d(affected, 2 * SETTINGS.around + 1))
        free = near if accuracy == accuracies[-1] and len(near) < SETTINGS.few * len(every) else every
        if number == 1:
            parts = _parts_by_unused_jerk(window, seam, profile, values)
            grid, seam = window.grid.split(window.first, parts), int(parts[: seam - window.first].sum())
            window, enforced = (
                Window.build(Stretch(grid, 0, 0), 0, int(parts.sum()), window.ends),
                enforced.split(parts),
            )
            motion, free = profile.at_distance(window.nodes), np.arange(window.last)
            start, every = (motion.speed**2, 2 * motion.acceleration), free
    worst = used[:, :checked].max(axis=(0, 2))
    place, largest = float(window.nodes[worst.argmax()]), float(worst.max())
    message = f"the limits are violated by {largest - 1:.2g} at {place:g} m, where the path or its joints bend sharply"
    raise ProblemError(message, name="limits", value=largest, limit=1.0, time=place)


def _parts_by_unused_jerk(window: Window, seam: int, profile: SpeedProfile, values: Array) -> NDArray[np.intp]:
    """Return the number of parts of each interval with which unused jerk costs about SETTINGS.lost of the duration.

    Where the mean jerk is (1 - u) J in a time T, the greatest jerk J and then (1 - 2 u) J would lead to a speed that is
    u J T^2 / 4 higher. Its ratio to the acceleration, which is at least J T, is a time, half of which would be saved on
    average on the way to the top speed. Of this loss, 1 / n^2 remains with n parts.
    """
    requested = window.grid.requested[window.first : window.last]
    speed = np.minimum(profile.speed[:-2:2], profile.speed[2::2]) / requested
    unused = np.maximum(1 - np.maximum(np.abs(values).max(axis=2).mean(axis=0), speed), 0.0)
    time, a = np.diff(profile.t[::2]), np.abs(profile.acceleration[::2])
    sharp = np.abs(window.rows[2].jerk[:, :, 0]).max(axis=1)
    loss = unused * time**2 / (8 * np.maximum(np.maximum(a[:-1], a[1:]) * sharp, time))
    loss[seam - window.first :] = 0.0
    # the sum of loss / n^2 for a given sum of n is least if n is proportional to the cube root
    root = np.cbrt(loss)
    parts = np.rint(root * np.sqrt(root.sum() / (SETTINGS.lost * profile.t[2 * (seam - window.first)])))
    return np.asarray(np.clip(parts, 1, SETTINGS.parts), dtype=np.intp)


def _seam_shares(window: Window, seam: int) -> Array:
    """Return the fraction of the limits that the motion in each interval of a window may use. Shape (N,)."""
    return np.where(np.arange(window.first, window.last) < seam, 1.0, SETTINGS.seam)


def _columns(rows: Rows) -> tuple[Array, Array]:
    """Return the largest coefficient of the speed, s/m, and the coefficients (p, q, r) of the acceleration limits.

    Shapes (P,) and (3, R, P).
    """
    return rows.speed.max(axis=1), np.ascontiguousarray(rows.acceleration.T)


def _solve_without_jerk(grid: Grid) -> SpeedProfile:
    """Return the fastest motion along a path for unlimited jerk, by two passes on a grid that is refined in rounds.

    An interval is split while a limit is violated inside it, and in the first rounds where a limit is active at an end
    but none in the middle.

    Raises:
        ProblemError: A limit is violated in the shortest intervals too, with the distance.
    """
    s, requested, jumps, count = grid.distance, grid.requested, grid.jumps - 1, len(grid.requested)
    first, last = (_columns(rows) for rows in grid.ends(0, count))
    # coefficients at five points of each interval: at its ends, and inside, where they are evaluated in the rounds
    speed, rows = (np.stack([begin] * 4 + [end], axis=-2) for begin, end in zip(first, last, strict=True))
    shares, new, inner = np.array([[GAUSS[0]], [0.5], [GAUSS[1]]]), np.full(count, True), np.zeros(0, dtype=np.intp)
    for _ in range(SETTINGS.rounds):
        h = np.diff(s)
        places = s[:-1] + shares * h
        added = limit_rows(grid.path, grid.limits, grid.joints, np.append(s[inner], places[:, new]))
        for values, of_added in zip((speed, rows), _columns(added), strict=True):
            values[..., 0, inner] = values[..., 4, inner - 1] = of_added[..., : len(inner)]
            values[..., 1:4, new] = of_added[..., len(inner) :].reshape(*values.shape[:-2], 3, -1)
        np.maximum(speed, 1 / requested, out=speed)
        caps = np.maximum(np.append(speed[0], 0.0), np.insert(speed[4], 0, 0.0)) ** -2.0
        caps[[0, -1]] = 0.0
        at_nodes = np.concatenate([rows[:, :, 0], rows[:, :, 4, -1:]], axis=2)
        x, *rates = reachability_passes(s, caps, at_nodes, (jumps, rows[:, :, 4, jumps]))
        profile = profile_between(s, np.sqrt(x), (rates[0], rates[1]))
        used, peak = _usage_without_jerk(profile, places, speed, rows)
        # the excess falls at least as fast as the length of the interval
        parts = np.clip(np.ceil(2 * (peak - 1) / SETTINGS.exceeded) - 1, 1, SETTINGS.parts).astype(np.intp)
        unused = np.where(used[[0, -1]].max(axis=0) > 1 - 2 * SETTINGS.exceeded, 1 - used[2], 0.0)
        if unused @ np.diff(profile.t) > SETTINGS.unused * profile.duration:
            # in halves, which gain speed, limits would be violated again
            parts = np.maximum(parts, np.where(unused > 2 * SETTINGS.exceeded, SETTINGS.parts // 2, 1))
        if not (parts > 1).any():
            return profile
        at = np.repeat(np.arange(len(parts)), parts)
        number = np.arange(len(at)) - (np.cumsum(parts) - parts)[at]
        s, inner = np.append(s[at] + h[at] * number / parts[at], s[-1]), np.flatnonzero(number)
        jumps, requested, new = np.cumsum(parts)[jumps] - 1, requested[at], parts[at] > 1
        speed, rows = speed.take(at, axis=-1), rows.take(at, axis=-1)
    worst = int(peak.argmax())
    place, largest = float(profile.distance[worst]), float(peak[worst])
    message = f"the limits are violated by {largest - 1:.2g} at {place:g} m, where the path or its joints bend sharply"
    raise ProblemError(message, name="limits", value=largest, limit=1.0, time=place)


def _usage_without_jerk(profile: SpeedProfile, places: Array, speed: Array, rows: Array) -> tuple[Array, Array]:
    """Return the largest ratio of any quantity except jerk to its limit: at five points and over each interval.

    The points are the start, first Gauss point, middle, second Gauss point and end. In either half each row is
    interpolated by a parabola through three of them; what a cubic may deviate from it is added. Shapes (5, N) and (N,).

    Args:
        profile: Motion, with one segment in each interval.
        places: Distances of the inner points along the path. Shape (3, N), m.
        speed: Largest coefficients of the speed at the five points. Shape (5, N), s/m.
        rows: Coefficients (p, q, r) of the limits of the acceleration there. Shape (3, R, 5, N).
    """
    first, last, acceleration, jerk = profile.speed[:-1], profile.speed[1:], profile.acceleration[:-1], profile.jerk
    covered = places - profile.distance[:-1]
    share = covered / np.diff(profile.distance)
    # time at constant acceleration, then Newton steps, which converge quadratically
    t = 2 * covered / (first + np.sqrt((1 - share) * first**2 + share * last**2))
    for _ in range(2):
        reached, v, a = integrate_jerk(first, acceleration, jerk, t)
        t -= (reached - covered) / v
    _, v, a = integrate_jerk(first, acceleration, jerk, np.vstack([0 * first, t, np.diff(profile.t)]))
    p, q, r = rows
    values = np.concatenate([(speed * v)[None], p * a + q * v**2 + r])
    sizes = np.abs(values)
    used = sizes.max(axis=0)
    # neither a parabola nor a cubic through values below half the limit reaches the limit
    row, at = np.nonzero(sizes.max(axis=1) > 0.5)
    high = values[row, :, at].T
    weights = (1 - GAUSS[0]) * (1 - 2 * GAUSS[0]), 4 * GAUSS[0] * (1 - GAUSS[0]), GAUSS[0] * (2 * GAUSS[0] - 1)
    error = np.abs(np.array([weights, weights[::-1]]) @ high[::2] - high[1::2]).max(axis=0)
    left, right = parabola_peak(high[:3], (0.0, GAUSS[0], 0.5)), parabola_peak(high[2:], (0.5, GAUSS[1], 1.0))
    peak = used.max(axis=0)
    np.maximum.at(peak, at, np.abs([left, right, *high]).max(axis=0) + HALF_ERROR * error)
    return used, peak


def _solve_with_jerk(
    window: Window, enforced: EnforcedRows, seam: int, known: Motion | None, accuracy: float, free: NDArray[np.intp]
) -> Motion:
    """Return squared speeds and their derivatives at the nodes of a window for the fastest motion under jerk limits."""
    begin, end, ends, grid, nodes = window.first, window.last, window.ends, window.grid, window.nodes
    left, middle, right = (window.rows[k] for k in (0, 2, 4))
    at_rest = ends[0][0] == 0, ends[1][0] == 0
    seam_shares = _seam_shares(window, seam)
    shares = enforced.margins.times(seam_shares)
    requested = grid.requested[begin:end] ** 2 * seam_shares**2
    first, inside, last = (rows.speed.max(axis=1, initial=0.0) for rows in (left, middle, right))
    with np.errstate(divide="ignore"):
        permitted = np.maximum(np.append(first, 0.0), np.insert(last, 0, 0.0)) ** -2.0
        between = (inside / shares.speed) ** -2.0
    caps = np.minimum(node_minimum(requested), permitted * node_minimum(shares.speed) ** 2)
    rates = acceleration_bounds(left, right, caps[:-1], caps[1:])
    reachable = reachable_squares(nodes, caps, rates, at_rest)
    # an interval next to rest has constant jerk and is not part of the program
    low, high = int(at_rest[0]), len(nodes) - int(at_rest[1])
    rest = [0.0, 0.0]
    for side in np.flatnonzero(at_rest).tolist():
        node, width = (1, nodes[1] - nodes[0]) if side == 0 else (-2, nodes[-1] - nodes[-2])
        rest[side] = float(width)
        sharp = _rest_jerk(left, right, float(width), side, shares.jerk)
        caps[node] = min(caps[node], (9 * width**2 * sharp / 2) ** (2 / 3))
    inner, cells = slice(low, high), slice(low, high - 1)
    if known is not None and len(free) == end - begin:
        v, new = np.sqrt(known[0]), slice(max(low, enforced.inherited), high - 1)
        least = 2 / (1 + np.sqrt(1 + GRID_SETTINGS.rise))  # a greater rise is that of a rough motion
        enforced.ratios[new] = np.clip(2 * v[:-1] / (v[:-1] + v[1:]), least, 2 - least)[new]
    spline = Spline(nodes[inner], enforced.ratios[cells])
    upper = np.concatenate([caps[inner][:1], np.minimum(requested, between)[cells], caps[inner][-1:]])
    mask = enforced.mask.copy()
    if known is None:
        start = _initial_squares(nodes, np.minimum(reachable, caps), left, right, ends)[inner]
        b = np.concatenate([start[:1], np.minimum(start[:-1], start[1:]), start[-1:]])
        mask[1] |= _reachable_rows(window.rows[1], np.maximum(reachable[1:], reachable[:-1]), rates, shares)
    else:
        b = spline.through(known[0][inner], known[1][inner])
        b = np.maximum(b, 1e-9 * b.max())
    fixed: list[int] = []
    sides = ((0, 1, spline.width[0]), (len(b) - 1, len(b) - 2, -spline.width[-1]))
    for (x_end, slope_end), resting, (outermost, next_to, signed_width) in zip(ends, at_rest, sides, strict=True):
        if not resting:
            b[outermost], b[next_to] = x_end, x_end + signed_width * slope_end / 2
            upper[[outermost, next_to]] = np.inf
            fixed += [outermost, next_to]
    places, in_motion = tuple(rows.take(cells) for rows in window.rows), (not at_rest[0], not at_rest[1])
    with np.errstate(invalid="ignore"):
        implied = (1 - spline.share) * upper[:-1] + spline.share * upper[1:]
    rows = _spline_rows(places, mask[:, :, cells], caps[inner], implied, shares.take(cells), in_motion)
    program = Program(spline, rows, upper, (rest[0], rest[1]), np.array(fixed, dtype=np.intp))
    try:
        if known is None:
            b = least_time(program, b, accuracy=accuracy, center=SETTINGS.center)
        elif len(free) == end - begin:
            b = _resolve(program, b, accuracy)
        else:
            part, at = program.part(free[(free >= low) & (free < high - 1)] - low)
            b[at] = _resolve(part, b[at], accuracy)
    except SolveError as error:
        message = f"{error}; raise the limits, or keep the path away from singular arms"
        raise ProblemError(message, name="limits", value=error.value, limit=error.limit, time=error.time) from error
    x, slope = np.zeros(len(nodes)), np.zeros(len(nodes))
    x[inner], slope[inner] = spline.at_nodes(b)
    return x, slope


def _resolve(program: Program, known: Array, accuracy: float) -> Array:
    """Solve a `Program` starting from reduced squared speeds of a similar solution; on failure, reduce them further."""
    free = np.ones(len(known), dtype=bool)
    free[program.fixed] = False
    start = np.where(free, SETTINGS.again, 1.0) * known
    try:
        return least_time(program, start, accuracy=accuracy, center=SETTINGS.center_again)
    except SolveError:
        start[free] *= SETTINGS.again_inside
        return least_time(program, start, accuracy=accuracy, center=SETTINGS.center)


def _initial_squares(nodes: Array, most: Array, left: Rows, right: Rows, ends: Ends) -> Array:
    """Return an initial guess of the squared speeds at nodes (N + 1,) that approximately satisfies the jerk limits.

    From rest at a constant jerk J, the squared speed to the power 3/4 grows by sqrt(9/2 J) times the distance; a known
    motion at an end may slow down at the same rate.
    """
    steady = np.minimum(left.steady(), right.steady())
    y = (SETTINGS.start * np.minimum(most, node_minimum(steady) ** 2)) ** 0.75
    with np.errstate(divide="ignore"):
        sharp = 1 / np.maximum(*(np.abs(rows.jerk[:, :, 0]).max(axis=1) for rows in (left, right)))
    away = np.concatenate([[0.0], np.cumsum(np.sqrt(4.5 * sharp) * np.diff(nodes))])
    y[0], y[-1] = (x**0.75 for x, _ in ends)
    y = limit_slope(y, away)
    start = np.maximum(y, np.maximum(ends[0][0] ** 0.75 - away, ends[1][0] ** 0.75 - (away[-1] - away))) ** (4 / 3)
    return np.asarray(np.maximum(start, 1e-9 * start.max()))


def _rest_jerk(left: Rows, right: Rows, width: float, side: int, shares: Array) -> float:
    """Return the greatest constant jerk permitted from rest in the first interval (side 0), or to rest in the last."""
    interval, sign, ratio = -side, 1.0 - 2.0 * side, 0.0
    for s in (0.0, width):
        for rows in (left, right):
            p, q, r = rows.jerk[interval].T
            jerk = p + sign * 3 * s * q + 4.5 * s * s * r
            ratio = max(ratio, float((np.abs(jerk) / shares[interval]).max(initial=0.0)))
    return 1 / ratio


def _spline_rows(
    places: tuple[Rows, ...],
    mask: NDArray[np.bool_],
    caps: Array,
    implied: Array,
    shares: Margins,
    in_motion: tuple[bool, bool],
) -> SplineRows:
    """Return the enforced limits as constraints on the spline of the squared speed along a path.

    Args:
        places: Limit rows where intervals begin, inside them, and where they end. Shape (N,) each.
        mask: Which limit rows are enforced, at the `ENFORCED_AT` positions. Shape (4, 2, N, K + L + P).
        caps, implied: Greatest squared speed at nodes by the speed limits, and by coefficient bounds. Shape (N + 1,).
        shares: Shares of the limits that each interval may use.
        in_motion: Whether the program begins and ends with a known motion, whose own rows are left out.
    """
    count, first = len(caps) - 1, places[0].speed.shape[1]
    second = first + places[0].acceleration.shape[1]
    nodes = np.flatnonzero((caps < implied * (1 - ROUNDING_SHARE)) & np.isfinite(caps))
    nodes = nodes[(nodes >= int(in_motion[0])) & (nodes <= count - int(in_motion[1]))]
    parts = [_speed_rows(np.minimum(nodes, count - 1), (nodes == count).astype(float), 1 / caps[nodes])]
    slow = np.flatnonzero(shares.speed < SETTINGS.seam * (1 - WINDOW_SETTINGS.room))
    for inside, rows in zip(INSIDE, places[1:-1], strict=True):
        most = (rows.speed[slow].max(axis=1, initial=0.0) / shares.speed[slow]) ** 2
        parts.append(_speed_rows(slow, np.full(len(slow), inside), most))
    for which, at_place in zip(mask, ENFORCED_AT, strict=True):
        inside, rows, active = (0.0, *INSIDE, 1.0)[at_place], places[at_place], which[:, :, first:second].copy()
        if inside in (0.0, 1.0) and in_motion[int(inside)]:
            active[:, -int(inside)] = False
        sign, at, row = np.nonzero(active)
        p, q, r = rows.acceleration[at, row].T
        direction, place = 1.0 - 2.0 * sign, np.full(len(at), inside)
        of = direction[:, None] * np.stack([q, p / 2, np.zeros(len(at))], axis=1)
        bound, is_jerk = shares.acceleration[at, row] - direction * r, np.zeros(len(at), dtype=bool)
        parts.append(SplineRows(at, place, of, bound, is_jerk))
        sign, at, row = np.nonzero(which[:, :, second:])
        p, q, r = rows.jerk[at, row].T
        of = (1.0 - 2.0 * sign)[:, None] * np.stack([r, q / 2, p / 2], axis=1)
        place, is_jerk = np.full(len(at), inside), np.ones(len(at), dtype=bool)
        parts.append(SplineRows(at, place, of, shares.jerk[at, row], is_jerk))
    return SplineRows(*(np.concatenate(kind) for kind in zip(*parts, strict=True)))


def _speed_rows(interval: NDArray[np.intp], fraction: Array, of: Array) -> SplineRows:
    """Return the constraints c * squared speed <= 1, with coefficients c = `of`, at given fractions of intervals."""
    coefficients, none = np.stack([of, 0 * of, 0 * of], axis=1), np.zeros(len(of), dtype=bool)
    return SplineRows(interval, fraction, coefficients, np.ones(len(of)), none)


def _reachable_rows(rows: Rows, squares: Array, rates: Array, shares: Margins) -> NDArray[np.bool_]:
    """Return which acceleration and jerk limits some motion can reach in each interval. Shape (N, K + L + P).

    `squares` and `rates` are the greatest squared speed and acceleration of any motion. Shape (N,) each.
    """
    a, j, top = np.abs(rows.acceleration), np.abs(rows.jerk), np.sqrt(squares)
    acceleration = a[:, :, 0] * rates[:, None] + a[:, :, 1] * squares[:, None] + a[:, :, 2]
    without_jerk = j[:, :, 1] * (top * rates)[:, None] + j[:, :, 2] * (top**3)[:, None]
    with np.errstate(divide="ignore", invalid="ignore"):
        sharp = np.where(j[:, :, 0] > 0, (1 + without_jerk) / j[:, :, 0], np.inf).min(axis=1, initial=np.inf)
        jerk = np.where(j[:, :, 0] > 0, j[:, :, 0] * sharp[:, None], 0.0) + without_jerk
    active = acceleration > ACTIVE_SHARE * shares.acceleration, jerk > ACTIVE_SHARE * shares.jerk
    return np.concatenate([np.zeros(rows.speed.shape, dtype=bool), *active], axis=1)
