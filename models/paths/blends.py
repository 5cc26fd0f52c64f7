"""Curves that round the corner between two segments, and their closed forms at a corner of two lines.

Lee, Ryu, Cheong 2006, eqs (1)-(9): a cubic with end tangents alpha n1, alpha n2, alpha = shape * remaining (9). With 3
its end curvature between lines is exactly zero for every angle; next to an arc it is not that of the arc. The
quintic prescribes the second derivative as well and so matches the curvature of every neighbour.

Polynomials are ascending: r(u) = sum_k coefficients[k] u^k, u in [0, 1]. Shape (..., 6, 3), a cubic filled with zeros.
`angle` is the interior angle at the vertex: pi for a straight line, small for a sharp corner.

The shape factor that suits a corner: the one whose quintic bends least at its sharpest place.

A steady speed v is permitted up to v^2 curvature = centripetal limit, so of all shapes at one remaining distance that
of least peak curvature is run fastest. A small factor bends near the ends, a large one in the middle: between them the
peak has one lowest place, and where a neighbour's own curvature is the peak a whole stretch of them. It is found by a
search along one line, coarse and then by the golden section. Between two lines it is a function of the angle alone,
kept in a table; next to arcs it depends on their curvatures times the remaining distance too.

A tangent joint of line and arc is left at the arc's own curvature: 1 of its speed, where the factor 1.5 permits 0.79.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Literal, TypeAlias, get_args

import casadi as ca
import numpy as np

from models.arrays import Array, ArrayInput, checked_broadcast, checked_choice, checked_number, checked_numbers
from models.errors import ModelError
from models.spatial import Expression

__all__ = [
    "PAPER_SHAPE",
    "BlendKind",
    "best_shape",
    "by_arc_length",
    "checked_shape",
    "corner_shape",
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
    factors = checked_broadcast(shape, count, f"{kind} blend", "shape factor", "vertices", positive=True)
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


@dataclass(frozen=True)
class ShapeSearch:
    """How the best shape factor is looked for.

    Attributes:
        narrowest, widest: Of the factor times remaining distance over the chord: between two lines the best lies from
            0.885 to 2.44.
        below_cusp: Share of the factor at which a blend has a cusp.
        coarse: Factors compared first. steps: Of the golden section between the neighbours of the best.
        samples: Of a blend whose peak is looked for.
        table_angles, table_samples: Corners of the table, and samples of each.
        least_angle: Of the table, rad; below, the best factor over sine of half the angle is constant.
        block: Corners handled at once, which bounds the memory.
    """

    narrowest: float = 0.5
    widest: float = 3.0
    below_cusp: float = 0.95
    coarse: int = 9
    steps: int = 16
    samples: int = 49
    table_angles: int = 65
    table_samples: int = 201
    least_angle: float = 1e-3
    block: int = 500


SEARCH = ShapeSearch()


def corner_shape(angle: Array) -> Array:
    """Best factors at corners between two lines, of interior angles (rad). Shapes (V,) to (V,)."""
    angles, over_chord = _table()
    return np.asarray(2 * np.sin(angle / 2) * np.interp(angle, angles, over_chord))


@lru_cache(maxsize=1)
def _table() -> tuple[Array, Array]:
    """Interior angles, rad, and the best factor over the chord at remaining distance 1."""
    angles = np.linspace(SEARCH.least_angle, np.pi, SEARCH.table_angles)
    zero = np.zeros((SEARCH.table_angles, 3))
    before = np.column_stack([np.ones(SEARCH.table_angles), zero[:, :2]])
    after = np.column_stack([-np.cos(angles), np.sin(angles), zero[:, 0]])
    nearly = angles.copy()
    nearly[-1] = (angles[-1] + angles[-2]) / 2  # where all is straight any factor will do: the limit counts
    after[-1] = [-np.cos(nearly[-1]), np.sin(nearly[-1]), 0.0]
    found = best_shape(-before, before, zero, after, after, zero, np.ones(SEARCH.table_angles), SEARCH.table_samples)
    return angles, found / (2 * np.sin(nearly / 2))


def best_shape(
    start: Array,
    start_tangent: Array,
    start_bend: Array,
    end: Array,
    end_tangent: Array,
    end_bend: Array,
    remaining: Array,
    samples: int = SEARCH.samples,
) -> Array:
    """Factors of least peak curvature of quintic blends between given ends.

    Args:
        start, end: Shape (V, 3), m.
        start_tangent, end_tangent: Unit. Shape (V, 3).
        start_bend, end_bend: Curvature vectors. Shape (V, 3), 1/m.
        remaining: Distance from the vertex at either end. Shape (V,), m.
        samples: Of a blend whose peak is looked for.

    Returns:
        Shape (V,).
    """
    ends = start, start_tangent, start_bend, end, end_tangent, end_bend
    parts = [slice(first, first + SEARCH.block) for first in range(0, len(remaining), SEARCH.block)]
    found = [_searched(tuple(each[part] for each in ends), remaining[part], samples) for part in parts]
    return np.concatenate(found) if found else np.zeros(0)


def _searched(ends: tuple[Array, ...], remaining: Array, samples: int) -> Array:
    start, tangent, bend, end, end_tangent, end_bend = ends
    u = np.linspace(0, 1, samples)

    def peak(logarithm: Array) -> Array:
        rate = (np.exp(logarithm) * remaining)[:, None]
        curve = quintic(start, rate * tangent, rate**2 * bend, end, rate * end_tangent, rate**2 * end_bend)
        first, second = (polynomial(curve[:, None], u, order) for order in (1, 2))
        square = np.einsum("vui,vui->vu", first, first)
        # |F' x F''|^2 = |F'|^2 |F''|^2 - (F' F'')^2, over |F'|^6
        across = square * np.einsum("vui,vui->vu", second, second) - np.einsum("vui,vui->vu", first, second) ** 2
        with np.errstate(divide="ignore", invalid="ignore"):
            curvature = np.maximum(across, 0.0) / square**3
        return np.asarray(np.nan_to_num(curvature, nan=np.inf).max(axis=1))

    chord = np.linalg.norm(end - start, axis=1) / remaining
    golden = (np.sqrt(5) - 1) / 2
    cusp = SEARCH.below_cusp * LARGEST_SHAPE["quintic"]
    low = np.log(np.clip(SEARCH.narrowest * chord, 1e-6, cusp / 2))
    high = np.log(np.minimum(np.maximum(SEARCH.widest * chord, 2 * np.exp(low)), cusp))
    grid = low + np.linspace(0, 1, SEARCH.coarse)[:, None] * (high - low)
    lowest = np.argmin([peak(each) for each in grid], axis=0)
    row = np.arange(len(remaining))
    low, high = grid[np.maximum(lowest - 1, 0), row], grid[np.minimum(lowest + 1, SEARCH.coarse - 1), row]
    left, right = high - golden * (high - low), low + golden * (high - low)
    at_left, at_right = peak(left), peak(right)
    for _ in range(SEARCH.steps):
        lower = at_left <= at_right
        low, high = np.where(lower, low, left), np.where(lower, right, high)
        new = np.where(lower, high - golden * (high - low), low + golden * (high - low))
        at_new = peak(new)
        left, right = np.where(lower, new, right), np.where(lower, left, new)
        at_left, at_right = np.where(lower, at_new, at_right), np.where(lower, at_left, at_new)
    return np.asarray(np.exp(np.where(at_left <= at_right, left, right)))
