"""Exceptions and warnings of the package, its checks of arguments (`require`), and the status of a solver.

Each message names the faulty argument or constraint, its value and the remedy. The exception holds the same data as
fields.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from enum import Enum
from typing import Any

import numpy as np

from models.checks import NOT_NUMBERS, ROUNDING, Checks, argument_of, floats
from models.errors import DetailedError, ModelError
from models.files import INPUT_LIMITS


class ProblemError(DetailedError, ValueError):
    """Error about an invalid problem, method or argument, detected before anything is solved."""


class SolveError(DetailedError, RuntimeError):
    """Error raised when a solve ends without an optimum.

    Attributes:
        solution: The last iterate as an unsuccessful solution, or None.
        conflicts: The constraints that would have to be relaxed (:class:`ocp.direct.diagnosis.Conflict`), the worst
            first.
        candidates: The motions that a planner tried, each with the reason of its rejection
            (:class:`ocp.motion.result.candidate.Candidate`).
    """

    def __init__(
        self,
        message: str = "",
        solution: Any = None,
        conflicts: Sequence[Any] = (),
        candidates: Sequence[Any] = (),
        **details: Any,
    ) -> None:
        super().__init__(message, **details)
        self.solution, self.conflicts, self.candidates = solution, tuple(conflicts), tuple(candidates)


class Interrupted(KeyboardInterrupt):
    """Exception raised when Ctrl-C ends a solve that already has an iterate.

    Attributes:
        solution: The last iterate as an unsuccessful solution.
    """

    def __init__(self, message: str = "", solution: Any = None) -> None:
        super().__init__(message)
        self.solution = solution


class AuditError(DetailedError, RuntimeError):
    """Error raised when a solution cannot be audited, for example because it was loaded without its problem."""


class RefinementWarning(DetailedError, UserWarning):
    """Warning that the audit does not pass after mesh refinement; ``value`` is the largest ratio of error to limit."""


class StorageWarning(DetailedError, UserWarning):
    """Warning that a part of a plan cannot be saved as data, such as a problem that calls a Python function."""


class BoundWarning(DetailedError, UserWarning):
    """Warning about a bug of this package: a motion's cost ``value`` is below its proven lower bound ``limit``."""


class SolverStatus(Enum):
    """Status with which a solver ended. Its value is the name that IPOPT gives to the status, if there is one."""

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
    """Any other status; the message is the status text of the solver itself."""

    @classmethod
    def of_word(cls, word: str) -> SolverStatus:
        """Return the status that a solver's status text names; FAILED if the text is unknown."""
        return cls(word) if word in cls._value2member_map_ else cls.FAILED

    @property
    def is_success(self) -> bool:
        """Whether the status reports an optimum."""
        return self in (SolverStatus.SOLVED, SolverStatus.ACCEPTABLE)

    @property
    def message(self) -> str:
        """Text of the status with advice on what to try next; "" after a success."""
        if self.is_success:
            return ""
        return f"{self.value}: {ADVICE[self]}" if self in ADVICE else self.value

    def __str__(self) -> str:
        """Return the text of the status."""
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
    """Set the attribute ``name`` of every error that a ``with`` block raises, unless it already has a name."""
    try:
        yield
    except DetailedError as error:
        error.name = name if error.name is None else error.name
        raise


@contextmanager
def problem_errors(prefix: str = "") -> Iterator[None]:
    """Convert each ModelError of a ``with`` block to a ProblemError, and add a prefix to the message."""
    try:
        yield
    except ModelError as error:
        raise ProblemError(f"{prefix}{error}", **vars(error)) from error


require = Checks(ProblemError)


def format_distinct(*numbers: float) -> list[str]:
    """Format numbers with six digits, or with more digits if unequal numbers would otherwise have equal texts."""
    candidates = [[f"{number:.{digits}g}" for number in numbers] for digits in range(6, 18)]
    different = len({repr(number) for number in numbers})
    return next((texts for texts in candidates if len({*texts}) == different), candidates[-1])


def values_within(value: Any, upper: float, name: str, problem: str) -> np.ndarray:
    """Return one or several times or distances as an array of floats, clipped to the range from 0 to `upper`.

    The name of the argument begins the error message, and `problem` ends it for a number outside the range.

    Raises:
        ProblemError: A value is not a number or not in a row, or is outside the range by more than rounding.
    """
    try:
        # a contiguous array occupies its memory; a broadcast view could claim any size
        plain = isinstance(value, np.ndarray) and value.dtype == float and value.flags.c_contiguous
        array = np.asarray(value, dtype=float) if plain else floats(value)
    except NOT_NUMBERS as error:
        raise ProblemError(f"{name} {value!r} is not numeric", name=name, value=value) from error
    if array.ndim > 1:
        raise ProblemError(f"{name} has shape {array.shape}; give one number or a row", name=name, value=array.shape)
    slack = ROUNDING * upper
    inside = (array >= -slack) & (array <= upper + slack)
    if not inside.all():
        outside = array[~inside][:3].tolist()
        raise ProblemError(f"{name} {outside} {problem}", name=name, value=outside[0], limit=(0.0, upper))
    return np.asarray(np.clip(array, 0.0, upper))


def sample_times(label: str, period: Any, duration: float) -> np.ndarray:
    """Return the sample times 0, period, 2 period, ... before the end of the duration, and the end itself, s.

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
    """Return a time limit, s, or None for no limit; raise ProblemError unless the limit is positive."""
    return None if seconds is None else require.positive("time_limit", seconds)
