"""Exceptions of the package, and the checks of arguments that raise them.

Each message names the offending thing, its value and what to do; the exception carries the same as fields.
"""

from __future__ import annotations

import pickle
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from difflib import get_close_matches
from typing import Any, TypeVar

import numpy as np

from models.arrays import NOT_NUMBERS, check_entries, floats
from models.input_files import INPUT_LIMITS

__all__ = [
    "MAX_COUNT",
    "NOT_NUMBERS",
    "AuditError",
    "BoundWarning",
    "DetailedError",
    "Interrupted",
    "ProblemError",
    "RefinementWarning",
    "SolveError",
    "StorageWarning",
    "check_entries",
    "checked_choice",
    "checked_count",
    "checked_each",
    "checked_flag",
    "checked_instance",
    "checked_mapping",
    "checked_nonnegative",
    "checked_positive",
    "checked_text",
    "checked_time_limit",
    "error_names",
    "floats",
    "format_distinct",
    "real",
    "sample_times",
    "unknown_name",
]

MAX_COUNT = 1_000_000
"""Of what is counted: more than these take longer than anybody waits."""
_Kind = TypeVar("_Kind")


class DetailedError(Exception):
    """An exception that carries what its message says; it is pickled with all of it.

    Attributes:
        name: Of the offending state, control, constraint, parameter, option or argument, where it is one.
        value: What was found. limit: What it may be. time: When, s, or where along a path, m. Each None where the
            message says none.
    """

    def __init__(
        self, message: str = "", *, name: str | None = None, value: Any = None, limit: Any = None, time: Any = None
    ) -> None:
        super().__init__(message)
        self.name, self.value, self.limit, self.time = name, value, limit, time

    def __reduce__(self) -> Any:
        """Pickled with all that it carries; of what cannot be pickled, such as an expression, with how it is shown."""
        return type(self), self.args, {key: _pickled(value) for key, value in self.__dict__.items()}


class ProblemError(DetailedError, ValueError):
    """A problem, a method or an argument that cannot be right, found before anything is solved."""


class SolveError(DetailedError, RuntimeError):
    """A solve that ended without an optimum.

    Attributes:
        solution: The last iterate as an unsuccessful solution, or None where there is none.
        conflicts: The constraints that have to give way (:class:`ocp.direct.diagnosis.Conflict`), the worst first.
    """

    def __init__(self, message: str = "", solution: Any = None, conflicts: Sequence[Any] = (), **details: Any) -> None:
        super().__init__(message, **details)
        self.solution, self.conflicts = solution, tuple(conflicts)


class Interrupted(KeyboardInterrupt):
    """Ctrl-C, where something had been found before.

    Attributes:
        solution: The last iterate as an unsuccessful solution.
    """

    def __init__(self, message: str = "", solution: Any = None) -> None:
        super().__init__(message)
        self.solution = solution


class AuditError(DetailedError, RuntimeError):
    """An audit that cannot be made, for example of a loaded solution without its problem."""


class RefinementWarning(DetailedError, UserWarning):
    """A refinement that stopped where the audit does not pass; ``value`` is the share of its limit that a row is at."""


class StorageWarning(DetailedError, UserWarning):
    """A part that a file cannot hold as data, such as a problem that calls a function of Python's."""


class BoundWarning(DetailedError, UserWarning):
    """A motion that costs less, ``value``, than the lower bound of all, ``limit``: a fault of this package."""


@contextmanager
def error_names(name: str) -> Iterator[None]:
    """What is raised inside, and names nothing itself, is about ``name``."""
    try:
        yield
    except DetailedError as error:
        error.name = name if error.name is None else error.name
        raise


def unknown_name(kind: str, name: object, known: Iterable[str]) -> ProblemError:
    """Error for a name that nothing bears, listing the near ones (or all, if none is near)."""
    names = [str(item) for item in known]
    near = get_close_matches(str(name), names, n=3)
    hint = f"did you mean {', '.join(near)}?" if near else f"known: {', '.join(names) or 'none'}"
    return ProblemError(f"unknown {kind} {name!r}; {hint}", name=str(name) or kind, limit=tuple(names))


def real(value: Any) -> float:
    """A single real number, nan where it is none."""
    if isinstance(value, bool | np.bool_) or not isinstance(value, int | float | np.integer | np.floating):
        return np.nan
    try:
        return float(value)
    except OverflowError:
        return np.nan


def checked_choice(what: str, value: Any, choices: Sequence[str]) -> str:
    """``value``, or ProblemError where it is none of the words ``choices``; ``what`` ends with the argument's name."""
    if not isinstance(value, str) or value not in choices:
        words = " or ".join(repr(choice) for choice in choices)
        raise ProblemError(
            f"{what} must be {words}, not {value!r}", name=_last(what), value=value, limit=tuple(choices)
        )
    return value


def checked_count(what: str, value: Any, least: int = 1, most: int | None = None) -> int:
    """``value`` as a plain integer, or ProblemError unless it is a whole number from ``least`` to ``most``."""
    whole = isinstance(value, int | np.integer) and not isinstance(value, bool)
    if not whole or value < least or value > (MAX_COUNT if most is None else most):
        kind = "a positive integer" if least == 1 else f"a whole number, at least {least}"
        kind = kind if most is None else f"{least} to {most}"
        raise ProblemError(f"{what} must be {kind}, not {value!r}", name=_last(what), value=value, limit=(least, most))
    return int(value)


def checked_nonnegative(what: str, value: Any) -> float:
    """``value``, or ProblemError unless it is a finite number, zero or above."""
    if not 0 <= real(value) < np.inf:
        words = f"{what} must be a finite number, zero or above, not {value!r}"
        raise ProblemError(words, name=_last(what), value=value, limit=0.0)
    kept: float = value  # a whole number stays one
    return kept


def checked_positive(what: str, value: Any, below: float = np.inf) -> float:
    """``value``, or ProblemError unless it is a number between 0 and ``below``, both excluded."""
    if not 0 < real(value) < below:
        kind = "positive and finite" if below == np.inf else f"between 0 and {below:g}"
        raise ProblemError(f"{what} must be {kind}, not {value!r}", name=_last(what), value=value, limit=below)
    kept: float = value
    return kept


def format_distinct(*numbers: float) -> list[str]:
    """Numbers for a message, in six digits, or in as many more as tell those apart that differ."""
    told = [[f"{number:.{digits}g}" for number in numbers] for digits in range(6, 18)]
    return next((each for each in told if len({*each}) == len({repr(number) for number in numbers})), told[-1])


def sample_times(what: str, period: Any, duration: float) -> np.ndarray:
    """Every `period` from 0 on, and the end of the duration, which comes as early as that says; s.

    Raises:
        ProblemError: A period that is not positive, or so short that there were more than `INPUT_LIMITS.array_entries`.
    """
    step = checked_positive(what, period)
    count = np.ceil(duration / step * (1 - 1e-12))  # but for rounding
    most = INPUT_LIMITS.array_entries
    if not count < most:
        words = f"{what} {step:g} s asks for {count:g} samples of {duration:g} s, more than {most}"
        raise ProblemError(words, name=_last(what), value=period, limit=duration / most)
    return np.append(np.arange(int(count)) * step, duration)


def checked_text(what: str, value: Any) -> str:
    """``value``, or ProblemError unless it is a string; an empty one will do."""
    if not isinstance(value, str):
        raise ProblemError(f"{what} must be a string, not {value!r}", name=_last(what), value=value)
    return value


def checked_flag(what: str, value: Any) -> bool:
    """``value`` as a bool, or ProblemError unless it is True or False."""
    if not isinstance(value, bool | np.bool_):
        raise ProblemError(f"{what} must be True or False, not {value!r}", name=_last(what), value=value)
    return bool(value)


def checked_instance(what: str, value: Any, kind: type[_Kind]) -> _Kind:
    """``value``, or ProblemError unless it is a ``kind``."""
    if not isinstance(value, kind):
        words = f"{what} must be a {kind.__name__}, not {value!r}"
        raise ProblemError(words, name=_last(what), value=value, limit=kind.__name__)
    return value


def checked_each(what: str, values: Any, kind: type[_Kind]) -> tuple[_Kind, ...]:
    """``values`` as a tuple, or ProblemError unless they are several (or none) of a ``kind``."""
    try:
        check_entries(values)
        each = tuple(values)
    except NOT_NUMBERS as error:
        words = f"{what} must be a list of {kind.__name__}, not {values!r}"
        raise ProblemError(words, name=_last(what), value=values, limit=kind.__name__) from error
    for value in each:
        checked_instance(what, value, kind)
    return each


def checked_time_limit(seconds: Any) -> float | None:
    """A time limit, or ProblemError unless it is a positive number of seconds, or None for no limit."""
    return None if seconds is None else checked_positive("time_limit", seconds)


def checked_mapping(what: str, values: Any) -> dict[str, Any]:
    """A dictionary by name, or nothing, as a dictionary of its own; ProblemError for anything else."""
    if not isinstance(values, Mapping | None):
        raise ProblemError(f"{what} must be a dictionary by name, not {values!r}", name=_last(what), value=values)
    return dict(values or {})


def _last(what: str) -> str:
    """The name of an argument at the end of ``Collocation: scheme``."""
    return what.rpartition(" ")[2].strip("'")


def _pickled(value: Any) -> Any:
    try:
        pickle.dumps(value)
    except Exception:  # of any kind
        return repr(value)
    return value
