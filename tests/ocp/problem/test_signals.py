"""A known function of time declared as a signal is the same problem as with its expression written out."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
import pytest

from ocp import Collocation, Indirect, MultipleShooting, Problem, ProblemError, Solution, SolveError, solve
from ocp.problem.formulation import Formulation
from tests.ocp.test_faults import run

HORIZON = 2.0
GRID = np.linspace(0.0, HORIZON, 21)
SPLINE = ca.interpolant("wave", "bspline", [GRID], np.sin(2 * GRID))


def wave(t: Any) -> Any:
    """Written in time: two entries."""
    return ca.vertcat(ca.sin(2 * t), 0.5 * ca.cos(t))


Track = Callable[[Any], Any]


def everywhere(known: bool, symbols: Any = ca.SX, track: Track = wave) -> Problem:
    """w(t) in dynamics, running cost, path, start, end and watch rows; the start of one state is free."""
    problem = Problem("everywhere", symbols)
    x = problem.state("x", lower=-5.0, upper=5.0)
    v = problem.state("v", initial=0.3)
    u = problem.control("u", lower=-20.0, upper=20.0)
    problem.horizon(HORIZON)
    w = problem.signal("w", track) if known else track(problem.time)
    first, second = (w[0], w[1]) if w.shape[0] == 2 else (w, w)
    problem.dynamics(x, v + second)
    problem.dynamics(v, u - 0.5 * first * v)
    problem.path("corridor", x - first, lower=-0.7, upper=0.7)
    problem.start("on the wave", x - first - 0.1, 0, 0)
    problem.end("at the wave", x - 0.8 * first, 0, 0)
    problem.watch("drift", x - second, lower=-9.0, upper=9.0)
    problem.minimize(running=u**2 / 2 + (v - first) ** 2)
    return problem


METHODS: dict[str, Any] = {
    "radau": Collocation(8, 3),
    "legendre": Collocation(8, 3, scheme="legendre"),
    "held": Collocation(12, 3, control="held"),
    "shooting, held": MultipleShooting(12, steps=3),
    "shooting, linear": MultipleShooting(12, steps=3, control="linear"),
}


@pytest.mark.parametrize("symbols", [ca.SX, ca.MX])
@pytest.mark.parametrize("method", METHODS)
def test_a_signal_is_the_expression_that_it_stands_for(method: str, symbols: Any) -> None:
    report, written = (solve(everywhere(known, symbols), METHODS[method]) for known in (True, False))
    assert report.cost == pytest.approx(written.cost, rel=1e-9)
    for name in ("x", "v", "u"):
        np.testing.assert_allclose(report[name], written[name], atol=1e-7)
    first, second = report.audit(), written.audit()
    assert (first.passed, first.feasible, first.optimal) == (second.passed, second.feasible, second.optimal)
    findings = {finding.name: finding.value for finding in second.findings}
    assert {finding.name for finding in first.findings} == set(findings)


def test_a_signal_may_be_an_interpolant_in_a_problem_of_other_symbols() -> None:
    """Splines take MX symbols only; the problem of SX symbols has the cost of the one of MX symbols."""
    mesh = Collocation(8, 3)
    report, written = solve(everywhere(True, ca.SX, SPLINE), mesh), solve(everywhere(False, ca.MX, SPLINE), mesh)
    assert report.cost == pytest.approx(written.cost, rel=1e-9)
    assert report.audit().passed is written.audit().passed


@pytest.mark.parametrize("track", [wave, SPLINE], ids=["expression", "spline"])
def test_a_problem_with_signals_is_read_and_audited_in_another_process(track: Track, tmp_path: Path) -> None:
    solution = solve(everywhere(True, ca.SX, track), Collocation(8, 3))
    solution.save(tmp_path / "wave.npz")
    again = Solution.load(tmp_path / "wave.npz")
    assert [f.value for f in again.audit().findings] == [f.value for f in solution.audit().findings]
    done = run(f"""
        from ocp import Collocation, Solution, solve
        plan = Solution.load({str(tmp_path / "wave.npz")!r})
        print(plan.audit().passed, repr(solve(plan.problem, Collocation(8, 3)).cost))
    """)
    passed, cost = done.stdout.split()
    assert passed == str(solution.audit().passed), done.stderr
    assert float(cost) == pytest.approx(solution.cost, rel=1e-12)


def test_a_pure_state_row_holds_the_controls_by_the_signals_derivatives() -> None:
    """x = w(t) all along: x'' = u = w'' is forced, and the audit that is told w by a signal decides as with t."""

    def tracked(known: bool) -> Problem:
        problem = Problem("on the wave")
        x, v = problem.state("x"), problem.state("v")
        u, free = problem.control("u"), problem.control("free")
        problem.horizon(HORIZON)
        w = problem.signal("w", lambda t: ca.sin(t)) if known else ca.sin(problem.time)
        problem.dynamics(x, v)
        problem.dynamics(v, u)
        problem.path("rail", x - w, 0, 0)
        problem.minimize(running=u**2 / 2 + (free - w) ** 2)
        return problem

    report, written = (solve(tracked(known), Collocation(12, 4)) for known in (True, False))
    inside = np.linspace(0.1, HORIZON - 0.1, 50)
    np.testing.assert_allclose(report.at(inside)["v"][:, 0], np.cos(inside), atol=1e-5)
    assert report.cost == pytest.approx(written.cost, rel=1e-9)
    first, second = report.audit(), written.audit()
    assert (first.feasible, first.optimal) == (second.feasible, second.optimal)
    values = {finding.name: finding.value for finding in second.findings}
    for finding in first.findings:
        assert finding.value == pytest.approx(values[finding.name], rel=1e-3, abs=1e-6), finding.name


@pytest.mark.parametrize("order", [0, 1, 2, 3])
def test_derivatives_of_signals_are_those_of_their_expression(order: int) -> None:
    form = Formulation(everywhere(True))
    times = np.array([0.0, 0.3, 1.1, HORIZON])
    wanted = np.column_stack(
        [2**order * np.sin(2 * times + order * np.pi / 2), 0.5 * np.cos(times + order * np.pi / 2)]
    )
    np.testing.assert_allclose(form.signals_at(times, order), wanted, atol=1e-12)


def test_signals_are_described() -> None:
    assert any("signal" in line and "w (2)" in line for line in str(everywhere(True)).splitlines())


# ---- what signals cannot do ------------------------------------------------------------------------------------------


def with_signal(**horizon: Any) -> Problem:
    problem = Problem("signalled")
    x, u = problem.state("x", initial=0.0), problem.control("u")
    w = problem.signal("wave", ca.sin)
    if "parameter" in horizon:
        problem.horizon(problem.parameter("end"))
    else:
        problem.horizon(**horizon)
    problem.dynamics(x, u)
    problem.minimize(running=(u - w) ** 2)
    return problem


@pytest.mark.parametrize(
    ("problem", "method", "parameters"),
    [
        (lambda: with_signal(lower=0.5, upper=2.0, guess=1.0), Collocation(4), {}),
        (lambda: with_signal(parameter=True), Collocation(4), {"end": 1.0}),
        (lambda: with_signal(value=1.0), Indirect(), {}),
    ],
    ids=["free horizon", "parametric horizon", "indirect"],
)
def test_expressions_without_signals_are_refused_by_name(problem: Any, method: Any, parameters: dict[str, Any]) -> None:
    with pytest.raises(ProblemError, match="wave") as caught:
        solve(problem(), method, parameters=parameters)
    assert caught.value.name == "wave"


@pytest.mark.parametrize("control", ["held", "linear"])
def test_cvodes_takes_signals_too(control: Any) -> None:
    method = MultipleShooting(6, integrator="cvodes", control=control)
    report, written = (solve(everywhere(known), method) for known in (True, False))
    assert report.cost == pytest.approx(written.cost, rel=1e-6)


@pytest.mark.parametrize(
    ("name", "track"),
    [
        ("", ca.sin),
        (3, ca.sin),
        ("t", ca.sin),
        ("x", ca.sin),
        ("wave", "word"),
        ("wave", 3.0),
        ("wave", None),
        ("wave", lambda t: "word"),
        ("wave", lambda: 3.0),
        ("wave", lambda t: t + ca.MX.sym("strange")),
        ("wave", lambda t: ca.SX.sym("strange")),
        ("wave", lambda t: [t, t, None]),
        ("wave", lambda t: 1 / 0),
        ("wave", lambda t: {"b": t}["a"]),
        ("wave", lambda t: t.nothing),
        ("wave", lambda t: np.zeros((2, 2, 2))),
    ],
)
def test_bad_signals_are_refused_by_name(name: Any, track: Any) -> None:
    problem = Problem("bad")
    problem.state("x")
    with pytest.raises(ProblemError) as caught:
        problem.signal(name, track)
    assert caught.value.name


def test_a_signal_that_is_not_finite_somewhere_is_refused() -> None:
    problem = Problem("root")
    x, u = problem.state("x", initial=0.0), problem.control("u")
    w = problem.signal("root", lambda t: ca.sqrt(0.5 - t))
    problem.horizon(1.0)
    problem.dynamics(x, u)
    problem.minimize(running=(u - w) ** 2)
    with pytest.raises((ProblemError, SolveError), match=r"root|finite|nan|NaN"):
        solve(problem, Collocation(4))
