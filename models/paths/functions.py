"""Smooth paths as casadi Functions, for use in expressions and for generated C code.

`path_function` and `turn_function` accept any distance. A real-time controller only steps along a blend from one
sample to the next: `predictor_corrector` and `gauss_newton` map steps of the distance to the curve parameter. Both
continue from the sample before: state (u_(n-1), u_n) and steps (L_n - L_(n-1), L_(n+1) - L_n) give (u_n, u_(n+1)). At
the first sample inside a blend the state is (0, 0) and the steps are (0, distance from its start).
"""

from __future__ import annotations

from functools import lru_cache
from math import factorial
from typing import Any

import casadi as ca
import numpy as np

from models.checks import Array, ArrayInput, require
from models.errors import ModelError
from models.paths.blends import GAUSS_NODES, GAUSS_WEIGHTS, gauss_rule, speed
from models.paths.segments import screw_axes
from models.paths.smooth_path import SmoothPath
from models.paths.splines import SERIES_TERMS
from models.spatial import angular_velocity_from_quaternion, quaternion_product

MAX_TERMS = 100
"""Largest allowed number of corrector steps or quadrature nodes, since a mapping's expression grows with them."""


def path_function(path: SmoothPath) -> Any:
    """Return the casadi Function that evaluates position, tangent and curvature of a path at a distance (m) along it.

    Outputs: position (3, m), tangent (3), curvature vector (3, 1/m), its derivative (3, 1/m^2). It is an MX function
    with the tables of the path in it; distances outside the path are clamped to it. It computes the same as
    `SmoothPath.at`, with a binary search for the cell, so that `generate` writes C without any library. casadi
    differentiates inside a cell only.
    """
    knots, columns = _cell_table(require.instance("path_function: path", path, SmoothPath))
    s = ca.MX.sym("distance")
    clamped = _clamp(s, path.length)
    outputs = _cell_function()(_column_at(knots, columns, clamped), clamped)
    return ca.Function("path", [s], list(outputs), ["distance"], ["position", "tangent", "curvature", "curvature_rate"])


def turn_function(path: SmoothPath) -> Any:
    """Return the casadi Function that evaluates tool orientation and its rates at a distance (m) along a path.

    Outputs as `SmoothPath.turn`: quaternion (4), rate, acceleration, jerk (3 each, rad/m, rad/m^2, rad/m^3). It is an
    MX function like `path_function`.
    """
    reference, theta = require.instance("turn_function: path", path, SmoothPath).charts
    columns = np.column_stack([reference, theta.reshape(-1, 18), path.piece_lengths, path.bounds[:-1]]).T
    s = ca.MX.sym("distance")
    clamped = _clamp(s, path.length)
    column = _column_at(path.bounds, columns, clamped)
    outputs = orientation_function()(column[:4], column[4:22], column[22], (clamped - column[23]) / column[22])
    return ca.Function("turn", [s], list(outputs), ["distance"], ["quaternion", "rate", "acceleration", "jerk"])


def _column_at(knots: Array, columns: Array, distance: Any) -> Any:
    """Return the column of a table that belongs to the interval between knots in which a distance lies (binary search).

    The tables are interpolants, since CasADi copies a constant matrix whenever it evaluates a function.
    """
    count = len(knots) - 1
    if count == 1:
        return ca.MX(ca.DM(columns))
    place = ca.interpolant("place", "linear", [knots], np.arange(count + 1.0), {"lookup_mode": ["binary"]})
    table = ca.interpolant("table", "linear", [np.arange(count)], columns.ravel("F"), {"lookup_mode": ["exact"]})
    return table(ca.fmin(ca.floor(place(distance)), count - 1))


def _clamp(distance: Any, length: float) -> Any:
    """Return the distance clamped to the path, as an expression whose derivative stays 1 at both ends of the path."""
    return ca.if_else(distance > length, length, ca.if_else(distance < 0, 0.0, distance))


@lru_cache(maxsize=1)
def _cell_function() -> Any:
    row, s = ca.SX.sym("row", 38), ca.SX.sym("s")
    start, axial, tangential, inward, rate, powers, cell = ca.vertsplit(row, [0, 3, 6, 9, 12, 13, 31, 38])
    coefficients = ca.reshape(powers, 3, 6)
    first_s, length, curved, first_u, width, speed0, speed1 = ca.vertsplit(cell)
    distance = s - first_s

    # on a segment; a line has the rate 0, where sin(rate s)/rate is s
    safe = rate + (rate == 0)
    along = ca.if_else(rate == 0, distance, ca.sin(rate * distance) / safe)
    across = ca.if_else(rate == 0, 0, 2 * ca.sin(rate * distance / 2) ** 2 / safe)
    cosine, sine = ca.cos(rate * distance), ca.sin(rate * distance)
    turning = cosine * tangential + sine * inward
    on_segment = [
        start + distance * axial + along * tangential + across * inward,
        axial + turning,
        rate * (cosine * inward - sine * tangential),
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
    guess: Any = first_u + width * x * (slope0 + x * (3 - 2 * slope0 - slope1 + x * (slope0 + slope1 - 2)))
    for _ in range(3):  # the interpolation is already close
        step = guess - first_u
        mean = sum(
            float(w) * rate_of(row, first_u + float(n) * step) for n, w in zip(GAUSS_NODES, GAUSS_WEIGHTS, strict=True)
        )
        guess = guess - (step * mean - distance) / rate_of(row, guess)
    rate_u = ca.dot(first, second) / rate
    rate_uu = (ca.dot(second, second) + ca.dot(first, third) - rate_u**2) / rate
    bend = (second - first * rate_u / rate) / rate**2
    change = (third - 3 * second * rate_u / rate + first * (3 * rate_u**2 / rate**2 - rate_uu / rate)) / rate**3
    curve = ca.Function("curve", [row, u], [_horner(coefficients, u), first / rate, bend, change])
    outputs = [ca.if_else(curved, b, a) for a, b in zip(on_segment, curve(row, guess), strict=True)]
    return ca.Function("in_cell", [row, s], ca.cse(outputs))


def _derivative(columns: Any) -> Any:
    """Return the coefficients of a polynomial's derivative; the coefficients of each power form one column."""
    return ca.horzcat(*[power * columns[:, power] for power in range(1, columns.shape[1])])


def _horner(columns: Any, u: Any) -> Any:
    value = columns[:, -1]
    for j in reversed(range(columns.shape[1] - 1)):
        value = columns[:, j] + u * value
    return value


def _cell_table(path: SmoothPath) -> tuple[Array, Array]:
    """Return the table of `path_function`: distances at which parts of the path start, and a data column for each part.

    The length of the path follows the distances. A part is what remains of a line, arc or helix, or a cell of a curve.
    For a segment: its start point, the axial, tangential and inward vectors of its screw, and its rotation rate. For a
    curve: the coefficients, three a power. For both: distance, length, whether it is a curve; u at the start, width in
    u, speeds at both ends.
    """
    on_segment = np.flatnonzero(path.piece_curve < 0)
    count, segment, task, cells = len(on_segment), path.piece_segment[on_segment], path.path, path.cells
    skipped = np.concatenate([[0.0], path.remaining])[segment]
    position, tangent, bend, _ = task.at(segment, skipped)
    k = task.curvature[segment]
    normal = bend / np.where(k == 0, 1.0, k)[:, None]
    screw = screw_axes(tangent, normal, k, task.torsion[segment])
    # a segment needs some regular curve, of nonzero speed, which is not used
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
    """Return the casadi Function that steps the curve parameter u along a blend by a predictor and several correctors.

    Lee, Ryu, Cheong 2006: predictor (15), then `corrections` correctors (13). The mapping does not control its error:
    with the trapezoid rule (12) the sample drifts from its distance.

    Args:
        degree: Degree of the blend, 3 or 5.
        corrections: Number of corrections; the paper uses 3.

    Returns:
        casadi Function (state (2), coefficients (3 (degree + 1)), steps (2, m)) -> state (2). Coefficients are in
        ascending order, three entries a power: the first rows of `Blend.coefficients`, flattened.
    """
    state, coefficients, steps, rate = _symbols(degree)
    u, step = state[1], steps[1]
    start_rate = rate(u)
    guess = state[0] + (steps[0] + step) / start_rate  # eq. (15)
    for _ in range(require.count("mapping: corrections", corrections, 0, MAX_TERMS)):
        guess = u + 2 * step / (start_rate + rate(guess))
    return ca.Function("predictor_corrector", [state, coefficients, steps], [ca.cse(ca.vertcat(u, guess))])


def gauss_newton(degree: int = 3, nodes: tuple[int, ...] = (2, 3, 4, 8)) -> Any:
    """Return the casadi Function that steps the curve parameter u along a blend by quadrature and Newton steps.

    The predictor is equation (15), the Newton steps solve for the arc length. Arguments and result as for
    `predictor_corrector`, except `nodes`: the number of quadrature nodes over one control step, for each Newton step.
    The first steps need few nodes; the last one determines the drift.
    """
    numbers = tuple(
        require.count("mapping: nodes", n, 1, MAX_TERMS) for n in require.each("mapping: nodes", nodes, int)
    )
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
    """Return the curve parameters u of a blend at increasing distances (m) from its start, step by step. Shape (M,).

    Args:
        mapping: Result of `predictor_corrector` or `gauss_newton`.
        coefficients: Polynomial coefficients of one blend. Shape (6, 3).
        distances: Shape (M,), m.

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
    """Return symbols of state, coefficients and steps of a mapping, and the function from u to the speed |dr/du|."""
    degree = require.choice("blend: degree", degree, (3, 5))
    sizes = {"state": 2, "coefficients": 3 * (degree + 1), "steps": 2}
    state, coefficients, steps = (ca.SX.sym(name, size) for name, size in sizes.items())
    derivative = _derivative(ca.reshape(coefficients, 3, degree + 1))
    return state, coefficients, steps, lambda u: ca.norm_2(_horner(derivative, u))


def exponential(vector: Any) -> Any:
    """Return the unit quaternion of a rotation vector (rad) as a casadi expression. Shape (4, 1).

    A power series in the squared angle, without branches or roots, which is smooth at zero and accurate to rounding for
    angles up to 2 pi.
    """
    square = ca.dot(vector, vector) / 4
    cosine: Any = 0
    sinc: Any = 0
    for k in reversed(range(SERIES_TERMS)):
        cosine = (-1) ** k / factorial(2 * k) + square * cosine
        sinc = (-1) ** k / factorial(2 * k + 1) + square * sinc
    return ca.vertcat(cosine, sinc / 2 * vector)


@lru_cache(maxsize=1)
def orientation_function() -> Any:
    """Return the casadi Function that evaluates the tool orientation and its rates on one segment or blend of a path.

    Inputs: reference (4); theta (3, 6) as 18 entries column by column, ascending powers of distance over length; length
    (m); distance over length. Outputs: unit quaternion (4); in world axes the angular rate per metre (3, rad/m), its
    first and second derivatives with respect to the distance (rad/m^2, rad/m^3).
    """
    reference, theta = ca.SX.sym("reference", 4), ca.SX.sym("theta", 18)
    length, fraction = ca.SX.sym("length"), ca.SX.sym("fraction")
    powers = ca.vertcat(*[fraction**k for k in range(6)])
    quaternion = quaternion_product(reference, exponential(ca.mtimes(ca.reshape(theta, 3, 6), powers)))
    outputs = [quaternion]
    rate = angular_velocity_from_quaternion(quaternion, ca.jacobian(quaternion, fraction) / length)
    for _ in range(3):
        outputs.append(rate)
        rate = ca.jacobian(rate, fraction) / length
    return ca.Function("orientation", [reference, theta, length, fraction], ca.cse(outputs))
