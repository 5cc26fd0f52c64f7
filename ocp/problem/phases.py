"""Phases: consecutive optimal control problems as one problem, joined at times that may be free.

A satellite is approached, grasped and brought to rest; a part is picked up, carried and put down; stages of a rocket
burn out and are dropped. Each phase is a :class:`~ocp.problem.problem.Problem` with its own states, controls, limits,
cost and horizon, fixed or free. Joins couple the end of one phase to the start of others.

All phases run in parallel over the same fraction s in 0..1, each over its own duration T_k:

    dx_k/ds = T_k f_k(x_k, u_k, s T_k),     cost = sum of T_k L_k integrated over s, and of the terminal costs,

A free duration is a state of zero rate, and a join is a condition on both ends, x_b(0) = x_a(1). The result is an
ordinary problem, so the methods need no notion of phases (Betts, Practical Methods for Optimal Control, 2010, section
4.1). The costate of x_k is the same function of time as in the phase alone; if x_b(0) = g(x_a(1)), it jumps according
to lambda_a(1) = g'^T lambda_b(0).

The mesh is that of the fraction: all phases have the same number of intervals with the same spacing.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import casadi as ca
import numpy as np

from ocp.errors import ProblemError, error_names, require
from ocp.problem.declarations import ENDS, Constraint, PhaseTimes, Variable
from ocp.problem.hulls import Separation
from ocp.problem.problem import Problem, checked_problem
from ocp.problem.values import constant, identity, middle_horizon
from ocp.solution_data import entry_named

DURATION = "duration"
"""Name of the state that represents the free duration of a phase."""


@dataclass(frozen=True)
class Phase:
    """A phase of :class:`Phases`, including the symbols and times by which constraints couple it to other phases.

    Attributes:
        name: Name of the phase.
        begin, duration: Start time and duration, s. Scalar expressions for end constraints and terminal costs.
    """

    name: str
    begin: Any
    duration: Any
    _whole: Phases

    def at_start(self, state: str) -> Any:
        """Return the symbol of a state or control at the start of the phase. Shape (n, 1)."""
        return self._whole.at_start(self._symbol(state))

    def at_end(self, state: str) -> Any:
        """Return the symbol of a state or control at the phase's end, for end constraints and costs. Shape (n, 1)."""
        return self._symbol(state)

    def _symbol(self, name: str) -> Any:
        return entry_named(f"state or control of phase {self.name!r}", name, self._whole.of(self.name)).symbol


class Phases(Problem):
    """Several consecutive optimal control problems, joined into one problem.

    ``phases["carry"]`` has the symbols of a phase. :meth:`join` connects phases; ``end`` and ``start`` declare further
    conditions on their ends and starts. The horizon of the whole is 1, the fraction of every phase;
    :meth:`ocp.solution.Solution.phase` returns a phase as a plan over its own time.

    Args:
        name: A name for tables, errors and files.
        phases: The problems by the names of their phases, in the order of time. They are copied; later declarations in
            them have no effect. Parameters of one name are one parameter, given when it is solved. The parts of a phase
            are called ``PHASE.NAME``, a free duration ``PHASE.duration``.

    Raises:
        ProblemError: A phase that is incomplete or has phases itself; parameters of one name and different sizes; a
            signal, or a moving obstacle, in a phase whose duration is not a number.
    """

    def __init__(self, name: str, phases: Mapping[str, Problem]) -> None:
        phases = require.mapping("phases", phases)
        if not phases:
            raise ProblemError(f"problem {name!r}: phases must not be empty", name="phases")
        for phase, problem in phases.items():
            if not phase or "." in phase:
                words = f"problem {name!r}: a phase needs a name without a dot, not {phase!r}"
                raise ProblemError(words, name="phases", value=phase)
            if checked_problem(problem).declared.phases:
                words = f"phase {phase!r} has phases itself; give all phases to one problem"
                raise ProblemError(words, name=phase)
            problem.check()
        super().__init__(name, ca.MX if any(p.symbols is ca.MX for p in phases.values()) else ca.SX)
        self.horizon(1.0)
        begin, running, terminal = (self.symbols(0.0) for _ in range(3))
        for phase, problem in phases.items():
            times = _PhaseInserter(self, phase, problem).declare(begin)
            self.declared.phases[phase] = times
            begin = begin + times.duration
            running, terminal = running + times.running, terminal + times.terminal
        self.declared.running, self.declared.terminal = running, terminal

    def __getitem__(self, name: str) -> Phase:
        """Return a phase by its name."""
        times = entry_named("phase", name, self.declared.phases)
        return Phase(name, times.begin, times.duration, self)

    def of(self, phase: str) -> dict[str, Variable]:
        """Return the states and controls of a phase by their names in that phase."""
        return parts_of_phase(self[phase].name, {**self.declared.states, **self.declared.controls})

    def join(self, before: str, after: str, states: Mapping[str, Any] | None = None) -> None:
        """Declare that one phase continues another: states of the same name are equal at the junction.

        Args:
            before, after: Names of phases, in any order; a phase may be joined to several.
            states: Other initial values of states of ``after``, by their names in it: an expression of ends of phases
                (``phases["free"].at_end("v") + kick``), for example after an impact or a grasp; None leaves a state
                free, except for its own initial value. States of ``after`` that are neither named here nor in
                ``before`` are not affected.

        Raises:
            ProblemError: An unknown phase or state, an expression of the wrong size, a second join, nothing to join.
        """
        first, second = self[before], self[after]
        values = require.mapping("states", states)
        begins = {name: v for name, v in parts_of_phase(after, self.declared.states).items() if name != DURATION}
        ends = parts_of_phase(before, self.declared.states)
        for name in values:
            if name not in begins:
                raise require.unknown(f"state of phase {after!r}", name, begins)
        label = f"{before} to {after}"
        for name in ends:
            if name in begins and name not in values:
                if ends[name].size != begins[name].size:
                    words = f"{label}: {name!r} has {ends[name].size} entries and then {begins[name].size}"
                    raise ProblemError(f"{words}; give its initial value in states", name=name)
                values[name] = first.at_end(name)
        joined = {name: value for name, value in values.items() if value is not None}
        if not joined:
            raise ProblemError(f"{label}: no states of the same name, and no states given", name=after)
        known = [v.symbol for v in (*self.declared.states.values(), *self.declared.parameters.values())]
        rows = {}
        for name, value in joined.items():
            what = f"{label}: {name}"
            if any(what in pool for pool in (self.declared.start, self.declared.end)):
                raise ProblemError(f"{what} is joined twice", name=name)
            with error_names(name):
                expression = self._reader.expression(what, value, [*known, *self.declared.at_start.values()])
            if expression.numel() not in (1, begins[name].size):
                words = f"{what} has {expression.numel()} entries, the state has {begins[name].size}"
                raise ProblemError(words, name=name, value=expression.numel(), limit=begins[name].size)
            rows[what] = second.at_start(name) - expression, begins[name].unit
        for what, (gap, unit) in rows.items():
            self.end(what, gap, lower=0.0, upper=0.0, unit=unit)

    def minimize(self, running: Any = 0, terminal: Any = 0) -> None:
        """Add a terminal cost, a function of the states at the ends of phases, to the sum of the costs of all phases.

        Raises:
            ProblemError: ``running`` is not zero: it belongs to the problem of a phase.
        """
        density, cost = self._costs(running, terminal)
        if not density.is_zero():
            words = f"problem {self.name!r}: a running cost belongs to the problem of a phase"
            raise ProblemError(words, name="running", value=running)
        self.declared.terminal = self.declared.terminal + cost


class _PhaseInserter:
    """Helper that declares variables, equations and constraints of a phase in the symbols of the whole problem."""

    def __init__(self, whole: Phases, name: str, problem: Problem) -> None:
        self.whole, self.name, self.problem = whole, name, problem
        self.old: list[Any] = []
        self.new: list[Any] = []
        self.guess_duration: float | None = None  # duration over which guesses are read, s; None if unknown

    def declare(self, begin: Any) -> PhaseTimes:
        """Declare the phase, except for its cost, in the whole problem; return the times and the cost of the phase."""
        whole, declared = self.whole, self.problem.declared
        for parameter in declared.parameters.values():
            self._parameter(parameter)
        duration, length = self._duration()
        self._replace(self.problem.time, duration * whole.time)
        variables = [("state", v) for v in declared.states.values()]
        variables += [("control", v) for v in declared.controls.values()]
        for kind, variable in variables:
            self._replace(variable.symbol, self._variable(kind, variable))
        for signal in declared.signals.values():
            if length is None:
                words = f"phase {self.name!r}: signal {signal.name!r} needs a horizon that is a number"
                raise ProblemError(words, name=signal.name)
            track = _of_fraction(signal.function, length)
            self._replace(signal.symbol, whole.signal(self._prefix(signal.name), track))
        for name, symbol in declared.at_start.items():
            self._replace(symbol, whole.at_start(self._prefix(name)))
        for name, rate in declared.dynamics.items():
            whole.declared.dynamics[self._prefix(name)] = duration * self._substitute(rate)
        for kind in ("path", "start", "end", "watch"):
            pool = getattr(whole.declared, kind)
            for name, constraint in getattr(declared, kind).items():
                pool[self._prefix(name)] = self._constraint(constraint, duration)
        for name, separation in declared.apart.items():
            whole.declared.apart[self._prefix(name)] = self._separation(separation, length)
        costs = (0 if cost is None else cost for cost in (declared.running, declared.terminal))
        running, terminal = (self._substitute(self.problem.symbols(cost)) for cost in costs)
        terminal = ca.substitute([terminal], [whole.time], [whole.symbols(1.0)])[0]
        return PhaseTimes(self.name, begin, duration, duration * running, terminal)

    def _prefix(self, name: str) -> str:
        return f"{self.name}.{name}"

    def _replace(self, old: Any, new: Any) -> None:
        self.old.append(old)
        self.new.append(new)

    def _substitute(self, expression: Any) -> Any:
        """Return an expression of the phase in the symbols of the whole problem."""
        used = {identity(symbol) for symbol in ca.symvar(expression)}
        pairs = [
            (old, self.whole.symbols(new))
            for old, new in zip(self.old, self.new, strict=True)
            if any(identity(symbol) in used for symbol in ca.symvar(old))
        ]
        inside = ca.Function("placed", [old for old, _ in pairs], [expression])
        inline = inside.is_a("MXFunction") or self.whole.symbols is ca.SX
        placed = inside.call([new for _, new in pairs], inline, False)[0]  # a number if there are no symbols
        return self.whole.symbols(ca.densify(placed))

    def _column(self, values: Any) -> Any:
        """Return a column of expressions in the symbols of the whole problem; entries that are numbers stay numbers."""
        entries = ca.vertsplit(values)
        numbers = [not ca.symvar(entry) for entry in entries]
        placed = [
            self.whole.symbols(ca.DM(constant(entry)[0])) if is_number else self._substitute(entry)
            for entry, is_number in zip(entries, numbers, strict=True)
        ]
        return ca.vertcat(*placed)

    def _parameter(self, parameter: Variable) -> None:
        known = self.whole.declared.parameters.get(parameter.name)
        if known is not None and known.size != parameter.size:
            words = f"parameter {parameter.name!r} has {known.size} entries in one phase, {parameter.size} in another"
            raise ProblemError(words, name=parameter.name)
        symbol = self.whole.parameter(parameter.name, parameter.size) if known is None else known.symbol
        self._replace(parameter.symbol, symbol)

    def _duration(self) -> tuple[Any, float | None]:
        """Return the duration of the phase as an expression and as a number, which is None if the duration is free."""
        horizon = self.problem.declared.horizon
        assert horizon is not None
        if horizon.fixed:
            duration = self._column(horizon.lower)
            number = float(constant(duration)[0])
            self.guess_duration = None if np.isnan(number) else number
            self._replace(horizon.symbol, duration)
            return duration, self.guess_duration
        bounds = {"lower": self._column(horizon.lower), "upper": self._column(horizon.upper)}
        self.guess_duration = horizon.guess
        if self.guess_duration is None:  # the default of any problem
            low, high = (float(constant(bound)[0]) for bound in bounds.values())
            within = middle_horizon(low, high)
            self.guess_duration = None if np.isnan(within) else within
        name = self._prefix(DURATION)
        duration = self.whole.free_parameter(name, 1, **bounds, guess=self.guess_duration, unit="s")
        self._replace(horizon.symbol, duration)
        return duration, None

    def _variable(self, kind: str, variable: Variable) -> Any:
        parts = ("lower", "upper", *(ENDS if kind == "state" else ()))
        values = {part: self._column(getattr(variable, part)) for part in parts}
        guess = variable.guess
        if callable(guess):
            guess = None if self.guess_duration is None else _of_fraction(guess, self.guess_duration)
        declare = self.whole.state if kind == "state" else self.whole.control
        return declare(
            self._prefix(variable.name), variable.size, **values, guess=guess, unit=variable.unit, scale=variable.scale
        )

    def _constraint(self, constraint: Constraint, duration: Any) -> Constraint:
        parts = {part: self._column(getattr(constraint, part)) for part in ("lower", "upper")}
        parts["expression"] = self._substitute(constraint.expression)
        way = None if constraint.way is None else duration * self._substitute(constraint.way)
        if constraint.integral:
            parts["expression"] = duration * parts["expression"]
        return replace(constraint, name=self._prefix(constraint.name), way=way, **parts)

    def _separation(self, separation: Separation, length: float | None) -> Separation:
        if length is None and ca.depends_on(separation.placements, self.problem.time):
            words = (
                f"phase {self.name!r}: {separation.name!r} has moving obstacles and needs a horizon that is a number"
            )
            raise ProblemError(words, name=separation.name)
        return replace(
            separation,
            name=self._prefix(separation.name),
            placements=self._substitute(separation.placements),
            movers={self._prefix(name): size for name, size in separation.movers.items()},
        )


def parts_of_phase(phase: str, pool: Mapping[str, Any]) -> dict[str, Any]:
    """Return those states, controls or other entries that belong to a phase, by their names within the phase."""
    prefix = f"{phase}."
    return {name.removeprefix(prefix): value for name, value in pool.items() if name.startswith(prefix)}


def _of_fraction(function: Callable[[Any], Any], length: float) -> Callable[[Any], Any]:
    """Convert a function of the time of a phase to a function of the fraction of the phase's duration."""
    return lambda fraction: function(fraction * length)
