"""Tables as functions: they interpolate with fourth order, are smooth also at their edges, and continue beyond them."""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np
import pytest

from ocp import Collocation, Problem, ProblemError, Solution, solve, table


def test_a_table_interpolates_and_converges_with_fourth_order() -> None:
    at, errors = np.linspace(0.0, 3.0, 301), []
    for n in (11, 21, 41):
        points = np.linspace(0.0, 3.0, n)
        function = table(points, np.sin(2 * points))
        assert [function(x) for x in points] == pytest.approx(np.sin(2 * points), abs=1e-14)
        errors.append(max(abs(function(x) - np.sin(2 * x)) for x in at))
    orders = np.log2(np.array(errors[:-1]) / errors[1:])
    assert (orders > 3.7).all()


def test_cubics_are_exact_and_quadratics_also_beyond_the_edges() -> None:
    points = np.array([-1.0, 0.0, 0.5, 2.0, 3.0])
    cubic, square = table(points, points**3 - points), table(points, points**2 - points)
    for x in (-0.7, 0.2, 1.3, 2.9):
        assert cubic(x) == pytest.approx(x**3 - x, abs=1e-13)
    for x in (-5.0, 4.0, 10.0):
        assert square(x) == pytest.approx(x**2 - x, abs=1e-11)


@pytest.mark.parametrize("symbols", [ca.SX, ca.MX])
def test_value_slope_and_curvature_are_continuous_at_every_point(symbols: Any) -> None:
    points = np.array([0.0, 0.4, 0.8, 0.9, 1.0, 1.2, 1.4])
    function = table(points, [3.44, 3.44, 3.44, 3.58, 4.44, 3.44, 3.01])
    x = symbols.sym("x")
    value = function(x)
    slope = ca.gradient(value, x)
    derivatives = ca.Function("derivatives", [x], [value, slope, ca.gradient(slope, x)])
    for point in points:
        left, right = (np.array(derivatives(point + side)).ravel() for side in (-1e-9, 1e-9))
        assert left == pytest.approx(right, abs=1e-4)
    inner = np.linspace(-0.5, 2.0, 26) + 0.013
    numerical = [(function(x + 1e-6) - function(x - 1e-6)) / 2e-6 for x in inner]
    assert [float(derivatives(x)[1]) for x in inner] == pytest.approx(numerical, rel=1e-6, abs=1e-7)


def test_a_table_of_two_arguments_is_the_product_of_its_splines() -> None:
    a, b = np.linspace(0.0, 2.0, 7), np.array([-1.0, 0.0, 1.0, 3.0, 4.0])
    function = table((a, b), np.multiply.outer(np.sin(a), b**2 - 1.0))
    one, other = table(a, np.sin(a)), table(b, b**2 - 1.0)
    for x, y in ((0.3, -0.4), (1.9, 3.7), (-0.5, 2.0), (1.1, 6.0)):
        assert function(x, y) == pytest.approx(one(x) * other(y), rel=1e-12)
    assert function.bounds == ((0.0, 2.0), (-1.0, 4.0))


def test_two_points_are_a_line() -> None:
    line = table([1.0, 3.0], [2.0, 6.0])
    assert [line(x) for x in (0.0, 2.0, 10.0)] == pytest.approx([0.0, 4.0, 20.0])


def drag(symbols: Any, force: Any) -> Problem:
    """A body at the edge of a table of its drag: it starts at speed 0, where the table begins."""
    problem = Problem("drag", symbols)
    speed = problem.state("speed", initial=0.0, terminal=2.0, lower=0.0)
    push = problem.control("push")
    problem.dynamics(speed, push - force(speed))
    problem.watch("in the table", speed, 0.0, 3.0)
    problem.horizon(1.0)
    problem.minimize(push**2)
    return problem


@pytest.mark.parametrize("symbols", [ca.SX, ca.MX])
def test_a_plan_with_a_table_is_that_with_the_function_of_the_table(symbols: Any, tmp_path: Any) -> None:
    points = np.linspace(0.0, 3.0, 9)
    force = table(points, points**3 / 4)
    solution = solve(drag(symbols, force), Collocation(20))
    assert solution.cost == pytest.approx(solve(drag(symbols, lambda v: v**3 / 4), Collocation(20)).cost, rel=1e-9)
    assert solution.audit().passed
    solution.save(tmp_path / "plan.npz")
    assert Solution.load(tmp_path / "plan.npz").audit().passed


@pytest.mark.parametrize(
    ("points", "values", "message"),
    [
        ([0.0, 0.0], [1.0, 2.0], "increase"),
        ([0.0], [1.0], "2 at least"),
        ([0.0, np.nan], [1.0, 2.0], "finite"),
        ([0.0, 1.0], [1.0, np.inf], "finite"),
        ([0.0, 1.0], [1.0, 2.0, 3.0], "shape"),
        (([0.0, 1.0], [0.0, 1.0]), [1.0, 2.0], "shape"),
        ("x", [1.0], "not numeric"),
    ],
)
def test_tables_that_are_none_are_refused(points: Any, values: Any, message: str) -> None:
    with pytest.raises(ProblemError, match=message):
        table(points, values)


def test_a_wrong_number_of_arguments_is_refused() -> None:
    with pytest.raises(ProblemError, match="1 arguments, not 2"):
        table([0.0, 1.0], [1.0, 2.0])(0.5, 0.5)
