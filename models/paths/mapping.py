"""From distance to curve parameter in real time: two ways to step along a blend, as functions that generate C.

Both continue from the sample before: state (u_(n-1), u_n) and steps (L_n - L_(n-1), L_(n+1) - L_n) give (u_n, u_(n+1)).
At the first sample inside a blend the state is (0, 0) and the steps are (0, distance from its start).
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import casadi as ca
import numpy as np

from models.arrays import Array, ArrayInput, checked_array
from models.errors import ModelError

__all__ = ["gauss_newton", "march", "predictor_corrector"]

NODES = (2, 3, 4, 8)
"""Twice the time of the paper's 3 corrections; on a 90 deg corner of 5 mm, at 1 m/s and 2 ms, a drift of 2e-9 mm."""


@lru_cache(maxsize=16)
def predictor_corrector(degree: int = 3, corrections: int = 3) -> Any:
    """The paper's mapping: predictor (15), then `corrections` times the corrector (13).

    It is blind to its own error: the trapezoid rule (12) lets the sample drift off its distance.

    Args:
        degree: Of the blend: 3 or 5.
        corrections: Number of corrections; the paper takes 3.

    Returns:
        casadi Function (state (2), coefficients (3 (degree + 1)), steps (2, m)) -> state (2). Coefficients are in
        ascending order, three entries a power: the first rows of `Blend.coefficients`, flattened.
    """
    state, coefficients, steps, rate = _symbols(degree)
    u, step = state[1], steps[1]
    here = rate(u)
    guess = _predicted(state, steps, here)
    for _ in range(corrections):
        guess = u + 2 * step / (here + rate(guess))
    return ca.Function("predictor_corrector", [state, coefficients, steps], [ca.cse(ca.vertcat(u, guess))])


@lru_cache(maxsize=16)
def gauss_newton(degree: int = 3, nodes: tuple[int, ...] = NODES) -> Any:
    """The default mapping: the same predictor, then Newton steps on the arc length by Gauss-Legendre quadrature.

    Arguments and results as of predictor_corrector, but for `nodes`: of the quadrature over one control step, for each
    Newton step. The first ones need few, since they only lead near; the last one decides the drift.
    """
    state, coefficients, steps, rate = _symbols(degree)
    if not nodes or not all(isinstance(n, int) and n > 0 for n in nodes):
        raise ModelError(f"quadrature nodes {nodes!r} must be positive whole numbers, one for each Newton step")
    u, step = state[1], steps[1]
    guess = _predicted(state, steps, rate(u))
    for number in nodes:
        points, weights = np.polynomial.legendre.leggauss(number)
        points, weights = (points + 1) / 2, weights / 2
        width = guess - u
        mean = sum(float(w) * rate(u + float(x) * width) for x, w in zip(points, weights, strict=True))
        guess = guess - (width * mean - step) / rate(guess)
    return ca.Function("gauss_newton", [state, coefficients, steps], [ca.cse(ca.vertcat(u, guess))])


def march(mapping: Any, coefficients: Array, distances: ArrayInput) -> Array:
    """Parameters at increasing distances (m) from the start of a blend, each from the one before. Shape (M,).

    Args:
        mapping: Of predictor_corrector or gauss_newton.
        coefficients: Of one blend. Shape (6, 3).
        distances: Shape (M,), m.

    Raises:
        ModelError: Wrong shapes, nan, distances that do not increase from 0.
    """
    try:
        places = np.asarray(distances, dtype=float)
    except (TypeError, ValueError) as error:
        raise ModelError(f"distances {distances!r} are not numeric") from error
    given = np.diff(np.atleast_1d(places), prepend=0.0)
    if places.ndim != 1 or not (np.isfinite(places).all() and (given >= 0).all()):
        raise ModelError(f"distances of shape {places.shape} must be finite and increase from 0, in one row")
    curve = checked_array(coefficients, (6, 3), "blend", "coefficients")
    if not places.size:
        return places
    entries = curve.ravel()[: mapping.numel_in(1)]
    steps = np.stack([np.concatenate([[0.0], given[:-1]]), given])
    along = mapping.mapaccum(len(given))
    states = along(np.zeros(2), np.repeat(entries[:, None], len(given), axis=1), steps)
    return np.asarray(np.array(states)[1])


def _symbols(degree: int) -> tuple[Any, Any, Any, Any]:
    if degree not in (3, 5):
        raise ModelError(f"degree {degree} of a blend is unknown; use 3 (cubic) or 5 (quintic)")
    state, coefficients, steps = (
        ca.SX.sym("state", 2),
        ca.SX.sym("coefficients", 3 * (degree + 1)),
        ca.SX.sym("steps", 2),
    )
    columns = ca.reshape(coefficients, 3, degree + 1)
    derivative = [k * columns[:, k] for k in range(1, degree + 1)]

    def rate(u: Any) -> Any:
        value = derivative[-1]
        for term in reversed(derivative[:-1]):
            value = term + u * value
        return ca.norm_2(value)

    return state, coefficients, steps, rate


def _predicted(state: Any, steps: Any, rate: Any) -> Any:
    return state[0] + (steps[0] + steps[1]) / rate  # eq. (15)
