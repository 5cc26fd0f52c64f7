"""Exceptions and warnings of the package, and the fields that they carry."""

from __future__ import annotations

import pickle
from typing import Any


class DetailedError(Exception):
    """An exception that stores name, value, violated limit and time of a fault as attributes, which pickling preserves.

    Attributes:
        name: Name of the faulty argument, option, joint, link, state or constraint; None if there is none.
        value: The value at fault.
        limit: What the value violates: a bound, a pair of bounds, a shape or the allowed choices.
        time: Time of the fault, s, or its position along a path, m. This and the two above may be None.
    """

    def __init__(
        self, message: str = "", *, name: str | None = None, value: Any = None, limit: Any = None, time: Any = None
    ) -> None:
        super().__init__(message)
        self.name, self.value, self.limit, self.time = name, value, limit, time

    def __reduce__(self) -> Any:
        """Return the data from which pickle recreates the exception; a field that pickle rejects becomes its `repr`."""
        return type(self), self.args, {key: _picklable(value) for key, value in self.__dict__.items()}


class ModelError(DetailedError, ValueError):
    """Error about a machine that cannot exist, or about an argument that is invalid or does not fit the machine."""


class ModelWarning(DetailedError, UserWarning):
    """Warning about a suspicious but usable description of a machine; the message names the suspicious part."""


def _picklable(value: Any) -> Any:
    """Return a value that can be pickled: the value itself, or its `repr`."""
    try:
        pickle.dumps(value)
    except Exception:  # pickling raises errors of many kinds
        return repr(value)
    return value
