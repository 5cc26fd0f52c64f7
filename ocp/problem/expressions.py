"""Reader of values given by the user as checked columns of a problem's symbols."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np

from ocp.errors import ProblemError, require
from ocp.problem.declarations import Constraint, Horizon
from ocp.problem.values import (
    check_finite,
    check_horizon,
    check_inside,
    check_order,
    constant,
    identity,
    is_symbolic,
    numeric,
    stacked,
)

__all__ = ["ExpressionReader", "Value", "check_guess", "number_of_entries", "read_scale", "signal_function"]

Value = Any  # a number, an array, or a casadi expression of parameters


@dataclass(frozen=True)
class ExpressionReader:
    """Reader of values as expressions of the symbols of one problem.

    Attributes:
        symbols: ``casadi.SX`` or ``casadi.MX``. parameters: The symbols of the parameters declared so far.
    """

    symbols: Any
    parameters: tuple[Any, ...]

    def expression(self, what: str, value: Value, known: Sequence[Any], *, finite: bool = True) -> Any:
        """Return a value as a dense column of ``known`` symbols only; with ``finite``, its constants must be finite."""
        if value is None or isinstance(value, str):
            raise ProblemError(f"{what}: a number or an expression is expected, not {value!r}")
        if is_symbolic(value):
            expression = stacked(what, value)
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
                raise ProblemError(
                    f"{what} uses the symbol {symbol.name()!r}, which is not allowed here: it is not part of this "
                    f"problem, was declared later, or has no meaning at this place"
                )
        return expression

    def column(self, what: str, value: Value, size: int, default: float) -> Any:
        """Return a value as a column that depends on parameters only. Shape (size, 1)."""
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
        """Return lower and upper bounds as columns of ``size`` entries, infinite if there are none."""
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
        bounds: tuple[Value, Value],
        unit: str,
        tolerance: Value,
    ) -> Constraint:
        """Return a constraint on an expression of the ``known`` symbols; ``kind`` is for messages."""
        what = f"{kind} constraint {name!r}"
        require.text(f"{what}: unit", unit)
        vector = self.expression(what, expression, known)
        if vector.numel() == 0:
            raise ProblemError(f"{what} is empty")
        if bounds[0] is None and bounds[1] is None:
            raise ProblemError(f"{what} has neither lower nor upper bound")
        low, high = self.bounds(what, vector.numel(), *bounds)
        return Constraint(name, vector, low, high, unit, read_tolerance(what, tolerance, vector.numel()))

    def horizon(self, what: str, value: Value, lower: Value, upper: Value, guess: float | None) -> Horizon:
        """Return a horizon fixed at ``value``, or free from ``lower`` to ``upper``."""
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
    """Return the given size, or the common size of the labelled values; 1 if all are scalars."""
    if size is not None:
        return require.count(f"{what}: size", size)
    labelled = {f"{what}: {k}": v for k, v in values.items() if v is not None and not callable(v)}
    lengths = {k: stacked(k, v).numel() if is_symbolic(v) else numeric(k, v).size for k, v in labelled.items()}
    for label, n in lengths.items():
        if n == 0:
            raise ProblemError(f"{label} is empty")
    sizes = {label.rpartition(" ")[2]: n for label, n in lengths.items() if n != 1}
    if len(set(sizes.values())) > 1:
        detail = ", ".join(f"{k} has {n}" for k, n in sizes.items())
        raise ProblemError(f"{what}: sizes do not match: {detail} entries")
    return int(next(iter(sizes.values()), 1))


def read_scale(what: str, value: Value, size: int) -> Any:
    """Return the scales of the entries, nan for unknown ones. Shape (size,), or None."""
    if value is None:
        return None
    array = numeric(f"{what}: scale", value)
    if array.size not in (1, size) or not (np.isnan(array) | (np.isfinite(array) & (array > 0))).all():
        words = f"{what}: scale must be positive, one number or {size}, nan for an unknown one, not {value!r}"
        raise ProblemError(words, value=value, limit=size)
    return np.array(np.broadcast_to(array.ravel(), size))


def check_guess(what: str, guess: Any, size: int) -> None:
    """Raise ProblemError unless a guess is None, a function, or one finite number for all entries or for each."""
    if guess is None or callable(guess):
        return
    array = numeric(f"{what}: guess", guess)
    check_finite(f"{what}: guess", array)
    if array.size not in (1, size):
        words = f"{what}: guess has {array.size} entries, {size} expected"
        raise ProblemError(words, value=array.size, limit=size)


def read_tolerance(what: str, value: Value, size: int) -> list[float] | None:
    """Return the tolerances of the rows of a constraint, (size,), or None."""
    if value is None:
        return None
    array = numeric(f"{what}: tolerance", value)
    if array.size not in (1, size) or not (array > 0).all():
        words = f"{what}: tolerance must be positive numbers, 1 or {size} of them, not {value!r}"
        raise ProblemError(words, value=value, limit=size)
    return [float(entry) for entry in np.broadcast_to(array, size)]


def signal_function(what: str, track: Callable[[Any], Any]) -> Any:
    """Return the casadi Function time -> column of a function of time alone."""
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
