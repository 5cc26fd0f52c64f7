"""Problems as data: names, numbers, and expressions as functions written by elementary operations."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import fields, is_dataclass
from typing import Any

import casadi as ca
import numpy as np

from ocp.errors import ProblemError
from ocp.problem.function_reader import FunctionReader
from ocp.problem.function_writer import FunctionWriter

__all__ = ["ARRAY_NAMES", "RECORD_ERRORS", "from_record", "pack_record", "to_record", "unpack_record"]

SYMBOLS = {"SX": ca.SX, "MX": ca.MX}
RECORD_ERRORS = (
    AttributeError, IndexError, KeyError, NotImplementedError, OverflowError, RecursionError, RuntimeError, TypeError,
    ValueError,
)  # fmt: skip
"""Errors raised by rebuilding objects from damaged data."""
ARRAYS = {"i": "integers", "f": "numbers"}
ARRAY_NAMES = tuple(ARRAYS.values())
"""Names of the arrays into which a record is packed."""


# ---- a problem ---------------------------------------------------------------------------------------------------


def to_record(name: str, symbols: Any, time: Any, declared: Any) -> dict[str, Any]:
    """Return a problem as names, numbers and arrays. Guesses that are functions are left out.

    Args:
        name: Name of the problem.
        symbols: ``casadi.SX`` or ``casadi.MX``.
        time: Its symbol of time.
        declared: A dataclass of expressions, values, dictionaries and such dataclasses. Fields called ``symbol`` and
            the entries of ``at_start`` are symbols; all other expressions depend on them.

    Raises:
        ProblemError: An expression calls a function that is not elementary, such as a Python callback.
    """
    inputs, outputs, writer = [time], list[Any](), FunctionWriter()

    def put(value: Any, is_symbol: bool = False) -> Any:
        if is_symbol:
            inputs.append(value)
            return {"input": len(inputs) - 1, "size": value.numel(), "name": symbol_name(value)}
        if isinstance(value, ca.SX | ca.MX):
            outputs.append(value)
            return {"output": len(outputs) - 1}
        if isinstance(value, ca.Function):
            return {"function": writer.write(value)}
        if value is None or callable(value):
            return None
        if isinstance(value, Mapping):
            return {"pool": [[key, put(item)] for key, item in value.items()]}
        if is_dataclass(value):
            parts = {f.name: getattr(value, f.name) for f in fields(value)}
            inside = {key: put(part, is_symbol=key == "symbol") for key, part in parts.items() if key != "at_start"}
            if "at_start" in parts:
                inside["at_start"] = {
                    "pool": [[key, put(item, is_symbol=True)] for key, item in parts["at_start"].items()]
                }
            return {"kind": type(value).__name__, "fields": inside}
        if isinstance(value, str | bool | int | float):
            return value
        return np.asarray(value.full() if isinstance(value, ca.DM) else value, dtype=float)

    try:
        record = {"name": name, "symbols": symbols.__name__, "declared": put(declared)}
        record["expressions"] = writer.write(ca.Function("expressions", inputs, outputs))
    except (ProblemError, RuntimeError) as error:
        words = f"problem {name!r} cannot be written: {str(error).strip().splitlines()[-1]}"
        raise ProblemError(words, name=name) from error
    return {**record, "functions": writer.records}


def from_record(record: Mapping[str, Any], kinds: Sequence[type]) -> tuple[str, Any, Any, Any]:
    """Return the name, the type of symbols, the symbol of time and all declarations, with new symbols.

    Args:
        record: As :func:`to_record` returns it, from an untrusted source.
        kinds: The dataclasses that may occur in it.

    Raises:
        ProblemError: The record is damaged.
    """
    try:
        return _from_record(record, {kind.__name__: kind for kind in kinds})
    except (*RECORD_ERRORS, ProblemError) as error:
        raise ProblemError(f"the saved problem is damaged: {error}", name="problem") from error


def _from_record(record: Mapping[str, Any], kinds: Mapping[str, type]) -> tuple[str, Any, Any, Any]:
    symbols, functions = SYMBOLS[record["symbols"]], FunctionReader(record["functions"]).functions
    expressions = functions[record["expressions"]]
    time = symbols.sym("time")
    inputs: list[Any] = [time] + [None] * (expressions.n_in() - 1)
    for symbol in _symbols_in(record["declared"]):
        if inputs[symbol["input"]] is not None or not isinstance(symbol["name"], str):
            raise ValueError(f"symbol {symbol['input']} occurs twice")
        size = expressions.size_in(symbol["input"])
        if size != (symbol["size"], 1):
            raise ValueError(
                f"symbol {symbol['name']!r} has {symbol['size']} entries, the input of the function {size}"
            )
        inputs[symbol["input"]] = symbols.sym(symbol["name"], size[0])
    outputs = expressions.call(inputs, True, False)

    def read(value: Any) -> Any:
        if not isinstance(value, dict):
            return value
        if "input" in value:
            return inputs[value["input"]]
        if "output" in value:
            return outputs[value["output"]]
        if "function" in value:
            return functions[value["function"]]
        if "pool" in value:
            return {key: read(item) for key, item in value["pool"]}
        return kinds[value["kind"]](**{key: read(part) for key, part in value["fields"].items()})

    return str(record["name"]), symbols, time, read(record["declared"])


def _symbols_in(value: Any) -> Iterator[dict[str, Any]]:
    """Yield the records of symbols in a record of declarations."""
    if isinstance(value, dict) and "input" in value:
        yield value
    elif isinstance(value, dict | list):
        for part in value.values() if isinstance(value, dict) else value:
            yield from _symbols_in(part)


def symbol_name(symbol: Any) -> str:
    """Return the name with which a symbol was created."""
    first = str(ca.symvar(symbol)[0].name())
    return first.rpartition("_")[0] if isinstance(symbol, ca.SX) and symbol.numel() > 1 else first


# ---- records in files of arrays ----------------------------------------------------------------------------------


def pack_record(record: Any) -> tuple[Any, dict[str, np.ndarray]]:
    """Return the structure of a record, which JSON can hold, and its arrays, concatenated by type."""
    chunks: dict[str, list[np.ndarray]] = {name: [] for name in ARRAY_NAMES}
    lengths = dict.fromkeys(chunks, 0)

    def pack(value: Any) -> Any:
        if isinstance(value, np.ndarray):
            name = ARRAYS[value.dtype.kind]
            chunks[name].append(value.ravel())
            lengths[name] += value.size
            return {"array": name, "begin": lengths[name] - value.size, "shape": list(value.shape)}
        if isinstance(value, dict):
            return {key: pack(part) for key, part in value.items()}
        return [pack(part) for part in value] if isinstance(value, list | tuple) else value

    structure = pack(record)
    empty = {"integers": np.zeros(0, dtype=np.int64), "numbers": np.zeros(0)}
    return structure, {name: np.concatenate([empty[name], *parts]) for name, parts in chunks.items()}


def unpack_record(structure: Any, arrays: Mapping[str, np.ndarray]) -> Any:
    """Return the record whose parts :func:`pack_record` returned.

    Raises:
        ValueError, KeyError, TypeError: The parts are damaged.
    """
    if isinstance(structure, dict) and structure.get("array") in ARRAY_NAMES:
        shape, begin = [int(size) for size in structure["shape"]], int(structure["begin"])
        size = int(np.prod(shape, dtype=object))
        if begin < 0 or min(shape, default=0) < 0 or begin + size > arrays[structure["array"]].size:
            raise ValueError("an array exceeds the numbers of the file")
        return arrays[structure["array"]][begin : begin + size].reshape(shape)
    if isinstance(structure, dict):
        return {key: unpack_record(part, arrays) for key, part in structure.items()}
    return [unpack_record(part, arrays) for part in structure] if isinstance(structure, list) else structure
