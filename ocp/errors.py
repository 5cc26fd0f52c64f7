"""Exceptions of the package, and `require`, the checks of arguments that raise ProblemError.

Each message names the faulty argument or constraint, its value and the remedy. The exception holds the same data as
fields.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import numpy as np

from models.checks import Checks, argument_of
from models.errors import DetailedError
from models.files import INPUT_LIMITS

__all__ = [
    "AuditError", "BoundWarning", "DetailedError", "Interrupted", "ProblemError", "RefinementWarning", "SolveError",
    "StorageWarning", "checked_time_limit", "error_names", "format_distinct", "require", "sample_times",
]  # fmt: skip


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


@contextmanager
def error_names(name: str) -> Iterator[None]:
    """Set the name of every exception raised inside that has no name yet."""
    try:
        yield
    except DetailedError as error:
        error.name = name if error.name is None else error.name
        raise


require = Checks(ProblemError)


def format_distinct(*numbers: float) -> list[str]:
    """Format numbers with six digits, or with as many more as it takes to distinguish unequal numbers."""
    candidates = [[f"{number:.{digits}g}" for number in numbers] for digits in range(6, 18)]
    different = len({repr(number) for number in numbers})
    return next((texts for texts in candidates if len({*texts}) == different), candidates[-1])


def sample_times(label: str, period: Any, duration: float) -> np.ndarray:
    """Return the times 0, period, 2 period, ... before the end of the duration, and the end itself, s.

    Raises:
        ProblemError: The period is not positive, or gives more than `INPUT_LIMITS.array_entries` samples.
    """
    step = require.positive(label, period)
    count = np.ceil(duration / step * (1 - 1e-12))  # tolerates rounding of the quotient
    most = INPUT_LIMITS.array_entries
    if not count < most:
        words = f"{label} {step:g} s gives {count:g} samples over {duration:g} s, more than {most}"
        raise ProblemError(words, name=argument_of(label), value=period, limit=duration / most)
    return np.append(np.arange(int(count)) * step, duration)


def checked_time_limit(seconds: Any) -> float | None:
    """Return a time limit in seconds, None for no limit; raise ProblemError unless it is positive."""
    return None if seconds is None else require.positive("time_limit", seconds)
