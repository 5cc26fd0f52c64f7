"""Where a trigonometric polynomial of one angle vanishes, in a fixed number of operations and without branches.

Points of the unit circle are pairs (cosine, sine), so that nothing here calls a trigonometric function of the angle.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import casadi as ca

from models.spatial import Expression

Point = tuple[Expression, Expression]
"""A point of the unit circle: (cosine, sine) of an angle."""

Slope = Callable[[Expression, Expression], tuple[Expression, Expression]]
"""A function of a point of the circle that gives a value and its derivative by the angle."""

SMALLEST_SECOND = 1e-6
"""Least second harmonic, relative, that the pencil of conics is given; the polish takes the difference out again."""
TINY = 1e-300
CUBIC_STEPS, POLISH_STEPS, POLISH_REACH = 2, 3, 0.05
ABERTH_STEPS = 24


class Harmonics(NamedTuple):
    """f = a0 + a1 cos + b1 sin + a2 cos 2 + b2 sin 2 of an angle; scalar expressions or numbers."""

    a0: Expression
    a1: Expression
    b1: Expression
    a2: Expression
    b2: Expression

    def value(self, c: Expression, s: Expression) -> Expression:
        """f at the angle whose cosine and sine are c and s."""
        return self.a0 + self.a1 * c + self.b1 * s + self.a2 * (c * c - s * s) + 2 * self.b2 * c * s

    def derivative(self) -> Harmonics:
        """df / d angle."""
        return Harmonics(0.0, self.b1, -self.a1, 2 * self.b2, -2 * self.a2)

    def slope_bound(self) -> Expression:
        """Upper bound of |f''|: hypot(a1, b1) + 4 hypot(a2, b2)."""
        return ca.sqrt(self.a1**2 + self.b1**2) + 4 * ca.sqrt(self.a2**2 + self.b2**2)

    def swing_bound(self) -> Expression:
        """Upper bound of |f - a0|: hypot(a1, b1) + hypot(a2, b2)."""
        return ca.sqrt(self.a1**2 + self.b1**2) + ca.sqrt(self.a2**2 + self.b2**2)


def first_square(a0: Expression, a1: Expression, b1: Expression) -> Harmonics:
    """(a0 + a1 cos + b1 sin)^2."""
    mean = a0 * a0 + (a1 * a1 + b1 * b1) / 2
    return Harmonics(mean, 2 * a0 * a1, 2 * a0 * b1, (a1 * a1 - b1 * b1) / 2, a1 * b1)


def minus(f: Harmonics, g: Harmonics) -> Harmonics:
    """f - g."""
    return Harmonics(*(a - b for a, b in zip(f, g, strict=True)))


def scaled(f: Harmonics, factor: Expression) -> Harmonics:
    """factor f."""
    return Harmonics(*(factor * a for a in f))


def roots(f: Harmonics, sharper: Slope | None = None, steps: int = POLISH_STEPS) -> list[Point]:
    """Four points of the circle, among which are all roots of f; where f has fewer, the others mean nothing.

    The unit circle is cut by the conic f = 0: turned so that the second harmonic is r (x^2 - y^2), the pencil
    f + l (x^2 + y^2 - 1) holds a pair of real lines for a root l in [-r, r] of a cubic that always has one there.
    The lines meet the circle in the roots, which Newton steps then polish. Roots are good to rounding where they are
    simple, to its square root where they are double.

    Args:
        f: The polynomial.
        sharper: Function to polish with in place of f: one that shares the roots that matter and has them simple.
        steps: Newton steps of the polish; with none, simple roots are good to about 1e-6.
    """
    size = ca.fabs(f.a1) + ca.fabs(f.b1) + ca.fabs(f.a2) + ca.fabs(f.b2) + TINY
    f = Harmonics(f.a0 / size, f.a1 / size, f.b1 / size, f.a2 / size, f.b2 / size)
    a0 = ca.fmin(ca.fmax(f.a0, -3.0), 3.0)  # beyond there is no root, only lost digits
    plain = f.a2 * f.a2 + f.b2 * f.b2 < SMALLEST_SECOND**2
    a2 = f.a2 + ca.if_else(plain, 2 * SMALLEST_SECOND, 0.0)
    r = ca.sqrt(a2 * a2 + f.b2 * f.b2)
    large = ca.sqrt((r + ca.fabs(a2)) / (2 * r))
    small = ca.fabs(f.b2) / (2 * r * large)
    turn_c = ca.if_else(a2 >= 0, large, small)
    turn_s = ca.if_else(a2 >= 0, small, large) * _sign(f.b2)
    p = f.a1 * turn_c + f.b1 * turn_s
    q = f.b1 * turn_c - f.a1 * turn_s

    t = _pencil(a0, p, q, r)
    wide, narrow = ca.sqrt(r * (1 + t)), ca.sqrt(r * (1 - t))
    p_direct, q_direct = ca.fabs(p) / (2 * wide + TINY), ca.fabs(q) / (2 * narrow + TINY)
    direct = t >= 0  # divide by the larger of the two square roots, take the other part from the pencil
    p_part = ca.if_else(direct, p_direct, ca.sqrt(ca.fmax(0.0, a0 - r * t + q_direct * q_direct)))
    q_part = ca.if_else(direct, ca.sqrt(ca.fmax(0.0, r * t - a0 + p_direct * p_direct)), q_direct)
    outer = p_part + q_part
    inner = (r * t - a0) / ca.fmax(outer, TINY)  # q_part - p_part without its cancellation
    sign = _sign(p)
    alike = _sign(p) * _sign(q) > 0
    first = ca.if_else(alike, -sign * outer, sign * inner)
    second = ca.if_else(alike, sign * inner, -sign * outer)

    points = []
    unit = ca.sqrt(2 * r)
    for side, offset in ((-1, first), (1, second)):
        nx, ny = wide / unit, side * narrow / unit
        d = ca.fmin(ca.fmax(offset / unit, -1.0), 1.0)
        h = ca.sqrt((1 - d) * (1 + d))
        for end in (-1, 1):
            x, y = d * nx - end * h * ny, d * ny + end * h * nx
            points.append((x * turn_c - y * turn_s, x * turn_s + y * turn_c))
    slope = f.derivative()
    sharp = sharper or (lambda c, s: (f.value(c, s), slope.value(c, s)))
    return [polish(point, sharp, steps) for point in points]


def polish(point: Point, function: Slope, steps: int = POLISH_STEPS) -> Point:
    """Newton steps of at most POLISH_REACH rad on the circle; `function` gives value and derivative by the angle."""
    c, s = point
    for _ in range(steps):
        value, slope = function(c, s)
        step = -value * slope / (slope * slope + TINY)
        step = ca.fmin(ca.fmax(step, -POLISH_REACH), POLISH_REACH)
        c, s = c - step * s, s + step * c
        shrink = 1.5 - 0.5 * (c * c + s * s)  # 1 / norm to first order
        c, s = c * shrink, s * shrink
    norm = 1 / ca.sqrt(c * c + s * s)
    return c * norm, s * norm


def _sign(x: Expression) -> Expression:
    return ca.if_else(x < 0, -1.0, 1.0)


def _pencil(a0: Expression, p: Expression, q: Expression, r: Expression) -> Expression:
    """The root t = l / r in [-1, 1] of 4 r (r t - a0) (t^2 - 1) + p^2 (t - 1) + q^2 (t + 1)."""
    b2 = -a0 / r
    b1 = (p * p + q * q) / (4 * r * r) - 1
    b0 = a0 / r + (q * q - p * p) / (4 * r * r)
    big_q = (b2 * b2 - 3 * b1) / 9
    big_r = (2 * b2 * b2 * b2 - 9 * b2 * b1 + 27 * b0) / 54
    excess = big_r * big_r - big_q * big_q * big_q
    grow = (ca.fabs(big_r) + ca.sqrt(ca.fmax(excess, 0.0)) + TINY) ** (1 / 3)
    lone = -_sign(big_r) * (grow + big_q / grow) - b2 / 3
    root_q = ca.sqrt(ca.fmax(big_q, 0.0))
    third = ca.acos(ca.fmin(ca.fmax(big_r / (root_q * root_q * root_q + TINY), -1.0), 1.0)) / 3
    least = -2 * root_q * ca.cos(third) - b2 / 3
    greatest = root_q * (ca.cos(third) + 3**0.5 * ca.sin(third)) - b2 / 3
    # of three real roots an odd number lies in [-1, 1]: the least does, or else the greatest
    t = ca.if_else(excess >= 0, lone, ca.if_else(least >= -1 - 1e-9, least, greatest))
    t = ca.fmin(ca.fmax(t, -1.0), 1.0)
    for _ in range(CUBIC_STEPS):
        value = ((t + b2) * t + b1) * t + b0
        slope = (3 * t + 2 * b2) * t + b1
        step = -value * slope / (slope * slope + TINY)
        t = ca.fmin(ca.fmax(t + ca.fmin(ca.fmax(step, -1e-2), 1e-2), -1.0), 1.0)
    return t


# ---- any degree ----------------------------------------------------------------------------------------------


Series = list[tuple[Expression, Expression]]
"""Coefficients (a_k, b_k) of cos k and sin k of an angle, k = 0, 1, ...; b_0 is 0."""


def product(f: Series, g: Series) -> Series:
    """f g."""
    total = [[0.0, 0.0] for _ in range(len(f) + len(g) - 1)]
    for i, (a, b) in enumerate(f):
        for k, (c, d) in enumerate(g):
            gap, turn = abs(i - k), 1 if i >= k else -1
            total[i + k][0] = total[i + k][0] + (a * c - b * d) / 2
            total[i + k][1] = total[i + k][1] + (a * d + b * c) / 2
            total[gap][0] = total[gap][0] + (a * c + b * d) / 2
            total[gap][1] = total[gap][1] + turn * (b * c - a * d) / 2
    return [(a, 0.0 if k == 0 else b) for k, (a, b) in enumerate(total)]


def series_roots(degree: int) -> Any:
    """Function of the coefficients of a Series -> points of the circle, among which are its simple roots.

    Input (2, degree + 1), rows a and b; output (2, 2 degree), rows cosine and sine. The roots z = exp(i angle) of the
    polynomial z^degree f are found all at once (Aberth 1973) in ABERTH_STEPS steps, and those off the circle are
    drawn to it, where they mean nothing. Good to a few digits at least; polish them with the function at hand.
    """
    n = 2 * degree
    given = ca.SX.sym("coefficients", 2, degree + 1)
    unit = ca.SX.sym("scaled", 2, degree + 1)
    z = ca.SX.sym("z", 2, n)
    real: list[Expression] = [0] * (n + 1)
    imaginary: list[Expression] = [0] * (n + 1)
    for k in range(degree + 1):
        a, b = (unit[0, k], unit[1, k]) if k else (2 * unit[0, 0], 0)
        real[degree + k], imaginary[degree + k] = a, -b
        real[degree - k], imaginary[degree - k] = a, b
    moved = []
    for i in range(n):
        x, y = z[0, i], z[1, i]
        value, slope = (real[n], imaginary[n]), (0, 0)
        for k in reversed(range(n)):
            slope = _times(slope, (x, y))
            slope = (slope[0] + value[0], slope[1] + value[1])
            value = _times(value, (x, y))
            value = (value[0] + real[k], value[1] + imaginary[k])
        newton = _over(value, slope)
        push: Point = (0, 0)
        for k in range(n):
            if k != i:
                part = _over((1, 0), (x - z[0, k], y - z[1, k]))
                push = (push[0] + part[0], push[1] + part[1])
        drawn = _times(newton, push)
        step = _over(newton, (1 - drawn[0], -drawn[1]))
        length = ca.hypot(step[0], step[1])
        calm = 1 / ca.fmax(1.0, length / (0.5 * (1 + ca.hypot(x, y))))
        moved.append(ca.vertcat(x - calm * step[0], y - calm * step[1]))
    step_function = ca.Function("aberth", [z, unit], [ca.horzcat(*moved)])

    symbol = ca.MX.sym("coefficients", 2, degree + 1)
    norm = ca.Function("norm", [given], [given / (ca.norm_1(ca.vec(given)) + TINY)])(symbol)
    angles = [0.37 + 2 * ca.pi * i / n for i in range(n)]
    start = ca.DM([[1.05 * ca.cos(a) for a in angles], [1.05 * ca.sin(a) for a in angles]])
    found = step_function.fold(ABERTH_STEPS)(start, ca.repmat(norm, 1, ABERTH_STEPS))
    circle = ca.Function("circle", [z], [z / ca.repmat(ca.sqrt(ca.sum1(z * z) + TINY), 2, 1)])
    return ca.Function("series_roots", [symbol], [circle(found)], ["coefficients"], ["points"])


def _times(a: Point, b: Point) -> Point:
    return a[0] * b[0] - a[1] * b[1], a[0] * b[1] + a[1] * b[0]


def _over(a: Point, b: Point) -> Point:
    size = b[0] * b[0] + b[1] * b[1] + TINY
    return (a[0] * b[0] + a[1] * b[1]) / size, (a[1] * b[0] - a[0] * b[1]) / size
