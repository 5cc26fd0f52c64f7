"""Long paths on which centripetal acceleration alone slows the line: stretches of one speed, joined by ramps.

What a steady speed may be is the maximum velocity curve, sqrt(most / curvature), on a grid that is fine where it
changes and near its minima. The path is planned in zones of one speed each; where the plan is above the curve, the
stretch about the slowest place gets its speed, and the plan is made anew. Ramps are exact; the speed follows the curve
in steps, and takes some 8 % more time on random short lines than the fastest motion, at a fiftieth of the work.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ocp.errors import ProblemError
from ocp.schedule.limits import LineLimits, PathLike, curvature_along
from ocp.schedule.profile import Array, SpeedProfile, piece_of
from ocp.schedule.ramps import Zones, plan
from ocp.schedule.settings import SETTINGS
from ocp.tolerances import ROUNDING_SHARE

__all__ = ["ramps_below_the_curve"]


def ramps_below_the_curve(path: PathLike, limits: LineLimits) -> SpeedProfile:
    """The motion from rest to rest that keeps the limits of the line and of centripetal acceleration.

    Raises:
        ProblemError: A curvature that is not finite; no plan below the curve.
    """
    s, permitted, asked = _curve(path, limits)
    speed, memory = asked.copy(), dict[tuple[float, ...], tuple[tuple[float, float], ...]]()
    for number in range(SETTINGS.zone_rounds):
        profile = plan(_zones(s, speed, limits), memory)
        if not _lowered(s, permitted, speed, profile, number >= SETTINGS.thorough_from):
            return profile
    message = f"no plan below the speed that centripetal acceleration permits, after {SETTINGS.zone_rounds} rounds"
    raise ProblemError(message, name="centripetal", value=limits.centripetal)


def _curve(path: PathLike, limits: LineLimits) -> tuple[Array, Array, Array]:
    """Distances, the speed permitted at them (G,), and the asked one in each interval (G - 1,)."""
    of_pieces, bounds = path.by_piece(limits.speed), np.asarray(path.bounds, dtype=float)
    first = np.unique(np.concatenate([path.dense(8, 2), bounds]))
    parts = []
    for begin in range(0, len(of_pieces), SETTINGS.block):
        ends = bounds[begin : begin + SETTINGS.block + 1]
        low, high = np.searchsorted(first, ends[[0, -1]])
        parts.append(_refined(path, limits, first[low : high + 1], ends, of_pieces[begin : begin + SETTINGS.block]))
    s = np.concatenate([part[0][:-1] for part in parts] + [first[-1:]])
    permitted = np.concatenate([part[1][:-1] for part in parts] + [parts[-1][1][-1:]])
    # where two parts meet, both sides count
    seams = np.cumsum([len(part[0]) - 1 for part in parts])[:-1]
    permitted[seams] = np.minimum(permitted[seams], [part[1][-1] for part in parts[:-1]])
    return s, permitted * (1 - SETTINGS.speed_error), np.concatenate([part[2] for part in parts])


def _refined(
    path: PathLike, limits: LineLimits, s: Array, bounds: Array, of_pieces: Array
) -> tuple[Array, Array, Array]:
    """`_curve` over some of the pieces, from distances that are halved until they resolve it."""

    def most(places: Array) -> Array:
        with np.errstate(divide="ignore"):
            return np.asarray(np.sqrt(limits.centripetal / curvature_along(path, places)))

    permitted = most(s)
    inner = bounds[1:]
    before = inner - np.minimum(ROUNDING_SHARE * path.length, np.diff(bounds) / 2)
    at = np.searchsorted(s, inner)
    permitted[at] = np.minimum(most(before), permitted[at])
    for _ in range(SETTINGS.curve_halvings):
        asked = of_pieces[piece_of(bounds, (s[:-1] + s[1:]) / 2)]
        cut = np.flatnonzero(_coarse(path.length, s, permitted, asked, limits.acceleration))
        if not cut.size:
            break
        middle = (s[cut] + s[cut + 1]) / 2
        s, permitted = np.insert(s, cut + 1, middle), np.insert(permitted, cut + 1, most(middle))
    return s, permitted, np.asarray(of_pieces[piece_of(bounds, (s[:-1] + s[1:]) / 2)])


def _coarse(length: float, s: Array, permitted: Array, asked: Array, acceleration: float) -> NDArray[np.bool_]:
    """Which intervals do not resolve the permitted speed, where that is near or below the asked one.

    Nor where no motion that is slow enough in its neighbourhood gets near to it.
    """
    low = np.minimum(permitted[:-1], permitted[1:])
    gain = 2 * acceleration * (s - s[0])
    within = np.minimum.accumulate(permitted**2 - gain) + gain
    within = np.minimum.accumulate((within + gain)[::-1])[::-1] - gain
    within = np.sqrt(np.maximum(within[:-1], within[1:]))
    matters = (low < 1.1 * np.minimum(asked, within)) & (np.diff(s) > ROUNDING_SHARE * length)
    value = np.log(np.minimum(permitted, 2 * asked.max()))
    step, slope = np.diff(s), np.diff(value) / np.diff(s)
    bend, least = np.zeros(len(s)), np.zeros(len(s), dtype=bool)
    bend[1:-1] = 2 * np.abs(np.diff(slope)) / (step[:-1] + step[1:])
    least[1:-1] = (slope[:-1] <= 0) & (slope[1:] >= 0) & (bend[1:-1] > 0)
    error = np.where(least[:-1] | least[1:], step**2 / 8 * np.maximum(bend[:-1], bend[1:]), 0.0)
    return np.asarray(matters & ((np.abs(np.diff(value)) > SETTINGS.speed_change) | (error > SETTINGS.speed_error)))


def _zones(s: Array, speed: Array, limits: LineLimits) -> Zones:
    """Neighbours of one speed as one zone."""
    starts = np.concatenate([[0], 1 + np.flatnonzero(np.diff(speed))])
    same = np.ones(len(starts))
    return Zones(s[np.append(starts, len(speed))], speed[starts], limits.acceleration * same, limits.jerk * same)


def _lowered(s: Array, permitted: Array, speed: Array, profile: SpeedProfile, thoroughly: bool) -> bool:
    """Lower speeds, in place, where a plan is faster than permitted; False when it is nowhere."""
    here = np.concatenate([profile.at_distance(part).speed for part in np.array_split(s, len(s) // SETTINGS.block + 1)])
    top = np.maximum(here[:-1], here[1:])
    peaks = profile.peaks()
    np.maximum.at(top, piece_of(s, peaks.distance), peaks.speed)
    most = np.minimum(permitted[:-1], permitted[1:])
    fast = np.minimum(top, speed) > most * (1 + ROUNDING_SHARE)
    if thoroughly:
        speed[fast] = most[fast]
        return bool(fast.any())
    inside = np.flatnonzero(fast)
    if not inside.size:
        return False
    # one stretch about the slowest place of each run of them, as far as not much more is permitted
    starts = np.flatnonzero(np.diff(inside, prepend=-2) > 1)
    run = np.repeat(np.arange(len(starts)), np.diff(starts, append=len(inside)))
    here = most[inside]
    least = np.minimum.reduceat(here, starts)
    slowest = np.minimum.reduceat(np.where(here == least[run], inside, len(most)), starts)
    apart = np.concatenate([[-1], inside[here > SETTINGS.spread * least[run]], [len(most)]])
    after = np.searchsorted(apart, slowest)
    near = (inside > apart[after - 1][run]) & (inside < apart[after][run])
    speed[inside[near]] = np.minimum(speed[inside[near]], least[run[near]])
    return True
