"""Arc length of blends, to rounding, and its inverse.

The speed |dr/du| of a blend is analytic but nearly singular in the middle of a sharp corner. Each curve is therefore
split into cells in which the 10-point Gauss-Legendre rule is exact to rounding; cells are smaller near sharp corners.
They are also small enough for the cubic Hermite guess of the inverse to be monotone, from which Chebyshev's method
converges.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from models.arrays import Array
from models.errors import ModelError

__all__ = ["GAUSS_NODES", "GAUSS_WEIGHTS", "Cells", "arc_length", "cells", "gauss_rule", "parameter", "speed"]


def gauss_rule(count: int) -> tuple[Array, Array]:
    """Return nodes and weights of the Gauss-Legendre rule on 0 to 1."""
    nodes, weights = np.polynomial.legendre.leggauss(count)
    return (nodes + 1) / 2, weights / 2


GAUSS_NODES, GAUSS_WEIGHTS = gauss_rule(10)
MAX_STEPS = 4


class Cells(NamedTuple):
    """Cells of polynomial curves, sorted by curve and u.

    Attributes:
        curve: Index of the curve. Shape (C,).
        start, width: In u. Shape (C,).
        length: Arc length. Shape (C,), m.
    """

    curve: NDArray[np.intp]
    start: Array
    width: Array
    length: Array


def speed(coefficients: Array, u: Array) -> Array:
    """Return the speed |dr/du| at u. Shapes (M, 6, 3), (M,) to (M,), m."""
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
    """Return half the derivative of the squared speed by u. Shapes (3, 5, M), (M,) to (M,)."""
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
    """Split curves into cells. `coefficients` as in models.paths.blends, shape (B, 6, 3).

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


def parameter(coefficients: Array, start: Array, width: Array, length: Array, distance: Array) -> Array:
    """Return the u at which the arc length from the cell's start is `distance`.

    Shapes: coefficients (M, 6, 3), all others (M,). A cubic Hermite guess from the cell's ends is refined by Chebyshev
    iterations, which converge cubically, with the 10-point rule. The result is accurate to rounding for distances from
    0 to the cell's length.
    """
    slopes = _derivative(coefficients)
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
    return np.asarray(u)


def arc_length(coefficients: Array, u: Array) -> Array:
    """Return the arc length from 0 to u of one curve, shape (6, 3). Shapes (M,) to (M,), m."""
    curve = coefficients[None]
    parts = cells(curve)
    index = np.clip(np.searchsorted(parts.start, u, side="right") - 1, 0, len(parts.start) - 1)
    before = np.concatenate([[0.0], np.cumsum(parts.length)])[index]
    start = parts.start[index]
    return np.asarray(before + _lengths(_derivative(curve[np.zeros(len(index), dtype=int)]), start, u - start))
