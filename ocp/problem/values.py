"""Values that users give: numbers, arrays and expressions, told apart, stacked and checked.

CasADi functions of columns evaluated at many samples, block by block.
"""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np

from ocp.errors import NOT_NUMBERS, ProblemError, floats, format_distinct

__all__ = [
    "Sampler",
    "check_finite",
    "check_horizon",
    "check_inside",
    "check_order",
    "constant",
    "evaluate_at_samples",
    "evaluate_in_blocks",
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
            least, most = format_distinct(float(low), float(high))
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
            told, least, most = format_distinct(float(number), float(low), float(high))
            words = f"{what} value {told} is outside the bounds [{least}, {most}] (entry {i})"
            raise ProblemError(words, **given)


def check_horizon(what: str, value: np.ndarray) -> None:
    """Raise unless a horizon is a positive finite number (nan: an expression of parameters)."""
    if np.isinf(value[0]) or value[0] <= 0:
        words = f"{what} must be positive and finite, not {value[0]:g} s"
        raise ProblemError(words, value=float(value[0]))


BLOCKS = (512, 32)  # samples in one call of a function: a map of them all takes longer to make than to evaluate


class Sampler:
    """A function of columns, called at many samples at once."""

    def __init__(self, symbols: list[Any], outputs: list[Any]) -> None:
        """Of expressions of symbols; an output that is a matrix is read column by column."""
        self._inputs, self._outputs = ([part.numel() for part in parts] for parts in (symbols, outputs))
        packed, found = ca.vertcat(*symbols), ca.vertcat(*[ca.densify(ca.vec(output)) for output in outputs])
        if isinstance(packed, ca.MX):  # of which only symbols can be inputs
            inner = ca.Function("inner", symbols, [found], {"cse": True})
            packed = ca.MX.sym("packed", sum(self._inputs))
            found = inner(*ca.vertsplit(packed, np.cumsum([0, *self._inputs]).tolist()))
        self._function = ca.Function("sampled", [packed], [found])
        self._filled = np.array(self._function.sparsity_out(0).row(), dtype=int)  # CasADi drops constants that are zero
        self._maps: dict[int, Any] = {}

    def __call__(self, *columns: Any) -> list[np.ndarray]:
        """Its outputs at M samples, each (M, n).

        Args:
            columns: Its arguments: an array (M, n) of what differs from sample to sample, or (n,) or a number of what
                does not.
        """
        values = [np.asarray(column, dtype=float) for column in columns]
        m = next(len(value) for value in values if value.ndim == 2)
        whole = -(-m // BLOCKS[-1]) * BLOCKS[-1]
        given, filled = np.empty((whole, sum(self._inputs))), np.empty((whole, self._filled.size))
        first = 0
        for size, value in zip(self._inputs, values, strict=True):
            given[:m, first : first + size] = value
            first += size
        given[m:] = given[m - 1 : m]  # what is left of the last block says the last sample again
        at = 0
        for size in BLOCKS:
            end = whole - (whole - at) % size
            if end > at:
                block = self._maps.get(size) or self._maps.setdefault(size, self._function.map(size))
                evaluate_in_blocks(block, size, given[at:end], [filled[at:end]])
            at = end
        found = np.zeros((whole, sum(self._outputs)))
        found[:, self._filled] = filled
        return np.split(found[:m], np.cumsum(self._outputs[:-1]), axis=1)


def evaluate_in_blocks(
    function: Any, size: int, given: np.ndarray, outputs: list[np.ndarray], state: np.ndarray | None = None
) -> None:
    """Call a casadi function of ``size`` columns side by side block by block.

    Args:
        given, outputs: Its input and outputs, the columns as rows, in whole blocks: (K size, n) each.
        state: An input (n,) before that: the last column of the first output of the block before.
    """
    memory, evaluate = function.buffer()
    if state is not None:
        memory.set_arg(0, state.data)
    for at in range(0, len(given), size):
        part = slice(at, at + size)
        memory.set_arg(0 if state is None else 1, given[part].data)
        for i, value in enumerate(outputs):
            memory.set_res(i, value[part].data)
        evaluate()
        if memory.ret():
            raise RuntimeError(f"{function.name()} failed at samples {at} to {at + size - 1}")
        if state is not None:
            state[:] = outputs[0][at + size - 1]


def evaluate_at_samples(function: Any, *columns: Any) -> list[np.ndarray]:
    """A casadi function of dense columns at M samples, see :class:`Sampler`."""
    symbols = [ca.MX.sym(f"input{i}", function.numel_in(i)) for i in range(function.n_in())]
    return Sampler(symbols, list(function.call(symbols)))(*columns)
