"""What a problem consists of: variables, signals, constraints, horizon, phases, by name, and how each reads."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import casadi as ca
import numpy as np

from ocp.errors import ProblemError
from ocp.problem.separation import Separation

__all__ = ["ENDS", "Constraint", "Declarations", "Guess", "Horizon", "PhaseTimes", "Signal", "Variable"]

Guess = Any  # a value, or a function of time that returns one
ENDS = ("initial", "terminal")
RESERVED = ("t", "time", "horizon")


@dataclass(frozen=True)
class Variable:
    """A named state, control or parameter.

    Attributes:
        name: Its name, unique in the problem.
        symbol: Its symbol. Shape (n, 1).
        lower, upper: Bounds, casadi expressions of parameters. Shape (n, 1).
        initial, terminal: Values at both ends, nan where an entry is free. Shape (n, 1). States only.
        guess: A value, a function of time, or None. States and controls only.
        unit: For those who read it, "rad" or "m/s"; of a vector of several kinds all of them, "rad, m".
        scale: Sizes that solvers divide the entries by, nan where they find them. Shape (n,), or None for all nan.
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
        name: Its name, unique in the problem.
        symbol: What stands for its value. Shape (n, 1).
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
    """A named vector constraint ``lower <= expression <= upper``; equal bounds make an equality.

    Attributes:
        name: Its name, unique among the constraints of the problem.
        expression: Shape (m, 1).
        lower, upper: casadi expressions of parameters. Shape (m, 1).
        unit: As of a variable.
        tolerance: Largest violation of each row that the audit lets pass, in its unit; None: as its size says. (m,).
        integral: Whether it is the integral of the expression over time that is meant. Of what is watched only.
        way: Rate of the way that it is judged against, shape (m, 1), or None. Of what is watched only.
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
        """Raise ProblemError where its parts do not fit together; see :meth:`Declarations.check`."""
        what = f"constraint {self.name!r}"
        way = () if self.way is None else (self.way,)
        _require_columns(symbols, self.size, what, self.expression, self.lower, self.upper, *way)
        _require(isinstance(self.unit, str) and isinstance(self.integral, bool), what)
        given = np.ones(1) if self.tolerance is None else np.asarray(self.tolerance, dtype=float)
        _require(given.size in (1, self.size) and bool((given > 0).all()), what)

    def __str__(self) -> str:
        low, high = column_text(self.lower), column_text(self.upper)
        what = f"integral of {short(self.expression)} dt" if self.integral else short(self.expression)
        return f"{self.name} ({self.size}): {low} <= {what} <= {high} {self.unit}".rstrip()


@dataclass
class Horizon:
    """The final time: fixed when lower and upper are one expression."""

    symbol: Any
    lower: Any
    upper: Any
    guess: float | None
    fixed: bool

    def check(self, symbols: Any) -> None:
        """Raise ProblemError where its parts do not fit together; see :meth:`Declarations.check`."""
        _require(isinstance(self.fixed, bool), "horizon")
        _require_columns(symbols, 1, "horizon", self.symbol, self.lower, self.upper)
        _require(self.guess is None or bool(np.isfinite(float(self.guess))), "horizon")

    def __str__(self) -> str:
        low, high = column_text(self.lower), column_text(self.upper)
        return f"{low} s" if self.fixed else f"free in [{low}, {high}] s"


@dataclass(frozen=True)
class PhaseTimes:
    """When a phase is, of a problem of several one after the other (:mod:`ocp.problem.phases`).

    Attributes:
        name: Of the phase. What belongs to it bears names that begin with it and a dot.
        begin, duration: Expressions of states that stand still, and of parameters. Scalars, s.
        running, terminal: Its own share of the cost: density over the fraction of the phase, and what comes at its end.
    """

    name: str
    begin: Any
    duration: Any
    running: Any
    terminal: Any


@dataclass
class Declarations:
    """Everything declared so far, by kind and name, in order of declaration."""

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

    def check_new_variable(self, kind: str, name: Any) -> None:
        """Raise ProblemError unless a name can be that of a new variable; ``kind`` is that of the message."""
        if not isinstance(name, str) or not name:
            raise ProblemError(f"{kind} name must be a non-empty string, not {name!r}")
        if name in RESERVED:
            raise ProblemError(f"{kind} {name!r}: this name is reserved ({', '.join(RESERVED)})")
        for other in ("states", "controls", "parameters", "signals"):
            if name in getattr(self, other):
                raise ProblemError(f"{kind} {name!r}: a {other[:-1]} of this name exists already")

    def check_new_constraint(self, kind: str, name: Any) -> None:
        """Raise ProblemError unless a name can be that of a new constraint; ``kind`` is that of the message."""
        if not isinstance(name, str) or not name:
            raise ProblemError(f"{kind}: its name must be a non-empty string, not {name!r}")
        if any(name in pool for pool in (self.path, self.start, self.end, self.watch, self.apart)):
            raise ProblemError(f"{kind} {name!r}: a constraint of this name exists already")

    def check(self, symbols: Any) -> None:
        """Raise ProblemError, which names the part, where declarations that were read from a file do not fit together.

        Args:
            symbols: ``casadi.SX`` or ``casadi.MX``, of which every expression is made.
        """

        for pool, kind in PART_KINDS.items():
            for name, part in getattr(self, pool).items():
                _require(isinstance(part, kind) and isinstance(name, str) and part.name == name, f"{pool}: {name!r}")
        self._check_variables(symbols)
        self._check_equations(symbols)
        for one in (*self.path.values(), *self.start.values(), *self.end.values(), *self.watch.values()):
            one.check(symbols)
        for apart in self.apart.values():
            movers = {name: self.states[name].size for name in apart.movers if name in self.states}
            _require(movers == apart.movers and isinstance(apart.placements, symbols), f"separation {apart.name!r}")
        for phase in self.phases.values():
            parts = phase.begin, phase.duration, phase.running, phase.terminal
            _require_columns(symbols, 1, f"phase {phase.name!r}", *parts)
        if self.horizon is not None:
            _require(isinstance(self.horizon, Horizon), "horizon")
            self.horizon.check(symbols)

    def _check_variables(self, symbols: Any) -> None:
        """Check sizes, guesses, scales and units of states, controls and parameters."""
        bounded = ("symbol", "lower", "upper")
        for pool, needed in (("parameters", ("symbol",)), ("controls", bounded), ("states", (*bounded, *ENDS))):
            for name, one in getattr(self, pool).items():
                what, n = f"{pool[:-1]} {name!r}", int(np.prod(one.symbol.shape))
                _require_columns(symbols, n, what, *(getattr(one, part) for part in needed))
                for value, sizes in ((one.guess, (1, n)), (one.scale, (n,))):
                    _require(value is None or np.asarray(value, dtype=float).size in sizes, what)
                _require(isinstance(one.unit, str), what)

    def _check_equations(self, symbols: Any) -> None:
        """Check dynamics, symbols at the start, signals and cost."""
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
        """States, controls, parameters, horizon, dynamics, constraints and cost by name, one a line."""
        lines = ["  horizon      not declared" if self.horizon is None else f"  horizon      {self.horizon}"]
        for state in self.states.values():
            ends = [f"; {end} {text}" for end in ENDS if (text := column_text(getattr(state, end))) != "nan"]
            lines.append(f"  state        {state}{''.join(ends)}")
        lines += [f"  control      {control}" for control in self.controls.values()]
        lines += [f"  parameter    {p.name} ({p.size})" for p in self.parameters.values()]
        lines += [f"  signal       {s.name} ({s.size})" for s in self.signals.values()]
        lines += [f"  d{state}/dt = {short(rate)}" for state, rate in self.dynamics.items()]
        for kind in ("path", "start", "end", "watch"):
            lines += [f"  {kind:<12} {constraint}" for constraint in getattr(self, kind).values()]
        lines += [f"  apart        {apart}" for apart in self.apart.values()]
        if self.running is not None:
            lines.append(f"  minimize     integral of {short(self.running)} dt + {short(self.terminal)}")
        return "\n".join(lines)


PART_KINDS: dict[str, Any] = {
    **dict.fromkeys(("states", "controls", "parameters"), Variable),
    **dict.fromkeys(("path", "start", "end", "watch"), Constraint),
    "signals": Signal,
    "apart": Separation,
    "phases": PhaseTimes,
}


def _require(holds: bool, what: str) -> None:
    """Raise ProblemError, which names a part, unless it fits the rest of its problem."""
    if not holds:
        raise ProblemError(f"{what} does not fit the rest of its problem", name=what)


def _require_columns(symbols: Any, size: int, what: str, *values: Any) -> None:
    """Require that the values of a part are columns of so many entries, of these symbols."""
    for value in values:
        _require(isinstance(value, symbols) and value.shape == (size, 1), what)


def column_text(value: Any) -> str:
    """A column of numbers or expressions; one number where all entries are the same."""
    if isinstance(value, ca.MX):
        if ca.symvar(value):
            return short(str(value))
        value = ca.evalf(value)
    entries = [str(entry) for entry in ca.vertsplit(value)]
    return entries[0] if len(set(entries)) == 1 else short("[" + ", ".join(entries) + "]")


def short(expression: Any) -> str:
    """An expression on one line of bounded length. SX prints its shared parts first; only bounded text is kept."""
    if not isinstance(expression, str) and ca.Function("size", ca.symvar(expression), [expression]).n_nodes() > 60:
        return f"expression of {', '.join(s.name() for s in ca.symvar(expression)[:8])}, ..."
    text, width = " ".join(str(expression).split()), 100
    return text if len(text) <= width else text[: width - 3] + "..."
