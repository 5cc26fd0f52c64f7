"""CasADi functions of columns evaluated at many samples, block by block."""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np

__all__ = ["Sampler", "at_samples", "in_blocks"]

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
                in_blocks(block, size, given[at:end], [filled[at:end]])
            at = end
        found = np.zeros((whole, sum(self._outputs)))
        found[:, self._filled] = filled
        return np.split(found[:m], np.cumsum(self._outputs[:-1]), axis=1)


def in_blocks(
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


def at_samples(function: Any, *columns: Any) -> list[np.ndarray]:
    """A casadi function of dense columns at M samples, see :class:`Sampler`."""
    symbols = [ca.MX.sym(f"input{i}", function.numel_in(i)) for i in range(function.n_in())]
    return Sampler(symbols, list(function.call(symbols)))(*columns)
