"""Time parametrisation of paths: at the requested speed wherever the limits permit it, and smoothly reduced elsewhere.

On long paths where centripetal acceleration alone reduces the speed, the schedule consists of stretches of constant
speed joined by ramps. The maximum velocity curve, sqrt(limit / curvature), is sampled on a grid that is refined where
it changes and near its minima. The path is planned in zones of constant speed; if the plan exceeds the curve, the
stretch around the slowest place gets its speed, and the path is planned again. Ramps are exact, but the speed follows
the curve in steps, which takes about 8 % more time on random short lines than the fastest motion, at a fiftieth of the
work.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from models.checks import Array
from ocp.console import interruptible
from ocp.errors import ProblemError, require, sample_times
from ocp.motion.schedule.grid import Grid, coarse_grid, limit_slope, make_grid, node_minimum
from ocp.motion.schedule.limits import (
    BLOCK_SIZE,
    JointPath,
    LineLimits,
    PathLike,
    check_line,
    curvature_along,
    limit_names,
)
from ocp.motion.schedule.ramps import Zones, plan_zones
from ocp.motion.schedule.stretch import ACTIVE_SHARE, fastest_profile
from ocp.motion.schedule.window import Stretch
from ocp.motion.tasks.speed_profile import LineMotion, SpeedProfile, join_profiles, ramp_distance, segment_index
from ocp.tolerances import ROUNDING_SHARE


@dataclass(frozen=True)
class ScheduleSettings:
    """Settings for planning the time parametrisation of a path and for sampling its maximum velocity curve.

    Attributes:
        curve_halvings: Largest number of halvings of an interval of the velocity curve, whose minima are sharp.
        reached: Relative reduction of the requested speed above which a motion counts as slower.
        leaving: Relative reduction accepted near the ends of a stretch that is long enough.
        long_path: Number of segments from which a path with centripetal limits alone uses ramps, at a fiftieth of the
            work.
        speed_error: Relative error of the permitted speed between two samples of the velocity curve, which is
            subtracted.
        speed_change: Largest relative change of the permitted speed between two samples; the lower value applies
            between them.
        spread: Largest ratio of permitted speeds in a stretch of one speed.
        zone_rounds, thorough_from: Largest number of rounds, and the round from which every interval gets its own
            speed.
    """

    curve_halvings: int = 12
    reached: float = 1e-4
    leaving: float = 1e-5
    long_path: int = 400
    speed_error: float = 2e-4
    speed_change: float = 0.1
    spread: float = 1.2
    zone_rounds: int = 200
    thorough_from: int = 40


SETTINGS = ScheduleSettings()


def plan_below_velocity_curve(path: PathLike, limits: LineLimits) -> SpeedProfile:
    """Return a rest-to-rest motion below the maximum velocity curve, within limits of path acceleration and jerk.

    Raises:
        ProblemError: The curvature is not finite, or no plan below the curve is found.
    """
    s, permitted, requested = _velocity_curve(path, limits)
    speed, cache = requested.copy(), dict[tuple[float, ...], tuple[tuple[float, float], ...]]()
    for number in range(SETTINGS.zone_rounds):
        profile = plan_zones(_constant_zones(s, speed, limits), cache)
        if not _lower_speeds(s, permitted, speed, profile, number >= SETTINGS.thorough_from):
            return profile
    message = f"no plan below the speed that centripetal acceleration permits after {SETTINGS.zone_rounds} rounds"
    raise ProblemError(message, name="centripetal", value=limits.centripetal)


def _velocity_curve(path: PathLike, limits: LineLimits) -> tuple[Array, Array, Array]:
    """Return G distances, the maximum velocity curve at these, and the requested speeds (G - 1,) between neighbours."""
    of_pieces, bounds = path.by_piece(limits.speed), np.asarray(path.bounds, dtype=float)
    first = np.unique(np.concatenate([path.sample_distances(8, 2), bounds]))
    parts = []
    for begin in range(0, len(of_pieces), BLOCK_SIZE):
        ends = bounds[begin : begin + BLOCK_SIZE + 1]
        low, high = np.searchsorted(first, ends[[0, -1]])
        parts.append(
            _refine_distances(path, limits, first[low : high + 1], ends, of_pieces[begin : begin + BLOCK_SIZE])
        )
    s = np.concatenate([part[0][:-1] for part in parts] + [first[-1:]])
    permitted = np.concatenate([part[1][:-1] for part in parts] + [parts[-1][1][-1:]])
    # where two parts meet, both sides count
    seams = np.cumsum([len(part[0]) - 1 for part in parts])[:-1]
    permitted[seams] = np.minimum(permitted[seams], [part[1][-1] for part in parts[:-1]])
    return s, permitted * (1 - SETTINGS.speed_error), np.concatenate([part[2] for part in parts])


def _refine_distances(
    path: PathLike, limits: LineLimits, s: Array, bounds: Array, of_pieces: Array
) -> tuple[Array, Array, Array]:
    """Insert sample distances on given segments of a path until the samples resolve the maximum velocity curve."""

    def permitted_at(places: Array) -> Array:
        with np.errstate(divide="ignore"):
            return np.asarray(np.sqrt(limits.centripetal / curvature_along(path, places)))

    permitted = permitted_at(s)
    inner = bounds[1:]
    before = inner - np.minimum(ROUNDING_SHARE * path.length, np.diff(bounds) / 2)
    at = np.searchsorted(s, inner)
    permitted[at] = np.minimum(permitted_at(before), permitted[at])
    for _ in range(SETTINGS.curve_halvings):
        requested = of_pieces[segment_index(bounds, (s[:-1] + s[1:]) / 2)]
        coarse = np.flatnonzero(_unresolved_intervals(path.length, s, permitted, requested, limits.acceleration))
        if not coarse.size:
            break
        middle = (s[coarse] + s[coarse + 1]) / 2
        s, permitted = np.insert(s, coarse + 1, middle), np.insert(permitted, coarse + 1, permitted_at(middle))
    return s, permitted, np.asarray(of_pieces[segment_index(bounds, (s[:-1] + s[1:]) / 2)])


def _unresolved_intervals(
    length: float, s: Array, permitted: Array, requested: Array, acceleration: float
) -> NDArray[np.bool_]:
    """Return which intervals are too long to resolve the maximum velocity curve where it limits the motion.

    The curve does so where it is near or below the requested speed and the acceleration suffices to get near it.
    """
    low = np.minimum(permitted[:-1], permitted[1:])
    reachable = limit_slope(permitted**2, 2 * acceleration * (s - s[0]))
    reachable = np.sqrt(np.maximum(reachable[:-1], reachable[1:]))
    matters = (low < 1.1 * np.minimum(requested, reachable)) & (np.diff(s) > ROUNDING_SHARE * length)
    value = np.log(np.minimum(permitted, 2 * requested.max()))
    step, slope = np.diff(s), np.diff(value) / np.diff(s)
    bend, minimum = np.zeros(len(s)), np.zeros(len(s), dtype=bool)
    bend[1:-1] = 2 * np.abs(np.diff(slope)) / (step[:-1] + step[1:])
    minimum[1:-1] = (slope[:-1] <= 0) & (slope[1:] >= 0) & (bend[1:-1] > 0)
    error = np.where(minimum[:-1] | minimum[1:], step**2 / 8 * np.maximum(bend[:-1], bend[1:]), 0.0)
    return np.asarray(matters & ((np.abs(np.diff(value)) > SETTINGS.speed_change) | (error > SETTINGS.speed_error)))


def _constant_zones(s: Array, speed: Array, limits: LineLimits) -> Zones:
    """Merge neighbouring intervals of a path that have the same speed limit into longer parts with constant limits."""
    starts = np.concatenate([[0], 1 + np.flatnonzero(np.diff(speed))])
    same = np.ones(len(starts))
    return Zones(s[np.append(starts, len(speed))], speed[starts], limits.acceleration * same, limits.jerk * same)


def _lower_speeds(s: Array, permitted: Array, speed: Array, profile: SpeedProfile, everywhere: bool) -> bool:
    """Lower, in place, the speed limits of intervals where a profile is too fast; return whether any was lowered."""
    speeds = np.concatenate([profile.at_distance(part).speed for part in np.array_split(s, len(s) // BLOCK_SIZE + 1)])
    top = np.maximum(speeds[:-1], speeds[1:])
    peaks = profile.peaks()
    np.maximum.at(top, segment_index(s, peaks.distance), peaks.speed)
    allowed = np.minimum(permitted[:-1], permitted[1:])
    excess = np.minimum(top, speed) > allowed * (1 + ROUNDING_SHARE)
    if everywhere:
        speed[excess] = allowed[excess]
        return bool(excess.any())
    inside = np.flatnonzero(excess)
    if not inside.size:
        return False
    # one stretch around the slowest place of each run, as far as the permitted speed is similar
    starts = np.flatnonzero(np.diff(inside, prepend=-2) > 1)
    run = np.repeat(np.arange(len(starts)), np.diff(starts, append=len(inside)))
    speeds = allowed[inside]
    least = np.minimum.reduceat(speeds, starts)
    slowest = np.minimum.reduceat(np.where(speeds == least[run], inside, len(allowed)), starts)
    borders = np.concatenate([[-1], inside[speeds > SETTINGS.spread * least[run]], [len(allowed)]])
    after = np.searchsorted(borders, slowest)
    lowered = (inside > borders[after - 1][run]) & (inside < borders[after][run])
    speed[inside[lowered]] = np.minimum(speed[inside[lowered]], least[run[lowered]])
    return True


@dataclass(frozen=True)
class Dip:
    """Part of a path on which the motion is slower than requested, and the limit that causes the reduction.

    Attributes:
        start, end: Distances along the path, m.
        cause: The active limit, for example "centripetal acceleration" or "joint 'elbow' velocity".
        requested, permitted: Requested speed along the path and lowest steady speed that the limits permit there, m/s;
            equal if the limit is active on a ramp only.
        speed: Lowest speed of the schedule there, m/s.
        acceleration, jerk: Largest acceleration and jerk along the path there, m/s^2 and m/s^3.
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
        amount = f"permits {self.permitted:.4g} of {self.requested:.4g} m/s" if slow else "is active on a ramp"
        line = f"line acceleration {self.acceleration:.4g} m/s^2, jerk {self.jerk:.4g} m/s^3"
        return f"{self.start:.6g} to {self.end:.6g} m: {self.cause} {amount}, {line}"


@dataclass(frozen=True, eq=False)
class Schedule:
    """Motion along a path as a function of time, planned by `schedule`.

    Attributes:
        path: The path.
        limits: Limits of the schedule.
        profile: Distance and speed over time.
        dips: Parts of the path on which the motion is slower than requested, with the cause.
        joints: The joints along the path, if they were given.
    """

    path: PathLike
    limits: LineLimits
    profile: SpeedProfile
    dips: tuple[Dip, ...]
    joints: JointPath | None = None

    def __repr__(self) -> str:
        slower = f"slower than requested in {len(self.dips)} places" if self.dips else "at the requested speed"
        return f"<Schedule of {self.profile.distance[-1]:.6g} m in {self.duration:.6g} s, {slower}>"

    @property
    def duration(self) -> float:
        """Duration of the motion, s."""
        return self.profile.duration

    def at(self, time: ArrayLike) -> LineMotion:
        """Return the motion at times (M,) in [0, duration], s."""
        return self.profile.at(time)

    def time_at(self, distance: ArrayLike) -> Array:
        """Return the times at which the motion reaches distances (M,) from the start of the path, s."""
        return self.profile.at_distance(distance).t

    def sample(self, period: float) -> LineMotion:
        """Return samples of the motion every `period` s from the start, and at the end.

        Raises:
            ProblemError: The period is not positive, or too short.
        """
        return self.at(sample_times("sample period", period, self.duration))

    def function(self) -> Any:
        """Return the motion as a CasADi Function from time (s) to distance, speed, acceleration and jerk."""
        return self.profile.function()


@interruptible
def schedule(path: PathLike, limits: LineLimits, *, joints: JointPath | None = None, strict: bool = False) -> Schedule:
    """Plan the speed along a path from rest to rest in the least time that the limits allow.

    If only speed, acceleration and jerk along the path are active, the result is one jerk-limited motion, at the
    requested speed between its ramps and through the blends. Where that violates another limit, the stretch around the
    violation is planned again under all limits: by exact passes without jerk limits, else by convex programs. All
    limits are satisfied between the nodes too, to 0.1 %. Long paths without limits of joints or tool use ramps.

    Args:
        path: A models.paths.SmoothPath, or any PathLike.
        joints: The joints along the path; required with limits.joints.
        strict: Raise an error instead of reducing the speed.

    Raises:
        ProblemError: There are joint limits without joints, no motion keeps the limits, or, if strict, the requested
            speed violates a limit.
    """
    limited = check_line(path, limits, joints)
    require.flag("strict", strict)
    line_profile = None
    if np.isfinite(limits.jerk):
        line_profile = plan_zones(_constant_zones(np.asarray(path.bounds), path.by_piece(limits.speed), limits), {})
    further_limits = limited is not None or limits.tool is not None or np.isfinite(limits.centripetal)
    if line_profile is not None and not further_limits:
        return Schedule(path, limits, line_profile, (), joints)
    if line_profile is not None and limited is None and limits.tool is None and len(path.bounds) > SETTINGS.long_path:
        profile = plan_below_velocity_curve(path, limits)
        grid = coarse_grid(path, limits)
    else:
        grid = make_grid(path, limits, limited)
        profile = _constrained_profile(grid, line_profile)
    dips = () if profile is line_profile else _find_dips(grid, profile, limit_names(limits, limited))
    if strict and dips:
        listed = "\n  ".join(str(dip) for dip in dips[:10])
        hint, dip = "reduce the speed, enlarge the blends, or set strict=False", dips[0]
        message = f"the requested speed violates limits in {len(dips)} place(s); {hint}:\n  {listed}"
        raise ProblemError(message, name=dip.cause, value=dip.requested, limit=dip.permitted, time=dip.start)
    return Schedule(path, limits, profile, dips, joints)


def _constrained_profile(grid: Grid, line_profile: SpeedProfile | None) -> SpeedProfile:
    """Return a speed profile within all limits: `line_profile`, planned again where it violates a limit.

    If `line_profile` is None, the whole path is planned.
    """
    count = len(grid.requested)
    if line_profile is None:
        return fastest_profile(Stretch(grid, 0, count))
    violated = _violated_intervals(grid, line_profile)
    if not violated.any():
        return line_profile
    s, extent = grid.distance, 1.0
    while True:
        stretches = _violated_stretches(grid, line_profile, violated, extent)
        motions = []
        for first, last in stretches:
            ends = [(0.0 if k in (0, count) else float(grid.requested[k]) ** 2, 0.0) for k in (first, last)]
            try:
                motion = fastest_profile(Stretch(grid, first, last, (ends[0], ends[1])))
            except ProblemError:
                if (first, last) == (0, count):
                    raise
                break  # too short for the change of speed
            if not _reaches_speed_at_ends(grid, motion, first, last):
                break
            motions.append(motion)
        if len(motions) == len(stretches):
            break
        extent *= 2
    parts: list[SpeedProfile] = []
    done = 0.0
    for (first, last), motion in zip(stretches, motions, strict=True):
        if s[first] > done:
            parts.append(_cut_profile(line_profile, done, float(s[first])))
        parts.append(motion)
        done = float(s[last])
    if done < s[-1]:
        parts.append(_cut_profile(line_profile, done, float(s[-1])))
    return join_profiles(parts)


def _violated_intervals(grid: Grid, profile: SpeedProfile) -> NDArray[np.bool_]:
    """Return in which intervals of the grid a speed profile violates a limit. Shape (N,)."""
    violated = np.zeros(len(grid.requested), dtype=bool)
    # inside an interval the jerk may change and the speed may have its maximum
    before = np.maximum(profile.t[1:] - 1e-12 * profile.duration, 0.0)
    peaks = profile.at(np.concatenate([profile.t, before, profile.peaks().t]))
    at = segment_index(grid.distance, peaks.distance)
    for first, last in grid.blocks():
        at_nodes, inside = profile.at_distance(grid.distance[first : last + 1]), (at >= first) & (at < last)
        turn = LineMotion(*(value[inside] for value in peaks))
        for rows, ends in zip(grid.ends(first, last), (slice(-1), slice(1, None)), strict=True):
            motion = LineMotion(*(value[ends] for value in at_nodes))
            violated[first:last] |= (np.abs(rows.usage(motion)) > 1 + ROUNDING_SHARE).any(axis=1)
            exceeded = (np.abs(rows.take(at[inside] - first).usage(turn)) > 1 + ROUNDING_SHARE).any(axis=1)
            np.logical_or.at(violated, at[inside], exceeded)
    return violated


def _violated_stretches(
    grid: Grid, profile: SpeedProfile, violated: NDArray[np.bool_], extent: float
) -> list[tuple[int, int]]:
    """Return the first and last node of each part of a path that must be planned again because it violates a limit.

    The parts end at steady speeds or path ends, beyond the violated intervals by `extent` times the length of a ramp to
    rest.
    """
    count, s, limits = len(violated), grid.distance, grid.limits
    motion = profile.at_distance(s)
    steady = (np.abs(motion.acceleration) <= ROUNDING_SHARE * limits.acceleration) & (motion.jerk == 0)
    requested = node_minimum(grid.requested)
    steady &= np.abs(motion.speed - requested) <= ROUNDING_SHARE * requested
    steady[[0, -1]] = True
    steady_nodes = np.flatnonzero(steady)
    edges = np.flatnonzero(np.diff(np.concatenate([[0], violated.astype(np.int8), [0]]))).reshape(-1, 2)
    stretches: list[tuple[int, int]] = []
    for first, last in edges.tolist():
        ramp = extent * ramp_distance(0.0, float(grid.requested[first:last].max()), limits.acceleration, limits.jerk)
        low = int(np.searchsorted(s, s[first] - ramp, side="right")) - 1
        high = int(np.searchsorted(s, s[last] + ramp))
        begin = int(steady_nodes[np.searchsorted(steady_nodes, max(low, 0), side="right") - 1])
        end = int(steady_nodes[np.searchsorted(steady_nodes, min(high, count))])
        if stretches and begin <= stretches[-1][1]:
            stretches[-1] = (stretches[-1][0], max(end, stretches[-1][1]))
        else:
            stretches.append((begin, end))
    return stretches


def _reaches_speed_at_ends(grid: Grid, motion: SpeedProfile, first: int, last: int) -> bool:
    """Return whether a motion has the requested speed near its ends, except at the ends of the whole path."""
    length = motion.distance[-1] - motion.distance[0]
    for node, inside in ((first, first), (last, last - 1)):
        if node in (0, len(grid.requested)):
            continue
        near = np.abs(motion.distance - grid.distance[node]) < 0.02 * length
        if (motion.speed[near] < grid.requested[inside] * (1 - SETTINGS.leaving)).any():
            return False
    return True


def _cut_profile(profile: SpeedProfile, begin: float, end: float) -> SpeedProfile:
    """Return the part of a speed profile between two distances along the path."""
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


def _find_dips(grid: Grid, profile: SpeedProfile, names: tuple[str, ...]) -> tuple[Dip, ...]:
    """Return the parts of a path on which a curvature, tool or joint limit makes the motion slower than requested."""
    middle = profile.at_distance((grid.distance[:-1] + grid.distance[1:]) / 2)
    line_rows = [k for k, name in enumerate(names) if name.startswith("line ")]
    cause, steady = np.zeros(len(grid.requested), dtype=np.intp), np.zeros(len(grid.requested))
    binding = middle.speed < grid.requested * (1 - SETTINGS.reached)
    for first, last in grid.blocks():
        part, sides = slice(first, last), grid.ends(first, last)
        motion = LineMotion(*(value[part] for value in middle))
        usage = np.maximum(*(np.abs(rows.usage(motion)) for rows in sides))
        line = usage[:, line_rows].max(axis=1, initial=0.0)
        usage[:, line_rows] = 0.0
        cause[part], largest = usage.argmax(axis=1), usage.max(axis=1)
        binding[part] &= (largest > ACTIVE_SHARE) & (largest >= line - (1 - ACTIVE_SHARE))
        steady[part] = np.minimum(*(rows.steady() for rows in sides))
    permitted = np.minimum(steady, grid.requested)
    changes = (np.diff(binding) != 0) | (np.diff(cause) != 0) | (np.diff(grid.requested) != 0)
    edges = np.concatenate([[0], 1 + np.flatnonzero(changes), [len(binding)]])
    runs = np.stack([edges[:-1], edges[1:]], axis=1)[binding[edges[:-1]]]
    if not runs.size:
        return ()
    # runs of one cause form one dip unless the count of intervals at the requested speed grows between them
    reached = np.concatenate([[0], np.cumsum(middle.speed >= grid.requested * (1 - SETTINGS.reached))])
    begin, end = runs[1:, 0], runs[:-1, 1]
    separate = (cause[begin] != cause[end - 1]) | (grid.requested[begin] != grid.requested[end - 1])
    groups = np.concatenate([[0], 1 + np.flatnonzero(separate | (reached[begin] != reached[end]))])

    def extreme(function: np.ufunc, values: Array) -> Array:
        by_run = function.reduceat(np.append(values, values[-1]), runs.ravel())[::2]
        return np.asarray(function.reduceat(by_run, groups))

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
