"""Exceptions of the package, the checks of arguments that raise them, and the status of a solve.

Each message names the faulty argument or constraint, its value and the remedy. The exception holds the same data as
fields.
"""

from __future__ import annotations

import pickle
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from difflib import get_close_matches
from enum import Enum
from typing import Any, TypeVar

import numpy as np

from models.arrays import NOT_NUMBERS, check_entries, floats
from models.files import INPUT_LIMITS

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
    "SolverStatus",
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
"""Largest accepted count: more items take longer than anybody waits."""
_Kind = TypeVar("_Kind")


class DetailedError(Exception):
    """An exception that carries the data of its message as fields, also through pickling.

    Attributes:
        name: Name of the faulty state, control, constraint, parameter, option or argument; None if there is none.
        value: The value at fault. limit: The value allowed. time: When, s, or where along a path, m. Each is None if
            the message states none.
    """

    def __init__(
        self, message: str = "", *, name: str | None = None, value: Any = None, limit: Any = None, time: Any = None
    ) -> None:
        super().__init__(message)
        self.name, self.value, self.limit, self.time = name, value, limit, time

    def __reduce__(self) -> Any:
        """Pickle all fields; a field that cannot be pickled, such as an expression, is replaced by its `repr`."""
        return type(self), self.args, {key: _pickled(value) for key, value in self.__dict__.items()}


class ProblemError(DetailedError, ValueError):
    """An invalid problem, method or argument, detected before anything is solved."""


class SolveError(DetailedError, RuntimeError):
    """A solve that ended without an optimum.

    Attributes:
        solution: The last iterate as an unsuccessful solution, or None.
        conflicts: The constraints that would have to be relaxed (:class:`ocp.direct.diagnosis.Conflict`), the worst
            first.
    """

    def __init__(self, message: str = "", solution: Any = None, conflicts: Sequence[Any] = (), **details: Any) -> None:
        super().__init__(message, **details)
        self.solution, self.conflicts = solution, tuple(conflicts)


class Interrupted(KeyboardInterrupt):
    """Ctrl-C during a solve that already has an iterate.

    Attributes:
        solution: The last iterate as an unsuccessful solution.
    """

    def __init__(self, message: str = "", solution: Any = None) -> None:
        super().__init__(message)
        self.solution = solution


class AuditError(DetailedError, RuntimeError):
    """An audit that is impossible, for example of a loaded solution without its problem."""


class RefinementWarning(DetailedError, UserWarning):
    """A refinement that stopped before the audit passed; ``value`` is the worst row's value divided by its limit."""


class StorageWarning(DetailedError, UserWarning):
    """A part that cannot be saved as data, such as a problem that calls a Python function."""


class BoundWarning(DetailedError, UserWarning):
    """A motion whose cost, ``value``, is below the proven lower bound, ``limit``: a bug of this package."""


class SolverStatus(Enum):
    """The end of a solve. The value is IPOPT's word if IPOPT has one; files store it."""

    SOLVED = "Solve_Succeeded"
    ACCEPTABLE = "Solved_To_Acceptable_Level"
    INFEASIBLE = "Infeasible_Problem_Detected"
    ITERATION_LIMIT = "Maximum_Iterations_Exceeded"
    TIME_LIMIT = "Maximum_WallTime_Exceeded"
    INTERRUPTED = "User_Requested_Stop"
    RESTORATION_FAILED = "Restoration_Failed"
    DIVERGING = "Diverging_Iterates"
    NOT_FINITE = "Invalid_Number_Detected"
    SMALL_STEP = "Search_Direction_Becomes_Too_Small"
    TOO_FEW_VARIABLES = "Not_Enough_Degrees_Of_Freedom"
    STEP_FAILED = "Error_In_Step_Computation"
    REJECTED = "Rejected"
    """The solver found a point that a later check rejected; the message gives the reason."""
    FAILED = "Failed"
    """Any other end; the message holds the solver's own word."""

    @classmethod
    def of_word(cls, word: str) -> SolverStatus:
        """Return the status whose value is a solver's word, FAILED for any other word."""
        return cls(word) if word in cls._value2member_map_ else cls.FAILED

    @property
    def is_success(self) -> bool:
        """Return whether the solver reports an optimum."""
        return self in (SolverStatus.SOLVED, SolverStatus.ACCEPTABLE)

    @property
    def message(self) -> str:
        """Return the value with advice on what to try next; "" for a success."""
        if self.is_success:
            return ""
        return f"{self.value}: {ADVICE[self]}" if self in ADVICE else self.value

    def __str__(self) -> str:
        """Return the value."""
        return self.value


ADVICE = {
    SolverStatus.INFEASIBLE: "no point near the guess meets all constraints; relax the ones named below, "
    "lengthen the horizon or start from another guess",
    SolverStatus.ITERATION_LIMIT: "raise options={'max_iter': ...}, or start from a better guess",
    SolverStatus.TIME_LIMIT: "raise time_limit, or start from a better guess",
    SolverStatus.INTERRUPTED: "interrupted",
    SolverStatus.RESTORATION_FAILED: "start from a better guess, or scale states and constraints nearer to 1",
    SolverStatus.DIVERGING: "the cost may be unbounded below; bound the controls or add a term to the cost",
    SolverStatus.NOT_FINITE: "a function is not finite at an iterate; keep the states away from where it is singular",
    SolverStatus.SMALL_STEP: "the problem may be badly scaled or its constraints redundant",
    SolverStatus.TOO_FEW_VARIABLES: "there are more equations than unknowns; drop redundant constraints",
    SolverStatus.STEP_FAILED: "constraints may be redundant or a function not smooth",
}


@contextmanager
def error_names(name: str) -> Iterator[None]:
    """Set the name of every exception raised inside that has no name yet."""
    try:
        yield
    except DetailedError as error:
        error.name = name if error.name is None else error.name
        raise


def unknown_name(kind: str, name: object, known: Iterable[str]) -> ProblemError:
    """Return the error for an unknown name, with the most similar known names, or all names if none is similar."""
    names = [str(item) for item in known]
    similar = get_close_matches(str(name), names, n=3)
    hint = f"did you mean {', '.join(similar)}?" if similar else f"known: {', '.join(names) or 'none'}"
    return ProblemError(f"unknown {kind} {name!r}; {hint}", name=str(name) or kind, limit=tuple(names))


def real(value: Any) -> float:
    """Return a real number as a float, nan if the value is not a real number."""
    if isinstance(value, bool | np.bool_) or not isinstance(value, int | float | np.integer | np.floating):
        return np.nan
    try:
        return float(value)
    except OverflowError:
        return np.nan


def checked_choice(what: str, value: Any, choices: Sequence[str]) -> str:
    """Return ``value``, or raise ProblemError unless it is one of ``choices``. ``what`` ends with the argument."""
    if not isinstance(value, str) or value not in choices:
        raise _invalid(what, " or ".join(repr(choice) for choice in choices), value, tuple(choices))
    return value


def checked_count(what: str, value: Any, least: int = 1, most: int | None = None) -> int:
    """Return ``value`` as an int, or raise ProblemError unless it is an integer from ``least`` to ``most``."""
    whole = isinstance(value, int | np.integer) and not isinstance(value, bool)
    if not whole or value < least or value > (MAX_COUNT if most is None else most):
        kind = "a positive integer" if least == 1 else f"a whole number, at least {least}"
        kind = kind if most is None else f"{least} to {most}"
        raise _invalid(what, kind, value, (least, most))
    return int(value)


def checked_nonnegative(what: str, value: Any) -> float:
    """Return ``value``, or raise ProblemError unless it is a finite number, zero or above."""
    if not 0 <= real(value) < np.inf:
        raise _invalid(what, "a finite number, zero or above", value, 0.0)
    number: float = value  # an integer stays an integer
    return number


def checked_positive(what: str, value: Any, below: float = np.inf) -> float:
    """Return ``value``, or raise ProblemError unless 0 < ``value`` < ``below``."""
    if not 0 < real(value) < below:
        kind = "positive and finite" if below == np.inf else f"between 0 and {below:g}"
        raise _invalid(what, kind, value, below)
    number: float = value
    return number


def format_distinct(*numbers: float) -> list[str]:
    """Format numbers with six digits, or with as many more as it takes to distinguish unequal numbers."""
    candidates = [[f"{number:.{digits}g}" for number in numbers] for digits in range(6, 18)]
    different = len({repr(number) for number in numbers})
    return next((texts for texts in candidates if len({*texts}) == different), candidates[-1])


def sample_times(what: str, period: Any, duration: float) -> np.ndarray:
    """Return the times 0, period, 2 period, ... before the end of the duration, and the end itself, s.

    Raises:
        ProblemError: The period is not positive, or gives more than `INPUT_LIMITS.array_entries` samples.
    """
    step = checked_positive(what, period)
    count = np.ceil(duration / step * (1 - 1e-12))  # tolerates rounding of the quotient
    most = INPUT_LIMITS.array_entries
    if not count < most:
        words = f"{what} {step:g} s gives {count:g} samples over {duration:g} s, more than {most}"
        raise ProblemError(words, name=_argument(what), value=period, limit=duration / most)
    return np.append(np.arange(int(count)) * step, duration)


def checked_text(what: str, value: Any) -> str:
    """Return ``value``, or raise ProblemError unless it is a string, which may be empty."""
    if not isinstance(value, str):
        raise _invalid(what, "a string", value)
    return value


def checked_flag(what: str, value: Any) -> bool:
    """Return ``value`` as a bool, or raise ProblemError unless it is True or False."""
    if not isinstance(value, bool | np.bool_):
        raise _invalid(what, "True or False", value)
    return bool(value)


def checked_instance(what: str, value: Any, kind: type[_Kind]) -> _Kind:
    """Return ``value``, or raise ProblemError unless it is an instance of ``kind``."""
    if not isinstance(value, kind):
        raise _invalid(what, f"a {kind.__name__}", value, kind.__name__)
    return value


def checked_each(what: str, values: Any, kind: type[_Kind]) -> tuple[_Kind, ...]:
    """Return ``values`` as a tuple, or raise ProblemError unless they are a list of ``kind``, which may be empty."""
    try:
        check_entries(values)
        items = tuple(values)
    except NOT_NUMBERS as error:
        raise _invalid(what, f"a list of {kind.__name__}", values, kind.__name__) from error
    for item in items:
        checked_instance(what, item, kind)
    return items


def checked_time_limit(seconds: Any) -> float | None:
    """Return a time limit in seconds, None for no limit; raise ProblemError unless it is positive."""
    return None if seconds is None else checked_positive("time_limit", seconds)


def checked_mapping(what: str, values: Any) -> dict[str, Any]:
    """Return a copy of a dictionary by name, empty for None; raise ProblemError for any other value."""
    if not isinstance(values, Mapping | None):
        raise _invalid(what, "a dictionary by name", values)
    return dict(values or {})


def _argument(what: str) -> str:
    """Return the argument's name, ``scheme``, from a description such as ``Collocation: scheme``."""
    return what.rpartition(" ")[2].strip("'")


def _invalid(what: str, requirement: str, value: Any, limit: Any = None) -> ProblemError:
    """Return the error of an argument that violates a requirement."""
    words = f"{what} must be {requirement}, not {value!r}"
    return ProblemError(words, name=_argument(what), value=value, limit=limit)


def _pickled(value: Any) -> Any:
    """Return a value, or its `repr` if it cannot be pickled."""
    try:
        pickle.dumps(value)
    except Exception:  # pickling raises errors of many kinds
        return repr(value)
    return value
