"""What is asked: states, controls, parameters, dynamics, constraints, cost. Inert: declaring solves nothing.

``str(problem)`` shows all that was declared, one thing a line.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from copy import copy
from dataclasses import replace
from functools import wraps
from inspect import signature
from typing import Any, ParamSpec, TypeVar, cast

import casadi as ca
import numpy as np

from ocp.errors import ProblemError, checked_count, checked_text, error_names, unknown_name
from ocp.problem.declarations import ENDS, Constraint, Declarations, Guess, Horizon, PhaseTimes, Signal, Variable
from ocp.problem.enclosures import PrescribedMotion
from ocp.problem.expressions import ExpressionReader, Value, check_guess, number_of_entries, read_scale, signal_function
from ocp.problem.hulls import Hull
from ocp.problem.separation import Separation, index_rows, stack_motion_bounds
from ocp.problem.stored import from_record, stored
from ocp.problem.values import check_inside, constant, identity

__all__ = ["Problem", "checked_problem", "remembers_request"]

Declare = TypeVar("Declare", bound=Callable[..., Any])
Given = ParamSpec("Given")


def _about_its_name(method: Declare) -> Declare:
    """What a declaration raises is about the name it is given."""

    @wraps(method)
    def declare(self: Any, name: Any, *args: Any, **values: Any) -> Any:
        with error_names(name if isinstance(name, str) and name else "name"):
            return method(self, name, *args, **values)

    return cast(Declare, declare)


def checked_problem(problem: Any) -> Problem:
    """``problem``, or ProblemError where it is none."""
    if not isinstance(problem, Problem):
        raise ProblemError(f"a Problem is expected, not {type(problem).__name__}", name="problem", value=problem)
    return problem


def remembers_request(builder: str) -> Callable[[Callable[Given, Problem]], Callable[Given, Problem]]:
    """Let the problems of a builder remember its name and arguments, from which they can be declared again."""

    def decorate(declare: Callable[Given, Problem]) -> Callable[Given, Problem]:
        @wraps(declare)
        def declared(*args: Given.args, **kwargs: Given.kwargs) -> Problem:
            problem = declare(*args, **kwargs)
            problem.origin = builder, signature(declare).bind(*args, **kwargs).arguments
            return problem

        return declared

    return decorate


class Problem:
    """An optimal control problem, declared piece by piece and solved by a method of choice.

    Args:
        name: A name for tables, errors and files.
        symbols: ``casadi.SX`` (default; fast derivatives) or ``casadi.MX`` for problems that call interpolants
            or external functions.

    Raises:
        ProblemError: From every method, naming what is wrong, at the moment it is declared.
    """

    def __init__(self, name: str, symbols: Any = ca.SX) -> None:
        if symbols not in (ca.SX, ca.MX):
            words = f"problem {name!r}: symbols must be casadi.SX or casadi.MX, not {symbols!r}"
            raise ProblemError(words, name="symbols", value=symbols)
        if not checked_text("problem: its name", name):
            raise ProblemError("a problem needs a name", name="name", value=name)
        self.name = name
        self.symbols = symbols
        self.time = symbols.sym("time")
        self.declared = Declarations()
        self.formulated: Any = None  # see ocp.problem.formulation.Formulation.of
        self.origin: Any = None  # the builder that declared it and its arguments, see `remembers_request`

    # ---- copies and files ------------------------------------------------------------------------------------

    def __getstate__(self) -> dict[str, Any]:
        """Return the problem as data, see :mod:`ocp.problem.stored`. Guesses that are functions are left out.

        Raises:
            ProblemError: An expression calls what is no elementary operation, such as a function of Python's.
        """
        return stored(self.name, self.symbols, self.time, self.declared)

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Restore what :meth:`__getstate__` returned, with new symbols.

        Raises:
            ProblemError: The record is damaged.
        """
        kinds = (Variable, Signal, Constraint, Horizon, PhaseTimes, Declarations, Separation, Hull)
        self.name, self.symbols, self.time, self.declared = from_record(state, kinds)
        self.declared.check(self.symbols)
        self.formulated = self.origin = None

    @classmethod
    def from_record(cls, state: dict[str, Any]) -> Problem:
        """Return the problem of which :meth:`__getstate__` returned the state."""
        problem = cls.__new__(cls)
        problem.__setstate__(state)
        return problem

    def __copy__(self) -> Problem:
        """A problem of the same symbols, to which more can be declared."""
        again = Problem(self.name, self.symbols)
        again.time = self.time
        for name, value in vars(self.declared).items():
            setattr(again.declared, name, copy(value) if isinstance(value, dict | Horizon) else value)
        return again

    def __deepcopy__(self, memo: Any) -> Problem:
        """As a copy: symbols never change."""
        return self.__copy__()

    # ---- variables -------------------------------------------------------------------------------------------

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
        """Declare a state and return its symbol, shape (n, 1).

        Args:
            name: Unique name.
            size: Number of entries; taken from the arrays given where left out (1 if they are all scalars).
            initial, terminal: Values at both ends; nan leaves an entry free, None leaves all free. A scalar is
                for every entry. May be expressions of parameters.
            lower, upper: Bounds at every time; may be expressions of parameters.
            guess: A value, or a function ``time -> value``.
            unit: Shown beside its values, "rad" or "m/s"; of a vector of several kinds all of them, "rad, m".
            scale: About how large its entries become, by which they are divided to be solved for; nan for an entry, and
                None for all, leaves that to what is given: numbers that are usual are left alone then. For entries
                of one vector that differ by orders of magnitude, as the speeds of a rotor and of an arm.
        """
        what, given = f"state {name!r}", {"initial": initial, "terminal": terminal, "lower": lower, "upper": upper}
        variable = self._variable("state", name, size, given, guess, unit, scale)
        low, high = constant(variable.lower), constant(variable.upper)
        ends = {label: self._reader.column(f"{what}: {label}", given[label], variable.size, np.nan) for label in ENDS}
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
    ) -> Any:
        """Declare a control and return its symbol, shape (n, 1). Arguments as for :meth:`state`."""
        bounds = {"lower": lower, "upper": upper}
        self.declared.controls[name] = self._variable("control", name, size, bounds, guess, unit, scale)
        return self.declared.controls[name].symbol

    @_about_its_name
    def parameter(self, name: str, size: int = 1) -> Any:
        """Declare a parameter, whose value is given at solve time, and return its symbol, shape (n, 1)."""
        size = checked_count(f"parameter {name!r}: size", size)
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
        """Declare a number that is sought with the motion, a state that stands still; return its symbol, shape (n, 1).

        Arguments as for :meth:`state`; its bounds hold, its costate at the start is the derivative of the cost in it.
        """
        if callable(guess):
            raise ProblemError(f"free parameter {name!r}: guess must be a value, not a function", value=guess)
        symbol = self.state(name, size, lower=lower, upper=upper, guess=guess, unit=unit)
        self.dynamics(symbol, np.zeros(symbol.numel()))
        return symbol

    @_about_its_name
    def integral(self, name: str, rate: Value, lower: Value = None, upper: Value = None, *, unit: str = "") -> Any:
        """Declare ``lower <= integral of rate dt <= upper`` over the horizon; return the integral so far, a state.

        Args:
            name: Unique among states and constraints.
            rate: As of :meth:`dynamics`.
            lower, upper: Bounds; may be expressions of parameters. None on both sides: it is only integrated, to stand
                in the terminal cost, say.
            unit: Of the integral.
        """
        what = f"integral {name!r}"
        size = self._reader.expression(what, rate, self._inner()).numel()
        if size == 0:
            raise ProblemError(f"{what} is empty")
        if lower is not None or upper is not None:  # all is looked at before anything is declared
            self.declared.check_new_constraint("integral", name)
            self._reader.bounds(what, size, lower, upper)
        state = self.state(name, size, initial=0.0, unit=unit)
        self.dynamics(state, rate)
        if lower is not None or upper is not None:
            self.end(name, state, lower, upper, unit=unit)
        return state

    @_about_its_name
    def signal(self, name: str, track: Callable[[Any], Any]) -> Any:
        """Declare a known function of time and return the symbol of its value, shape (n, 1).

        For what the time alone decides and takes long to say: interpolants, paths of many pieces. It is evaluated
        before anything is solved, never differentiated twice, and may call what takes MX symbols only, in a problem of
        SX symbols. The horizon has to be a number then; the indirect method takes none.

        Args:
            name: Unique name.
            track: casadi time (s), an MX symbol -> a column of expressions.
        """
        function = signal_function(f"signal {name!r}", track)
        self.declared.signals[name] = Signal(name, self._symbol("signal", name, function.numel_out(0)), function)
        return self.declared.signals[name].symbol

    def horizon(
        self, value: Value = None, *, lower: Value = None, upper: Value = None, guess: float | None = None
    ) -> Any:
        """Fix the final time (``value``, s) or free it (``lower``, ``upper``, ``guess``); return its symbol.

        A free horizon starts at 0 excluded: ``lower`` must be positive (default 1e-6 s).
        """
        what = f"problem {self.name!r}: horizon"
        with error_names("horizon"):
            if self.declared.horizon is not None:
                raise ProblemError(f"{what} is declared twice")
            self.declared.horizon = self._reader.horizon(what, value, lower, upper, guess)
        return self.declared.horizon.symbol

    def at_start(self, variable: Any) -> Any:
        """Symbol of a state or control at the start, for conditions that tie both ends. Shape (n, 1)."""
        found = self._find({**self.declared.states, **self.declared.controls}, variable, "at_start")
        if found.name not in self.declared.at_start:
            self.declared.at_start[found.name] = self.symbols.sym(f"{found.name}_at_start", found.size)
        return self.declared.at_start[found.name]

    # ---- equations -------------------------------------------------------------------------------------------

    def dynamics(self, state: Any, derivative: Value) -> None:
        """Declare ``d state / dt = derivative``, shape (n, 1), of states, controls, parameters, time, horizon."""
        found = self._find(self.declared.states, state, "dynamics")
        if found.name in self.declared.dynamics:
            raise ProblemError(f"state {found.name!r}: dynamics declared twice", name=found.name)
        what = f"dynamics of {found.name!r}"
        with error_names(found.name):
            expression = self._reader.expression(what, derivative, self._inner())
            if expression.numel() != found.size:
                raise ProblemError(f"{what} has {expression.numel()} entries, the state has {found.size}")
        self.declared.dynamics[found.name] = expression

    @_about_its_name
    def path(
        self,
        name: str,
        expression: Value,
        lower: Value = None,
        upper: Value = None,
        *,
        unit: str = "",
        tolerance: Value = None,
    ) -> None:
        """Declare ``lower <= expression <= upper`` at every time; equal bounds make an equality.

        Args:
            tolerance: Largest violation that the audit lets pass, in the unit of the expression, where that is less
                than its share of the constraint's size; positive numbers, one for all rows or for each.
        """
        self.declared.path[name] = self._constraint("path", name, expression, (lower, upper), unit, tolerance)

    @_about_its_name
    def start(self, name: str, expression: Value, lower: Value = None, upper: Value = None, *, unit: str = "") -> None:
        """Declare ``lower <= expression <= upper`` at the start."""
        self.declared.start[name] = self._constraint("start", name, expression, (lower, upper), unit)

    @_about_its_name
    def end(self, name: str, expression: Value, lower: Value = None, upper: Value = None, *, unit: str = "") -> None:
        """Declare ``lower <= expression <= upper`` at the end; ``at_start`` symbols tie it to the start."""
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
        """Declare that the audit judges ``lower <= expression <= upper`` at every time, which no method holds.

        For what follows from the other constraints but for small errors that add up: the place of a tip whose velocity
        is held.

        Args:
            name: Unique among the constraints.
            expression: May use ``at_start`` symbols.
            lower, upper: Bounds; may be expressions of parameters.
            integral: Whether the integral of the expression from the start to each time is meant.
            way: Rate of the way that is judged against, of the expression's size: a miss is relative to how far the
                integral of ``way`` goes along the plan. None: to what the expression is made of.
            unit: Of the expression, or of its integral. tolerance: As of :meth:`path`, in this unit.
        """
        if not isinstance(integral, bool):
            raise ProblemError(f"watch {name!r}: integral must be True or False, not {integral!r}", value=integral)
        known = list(self.declared.at_start.values())
        found = self._constraint("watch", name, expression, (lower, upper), unit, tolerance, known)
        rate = None if way is None else self._reader.expression(f"watch {name!r}: way", way, [*self._inner(), *known])
        if rate is not None and rate.numel() != found.size:
            words = f"watch {name!r}: way has {rate.numel()} entries, the expression has {found.size}"
            raise ProblemError(words, value=rate.numel(), limit=found.size)
        self.declared.watch[name] = replace(found, integral=integral, way=rate)

    @_about_its_name
    def separate(
        self,
        name: str,
        placements: Value,
        hulls: Mapping[str, Hull],
        pairs: Any,
        least: Any,
        *,
        levers: Mapping[str, Any],
        turns: Mapping[str, Any],
        covers: Mapping[int, Any] | None = None,
        assumed: Mapping[str, str] | None = None,
    ) -> None:
        """Declare bodies that have to stay apart at every time, which the audit proves and no method holds.

        Args:
            name: Unique among the constraints.
            placements: Of F frames in world: rotation column by column, then position, one below the other. Each of
                states and parameters, or of time and parameters. Shape (12 F, 1).
            hulls: The bodies by name, on these frames or in world.
            pairs: Of each pair the two bodies, by their places in ``hulls``, and the frame from which one is seen from
                the other, -1 for the world. Shape (n, 3).
            least: Least distance. Shape (n,) or a number, m.
            levers, turns: By the name of a state: how far, and by what angle, it moves and turns one body seen from the
                other at most, by its unit; see :mod:`ocp.problem.separation`. Shape (n, size) each.
            covers: By the place of a pair, pairs of bodies that hold its two between them. Shape (m, 2) each.
            assumed: Pairs that are left out by assumption, in words, and why: the audit tells them.
        """
        self.declared.check_new_constraint("separation", name)
        movers = {}
        for each in (*levers, *turns):
            movers[each] = self._find(self.declared.states, each, "separation").size
        what = f"separation {name!r}"
        count = len(index_rows(what, "pairs", pairs, 3))
        parts: dict[str, Any] = {
            label: stack_motion_bounds(f"{what}: {label}", given, movers, count)
            for label, given in (("levers", levers), ("turns", turns))
        }
        parameters = self._reader.parameters
        known = [*(v.symbol for v in self.declared.states.values()), *parameters, self.time]
        frames = self._reader.expression(f"{what}: placements", placements, known)
        parts |= {"covers": {} if covers is None else covers, "assumed": {} if assumed is None else assumed}
        apart = Separation(name, frames, dict(hulls), pairs, least, movers, **parts)
        PrescribedMotion(apart, frames, self.time, parameters, [ca.DM.zeros(each.shape) for each in parameters])
        self.declared.apart[name] = apart

    def minimize(self, running: Value = 0, terminal: Value = 0) -> None:
        """Declare the cost: ``integral of running dt + terminal``. ``terminal`` may use ``at_start`` symbols."""
        if self.declared.running is not None:
            raise ProblemError(f"problem {self.name!r}: the cost is declared twice")
        ends = [v.symbol for v in (*self.declared.states.values(), *self.declared.parameters.values())]
        ends += [*self.declared.at_start.values(), self.time, *self._horizon_symbol()]
        costs = {}
        for label, cost, known in (("running", running, self._inner()), ("terminal", terminal, ends)):
            with error_names(label):
                costs[label] = self._reader.expression(f"{label} cost", cost, known)
                if (size := costs[label].numel()) != 1:
                    raise ProblemError(f"{label} cost must be a scalar, it has {size} entries", value=size, limit=1)
        self.declared.running, self.declared.terminal = costs["running"], costs["terminal"]

    def check(self) -> None:
        """Raise ProblemError where the declaration is not complete: no state, a state without dynamics, no horizon."""
        if not self.declared.states:
            raise ProblemError(f"problem {self.name!r} has no state; declare one with problem.state(...)")
        for name in self.declared.states:
            if name not in self.declared.dynamics:
                raise ProblemError(f"state {name!r} has no dynamics; declare problem.dynamics({name}, ...)", name=name)
        if self.declared.horizon is None:
            raise ProblemError(f"problem {self.name!r} has no horizon; declare problem.horizon(...)", name="horizon")

    def __str__(self) -> str:
        """States, controls, parameters, horizon, dynamics, constraints and cost by name, one a line."""
        return f"Problem {self.name!r}\n{self.declared}"

    def __repr__(self) -> str:
        d = self.declared
        return f"<Problem {self.name!r}: {len(d.states)} states, {len(d.controls)} controls>"

    # ---- checks ----------------------------------------------------------------------------------------------

    def _variable(
        self, kind: str, name: str, size: int | None, given: dict[str, Value], guess: Guess, unit: str, scale: Value
    ) -> Variable:
        what = f"{kind} {name!r}"
        checked_text(f"{what}: unit", unit)
        size = number_of_entries(what, size, {**given, "guess": guess})
        symbol = self._symbol(kind, name, size)
        low, high = self._reader.bounds(what, size, given["lower"], given["upper"])
        check_guess(what, guess, size)
        return Variable(name, symbol, low, high, guess=guess, unit=unit, scale=read_scale(what, scale, size))

    @property
    def _reader(self) -> ExpressionReader:
        """Reads values of this problem's symbols; ends and bounds may refer to the parameters declared so far."""
        return ExpressionReader(self.symbols, tuple(v.symbol for v in self.declared.parameters.values()))

    def _horizon_symbol(self) -> list[Any]:
        return [] if self.declared.horizon is None else [self.declared.horizon.symbol]

    def _inner(self) -> list[Any]:
        """Symbols that may stand inside the horizon."""
        d = self.declared
        pools = (d.states, d.controls, d.parameters, d.signals)
        return [v.symbol for pool in pools for v in pool.values()] + [self.time, *self._horizon_symbol()]

    def _symbol(self, kind: str, name: str, size: int) -> Any:
        self.declared.check_new_variable(kind, name)
        return self.symbols.sym(name, size)

    def _find(self, pool: dict[str, Variable], symbol: Any, what: str) -> Variable:
        if isinstance(symbol, str):
            if symbol in pool:
                return pool[symbol]
            raise unknown_name(f"variable in {what}", symbol, pool)
        if isinstance(symbol, self.symbols) and symbol.is_valid_input():
            wanted = [identity(s) for s in ca.symvar(symbol)]
            for variable in pool.values():
                if [identity(s) for s in ca.symvar(variable.symbol)] == wanted:
                    return variable
        raise ProblemError(
            f"{what}: {symbol!r} is not a declared {'state' if what == 'dynamics' else 'state or control'} of "
            f"problem {self.name!r}; known: {', '.join(pool) or 'none'}",
            name="state" if what == "dynamics" else "variable",
            limit=tuple(pool),
        )

    def _constraint(
        self,
        kind: str,
        name: str,
        expression: Value,
        bounds: tuple[Value, Value],
        unit: str,
        tolerance: Value = None,
        known: Sequence[Any] = (),
    ) -> Constraint:
        """A new constraint of the symbols inside the horizon and of those ``known`` besides."""
        self.declared.check_new_constraint(f"{kind} constraint", name)
        return self._reader.constraint(kind, name, expression, [*self._inner(), *known], bounds, unit, tolerance)
