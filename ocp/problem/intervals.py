"""Interval arithmetic: the range of each instruction of an expression over whole intervals of its inputs.

Moore, Kearfott & Cloud, *Introduction to Interval Analysis*, 2009, chapters 2 to 5. Every instruction is evaluated on
all intervals at once, and its result is widened by a few roundings, so the bounds hold for the exact value as well as
for casadi's result. Their overestimation is about proportional to the length of the interval.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import product
from math import tau
from typing import Any, NamedTuple, TypeAlias, TypeVar

import casadi as ca
import numpy as np

from ocp.errors import ProblemError

Array: TypeAlias = np.ndarray
Value = TypeVar("Value")


class Interval(NamedTuple):
    """Lower and upper bounds of a quantity over each of M intervals of the inputs of a function.

    Attributes:
        low, high: The bounds. Shape (M,).
        negates: The test of which it is the negation, if any.
        part: For an instruction of if_else, (a test, a value): the value where the test holds and 0 elsewhere.
    """

    low: Array
    high: Array
    negates: Interval | None = None
    part: tuple[Interval, Interval] | None = None


def evaluate(function: Any, inputs: Sequence[Interval]) -> list[Interval]:
    """Return the range of each entry of the single output of an SX function over intervals of its inputs.

    Args:
        function: Function of scalars whose instructions are those of `RULES`, see `check_instructions`.
        inputs: The range of each input, over the same M intervals.
    """
    with np.errstate(all="ignore"):
        return interpret(
            function,
            inputs,
            lambda value: constant(value, inputs[0].low),
            lambda code, *operands: RULES[code](*operands),
        )


def interpret(
    function: Any, inputs: Sequence[Value], constant: Callable[[float], Value], apply: Callable[..., Value]
) -> list[Value]:
    """Evaluate the single output of an SX function in another arithmetic, such as interval arithmetic.

    Args:
        function: Function of scalars.
        inputs: The value of each input in that arithmetic.
        constant: Function that converts a number to that arithmetic.
        apply: Function (instruction code, operands) that evaluates an operation.
    """
    slots: dict[int, Value] = {}
    outputs: dict[int, Value] = {}
    for k in range(function.n_instructions()):
        code, operands = function.instruction_id(k), function.instruction_input(k)
        if code == ca.OP_OUTPUT:
            outputs[function.instruction_output(k)[1]] = slots[operands[0]]
        elif code == ca.OP_INPUT:
            slots[function.instruction_output(k)[0]] = inputs[operands[0]]
        elif code == ca.OP_CONST:
            slots[function.instruction_output(k)[0]] = constant(function.instruction_constant(k))
        else:
            slots[function.instruction_output(k)[0]] = apply(code, *(slots[slot] for slot in operands))
    return [outputs[k] for k in range(len(outputs))]


def check_instructions(what: str, function: Any) -> None:
    """Raise ProblemError, naming the instruction, if an SX function has an instruction without an interval rule."""
    for k in range(function.n_instructions()):
        code = function.instruction_id(k)
        if code not in RULES and code not in (ca.OP_INPUT, ca.OP_OUTPUT, ca.OP_CONST):
            name = NAMES.get(code, str(code))
            words = f"{what}: the operation {name!r} has no bounds; write it with elementary functions"
            raise ProblemError(words, name=name, value=code)


def _widen(low: Any, high: Any) -> Interval:
    """Return an interval that is widened by possible rounding errors; a bound that is nan becomes infinite."""
    low, high = np.where(np.isnan(low), -np.inf, low), np.where(np.isnan(high), np.inf, high)
    # the functions of a C library are accurate to four units in the last place
    share, smallest = 4 * np.finfo(float).eps, 1e-300
    spread = [share * np.where(np.isfinite(end), np.abs(end), 0.0) + smallest for end in (low, high)]
    return Interval(low - spread[0], high + spread[1])


def constant(value: float, like: Array) -> Interval:
    """Return a number as an interval of zero width, repeated for each entry of an array."""
    return Interval(np.full(like.shape, value), np.full(like.shape, value))


def _range_of(corners: list[Array]) -> Interval:
    """Return the interval from the smallest to the largest of given values, widened by possible rounding errors."""
    stacked = np.array(corners)
    return _widen(stacked.min(axis=0), stacked.max(axis=0))


def bounded_where(known: Any, x: Interval, low: Any = -np.inf, high: Any = np.inf) -> Interval:
    """Return the intervals `x` where a mask is true, and the interval from `low` to `high` elsewhere."""
    return Interval(np.where(known, x.low, low), np.where(known, x.high, high))


def _add(x: Interval, y: Interval) -> Interval:
    """Return the range of a sum. A sum may represent an if_else, which casadi writes as a sum of both branches."""
    if x.part is not None and y.part is not None:
        (test, yes), (opposite, no) = x.part, y.part
        if test.negates is opposite or opposite.negates is test:
            return _either(test, yes, no)
    return _widen(x.low + y.low, x.high + y.high)


def _either(test: Interval, yes: Interval, no: Interval) -> Interval:
    """Return the range of if_else: `yes` where the test always holds, `no` where it always fails, else the union."""
    holds, fails = decided_masks(test)
    either = np.minimum(yes.low, no.low), np.maximum(yes.high, no.high)
    return bounded_where(holds, yes, *bounded_where(fails, no, *either)[:2])


def decided_masks(test: Interval) -> tuple[Any, Any]:
    """Return masks of the intervals in which a test always holds, and in which it always fails. Shape (M,) each."""
    return (test.low > 0) | (test.high < 0), (test.low == 0) & (test.high == 0)


def _if_else_zero(test: Interval, value: Interval) -> Interval:
    result = _either(test, value, constant(0.0, value.low))
    return result._replace(part=(test, value))


def _subtract(x: Interval, y: Interval) -> Interval:
    return _widen(x.low - y.high, x.high - y.low)


def _multiply(x: Interval, y: Interval) -> Interval:
    if x is y:
        return _square(x)
    corners = [a * b for a, b in product((x.low, x.high), (y.low, y.high))]
    return _range_of([np.where(np.isnan(corner), 0.0, corner) for corner in corners])  # 0 times infinity is 0 here


def _inverse(x: Interval) -> Interval:
    about_zero = (x.low <= 0) & (x.high >= 0)
    return _widen(np.where(about_zero, -np.inf, 1 / x.high), np.where(about_zero, np.inf, 1 / x.low))


def _square(x: Interval) -> Interval:
    size = _absolute(x)
    return _clamp(_widen(size.low * size.low, size.high * size.high), low=0.0)


def _power(x: Interval, y: Interval) -> Interval:
    fixed = (y.low == y.high).all() and (y.low == y.low[0]).all()
    if fixed and float(y.low[0]).is_integer():
        exponent = int(y.low[0])
        if exponent < 0:
            return _inverse(_power(x, constant(-exponent, x.low)))
        if exponent % 2 == 0:
            base = _absolute(x)
            return _clamp(_widen(base.low**exponent, base.high**exponent), low=0.0)
        return _widen(x.low**exponent, x.high**exponent)
    base = _clamp(x, low=0.0)
    powers = _range_of([a**b for a, b in product((base.low, base.high), (y.low, y.high))])
    return bounded_where((x.low >= 0) | ((x.high >= 0) & fixed), powers)  # y may contain an integer exponent


def _clamp(x: Interval, low: float = -np.inf, high: float = np.inf) -> Interval:
    return Interval(np.clip(x.low, low, high), np.clip(x.high, low, high))


def _absolute(x: Interval) -> Interval:
    return Interval(np.maximum(0.0, np.maximum(x.low, -x.high)), np.maximum(np.abs(x.low), np.abs(x.high)))


def _increasing_rule(
    function: Callable[[Any], Any], low: float = -np.inf, high: float = np.inf
) -> Callable[..., Interval]:
    """Return the interval extension of an increasing function that is defined from `low` to `high`."""

    def rule(x: Interval) -> Interval:
        inside = _clamp(x, low, high)
        return bounded_where((x.high >= low) & (x.low <= high), _widen(function(inside.low), function(inside.high)))

    return rule


def _negative(x: Interval) -> Interval:
    return Interval(-x.high, -x.low)


def _contains_multiple(x: Interval, first: float, step: float) -> Any:
    """Return which intervals contain `first` plus an integer multiple of `step`, within rounding. Shape (M,)."""
    # multiples of a turn are accurate to fifty units in the last place of the angle
    slack = 1e-14 * (1 + np.maximum(np.abs(x.low), np.abs(x.high)))
    return np.floor((x.high + slack - first) / step) >= np.ceil((x.low - slack - first) / step)


def _sinusoid_rule(function: Callable[[Any], Any], crest: float) -> Callable[..., Interval]:
    """Return the interval extension of sine or cosine, whose maximum is at the angle `crest`."""

    def rule(x: Interval) -> Interval:
        ends = function(x.low), function(x.high)
        result = _widen(np.minimum(*ends), np.maximum(*ends))
        high = np.where(_contains_multiple(x, crest, tau), 1.0, np.minimum(result.high, 1.0))
        low = np.where(_contains_multiple(x, crest + tau / 2, tau), -1.0, np.maximum(result.low, -1.0))
        return bounded_where(np.isfinite(x.low) & np.isfinite(x.high), Interval(low, high), -1.0, 1.0)

    return rule


def _tangent(x: Interval) -> Interval:
    smooth = ~_contains_multiple(x, tau / 4, tau / 2) & np.isfinite(x.low) & np.isfinite(x.high)
    return bounded_where(smooth, _widen(np.tan(x.low), np.tan(x.high)))


def _angle(y: Interval, x: Interval) -> Interval:
    """Return the range of atan2(y, x) from the ends of both intervals, or a full turn where atan2 may jump."""
    result = _range_of([np.arctan2(a, b) for a, b in product((y.low, y.high), (x.low, x.high))])
    half = float(np.nextafter(np.pi, 4))
    return bounded_where((x.low > 0) | (y.low > 0) | (y.high < 0), result, -half, half)


def _hypot(x: Interval, y: Interval) -> Interval:
    first, second = _absolute(x), _absolute(y)
    return _clamp(_widen(np.hypot(first.low, second.low), np.hypot(first.high, second.high)), low=0.0)


def _copysign(x: Interval, y: Interval) -> Interval:
    size = _absolute(x)
    low = np.where(y.low > 0, size.low, np.minimum(-size.high, size.low))  # a zero may have either sign
    high = np.where(y.high < 0, -size.low, np.maximum(-size.low, size.high))
    return Interval(low, high)


def multiple_of(x: Interval, y: Interval, rounded: Callable[[Any], Any]) -> tuple[Any, Any]:
    """Return the rounded quotient x / y, and a mask of the intervals in which the rounded quotient is constant."""
    quotient = _multiply(x, _inverse(y))
    multiple = rounded(quotient.low)
    known = np.isfinite(multiple) & (multiple == rounded(quotient.high))
    return np.where(known, multiple, 0.0), known


def _modulo(x: Interval, y: Interval) -> Interval:
    """Return the range of fmod(x, y): the remainder of the division x / y, with the sign of x."""
    largest = np.minimum(_absolute(y).high, _absolute(x).high)
    return _reduce(x, y, np.trunc, np.where(x.low < 0, -largest, 0.0), np.where(x.high > 0, largest, 0.0))


def _remainder(x: Interval, y: Interval) -> Interval:
    """Return the range of the remainder: the difference of x from the nearest integer multiple of y."""
    half = np.minimum(_absolute(y).high / 2, _absolute(x).high)
    return _reduce(x, y, np.rint, -half, half)


def _reduce(x: Interval, y: Interval, rounded: Callable[[Any], Any], low: Array, high: Array) -> Interval:
    """Return the range of x - y * rounded(x / y), which is known to lie between `low` and `high`. Shape (M,) each."""
    multiple, known = multiple_of(x, y, rounded)
    result = _subtract(x, _multiply(Interval(multiple, multiple), y))
    return bounded_where(known, Interval(np.maximum(result.low, low), np.minimum(result.high, high)), low, high)


def _below(x: Interval, y: Interval, *, strict: bool) -> Interval:
    """Return the range of the comparison x < y or x <= y: 1 if true, 0 if false."""
    always = x.high < y.low if strict else x.high <= y.low
    never = x.low >= y.high if strict else x.low > y.high
    return Interval(np.where(always, 1.0, 0.0), np.where(never, 0.0, 1.0))


def _equal(x: Interval, y: Interval) -> Interval:
    always = (x.low == x.high) & (y.low == y.high) & (x.low == y.low)
    never = (x.low > y.high) | (x.high < y.low)
    return Interval(np.where(always, 1.0, 0.0), np.where(never, 0.0, 1.0))


def _not(x: Interval) -> Interval:
    holds, fails = decided_masks(x)
    return Interval(np.where(fails, 1.0, 0.0), np.where(holds, 0.0, 1.0), negates=x)


def _and(x: Interval, y: Interval) -> Interval:
    (first, first_fails), (second, second_fails) = decided_masks(x), decided_masks(y)
    return Interval(np.where(first & second, 1.0, 0.0), np.where(first_fails | second_fails, 0.0, 1.0))


def _step_rule(function: Callable[[Any], Any]) -> Callable[..., Interval]:
    """Return the interval extension of an increasing step function, whose integer values have no rounding errors."""
    return lambda x: Interval(function(x.low), function(x.high))


_BY_NAME: dict[str, Callable[..., Interval]] = {
    "ASSIGN": lambda x: x,
    "ADD": _add,
    "SUB": _subtract,
    "MUL": _multiply,
    "DIV": lambda x, y: _multiply(x, _inverse(y)),
    "NEG": _negative,
    "INV": _inverse,
    "TWICE": lambda x: _widen(2 * x.low, 2 * x.high),
    "SQ": _square,
    "SQRT": _increasing_rule(np.sqrt, low=0.0),
    "POW": _power,
    "CONSTPOW": _power,
    "EXP": _increasing_rule(np.exp),
    "EXPM1": _increasing_rule(np.expm1),
    "LOG": _increasing_rule(np.log, low=0.0),
    "LOG1P": _increasing_rule(np.log1p, low=-1.0),
    "SIN": _sinusoid_rule(np.sin, tau / 4),
    "COS": _sinusoid_rule(np.cos, 0.0),
    "TAN": _tangent,
    "ASIN": _increasing_rule(np.arcsin, -1.0, 1.0),
    "ACOS": lambda x: _negative(_increasing_rule(lambda a: -np.arccos(a), -1.0, 1.0)(x)),
    "ATAN": _increasing_rule(np.arctan),
    "ATAN2": _angle,
    "SINH": _increasing_rule(np.sinh),
    "COSH": lambda x: _increasing_rule(np.cosh)(_absolute(x)),
    "TANH": _increasing_rule(np.tanh),
    "ASINH": _increasing_rule(np.arcsinh),
    "ACOSH": _increasing_rule(np.arccosh, low=1.0),
    "ATANH": _increasing_rule(np.arctanh, -1.0, 1.0),
    "HYPOT": _hypot,
    "FABS": _absolute,
    "FMIN": lambda x, y: Interval(np.minimum(x.low, y.low), np.minimum(x.high, y.high)),
    "FMAX": lambda x, y: Interval(np.maximum(x.low, y.low), np.maximum(x.high, y.high)),
    "FMOD": _modulo,
    "REMAINDER": _remainder,
    "COPYSIGN": _copysign,
    "FLOOR": _step_rule(np.floor),
    "CEIL": _step_rule(np.ceil),
    "SIGN": _step_rule(np.sign),
    "LT": lambda x, y: _below(x, y, strict=True),
    "LE": lambda x, y: _below(x, y, strict=False),
    "EQ": _equal,
    "NE": lambda x, y: _not(_equal(x, y))._replace(negates=None),
    "NOT": _not,
    "AND": _and,
    "OR": lambda x, y: _not(_and(_not(x), _not(y)))._replace(negates=None),
    "IF_ELSE_ZERO": _if_else_zero,
}
RULES = {getattr(ca, f"OP_{name}"): rule for name, rule in _BY_NAME.items()}
"""Interval rules of operations, by the instruction code of casadi."""
NAMES = {getattr(ca, name): name.removeprefix("OP_").lower() for name in dir(ca) if name.startswith("OP_")}
