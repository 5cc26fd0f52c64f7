"""Validation of user input: arrays, numbers, names, flags and typed values. Validated arrays are read-only."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from math import isfinite, isnan
from numbers import Real
from typing import Any, TypeAlias, TypeVar
from warnings import warn

import numpy as np
from numpy.typing import NDArray

from models.errors import ModelError, ModelWarning
from models.files import INPUT_LIMITS

__all__ = ["NOT_NUMBERS", "check_entries", "floats"]

NOT_NUMBERS = (TypeError, ValueError, OverflowError, RuntimeError, NotImplementedError)
"""Exceptions that NumPy and CasADi raise for values that are not numeric."""


def check_entries(value: Any) -> None:
    """Raise ValueError if `value` has more than `INPUT_LIMITS.array_entries` entries.

    The size is estimated before anything is copied, since a view or a range may exceed the memory. The first entry of a
    list stands for all its entries.
    """
    limit, entries, part = INPUT_LIMITS.array_entries, 1, value
    for _ in range(INPUT_LIMITS.nesting):  # as many dimensions as numpy's arrays have at most
        if isinstance(part, np.ndarray):
            entries *= part.size
        if not isinstance(part, Sequence) or isinstance(part, str | bytes):
            break
        entries *= len(part)
        if not 0 < entries <= limit:
            break
        part = part[0]
    if entries > limit:
        raise ValueError(f"{entries} entries, at most {limit} are read")


def floats(value: Any) -> NDArray[np.float64]:
    """Return a value as a new array of floats.

    Values that NumPy would silently convert are refused too: text, True, None, symbols (read as nan) and complex
    numbers.

    Raises:
        TypeError, ValueError, ...: One of NOT_NUMBERS: the value is not numeric or has too many entries.
    """
    check_entries(value)
    array = np.asarray(value)
    if array.dtype.kind == "O":
        numeric = all(isinstance(entry, Real) and not isinstance(entry, bool | np.bool_) for entry in array.flat)
    else:
        numeric = array.dtype.kind in "iuf"
    if not numeric:
        raise TypeError(f"{array.dtype} is no real number")
    return np.array(array, dtype=float)


Array: TypeAlias = NDArray[np.float64]

ArrayInput: TypeAlias = Any

ROUNDING = 1e-9
"""Relative tolerance (or absolute, in m or rad) below which a difference is attributed to rounding."""
MAX_LISTED = 12
"""Largest number of vector entries, or of names, that a message lists."""

_Choice = TypeVar("_Choice")
_Kind = TypeVar("_Kind")


def frozen(array: Array) -> Array:
    """Make an array read-only and return it."""
    array.setflags(write=False)
    return array


def checked_array(
    value: ArrayInput,
    shape: tuple[int | str, ...],
    owner: str,
    argument: str,
    *,
    finite: bool = True,
    nan: bool = False,
    positive: bool = False,
    least: int = 1,
    unit: str = "",
) -> Array:
    """Return `value` as a read-only array of floats of the given shape.

    Args:
        value: Anything that NumPy reads as floats.
        shape: Expected shape. A string stands for a free dimension of size `least` or more: ("points", 3). A shape with
            one free dimension also accepts a scalar.
        owner, argument: The object and the name of its argument, for messages.
        finite: Refuse inf.
        nan: Accept nan.
        positive: Require all entries to be above zero.
        unit: For messages.

    Raises:
        ModelError: A value that is not numeric, has the wrong shape, or contains nan, inf or an entry that is not
            positive. The error's `name` is `argument`.
    """
    array = _read(value, owner, argument)
    if array.shape != shape:
        array = _shaped(array, shape, owner, argument, least)
    if not np.isfinite(array).all():
        wrong = (np.isnan(array) & (not nan)) | (np.isinf(array) & finite)
        if wrong.any():
            raise ModelError(f"{owner}: {_shown(array, wrong, argument)} is not finite", name=argument, value=array)
    if positive and not (array > 0).all():
        shown = f"{_shown(array, ~(array > 0), argument)} {unit}".rstrip()
        raise ModelError(f"{owner}: {shown} is not positive", name=argument, value=array, limit=0.0)
    return frozen(array)


def _read(value: ArrayInput, owner: str, argument: str) -> Array:
    try:
        return floats(value)
    except NOT_NUMBERS as error:
        raise ModelError(f"{owner}: {argument} {value!r} is not numeric", name=argument, value=value) from error


def _shaped(array: Array, shape: tuple[int | str, ...], owner: str, argument: str, least: int) -> Array:
    """Return the array, a scalar as shape (1,), if it fits a shape with free dimensions; raise ModelError otherwise."""
    if array.ndim == 0 and len(shape) == 1 and isinstance(shape[0], str):
        array = array.reshape(1)
    fits = array.ndim == len(shape) and all(
        size >= least if isinstance(expected_size, str) else size == expected_size
        for size, expected_size in zip(array.shape, shape, strict=True)
    )
    if not fits:
        expected = str(shape).replace("'", "")
        hint = f", {least} at least" if any(isinstance(expected_size, str) for expected_size in shape) else ""
        message = f"{owner}: {argument} has shape {array.shape}, expected {expected}{hint}"
        raise ModelError(message, name=argument, value=array, limit=shape)
    return array


def _shown(array: Array, wrong: Any, argument: str) -> str:
    """Describe an invalid array: whole if it is a short vector, else by its first invalid entry or row."""
    if array.ndim < 2 and array.size <= MAX_LISTED:
        return f"{argument} {array.tolist()}"
    if array.ndim == 1:
        entry = int(np.flatnonzero(wrong)[0])
        return f"{argument} (entry {entry}) {array[entry].item()}"
    row = int(np.flatnonzero(wrong.reshape(len(array), -1).any(axis=1))[0])
    return f"{argument} (row {row}) {array[row].tolist()}"


def checked_numbers(value: ArrayInput, owner: str, argument: str) -> Array:
    """Return `value` as an array of finite floats of any shape; errors as in checked_array."""
    array = _read(value, owner, argument)
    return checked_array(array, array.shape, owner, argument)


def checked_number(
    value: ArrayInput, owner: str, argument: str, *, finite: bool = True, positive: bool = False, unit: str = ""
) -> float:
    """Return `value` as a float; arguments and errors as in checked_array."""
    if isinstance(value, float) and (isfinite(value) or not (finite or isnan(value))) and (value > 0 or not positive):
        return float(value)  # fast path: a robot has hundreds of numbers
    return float(checked_array(value, (), owner, argument, finite=finite, positive=positive, unit=unit))


def checked_nonnegative(value: ArrayInput, owner: str, argument: str, unit: str = "") -> float:
    """Return `value` as a float; raise ModelError unless it is finite and not negative."""
    number = checked_number(value, owner, argument)
    if number < 0:
        message = f"{owner}: {argument} {number} {unit}".rstrip()
        raise ModelError(f"{message} is negative", name=argument, value=number, limit=0.0)
    return number


def checked_count(value: Any, owner: str, argument: str, least: int = 1, most: int = INPUT_LIMITS.count) -> int:
    """Return `value` as an int; raise ModelError unless it is an integer from `least` to `most`."""
    if not isinstance(value, int | np.integer) or isinstance(value, bool) or not least <= value <= most:
        message = f"{owner}: {argument} must be a whole number, {least} to {most}, not {value!r}"
        raise ModelError(message, name=argument, value=value, limit=(least, most))
    return int(value)


def checked_indices(value: Any, count: int, owner: str, argument: str) -> NDArray[np.intp]:
    """Return `value` as an array of indices; raise ModelError unless all are integers in [0, count)."""
    try:
        check_entries(value)
        indices = np.asarray(value)
    except NOT_NUMBERS:  # rejected below
        indices = np.array(np.nan)
    if indices.dtype.kind not in "iu" or ((indices < 0) | (indices >= count)).any():
        message = f"{owner}: {argument} must be whole numbers from 0, below {count}, not {value!r}"
        raise ModelError(message, name=argument, value=value, limit=(0, count))
    return indices.astype(np.intp)


def checked_broadcast(
    value: ArrayInput, count: int, owner: str, argument: str, items: str, *, finite: bool = True, **checks: Any
) -> Array:
    """Return one float for each of `count` items, from one number or from an array of shape (count,).

    Args:
        items: Plural noun for messages.
        checks: Further arguments of checked_array.

    Raises:
        ModelError: As in checked_array.
    """
    array = _read(value, owner, argument)
    if array.ndim and array.shape != (count,):
        message = f"{owner}: {argument} has shape {array.shape}; give one number or one for each of the {count} {items}"
        raise ModelError(message, name=argument, value=array, limit=(count,))
    values = checked_array(array, array.shape, owner, argument, finite=finite, **checks)
    return frozen(np.array(np.broadcast_to(values, (count,))))


def warn_of_degrees(angles: ArrayInput, owner: str, name: str, argument: str) -> None:
    """Warn if an angle (rad) exceeds two turns and so looks like degrees. Values above 1e4 count as "no limit".

    Python shows the same message only once.

    Warns:
        ModelWarning: With the `name` of a joint or argument, and the angle.
    """
    words = "rad is more than two turns; angles are in rad, is it in degrees?"
    _warn_of_unit(angles, (4 * np.pi, 1e4), name, f"{owner}: {argument}", words)


def warn_of_millimetres(lengths: ArrayInput, owner: str, name: str, argument: str) -> None:
    """Warn if a length (m) exceeds 50 m and so looks like millimetres, as warn_of_degrees does for angles."""
    words = "m is long for a robot; lengths are in m, is it in millimetres?"
    _warn_of_unit(lengths, (50.0, np.inf), name, f"{owner}: {argument}", words)


def _warn_of_unit(values: ArrayInput, suspicious: tuple[float, float], name: str, owner: str, words: str) -> None:
    """Warn of the first entry whose magnitude is between two bounds."""
    low, high = suspicious
    for value in np.ravel(values).tolist():  # faster than array operations on few entries
        if low < abs(value) < high:
            warn(ModelWarning(f"{owner} {value:g} {words}", name=name, value=value, limit=low), stacklevel=2)
            return


def checked_rotation(value: ArrayInput, owner: str, argument: str) -> Array:
    """Return a read-only copy of a rotation matrix; raise ModelError if it is not one."""
    matrix = checked_array(value, (3, 3), owner, argument)
    error = float(np.abs(matrix @ matrix.T - np.eye(3)).max())
    (a, b, c), (d, e, f), (g, h, i) = matrix.tolist()  # np.linalg.det would double the cost
    if error > 1e-6 or a * (e * i - f * h) + b * (f * g - d * i) + c * (d * h - e * g) < 0:
        message = f"{owner}: {argument} {matrix.tolist()} is not a rotation matrix (orthonormal, determinant 1)"
        raise ModelError(message, name=argument, value=matrix)
    if error > 1e-12:  # printed with few digits: project onto the nearest rotation
        left, _, right = np.linalg.svd(matrix)
        matrix = frozen(left @ right)
    return matrix


def checked_choice(value: _Choice, choices: Iterable[Any], owner: str, argument: str) -> _Choice:
    """Return `value`; raise ModelError unless it is one of the choices."""
    allowed = tuple(choices)
    if not any(isinstance(value, type(choice)) and value == choice for choice in allowed):
        message = f"{owner}: {argument} {value!r} is unknown; use one of {list(allowed)}"
        raise ModelError(message, name=argument, value=value, limit=allowed)
    return value


def checked_instance(value: Any, kind: type[_Kind], owner: str, argument: str) -> _Kind:
    """Return `value`; raise ModelError unless it is an instance of `kind`."""
    if not isinstance(value, kind):
        message = f"{owner}: {argument} must be a {kind.__name__}, not {value!r}"
        raise ModelError(message, name=argument, value=value, limit=kind.__name__)
    return value


def checked_each(values: Any, kind: type[_Kind], owner: str, argument: str) -> tuple[_Kind, ...]:
    """Return `values` as a tuple; raise ModelError unless all are instances of `kind`."""
    try:
        check_entries(values)
        items = tuple(values)
    except NOT_NUMBERS as error:
        message = f"{owner}: {argument} must be a list of {kind.__name__}, not {values!r}"
        raise ModelError(message, name=argument, value=values, limit=kind.__name__) from error
    for value in items:
        checked_instance(value, kind, owner, argument)
    return items


def checked_name(value: Any, owner: str, argument: str) -> str:
    """Return `value`; raise ModelError unless it is a non-empty string of printable characters.

    Terminals, tables and shells act on control characters, so names must not contain any.
    """
    if not isinstance(value, str) or not value:
        message = f"{owner}: {argument} must be a name, a string that is not empty, not {value!r}"
        raise ModelError(message, name=argument, value=value)
    limit = INPUT_LIMITS.name_characters
    if len(value) > limit or not value.isprintable():
        message = f"{owner}: {argument} must be at most {limit} printable characters, not {value[:limit]!r}"
        raise ModelError(message, name=argument, value=value, limit=limit)
    return value


def checked_text(value: Any, owner: str, argument: str) -> str:
    """Return `value`; raise ModelError unless it is a string."""
    return checked_instance(value, str, owner, argument)


def checked_flag(value: Any, owner: str, argument: str) -> bool:
    """Return `value` as a bool; raise ModelError unless it is True or False."""
    if not isinstance(value, bool | np.bool_):
        message = f"{owner}: {argument} must be True or False, not {value!r}"
        raise ModelError(message, name=argument, value=value, limit=(True, False))
    return bool(value)


def checked_mapping(values: Any, owner: str, argument: str) -> dict[str, Any]:
    """Return a copy of a dictionary with string keys; raise ModelError for anything else."""
    if not isinstance(values, Mapping) or not all(isinstance(name, str) for name in values):
        message = f"{owner}: {argument} must be a dictionary by name, not {values!r}"
        raise ModelError(message, name=argument, value=values)
    return dict(values)
