"""Curves that round the corner between two segments, and their closed forms at a corner of two lines.

Lee, Ryu, Cheong 2006, eqs (1)-(9): a cubic with end tangents alpha n1, alpha n2, alpha = shape * remaining (9). With 3
its end curvature between lines is exactly zero for every angle; next to an arc it is not that of the arc. The
quintic prescribes the second derivative as well and so matches the curvature of every neighbour.

Polynomials are ascending: r(u) = sum_k coefficients[k] u^k, u in [0, 1]. Shape (..., 6, 3), a cubic filled with zeros.
`angle` is the interior angle at the vertex: pi for a straight line, small for a sharp corner.
"""

from __future__ import annotations

from typing import Literal, TypeAlias, get_args

import casadi as ca
import numpy as np

from models.arrays import Array, ArrayInput, checked_choice, checked_number, checked_numbers, one_for_each
from models.errors import ModelError
from models.spatial import Expression

__all__ = [
    "PAPER_SHAPE",
    "BlendKind",
    "by_arc_length",
    "checked_shape",
    "cubic",
    "curvature",
    "end_curvature",
    "gamma",
    "middle_curvature",
    "peak_curvature",
    "polynomial",
    "quintic",
    "rest_to_rest",
]

BlendKind: TypeAlias = Literal["cubic", "quintic"]
PAPER_SHAPE = 3.0
"""Of the cubic, whose curvature is then continuous between lines."""
LARGEST_SHAPE: dict[str, float] = {"cubic": 6.0, "quintic": 30 / 7}
"""At these the curve between two lines stops in its middle: a cusp."""
# value and derivative at the middle of the corner: F = Lr (n2 - n1) (1/2 - a shape), F' = Lr (n1 + n2) (b - c shape),
# F'' = Lr (n2 - n1) d shape
MIDDLE: dict[str, tuple[float, float, float, float]] = {
    "cubic": (1 / 8, 3 / 2, 1 / 4, 1.0),
    "quintic": (5 / 32, 15 / 8, 7 / 16, 3 / 2),
}


def checked_shape(shape: ArrayInput, kind: str, count: int = 1) -> Array:
    """Shape factors of some vertices, one or one for each given.

    Shape (count,).

    Raises:
        ModelError: A factor that is not above zero and below that of the cusp (cubic 6, quintic 30/7), an unknown kind.
    """
    checked_choice(kind, get_args(BlendKind), "blend", "kind")
    cusp = LARGEST_SHAPE[kind]
    factors = one_for_each(shape, count, f"{kind} blend", "shape factor", "vertices", positive=True)
    if (factors >= cusp).any():
        worst = float(factors.max())
        message = f"shape factor {worst:g} of a {kind} blend must be below {cusp:.6g}, where the curve has a cusp"
        raise ModelError(message, name="shape", value=worst, limit=cusp)
    return factors


def rest_to_rest(s: Expression) -> Expression:
    """Share of a way after the share s of its time, from rest to rest: 10 s^3 - 15 s^4 + 6 s^5, s in [0, 1].

    The polynomial of least degree whose speed and acceleration are zero at both ends. Numbers, arrays and expressions.
    """
    if not isinstance(s, ca.SX | ca.MX | ca.DM):
        s = checked_numbers(s, "rest_to_rest", "s")
    return s**3 * (10 - 15 * s + 6 * s**2)


def cubic(start: Array, start_rate: Array, end: Array, end_rate: Array) -> Array:
    """Cubic with given ends and derivatives by u, eqs (1)-(7). Shapes (..., 3) to (..., 6, 3)."""
    chord = end - start
    zero = np.zeros_like(chord)
    second = 3 * chord - 2 * start_rate - end_rate
    third = start_rate + end_rate - 2 * chord
    return np.stack([start, start_rate, second, third, zero, zero], axis=-2)


def quintic(
    start: Array, start_rate: Array, start_second: Array, end: Array, end_rate: Array, end_second: Array
) -> Array:
    """Quintic with given ends, first and second derivatives by u. Shapes (..., 3) to (..., 6, 3)."""
    value = end - start - start_rate - start_second / 2
    rate = end_rate - start_rate - start_second
    bend = end_second - start_second
    return np.stack(
        [
            start,
            start_rate,
            start_second / 2,
            10 * value - 4 * rate + bend / 2,
            -15 * value + 7 * rate - bend,
            6 * value - 3 * rate + bend / 2,
        ],
        axis=-2,
    )


def polynomial(coefficients: Array, u: Array, order: int = 0) -> Array:
    """Derivative of some order of polynomials at u. Shapes (..., 6, 3), (...) to (..., 3)."""
    powers = _falling(order)
    last = coefficients[..., 5, :] * powers[5]
    u = np.asarray(u, dtype=float)[..., None]
    for k in range(4, order - 1, -1):
        last = last * u + coefficients[..., k, :] * powers[k]
    return np.asarray(last)


def _falling(order: int) -> list[float]:
    # k (k - 1) ... (k - order + 1)
    return [float(np.prod(np.arange(k - order + 1, k + 1))) if k >= order else 0.0 for k in range(6)]


def _check_corner(shape: float, angle: float, remaining: float = 1.0) -> None:
    for what, value in (("shape factor", shape), ("angle", angle), ("remaining distance", remaining)):
        checked_number(value, "corner", what, positive=True)
    if angle > np.pi:
        raise ModelError(f"corner: angle {angle:g} rad is above pi", name="angle", value=angle, limit=np.pi)


def _middle(kind: str) -> tuple[float, float, float, float]:
    return MIDDLE[checked_choice(kind, get_args(BlendKind), "blend", "kind")]


def gamma(shape: float, angle: float, kind: str = "cubic") -> float:
    """Distance vertex to curve over the remaining distance, eq. (8), between two lines.

    |1 - shape/4| cos(angle/2) for the cubic, |1 - 5 shape/16| cos(angle/2) for the quintic: the distance at u = 1/2,
    which is the nearest point for shapes up to 4 (cubic) and 3.2 (quintic).
    """
    _check_corner(shape, angle)
    a = _middle(kind)[0]
    return float(abs(1 - 2 * a * shape) * np.cos(angle / 2))


def end_curvature(shape: float, angle: float, remaining: float) -> float:
    """Curvature (1/m) of the cubic where it leaves a line: |6 - 2 shape| sin(angle) / (shape^2 remaining)."""
    _check_corner(shape, angle, remaining)
    return float(abs(6 - 2 * shape) * np.sin(angle) / (shape**2 * remaining))


def middle_curvature(shape: float, angle: float, remaining: float, kind: str = "cubic") -> float:
    """Curvature (1/m) at u = 1/2 between two lines.

    For the cubic shape cos(angle/2) / [2 (1.5 - shape/4)^2 sin^2(angle/2) remaining], the largest of the curve near
    shape 3; a flatter shape bends more at its ends, see `peak_curvature`.
    """
    _check_corner(shape, angle, remaining)
    _, b, c, d = _middle(kind)
    half = angle / 2
    return float(d * shape * np.cos(half) / (2 * (b - c * shape) ** 2 * np.sin(half) ** 2 * remaining))


def peak_curvature(shape: float, angle: float, remaining: float, kind: str = "cubic") -> float:
    """Largest curvature (1/m) of the blend between two lines, wherever it lies.

    Taken on a grid that is refined about its largest value, 1e-8 relative.
    """
    _check_corner(shape, angle, remaining)
    checked_shape(shape, kind)
    n1, n2 = np.array([1.0, 0.0, 0.0]), np.array([-np.cos(angle), np.sin(angle), 0.0])
    rate, zero = shape * remaining, np.zeros(3)
    start, end = -remaining * n1, remaining * n2
    if kind == "cubic":
        curve = cubic(start, rate * n1, end, rate * n2)
    else:
        curve = quintic(start, rate * n1, zero, end, rate * n2, zero)
    low, high, best = 0.0, 1.0, 0.0
    for _ in range(5):
        u = np.linspace(low, high, 2001)
        bend = curvature(curve, u)
        at = int(bend.argmax())
        best = float(bend[at])
        low, high = u[max(at - 2, 0)], u[min(at + 2, len(u) - 1)]
    return best


def curvature(coefficients: Array, u: Array) -> Array:
    """|F' x F''| / |F'|^3 of curves at u. Shapes (..., 6, 3), (...) to (...), 1/m."""
    first, second = polynomial(coefficients, u, 1), polynomial(coefficients, u, 2)
    bend = np.linalg.norm(np.cross(first, second), axis=-1)
    return np.asarray(bend / np.linalg.norm(first, axis=-1) ** 3)


def by_arc_length(coefficients: Array, u: Array) -> tuple[Array, Array, Array, Array]:
    """Position and derivatives by the distance from derivatives by u: the chain rule with d/ds = (1/|F'|) d/du."""
    position, first, second, third = (polynomial(coefficients, u, order) for order in range(4))
    rate = np.linalg.norm(first, axis=-1, keepdims=True)
    rate_u = (first * second).sum(axis=-1, keepdims=True) / rate
    rate_uu = ((second**2).sum(axis=-1, keepdims=True) + (first * third).sum(axis=-1, keepdims=True) - rate_u**2) / rate
    curvature = (second - first * rate_u / rate) / rate**2
    change = third - 3 * second * rate_u / rate + first * (3 * rate_u**2 / rate**2 - rate_uu / rate)
    return position, first / rate, curvature, change / rate**3
