"""CasADi functions written as data: lists of elementary operations, as :mod:`ocp.problem.function_reader` reads them.

A function of matrices is worked out on scalars, operation by operation. The numbers that define tables, splines and
integrators come from CasADi's own debugging output of a function, which is never read from a file.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import casadi as ca
import numpy as np

from ocp.errors import ProblemError
from ocp.problem.function_reader import (
    BUILDERS,
    CALL,
    CONSTANT,
    INPUT,
    INTEGRATOR_OPTIONS,
    INTEGRATORS,
    PLACES,
    RESULT,
    shaped,
)

__all__ = ["FunctionWriter"]


class FunctionWriter:
    """Writes functions as records, each once, after the functions that it calls.

    Attributes:
        records: Of each function a dictionary of text, numbers, lists and arrays, as `FunctionReader` takes them.
    """

    def __init__(self) -> None:
        self.records: list[dict[str, Any]] = []
        self._written: list[Any] = []  # the functions of the records
        self._numbers: dict[int, int] = {}
        self._pending: set[int] = set()
        self._kept: list[Any] = []  # a function that is gone gives its hash to another one

    def write(self, function: Any) -> int:
        """Return the number of a function's record.

        Raises:
            ProblemError: The function, or one that it calls, cannot be written, such as a callback of Python's.
        """
        key = function.__hash__()
        if key in self._numbers:
            return self._numbers[key]
        if key in self._pending:
            raise _unwritable(function)
        self._pending.add(key)
        self._kept.append(function)
        kind = function.class_name()
        if kind == "BSplineInterpolant":
            return self._numbered(key, self.write(function.find_functions()[0]))
        if kind in ("LinearInterpolant", "LinearInterpolantJac"):
            record = _interpolant_record(function, kind)
        elif kind in INTEGRATORS:
            record = _integrator_record(function, self.write(function.oracle()))
        else:
            record = self._operations(self._as_scalars(function))
            if (callee := self._passed_to(record)) is not None:
                return self._numbered(key, callee)
        return self._append(key, record, function)

    def _append(self, key: int, record: dict[str, Any], function: Any) -> int:
        self.records.append(record)
        self._written.append(function)
        return self._numbered(key, len(self.records) - 1)

    def _passed_to(self, record: dict[str, Any]) -> int | None:
        """The number of the function to which a function passes all that it is given, and nothing else; None if none.

        Without this look, every writing of what was read would wrap its tables in one more function.
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

    def _numbered(self, key: int, number: int) -> int:
        self._numbers[key] = number
        return number

    def _leaf(self, record: dict[str, Any]) -> Any:
        """A function of a record, known under it."""
        function = BUILDERS[record["kind"]](record, ())
        self._kept.append(function)
        self._append(function.__hash__(), record, function)
        return function

    def _called(self, record: dict[str, Any], entries: Sequence[Any], pattern: Any) -> Any:
        """The result of a function of one column that a record defines."""
        given = ca.vertcat(*entries) if entries else ca.SX(0, 1)
        return shaped(pattern, self._leaf(record).call([given], False, True)[0].nonzeros())

    def _as_scalars(self, function: Any) -> Any:
        """The same function of SX symbols, with calls for what is no scalar arithmetic."""
        kind = function.class_name()
        if kind == "SXFunction":
            return function
        inputs = [ca.SX.sym(f"i{k}", function.sparsity_in(k)) for k in range(function.n_in())]
        try:
            outputs = (
                self._interpreted(function, inputs) if kind == "MXFunction" else _called_on_scalars(function, inputs)
            )
            return ca.Function(function.name(), inputs, outputs)
        except (RuntimeError, NotImplementedError) as error:
            raise _unwritable(function) from error

    def _interpreted(self, function: Any, inputs: Sequence[Any]) -> list[Any]:
        """The results of a function of matrices, worked out on SX matrices."""
        values: dict[int, Any] = {}
        outputs: list[list[Any]] = [[] for _ in range(function.n_out())]
        for k in range(function.n_instructions()):
            code = function.instruction_id(k)
            slots, places = function.instruction_input(k), function.instruction_output(k)
            if code == ca.OP_OUTPUT:
                outputs[places[0]] += values[slots[0]].nonzeros()  # an output may come in several parts, in order
                continue
            node = function.instruction_MX(k)
            if code == ca.OP_INPUT:
                where = node.info()
                entries = inputs[where["ind"]].nonzeros()[where["offset"] : where["offset"] + node.nnz()]
                results = [shaped(node.sparsity(), entries)]
            else:
                arguments = [values[slot] if slot >= 0 else None for slot in slots]
                results = self._applied(function, node, code, arguments)
            values.update((slot, result) for slot, result in zip(places, results, strict=True) if slot >= 0)
        return [shaped(function.sparsity_out(k), entries) for k, entries in enumerate(outputs)]

    def _applied(self, function: Any, node: Any, code: int, arguments: Sequence[Any]) -> list[Any]:
        """The results of one operation on matrices."""
        if code == ca.OP_CONST:
            return [ca.SX(node.to_DM())]
        if code == ca.OP_CALL:
            callee = node.which_function()
            given = [ca.SX(callee.sparsity_in(k)) if value is None else value for k, value in enumerate(arguments)]
            return _called_on_scalars(callee, given)
        symbols = [ca.MX.sym("a", node.dep(k).sparsity()) for k in range(node.n_dep())]
        step = ca.Function("step", symbols, node.eval_mx(symbols))
        if code == ca.OP_LOW:
            table, at = ca.densify(arguments[0]), arguments[1]
            if _is_constant(table):
                mode = _fields(step, {"Low::lookup_mode": int})["Low::lookup_mode"]
                record = {"kind": "low", "table": _numbers(table), "count": at.nnz(), "mode": mode}
                return [self._called(record, at.nonzeros(), node.sparsity())]
            inner = table.nonzeros()[1:-1]
            return [shaped(node.sparsity(), [sum((x >= edge for edge in inner), ca.SX(0)) for x in at.nonzeros()])]
        if code == ca.OP_GETNONZEROS_PARAM:
            return [self._gathered(node, arguments)]
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

    def _gathered(self, node: Any, arguments: Sequence[Any]) -> Any:
        """Entries of a table at places that are computed."""
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
            return self._called(record, places, node.sparsity())
        entries = table.nonzeros()
        found = [sum((ca.if_else(place == k, one, 0) for k, one in enumerate(entries)), ca.SX(0)) for place in places]
        return shaped(node.sparsity(), found)

    def _operations(self, function: Any) -> dict[str, Any]:
        """The record of a function of SX symbols."""
        nodes: list[Any] = []
        rows: list[tuple[int, int, int]] = []
        constants: list[float] = []
        arguments: list[int] = []
        slots: dict[int, int] = {}
        outputs = [[0] * function.nnz_out(k) for k in range(function.n_out())]
        for k in range(function.n_instructions()):
            code = function.instruction_id(k)
            given, places = function.instruction_input(k), function.instruction_output(k)
            if code == ca.OP_OUTPUT:
                outputs[places[0]][places[1]] = slots[given[0]]
                continue
            if code == ca.OP_INPUT:
                rows.append((INPUT, *given))
            elif code == ca.OP_CONST:
                rows.append((CONSTANT, len(constants), 0))
                constants.append(function.instruction_constant(k))
            elif code == ca.OP_CALL:
                nodes = nodes or function.instructions_sx().nonzeros()
                begin, call = len(arguments), len(rows)
                arguments += [slots[slot] for slot in given]
                rows.append((CALL, self.write(nodes[k].which_function()), begin))
                for number, place in enumerate(places):
                    if place >= 0:
                        slots[place] = len(rows)
                        rows.append((RESULT, call, number))
                continue
            elif code in PLACES:
                operands = [slots[slot] for slot in given]
                rows.append((PLACES[code], operands[0], operands[-1]))
            elif code in (ca.OP_ASSIGN, ca.OP_LIFT):
                slots[places[0]] = slots[given[0]]
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
    """Rows, columns and, of a sparse one, the places of its entries column by column."""
    shape = [pattern.size1(), pattern.size2()]
    return shape if pattern.is_dense() else [*shape, pattern.find()]


def _size(pattern: list[Any]) -> int:
    return len(pattern[2]) if len(pattern) > 2 else pattern[0] * pattern[1]


def _called_on_scalars(function: Any, inputs: Sequence[Any]) -> list[Any]:
    """The results of a function of any kind on SX matrices, as a call where CasADi can make one."""
    if function.class_name() == "Switch":  # on scalars it compares the number of the case, which it else cuts off
        case = ca.if_else(inputs[0] < 0, ca.ceil(inputs[0]), ca.floor(inputs[0]))
        inputs = [case, *inputs[1:]]
    return list(function.call(list(inputs), False, True))


def _is_constant(matrix: Any) -> bool:
    return all(entry.is_constant() for entry in matrix.nonzeros())


def _numbers(matrix: Any) -> np.ndarray:
    return np.array([float(entry) for entry in matrix.nonzeros()])


def _fields(function: Any, kinds: Mapping[str, Any]) -> dict[str, Any]:
    """Values that CasADi tells of a function by name in its debugging output: `int`, `float` or lists of them.

    The text comes from a function of this process, never from a file.
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

    found = {}
    for name, kind in kinds.items():
        letter = b"V" if isinstance(kind, list) else types[kind][0]
        at = text.rfind(name.encode() + letter)  # of what the function was derived from it tells before
        if at >= 0:
            found[name] = value(at + len(name), kind)
    return found


def _spline_fields(step: Any) -> dict[str, Any]:
    own = "BSplineCommon::"
    kinds = {f"{own}{name}": [int] for name in ("offset", "degree", "lookup_mode")}
    told = _fields(step, {f"{own}knots": [float], "BSpline::coeffs": [float], f"{own}m": int, **kinds})
    return {
        "knots": told[f"{own}knots"],
        "offsets": told[f"{own}offset"].tolist(),
        "degrees": told[f"{own}degree"].tolist(),
        "modes": told[f"{own}lookup_mode"].tolist(),
        "coefficients": told["BSpline::coeffs"],
        "size": told[f"{own}m"],
    }


def _interpolant_record(function: Any, kind: str) -> dict[str, Any]:
    told = _fields(
        function,
        {
            "Interpolant::grid": [float],
            "Interpolant::values": [float],
            "Interpolant::offset": [int],
            "Interpolant::m": int,
            "Interpolant::batch_x": int,
        },
    )
    if told["Interpolant::batch_x"] != 1 or not told["Interpolant::values"].size:
        raise _unwritable(function)
    return {
        "kind": "interpolant",
        "grid": told["Interpolant::grid"],
        "offsets": told["Interpolant::offset"].tolist(),
        "values": told["Interpolant::values"],
        "derivative": kind == "LinearInterpolantJac",
    }


def _integrator_record(function: Any, oracle: int) -> dict[str, Any]:
    kinds = dict(INTEGRATOR_OPTIONS.values())
    names = {"Integrator::t0": float, "Integrator::tout": [float], "Integrator::nfwd": int, "Integrator::nadj": int}
    told = _fields(function, {**kinds, **names})
    if told["Integrator::nfwd"] or told["Integrator::nadj"]:
        raise _unwritable(function)
    equations = function.oracle()
    return {
        "kind": "integrator",
        "plugin": INTEGRATORS[function.class_name()],
        "equations": oracle,
        "names": [equations.name_in(), equations.name_out()],
        "begin": told["Integrator::t0"],
        "times": told["Integrator::tout"],
        "options": {option: told[name] for option, (name, _) in INTEGRATOR_OPTIONS.items() if name in told},
    }
