"""Problems outlive their process: written, pickled and copied, they are audited and solved to the same numbers."""

from __future__ import annotations

import copy
import json
import pickle
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
import pytest

import ocp
from models import examples as papers
from ocp import (
    AuditError,
    Collocation,
    Indirect,
    MultipleShooting,
    Problem,
    ProblemError,
    Solution,
    SolveError,
    StorageWarning,
    TipTask,
    prepare,
    solve,
)
from ocp.problem.record_reader import unpack_record
from ocp.problem.record_writer import pack_record
from tests.families import some
from tests.ocp.problems import SWING, energy, plant, swing, van_der_pol
from tests.ocp.test_faults import run


def interpolated(symbols: Any = ca.MX) -> Problem:
    """A cost that an interpolant gives."""
    grid = np.linspace(-3.0, 3.0, 30)
    bowl = ca.interpolant("bowl", "bspline", [grid], np.cosh(grid))
    problem, x, u = plant("interpolated", symbols=symbols, initial=1.0)
    problem.dynamics(x, u)
    problem.minimize(running=bowl(x) + u**2)
    return problem


def mapped() -> Problem:
    """Dynamics that call a function mapped over its arguments, and a free horizon in the cost."""
    y = ca.SX.sym("y")
    damped = ca.Function("damped", [y], [-y / (1 + y**2)]).map(3)
    problem = Problem("mapped", ca.MX)
    x = problem.state("x", 3, initial=[1.0, 2.0, np.nan], lower=-5.0, guess=[1.0, 1.0, 1.0], unit="rad")
    u = problem.control("u", 3, lower=-2.0, upper=2.0)
    horizon = problem.horizon(lower=0.5, upper=2.0, guess=1.0)
    problem.dynamics(x, damped(x.T).T + u)
    problem.start("third", x[2] - x[1], 0, 0, unit="rad")
    problem.watch("drift", x - problem.at_start(x), lower=-9.0, integral=True, way=u, unit="rad s")
    problem.minimize(running=ca.sumsqr(x) + ca.sumsqr(u), terminal=horizon + ca.sumsqr(x - problem.at_start(x)))
    return problem


def moved() -> Problem:
    arm, start = papers.paper_example(), [0.7, 0.6, 0.9]
    return ocp.minimum_velocity_problem(arm, TipTask(rows=(3, 4), velocity=(-1.0, -1.0)), 0.5, start=start)


PROBLEMS: dict[str, tuple[Callable[[], Problem], dict[str, Any]]] = {
    "SX": (lambda: swing(control_ties=True), SWING),
    "MX": (lambda: swing(ca.MX, control_ties=True), SWING),
    "interpolant": (interpolated, {}),
    "interpolant of scalars": (lambda: interpolated(ca.SX), {}),
    "mapping": (mapped, {}),
    "builder": (moved, {}),
}


@pytest.mark.parametrize("what", some(PROBLEMS, 2))
def test_a_saved_plan_is_audited_in_another_process(what: str, tmp_path: Path) -> None:
    build, parameters = PROBLEMS[what]
    plan = solve(build(), Collocation(6), parameters=parameters)
    plan.save(tmp_path / "plan.npz")
    done = run(f"""
        from ocp import Solution
        print(Solution.load({str(tmp_path / "plan.npz")!r}).audit())
    """)
    assert done.returncode == 0, done.stderr
    assert done.stdout == f"{plan.audit()}\n"


COPIES: dict[str, Callable[[Any], Any]] = {
    "pickle": lambda thing: pickle.loads(pickle.dumps(thing)),
    "copy": copy.copy,
    "deepcopy": copy.deepcopy,
}


@pytest.mark.parametrize("how", COPIES)
@pytest.mark.parametrize("what", PROBLEMS)
def test_a_problem_again_is_the_same_problem(what: str, how: str) -> None:
    build, parameters = PROBLEMS[what]
    problem = build()
    again = COPIES[how](problem)
    if what not in ("SX", "builder") and how == "pickle":  # matrices are written entry by entry, tables without names
        assert str(again).split("  d")[0] == str(problem).split("  d")[0]
        assert str(COPIES[how](again)) == str(again)
    else:
        assert str(again) == str(problem)
    assert again.symbols is problem.symbols
    for pool in ("states", "controls", "path", "start"):
        units = {name: item.unit for name, item in getattr(problem.declared, pool).items()}
        assert {name: item.unit for name, item in getattr(again.declared, pool).items()} == units
    one, other = (solve(p, Collocation(4), parameters=parameters, guess={}) for p in (problem, again))
    assert other.cost == pytest.approx(one.cost, rel=1e-12)


def test_more_can_be_declared_of_a_copy_alone() -> None:
    problem = van_der_pol()
    for again in (copy.copy(problem), copy.deepcopy(problem)):
        x = again.declared.states["x"].symbol  # the same symbols
        again.path("wall", x[0], upper=2.0)
        assert "wall" not in problem.declared.path
    loaded = pickle.loads(pickle.dumps(problem))
    loaded.path("wall", loaded.declared.states["x"].symbol[0], upper=2.0)
    assert solve(loaded, Collocation(5)).success


@pytest.mark.parametrize("name", ["energy", "swing", "van der Pol"])
def test_incomplete_problems_are_stored(name: str) -> None:
    problem = Problem(name)
    problem.state("x", 2, initial=[1.0, np.nan], guess=lambda t: [t, t])
    again = pickle.loads(pickle.dumps(problem))
    assert str(again) == str(problem)
    assert again.declared.states["x"].guess is None, "functions are not kept"
    with pytest.raises(ProblemError, match="no dynamics"):
        again.check()


class OfPython(ca.Callback):  # type: ignore[misc]
    """x^2, as a function that only Python knows."""

    def __init__(self) -> None:
        ca.Callback.__init__(self)
        self.construct("of_python", {"enable_fd": True})

    def eval(self, arguments: list[Any]) -> list[Any]:
        return [arguments[0] ** 2]


def test_a_problem_that_calls_python_is_left_out_and_the_plan_says_so(tmp_path: Path) -> None:
    square = OfPython()
    problem, x, u = plant("of Python", symbols=ca.MX, initial=1.0)
    problem.dynamics(x, u)
    problem.minimize(running=x**2 + u**2)
    plan = solve(problem, Collocation(4))
    problem.path("square", square(x), upper=9.0)
    plan = plan.with_problem(problem)
    with pytest.raises(ProblemError, match=r"problem 'of Python' cannot be written: .*Callback") as caught:
        pickle.dumps(problem)
    assert caught.value.name == "of Python"
    with pytest.warns(StorageWarning, match=r"saved without its problem and cannot be audited: .*CallbackInternal"):
        plan.save(tmp_path / "plan.npz")
    for again in (Solution.load(tmp_path / "plan.npz"), pickle.loads(pickle.dumps(plan))):
        assert again.problem is None
        with pytest.raises(AuditError, match=r"has no problem .*cannot be written.*; call audit\(problem\)"):
            again.audit()
        np.testing.assert_array_equal(again["x"], plan["x"])
        again.save(tmp_path / "again.npz")
        with pytest.raises(AuditError, match="cannot be written"):
            Solution.load(tmp_path / "again.npz").audit()


@pytest.mark.parametrize("how", COPIES)
def test_a_solution_again_is_the_same_solution(how: str) -> None:
    plan = solve(energy(), Collocation(4))
    again = COPIES[how](plan)
    assert str(again.audit()) == str(plan.audit())
    np.testing.assert_array_equal(again["u"], plan["u"])
    assert (again["u"] is plan["u"]) == (how == "copy")
    assert solve(energy(), Collocation(4), guess=again).success


@pytest.mark.parametrize("how", COPIES)
@pytest.mark.parametrize("method", [Collocation(4), MultipleShooting(4), Indirect(seed=Collocation(4))], ids=str)
def test_a_prepared_problem_is_prepared_again(method: Any, how: str) -> None:
    prepared = prepare(energy(), method, options={"max_iter": 77})
    again = COPIES[how](prepared)
    assert again is not prepared
    assert again.solve().cost == pytest.approx(prepared.solve().cost, rel=1e-12)


@pytest.mark.parametrize("how", COPIES)
def test_a_failure_again_carries_its_plan(how: str) -> None:
    with pytest.raises(SolveError) as caught:
        solve(van_der_pol(), Collocation(4), options={"max_iter": 1})
    again = COPIES[how](caught.value)
    assert str(again) == str(caught.value)
    assert again.name == caught.value.name
    assert not again.solution.success
    assert str(again.solution.problem) == str(van_der_pol())


def test_an_exception_whose_value_cannot_be_pickled_tells_how_it_is_shown() -> None:
    x = ca.SX.sym("x")
    error = pickle.loads(pickle.dumps(ProblemError("no", name="x", value=x, limit=lambda t: t)))
    assert (str(error), error.name, error.value) == ("no", "x", repr(x))
    assert error.limit.startswith("<function")


@pytest.mark.parametrize("part", ["functions", "expressions", "declared", "symbols", "name"])
def test_a_record_that_was_changed_is_refused(part: str) -> None:
    report, arrays = pack_record(energy().__getstate__())
    record = unpack_record(json.loads(json.dumps(report)), arrays)
    assert str(Problem.from_record(record)) == str(energy())
    without = {key: value for key, value in record.items() if key != part}
    changed = {**record, part: record["symbols"][:1]}
    for wrong in (without,) if part == "name" else (without, changed):
        with pytest.raises(ProblemError, match="the saved problem is damaged"):
            Problem.from_record(wrong)


def test_units_outputs_tightened_bounds_and_starts_survive_the_file(tmp_path: Path) -> None:
    plan = solve(mapped(), Collocation(5))
    tightening = replace(plan, bound_tightening=np.full((2, 5, 6), 0.25), start="zeros", regularised=True)
    tightening.save(tmp_path / "plan.npz")
    loaded = Solution.load(tmp_path / "plan.npz")
    assert (loaded.start, loaded.regularised) == ("zeros", True)
    np.testing.assert_array_equal(loaded.bound_tightening, tightening.bound_tightening)
    assert loaded.problem.declared.states["x"].unit == "rad"
    assert loaded.problem.declared.start["third"].unit == "rad"
    watched = loaded.problem.declared.watch["drift"]
    assert (watched.integral, watched.way.numel(), watched.unit) == (True, 3, "rad s")
    np.testing.assert_array_equal(loaded.problem.declared.states["x"].guess, [1.0, 1.0, 1.0])
