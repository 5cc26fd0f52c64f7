"""Spatial vector algebra of rigid bodies (Featherstone, *Rigid Body Dynamics Algorithms*, 2008, chapter 2).

Spatial vectors are (angular, linear): a motion vector is (angular velocity, velocity of the point at the frame's
origin), a force vector is (moment about the frame's origin, force). Every function takes SX, MX, DM, NumPy arrays or
nested lists and keeps structural zeros.

Linear systems and determinants of small matrices are expanded element by element, look-up tables as piecewise
polynomials, which keeps expression graphs small.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from functools import wraps
from itertools import combinations
from math import factorial
from typing import Any, NamedTuple, TypeVar, cast

import casadi as ca
import numpy as np
import scipy

from models.checks import NOT_NUMBERS, ROUNDING, Array, floats
from models.errors import ModelError

Expression = Any
"""A CasADi SX, MX or DM, anything that NumPy reads as an array of floats, or a (nested) list with CasADi entries."""
FULL_TURN = 2 * np.pi
"""Angle of a full turn: 2 pi, rad."""

_Callable = TypeVar("_Callable", bound=Callable[..., Any])


class Frame(NamedTuple):
    """Pose of a frame B in a frame A, which transforms points as x_in_a = rotation x_in_b + position.

    Attributes:
        rotation: Axes of B as columns, in A. Shape (3, 3).
        position: Origin of B in A. Shape (3, 1), m.
    """

    rotation: Expression
    position: Expression

    def point(self, position: Expression) -> Expression:
        """Return the coordinates in frame A of a point that is given in frame B. Shape (3, 1), m."""
        return self.position + ca.mtimes(self.rotation, expression(position))


def expression(value: Expression) -> Expression:
    """Convert numbers, a CasADi matrix, or a nested list of both to one CasADi matrix.

    A CasADi matrix is returned unchanged; numbers become a DM without its exact zeros, vectors become columns. Lists,
    tuples and arrays with CasADi entries are stacked vertically, inner lists horizontally.

    Raises:
        ModelError: Text, booleans, ragged lists, arrays of more than two dimensions.
    """
    if isinstance(value, ca.SX | ca.MX | ca.DM):
        return value
    if has_expressions(value):  # NumPy would read a symbol as nan
        rows = [ca.horzcat(*map(expression, row)) if _is_sequence(row) else expression(row) for row in value]
        return ca.vertcat(*rows)
    try:
        return ca.sparsify(ca.DM(floats(value)))
    except NOT_NUMBERS as error:
        message = f"{value!r} is neither an expression nor an array of numbers"
        raise ModelError(message, name="expression", value=value) from error


def has_expressions(value: Any) -> bool:
    """Return whether a list, tuple or array contains a CasADi matrix at any depth."""
    if not _is_sequence(value):
        return False
    return any(isinstance(entry, ca.SX | ca.MX | ca.DM) or has_expressions(entry) for entry in value)


def _is_sequence(value: Any) -> bool:
    if isinstance(value, np.ndarray):
        return value.dtype == object and value.ndim > 0
    return isinstance(value, list | tuple)


def on_scalars(function: _Callable) -> _Callable:
    """Decorate a function of CasADi matrices: for MX arguments, build a Function with SX symbols and call it.

    Element-wise MX graphs are slow to build and to run. Other arguments pass through unchanged. A flat list of scalars
    with MX entries counts as an MX column.
    """

    def column(value: Any) -> Any:
        return expression(value) if isinstance(value, list) and has_expressions(value) else value

    @wraps(function)
    def wrapper(*args: Any, **kwargs: Any) -> Any:
        args, kwargs = tuple(map(column, args)), {name: column(value) for name, value in kwargs.items()}
        mx_arguments = [value for value in (*args, *kwargs.values()) if isinstance(value, ca.MX)]
        if not mx_arguments:
            return function(*args, **kwargs)
        symbols = [ca.SX.sym(f"x{i}", value.sparsity()) for i, value in enumerate(mx_arguments)]
        next_symbol = iter(symbols)
        scalar_args = [next(next_symbol) if isinstance(value, ca.MX) else value for value in args]
        scalar_kwargs = {k: next(next_symbol) if isinstance(v, ca.MX) else v for k, v in kwargs.items()}
        result = function(*scalar_args, **scalar_kwargs)
        parts = result if isinstance(result, tuple) else (result,)
        called = ca.Function(function.__name__.strip("_"), symbols, list(parts)).call(mx_arguments)
        if not isinstance(result, tuple):
            return called[0]
        return type(result)(*called) if hasattr(result, "_fields") else tuple(called)  # a NamedTuple such as Frame

    return cast(_Callable, wrapper)


def skew(vector: Expression) -> Expression:
    """Return the skew-symmetric matrix [a x] of a vector a, for the cross product a x b = [a x] b. Shape (3, 3)."""
    a = expression(vector)
    zero = type(a)(1, 1)
    return ca.vertcat(ca.horzcat(zero, -a[2], a[1]), ca.horzcat(a[2], zero, -a[0]), ca.horzcat(-a[1], a[0], zero))


def cross(a: Expression, b: Expression) -> Expression:
    """Return the cross product of two vectors, shape (3, 1); unlike CasADi's, it keeps structural zeros."""
    a, b = expression(a), expression(b)
    return ca.vertcat(a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0])


def rotation(axis: Expression, angle: Expression) -> Expression:
    """Return the matrix of a rotation by `angle` (rad) about the unit vector `axis`. Shape (3, 3).

    Rodrigues' formula as a a' + cos (1 - a a') + sin [a x]: for a coordinate axis its zeros and its one are exact.
    """
    a, angle = expression(axis), expression(angle)
    along = ca.mtimes(a, a.T)
    across = ca.DM.eye(3) - along
    if isinstance(across, ca.DM):
        along, across = ca.sparsify(along), ca.sparsify(across)
    return along + ca.cos(angle) * across + ca.sin(angle) * skew(a)


def rotation_matrices(vectors: Array) -> Array:
    """Return the rotation matrices of rotation vectors (rad). Shapes (..., 3) -> (..., 3, 3)."""
    angles = np.linalg.norm(vectors, axis=-1)[..., None, None]
    skews = np.cross(vectors[..., None, :], np.eye(3)).swapaxes(-1, -2)
    versines = np.sinc(angles / (2 * np.pi)) ** 2 / 2  # (1 - cos) / angle^2; np.sinc(x) is sin(pi x) / (pi x)
    return np.asarray(np.eye(3) + np.sinc(angles / np.pi) * skews + versines * (skews @ skews))


def least_rotation(first: Array, second: Array) -> Array:
    """Return the rotation matrix of least angle that takes one unit vector to another. Shape (3, 3)."""
    cosine = first @ second
    across = second - cosine * first
    sine = np.linalg.norm(across)
    if sine < np.finfo(float).eps:  # for opposite vectors, half a turn about any axis across
        across = np.cross(first, np.eye(3)[np.abs(first).argmin()])
    for _ in range(2):  # again, since rounding errors of a small difference are relatively large
        across = across / np.linalg.norm(across)
        across = across - (first @ across) * first
    plane = np.outer(first, first) + np.outer(across, across)
    swap = np.outer(across, first)
    return np.asarray(np.eye(3) + (cosine - 1) * plane + sine * (swap - swap.T))


def rotation_from_rpy(roll: Expression, pitch: Expression, yaw: Expression) -> Expression:
    """Return the rotation matrix of roll, pitch, yaw (rad) as in URDF: Rz(yaw) Ry(pitch) Rx(roll). Shape (3, 3)."""
    return ca.mtimes([rotation((0, 0, 1), yaw), rotation((0, 1, 0), pitch), rotation((1, 0, 0), roll)])


def quaternion_product(a: Expression, b: Expression) -> Expression:
    """Return the Hamilton product a b of quaternions [w, x, y, z]: rotate by b, then by a. Shape (4, 1)."""
    a, b = expression(a), expression(b)
    scalar = a[0] * b[0] - ca.dot(a[1:4], b[1:4])
    return ca.vertcat(scalar, a[0] * b[1:4] + b[0] * a[1:4] + cross(a[1:4], b[1:4]))


def rotation_from_quaternion(quaternion: Expression) -> Expression:
    """Return the rotation matrix of a quaternion [w, x, y, z] of any non-zero norm. Shape (3, 3)."""
    q = expression(quaternion)
    w, x, y, z = q[0], q[1], q[2], q[3]
    s = 2 / (w * w + x * x + y * y + z * z)
    sx, sy, sz = s * x, s * y, s * z
    wx, wy, wz = w * sx, w * sy, w * sz
    xx, xy, xz, yy, yz, zz = x * sx, x * sy, x * sz, y * sy, y * sz, z * sz
    return ca.vertcat(
        ca.horzcat(1 - (yy + zz), xy - wz, xz + wy),
        ca.horzcat(xy + wz, 1 - (xx + zz), yz - wx),
        ca.horzcat(xz - wy, yz + wx, 1 - (xx + yy)),
    )


def quaternion_from_rotation(rotation: Array) -> Array:
    """Return unit quaternions [w, x, y, z] with w >= 0 of numeric rotation matrices (Shepperd 1978).

    Shapes (M, 3, 3) -> (M, 4).
    """
    r = np.asarray(rotation, dtype=float)
    trace = np.trace(r, axis1=1, axis2=2)
    squares = np.column_stack([trace, r[:, 0, 0], r[:, 1, 1], r[:, 2, 2]])
    largest = squares.argmax(axis=1)  # avoids division by a small number
    quaternions = np.empty((len(r), 4))
    for k in range(4):
        selected = largest == k
        m = r[selected]
        spin = np.stack([m[:, 2, 1] - m[:, 1, 2], m[:, 0, 2] - m[:, 2, 0], m[:, 1, 0] - m[:, 0, 1]], axis=1)
        if k == 0:
            quaternions[selected] = np.column_stack([1 + trace[selected], spin])
        else:
            i = k - 1
            row = m[:, i, :] + m[:, :, i]
            row[:, i] = 1 + 2 * m[:, i, i] - trace[selected]
            quaternions[selected] = np.column_stack([spin[:, i], row])
    quaternions *= np.where(quaternions[:, :1] < 0, -1.0, 1.0)
    return np.asarray(quaternions / np.linalg.norm(quaternions, axis=1, keepdims=True))


def angular_velocity_from_quaternion(quaternion: Expression, rate: Expression) -> Expression:
    """Return the angular velocity (world axes, rad/s) from a quaternion and its time derivative. Shape (3, 1).

    The quaternion may have any non-zero norm.
    """
    quaternion = expression(quaternion)
    product = quaternion_product(rate, ca.vertcat(quaternion[0], -quaternion[1:4]))
    return 2 * product[1:4] / ca.dot(quaternion, quaternion)


def motion_transform(frame: tuple[Expression, Expression]) -> Expression:
    """Return the matrix that transforms twists from frame B to frame A, given the pose of B in A. Shape (6, 6)."""
    turn, position = expression(frame[0]), expression(frame[1])
    return ca.vertcat(ca.horzcat(turn, type(turn)(3, 3)), ca.horzcat(ca.mtimes(skew(position), turn), turn))


def force_transform(frame: tuple[Expression, Expression]) -> Expression:
    """Return the matrix, (6, 6), that transforms wrenches or momenta from frame B to A, given the pose of B in A."""
    turn, position = expression(frame[0]), expression(frame[1])
    return ca.vertcat(ca.horzcat(turn, ca.mtimes(skew(position), turn)), ca.horzcat(type(turn)(3, 3), turn))


@on_scalars
def solve_spd(matrix: Expression, right: Expression) -> Expression:
    """Solve the linear system A x = right for x, where A, `matrix`, is small, symmetric and positive definite.

    L D L' elimination without pivoting or square roots, meant for n <= 7, with a third of the operations of ca.solve;
    only the lower triangle is read. An indefinite matrix is not detected, and a singular one gives inf or nan.
    """
    matrix, right = expression(matrix), expression(right)
    size = matrix.shape[0]
    factor: dict[tuple[int, int], Expression] = {}  # unit lower triangle L of matrix = L D L'
    scaled: dict[tuple[int, int], Expression] = {}  # L D
    inverse_pivot = []
    for j in range(size):
        for i in range(j, size):
            scaled[i, j] = matrix[i, j] - sum(scaled[i, k] * factor[j, k] for k in range(j))
        inverse_pivot.append(1 / scaled[j, j])
        for i in range(j + 1, size):
            factor[i, j] = scaled[i, j] * inverse_pivot[j]
    rows: list[Expression] = []
    for i in range(size):
        rows.append(right[i, :] - sum(factor[i, k] * rows[k] for k in range(i)))
    rows = [row * inverse_pivot[i] for i, row in enumerate(rows)]
    for i in reversed(range(size)):
        rows[i] = rows[i] - sum(factor[k, i] * rows[k] for k in range(i + 1, size))
    return ca.vertcat(*rows)


@on_scalars
def determinant(matrix: Expression) -> Expression:
    """Return the determinant, (1, 1), of a small square matrix (n <= 7), without divisions, since pivots may be zero.

    The Laplace expansion computes each minor of the first rows once: n 2^(n-1) products instead of n!.
    """
    matrix = expression(matrix)
    size = matrix.shape[0]
    minors: dict[tuple[int, ...], Expression] = {(): ca.DM(1)}
    for row in range(size):
        minors = {
            columns: sum(
                (-1) ** (row + at) * matrix[row, column] * minors[columns[:at] + columns[at + 1 :]]
                for at, column in enumerate(columns)
            )
            for columns in combinations(range(size), row + 1)
        }
    return minors[tuple(range(size))]


LINEAR = re.compile(r"casadi_interpn\(res\[0\], 1, (\w+), \w+, (\w+), arg\[0\]")
SPLINE = re.compile(r"nd_boor_eval\)?\([^;]*?,1,(\w+),\w+,(\w+),\w+,(\w+),")
NUMBERS = re.compile(r"static const casadi_(?:real|int) (\w+)\[\d+\] =\s*\{([^}]*)\}")


def expand_tables(values: Any) -> Any:
    """Return an SX matrix in which look-up tables (CasADi interpolants) of one argument become piecewise polynomials.

    Raises:
        ModelError: An entry calls a function that is not a table of one argument.
    """
    instructions = ca.Function("values", ca.symvar(values), [values])
    if ca.OP_CALL not in {instructions.instruction_id(k) for k in range(instructions.n_instructions())}:
        return values
    expanded: dict[int, Any] = {}

    def expand(node: Any) -> Any:
        if (key := node.element_hash()) not in expanded:
            if node.is_output():
                call = node.dep(0)
                inputs = [expand(call.dep(k)) for k in range(call.n_dep())]
                expanded[key] = _table(call.which_function(), inputs)[node.which_output()]
            else:
                parts = [expand(node.dep(k)) for k in range(node.n_dep())]
                operation = ca.SX.binary if len(parts) == 2 else ca.SX.unary
                expanded[key] = operation(node.op(), *parts) if parts else node
        return expanded[key]

    return ca.reshape(ca.vertcat(*map(expand, ca.vertsplit(ca.vec(values)))), *values.shape)


def _table(function: Any, inputs: list[Any]) -> list[Any]:
    """Return the outputs of a table (CasADi interpolant) as piecewise polynomials, read from its generated C code."""
    code = ca.CodeGenerator("table")
    code.add(function)
    text = code.dump()
    arrays = {name: np.array(numbers.split(","), dtype=float) for name, numbers in NUMBERS.findall(text)}
    linear = LINEAR.search(text)
    numbers = linear or SPLINE.search(text)
    if len(inputs) != 1 or numbers is None:
        message = f"{function.name()!r}, a {function.class_name()}, is no table of one argument; write it out"
        raise ModelError(message, name=function.name(), value=function.class_name())
    knots, *degree, values = (arrays[name] for name in numbers.groups())
    order = int(degree[0][0]) if degree else 1
    if linear:  # as a spline of degree 1
        knots = np.concatenate([knots[:1], knots, knots[-1:]])
    curve = scipy.interpolate.BSpline(knots, values.reshape(len(knots) - order - 1, -1), order)
    breaks = np.unique(knots)
    coefficients = np.array([curve(breaks[:-1], k) / factorial(k) for k in range(order + 1)])
    x = ca.SX.sym("x")
    table = ca.Function("table", [x], [_polynomials(breaks, coefficients, x, beyond=bool(linear))])
    samples = np.concatenate([breaks, (breaks[1:] + breaks[:-1]) / 2, breaks[:1] - 1.0, breaks[-1:] + 1.0])[None]
    expected, actual = np.array(function(samples)), np.array(table(samples))
    if not np.abs(expected - actual).max() <= ROUNDING * (1 + np.abs(expected).max()):
        message = f"the table {function.name()!r} is not generated by CasADi in a known form; write it out"
        raise ModelError(message, name=function.name(), value=float(np.abs(expected - actual).max()))
    return list(ca.vertsplit(table(inputs[0])))


def _polynomials(breaks: Array, coefficients: Array, x: Any, *, beyond: bool) -> Any:
    """Evaluate a piecewise polynomial at x without branches; beyond its breaks, it continues if `beyond`, else is 0."""
    last = len(breaks) - 2
    total = ca.SX(ca.DM(coefficients[0, 0]))
    for k in range(last + 1):
        clipped = x if beyond and k == last else ca.fmin(x, breaks[k + 1])
        clipped = clipped if beyond and k == 0 else ca.fmax(clipped, breaks[k])
        increment = 0.0
        for factors in coefficients[:0:-1, k]:
            increment = (increment + ca.DM(factors)) * (clipped - breaks[k])
        total += increment
    return total if beyond else ca.if_else(ca.logic_and(x >= breaks[0], x <= breaks[-1]), total, 0.0)
