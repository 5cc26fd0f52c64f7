"""Phases: problems done one after the other as one problem, joined at times that may be free.

A satellite is approached, grasped and brought to rest; a part is picked up, carried and put down; stages of a rocket
burn out and are dropped. Each phase is a :class:`~ocp.problem.problem.Problem` of its own, with its own states,
controls, limits, cost and horizon, fixed or free; what is said between them ties the ends of one to those of others.

All phases run side by side over the same fraction s in 0..1, each over its own duration T_k:

    dx_k/ds = T_k f_k(x_k, u_k, s T_k),     cost = sum of T_k L_k integrated over s, and of the terminal costs,

a free duration being a state that stands still, and a join a condition that ties both ends, x_b(0) = x_a(1). So what
is solved, audited, refined and saved is one problem as any other (Betts, Practical Methods for Optimal Control, 2010,
section 4.1, says the same of intervals on which nothing else changes), and no method knows of phases. The costate of
x_k is the same function of time that it is in the phase; where x_b(0) = g(x_a(1)) it jumps as theory says, by
lambda_a(1) = g'^T lambda_b(0).

The mesh is that of the fraction: all phases have as many intervals, spread alike.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import casadi as ca
import numpy as np

from ocp.errors import ProblemError, checked_text, error_names, unknown_name
from ocp.problem.declarations import Constraint, PhaseTimes, Variable
from ocp.problem.problem import Problem, checked_problem
from ocp.problem.separation import Separation
from ocp.problem.values import constant, identity, is_symbolic, numeric

__all__ = ["Phase", "Phases"]

DURATION = "duration"
"""Name of a free duration among the states of a phase."""


@dataclass(frozen=True)
class Phase:
    """A phase of :class:`Phases`: symbols and expressions to tie it to others.

    Attributes:
        name: Its name.
        begin, duration: When it begins, and how long it takes, s. Scalar expressions for ends and terminal costs.
    """

    name: str
    begin: Any
    duration: Any
    _whole: Phases

    def at_start(self, state: str) -> Any:
        """A state, or control, at the start of the phase. Shape (n, 1)."""
        return self._whole.at_start(self._symbol(state))

    def at_end(self, state: str) -> Any:
        """A state, or control, at the end of the phase, in ends and terminal costs. Shape (n, 1)."""
        return self._symbol(state)

    def _symbol(self, name: str) -> Any:
        own = self._whole.of(self.name)
        if name not in own:
            raise unknown_name(f"state or control of phase {self.name!r}", name, own)
        return own[name].symbol


class Phases(Problem):
    """Problems done one after the other, as one problem.

    ``phases["carry"]`` has the symbols of a phase; :meth:`join` says what goes on from one into the next; ``end`` ties
    whatever else there is at the ends of phases, ``start`` what is at their starts. The horizon of the whole is 1, the
    fraction of every phase; :meth:`ocp.solution.Solution.phase` gives a phase as a plan over its own time.

    Args:
        name: A name for tables, errors and files.
        phases: The problems by the names of their phases, in the order of time. They are read, not kept; what is
            declared in them later does not count. Parameters of one name are one parameter, given when it is solved.
            What belongs to a phase is called ``PHASE.NAME``, a free duration ``PHASE.duration``.

    Raises:
        ProblemError: A phase that is no complete problem, or a problem of phases itself; parameters of one name and
            different sizes; a signal, or what is moved by time alone and has to stay clear, in a phase whose duration
            is no number.
    """

    def __init__(self, name: str, phases: Mapping[str, Problem]) -> None:
        if not _by_name("phases", phases):
            raise ProblemError(f"problem {name!r}: problems by the names of their phases are expected", name="phases")
        for each, problem in phases.items():
            if not checked_text(f"problem {name!r}: name of a phase", each) or "." in each:
                words = f"problem {name!r}: a phase needs a name without a dot, not {each!r}"
                raise ProblemError(words, name="phases", value=each)
            if checked_problem(problem).declared.phases:
                words = f"phase {each!r} has phases itself; give them all to one problem"
                raise ProblemError(words, name=each)
            problem.check()
        super().__init__(name, ca.MX if any(p.symbols is ca.MX for p in phases.values()) else ca.SX)
        self.horizon(1.0)
        begin, running, terminal = (self.symbols(0.0) for _ in range(3))
        for each, problem in phases.items():
            times = _Placed(self, each, problem).declare(begin)
            self.declared.phases[each] = times
            begin = begin + times.duration
            running, terminal = running + times.running, terminal + times.terminal
        self.declared.running, self.declared.terminal = running, terminal

    def __getitem__(self, name: str) -> Phase:
        """A phase by its name."""
        if not isinstance(name, str) or name not in self.declared.phases:
            raise unknown_name("phase", name, self.declared.phases)
        times = self.declared.phases[name]
        return Phase(name, times.begin, times.duration, self)

    def of(self, phase: str) -> dict[str, Variable]:
        """States and controls of a phase, by their names in it."""
        return own_of(self[phase].name, {**self.declared.states, **self.declared.controls})

    def join(self, before: str, after: str, states: Mapping[str, Any] | None = None) -> None:
        """A phase goes on from where another ends: states of the same name have the same values.

        Args:
            before, after: Names of phases, in whatever order; a phase may be joined to several.
            states: What states of ``after`` start from instead, by their names in it: an expression of ends of phases
                (``phases["free"].at_end("v") + kick``), as after an impact or a grasp; None where nothing is said of
                one, which is free then but for its own initial value. States of ``after`` that are not named here and
                that ``before`` does not have are left alone.

        Raises:
            ProblemError: An unknown phase or state, an expression of the wrong size, joined twice, nothing to join.
        """
        one, other = self[before], self[after]
        said = dict(_by_name("states", {} if states is None else states))
        begins = {name: v for name, v in own_of(after, self.declared.states).items() if name != DURATION}
        ends = own_of(before, self.declared.states)
        for name in said:
            if name not in begins:
                raise unknown_name(f"state of phase {after!r}", name, begins)
        label = f"{before} to {after}"
        for name in ends:
            if name in begins and name not in said:
                if ends[name].size != begins[name].size:
                    words = f"{label}: {name!r} has {ends[name].size} entries and then {begins[name].size}; say what it"
                    raise ProblemError(f"{words} starts from", name=name)
                said[name] = one.at_end(name)
        joined = {name: value for name, value in said.items() if value is not None}
        if not joined:
            raise ProblemError(f"{label}: no state of the same name, and none said", name=after)
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
            rows[what] = other.at_start(name) - expression, begins[name].unit
        for what, (gap, unit) in rows.items():
            self.end(what, gap, lower=0.0, upper=0.0, unit=unit)

    def guess(self, plans: Mapping[str, Any]) -> dict[str, Any]:
        """A guess of the whole from plans of phases made one by one, :class:`ocp.solution.Solution`, by their names."""
        found: dict[str, Any] = {}
        for phase, plan in _by_name("plans", plans).items():
            own = self.of(phase)
            if not all(hasattr(plan, part) for part in ("states", "controls", "at_fraction")):
                raise ProblemError(f"phase {phase!r}: a plan is expected, not {plan!r}", name=phase, value=plan)
            for name in own:
                if name in plan.states or name in plan.controls:
                    found[f"{phase}.{name}"] = lambda s, plan=plan, name=name: plan.at_fraction(s)[name]
            if DURATION in own and DURATION not in plan.states:
                found[f"{phase}.{DURATION}"] = plan.horizon
        return found

    def minimize(self, running: Any = 0, terminal: Any = 0) -> None:
        """Declare a terminal cost of ends of phases, which is added to the costs that the phases have themselves.

        Raises:
            ProblemError: ``running`` is given: it belongs to the problem of a phase.
        """
        with error_names("running"):
            nothing = not is_symbolic(running) and not numeric("running cost", running).any()
        if not nothing:
            words = f"problem {self.name!r}: a running cost belongs to the problem of a phase"
            raise ProblemError(words, name="running", value=running)
        own = self.declared.running, self.declared.terminal
        self.declared.running = self.declared.terminal = None
        try:
            super().minimize(0, terminal)
        except ProblemError:
            self.declared.running, self.declared.terminal = own
            raise
        self.declared.running, self.declared.terminal = own[0], own[1] + self.declared.terminal


class _Placed:
    """The declarations of a phase, in the symbols of the whole."""

    def __init__(self, whole: Phases, name: str, problem: Problem) -> None:
        self.whole, self.name, self.problem = whole, name, problem
        self.old: list[Any] = []
        self.new: list[Any] = []
        self.guessed: float | None = None  # duration that guesses are read over, s; None where it is not known

    def declare(self, begin: Any) -> PhaseTimes:
        """Declare all that the phase says but its cost, which is returned with its times."""
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
                words = f"phase {self.name!r}: signals need a horizon that is a number; {signal.name!r} is one"
                raise ProblemError(words, name=signal.name)
            track = _stretched(signal.function, length)
            self._replace(signal.symbol, whole.signal(self._called(signal.name), track))
        for name, symbol in declared.at_start.items():
            self._replace(symbol, whole.at_start(self._called(name)))
        for name, rate in declared.dynamics.items():
            whole.declared.dynamics[self._called(name)] = duration * self._placed(rate)
        for kind in ("path", "start", "end", "watch"):
            pool = getattr(whole.declared, kind)
            for name, constraint in getattr(declared, kind).items():
                pool[self._called(name)] = self._constraint(constraint, duration)
        for name, apart in declared.apart.items():
            whole.declared.apart[self._called(name)] = self._apart(apart, length)
        costs = (0 if cost is None else cost for cost in (declared.running, declared.terminal))
        running, terminal = (self._placed(self.problem.symbols(cost)) for cost in costs)
        terminal = ca.substitute([terminal], [whole.time], [whole.symbols(1.0)])[0]
        return PhaseTimes(self.name, begin, duration, duration * running, terminal)

    def _called(self, name: str) -> str:
        return f"{self.name}.{name}"

    def _replace(self, old: Any, new: Any) -> None:
        self.old.append(old)
        self.new.append(new)

    def _placed(self, expression: Any) -> Any:
        """An expression of the phase in the symbols of the whole."""
        used = {identity(symbol) for symbol in ca.symvar(expression)}
        pairs = [
            (old, self.whole.symbols(new))
            for old, new in zip(self.old, self.new, strict=True)
            if any(identity(symbol) in used for symbol in ca.symvar(old))
        ]
        inside = ca.Function("placed", [old for old, _ in pairs], [expression])
        inline = inside.is_a("MXFunction") or self.whole.symbols is ca.SX
        placed = inside.call([new for _, new in pairs], inline, False)[0]  # numbers of what has no symbols
        return self.whole.symbols(ca.densify(placed))

    def _column(self, values: Any) -> Any:
        """As :meth:`_placed`, entry by entry, so that what is a number remains one."""
        entries = ca.vertsplit(values)
        numbers = [not ca.symvar(entry) for entry in entries]
        placed = [
            self.whole.symbols(ca.DM(constant(entry)[0])) if known else self._placed(entry)
            for entry, known in zip(entries, numbers, strict=True)
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
        """Its duration, and the number that it is, None where it is none."""
        horizon = self.problem.declared.horizon
        assert horizon is not None
        if horizon.fixed:
            duration = self._column(horizon.lower)
            number = float(constant(duration)[0])
            self.guessed = None if np.isnan(number) else number
            self._replace(horizon.symbol, duration)
            return duration, self.guessed
        bounds = {"lower": self._column(horizon.lower), "upper": self._column(horizon.upper)}
        self.guessed = horizon.guess
        if self.guessed is None:  # as of any problem
            low, high = (float(constant(bound)[0]) for bound in bounds.values())
            within = np.clip(1.0, low, high) if np.isinf(high) else 0.5 * (low + high)
            self.guessed = None if np.isnan(within) else float(within)
        name = self._called(DURATION)
        duration = self.whole.free_parameter(name, 1, **bounds, guess=self.guessed, unit="s")
        self._replace(horizon.symbol, duration)
        return duration, None

    def _variable(self, kind: str, variable: Variable) -> Any:
        known = {"lower": self._column(variable.lower), "upper": self._column(variable.upper)}
        if kind == "state":
            known |= {"initial": self._column(variable.initial), "terminal": self._column(variable.terminal)}
        guess = variable.guess
        if callable(guess):
            guess = None if self.guessed is None else _stretched(guess, self.guessed)
        declare = self.whole.state if kind == "state" else self.whole.control
        return declare(
            self._called(variable.name), variable.size, **known, guess=guess, unit=variable.unit, scale=variable.scale
        )

    def _constraint(self, given: Constraint, duration: Any) -> Constraint:
        parts = {part: self._column(getattr(given, part)) for part in ("lower", "upper")}
        parts["expression"] = self._placed(given.expression)
        way = None if given.way is None else duration * self._placed(given.way)
        if given.integral:
            parts["expression"] = duration * parts["expression"]
        return replace(given, name=self._called(given.name), way=way, **parts)

    def _apart(self, given: Separation, length: float | None) -> Separation:
        if length is None and ca.depends_on(given.placements, self.problem.time):
            words = f"phase {self.name!r}: {given.name!r} keeps clear of what moves by time, and needs a horizon that"
            raise ProblemError(f"{words} is a number", name=given.name)
        return replace(
            given,
            name=self._called(given.name),
            placements=self._placed(given.placements),
            movers={self._called(name): size for name, size in given.movers.items()},
        )


def own_of(phase: str, pool: Mapping[str, Any]) -> dict[str, Any]:
    """What of a pool belongs to a phase, by the names in it."""
    head = f"{phase}."
    return {name.removeprefix(head): value for name, value in pool.items() if name.startswith(head)}


def _by_name(what: str, given: Any) -> Mapping[str, Any]:
    if not isinstance(given, Mapping):
        raise ProblemError(f"{what}: a mapping by name is expected, not {given!r}", name=what, value=given)
    return given


def _stretched(function: Callable[[Any], Any], length: float) -> Callable[[Any], Any]:
    """A function of the time of a phase as one of its fraction."""
    return lambda fraction: function(fraction * length)
