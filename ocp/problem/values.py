"""Values that users give: numbers, arrays and expressions, told apart, stacked and checked."""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np

from ocp.errors import NOT_NUMBERS, ProblemError, floats, told_apart

__all__ = [
    "check_finite",
    "check_horizon",
    "check_inside",
    "check_order",
    "constant",
    "identity",
    "is_symbolic",
    "numeric",
    "stacked",
    "symbols_of",
    "table",
]


def is_symbolic(value: Any) -> bool:
    """Whether a value is an expression, or a list or tuple that holds one."""
    if isinstance(value, list | tuple):
        return any(is_symbolic(entry) for entry in value)
    return isinstance(value, ca.SX | ca.MX)


def stacked(what: str, value: Any) -> Any:
    """An expression as one column; a list or tuple of expressions and numbers is stacked."""
    try:
        return ca.densify(ca.vec(ca.vertcat(*value) if isinstance(value, list | tuple) else value))
    except NOT_NUMBERS as error:
        words = f"{what}: a flat list of numbers and expressions is expected, not {value!r}"
        raise ProblemError(words, value=value) from error


def symbols_of(*functions: Any) -> Any:
    """The symbols to call functions with: ``casadi.SX`` where all are made of SX, which inlines them, else MX."""
    return ca.SX if all(function.is_a("SXFunction") for function in functions) else ca.MX


def identity(symbol: Any) -> int:
    """A number that is the same for the same scalar SX or the same MX symbol."""
    return int(symbol.element_hash() if isinstance(symbol, ca.SX) else symbol.__hash__())


def numeric(what: str, value: Any) -> np.ndarray:
    """A value as a flat float array, or ProblemError where it is none."""
    return table(what, value).reshape(-1)


def table(what: str, value: Any) -> np.ndarray:
    """A value as a float array of its own shape, or ProblemError where it is none."""
    try:
        return floats(value.full() if isinstance(value, ca.DM) else value)
    except NOT_NUMBERS as error:
        words = f"{what}: numbers or expressions are expected, not {value!r}"
        raise ProblemError(words, value=value) from error


def constant(expression: Any) -> np.ndarray:
    """Numbers of a column of constants, nan where an entry is an expression of parameters. Shape (n,)."""
    entries = ca.vertsplit(expression)
    if isinstance(expression, ca.MX):
        if not ca.symvar(expression):
            return np.asarray(ca.evalf(expression).full()).reshape(-1)
        return np.full(len(entries), np.nan)
    return np.array([float(entry) if entry.is_constant() else np.nan for entry in entries])


def check_finite(what: str, value: np.ndarray) -> None:
    """Raise where an entry is infinite or not a number."""
    if not np.all(np.isfinite(value)):
        raise ProblemError(f"{what} is not finite: {value.tolist()}", value=value.tolist())


def check_order(what: str, lower: np.ndarray, upper: np.ndarray) -> None:
    """Raise where a lower bound lies above its upper bound, or bounds cannot be met at all."""
    for i, (low, high) in enumerate(zip(lower, upper, strict=True)):
        given: dict[str, Any] = {"value": float(low), "limit": float(high)}
        if low > high:
            least, most = told_apart(float(low), float(high))
            raise ProblemError(f"{what}: lower bound {least} is above upper bound {most} (entry {i})", **given)
        if low == np.inf or high == -np.inf:
            raise ProblemError(f"{what}: bounds [{low:g}, {high:g}] exclude everything (entry {i})", **given)


def check_inside(what: str, value: np.ndarray, lower: np.ndarray, upper: np.ndarray) -> None:
    """Raise where a value (nan: free) is infinite or lies outside its bounds (nan: not known yet)."""
    for i, (number, low, high) in enumerate(zip(value, lower, upper, strict=True)):
        given: dict[str, Any] = {"value": float(number), "limit": (float(low), float(high))}
        if np.isinf(number):
            raise ProblemError(f"{what} is not finite: {number} (entry {i}); use nan to leave it free", **given)
        if number < low or number > high:
            told, least, most = told_apart(float(number), float(low), float(high))
            words = f"{what} value {told} is outside the bounds [{least}, {most}] (entry {i})"
            raise ProblemError(words, **given)


def check_horizon(what: str, value: np.ndarray) -> None:
    """Raise unless a horizon is a positive finite number (nan: an expression of parameters)."""
    if np.isinf(value[0]) or value[0] <= 0:
        words = f"{what} must be positive and finite, not {value[0]:g} s"
        raise ProblemError(words, value=float(value[0]))
