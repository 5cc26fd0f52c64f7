"""Fastest motions through zones of constant limits, and time-optimal passes for motions without jerk limits.

A zone is a stretch of the path with constant limits of speed, acceleration and jerk; `plan_zones` finds the speeds at
their bounds and joins the fastest motions between them.

Without jerk limits the fastest motion follows from a backward and a forward pass in (s, v^2). With x = v^2 at the nodes
and one acceleration u in each interval of width h, x grows by 2 h u, and each row is linear in (u, x). Backward, the
squared speeds from which the end can be reached form an interval at each node: eliminating u from the rows of an
interval leaves bounds on x. Forward, the greatest u that stays among them is taken (Pham and Pham, A New Approach to
Time-Optimal Path Parameterization Based on Reachability Analysis, 2018; the rows hold at both ends of an interval).
"""

from __future__ import annotations

from collections.abc import MutableMapping
from math import sqrt
from typing import NamedTuple

import numpy as np
from ruckig import InputParameter, Result, Ruckig, RuckigError, Trajectory

from ocp.errors import ProblemError, require
from ocp.motion.tasks.speed_profile import (
    Array,
    Phases,
    SpeedProfile,
    integrate_jerk,
    ramp_distance,
    ramp_phases,
    reachable_speed,
)
from ocp.tolerances import ROUNDING_SHARE

__all__ = [
    "Memory", "Zones", "fastest_motion", "peak_acceleration", "plan_zones", "reachability_passes",
]  # fmt: skip

Memory = MutableMapping[tuple[float, ...], Phases]
"""Cache of computed motions, keyed by distance, end speeds and limits."""

REACH_MARGIN = 1e-6
"""Fraction of a zone (stretch with constant limits) kept in reserve, so that a motion through the zone is feasible."""


class Zones(NamedTuple):
    """Consecutive parts of a path, each with its own constant limits of speed, acceleration and jerk.

    Attributes:
        bounds: Distances at which the zones begin, and at which the last one ends. Shape (Z + 1,), m.
        speed, acceleration, jerk: Limits in each zone. Shape (Z,).
    """

    bounds: Array
    speed: Array
    acceleration: Array
    jerk: Array


def peak_acceleration(mean: float, speed: float, jerk: float) -> float:
    """Return the peak acceleration (m/s^2) of a ramp from rest to `speed` (m/s) with mean acceleration `mean`.

    It is the smaller root of v/A + A/J = v/mean.

    Raises:
        ProblemError: A value is not positive, or the jerk is too low for that mean.
    """
    for name, value in (("mean", mean), ("speed", speed), ("jerk", jerk)):
        require.positive(f"peak_acceleration: {name}", value)
    time = speed / mean
    square = time * time - 4 * speed / jerk
    if square < 0:
        least = 4 * mean**2 / speed
        message = f"mean acceleration {mean:g} m/s^2 up to {speed:g} m/s needs a jerk of {least:g} m/s^3 or more"
        raise ProblemError(f"{message}, not {jerk:g}", name="jerk", value=jerk, limit=(least, np.inf))
    return jerk * (time - sqrt(square)) / 2


def fastest_motion(distance: float, first: float, last: float, limits: tuple[float, float, float]) -> Phases:
    """Return the fastest motion over a distance (m) between two speeds, with zero acceleration at both ends.

    ruckig computes it, in units of the distance and of the time to cover it at top speed. If its result misses the
    distance or the final speed, as for distances that are barely enough, the profile is built from two ramps.

    Args:
        distance: m; at least the ramp_distance of the change of speed.
        first, last: Speeds, m/s, at most `top`.
        limits: Largest speed `top`, acceleration and jerk, m/s, m/s^2, m/s^3.
    """
    top, acceleration, jerk = limits
    unit = distance / top
    request = InputParameter(1)
    request.current_position, request.target_position = [0.0], [1.0]
    request.current_velocity, request.target_velocity = [first / top], [last / top]
    request.max_velocity = [1.0]
    request.max_acceleration = [acceleration * unit / top]
    request.max_jerk = [jerk * unit * unit / top]
    trajectory = Trajectory(1)
    try:
        solved = Ruckig(1).calculate(request, trajectory) == Result.Working
    except RuckigError:  # its root finding failed
        solved = False
    if solved:
        profile = trajectory.profiles[0][0]
        scale = top / (unit * unit)
        phases = tuple((t * unit, j * scale) for t, j in zip(profile.t, profile.j, strict=True) if t > 0)
        if _closes(phases, distance, first, last, top):
            return phases
    return _two_ramps(distance, first, last, top, acceleration, jerk)


def _closes(phases: Phases, distance: float, first: float, last: float, top: float) -> bool:
    """Return whether a motion in phases of constant jerk ends at the given distance and speed, at permitted speeds."""
    s, v, a = 0.0, first, 0.0
    error = ROUNDING_SHARE * top
    for t, j in phases:
        covered, v, a = integrate_jerk(v, a, j, t)
        s += covered
        if not min(first, last) - error <= v <= top + error:
            return False
    return abs(s - distance) <= ROUNDING_SHARE * distance and abs(v - last) <= error


def _two_ramps(distance: float, first: float, last: float, top: float, acceleration: float, jerk: float) -> Phases:
    """Return a motion that accelerates to the highest possible speed, continues at that speed, and decelerates."""

    def needed(peak: float) -> float:
        return ramp_distance(first, peak, acceleration, jerk) + ramp_distance(peak, last, acceleration, jerk)

    low, high = max(first, last), top
    if needed(high) <= distance:
        low = high
    while low < (middle := (low + high) / 2) < high:
        low, high = (middle, high) if needed(middle) <= distance else (low, middle)
    rest = max(distance - needed(low), 0.0)
    return (
        *ramp_phases(low - first, acceleration, jerk),
        *(((rest / low, 0.0),) if rest > 0 and low > 0 else ()),
        *ramp_phases(last - low, acceleration, jerk),
    )


def plan_zones(zones: Zones, cache: Memory) -> SpeedProfile:
    """Return a fast rest-to-rest speed profile through parts of a path that have constant limits each.

    Two passes find the speeds at the bounds of the parts; in each part the motion between these is the fastest. The
    result is time-optimal for one part, and for several under the condition of zero acceleration at their bounds.
    """
    lengths = np.diff(zones.bounds).tolist()
    limits = list(zip(zones.speed.tolist(), zones.acceleration.tolist(), zones.jerk.tolist(), strict=True))
    ends = [0.0, *np.minimum(zones.speed[:-1], zones.speed[1:]).tolist(), 0.0]
    count = len(lengths)
    for i in range(count):
        if ends[i + 1] > ends[i]:
            ends[i + 1] = _limit_speed(ends[i + 1], ends[i], lengths[i], limits[i])
    for i in reversed(range(count)):
        if ends[i] > ends[i + 1]:
            ends[i] = _limit_speed(ends[i], ends[i + 1], lengths[i], limits[i])

    motions: list[Phases] = []
    for largest, length, first, last in zip(limits, lengths, ends[:-1], ends[1:], strict=True):
        key = (length, first, last, *largest)
        if first == last == largest[0]:
            motions.append(((length / first, 0.0),))
        else:
            motions.append(
                cache[key] if key in cache else cache.setdefault(key, fastest_motion(length, first, last, largest))
            )
    return _profile(zones, np.array(ends), motions)


def _profile(zones: Zones, ends: Array, motions: list[Phases]) -> SpeedProfile:
    """Join the motions through consecutive parts of a path to one speed profile; their end speeds are given, m/s."""
    counts = np.array([len(phases) for phases in motions])
    durations, jerks = np.array([phase for phases in motions for phase in phases]).reshape(-1, 2).T
    if not durations.size or not np.isfinite(durations).all():
        message = f"no line-speed profile over {zones.bounds[-1]:g} m: durations {durations[:5].tolist()}"
        raise ProblemError(message, name="durations", value=durations[:5].tolist())
    starts = np.cumsum(counts) - counts
    s, v, a = (np.zeros(len(durations) + 1) for _ in range(3))
    place, speed, rate = zones.bounds[:-1].copy(), ends[:-1].copy(), np.zeros(len(motions))
    for phase_number in range(int(counts.max())):
        longer = np.flatnonzero(counts > phase_number)
        at = starts[longer] + phase_number
        s[at], v[at], a[at] = place[longer], speed[longer], rate[longer]
        covered, new_speed, new_acceleration = integrate_jerk(speed[longer], rate[longer], jerks[at], durations[at])
        place[longer] += covered
        speed[longer] = np.maximum(new_speed, 0.0)
        rate[longer] = np.where(np.abs(new_acceleration) > 1e-9 * zones.acceleration[longer], new_acceleration, 0.0)
    s[-1] = zones.bounds[-1]
    return SpeedProfile(np.concatenate([[0.0], np.cumsum(durations)]), s, v, a, jerks)


def _limit_speed(speed: float, other_end: float, length: float, limits: tuple[float, float, float]) -> float:
    """Lower the speed at one end of a part of a path to what can be reached from the speed at the other end."""
    return min(speed, reachable_speed(other_end, length * (1 - REACH_MARGIN), *limits[1:]))


def reachability_passes(distance: Array, caps: Array, *, p: Array, q: Array, low: Array, high: Array) -> Array:
    """Return the greatest squared speeds at path nodes (N + 1,) from rest to rest, by a backward and a forward pass.

    Args:
        distance: Distances of the nodes. Shape (N + 1,), m.
        caps: Greatest permitted squared speed at each node. Shape (N + 1,).
        p, q, low, high: low <= p u + q x <= high in each interval, x at its first node. Shape (N, R).

    Raises:
        ProblemError: No motion can pass a node, its distance (m) as `time`.
    """
    h = np.diff(distance)
    floor, ceiling = _feasible_squares(p, q, low, high, caps[:-1])
    least, top = np.zeros(len(distance)), np.zeros(len(distance))
    # bounds of u, linear in x: rows with p > 0 bound u from above by `high`, from below by `low`, others vice versa
    sign = np.sign(p)
    with np.errstate(divide="ignore", invalid="ignore"):
        slope = np.where(sign == 0, 0.0, -q / p)
        above = np.where(sign == 0, np.inf, np.where(sign > 0, high, low) / p)
        below = np.where(sign == 0, -np.inf, np.where(sign > 0, low, high) / p)
    with np.errstate(divide="ignore", invalid="ignore"):
        for k in range(len(h) - 1, -1, -1):
            # the range of x + 2 h u over u must intersect the reachable interval of the next node
            bend = 1 + 2 * h[k] * slope[k]
            ends = (top[k + 1] - 2 * h[k] * below[k]) / bend
            starts = (least[k + 1] - 2 * h[k] * above[k]) / bend
            up, down = bend > 0, bend < 0
            high_x = min(ceiling[k], ends[up].min(initial=np.inf), starts[down].min(initial=np.inf))
            low_x = max(floor[k], starts[up].max(initial=0.0), ends[down].max(initial=0.0))
            if not low_x <= high_x * (1 + ROUNDING_SHARE) + 1e-300:
                place = float(distance[k])
                message = f"no motion keeps the limits of acceleration and torque at {place:g} m; raise them"
                raise ProblemError(message, name="acceleration", value=low_x, limit=high_x, time=place)
            least[k], top[k] = min(low_x, high_x), high_x
    if least[0] > 0:
        message = "no motion from rest keeps the limits of acceleration and torque at 0 m; raise them"
        raise ProblemError(message, name="acceleration", value=float(least[0]), limit=0.0, time=0.0)
    x = np.zeros(len(distance))
    for k in range(len(h)):
        u = min(float((above[k] + slope[k] * x[k]).min(initial=np.inf)), (top[k + 1] - x[k]) / (2 * h[k]))
        x[k + 1] = min(max(x[k] + 2 * h[k] * u, least[k + 1]), top[k + 1])
    return x


def _feasible_squares(p: Array, q: Array, low: Array, high: Array, caps: Array) -> tuple[Array, Array]:
    """Return lower and upper bounds (N,) of the squared speeds at which the limits leave some acceleration possible."""
    floor, ceiling = np.zeros(len(p)), caps.copy()
    count = p.shape[1]
    with np.errstate(divide="ignore", invalid="ignore"):
        for i in range(count):
            for j in range(i, count):
                # eliminating u from two rows leaves bounds on x
                weight = np.where(p[:, i] == 0, 1.0, p[:, j]), np.where(p[:, i] == 0, 0.0, -p[:, i])
                if i == j:
                    weight = np.where(p[:, i] == 0, 1.0, 0.0), np.zeros(len(p))
                of_x = weight[0] * q[:, i] + weight[1] * q[:, j]
                least = sum(np.minimum(w * low[:, r], w * high[:, r]) for w, r in zip(weight, (i, j), strict=True))
                greatest = sum(np.maximum(w * low[:, r], w * high[:, r]) for w, r in zip(weight, (i, j), strict=True))
                ends = least / of_x, greatest / of_x
                bounded = of_x != 0
                ceiling = np.where(bounded, np.minimum(ceiling, np.fmax(*ends)), ceiling)
                floor = np.where(bounded, np.maximum(floor, np.fmin(*ends)), floor)
                ceiling = np.where(~bounded & ((least > 0) | (greatest < 0)) & (np.abs(weight[0]) > 0), -1.0, ceiling)
    return floor, ceiling
