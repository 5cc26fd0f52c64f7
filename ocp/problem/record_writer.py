"""Write problems and CasADi functions as data, which :mod:`ocp.problem.record_reader` reads.

A function of matrices is expanded to scalars, operation by operation. The numbers that define tables, splines and
integrators come from CasADi's debugging output of a function in memory, never from a file.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import fields, is_dataclass
from typing import Any

import casadi as ca
import numpy as np

from ocp.errors import ProblemError
from ocp.problem.record_reader import (
    ARRAY_NAMES,
    BUILDERS,
    CALL,
    CONSTANT,
    INPUT,
    INTEGRATOR_OPTIONS,
    INTEGRATORS,
    PLACES,
    RESULT,
    from_entries,
)


class FunctionWriter:
    """Writer of CasADi functions as records; each function is written once, after the functions that it calls.

    Attributes:
        records: For each function a dictionary of text, numbers, lists and arrays, as `FunctionReader` takes them.
    """

    def __init__(self) -> None:
        self.records: list[dict[str, Any]] = []
        self._written: list[Any] = []  # the functions of the records
        self._numbers: dict[int, int] = {}
        self._pending: set[int] = set()
        self._alive: list[Any] = []  # keeps functions alive: CasADi reuses the hash of a deleted one

    def write(self, function: Any) -> int:
        """Write a function as a record unless it has been written before, and return the number of the record.

        Raises:
            ProblemError: The function, or one that it calls, cannot be written, such as a Python callback.
        """
        key = function.__hash__()
        if key in self._numbers:
            return self._numbers[key]
        if key in self._pending:
            raise _unwritable(function)
        self._pending.add(key)
        self._alive.append(function)
        kind = function.class_name()
        if kind == "BSplineInterpolant":
            return self._register(key, self.write(function.find_functions()[0]))
        if kind in ("LinearInterpolant", "LinearInterpolantJac"):
            record = _interpolant_record(function, kind)
        elif kind in INTEGRATORS:
            record = _integrator_record(function, self.write(function.oracle()))
        else:
            record = self._operations(self._as_scalars(function))
            if (callee := self._forwarded_to(record)) is not None:
                return self._register(key, callee)
        return self._append(record, function)

    def _append(self, record: dict[str, Any], function: Any) -> int:
        """Append the record of a function, and return the number of the record."""
        self.records.append(record)
        self._written.append(function)
        return self._register(function.__hash__(), len(self.records) - 1)

    def _forwarded_to(self, record: dict[str, Any]) -> int | None:
        """Return the number of the function to which a recorded function merely passes its own arguments, or None.

        Without this check, each save of a loaded problem would wrap its tables in one more function.
        """
        rows, count = record["rows"], sum(_size(pattern) for pattern in record["inputs"])
        if len(rows) <= count or rows[count, 0] != CALL:
            return None
        callee = self._written[rows[count, 1]]
        inputs = [[INPUT, k, entry] for k, pattern in enumerate(record["inputs"]) for entry in range(_size(pattern))]
        outputs = [[RESULT, count, entry] for entry in range(len(rows) - count - 1)]
        passes = [*inputs, rows[count].tolist(), *outputs] == rows.tolist()
        passes &= record["arguments"].tolist() == list(range(count))
        passes &= record["results"].tolist() == list(range(count + 1, len(rows)))
        patterns = [_pattern(callee.sparsity_in(k)) for k in range(callee.n_in())]
        results = [_pattern(callee.sparsity_out(k)) for k in range(callee.n_out())]
        return int(rows[count, 1]) if passes and (patterns, results) == (record["inputs"], record["outputs"]) else None

    def _register(self, key: int, number: int) -> int:
        """Store the number of a function's record under the hash of the function, and return the number."""
        self._numbers[key] = number
        return number

    def _leaf(self, record: dict[str, Any]) -> Any:
        """Store the record of a function, such as a table look-up, and return the function rebuilt from the record."""
        function = BUILDERS[record["kind"]](record, ())
        self._alive.append(function)
        self._append(record, function)
        return function

    def _call_leaf(self, record: dict[str, Any], entries: Sequence[Any], pattern: Any) -> Any:
        """Store the record of a function of one vector, and return the function's value for given vector entries."""
        argument = ca.vertcat(*entries) if entries else ca.SX(0, 1)
        return from_entries(pattern, self._leaf(record).call([argument], False, True)[0].nonzeros())

    def _as_scalars(self, function: Any) -> Any:
        """Convert a function to a function of SX symbols, which may call other functions, such as table look-ups."""
        kind = function.class_name()
        if kind == "SXFunction":
            return function
        inputs = [ca.SX.sym(f"i{k}", function.sparsity_in(k)) for k in range(function.n_in())]
        try:
            outputs = self._interpret(function, inputs) if kind == "MXFunction" else _call_on_scalars(function, inputs)
            return ca.Function(function.name(), inputs, outputs)
        except (RuntimeError, NotImplementedError) as error:
            raise _unwritable(function) from error

    def _interpret(self, function: Any, inputs: Sequence[Any]) -> list[Any]:
        """Evaluate a function of matrices on SX matrices, operation by operation."""
        values: dict[int, Any] = {}
        outputs: list[list[Any]] = [[] for _ in range(function.n_out())]
        for k in range(function.n_instructions()):
            code = function.instruction_id(k)
            slots, places = function.instruction_input(k), function.instruction_output(k)
            if code == ca.OP_OUTPUT:
                outputs[places[0]] += values[slots[0]].nonzeros()  # an output may consist of several parts, in order
                continue
            node = function.instruction_MX(k)
            if code == ca.OP_INPUT:
                where = node.info()
                entries = inputs[where["ind"]].nonzeros()[where["offset"] : where["offset"] + node.nnz()]
                results = [from_entries(node.sparsity(), entries)]
            else:
                arguments = [values[slot] if slot >= 0 else None for slot in slots]
                results = self._apply(function, node, code, arguments)
            values.update((slot, result) for slot, result in zip(places, results, strict=True) if slot >= 0)
        return [from_entries(function.sparsity_out(k), entries) for k, entries in enumerate(outputs)]

    def _apply(self, function: Any, node: Any, code: int, arguments: Sequence[Any]) -> list[Any]:
        """Apply one operation of a function of matrices to SX matrices, and return the results."""
        if code == ca.OP_CONST:
            return [ca.SX(node.to_DM())]
        if code == ca.OP_CALL:
            callee = node.which_function()
            inputs = [ca.SX(callee.sparsity_in(k)) if value is None else value for k, value in enumerate(arguments)]
            return _call_on_scalars(callee, inputs)
        symbols = [ca.MX.sym("a", node.dep(k).sparsity()) for k in range(node.n_dep())]
        step = ca.Function("step", symbols, node.eval_mx(symbols))
        if code == ca.OP_LOW:
            table, at = ca.densify(arguments[0]), arguments[1]
            if _is_constant(table):
                mode = _fields(step, {"Low::lookup_mode": int})["Low::lookup_mode"]
                record = {"kind": "low", "table": _numbers(table), "count": at.nnz(), "mode": mode}
                return [self._call_leaf(record, at.nonzeros(), node.sparsity())]
            inner = table.nonzeros()[1:-1]
            indices = [sum((x >= edge for edge in inner), ca.SX(0)) for x in at.nonzeros()]
            return [from_entries(node.sparsity(), indices)]
        if code == ca.OP_GETNONZEROS_PARAM:
            return [self._gather(node, arguments)]
        if code == ca.OP_BSPLINE and node.n_dep() == 1:
            record = {"kind": "bspline", **_spline_fields(step), "count": arguments[0].size2()}
            return list(self._leaf(record).call([ca.densify(arguments[0])], False, True))
        if code == ca.OP_SOLVE:
            matrix = arguments[1].T if node.info()["tr"] else arguments[1]
            record = {"kind": "solve", "size": matrix.size1(), "columns": arguments[0].size2()}
            return [self._leaf(record).call([ca.densify(matrix), ca.densify(arguments[0])], False, True)[0]]
        if code == ca.OP_LOGSUMEXP:
            largest = ca.mmax(arguments[0])
            return [largest + ca.log(ca.sum1(ca.exp(arguments[0] - largest)))]
        return list(step.expand().call(list(arguments)))

    def _gather(self, node: Any, arguments: Sequence[Any]) -> Any:
        """Return expressions for table entries at computed positions; a constant table becomes a function call."""
        where, chosen = node.info(), [argument.nonzeros() for argument in arguments[1:]]
        sides = {
            side: [ca.SX(k) for k in range(*(where[side][key] for key in ("start", "stop", "step")))]
            for side in ("inner", "outer")
            if side in where
        }
        if "inner" in sides:
            outer, inner = chosen[0], sides["inner"]
        else:
            inner = chosen[0]
            outer = sides["outer"] if "outer" in sides else chosen[1] if len(chosen) > 1 else [ca.SX(0)]
        places = [a + b for a in outer for b in inner]
        table = arguments[0]
        if _is_constant(table):
            record = {"kind": "gather", "table": _numbers(table), "count": len(places)}
            return self._call_leaf(record, places, node.sparsity())
        entries = table.nonzeros()
        values = [sum((ca.if_else(place == k, x, 0) for k, x in enumerate(entries)), ca.SX(0)) for place in places]
        return from_entries(node.sparsity(), values)

    def _operations(self, function: Any) -> dict[str, Any]:
        """Return the record of a function of SX symbols: its scalar operations, constants and calls."""
        nodes: list[Any] = []
        rows: list[tuple[int, int, int]] = []
        constants: list[float] = []
        arguments: list[int] = []
        slots: dict[int, int] = {}
        outputs = [[0] * function.nnz_out(k) for k in range(function.n_out())]
        for k in range(function.n_instructions()):
            code = function.instruction_id(k)
            inputs, places = function.instruction_input(k), function.instruction_output(k)
            if code == ca.OP_OUTPUT:
                outputs[places[0]][places[1]] = slots[inputs[0]]
                continue
            if code == ca.OP_INPUT:
                rows.append((INPUT, *inputs))
            elif code == ca.OP_CONST:
                rows.append((CONSTANT, len(constants), 0))
                constants.append(function.instruction_constant(k))
            elif code == ca.OP_CALL:
                nodes = nodes or function.instructions_sx().nonzeros()
                begin, call = len(arguments), len(rows)
                arguments += [slots[slot] for slot in inputs]
                rows.append((CALL, self.write(nodes[k].which_function()), begin))
                for number, place in enumerate(places):
                    if place >= 0:
                        slots[place] = len(rows)
                        rows.append((RESULT, call, number))
                continue
            elif code in PLACES:
                operands = [slots[slot] for slot in inputs]
                rows.append((PLACES[code], operands[0], operands[-1]))
            elif code in (ca.OP_ASSIGN, ca.OP_LIFT):
                slots[places[0]] = slots[inputs[0]]
                continue
            else:
                raise _unwritable(function)
            slots[places[0]] = len(rows) - 1
        return {
            "kind": "operations",
            "inputs": [_pattern(function.sparsity_in(k)) for k in range(function.n_in())],
            "outputs": [_pattern(function.sparsity_out(k)) for k in range(function.n_out())],
            "rows": np.array(rows, dtype=np.int64).reshape(-1, 3),
            "constants": np.array(constants),
            "arguments": np.array(arguments, dtype=np.int64),
            "results": np.array([row for column in outputs for row in column], dtype=np.int64),
        }


def _unwritable(function: Any) -> ProblemError:
    name, kind = function.name(), function.class_name()
    words = f"function {name!r} of kind {kind} cannot be written as elementary operations"
    return ProblemError(words, name=name, value=kind)


def _pattern(pattern: Any) -> list[Any]:
    """Return the stored form of a sparsity pattern: row count, column count and, if sparse, entry positions."""
    shape = [pattern.size1(), pattern.size2()]
    return shape if pattern.is_dense() else [*shape, pattern.find()]


def _size(pattern: list[Any]) -> int:
    return len(pattern[2]) if len(pattern) > 2 else pattern[0] * pattern[1]


def _call_on_scalars(function: Any, inputs: Sequence[Any]) -> list[Any]:
    """Evaluate a function of any kind on SX matrices, without inlining the function if CasADi supports that."""
    if function.class_name() == "Switch":  # on scalars CasADi compares the case number, which it otherwise truncates
        case = ca.if_else(inputs[0] < 0, ca.ceil(inputs[0]), ca.floor(inputs[0]))
        inputs = [case, *inputs[1:]]
    return list(function.call(list(inputs), False, True))


def _is_constant(matrix: Any) -> bool:
    return all(entry.is_constant() for entry in matrix.nonzeros())


def _numbers(matrix: Any) -> np.ndarray:
    return np.array([float(entry) for entry in matrix.nonzeros()])


def _fields(function: Any, kinds: Mapping[str, Any]) -> dict[str, Any]:
    """Return the values of internal fields of a CasADi function by name, read from CasADi's debugging output.

    ``kinds`` gives the type of each field: `int`, `float`, or a list of one of them for an array. The text comes from a
    function of this process, never from a file.
    """
    letters = function.serialize({"debug": True})
    text = bytes(ord(low) - 97 + ((ord(high) - 97) << 4) for low, high in zip(letters[::2], letters[1::2], strict=True))
    types = {int: (b"J", "<i8"), float: (b"d", "<f8")}

    def value(at: int, kind: Any) -> Any:
        if isinstance(kind, list):
            count, letter = value(at + 1, int), types[kind[0]][0]
            entries = np.frombuffer(
                text[at + 10 : at + 10 + 9 * count], dtype=[("letter", "S1"), ("value", types[kind[0]][1])]
            )
            if text[at : at + 1] != b"V" or (entries["letter"] != letter).any():
                raise _unwritable(function)
            return entries["value"].copy()
        letter, dtype = types[kind]
        if text[at : at + 1] != letter:
            raise _unwritable(function)
        return kind(np.frombuffer(text[at + 1 : at + 9], dtype)[0])

    values = {}
    for name, kind in kinds.items():
        letter = b"V" if isinstance(kind, list) else types[kind][0]
        at = text.rfind(name.encode() + letter)  # the function's own fields follow those of its base
        if at >= 0:
            values[name] = value(at + len(name), kind)
    return values


def _spline_fields(step: Any) -> dict[str, Any]:
    """Return the numbers that define a casadi B-spline: knots, degrees, look-up modes and coefficients."""
    prefix = "BSplineCommon::"
    lists = {"offsets": "offset", "degrees": "degree", "modes": "lookup_mode"}
    kinds = {f"{prefix}{name}": [int] for name in lists.values()}
    numbers = _fields(step, {f"{prefix}knots": [float], "BSpline::coeffs": [float], f"{prefix}m": int, **kinds})
    return {
        "knots": numbers[f"{prefix}knots"],
        **{key: numbers[f"{prefix}{name}"].tolist() for key, name in lists.items()},
        "coefficients": numbers["BSpline::coeffs"],
        "size": numbers[f"{prefix}m"],
    }


def _interpolant_record(function: Any, kind: str) -> dict[str, Any]:
    """Return the record of a linear interpolant of casadi, or of its derivative."""
    prefix = "Interpolant::"
    kinds = {f"{prefix}{name}": [float] for name in ("grid", "values")}
    numbers = _fields(function, {**kinds, f"{prefix}offset": [int], f"{prefix}batch_x": int})
    if numbers[f"{prefix}batch_x"] != 1 or not numbers[f"{prefix}values"].size:
        raise _unwritable(function)
    return {
        "kind": "interpolant",
        "grid": numbers[f"{prefix}grid"],
        "offsets": numbers[f"{prefix}offset"].tolist(),
        "values": numbers[f"{prefix}values"],
        "derivative": kind == "LinearInterpolantJac",
    }


def _integrator_record(function: Any, oracle: int) -> dict[str, Any]:
    """Return the record of a casadi integrator, whose differential equations are the recorded function `oracle`."""
    kinds = dict(INTEGRATOR_OPTIONS.values())
    names = {"Integrator::t0": float, "Integrator::tout": [float], "Integrator::nfwd": int, "Integrator::nadj": int}
    numbers = _fields(function, {**kinds, **names})
    if numbers["Integrator::nfwd"] or numbers["Integrator::nadj"]:
        raise _unwritable(function)
    equations = function.oracle()
    return {
        "kind": "integrator",
        "plugin": INTEGRATORS[function.class_name()],
        "equations": oracle,
        "names": [equations.name_in(), equations.name_out()],
        "begin": numbers["Integrator::t0"],
        "times": numbers["Integrator::tout"],
        "options": {option: numbers[name] for option, (name, _) in INTEGRATOR_OPTIONS.items() if name in numbers},
    }


def to_record(name: str, symbols: Any, time: Any, declared: Any) -> dict[str, Any]:
    """Return a problem as names, numbers and arrays, without those guesses that are functions.

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
            label = str(ca.symvar(value)[0].name())  # entries of an SX column have numbered names
            label = label.rpartition("_")[0] if isinstance(value, ca.SX) and value.numel() > 1 else label
            return {"input": len(inputs) - 1, "size": value.numel(), "name": label}
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
                pool = [[key, put(item, is_symbol=True)] for key, item in parts["at_start"].items()]
                inside["at_start"] = {"pool": pool}
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


def pack_record(record: Any) -> tuple[Any, dict[str, np.ndarray]]:
    """Split a record into its structure, which JSON can represent, and its arrays, concatenated by type."""
    chunks: dict[str, list[np.ndarray]] = {name: [] for name in ARRAY_NAMES}
    lengths = dict.fromkeys(chunks, 0)

    def pack(value: Any) -> Any:
        if isinstance(value, np.ndarray):
            name = dict(zip("if", ARRAY_NAMES, strict=True))[value.dtype.kind]
            chunks[name].append(value.ravel())
            lengths[name] += value.size
            return {"array": name, "begin": lengths[name] - value.size, "shape": list(value.shape)}
        if isinstance(value, dict):
            return {key: pack(part) for key, part in value.items()}
        return [pack(part) for part in value] if isinstance(value, list | tuple) else value

    structure = pack(record)
    empty = {"integers": np.zeros(0, dtype=np.int64), "numbers": np.zeros(0)}
    return structure, {name: np.concatenate([empty[name], *parts]) for name, parts in chunks.items()}
