"""Arrays that users give: read, checked, frozen."""

from __future__ import annotations

from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from models.errors import ModelError

Array: TypeAlias = NDArray[np.float64]


ArrayInput: TypeAlias = Any


def frozenchecked_array(array: Array) -> Array:
    array.setflags(write=False)
    return array


def checked_array(value: ArrayInput, shape: tuple[int, ...], owner: str, what: str, finite: bool = True) -> Array:
    """Read-only copy of `value` as floats.

    ModelError naming `owner` and `what` for a wrong shape, nan, or inf.
    """
    try:
        array = np.array(value, dtype=float)
    except (TypeError, ValueError) as error:
        raise ModelError(f"{owner}: {what} {value!r} is not numeric") from error
    if array.shape != shape:
        raise ModelError(f"{owner}: {what} has shape {array.shape}, expected {shape}")
    if np.isnan(array).any() or (finite and not np.isfinite(array).all()):
        raise ModelError(f"{owner}: {what} {array.tolist()} is not finite")
    return frozenchecked_array(array)


def checked_rotation(value: ArrayInput, owner: str, what: str) -> Array:
    """Read-only copy of a rotation matrix; ModelError naming `owner` and `what` when it is none."""
    matrix = checked_array(value, (3, 3), owner, what)
    error = float(np.abs(matrix @ matrix.T - np.eye(3)).max())
    if error > 1e-6 or np.linalg.det(matrix) < 0:
        raise ModelError(f"{owner}: {what} {matrix.tolist()} is not a rotation matrix (orthonormal, determinant 1)")
    if error > 1e-12:  # printed to few digits: take the nearest rotation
        left, _, right = np.linalg.svd(matrix)
        matrix = frozenchecked_array(left @ right)
    return matrix
