"""Time along a path: the asked line speed wherever the limits allow it, slowed smoothly just where they do not.

Long paths on which centripetal acceleration alone slows the line: stretches of one speed, joined by ramps.

What a steady speed may be is the maximum velocity curve, sqrt(most / curvature), on a grid that is fine where it
changes and near its minima. The path is planned in zones of one speed each; where the plan is above the curve, the
stretch about the slowest place gets its speed, and the plan is made anew. Ramps are exact; the speed follows the curve
in steps, and takes some 8 % more time on random short lines than the fastest motion, at a fiftieth of the work.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ocp.console import interruptible
from ocp.errors import ProblemError, checked_flag, sample_times
from ocp.motion.schedule.grid import Grid, coarse_grid, make_grid
from ocp.motion.schedule.limits import JointPath, LineLimits, PathLike, check_line, curvature_along, limit_names
from ocp.motion.schedule.profile import Array, LineMotion, SpeedProfile, join_profiles, segment_index
from ocp.motion.schedule.ramps import Zones, plan_zones, ramp_distance
from ocp.motion.schedule.settings import SETTINGS
from ocp.motion.schedule.stretch import fastest_profile
from ocp.motion.schedule.window import Stretch
from ocp.tolerances import ROUNDING_SHARE

__all__ = ["Dip", "Schedule", "plan_below_velocity_curve", "schedule"]


def plan_below_velocity_curve(path: PathLike, limits: LineLimits) -> SpeedProfile:
    """The motion from rest to rest that keeps the limits of the line and of centripetal acceleration.

    Raises:
        ProblemError: A curvature that is not finite; no plan below the curve.
    """
    s, permitted, asked = _curve(path, limits)
    speed, memory = asked.copy(), dict[tuple[float, ...], tuple[tuple[float, float], ...]]()
    for number in range(SETTINGS.zone_rounds):
        profile = plan_zones(_zones(s, speed, limits), memory)
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
        asked = of_pieces[segment_index(bounds, (s[:-1] + s[1:]) / 2)]
        cut = np.flatnonzero(_coarse(path.length, s, permitted, asked, limits.acceleration))
        if not cut.size:
            break
        middle = (s[cut] + s[cut + 1]) / 2
        s, permitted = np.insert(s, cut + 1, middle), np.insert(permitted, cut + 1, most(middle))
    return s, permitted, np.asarray(of_pieces[segment_index(bounds, (s[:-1] + s[1:]) / 2)])


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
    np.maximum.at(top, segment_index(s, peaks.distance), peaks.speed)
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


@dataclass(frozen=True)
class Dip:
    """A stretch in which the schedule stays below what was asked.

    Attributes:
        start, end: Distances along the path, m.
        cause: The limit that binds, for example "centripetal acceleration" or "joint 'elbow' velocity".
        requested, permitted: Line speed and the lowest steady one that the limits permit there, m/s: the same where
            the limit binds on a ramp alone.
        speed: Lowest line speed of the schedule there, m/s.
        acceleration, jerk: Of the line speed, largest there, m/s^2 and m/s^3.
    """

    start: float
    end: float
    cause: str
    requested: float
    permitted: float
    speed: float
    acceleration: float
    jerk: float

    def __str__(self) -> str:
        slow = self.permitted < self.requested
        amount = f"permits {self.permitted:.4g} of {self.requested:.4g} m/s" if slow else "binds on a ramp"
        return (
            f"{self.start:.6g} to {self.end:.6g} m: {self.cause} {amount}, "
            f"line acceleration {self.acceleration:.4g} m/s^2, jerk {self.jerk:.4g} m/s^3"
        )


@dataclass(frozen=True, eq=False)
class Schedule:
    """When the path is where.

    Attributes:
        path: What it was made for.
        limits: What it keeps to.
        profile: Distance and speed over time.
        dips: Where it is slower than asked, and why; empty if nowhere.
        joints: The joints along the path, if they were limited.
    """

    path: PathLike
    limits: LineLimits
    profile: SpeedProfile
    dips: tuple[Dip, ...]
    joints: JointPath | None = None

    def __repr__(self) -> str:
        slower = f"slower than asked in {len(self.dips)} places" if self.dips else "at the asked speed"
        return f"<Schedule of {self.profile.distance[-1]:.6g} m in {self.duration:.6g} s, {slower}>"

    @property
    def duration(self) -> float:
        """s."""
        return self.profile.duration

    def at(self, time: ArrayLike) -> LineMotion:
        """LineMotion at times of [0, duration]. Shape (M,), s."""
        return self.profile.at(time)

    def time_at(self, distance: ArrayLike) -> Array:
        """Times at which the path has the given distances from its start. Shape (M,), s."""
        return self.profile.at_distance(distance).t

    def sample(self, period: float) -> LineMotion:
        """LineMotion every `period` s from the start; the last sample, at the end, comes as early as the duration says.

        Raises:
            ProblemError: A period that is not positive, or nan, or too short.
        """
        return self.at(sample_times("sample period", period, self.duration))

    def function(self) -> Any:
        """casadi Function of the time, see SpeedProfile.function."""
        return self.profile.function()


@interruptible
def schedule(path: PathLike, limits: LineLimits, *, joints: JointPath | None = None, strict: bool = False) -> Schedule:
    """Plan the line speed along a path from rest to rest, in the least time that the limits allow.

    One jerk-limited motion if nothing but speed, acceleration and jerk binds; the speed is then constant at the asked
    one, through the blends as well, between its ramps. Where that breaks another limit, the stretch about the place is
    planned anew under all of them: by exact passes where no jerk is limited, else by convex programs. All limits hold
    between the nodes too, to 0.1 %. A long path without limits of joints or tool is slowed by ramps.

    Args:
        path: A models.paths.SmoothPath, or whatever has what PathLike says.
        limits: What to keep to.
        joints: The joints along the path, where limits.joints is given.
        strict: Raise instead of slowing down.

    Raises:
        ProblemError: Joint limits without joints, or a limit that would be broken at the asked speed, if strict;
            limits that no motion keeps.
    """
    limited = check_line(path, limits, joints)
    checked_flag("strict", strict)
    base = _by_ramps(path, limits) if np.isfinite(limits.jerk) else None
    more = limited is not None or limits.tool is not None or np.isfinite(limits.centripetal)
    if base is not None and not more:
        return Schedule(path, limits, base, (), joints)
    if base is not None and limited is None and limits.tool is None and len(path.bounds) > SETTINGS.long_path:
        profile = plan_below_velocity_curve(path, limits)
        grid = coarse_grid(path, limits)
    else:
        grid = make_grid(path, limits, limited)
        profile = _planned(grid, base)
    dips = () if profile is base else _dips(grid, profile, limit_names(limits, limited))
    if strict and dips:
        listed = "\n  ".join(str(dip) for dip in dips[:10])
        hint, one = "ask for less, larger blends, or strict=False", dips[0]
        message = f"the asked speed breaks limits in {len(dips)} place(s); {hint}:\n  {listed}"
        raise ProblemError(message, name=one.cause, value=one.requested, limit=one.permitted, time=one.start)
    return Schedule(path, limits, profile, dips, joints)


def _by_ramps(path: PathLike, limits: LineLimits) -> SpeedProfile:
    """The motion that keeps speed, acceleration and jerk of the line."""
    asked, bounds = path.by_piece(limits.speed), np.asarray(path.bounds, dtype=float)
    first = np.concatenate([[0], 1 + np.flatnonzero(np.diff(asked))])
    same = np.ones(len(first))
    zones = Zones(bounds[np.append(first, len(asked))], asked[first], limits.acceleration * same, limits.jerk * same)
    return plan_zones(zones, {})


def _planned(grid: Grid, base: SpeedProfile | None) -> SpeedProfile:
    """The base motion where it keeps all limits, the fastest motion elsewhere."""
    count = len(grid.requested)
    if base is None:
        return fastest_profile(Stretch(grid, 0, count))
    broken = _broken(grid, base)
    if not broken.any():
        return base
    s, reach = grid.distance, 1.0
    while True:
        stretches = _stretches(grid, base, broken, reach)
        found = []
        for first, last in stretches:
            ends = [(0.0 if k in (0, count) else float(grid.requested[k]) ** 2, 0.0) for k in (first, last)]
            try:
                motion = fastest_profile(Stretch(grid, first, last, (ends[0], ends[1])))
            except ProblemError:
                if (first, last) == (0, count):
                    raise
                break  # too short to change the speed in
            if not _long_enough(grid, motion, first, last):
                break
            found.append(motion)
        if len(found) == len(stretches):
            break
        reach *= 2
    parts: list[SpeedProfile] = []
    passed = 0.0
    for (first, last), motion in zip(stretches, found, strict=True):
        if s[first] > passed:
            parts.append(_cut(base, passed, float(s[first])))
        parts.append(motion)
        passed = float(s[last])
    if passed < s[-1]:
        parts.append(_cut(base, passed, float(s[-1])))
    return join_profiles(parts)


def _broken(grid: Grid, base: SpeedProfile) -> NDArray[np.bool_]:
    """Intervals of the grid in which a motion breaks a limit. Shape (N,)."""
    over = np.zeros(len(grid.requested), dtype=bool)
    # inside an interval the jerk may change, and the speed be larger
    turns = base.at(np.concatenate([base.t, np.maximum(base.t[1:] - 1e-12 * base.duration, 0.0), base.peaks().t]))
    at = segment_index(grid.distance, turns.distance)
    for first, last in grid.parts():
        here, inside = base.at_distance(grid.distance[first : last + 1]), (at >= first) & (at < last)
        turn = LineMotion(*(value[inside] for value in turns))
        for rows, ends in zip(grid.ends(first, last), (slice(-1), slice(1, None)), strict=True):
            motion = LineMotion(*(value[ends] for value in here))
            over[first:last] |= (np.abs(rows.demands(motion)) > 1 + ROUNDING_SHARE).any(axis=1)
            passed = (np.abs(rows.take(at[inside] - first).demands(turn)) > 1 + ROUNDING_SHARE).any(axis=1)
            np.logical_or.at(over, at[inside], passed)
    return over


def _stretches(grid: Grid, base: SpeedProfile, broken: NDArray[np.bool_], reach: float) -> list[tuple[int, int]]:
    """First and last nodes of the stretches to be planned anew: between them the base is steady, or the path ends.

    On either side of what is broken they are `reach` times as long as a ramp to rest.
    """
    count, s, limits = len(broken), grid.distance, grid.limits
    here = base.at_distance(s)
    steady = (np.abs(here.acceleration) <= ROUNDING_SHARE * limits.acceleration) & (here.jerk == 0)
    asked = np.minimum(np.append(grid.requested, np.inf), np.insert(grid.requested, 0, np.inf))
    steady &= np.abs(here.speed - asked) <= ROUNDING_SHARE * asked
    steady[[0, -1]] = True
    seats = np.flatnonzero(steady)
    edges = np.flatnonzero(np.diff(np.concatenate([[0], broken.astype(np.int8), [0]]))).reshape(-1, 2)
    found: list[tuple[int, int]] = []
    for first, last in edges.tolist():
        ramp = reach * ramp_distance(0.0, float(grid.requested[first:last].max()), limits.acceleration, limits.jerk)
        low = int(np.searchsorted(s, s[first] - ramp, side="right")) - 1
        high = int(np.searchsorted(s, s[last] + ramp))
        begin = int(seats[np.searchsorted(seats, max(low, 0), side="right") - 1])
        end = int(seats[np.searchsorted(seats, min(high, count))])
        if found and begin <= found[-1][1]:
            found[-1] = (found[-1][0], max(end, found[-1][1]))
        else:
            found.append((begin, end))
    return found


def _long_enough(grid: Grid, motion: SpeedProfile, first: int, last: int) -> bool:
    """Whether a motion has not left the asked speed near those ends of its stretch that are none of the path."""
    length = motion.distance[-1] - motion.distance[0]
    for node, inside in ((first, first), (last, last - 1)):
        if node in (0, len(grid.requested)):
            continue
        near = np.abs(motion.distance - grid.distance[node]) < 0.02 * length
        if (motion.speed[near] < grid.requested[inside] * (1 - SETTINGS.leaving)).any():
            return False
    return True


def _cut(profile: SpeedProfile, begin: float, end: float) -> SpeedProfile:
    """The part of a profile between two distances."""
    first, last = (profile.at_distance([place]) for place in (begin, end))
    inside = (profile.t > first.t[0]) & (profile.t < last.t[0])
    t, s, v, a = (
        np.concatenate([[getattr(first, kind)[0]], getattr(profile, kind)[inside], [getattr(last, kind)[0]]])
        for kind in ("t", "distance", "speed", "acceleration")
    )
    s[0], s[-1] = begin, end
    if end == profile.distance[-1]:
        v[-1], a[-1] = profile.speed[-1], profile.acceleration[-1]
    return SpeedProfile(t - t[0], s, v, a, profile.jerk[segment_index(profile.t, (t[:-1] + t[1:]) / 2)])


def _dips(grid: Grid, profile: SpeedProfile, names: tuple[str, ...]) -> tuple[Dip, ...]:
    """Where another limit than those of the line binds, while the motion stays below the asked speed."""
    middle = profile.at_distance((grid.distance[:-1] + grid.distance[1:]) / 2)
    of_line = [k for k, name in enumerate(names) if name.startswith("line ")]
    cause, steady = np.zeros(len(grid.requested), dtype=np.intp), np.zeros(len(grid.requested))
    binding = middle.speed < grid.requested * (1 - SETTINGS.reached)
    for first, last in grid.parts():
        part, sides = slice(first, last), grid.ends(first, last)
        here = LineMotion(*(value[part] for value in middle))
        demand = np.maximum(*(np.abs(rows.demands(here)) for rows in sides))
        line = demand[:, of_line].max(axis=1, initial=0.0)
        demand[:, of_line] = 0.0
        cause[part], most = demand.argmax(axis=1), demand.max(axis=1)
        binding[part] &= (most > SETTINGS.binding) & (most >= line - (1 - SETTINGS.binding))
        steady[part] = np.minimum(*(rows.steady()[0] for rows in sides))
    permitted = np.minimum(steady, grid.requested)
    changes = (np.diff(binding) != 0) | (np.diff(cause) != 0) | (np.diff(grid.requested) != 0)
    edges = np.concatenate([[0], 1 + np.flatnonzero(changes), [len(binding)]])
    runs = np.stack([edges[:-1], edges[1:]], axis=1)[binding[edges[:-1]]]
    if not runs.size:
        return ()
    # runs of one cause are one dip, unless the asked speed is reached between them: the count of such intervals grows
    reached = np.concatenate([[0], np.cumsum(middle.speed >= grid.requested * (1 - SETTINGS.reached))])
    begin, end = runs[1:, 0], runs[:-1, 1]
    apart = (cause[begin] != cause[end - 1]) | (grid.requested[begin] != grid.requested[end - 1])
    groups = np.concatenate([[0], 1 + np.flatnonzero(apart | (reached[begin] != reached[end]))])

    def extreme(of: np.ufunc, values: Array) -> Array:
        each = of.reduceat(np.append(values, values[-1]), runs.ravel())[::2]
        return np.asarray(of.reduceat(each, groups))

    begin, end = runs[groups, 0], np.append(runs[groups[1:] - 1, 1], runs[-1, 1])
    columns = (
        grid.distance[begin],
        grid.distance[end],
        [names[k] for k in cause[begin].tolist()],
        grid.requested[begin],
        extreme(np.minimum, permitted),
        extreme(np.minimum, middle.speed),
        extreme(np.maximum, np.abs(middle.acceleration)),
        extreme(np.maximum, np.abs(middle.jerk)),
    )
    return tuple(Dip(*row) for row in zip(*(np.asarray(column).tolist() for column in columns), strict=True))
