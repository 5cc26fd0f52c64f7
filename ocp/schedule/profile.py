"""Distance and line speed over time, as pieces of constant jerk."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike, NDArray

from ocp.errors import ProblemError

__all__ = ["Motion", "SpeedProfile"]

Array = NDArray[np.float64]
STEPS = 60


class Motion(NamedTuple):
    """Motion along a path at M instants.

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


def _row(value: ArrayLike, what: str) -> Array:
    try:
        array = np.atleast_1d(np.asarray(value, dtype=float))
    except (TypeError, ValueError) as error:
        raise ProblemError(f"{what} {value!r} is not numeric") from error
    if array.ndim != 1:
        raise ProblemError(f"{what} has shape {array.shape}; give one number or a row")
    return array


@dataclass(frozen=True, eq=False)
class SpeedProfile:
    """Pieces of constant jerk, one after the other.

    Attributes:
        t, distance, speed, acceleration: At the start of each piece, and at the end of the last. Shape (K + 1,).
        jerk: Of each piece. Shape (K,), m/s^3.
    """

    t: Array
    distance: Array
    speed: Array
    acceleration: Array
    jerk: Array

    @property
    def duration(self) -> float:
        """s."""
        return float(self.t[-1])

    def at(self, time: ArrayLike) -> Motion:
        """Motion at times of [0, duration], shape (M,), s. The jerk at a step is that after it.

        Raises:
            ProblemError: nan, or a time outside by more than rounding.
        """
        t = _row(time, "time")
        slack = 1e-9 * self.duration
        if not ((t >= -slack) & (t <= self.duration + slack)).all():
            wrong = t[~((t >= -slack) & (t <= self.duration + slack))]
            raise ProblemError(f"time {wrong[:3].tolist()} s is outside the schedule, 0 to {self.duration:g} s")
        t = np.clip(t, 0.0, self.duration)
        piece = np.clip(np.searchsorted(self.t, t, side="right") - 1, 0, len(self.jerk) - 1)
        motion = self._inside(piece, t - self.t[piece])
        # the end is known, but for rounding the pieces lead to it
        for values, last in zip(motion[:4], (self.t, self.distance, self.speed, self.acceleration), strict=True):
            values[t == self.duration] = last[-1]
        return motion

    def at_distance(self, distance: ArrayLike) -> Motion:
        """Motion where the path has the given distances from its start, shape (M,), m; the first time, at a rest.

        Raises:
            ProblemError: nan, or a distance off the path by more than rounding.
        """
        s = _row(distance, "distance")
        length = float(self.distance[-1])
        slack = 1e-9 * length
        if not ((s >= -slack) & (s <= length + slack)).all():
            wrong = s[~((s >= -slack) & (s <= length + slack))]
            raise ProblemError(f"distance {wrong[:3].tolist()} m is off the path, which is {length:g} m long")
        s = np.clip(s, 0.0, length)
        piece = np.clip(np.searchsorted(self.distance, s, side="left") - 1, 0, len(self.jerk) - 1)
        inside = self._time_inside(piece, s - self.distance[piece])
        # at rest the time is the cube root of a rounding error: the end is known exactly
        return self._inside(piece, np.where(s == length, np.diff(self.t)[-1], inside))

    def peaks(self) -> Motion:
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
        outputs = [s + t * (v + t * (a / 2 + t * j / 6)), v + t * (a + t * j / 2), a + t * j, j]
        return ca.Function("profile", [time], outputs, ["time"], ["distance", "speed", "acceleration", "jerk"])

    def _inside(self, piece: NDArray[np.intp], t: Array) -> Motion:
        s, v, a, j = self.distance[piece], self.speed[piece], self.acceleration[piece], self.jerk[piece]
        speed = np.maximum(v + t * (a + t * j / 2), 0.0)  # no rounding below rest
        return Motion(self.t[piece] + t, s + t * (v + t * (a / 2 + t * j / 6)), speed, a + t * j, j)

    def _time_inside(self, piece: NDArray[np.intp], distance: Array) -> Array:
        v, a, j = self.speed[piece], self.acceleration[piece], self.jerk[piece]
        low, high = np.zeros_like(distance), np.diff(self.t)[piece]
        even = (a == 0) & (j == 0)
        with np.errstate(divide="ignore", invalid="ignore"):
            t = np.where(even, np.minimum(distance / v, high), high)
        todo = np.flatnonzero(~even)
        # Newton inside a bracket, for those that still move: the distance grows with the time
        high = high[todo]
        whole = high * (v[todo] + high * (a[todo] / 2 + high * j[todo] / 6))
        t[todo] = high * np.clip(distance[todo] / np.maximum(whole, 1e-300), 0.0, 1.0) ** np.where(a[todo] == 0, 0.5, 1)
        low = np.zeros_like(high)
        for _ in range(STEPS):
            if not todo.size:
                break
            x, v_, a_, j_ = t[todo], v[todo], a[todo], j[todo]
            error = x * (v_ + x * (a_ / 2 + x * j_ / 6)) - distance[todo]
            low, high = np.where(error <= 0, x, low), np.where(error >= 0, x, high)
            with np.errstate(divide="ignore", invalid="ignore"):
                new = x - error / (v_ + x * (a_ + x * j_ / 2))
            new = np.where((new >= low) & (new <= high), new, (low + high) / 2)
            t[todo] = new
            moving = np.abs(new - x) > 4e-16 * np.abs(self.duration)
            todo, low, high = todo[moving], low[moving], high[moving]
        return np.asarray(t)
