"""Optimal control problems, declared variable by variable and equation by equation. Declaring solves nothing."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from copy import copy
from dataclasses import replace
from functools import wraps
from inspect import signature
from typing import Any, ParamSpec, TypeVar, cast

import casadi as ca
import numpy as np

from ocp.errors import ProblemError, error_names, require
from ocp.problem.declarations import (
    ENDS,
    RECORD_KINDS,
    Constraint,
    Declarations,
    Guess,
    Horizon,
    Signal,
    Value,
    Variable,
)
from ocp.problem.enclosures import PrescribedMotion
from ocp.problem.expressions import ExpressionReader, check_guess, number_of_entries, read_positive, signal_function
from ocp.problem.hulls import Hull, Separation, index_rows, stack_motion_bounds
from ocp.problem.record_reader import from_record
from ocp.problem.record_writer import to_record
from ocp.problem.values import check_inside, constant, identity

Declare = TypeVar("Declare", bound=Callable[..., Any])
Arguments = ParamSpec("Arguments")
Declared = TypeVar("Declared", bound="Problem")


def _about_its_name(method: Declare) -> Declare:
    """Decorate a method of Problem that declares an item, so that errors of the method name the item."""

    @wraps(method)
    def declare(self: Any, name: Any, *args: Any, **values: Any) -> Any:
        with error_names(name if isinstance(name, str) and name else "name"):
            return method(self, name, *args, **values)

    return cast(Declare, declare)


def checked_problem(problem: Any) -> Problem:
    """Return ``problem``, or raise ProblemError unless it is a Problem."""
    if not isinstance(problem, Problem):
        raise ProblemError(f"a Problem is expected, not {type(problem).__name__}", name="problem", value=problem)
    return problem


def remembers_request(builder: str) -> Callable[[Callable[Arguments, Declared]], Callable[Arguments, Declared]]:
    """Decorate a function that builds a problem, so that the problem stores the function's name and arguments."""

    def decorate(declare: Callable[Arguments, Declared]) -> Callable[Arguments, Declared]:
        parameters = signature(declare)

        @wraps(declare)
        def declared(*args: Arguments.args, **kwargs: Arguments.kwargs) -> Declared:
            problem = declare(*args, **kwargs)
            problem.origin = builder, dict(parameters.bind(*args, **kwargs).arguments)
            return problem

        return declared

    return decorate


class Problem:
    """An optimal control problem, declared step by step and solved by any method.

    Args:
        name: A name for tables, errors and files.
        symbols: ``casadi.SX`` (default; fast derivatives) or ``casadi.MX`` for problems that call interpolants or
            external functions.

    Raises:
        ProblemError: Every method raises it at once for an invalid declaration, and names the fault.
    """

    def __init__(self, name: str, symbols: Any = ca.SX) -> None:
        if symbols not in (ca.SX, ca.MX):
            words = f"problem {name!r}: symbols must be casadi.SX or casadi.MX, not {symbols!r}"
            raise ProblemError(words, name="symbols", value=symbols)
        if not require.text("problem: its name", name):
            raise ProblemError("a problem needs a name", name="name", value=name)
        self.name = name
        self.symbols = symbols
        self.time = symbols.sym("time")
        self.declared = Declarations()
        self.formulated: Any = None  # see ocp.problem.formulation.Formulation.of
        self.origin: Any = None  # the builder that declared it and its arguments, see `remembers_request`

    def __getstate__(self) -> dict[str, Any]:
        """Return the problem as plain data, without those guesses that are functions; see `to_record`."""
        return to_record(self.name, self.symbols, self.time, self.declared)

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Restore the problem with new symbols from data of `__getstate__`; raise ProblemError if they are damaged."""
        self.name, self.symbols, self.time, self.declared = from_record(state, RECORD_KINDS)
        self.declared.check(self.symbols)
        self.formulated = self.origin = None

    @classmethod
    def from_record(cls, state: dict[str, Any]) -> Problem:
        """Rebuild a problem from the data that :meth:`__getstate__` has returned."""
        problem = cls.__new__(cls)
        problem.__setstate__(state)
        return problem

    def __copy__(self) -> Problem:
        """Return a copy with the same symbols, which can be extended independently."""
        duplicate = Problem(self.name, self.symbols)
        duplicate.time = self.time
        for name, value in vars(self.declared).items():
            setattr(duplicate.declared, name, copy(value) if isinstance(value, dict | Horizon) else value)
        return duplicate

    def __deepcopy__(self, memo: Any) -> Problem:
        """Return a copy with the same symbols, which are immutable."""
        return self.__copy__()

    @_about_its_name
    def state(
        self,
        name: str,
        size: int | None = None,
        *,
        initial: Value = None,
        terminal: Value = None,
        lower: Value = None,
        upper: Value = None,
        guess: Guess = None,
        unit: str = "",
        scale: Value = None,
    ) -> Any:
        """Declare a state and return its symbol. Shape (n, 1).

        Args:
            name: Unique name.
            size: Number of entries; by default that of the given arrays (1 if all are scalars).
            initial, terminal: Values at both ends; nan frees an entry, None frees all. A scalar applies to every entry.
                Expressions of parameters are allowed.
            lower, upper: Bounds at all times; expressions of parameters are allowed.
            guess: A value, a function ``time -> value``, or samples (M, n) evenly over the horizon.
            unit: Shown beside the values, "rad" or "m/s"; for mixed entries all units, "rad, m".
            scale: Typical size of the entries, by which the solver divides them; nan for an entry, None for all,
                derives it. Give it if entries of one vector differ by orders of magnitude, as rotor and arm speeds do.
        """
        what, values = f"state {name!r}", {"initial": initial, "terminal": terminal, "lower": lower, "upper": upper}
        variable = self._variable("state", name, size, values, guess, unit, scale)
        low, high = constant(variable.lower), constant(variable.upper)
        ends = {label: self._reader.column(f"{what}: {label}", values[label], variable.size, np.nan) for label in ENDS}
        for label, value in ends.items():
            check_inside(f"{what}: {label}", constant(value), low, high)
        self.declared.states[name] = replace(variable, **ends)
        return variable.symbol

    @_about_its_name
    def control(
        self,
        name: str,
        size: int | None = None,
        *,
        lower: Value = None,
        upper: Value = None,
        guess: Guess = None,
        unit: str = "",
        scale: Value = None,
        rate: Value = None,
    ) -> Any:
        """Declare a control and return its symbol. Shape (n, 1). The arguments are those of :meth:`state`.

        With ``rate``, the largest absolute rate of change, it is a state, and the control is its rate, ``NAME rate``.
        """
        bounds = {"lower": lower, "upper": upper}
        if rate is not None:
            n = number_of_entries(f"control {name!r}", size, {**bounds, "guess": guess, "rate": rate})
            symbol = self.state(name, n, **bounds, guess=guess, unit=unit, scale=scale)
            change = self._reader.column(f"control {name!r}: rate", rate, n, np.nan)
            self.dynamics(symbol, self.control(f"{name} rate", n, lower=-change, upper=change))
            return symbol
        self.declared.controls[name] = self._variable("control", name, size, bounds, guess, unit, scale)
        return self.declared.controls[name].symbol

    @_about_its_name
    def parameter(self, name: str, size: int = 1) -> Any:
        """Declare a parameter, whose value is passed to each solve, and return its symbol. Shape (n, 1)."""
        size = require.count(f"parameter {name!r}: size", size)
        self.declared.parameters[name] = Variable(name, self._symbol("parameter", name, size))
        return self.declared.parameters[name].symbol

    @_about_its_name
    def free_parameter(
        self,
        name: str,
        size: int | None = None,
        *,
        lower: Value = None,
        upper: Value = None,
        guess: Value = None,
        unit: str = "",
    ) -> Any:
        """Declare a constant that is optimised together with the motion, and return its symbol. Shape (n, 1).

        It is a state of zero rate: its costate at the start is the derivative of the cost with respect to it. Arguments
        as for :meth:`state`.
        """
        if callable(guess):
            raise ProblemError(f"free parameter {name!r}: guess must be a value, not a function", value=guess)
        symbol = self.state(name, size, lower=lower, upper=upper, guess=guess, unit=unit)
        self.dynamics(symbol, np.zeros(symbol.numel()))
        return symbol

    @_about_its_name
    def integral(self, name: str, rate: Value, lower: Value = None, upper: Value = None, *, unit: str = "") -> Any:
        """Declare ``lower <= integral of rate dt <= upper``, and return the state that is the integral up to each time.

        Args:
            name: Unique among states and constraints.
            rate: As of :meth:`dynamics`.
            lower, upper: Bounds; expressions of parameters are allowed. With None for both, the integral is
                unconstrained, for use in the terminal cost.
            unit: Unit of the integral.
        """
        what = f"integral {name!r}"
        size = self._reader.expression(what, rate, self._inner()).numel()
        if size == 0:
            raise ProblemError(f"{what} is empty")
        if lower is not None or upper is not None:  # check everything before declaring anything
            self.declared.check_new_constraint("integral", name)
            self._reader.bounds(what, size, lower, upper)
        state = self.state(name, size, initial=0.0, unit=unit)
        self.dynamics(state, rate)
        if lower is not None or upper is not None:
            self.end(name, state, lower, upper, unit=unit)
        return state

    @_about_its_name
    def signal(self, name: str, track: Callable[[Any], Any]) -> Any:
        """Declare a known function of time, and return the symbol of its value. Shape (n, 1).

        Use it for expensive functions of time alone, such as interpolants or paths of many segments. Signals are
        evaluated before the solve and never differentiated twice. The function may require MX symbols even if the
        problem has SX symbols. The horizon must be a number, and the indirect method accepts no signals.

        Args:
            name: Unique name.
            track: Function of a casadi MX symbol, the time (s), that returns a column of expressions.
        """
        function = signal_function(f"signal {name!r}", track)
        self.declared.signals[name] = Signal(name, self._symbol("signal", name, function.numel_out(0)), function)
        return self.declared.signals[name].symbol

    def horizon(
        self, value: Value = None, *, lower: Value = None, upper: Value = None, guess: float | None = None
    ) -> Any:
        """Declare the final time, s, as fixed (``value``) or free (``lower``, ``upper``, ``guess``); return its symbol.

        A free horizon must be positive: so must ``lower`` (default 1e-6 s).
        """
        what = f"problem {self.name!r}: horizon"
        with error_names("horizon"):
            if self.declared.horizon is not None:
                raise ProblemError(f"{what} is declared twice")
            self.declared.horizon = self._reader.horizon(what, value, lower, upper, guess=guess)
        return self.declared.horizon.symbol

    def at_start(self, variable: Any) -> Any:
        """Return the symbol of a state or control at the start, for conditions that involve both ends. Shape (n, 1)."""
        declared = self._find({**self.declared.states, **self.declared.controls}, variable, "at_start")
        if declared.name not in self.declared.at_start:
            self.declared.at_start[declared.name] = self.symbols.sym(f"{declared.name}_at_start", declared.size)
        return self.declared.at_start[declared.name]

    def dynamics(self, state: Any, derivative: Value) -> None:
        """Declare ``d state / dt = derivative`` (n, 1), which may contain states, controls, parameters and time."""
        variable = self._find(self.declared.states, state, "dynamics")
        if variable.name in self.declared.dynamics:
            raise ProblemError(f"state {variable.name!r}: dynamics declared twice", name=variable.name)
        what = f"dynamics of {variable.name!r}"
        with error_names(variable.name):
            expression = self._reader.expression(what, derivative, self._inner())
            if expression.numel() != variable.size:
                raise ProblemError(f"{what} has {expression.numel()} entries, the state has {variable.size}")
        self.declared.dynamics[variable.name] = expression

    @_about_its_name
    def path(
        self,
        name: str,
        expression: Value,
        lower: Value = None,
        upper: Value = None,
        *,
        during: Value = None,
        unit: str = "",
        tolerance: Value = None,
    ) -> None:
        """Declare the path constraint ``lower <= expression <= upper`` at all times; equal bounds make an equality.

        Args:
            lower, upper: Bounds; expressions of parameters and of the time are allowed.
            during: First and last time (s) of the window in which an inequality holds; None: always. Give the mesh
                nodes there: ``method.with_nodes_at(fractions)``.
            tolerance: Largest violation that the audit accepts, in the unit of the expression, if it is smaller than
                the relative tolerance of the constraint; positive, one number for all rows or for each.
        """
        constraint = self._constraint("path", name, expression, (lower, upper), unit, tolerance, during=during)
        self.declared.path[name] = constraint

    @_about_its_name
    def start(self, name: str, expression: Value, lower: Value = None, upper: Value = None, *, unit: str = "") -> None:
        """Declare the constraint ``lower <= expression <= upper`` at the start of the motion."""
        self.declared.start[name] = self._constraint("start", name, expression, (lower, upper), unit)

    @_about_its_name
    def end(self, name: str, expression: Value, lower: Value = None, upper: Value = None, *, unit: str = "") -> None:
        """Declare the constraint ``lower <= expression <= upper`` at the end; it may contain ``at_start`` symbols."""
        known = list(self.declared.at_start.values())
        self.declared.end[name] = self._constraint("end", name, expression, (lower, upper), unit, known=known)

    @_about_its_name
    def watch(
        self,
        name: str,
        expression: Value,
        lower: Value = None,
        upper: Value = None,
        *,
        integral: bool = False,
        way: Value = None,
        unit: str = "",
        tolerance: Value = None,
    ) -> None:
        """Declare ``lower <= expression <= upper`` at all times, which only the audit checks and no solver enforces.

        Use it for conditions that follow from the other constraints up to accumulated errors, such as the position of a
        tip whose velocity is constrained.

        Args:
            name: Unique among the constraints.
            expression: May use ``at_start`` symbols.
            lower, upper: Bounds; expressions of parameters are allowed.
            integral: Whether the bounds apply to the integral of the expression from the start to each time.
            way: Rate of the reference path length, of the expression's size: an error is measured relative to the
                integral of ``way`` along the plan. None: relative to the size of the expression's terms.
            unit: Unit of the expression, or of its integral. tolerance: As of :meth:`path`, in this unit.
        """
        if not isinstance(integral, bool):
            raise ProblemError(f"watch {name!r}: integral must be True or False, not {integral!r}", value=integral)
        known = list(self.declared.at_start.values())
        constraint = self._constraint("watch", name, expression, (lower, upper), unit, tolerance, known)
        rate = None if way is None else self._reader.expression(f"watch {name!r}: way", way, [*self._inner(), *known])
        if rate is not None and rate.numel() != constraint.size:
            words = f"watch {name!r}: way has {rate.numel()} entries, the expression has {constraint.size}"
            raise ProblemError(words, value=rate.numel(), limit=constraint.size)
        self.declared.watch[name] = replace(constraint, integral=integral, way=rate)

    @_about_its_name
    def separate(
        self,
        name: str,
        placements: Value,
        hulls: Mapping[str, Hull],
        pairs: Any,
        *,
        least: Any,
        levers: Mapping[str, Any],
        turns: Mapping[str, Any],
        covers: Mapping[int, Any] | None = None,
        assumed: Mapping[str, str] | None = None,
    ) -> None:
        """Declare minimum distances between bodies, which the audit proves at all times and no solver enforces.

        Args:
            name: Unique among the constraints.
            placements, hulls, pairs, covers, assumed: As of :class:`ocp.problem.hulls.Separation`.
            least: Minimum distance. Shape (n,) or a number, m.
            levers, turns: By the name of a state, upper bounds of the displacement and of the rotation of one body
                relative to the other per unit of the state; see :mod:`ocp.problem.hulls`. Shape (n, size) each.
        """
        self.declared.check_new_constraint("separation", name)
        states = self.declared.states
        movers = {state: self._find(states, state, "separation").size for state in (*levers, *turns)}
        what = f"separation {name!r}"
        count = len(index_rows(what, "pairs", pairs, 3))
        parts: dict[str, Any] = {
            label: stack_motion_bounds(f"{what}: {label}", bounds, movers, count)
            for label, bounds in (("levers", levers), ("turns", turns))
        }
        parameters = self._reader.parameters
        known = [*(state.symbol for state in states.values()), *parameters, self.time]
        frames = self._reader.expression(f"{what}: placements", placements, known)
        parts |= {"covers": covers, "assumed": assumed}
        separation = Separation(name, frames, dict(hulls), pairs, least, movers, **parts)
        zeros = [ca.DM.zeros(parameter.shape) for parameter in parameters]
        # raises if a motion has no bounds
        PrescribedMotion(separation, frames, self.time, parameters=parameters, values=zeros)
        self.declared.apart[name] = separation

    def minimize(self, running: Value = 0, terminal: Value = 0) -> None:
        """Declare the cost ``integral of running dt + terminal``; ``terminal`` may contain ``at_start`` symbols."""
        if self.declared.running is not None:
            raise ProblemError(f"problem {self.name!r}: the cost is declared twice")
        self.declared.running, self.declared.terminal = self._costs(running, terminal)

    def _costs(self, running: Value, terminal: Value) -> list[Any]:
        """Return the running and the terminal cost as scalar expressions; raise ProblemError if they are invalid."""
        ends = [v.symbol for v in (*self.declared.states.values(), *self.declared.parameters.values())]
        ends += [*self.declared.at_start.values(), *self._times()]
        costs = []
        for label, cost, known in (("running", running, self._inner()), ("terminal", terminal, ends)):
            with error_names(label):
                costs.append(self._reader.expression(f"{label} cost", cost, known))
                if (size := costs[-1].numel()) != 1:
                    raise ProblemError(f"{label} cost must be a scalar, it has {size} entries", value=size, limit=1)
        return costs

    def check(self) -> None:
        """Raise ProblemError if the problem is incomplete: it has no state, a state without dynamics, or no horizon."""
        if not self.declared.states:
            raise ProblemError(f"problem {self.name!r} has no state; declare one with problem.state(...)")
        for name in self.declared.states:
            if name not in self.declared.dynamics:
                raise ProblemError(f"state {name!r} has no dynamics; declare problem.dynamics({name}, ...)", name=name)
        if self.declared.horizon is None:
            raise ProblemError(f"problem {self.name!r} has no horizon; declare problem.horizon(...)", name="horizon")

    def __str__(self) -> str:
        """Return a text with one line for each declaration, such as that of a state or of a constraint."""
        return f"Problem {self.name!r}\n{self.declared}"

    def __repr__(self) -> str:
        return f"<Problem {self.name!r}: {len(self.declared.states)} states, {len(self.declared.controls)} controls>"

    def _variable(
        self, kind: str, name: str, size: int | None, values: dict[str, Value], guess: Guess, unit: str, scale: Value
    ) -> Variable:
        what = f"{kind} {name!r}"
        require.text(f"{what}: unit", unit)
        size = number_of_entries(what, size, {**values, "guess": guess})
        symbol = self._symbol(kind, name, size)
        low, high = self._reader.bounds(what, size, values["lower"], values["upper"])
        check_guess(what, guess, size)
        scales = read_positive(f"{what}: scale", scale, size, scale=True)
        return Variable(name, symbol, low, high, guess=guess, unit=unit, scale=scales)

    @property
    def _reader(self) -> ExpressionReader:
        """Reader that converts user values to expressions of this problem and of the parameters declared so far."""
        return ExpressionReader(self.symbols, self.time, tuple(v.symbol for v in self.declared.parameters.values()))

    def _times(self) -> list[Any]:
        return [self.time, *([] if self.declared.horizon is None else [self.declared.horizon.symbol])]

    def _inner(self) -> list[Any]:
        """Return the symbols allowed in path constraints: states, controls, parameters, signals, time and horizon."""
        d = self.declared
        pools = (d.states, d.controls, d.parameters, d.signals)
        return [v.symbol for pool in pools for v in pool.values()] + self._times()

    def _symbol(self, kind: str, name: str, size: int) -> Any:
        self.declared.check_new_variable(kind, name)
        return self.symbols.sym(name, size)

    def _find(self, pool: dict[str, Variable], symbol: Any, what: str) -> Variable:
        if isinstance(symbol, str):
            if symbol in pool:
                return pool[symbol]
            raise require.unknown(f"variable in {what}", symbol, pool)
        if isinstance(symbol, self.symbols) and symbol.is_valid_input():
            identities = [identity(s) for s in ca.symvar(symbol)]
            for variable in pool.values():
                if [identity(s) for s in ca.symvar(variable.symbol)] == identities:
                    return variable
        kind, name = ("state", "state") if what == "dynamics" else ("state or control", "variable")
        words = f"{what}: {symbol!r} is not a declared {kind} of problem {self.name!r}"
        raise ProblemError(f"{words}; known: {', '.join(pool) or 'none'}", name=name, limit=tuple(pool))

    def _constraint(
        self,
        kind: str,
        name: str,
        expression: Value,
        bounds: tuple[Value, Value],
        unit: str,
        tolerance: Value = None,
        known: Sequence[Any] = (),
        during: Value = None,
    ) -> Constraint:
        """Return a new constraint, whose expression may contain ``known`` symbols and those of path constraints."""
        self.declared.check_new_constraint(f"{kind} constraint", name)
        symbols, options = [*self._inner(), *known], {"unit": unit, "tolerance": tolerance, "during": during}
        return self._reader.constraint(kind, name, expression, symbols, bounds=bounds, **options)
