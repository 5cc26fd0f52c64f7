"""Interpolate joint samples as controllers do, and bound the interpolant between the samples.

A file with positions alone is interpolated linearly, one with velocities by cubics (Hermite), and one with
accelerations by quintics. Polynomials are stored by their Bernstein coefficients, which enclose them: splitting an
interval until a value reaches its enclosure gives the maximum with certainty.

Where the acceleration of the sampled motion jumps, the interpolant overestimates it: a cubic by up to two thirds, a
quintic by a sixth. The samples do not show what happens between them. A quantity is therefore compared with a limit
only as far as every motion through the samples needs it (`Motion.needed`), unless the rule of the controller is stated.

Linear interpolation has no acceleration. The samples bound it by divided differences: any twice differentiable motion
through three samples has the acceleration 2 q[t0, t1, t2] at some time between them, and any smoother one the jerk
6 q[t0, t1, t2, t3]. The same holds for differences of given velocities.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from math import comb
from typing import Any, Literal, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from models.checks import Array
from ocp.errors import ProblemError
from ocp.tolerances import LIMIT_SHARE

Indices: TypeAlias = NDArray[np.intp]
Rule: TypeAlias = Literal["linear", "cubic", "quintic"]


@dataclass(frozen=True, eq=False)
class PiecewisePolynomial:
    """Piecewise polynomials in Bernstein form.

    Attributes:
        t: Break points, increasing. Shape (N + 1,), s.
        coefficients: Bernstein coefficients. Shape (N, d + 1, n).
    """

    t: Array
    coefficients: Array

    def derivative(self) -> PiecewisePolynomial:
        """Return the time derivative of the piecewise polynomials."""
        degree = self.coefficients.shape[1] - 1
        width = np.diff(self.t)[:, None, None]
        return PiecewisePolynomial(self.t, degree * np.diff(self.coefficients, axis=1) / width)

    def at(self, times: Array) -> Array:
        """Return the values at times (M,), clipped to the range of `t`; the shape is (M, n).

        At a break point the value is that of the later piece.
        """
        interval = np.clip(np.searchsorted(self.t, times, side="right") - 1, 0, len(self.t) - 2)
        begin, end = self.t[interval], self.t[interval + 1]
        return self.within(interval, np.clip((times - begin) / (end - begin), 0.0, 1.0))

    def within(self, interval: Indices, fraction: Array) -> Array:
        """Return the values in given intervals (M,) at fractions (M,), 0 to 1, of the interval length. Shape (M, n)."""
        degree = self.coefficients.shape[1] - 1
        s = fraction[:, None]
        total = np.zeros((len(interval), self.coefficients.shape[2]))
        for k in range(degree + 1):
            total += comb(degree, k) * s**k * (1 - s) ** (degree - k) * self.coefficients[interval, k]
        return total

    @property
    def greatest(self) -> Array:
        """Upper bounds of the absolute values of the polynomials in each interval. Shape (N, n)."""
        return np.asarray(np.abs(self.coefficients).max(axis=1))


def polynomial_maxima(coefficients: Array) -> tuple[Array, Array]:
    """Return maxima on [0, 1] of polynomials in Bernstein form (K, d + 1), and where they occur. Shape (K,) each."""
    first, last = coefficients[:, 0], coefficients[:, -1]
    best, argument = np.maximum(first, last), np.where(last > first, 1.0, 0.0)
    tolerance = 1e-10 * np.abs(coefficients).max(axis=1, initial=0.0)  # far below the accuracy of any limit
    owner = np.arange(len(coefficients))
    begin, width, part = np.zeros(len(owner)), 1.0, coefficients
    for _ in range(40):  # a part is then 1e-12 of its interval
        open_ = part.max(axis=1) > best[owner] + tolerance[owner]
        if not open_.any():
            break
        owner, begin, part = owner[open_], begin[open_], part[open_]
        width /= 2
        left, right = _halves(part)
        middle = left[:, -1]
        order = np.lexsort((-middle, owner))
        leading = order[np.unique(owner[order], return_index=True)[1]]
        improved = leading[middle[leading] > best[owner[leading]]]
        best[owner[improved]], argument[owner[improved]] = middle[improved], begin[improved] + width
        owner, begin = np.tile(owner, 2), np.concatenate([begin, begin + width])
        part = np.concatenate([left, right])
    return best, argument


def _halves(coefficients: Array) -> tuple[Array, Array]:
    """Return the Bernstein coefficients (K, d + 1) of polynomials on each half of [0, 1] (de Casteljau's algorithm)."""
    left, right, row = [coefficients[:, 0]], [coefficients[:, -1]], coefficients
    for _ in range(coefficients.shape[1] - 1):
        row = (row[:, 1:] + row[:, :-1]) / 2
        left.append(row[:, 0])
        right.append(row[:, -1])
    return np.stack(left, axis=1), np.stack(right[::-1], axis=1)


class MotionQuantity(NamedTuple):
    """A quantity, such as the velocity, of every joint along a motion.

    Attributes:
        pieces: The quantity as polynomials, or the constants between two times that divided differences give.
        blur: Largest error of the quantity due to the digits of the file. Shape (N, n).
        closed: Whether the quantity is that of the interpolant, at every time; otherwise any motion through the samples
            has it at some time.
        needed: Largest value, and largest value of the negative, that every motion through the samples needs in each
            interval; infinite if the interpolant itself counts. Shape (N, n) each, or ().
    """

    pieces: PiecewisePolynomial
    blur: Array
    closed: bool
    needed: tuple[Any, Any] = (np.inf, np.inf)


@dataclass(frozen=True, eq=False)
class Motion:
    """Samples of a joint motion and the rule of interpolation between them.

    Attributes:
        t: Sample times, increasing, at least two. Shape (M,), s.
        q, v, a: Positions, velocities or None, accelerations or None. Shape (M, n).
        stated: Whether the controller is known to interpolate by this rule, so that the interpolant itself counts.
    """

    t: Array
    q: Array
    v: Array | None = None
    a: Array | None = None
    stated: bool = False

    @property
    def rule(self) -> Rule:
        """Name of the rule of interpolation between the samples: "linear", "cubic" or "quintic"."""
        return "linear" if self.v is None else "cubic" if self.a is None else "quintic"

    def by(self, rule: Rule) -> Motion:
        """Return the same samples with another interpolation rule.

        Raises:
            ProblemError: The rule needs velocities or accelerations that the samples do not have.
        """
        for needed, name, values in (
            (("cubic", "quintic"), "velocities", self.v),
            (("quintic",), "accelerations", self.a),
        ):
            if rule in needed and values is None:
                words = f"the rule {rule!r} needs {name}, which are not given for every joint; omit the rule"
                raise ProblemError(words, name="rule", value=rule)
        v, a = None if rule == "linear" else self.v, self.a if rule == "quintic" else None
        return Motion(self.t, self.q, v, a, stated=True)

    @cached_property
    def position(self) -> PiecewisePolynomial:
        """Positions between the samples as piecewise polynomials of time."""
        h = np.diff(self.t)[:, None]
        q, v, a = self.q, self.v, self.a
        if v is None:
            inner: list[Array] = []
        elif a is None:
            inner = [q[:-1] + h / 3 * v[:-1], q[1:] - h / 3 * v[1:]]
        else:
            inner = [
                q[:-1] + h / 5 * v[:-1],
                q[:-1] + 2 * h / 5 * v[:-1] + h**2 / 20 * a[:-1],
                q[1:] - 2 * h / 5 * v[1:] + h**2 / 20 * a[1:],
                q[1:] - h / 5 * v[1:],
            ]
        return PiecewisePolynomial(self.t, np.stack([q[:-1], *inner, q[1:]], axis=1))

    @cached_property
    def velocity(self) -> PiecewisePolynomial:
        """Velocities as piecewise polynomials of time; piecewise constant if the file has only positions."""
        return self.position.derivative()

    def end_speeds(self) -> Array:
        """Return the speeds of the joints at both ends, 0 for a joint that is at rest there. Shape (2, n).

        A motion of which only positions are known counts as at rest at an end if its mean speed in the interval there
        is at most the change of speed to the next interval, as under any constant acceleration or jerk from rest.
        """
        rates = np.diff(self.q, axis=0) / np.diff(self.t)[:, None] if self.v is None else self.v
        speeds, tolerated = np.abs(rates[[0, -1]]), LIMIT_SHARE * np.abs(rates).max(initial=0.0)
        if self.v is None and len(rates) > 1:
            tolerated = np.maximum(tolerated, np.abs(rates[[0, -1]] - rates[[1, -2]]))
        return np.where(speeds > tolerated, speeds, 0.0)

    @cached_property
    def acceleration(self) -> PiecewisePolynomial | None:
        """Accelerations as piecewise polynomials of time; None for linear interpolation."""
        return None if self.v is None else self.velocity.derivative()

    @cached_property
    def digits(self) -> tuple[Array, Array, Array]:
        """Rounding errors of positions, velocities and accelerations: half of their last digits. Shape (n,) each."""
        none = np.zeros(self.q.shape[1])
        return tuple(none if values is None else half_digits(values) for values in (self.q, self.v, self.a))  # type: ignore[return-value]

    def quantity(self, name: str) -> MotionQuantity | None:
        """Return a quantity along the motion, such as "velocity" or "jerk"; None if there are too few samples."""
        h = np.diff(self.t)[:, None]
        eq, ev, ea = self.digits
        smooth = {"linear": 0, "cubic": 1, "quintic": 2}[self.rule]
        if name == "position":
            return MotionQuantity(self.position, np.broadcast_to(eq, h.shape[:1] + eq.shape), True)
        if name == "velocity":
            # only the middle Bernstein coefficient contains the difference of positions
            blur = {0: 2 * eq / h, 1: 3 * eq / h + ev, 2: 3.75 * eq / h + 2.5 * ev + 0.2 * h * ea}[smooth]
            return MotionQuantity(self.velocity, blur, True, self.needed(name))
        if name == "acceleration" and smooth:
            assert self.acceleration is not None
            blur = 12 * eq / h**2 + 6 * ev / h if smooth == 1 else 30 * eq / h**2 + 15 * ev / h + 3 * ea
            return MotionQuantity(self.acceleration, blur, True, self.needed(name))
        if name == "jerk" and smooth == 2:
            assert self.acceleration is not None
            blur = 120 * eq / h**3 + 60 * ev / h**2 + 12 * ea / h
            return MotionQuantity(self.acceleration.derivative(), blur, True, self.needed(name))
        values, digits, order = (self.q, eq, 2 if name == "acceleration" else 3) if smooth == 0 else (self.v, ev, 2)
        assert values is not None
        return self._differences(values, digits, order)

    def needed(self, name: str) -> tuple[Any, Any]:
        """Return the least possible maxima, in each interval, of a quantity and of its negative in motions through the
        samples.

        Acceleration: a motion between given positions and velocities needs the least if it switches once from A to -A,
        where A = (2 |e| + sqrt(4 e^2 + h^2 d^2)) / h^2, d is the change of velocity, and e is the displacement minus h
        times the mean of both velocities. Given accelerations count as well. Jerk: three weighted means, with weights 1
        and the Chebyshev polynomials U1 and U2 of the interval; from rest to rest this gives 32 of the 60 that a
        quintic has. Velocity: the peak of a trapezoidal profile, the lowest of all motions that accelerate no harder
        than this interval or its neighbours need; without that bound only the mean velocity would be certain.
        """
        if self.stated or self.v is None:
            return np.inf, np.inf
        h, v, a = np.diff(self.t)[:, None], self.v, self.a
        displacement, change, mean = np.diff(self.q, axis=0), np.diff(v, axis=0), (v[1:] + v[:-1]) / 2
        residual = displacement - h * mean
        if name == "jerk" and a is not None:
            step = np.diff(a, axis=0)
            means = (step * h**2, 4 * h * (change - h * (a[1:] + a[:-1]) / 2), 32 * residual + 3 * h**2 * step)
            jerk = np.abs(means).max(axis=0) / h**3
            return jerk, jerk
        least = (2 * np.abs(residual) + np.sqrt(4 * residual**2 + (h * change) ** 2)) / h**2
        if a is not None:
            least = np.maximum(least, np.maximum(np.abs(a[1:]), np.abs(a[:-1])))
        if name == "acceleration":
            return least, least
        padded = np.pad(least, ((1, 1), (0, 0)))
        hardest = np.maximum(least, np.maximum(padded[2:], padded[:-2]))
        ends = (v[1:] ** 2 + v[:-1] ** 2) / 2

        def peak(sign: float) -> Array:
            middle = hardest * h / 2 + sign * mean
            lowest = middle - np.sqrt(np.maximum(middle**2 - sign * hardest * displacement - ends, 0.0))
            return np.asarray(np.maximum(lowest, np.maximum(sign * v[1:], sign * v[:-1])))

        return peak(1.0), peak(-1.0)

    def _differences(self, values: Array, digits: Array, order: int) -> MotionQuantity | None:
        """Return a time derivative of sampled values by divided differences; None if the samples are too few."""
        if len(self.t) <= order:
            return None
        table, blur = values, np.broadcast_to(digits, values.shape)
        for k in range(1, order + 1):
            width = (self.t[k:] - self.t[:-k])[:, None]
            table, blur = k * np.diff(table, axis=0) / width, k * (blur[1:] + blur[:-1]) / width
        begin, end = self.t[:-order], self.t[order:]
        middle = (begin + end) / 2
        edges = np.concatenate([[begin[0]], (middle[1:] + middle[:-1]) / 2, [end[-1]]])
        return MotionQuantity(PiecewisePolynomial(edges, table[:, None]), blur, False)


def interpolate(times: Array, t: Array, values: Array) -> Array:
    """Interpolate `values` (M, n), given at increasing times `t` (M,), linearly at other times (K,). Shape (K, n)."""
    return np.column_stack([np.interp(times, t, column) for column in values.T])


def half_digits(values: Array) -> Array:
    """Return the rounding error of each column of numbers: half of its last decimal or binary digit. Shape (n,).

    A column of few digits may be exact: columns with digits coarser than a thousandth or with few values count as
    exact.
    """
    errors = np.asarray(2.0**-53 * np.abs(values).max(axis=0))
    for k, column in enumerate(values.T):
        distinct = np.unique(column)
        if len(distinct) < 20:
            continue
        for power in range(3, 13):
            scaled = distinct * 10.0**power
            if (np.abs(scaled - np.rint(scaled)) <= 1e-14 * np.abs(scaled) + 1e-9).all():
                errors[k] = 0.5 * 10.0**-power
                break
        else:
            if (distinct.astype(np.float32) == distinct).all():
                errors[k] = 2.0**-25 * np.abs(distinct).max()
    return errors
