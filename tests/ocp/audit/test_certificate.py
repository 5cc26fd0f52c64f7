"""Certificates: solutions of one problem that agree, that differ, and that cannot be compared."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ocp import (
    Certificate,
    Collocation,
    Indirect,
    MultipleShooting,
    Problem,
    ProblemError,
    Solution,
    certificate,
    solve,
)
from ocp.curves import PiecewisePolynomial
from ocp.errors import SolverStatus
from scripts.papers.free_floating.formulations import null_space_problem
from scripts.papers.free_floating.formulations import problem as paper_problem
from tests.ocp.indirect.extremals import EXTREMA
from tests.ocp.problems import energy, plant, van_der_pol

pytestmark = pytest.mark.xdist_group("certificates")  # one process, so that every plan is solved once

NAMES: dict[str, Any] = {
    "Collocation": Collocation(50, 3, "legendre"),
    "MultipleShooting": MultipleShooting(100, control="linear"),
    "Indirect": Indirect(),
}


@cache
def three() -> tuple[Problem, dict[str, Solution]]:
    problem = van_der_pol()
    return problem, {name: solve(problem, method) for name, method in NAMES.items()}


def moved(solution: Solution, which: str, change: float) -> Solution:
    """A solution whose states, costates or controls are bent in the middle by a share of their own size."""
    pool = {"state": "states", "costate": "costates", "control": "controls"}[which]
    old: PiecewisePolynomial = getattr(solution, f"{which}_interpolant")
    size = change * float(np.max(np.abs(old.values)))
    places = (old.breaks[:-1, None] + np.diff(old.breaks)[:, None] * old.nodes)[..., None]
    curve = replace(old, values=old.values + size * np.sin(np.pi * places))
    bump = size * np.sin(np.pi * solution.t / solution.horizon)[:, None]
    named = {name: values + bump for name, values in getattr(solution, pool).items()}
    return changed(solution, {pool: named, f"{which}_interpolant": curve})


def changed(solution: Solution, fields: dict[str, Any]) -> Solution:
    return replace(solution, **fields)


def row(result: Certificate, name: str) -> Any:
    return next(c for c in result.comparisons if c.name == name)


# ---- agreement ---------------------------------------------------------------------------------------------------


def test_three_methods_agree_and_the_indirect_one_is_the_reference() -> None:
    problem, solutions = three()
    result = certificate(problem, solutions)
    assert result.passed
    assert result.reference == "Indirect"
    assert [c.name for c in result.comparisons] == ["Indirect", "Collocation", "MultipleShooting"]
    assert row(result, "Indirect").worst == 0
    assert row(result, "Collocation").worst < 1e-5
    assert 0 < row(result, "MultipleShooting").worst < result.tolerance
    assert set(result.audits) == set(solutions)
    assert all(audit.passed for audit in result.audits.values())
    assert "3 solutions agree to 0.001" in result.verdict


def test_the_paper_example_is_certified_by_three_methods() -> None:
    problem = null_space_problem()
    direct = solve(problem, Collocation(100, 3, "legendre"))
    shot = solve(problem, MultipleShooting(100, control="linear"), guess=direct)
    indirect = solve(problem, Indirect(shooting="backward"), guess=direct)
    result = certificate(problem, [direct, shot, indirect])
    assert result.passed, str(result)
    assert result.reference == "Indirect backward, 20"
    by_collocation = row(result, "Collocation legendre-3, 100")
    assert by_collocation.costate < 1e-5
    assert by_collocation.cost_difference < 1e-9


@pytest.mark.parametrize("name", ["everything", "free horizon", "mixed", "bang-bang", "bounded task", "tabulated"])
def test_every_shape_of_problem_is_certified(name: str) -> None:
    case = EXTREMA[name]
    problem = case.build()
    plans = [solve(problem, by, parameters=case.parameters) for by in (case.direct, Indirect())]
    result = certificate(problem, plans, tolerance=2e-2 if case.switches else 1e-3)
    assert result.passed, str(result)


def test_differences_are_relative_and_measured() -> None:
    """Energy scaled: the same relative differences whatever the unit of the cost."""
    rows = []
    for weight in (1.0, 1e6):
        problem, x, u = plant("weighted", initial=1.0)
        problem.dynamics(x, u - x**3)
        problem.minimize(running=weight * (x**2 + u**2))
        result = certificate(
            problem, {"coarse": solve(problem, MultipleShooting(10)), "exact": solve(problem, Indirect())}
        )
        rows.append(row(result, "coarse"))
    for what in ("cost_difference", "state", "control", "costate", "hamiltonian"):
        assert getattr(rows[0], what) == pytest.approx(getattr(rows[1], what), rel=1e-3)
        assert getattr(rows[0], what) > 0


def test_a_hamiltonian_and_a_cost_that_vanish_are_compared_by_their_parts() -> None:
    """A cost that an offset brings to zero, and H = 0 of a free horizon (in the test above)."""
    problem, x, u = plant("vanishing", initial=1.0)
    problem.dynamics(x, -x + u)
    problem.minimize(running=x + u**2 / 2 - offset())
    plans = {"indirect": solve(problem, Indirect()), "direct": solve(problem, Collocation(20))}
    assert abs(plans["indirect"].cost) < 1e-9
    result = certificate(problem, plans)
    assert result.passed, str(result)
    assert row(result, "direct").cost_difference < 1e-8


def offset() -> float:
    """Optimal cost of min int x + u^2/2, x' = u - x, x(0) = 1, over 1 s: u = e^(t-1) - 1 (minimum principle)."""
    nodes, weights = np.polynomial.legendre.leggauss(30)
    t, w = (1 + nodes) / 2, weights / 2
    lam = 1 - np.exp(t - 1)
    return float(1 - np.exp(-1.0) - w @ lam**2 / 2)  # lambda(0) x(0) - int lambda^2/2: the cost is linear in x


def test_without_an_indirect_solution_the_first_is_the_reference() -> None:
    problem, solutions = three()
    result = certificate(problem, [solutions["MultipleShooting"], solutions["Collocation"]])
    assert result.reference == "MultipleShooting rk4 linear, 100"
    assert result.passed


def test_solutions_of_one_method_are_numbered() -> None:
    problem, solutions = three()
    result = certificate(problem, [solutions["Collocation"]] * 3)
    names = [c.name for c in result.comparisons]
    assert names == ["Collocation legendre-3, 50", "Collocation legendre-3, 50 (2)", "Collocation legendre-3, 50 (3)"]


def test_loaded_solutions_are_certified_too(tmp_path: Path) -> None:
    problem, solutions = three()
    loaded = {}
    for name, solution in solutions.items():
        solution.save(tmp_path / f"{name}.npz")
        loaded[name] = Solution.load(tmp_path / f"{name}.npz")
    again = certificate(problem, loaded)
    assert again.passed
    assert str(again) == str(certificate(problem, solutions))


# ---- disagreement ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("which", ["state", "costate", "control"])
def test_a_perturbed_solution_is_detected(which: str) -> None:
    problem, solutions = three()
    perturbed = {**solutions, "bent": moved(solutions["Collocation"], which, 0.01)}
    result = certificate(problem, perturbed)
    assert not result.passed
    assert getattr(row(result, "bent"), which) == pytest.approx(0.01, rel=0.5)
    assert "bent differ from Indirect by more than 0.001" in result.verdict
    assert row(result, "Collocation").worst < 1e-3


def test_a_changed_cost_or_horizon_is_detected() -> None:
    problem, solutions = three()
    for change in (
        {"cost": solutions["Collocation"].cost * 1.01},
        {"horizon": solutions["Collocation"].horizon * 1.01},
    ):
        result = certificate(problem, {**solutions, "changed": changed(solutions["Collocation"], change)})
        assert not result.passed
        assert not row(result, "changed").passed or "changed differ" in result.verdict


def test_a_reference_that_is_wrong_fails_all_the_same() -> None:
    problem, solutions = three()
    result = certificate(problem, {**solutions, "Indirect": moved(solutions["Indirect"], "costate", 0.05)})
    assert not result.passed
    assert "the audit of Indirect failed" in result.verdict
    assert "Collocation, MultipleShooting differ" in result.verdict


@pytest.mark.long
def test_an_extremal_of_another_branch_is_detected_though_it_passes_its_audit() -> None:
    """J = 1.7351 and J = 1.7467 both satisfy the minimum principle of the paper's example."""
    problem = paper_problem()
    best = solve(problem, Indirect(shooting="backward"))
    other = solve(paper_problem(guess_damping=0.03), Collocation(100))
    assert best.cost == pytest.approx(1.735114311245, abs=1e-9)
    assert other.cost > best.cost + 0.01
    result = certificate(problem, {"best": best, "other": other})
    assert result.audits["other"].passed
    assert not result.passed
    assert row(result, "other").cost_difference == pytest.approx(other.cost / best.cost - 1, rel=1e-4)
    assert "other differ from best" in result.verdict


def test_solutions_that_agree_on_a_failed_audit_are_not_certified() -> None:
    problem, solutions = three()
    wrong = replace(solutions["Collocation"], success=False, status=SolverStatus.ITERATION_LIMIT)
    result = certificate(problem, {"Indirect": solutions["Indirect"], "wrong": wrong})
    assert row(result, "wrong").worst < 1e-3
    assert not row(result, "wrong").passed
    assert not result.passed
    assert result.verdict == "the audit of wrong failed"


def test_numbers_that_are_none_do_not_pass() -> None:
    problem, solutions = three()
    for change in ({"cost": np.nan}, {"cost": np.inf}):
        result = certificate(problem, {**solutions, "broken": changed(solutions["Collocation"], change)})
        assert not result.passed
    result = certificate(problem, {**solutions, "broken": moved(solutions["Collocation"], "costate", np.nan)})
    assert not result.passed
    assert "broken" in result.verdict


def test_the_tolerance_decides() -> None:
    problem, solutions = three()
    assert not certificate(problem, solutions, tolerance=1e-9).passed
    assert certificate(problem, solutions, tolerance=1e-2).passed


# ---- what cannot be compared -------------------------------------------------------------------------------------


@pytest.mark.parametrize("count", [0, 1])
def test_one_solution_is_no_certificate(count: int) -> None:
    problem, solutions = three()
    with pytest.raises(ProblemError, match=f"at least two solutions, not {count}"):
        certificate(problem, list(solutions.values())[:count])


def test_a_solution_of_another_problem_is_refused() -> None:
    problem, solutions = three()
    with pytest.raises(ProblemError, match=r"plan 'energy' has states .* problem 'van der Pol' has"):
        certificate(problem, [solutions["Indirect"], solve(energy(), Collocation(5))])


def test_solutions_at_other_parameters_are_refused() -> None:
    case = EXTREMA["fixed horizon"]
    plans = [solve(case.build(), Collocation(10), parameters={"h": h, "x0": 0.4}) for h in (1.7, 1.8)]
    with pytest.raises(ProblemError, match="were solved at different parameters"):
        certificate(case.build(), plans)


# ---- the table ---------------------------------------------------------------------------------------------------


def test_the_table_has_a_line_for_every_solution_and_the_verdict() -> None:
    problem, solutions = three()
    result = certificate(problem, {**solutions, "bent": moved(solutions["Collocation"], "costate", 0.02)})
    lines = str(result).splitlines()
    assert lines[0] == "Certificate of 'van der Pol': FAILED"
    for head in ("cost", "d state", "d costate", "d H", "audit"):
        assert head in lines[1]
    assert [line.split()[0] for line in lines[2:-1]] == ["Indirect", "Collocation", "MultipleShooting", "bent"]
    assert all(f"{solutions['Indirect'].cost:.6g}"[:6] in line for line in lines[2:5])
    assert lines[2].endswith("passed")
    assert lines[5].endswith("FAILED")
    assert result.verdict in lines[-1]
    assert len({len(line) for line in lines[2:-1]}) == 1  # columns line up
    assert str(certificate(problem, solutions)).splitlines()[0].endswith("passed")
