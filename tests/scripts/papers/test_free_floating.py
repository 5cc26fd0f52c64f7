"""The free-floating paper's script: its numbers against published and independently found ones, and its files."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest
from PIL import Image

from models import FreeFloating, paper_example
from ocp import Collocation, TipTask, resolve, solve
from ocp.motion.local.rates import LocalSolution
from scripts import free_floating
from scripts.papers.free_floating import extremals, false_optima
from scripts.papers.free_floating import results as free_floating_results
from scripts.papers.free_floating.extremals import DAMPINGS, SPREADS
from scripts.papers.free_floating.false_optima import FALSE, Trial
from scripts.papers.free_floating.formulations import ROWS, START_JOINTS, TIP_VELOCITY, problem
from scripts.papers.free_floating.motion import laws, momentum, motion_of_local, total_center_of_mass
from scripts.papers.free_floating.results import Results
from tests.scripts.papers.script_run import Run, Summary, assert_committed_numbers, assert_whole_picture, column

PAPER = free_floating.PAPER
pytestmark = [pytest.mark.xdist_group("free_floating"), pytest.mark.long]  # one process, so that the script runs once
GUESSES = ("constant", *["smooth"] * 4, *["rough"] * 4)
HORIZONS = (3.5, 4.0, 5.0)  # s
SEEDS = range(1)
STARTS = len(DAMPINGS) + 1 + len(SPREADS) * len(SEEDS)
SAMPLE = {
    (false_optima, "GUESSES"): GUESSES,
    (extremals, "HORIZONS"): HORIZONS,
    (extremals, "SEEDS"): SEEDS,
    (extremals, "STARTS"): STARTS,
}

REFERENCE = 1.735114311245
"""J at 5 s: backward shooting of the minimum principle and Legendre-3 collocation, in an implementation of its own."""
EXTREMALS = (1.36393, 1.49337)
"""J of the two extremals that are known at 4 s, by an implementation of its own."""
TABLE_1 = (157.8240, 69.7189, -113.5345, 70.4688, -22.0748, -98.1823)
TABLE_2 = (-154757.4, -14153.14, 148085.1, -811.6214, 136.2558, -296.0277)
PICTURES = (
    "fig03_08_motion.png",
    "fig04_09_base_pose.png",
    "fig05_10_joint_angles.png",
    "fig06_11_base_velocity.png",
    "fig07_12_joint_velocity.png",
    "fig13_manipulability.png",
    "optimal_motion.png",
    "convergence.png",
    "false_optima.png",
    "costates.png",
    "hamiltonian.png",
    "extremals.png",
)
TABLES = (
    "table1_peak_velocity.csv",
    "table2_acceleration.csv",
    "sensitivity.csv",
    "convergence.csv",
    "false_optima.csv",
    "certificate.csv",
    "extremals.csv",
)


@pytest.fixture(scope="module")
def machine() -> FreeFloating:
    return paper_example()


# ---- the pseudo-inverse


def test_pseudo_inverse_peaks_are_the_converged_ones(run: Run[Results]) -> None:
    peaks = run.summary["pseudo_inverse"]["peak_joint_velocity_deg_s"]
    assert peaks == pytest.approx([153.73, 66.97, -109.08], abs=0.05)
    assert run.summary["pseudo_inverse"]["peak_time_s"] == pytest.approx([3.044, 2.996, 3.043], abs=1e-3)


def test_pseudo_inverse_passes_nearest_to_the_singularity_at_three_seconds(run: Run[Results]) -> None:
    assert run.summary["pseudo_inverse"]["min_manipulability"] == pytest.approx(0.476, abs=5e-4)
    assert run.summary["pseudo_inverse"]["min_manipulability_time_s"] == pytest.approx(3.045, abs=1e-3)


def test_pseudo_inverse_motion_does_the_task_with_the_least_joint_rates(
    run: Run[Results], machine: FreeFloating
) -> None:
    motion = run.results.local
    jacobian = ca.Function("G", [b := ca.SX.sym("b", 3), q := ca.SX.sym("q", 3)], [machine.tip_jacobian(b, q)])
    for k in range(0, len(motion.t), 500):
        rows = np.array(jacobian(motion.base[k], motion.joints[k]))[list(ROWS)]
        assert motion.joint_rates[k] == pytest.approx(np.linalg.pinv(rows) @ TIP_VELOCITY, abs=1e-9)


def test_accelerations_of_both_motions_are_the_slopes_of_their_velocities(run: Run[Results]) -> None:
    rates = run.results.agreement.backward.at(run.results.optimal.t)["rates"]
    for motion, velocities in ((run.results.local, run.results.local.joint_rates), (run.results.optimal, rates)):
        slope = np.gradient(velocities, motion.t, axis=0)[1:-1]  # its own error: 1e-3 where the curve is sharpest
        size = np.abs(motion.joint_accelerations).max()
        assert np.abs(slope - motion.joint_accelerations[1:-1]).max() < 2e-3 * size
    assert np.abs(rates - run.results.optimal.joint_rates).max() < 1e-4


def test_acceleration_vanishes_at_a_peak_inside_the_motion(run: Run[Results]) -> None:
    motion = run.results.near_peaks
    largest = np.abs(motion.joint_accelerations).max(axis=0)
    assert (np.abs(motion.accelerations_at_peaks()) < 1e-3 * largest).all()
    assert np.degrees(largest) == pytest.approx([1592, 3764, 1565], rel=5e-3)  # by finite differences of a simulation


def test_a_thousandth_of_a_link_explains_the_first_peak_and_is_not_used(run: Run[Results]) -> None:
    rows = run.table("sensitivity.csv")
    identified, fitted, paper = rows[1], rows[-2], rows[-1]
    assert float(identified["link_length_m"]) == 2.0
    assert float(fitted["link_length_m"]) == pytest.approx(2.0, rel=2e-3)
    assert float(fitted["joint1_deg_s"]) == pytest.approx(float(paper["joint1_deg_s"]), abs=0.01)
    assert abs(float(fitted["joint2_deg_s"]) - float(paper["joint2_deg_s"])) > 0.5
    ours = column(run.table("table1_peak_velocity.csv"), "ours_deg_s", method="pseudo-inverse")
    assert ours[0] == pytest.approx(float(identified["joint1_deg_s"]), abs=0.05)


# ---- the optimum


def test_every_method_finds_the_same_optimum(run: Run[Results]) -> None:
    optimal = run.summary["optimal"]
    assert optimal["horizon_s"] == 5.0
    assert optimal["indirect"]["backward"]["cost"] == pytest.approx(REFERENCE, abs=5e-12)
    assert optimal["collocation"]["intervals"] == 100
    assert optimal["collocation"]["cost"] == pytest.approx(REFERENCE, abs=1e-10)
    assert optimal["multiple_shooting"]["intervals"] == 100
    assert optimal["multiple_shooting"]["cost"] == pytest.approx(REFERENCE, abs=1e-6)


@pytest.mark.parametrize(
    ("method", "intervals", "error"),
    [
        ("Radau 3", 50, 1e-7),
        ("Radau 3", 100, 5e-9),
        ("Radau 3", 200, 1e-10),
        ("Legendre 3", 25, 2e-7),
        ("Legendre 3", 50, 1e-8),
        ("Legendre 3", 200, 5e-12),
        ("multiple shooting RK4, held control", 100, 5e-5),
        ("multiple shooting RK4, linear control", 50, 5e-6),
        ("multiple shooting RK4, linear control", 100, 1e-6),
        ("multiple shooting RK4, linear control", 200, 2e-8),
        ("minimum principle, forward multiple shooting", 20, 5e-12),
    ],
)
def test_cost_of_each_method_and_mesh(run: Run[Results], method: str, intervals: int, error: float) -> None:
    result = column(run.table("convergence.csv"), "cost", method=method, intervals=str(intervals))
    assert result.shape == (1,)
    assert abs(result[0] - REFERENCE) < error


@pytest.mark.parametrize("method", [name for name, *_ in free_floating_results.METHODS])
def test_cost_converges_with_the_order_of_its_method(run: Run[Results], method: str) -> None:
    rows = [row for row in run.table("convergence.csv") if row["method"] == method]
    errors = {int(row["intervals"]): abs(float(row["difference"])) for row in rows}
    coarse, fine = min(errors), 2 * min(errors)
    assert np.log2(errors[coarse] / errors[fine]) == pytest.approx(float(rows[0]["order"]), abs=0.4)


def test_optimal_peaks_are_lower_and_the_singularity_is_not_passed(run: Run[Results]) -> None:
    peaks = run.summary["optimal"]["peak_joint_velocity_deg_s"]
    assert peaks == pytest.approx([46.10, 24.26, -77.95], abs=0.05)
    factors = np.abs(run.summary["pseudo_inverse"]["peak_joint_velocity_deg_s"]) / np.abs(peaks)
    assert factors == pytest.approx([3.3, 2.8, 1.4], abs=0.05)
    assert run.summary["optimal"]["min_manipulability"] > 3


def test_momentum_stays_zero_along_the_reintegrated_plan(run: Run[Results]) -> None:
    assert run.summary["optimal"]["momentum_drift"] < 1e-9
    assert run.summary["optimal"]["center_of_mass_drift_m"] < 1e-9


def test_tip_stays_on_its_line_along_the_reintegrated_plan(run: Run[Results]) -> None:
    assert run.summary["optimal"]["tip_error_m"] < 2e-7


def test_tip_stays_on_its_line_on_half_the_intervals(machine: FreeFloating) -> None:
    plan = solve(problem(), Collocation(50, scheme="legendre"))
    assert abs(plan.cost - REFERENCE) < 1e-8
    kept = laws(machine, plan.audit(), TIP_VELOCITY)
    assert kept.tip_error < 2e-6
    assert kept.momentum_drift < 1e-9


def test_plan_passes_its_audit_and_the_script_succeeds(run: Run[Results]) -> None:
    assert run.summary["optimal"]["audit_passed"] is True
    assert run.status == 0
    table = (run.folder / "audit.txt").read_text(encoding="utf-8")
    assert table.splitlines()[0] == "Audit of 'tool motion': passed"


# ---- the instruments


def test_momentum_of_the_links_is_that_of_the_momentum_matrices(machine: FreeFloating) -> None:
    rng = np.random.default_rng(1)
    base, joints, base_rates, rates = (rng.normal(size=(5, 3)) for _ in range(4))
    result = momentum(machine, base, joints, base_rates, rates)
    for k in range(5):
        twist = [base_rates[k, 2], *base_rates[k, :2]]
        expected = np.array(machine.momentum(base[k], joints[k], twist, rates[k])).ravel()
        assert result[k] == pytest.approx(expected, rel=1e-12, abs=1e-10)
    assert np.abs(result).min() > 1e-3  # of a motion that nothing conserves


def test_center_of_mass_moves_with_the_linear_momentum(machine: FreeFloating) -> None:
    rng = np.random.default_rng(2)
    base, joints, base_rates, rates = (rng.normal(size=(4, 3)) for _ in range(4))
    step = 1e-6
    ahead = total_center_of_mass(machine, base + step * base_rates, joints + step * rates)
    behind = total_center_of_mass(machine, base - step * base_rates, joints - step * rates)
    linear = momentum(machine, base, joints, base_rates, rates)[:, 1:]
    assert machine.robot.total_mass * (ahead - behind) / (2 * step) == pytest.approx(linear, rel=1e-6, abs=1e-6)


def test_motion_of_a_local_solution_keeps_its_arrays(machine: FreeFloating) -> None:
    local = resolve(machine, TipTask(rows=ROWS, velocity=TIP_VELOCITY), 1.0, start=START_JOINTS, samples=11)
    assert isinstance(local, LocalSolution)
    motion = motion_of_local(machine, local, TIP_VELOCITY, ROWS)
    assert motion.joint_accelerations.shape == (11, 3)
    line = motion.tip_in_world[0] + motion.t[:, None] * TIP_VELOCITY
    assert motion.tip_in_world == pytest.approx(line, abs=1e-8)


# ---- false optima


def test_every_guess_was_tried_once(run: Run[Results]) -> None:
    assert [trial.guess for trial in run.results.trials] == list(GUESSES)
    assert [trial.seed for trial in run.results.trials] == list(range(-1, len(GUESSES) - 1))


def test_plans_that_jump_across_the_singularity_fail_their_audit(run: Run[Results]) -> None:
    jumping = [trial for trial in run.results.trials if trial.jump_deg_s > 200]
    assert jumping, "no guess led to a false optimum: there is nothing to reject"
    assert all("Succeeded" in trial.status for trial in jumping)  # the solver is content with them
    assert not any(trial.audit for trial in jumping)


def test_plans_that_pass_are_extremals_that_keep_their_cost_on_a_finer_mesh(run: Run[Results]) -> None:
    passed = [trial for trial in run.results.trials if trial.audit]
    assert passed
    for trial in passed:
        assert trial.refined_audit
        assert trial.intervals == 100
        assert trial.refined_cost == pytest.approx(trial.cost, rel=1e-6)


def test_plans_that_fail_change_their_cost_or_pass_on_a_finer_mesh(run: Run[Results]) -> None:
    for trial in run.results.trials:
        if not trial.audit:
            kept = abs(trial.refined_cost / trial.cost - 1) < 1e-2
            assert (trial.verdict == FALSE) == (not (kept and trial.refined_audit)), describe(trial)


def test_both_known_extremals_are_reached(run: Run[Results]) -> None:
    costs = run.summary["false_optima"]["extremal_costs"]
    for known in EXTREMALS:
        assert min(abs(cost - known) for cost in costs) < 2e-5


def describe(trial: Trial) -> str:
    return f"{trial.guess} guess, seed {trial.seed}: J {trial.cost}, refined {trial.refined_cost}, {trial.verdict}"


# ---- the files


def test_paper_ours_and_difference_stand_side_by_side(run: Run[Results]) -> None:
    for name, unit, printed in (
        ("table1_peak_velocity.csv", "deg_s", TABLE_1),
        ("table2_acceleration.csv", "deg_s2", TABLE_2),
    ):
        rows = run.table(name)
        paper, ours = column(rows, f"paper_{unit}"), column(rows, f"ours_{unit}")
        assert paper == pytest.approx(printed)
        assert column(rows, f"difference_{unit}") == pytest.approx(ours - paper, abs=1e-6, rel=1e-6)
        for value in printed:
            assert f"{value:.6g}" in run.printed


def test_numbers_that_cannot_be_reproduced_are_marked(run: Run[Results]) -> None:
    for name in ("table1_peak_velocity.csv", "table2_acceleration.csv"):
        for row in run.table(name):
            if row["method"] == "optimum":
                assert "horizon is not printed" in row["note"]
    for row in run.table("table2_acceleration.csv"):
        if row["method"] == "pseudo-inverse":
            assert "not reproducible" in row["note"]
    for words in (
        "not reproducible",
        "not comparable",
        "links 2 m long",
        "(1, 0) m",
        "mid-link",
        "horizon 5 s (chosen",
    ):
        assert words in run.printed


def test_summary_agrees_with_the_tables(run: Run[Results]) -> None:
    summary = run.summary
    peaks = run.table("table1_peak_velocity.csv")
    for method, part in (("pseudo-inverse", "pseudo_inverse"), ("optimum", "optimal")):
        result = column(peaks, "ours_deg_s", method=method)
        assert result == pytest.approx(summary[part]["peak_joint_velocity_deg_s"], rel=1e-9)
    costs = run.table("convergence.csv")
    for part, method in (("collocation", "Legendre 3"), ("multiple_shooting", "multiple shooting RK4, linear control")):
        result = column(costs, "cost", method=method, intervals="100")
        assert result == pytest.approx([summary["optimal"][part]["cost"]], abs=1e-12)
    verdicts = [row["verdict"] for row in run.table("false_optima.csv")]
    assert len(verdicts) == summary["false_optima"]["guesses"]
    assert verdicts.count(FALSE) == summary["false_optima"]["false"]
    audits = [row["audit"] for row in run.table("false_optima.csv")]
    assert audits.count("yes") == summary["false_optima"]["passed"]


def test_all_files_are_there_and_nothing_else(run: Run[Results]) -> None:
    expected = {*PICTURES, *TABLES, "motion.gif", "summary.json", "audit.txt", "certificate.txt"}
    assert run.names == expected


def test_files_are_small_enough_to_be_committed(run: Run[Results]) -> None:
    sizes = {path.name: path.stat().st_size for path in run.folder.iterdir()}
    assert sizes["motion.gif"] < 1.5e6
    assert sum(sizes.values()) < 4e6


@pytest.mark.parametrize("name", PICTURES)
def test_pictures_are_drawn_to_their_edges_and_not_beyond(run: Run[Results], name: str) -> None:
    assert_whole_picture(run.folder / name)


def test_animation_shows_the_whole_motion_in_real_time(run: Run[Results]) -> None:
    seconds = 0.0
    seen = set()
    with Image.open(run.folder / "motion.gif") as animation:
        frames = getattr(animation, "n_frames", 1)
        for k in range(frames):
            animation.seek(k)
            seconds += animation.info["duration"] / 1000
            seen.add(animation.convert("RGB").tobytes())
    assert len(seen) == frames == 101
    assert seconds == pytest.approx(5.0, abs=1.1)  # and a moment at the end


@pytest.mark.long
def test_the_committed_numbers_are_those_of_the_run(summary: Summary) -> None:
    assert_committed_numbers("free_floating", summary)
