"""The public suites are complete, and their problems have the costs of the table that the page shows."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from ocp import Solution, solve

from .__main__ import COLUMNS, PSOPT_SECONDS, rows_of
from .entry import COPS, PSOPT, TOOLBOX
from .library import EXCLUDED, SAME, entries
from .page import PAGE, table
from .run import digits, last_digit, reached, verdict, without_guess

ROOT = Path(__file__).resolve().parents[3]
ROWS = rows_of(ROOT / "results" / "suite")
ENTRIES = entries()
SETTLED = [name for name, row in ROWS.items() if row["verdict"] in ("agrees", "below", "above", "confirmed")]
"""Problems whose cost two methods confirm."""
KNOWN = {
    PSOPT: "alpine bioreactor brac1 breakwell bryson_denham bryson_max_range catmix chain chance_constraint "
    "chance_covariance climb conic_sdp conic_soc control_rate coulomb cracking dae_i3 delay1 delay_history dqc "
    "f8 fuller geodesic glider goddard heat hypersensitive int_static_linear interior_point isoperimetric "
    "lambert launch lotka lotka2 low_thrust lqr_gauss lqr_radau lts manutec mineng_di mineng_free_vf "
    "mineng_target_set missile mpec notorious obstacle path_window rayleigh reorientation shuttle_reentry "
    "singular5 singular_di stc1 steps twoburn twolinkarm twophase_robot twophase_schwartz zpm",
    TOOLBOX: "balanced_field beam bioreactor_1day bryson_denham cannonball cart_pendulum chain "
    "dielectrophoretic_particle double_oscillator ducted_fan electric_vehicle glider_cops insurance jackson "
    "moonlander mountain_car quadrotor robbins robertson robot rocket space_shuttle ssto_earth steering "
    "truck_trailer vanderpol water_rocket",
    COPS: "catmix chain gasoil glider_cops marine methanol pinene robot rocket steering",
}
"""The problems of the suites, but for those kept for verification."""
FAST = [
    "bryson_max_range", "chain", "chance_constraint", "conic_sdp", "f8", "geodesic", "interior_point",
    "lqr_gauss", "lts", "manutec", "mineng_target_set", "robot", "singular_di", "vanderpol",
]  # fmt: skip
"""Of every kind one: limits of states and controls, phases, integrals, equations, free times, switches."""
COARSE = 1e-3
"""Relative deviation of the cost on the first mesh from that of the refined one."""


@pytest.mark.parametrize("suite", KNOWN)
def test_every_problem_of_a_suite_is_stated_or_excluded_with_a_reason(suite: str) -> None:
    for name in KNOWN[suite].split():
        entry = ENTRIES.get(SAME.get(name, name))
        assert (entry is not None and suite in entry.suites) or EXCLUDED.get(name), name


def test_no_problem_is_both_stated_and_excluded() -> None:
    assert not set(EXCLUDED) & set(ENTRIES)
    assert set(PSOPT_SECONDS) <= set(ENTRIES)


@pytest.mark.parametrize(
    "name",
    [pytest.param(name, marks=() if name in FAST else pytest.mark.long) for name in ROWS if ROWS[name]["first_cost"]],
)
def test_the_first_mesh_has_the_cost_of_the_table(name: str) -> None:
    """Also that of the closed form, to what this mesh is entitled."""
    entry = ENTRIES[name]
    plan = solve(entry.build(), entry.method)
    assert isinstance(plan, Solution)
    assert plan.cost == pytest.approx(float(ROWS[name]["first_cost"]), rel=1e-6, abs=1e-9)
    if entry.exact is not None and name in FAST:
        assert plan.cost == pytest.approx(entry.exact, rel=COARSE, abs=1e-9)


@pytest.mark.parametrize("name", [name for name in ROWS if ROWS[name]["exact"] and ROWS[name]["cost"]])
def test_the_cost_of_the_table_is_that_of_the_closed_form(name: str) -> None:
    exact = ENTRIES[name].exact
    assert exact is not None
    assert float(ROWS[name]["cost"]) == pytest.approx(exact, rel=1e-4, abs=1e-9)


def test_the_table_has_stated_problems_and_every_column() -> None:
    assert set(ROWS) <= set(ENTRIES)
    assert tuple(next(iter(ROWS.values()))) == COLUMNS


def test_two_methods_confirm_nineteen_of_twenty_problems() -> None:
    assert len(SETTLED) >= 0.95 * len(ENTRIES)


def test_no_cost_contradicts_a_second_method() -> None:
    for name in SETTLED:
        assert float(ROWS[name]["digits"]) >= 3, name


def test_the_page_shows_the_table() -> None:
    text = PAGE.read_text(encoding="utf-8")
    assert table(ROWS) in text
    for name, reason in EXCLUDED.items():
        assert name in text
        assert reason in text


def test_the_readme_states_the_counts() -> None:
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    match = re.search(r"(\d+) problems of three public suites\]\(docs/suite.md\) are stated, (\d+) of them", text)
    assert match is not None
    assert [int(number) for number in match.groups()] == [len(ENTRIES), len(SETTLED)]


def test_the_page_counts_the_problems_that_are_solved_without_a_method() -> None:
    solved = [row for row in ROWS.values() if row["automatic"] == "True"]
    for row in solved:
        assert float(row["automatic_seconds"]) < 61
        assert reached(float(row["automatic_cost"]), float(row["cost"])), row["name"]
    unguessed = sum(row["automatic_start"] == "no guess" for row in solved)
    assert unguessed >= 0.85 * len(ENTRIES)
    match = re.search(
        r"solves (\d+) of the (\d+) problems without a guess, (\d+) more", PAGE.read_text(encoding="utf-8")
    )
    assert match is not None
    assert [int(number) for number in match.groups()] == [unguessed, len(ENTRIES), len(solved) - unguessed]


def test_a_problem_without_guess_starts_from_straight_lines() -> None:
    problem = without_guess(ENTRIES["brac1"].build())
    assert all(variable.guess is None for variable in problem.declared.states.values())
    assert problem.declared.horizon is not None
    assert problem.declared.horizon.guess is None


def test_digits_and_verdicts() -> None:
    assert digits(1.0, 1.001) == pytest.approx(3.0, abs=0.01)
    assert digits(0.0, 0.0) == 15.0
    assert last_digit(1.492) == pytest.approx(1e-3)
    assert last_digit(4.372837e-05) == pytest.approx(1e-11)
    assert last_digit("6.680107e6") == pytest.approx(1.0)
    assert last_digit("1.23e3") == pytest.approx(10.0)
    assert verdict(1.0, 1.0, 1.0) == "agrees"
    assert verdict(0.99, "1.0000", 0.9901) == "below"
    assert verdict(1.01, "1.0000", 1.0101) == "above"
    assert verdict(1.01, "1.0000", 1.005) == "open"
    assert verdict(1.01, "1.0", 1.005) == "agrees"
    assert verdict(1.0, None, 1.00001) == "confirmed"
