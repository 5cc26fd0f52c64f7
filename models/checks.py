"""Checks of arguments: numbers, arrays, names, flags and typed values.

`Checks(error)` holds the checks of a package, which raise its exception. `require` is that of `models`, and
`ocp.errors.require` that of `ocp`. Every check takes a label and the value, and returns the value in its checked form.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, fields
from difflib import get_close_matches
from math import inf, isinf, isnan
from numbers import Real
from typing import Any, Literal, TypeAlias, TypeVar
from warnings import warn

import numpy as np
from numpy.typing import NDArray

from models.errors import DetailedError, ModelError, ModelWarning
from models.files import INPUT_LIMITS

Array: TypeAlias = NDArray[np.float64]
ArrayInput: TypeAlias = Any
Entries: TypeAlias = Literal["finite", "numbers", "any"]
Sign: TypeAlias = Literal["any", "positive", "nonnegative"]

NOT_NUMBERS = (TypeError, ValueError, OverflowError, RuntimeError, NotImplementedError)
"""Exceptions that NumPy and CasADi raise for values that are not numeric."""
ROUNDING = 1e-9
"""Tolerance, relative or in m or rad, below which a difference is attributed to rounding errors."""
MAX_LISTED = 12
"""Largest number of vector entries, or of names, that an error message lists."""

_Choice = TypeVar("_Choice")
_Kind = TypeVar("_Kind")


def check_entries(value: Any) -> None:
    """Raise ValueError if an array or nested list has more entries than the limit `INPUT_LIMITS.array_entries`.

    The size is estimated before anything is copied; the first entry of a list stands for all its entries.
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


def floats(value: Any) -> Array:
    """Return numbers, an array or a nested list as a float array; raise one of `NOT_NUMBERS` for any other value.

    Values that NumPy would convert are refused too: text, True, None, symbols (which become nan) and complex numbers.
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


def real(value: Any) -> float:
    """Return a real number, or a zero-dimensional array, as a float; return nan for any other value."""
    value = value[()] if isinstance(value, np.ndarray) and value.ndim == 0 else value
    if isinstance(value, bool | np.bool_) or not isinstance(value, Real):
        return np.nan
    try:
        return float(value)
    except OverflowError:
        return np.nan


def freeze(array: Array) -> Array:
    """Make an array read-only and return it."""
    array.setflags(write=False)
    return array


def set_fields(instance: Any, **values: Any) -> None:
    """Set fields of an instance of a frozen dataclass while the instance is constructed."""
    vars(instance).update(values)


def argument_of(label: str) -> str:
    """Return the name of the argument at the end of an error label: `scheme` for the label `Collocation: scheme`."""
    return label.rpartition(" ")[2].strip("'")


@dataclass(frozen=True)
class Checks:
    """Checks of function arguments: each method returns the checked value or raises an exception of a given class.

    The first argument of each check, `label`, is the name of the argument, preceded by its owner if this helps: "count"
    or "box: size". Messages state the label, the requirement and the value. The exception has the fields `name`, the
    last word of the label, `value`, and `limit`, the permitted values.
    """

    error: type[DetailedError]  # class of the exceptions

    def invalid(self, label: str, requirement: str, value: Any, limit: Any = None) -> DetailedError:
        """Return the exception that reports an argument's label and value and the requirement that it violates."""
        value = value.item() if isinstance(value, np.generic) else value
        words = f"{label} must be {requirement}, not {value!r}"
        return self.error(words, name=argument_of(label), value=value, limit=limit)

    def unknown(self, kind: str, name: object, known: Iterable[str]) -> DetailedError:
        """Return the exception about an unknown name; its message suggests similar names or lists the known names."""
        names = [str(item) for item in known]
        by_case = {item.casefold(): item for item in reversed(names)}
        similar = [by_case[item] for item in similar_names(str(name).casefold(), by_case, 3)]
        listed = ", ".join(names[:MAX_LISTED]) or "none"
        listed += f" and {len(names) - MAX_LISTED} more" if len(names) > MAX_LISTED else ""
        hint = f"did you mean {' or '.join(map(repr, similar))}?" if similar else f"known: {listed}"
        words = f"{kind} {name!r} does not exist; {hint}"
        return self.error(words, name=str(name) or kind, value=name, limit=tuple(names))

    def number(self, label: str, value: Any, *, finite: bool = True, unit: str = "") -> float:
        """Return a value as a float after checking that it is a number and, if `finite`, that it is finite."""
        number = real(value)
        if isnan(number) or (finite and isinf(number)):
            raise self.invalid(label, ("a finite number" if finite else "a number") + _unit_text(unit), value)
        return number

    def positive(self, label: str, value: Any, *, below: float = inf, unit: str = "") -> float:
        """Return a value as a float after checking that it is a number above zero and less than `below`."""
        number = real(value)
        if not 0 < number < below:
            kind = "positive and finite" if below == inf else f"between 0 and {below:g}"
            raise self.invalid(label, kind + _unit_text(unit), value, 0.0 if below == inf else (0.0, below))
        return number

    def nonnegative(self, label: str, value: Any, *, unit: str = "") -> float:
        """Return a value as a float after checking that it is a finite number, zero or above."""
        number = real(value)
        if not 0 <= number < inf:
            raise self.invalid(label, "a finite number, zero or above" + _unit_text(unit), value, 0.0)
        return number

    def count(self, label: str, value: Any, least: int = 1, most: int = INPUT_LIMITS.count) -> int:
        """Return the value after checking that it is an integer from `least` to `most`."""
        if not isinstance(value, int | np.integer) or isinstance(value, bool) or not least <= value <= most:
            raise self.invalid(label, f"a whole number, {least} to {most}", value, (least, most))
        return int(value)

    def choice(self, label: str, value: _Choice, choices: Iterable[Any]) -> _Choice:
        """Return the value after checking that it equals one of the choices and has the type of that choice."""
        allowed = tuple(choices)
        if not any(isinstance(value, type(item)) and value == item for item in allowed):
            raise self.invalid(label, " or ".join(map(repr, allowed)), value, allowed)
        return value

    def flag(self, label: str, value: Any) -> bool:
        """Return the value after checking that it is True or False."""
        if not isinstance(value, bool | np.bool_):
            raise self.invalid(label, "True or False", value, (True, False))
        return bool(value)

    def text(self, label: str, value: Any) -> str:
        """Return the value after checking that it is a string; it may be empty."""
        if not isinstance(value, str):
            raise self.invalid(label, "a string", value, "str")
        return value

    def name(self, label: str, value: Any) -> str:
        """Return the value after checking that it is a non-empty string of printable characters."""
        limit = INPUT_LIMITS.name_characters
        if not isinstance(value, str) or not value:
            raise self.invalid(label, "a name, a string that is not empty", value)
        if len(value) > limit or not value.isprintable():
            raise self.invalid(label, f"at most {limit} printable characters", value[:limit], limit)
        return value

    def instance(self, label: str, value: Any, kind: type[_Kind]) -> _Kind:
        """Return the value after checking that it is an instance of a given class."""
        if not isinstance(value, kind):
            raise self.invalid(label, f"a {kind.__name__}", value, kind.__name__)
        return value

    def each(self, label: str, values: Any, kind: type[_Kind]) -> tuple[_Kind, ...]:
        """Return a list as a tuple after checking that all its entries are instances of a given class."""
        try:
            check_entries(values)
            items = tuple(values)
        except NOT_NUMBERS as error:
            raise self.invalid(label, f"a list of {kind.__name__}", values, kind.__name__) from error
        return tuple(self.instance(label, item, kind) for item in items)

    def call(self, label: str, function: Any, *arguments: Any) -> Any:
        """Return the value of a user's function; raise an error of the package that names the function if it fails.

        Errors of a package, and those of CasADi that are due to SX symbols, are passed on.
        """
        try:
            return function(*arguments)
        except (RuntimeError, DetailedError):
            raise
        except Exception as error:  # raised by the function itself
            raise self.error(f"{label}: the function fails: {error!r}", name=label, value=function) from error

    def mapping(self, label: str, values: Any, keys: type = str) -> dict[Any, Any]:
        """Return a copy of a dictionary after checking the class of its keys; return an empty dictionary for None."""
        if not isinstance(values, Mapping | None) or not all(isinstance(key, keys) for key in values or ()):
            raise self.invalid(label, "a dictionary by name", values)
        return dict(values or {})

    def array(
        self,
        label: str,
        value: ArrayInput,
        shape: tuple[int | str, ...] | None = None,
        *,
        entries: Entries = "finite",
        sign: Sign = "any",
        least: int = 1,
        unit: str = "",
        meaning: str = "",
    ) -> Array:
        """Return a value as a read-only array of floats after checking its shape and its entries.

        Args:
            value: Anything that NumPy reads as floats.
            shape: Expected shape; any if None. A string stands for a free dimension: ("points", 3). A shape with one
                free dimension also accepts a scalar, one of a vector also a column.
            entries: "finite" ones only; "numbers" may be infinite; "any" may be nan as well.
            sign: Sign of all entries.
            least: Least size of a free dimension.
            unit, meaning: Unit and meaning of the entries, for messages.
        """
        try:
            array = floats(value)
        except NOT_NUMBERS as error:
            raise self._wrong(label, f"{value!r} is not numeric", value) from error
        if shape is not None and array.shape != shape:
            array = self._check_shape(label, array, shape, least, meaning)
        if entries != "any" and not np.isfinite(array).all():
            wrong = ~np.isfinite(array) if entries == "finite" else np.isnan(array)
            if wrong.any():
                raise self._wrong(label, f"{_description(array, wrong)} is not finite", array)
        if sign != "any" and (wrong := array < 0 if sign == "nonnegative" else ~(array > 0)).any():
            words = f"{_description(array, wrong)} {unit}".rstrip()
            fault = "negative" if sign == "nonnegative" else "not positive"
            raise self._wrong(label, f"{words} is {fault}", array, 0.0)
        return freeze(array)

    def broadcast(
        self,
        label: str,
        value: ArrayInput,
        count: int,
        items: str,
        *,
        entries: Entries = "finite",
        sign: Sign = "any",
        unit: str = "",
    ) -> Array:
        """Return an array of `count` numbers from one number for each item or one number for all. Shape (count,).

        Args:
            items: Plural noun for messages.
            entries, sign, unit: As in `array`.
        """
        array = self.array(label, value, entries=entries, sign=sign, unit=unit)
        if array.ndim and array.shape != (count,):
            words = f"has shape {array.shape}; give one number or one for each of the {count} {items}"
            raise self._wrong(label, words, array, (count,))
        return freeze(np.array(np.broadcast_to(array, (count,))))

    def indices(self, label: str, value: Any, count: int) -> NDArray[np.intp]:
        """Return an array of indices after checking that each is an integer from 0 to `count` - 1."""
        try:
            check_entries(value)
            indices = np.asarray(value)
        except NOT_NUMBERS:  # rejected below
            indices = np.array(np.nan)
        if indices.dtype.kind not in "iu" or ((indices < 0) | (indices >= count)).any():
            raise self.invalid(label, f"whole numbers from 0, below {count}", value, (0, count))
        return indices.astype(np.intp)

    def rotation(self, label: str, value: ArrayInput) -> Array:
        """Return a matrix, (3, 3), after checking that it is a rotation matrix and removing its rounding errors."""
        matrix = self.array(label, value, (3, 3))
        error = float(np.abs(matrix @ matrix.T - np.eye(3)).max())
        (a, b, c), (d, e, f), (g, h, i) = matrix.tolist()  # np.linalg.det would double the cost
        if error > 1e-6 or a * (e * i - f * h) + b * (f * g - d * i) + c * (d * h - e * g) < 0:
            raise self._wrong(label, f"{matrix.tolist()} is not a rotation matrix (orthonormal, determinant 1)", matrix)
        if error > 1e-12:
            left, _, right = np.linalg.svd(matrix)
            matrix = freeze(left @ right)
        return matrix

    def _wrong(self, label: str, words: str, value: Any, limit: Any = None) -> DetailedError:
        return self.error(f"{label} {words}", name=argument_of(label), value=value, limit=limit)

    def _check_shape(self, label: str, array: Array, shape: tuple[int | str, ...], least: int, meaning: str) -> Array:
        """Return the array after checking its shape; a string in `shape` stands for a dimension of any size."""
        if len(shape) == 1 and ((array.ndim == 0 and isinstance(shape[0], str)) or array.shape[1:] == (1,)):
            array = array.reshape(-1)
        fits = array.ndim == len(shape) and all(
            size >= least if isinstance(expected, str) else size == expected
            for size, expected in zip(array.shape, shape, strict=True)
        )
        if fits:
            return array
        hint = f", {least} at least" if any(isinstance(expected, str) for expected in shape) else ""
        hint += f": {meaning}" if meaning else ""
        words = f"has shape {array.shape}, expected {str(shape).replace(chr(39), '')}{hint}"
        raise self._wrong(label, words, array, shape)


require = Checks(ModelError)


def _unit_text(unit: str) -> str:
    return f" (in {unit})" if unit else ""


def _description(array: Array, wrong: Any) -> str:
    """Return the text that an error message shows for an array: all entries, or the first invalid entry or row."""
    if array.ndim < 2 and array.size <= MAX_LISTED:
        return f"{array.tolist()}"
    if array.ndim == 1:
        entry = int(np.flatnonzero(wrong)[0])
        return f"(entry {entry}) {array[entry].item()}"
    row = int(np.flatnonzero(wrong.reshape(len(array), -1).any(axis=1))[0])
    return f"(row {row}) {array[row].tolist()}"


def warn_of_degrees(label: str, angles: ArrayInput, name: str | None = None) -> None:
    """Warn with ModelWarning if an angle (rad) exceeds two turns; an angle above 1e4 means "no limit" and is accepted.

    `label` is as in `Checks`; `name` is the attribute of the warning, by default the last word of the label.
    """
    words = "rad is more than two turns; angles are in rad, is it in degrees?"
    _warn_of_unit(label, angles, name, (4 * np.pi, 1e4), words)


def warn_of_millimetres(label: str, lengths: ArrayInput, name: str | None = None) -> None:
    """Warn if a length (m) exceeds 50 m, since it may be in millimetres; `warn_of_degrees` explains the arguments."""
    _warn_of_unit(label, lengths, name, (50.0, inf), "m is long for a robot; lengths are in m, is it in millimetres?")


def _warn_of_unit(label: str, values: ArrayInput, name: str | None, range_: tuple[float, float], words: str) -> None:
    """Warn about the first value whose magnitude lies in a range that suggests another unit, such as degrees."""
    low, high = range_
    for value in np.ravel(values).tolist():  # faster than array operations on few entries
        if low < abs(value) < high:
            name = argument_of(label) if name is None else name
            warn(ModelWarning(f"{label} {value:g} {words}", name=name, value=value, limit=low), stacklevel=2)
            return


def similar_names(name: str, known: Iterable[str], most: int = 2) -> list[str]:
    """Return known names that abbreviate or extend a given name or, if there are none, names of similar spelling."""
    names = list(dict.fromkeys(known))
    related = [each for each in names if min(len(each), len(name)) > 2 and each[: len(name)] == name[: len(each)]]
    return related[:most] or get_close_matches(name, names, most, 0.5)


def short_repr(instance: Any) -> str:
    """Return a dataclass or named tuple as text, with long values replaced by their sizes and defaults omitted."""
    if isinstance(instance, tuple):
        shown = dict.fromkeys(instance._fields)  # type: ignore[attr-defined]
    else:
        shown = {each.name: each.default for each in fields(instance) if each.repr}
    parts = []
    for name, default in shown.items():
        value = getattr(instance, name)
        is_default = value is default or (isinstance(value, str | int | float) and value == default)
        if value is not None and not is_default:
            parts.append(f"{name}={_short_text(value)}")
    return f"{type(instance).__name__}({', '.join(parts)})"


def _short_text(value: Any) -> str:
    if isinstance(value, np.ndarray):
        if value.size > SHORT_ARRAY:
            return f"<array of shape {value.shape}>"
        return " ".join(np.array2string(value, separator=", ", threshold=SHORT_ARRAY).split())
    text = " ".join(repr(value).split())
    if len(text) <= SHORT_TEXT:
        return text
    if isinstance(value, list | tuple | dict):
        return f"<{type(value).__name__} of {len(value)}>"
    return f"<{getattr(value, '__name__', type(value).__name__)}>"


SHORT_ARRAY, SHORT_TEXT = 16, 60
"""Number of entries of an array, and of characters of another value, up to which `short_repr` shows them."""
