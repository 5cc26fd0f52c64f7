"""A declared problem as text."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest

from ocp import Collocation, Problem, solve
from tests.ocp.problems import swing


@pytest.mark.parametrize("symbols", [ca.SX, ca.MX])
def test_everything_declared_is_shown_by_name(symbols: type) -> None:
    text = str(swing(symbols, control_ties=True))
    for line in (
        "Problem 'swing'",
        "horizon      free in [1, 8] s",
        "state        x (2) in [-3, 3]",
        "state        w (1)",
        "control      u (1) in [-1, 1]",
        "control      b (2) in [-2, 2]",
        "parameter    k (2)",
        "path         speed (1): -1.5 <= ",
        "path         place (1): -inf <= ",
        "path         balance (1): 0 <= ",
        "start        push (1): 0.8 <= ",
        "end          cyclic (2): 0 <= ",
        "end          smooth (1): -0.2 <= ",
        "dx/dt = ",
        "dw/dt = ",
        "minimize     integral of ",
    ):
        assert f"  {line}" in text or text.startswith(line), f"{line!r} is not in\n{text}"
    assert "x_at_start" in text


def test_ends_and_parametric_bounds_are_shown() -> None:
    problem = Problem("ends")
    p = problem.parameter("p")
    problem.state("x", initial=[1.0, np.nan], terminal=[p, 2.0], upper=2 * p)
    problem.horizon(3 * p)
    text = str(problem)
    assert "initial [1, nan]; terminal [p, 2]" in text
    assert "(2.*p)]" in text.replace("(2*p)", "(2.*p)")
    assert "horizon      (3.*p) s" in text.replace("(3*p)", "(3.*p)")


def test_an_unfinished_problem_is_shown_too() -> None:
    problem = Problem("unfinished")
    assert "not declared" in str(problem)
    problem.control("u")
    assert "control      u (1)" in str(problem)
    assert repr(problem) == "<Problem 'unfinished': 0 states, 1 controls>"


@pytest.mark.parametrize("symbols", [ca.SX, ca.MX])
def test_long_expressions_stay_on_one_bounded_line(symbols: type) -> None:
    problem = Problem("long", symbols)
    x = problem.state("x", 6)
    rate = x
    for _ in range(12):  # written out, this has 6 * 2^12 terms
        rate = ca.sin(rate) * rate + ca.mtimes(ca.DM.ones(6, 6), rate)
    problem.dynamics(x, rate)
    problem.path("sum of many", sum(x[i] * x[j] for i in range(6) for j in range(6)), upper=1.0)
    lines = str(problem).splitlines()
    assert max(len(line) for line in lines) < 160
    assert any(line.startswith("  dx/dt = ") for line in lines)


def test_constants_and_empty_costs_are_shown() -> None:
    problem = Problem("constant")
    x = problem.state("x", initial=0.0)
    problem.dynamics(x, 1.0)
    problem.path("number", 5.0, upper=6.0)
    problem.horizon(1.0)
    assert "number (1): -inf <= 5 <= 6" in str(problem)
    assert "minimize" not in str(problem)
    assert solve(problem, Collocation(2))["x"][-1, 0] == pytest.approx(1.0)
