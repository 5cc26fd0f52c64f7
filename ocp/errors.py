"""Exceptions of the package, and the checks of arguments that raise them.

Each message names the offending thing, its value and what to do; the exception carries the same as fields.
"""

from __future__ import annotations

import pickle
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from difflib import get_close_matches
from typing import Any

import numpy as np

__all__ = [
    "AuditError",
    "Detailed",
    "Interrupted",
    "ProblemError",
    "RefinementWarning",
    "SolveError",
    "about",
    "checked_choice",
    "checked_count",
    "checked_mapping",
    "checked_nonnegative",
    "checked_positive",
    "checked_text",
    "checked_time_limit",
    "unknown_name",
]


class Detailed(Exception):
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


class ProblemError(Detailed, ValueError):
    """A problem, a method or an argument that cannot be right, found before anything is solved."""


class SolveError(Detailed, RuntimeError):
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


class AuditError(Detailed, RuntimeError):
    """An audit that cannot be made, for example of a loaded solution without its problem."""


class RefinementWarning(Detailed, UserWarning):
    """A refinement that stopped where the audit does not pass; ``value`` is the share of its limit that a row is at."""


@contextmanager
def about(name: str) -> Iterator[None]:
    """What is raised inside, and names nothing itself, is about ``name``."""
    try:
        yield
    except Detailed as error:
        error.name = name if error.name is None else error.name
        raise


def unknown_name(kind: str, name: object, known: Iterable[str]) -> ProblemError:
    """Error for a name that nothing bears, listing the near ones (or all, if none is near)."""
    names = [str(item) for item in known]
    near = get_close_matches(str(name), names, n=3)
    hint = f"did you mean {', '.join(near)}?" if near else f"known: {', '.join(names) or 'none'}"
    return ProblemError(f"unknown {kind} {name!r}; {hint}", name=str(name), limit=tuple(names))


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
    if not whole or value < least or (most is not None and value > most):
        kind = "a positive integer" if least == 1 else f"a whole number, at least {least}"
        kind = kind if most is None else f"{least} to {most}"
        raise ProblemError(f"{what} must be {kind}, not {value!r}", name=_last(what), value=value, limit=(least, most))
    return int(value)


def checked_nonnegative(what: str, value: Any) -> float:
    """``value``, or ProblemError unless it is a finite number, zero or above."""
    if isinstance(value, bool) or not isinstance(value, int | float | np.number) or not 0 <= value < np.inf:
        words = f"{what} must be a finite number, zero or above, not {value!r}"
        raise ProblemError(words, name=_last(what), value=value, limit=0.0)
    return value  # type: ignore[return-value]


def checked_positive(what: str, value: Any, below: float = np.inf) -> float:
    """``value``, or ProblemError unless it is a number between 0 and ``below``, both excluded."""
    if (
        isinstance(value, bool)
        or not isinstance(value, int | float | np.integer | np.floating)
        or not 0 < value < below
    ):
        kind = "positive and finite" if below == np.inf else f"between 0 and {below:g}"
        raise ProblemError(f"{what} must be {kind}, not {value!r}", name=_last(what), value=value, limit=below)
    return value  # type: ignore[return-value]


def checked_text(what: str, value: Any) -> str:
    """``value``, or ProblemError unless it is a string; an empty one will do."""
    if not isinstance(value, str):
        raise ProblemError(f"{what} must be a string, not {value!r}", name=_last(what), value=value)
    return value


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
