"""Values given by the user, read as numbers, arrays or expressions, and functions evaluated at many samples."""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import casadi as ca
import numpy as np

from models.checks import NOT_NUMBERS, floats
from ocp.errors import ProblemError, format_distinct


def is_symbolic(value: Any) -> bool:
    """Return whether a value is an expression, or a list or tuple that contains one."""
    if isinstance(value, list | tuple):
        return any(is_symbolic(entry) for entry in value)
    return isinstance(value, ca.SX | ca.MX)


def stack_column(what: str, value: Any) -> Any:
    """Return an expression, or a list or tuple of expressions, as one column."""
    try:
        return ca.densify(ca.vec(ca.vertcat(*value) if isinstance(value, list | tuple) else value))
    except NOT_NUMBERS as error:
        words = f"{what}: a flat list of numbers and expressions is expected, not {value!r}"
        raise ProblemError(words, value=value) from error


def symbols_of(*functions: Any) -> Any:
    """Return the symbol type for calls of functions: ``casadi.SX`` if all are SX functions, else ``casadi.MX``."""
    return ca.SX if all(function.is_a("SXFunction") for function in functions) else ca.MX


def identity(symbol: Any) -> int:
    """Return a number that identifies a symbol; only equal scalar SX or equal MX symbols have the same number."""
    return int(symbol.element_hash() if isinstance(symbol, ca.SX) else symbol.__hash__())


def numeric(what: str, value: Any) -> np.ndarray:
    """Return a numeric value as a flat float array; raise ProblemError for anything else."""
    return table(what, value).reshape(-1)


def table(what: str, value: Any) -> np.ndarray:
    """Return a numeric value as a float array without changing its shape; raise ProblemError for anything else."""
    try:
        return floats(value.full() if isinstance(value, ca.DM) else value)
    except NOT_NUMBERS as error:
        words = f"{what}: numbers or expressions are expected, not {value!r}"
        raise ProblemError(words, value=value) from error


def constant(expression: Any) -> np.ndarray:
    """Return a column of constants as numbers, with nan for entries that depend on parameters. Shape (n,)."""
    entries = ca.vertsplit(expression)
    if isinstance(expression, ca.MX):
        if not ca.symvar(expression):
            return np.asarray(ca.evalf(expression).full()).reshape(-1)
        return np.full(len(entries), np.nan)
    return np.array([float(entry) if entry.is_constant() else np.nan for entry in entries])


def check_finite(what: str, value: np.ndarray) -> None:
    """Raise ProblemError if an entry of an array is infinite or nan."""
    if not np.all(np.isfinite(value)):
        raise ProblemError(f"{what} is not finite: {value.tolist()}", value=value.tolist())


def check_order(what: str, lower: np.ndarray, upper: np.ndarray) -> None:
    """Raise ProblemError if a lower bound exceeds its upper bound, or if no finite number lies between them."""
    for i, (low, high) in enumerate(zip(lower, upper, strict=True)):
        details: dict[str, Any] = {"value": float(low), "limit": float(high)}
        if low > high:
            least, greatest = format_distinct(float(low), float(high))
            raise ProblemError(f"{what}: lower bound {least} is above upper bound {greatest} (entry {i})", **details)
        if low == np.inf or high == -np.inf:
            raise ProblemError(f"{what}: bounds [{low:g}, {high:g}] exclude everything (entry {i})", **details)


def check_inside(what: str, value: np.ndarray, lower: np.ndarray, upper: np.ndarray) -> None:
    """Raise ProblemError if a value is infinite or outside its bounds; nan stands for a free value or unknown bound."""
    for i, (number, low, high) in enumerate(zip(value, lower, upper, strict=True)):
        details: dict[str, Any] = {"value": float(number), "limit": (float(low), float(high))}
        if np.isinf(number):
            raise ProblemError(f"{what} is not finite: {number} (entry {i}); use nan to leave it free", **details)
        if number < low or number > high:
            shown, least, greatest = format_distinct(float(number), float(low), float(high))
            words = f"{what} value {shown} is outside the bounds [{least}, {greatest}] (entry {i})"
            raise ProblemError(words, **details)


def check_horizon(what: str, value: np.ndarray) -> None:
    """Raise ProblemError unless a horizon is positive and finite, or nan because it depends on parameters."""
    if np.isinf(value[0]) or value[0] <= 0:
        words = f"{what} must be positive and finite, not {value[0]:g} s"
        raise ProblemError(words, value=float(value[0]))


def middle_horizon(low: float, high: float) -> float:
    """Return the horizon at which a solve starts without a guess, s: the middle of its bounds, or a value near 1 s."""
    return float(np.clip(1.0, low, high) if np.isinf(high) else 0.5 * (low + high))


def dependence(expression: Any, symbols: Any) -> np.ndarray:
    """Return which entries of a column of expressions contain which symbols of a column. Shape (m, n), bool."""
    pattern = np.asarray(ca.DM(ca.jacobian_sparsity(expression, symbols), 1).full()) != 0
    return np.asarray(pattern.reshape(expression.numel(), symbols.numel()))


BLOCK_SIZES = (512, 32, 8, 1)  # samples per call: one map of all samples takes longer to build than to evaluate


class Sampler:
    """A function of column vectors that is evaluated at many samples at once, in blocks of samples.

    Args:
        symbols: Arguments of the function, one column each.
        outputs: Expressions of the symbols. A matrix is read column by column.
    """

    def __init__(self, symbols: list[Any], outputs: list[Any]) -> None:
        self._inputs = [part.numel() for part in symbols]
        self._ends = np.cumsum([output.numel() for output in outputs], dtype=int).tolist()
        packed, results = ca.vertcat(*symbols), ca.vertcat(*[ca.densify(ca.vec(output)) for output in outputs])
        if isinstance(packed, ca.MX):  # the inputs of an MX function must be symbols
            inner = ca.Function("inner", symbols, [results], {"cse": True})
            packed = ca.MX.sym("packed", sum(self._inputs))
            results = inner(*ca.vertsplit(packed, np.cumsum([0, *self._inputs]).tolist()))
        self._function = ca.Function("sampled", [packed], [results])
        self._filled = np.array(self._function.sparsity_out(0).row(), dtype=int)  # CasADi drops constant zeros
        self._maps: dict[int, Any] = {}

    def __call__(self, *columns: Any) -> list[np.ndarray]:
        """Return the outputs of the function at M samples of its arguments. Shape (M, n) each.

        Args:
            columns: The arguments: an array (M, n) that varies over the samples, or (n,) or a number that does not.
        """
        values = [np.asarray(column, dtype=float) for column in columns]
        count = next(len(value) for value in values if value.ndim == 2)
        arguments, results = np.empty((count, sum(self._inputs))), np.empty((count, self._filled.size))
        first = 0
        for size, value in zip(self._inputs, values, strict=True):
            arguments[:, first : first + size] = value
            first += size
        begin = 0
        for size in BLOCK_SIZES:
            end = count - (count - begin) % size
            if end > begin:
                block = self._maps.get(size) or self._maps.setdefault(size, self._function.map(size))
                evaluate_in_blocks(block, size, arguments[begin:end], [results[begin:end]])
            begin = end
        if self._filled.size < self._ends[-1]:
            filled, results = results, np.zeros((count, self._ends[-1]))
            results[:, self._filled] = filled
        return [results[:, begin:end] for begin, end in pairwise((0, *self._ends))]


def evaluate_in_blocks(
    function: Any, size: int, inputs: np.ndarray, outputs: list[np.ndarray], *, previous: np.ndarray | None = None
) -> None:
    """Call a casadi function of ``size`` samples on one block of samples after another; store results in arrays.

    Args:
        inputs, outputs: Input and outputs with samples as rows, in whole blocks. Shape (K size, n) each.
        previous: First argument of the function: the last row of its first output in the previous block. Shape (n,).
            Updated in place.
    """
    memory, evaluate = function.buffer()
    if previous is not None:
        memory.set_arg(0, previous.data)
    for begin in range(0, len(inputs), size):
        block = slice(begin, begin + size)
        memory.set_arg(0 if previous is None else 1, inputs[block].data)
        for i, value in enumerate(outputs):
            memory.set_res(i, value[block].data)
        evaluate()
        if memory.ret():
            raise RuntimeError(f"{function.name()} failed at samples {begin} to {begin + size - 1}")
        if previous is not None:
            previous[:] = outputs[0][begin + size - 1]


def evaluate_at_samples(function: Any, *columns: Any) -> list[np.ndarray]:
    """Return the outputs of a casadi function of dense columns at M samples of its arguments. Shape (M, n) each."""
    symbols = [ca.MX.sym(f"input{i}", function.numel_in(i)) for i in range(function.n_in())]
    return Sampler(symbols, list(function.call(symbols)))(*columns)
