"""Tool orientation along a path: rotation vectors in a chart, blended like positions.

On each piece of a path the orientation is q(s) = reference exp(theta(s)) with a polynomial theta of the distance. A
segment that turns at a constant rate about a fixed axis is linear in this chart, whether the reference is its start or
the vertex at its end. A quintic in the chart of a vertex therefore joins two segments with continuous rate and
acceleration.
"""

from __future__ import annotations

from functools import lru_cache
from math import atan2, factorial, hypot
from typing import Any

import casadi as ca
import numpy as np

from models.arrays import Array, ArrayInput, checked_array, frozen
from models.errors import ModelError
from models.paths.blends import polynomial
from models.spatial import angular_velocity_from_quaternion, quaternion_product

__all__ = [
    "along_piece",
    "exponential",
    "orientation_function",
    "product",
    "rotation_matrix",
    "rotation_vector",
    "unit_quaternion",
]

LARGEST_TURN = np.pi - 1e-3
"""Largest angle (rad) between two orientations; near pi the shorter rotation between them is ambiguous."""
SERIES_TERMS = 18


def unit_quaternion(value: ArrayInput, what: str) -> Array:
    """Return `value` as a read-only unit quaternion [w, x, y, z]; raise a ModelError if its norm is not 1."""
    quaternion = checked_array(value, (4,), what, "quaternion")
    norm = float(np.linalg.norm(quaternion))
    if abs(norm - 1) > 1e-6:
        message = f"{what}: quaternion {quaternion.tolist()} has the norm {norm:g}; give a unit quaternion"
        raise ModelError(message, name=what, value=quaternion, limit=1.0)
    return frozen(quaternion / norm)


def rotation_vector(first: ArrayInput, second: ArrayInput, owner: str = "orientation") -> Array:
    """Return the shorter rotation from `first` to `second`, in the axes of `first`: second = first exp(vector).

    Shape (3,), rad.

    Raises:
        ModelError: The orientations differ by nearly half a turn, so the shorter rotation is ambiguous.
    """
    # plain floats: a path has many segments, and numpy is slow for three entries
    p0, p1, p2, p3 = np.asarray(first, dtype=float).tolist()
    q0, q1, q2, q3 = np.asarray(second, dtype=float).tolist()
    scalar = p0 * q0 + p1 * q1 + p2 * q2 + p3 * q3
    x = p0 * q1 - q0 * p1 - (p2 * q3 - p3 * q2)
    y = p0 * q2 - q0 * p2 - (p3 * q1 - p1 * q3)
    z = p0 * q3 - q0 * p3 - (p1 * q2 - p2 * q1)
    if scalar < 0:
        scalar, x, y, z = -scalar, -x, -y, -z
    norm = hypot(x, y, z)
    angle = 2 * atan2(norm, scalar)
    if angle > LARGEST_TURN:
        message = (
            f"{owner}: the tool turns by {np.degrees(angle):.4g} deg in one segment, so the sense of rotation is "
            "ambiguous; split the segment"
        )
        raise ModelError(message, name=owner, value=angle, limit=LARGEST_TURN)
    factor = angle / norm if norm > 0 else 2.0
    return np.array([x * factor, y * factor, z * factor])


def product(first: ArrayInput, second: ArrayInput) -> Array:
    """Return the quaternion product of rows or single quaternions: `second` in axes of `first`. Shape (..., 4)."""
    p, q = np.asarray(first, dtype=float), np.asarray(second, dtype=float)
    scalar = p[..., :1] * q[..., :1] - (p[..., 1:] * q[..., 1:]).sum(axis=-1, keepdims=True)
    vector = p[..., :1] * q[..., 1:] + q[..., :1] * p[..., 1:] + np.cross(p[..., 1:], q[..., 1:])
    return np.concatenate([scalar, vector], axis=-1)


def rotation_matrix(quaternion: ArrayInput) -> Array:
    """Return the rotation matrix of a unit quaternion; its columns are the axes. Shape (3, 3)."""
    w, x, y, z = np.asarray(quaternion, dtype=float)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def exponential(vector: Any) -> Any:
    """Return the unit quaternion of a rotation vector (rad), a casadi expression. Shape (4, 1).

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


def along_piece(reference: Array, theta: Array, length: Array, fraction: Array) -> tuple[Array, Array, Array, Array]:
    """Return the same as `orientation_function`, in numpy, for M samples.

    omega = theta' + B theta x theta' + C theta x (theta x theta'), with B = (1 - cos a)/a^2, C = (a - sin a)/a^3 and
    a = |theta|, in the axes of the reference. B and C are entire functions of a^2.

    Args:
        reference: Shape (M, 4).
        theta: Shape (M, 6, 3).
        length, fraction: Shape (M,).

    Returns:
        Unit quaternion (M, 4); rate, acceleration and jerk by the distance (M, 3).
    """
    t0, t1, t2, t3 = (polynomial(theta, fraction, order) / length[:, None] ** order for order in range(4))
    square = _dot(t0, t0)
    first, second = 2 * _dot(t0, t1), 2 * (_dot(t1, t1) + _dot(t0, t2))
    a0, a1 = np.cross(t0, t1), np.cross(t0, t2)
    a2 = np.cross(t1, t2) + np.cross(t0, t3)
    b0, b1 = np.cross(t0, a0), np.cross(t1, a0) + np.cross(t0, a1)
    b2 = np.cross(t2, a0) + 2 * np.cross(t1, a1) + np.cross(t0, a2)
    omega = [t1, t2, t3]
    for start, (v0, v1, v2) in ((2, (a0, a1, a2)), (3, (b0, b1, b2))):
        f0, f1, f2 = _series(start, square)
        f2 = f2 * first**2 + f1 * second
        f1 = f1 * first
        omega[0] = omega[0] + f0 * v0
        omega[1] = omega[1] + f1 * v0 + f0 * v1
        omega[2] = omega[2] + f2 * v0 + 2 * f1 * v1 + f0 * v2
    half = np.sqrt(square) / 2
    scalar, vector = np.cos(half)[:, 0], np.sinc(half / np.pi) / 2 * t0
    w, v = reference[:, 0], reference[:, 1:]
    product = w[:, None] * vector + scalar[:, None] * v + np.cross(v, vector)
    quaternion = np.column_stack([w * scalar - (v * vector).sum(axis=1), product])
    rates = []
    for value in omega:
        twist = 2 * np.cross(v, value)
        rates.append(value + w[:, None] * twist + np.cross(v, twist))
    return quaternion, rates[0], rates[1], rates[2]


def _dot(a: Array, b: Array) -> Array:
    return np.asarray((a * b).sum(axis=1, keepdims=True))


def _series(start: int, square: Array) -> tuple[Array, Array, Array]:
    """Return the sum of (-x)^k / (2 k + start)! and its two derivatives by x."""
    value, first, second = (np.zeros_like(square) for _ in range(3))
    for k in reversed(range(SERIES_TERMS)):
        second = second * square + 2 * first
        first = first * square + value
        value = value * square + (-1) ** k / factorial(2 * k + start)
    return value, first, second


@lru_cache(maxsize=1)
def orientation_function() -> Any:
    """Return the casadi Function of the orientation on a piece and its rates, for any number of samples as columns.

    Inputs: reference (4); theta (3, 6) as 18 entries column by column, ascending powers of distance over length; length
    (m); distance over length. Outputs: unit quaternion (4); in world axes the angular rate per metre (3, rad/m), its
    first and second derivatives by the distance (rad/m^2, rad/m^3).
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
