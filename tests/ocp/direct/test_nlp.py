"""Solver calls: both solvers agree, both report failures, and Ctrl-C is handled."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import textwrap
import threading
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
import pytest

from ocp import Collocation, MultipleShooting, Problem, ProblemError, SolveError, prepare, solve
from ocp.direct import nlp, prepared
from ocp.errors import SolverStatus
from tests.families import some
from tests.ocp.problems import METHODS, SOLVERS, SWING, Method, energy, plant, relative, swing, van_der_pol

FINE: dict[str, Method] = {
    "radau": Collocation(10),
    "legendre-held": Collocation(10, scheme="legendre", control="held"),
    "rk4-held": MultipleShooting(12, steps=2),
    "rk4-linear": MultipleShooting(12, steps=2, control="linear"),
}


def soft_lander() -> Problem:
    """Free horizon, bang-bang control, terminal inequality."""
    problem = Problem("soft lander")
    h = problem.state("h", initial=10.0, terminal=0.0)
    v = problem.state("v", initial=-2.0, terminal=0.0)
    u = problem.control("u", lower=0.0, upper=3.0)
    horizon = problem.horizon(lower=1.0, upper=10.0, guess=4.0)
    problem.dynamics(h, v)
    problem.dynamics(v, u - 1.5)
    problem.end("late", horizon, lower=2.0)
    problem.minimize(running=u + 0.05 * u**2)
    return problem


def obstacle() -> Problem:
    """A point mass round a disc: a path inequality of states, one of states and controls, an end tied to the start."""
    problem = Problem("obstacle")
    x = problem.state("x", 2, initial=[0.0, 0.0], terminal=[2.0, np.nan], guess=lambda t: [t, 0.5])
    u = problem.control("u", 2)
    problem.dynamics(x, u)
    problem.horizon(2.0)
    problem.path("disc", ca.sumsqr(x - ca.DM([1.0, -0.1])), lower=0.25)
    problem.path("slow", u[0] - 0.2 * x[1], upper=1.3)
    problem.end("level", x[1] - problem.at_start(x)[1], 0.0, 0.0)
    problem.minimize(running=ca.sumsqr(u))
    return problem


# ---- two solvers -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("method", FINE)
@pytest.mark.parametrize("problem", [soft_lander, obstacle, lambda: swing()], ids=["lander", "obstacle", "swing"])
def test_ipopt_and_fatrop_find_the_same_optimum(problem: Any, method: str) -> None:
    parameters = SWING if problem().name == "swing" else {}
    a, b = (solve(problem(), FINE[method], solver=solver, parameters=parameters) for solver in SOLVERS)
    assert b.cost == pytest.approx(a.cost, rel=1e-8, abs=1e-8)
    assert b.horizon == pytest.approx(a.horizon, rel=1e-6)
    for pool in ("states", "controls", "costates"):
        for name, values in getattr(a, pool).items():
            assert relative(getattr(b, pool)[name], values) < 1e-5, f"{pool} {name}"


@pytest.mark.parametrize("method", METHODS)
def test_ipopt_and_fatrop_agree_without_inequalities_to_rounding(method: str) -> None:
    a, b = (solve(van_der_pol(), METHODS[method], solver=solver) for solver in SOLVERS)
    assert b.cost == pytest.approx(a.cost, abs=1e-11)
    for name in ("x", "u"):
        np.testing.assert_allclose(b[name], a[name], atol=1e-8)
    np.testing.assert_allclose(b.costate("x"), a.costate("x"), atol=1e-8)


@pytest.mark.parametrize("solver", SOLVERS)
@pytest.mark.parametrize("method", METHODS)
def test_plans_respect_the_requested_bounds(method: str, solver: str) -> None:
    solution = solve(energy(lower=-5.0, upper=5.0), METHODS[method], solver=solver)
    values = solution.control_interpolant.values
    assert values.max() <= 5.0
    assert values.min() >= -5.0
    assert solution["q"][0, 0] == 0.0
    assert solution["q"][-1, 0] == pytest.approx(1.0, abs=1e-12)


@pytest.mark.parametrize("method", ["radau", "radau-held", "legendre", "legendre-held", "rk4-held"])
def test_fatrop_says_that_it_cannot_constrain_the_control_at_the_end(method: str) -> None:
    with pytest.raises(ProblemError, match="cannot constrain the control at the end; use ipopt"):
        prepare(swing(control_ties=True), METHODS[method], solver="fatrop")


def test_fatrop_constrains_controls_at_the_end_where_they_stand_at_nodes() -> None:
    a, b = (solve(swing(control_ties=True), FINE["rk4-linear"], solver=s, parameters=SWING) for s in SOLVERS)
    assert b.cost == pytest.approx(a.cost, rel=1e-8)


# ---- options -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("solver", ["snopt", "", None, "IPOPT", 3])
def test_unknown_solvers_are_named(solver: Any) -> None:
    with pytest.raises(ProblemError, match=r"solver must be 'ipopt' or 'fatrop' or 'sleqp'"):
        solve(energy(), Collocation(2), solver=solver)


@pytest.mark.parametrize(
    ("solver", "options"),
    [
        ("ipopt", {"max_itr": 5}),
        ("ipopt", {"max_iter": "many"}),
        ("ipopt", {"max_iter": -1}),
        ("ipopt", {"tol": "small"}),
        ("ipopt", {1: 2}),
        ("fatrop", {"max_itr": 5}),
        ("fatrop", {"max_iter": "many"}),
        ("fatrop", {1: 2}),
    ],
)
def test_options_that_a_solver_does_not_take_are_named(solver: str, options: Any) -> None:
    with pytest.raises(
        ProblemError, match=rf"{solver} does not take th(is|ese) option|options must be a dictionary by name"
    ):
        solve(energy(), Collocation(2), solver=solver, options=options)


@pytest.mark.parametrize("solver", SOLVERS)
def test_options_reach_the_solver(solver: str) -> None:
    solution = solve(van_der_pol(), Collocation(5), solver=solver, options={"max_iter": 2}, check=False)
    assert not solution.success
    assert solution.message.startswith("Maximum_Iterations_Exceeded: raise options={'max_iter'")
    assert solution.iterations <= 3
    assert solve(van_der_pol(), Collocation(5), solver=solver, options={"max_iter": 50}).success


# ---- failures ----------------------------------------------------------------------------------------------------


def too_far() -> Problem:
    """1 m in 1 s at no more than 0.1 m/s."""
    problem, x, u = plant("too far", initial=0.0, terminal=1.0, u={"lower": -0.1, "upper": 0.1})
    problem.dynamics(x, u)
    problem.minimize(running=u**2)
    return problem


@pytest.mark.parametrize("solver", SOLVERS)
@pytest.mark.parametrize("method", METHODS)
def test_an_infeasible_problem_names_the_violated_constraint_and_place(method: str, solver: str) -> None:
    with pytest.raises(SolveError) as caught:
        solve(too_far(), METHODS[method], solver=solver)
    message = str(caught.value)
    assert f"problem 'too far': {solver} ended with " in message
    assert re.search(r"control u is at its upper bound 0\.1 at \d+% of its points", message)
    missed = [line for line in message.splitlines() if "is missed by" in line]
    assert missed
    assert all(" x is missed by " in line and line.endswith(" s") for line in missed)
    assert "all constraints are met" not in message
    solution = caught.value.solution
    assert solution is not None
    assert not solution.success


@pytest.mark.parametrize("solver", SOLVERS)
def test_an_infeasible_problem_does_not_blame_the_number_of_iterations(solver: str) -> None:
    solution = solve(too_far(), Collocation(4), solver=solver, check=False)
    assert not solution.success
    assert solution.iterations < 200
    assert solution.status is not SolverStatus.ITERATION_LIMIT


def no_least_cost() -> Problem:
    """The more control the better, without an end."""
    problem, x, u = plant("no least cost", initial=0.0)
    problem.dynamics(x, u)
    problem.minimize(running=-u)
    return problem


@pytest.mark.parametrize(
    ("problem", "options", "word", "status"),
    [
        (van_der_pol(), {"max_iter": 2}, "iteration limit", SolverStatus.ITERATION_LIMIT),
        pytest.param(too_far(), {}, "deadpoint", SolverStatus.STEP_FAILED, marks=pytest.mark.long),
        (no_least_cost(), {}, "unbounded", SolverStatus.DIVERGING),
    ],
    ids=["iteration limit", "deadpoint", "unbounded"],
)
def test_a_false_success_of_sleqp_is_a_failure(
    problem: Problem, options: dict[str, Any], word: str, status: SolverStatus, monkeypatch: pytest.MonkeyPatch
) -> None:
    results = []

    def call_solver(solver: Any, *arguments: Any) -> nlp.Outcome:
        outcome = nlp.call_solver(solver, *arguments)
        results.append((solver.stats()["return_status"], solver.stats()["success"]))
        return outcome

    monkeypatch.setattr(prepared, "call_solver", call_solver)
    solution = solve(problem, MultipleShooting(4), solver="sleqp", options=options, check=False)
    assert results[-1] == (word, True)
    assert (solution.success, solution.status) == (False, status)
    with pytest.raises(SolveError, match=str(status)):
        solve(problem, MultipleShooting(4), solver="sleqp", options=options)


def test_conflicting_constraints_are_named() -> None:
    problem = van_der_pol()
    x = problem.declared.states["x"].symbol
    problem.path("high", x[0] + x[1], lower=3.0)
    problem.end("low", x[0], upper=-2.0)
    with pytest.raises(SolveError, match=r"(high|low) is missed by"):
        solve(problem, Collocation(5))


def test_a_stop_before_the_optimum_is_reported() -> None:
    with pytest.raises(SolveError, match="Maximum_Iterations_Exceeded") as caught:
        solve(van_der_pol(), Collocation(5), options={"max_iter": 1})
    assert caught.value.solution is not None
    assert caught.value.solution.t.shape == (16,)


def test_a_feasible_plan_that_is_not_optimal_is_reported_as_such() -> None:
    """Linear dynamics are met after one step; the cost is far from its optimum."""
    problem, x, u = plant("quartic", initial=1.0, u={"guess": 5.0})
    problem.dynamics(x, u - x)
    problem.minimize(running=(u - 3) ** 4 + x**4)
    with pytest.raises(SolveError, match="all constraints are met; the plan is feasible but not optimal"):
        solve(problem, Collocation(4), options={"max_iter": 3})


def rooted() -> Problem:
    """The root of a state that the first guess takes below zero."""
    problem, x, u = plant("rooted", initial=1.0, terminal=-1.0, u={"lower": -5.0, "upper": 5.0})
    problem.dynamics(x, u + ca.sqrt(x))
    problem.minimize(running=u**2)
    return problem


@pytest.mark.parametrize(
    "method", [Collocation(3), MultipleShooting(3), MultipleShooting(3, integrator="cvodes")], ids=str
)
def test_functions_that_are_not_finite_are_named(method: Method, capfd: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SolveError, match=r"(dynamics|continuity) of x is not finite at .* s") as caught:
        solve(rooted(), method)
    assert "all constraints are met" not in str(caught.value)
    assert "Invalid_Number_Detected" in str(caught.value)
    capfd.readouterr()  # the integrator complains by itself


def test_fatrop_does_not_hang_on_functions_that_are_not_finite() -> None:
    """In a process of its own, because nothing stops fatrop once it loops."""
    code = """
    import casadi as ca
    from ocp import Collocation, SolveError, solve
    from tests.ocp.direct.test_nlp import rooted
    try:
        solve(rooted(), Collocation(3), solver="fatrop")
    except SolveError as error:
        print("told:", error)
    """
    done = run(code)
    assert "told: problem 'rooted'" in done.stdout, done.stderr


def test_an_unbounded_cost_is_reported() -> None:
    problem, x, u = plant("endless", initial=1.0)
    problem.dynamics(x, u)
    problem.minimize(running=u)
    with pytest.raises(SolveError, match="endless"):
        solve(problem, Collocation(3), options={"max_iter": 100})


# ---- Ctrl-C ------------------------------------------------------------------------------------------------------


def run(code: str, timeout: float = 600.0) -> subprocess.CompletedProcess[str]:
    """Python code in a process of its own, from the root of the repository."""
    root = Path(__file__).parents[3]
    return subprocess.run(
        [sys.executable, "-c", textwrap.dedent(code)],
        cwd=root,
        env={**os.environ, "PYTHONPATH": str(root)},
        capture_output=True,
        text=True,
        timeout=timeout,
        check=False,
    )


INTERRUPTED = """
import os, signal, time
import casadi as ca
from ocp import Collocation, Problem, console, prepare

signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell starts background jobs with Ctrl-C ignored
problem = Problem("long")
x = problem.state("x", 2, initial=[1.0, 0.0])
u = problem.control("u", lower=-1.0, upper=1.0)
problem.dynamics(x, ca.vertcat(x[1], (1 - x[0] ** 2) * x[1] - x[0] + u))
problem.horizon(20.0)
problem.minimize(running=ca.sumsqr(x))
# a tolerance that is never reached keeps the solver at work
never = {"max_iter": 1000000}
if SOLVER != "fatrop":
    never |= {"tol": 1e-300, "acceptable_iter": 0 if SOLVER == "ipopt" else 1000000}
prepared = prepare(problem, Collocation(600, 4), solver=SOLVER, options=never)


def stopping(kind):
    real = kind.eval

    def eval(self, arguments):
        if self.stops and self.iterations == 3:
            os.kill(os.getpid(), signal.SIGINT)
        return real(self, arguments)

    kind.eval, kind.stops = eval, True


stopping(console.IterationMonitor)
stopping(console.FatropMonitor)
before = signal.getsignal(signal.SIGINT)
for check in (False, True):
    try:
        prepared.solve(check=check)
        print("returned")
    except KeyboardInterrupt as error:
        print(error.solution.success, error.solution.message, error.solution["x"].shape)
    print("restored", signal.getsignal(signal.SIGINT) is before)
console.IterationMonitor.stops = console.FatropMonitor.stops = False
again = prepare(problem, Collocation(20), solver=SOLVER).solve()
print("afterwards", again.success)
try:
    os.kill(os.getpid(), signal.SIGINT)
    time.sleep(1)
except KeyboardInterrupt:
    print("Ctrl-C works as before")
"""


@pytest.mark.parametrize("solver", some(SOLVERS, 1))
def test_ctrl_c_stops_a_solve_and_carries_the_last_iterate(solver: str) -> None:
    done = run(f"SOLVER = {solver!r}\n{INTERRUPTED}")
    assert done.stdout.splitlines() == [
        "False User_Requested_Stop: interrupted (2401, 2)",
        "restored True",
        "False User_Requested_Stop: interrupted (2401, 2)",
        "restored True",
        "afterwards True",
        "Ctrl-C works as before",
    ], done.stdout + done.stderr


def test_signal_handlers_are_left_alone() -> None:
    seen = []
    before = signal.signal(signal.SIGINT, lambda number, frame: seen.append(number))
    try:
        mine = signal.getsignal(signal.SIGINT)
        solve(energy(), Collocation(3))
        assert signal.getsignal(signal.SIGINT) is mine
        with pytest.raises(SolveError):
            solve(too_far(), Collocation(3))
        assert signal.getsignal(signal.SIGINT) is mine
        os.kill(os.getpid(), signal.SIGINT)
        assert seen == [signal.SIGINT]
    finally:
        signal.signal(signal.SIGINT, before)


def test_solving_in_another_thread_works() -> None:
    costs = []
    thread = threading.Thread(target=lambda: costs.append(solve(energy(), Collocation(3)).cost))
    thread.start()
    thread.join()
    assert costs == [pytest.approx(6.0)]


@pytest.mark.parametrize("solver", SOLVERS)
def test_solving_is_silent(solver: str, capfd: pytest.CaptureFixture[str]) -> None:
    solve(van_der_pol(), Collocation(5), solver=solver)
    out = capfd.readouterr()
    assert out.out == ""
    assert out.err == ""


@pytest.mark.parametrize("solver", SOLVERS)
def test_an_infeasible_solve_prints_nothing(solver: str, capfd: pytest.CaptureFixture[str]) -> None:
    solve(too_far(), Collocation(5), solver=solver, check=False)
    out = capfd.readouterr()
    assert out.out == ""
    assert out.err == ""
