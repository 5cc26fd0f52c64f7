"""What makes the free-floating plan an optimum, and what other extremals there are: laws and known numbers."""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np
import pytest

from models import paper_example
from scripts import free_floating
from scripts.papers.free_floating.extremals import CONFIRMED, NOT_GLOBAL
from scripts.papers.free_floating.false_optima import first_guess
from scripts.papers.free_floating.formulations import ROWS, START_JOINTS, TIP_VELOCITY
from scripts.papers.free_floating.optimality import costate_difference, costates, hamiltonians
from scripts.papers.free_floating.results import PAPER_PEAKS, START, START_BASE, Results
from tests.scripts.papers.script_run import Run, column
from tests.scripts.papers.test_free_floating import HORIZONS, REFERENCE, SAMPLE, STARTS

__all__ = ["SAMPLE"]  # read by the fixture that runs the script

PAPER = free_floating.PAPER
pytestmark = [pytest.mark.xdist_group("free_floating"), pytest.mark.long]  # one process, so that the script runs once

KNOWN = {3.5: (1.23315, 1.32544), 4.0: (1.36393, 1.49337), 5.0: (REFERENCE, 1.7467)}
"""J of extremals at other horizons, by an implementation of its own."""
INDIRECT = ("multiple", "backward")


def indirect(run: Run[Results], shooting: str) -> dict[str, Any]:
    result: dict[str, Any] = run.summary["optimal"]["indirect"]
    return result if shooting == "multiple" else result["backward"]


# ---- the minimum principle


@pytest.mark.parametrize("shooting", INDIRECT)
def test_minimum_principle_gives_the_known_cost_in_a_few_newton_steps(run: Run[Results], shooting: str) -> None:
    result = indirect(run, shooting)
    assert result["shooting"] == shooting
    assert result["cost"] == pytest.approx(REFERENCE, abs=1e-9)
    assert 1 <= result["newton_steps"] <= 5


@pytest.mark.parametrize("shooting", INDIRECT)
def test_hamiltonian_is_constant_along_the_minimum_principle(run: Run[Results], shooting: str) -> None:
    assert indirect(run, shooting)["hamiltonian_drift"] < 1e-9


@pytest.mark.parametrize("shooting", INDIRECT)
def test_costates_vanish_at_the_free_end_and_the_start_is_met(run: Run[Results], shooting: str) -> None:
    assert indirect(run, shooting)["costate_at_end"] < 1e-9
    assert indirect(run, shooting)["start_error"] < 1e-9


@pytest.mark.parametrize("shooting", INDIRECT)
def test_costates_of_direct_and_indirect_agree(run: Run[Results], shooting: str) -> None:
    result = run.results.agreement
    difference = costate_difference(result.plan, result.multiple if shooting == "multiple" else result.backward)
    assert difference.shape == (len(result.plan.t), 6)
    assert np.abs(difference).max() < 1e-5
    report = indirect(run, shooting)["costate_difference_from_direct"]
    assert report == pytest.approx(np.abs(difference).max(), rel=1e-9)
    assert report > 1e-12  # they are two solutions, not one


def test_costates_are_the_same_in_both_formulations(run: Run[Results]) -> None:
    result = run.results.agreement
    fractions = np.linspace(0.0, 1.0, 51)
    reference = costates(result.multiple, fractions)
    for name, solution in result.null_space.items():
        if name.startswith("minimum principle"):
            assert costates(solution, fractions) == pytest.approx(reference, abs=1e-9 * np.abs(reference).max())


def test_costates_of_the_base_position_vanish_for_the_cost_does_not_depend_on_the_place(run: Run[Results]) -> None:
    result = run.results.agreement
    for solution in (result.plan, result.multiple, result.backward, result.shooting):
        assert np.abs(solution.costate("base")[:, :2]).max() < 1e-9
        assert np.abs(solution.costate("base")[:, 2]).max() > 3.0


def test_control_of_the_minimum_principle_is_the_projection_of_its_costates(run: Run[Results]) -> None:
    """Equation (31), u = E2' E1^-T lambda1 - lambda2, and the motion (26): x2' = (1 - G#G) u + G# v, at every time."""
    machine = paper_example()
    b, q, r = (ca.SX.sym(name, 3) for name in "bqr")
    rate = ca.Function("rate", [b, q], [ca.jacobian(machine.base_rate(b, q, r), r)])
    tip = ca.Function("tip", [b, q], [machine.tip_jacobian(b, q)])
    solution = run.results.agreement.multiple
    lam = costates(solution)
    for k in range(0, len(solution.t), 9):
        base, joints = solution["base"][k], solution["joints"][k]
        jacobian = np.array(tip(base, joints))[list(ROWS)]
        free = -np.array(rate(base, joints)).T @ lam[k, :3] - lam[k, 3:]  # base_rate = -E1^-1 E2 x2'
        inverse = np.linalg.pinv(jacobian)
        expected = free - inverse @ (jacobian @ free) + inverse @ TIP_VELOCITY
        assert solution["rates"][k] == pytest.approx(expected, abs=1e-9)


def test_hamiltonian_is_half_the_squared_joint_rates_at_the_end(run: Run[Results]) -> None:
    """At the free end lambda = 0, so that H = L = 1/2 |x2'|^2 of the least joint rates."""
    solution = run.results.agreement.multiple
    mean = run.summary["optimal"]["indirect"]["hamiltonian"]
    assert mean == pytest.approx(0.5 * float(np.sum(solution["rates"][-1] ** 2)), abs=1e-9)


def test_hamiltonian_of_every_method_has_the_same_mean(run: Run[Results]) -> None:
    curves = hamiltonians(run.results.agreement)
    assert len(curves) == 7
    expected = run.summary["optimal"]["indirect"]["hamiltonian"]
    for name, (t, value) in curves.items():
        assert t.shape == value.shape
        assert value.mean() == pytest.approx(expected, rel=1e-5), name


# ---- the certificates


def test_all_methods_of_a_formulation_agree_and_pass_their_audits(run: Run[Results]) -> None:
    assert run.summary["optimal"]["certified"] == {"rates": True, "null space": True}
    rows = run.table("certificate.csv")
    assert [row["formulation"] for row in rows] == ["rates"] * 4 + ["null space"] * 3
    assert {(row["audit"], row["agrees"]) for row in rows} == {("yes", "yes")}
    assert np.abs(column(rows, "cost") - REFERENCE).max() < 1e-6
    for quantity in ("cost", "state", "control", "costate", "hamiltonian"):
        assert column(rows, f"{quantity}_difference").max() < 1e-4


def test_certificates_are_printed_and_written(run: Run[Results]) -> None:
    text = (run.folder / "certificate.txt").read_text(encoding="utf-8")
    assert text.strip() in run.printed
    for name in ("tool motion", "minimum velocity, null space"):
        assert f"Certificate of '{name}': passed" in text
    for row in run.table("certificate.csv"):
        assert row["solution"] in text


# ---- extremals at other horizons


@pytest.mark.parametrize(("horizon", "cost"), [(h, cost) for h, costs in KNOWN.items() for cost in costs])
def test_known_extremals_are_found(run: Run[Results], horizon: float, cost: float) -> None:
    rows = [row for row in run.table("extremals.csv") if float(row["horizon_s"]) == horizon]
    result = column(rows, "cost_indirect", verdict=CONFIRMED)
    assert np.abs(result - cost).min() < 2e-5


def test_direct_and_indirect_cost_of_every_confirmed_extremal_agree(run: Run[Results]) -> None:
    rows = [row for row in run.table("extremals.csv") if row["verdict"] == CONFIRMED]
    assert {float(row["horizon_s"]) for row in rows} == set(HORIZONS)
    assert column(rows, "cost_direct") == pytest.approx(column(rows, "cost_indirect"), rel=1e-5)


def test_best_is_the_confirmed_extremal_of_least_cost_at_each_horizon(run: Run[Results]) -> None:
    rows = run.table("extremals.csv")
    for report in run.summary["extremals"]["by_horizon"]:
        mine = [row for row in rows if float(row["horizon_s"]) == report["horizon_s"]]
        best = [row for row in mine if row["best"] == "yes"]
        assert len(best) == 1
        costs = column(mine, "cost_indirect", verdict=CONFIRMED)
        assert float(best[0]["cost_indirect"]) == costs.min()
        assert report["best_cost"] == pytest.approx(costs.min(), rel=1e-11)
        assert report["costs"] == pytest.approx(sorted(costs), rel=1e-11)
        assert f"best J = {report['best_cost']:.9f}" in run.printed


def test_every_start_is_accounted_for(run: Run[Results]) -> None:
    for one in run.results.searches:
        assert one.starts == STARTS
        assert one.rejected + sum(extremal.guess_count for extremal in one.extremals) == one.solved <= one.starts


def test_extremals_of_one_horizon_are_different_motions(run: Run[Results]) -> None:
    for one in run.results.searches:
        curves = [extremal.joint_rates for extremal in one.extremals]
        for i, first in enumerate(curves):
            for second in curves[i + 1 :]:
                assert np.abs(first - second).max() > 1e-2


def test_cost_of_every_extremal_is_the_integral_of_its_joint_rates(run: Run[Results]) -> None:
    for one in run.results.searches:
        for extremal in one.extremals:
            energy = 0.5 * np.sum(extremal.joint_rates**2, axis=1)
            assert np.trapezoid(energy, extremal.t) == pytest.approx(extremal.cost, rel=1e-3)


def test_no_extremal_has_the_peaks_of_the_paper_and_none_is_called_global(run: Run[Results]) -> None:
    rows = run.table("extremals.csv")
    peaks = np.column_stack([column(rows, f"joint{i}_peak_deg_s") for i in (1, 2, 3)])
    differences = np.abs(peaks - PAPER_PEAKS["optimum"]).max(axis=1)
    assert column(rows, "largest_difference_from_paper_deg_s") == pytest.approx(differences, abs=1e-6)
    assert differences.min() > 20
    report = run.summary["extremals"]["nearest_to_paper"]["largest_difference_deg_s"]
    assert report == pytest.approx(differences.min(), abs=1e-6)
    assert NOT_GLOBAL in run.printed
    assert "None has the peaks of the paper's optimum" in run.printed
    assert "global" not in run.printed.lower()


def test_random_guesses_are_seeded_and_spread_about_the_start() -> None:
    wide, again = (first_guess("smooth", 3, START_BASE, START_JOINTS, 6.0) for _ in range(2))
    narrow = first_guess("smooth", 3, START_BASE, START_JOINTS, 6.0, 0.5)
    other = first_guess("smooth", 4, START_BASE, START_JOINTS, 6.0)
    assert wide["t"][[0, -1]].tolist() == [0.0, 6.0]
    for name, middle in (("base", START[:3]), ("joints", START[3:]), ("rates", np.zeros(3))):
        assert (wide[name] == again[name]).all()
        assert (wide[name] != other[name]).all()
        assert narrow[name] - middle == pytest.approx(0.5 * (wide[name] - middle), abs=1e-12)
