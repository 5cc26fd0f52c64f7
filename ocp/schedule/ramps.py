"""Jerk-limited changes of the line speed: their length, their reach, and the fastest motion between two of them.

From limits that change along the path to one line-speed profile.
"""

from __future__ import annotations

from collections.abc import MutableMapping
from math import isfinite, sqrt
from typing import NamedTuple

import numpy as np
from ruckig import InputParameter, Result, Ruckig, RuckigError, Trajectory

from ocp.errors import ProblemError
from ocp.schedule.profile import Array, SpeedProfile

__all__ = ["Memory", "Phases", "Zones", "fastest", "peak_acceleration", "plan", "ramp_distance", "ramp_time", "reach"]

Phases = tuple[tuple[float, float], ...]
"""Durations (s) and jerks (m/s^3) of the parts of constant jerk, in order."""

CLOSED = 1e-9
"""Largest error of a motion's end, relative to its length and top speed."""


def ramp_time(change: float, acceleration: float, jerk: float) -> float:
    """Shortest time (s) of a speed change (m/s) that begins and ends without acceleration."""
    if change * jerk >= acceleration**2:
        return change / acceleration + acceleration / jerk
    return 2 * sqrt(change / jerk)


def ramp_distance(first: float, last: float, acceleration: float, jerk: float) -> float:
    """Distance (m) that the shortest change from one speed to the other takes."""
    return (first + last) / 2 * ramp_time(abs(last - first), acceleration, jerk)


def reach(speed: float, distance: float, acceleration: float, jerk: float) -> float:
    """Greatest speed (m/s) to which the speed can change within a distance (m), without acceleration at both ends.

    The inverse of ramp_distance: the same for slowing down from that speed.
    """
    # without constant acceleration x = sqrt((v - speed)/jerk) solves jerk x^3 + 2 speed x = distance: Newton from above
    x = (distance / jerk) ** (1 / 3)
    for _ in range(50):
        step = ((jerk * x * x + 2 * speed) * x - distance) / (3 * jerk * x * x + 2 * speed)
        x -= step
        if abs(step) <= 1e-15 * x:
            break
    if jerk * x <= acceleration:
        return float(speed + jerk * x * x)
    # with it: v^2 + v A^2/J = speed^2 - speed A^2/J + 2 A distance
    b = acceleration**2 / jerk
    root = sqrt(b * b + 4 * (speed * speed - speed * b + 2 * acceleration * distance))
    return float(max(speed, (root - b) / 2))


def peak_acceleration(mean: float, speed: float, jerk: float) -> float:
    """Peak acceleration (m/s^2) whose ramp from rest to `speed` (m/s) has the mean acceleration `mean`.

    v/A + A/J = v/mean, the smaller root.

    Raises:
        ProblemError: Values that are not positive; a jerk too low for that mean.
    """
    for name, value in (("mean acceleration", mean), ("speed", speed), ("jerk", jerk)):
        if not isinstance(value, int | float) or not (isfinite(value) and value > 0):
            raise ProblemError(f"{name} {value!r} must be positive and finite")
    time = speed / mean
    square = time * time - 4 * speed / jerk
    if square < 0:
        raise ProblemError(
            f"mean acceleration {mean:g} m/s^2 up to {speed:g} m/s needs a jerk of {4 * mean**2 / speed:g} m/s^3 or "
            f"more, not {jerk:g}"
        )
    return jerk * (time - sqrt(square)) / 2


def fastest(distance: float, first: float, last: float, top: float, acceleration: float, jerk: float) -> Phases:
    """Fastest motion over a distance (m) from one speed to another, without acceleration at both ends.

    ruckig finds it, in units of the distance and of the time that the top speed takes for it. Where its answer does
    not close, which happens for distances that are barely enough, the same profile is put together from two ramps.

    Args:
        distance: m; enough for the change of speed, see ramp_distance.
        first, last: m/s, at most `top`.
        top, acceleration, jerk: Limits, m/s, m/s^2, m/s^3.
    """
    unit = distance / top
    asked = InputParameter(1)
    asked.current_position, asked.target_position = [0.0], [1.0]
    asked.current_velocity, asked.target_velocity = [first / top], [last / top]
    asked.max_velocity = [1.0]
    asked.max_acceleration = [acceleration * unit / top]
    asked.max_jerk = [jerk * unit * unit / top]
    trajectory = Trajectory(1)
    try:
        solved = Ruckig(1).calculate(asked, trajectory) == Result.Working
    except RuckigError:  # its root finding gave up
        solved = False
    if solved:
        found = trajectory.profiles[0][0]
        scale = top / (unit * unit)
        phases = tuple((t * unit, j * scale) for t, j in zip(found.t, found.j, strict=True) if t > 0)
        if _closes(phases, distance, first, last, top):
            return phases
    return _two_ramps(distance, first, last, top, acceleration, jerk)


def _closes(phases: Phases, distance: float, first: float, last: float, top: float) -> bool:
    s, v, a = 0.0, first, 0.0
    low, high = min(first, last), top
    for t, j in phases:
        s += t * (v + t * (a / 2 + t * j / 6))
        v += t * (a + t * j / 2)
        a += t * j
        if not low - CLOSED * top <= v <= high + CLOSED * top:
            return False
    return abs(s - distance) <= CLOSED * distance and abs(v - last) <= CLOSED * top


def _two_ramps(distance: float, first: float, last: float, top: float, acceleration: float, jerk: float) -> Phases:
    def needed(peak: float) -> float:
        return ramp_distance(first, peak, acceleration, jerk) + ramp_distance(peak, last, acceleration, jerk)

    low, high = max(first, last), top
    if needed(high) > distance:
        for _ in range(200):
            middle = (low + high) / 2
            if middle in (low, high):
                break
            low, high = (middle, high) if needed(middle) <= distance else (low, middle)
    else:
        low = high
    rest = max(distance - needed(low), 0.0)
    return (
        *_ramp(low - first, acceleration, jerk),
        *(((rest / low, 0.0),) if rest > 0 and low > 0 else ()),
        *_ramp(last - low, acceleration, jerk),
    )


def _ramp(change: float, acceleration: float, jerk: float) -> Phases:
    size, sign = abs(change), 1.0 if change > 0 else -1.0
    if size == 0:
        return ()
    if size * jerk < acceleration**2:
        t = sqrt(size / jerk)
        return ((t, sign * jerk), (t, -sign * jerk))
    t = acceleration / jerk
    middle = size / acceleration - t
    flat = ((middle, 0.0),) if middle > 0 else ()
    return ((t, sign * jerk), *flat, (t, -sign * jerk))


Memory = MutableMapping[tuple[float, ...], Phases]
"""Motions already found, by their limits and ends."""
MARGIN = 1e-6
"""Share of a zone's length kept back when its ends' speeds are chosen, so that a motion surely exists."""


class Zones(NamedTuple):
    """Stretches of a path with limits of their own.

    Attributes:
        bounds: Distances at which the zones begin, and the end. Shape (Z + 1,), m.
        speed, acceleration, jerk: Limits in each zone. Shape (Z,).
    """

    bounds: Array
    speed: Array
    acceleration: Array
    jerk: Array


def plan(zones: Zones, memory: Memory) -> SpeedProfile:
    """Line speed from rest to rest, as fast as the zones' limits allow with no acceleration at their bounds.

    A backward and a forward pass find the speeds at the bounds, then each zone is the fastest motion between them.
    One zone alone gives the time optimum; more do but for the acceleration that drops to zero at a bound.
    """
    lengths = np.diff(zones.bounds).tolist()
    limits = list(zip(zones.speed.tolist(), zones.acceleration.tolist(), zones.jerk.tolist(), strict=True))
    ends = [0.0, *np.minimum(zones.speed[:-1], zones.speed[1:]).tolist(), 0.0]
    count = len(lengths)
    for i in range(count):
        ends[i + 1] = _limited(ends[i + 1], ends[i], lengths[i], limits[i])
    for i in reversed(range(count)):
        ends[i] = _limited(ends[i], ends[i + 1], lengths[i], limits[i])

    durations: list[float] = []
    jerks: list[float] = []
    rows: list[tuple[float, float, float]] = []  # distance, speed, acceleration at the start of each phase
    for i, ((top, most, jerk), length) in enumerate(zip(limits, lengths, strict=True)):
        first, last = ends[i], ends[i + 1]
        if first == last == top:
            phases: Phases = ((length / top, 0.0),)
        else:
            key = (length, first, last, top, most, jerk)
            known = memory.get(key)
            if known is None:
                known = memory[key] = fastest(*key)
            phases = known
        s, v, a = float(zones.bounds[i]), first, 0.0
        for t, j in phases:
            durations.append(t)
            jerks.append(j)
            rows.append((s, v, a))
            s += t * (v + t * (a / 2 + t * j / 6))
            v = max(v + t * (a + t * j / 2), 0.0)
            a += t * j
            if abs(a) <= 1e-9 * most:
                a = 0.0
    if not durations or not np.isfinite(durations).all():
        raise ProblemError(f"no line-speed profile over {zones.bounds[-1]:g} m: durations {durations[:5]}")
    state = np.array([*rows, (float(zones.bounds[-1]), 0.0, 0.0)])
    times = np.concatenate([[0.0], np.cumsum(durations)])
    return SpeedProfile(times, state[:, 0], state[:, 1], state[:, 2], np.array(jerks))


def _limited(speed: float, other: float, length: float, limits: tuple[float, float, float]) -> float:
    if speed <= other:
        return speed
    return min(speed, reach(other, length * (1 - MARGIN), *limits[1:]))
