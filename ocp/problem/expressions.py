"""Reader of the values that users declare: expressions, bounds, windows of time, sizes, guesses and tolerances."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np

from ocp.errors import ProblemError, require
from ocp.problem.declarations import Constraint, Horizon, Value
from ocp.problem.values import (
    check_finite,
    check_horizon,
    check_inside,
    check_order,
    constant,
    identity,
    is_symbolic,
    numeric,
    stack_column,
    table,
)


@dataclass(frozen=True)
class ExpressionReader:
    """Reader that converts values given by the user to expressions in the symbols of one problem.

    Attributes:
        symbols: ``casadi.SX`` or ``casadi.MX``. time: Symbol of the time.
        parameters: The symbols of the parameters declared so far.
    """

    symbols: Any
    time: Any
    parameters: tuple[Any, ...]

    def expression(self, what: str, value: Value, known: Sequence[Any], *, finite: bool = True) -> Any:
        """Convert a value to a column of expressions in the ``known`` symbols; ``finite`` requires finite constants."""
        if value is None or isinstance(value, str):
            raise ProblemError(f"{what}: a number or an expression is expected, not {value!r}")
        if is_symbolic(value):
            expression = stack_column(what, value)
            if not isinstance(expression, self.symbols):
                own, expected = type(expression).__name__, self.symbols.__name__
                raise ProblemError(f"{what} is made of {own} symbols, the problem of {expected} symbols")
            entries = ca.vertsplit(expression) if isinstance(expression, ca.SX) and expression.numel() else []
            if finite and not all(np.isfinite(float(entry)) for entry in entries if entry.is_constant()):
                raise ProblemError(f"{what} is not finite: {expression}")
        else:
            array = numeric(what, value)
            check_finite(what, array)
            expression = self.symbols(ca.DM(array))
        identities = {identity(s) for symbol in known for s in ca.symvar(symbol)}
        for symbol in ca.symvar(expression):
            if identity(symbol) not in identities:
                words = f"{what} uses the symbol {symbol.name()!r}, which is not allowed here: it is not part of this "
                raise ProblemError(words + "problem, was declared later, or has no meaning at this place")
        return expression

    def column(self, what: str, value: Value, size: int, default: float) -> Any:
        """Convert a value, or ``default`` for None, to a column of expressions of parameters. Shape (size, 1)."""
        if value is None:
            return self.symbols(ca.DM.ones(size, 1) * default)
        if is_symbolic(value):
            expression = self.expression(what, value, self.parameters, finite=False)  # nan frees an entry
        else:
            expression = self.symbols(ca.DM(numeric(what, value)))
        if expression.numel() == 1:
            expression = ca.repmat(expression, size, 1)
        if expression.numel() != size:
            words = f"{what} has {expression.numel()} entries, {size} expected"
            raise ProblemError(words, value=expression.numel(), limit=size)
        return ca.densify(ca.vec(expression))

    def bounds(self, what: str, size: int, lower: Value, upper: Value) -> tuple[Any, Any]:
        """Convert lower and upper bounds to columns of ``size`` entries; a bound that is None becomes infinite."""
        low = self.column(f"{what}: lower", lower, size, -np.inf)
        high = self.column(f"{what}: upper", upper, size, np.inf)
        for label, value in (("lower", lower), ("upper", upper)):
            _check_number(what, label, value)
        check_order(what, constant(low), constant(high))
        return low, high

    def constraint(
        self,
        kind: str,
        name: str,
        expression: Value,
        known: Sequence[Any],
        *,
        bounds: tuple[Value, Value],
        unit: str,
        tolerance: Value,
        during: Value = None,
    ) -> Constraint:
        """Return a constraint of a given kind on an expression that contains only the symbols ``known``.

        Bounds that contain the time become part of the expression: e <= b of e - b <= 0. ``during`` are the first and
        the last time of a window; outside, the expression is replaced by a number inside the bounds.
        """
        what = f"{kind} constraint {name!r}"
        require.text(f"{what}: unit", unit)
        vector = self.expression(what, expression, known)
        if vector.numel() == 0:
            raise ProblemError(f"{what} is empty")
        if bounds[0] is None and bounds[1] is None:
            raise ProblemError(f"{what} has neither lower nor upper bound")
        tolerances = read_positive(f"{what}: tolerance", tolerance, vector.numel())
        if any(self._changes_in_time(what, bound) for bound in bounds):
            sides = [
                self.expression(f"{what}: bound", bound, (self.time, *self.parameters))
                for bound in bounds
                if bound is not None
            ]
            equal = len(sides) == 2 and ca.is_equal(sides[0], sides[1], 8)
            zeros = np.zeros(vector.numel())
            if len(sides) == 2 and not equal:
                bounds = np.append(zeros, np.full(len(zeros), -np.inf)), np.append(zeros + np.inf, zeros)
                tolerances = None if tolerances is None else np.tile(tolerances, 2)
            else:
                bounds = (zeros if bounds[0] is not None else None, zeros if bounds[1] is not None else None)
                sides = sides[:1]
            vector = ca.vertcat(*[vector - side for side in sides])
        low, high = self.bounds(what, vector.numel(), *bounds)
        if during is not None:
            vector = self._inside_window(what, vector, (low, high), during)
        return Constraint(name, vector, low, high, unit, tolerances)

    def _changes_in_time(self, what: str, bound: Value) -> bool:
        """Return whether a bound depends on the time."""
        column = stack_column(what, bound) if is_symbolic(bound) else None
        return isinstance(column, self.symbols) and bool(ca.depends_on(column, self.time))

    def _inside_window(self, what: str, vector: Any, bounds: tuple[Any, Any], during: Value) -> Any:
        """Return an expression that equals a given one in a time window, and a number within the bounds elsewhere."""
        if not isinstance(during, tuple | list) or len(during) != 2:
            raise ProblemError(f"{what}: during must be two times, not {during!r}", name="during", value=during)
        begin, end = (self.column(f"{what}: during", part, 1, np.nan) for part in during)
        check_order(f"{what}: during", constant(begin), constant(end))
        neutral = []
        for low, high in zip(*map(ca.vertsplit, bounds), strict=True):
            if ca.is_equal(low, high, 8):
                raise ProblemError(f"{what}: an equality cannot be limited to a window; use a phase", name="during")
            has_low, has_high = constant(low)[0] != -np.inf, constant(high)[0] != np.inf
            above, below = low + ca.fmax(ca.fabs(low), 1.0), high - ca.fmax(ca.fabs(high), 1.0)
            neutral.append((low + high) / 2 if has_low and has_high else above if has_low else below)
        is_inside = ca.logic_and(self.time >= begin, self.time <= end)
        return ca.if_else(is_inside, vector, ca.vertcat(*neutral))

    def horizon(self, what: str, value: Value, lower: Value, upper: Value, *, guess: float | None) -> Horizon:
        """Return the declaration of a horizon that is fixed at ``value``, or free between ``lower`` and ``upper``."""
        for label, bound in (("value", value), ("lower", lower), ("upper", upper)):
            _check_number(what, label, bound)
        symbol = self.symbols.sym("horizon")
        if value is not None:
            if not (lower is None and upper is None and guess is None):
                raise ProblemError(f"{what}: give a fixed value or lower, upper and guess, not both")
            fixed = self.column(what, value, 1, np.nan)
            check_horizon(what, constant(fixed))
            return Horizon(symbol, fixed, fixed, None, fixed=True)
        low = self.column(f"{what}: lower", lower, 1, 1e-6)
        high = self.column(f"{what}: upper", upper, 1, np.inf)
        check_horizon(f"{what}: lower", constant(low))
        check_order(what, constant(low), constant(high))
        if guess is not None:
            number = numeric(f"{what}: guess", guess)
            if number.size != 1 or np.isnan(number[0]):
                raise ProblemError(f"{what}: guess must be one number, not {guess!r}", value=guess)
            check_horizon(f"{what}: guess", number)
            check_inside(f"{what}: guess", number, constant(low), constant(high))
            guess = float(number[0])
        return Horizon(symbol, low, high, guess, fixed=False)


def number_of_entries(what: str, size: int | None, values: dict[str, Value]) -> int:
    """Return the number of entries of a variable: the given size, or the common size of its bounds, guess and so on."""
    if size is not None:
        return require.count(f"{what}: size", size)
    labelled = {f"{what}: {k}": v for k, v in values.items() if v is not None and not callable(v)}
    lengths = {k: stack_column(k, v).numel() if is_symbolic(v) else _columns(table(k, v)) for k, v in labelled.items()}
    for label, n in lengths.items():
        if n == 0:
            raise ProblemError(f"{label} is empty")
    sizes = {label.rpartition(" ")[2]: n for label, n in lengths.items() if n != 1}
    if len(set(sizes.values())) > 1:
        detail = ", ".join(f"{k} has {n}" for k, n in sizes.items())
        raise ProblemError(f"{what}: sizes do not match: {detail} entries")
    return int(next(iter(sizes.values()), 1))


def _columns(array: np.ndarray) -> int:
    """Return the number of entries of a value; for a table (M, n) of several samples, the number n of columns."""
    return int(array.shape[1] if array.ndim == 2 and min(array.shape) > 1 else array.size)


def read_positive(what: str, value: Value, size: int, *, scale: bool = False) -> np.ndarray | None:
    """Return ``size`` positive numbers, given one number for all or one for each entry; None if the value is None.

    The numbers of a ``scale`` are finite, or nan where the scale is unknown.
    """
    if value is None:
        return None
    array = numeric(what, value)
    valid = np.isnan(array) | ((array > 0) & np.isfinite(array)) if scale else array > 0
    if array.size not in (1, size) or not valid.all():
        rule = f"positive, one number or {size}" + (", nan for an unknown one" if scale else "")
        raise ProblemError(f"{what} must be {rule}, not {value!r}", value=value, limit=size)
    return np.array(np.broadcast_to(array, size))


def check_guess(what: str, guess: Any, size: int) -> None:
    """Raise ProblemError unless a guess is None, a function, a finite number or a finite array of a suitable size."""
    if guess is None or callable(guess):
        return
    array = table(f"{what}: guess", guess)
    check_finite(f"{what}: guess", array)
    if array.size not in (1, size) and not (array.ndim == 2 and array.shape[1] == size and len(array) > 1):
        words = f"{what}: guess has {array.size} entries, {size} expected"
        raise ProblemError(words, value=array.size, limit=size)


def signal_function(what: str, track: Callable[[Any], Any]) -> Any:
    """Convert a user's function of time to a casadi Function whose value is a column."""
    time = ca.MX.sym("time")
    try:
        return ca.Function("signal", [time], [ca.densify(ca.vec(ca.MX(track(time))))])
    except Exception as error:  # the user's function may raise anything
        words = f"{what}: a function of time alone that returns a column is expected: {error}"
        raise ProblemError(words, value=track) from error


def _check_number(what: str, label: str, bound: Value) -> None:
    """Raise ProblemError if a numeric bound contains nan."""
    if bound is not None and not is_symbolic(bound) and np.any(np.isnan(numeric(what, bound))):
        raise ProblemError(f"{what}: {label} is not a number: {bound!r}", value=bound)
