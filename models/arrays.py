"""What users give, read and checked: arrays, numbers, names, flags, parts of a machine. Arrays are frozen.

Real numbers that users give, read as arrays of floats and counted before they are copied.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from math import isfinite, isnan
from numbers import Real
from typing import Any, TypeAlias, TypeVar
from warnings import warn

import numpy as np
from numpy.typing import NDArray

from models.errors import ModelError, ModelWarning
from models.input_files import INPUT_LIMITS

__all__ = ["NOT_NUMBERS", "check_entries", "floats"]

NOT_NUMBERS = (TypeError, ValueError, OverflowError, RuntimeError, NotImplementedError)
"""What numpy and casadi raise of values that are no numbers."""


def check_entries(value: Any) -> None:
    """Raise ValueError of more than `INPUT_LIMITS.array_entries`: a view or a range may be larger than all memory.

    Nothing is copied or gone through: the first entry of a list stands for all.
    """
    most, entries, part = INPUT_LIMITS.array_entries, 1, value
    for _ in range(INPUT_LIMITS.nesting):  # as many dimensions as numpy's arrays have at most
        if isinstance(part, np.ndarray):
            entries *= part.size
        if not isinstance(part, Sequence) or isinstance(part, str | bytes):
            break
        entries *= len(part)
        if not 0 < entries <= most:
            break
        part = part[0]
    if entries > most:
        raise ValueError(f"{entries} entries, at most {most} are read")


def floats(value: Any) -> NDArray[np.float64]:
    """Return a value as a new array of floats; raise one of NOT_NUMBERS where it is none.

    That is also where there are too many entries, which are not copied, and where numpy would read a number all the
    same: in a text, in True, in None and in a symbol (nan), in the real part of a complex number.
    """
    check_entries(value)
    plain = np.asarray(value)
    if plain.dtype.kind == "O":
        fits = all(isinstance(entry, Real) and not isinstance(entry, bool | np.bool_) for entry in plain.flat)
    else:
        fits = plain.dtype.kind in "iuf"
    if not fits:
        raise TypeError(f"{plain.dtype} is no real number")
    return np.array(plain, dtype=float)


Array: TypeAlias = NDArray[np.float64]

ArrayInput: TypeAlias = Any

ROUNDING = 1e-9
"""Share of the largest of its kind, or m or rad, below which a difference is rounding, after many operations."""
MAX_LISTED = 12
"""Entries of a vector, or names, that a message lists."""

_Choice = TypeVar("_Choice")
_Kind = TypeVar("_Kind")


def frozen(array: Array) -> Array:
    """The array itself, read-only from now on."""
    array.setflags(write=False)
    return array


def checked_array(
    value: ArrayInput,
    shape: tuple[int | str, ...],
    owner: str,
    what: str,
    *,
    finite: bool = True,
    nan: bool = False,
    positive: bool = False,
    least: int = 1,
    unit: str = "",
) -> Array:
    """Read-only copy of `value` as floats.

    Args:
        value: Anything that numpy reads as floats.
        shape: A name in it stands for a free dimension of at least `least`: ("points", 3). For a shape of one free
            dimension a bare number will do as a list of one.
        owner, what: The thing and its argument, for messages.
        finite: Whether inf is refused.
        nan: Whether nan is allowed.
        positive: Whether all entries must be above zero.
        unit: For messages.

    Raises:
        ModelError: Something that is not numeric, a wrong shape, nan, inf, an entry that is not positive. The error's
            `name` is `what`.
    """
    array = _read(value, owner, what)
    if array.shape != shape:
        array = _shaped(array, shape, owner, what, least)
    if not np.isfinite(array).all():
        wrong = (np.isnan(array) & (not nan)) | (np.isinf(array) & finite)
        if wrong.any():
            raise ModelError(f"{owner}: {_shown(array, wrong, what)} is not finite", name=what, value=array)
    if positive and not (array > 0).all():
        shown = f"{_shown(array, ~(array > 0), what)} {unit}".rstrip()
        raise ModelError(f"{owner}: {shown} is not positive", name=what, value=array, limit=0.0)
    return frozen(array)


def _read(value: ArrayInput, owner: str, what: str) -> Array:
    try:
        return floats(value)
    except NOT_NUMBERS as error:
        raise ModelError(f"{owner}: {what} {value!r} is not numeric", name=what, value=value) from error


def _shaped(array: Array, shape: tuple[int | str, ...], owner: str, what: str, least: int) -> Array:
    """The array itself, or a bare number as a list of one, where it fits a shape that names free dimensions."""
    if array.ndim == 0 and len(shape) == 1 and isinstance(shape[0], str):
        array = array.reshape(1)
    fits = array.ndim == len(shape) and all(
        size >= least if isinstance(wanted, str) else size == wanted
        for size, wanted in zip(array.shape, shape, strict=True)
    )
    if not fits:
        expected = str(shape).replace("'", "")
        hint = f", {least} at least" if any(isinstance(wanted, str) for wanted in shape) else ""
        message = f"{owner}: {what} has shape {array.shape}, expected {expected}{hint}"
        raise ModelError(message, name=what, value=array, limit=shape)
    return array


def _shown(array: Array, wrong: Any, what: str) -> str:
    """Name and values; of a table only the first row that is wrong, of a long vector the first entry."""
    if array.ndim < 2 and array.size <= MAX_LISTED:
        return f"{what} {array.tolist()}"
    if array.ndim == 1:
        entry = int(np.flatnonzero(wrong)[0])
        return f"{what} (entry {entry}) {array[entry].item()}"
    row = int(np.flatnonzero(wrong.reshape(len(array), -1).any(axis=1))[0])
    return f"{what} (row {row}) {array[row].tolist()}"


def checked_numbers(value: ArrayInput, owner: str, what: str) -> Array:
    """`value` as an array of floats of its own shape, all finite; errors as of checked_array."""
    array = _read(value, owner, what)
    return checked_array(array, array.shape, owner, what)


def checked_number(
    value: ArrayInput, owner: str, what: str, *, finite: bool = True, positive: bool = False, unit: str = ""
) -> float:
    """`value` as a float; arguments and errors as of checked_array."""
    if isinstance(value, float) and (isfinite(value) or not (finite or isnan(value))) and (value > 0 or not positive):
        return float(value)  # nothing to say, and no array needed: a robot has hundreds of numbers
    return float(checked_array(value, (), owner, what, finite=finite, positive=positive, unit=unit))


def checked_nonnegative(value: ArrayInput, owner: str, what: str, unit: str = "") -> float:
    """`value` as a float; ModelError naming `owner` and `what` unless it is a finite number, zero or above."""
    number = checked_number(value, owner, what)
    if number < 0:
        message = f"{owner}: {what} {number} {unit}".rstrip()
        raise ModelError(f"{message} is negative", name=what, value=number, limit=0.0)
    return number


def checked_count(value: Any, owner: str, what: str, least: int = 1, most: int = INPUT_LIMITS.count) -> int:
    """`value` as an int; ModelError naming `owner` and `what` unless it is a whole number from `least` to `most`."""
    if not isinstance(value, int | np.integer) or isinstance(value, bool) or not least <= value <= most:
        message = f"{owner}: {what} must be a whole number, {least} to {most}, not {value!r}"
        raise ModelError(message, name=what, value=value, limit=(least, most))
    return int(value)


def checked_indices(value: Any, count: int, owner: str, what: str) -> NDArray[np.intp]:
    """`value` as an array of indices; ModelError naming `owner` and `what` unless they are whole, from 0 to `count`."""
    try:
        check_entries(value)
        found = np.asarray(value)
    except NOT_NUMBERS:  # refused below
        found = np.array(np.nan)
    if found.dtype.kind not in "iu" or ((found < 0) | (found >= count)).any():
        message = f"{owner}: {what} must be whole numbers from 0, below {count}, not {value!r}"
        raise ModelError(message, name=what, value=value, limit=(0, count))
    return found.astype(np.intp)


def checked_broadcast(
    value: ArrayInput, count: int, owner: str, what: str, items: str, *, finite: bool = True, **checks: Any
) -> Array:
    """`value`, one number for all `items` or one for each of the `count`, as one for each. Shape (count,).

    Further arguments and errors as of checked_array.
    """
    array = _read(value, owner, what)
    if array.ndim and array.shape != (count,):
        message = f"{owner}: {what} has shape {array.shape}; give one number, or one for each of the {count} {items}"
        raise ModelError(message, name=what, value=array, limit=(count,))
    known = checked_array(array, array.shape, owner, what, finite=finite, **checks)
    return frozen(np.array(np.broadcast_to(known, (count,))))


def warn_of_degrees(angles: ArrayInput, owner: str, name: str, what: str) -> None:
    """Warn where an angle, rad, is that large that it looks like degrees: beyond two turns, but no stand-in for none.

    Python says the same words once only.

    Warns:
        ModelWarning: With `name`, of a joint or argument, and the angle.
    """
    limit = 4 * np.pi
    odd = _first_between(angles, limit, 1e4)  # beyond, it is written for no limit at all
    if odd is not None:
        message = f"{owner}: {what} {odd:g} rad is more than two turns; angles are in rad, is it in degrees?"
        warn(ModelWarning(message, name=name, value=odd, limit=limit), stacklevel=1)


def warn_of_millimetres(lengths: ArrayInput, owner: str, name: str, what: str) -> None:
    """Warn where a length, m, is that large that it looks like millimetres; as warn_of_degrees."""
    limit = 50.0  # m: no part of an arm is longer
    odd = _first_between(lengths, limit, np.inf)
    if odd is not None:
        message = f"{owner}: {what} {odd:g} m is long for a robot; lengths are in m, is it in millimetres?"
        warn(ModelWarning(message, name=name, value=odd, limit=limit), stacklevel=1)


def _first_between(values: ArrayInput, low: float, high: float) -> float | None:
    """The first entry whose size is between the two, where there is one."""
    entries = np.ravel(values).tolist()  # a robot has hundreds of few entries, where numpy is slower
    return next((entry for entry in entries if low < abs(entry) < high), None)


def checked_rotation(value: ArrayInput, owner: str, what: str) -> Array:
    """Read-only copy of a rotation matrix; ModelError naming `owner` and `what` when it is none."""
    matrix = checked_array(value, (3, 3), owner, what)
    error = float(np.abs(matrix @ matrix.T - np.eye(3)).max())
    (a, b, c), (d, e, f), (g, h, i) = matrix.tolist()  # numpy's determinant costs as much as all the rest
    if error > 1e-6 or a * (e * i - f * h) + b * (f * g - d * i) + c * (d * h - e * g) < 0:
        message = f"{owner}: {what} {matrix.tolist()} is not a rotation matrix (orthonormal, determinant 1)"
        raise ModelError(message, name=what, value=matrix)
    if error > 1e-12:  # printed to few digits: take the nearest rotation
        left, _, right = np.linalg.svd(matrix)
        matrix = frozen(left @ right)
    return matrix


def checked_choice(value: _Choice, choices: Iterable[Any], owner: str, what: str) -> _Choice:
    """`value` itself; ModelError naming `owner`, `what` and the choices when it is none of them."""
    known = tuple(choices)
    if not any(isinstance(value, type(choice)) and value == choice for choice in known):
        message = f"{owner}: {what} {value!r} is unknown; use one of {list(known)}"
        raise ModelError(message, name=what, value=value, limit=known)
    return value


def checked_instance(value: Any, kind: type[_Kind], owner: str, what: str) -> _Kind:
    """`value` itself; ModelError naming `owner` and `what` unless it is a `kind`."""
    if not isinstance(value, kind):
        message = f"{owner}: {what} must be a {kind.__name__}, not {value!r}"
        raise ModelError(message, name=what, value=value, limit=kind.__name__)
    return value


def checked_each(values: Any, kind: type[_Kind], owner: str, what: str) -> tuple[_Kind, ...]:
    """`values` as a tuple; ModelError naming `owner` and `what` unless they are several (or none) of a `kind`."""
    try:
        check_entries(values)
        each = tuple(values)
    except NOT_NUMBERS as error:
        message = f"{owner}: {what} must be a list of {kind.__name__}, not {values!r}"
        raise ModelError(message, name=what, value=values, limit=kind.__name__) from error
    for value in each:
        checked_instance(value, kind, owner, what)
    return each


def checked_name(value: Any, owner: str, what: str) -> str:
    """`value` itself; ModelError naming `owner` and `what` unless it is a string that is not empty.

    Nor may it hold control characters and others that are not printed, which terminals, tables and shells act on.
    """
    if not isinstance(value, str) or not value:
        message = f"{owner}: {what} must be a name, a string that is not empty, not {value!r}"
        raise ModelError(message, name=what, value=value)
    most = INPUT_LIMITS.name_characters
    if len(value) > most or not value.isprintable():
        message = f"{owner}: {what} must be at most {most} printable characters, not {value[:most]!r}"
        raise ModelError(message, name=what, value=value, limit=most)
    return value


def checked_text(value: Any, owner: str, what: str) -> str:
    """`value` itself; ModelError naming `owner` and `what` unless it is a string."""
    return checked_instance(value, str, owner, what)


def checked_flag(value: Any, owner: str, what: str) -> bool:
    """`value` as a bool; ModelError naming `owner` and `what` unless it is True or False."""
    if not isinstance(value, bool | np.bool_):
        message = f"{owner}: {what} must be True or False, not {value!r}"
        raise ModelError(message, name=what, value=value, limit=(True, False))
    return bool(value)


def checked_mapping(values: Any, owner: str, what: str) -> dict[str, Any]:
    """A dictionary by name as one of its own; ModelError naming `owner` and `what` for anything else."""
    if not isinstance(values, Mapping) or not all(isinstance(name, str) for name in values):
        message = f"{owner}: {what} must be a dictionary by name, not {values!r}"
        raise ModelError(message, name=what, value=values)
    return dict(values)
