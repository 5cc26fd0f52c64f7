"""A stage-ordered program solved by fatrop through its own C interface, without CasADi in between.

Fatrop (Vanroye, Sathya, De Schutter, Decre, 2023) is an interior-point method whose linear algebra goes from stage to
stage. CasADi's plugin for it takes a time that grows with the square of the intervals to build; here tables say where
every number of a block stands in the matrices of the stages, and `stages.c`, compiled once a machine, puts them there.
Its C interface wants equalities apart from inequalities, and bounds of variables among these.

The blocks are evaluated by CasADi, all applications at once, through a call back to Python, five times an iteration.
"""

from __future__ import annotations

import ctypes
import threading
import weakref
from collections import OrderedDict
from collections.abc import Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np

from ocp.console import Watch
from ocp.direct.assembly import Derivatives, gather, inputs, mapped, nonzeros, repeat
from ocp.direct.compiled import CompilerError, Library, built
from ocp.direct.fragment import Fragment
from ocp.direct.stages import Tables
from ocp.errors import ProblemError
from ocp.problem.formulation import Formulation

__all__ = ["NativeSolver", "why_not"]

KINDS = ("value", "gradient", "jacobian", "hessian")
VALUE, GRADIENT, JACOBIAN, HESSIAN = range(4)
DYNAMICS, EQUALITY, INEQUALITY = range(3)
MOST_KEPT = 4
"""Solvers kept of one program: which rows are equalities may change with the parameters, and makes another solver."""
WORDS = {
    0: "Solve_Succeeded",
    1: "Maximum_Iterations_Exceeded",
    2: "Solved_To_Acceptable_Level",
    3: "Infeasible_Problem_Detected",
}
SOURCE = Path(__file__).with_name("stages.c")
_CREATION = threading.Lock()  # fatrop sets a stream of the whole process when a solver is made


# ---- the library -------------------------------------------------------------------------------------------------


def why_not() -> str:
    """Why there is no native solver on this machine, in words; "" where there is one."""
    try:
        library()
    except (CompilerError, OSError) as error:
        return str(error)
    return ""


@cache
def library() -> Any:
    """The driver, compiled for this machine.

    Raises:
        CompilerError: There is no compiler, or it fails. OSError: There is no library of fatrop beside casadi.
    """
    home = Path(ca.__file__).parent
    for name in ("libfatrop.so", "libblasfeo.so", "include/fatrop/ocp/OCPCInterface.h"):
        if not (home / name).exists():
            raise OSError(f"casadi brings no {name}")
    text = SOURCE.read_text(encoding="utf-8")
    link = (f"-L{home}", "-lfatrop", "-l:libblasfeo.so", f"-Wl,-rpath,{home}", "-lm")
    made = ctypes.CDLL(str(built(Library((text,), lambda: text, (str(home / "include"),), link))))
    address, number = ctypes.c_void_p, ctypes.c_int
    for name, result, given in (
        ("stages_create", address, [address]),
        ("stages_places", None, [address, address, number]),
        ("stages_option", None, [address, ctypes.c_char_p, number, ctypes.c_double]),
        ("stages_option_type", number, [ctypes.c_char_p]),
        ("stages_solve", number, [address] * 5),
        ("stages_values", None, [address] * 3),
        ("stages_destroy", None, [address]),
    ):
        function = getattr(made, name)
        function.restype, function.argtypes = result, given
    return made


class _Entries(ctypes.Structure):
    _fields_ = [
        ("size", ctypes.c_int),
        *((name, ctypes.c_void_p) for name in ("matrix", "row", "column", "source", "scale")),
    ]


EVALUATE = ctypes.CFUNCTYPE(ctypes.c_int, ctypes.c_int)
WATCH = ctypes.CFUNCTYPE(ctypes.c_int)


class _Program(ctypes.Structure):
    _fields_ = [
        *(
            (name, ctypes.c_int)
            for name in ("stages", "variables", "rows", "bounds", "linear", "values", "slopes", "duals")
        ),
        *(
            (name, ctypes.c_void_p)
            for name in (
                *("nx", "nu", "ng", "ni", "place", "a", "target", "factor", "shift"),
                *("bound_of", "bound_at", "bound_shift", "linear_row", "linear_column", "linear_value"),
            )
        ),
        ("numbers", ctypes.c_void_p * 4),
        *((name, ctypes.c_void_p) for name in ("value_row", "slope_at", "slope_scale")),
        ("jacobian", _Entries),
        ("hessian", _Entries),
        ("cost_scale", ctypes.c_double),
        *((name, ctypes.c_void_p) for name in ("x", "g", "lam")),
        ("sigma", ctypes.c_double),
        *((name, ctypes.c_void_p) for name in ("lower", "upper", "guess")),
        ("evaluate", EVALUATE),
        ("watch", WATCH),
        ("solver", ctypes.c_void_p),
        ("stopped", ctypes.c_int),
        ("known", ctypes.c_int),
        *((name, ctypes.c_void_p) for name in ("slack_first", "primal_first", "seen")),
    ]


# ---- the solver --------------------------------------------------------------------------------------------------


class _Handle:
    """A solver of fatrop for what is an equality, what an inequality and what neither.

    Attributes:
        address: Of the solver in C. duals: How many multipliers. target: Where each row stands; -1: nowhere.
    """

    def __init__(self, solver: NativeSolver, kinds: tuple[np.ndarray, np.ndarray]) -> None:
        """``kinds`` of each row and of each variable: EQUALITY, INEQUALITY, or -1."""
        tables = solver.tables
        of_rows, of_variables = kinds
        self.bounded = np.flatnonzero(of_variables >= 0)
        stage = np.concatenate([tables.row_stage, tables.stage[self.bounded]])
        kind = np.concatenate([of_rows, of_variables[self.bounded]])
        stages, m = len(tables.nx), tables.fragment.n_rows
        position = np.concatenate([tables.dynamics, np.full(len(self.bounded), -1)])
        counts = {}
        for which in (EQUALITY, INEQUALITY):
            mine = np.flatnonzero(kind == which)
            order = mine[np.argsort(stage[mine], kind="stable")]
            counts[which] = np.bincount(stage[order], minlength=stages)
            before = np.concatenate([[0], np.cumsum(counts[which])])
            position[order] = np.arange(len(order)) - before[stage[order]]
        ng, ni = counts[EQUALITY], counts[INEQUALITY]
        # fatrop would end the whole process
        if np.any(ng > tables.nx + tables.nu):
            crowded = int(np.argmax(ng - tables.nx - tables.nu))
            raise RuntimeError(f"stage {crowded} has {ng[crowded]} equalities, more than it has variables; use ipopt")
        self.slack = np.concatenate([[0], np.cumsum(ni)])
        self.duals = int(tables.nx[1:].sum() + ng.sum() + ni.sum())

        self.base = base = _Program()
        ctypes.pointer(base)[0] = solver.base  # a copy
        self.arrays = [np.ascontiguousarray(part, dtype=np.int32) for part in (ng, ni, self.slack)]
        base.ng, base.ni, base.slack_first = (part.ctypes.data for part in self.arrays)
        self.limits = np.zeros((2, self.slack[-1]))
        base.lower, base.upper = (part.ctypes.data for part in self.limits)
        library = solver.library
        with _CREATION:
            self.address = library.stages_create(ctypes.byref(base))
        weakref.finalize(self, library.stages_destroy, self.address)
        places = np.zeros(3 * stages, dtype=np.int32)
        library.stages_places(self.address, places.ctypes.data, stages)
        for name, (type_, value) in solver.options.items():
            library.stages_option(self.address, name.encode(), type_, float(value))
        at = np.where(kind >= 0, places[3 * stage + np.maximum(kind, 0)] + position, -1)
        self.target, bound_at = at[:m], at[m:]
        is_slack = kind == INEQUALITY
        self.slack_row = np.flatnonzero(is_slack[:m])
        self.slack_of_row = (self.slack[stage] + position)[:m][self.slack_row]
        self.slack_bound = np.flatnonzero(is_slack[m:])
        self.slack_of_bound = (self.slack[stage] + position)[m:][self.slack_bound]
        self.equal = kind[m:] == EQUALITY

        # entries of the Jacobian: of rows that stand somewhere in variables of their stage; then of bounded variables
        row, column, source = tables.jacobian.row, tables.jacobian.column, tables.jacobian.source
        own = (of_rows[row] >= 0) & tables.own[column] & (tables.stage[column] == tables.row_stage[row])
        row, column, source = row[own], column[own], source[own]
        one = solver.one
        parts = (
            np.concatenate([3 * tables.row_stage[row] + of_rows[row], 3 * stage[m:] + kind[m:]]),
            np.concatenate([tables.local[column], tables.local[self.bounded]]),
            np.concatenate([position[row], position[m:]]),
            np.concatenate([source, np.full(len(self.bounded), one)]),
        )
        self.row, self.column = row, column
        self.scale = np.ones(len(parts[0]))
        self.factor, self.shift = np.ones(m), np.zeros(m)
        self.bound_shift = np.zeros(len(self.bounded))
        ints = [np.ascontiguousarray(part, dtype=np.int32) for part in (*parts, self.target, self.bounded, bound_at)]
        self.arrays += ints
        base.jacobian = _Entries(len(parts[0]), *(part.ctypes.data for part in ints[:4]), self.scale.ctypes.data)
        base.target, base.bound_of, base.bound_at = (part.ctypes.data for part in ints[4:])
        base.bounds, base.duals = len(self.bounded), self.duals
        base.factor, base.shift, base.bound_shift = (
            part.ctypes.data for part in (self.factor, self.shift, self.bound_shift)
        )
        self.kinds, self.is_dynamics = kinds, tables.dynamics >= 0

    def bind(self, tables: Tables, a: np.ndarray, b: np.ndarray, sides: tuple[np.ndarray, ...]) -> None:
        """Set scales of variables and rows, and bounds (lbx, ubx, lbg, ubg)."""
        lbx, ubx, lbg, ubg = sides
        onto = tables.onto[self.is_dynamics]
        self.factor[:] = 1.0 / b
        self.factor[self.is_dynamics] = -1.0 / a[onto]
        self.shift[:] = np.where(
            self.kinds[0] == INEQUALITY, 0.0, np.where(self.kinds[0] >= 0, lbg * b * self.factor, 0.0)
        )
        self.scale[: len(self.row)] = self.factor[self.row] * a[self.column]
        self.bound_shift[:] = np.where(self.equal, lbx[self.bounded], 0.0)
        for side, (of_rows, of_variables) in zip(self.limits, ((lbg, lbx), (ubg, ubx)), strict=True):
            side[self.slack_of_row] = of_rows[self.slack_row]
            side[self.slack_of_bound] = of_variables[self.bounded[self.slack_bound]]


class NativeSolver:
    """Fatrop for one program, called as a casadi solver is.

    Args:
        form, fragment: What is solved, in stages. functions: Of its blocks. options: Of fatrop.
        watch: Asked at every iterate whether the solve must end.

    Raises:
        ProblemError: An option that fatrop does not take.
    """

    def __init__(
        self,
        form: Formulation,
        fragment: Fragment,
        functions: Sequence[Derivatives],
        options: Mapping[str, Any],
        watch: Watch,
    ) -> None:
        self.library = library()
        self.options = checked_options(self.library, options)
        self.tables = tables = Tables(form, fragment, functions)
        self._parameters, self._watch = form.np, watch
        self._stats: dict[str, Any] = {}
        self._handles: OrderedDict[bytes, _Handle] = OrderedDict()
        self._kept: list[Any] = []
        self._error: BaseException | None = None
        self._x, self._lam, self._g = np.zeros(fragment.size), np.zeros(fragment.n_rows), np.zeros(fragment.n_rows)
        self._p, self._sigma, self._a = np.zeros(form.np), np.zeros(1), np.ones(fragment.size)
        self._slope_scale, self._curve_scale = np.ones(len(tables.slope_of)), np.ones(len(tables.hessian.row))
        self._numbers = [np.zeros(count) for count in tables.counts]
        self._numbers[JACOBIAN] = np.concatenate([self._numbers[JACOBIAN], fragment.linear[2], [1.0]])
        self.one = len(self._numbers[JACOBIAN]) - 1
        self._calls = self._functions()
        self.base = self._program()

    def class_name(self) -> str:
        """The kind of solver."""
        return "NativeSolver"

    def stats(self) -> dict[str, Any]:
        """The word, success and iterations of the last solve."""
        return self._stats

    # ---- the parts of the program that stay ----

    def keep(self, array: Any, kind: Any) -> int:
        """The address of an array that is kept from now on."""
        whole = np.ascontiguousarray(array, dtype=kind)
        self._kept.append(whole)
        return int(whole.ctypes.data)

    def _program(self) -> _Program:
        me = weakref.proxy(self)  # no circle: what C holds is given back at once
        tables, fragment = self.tables, self.tables.fragment
        at, column, value = fragment.linear
        entries, stage = tables.hessian, tables.stage[tables.hessian.row]
        local = tables.local[entries.row], tables.local[entries.column]
        curve = (self.keep(part, np.int32) for part in (stage, *local, entries.source))
        base = _Program(
            stages=len(tables.nx),
            variables=fragment.size,
            rows=fragment.n_rows,
            linear=len(at),
            values=tables.counts[VALUE],
            slopes=tables.counts[GRADIENT],
            nx=self.keep(tables.nx, np.int32),
            nu=self.keep(tables.nu, np.int32),
            place=self.keep(tables.place, np.int32),
            linear_row=self.keep(at, np.int32),
            linear_column=self.keep(column, np.int32),
            linear_value=self.keep(value, float),
            value_row=self.keep(tables.value_row, np.int32),
            slope_at=self.keep(tables.place[tables.slope_of], np.int32),
            slope_scale=self._slope_scale.ctypes.data,
            hessian=_Entries(len(stage), *curve, self._curve_scale.ctypes.data),
            a=self._a.ctypes.data,
            x=self._x.ctypes.data,
            lam=self._lam.ctypes.data,
            g=self._g.ctypes.data,
            seen=self.keep(np.zeros(tables.first[-1]), float),
            primal_first=self.keep(tables.first, np.int32),
            watch=WATCH(lambda: me._ask()),
            evaluate=EVALUATE(lambda kind: me._evaluate(kind)),
        )
        for i, numbers in enumerate(self._numbers):
            base.numbers[i] = numbers.ctypes.data
        self._kept += [base.watch, base.evaluate]
        return base

    def _functions(self) -> list[tuple[Any, Any, Any]]:
        """Functions of all numbers of a kind at once, that write where C reads; with their buffers and their calls."""
        fragment = self.tables.fragment
        x, p = ca.MX.sym("x", fragment.size), ca.MX.sym("p", self._parameters)
        sigma, lam = ca.MX.sym("sigma"), ca.MX.sym("lam", fragment.n_rows)
        pieces: list[list[Any]] = [[], [], [], []]
        for block, of in zip(fragment.blocks, self.tables.functions, strict=True):
            call = [*inputs(block, x), p]
            more = [repeat(sigma, block), gather(lam, block.rows)]
            pieces[VALUE].append(ca.vertcat(*mapped(of.value, block, call)))
            for kind, function, given in (
                (GRADIENT, of.gradient, call),
                (JACOBIAN, of.jacobian, call),
                (HESSIAN, of.hessian, [*call, *more]),
            ):
                pieces[kind].append(mapped(function, block, given)[0])
        calls = []
        for kind, name in enumerate(KINDS):
            given = [x, p, sigma, lam] if kind == HESSIAN else [x, p]
            function = ca.Function(name, given, [ca.densify(nonzeros(pieces[kind]))])
            buffer, run = function.buffer()
            for i, array in enumerate((self._x, self._p, self._sigma, self._lam)[: len(given)]):
                buffer.set_arg(i, array.data)
            buffer.set_res(0, self._numbers[kind][: self.tables.counts[kind]].data)
            calls.append((function, buffer, run))
        return calls

    def _evaluate(self, kind: int) -> int:
        numbers = self._numbers[kind][: self.tables.counts[kind]]
        try:
            if len(numbers):
                self._sigma[0] = self._running.sigma
                _, buffer, run = self._calls[kind]
                run()
                if buffer.ret():
                    numbers[:] = np.nan
        except BaseException as error:  # nothing may leave through C
            self._error = error
            numbers[:] = np.nan
        return 1

    def _ask(self) -> int:
        """Whether the solve must end."""
        try:
            return int(self._error is not None or not self._watch.may_go_on(self._x))
        except BaseException as error:
            self._error = error
            return 1

    # ---- a solve ----

    def _handle(self, sides: tuple[np.ndarray, ...]) -> _Handle:
        tables = self.tables
        lbx, ubx, lbg, ubg = sides

        def kinds(lower: np.ndarray, upper: np.ndarray) -> np.ndarray:
            loose = np.isneginf(lower) & np.isposinf(upper)
            return np.where(lower == upper, EQUALITY, np.where(loose, -1, INEQUALITY))

        of_rows = np.where(tables.dynamics >= 0, DYNAMICS, np.where(tables.twin >= 0, -1, kinds(lbg, ubg)))
        of_variables = np.where(tables.own, kinds(lbx, ubx), -1)
        key = np.concatenate([of_rows, of_variables]).astype(np.int8).tobytes()
        handle = self._handles.pop(key, None) or _Handle(self, (of_rows, of_variables))
        self._handles[key] = handle
        if len(self._handles) > MOST_KEPT:
            self._handles.popitem(last=False)
        return handle

    def __call__(
        self, x0: np.ndarray, p: np.ndarray, lbx: np.ndarray, ubx: np.ndarray, lbg: np.ndarray, ubg: np.ndarray
    ) -> dict[str, Any]:
        """Solve the scaled program; see :func:`ocp.direct.scaling.scaled_program` for its parameters."""
        tables, k = self.tables, self._parameters
        n, m = tables.fragment.size, tables.fragment.n_rows
        a, b, c = p[k : k + n], p[k + n : k + n + m], float(p[k + n + m])
        handle = self._handle((lbx, ubx, lbg, ubg))
        handle.bind(tables, a, b, (lbx, ubx, lbg, ubg))
        self._p[:], self._a[:], self._error = p[:k], a[tables.standing], None
        self._slope_scale[:] = a[tables.slope_of] / c
        self._curve_scale[:] = a[tables.hessian.row] * a[tables.hessian.column]
        guess = np.zeros(tables.first[-1])
        guess[tables.place[tables.own]] = x0[tables.own]
        primal, dual, told = np.zeros(len(guess)), np.zeros(handle.duals), np.zeros(2, dtype=np.int32)
        program, cost = handle.base, ctypes.c_double()
        program.guess, program.cost_scale = guess.ctypes.data, c
        self._running = program
        self.library.stages_solve(
            handle.address, ctypes.byref(program), primal.ctypes.data, dual.ctypes.data, told.ctypes.data
        )
        self.library.stages_values(ctypes.byref(program), primal.ctypes.data, ctypes.byref(cost))
        if program.stopped:
            self._handles.clear()  # it was stopped by an option that would stop it again
        if self._error is not None and not isinstance(self._error, RuntimeError):
            raise self._error
        flag, iterations = (int(value) for value in told)
        word = WORDS.get(flag, "Error_In_Step_Computation")
        self._stats = {"return_status": word, "success": flag == 0, "iter_count": iterations}
        lam = np.where(handle.target >= 0, handle.factor * dual[handle.target], 0.0)
        copies = tables.twin >= 0
        lam[copies] = lam[tables.twin[copies]]
        found = primal[tables.place] * self._a / a
        return {"x": found, "f": np.array(cost.value), "g": self._g / b, "lam_g": lam * b}


def checked_options(library: Any, options: Mapping[str, Any]) -> dict[str, tuple[int, float]]:
    """Options of fatrop by name, with the type that it asks for: 0 a number, 1 a whole number, 2 a switch."""
    found = {}
    for name, value in options.items():
        type_ = library.stages_option_type(name.encode()) if isinstance(name, str) else -1
        number = isinstance(value, int | float | np.number) and bool(np.isfinite(value))
        if type_ not in (0, 1, 2) or not (number or isinstance(value, bool)) or (type_ == 1 and int(value) != value):
            words = f"native does not take this option: {name!r}: {value!r}"
            raise ProblemError(words, name="options", value=dict(options))
        found[name] = (int(type_), float(value))
    return found
