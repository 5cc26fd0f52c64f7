"""What a controller makes of samples: polynomials from one to the next, and how far they go, between the samples too.

The rule is that of the usual controllers: straight lines where a file has positions alone, cubics where it has
velocities (Hermite), quintics where it has accelerations, too. Polynomials are kept by their Bernstein coefficients,
which enclose them: halving a piece until the enclosure is met by a value tells its greatest value for sure.

Where the acceleration of the sampled motion jumps, these polynomials have more of it than the motion had: a cubic up to
two thirds, a quintic a sixth. Samples are silent about what happens between them. A file is therefore held only to what
every motion through its samples needs (`Motion.needed`), unless the rule of its controller is stated.

Straight lines have no acceleration to look at. What the samples say of it are their divided differences: of any
twice differentiable motion through three samples, 2 q[t0, t1, t2] is its acceleration at some time between them, and
6 q[t0, t1, t2, t3] the jerk of any smoother one. The same holds of velocities where these are given.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from math import comb
from typing import Any, Literal, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from models.arrays import Array
from ocp.errors import ProblemError

__all__ = ["Indices", "Motion", "MotionQuantity", "PiecewisePolynomial", "Rule", "half_digits", "polynomial_maxima"]

Indices: TypeAlias = NDArray[np.intp]
Rule: TypeAlias = Literal["linear", "cubic", "quintic"]


@dataclass(frozen=True, eq=False)
class PiecewisePolynomial:
    """Polynomials one after the other.

    Attributes:
        t: Where they begin and end, increasing. Shape (N + 1,), s.
        coefficients: Bernstein's. Shape (N, d + 1, n).
    """

    t: Array
    coefficients: Array

    def derivative(self) -> PiecewisePolynomial:
        """In time."""
        degree = self.coefficients.shape[1] - 1
        width = np.diff(self.t)[:, None, None]
        return PiecewisePolynomial(self.t, degree * np.diff(self.coefficients, axis=1) / width)

    def at(self, times: Array) -> Array:
        """Values at times (M,), continuous from the right, clipped to the ends. Shape (M, n)."""
        piece = np.clip(np.searchsorted(self.t, times, side="right") - 1, 0, len(self.t) - 2)
        begin, end = self.t[piece], self.t[piece + 1]
        return self.within(piece, np.clip((times - begin) / (end - begin), 0.0, 1.0))

    def within(self, piece: Indices, place: Array) -> Array:
        """Values at places (M,), 0 to 1, of pieces (M,). Shape (M, n)."""
        degree = self.coefficients.shape[1] - 1
        s = place[:, None]
        total = np.zeros((len(piece), self.coefficients.shape[2]))
        for k in range(degree + 1):
            total += comb(degree, k) * s**k * (1 - s) ** (degree - k) * self.coefficients[piece, k]
        return total

    @property
    def greatest(self) -> Array:
        """Bounds of the sizes in every piece. Shape (N, n)."""
        return np.asarray(np.abs(self.coefficients).max(axis=1))


def polynomial_maxima(coefficients: Array) -> tuple[Array, Array]:
    """Greatest values of polynomials by their Bernstein coefficients (K, d + 1), and where, 0 to 1. Shape (K,) each."""
    first, last = coefficients[:, 0], coefficients[:, -1]
    best, place = np.maximum(first, last), np.where(last > first, 1.0, 0.0)
    enough = 1e-10 * np.abs(coefficients).max(axis=1, initial=0.0)  # far below what any limit is known to
    owner = np.arange(len(coefficients))
    begin, width, part = np.zeros(len(owner)), 1.0, coefficients
    for _ in range(40):  # a part is then 1e-12 of its piece
        open_ = part.max(axis=1) > best[owner] + enough[owner]
        if not open_.any():
            break
        owner, begin, part = owner[open_], begin[open_], part[open_]
        width /= 2
        left, right = _halves(part)
        middle = left[:, -1]
        order = np.lexsort((-middle, owner))
        lead = order[np.unique(owner[order], return_index=True)[1]]
        better = lead[middle[lead] > best[owner[lead]]]
        best[owner[better]], place[owner[better]] = middle[better], begin[better] + width
        owner, begin = np.tile(owner, 2), np.concatenate([begin, begin + width])
        part = np.concatenate([left, right])
    return best, place


def _halves(coefficients: Array) -> tuple[Array, Array]:
    """Of both halves (de Casteljau). Shape (K, d + 1) each."""
    left, right, row = [coefficients[:, 0]], [coefficients[:, -1]], coefficients
    for _ in range(coefficients.shape[1] - 1):
        row = (row[:, 1:] + row[:, :-1]) / 2
        left.append(row[:, 0])
        right.append(row[:, -1])
    return np.stack(left, axis=1), np.stack(right[::-1], axis=1)


class MotionQuantity(NamedTuple):
    """Something of every joint along a motion.

    Attributes:
        pieces: It, as polynomials; or constants, what divided differences say between two times.
        blur: By how much the digits of the file may make it more than it is. Shape (N, n).
        closed: Whether it is that of the interpolant, at every time; else what the samples prove of any motion.
        needed: The largest value, and the largest of the negative, that every motion through the samples needs in each
            piece; infinite where the interpolant itself counts. Shape (N, n) each, or ().
    """

    pieces: PiecewisePolynomial
    blur: Array
    closed: bool
    needed: tuple[Any, Any] = (np.inf, np.inf)


@dataclass(frozen=True, eq=False)
class Motion:
    """Samples of joints and what is between them.

    Attributes:
        t: Increasing, at least two. Shape (M,), s.
        q, v, a: Positions, velocities or None, accelerations or None. Shape (M, n).
        stated: Whether the controller is known to join them by this rule, so that the interpolant itself counts.
    """

    t: Array
    q: Array
    v: Array | None = None
    a: Array | None = None
    stated: bool = False

    @property
    def rule(self) -> Rule:
        """How the samples are joined."""
        return "linear" if self.v is None else "cubic" if self.a is None else "quintic"

    def by(self, rule: Rule) -> Motion:
        """The same samples, joined by another rule that needs no more than they tell.

        Raises:
            ProblemError: The rule needs velocities, or accelerations, that they do not tell.
        """
        for needed, what, values in (
            (("cubic", "quintic"), "velocities", self.v),
            (("quintic",), "accelerations", self.a),
        ):
            if rule in needed and values is None:
                words = f"the rule {rule!r} needs {what}, which are not those of every joint; leave the rule out"
                raise ProblemError(words, name="rule", value=rule)
        v, a = None if rule == "linear" else self.v, self.a if rule == "quintic" else None
        return Motion(self.t, self.q, v, a, stated=True)

    @cached_property
    def position(self) -> PiecewisePolynomial:
        """As polynomials."""
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
        """As polynomials; steps where the file has positions alone."""
        return self.position.derivative()

    @cached_property
    def acceleration(self) -> PiecewisePolynomial | None:
        """As polynomials; None where there is none, of straight lines."""
        return None if self.v is None else self.velocity.derivative()

    @cached_property
    def digits(self) -> tuple[Array, Array, Array]:
        """Half of the last digit that positions, velocities and accelerations are written with. Shape (n,) each."""
        none = np.zeros(self.q.shape[1])
        return tuple(none if values is None else half_digits(values) for values in (self.q, self.v, self.a))  # type: ignore[return-value]

    def quantity(self, what: str) -> MotionQuantity | None:
        """Its "position", "velocity", "acceleration" or "jerk"; None where there are too few samples."""
        h = np.diff(self.t)[:, None]
        eq, ev, ea = self.digits
        smooth = {"linear": 0, "cubic": 1, "quintic": 2}[self.rule]
        if what == "position":
            return MotionQuantity(self.position, np.broadcast_to(eq, h.shape[:1] + eq.shape), True)
        if what == "velocity":
            # of the Bernstein coefficients only the middle one has the difference of positions in it
            grows = {0: 2 * eq / h, 1: 3 * eq / h + ev, 2: 3.75 * eq / h + 2.5 * ev + 0.2 * h * ea}[smooth]
            return MotionQuantity(self.velocity, grows, True, self.needed(what))
        if what == "acceleration" and smooth:
            assert self.acceleration is not None
            grows = 12 * eq / h**2 + 6 * ev / h if smooth == 1 else 30 * eq / h**2 + 15 * ev / h + 3 * ea
            return MotionQuantity(self.acceleration, grows, True, self.needed(what))
        if what == "jerk" and smooth == 2:
            assert self.acceleration is not None
            grows = 120 * eq / h**3 + 60 * ev / h**2 + 12 * ea / h
            return MotionQuantity(self.acceleration.derivative(), grows, True, self.needed(what))
        values, digits, order = (self.q, eq, 2 if what == "acceleration" else 3) if smooth == 0 else (self.v, ev, 2)
        assert values is not None
        return self._differences(values, digits, order)

    def needed(self, what: str) -> tuple[Any, Any]:
        """What every motion through the samples needs in each piece, as `MotionQuantity.needed`.

        Acceleration: a motion between positions and velocities needs the least if it switches once from A to -A, where
        A = (2 |e| + sqrt(4 e^2 + h^2 d^2)) / h^2, d is the change of velocity, and e the way less h times the mean
        velocity of both ends. Accelerations that are given count, too. Jerk: by three weighted means, of weights 1 and
        the Chebyshev polynomials U1 and U2 of the piece; from rest to rest 32 of the 60 that a quintic has. Velocity:
        the peak of a trapezium, the lowest of all motions that accelerate no harder than this piece or the one before
        or after it needs; without that bound only the mean velocity would be certain.
        """
        if self.stated or self.v is None:
            return np.inf, np.inf
        h, v, a = np.diff(self.t)[:, None], self.v, self.a
        way, change, mean = np.diff(self.q, axis=0), np.diff(v, axis=0), (v[1:] + v[:-1]) / 2
        off = way - h * mean
        if what == "jerk" and a is not None:
            turn = np.diff(a, axis=0)
            means = turn * h**2, 4 * h * (change - h * (a[1:] + a[:-1]) / 2), 32 * off + 3 * h**2 * turn
            jerk = np.abs(means).max(axis=0) / h**3
            return jerk, jerk
        least = (2 * np.abs(off) + np.sqrt(4 * off**2 + (h * change) ** 2)) / h**2
        if a is not None:
            least = np.maximum(least, np.maximum(np.abs(a[1:]), np.abs(a[:-1])))
        if what == "acceleration":
            return least, least
        around = np.pad(least, ((1, 1), (0, 0)))
        hardest = np.maximum(least, np.maximum(around[2:], around[:-2]))
        ends = (v[1:] ** 2 + v[:-1] ** 2) / 2

        def peak(sign: float) -> Array:
            middle = hardest * h / 2 + sign * mean
            lowest = middle - np.sqrt(np.maximum(middle**2 - sign * hardest * way - ends, 0.0))
            return np.asarray(np.maximum(lowest, np.maximum(sign * v[1:], sign * v[:-1])))

        return peak(1.0), peak(-1.0)

    def _differences(self, values: Array, digits: Array, order: int) -> MotionQuantity | None:
        """order! times divided differences, each between the times of all of its samples."""
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


def half_digits(values: Array) -> Array:
    """Half of the last digit that each column is written with; of single precision half of its last bit. Shape (n,).

    A column of few digits may be exact: digits coarser than a thousandth, and those of few values, count as such.
    """
    found = np.asarray(2.0**-53 * np.abs(values).max(axis=0))
    for k, column in enumerate(values.T):
        several = np.unique(column)
        if len(several) < 20:
            continue
        for power in range(3, 13):
            scaled = several * 10.0**power
            if (np.abs(scaled - np.rint(scaled)) <= 1e-14 * np.abs(scaled) + 1e-9).all():
                found[k] = 0.5 * 10.0**-power
                break
        else:
            if (several.astype(np.float32) == several).all():
                found[k] = 2.0**-25 * np.abs(several).max()
    return found
