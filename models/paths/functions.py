"""A smooth path as casadi Functions, for expressions and for generated C.

`path_function` and `turn_function` take any distance. In real time it is enough to step along a blend from one sample
to the next: `predictor_corrector` and `gauss_newton` map steps of the distance to the curve parameter. Both continue
from the sample before: state (u_(n-1), u_n) and steps (L_n - L_(n-1), L_(n+1) - L_n) give (u_n, u_(n+1)). At the first
sample inside a blend the state is (0, 0) and the steps are (0, distance from its start).
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import casadi as ca
import numpy as np

from models.arrays import (
    Array,
    ArrayInput,
    checked_array,
    checked_choice,
    checked_count,
    checked_each,
    checked_instance,
)
from models.errors import ModelError
from models.paths.arc_length import GAUSS_NODES, GAUSS_WEIGHTS, gauss_rule, speed
from models.paths.orientation import orientation_function
from models.paths.segments import screw_axes
from models.paths.smooth_path import SmoothPath

__all__ = ["gauss_newton", "march", "path_function", "predictor_corrector", "turn_function"]

MOST_TERMS = 100
"""Corrections, or nodes, of a mapping, whose expression grows with them."""


def path_function(path: SmoothPath) -> Any:
    """Function distance (m) -> position (3, m), tangent (3), curvature (3, 1/m), its derivative (3, 1/m^2).

    MX, with the tables of the path in it; distances outside are those of the ends. The same arithmetic as
    `SmoothPath.at`, on a binary search for the cell, so that `generate` writes C without any library. Derivatives are
    those of the last three outputs' own formulas: casadi differentiates inside a cell only.
    """
    knots, columns = _table(checked_instance(path, SmoothPath, "path_function", "path"))
    s = ca.MX.sym("distance")
    inside = _inside(s, path.length)
    cell = ca.low(ca.DM(knots), inside, {"lookup_mode": "binary"}) if len(knots) > 2 else ca.MX(0)
    outputs = _in_cell()(ca.MX(ca.DM(columns))[:, cell], inside)
    return ca.Function("path", [s], list(outputs), ["distance"], ["position", "tangent", "curvature", "curvature_rate"])


def turn_function(path: SmoothPath) -> Any:
    """Function distance (m) -> quaternion (4), rate (3, rad/m), acceleration (3, rad/m^2), jerk (3, rad/m^3).

    Tool orientation in world and its rates, as of `SmoothPath.turn`; MX with the tables in it, made as path_function.
    """
    reference, theta = checked_instance(path, SmoothPath, "turn_function", "path").charts
    columns = np.column_stack([reference, theta.reshape(-1, 18), path.piece_lengths, path.bounds[:-1]]).T
    s = ca.MX.sym("distance")
    inside = _inside(s, path.length)
    piece = ca.low(ca.DM(path.bounds), inside, {"lookup_mode": "binary"}) if len(path.bounds) > 2 else ca.MX(0)
    column = ca.MX(ca.DM(columns))[:, piece]
    outputs = orientation_function()(column[:4], column[4:22], column[22], (inside - column[23]) / column[22])
    return ca.Function("turn", [s], list(outputs), ["distance"], ["quaternion", "rate", "acceleration", "jerk"])


def _inside(distance: Any, length: float) -> Any:
    """The nearest distance on the path, whose derivative is 1 at both ends too."""
    return ca.if_else(distance > length, length, ca.if_else(distance < 0, 0.0, distance))


@lru_cache(maxsize=1)
def _in_cell() -> Any:
    row, s = ca.SX.sym("row", 38), ca.SX.sym("s")
    start, climb, ahead, inward, rate, powers, cell = ca.vertsplit(row, [0, 3, 6, 9, 12, 13, 31, 38])
    coefficients = ca.reshape(powers, 3, 6)
    first_s, length, curved, first_u, width, speed0, speed1 = ca.vertsplit(cell)
    distance = s - first_s

    # segment; a line has the rate 0: then sin(rate s)/rate is s
    safe = rate + (rate == 0)
    along = ca.if_else(rate == 0, distance, ca.sin(rate * distance) / safe)
    across = ca.if_else(rate == 0, 0, 2 * ca.sin(rate * distance / 2) ** 2 / safe)
    cosine, sine = ca.cos(rate * distance), ca.sin(rate * distance)
    turning = cosine * ahead + sine * inward
    on_segment = [
        start + distance * climb + along * ahead + across * inward,
        climb + turning,
        rate * (cosine * inward - sine * ahead),
        -(rate**2) * turning,
    ]

    u = ca.SX.sym("u")
    slopes = _derivative(coefficients)
    bends = _derivative(slopes)
    first, second, third = (_horner(columns, u) for columns in (slopes, bends, _derivative(bends)))
    rate = ca.norm_2(first)
    rate_of = ca.Function("rate", [row, u], [rate])
    x = distance / length
    slope0, slope1 = length / (width * speed0), length / (width * speed1)
    at: Any = first_u + width * x * (slope0 + x * (3 - 2 * slope0 - slope1 + x * (slope0 + slope1 - 2)))
    for _ in range(3):  # from an interpolation, which errs little
        step = at - first_u
        mean = sum(
            float(w) * rate_of(row, first_u + float(n) * step) for n, w in zip(GAUSS_NODES, GAUSS_WEIGHTS, strict=True)
        )
        at = at - (step * mean - distance) / rate_of(row, at)
    rate_u = ca.dot(first, second) / rate
    rate_uu = (ca.dot(second, second) + ca.dot(first, third) - rate_u**2) / rate
    bend = (second - first * rate_u / rate) / rate**2
    change = (third - 3 * second * rate_u / rate + first * (3 * rate_u**2 / rate**2 - rate_uu / rate)) / rate**3
    curve = ca.Function("curve", [row, u], [_horner(coefficients, u), first / rate, bend, change])
    on_blend = curve(row, at)
    outputs = [ca.if_else(curved, b, a) for a, b in zip(on_segment, on_blend, strict=True)]
    return ca.Function("in_cell", [row, s], ca.cse(outputs))


def _derivative(columns: Any) -> Any:
    """Coefficients of the derivative, one column less."""
    return ca.horzcat(*[power * columns[:, power] for power in range(1, columns.shape[1])])


def _horner(columns: Any, u: Any) -> Any:
    value = columns[:, -1]
    for j in reversed(range(columns.shape[1] - 1)):
        value = columns[:, j] + u * value
    return value


def _table(path: SmoothPath) -> tuple[Array, Array]:
    """Where cells begin and the path ends, and a column for each cell: what `_in_cell` takes apart.

    Of a segment its start, the parts along, round and towards the axis of its screw, and its rate of turning; the
    coefficients of a curve, three a power; distance, length, whether on a blend; u at the start, width in u, speeds.
    """
    on_segment = np.flatnonzero(path.piece_segment >= 0)
    count, segment, task, cells = len(on_segment), path.piece_segment[on_segment], path.path, path.cells
    skipped = np.concatenate([[0.0], path.remaining])[segment]
    position, tangent, bend, _ = task.at(segment, skipped)
    k = task.curvature[segment]
    normal = bend / np.where(k == 0, 1.0, k)[:, None]
    screw = screw_axes(tangent, normal, k, task.torsion[segment])
    # any regular curve will do where none is used: its speed must not be zero
    unused = np.tile([0, 0, 0, 1, 0, 0] + [0] * 12, (count, 1))
    begin, length, none, one = path.bounds[on_segment], path.piece_lengths[on_segment], np.zeros(count), np.ones(count)
    segments = np.column_stack([position, *screw, unused, begin, length, none, none, one, length, length])

    coefficients = path.coefficients[cells.curve]
    speeds = speed(coefficients, cells.start), speed(coefficients, cells.start + cells.width)
    flag, unused, begin_cells = np.ones(len(cells.curve)), np.zeros((len(cells.curve), 13)), path.cell_bounds
    shape = coefficients.reshape(-1, 18)
    curves = np.column_stack([unused, shape, begin_cells, cells.length, flag, cells.start, cells.width, *speeds])
    starts = np.concatenate([begin, begin_cells])
    order = np.argsort(starts, kind="stable")
    return np.append(starts[order], path.length), np.concatenate([segments, curves])[order].T


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
    number = checked_count(corrections, "mapping", "corrections", 0, MOST_TERMS)
    return _predictor_corrector(checked_choice(degree, (3, 5), "blend", "degree"), number)


@lru_cache(maxsize=16)
def _predictor_corrector(degree: int, corrections: int) -> Any:
    state, coefficients, steps, rate = _symbols(degree)
    u, step = state[1], steps[1]
    here = rate(u)
    guess = _predicted(state, steps, here)
    for _ in range(corrections):
        guess = u + 2 * step / (here + rate(guess))
    return ca.Function("predictor_corrector", [state, coefficients, steps], [ca.cse(ca.vertcat(u, guess))])


def gauss_newton(degree: int = 3, nodes: tuple[int, ...] = (2, 3, 4, 8)) -> Any:
    """The default mapping: the same predictor, then Newton steps on the arc length by Gauss-Legendre quadrature.

    Arguments and results as of predictor_corrector, but for `nodes`: of the quadrature over one control step, for each
    Newton step. The first ones need few, since they only lead near; the last one decides the drift.
    """
    numbers = tuple(
        checked_count(n, "mapping", "nodes", 1, MOST_TERMS) for n in checked_each(nodes, int, "mapping", "nodes")
    )
    if not numbers:
        message = "mapping: nodes are empty; give one number for each Newton step"
        raise ModelError(message, name="nodes", value=nodes)
    return _gauss_newton(checked_choice(degree, (3, 5), "blend", "degree"), numbers)


@lru_cache(maxsize=16)
def _gauss_newton(degree: int, nodes: tuple[int, ...]) -> Any:
    state, coefficients, steps, rate = _symbols(degree)
    u, step = state[1], steps[1]
    guess = _predicted(state, steps, rate(u))
    for number in nodes:
        width = guess - u
        mean = sum(float(w) * rate(u + float(x) * width) for x, w in zip(*gauss_rule(number), strict=True))
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
    checked_instance(mapping, ca.Function, "march", "mapping")
    places = checked_array(distances, ("samples",), "march", "distances", least=0)
    given = np.diff(places, prepend=0.0)
    if (given < 0).any():
        worst = float(places[int((given < 0).argmax())])
        raise ModelError(f"march: distances must increase from 0, not to {worst:g} m", name="distances", value=worst)
    curve = checked_array(coefficients, (6, 3), "blend", "coefficients")
    if not places.size:
        return places
    entries = curve.ravel()[: mapping.numel_in(1)]
    steps = np.stack([np.concatenate([[0.0], given[:-1]]), given])
    along = mapping.mapaccum(len(given))
    states = along(np.zeros(2), np.repeat(entries[:, None], len(given), axis=1), steps)
    return np.asarray(np.array(states)[1])


def _symbols(degree: int) -> tuple[Any, Any, Any, Any]:
    sizes = {"state": 2, "coefficients": 3 * (degree + 1), "steps": 2}
    state, coefficients, steps = (ca.SX.sym(name, size) for name, size in sizes.items())
    columns = ca.reshape(coefficients, 3, degree + 1)
    derivative = _derivative(columns)
    return state, coefficients, steps, lambda u: ca.norm_2(_horner(derivative, u))


def _predicted(state: Any, steps: Any, rate: Any) -> Any:
    return state[0] + (steps[0] + steps[1]) / rate  # eq. (15)
