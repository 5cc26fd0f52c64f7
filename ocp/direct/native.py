"""A stage-ordered program solved by an interior-point method of our own, in C that is compiled once a machine.

What IPOPT does (`interior.c`), with linear algebra that goes from stage to stage (`riccati.c`), in a time and a memory
that grow with the intervals alone. Tables say where every number of a block stands in the matrices of the stages
(`stages.c`). What the dynamics inside an interval define, the method does not see: `inner.c` finds it by Newton's
method, with its slopes and curvature (condensing: Bock, Plitt, 1984; of collocation: Quirynen, Gros, Diehl, 2015).
Where IPOPT would begin its restoration, this ends, and IPOPT itself goes on.

The blocks are evaluated by CasADi, all applications at once, through a call back to Python, some five times an
iteration.
"""

from __future__ import annotations

import ctypes
import weakref
from collections import OrderedDict
from collections.abc import Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np

from ocp.console import Progress
from ocp.direct.assembly import Derivatives, gather, inputs, mapped, nonzeros, repeat
from ocp.direct.compiled import Background
from ocp.direct.fragment import Fragment
from ocp.direct.stages import Entries, Tables
from ocp.errors import ProblemError
from ocp.libraries import CompilerError, Library, built, kept
from ocp.problem.formulation import Formulation

__all__ = ["NativeSolver", "checked_options", "is_at_hand", "is_ready", "why_not"]

KINDS = ("value", "gradient", "jacobian", "hessian")
VALUE, GRADIENT, JACOBIAN, HESSIAN = range(4)
DYNAMICS, EQUALITY, INEQUALITY, INNER = range(4)
MOST_KEPT = 4
"""Solvers kept of one program: which rows are equalities may change with the parameters, and makes another solver."""
WORDS = (
    "Solve_Succeeded",
    "Maximum_Iterations_Exceeded",
    "Solved_To_Acceptable_Level",
    "Restoration_Failed",
    "Error_In_Step_Computation",
)
"""How a solve ended, in ipopt's words."""
OPTIONS: dict[str, type] = {"tol": float, "max_iter": int, "acceptable_tol": float, "acceptable_iter": int}
"""What can be told it, which means the same to ipopt."""
SOURCES = tuple(Path(__file__).with_name(name) for name in ("inner.c", "riccati.c", "stages.c", "interior.c"))


# ---- the library -------------------------------------------------------------------------------------------------


def why_not() -> str:
    """Why there is no native solver on this machine, in words; "" where there is one."""
    try:
        library()
    except (CompilerError, OSError) as error:
        return str(error)
    return ""


def is_at_hand() -> bool:
    """Whether the driver is compiled; where it is not, that is done in the background."""
    if library.cache_info().currsize > 0:
        return True
    try:
        return kept(driver()) is not None or isinstance(in_background().found[0], Path)
    except OSError:  # no more files can be opened
        return False


@cache
def is_ready() -> bool:
    """Whether there is a native solver, after it is compiled: who needs the same numbers of many processes waits."""
    return not why_not()


@cache
def in_background() -> Background:
    """What compiles the driver."""
    return Background([driver()])


@cache
def driver() -> Library:
    """The driver, for this machine's processor."""
    text = "\n".join(source.read_text(encoding="utf-8") for source in SOURCES)
    return Library((text,), lambda: text, vectors=True, flags=("-O3",))


@cache
def library() -> Any:
    """The driver, compiled for this machine.

    Raises:
        CompilerError: There is no compiler, or it fails. OSError: It cannot be loaded.
    """
    made = ctypes.CDLL(str(built(driver())))
    address, number = ctypes.c_void_p, ctypes.c_int
    for name, result, given in (
        ("stages_create", address, [address]),
        ("stages_solve", None, [address, ctypes.c_double, number, ctypes.c_double, number, *[address] * 3]),
        ("stages_values", None, [address] * 4),
        ("stages_curve_upwards", number, [address] * 3),
        ("stages_destroy", None, [address]),
    ):
        function = getattr(made, name)
        function.restype, function.argtypes = result, given
    return made


class _Entries(ctypes.Structure):
    _fields_ = [(name, ctypes.c_void_p) for name in ("first", "row", "column", "source")]


EVALUATE = ctypes.CFUNCTYPE(ctypes.c_int, ctypes.c_int)
WATCH = ctypes.CFUNCTYPE(ctypes.c_int, ctypes.c_int)


class _Program(ctypes.Structure):
    _fields_ = [
        *(
            (name, ctypes.c_int)
            for name in (
                *("stages", "variables", "rows", "values", "slopes", "linear", "equal", "slacks"),
                *("plain", "most"),
            )
        ),
        *(
            (name, ctypes.c_void_p)
            for name in (
                *("nx", "nu", "nz", "ng", "ni"),
                *("primal_first", "slack_first", "inner_first", "factors_first", "sensitivity_first"),
                *("place", "local", "inner_variable", "inner_row", "a"),
                *("kind", "position", "target", "factor", "shift"),
            )
        ),
        *((name, _Entries) for name in ("constant", "inner", "jacobian", "hessian")),
        ("half", ctypes.c_void_p),
        ("numbers", ctypes.c_void_p * 4),
        *((name, ctypes.c_void_p) for name in ("value_row", "slope_of")),
        ("cost_scale", ctypes.c_double),
        *((name, ctypes.c_void_p) for name in ("x", "g", "lam")),
        ("sigma", ctypes.c_double),
        *((name, ctypes.c_void_p) for name in ("lower", "upper", "guess", "own")),
        ("evaluate", EVALUATE),
        ("watch", WATCH),
        ("cost", ctypes.c_double),
        ("missed", ctypes.c_double),
        *(
            (name, ctypes.c_void_p)
            for name in ("seen", "before", "slope", "step", "size", "factors", "sensitivity", "scratch", "pivots")
        ),
        *((name, ctypes.c_int) for name in ("stopped", "known", "found", "ready", "sloped", "factored")),
    ]


class _Kept:
    """Arrays that C reads, kept as long as this is."""

    def __init__(self) -> None:
        self._kept: list[Any] = []

    def keep(self, array: Any, kind: Any = np.int32) -> int:
        """The address of an array that is kept from now on."""
        whole = np.ascontiguousarray(array, dtype=kind)
        self._kept.append(whole)
        return int(whole.ctypes.data)

    def entries(self, entries: Entries, stage: np.ndarray, stages: int) -> _Entries:
        """Entries in C, those of one stage after those of the other; ``stage`` of each."""
        if np.any(np.diff(stage) < 0):
            order = np.argsort(stage, kind="stable")
            stage, entries = stage[order], entries.select(order)
        first = np.searchsorted(stage, np.arange(stages + 1))
        return _Entries(self.keep(first), *(self.keep(part) for part in entries))


# ---- the solver --------------------------------------------------------------------------------------------------


class _Handle(_Kept):
    """A solver for what is an equality, what an inequality and what neither.

    The bounds of variables are rows behind those of the program.

    Attributes:
        address: Of the solver in C. duals: How many multipliers. base: The program in C.
    """

    def __init__(self, solver: NativeSolver, kinds: tuple[np.ndarray, np.ndarray]) -> None:
        """``kinds`` of each row and of each variable: DYNAMICS, EQUALITY, INEQUALITY, INNER, or -1."""
        super().__init__()
        tables = solver.tables
        of_rows, of_variables = kinds
        self.bounded = np.flatnonzero(of_variables >= 0)
        stage = np.concatenate([tables.row_stage, tables.stage[self.bounded]])
        kind = np.concatenate([of_rows, of_variables[self.bounded]])
        stages, m, more = len(tables.nx), tables.fragment.n_rows, len(self.bounded)
        position = np.concatenate([np.maximum(tables.dynamics, tables.position), np.full(more, -1)])
        counts = {}
        for which in (EQUALITY, INEQUALITY):
            mine = np.flatnonzero(kind == which)
            order = mine[np.argsort(stage[mine], kind="stable")]
            counts[which] = np.bincount(stage[order], minlength=stages)
            before = np.concatenate([[0], np.cumsum(counts[which])])
            position[order] = np.arange(len(order)) - before[stage[order]]
        ng, ni = counts[EQUALITY], counts[INEQUALITY]
        if np.any(ng > tables.nx + tables.nu):
            crowded = int(np.argmax(ng - tables.nx - tables.nu))
            raise RuntimeError(f"stage {crowded} has {ng[crowded]} equalities, more than it has variables; use ipopt")
        # dynamics, equalities, inequalities, each from stage to stage
        firsts = [np.concatenate([[0], np.cumsum(count)]) for count in (tables.nx[1:], ng, ni)]
        dynamics, slack = int(firsts[0][-1]), firsts[2]
        equal = dynamics + int(firsts[1][-1])
        begins = np.zeros((stages, 3), dtype=int)
        begins[: stages - 1, DYNAMICS] = firsts[0][:-1]
        begins[:, EQUALITY], begins[:, INEQUALITY] = dynamics + firsts[1][:-1], equal + slack[:-1]
        self.duals = equal + int(slack[-1])

        self.base = base = _Program()
        ctypes.pointer(base)[0] = solver.base  # a copy
        base.ng, base.ni, base.slack_first = (self.keep(part) for part in (ng, ni, slack))
        base.equal, base.slacks = equal, int(slack[-1])
        self.limits = np.zeros((2, slack[-1]))
        base.lower, base.upper = (part.ctypes.data for part in self.limits)
        seen = (kind >= 0) & (kind != INNER)
        base.target = self.keep(np.where(seen, begins[stage, np.where(seen, kind, 0)] + position, -1))
        base.kind, base.position = self.keep(kind), self.keep(position)
        self.is_slack, self.is_equality = kind == INEQUALITY, kind == EQUALITY
        self.slack = (slack[stage] + position)[self.is_slack]
        own = np.full(slack[-1], -1)
        mine = self.is_slack[m:]
        own[(slack[stage] + position)[m:][mine]] = tables.place[self.bounded][mine]
        base.own = self.keep(own)
        self.is_dynamics = tables.dynamics >= 0

        at, column, value = tables.fragment.linear
        bound = Entries(m + np.arange(more), self.bounded, np.full(more, solver.one))
        constant = Entries(at, column, solver.one - len(value) + np.arange(len(at))).followed_by(bound)
        base.constant = self.entries(constant, stage[constant.row], stages)
        base.linear, base.rows = len(constant.row), m + more
        entries = tables.jacobian.followed_by(bound)
        entries = entries.select(seen[entries.row] & (tables.stage[entries.column] == stage[entries.row]))
        base.jacobian = self.entries(entries, stage[entries.row], stages)
        self.factor, self.shift = np.zeros(m + more), np.zeros(m + more)
        base.factor, base.shift = self.factor.ctypes.data, self.shift.ctypes.data
        self.address = solver.library.stages_create(ctypes.byref(base))
        if not self.address:
            raise MemoryError("no memory for the stages of a solver")
        weakref.finalize(self, solver.library.stages_destroy, self.address)

    def bind(self, tables: Tables, a: np.ndarray, b: np.ndarray, sides: tuple[np.ndarray, ...]) -> None:
        """Set scales of variables and rows, and bounds (lbx, ubx, lbg, ubg)."""
        lbx, ubx, lbg, ubg = sides
        self.factor[:] = 1.0 / np.concatenate([b, a[self.bounded]])
        self.factor[: len(b)][self.is_dynamics] = -1.0 / a[tables.onto[self.is_dynamics]]
        low, high = (np.concatenate([lbg, lbx[self.bounded]]), np.concatenate([ubg, ubx[self.bounded]]))
        self.shift[:] = np.where(self.is_equality, low, 0.0)
        self.limits[:, self.slack] = low[self.is_slack], high[self.is_slack]


class NativeSolver(_Kept):
    """The native solver of one program, called as a casadi solver is.

    Args:
        form, fragment: What is solved, in stages. functions: Of its blocks. options: See OPTIONS.
        progress: Told of every iterate, and asked whether the solve must end.

    Raises:
        ProblemError: An option that it does not take.
    """

    def __init__(
        self,
        form: Formulation,
        fragment: Fragment,
        functions: Sequence[Derivatives],
        options: Mapping[str, Any],
        progress: Progress,
    ) -> None:
        super().__init__()
        self.library = library()
        self.options = checked_options(options)
        self.tables = tables = Tables(form, fragment, functions)
        self._parameters, self._progress = form.np, progress
        self._stats: dict[str, Any] = {}
        self._handles: OrderedDict[bytes, _Handle] = OrderedDict()
        self._error: BaseException | None = None
        self._x, self._a = np.zeros(fragment.size), np.ones(fragment.size)
        # the bounds of variables are rows too
        self._lam, self._g = np.zeros(fragment.n_rows + fragment.size), np.zeros(fragment.n_rows + fragment.size)
        self._p, self._sigma = np.zeros(form.np), np.zeros(1)
        self._numbers = [np.zeros(count) for count in tables.counts]
        self._numbers[JACOBIAN] = np.concatenate([self._numbers[JACOBIAN], fragment.linear[2], [1.0]])
        self.one = len(self._numbers[JACOBIAN]) - 1
        self._calls = self._functions()
        self.base = self._program()

    def class_name(self) -> str:
        """The kind of solver."""
        return "NativeSolver"

    def stats(self) -> dict[str, Any]:
        """The word, success and iterations of the last solve, and whether the cost curves downwards somewhere there."""
        return self._stats

    # ---- the parts of the program that stay ----

    def _program(self) -> _Program:
        me = weakref.proxy(self)  # no circle: what C holds is given back at once
        tables = self.tables
        inner = tables.jacobian.select(tables.position[tables.jacobian.row] >= 0)
        own = tables.nx + tables.nu
        first = {
            "primal_first": own,
            "inner_first": tables.nz,
            "factors_first": tables.nz**2,
            "sensitivity_first": tables.nz * own,
        }
        sums = {name: np.concatenate([[0], np.cumsum(part)]) for name, part in first.items()}
        last = {name: int(part[-1]) for name, part in sums.items()}
        scratch = int(max(((own + tables.nz) * own).max(), 2 * own.max()))
        sizes = {
            "seen": last["primal_first"],
            "before": last["primal_first"] + last["inner_first"],
            "slope": tables.fragment.size,
            "step": last["inner_first"],
            "size": len(own),
            "factors": last["factors_first"],
            "sensitivity": last["sensitivity_first"],
            "scratch": scratch,
        }
        base = _Program(
            stages=len(tables.nx),
            variables=tables.fragment.size,
            values=tables.counts[VALUE],
            slopes=tables.counts[GRADIENT],
            plain=tables.plain,
            most=int(own.max()),
            nx=self.keep(tables.nx),
            nu=self.keep(tables.nu),
            nz=self.keep(tables.nz),
            place=self.keep(tables.place),
            local=self.keep(tables.local),
            inner_variable=self.keep(tables.inner),
            inner_row=self.keep(tables.inner_rows),
            value_row=self.keep(tables.value_row),
            slope_of=self.keep(tables.slope_of),
            inner=self.entries(inner, tables.row_stage[inner.row], len(own)),
            hessian=self.entries(tables.hessian, tables.stage[tables.hessian.row], len(own)),
            half=self.keep(tables.half, float),
            a=self._a.ctypes.data,
            x=self._x.ctypes.data,
            lam=self._lam.ctypes.data,
            g=self._g.ctypes.data,
            pivots=self.keep(np.zeros(last["inner_first"])),
            watch=WATCH(lambda anew: me._ask(anew)),
            evaluate=EVALUATE(lambda kind: me._evaluate(kind)),
            **{name: self.keep(part) for name, part in sums.items()},
            **{name: self.keep(np.zeros(size), float) for name, size in sizes.items()},
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
            for i, array in enumerate((self._x, self._p, self._sigma, self._lam[: fragment.n_rows])[: len(given)]):
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

    def _ask(self, anew: int) -> int:
        """Whether the solve must end; at a new iterate, or inside an iteration."""
        at = self._running
        try:
            ends = not self._progress.may_go_on(self._x, at.cost, at.missed) if anew else self._progress.must_end()
            return int(ends or self._error is not None)
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

        of_rows = np.where(tables.dynamics >= 0, DYNAMICS, np.where(tables.position >= 0, INNER, kinds(lbg, ubg)))
        of_variables = kinds(lbx, ubx)
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
        self._p[:], self._a[:], self._error = p[:k], a, None
        self._x[:] = x0 * a
        guess = np.zeros(tables.first[-1])
        seen = tables.place >= 0
        guess[tables.place[seen]] = x0[seen]
        primal, dual, told = np.zeros(len(guess)), np.zeros(handle.duals), np.zeros(2, dtype=np.int32)
        ends = [self.options[name] for name in OPTIONS]
        program, cost = handle.base, ctypes.c_double()
        program.guess, program.cost_scale = guess.ctypes.data, c
        self._running = program
        self.library.stages_solve(handle.address, *ends, primal.ctypes.data, dual.ctypes.data, told.ctypes.data)
        self.library.stages_values(ctypes.byref(program), primal.ctypes.data, dual.ctypes.data, ctypes.byref(cost))
        if self._error is not None and not isinstance(self._error, RuntimeError):
            raise self._error
        flag, iterations = (int(value) for value in told)
        word = WORDS[flag]
        upwards = flag == 0 and self.library.stages_curve_upwards(
            ctypes.byref(program), primal.ctypes.data, dual.ctypes.data
        )
        self._stats = {
            "return_status": word,
            "success": flag == 0,
            "iter_count": iterations,
            "regularised": flag == 0 and not upwards,
        }
        return {"x": self._x / a, "f": np.array(cost.value), "g": self._g[:m] / b, "lam_g": self._lam[:m] * b}


def checked_options(options: Mapping[str, Any]) -> dict[str, Any]:
    """Options by name, of the type of each."""
    found = {}
    for name, value in options.items():
        type_ = OPTIONS.get(name)
        is_number = isinstance(value, int | float | np.number) and not isinstance(value, bool)
        if type_ is None or not (is_number and 0 <= value < np.inf and value == type_(value)):
            words = f"native does not take this option: {name!r}: {value!r}"
            raise ProblemError(words, name="options", value=dict(options))
        found[name] = type_(value)
    return found
