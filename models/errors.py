"""The exception and the warning that the whole package raises."""

from __future__ import annotations

from typing import Any


class ModelError(ValueError):
    """An impossible machine, or an argument that does not fit it.

    The message names the offending link, joint or argument, its value, and the remedy.

    Attributes:
        name: Name of the link, joint or argument, or None.
        value: The offending value, or None.
        limit: What the value violates: a bound, a pair of bounds, a shape or the allowed choices.
        time: Time at which it does, s, or None.
    """

    def __init__(
        self, message: str = "", *, name: str | None = None, value: Any = None, limit: Any = None, time: Any = None
    ) -> None:
        super().__init__(message)
        self.name, self.value, self.limit, self.time = name, value, limit, time


class ModelWarning(UserWarning):
    """A suspicious but usable description of a machine; the message says where.

    Attributes:
        name, value, limit: As in ModelError; each None if there is none, or if the warning concerns several.
    """

    def __init__(self, message: str = "", *, name: str | None = None, value: Any = None, limit: Any = None) -> None:
        super().__init__(message)
        self.name, self.value, self.limit = name, value, limit
