"""Ranges and slopes of expressions over intervals: every sample and every difference quotient lies inside.

Halves of intervals have half the excess.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import casadi as ca
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ocp import ProblemError
from ocp.problem.enclosures import Enclosures
from ocp.problem.intervals import RULES

T = ca.SX.sym("t")
ONE: dict[str, Callable[[Any], Any]] = {
    "negative": lambda x: -x,
    "inverse": lambda x: 1 / x,
    "square": lambda x: x**2,
    "square of itself": lambda x: x * x,
    "cube": lambda x: x**3,
    "fourth power": lambda x: ca.power(x, 4),
    "fifth power": lambda x: ca.power(x, 5),
    "inverse cube": lambda x: x**-3,
    "half power": lambda x: x**2.5,
    "power of two": lambda x: ca.constpow(2, x),
    "power of itself": lambda x: ca.power(x, x),
    "twice": lambda x: x + x,
    "root": ca.sqrt,
    "exp": ca.exp,
    "expm1": ca.expm1,
    "log": ca.log,
    "log1p": ca.log1p,
    "sin": ca.sin,
    "cos": ca.cos,
    "tan": ca.tan,
    "asin": ca.asin,
    "acos": ca.acos,
    "atan": ca.atan,
    "sinh": ca.sinh,
    "cosh": ca.cosh,
    "tanh": ca.tanh,
    "asinh": ca.asinh,
    "acosh": ca.acosh,
    "atanh": ca.atanh,
    "abs": ca.fabs,
    "floor": ca.floor,
    "ceil": ca.ceil,
    "sign": ca.sign,
    "not": ca.logic_not,
}
TWO: dict[str, Callable[[Any, Any], Any]] = {
    "sum": lambda x, y: x + y,
    "difference": lambda x, y: x - y,
    "product": lambda x, y: x * y,
    "quotient": lambda x, y: x / y,
    "power": ca.power,
    "least": ca.fmin,
    "most": ca.fmax,
    "angle": ca.atan2,
    "hypotenuse": ca.hypot,
    "remainder": ca.fmod,
    "remainder of the nearest": ca.remainder,
    "sign of another": ca.copysign,
    "less": lambda x, y: x < y,
    "less or equal": lambda x, y: x <= y,
    "equal": lambda x, y: x == y,
    "different": lambda x, y: x != y,
    "both": ca.logic_and,
    "either": ca.logic_or,
    "choice": lambda x, y: ca.if_else(x < y, x * y, 1 - x),
    "other choice": lambda x, y: ca.if_else(ca.logic_not(x < 0), y, x),
}
ends = st.floats(-6, 6).map(lambda x: round(x * 8) / 8) | st.floats(-3, 3)
intervals = st.tuples(ends, ends).map(sorted)


def bounds(values: Any, symbol: Any, low: Any, high: Any) -> tuple[Any, Any]:
    outcome = Enclosures(values, symbol)(*(np.atleast_1d(np.asarray(end, float)) for end in (low, high)))
    return outcome.low, outcome.high


def assert_inside(values: Any, low: float, high: float, parts: tuple[Any, ...] = ()) -> None:
    """Of all samples at which the values and their parts are numbers, and of the slopes between them."""
    lower, upper, least, most = Enclosures(values, T)(np.array([1.0 * low]), np.array([1.0 * high]))
    assert lower.shape == upper.shape == (1, values.shape[0])
    times = np.unique(np.concatenate([np.linspace(low, high, 101), [low, high]]).clip(low, high))
    every = ca.densify(ca.vertcat(values, *parts))
    result = np.array(ca.Function("f", [T], [every])(times[None])).reshape(every.shape[0], -1, order="F")
    sound = ~np.isnan(result[values.shape[0] :]).any(axis=0)
    for entry in range(values.shape[0]):
        kept = sound & np.isfinite(result[entry])
        row, when = result[entry][kept], times[kept]
        assert (row >= lower[0, entry]).all(), (lower, row.min())
        assert (row <= upper[0, entry]).all(), (upper, row.max())
        for stride in (1, 7, 50):
            steps, rises = when[stride:] - when[:-stride], row[stride:] - row[:-stride]
            rounding = 1e-13 * (1 + np.abs(row).max(initial=0.0))
            with np.errstate(over="ignore"):
                assert (rises >= least[0, entry] * steps - rounding).all(), (least, rises / steps)
                assert (rises <= most[0, entry] * steps + rounding).all(), (most, rises / steps)


@pytest.mark.parametrize("name", ONE)
@given(interval=intervals)
@settings(max_examples=25)
def test_no_sample_of_a_function_lies_outside(name: str, interval: list[float]) -> None:
    assert_inside(ONE[name](T), interval[0], interval[1])


@pytest.mark.parametrize("name", TWO)
@given(interval=intervals, shift=st.floats(-3, 3), rate=st.sampled_from([-2.0, -0.5, 0.0, 1.0]))
@settings(max_examples=25)
def test_no_sample_of_a_function_of_two_lies_outside(
    name: str, interval: list[float], shift: float, rate: float
) -> None:
    values = ca.vertcat(TWO[name](T, rate * T + shift), TWO[name](ca.sin(T), T**2 + shift))
    assert_inside(values, interval[0], interval[1])


def random_expression(rng: np.random.Generator, depth: int, parts: list[Any]) -> Any:
    """A tree of functions of the time; its branches are added to the parts."""
    if depth == 0:
        return T if rng.random() < 0.7 else ca.SX(round(float(rng.normal()), 2))
    if rng.random() < 0.4:
        result = ONE[str(rng.choice(list(ONE)))](random_expression(rng, depth - 1, parts))
    else:
        both = random_expression(rng, depth - 1, parts), random_expression(rng, depth - 1, parts)
        result = TWO[str(rng.choice(list(TWO)))](*both)
    parts.append(result)
    return result


@pytest.mark.long
@given(st.integers(0, 2**32 - 1), intervals)
@settings(max_examples=400)
def test_no_sample_of_a_tree_of_functions_lies_outside(seed: int, interval: list[float]) -> None:
    parts: list[Any] = []
    values = random_expression(np.random.default_rng(seed), 4, parts)
    assert_inside(values, interval[0], interval[1], tuple(parts))


SMOOTH = ca.vertcat(
    ca.sin(3 * T) * ca.exp(-T) + T**3,
    ca.sqrt(1 + T**2) / (2 + ca.cos(T)),
    ca.atan2(T - 1, 2 + T) * ca.log(3 + T),
    ca.if_else(T < 0.5, T * (1 - T), 0.25 + 3 * (T - 0.5)),
    ca.fmax(T - 0.3, 0.2 * T) ** 2.5,
)


def test_the_excess_is_halved_with_the_intervals() -> None:
    """Of the range of each piece; first order, and no gap of a choice stays open."""
    function = ca.Function("f", [T], [SMOOTH])
    excess = []
    for count in (64, 128, 256, 512):
        marks = np.linspace(0, 2, count + 1)
        lower, upper = bounds(SMOOTH, T, marks[:-1], marks[1:])
        times = marks[:-1, None] + np.linspace(0, 1, 33) * (2 / count)
        values = np.array(function(times.ravel()[None])).T.reshape(count, 33, -1)
        excess.append(np.maximum(values.min(axis=1) - lower, upper - values.max(axis=1)).max(axis=0))
    ratios = np.array(excess[:-1]) / np.array(excess[1:])
    assert ((ratios[-1] > 1.8) | (excess[-1] < 1e-12)).all(), ratios
    assert (np.array(excess[-1]) < 0.1).all()


@pytest.mark.parametrize(
    ("values", "low", "high", "least", "most"),
    [
        (T**2, -1, 2, 0, 4),
        (ca.sin(T), 1, 2, np.sin(1), 1),
        (ca.sin(T), 4, 5, -1, np.sin(4)),
        (ca.cos(T), -0.5, 0.2, np.cos(0.5), 1),
        (ca.cos(T), 3, 3.5, -1, np.cos(3.5)),
        (ca.sin(T), 0, 7, -1, 1),
        (ca.sin(T), 0.2, 0.7, np.sin(0.2), np.sin(0.7)),
        (ca.tan(T), 1, 1.5, np.tan(1), np.tan(1.5)),
        (ca.tan(T), 1, 2, -np.inf, np.inf),
        (1 / T, 1, 2, 0.5, 1),
        (1 / T, -1, 1, -np.inf, np.inf),
        (1 / T, -2, -1, -1, -0.5),
        (ca.sqrt(T), -1, 4, 0, 2),
        (ca.log(T), -1, 1, -np.inf, 0),
        (ca.power(T, -2), 1, 2, 0.25, 1),
        (T**2.5, 1, 4, 1, 32),
        (ca.power(T, 3), 1, 2, 1, 8),
        (ca.power(T, 4), -2, 1, 0, 16),
        (ca.fabs(T), -2, 1, 0, 2),
        (ca.atan2(T, ca.SX(1)), -1, 1, -np.pi / 4, np.pi / 4),
        (ca.atan2(T, ca.SX(-1)), -1, 1, -np.pi, np.pi),
        (ca.atan2(ca.SX(1), T), -1, 1, np.pi / 4, 3 * np.pi / 4),
        (ca.cosh(T), -1, 2, 1, np.cosh(2)),
        (ca.acos(T), -1, 1, 0, np.pi),
        (ca.floor(T), 0.5, 2.5, 0, 2),
        (ca.sign(T), -1, 1, -1, 1),
        (ca.fmod(T, 2), 2.5, 3.5, 0.5, 1.5),
        (ca.fmod(T, 2), -3.5, -2.5, -1.5, -0.5),
        (ca.fmod(T, 2), 1, 3, 0, 2),
        (ca.if_else(T < 1, T + 5, T + 3), 0, 0.5, 5, 5.5),
        (ca.if_else(T < 1, T + 5, T + 3), 2, 3, 5, 6),
        (ca.if_else(T < 1, T + 5, T + 3), 0.5, 1.5, 3.5, 6.5),
        (ca.if_else(T == 0.5, 3, 7), 0.5, 0.5, 3, 3),
        (ca.if_else(T == 0.5, 3, 7), 0, 1, 3, 7),
        (ca.if_else(T == 0.5, 3, 7), 0.5, 1, 3, 7),
        (ca.if_else(T == 0.5, 3, 7), 0.6, 1, 7, 7),
        (ca.if_else(T == T**2, 3, 7), 0.25, 0.75, 3, 7),
        (ca.if_else(ca.floor(T) == T, 3, 7), 0.5, 0.75, 7, 7),
        (ca.if_else(ca.floor(T) == ca.ceil(T), 3, 7), 0.5, 0.75, 7, 7),
        (ca.copysign(2, T), 1, 2, 2, 2),
        (ca.copysign(2, T), -2, -1, -2, -2),
        (ca.copysign(2, T), -2, 0, -2, 2),
        (ca.remainder(T, 2), 2.5, 3.5, -1, 1),
        (ca.remainder(T, 2), 1.5, 2.5, -0.5, 0.5),
        (ca.hypot(T, 3), -4, 1, 3, 5),
        (ca.fmin(T, 1), 0, 2, 0, 1),
        (ca.fmax(T, 1), 0, 2, 1, 2),
        (2 * T + T, 1, 2, 3, 6),
        (ca.SX(7), 0, 1, 7, 7),
    ],
    ids=str,
)
def test_ranges_of_single_functions_are_exact(values: Any, low: float, high: float, least: float, most: float) -> None:
    lower, upper = bounds(values, T, low, high)
    np.testing.assert_allclose([lower[0, 0], upper[0, 0]], [least, most], rtol=1e-12, atol=1e-12)


def test_the_pole_of_the_tangent_is_within_whatever_rounding_does() -> None:
    """Of the many from a quarter turn on, one rounding beyond the start of an interval or before its end."""
    poles = np.pi / 2 + np.pi * np.arange(-300, 300)
    for low, high in (
        (np.nextafter(poles, -np.inf), poles + 1),
        (poles, poles + 1),
        (poles - 1, poles),
        (poles - 1, np.nextafter(poles, np.inf)),
    ):
        lower, upper = bounds(ca.tan(T), T, low, high)
        assert (lower == -np.inf).all()
        assert (upper == np.inf).all()


def test_both_kinds_of_symbols_have_the_same_bounds() -> None:
    t = ca.MX.sym("t")
    called = ca.Function("f", [T], [SMOOTH])(t)
    for one, other in zip(bounds(SMOOTH, T, [0, 1], [1, 2]), bounds(called, t, [0, 1], [1, 2]), strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-12)


def test_unbounded_expressions_are_named() -> None:
    assert len(RULES) > 40
    with pytest.raises(ProblemError, match="operation 'erf' has no bounds") as caught:
        bounds(ca.erf(T), T, 0, 1)
    assert caught.value.name == "erf"
    for values in (T + ca.SX.sym("strange"), ca.MX.sym("x")):
        with pytest.raises(ProblemError) as caught:
            bounds(values, T, 0, 1)
        assert caught.value.name == "values"
