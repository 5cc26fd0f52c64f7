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
WIDTH = 100  # of an expression shown as text


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

    def check(self, symbols: Any) -> None:
        """Raise ProblemError, which names the part, where declarations that were read from a file do not fit together.

        Args:
            symbols: ``casadi.SX`` or ``casadi.MX``, of which every expression is made.
        """

        def require(holds: bool, what: str) -> None:
            if not holds:
                raise ProblemError(f"{what} does not fit the rest of its problem", name=what)

        def column(value: Any, size: int, what: str) -> None:
            require(isinstance(value, symbols) and value.shape == (size, 1), what)

        for pool, kind in PART_KINDS.items():
            for name, part in getattr(self, pool).items():
                require(isinstance(part, kind) and isinstance(name, str) and part.name == name, f"{pool}: {name!r}")
        columns = {"parameters": ["symbol"], "controls": ["symbol", "lower", "upper"]}
        columns["states"] = [*columns["controls"], *ENDS]
        for pool, needed in columns.items():
            for name, one in getattr(self, pool).items():
                what, n = f"{pool[:-1]} {name!r}", int(np.prod(one.symbol.shape))
                for part in needed:
                    column(getattr(one, part), n, what)
                for value, sizes in ((one.guess, (1, n)), (one.scale, (n,))):
                    require(value is None or np.asarray(value, dtype=float).size in sizes, what)
                require(isinstance(one.unit, str), what)
        for name, rate in self.dynamics.items():
            require(name in self.states, f"dynamics of {name!r}")
            column(rate, self.states[name].size, f"dynamics of {name!r}")
        for name, symbol in self.at_start.items():
            require(name in self.states or name in self.controls, f"start of {name!r}")
            column(symbol, {**self.states, **self.controls}[name].size, f"start of {name!r}")
        for signal in self.signals.values():
            shape = isinstance(signal.function, ca.Function) and (signal.function.n_in(), signal.function.size_in(0))
            require(shape == (1, (1, 1)) and signal.function.numel_out(0) == signal.size, f"signal {signal.name!r}")
        for one in (*self.path.values(), *self.start.values(), *self.end.values(), *self.watch.values()):
            for value in (one.expression, one.lower, one.upper, *(() if one.way is None else (one.way,))):
                column(value, one.size, f"constraint {one.name!r}")
            require(isinstance(one.unit, str) and isinstance(one.integral, bool), f"constraint {one.name!r}")
            given = np.ones(1) if one.tolerance is None else np.asarray(one.tolerance, dtype=float)
            require(given.size in (1, one.size) and bool((given > 0).all()), f"constraint {one.name!r}")
        for apart in self.apart.values():
            movers = {name: self.states[name].size for name in apart.movers if name in self.states}
            require(movers == apart.movers and isinstance(apart.placements, symbols), f"separation {apart.name!r}")
        for phase in self.phases.values():
            for value in (phase.begin, phase.duration, phase.running, phase.terminal):
                column(value, 1, f"phase {phase.name!r}")
        if self.horizon is not None:
            require(isinstance(self.horizon, Horizon) and isinstance(self.horizon.fixed, bool), "horizon")
            for value in (self.horizon.symbol, self.horizon.lower, self.horizon.upper):
                column(value, 1, "horizon")
            require(self.horizon.guess is None or np.isfinite(float(self.horizon.guess)), "horizon")
        for value in (self.running, self.terminal):
            require(value is None or (isinstance(value, symbols) and value.numel() == 1), "cost")

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
    text = " ".join(str(expression).split())
    return text if len(text) <= WIDTH else text[: WIDTH - 3] + "..."
