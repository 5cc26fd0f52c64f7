"""Distance and line speed over time, as pieces of constant jerk."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike, NDArray

from ocp.errors import NOT_NUMBERS, ProblemError, floats

__all__ = ["Array", "LineMotion", "SpeedProfile", "integrate_jerk", "join_profiles", "profile_through", "segment_index"]

Array = NDArray[np.float64]


class LineMotion(NamedTuple):
    """Motion of the line, along a path, at M instants.

    Attributes:
        t: Time. Shape (M,), s.
        distance: Along the path. Shape (M,), m.
        speed, acceleration, jerk: Its derivatives. Shape (M,), m/s, m/s^2, m/s^3.
    """

    t: Array
    distance: Array
    speed: Array
    acceleration: Array
    jerk: Array


def integrate_jerk(speed: Any, acceleration: Any, jerk: Any, time: Any) -> tuple[Any, Any, Any]:
    """Way covered in a time under constant jerk, and the speed and acceleration then; numbers, arrays or casadi."""
    s = time * (speed + time * (acceleration / 2 + time * jerk / 6))
    return s, speed + time * (acceleration + time * jerk / 2), acceleration + time * jerk


def segment_index(bounds: ArrayLike, places: ArrayLike, side: Literal["left", "right"] = "right") -> NDArray[np.intp]:
    """Index of the piece between increasing bounds (K + 1,) that holds each place; at a bound the right or left one.

    What lies beyond the ends counts for the first and the last piece.
    """
    return np.asarray(np.clip(np.searchsorted(bounds, places, side=side) - 1, 0, len(np.asarray(bounds)) - 2))


def _inside(value: ArrayLike, most: float, what: str, place: str) -> Array:
    """A row of numbers of [0, most], clipped to that; ProblemError where one lies outside by more than rounding."""
    try:
        # an array that holds its numbers, and is no view of a few, may have as many as it does
        made = isinstance(value, np.ndarray) and value.dtype == float and value.flags.c_contiguous
        array = np.atleast_1d(np.asarray(value, dtype=float) if made else floats(value))
    except NOT_NUMBERS as error:
        raise ProblemError(f"{what} {value!r} is not numeric", name=what, value=value) from error
    if array.ndim != 1:
        message = f"{what} has shape {array.shape}; give one number or a row"
        raise ProblemError(message, name=what, value=array.shape)
    slack = 1e-9 * most
    inside = (array >= -slack) & (array <= most + slack)
    if not inside.all():
        wrong = array[~inside][:3].tolist()
        raise ProblemError(f"{what} {wrong} {place}", name=what, value=wrong[0], limit=(0.0, most))
    return np.asarray(np.clip(array, 0.0, most))


@dataclass(frozen=True, eq=False)
class SpeedProfile:
    """Pieces of constant jerk, one after the other.

    Attributes:
        t, distance, speed, acceleration: At the start of each piece, and at the end of the last. Shape (K + 1,).
        jerk: Of each piece. Shape (K,), m/s^3.

    Raises:
        ProblemError: Other shapes, what is not finite, times or distances that fall.
    """

    t: Array
    distance: Array
    speed: Array
    acceleration: Array
    jerk: Array

    def __post_init__(self) -> None:
        for what in ("t", "distance", "speed", "acceleration", "jerk"):
            try:
                row = floats(getattr(self, what))
            except NOT_NUMBERS as error:
                message = f"profile: {what} is not numeric: {getattr(self, what)!r}"
                raise ProblemError(message, name=what, value=getattr(self, what)) from error
            object.__setattr__(self, what, row)
            shape = (len(self.t) - (what == "jerk"),) if self.t.ndim == 1 and len(self.t) > 1 else None
            if row.shape != shape or not np.isfinite(row).all():
                message = (
                    f"profile: {what} of shape {row.shape} must be finite, {shape or 'two times at least'} expected"
                )
                raise ProblemError(message, name=what, value=row, limit=shape)
            if what in ("t", "distance") and (np.diff(row) < 0).any():
                raise ProblemError(f"profile: {what} must not fall", name=what, value=row)

    @property
    def duration(self) -> float:
        """s."""
        return float(self.t[-1])

    def at(self, time: ArrayLike) -> LineMotion:
        """Motion at times of [0, duration], shape (M,), s. The jerk at a step is that after it.

        Raises:
            ProblemError: nan, or a time outside by more than rounding.
        """
        t = _inside(time, self.duration, "time", f"s is outside the schedule, 0 to {self.duration:g} s")
        piece = segment_index(self.t, t)
        motion = self._motion(piece, t - self.t[piece])
        # the end is known, but for rounding the pieces lead to it
        for values, last in zip(motion[:4], (self.t, self.distance, self.speed, self.acceleration), strict=True):
            values[t == self.duration] = last[-1]
        return motion

    def at_distance(self, distance: ArrayLike) -> LineMotion:
        """Motion where the path has the given distances from its start, shape (M,), m; the first time, at a rest.

        Raises:
            ProblemError: nan, or a distance off the path by more than rounding.
        """
        length = float(self.distance[-1])
        s = _inside(distance, length, "distance", f"m is off the path, which is {length:g} m long")
        piece = segment_index(self.distance, s, side="left")
        inside = self._time_inside(piece, s - self.distance[piece])
        # at rest the time is the cube root of a rounding error: the end is known exactly
        return self._motion(piece, np.where(s == length, np.diff(self.t)[-1], inside))

    def peaks(self) -> LineMotion:
        """Motion wherever the speed may be largest: at the bounds of the pieces, and where one stops accelerating."""
        with np.errstate(divide="ignore", invalid="ignore"):
            turn = -self.acceleration[:-1] / self.jerk
        inside = np.flatnonzero((turn > 0) & (turn < np.diff(self.t)))
        return self.at(np.concatenate([self.t, self.t[:-1][inside] + turn[inside]]))

    def function(self) -> Any:
        """casadi Function time (s) -> (distance, speed, acceleration, jerk); MX with the pieces as tables, makes C.

        Times outside are those of the ends.
        """
        time = ca.MX.sym("time")
        inside = ca.fmin(ca.fmax(time, 0.0), self.duration)
        table = np.stack([self.t[:-1], self.distance[:-1], self.speed[:-1], self.acceleration[:-1], self.jerk])
        piece = ca.low(ca.DM(self.t), inside, {"lookup_mode": "binary"}) if len(self.jerk) > 1 else ca.MX(0)
        row = ca.MX(ca.DM(table))[:, piece]
        start, s, v, a, j = ca.vertsplit(row)
        t = inside - start
        way, speed, acceleration = integrate_jerk(v, a, j, t)
        outputs = [s + way, speed, acceleration, j]
        return ca.Function("profile", [time], outputs, ["time"], ["distance", "speed", "acceleration", "jerk"])

    def _motion(self, piece: NDArray[np.intp], t: Array) -> LineMotion:
        """At times (M,) after the start of pieces (M,)."""
        s, v, a, j = self.distance[piece], self.speed[piece], self.acceleration[piece], self.jerk[piece]
        way, speed, acceleration = integrate_jerk(v, a, j, t)
        return LineMotion(self.t[piece] + t, s + way, np.maximum(speed, 0.0), acceleration, j)  # no rounding below rest

    def _time_inside(self, piece: NDArray[np.intp], distance: Array) -> Array:
        """Times (M,) after the start of pieces (M,) at which they have covered distances (M,)."""
        v, a, j, high = self.speed[piece], self.acceleration[piece], self.jerk[piece], np.diff(self.t)[piece]
        even = (a == 0) & (j == 0)
        with np.errstate(divide="ignore", invalid="ignore"):
            t = np.where(even, np.minimum(distance / v, high), high)
        todo = np.flatnonzero(~even)
        # Newton inside a bracket, for those that still move: the distance grows with the time
        high = high[todo]
        whole = integrate_jerk(v[todo], a[todo], j[todo], high)[0]
        t[todo] = high * np.clip(distance[todo] / np.maximum(whole, 1e-300), 0.0, 1.0) ** np.where(a[todo] == 0, 0.5, 1)
        low = np.zeros_like(high)
        for _ in range(60):  # more than halving a bracket to the last digit takes
            if not todo.size:
                break
            x = t[todo]
            covered, speed, _ = integrate_jerk(v[todo], a[todo], j[todo], x)
            error = covered - distance[todo]
            low, high = np.where(error <= 0, x, low), np.where(error >= 0, x, high)
            with np.errstate(divide="ignore", invalid="ignore"):
                new = x - error / speed
            new = np.where((new >= low) & (new <= high), new, (low + high) / 2)
            t[todo] = new
            moving = np.abs(new - x) > 4e-16 * np.abs(self.duration)
            todo, low, high = todo[moving], low[moving], high[moving]
        return np.asarray(t)


def profile_through(distance: Array, speed: Array, acceleration: Array) -> SpeedProfile:
    """Pieces of constant jerk through given motions: two of one duration between neighbours, rest at an end with one.

    Over a way h, T follows from h = (v0 + v1)/2 T - (a1 - a0)/12 T^2, which two jerks of T/2 each satisfy.

    Args:
        distance, speed, acceleration: At the nodes, in order; the first and last speed may be 0, and the acceleration
            there is then that of constant jerk, 0. Shape (N + 1,).
    """
    h, mean = np.diff(distance), (speed[:-1] + speed[1:]) / 2
    change = np.diff(acceleration)
    time = 2 * h / (mean + np.sqrt(np.maximum(mean**2 - change * h / 3, 0.0)))
    half = time / 2
    first = (np.diff(speed) - acceleration[:-1] * time) / half**2 - 0.5 * change / half
    second = change / half - first
    _, middle, rate = integrate_jerk(speed[:-1], acceleration[:-1], first, half)
    way = integrate_jerk(speed[:-1], acceleration[:-1], first, half)[0]
    t = np.concatenate([[0.0], np.cumsum(np.repeat(half, 2))])

    def both(nodes: Array, between: Array) -> Array:
        return np.append(np.stack([nodes[:-1], between], axis=1).ravel(), nodes[-1])

    jerk = np.stack([first, second], axis=1).ravel()
    places = both(distance, distance[:-1] + way)
    return SpeedProfile(t, places, both(speed, np.maximum(middle, 0.0)), both(acceleration, rate), jerk)


def join_profiles(parts: Sequence[SpeedProfile]) -> SpeedProfile:
    """Profiles one after the other; each begins where the one before ends."""
    if len(parts) == 1:
        return parts[0]
    starts = np.concatenate([[0.0], np.cumsum([part.duration for part in parts])])
    t = np.concatenate([part.t[:-1] + start for part, start in zip(parts, starts, strict=False)] + [starts[-1:]])
    s, v, a = (
        np.concatenate([getattr(part, kind)[:-1] for part in parts] + [getattr(parts[-1], kind)[-1:]])
        for kind in ("distance", "speed", "acceleration")
    )
    return SpeedProfile(t, s, v, a, np.concatenate([part.jerk for part in parts]))
