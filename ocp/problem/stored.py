"""A problem as numbers, text and bytes: its expressions as CasADi writes a function of all its symbols. No pickle."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from dataclasses import fields, is_dataclass
from typing import Any

import casadi as ca
import numpy as np

from ocp.errors import ProblemError

__all__ = ["restored", "stored"]

FUNCTIONS = {"SX": (ca.SX, "SXFunction"), "MX": (ca.MX, "MXFunction")}


def stored(name: str, symbols: Any, time: Any, declared: Any) -> dict[str, Any]:
    """What JSON can hold, ``function`` being CasADi's text. Guesses that are functions are left out.

    Args:
        name: Of the problem. symbols: ``casadi.SX`` or ``casadi.MX``. time: Its symbol.
        declared: A dataclass of expressions, values, dictionaries and dataclasses of such, whatever it has. What is
            called ``symbol``, and what stands in ``at_start``, are symbols; all else is made of them.

    Raises:
        ProblemError: CasADi cannot write an expression.
    """
    inputs, outputs = [time], list[Any]()

    def put(value: Any, is_symbol: bool = False) -> Any:
        if is_symbol:
            inputs.append(value)
            return {"input": len(inputs) - 1, "size": value.numel(), "name": symbol_name(value)}
        if isinstance(value, ca.SX | ca.MX):
            outputs.append(value)
            return {"output": len(outputs) - 1}
        if isinstance(value, ca.Function):
            return {"function": value.serialize()}
        if value is None or callable(value):
            return None
        if isinstance(value, dict):
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
        return np.asarray(value.full() if isinstance(value, ca.DM) else value, dtype=float).tolist()

    record = {"name": name, "symbols": symbols.__name__, "declared": put(declared)}
    try:
        record["function"] = ca.Function("problem", inputs, outputs).serialize()
        ca.Function.deserialize(record["function"])  # a function of Python's is written, but cannot be read
    except (RuntimeError, NotImplementedError) as error:
        words = f"problem {name!r} cannot be written: {str(error).strip().splitlines()[-1]}"
        raise ProblemError(words, name=name) from error
    return {**record, "digest": digest(record)}


def restored(record: dict[str, Any], kinds: Sequence[type]) -> tuple[str, Any, Any, Any]:
    """Name, kind of symbols, the symbol of time and all declarations, with new symbols.

    Args:
        record: What :func:`stored` gave. kinds: The dataclasses that stand in it.

    Raises:
        ProblemError: The record is damaged.
    """
    try:
        return _restored(record, {kind.__name__: kind for kind in kinds})
    except (AttributeError, KeyError, IndexError, TypeError, ValueError, RuntimeError, NotImplementedError) as error:
        raise ProblemError(f"the problem that was written is damaged: {error}", name="problem") from error


def _restored(record: dict[str, Any], kinds: dict[str, type]) -> tuple[str, Any, Any, Any]:
    if digest({key: value for key, value in record.items() if key != "digest"}) != record["digest"]:
        raise ValueError("it is not what was written")
    symbols, kind_of_function = FUNCTIONS[record["symbols"]]
    function = ca.Function.deserialize(record["function"])
    if not function.is_a(kind_of_function):
        raise ValueError(f"it is no {kind_of_function}")
    time = symbols.sym("time")
    inputs = [time, *(None for _ in range(function.n_in() - 1))]

    def find(value: Any) -> None:
        """Make the symbols."""
        if isinstance(value, dict) and "input" in value:
            inputs[value["input"]] = symbols.sym(value["name"], value["size"])
        elif isinstance(value, dict):
            for part in value.values():
                find(part)
        elif isinstance(value, list):
            for part in value:
                find(part)

    def got(value: Any) -> Any:
        if not isinstance(value, dict):
            return value
        if "input" in value:
            return inputs[value["input"]]
        if "output" in value:
            return outputs[value["output"]]
        if "function" in value:
            return ca.Function.deserialize(value["function"])
        if "pool" in value:
            return {key: got(item) for key, item in value["pool"]}
        return kinds[value["kind"]](**{key: got(part) for key, part in value["fields"].items()})

    find(record["declared"])
    outputs = function.call(inputs, True, False)
    return str(record["name"]), symbols, time, got(record["declared"])


def symbol_name(symbol: Any) -> str:
    """The name that a symbol was made with."""
    first = str(ca.symvar(symbol)[0].name())
    return first.rpartition("_")[0] if isinstance(symbol, ca.SX) and symbol.numel() > 1 else first


def digest(record: dict[str, Any]) -> str:
    """What changes when anything of a record does."""
    return hashlib.sha256(json.dumps(record, sort_keys=True).encode()).hexdigest()
