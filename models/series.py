"""Roots of a trigonometric polynomial of any degree, all at once, in a bounded number of operations."""

from __future__ import annotations

from typing import Any

import casadi as ca

from models.harmonics import TINY, Point
from models.spatial import Expression

Series = list[tuple[Expression, Expression]]
"""Coefficients (a_k, b_k) of cos k and sin k of an angle, k = 0, 1, ...; b_0 is 0."""

ABERTH_STAGES, ABERTH_NEAR = (6, 1, 1, 1, 1, 2, 4, 8, 16), 1e-5
"""Steps to all roots at once: after each stage but the last only those that still move by more go on."""


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


def added(f: Series, g: Series, factor: float = 1) -> Series:
    """f + factor g."""
    zero: Series = [(0.0, 0.0)]
    size = max(len(f), len(g))
    longer = [f + zero * (size - len(f)), g + zero * (size - len(g))]
    return [(a + factor * c, b + factor * d) for (a, b), (c, d) in zip(*longer, strict=True)]


def series_roots(degree: int) -> Any:
    """Function of the coefficients of a Series -> points of the circle, among which are its simple roots.

    Input (2, degree + 1), rows a and b; output (2, 2 degree), rows cosine and sine. The roots z = exp(i angle) of the
    polynomial z^degree f are found all at once (Aberth 1973) in at most sum(ABERTH_STAGES) steps, and those off the
    circle are drawn to it, where they mean nothing. Good to a few digits; polish them with the function at hand.
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
    apart: dict[tuple[int, int], Point] = {}
    for i in range(n):
        for k in range(i):
            part = _over((1, 0), (z[0, i] - z[0, k], z[1, i] - z[1, k]))
            apart[i, k], apart[k, i] = part, (-part[0], -part[1])
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
                push = (push[0] + apart[i, k][0], push[1] + apart[i, k][1])
        drawn = _times(newton, push)
        step = _over(newton, (1 - drawn[0], -drawn[1]))
        length = ca.hypot(step[0], step[1])
        calm = 1 / ca.fmax(1.0, length / (2 * (1 + ca.hypot(x, y))))
        moved.append(ca.vertcat(x - calm * step[0], y - calm * step[1]))
    longest = ca.SX(0)
    for i in range(n):
        longest = ca.fmax(longest, ca.norm_1(moved[i] - z[:, i]) - ABERTH_NEAR * ca.norm_1(moved[i]))
    step_function = ca.Function("aberth", [z, unit], [ca.horzcat(*moved), longest])

    symbol = ca.MX.sym("coefficients", 2, degree + 1)
    norm = ca.Function("norm", [given], [given / (ca.norm_1(ca.vec(given)) + TINY)])(symbol)
    angles = [0.37 + 2 * ca.pi * i / n for i in range(n)]
    # off the circle the roots are in pairs z, 1 / conj z: one half starts inside, the other outside
    radii = [3.0 if i % 2 else 1 / 3.0 for i in range(n)]
    at = list(zip(angles, radii, strict=True))
    found: Any = ca.DM([[r * ca.cos(a) for a, r in at], [r * ca.sin(a) for a, r in at]])
    moving = None
    for count in ABERTH_STAGES:
        stage = _steps(step_function, count)
        if moving is None:
            found, moving = stage(found, norm)
            continue
        keep = ca.Function("keep", [z, unit], [z, 0])
        found, moving = ca.Function.if_else("aberth", stage, keep)(moving > 0, found, norm)
    circle = ca.Function("circle", [z], [z / ca.repmat(ca.sqrt(ca.sum1(z * z) + TINY), 2, 1)])
    return ca.Function("series_roots", [symbol], [circle(found)], ["coefficients"], ["points"])


def _steps(step: Any, count: int) -> Any:
    """Function (z, coefficients) -> (z after some steps, whether it still moves)."""
    z, unit = ca.MX.sym("z", *step.size_in(0)), ca.MX.sym("scaled", *step.size_in(1))
    moved, longest = z, None
    for _ in range(count):
        moved, longest = step(moved, unit)
    return ca.Function("steps", [z, unit], [moved, longest])


def _times(a: Point, b: Point) -> Point:
    return a[0] * b[0] - a[1] * b[1], a[0] * b[1] + a[1] * b[0]


def _over(a: Point, b: Point) -> Point:
    scale = 1 / (b[0] * b[0] + b[1] * b[1] + TINY)
    return (a[0] * b[0] + a[1] * b[1]) * scale, (a[1] * b[0] - a[0] * b[1]) * scale
