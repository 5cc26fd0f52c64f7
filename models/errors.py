"""The exception and the warning of the package, in a room of their own below all others, which all may raise them."""

from __future__ import annotations

from typing import Any


class ModelError(ValueError):
    """A machine that cannot exist or a request that does not fit it.

    The message names the offending link, joint or argument, its value, and what to do about it.

    Attributes:
        name: Of the link, joint or argument; None where the message names none.
        value: What it was, or is by the model; None where the message says none.
        limit: What the value breaks: a bound, a pair of bounds, a shape, the values to choose from.
        time: When, s.
    """

    def __init__(
        self, message: str = "", *, name: str | None = None, value: Any = None, limit: Any = None, time: Any = None
    ) -> None:
        super().__init__(message)
        self.name, self.value, self.limit, self.time = name, value, limit, time


class ModelWarning(UserWarning):
    """Something odd in what describes a machine, which can be worked with; the message names where it is.

    Attributes:
        name, value, limit: As of ModelError; each None where there is none, or where several are named.
    """

    def __init__(self, message: str = "", *, name: str | None = None, value: Any = None, limit: Any = None) -> None:
        super().__init__(message)
        self.name, self.value, self.limit = name, value, limit
