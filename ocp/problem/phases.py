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

from collections.abc import Callable, Collection, Mapping
from copy import copy
from dataclasses import dataclass, replace
from itertools import pairwise
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
        shared: Names of free parameters that the phases have in common. They keep their names.

    Raises:
        ProblemError: A phase that is incomplete or has phases itself; parameters of one name and different sizes; a
            signal, or a moving obstacle, in a phase whose duration is not a number; a shared state that changes.
    """

    def __init__(self, name: str, phases: Mapping[str, Problem], *, shared: Collection[str] = ()) -> None:
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
        for own in shared:
            rates = [problem.declared.dynamics[own] for problem in phases.values() if own in problem.declared.states]
            if not rates or not all(rate.is_zero() for rate in rates):
                raise ProblemError(f"problem {name!r}: shared {own!r} is no free parameter of the phases", name=own)
        for phase, problem in phases.items():
            times = _PhaseInserter(self, phase, problem, shared).declare(begin)
            self.declared.phases[phase] = times
            begin = begin + times.duration
            running, terminal = running + times.running, terminal + times.terminal
        self.declared.running, self.declared.terminal = running, terminal

    @classmethod
    def with_costs_at(cls, problem: Problem, costs: Mapping[float, Any]) -> Phases:
        """Return a problem with additional costs at given times, such as squared deviations from measurements.

        One phase leads from each of these times to the next, ``p0``, ``p1``, ...; the phases are joined, and share the
        free parameters, which keep their names.

        Args:
            problem: A problem with a fixed horizon. Its cost and its constraints remain.
            costs: Scalar expressions of states and parameters, by time, s.

        Raises:
            ProblemError: The horizon is no number, a time is outside it, a cost is no scalar of the states, or the
                problem has signals, watched constraints, separations or phases.
        """
        checked_problem(problem).check()
        declared, what = problem.declared, f"problem {problem.name!r}"
        if declared.signals or declared.watch or declared.apart or declared.phases:
            raise ProblemError(f"{what}: with costs at times it can have no signals, watches, separations or phases")
        horizon = declared.horizon
        assert horizon is not None
        total = float(constant(horizon.lower)[0]) if horizon.fixed else np.nan
        if not isinstance(costs, Mapping) or not all(0.0 <= time <= total for time in costs):
            raise ProblemError(f"{what}: costs at {[*costs]} s do not fit its horizon, {total} s", name="costs")
        times = np.unique([0.0, *costs, total]).tolist()
        legs = {f"p{k}": _leg(problem, begin, end, total) for k, (begin, end) in enumerate(pairwise(times))}
        shared = [name for name, rate in declared.dynamics.items() if rate.is_zero()]
        whole = cls(problem.name, legs, shared=shared)
        for before, after in pairwise(legs):
            whole.join(before, after)

        def at(phase: Phase, expression: Any, begin: bool = False) -> Any:
            """Return an expression of the original problem, evaluated at the start or the end of a phase."""
            pairs = [(problem.time, phase.begin if begin else phase.begin + phase.duration), (horizon.symbol, total)]
            pairs += [(declared.parameters[name].symbol, own.symbol) for name, own in whole.declared.parameters.items()]
            pairs += [(v.symbol, phase.at_start(n) if begin else phase.at_end(n)) for n, v in declared.states.items()]
            pairs += [(symbol, whole["p0"].at_start(name)) for name, symbol in declared.at_start.items()]
            old, new = zip(*pairs, strict=True)
            return ca.substitute([problem.symbols(expression)], list(old), list(map(problem.symbols, new)))[0]

        last = whole[next(reversed(legs))]
        for name, end in declared.end.items():
            whole.end(name, at(last, end.expression), at(last, end.lower), at(last, end.upper), unit=end.unit)
        cost = 0 if declared.terminal is None else at(last, declared.terminal)
        for time, own in costs.items():
            k = times.index(time)
            cost += at(whole[f"p{max(k - 1, 0)}"], own, begin=k == 0)
        whole.minimize(terminal=cost)
        return whole

    def __getitem__(self, name: str) -> Phase:
        """Return a phase by its name."""
        times = entry_named("phase", name, self.declared.phases)
        return Phase(name, times.begin, times.duration, self)

    def of(self, phase: str) -> dict[str, Variable]:
        """Return the states and controls of a phase by their names within the phase, and the shared free parameters."""
        pool = {**self.declared.states, **self.declared.controls}
        shared = {name: own for name, own in pool.items() if name.partition(".")[0] not in self.declared.phases}
        return shared | parts_of_phase(self[phase].name, pool)

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

    def __init__(self, whole: Phases, name: str, problem: Problem, shared: Collection[str]) -> None:
        self.whole, self.name, self.problem, self.shared = whole, name, problem, shared
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
            self._replace(symbol, whole.at_start(name if name in self.shared else self._prefix(name)))
        for name, rate in declared.dynamics.items():
            if name not in self.shared:
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
        """Convert an expression of the phase to the symbols of the whole problem."""
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
        """Convert a column of expressions of the phase to the symbols of the whole problem; numbers stay numbers."""
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
        declare, name = self.whole.state if kind == "state" else self.whole.control, self._prefix(variable.name)
        if variable.name in self.shared:
            name, states = variable.name, self.whole.declared.states
            if name in states:
                return states[name].symbol
            self.whole.declared.dynamics[name] = self.whole.symbols.zeros(variable.size)
        return declare(name, variable.size, **values, guess=guess, unit=variable.unit, scale=variable.scale)

    def _constraint(self, constraint: Constraint, duration: Any) -> Constraint:
        parts = {part: self._column(getattr(constraint, part)) for part in ("lower", "upper")}
        parts["expression"] = self._substitute(constraint.expression)
        way = None if constraint.way is None else duration * self._substitute(constraint.way)
        if constraint.integral:
            parts["expression"] = duration * parts["expression"]
        return replace(constraint, name=self._prefix(constraint.name), way=way, **parts)

    def _separation(self, separation: Separation, length: float | None) -> Separation:
        if length is None and ca.depends_on(separation.placements, self.problem.time):
            words = f"{separation.name!r} has moving obstacles and needs a horizon that is a number"
            raise ProblemError(f"phase {self.name!r}: {words}", name=separation.name)
        return replace(
            separation,
            name=self._prefix(separation.name),
            placements=self._substitute(separation.placements),
            movers={self._prefix(name): size for name, size in separation.movers.items()},
        )


def _leg(problem: Problem, begin: float, end: float, total: float) -> Problem:
    """Return the part of a problem between two times (s), without its terminal cost and its end constraints.

    ``total`` is the problem's horizon, s. Only the first part has given start states, only the last given end states.
    """
    leg = copy(problem)
    own = leg.declared
    assert own.horizon is not None
    old, new = [problem.time, own.horizon.symbol], [problem.time + begin, problem.symbols(total)]

    def moved(expression: Any) -> Any:
        return ca.substitute([problem.symbols(expression)], old, new)[0]

    def guess(value: Any) -> Any:
        if callable(value):
            return lambda t: value(t + begin)
        samples = None if value is None else np.asarray(value, dtype=float)
        if samples is None or samples.ndim < 2:
            return value
        at = np.linspace(0.0, total, len(samples))
        return lambda t: np.array([np.interp(t + begin, at, column) for column in samples.T])

    for pool in (own.states, own.controls):
        for name, variable in pool.items():
            free = {"initial": begin > 0, "terminal": end < total} if pool is own.states else {}
            ends = {key: problem.symbols(ca.DM.nan(variable.size)) for key, is_free in free.items() if is_free}
            pool[name] = replace(variable, guess=guess(variable.guess), **ends)
    own.dynamics = {name: moved(rate) for name, rate in own.dynamics.items()}
    own.path = {name: replace(rows, expression=moved(rows.expression)) for name, rows in own.path.items()}
    own.start = own.start if begin == 0 else {}
    own.running, own.terminal, own.end, own.at_start = moved(0 if own.running is None else own.running), None, {}, {}
    own.horizon = None
    leg.horizon(end - begin)
    return leg


def parts_of_phase(phase: str, pool: Mapping[str, Any]) -> dict[str, Any]:
    """Return those states, controls or other entries that belong to a phase, by their names within the phase."""
    prefix = f"{phase}."
    return {name.removeprefix(prefix): value for name, value in pool.items() if name.startswith(prefix)}


def _of_fraction(function: Callable[[Any], Any], length: float) -> Callable[[Any], Any]:
    """Convert a function of the time of a phase to a function of the fraction of the phase's duration."""
    return lambda fraction: function(fraction * length)
