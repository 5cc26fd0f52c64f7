"""Polynomial blends that round the corner between two path segments: coefficients, best shape factor, arc length.

The remaining distance is that from the vertex to both ends of the blend, along the segments. The cubic of Lee, Ryu,
Cheong 2006, eqs (1)-(9), has the end tangents alpha n1, alpha n2 with alpha = shape * remaining (9), where n1, n2 are
the unit tangents of the segments. With the shape factor 3 its end curvature between lines is exactly zero. The quintic
prescribes the second derivative as well and so matches the curvature of every neighbour.

Polynomials are ascending: r(u) = sum_k coefficients[k] u^k, u in [0, 1]. Shape (..., 6, 3), a cubic padded with zeros.
`angle` is the interior angle at the vertex: pi for a straight line, small for a sharp corner.

The best shape factor has the least peak curvature of the quintic, hence the highest constant speed. The peak has one
minimum over the factor, or an interval of minima if a neighbour's own curvature is the peak. Between two lines the
factor depends on the angle alone and is tabulated.

The arc length is computed to rounding. Each curve is split into cells, intervals of u, in which the 10-point Gauss-
Legendre rule is exact to rounding and the cubic Hermite guess of the inverse is monotone, from which Chebyshev's method
converges.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from math import perm
from typing import Any, Literal, NamedTuple, TypeAlias, get_args

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from models.checks import Array, ArrayInput, require
from models.errors import ModelError
from models.spatial import Expression

BlendKind: TypeAlias = Literal["cubic", "quintic"]
Ends: TypeAlias = tuple[Array, Array, Array, Array, Array, Array]
End: TypeAlias = tuple[Array, Array, Array]
PAPER_SHAPE = 3.0
"""Shape factor at which the cubic has continuous curvature between lines, the value of Lee, Ryu, Cheong 2006."""
LARGEST_SHAPE: dict[str, float] = {"cubic": 6.0, "quintic": 30 / 7}
"""Shape factors at which a blend between two lines has a cusp in its middle, by kind of blend."""
MIDDLE_FACTORS: dict[str, float] = {"cubic": 1 / 4, "quintic": 5 / 16}
"""Factors, by kind of blend, that relate the shape factor to the distance of a blend's middle from the vertex.

The distance at u = 1/2 is |1 - c shape| cos(angle/2) times the remaining distance, eq. (8).
"""


def checked_shape(shape: ArrayInput, kind: str, count: int = 1) -> Array:
    """Return checked shape factors of blends (end derivative over distance from the corner). Shape (count,).

    Raises:
        ModelError: A factor is not positive or reaches that of the cusp (cubic 6, quintic 30/7), or the kind is
            unknown.
    """
    require.choice("blend: kind", kind, get_args(BlendKind))
    cusp = LARGEST_SHAPE[kind]
    factors = require.broadcast(f"{kind} blend: shape", shape, count, "vertices", sign="positive")
    if (factors >= cusp).any():
        largest = float(factors.max())
        message = f"shape factor {largest:g} of a {kind} blend must be below {cusp:.6g}, where the curve has a cusp"
        raise ModelError(message, name="shape", value=largest, limit=cusp)
    return factors


def rest_to_rest(s: Expression) -> Expression:
    """Return the minimum-jerk time scaling 10 s^3 - 15 s^4 + 6 s^5, from rest to rest, at a fraction s of the duration.

    Accepts numbers, arrays and expressions.
    """
    if not isinstance(s, ca.SX | ca.MX | ca.DM):
        s = require.array("rest_to_rest: s", s)
    return s**3 * (10 - 15 * s + 6 * s**2)


def cubic(start: Array, start_rate: Array, end: Array, end_rate: Array) -> Array:
    """Return the coefficients of the cubic with given end points and first derivatives, eqs (1)-(7) of Lee et al. 2006.

    The derivatives are in the curve parameter u. Shapes (..., 3) -> (..., 6, 3).
    """
    chord = end - start
    zero = np.zeros_like(chord)
    second = 3 * chord - 2 * start_rate - end_rate
    third = start_rate + end_rate - 2 * chord
    return np.stack([start, start_rate, second, third, zero, zero], axis=-2)


def quintic(start: End, end: End) -> Array:
    """Return the coefficients of the quintic curve with given end points and first and second derivatives at the ends.

    An end is (point, first derivative, second derivative), with respect to the curve parameter u. Shapes (..., 3) ->
    (..., 6, 3).
    """
    (start_value, start_rate, start_second), (end_value, end_rate, end_second) = start, end
    value = end_value - start_value - start_rate - start_second / 2
    rate = end_rate - start_rate - start_second
    bend = end_second - start_second
    third = 10 * value - 4 * rate + bend / 2
    fourth = -15 * value + 7 * rate - bend
    fifth = 6 * value - 3 * rate + bend / 2
    return np.stack([start_value, start_rate, start_second / 2, third, fourth, fifth], axis=-2)


def polynomial(coefficients: Array, u: Array, order: int = 0) -> Array:
    """Return points, or derivatives, of polynomial curves at parameters u. Shapes (..., 6, 3), (...) -> (..., 3)."""
    value = coefficients[..., 5, :] * perm(5, order)
    u = np.asarray(u, dtype=float)[..., None]
    for k in range(4, order - 1, -1):
        value = value * u + coefficients[..., k, :] * perm(k, order)
    return np.asarray(value)


def gamma(shape: float, angle: float, kind: str = "cubic") -> float:
    """Return the distance from the corner of two lines to a blend's middle, divided by the distance to its ends.

    Equation (8): |1 - shape/4| cos(angle/2) for the cubic, |1 - 5 shape/16| cos(angle/2) for the quintic, the distance
    at u = 1/2, which is the closest point for shapes up to 4 (cubic) and 3.2 (quintic).
    """
    for name, value in (("shape", shape), ("angle", angle)):
        require.positive(f"corner: {name}", value)
    if angle > np.pi:
        raise ModelError(f"corner: angle {angle:g} rad is above pi", name="angle", value=angle, limit=np.pi)
    factor = MIDDLE_FACTORS[require.choice("blend: kind", kind, get_args(BlendKind))]
    return float(abs(1 - factor * shape) * np.cos(angle / 2))


def curvature(coefficients: Array, u: Array) -> Array:
    """Return the curvature of polynomial curves at curve parameters u. Shapes (..., 6, 3), (...) -> (...), 1/m."""
    first, second = polynomial(coefficients, u, 1), polynomial(coefficients, u, 2)
    bend = np.linalg.norm(np.cross(first, second), axis=-1)
    return np.asarray(bend / np.linalg.norm(first, axis=-1) ** 3)


def derivatives_by_arc_length(coefficients: Array, u: Array) -> tuple[Array, Array, Array, Array]:
    """Return points of polynomial curves at parameters u, and three derivatives of them with respect to arc length."""
    position, first, second, third = (polynomial(coefficients, u, order) for order in range(4))
    rate = np.linalg.norm(first, axis=-1, keepdims=True)
    rate_u = (first * second).sum(axis=-1, keepdims=True) / rate
    rate_uu = ((second**2).sum(axis=-1, keepdims=True) + (first * third).sum(axis=-1, keepdims=True) - rate_u**2) / rate
    curvature = (second - first * rate_u / rate) / rate**2
    change = third - 3 * second * rate_u / rate + first * (3 * rate_u**2 / rate**2 - rate_uu / rate)
    return position, first / rate, curvature, change / rate**3


@dataclass(frozen=True)
class ShapeSearch:
    """Settings of the search for the shape factor that gives a blend the least peak curvature."""

    narrowest: float = 0.5  # range of the factor times remaining distance over the chord, between lines 0.885 to 2.44
    widest: float = 3.0  # upper end of this range
    below_cusp: float = 0.95  # upper limit of the factor, relative to that of the cusp
    coarse: int = 9  # number of factors of the coarse grid
    steps: int = 16  # golden-section steps between the neighbours of the best
    samples: int = 49  # samples of a blend for its peak curvature
    table_angles: int = 65  # corners of the table
    table_samples: int = 201  # samples of each of these corners
    least_angle: float = 1e-3  # smallest angle of the table, rad; below, factor over sine of half the angle is constant
    block: int = 500  # corners processed at once, which bounds the memory


SEARCH = ShapeSearch()


def corner_shape(angle: Array) -> Array:
    """Return the shape factors, (V,), for which quintic blends between two lines at given angles have the least peak
    curvature. A shape factor is the length of the end tangents over the distance from vertex to blend ends.
    """
    angles, shape_over_chord = _shape_table()
    return np.asarray(2 * np.sin(angle / 2) * np.interp(angle, angles, shape_over_chord))


@lru_cache(maxsize=1)
def _shape_table() -> tuple[Array, Array]:
    """Tabulate the shape factor of least peak curvature, divided by 2 sin(angle / 2), over the angle between lines."""
    angles = np.linspace(SEARCH.least_angle, np.pi, SEARCH.table_angles)
    zero = np.zeros((SEARCH.table_angles, 3))
    before = np.column_stack([np.ones(SEARCH.table_angles), zero[:, :2]])
    after = np.column_stack([-np.cos(angles), np.sin(angles), zero[:, 0]])
    nearly = angles.copy()
    nearly[-1] = (angles[-1] + angles[-2]) / 2  # on a straight line every factor is best: take the limit
    after[-1] = [-np.cos(nearly[-1]), np.sin(nearly[-1]), 0.0]
    ends = -before, before, zero, after, after, zero
    return angles, best_shape(ends, np.ones(SEARCH.table_angles), SEARCH.table_samples) / (2 * np.sin(nearly / 2))


def best_shape(ends: Ends, remaining: Array, samples: int = SEARCH.samples) -> Array:
    """Return the shape factors, (V,), for which quintic blends between given ends have the least peak curvature.

    Args:
        ends: Point (m), unit tangent and curvature vector (1/m) at the start, and at the end. Shape (V, 3) each.
        remaining: Distance of both ends from the vertex. Shape (V,), m.
        samples: Samples of a blend for its peak curvature.
    """
    blocks = [slice(first, first + SEARCH.block) for first in range(0, len(remaining), SEARCH.block)]
    shapes = [_search_shapes([each[block] for each in ends], remaining[block], samples) for block in blocks]
    return np.concatenate(shapes) if shapes else np.zeros(0)


def _search_shapes(ends: Sequence[Array], remaining: Array, samples: int) -> Array:
    start, tangent, bend, end, end_tangent, end_bend = ends
    u = np.linspace(0, 1, samples)

    def peak(logarithm: Array) -> Array:
        rate = (np.exp(logarithm) * remaining)[:, None]
        curve = quintic((start, rate * tangent, rate**2 * bend), (end, rate * end_tangent, rate**2 * end_bend))
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


def gauss_rule(count: int) -> tuple[Array, Array]:
    """Return the nodes and weights of the Gauss-Legendre quadrature rule with `count` nodes on [0, 1]."""
    nodes, weights = np.polynomial.legendre.leggauss(count)
    return (nodes + 1) / 2, weights / 2


GAUSS_NODES, GAUSS_WEIGHTS = gauss_rule(10)
MAX_STEPS = 4


class Cells(NamedTuple):
    """Intervals of the curve parameter u (cells) into which polynomial curves are split to compute arc lengths.

    They are in the order of the curves, then of u.
    """

    curve: NDArray[np.intp]  # index of the curve. Shape (C,).
    start: Array  # start of the interval of u. Shape (C,).
    width: Array  # width of the interval of u. Shape (C,).
    length: Array  # arc length of the interval. Shape (C,), m.


def speed(coefficients: Array, u: Array) -> Array:
    """Return the parametric speed |dr/du| of curves r(u) at parameters u. Shapes (M, 6, 3), (M,) -> (M,), m."""
    return _speed(_derivative(coefficients), u)


def _derivative(coefficients: Array) -> Array:
    # (M, 6, 3) to (3, 5, M), with the samples last for long inner loops
    columns = np.ascontiguousarray(np.transpose(coefficients, (2, 1, 0)))
    return np.asarray(columns[:, 1:] * np.arange(1.0, 6.0)[:, None])


def _speed(derivative: Array, u: Array) -> Array:
    # (3, 5, M), (..., M) to (..., M)
    total: Array = np.zeros(np.shape(u))
    for terms in derivative:
        value = terms[4] * u
        for k in (3, 2, 1):
            value += terms[k]
            value *= u
        value += terms[0]
        value *= value
        total += value
    return np.asarray(np.sqrt(total, out=total))


def _half_square_slope(derivative: Array, u: Array) -> Array:
    """Return half of the derivative of the squared speed of M curves with respect to their parameter u. Shape (M,)."""
    total: Array = np.zeros(np.shape(u))
    for terms in derivative:
        value, slope = terms[4] * u + terms[3], terms[4].copy()
        for k in (2, 1, 0):
            slope = slope * u + value
            value = value * u + terms[k]
        total += value * slope
    return total


def _lengths(derivative: Array, start: Array, width: Array) -> Array:
    # (3, 5, M), (M,), (M,) to (M,)
    return np.asarray(width * (GAUSS_WEIGHTS @ _speed(derivative, start + width * GAUSS_NODES[:, None])))


def cells(coefficients: Array) -> Cells:
    """Split polynomial curves, shape (B, 6, 3), into parameter intervals on which arc lengths can be inverted reliably.

    Raises:
        ModelError: A curve has a cusp, which no finite number of cells resolves.
    """
    curve = np.arange(len(coefficients))
    start, width = np.zeros(len(curve)), np.ones(len(curve))
    slopes = _derivative(coefficients)
    whole = _lengths(slopes, start, width)
    scale = whole.copy()
    done: list[tuple[NDArray[np.intp], Array, Array, Array]] = []
    for _ in range(40):  # a cell of 1e-12 of the curve
        if not curve.size:
            break
        half = width / 2
        own_slopes = slopes[:, :, curve]
        left, right = _lengths(own_slopes, start, half), _lengths(own_slopes, start + half, half)
        fine = np.abs(whole - left - right) <= 1e-13 * scale[curve]  # rounding error of twenty terms
        slowest = np.minimum(_speed(own_slopes, start), _speed(own_slopes, start + width))
        # the cubic of u between the ends is monotone up to slopes of 3 over the mean (Fritsch & Carlson 1980)
        fine &= left + right <= 3 * width * slowest
        done.append((curve[fine], start[fine], width[fine], (left + right)[fine]))
        rough = ~fine
        curve = np.repeat(curve[rough], 2)
        width = np.repeat(half[rough], 2)
        start = np.stack([start[rough], start[rough] + half[rough]], axis=1).ravel()
        whole = np.stack([left[rough], right[rough]], axis=1).ravel()
    else:
        name = f"vertex {int(curve[0]) + 1}"
        message = f"the blend at {name} has a cusp at u = {start[0]:.6g}"
        raise ModelError(f"{message}; use a smaller shape factor or remaining distance", name=name, value=start[0])
    columns = [np.concatenate(parts) for parts in zip(*done, strict=True)] if done else [np.zeros(0)] * 4
    order = np.lexsort((columns[1], columns[0]))
    return Cells(columns[0][order].astype(np.intp), *(column[order] for column in columns[1:]))


def parameter(
    coefficients: Array, cells: Cells, index: NDArray[np.intp], distance: Array
) -> tuple[NDArray[np.intp], Array]:
    """Return curve index and parameter u of points at given arc lengths (m) from the starts of intervals of u (cells).

    A cubic Hermite guess from the cell's ends is refined to rounding by Chebyshev iterations.

    Args:
        coefficients: Polynomials of the curves. Shape (B, 6, 3).
        cells, index: Cells of the curves, and the index of the cell for each distance, shape (M,).
        distance: Clipped to the cell. Shape (M,).
    """
    curve, start, width, length = cells.curve[index], cells.start[index], cells.width[index], cells.length[index]
    distance = np.clip(distance, 0.0, length)
    slopes = _derivative(coefficients[curve])
    begin, end = _speed(slopes, start), _speed(slopes, start + width)
    x = distance / length
    # du/ds at the ends, over the mean slope of the cell
    slope0, slope1 = length / (width * begin), length / (width * end)
    guess = x * (slope0 + x * (3 - 2 * slope0 - slope1 + x * (slope0 + slope1 - 2)))
    u = start + width * np.clip(guess, 0, 1)
    for _ in range(MAX_STEPS):
        excess = _lengths(slopes, start, u - start) - distance
        rate = _speed(slopes, u)
        step = excess / rate
        step *= 1 + step * _half_square_slope(slopes, u) / (2 * rate**2)
        u = np.clip(u - step, start, start + width)
        if not excess.size or np.abs(excess / length).max() < 1e-6:  # the last step has cubed it
            break
    return curve, u


def arc_length(coefficients: Array, u: Array) -> Array:
    """Return the arc lengths (M,), m, of a polynomial curve, coefficients (6, 3), from its start to parameters u."""
    curve = coefficients[None]
    parts = cells(curve)
    index = np.clip(np.searchsorted(parts.start, u, side="right") - 1, 0, len(parts.start) - 1)
    before = np.concatenate([[0.0], np.cumsum(parts.length)])[index]
    start = parts.start[index]
    return np.asarray(before + _lengths(_derivative(curve[np.zeros(len(index), dtype=int)]), start, u - start))


MAX_TERMS = 100
"""Largest allowed number of corrector steps or quadrature nodes, since a mapping's expression grows with them."""


def derivative_of_columns(columns: Any) -> Any:
    """Return the coefficients of a polynomial's derivative; the coefficients of each power form one column."""
    return ca.horzcat(*[power * columns[:, power] for power in range(1, columns.shape[1])])


def horner(columns: Any, u: Any) -> Any:
    """Return, as an expression, the value at u of a polynomial whose coefficients of each power form one column."""
    value = columns[:, -1]
    for j in reversed(range(columns.shape[1] - 1)):
        value = columns[:, j] + u * value
    return value


def predictor_corrector(degree: int = 3, corrections: int = 3) -> Any:
    """Return the CasADi Function that advances the curve parameter u along a blend by a predictor and correctors.

    Lee, Ryu, Cheong 2006: predictor (15), then `corrections` (3 in the paper) correctors (13) by the trapezoid rule
    (12), which lets the sample drift from its distance. The degree of the blend is 3 or 5.

    Returns:
        (state (2), coefficients (3 (degree + 1)), steps (2, m)) -> state (2). State (u_(n-1), u_n) and steps (L_n -
            L_(n-1), L_(n+1) - L_n) give (u_n, u_(n+1)); at the first sample in a blend they are (0, 0) and (0,
            distance from its start). Coefficients are the first rows of `Blend.coefficients`, flattened.
    """
    state, coefficients, steps, rate = _symbols(degree)
    u, step = state[1], steps[1]
    start_rate = rate(u)
    guess = state[0] + (steps[0] + step) / start_rate  # eq. (15)
    for _ in range(require.count("mapping: corrections", corrections, 0, MAX_TERMS)):
        guess = u + 2 * step / (start_rate + rate(guess))
    return ca.Function("predictor_corrector", [state, coefficients, steps], [ca.cse(ca.vertcat(u, guess))])


def gauss_newton(degree: int = 3, nodes: tuple[int, ...] = (2, 3, 4, 8)) -> Any:
    """Return the CasADi Function that advances a blend's parameter u by arc lengths, with quadrature and Newton steps.

    The predictor is equation (15); the Newton steps solve for the arc length. Arguments and result are as for
    `predictor_corrector`. `nodes` has the number of quadrature nodes for each Newton step; the last number determines
    the drift.
    """
    nodes = require.each("mapping: nodes", nodes, int)
    numbers = [require.count("mapping: nodes", n, 1, MAX_TERMS) for n in nodes]
    if not numbers:
        raise ModelError("mapping: nodes is empty; give one number for each Newton step", name="nodes", value=nodes)
    state, coefficients, steps, rate = _symbols(degree)
    u, step = state[1], steps[1]
    guess = state[0] + (steps[0] + step) / rate(u)  # eq. (15)
    for number in numbers:
        width = guess - u
        mean = sum(float(w) * rate(u + float(x) * width) for x, w in zip(*gauss_rule(number), strict=True))
        guess = guess - (width * mean - step) / rate(guess)
    return ca.Function("gauss_newton", [state, coefficients, steps], [ca.cse(ca.vertcat(u, guess))])


def march(mapping: Any, coefficients: Array, distances: ArrayInput) -> Array:
    """Compute, one by one, the curve parameters u, (M,), of a blend at increasing distances (M,), m, from its start.

    `mapping` is a result of `predictor_corrector` or `gauss_newton`, `coefficients` are those of the blend, (6, 3).

    Raises:
        ModelError: A shape is wrong, an entry is nan, or the distances do not increase from 0.
    """
    require.instance("march: mapping", mapping, ca.Function)
    s = require.array("march: distances", distances, ("samples",), least=0)
    increments = np.diff(s, prepend=0.0)
    if (increments < 0).any():
        wrong = float(s[int((increments < 0).argmax())])
        raise ModelError(f"march: distances must increase from 0, not to {wrong:g} m", name="distances", value=wrong)
    curve = require.array("blend: coefficients", coefficients, (6, 3))
    count = len(s)
    if not count:
        return s
    entries = curve.ravel()[: mapping.numel_in(1)]
    steps = np.stack([np.concatenate([[0.0], increments[:-1]]), increments])
    states = mapping.mapaccum(count)(np.zeros(2), np.repeat(entries[:, None], count, axis=1), steps)
    return np.asarray(np.array(states)[1])


def _symbols(degree: int) -> tuple[Any, Any, Any, Any]:
    """Return symbolic inputs (state, coefficients, steps) of a Function for `march`, and the function u -> |dr/du|."""
    degree = require.choice("blend: degree", degree, (3, 5))
    sizes = {"state": 2, "coefficients": 3 * (degree + 1), "steps": 2}
    state, coefficients, steps = (ca.SX.sym(name, size) for name, size in sizes.items())
    derivative = derivative_of_columns(ca.reshape(coefficients, 3, degree + 1))
    return state, coefficients, steps, lambda u: ca.norm_2(horner(derivative, u))
