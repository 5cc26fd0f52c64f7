"""Declarations of a problem: variables, constraints, horizon, phases and cost, as they are stored and checked."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import casadi as ca
import numpy as np

from ocp.errors import ProblemError
from ocp.problem.hulls import Hull, Separation

Value = Any  # a number, an array, or a casadi expression of parameters
Guess = Any  # a value, or a function of time that returns one
ENDS = ("initial", "terminal")
RESERVED = ("t", "time", "horizon")


@dataclass(frozen=True)
class Variable:
    """A named state, control or parameter.

    Attributes:
        name: Unique name in the problem.
        symbol: casadi symbol. Shape (n, 1).
        lower, upper: Bounds, casadi expressions of parameters. Shape (n, 1).
        initial, terminal: Values at both ends, nan for free entries. Shape (n, 1). States only.
        guess: A value, a function of time, samples (M, n) evenly over the horizon, or None. States and controls only.
        unit: For display, "rad" or "m/s"; for mixed entries all units, "rad, m".
        scale: Sizes by which solvers divide the entries, nan if derived by the solver. Shape (n,), or None for all nan.
    """

    name: str
    symbol: Any
    lower: Any = None
    upper: Any = None
    initial: Any = None
    terminal: Any = None
    guess: Guess = None
    unit: str = ""
    scale: Any = None

    @property
    def size(self) -> int:
        return int(self.symbol.numel())

    def __str__(self) -> str:
        low, high = column_text(self.lower), column_text(self.upper)
        bounds = "" if (low, high) == ("-inf", "inf") else f" in [{low}, {high}]"
        return f"{self.name} ({self.size}){bounds} {self.unit}".rstrip()


@dataclass(frozen=True)
class Signal:
    """A named, known function of time.

    Attributes:
        name: Unique name in the problem.
        symbol: Symbol of its value. Shape (n, 1).
        function: casadi Function time (s) -> value.
    """

    name: str
    symbol: Any
    function: Any

    @property
    def size(self) -> int:
        return int(self.symbol.numel())


@dataclass(frozen=True)
class Constraint:
    """A named vector constraint ``lower <= expression <= upper``, an equality if both bounds are equal.

    Attributes:
        name: Unique among the constraints of the problem.
        expression: casadi expression that is bounded. Shape (m, 1).
        lower, upper: Bounds, casadi expressions of parameters. Shape (m, 1).
        unit: As of a variable.
        tolerance: Largest violation of each row that the audit accepts, in its unit; None: relative to its size. Shape
            (m,).
        integral: Whether the bounds apply to the integral of the expression over time. Watched constraints only.
        way: Rate of the reference path length, shape (m, 1), or None. Watched constraints only.
    """

    name: str
    expression: Any
    lower: Any
    upper: Any
    unit: str = ""
    tolerance: Any = None
    integral: bool = False
    way: Any = None

    @property
    def size(self) -> int:
        return int(self.expression.numel())

    def check(self, symbols: Any) -> None:
        """Raise ProblemError if expression, bounds, unit and tolerance of the constraint are inconsistent."""
        what = f"constraint {self.name!r}"
        way = () if self.way is None else (self.way,)
        _require_columns(symbols, self.size, what, self.expression, self.lower, self.upper, *way)
        _require(isinstance(self.unit, str) and isinstance(self.integral, bool), what)
        tolerance = np.ones(1) if self.tolerance is None else np.asarray(self.tolerance, dtype=float)
        _require(tolerance.size in (1, self.size) and bool((tolerance > 0).all()), what)

    def __str__(self) -> str:
        low, high = column_text(self.lower), column_text(self.upper)
        what = f"integral of {shorten(self.expression)} dt" if self.integral else shorten(self.expression)
        return f"{self.name} ({self.size}): {low} <= {what} <= {high} {self.unit}".rstrip()


@dataclass
class Horizon:
    """The declared final time, which is fixed if its lower and upper bounds are the same expression."""

    symbol: Any
    lower: Any
    upper: Any
    guess: float | None
    fixed: bool

    def check(self, symbols: Any) -> None:
        """Raise ProblemError if the symbol, the bounds or the guess of the horizon are invalid."""
        _require(isinstance(self.fixed, bool), "horizon")
        _require_columns(symbols, 1, "horizon", self.symbol, self.lower, self.upper)
        _require(self.guess is None or bool(np.isfinite(float(self.guess))), "horizon")

    def __str__(self) -> str:
        low, high = column_text(self.lower), column_text(self.upper)
        return f"{low} s" if self.fixed else f"free in [{low}, {high}] s"


@dataclass(frozen=True)
class PhaseTimes:
    """Start time, duration and cost of one phase of a problem with phases (:mod:`ocp.problem.phases`).

    Attributes:
        name: Name of the phase, the prefix, before a dot, of the names of its parts.
        begin, duration: Expressions of free parameters and of parameters. Scalars, s.
        running, terminal: Cost of the phase: density over the fraction of the phase, and terminal cost.
    """

    name: str
    begin: Any
    duration: Any
    running: Any
    terminal: Any


@dataclass
class Declarations:
    """All declarations of a problem by kind and name, in the order in which they were made."""

    states: dict[str, Variable] = field(default_factory=dict)
    controls: dict[str, Variable] = field(default_factory=dict)
    parameters: dict[str, Variable] = field(default_factory=dict)
    signals: dict[str, Signal] = field(default_factory=dict)
    dynamics: dict[str, Any] = field(default_factory=dict)
    path: dict[str, Constraint] = field(default_factory=dict)
    start: dict[str, Constraint] = field(default_factory=dict)
    end: dict[str, Constraint] = field(default_factory=dict)
    watch: dict[str, Constraint] = field(default_factory=dict)
    apart: dict[str, Separation] = field(default_factory=dict)
    phases: dict[str, PhaseTimes] = field(default_factory=dict)
    at_start: dict[str, Any] = field(default_factory=dict)
    horizon: Horizon | None = None
    running: Any = None
    terminal: Any = None

    def set_guesses(self, guesses: Mapping[str, Any]) -> None:
        """Replace the initial guesses of states and controls by those of the same name; other names are ignored."""
        for pool in (self.states, self.controls):
            pool.update({name: replace(pool[name], guess=guess) for name, guess in guesses.items() if name in pool})

    def check_new_variable(self, kind: str, name: Any) -> None:
        """Raise ProblemError if a new variable's name is invalid, reserved or used; messages begin with ``kind``."""
        if not isinstance(name, str) or not name:
            raise ProblemError(f"{kind} name must be a non-empty string, not {name!r}")
        if name in RESERVED:
            raise ProblemError(f"{kind} {name!r}: this name is reserved ({', '.join(RESERVED)})")
        for pool in ("states", "controls", "parameters", "signals"):
            if name in getattr(self, pool):
                raise ProblemError(f"{kind} {name!r}: a {pool[:-1]} of this name exists already")

    def check_new_constraint(self, kind: str, name: Any) -> None:
        """Raise ProblemError if the name of a new constraint is invalid or used; messages begin with ``kind``."""
        if not isinstance(name, str) or not name:
            raise ProblemError(f"{kind}: its name must be a non-empty string, not {name!r}")
        if any(name in pool for pool in (self.path, self.start, self.end, self.watch, self.apart)):
            raise ProblemError(f"{kind} {name!r}: a constraint of this name exists already")

    def check(self, symbols: Any) -> None:
        """Raise ProblemError, naming the faulty declaration, if declarations read from a file are inconsistent.

        Args:
            symbols: ``casadi.SX`` or ``casadi.MX``, the type of every expression.
        """
        for pool, kind in PART_KINDS.items():
            for name, part in getattr(self, pool).items():
                _require(isinstance(part, kind) and isinstance(name, str) and part.name == name, f"{pool}: {name!r}")
        self._check_variables(symbols)
        self._check_equations(symbols)
        for constraint in (*self.path.values(), *self.start.values(), *self.end.values(), *self.watch.values()):
            constraint.check(symbols)
        for separation in self.apart.values():
            movers = {name: self.states[name].size for name in separation.movers if name in self.states}
            fits = movers == separation.movers and isinstance(separation.placements, symbols)
            _require(fits, f"separation {separation.name!r}")
        for phase in self.phases.values():
            parts = phase.begin, phase.duration, phase.running, phase.terminal
            _require_columns(symbols, 1, f"phase {phase.name!r}", *parts)
        if self.horizon is not None:
            _require(isinstance(self.horizon, Horizon), "horizon")
            self.horizon.check(symbols)

    def _check_variables(self, symbols: Any) -> None:
        """Raise ProblemError if a state, control or parameter has a wrong size, guess, scale or unit."""
        bounded = ("symbol", "lower", "upper")
        for pool, needed in (("parameters", ("symbol",)), ("controls", bounded), ("states", (*bounded, *ENDS))):
            for name, variable in getattr(self, pool).items():
                what, n = f"{pool[:-1]} {name!r}", int(np.prod(variable.symbol.shape))
                _require_columns(symbols, n, what, *(getattr(variable, part) for part in needed))
                for value, sizes in ((variable.guess, (1, n)), (variable.scale, (n,))):
                    array = np.zeros(n) if value is None else np.asarray(value, dtype=float)
                    _require(array.size in sizes or (value is variable.guess and array.shape[1:] == (n,)), what)
                _require(isinstance(variable.unit, str), what)

    def _check_equations(self, symbols: Any) -> None:
        """Raise ProblemError if dynamics, symbols of start values, signals or cost have a wrong size or type."""
        for name, rate in self.dynamics.items():
            _require(name in self.states, f"dynamics of {name!r}")
            _require_columns(symbols, self.states[name].size, f"dynamics of {name!r}", rate)
        for name, symbol in self.at_start.items():
            _require(name in self.states or name in self.controls, f"start of {name!r}")
            size = {**self.states, **self.controls}[name].size
            _require_columns(symbols, size, f"start of {name!r}", symbol)
        for signal in self.signals.values():
            shape = isinstance(signal.function, ca.Function) and (signal.function.n_in(), signal.function.size_in(0))
            _require(shape == (1, (1, 1)) and signal.function.numel_out(0) == signal.size, f"signal {signal.name!r}")
        for value in (self.running, self.terminal):
            _require(value is None or (isinstance(value, symbols) and value.numel() == 1), "cost")

    def __str__(self) -> str:
        """Return a text with one line for each declaration, such as that of a state or of a constraint."""
        lines = ["  horizon      not declared" if self.horizon is None else f"  horizon      {self.horizon}"]
        for state in self.states.values():
            ends = [f"; {end} {text}" for end in ENDS if (text := column_text(getattr(state, end))) != "nan"]
            lines.append(f"  state        {state}{''.join(ends)}")
        lines += [f"  control      {control}" for control in self.controls.values()]
        lines += [f"  parameter    {p.name} ({p.size})" for p in self.parameters.values()]
        lines += [f"  signal       {s.name} ({s.size})" for s in self.signals.values()]
        lines += [f"  d{state}/dt = {shorten(rate)}" for state, rate in self.dynamics.items()]
        for kind in ("path", "start", "end", "watch"):
            lines += [f"  {kind:<12} {constraint}" for constraint in getattr(self, kind).values()]
        lines += [f"  separation   {separation}" for separation in self.apart.values()]
        if self.running is not None:
            lines.append(f"  minimize     integral of {shorten(self.running)} dt + {shorten(self.terminal)}")
        return "\n".join(lines)


RECORD_KINDS = (Variable, Signal, Constraint, Horizon, PhaseTimes, Declarations, Separation, Hull)
"""Classes of the parts of a problem, which its record contains by name."""
PART_KINDS: dict[str, Any] = {
    **dict.fromkeys(("states", "controls", "parameters"), Variable),
    **dict.fromkeys(("path", "start", "end", "watch"), Constraint),
    "signals": Signal,
    "apart": Separation,
    "phases": PhaseTimes,
}


def _require(condition: bool, what: str) -> None:
    """Raise ProblemError with the name ``what`` of the inconsistent declaration if a condition does not hold."""
    if not condition:
        raise ProblemError(f"{what} does not fit the rest of its problem", name=what)


def _require_columns(symbols: Any, size: int, what: str, *values: Any) -> None:
    """Raise ProblemError unless each value is a column of ``size`` expressions of a given CasADi type, SX or MX."""
    for value in values:
        _require(isinstance(value, symbols) and value.shape == (size, 1), what)


def column_text(value: Any) -> str:
    """Return a column of numbers or expressions as text; a column of equal entries is written as one entry."""
    if isinstance(value, ca.MX):
        if ca.symvar(value):
            return shorten(str(value))
        value = ca.evalf(value)
    entries = [str(entry) for entry in ca.vertsplit(value)]
    return entries[0] if len(set(entries)) == 1 else shorten("[" + ", ".join(entries) + "]")


def shorten(expression: Any) -> str:
    """Return an expression as text on one line of limited length.

    SX prints shared subexpressions first, so a large expression is described by its symbols instead.
    """
    if not isinstance(expression, str) and ca.Function("size", ca.symvar(expression), [expression]).n_nodes() > 60:
        return f"expression of {', '.join(s.name() for s in ca.symvar(expression)[:8])}, ..."
    text, width = " ".join(str(expression).split()), 100
    return text if len(text) <= width else text[: width - 3] + "..."
