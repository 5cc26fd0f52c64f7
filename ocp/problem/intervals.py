"""Interval arithmetic: the range of each instruction of an expression over whole intervals of its inputs.

Moore, Kearfott & Cloud, *Introduction to Interval Analysis*, 2009, chapters 2 to 5. Every instruction is done on all
intervals at once and its result is let out by a few roundings, so the bounds hold for the real value as well as for
what casadi works out at any time in the interval. They are wide by about the length of the interval: halve it, and they
are half as wide.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import product
from math import tau
from typing import Any, NamedTuple, TypeAlias

import casadi as ca
import numpy as np

from ocp.errors import ProblemError

__all__ = ["NAMES", "RULES", "Interval", "check_instructions", "constant", "decided", "evaluate", "multiple_of"]

Array: TypeAlias = np.ndarray


class Interval(NamedTuple):
    """Bounds of a number over each interval of time, and what it is for the sake of if_else.

    Attributes:
        low, high: Shape (M,).
        negates: The test of which it is the opposite, if any.
        part: Where it is (a test, a value): the value where the test holds and else 0.
    """

    low: Array
    high: Array
    negates: Interval | None = None
    part: tuple[Interval, Interval] | None = None


def evaluate(function: Any, inputs: Sequence[Interval]) -> list[Interval]:
    """Return the range of each entry of the only output of an SX function, in their order.

    Args:
        function: Of scalars; its instructions are those of `RULES`, see `check_instructions`.
        inputs: The range of each input, over the same M intervals.
    """
    slots: dict[int, Interval] = {}
    outputs: dict[int, Interval] = {}
    for k in range(function.n_instructions()):
        code, given = function.instruction_id(k), function.instruction_input(k)
        if code == ca.OP_OUTPUT:
            outputs[function.instruction_output(k)[1]] = slots[given[0]]
        else:
            slots[function.instruction_output(k)[0]] = (
                inputs[given[0]]
                if code == ca.OP_INPUT
                else constant(function.instruction_constant(k), inputs[0].low)
                if code == ca.OP_CONST
                else RULES[code](*(slots[slot] for slot in given))
            )
    return [outputs[k] for k in range(len(outputs))]


def check_instructions(what: str, function: Any) -> None:
    """Raise ProblemError that names an instruction of an SX function which no rule bounds."""
    for k in range(function.n_instructions()):
        code = function.instruction_id(k)
        if code not in RULES and code not in (ca.OP_INPUT, ca.OP_OUTPUT, ca.OP_CONST):
            name = NAMES.get(code, str(code))
            words = f"{what}: the operation {name!r} has no bounds; write it with elementary functions"
            raise ProblemError(words, name=name, value=code)


# ---- rules ----------------------------------------------------------------------------------------------------------


def _out(low: Any, high: Any) -> Interval:
    """Bounds let out by what rounding may do; what is no number is no bound."""
    low, high = np.where(np.isnan(low), -np.inf, low), np.where(np.isnan(high), np.inf, high)
    # the functions of a C library are good to four units of the last place
    share, least = 4 * np.finfo(float).eps, 1e-300
    spread = [share * np.where(np.isfinite(end), np.abs(end), 0.0) + least for end in (low, high)]
    return Interval(low - spread[0], high + spread[1])


def constant(value: float, like: Array) -> Interval:
    """Return the range of a number over as many intervals as an array has entries."""
    return Interval(np.full(like.shape, value), np.full(like.shape, value))


def _least_and_most(corners: list[Array]) -> Interval:
    stacked = np.array(corners)
    return _out(stacked.min(axis=0), stacked.max(axis=0))


def _quiet(rule: Callable[..., Interval]) -> Callable[..., Interval]:
    def silent(*given: Interval) -> Interval:
        with np.errstate(all="ignore"):
            return rule(*given)

    return silent


def _add(x: Interval, y: Interval) -> Interval:
    if x.part is not None and y.part is not None and _opposite(x.part[0], y.part[0]):
        return _either(x.part[0], x.part[1], y.part[1])
    return _out(x.low + y.low, x.high + y.high)


def _opposite(test: Interval, other: Interval) -> bool:
    return test.negates is other or other.negates is test


def _either(test: Interval, yes: Interval, no: Interval) -> Interval:
    """One value where the test holds, else the other."""
    holds, fails = decided(test)
    low = np.where(holds, yes.low, np.where(fails, no.low, np.minimum(yes.low, no.low)))
    high = np.where(holds, yes.high, np.where(fails, no.high, np.maximum(yes.high, no.high)))
    return Interval(low, high)


def decided(test: Interval) -> tuple[Any, Any]:
    """Return where a test holds all over the interval, and where it fails all over it. Shape (M,) each."""
    return (test.low > 0) | (test.high < 0), (test.low == 0) & (test.high == 0)


def _if_else_zero(test: Interval, value: Interval) -> Interval:
    found = _either(test, value, constant(0.0, value.low))
    return found._replace(part=(test, value))


def _subtract(x: Interval, y: Interval) -> Interval:
    return _out(x.low - y.high, x.high - y.low)


def _multiply(x: Interval, y: Interval) -> Interval:
    if x is y:
        return _square(x)
    corners = [a * b for a, b in product((x.low, x.high), (y.low, y.high))]
    return _least_and_most([np.where(np.isnan(corner), 0.0, corner) for corner in corners])  # 0 inf is 0 here


def _inverse(x: Interval) -> Interval:
    about_zero = (x.low <= 0) & (x.high >= 0)
    return _out(np.where(about_zero, -np.inf, 1 / x.high), np.where(about_zero, np.inf, 1 / x.low))


def _divide(x: Interval, y: Interval) -> Interval:
    return _multiply(x, _inverse(y))


def _square(x: Interval) -> Interval:
    most = np.maximum(np.abs(x.low), np.abs(x.high))
    least = np.maximum(0.0, np.maximum(x.low, -x.high))
    found = _out(least * least, most * most)
    return Interval(np.maximum(found.low, 0.0), found.high)


def _power(x: Interval, y: Interval) -> Interval:
    fixed = (y.low == y.high).all() and (y.low == y.low[0]).all()
    if fixed and float(y.low[0]).is_integer():
        exponent = int(y.low[0])
        if exponent < 0:
            return _inverse(_power(x, constant(-exponent, x.low)))
        if exponent % 2 == 0:
            base = _absolute(x)
            return _clamped(_out(base.low**exponent, base.high**exponent), low=0.0)
        return _out(x.low**exponent, x.high**exponent)
    base = _clamped(x, low=0.0)
    found = _least_and_most([a**b for a, b in product((base.low, base.high), (y.low, y.high))])
    unknown = (x.high < 0) | ((x.low < 0) & ~fixed)  # a whole exponent may lie in y
    return Interval(np.where(unknown, -np.inf, found.low), np.where(unknown, np.inf, found.high))


def _clamped(x: Interval, low: float = -np.inf, high: float = np.inf) -> Interval:
    return Interval(np.clip(x.low, low, high), np.clip(x.high, low, high))


def _absolute(x: Interval) -> Interval:
    return Interval(np.maximum(0.0, np.maximum(x.low, -x.high)), np.maximum(np.abs(x.low), np.abs(x.high)))


def _rising(function: Callable[[Any], Any], low: float = -np.inf, high: float = np.inf) -> Callable[..., Interval]:
    """The rule of a function that rises, defined from low to high."""

    def rule(x: Interval) -> Interval:
        inside = _clamped(x, low, high)
        found = _out(function(inside.low), function(inside.high))
        nowhere = (x.high < low) | (x.low > high)
        return Interval(np.where(nowhere, -np.inf, found.low), np.where(nowhere, np.inf, found.high))

    return rule


def _falling(function: Callable[[Any], Any], low: float, high: float) -> Callable[..., Interval]:
    rising = _rising(lambda x: -function(x), low, high)

    def rule(x: Interval) -> Interval:
        return _negative(rising(x))

    return rule


def _negative(x: Interval) -> Interval:
    return Interval(-x.high, -x.low)


def _holds_one_of(x: Interval, first: float, step: float) -> Any:
    """Whether first + k step lies in the interval for a whole k, or so near that rounding may have moved it."""
    # multiples of a turn are known to fifty units of the last place of the angle
    slack = 1e-14 * (1 + np.maximum(np.abs(x.low), np.abs(x.high)))
    return np.floor((x.high + slack - first) / step) >= np.ceil((x.low - slack - first) / step)


def _wave(function: Callable[[Any], Any], crest: float) -> Callable[..., Interval]:
    """The rule of a wave of a full turn and height 1 with a crest at an angle."""

    def rule(x: Interval) -> Interval:
        ends = function(x.low), function(x.high)
        found = _out(np.minimum(*ends), np.maximum(*ends))
        high = np.where(_holds_one_of(x, crest, tau), 1.0, np.minimum(found.high, 1.0))
        low = np.where(_holds_one_of(x, crest + tau / 2, tau), -1.0, np.maximum(found.low, -1.0))
        endless = ~(np.isfinite(x.low) & np.isfinite(x.high))
        return Interval(np.where(endless, -1.0, low), np.where(endless, 1.0, high))

    return rule


def _tangent(x: Interval) -> Interval:
    pole = _holds_one_of(x, tau / 4, tau / 2) | ~(np.isfinite(x.low) & np.isfinite(x.high))
    found = _out(np.tan(x.low), np.tan(x.high))
    return Interval(np.where(pole, -np.inf, found.low), np.where(pole, np.inf, found.high))


def _angle(y: Interval, x: Interval) -> Interval:
    """atan2: of a rectangle that neither holds the origin nor meets the cut, the corners have the extremes."""
    found = _least_and_most([np.arctan2(a, b) for a, b in product((y.low, y.high), (x.low, x.high))])
    whole = ~((x.low > 0) | (y.low > 0) | (y.high < 0))
    half = float(np.nextafter(np.pi, 4))
    return Interval(np.where(whole, -half, found.low), np.where(whole, half, found.high))


def _cosh(x: Interval) -> Interval:
    base = _absolute(x)
    return _out(np.cosh(base.low), np.cosh(base.high))


def _hypot(x: Interval, y: Interval) -> Interval:
    first, second = _absolute(x), _absolute(y)
    return _clamped(_out(np.hypot(first.low, second.low), np.hypot(first.high, second.high)), low=0.0)


def _least(x: Interval, y: Interval) -> Interval:
    return Interval(np.minimum(x.low, y.low), np.minimum(x.high, y.high))


def _most(x: Interval, y: Interval) -> Interval:
    return Interval(np.maximum(x.low, y.low), np.maximum(x.high, y.high))


def _copysign(x: Interval, y: Interval) -> Interval:
    size = _absolute(x)
    other = _negative(size)
    both = _hull(other, size)  # of a zero the sign is not known
    return Interval(np.where(y.low > 0, size.low, both.low), np.where(y.high < 0, other.high, both.high))


def _hull(x: Interval, y: Interval) -> Interval:
    return Interval(np.minimum(x.low, y.low), np.maximum(x.high, y.high))


def multiple_of(x: Interval, y: Interval, rounded: Callable[[Any], Any]) -> tuple[Any, Any]:
    """Return the whole multiple of y next to x, a quotient being rounded so, and where it is one all over."""
    quotient = _divide(x, y)
    multiple = rounded(quotient.low)
    known = np.isfinite(multiple) & (multiple == rounded(quotient.high))
    return np.where(known, multiple, 0.0), known


def _modulo(x: Interval, y: Interval) -> Interval:
    """fmod: x minus the whole multiple of y towards zero; its sign is that of x."""
    multiple, known = multiple_of(x, y, np.trunc)
    same = _subtract(x, _multiply(Interval(multiple, multiple), y))
    most = np.minimum(_absolute(y).high, _absolute(x).high)
    low, high = np.where(x.low < 0, -most, 0.0), np.where(x.high > 0, most, 0.0)
    return Interval(np.where(known, np.maximum(same.low, low), low), np.where(known, np.minimum(same.high, high), high))


def _remainder(x: Interval, y: Interval) -> Interval:
    """Return x minus the nearest whole multiple of y."""
    multiple, known = multiple_of(x, y, np.rint)
    same = _subtract(x, _multiply(Interval(multiple, multiple), y))
    half = np.minimum(_absolute(y).high / 2, _absolute(x).high)
    return Interval(
        np.where(known, np.maximum(same.low, -half), -half), np.where(known, np.minimum(same.high, half), half)
    )


def _below(x: Interval, y: Interval, *, strict: bool) -> Interval:
    """A test: 1 where x < y, or x <= y, 0 where not."""
    surely = x.high < y.low if strict else x.high <= y.low
    never = x.low >= y.high if strict else x.low > y.high
    return Interval(np.where(surely, 1.0, 0.0), np.where(never, 0.0, 1.0))


def _equal(x: Interval, y: Interval) -> Interval:
    surely = (x.low == x.high) & (y.low == y.high) & (x.low == y.low)
    never = (x.low > y.high) | (x.high < y.low)
    return Interval(np.where(surely, 1.0, 0.0), np.where(never, 0.0, 1.0))


def _not(x: Interval) -> Interval:
    holds, fails = decided(x)
    return Interval(np.where(fails, 1.0, 0.0), np.where(holds, 0.0, 1.0), negates=x)


def _and(x: Interval, y: Interval) -> Interval:
    (first, first_fails), (second, second_fails) = decided(x), decided(y)
    return Interval(np.where(first & second, 1.0, 0.0), np.where(first_fails | second_fails, 0.0, 1.0))


def _or(x: Interval, y: Interval) -> Interval:
    (first, first_fails), (second, second_fails) = decided(x), decided(y)
    return Interval(np.where(first | second, 1.0, 0.0), np.where(first_fails & second_fails, 0.0, 1.0))


def _step(function: Callable[[Any], Any]) -> Callable[..., Interval]:
    """The rule of a function that rises in steps, which are whole numbers: rounding does not touch it."""
    return lambda x: Interval(function(x.low), function(x.high))


def _same(x: Interval) -> Interval:
    return x


_BY_NAME: dict[str, Callable[..., Interval]] = {
    "ASSIGN": _same,
    "ADD": _add,
    "SUB": _subtract,
    "MUL": _multiply,
    "DIV": _divide,
    "NEG": _negative,
    "INV": _inverse,
    "TWICE": lambda x: _out(2 * x.low, 2 * x.high),
    "SQ": _square,
    "SQRT": _rising(np.sqrt, low=0.0),
    "POW": _power,
    "CONSTPOW": _power,
    "EXP": _rising(np.exp),
    "EXPM1": _rising(np.expm1),
    "LOG": _rising(np.log, low=0.0),
    "LOG1P": _rising(np.log1p, low=-1.0),
    "SIN": _wave(np.sin, tau / 4),
    "COS": _wave(np.cos, 0.0),
    "TAN": _tangent,
    "ASIN": _rising(np.arcsin, -1.0, 1.0),
    "ACOS": _falling(np.arccos, -1.0, 1.0),
    "ATAN": _rising(np.arctan),
    "ATAN2": _angle,
    "SINH": _rising(np.sinh),
    "COSH": _cosh,
    "TANH": _rising(np.tanh),
    "ASINH": _rising(np.arcsinh),
    "ACOSH": _rising(np.arccosh, low=1.0),
    "ATANH": _rising(np.arctanh, -1.0, 1.0),
    "HYPOT": _hypot,
    "FABS": _absolute,
    "FMIN": _least,
    "FMAX": _most,
    "FMOD": _modulo,
    "REMAINDER": _remainder,
    "COPYSIGN": _copysign,
    "FLOOR": _step(np.floor),
    "CEIL": _step(np.ceil),
    "SIGN": _step(np.sign),
    "LT": lambda x, y: _below(x, y, strict=True),
    "LE": lambda x, y: _below(x, y, strict=False),
    "EQ": _equal,
    "NE": lambda x, y: _not(_equal(x, y))._replace(negates=None),
    "NOT": _not,
    "AND": _and,
    "OR": _or,
    "IF_ELSE_ZERO": _if_else_zero,
}
RULES = {getattr(ca, f"OP_{name}"): _quiet(rule) for name, rule in _BY_NAME.items()}
"""Interval by the code of casadi's instruction."""
NAMES = {getattr(ca, name): name.removeprefix("OP_").lower() for name in dir(ca) if name.startswith("OP_")}
