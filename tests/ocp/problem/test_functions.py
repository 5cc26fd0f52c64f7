"""Functions written as operations are the same functions when they are read, and nothing else can be read."""

from __future__ import annotations

import os
from collections.abc import Callable
from contextlib import suppress
from copy import deepcopy
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
import pytest
from hypothesis import given, strategies

from ocp import ProblemError
from ocp.problem.record_reader import BINARY, MAX_ENTRIES, MAX_OPERATIONS, MAX_WORK, OPERATIONS, UNARY, FunctionReader
from ocp.problem.record_writer import FunctionWriter

GRID = np.linspace(0.0, 1.0, 5)
TABLE = ca.interpolant("table", "linear", [GRID, GRID], np.outer(GRID, GRID**2).ravel())
SPLINE = ca.interpolant("spline", "bspline", [GRID], np.sin(GRID))
SURFACE = ca.interpolant("surface", "bspline", [GRID, GRID], np.outer(GRID, GRID**2).ravel())
X, A = ca.MX.sym("x", 2), ca.MX.sym("A", 2, 2)
Y = ca.SX.sym("y", 2)
SQUARES = ca.Function("squares", [X], [X**2])
DECAY = {"x": (decaying := ca.MX.sym("x")), "p": (rate := ca.MX.sym("p")), "ode": -decaying * rate}
CHOICE = ca.Function.if_else("choice", ca.Function("yes", [Y], [Y**2]), ca.Function("no", [Y], [Y + 1]))


def integral(plugin: str, times: Any = 1.0, **options: Any) -> Any:
    run = ca.integrator("run", plugin, DECAY, 0.25, times, options)
    return run(x0=X[0], p=X[1])["xf"]


def many(function: Any) -> Any:
    return function(ca.horzcat(X, X / 2, X / 3))


EXPRESSIONS: dict[str, Callable[[], Any]] = {
    "interpolant": lambda: TABLE(X),
    "derivative of an interpolant": lambda: ca.gradient(TABLE(X), X),
    "spline": lambda: SPLINE(X[0]),
    "spline of two variables": lambda: SURFACE(X),
    "second derivative of a spline": lambda: ca.hessian(SPLINE(X[0]), X)[0],
    "spline by its knots": lambda: ca.bspline(X[0], ca.DM([0, 1, 2, 3, 4]), [[0, 0, 0, 0.3, 0.6, 1, 1, 1]], [2], 1),
    "cell of a table": lambda: ca.low(ca.DM(GRID), X),
    "cell of a variable table": lambda: ca.low(ca.vertcat(0, X * 0.5, 1), X[0]),
    "entry of a table": lambda: ca.MX(ca.DM(np.arange(12.0).reshape(4, 3)))[:, ca.floor(3 * X[0])],
    "entries of a matrix": lambda: A[ca.floor(2 * X), ca.floor(2 * X)],
    "row of a matrix": lambda: A[ca.floor(2 * X), 1],
    "linear system": lambda: ca.solve(A, X),
    "transposed linear system": lambda: ca.solve(A.T, X),
    "inverse": lambda: ca.inv(A),
    "determinant": lambda: ca.det(A),
    "Runge-Kutta": lambda: integral("rk", [0.5, 1.0], number_of_finite_elements=7),
    "collocation": lambda: integral("collocation", interpolation_order=4),
    "cvodes": lambda: integral("cvodes", abstol=1e-9),
    "choice": lambda: CHOICE(X[0], X),
    "map": lambda: many(SQUARES.map(3)),
    "derivative of a map": lambda: ca.jacobian(many(SQUARES.map(3)), X),
    "map of an interpolant": lambda: many(TABLE.map(3)),
    "accumulation": lambda: SQUARES.mapaccum(3)(X),
    "matrix algebra": lambda: ca.vertcat(
        ca.bilin(A, X, X), ca.vec(ca.rank1(A, 2, X, X)), ca.mtimes(A, X), ca.norm_inf(X)
    ),
    "log of a sum": lambda: ca.logsumexp(X),
    "cases": lambda: ca.conditional(X[0], [X[1], X[0]], X[0]),
    "branches": lambda: ca.if_else(X[0] > 0.2, X[1], X[0], True),
    "parts": lambda: ca.vertcat(ca.vertsplit(ca.sin(X))[1] * X, ca.horzsplit(A)[1], ca.vec(ca.repmat(X, 2, 2))),
    "assertion": lambda: X.attachAssert(X[0] > 0),
    "sparse": lambda: ca.jacobian(ca.sin(X), X),
    "blocks": lambda: ca.blockcat([[A, X], [X.T, 1]]),
}
POINTS = ([0.3, 0.6], [0.9, 0.1], [0.5, 0.25])
MATRIX = ca.DM([[2.0, 1.0], [1.0, 3.0]])


def copied(function: Any) -> Any:
    return FunctionReader(written(function)).functions[-1]


def written(function: Any) -> list[dict[str, Any]]:
    writer = FunctionWriter()
    assert writer.write(function) == len(writer.records) - 1
    return writer.records


def values(expression: Any, of: list[Any], at: list[Any]) -> Any:
    return ca.Function("values", of, [ca.densify(expression)])(*at).full()


@pytest.mark.parametrize("what", EXPRESSIONS)
def test_a_function_and_its_derivative_survive_being_written(what: str) -> None:
    function = ca.Function("function", [X, A], [EXPRESSIONS[what]()])
    again = copied(function)
    assert again.sparsity_out(0) == function.sparsity_out(0)
    for point in POINTS:
        at = [ca.DM(point), MATRIX]
        np.testing.assert_allclose(again(*at).full(), function(*at).full(), rtol=1e-13, atol=1e-14)
        slopes = [values(ca.jacobian(one(X, A), X), [X, A], at) for one in (function, again)]
        tolerance = 1e-5 if what in ("cvodes", "collocation") else 1e-12  # of the integrator's own sensitivities
        np.testing.assert_allclose(slopes[1], slopes[0], rtol=tolerance, atol=tolerance)


@pytest.mark.parametrize("what", EXPRESSIONS)
def test_writing_a_read_file_adds_no_function(what: str) -> None:
    first = written(ca.Function("function", [X, A], [EXPRESSIONS[what]()]))
    second = written(FunctionReader(first).functions[-1])
    third = written(FunctionReader(second).functions[-1])
    assert [record["kind"] for record in third] == [record["kind"] for record in second]


@pytest.mark.parametrize("name", [*UNARY, *BINARY])
def test_every_operation_is_read_as_the_one_that_was_written(name: str) -> None:
    code, a, b = getattr(ca, f"OP_{name}"), ca.SX.sym("a"), ca.SX.sym("b")
    value = ca.SX.unary(code, a) if name in UNARY else ca.SX.binary(code, a, b)
    function = ca.Function("operation", [a, b], [value])
    again = copied(function)
    for first in (-2.5, -0.4, 0.0, 0.3, 1.0, 7.25):
        for second in (-1.5, 0.0, 0.7, 3.0):
            np.testing.assert_array_equal(again(first, second).full(), function(first, second).full())


@given(
    strategies.lists(
        strategies.tuples(strategies.integers(0, 60), strategies.integers(0, 40), strategies.integers(0, 40)),
        max_size=30,
    )
)
def test_random_scalar_functions_survive_bit_by_bit(steps: list[tuple[int, int, int]]) -> None:
    x = ca.SX.sym("x", 3)
    known = [*x.nonzeros(), ca.SX(0.7)]
    for step, first, second in steps:
        name = (*UNARY, *BINARY)[step % (len(UNARY) + len(BINARY))]
        a, b = known[first % len(known)], known[second % len(known)]
        code = getattr(ca, f"OP_{name}")
        known.append(ca.SX.unary(code, a) if name in UNARY else ca.SX.binary(code, a, b))
    function = ca.Function("random", [x], [ca.vertcat(*known)])
    np.testing.assert_array_equal(copied(function)([0.3, -1.2, 2.5]).full(), function([0.3, -1.2, 2.5]).full())


def test_functions_that_are_called_twice_are_written_once() -> None:
    inner = ca.Function("inner", [Y], [ca.sin(Y) * Y])
    outer = ca.Function("outer", [X], [inner(X) + inner(2 * X)])
    assert [record["kind"] for record in written(outer)] == ["operations", "operations"]


def test_only_functions_that_call_others_are_made_of_matrices() -> None:
    inner = ca.Function("inner", [Y], [ca.sin(Y) * Y])
    kinds = [one.class_name() for one in FunctionReader(written(ca.Function("outer", [X], [inner(X)[0]]))).functions]
    assert kinds == ["SXFunction", "MXFunction"]


class OfPython(ca.Callback):  # type: ignore[misc]
    """x^2, as a function that only Python knows."""

    def __init__(self) -> None:
        ca.Callback.__init__(self)
        self.construct("of_python", {"enable_fd": True})

    def eval(self, arguments: list[Any]) -> list[Any]:
        return [arguments[0] ** 2]


def test_invalid_lists_of_operations_are_refused_by_name() -> None:
    callback = OfPython()
    root = ca.rootfinder("root", "newton", {"x": decaying, "p": rate, "g": decaying**3 - rate})
    for name, value in (("of_python", callback(X[0])), ("root", root(X[0], X[1])), ("function", ca.convexify(A))):
        with pytest.raises(ProblemError, match=f"{name}.* cannot be written as elementary operations"):
            FunctionWriter().write(ca.Function("function", [X, A], [value]))
    slope = ca.jacobian(integral("cvodes"), X)
    with pytest.raises(ProblemError, match="CvodesInterface"):
        FunctionWriter().write(ca.Function("slope", [X], [slope]))


# ---- records from strangers ------------------------------------------------------------------------------------------


def record_of(*rows: tuple[int, int, int], results: tuple[int, ...] = (0,), **changes: Any) -> dict[str, Any]:
    """A function of one number."""
    return {
        "kind": "operations",
        "inputs": [[1, 1]],
        "outputs": [[len(results), 1]],
        "rows": np.array(rows, dtype=np.int64).reshape(-1, 3),
        "constants": np.array([1.0]),
        "arguments": np.zeros(1, dtype=np.int64),
        "results": np.array(results, dtype=np.int64),
        **changes,
    }


INPUT, CONSTANT, CALL, RESULT, SIN = (OPERATIONS.index(name) for name in ("INPUT", "CONSTANT", "CALL", "RESULT", "SIN"))
IDENTITY = record_of((INPUT, 0, 0))
SPLINE_RECORD = next(record for record in written(SPLINE) if record["kind"] == "bspline")
TABLE_RECORD = written(TABLE)[0]
RUN = written(ca.Function("run", [X], [integral("cvodes")]))
CRAFTED: dict[str, list[dict[str, Any]]] = {
    "an operation that is not known": [record_of((INPUT, 0, 0), (len(OPERATIONS), 0, 0))],
    "an operation below all": [record_of((INPUT, 0, 0), (-1, 0, 0))],
    "an operand of its own": [record_of((SIN, 0, 0))],
    "an operand that comes later": [record_of((INPUT, 0, 0), (SIN, 2, 0), (INPUT, 0, 0))],
    "an operand before all": [record_of((INPUT, 0, 0), (SIN, -1, 0))],
    "an input too many": [record_of((INPUT, 1, 0))],
    "an entry too many": [record_of((INPUT, 0, 1))],
    "a constant too many": [record_of((CONSTANT, 1, 0))],
    "a call of itself": [record_of((INPUT, 0, 0), (CALL, 0, 0), (RESULT, 1, 0))],
    "a call of a later one": [record_of((INPUT, 0, 0), (CALL, 1, 0), (RESULT, 1, 0)), IDENTITY],
    "a call with too few arguments": [IDENTITY, record_of((INPUT, 0, 0), (CALL, 0, 7), (RESULT, 1, 0))],
    "a result too many": [IDENTITY, record_of((INPUT, 0, 0), (CALL, 0, 0), (RESULT, 1, 1))],
    "a result of no call": [record_of((INPUT, 0, 0), (RESULT, 0, 0))],
    "an operand that is a call": [IDENTITY, record_of((INPUT, 0, 0), (CALL, 0, 0), (SIN, 1, 0))],
    "an output of nothing": [record_of((INPUT, 0, 0), results=(5,))],
    "an output too few": [record_of((INPUT, 0, 0), outputs=[[2, 1]])],
    "a huge input": [record_of((INPUT, 0, 0), inputs=[[2**40, 2**40]])],
    "a huge output": [record_of((INPUT, 0, 0), outputs=[[2**31, 2]])],
    "a negative shape": [record_of((INPUT, 0, 0), inputs=[[-1, 1]])],
    "places out of order": [record_of((INPUT, 0, 0), inputs=[[3, 3, np.array([4, 1])]])],
    "a place outside": [record_of((INPUT, 0, 0), inputs=[[2, 2, np.array([7])]])],
    "rows of fractions": [record_of((INPUT, 0, 0), rows=np.array([[0.5, 0.0, 0.0]]))],
    "rows of two": [record_of((INPUT, 0, 0), rows=np.zeros((1, 2), dtype=np.int64))],
    "a kind that is not known": [{"kind": "external", "name": "library.so"}],
    "knots that do not rise": [{**SPLINE_RECORD, "knots": SPLINE_RECORD["knots"][::-1]}],
    "a degree beyond all": [{**SPLINE_RECORD, "degrees": [10**6]}],
    "a negative degree": [{**SPLINE_RECORD, "degrees": [-1]}],
    "coefficients too few": [{**SPLINE_RECORD, "coefficients": SPLINE_RECORD["coefficients"][:-1]}],
    "dimensions that lose knots": [{**SPLINE_RECORD, "offsets": [0, 3]}],
    "too many dimensions": [{**SPLINE_RECORD, "offsets": list(range(0, 20, 2))}],
    "a mode that is not known": [{**SPLINE_RECORD, "modes": [7]}],
    "a grid that does not rise": [{**TABLE_RECORD, "grid": np.zeros_like(TABLE_RECORD["grid"])}],
    "values too few": [{**TABLE_RECORD, "values": TABLE_RECORD["values"][:3]}],
    "no values": [{**TABLE_RECORD, "values": np.zeros(0)}],
    "a grid that is no number": [{**TABLE_RECORD, "grid": TABLE_RECORD["grid"] * np.nan}],
    "a table of one place": [{"kind": "low", "table": np.zeros(1), "count": 1, "mode": 0}],
    "an empty table": [{"kind": "gather", "table": np.zeros(0), "count": 1}],
    "a huge system": [{"kind": "solve", "size": 10**6, "columns": 1}],
    "an integrator of another kind": [*RUN[:1], {**RUN[1], "plugin": "external"}],
    "an integrator without equations": [RUN[1]],
    "an integrator with another option": [*RUN[:1], {**RUN[1], "options": {"monitor": ["daeF"]}}],
    "an integrator back in time": [*RUN[:1], {**RUN[1], "times": np.array([-3.0])}],
    "an integrator with jit": [*RUN[:1], {**RUN[1], "options": {"jit": True, "compiler": "shell"}}],
}


@pytest.mark.parametrize("what", CRAFTED)
def test_a_crafted_record_is_refused(what: str) -> None:
    with pytest.raises((ProblemError, KeyError)):
        FunctionReader(deepcopy(CRAFTED[what]))


@pytest.mark.long
def test_calls_that_multiply_are_refused_before_they_are_worked_out() -> None:
    doubled = record_of(
        (INPUT, 0, 0), (CALL, 0, 0), (RESULT, 1, 0), (CALL, 0, 1), (RESULT, 3, 0),
        results=(4,), arguments=np.array([0, 2]),
    )  # fmt: skip
    chain = [IDENTITY]
    for level in range(60):
        rows = doubled["rows"].copy()
        rows[[1, 3], 1] = level
        chain.append({**doubled, "rows": rows})
    with pytest.raises(ProblemError, match=f"at most {MAX_WORK}"):
        FunctionReader(chain)
    with pytest.raises(ProblemError, match=f"at most {MAX_OPERATIONS}"):
        FunctionReader([record_of(rows=np.zeros((MAX_OPERATIONS + 1, 3), dtype=np.int64))])
    many = [{**IDENTITY, "inputs": [[1024, 1]], "outputs": [[1, 1]]} for _ in range(1200)]
    square = [{**IDENTITY, "inputs": [[200, 300]]} for _ in range(20)]
    solves = [{"kind": "solve", "size": 512, "columns": 1} for _ in range(5)]
    for crowd in (many, square, solves):
        with pytest.raises(ProblemError, match=f"entries, at most {MAX_ENTRIES}"):
            FunctionReader(crowd)
    runs = [row for k in range(70) for row in ((CALL, 1, 0), (RESULT, 2 + 2 * k, 0))]
    caller = record_of((INPUT, 0, 0), (INPUT, 0, 1), *runs, inputs=[[2, 1]], arguments=np.array([0, 1]))
    with pytest.raises(ProblemError, match=f"at most {MAX_WORK}"):
        FunctionReader([*RUN[:2], caller])
    wide = record_of(*[(INPUT, 0, k) for k in range(1024)], inputs=[[1024, 1]], results=(0,))
    calls = [row for k in range(1100) for row in ((CALL, 0, 0), (RESULT, 1024 + 2 * k, 0))]
    caller = {**wide, "rows": np.concatenate([wide["rows"], calls]), "arguments": np.arange(1024)}
    with pytest.raises(ProblemError, match="calls have more than"):
        FunctionReader([wide, caller])


def test_no_file_reaches_the_readers_of_casadi(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The texts that CasADi would take as functions, which can run a compiler, stand nowhere in a file."""
    from ocp import Collocation, Solution, solve
    from tests.ocp.problems import energy

    monkeypatch.chdir(tmp_path)
    solve(energy(), Collocation(4)).save("plan.npz")
    with np.load("plan.npz") as archive:
        arrays = {name: archive[name] for name in archive.files}
    x = ca.SX.sym("x")
    evil = ca.Function("evil", [x], [x], {
        "jit": True, "compiler": "shell", "jit_serialize": "source",
        "jit_options": {"compiler": 'sh -c "touch MARKER; exec cc \\"\\$@\\"" cc', "flags": ["-O0"]},
    })  # fmt: skip
    assert "MARKER" in os.listdir()
    os.remove("MARKER")
    text = np.frombuffer(evil.serialize().encode(), dtype=np.uint8)
    for name in (*arrays, "problem", "problem/function"):
        np.savez("evil.npz", **{**arrays, name: text})
        with suppress(ProblemError):  # a few parts may be any numbers
            Solution.load("evil.npz").audit()
        assert "MARKER" not in os.listdir(), name
