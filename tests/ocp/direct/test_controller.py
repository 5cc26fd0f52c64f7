"""C for controllers, built and run: its functions are those that were solved with, its program tells the plan."""

from __future__ import annotations

import subprocess
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
import pytest

from models.checks import Array
from ocp import Collocation, MultipleShooting, Problem, ProblemError, Solution, prepare
from tests.ocp.problems import SWING, plant, swing, van_der_pol

STRICT = "-O1 -ffp-contract=off -std=c99 -Wall -Wextra -Wno-unused-parameter -Werror"
CASES = {
    "radau": (Collocation(4), "ipopt"),
    "legendre, stages": (Collocation(4, 2, "legendre"), "fatrop"),
    "two steps": (MultipleShooting(3, steps=2), "ipopt"),
    "linear": (MultipleShooting(4, control="linear", mesh=(0.0, 0.1, 0.4, 0.6, 1.0)), "ipopt"),
}


def compiled_controller(folder: Path) -> Path:
    subprocess.run(["make", f"CFLAGS={STRICT}"], cwd=folder, check=True, capture_output=True)
    return folder / "plan"


def run(program: Path, period: object, *numbers: Array) -> subprocess.CompletedProcess[str]:
    words = " ".join(repr(float(number)) for part in numbers for number in part)
    return subprocess.run([str(program), str(period)], input=words, capture_output=True, text=True, check=False)


def table(report: str) -> tuple[list[str], Array]:
    head, *lines = report.splitlines()
    return head.split(","), np.array([[float(word) for word in line.split(",")] for line in lines])


def of(plan: Solution, times: Array) -> Array:
    at = plan.at(times)
    return np.hstack([at[name].reshape(len(times), -1) for name in (*plan.states, *plan.controls)])


@pytest.mark.long
@pytest.mark.parametrize("case", CASES)
def test_the_program_tells_the_plan_and_its_functions_are_those_solved_with(case: str, tmp_path: Path) -> None:
    method, solver = CASES[case]
    prepared: Any = prepare(swing(), method, solver=solver)
    plan = prepared.solve(SWING)
    assert prepared.to_c(tmp_path / "new" / "folder", SWING, plan) == tmp_path / "new" / "folder"
    program = compiled_controller(tmp_path / "new" / "folder")
    p = prepared.formulation.parameter_vector(SWING)
    done = run(program, plan.horizon / 7.5, p)
    assert done.returncode == 0, done.stderr
    assert float(done.stderr.split()[1].rstrip(",")) == plan.cost
    names, rows = table(done.stdout)
    assert names == ["time", *prepared.formulation.state_labels, *prepared.formulation.control_labels]
    assert rows.shape == (9, len(names))
    assert rows[-1, 0] == plan.horizon
    np.testing.assert_allclose(rows[:, 1:], of(plan, rows[:, 0]), rtol=0, atol=1e-12)

    library = tmp_path / "plan.so"
    words = ["cc", "-shared", "-fPIC", "-w", "-ffp-contract=off", str(program.parent / "plan.c"), "-o", str(library)]
    subprocess.run([*words, "-lm"], check=True)

    def values_of(name: str, *options: Any) -> list[Array]:
        result = ca.external(f"plan_{name}", str(library)).call([ca.DM(each) for each in options])
        return [np.asarray(each.full()) for each in result]

    random = np.random.default_rng(0)
    x = plan.variables + random.uniform(-0.1, 0.1, plan.variables.shape)
    sigma, lam = random.uniform(0.5, 1.0), random.normal(size=plan.multipliers.shape)
    for name, function, options in (
        ("objective", prepared.program.gradient, (x, p)),
        ("constraints", prepared.program.jacobian, (x, p)),
        ("hessian", prepared.program.hessian, (x, p, sigma, lam)),
    ):
        for ours, theirs in zip(
            values_of(name, *options), function.call([ca.DM(each) for each in options]), strict=True
        ):
            np.testing.assert_array_equal(ours, theirs.full())
    lower, upper = prepared.formulation.bound_values(p)
    transcription = prepared.transcription
    expected = [side[at] for at in (transcription.variable_bounds, transcription.row_bounds) for side in (lower, upper)]
    for ours, theirs in zip(values_of("bounds", p), expected, strict=True):
        np.testing.assert_array_equal(ours.ravel(), theirs)


def test_another_plan_and_other_parameters_are_read(tmp_path: Path) -> None:
    prepared: Any = prepare(swing(), Collocation(4))
    prepared.to_c(tmp_path, SWING)
    program = compiled_controller(tmp_path)
    other = {name: 1.05 * np.asarray(value) for name, value in SWING.items()}
    plan = prepared.solve(other)
    p = prepared.formulation.parameter_vector(other)
    done = run(program, 0.5, p, plan.variables)
    assert done.returncode == 0
    rows = table(done.stdout)[1]
    np.testing.assert_allclose(rows[:, 1:], of(plan, rows[:, 0]), rtol=0, atol=1e-12)
    guess = run(program, 0.5, p)  # no plan: a guess, which misses the dynamics
    assert guess.returncode == 1
    assert "missed by" in guess.stderr
    for period, numbers in (("0.5", p[:-1]), ("0.5", [*p, 1.0]), ("0", p), ("-1", p), ("nan", p)):
        refused = run(program, period, np.asarray(numbers))
        assert (refused.returncode, refused.stdout) == (2, "")


def test_a_plan_that_is_not_finite_fails(tmp_path: Path) -> None:
    prepared: Any = prepare(van_der_pol(), Collocation(3))
    plan = prepared.solve()
    prepared.to_c(tmp_path, guess=plan)
    broken = plan.variables.copy()
    broken[5] = np.nan
    assert run(compiled_controller(tmp_path), 0.5, broken).returncode == 1


def test_names_are_written_as_they_are(tmp_path: Path) -> None:
    problem = Problem('what? */ "ends" \\ here')
    x = problem.state("größe", initial=0.0, terminal=1.0)
    u = problem.control("u")
    problem.dynamics(x, u)
    problem.horizon(1.0)
    problem.minimize(running=u**2)
    prepared: Any = prepare(problem, Collocation(2))
    done = run(compiled_controller(prepared.to_c(tmp_path, guess=prepared.solve())), 1.0)
    assert done.stdout.splitlines()[0] == "time,größe,u"


def test_functions_without_c_code_are_refused(tmp_path: Path) -> None:
    prepared: Any = prepare(van_der_pol(), MultipleShooting(2, "cvodes"))
    with pytest.raises(ProblemError, match="has no C"):
        prepared.to_c(tmp_path / "none")
    assert not (tmp_path / "none").exists()


@pytest.mark.parametrize(
    ("options", "match"),
    [
        ({"folder": 3}, "path"),
        ({"parameters": 3}, "parameters"),
        ({"parameters": {"no": 1.0}}, "no"),
        ({"guess": {"no": 1.0}}, "no"),
        ({"guess": 3}, "guess"),
    ],
)
def test_bad_input_is_refused(options: dict[str, Any], match: str, tmp_path: Path) -> None:
    prepared: Any = prepare(van_der_pol(), Collocation(2))
    with pytest.raises(ProblemError, match=match):
        prepared.to_c(**{"folder": tmp_path / "bad", **options})
    assert not (tmp_path / "bad").exists()


def test_a_plan_is_written_over_an_older_one(tmp_path: Path) -> None:
    problem, x, u = plant("later", initial=0.0, terminal=2.0, u={})
    problem.dynamics(x, u)
    problem.minimize(running=u**2)
    for how, cost in ((Collocation(2), 4.0), (MultipleShooting(3), 4.0)):
        prepared: Any = prepare(problem, how)
        done = run(compiled_controller(prepared.to_c(tmp_path, guess=prepared.solve())), 1.0)
        assert float(done.stderr.split()[1].rstrip(",")) == pytest.approx(cost)
