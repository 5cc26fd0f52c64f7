"""Exceptions of the package: each message names the offending thing, its value and what to do."""

from __future__ import annotations

from difflib import get_close_matches
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Iterable

    from ocp.solution import Solution

__all__ = ["AuditError", "ProblemError", "RefinementWarning", "SolveError", "unknown_name"]


class ProblemError(ValueError):
    """A problem, a method or an argument that cannot be right, found before anything is solved."""


class SolveError(RuntimeError):
    """A solve that ended without an optimum.

    Attributes:
        solution: The last iterate as an unsuccessful solution, or None where there is none.
    """

    def __init__(self, message: str, solution: Solution | None = None) -> None:
        super().__init__(message)
        self.solution = solution


class AuditError(RuntimeError):
    """An audit that cannot be made, for example of a loaded solution without its problem."""


class RefinementWarning(UserWarning):
    """A refinement that stopped at its cap before its tolerance was reached."""


def unknown_name(kind: str, name: object, known: Iterable[str]) -> ProblemError:
    """Error for a name that nothing bears, listing the near ones (or all, if none is near)."""
    names = [str(item) for item in known]
    near = get_close_matches(str(name), names, n=3)
    hint = f"did you mean {', '.join(near)}?" if near else f"known: {', '.join(names) or 'none'}"
    return ProblemError(f"unknown {kind} {name!r}; {hint}")
