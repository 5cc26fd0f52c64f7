"""Distance and speed along a path as functions of time, in segments of constant jerk.

A ramp changes the speed with zero acceleration at both ends. Its time, its distance, and the inverse (the speed within
reach) have closed forms, and so has the fastest motion from rest to rest, which consists of two ramps and a stretch of
constant speed.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import cbrt, hypot, sqrt
from typing import Any, Literal, NamedTuple

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike, NDArray

from models.checks import Array, short_repr
from ocp.errors import ProblemError, require, values_within
from ocp.tolerances import ROUNDING_SHARE

Phases = tuple[tuple[float, float], ...]  # durations (s) and jerks (m/s^3) of consecutive phases of constant jerk


class LineMotion(NamedTuple):
    """Motion along a path at M times: distance, speed, acceleration and jerk, in s and m. Shape (M,) each."""

    t: Array
    distance: Array
    speed: Array
    acceleration: Array
    jerk: Array

    def __repr__(self) -> str:
        return short_repr(self)


def integrate_jerk(speed: Any, acceleration: Any, jerk: Any, time: Any) -> tuple[Any, Any, Any]:
    """Return distance, speed and acceleration after a time at constant jerk; arguments may be CasADi expressions."""
    s = time * (speed + time * (acceleration / 2 + time * jerk / 6))
    return s, speed + time * (acceleration + time * jerk / 2), acceleration + time * jerk


def segment_index(bounds: ArrayLike, places: ArrayLike, side: Literal["left", "right"] = "right") -> NDArray[np.intp]:
    """Return, for each place, the index of the interval between increasing bounds (K + 1,) that is nearest to it."""
    return np.asarray(np.clip(np.searchsorted(bounds, places, side=side) - 1, 0, len(np.asarray(bounds)) - 2))


@dataclass(frozen=True, eq=False)
class SpeedProfile:
    """Motion along a path as consecutive segments of constant jerk.

    Attributes:
        t, distance, speed, acceleration: Values at the start of each segment, and at the end of the last.
            Shape (K + 1,), s, m, m/s, m/s^2.
        jerk: Jerk of each segment. Shape (K,), m/s^3.

    Raises:
        ProblemError: A shape is wrong, a value is not finite, or times or distances decrease.
    """

    t: Array
    distance: Array
    speed: Array
    acceleration: Array
    jerk: Array

    def __post_init__(self) -> None:
        for name in ("t", "distance", "speed", "acceleration", "jerk"):
            count = "times" if name == "t" else len(self.t) - (name == "jerk")
            row = require.array(f"profile: {name}", getattr(self, name), (count,), least=2)
            object.__setattr__(self, name, row)
            if name in ("t", "distance") and (np.diff(row) < 0).any():
                raise ProblemError(f"profile: {name} must not decrease", name=name, value=row)

    @property
    def duration(self) -> float:
        """Duration of the motion, s."""
        return float(self.t[-1])

    def at(self, time: ArrayLike) -> LineMotion:
        """Return the motion at times (M,) in [0, duration], s; where the jerk jumps, the later jerk counts."""
        words = f"s is outside the schedule, 0 to {self.duration:g} s"
        t = np.atleast_1d(values_within(time, self.duration, "time", words))
        segment = segment_index(self.t, t)
        motion = self._motion(segment, t - self.t[segment])
        # integration reaches the known end only to rounding
        for values, last in zip(motion[:4], (self.t, self.distance, self.speed, self.acceleration), strict=True):
            values[t == self.duration] = last[-1]
        return motion

    def at_distance(self, distance: ArrayLike) -> LineMotion:
        """Return the motion at distances (M,) from the start, m; where it stops, its state on arrival counts."""
        length = float(self.distance[-1])
        words = f"m is off the path, which is {length:g} m long"
        s = np.atleast_1d(values_within(distance, length, "distance", words))
        segment = segment_index(self.distance, s, side="left")
        inside = self._time_inside(segment, s - self.distance[segment])
        # near rest the time has the cube root of the rounding error, but the end is known
        return self._motion(segment, np.where(s == length, np.diff(self.t)[-1], inside))

    def peaks(self) -> LineMotion:
        """Return distance, speed, acceleration where speed may be largest: segment ends and zeros of acceleration."""
        with np.errstate(divide="ignore", invalid="ignore"):
            zero = -self.acceleration[:-1] / self.jerk
        inside = np.flatnonzero((zero > 0) & (zero < np.diff(self.t)))
        return self.at(np.concatenate([self.t, self.t[:-1][inside] + zero[inside]]))

    def function(self) -> Any:
        """Return a CasADi Function from time (s), clipped to the motion, to distance, speed, acceleration and jerk."""
        time = ca.MX.sym("time")
        inside = ca.fmin(ca.fmax(time, 0.0), self.duration)
        table = np.stack([self.t[:-1], self.distance[:-1], self.speed[:-1], self.acceleration[:-1], self.jerk])
        segment = ca.low(ca.DM(self.t), inside, {"lookup_mode": "binary"}) if len(self.jerk) > 1 else ca.MX(0)
        start, s, v, a, j = ca.vertsplit(ca.MX(ca.DM(table))[:, segment])
        distance, speed, acceleration = integrate_jerk(v, a, j, inside - start)
        outputs = [s + distance, speed, acceleration, j]
        return ca.Function("profile", [time], outputs, ["time"], ["distance", "speed", "acceleration", "jerk"])

    def _motion(self, segment: NDArray[np.intp], t: Array) -> LineMotion:
        """Return the motion at times (M,), s, measured from the starts of segments with given indices (M,)."""
        s, v, a, j = self.distance[segment], self.speed[segment], self.acceleration[segment], self.jerk[segment]
        distance, speed, acceleration = integrate_jerk(v, a, j, t)
        return LineMotion(self.t[segment] + t, s + distance, np.maximum(speed, 0.0), acceleration, j)

    def _time_inside(self, segment: NDArray[np.intp], distance: Array) -> Array:
        """Return the times (M,), from the starts of given segments (M,), at which distances (M,) are covered."""
        v, a, j, high = self.speed[segment], self.acceleration[segment], self.jerk[segment], np.diff(self.t)[segment]
        t, low, todo = np.where(distance > 0, high / 2, 0.0), np.zeros_like(high), np.arange(len(high))
        for _ in range(60):  # more than halving a bracket to the last digit takes
            x = t[todo]
            covered, speed, _ = integrate_jerk(v[todo], a[todo], j[todo], x)
            error = covered - distance[todo]
            low[todo], high[todo] = np.where(error <= 0, x, low[todo]), np.where(error >= 0, x, high[todo])
            # a Newton step, unless it leaves the bracket; distance increases with time
            with np.errstate(divide="ignore", invalid="ignore"):
                new = x - error / speed
            new = np.where((new >= low[todo]) & (new <= high[todo]), new, (low[todo] + high[todo]) / 2)
            t[todo] = new
            todo = todo[np.abs(new - x) > 4e-16 * self.duration]
            if not todo.size:
                break
        return np.asarray(t)


def profile_through(distance: Array, speed: Array, acceleration: Array) -> SpeedProfile:
    """Return the speed profile through nodes (N + 1,), with two constant jerks between neighbouring nodes.

    Over a distance h, the time T follows from h = (v0 + v1)/2 T - (a1 - a0)/12 T^2, which two jerks of T/2 each
    satisfy. Beside a node at rest, where the acceleration is 0, both have the same jerk.
    """
    h, mean = np.diff(distance), (speed[:-1] + speed[1:]) / 2
    change = np.diff(acceleration)
    time = 2 * h / (mean + np.sqrt(np.maximum(mean**2 - change * h / 3, 0.0)))
    half = time / 2
    first = (np.diff(speed) - acceleration[:-1] * time) / half**2 - 0.5 * change / half
    second = change / half - first
    covered, middle, rate = integrate_jerk(speed[:-1], acceleration[:-1], first, half)
    t = np.concatenate([[0.0], np.cumsum(np.repeat(half, 2))])

    def interleaved(nodes: Array, between: Array) -> Array:
        return np.append(np.stack([nodes[:-1], between], axis=1).ravel(), nodes[-1])

    jerk = np.stack([first, second], axis=1).ravel()
    places = interleaved(distance, distance[:-1] + covered)
    return SpeedProfile(t, places, interleaved(speed, np.maximum(middle, 0.0)), interleaved(acceleration, rate), jerk)


def profile_between(distance: Array, speed: Array, rates: tuple[Array, Array]) -> SpeedProfile:
    """Return the speed profile through nodes (N + 1,), with one constant jerk between neighbouring nodes.

    The time T over a distance h follows from h = (v0 + v1)/2 T - (a1 - a0)/12 T^2, where the change a1 - a0 is that of
    the approximate accelerations `rates` at both ends of each interval (N,); the acceleration jumps at nodes.
    """
    h, mean = np.diff(distance), (speed[:-1] + speed[1:]) / 2
    change = np.minimum(rates[1] - rates[0], 2 * mean**2 / h)
    time = 2 * h / (mean + np.sqrt(mean**2 - change * h / 3))
    acceleration = np.diff(speed) / time - change / 2
    t = np.concatenate([[0.0], np.cumsum(time)])
    last = acceleration[-1:] + change[-1:]
    return SpeedProfile(t, distance, speed, np.concatenate([acceleration, last]), change / time)


def join_profiles(parts: Sequence[SpeedProfile]) -> SpeedProfile:
    """Concatenate speed profiles, each of which begins where the previous one ends."""
    if len(parts) == 1:
        return parts[0]
    starts = np.concatenate([[0.0], np.cumsum([part.duration for part in parts])])
    t = np.concatenate([part.t[:-1] + start for part, start in zip(parts, starts, strict=False)] + [starts[-1:]])
    s, v, a = (
        np.concatenate([getattr(part, kind)[:-1] for part in parts] + [getattr(parts[-1], kind)[-1:]])
        for kind in ("distance", "speed", "acceleration")
    )
    return SpeedProfile(t, s, v, a, np.concatenate([part.jerk for part in parts]))


def ramp_time(change: float, acceleration: float, jerk: float) -> float:
    """Return the shortest time (s) in which the speed changes by `change` (m/s), from and to zero acceleration."""
    require.nonnegative("ramp: change", change)
    for name, value in (("acceleration", acceleration), ("jerk", jerk)):
        require.positive(f"ramp: {name}", value)
    return sum(time for time, _ in ramp_phases(change, acceleration, jerk))


def ramp_distance(first: float, last: float, acceleration: float, jerk: float) -> float:
    """Return the distance (m) covered while the speed changes from `first` to `last` (m/s) in the shortest time."""
    for name, value in (("first", first), ("last", last)):
        require.nonnegative(f"ramp: {name}", value)
    return (first + last) / 2 * ramp_time(abs(last - first), acceleration, jerk)


def reachable_speed(speed: float, distance: float, acceleration: float, jerk: float) -> float:
    """Return the greatest speed (m/s) that can be reached from `speed` over a distance (m); inverts `ramp_distance`."""
    # without constant acceleration x = sqrt((v - speed)/jerk) solves jerk x^3 + 2 speed x = distance, by Cardano's
    # formula as a quotient without cancellation
    half, third = distance / (2 * jerk), 2 * speed / (3 * jerk)
    root = cbrt(half + hypot(half, third**1.5))
    x = 2 * half / (root * root + third + (third / root) ** 2)
    if jerk * x <= acceleration:
        return float(speed + jerk * x * x)
    # with it: v^2 + v A^2/J = speed^2 - speed A^2/J + 2 A distance
    b = acceleration**2 / jerk
    root = sqrt(b * b + 4 * (speed * speed - speed * b + 2 * acceleration * distance))
    return float(max(speed, (root - b) / 2))


def ramp_phases(change: float, acceleration: float, jerk: float) -> Phases:
    """Return the phases of constant jerk that change the speed by a given amount (m/s) in the least time."""
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


def rest_profile(length: float, speed: float, acceleration: float, jerk: float) -> SpeedProfile:
    """Return the fastest motion from rest to rest over a length (m); its peak is at most `speed`."""
    for name, value in (("length", length), ("speed", speed), ("acceleration", acceleration), ("jerk", jerk)):
        require.positive(name, value)
    peak = min(speed, reachable_speed(0.0, length / 2, acceleration, jerk))
    rest = max(length - 2 * ramp_distance(0.0, peak, acceleration, jerk), 0.0)
    even = ((rest / peak, 0.0),) if rest > ROUNDING_SHARE * length else ()
    phases = (*ramp_phases(peak, acceleration, jerk), *even, *ramp_phases(-peak, acceleration, jerk))
    nodes = [(0.0, 0.0, 0.0, 0.0)]
    for time, change in phases:
        t, s, v, a = nodes[-1]
        covered, v, a = integrate_jerk(v, a, change, time)
        nodes.append((t + time, s + covered, max(v, 0.0), a))
    nodes[-1] = (nodes[-1][0], length, 0.0, 0.0)
    t, distance, speeds, accelerations = np.array(nodes).T
    return SpeedProfile(t, distance, speeds, accelerations, np.array([change for _, change in phases]))
