"""Trigonometric polynomials: sums, products and derivatives are those of their values, roots those that were put in."""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np
import pytest
from hypothesis import assume, example, given, settings
from hypothesis import strategies as st

from models.cts.trigonometric import (
    Harmonics,
    add_series,
    least_point,
    multiply_series,
    roots,
    scale_harmonics,
    square_of_first_harmonic,
    subtract_harmonics,
)

ANGLES = np.linspace(-3.0, 3.0, 13)
number = st.floats(-10, 10).map(lambda x: round(x, 3))
five = st.tuples(*[number] * 5)
angle = st.floats(-np.pi, np.pi)


def values(f: Harmonics, angles: Any = ANGLES) -> Any:
    return f.value(np.cos(angles), np.sin(angles))


def series_values(f: Any) -> Any:
    return sum(a * np.cos(k * ANGLES) + b * np.sin(k * ANGLES) for k, (a, b) in enumerate(f))


def numbers(points: Any) -> Any:
    return np.array([[float(ca.DM(part)) for part in point] for point in points])


@given(five, five, number)
def test_sums_multiples_and_squares_are_those_of_the_values(one: Any, other: Any, factor: float) -> None:
    f, g = Harmonics(*one), Harmonics(*other)
    np.testing.assert_allclose(values(subtract_harmonics(f, g)), values(f) - values(g), atol=1e-12)
    np.testing.assert_allclose(values(scale_harmonics(f, factor)), factor * values(f), atol=1e-10)
    plain = Harmonics(one[0], one[1], one[2], 0.0, 0.0)
    np.testing.assert_allclose(values(square_of_first_harmonic(*one[:3])), values(plain) ** 2, atol=1e-10)


@given(five)
def test_the_derivative_is_the_slope_and_its_bound_holds(one: Any) -> None:
    f, step = Harmonics(*one), 1e-5
    slope = (values(f, ANGLES + step) - values(f, ANGLES - step)) / (2 * step)
    np.testing.assert_allclose(values(f.derivative()), slope, atol=1e-7)
    bound = float(ca.DM(f.slope_bound()))
    fine = np.linspace(-np.pi, np.pi, 400)
    assert np.abs(values(f.derivative().derivative(), fine)).max() <= bound + 1e-12


@given(st.lists(st.tuples(number, number), min_size=1, max_size=4), st.lists(st.tuples(number, number), min_size=1))
def test_series_multiply_and_add_as_their_values(one: Any, other: Any) -> None:
    f, g = ([(series[0][0], 0.0), *series[1:]] for series in (one, other[:4]))
    np.testing.assert_allclose(series_values(multiply_series(f, g)), series_values(f) * series_values(g), atol=1e-9)
    difference = series_values(f) - 2 * series_values(g)
    np.testing.assert_allclose(series_values(add_series(f, g, -2.0)), difference, atol=1e-10)


@settings(max_examples=40)
@given(st.tuples(angle, angle), st.tuples(st.floats(0.2, 2.9), st.floats(0.2, 2.9)), st.floats(1e-3, 1e3))
def test_roots_of_a_product_of_two_lines_are_their_intersections_with_the_circle(
    middles: Any, widths: Any, factor: float
) -> None:
    """(cos(x - a) - cos w) vanishes at a - w and a + w; where no two roots are nearly one."""
    lines = [[(-np.cos(w), 0.0), (np.cos(a), np.sin(a))] for a, w in zip(middles, widths, strict=True)]
    (a0, _), (a1, b1), (a2, b2) = multiply_series(*lines)
    f = scale_harmonics(Harmonics(a0, a1, b1, a2, b2), factor)
    points = numbers(roots(Harmonics(*(ca.DM(part) for part in f))))
    np.testing.assert_allclose(np.hypot(*points.T), 1.0, atol=1e-12)
    known = np.array([root for a, w in zip(middles, widths, strict=True) for root in (a - w, a + w)])
    slopes = np.abs(values(f.derivative(), known)) / factor
    assume(slopes.min() > 1e-2)
    gaps = np.hypot(points[:, :1] - np.cos(known), points[:, 1:] - np.sin(known)).min(axis=0)
    assert (gaps * slopes).max() < 1e-12


@settings(max_examples=60)
@given(angle, angle, st.floats(-3.0, 3.0))
@example(0.125, 1.0077655281945015, -2.7256403103692675)
def test_the_polish_throws_no_double_root_away(at: float, other: float, middle: float) -> None:
    """(1 - cos(x - a)) (m + cos(x - b)) touches zero at a, where value and slope are rounding both."""
    (a0, _), (a1, b1), (a2, b2) = multiply_series(
        [(1.0, 0.0), (-np.cos(at), -np.sin(at))], [(middle, 0.0), (np.cos(other), np.sin(other))]
    )
    f = Harmonics(*(ca.DM(part) for part in (a0, a1, b1, a2, b2)))
    off = [np.hypot(*(numbers(roots(f, steps=steps)) - [np.cos(at), np.sin(at)]).T).min() for steps in (0, 3)]
    # near a double root f is c (x - a)^2: rounding of the size of its terms moves it by the root of both
    size, curvature = (1 + abs(np.cos(at)) + abs(np.sin(at))) * (abs(middle) + 1), abs(middle + np.cos(at - other)) / 2
    assume(curvature > 1e-3)  # a root of higher order is less certain
    assert off[1] <= max(off[0], np.sqrt(np.finfo(float).eps * size / curvature))


def test_a_double_root_is_good_to_the_square_root_of_rounding() -> None:
    (a0, _), (a1, b1), (a2, b2) = multiply_series(
        [(-np.cos(2.5), 0.0), (np.cos(1.5), np.sin(1.5))], [(-np.cos(1.0), 0.0), (1.0, 0.0)]
    )
    points = numbers(roots(Harmonics(*(ca.DM(part) for part in (a0, a1, b1, a2, b2)))))
    assert np.hypot(points[:, 0] - np.cos(1.0), points[:, 1] + np.sin(1.0)).min() < np.sqrt(np.finfo(float).eps)


@settings(max_examples=40)
@given(five, angle)
def test_the_least_point_turns_with_the_polynomial(one: Any, turn: float) -> None:
    """f(x - turn) is least where f is, turned on, and as small there as anywhere."""
    a0, a1, b1, a2, b2 = one
    (p1, q1), (p2, q2) = (
        (np.cos(k * turn) * a - np.sin(k * turn) * b, np.sin(k * turn) * a + np.cos(k * turn) * b)
        for k, a, b in ((1, a1, b1), (2, a2, b2))
    )
    least = []
    for f in (Harmonics(a0, a1, b1, a2, b2), Harmonics(a0, p1, q1, p2, q2)):
        (c, s), *_ = numbers([least_point(Harmonics(*(ca.DM(part) for part in f)))])
        assert np.hypot(c, s) == pytest.approx(1.0, abs=1e-12)
        least.append(float(f.value(c, s)))
        assert least[-1] <= values(f, np.linspace(-np.pi, np.pi, 2000)).min() + 1e-12 * (1 + np.abs(one).sum())
    assert least[0] == pytest.approx(least[1], abs=1e-11 * (1 + np.abs(one).sum()))


@pytest.mark.parametrize("factor", [2.0**400, 2.0**-250])
def test_the_least_point_of_a_multiple_is_the_same(factor: float) -> None:
    random = np.random.default_rng(0)
    for each in random.normal(size=(50, 5)):
        one, multiple = (numbers([least_point(Harmonics(*(ca.DM(part) for part in k * each)))]) for k in (1.0, factor))
        np.testing.assert_allclose(multiple, one, rtol=0, atol=1e-14)
