"""Real numbers that users give, read as arrays of floats and counted before they are copied."""

from __future__ import annotations

from collections.abc import Sequence
from numbers import Real
from typing import Any

import numpy as np
from numpy.typing import NDArray

from models.input_files import INPUT_LIMITS

__all__ = ["NOT_NUMBERS", "check_entries", "floats"]

NOT_NUMBERS = (TypeError, ValueError, OverflowError, RuntimeError, NotImplementedError)
"""What numpy and casadi raise of values that are no numbers."""


def check_entries(value: Any) -> None:
    """Raise ValueError of more than `INPUT_LIMITS.array_entries`: a view or a range may be larger than all memory.

    Nothing is copied or gone through: the first entry of a list stands for all.
    """
    most, entries, part = INPUT_LIMITS.array_entries, 1, value
    for _ in range(INPUT_LIMITS.nesting):  # as many dimensions as numpy's arrays have at most
        if isinstance(part, np.ndarray):
            entries *= part.size
        if not isinstance(part, Sequence) or isinstance(part, str | bytes):
            break
        entries *= len(part)
        if not 0 < entries <= most:
            break
        part = part[0]
    if entries > most:
        raise ValueError(f"{entries} entries, at most {most} are read")


def floats(value: Any) -> NDArray[np.float64]:
    """Return a value as a new array of floats; raise one of NOT_NUMBERS where it is none.

    That is also where there are too many entries, which are not copied, and where numpy would read a number all the
    same: in a text, in True, in None and in a symbol (nan), in the real part of a complex number.
    """
    check_entries(value)
    plain = np.asarray(value)
    if plain.dtype.kind == "O":
        fits = all(isinstance(entry, Real) and not isinstance(entry, bool | np.bool_) for entry in plain.flat)
    else:
        fits = plain.dtype.kind in "iuf"
    if not fits:
        raise TypeError(f"{plain.dtype} is no real number")
    return np.array(plain, dtype=float)
