"""Read problems and CasADi functions from untrusted data; every part is checked before it is built.

A function is a list of scalar operations, each of which may use the results of earlier ones. It may call functions that
precede it, so calls are never recursive. Functions that are not scalar arithmetic (a look-up table, a spline, an
interpolant, a linear solve, an integrator) are stored by the numbers that define them. No part of a record reaches
CasADi's own reader of serialised functions, which can load libraries and run a compiler.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from itertools import pairwise
from typing import Any

import casadi as ca
import numpy as np

from ocp.errors import ProblemError

UNARY = (
    "NEG", "EXP", "LOG", "SQRT", "SQ", "TWICE", "SIN", "COS", "TAN", "ASIN", "ACOS", "ATAN", "NOT", "FLOOR", "CEIL",
    "FABS", "SIGN", "ERF", "INV", "SINH", "COSH", "TANH", "ASINH", "ACOSH", "ATANH", "ERFINV", "LOG1P", "EXPM1",
)  # fmt: skip
BINARY = (
    "ADD", "SUB", "MUL", "DIV", "POW", "CONSTPOW", "LT", "LE", "EQ", "NE", "AND", "OR", "FMOD", "COPYSIGN",
    "IF_ELSE_ZERO", "FMIN", "FMAX", "ATAN2", "HYPOT", "REMAINDER",
)  # fmt: skip
STRUCTURAL = ("INPUT", "CONSTANT", "CALL", "RESULT")
OPERATIONS = (*STRUCTURAL, *UNARY, *BINARY)
"""Names of the operations in stored functions. Files store indices of this list: append only, never reorder."""
INPUT, CONSTANT, CALL, RESULT = range(len(STRUCTURAL))
CODES = [getattr(ca, f"OP_{name}") for name in OPERATIONS[len(STRUCTURAL) :]]
PLACES = {code: place for place, code in enumerate(CODES, len(STRUCTURAL))}
FIRST_BINARY = len(STRUCTURAL) + len(UNARY)

MAX_OPERATIONS = 2**20
"""Maximum number of operations in a file; rebuilding an operation takes about 5 microseconds and 200 bytes."""
MAX_WORK = 2**26
"""Maximum number of operations of one function evaluation with all nested calls, which can be many in a short file."""
MAX_ENTRIES = 2**20
"""Maximum number of entries of all arguments and results of the functions of a file."""
OPAQUE = {"never_inline": True}
"""CasADi options that keep functions other than scalar arithmetic as calls when applied to scalar symbols."""
MAX_DIMENSIONS = 6
"""Maximum number of dimensions of an interpolated table."""
MAX_DEGREE = 9
"""Maximum degree of a spline."""
INTEGRATORS = {"RungeKutta": "rk", "Collocation": "collocation", "CvodesInterface": "cvodes", "IdasInterface": "idas"}
INTEGRATOR_OPTIONS: dict[str, tuple[str, type]] = {
    "number_of_finite_elements": ("FixedStepIntegrator::nk_target", int),
    "interpolation_order": ("Collocation::deg", int),
    "abstol": ("SundialsInterface::abstol", float),
    "reltol": ("SundialsInterface::reltol", float),
    "max_num_steps": ("SundialsInterface::max_num_steps", int),
}
"""Integrator options that a file stores, with their names in CasADi's debugging output and their types."""


class FunctionReader:
    """Builder of CasADi functions from stored records; it rejects records that no `FunctionWriter` writes.

    Args:
        records: As of a `FunctionWriter`, from an untrusted source.

    Attributes:
        functions: A CasADi Function for each record.

    Raises:
        ProblemError: An invalid operation, index, size or number; too many operations in the file or in one evaluation.
    """

    def __init__(self, records: Sequence[Mapping[str, Any]]) -> None:
        self.functions: list[Any] = []
        self._work: list[int] = []
        self._passed = 0  # total entries of the arguments of calls
        total = len(records) + sum(len(record["rows"]) for record in records if record["kind"] == "operations")
        for what, count, most in (
            ("operations", total, MAX_OPERATIONS),
            ("entries", sum(map(_declared_entries, records)), MAX_ENTRIES),
        ):
            if not 0 <= count <= most:
                raise ProblemError(f"{count} {what}, at most {most} are read", name=what, value=count, limit=most)
        for number, record in enumerate(records):
            kind = record["kind"]
            if kind == "operations":
                function, work = self._rebuild(record, f"stored_{number}")
            elif kind in BUILDERS:
                function, work = BUILDERS[kind](record, self.functions), MAX_ENTRIES if kind == "integrator" else 1
            else:
                raise ProblemError(f"functions of kind {kind!r} are unknown", name="kind", value=kind)
            if work > MAX_WORK:
                words = f"function {number} takes {work} operations, at most {MAX_WORK} are accepted"
                raise ProblemError(words, name="rows", value=work, limit=MAX_WORK)
            self.functions.append(function)
            self._work.append(work)

    def _rebuild(self, record: Mapping[str, Any], name: str) -> tuple[Any, int]:
        """Return a function rebuilt from its stored operations, and the number of operations of one evaluation.

        It has SX symbols, or MX symbols if it calls other functions: only these differentiate all calls as CasADi does.
        """
        patterns = [_read_pattern(shape) for shape in record["inputs"]]
        table, constants = _integers(record["rows"], (None, 3)), _floats(record["constants"]).tolist()
        rows, kind = table.tolist(), ca.MX if (table[:, 0] == CALL).any() else ca.SX
        inputs = [kind.sym(f"i{k}", pattern) for k, pattern in enumerate(patterns)]
        input_entries = [_nonzeros(symbol) for symbol in inputs]
        arguments, work = _integers(record["arguments"], (None,)).tolist(), len(rows)
        values: list[Any] = []  # a scalar of each row; for a call the list of its results

        def operand(row: int) -> Any:
            value = values[_check_index(row, len(values), "operand")]
            if isinstance(value, list):
                raise ProblemError(f"operand {row} is a call, not a number", name="rows", value=row)
            return value

        for operation, first, second in rows:
            if operation == INPUT:
                entries = input_entries[_check_index(first, len(input_entries), "input")]
                values.append(entries[_check_index(second, len(entries), "entry")])
            elif operation == CONSTANT:
                values.append(kind(constants[_check_index(first, len(constants), "constant")]))
            elif operation == CALL:
                callee = self.functions[_check_index(first, len(self.functions), "function")]
                work += self._work[first]
                self._passed += _entries(callee)
                if self._passed > MAX_OPERATIONS:
                    words = f"calls have more than {MAX_OPERATIONS} arguments"
                    raise ProblemError(words, name="arguments", limit=MAX_OPERATIONS)
                values.append(_call(callee, [operand(row) for row in arguments[max(second, 0) :][: _entries(callee)]]))
            elif operation == RESULT:
                results = values[_check_index(first, len(values), "call")]
                if not isinstance(results, list):
                    raise ProblemError(f"row {first} is not a call", name="rows", value=first)
                values.append(results[_check_index(second, len(results), "result")])
            elif CALL < operation < FIRST_BINARY:
                values.append(kind.unary(CODES[operation - len(STRUCTURAL)], operand(first)))
            elif operation < len(OPERATIONS) and operation > 0:
                values.append(kind.binary(CODES[operation - len(STRUCTURAL)], operand(first), operand(second)))
            else:
                words = f"operation {operation} is unknown, only 0 to {len(OPERATIONS) - 1} exist"
                raise ProblemError(words, name="operation", value=operation, limit=len(OPERATIONS) - 1)
        patterns = [_read_pattern(shape) for shape in record["outputs"]]
        results = _integers(record["results"], (sum(pattern.nnz() for pattern in patterns),)).tolist()
        entries = [operand(row) for row in results]
        return ca.Function(name, inputs, matrices_from(patterns, entries, kind)), work


def from_entries(pattern: Any, entries: Sequence[Any], kind: Any = ca.SX) -> Any:
    """Build a matrix of a given sparsity pattern from its nonzero entries."""
    return kind(pattern, ca.vertcat(*entries) if entries else kind(0, 1))


def matrices_from(patterns: Sequence[Any], entries: Sequence[Any], kind: Any) -> list[Any]:
    """Build matrices of given sparsity patterns from one list of the nonzero entries of all matrices."""
    ends = np.cumsum([0, *(pattern.nnz() for pattern in patterns)]).tolist()
    return [from_entries(pattern, entries[a:b], kind) for pattern, (a, b) in zip(patterns, pairwise(ends), strict=True)]


def _nonzeros(matrix: Any) -> list[Any]:
    """Return the nonzero entries of an SX or MX matrix as scalar expressions, column by column."""
    return matrix.nonzeros() if isinstance(matrix, ca.SX) else [matrix.nz[k] for k in range(matrix.nnz())]


def _declared_entries(record: Mapping[str, Any]) -> int:
    """Return the number of matrix entries, zeros included, of the arguments and results of a recorded function."""
    if record["kind"] == "operations":
        return sum(abs(shape[0] * shape[1]) for shape in (*record["inputs"], *record["outputs"]))
    sizes = [abs(int(record.get(what, 1))) for what in ("count", "size", "columns")]
    return int(np.prod(sizes, dtype=object)) + sizes[1] ** 2


def _entries(function: Any) -> int:
    """Return the number of nonzero entries of all arguments of a function."""
    return sum(function.nnz_in(k) for k in range(function.n_in()))


def _call(callee: Any, entries: list[Any]) -> list[Any]:
    """Call a function on one list of the nonzeros of all arguments; return the nonzeros of all results as a list."""
    if len(entries) != _entries(callee):
        raise ProblemError(f"a call has {len(entries)} arguments, not {_entries(callee)}", name="arguments")
    arguments = matrices_from([callee.sparsity_in(k) for k in range(callee.n_in())], entries, ca.MX)
    return [entry for result in callee.call(arguments, False, True) for entry in _nonzeros(result)]


def _check_index(place: int, count: int, what: str) -> int:
    """Return an index; raise ProblemError unless it is below the number `count` of items, such as operands."""
    if not 0 <= place < count:
        raise ProblemError(f"{what} {place} does not exist, there are {count}", name=what, value=place, limit=count)
    return place


def _check_integer(value: Any, what: str, least: int, most: int) -> int:
    """Return a value of untrusted data; raise ProblemError unless it is an integer from `least` to `most`."""
    if isinstance(value, bool) or not isinstance(value, int) or not least <= value <= most:
        words = f"{what} {value!r} is not an integer from {least} to {most}"
        raise ProblemError(words, name=what, value=value, limit=(least, most))
    return value


def _integers(values: Any, shape: tuple[int | None, ...]) -> np.ndarray:
    """Return untrusted values as an array of integers; raise ProblemError if a size differs from `shape`."""
    array = np.asarray(values)
    fits = array.ndim == len(shape) and all(n in (None, m) for n, m in zip(shape, array.shape, strict=True))
    if not fits or (array.dtype.kind not in "iu" and array.size):
        raise ProblemError(f"integers of shape {shape} are expected, not {array.dtype} of {array.shape}", name="rows")
    return array


def _floats(values: Any, *, finite: bool = False) -> np.ndarray:
    """Return untrusted values as an array (n,) of floats; raise ProblemError if this is impossible."""
    array = np.asarray(values)
    if array.ndim != 1 or (array.dtype.kind not in "fiu" and array.size) or (finite and not np.isfinite(array).all()):
        raise ProblemError(f"a list of {'finite ' if finite else ''}numbers is expected", name="constants")
    return array.astype(float)


def _read_pattern(shape: Any) -> Any:
    """Return the sparsity pattern of a stored shape: row count, column count and, if sparse, entry positions."""
    if not isinstance(shape, list) or len(shape) not in (2, 3):
        raise ProblemError(f"a shape is expected, not {shape!r:.80}", name="shape")
    rows, columns = (_check_integer(size, "size", 0, MAX_ENTRIES) for size in shape[:2])
    if rows * columns > MAX_ENTRIES:
        raise ProblemError(f"{rows} x {columns} entries, at most {MAX_ENTRIES}", name="shape", limit=MAX_ENTRIES)
    if len(shape) == 2:
        return ca.Sparsity.dense(rows, columns)
    places = _integers(shape[2], (None,))
    if places.size and (places[0] < 0 or places[-1] >= rows * columns or (np.diff(places) <= 0).any()):
        raise ProblemError("positions of entries do not increase within the matrix", name="shape")
    return ca.Sparsity.nonzeros(rows, columns, places.tolist())


def _build_low(record: Mapping[str, Any], _: Sequence[Any]) -> Any:
    """Rebuild CasADi's function `low` from its record: the index of the table interval that contains a number."""
    table, modes = _floats(record["table"], finite=True), ("linear", "exact", "binary")
    count, mode = _check_integer(record["count"], "count", 0, MAX_ENTRIES), _check_integer(record["mode"], "mode", 0, 2)
    if len(table) < 2 or (np.diff(table) < 0).any():
        raise ProblemError("the grid of a table does not increase", name="table")
    x = ca.MX.sym("x", count)
    return ca.Function("low", [x], [ca.low(ca.DM(table), x, {"lookup_mode": modes[mode]})], OPAQUE)


def _build_gather(record: Mapping[str, Any], _: Sequence[Any]) -> Any:
    """Rebuild from its record a function that looks up table entries at computed positions; nan outside the table."""
    table, x = _floats(record["table"]), ca.MX.sym("x", _check_integer(record["count"], "count", 0, MAX_ENTRIES))
    if not len(table):
        raise ProblemError("a table is empty", name="table")
    return ca.Function("gather", [x], [ca.MX(ca.DM(table)).get_nz(False, x)], OPAQUE)


def _build_solve(record: Mapping[str, Any], _: Sequence[Any]) -> Any:
    """Rebuild from its record a function that solves a system of linear equations."""
    size, columns = (_check_integer(record[what], what, 1, 1024) for what in ("size", "columns"))
    matrix, right = ca.MX.sym("A", size, size), ca.MX.sym("b", size, columns)
    return ca.Function("solve", [matrix, right], [ca.solve(matrix, right)], OPAQUE)


def _grids(record: Mapping[str, Any], what: str) -> list[list[float]]:
    """Return the grid of a stored table along each dimension; raise ProblemError if it does not increase."""
    places, offsets = _floats(record[what], finite=True), _integers(record["offsets"], (None,)).tolist()
    if not 2 <= len(offsets) <= MAX_DIMENSIONS + 1 or offsets[0] != 0 or offsets[-1] != len(places):
        raise ProblemError(f"the offsets of a grid of {len(offsets) - 1} dimensions are inconsistent", name="offsets")
    grids = [places[begin:end] for begin, end in pairwise(offsets)]
    if any(len(grid) < 2 or (np.diff(grid) < 0).any() for grid in grids):
        raise ProblemError("the grid of a table does not increase", name=what)
    return [grid.tolist() for grid in grids]


def _build_bspline(record: Mapping[str, Any], _: Sequence[Any]) -> Any:
    """Rebuild from its record a B-spline of one or several variables."""
    knots, coefficients = _grids(record, "knots"), _floats(record["coefficients"])
    degrees = [_check_integer(degree, "degree", 0, MAX_DEGREE) for degree in record["degrees"]]
    modes = [("linear", "exact", "binary")[_check_integer(mode, "mode", 0, 2)] for mode in record["modes"]]
    size, count = (_check_integer(record[what], what, 1, MAX_ENTRIES) for what in ("size", "count"))
    if len(degrees) != len(knots) or len(modes) != len(knots):
        raise ProblemError(f"{len(degrees)} degrees for {len(knots)} dimensions", name="degrees")
    lengths = [len(grid) - degree - 1 for grid, degree in zip(knots, degrees, strict=True)]
    if min(lengths) < 1 or any(length <= degree for length, degree in zip(lengths, degrees, strict=True)):
        raise ProblemError("a spline has too few knots for its degree", name="knots")
    if len(coefficients) != size * int(np.prod(lengths, dtype=object)):
        raise ProblemError(f"{len(coefficients)} coefficients for {lengths} x {size}", name="coefficients")
    x = ca.MX.sym("x", len(knots), count)
    value = ca.bspline(x, ca.DM(coefficients), knots, degrees, size, {"lookup_mode": modes})
    return ca.Function("bspline", [x], [value], OPAQUE)


def _build_interpolant(record: Mapping[str, Any], _: Sequence[Any]) -> Any:
    """Rebuild from its record a linear interpolant of a table, or the derivative of such an interpolant."""
    grids, values = _grids(record, "grid"), _floats(record["values"])
    cells = int(np.prod([len(grid) for grid in grids], dtype=object))
    if not len(values) or len(values) % cells or any((np.diff(grid) <= 0).any() for grid in grids):
        raise ProblemError(f"{len(values)} values for a table of {cells}", name="values", value=len(values))
    function = ca.interpolant("interpolant", "linear", grids, values.tolist())
    return function.jacobian() if record["derivative"] is True else function


def _build_integrator(record: Mapping[str, Any], functions: Sequence[Any]) -> Any:
    """Rebuild from its record an integrator, whose differential equations are another stored function."""
    number = _check_integer(record["equations"], "equations", 0, MAX_ENTRIES)
    equations = functions[_check_index(number, len(functions), "equations")]
    if record["plugin"] not in INTEGRATORS.values():
        raise ProblemError(f"integrator {record['plugin']!r} is unknown", name="plugin", value=record["plugin"])
    begin, times = float(record["begin"]), _floats(record["times"], finite=True)
    if not np.isfinite(begin) or not len(times) or (np.diff([begin, *times]) < 0).any():
        raise ProblemError("an integrator's times do not increase", name="times")
    options = dict(record["options"])
    for option, value in options.items():
        kind = INTEGRATOR_OPTIONS[option][1]
        if kind is int:
            _check_integer(value, option, 0, 9 if option == "interpolation_order" else 100_000)
        elif not (isinstance(value, float) and 0 < value < 1):
            raise ProblemError(f"{option} {value!r} is not a tolerance", name=option, value=value)
    names = [("t", "x", "z", "p", "u"), ("ode", "alg", "quad", "zero")]
    if [tuple(labels) for labels in record["names"]] != names or (equations.n_in(), equations.n_out()) != (5, 4):
        raise ProblemError("an integrator's equations have wrong arguments", name="names", value=record["names"])
    symbols = [ca.MX.sym(name, equations.sparsity_in(k)) for k, name in enumerate(names[0])]
    named = ca.Function("equations", symbols, equations.call(symbols), *(list(labels) for labels in names))
    return ca.integrator("integrator", record["plugin"], named, begin, times.tolist(), options)


BUILDERS: dict[str, Callable[[Mapping[str, Any], Sequence[Any]], Any]] = {
    "low": _build_low,
    "gather": _build_gather,
    "solve": _build_solve,
    "bspline": _build_bspline,
    "interpolant": _build_interpolant,
    "integrator": _build_integrator,
}


SYMBOLS = {"SX": ca.SX, "MX": ca.MX}
RECORD_ERRORS = (
    AttributeError, IndexError, KeyError, NotImplementedError, OverflowError, RecursionError, RuntimeError, TypeError,
    ValueError,
)  # fmt: skip
"""Errors that rebuilding objects from damaged data may raise."""
ARRAY_NAMES = ("integers", "numbers")
"""Names of the arrays into which a record is packed."""


def from_record(record: Mapping[str, Any], kinds: Sequence[type]) -> tuple[str, Any, Any, Any]:
    """Return name, symbol type, time symbol and declarations of a problem rebuilt from its record with new symbols.

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
    """Rebuild a problem from its record; raise any of `RECORD_ERRORS` if the record is damaged."""
    symbols, functions = SYMBOLS[record["symbols"]], FunctionReader(record["functions"]).functions
    expressions = functions[record["expressions"]]
    time = symbols.sym("time")
    inputs: list[Any] = [time] + [None] * (expressions.n_in() - 1)
    for symbol in _symbols_in(record["declared"]):
        if inputs[symbol["input"]] is not None or not isinstance(symbol["name"], str):
            raise ValueError(f"symbol {symbol['input']} occurs twice")
        size = expressions.size_in(symbol["input"])
        if size != (symbol["size"], 1):
            words = f"symbol {symbol['name']!r} has {symbol['size']} entries, the input of the function {size}"
            raise ValueError(words)
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
    """Yield those parts of a record of declarations that describe symbols."""
    if isinstance(value, dict) and "input" in value:
        yield value
    elif isinstance(value, dict | list):
        for part in value.values() if isinstance(value, dict) else value:
            yield from _symbols_in(part)


def unpack_record(structure: Any, arrays: Mapping[str, np.ndarray]) -> Any:
    """Return the record that :func:`pack_record` has split into structure and arrays.

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
