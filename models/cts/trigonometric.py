"""Roots and minima of trigonometric polynomials of one angle, in a bounded number of operations.

Points of the unit circle are pairs (cosine, sine), so no trigonometric function of the angle is evaluated. Polynomials
of two harmonics are solved in closed form without branches, those of any degree by a simultaneous iteration on all
roots.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import casadi as ca
import numpy as np

from models.spatial import Expression

Point = tuple[Expression, Expression]
"""A point of the unit circle: (cosine, sine) of an angle."""
Slope = Callable[[Expression, Expression], tuple[Expression, Expression]]
"""A function of a point of the unit circle that returns a value and its derivative with respect to the angle."""
SMALLEST_DIVISOR = 1e-300
"""Number added to divisors that may be zero; it is too small to change any other divisor."""


@dataclass(frozen=True)
class RootSettings:
    """Settings of the root finding for trigonometric polynomials; they bound the number of operations.

    Attributes:
        min_second_harmonic: Smallest relative second harmonic in the pencil of conics; a smaller one is raised, and the
            polish removes the difference.
        min_square_harmonic: Smallest second harmonic whose square does not underflow.
        cubic_steps, polish_steps, least_steps: Newton or Halley steps to the root of the pencil, to a root, and to the
            minimum, after which only rounding errors are left.
        max_polish_step: Largest step of the polish, rad.
        root_tolerance: Largest distance of an approximate root from its polished root, rad.
        stages: Numbers of simultaneous steps on all roots in `series_roots`; after each stage but the last, the
            iteration ends if all roots move by less than `step_tolerance`.
        step_tolerance: Step of a root, relative to the root, at which the iteration ends.
    """

    min_second_harmonic: float = 1e-6
    min_square_harmonic: float = 1e-100
    cubic_steps: int = 2
    polish_steps: int = 3
    least_steps: int = 4
    max_polish_step: float = 0.05
    root_tolerance: float = 0.01
    stages: tuple[int, ...] = (6, 1, 1, 1, 1, 2, 4, 8, 16)
    step_tolerance: float = 1e-5


ROOTS = RootSettings()


class Harmonics(NamedTuple):
    """A trigonometric polynomial of an angle x: f = a0 + a1 cos x + b1 sin x + a2 cos 2x + b2 sin 2x."""

    a0: Expression
    a1: Expression
    b1: Expression
    a2: Expression
    b2: Expression

    def value(self, c: Expression, s: Expression) -> Expression:
        """Return the value of the trigonometric polynomial at the angle with a given cosine and sine."""
        return self.a0 + self.a1 * c + self.b1 * s + self.a2 * (c * c - s * s) + 2 * self.b2 * c * s

    def derivative(self) -> Harmonics:
        """Return the derivative of the trigonometric polynomial with respect to the angle."""
        return Harmonics(0.0, self.b1, -self.a1, 2 * self.b2, -2 * self.a2)

    def slope_bound(self) -> Expression:
        """Return hypot(a1, b1) + 4 hypot(a2, b2), which bounds how fast the slope of the polynomial changes."""
        return ca.sqrt(self.a1**2 + self.b1**2) + 4 * ca.sqrt(self.a2**2 + self.b2**2)


def square_of_first_harmonic(a0: Expression, a1: Expression, b1: Expression) -> Harmonics:
    """Return the square of a trigonometric polynomial of one harmonic, a0 + a1 cos x + b1 sin x."""
    return Harmonics(a0 * a0 + (a1 * a1 + b1 * b1) / 2, 2 * a0 * a1, 2 * a0 * b1, (a1 * a1 - b1 * b1) / 2, a1 * b1)


def subtract_harmonics(f: Harmonics, g: Harmonics) -> Harmonics:
    """Return the difference f - g of two trigonometric polynomials."""
    return Harmonics(*(a - b for a, b in zip(f, g, strict=True)))


def scale_harmonics(f: Harmonics, factor: Expression) -> Harmonics:
    """Return a trigonometric polynomial multiplied by a factor."""
    return Harmonics(*(factor * a for a in f))


def roots(f: Harmonics, steps: int = ROOTS.polish_steps) -> list[Point]:
    """Return four points of the unit circle that include all roots of a trigonometric polynomial of two harmonics.

    If it has fewer roots, the other points have no meaning. The roots are the intersections of the unit circle with the
    conic f = 0, in axes with the second harmonic r (x^2 - y^2). The pencil f + l (x^2 + y^2 - 1) contains a pair of
    real lines for a root l in [-r, r] of a cubic, which always has one. The lines intersect the circle in the roots,
    which Newton steps then polish. Simple roots are accurate to rounding. At double roots a step only halves the error
    of the lines, typically the square root of the machine precision.

    Args:
        steps: Newton steps of the polish; without any, simple roots are accurate to about 1e-6.
    """
    size = ca.fabs(f.a1) + ca.fabs(f.b1) + ca.fabs(f.a2) + ca.fabs(f.b2) + SMALLEST_DIVISOR
    f = Harmonics(f.a0 / size, f.a1 / size, f.b1 / size, f.a2 / size, f.b2 / size)
    a0 = ca.fmin(ca.fmax(f.a0, -3.0), 3.0)  # beyond there is no root; larger values would only lose digits
    first_only = f.a2 * f.a2 + f.b2 * f.b2 < ROOTS.min_second_harmonic**2
    turn_c, turn_s, p, q, r = _axes(f, ca.if_else(first_only, 2 * ROOTS.min_second_harmonic, 0.0))

    t = _pencil(a0, p, q, r)
    wide, narrow = ca.sqrt(r * (1 + t)), ca.sqrt(r * (1 - t))
    p_direct, q_direct = ca.fabs(p) / (2 * wide + SMALLEST_DIVISOR), ca.fabs(q) / (2 * narrow + SMALLEST_DIVISOR)
    direct = t >= 0  # divide by the larger of the two square roots, and take the other part from the pencil
    p_part = ca.if_else(direct, p_direct, ca.sqrt(ca.fmax(0.0, a0 - r * t + q_direct * q_direct)))
    q_part = ca.if_else(direct, ca.sqrt(ca.fmax(0.0, r * t - a0 + p_direct * p_direct)), q_direct)
    outer = p_part + q_part
    inner = (r * t - a0) / ca.fmax(outer, SMALLEST_DIVISOR)  # q_part - p_part without its cancellation
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
    # f has size 1: a slope below the square root of the machine precision is a rounding error, as at a double root
    options: dict[str, Any] = {"steps": steps, "floor": np.finfo(float).eps}
    return [polish(point, lambda c, s: (f.value(c, s), slope.value(c, s)), **options) for point in points]


def _axes(f: Harmonics, shift: Expression) -> tuple[Expression, Expression, Expression, Expression, Expression]:
    """Return the rotation that removes the mixed term x y of a polynomial on the unit circle, and the new coefficients.

    The rotation is (cosine, sine). With (x, y) on the unit circle f = a0 + p x + q y + r (x^2 - y^2), r > 0, in the
    rotated axes. `shift` is added to a2, so that the second harmonic has a direction.
    """
    a2 = f.a2 + shift
    r = ca.sqrt(a2 * a2 + f.b2 * f.b2)
    large = ca.sqrt((r + ca.fabs(a2)) / (2 * r))
    small = ca.fabs(f.b2) / (2 * r * large)
    turn_c = ca.if_else(a2 >= 0, large, small)
    turn_s = ca.if_else(a2 >= 0, small, large) * _sign(f.b2)
    return turn_c, turn_s, f.a1 * turn_c + f.b1 * turn_s, f.b1 * turn_c - f.a1 * turn_s, r


def least_point(f: Harmonics) -> Point:
    """Return the point (cos, sin) of the unit circle at which a trigonometric polynomial f has its global minimum.

    In axes with f = a0 + p x + q y + r (x^2 - y^2), r > 0, mirroring x or y only changes the terms p x and q y, so the
    minimum is in the quadrant where neither is positive. There f has exactly one stationary point, the root of
    P / cos - Q / sin - 4 r with P = |p|, Q = |q|, which is monotone over the quadrant. Halley steps start from the
    larger of two lower bounds of the angle. Near the cusp P = 4 r, Q = 0, where three roots meet, they start from the
    cube root that leads there. Three of them and one Newton step reach rounding accuracy for all P, Q, r >= 0.
    """
    turn_c, turn_s, p, q, r = _axes(f, ca.if_else(f.a2 >= 0, ROOTS.min_square_harmonic, -ROOTS.min_square_harmonic))
    big_p, big_q = ca.fabs(p), ca.fabs(q)
    scale = 1 / (big_p + big_q + 4 * r)
    big_p, big_q, big_r = big_p * scale, big_q * scale, 4 * r * scale
    hypot = ca.sqrt(big_p * big_p + big_q * big_q) + SMALLEST_DIVISOR
    widest = ca.fmax(big_p, big_r)
    c = big_p / ca.fmax(hypot, big_r)
    s_cusp = ca.fmin(1.0, 2 * big_q / widest) ** (1 / 3)
    step_tolerance = ca.fabs(big_r - big_p) * s_cusp < big_q
    c = ca.if_else(step_tolerance, ca.fmin(c, ca.sqrt((1 - s_cusp) * (1 + s_cusp))), c)
    s = ca.sqrt(ca.fmax((1 - c) * (1 + c), 0.0))
    for k in range(ROOTS.least_steps):
        pc, ps, qc, qs, rc, rs = big_p * c, big_p * s, big_q * c, big_q * s, big_r * c, big_r * s
        value = ps - qc - rs * c
        slope = ca.fmax(pc + qs - (rc * c - rs * s), 1e-30)
        if k < ROOTS.least_steps - 1:
            step = -value * slope / (slope * slope - 0.5 * value * (qc - ps + 4 * rs * c))
            step = ca.fmin(ca.fmax(step, -1.0), 1.0)
            c, s = ca.fmax(c - step * s, 0.0), ca.fmax(s + step * c, 0.0)
        else:
            step = -value / slope
            c, s = c - step * s, s + step * c
        size = c * c + s * s
        norm = 1.5 - 0.5 * size if k == ROOTS.least_steps - 2 else 1 / ca.sqrt(size)  # the last step but one is small
        c, s = c * norm, s * norm
    x, y = -_sign(p) * c, -_sign(q) * s
    return x * turn_c - y * turn_s, x * turn_s + y * turn_c


def polish(
    point: Point,
    function: Slope,
    *,
    steps: int = ROOTS.polish_steps,
    max_polish_step: float = ROOTS.max_polish_step,
    floor: float = SMALLEST_DIVISOR,
) -> Point:
    """Refine a point of the unit circle, an approximate root of a function of the angle, by bounded Newton steps.

    `function` returns value and derivative with respect to the angle. If the square of the derivative is below `floor`
    the steps vanish.
    """
    c, s = point
    for _ in range(steps):
        value, slope = function(c, s)
        step = -value * slope / (slope * slope + floor)
        step = ca.fmin(ca.fmax(step, -max_polish_step), max_polish_step)
        c, s = c - step * s, s + step * c
        shrink = 1.5 - 0.5 * (c * c + s * s)  # 1 / norm to first order
        c, s = c * shrink, s * shrink
    norm = 1 / ca.sqrt(c * c + s * s)
    return c * norm, s * norm


def _sign(x: Expression) -> Expression:
    return ca.if_else(x < 0, -1.0, 1.0)


def _pencil(a0: Expression, p: Expression, q: Expression, r: Expression) -> Expression:
    """Return the parameter in [-1, 1] of the two real lines in the pencil of the conics that `roots` intersects.

    The parameter t = l / r is a root of the cubic 4 r (r t - a0) (t^2 - 1) + p^2 (t - 1) + q^2 (t + 1) = 0.
    """
    b2 = -a0 / r
    b1 = (p * p + q * q) / (4 * r * r) - 1
    b0 = a0 / r + (q * q - p * p) / (4 * r * r)
    big_q = (b2 * b2 - 3 * b1) / 9
    big_r = (2 * b2 * b2 * b2 - 9 * b2 * b1 + 27 * b0) / 54
    excess = big_r * big_r - big_q * big_q * big_q
    grow = (ca.fabs(big_r) + ca.sqrt(ca.fmax(excess, 0.0)) + SMALLEST_DIVISOR) ** (1 / 3)
    lone = -_sign(big_r) * (grow + big_q / grow) - b2 / 3
    root_q = ca.sqrt(ca.fmax(big_q, 0.0))
    third = ca.acos(ca.fmin(ca.fmax(big_r / (root_q * root_q * root_q + SMALLEST_DIVISOR), -1.0), 1.0)) / 3
    least = -2 * root_q * ca.cos(third) - b2 / 3
    greatest = root_q * (ca.cos(third) + 3**0.5 * ca.sin(third)) - b2 / 3
    # an odd number of the three real roots lies in [-1, 1]: the least root, or else the greatest
    t = ca.if_else(excess >= 0, lone, ca.if_else(least >= -1 - 1e-9, least, greatest))
    t = ca.fmin(ca.fmax(t, -1.0), 1.0)
    for _ in range(ROOTS.cubic_steps):
        value = ((t + b2) * t + b1) * t + b0
        slope = (3 * t + 2 * b2) * t + b1
        step = -value * slope / (slope * slope + SMALLEST_DIVISOR)
        t = ca.fmin(ca.fmax(t + ca.fmin(ca.fmax(step, -1e-2), 1e-2), -1.0), 1.0)
    return t


Series = list[tuple[Expression, Expression]]
"""Coefficients (a_k, b_k) of cos kx and sin kx in a trigonometric polynomial of an angle x, k = 0, 1, ...; b_0 is 0."""


def multiply_series(f: Series, g: Series) -> Series:
    """Return the product of two trigonometric series."""
    total = [[0.0, 0.0] for _ in range(len(f) + len(g) - 1)]
    for i, (a, b) in enumerate(f):
        for k, (c, d) in enumerate(g):
            gap, turn = abs(i - k), 1 if i >= k else -1
            total[i + k][0] = total[i + k][0] + (a * c - b * d) / 2
            total[i + k][1] = total[i + k][1] + (a * d + b * c) / 2
            total[gap][0] = total[gap][0] + (a * c + b * d) / 2
            total[gap][1] = total[gap][1] + turn * (b * c - a * d) / 2
    return [(a, 0.0 if k == 0 else b) for k, (a, b) in enumerate(total)]


def add_series(f: Series, g: Series, factor: float = 1) -> Series:
    """Return the sum f + factor g of two trigonometric series f and g."""
    zero: Series = [(0.0, 0.0)]
    size = max(len(f), len(g))
    longer = [f + zero * (size - len(f)), g + zero * (size - len(g))]
    return [(a + factor * c, b + factor * d) for (a, b), (c, d) in zip(*longer, strict=True)]


def series_roots(degree: int) -> Any:
    """Return the CasADi Function that finds the simple roots of a trigonometric series from its coefficients.

    The roots are points of the unit circle. Input (2, degree + 1), rows a and b; output (2, 2 degree), rows cosine and
    sine. The roots z = exp(i angle) of the polynomial z^degree f are computed simultaneously (Aberth 1973) in at most
    sum(ROOTS.stages) steps. Roots off the circle are projected to it and meaningless. The result has a few correct
    digits; polish it with the function at hand.
    """
    n = 2 * degree
    coefficients = ca.SX.sym("coefficients", 2, degree + 1)
    unit = ca.SX.sym("scaled", 2, degree + 1)
    z = ca.SX.sym("z", 2, n)
    real: list[Expression] = [0] * (n + 1)
    imaginary: list[Expression] = [0] * (n + 1)
    for k in range(degree + 1):
        a, b = (unit[0, k], unit[1, k]) if k else (2 * unit[0, 0], 0)
        real[degree + k], imaginary[degree + k] = a, -b
        real[degree - k], imaginary[degree - k] = a, b
    inverse_differences: dict[tuple[int, int], Point] = {}
    for i in range(n):
        for k in range(i):
            part = _divide((1, 0), (z[0, i] - z[0, k], z[1, i] - z[1, k]))
            inverse_differences[i, k], inverse_differences[k, i] = part, (-part[0], -part[1])
    iterates = []
    for i in range(n):
        x, y = z[0, i], z[1, i]
        value, slope = (real[n], imaginary[n]), (0, 0)
        for k in reversed(range(n)):
            slope = _multiply(slope, (x, y))
            slope = (slope[0] + value[0], slope[1] + value[1])
            value = _multiply(value, (x, y))
            value = (value[0] + real[k], value[1] + imaginary[k])
        newton = _divide(value, slope)
        repulsion: Point = (0, 0)
        for k in range(n):
            if k != i:
                repulsion = (repulsion[0] + inverse_differences[i, k][0], repulsion[1] + inverse_differences[i, k][1])
        correction = _multiply(newton, repulsion)
        step = _divide(newton, (1 - correction[0], -correction[1]))
        damping = 1 / ca.fmax(1.0, ca.hypot(step[0], step[1]) / (2 * (1 + ca.hypot(x, y))))
        iterates.append(ca.vertcat(x - damping * step[0], y - damping * step[1]))
    longest = ca.SX(0)
    for i in range(n):
        longest = ca.fmax(longest, ca.norm_1(iterates[i] - z[:, i]) - ROOTS.step_tolerance * ca.norm_1(iterates[i]))
    step_function = ca.Function("aberth", [z, unit], [ca.horzcat(*iterates), longest])

    symbol = ca.MX.sym("coefficients", 2, degree + 1)
    size = ca.norm_1(ca.vec(coefficients)) + SMALLEST_DIVISOR
    norm = ca.Function("norm", [coefficients], [coefficients / size])(symbol)
    angles = [0.37 + 2 * ca.pi * i / n for i in range(n)]
    # off the circle the roots are in pairs z, 1 / conj z: one half starts inside, the other outside
    radii = [3.0 if i % 2 else 1 / 3.0 for i in range(n)]
    polar = list(zip(angles, radii, strict=True))
    points: Any = ca.DM([[r * ca.cos(a) for a, r in polar], [r * ca.sin(a) for a, r in polar]])
    moving = None
    for count in ROOTS.stages:
        stage = _steps(step_function, count)
        if moving is None:
            points, moving = stage(points, norm)
            continue
        keep = ca.Function("keep", [z, unit], [z, 0])
        points, moving = ca.Function.if_else("aberth", stage, keep)(moving > 0, points, norm)
    circle = ca.Function("circle", [z], [z / ca.repmat(ca.sqrt(ca.sum1(z * z) + SMALLEST_DIVISOR), 2, 1)])
    return ca.Function("series_roots", [symbol], [circle(points)], ["coefficients"], ["points"])


def _steps(step: Any, count: int) -> Any:
    """Return the CasADi Function that performs `count` iterations of Aberth's method for all roots of a polynomial.

    (roots, coefficients) -> (roots, excess of the last step over the tolerance).
    """
    z, unit = ca.MX.sym("z", *step.size_in(0)), ca.MX.sym("scaled", *step.size_in(1))
    iterates, longest = z, None
    for _ in range(count):
        iterates, longest = step(iterates, unit)
    return ca.Function("steps", [z, unit], [iterates, longest])


def _multiply(a: Point, b: Point) -> Point:
    return a[0] * b[0] - a[1] * b[1], a[0] * b[1] + a[1] * b[0]


def _divide(a: Point, b: Point) -> Point:
    scale = 1 / (b[0] * b[0] + b[1] * b[1] + SMALLEST_DIVISOR)
    return (a[0] * b[0] + a[1] * b[1]) * scale, (a[1] * b[0] - a[0] * b[1]) * scale
