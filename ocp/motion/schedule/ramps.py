"""Fastest motions through zones of constant limits, and time-optimal passes for motions without jerk limits.

A zone is a stretch of the path with constant limits of speed, acceleration and jerk; `plan_zones` finds the speeds at
their bounds and joins the fastest motions between them.

Without jerk limits the fastest motion follows from a backward and a forward pass in (s, v^2). With x = v^2 at the nodes
and an acceleration u that is linear in each interval of width h, x grows by h times the sum of u at both ends, and each
row bounds u by lines in x. Backward, the squared speeds from which the end can be reached are those up to a greatest
one, which follows from that of the next node; forward, the greatest x that stays below is taken (Pham and Pham, A New
Approach to Time-Optimal Path Parameterization Based on Reachability Analysis, 2018; by the trapezoidal rule here, whose
error falls with h^2). A pass is the fixed point of a minimum of increasing functions, which are piecewise linear.
"""

from __future__ import annotations

from collections.abc import MutableMapping
from math import sqrt
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from ruckig import InputParameter, Result, Ruckig, RuckigError, Trajectory

from models.checks import Array
from ocp.errors import ProblemError, require
from ocp.motion.tasks.speed_profile import (
    Phases,
    SpeedProfile,
    integrate_jerk,
    ramp_distance,
    ramp_phases,
    reachable_speed,
)
from ocp.tolerances import ROUNDING_SHARE

Memory = MutableMapping[tuple[float, ...], Phases]
"""Cache of computed motions, keyed by distance, end speeds and limits."""

NO_INERTIA = 1e-12
"""Coefficient of the acceleration, over the largest of all rows, below which a row does not limit the acceleration."""

UNBOUNDED = 1e300  # bound of an acceleration that is not limited; finite, so that its multiple by 0 is 0

ACTIVE_USAGE = 0.1  # share of a limit below which its part at a steady speed cannot make it active in a short interval

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
    """Return whether phases of constant jerk end at a given distance and speed, and keep the speed in its range."""
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
    """Return a fast rest-to-rest speed profile through consecutive parts of a path, each with constant limits.

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
        if key not in cache:
            steady = first == last == largest[0]
            cache[key] = ((length / first, 0.0),) if steady else fastest_motion(length, first, last, largest)
        motions.append(cache[key])
    return _join_motions(zones, np.array(ends), motions)


def _join_motions(zones: Zones, ends: Array, motions: list[Phases]) -> SpeedProfile:
    """Join motions through consecutive parts of a path, with given speeds at the ends, m/s, to one speed profile."""
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
    """Lower the speed at one end of a part of a path to the highest that the speed at the other end permits."""
    return min(speed, reachable_speed(other_end, length * (1 - REACH_MARGIN), *limits[1:]))


class _Bounds(NamedTuple):
    """Bounds of the acceleration u at squared speed x: low + slope x <= u <= high + slope x. Shape (R, P) each."""

    slope: Array
    low: Array
    high: Array

    @classmethod
    def build(cls, rows: Array) -> _Bounds:
        """Return the bounds of acceleration u at squared speed x that -1 <= p u + q x + r <= 1 sets for rows (p, q, r).

        Shape (3, R, P).
        """
        p, q, r = rows
        size = np.abs(p)
        free = size <= NO_INERTIA * size.max(axis=0)
        inverse = np.divide(-1.0, p, out=np.zeros_like(p), where=~free)
        middle, reach = r * inverse, np.where(free, UNBOUNDED, np.abs(inverse))
        return cls(q * inverse, middle - reach, middle + reach)

    def take(self, places: NDArray[np.intp] | slice) -> _Bounds:
        """Return the bounds at selected points of the path."""
        return _Bounds(*(kind[:, places] for kind in self))

    def at(self, x: Array) -> tuple[Array, Array, Array]:
        """Return the greatest lower and least upper bound of u at squared speeds x, and the slope of their gap."""
        change, each = self.slope * x, np.arange(len(x))
        below, above = change + self.low, change + self.high
        low, high = below.argmax(axis=0), above.argmin(axis=0)
        return below[low, each], above[high, each], self.slope[high, each] - self.slope[low, each]

    def feasible(self, caps: Array) -> Array:
        """Return the greatest squared speeds, at most `caps` (P,), at which an acceleration satisfies all bounds."""
        x, at, bounds = caps.copy(), np.arange(len(caps)), self
        while at.size:  # Newton's method on a concave function, from above its root
            low, high, slope = bounds.at(x[at])
            beyond = (low - high > ROUNDING_SHARE * (np.abs(low) + np.abs(high))) & (x[at] > 0)
            at = at[beyond]
            x[at] = np.maximum(x[at] + ((low - high)[beyond] / slope[beyond]), 0.0)
            bounds = self.take(at)
        return x


def reachability_passes(
    distance: Array, caps: Array, rows: Array, jumps: tuple[NDArray[np.intp], Array]
) -> tuple[Array, Array, Array]:
    """Return the greatest squared speeds at path nodes (N + 1,), and accelerations, by a backward and a forward pass.

    Args:
        distance: Distances of the nodes. Shape (N + 1,), m.
        caps: Greatest permitted squared speeds at the nodes; 0 at rest. Shape (N + 1,).
        rows: Coefficients (p, q, r) of rows -1 <= p u + q x + r <= 1 with -1 < r < 1 at the nodes. Shape (3, R, N + 1).
        jumps: Indices of the intervals at whose ends these rows jump, and the rows just before. Shape (J,), (3, R, J).

    Returns:
        The squared speeds, and the accelerations where each interval begins and where it ends. Shape (N,).

    Raises:
        ProblemError: The motion must stop at a node; `time` is the distance of this node, m.
    """
    h, (at, before), bounds, bounds_before = np.diff(distance), jumps, _Bounds.build(rows), _Bounds.build(jumps[1])
    most = bounds.feasible(caps)
    most[at + 1] = bounds_before.feasible(most[at + 1])
    begin, end = bounds.take(slice(-1)), bounds.take(slice(1, None))
    right = rows[:, :, 1:]
    if at.size:
        right, end = right.copy(), _Bounds(*(kind.copy() for kind in end))
        right[:, :, at] = before
        for kind, values in zip(end, bounds_before, strict=True):
            kind[:, at] = values
    # near a point of zero inertia a bound is steeper than the interval is short, and next to rest the acceleration is
    # no linear function of time: one acceleration holds at both ends
    (p, q), (p_end, q_end) = np.abs(rows[:2, :, :-1]), np.abs(right[:2])
    active = np.maximum(q, q_end) * np.maximum(caps[1:], caps[:-1]) > ACTIVE_USAGE
    stiff = (active & ((h * q > p) | (h * q_end > p_end))).any(axis=0) | (caps[1:] == 0) | (caps[:-1] == 0)
    left, moved = rows[:, :, :-1][:, :, stiff], right[:, :, stiff]
    moved[0] += 2 * h[stiff] * moved[1]
    both = _Bounds.build(np.concatenate([left, moved], axis=1))
    most[:-1][stiff] = both.feasible(most[:-1][stiff])
    padded = []
    for own, fill, at_both in zip(begin, (0.0, -UNBOUNDED, UNBOUNDED), both, strict=True):
        padded.append(np.concatenate([own, np.full(own.shape, fill)]))
        padded[-1][:, stiff] = at_both
    begin = _Bounds(*padded)
    # the squared speed grows by w u at the beginning + z u at the end
    w, z = np.where(stiff, 2 * h, h), np.where(stiff, 0.0, h)
    of_begin, of_end = 1 + w * begin.slope, 1 - z * end.slope
    backward = (of_begin, w * begin.low), (of_end, -z * end.low)
    top = _greatest_squares(most[::-1], *((slope[:, ::-1], offset[:, ::-1]) for slope, offset in backward))[::-1]
    x = _greatest_squares(top, (of_end, -z * end.high), (of_begin, w * begin.high))
    if not x[1:-1].all():
        place = float(distance[1 + int((x[1:-1] == 0).argmax())])
        message = f"no motion keeps the limits of acceleration and torque at {place:g} m; raise them"
        raise ProblemError(message, name="acceleration", value=0.0, limit=0.0, time=place)
    total = np.diff(x) / h
    (low, high, _), (low_end, high_end, _) = begin.at(x[:-1]), end.at(x[1:])
    u = np.minimum(np.maximum(total / 2, np.maximum(low, total - high_end)), np.minimum(high, total - low_end))
    u = np.where(stiff, total / 2, u)
    return x, u, total - u


def _greatest_squares(caps: Array, near: tuple[Array, Array], far: tuple[Array, Array]) -> Array:
    """Return the greatest squared speeds x <= `caps` at N + 1 nodes with max(a x[k + 1] + b) <= min(c x[k] + d).

    Howard's policy iteration: all nodes are solved with the lines that are active at the last solution, until the
    active lines stay the same.

    Args:
        caps: Upper bounds. Shape (N + 1,).
        near, far: a and b, c and d. Shape (R, N) each.
    """
    each, x, bounds, lines = np.arange(len(caps) - 1), caps, caps[1:].tolist(), np.zeros(0)
    for _ in each:
        i, j = (near[0] * x[1:] + near[1]).argmax(axis=0), (far[0] * x[:-1] + far[1]).argmin(axis=0)
        before, lines = lines, np.stack([i, j])
        if np.array_equal(lines, before):
            break
        slope = near[0][i, each]
        rises = slope > 0  # else the bound falls and does not limit x
        slope = np.where(rises, slope, 1.0)
        factor = np.where(rises, far[0][j, each], 0.0) / slope
        shift = np.where(rises, far[1][j, each] - near[1][i, each], UNBOUNDED) / slope
        value = float(caps[0])
        values = [value]
        for gain, more, cap in zip(factor.tolist(), shift.tolist(), bounds, strict=True):
            value = gain * value + more
            value = cap if value > cap else value if value > 0.0 else 0.0  # quicker than min and max
            values.append(value)
        last, x = x, np.array(values)
        if np.abs(x - last).max() <= ROUNDING_SHARE * x.max():
            break
    return x
