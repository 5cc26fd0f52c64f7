"""Tables, summary and printed report of the free-floating paper."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from scripts.papers.free_floating import extremals
from scripts.papers.free_floating.false_optima import EXTREMAL, FALSE
from scripts.papers.free_floating.false_optima import HORIZON as FALSE_HORIZON
from scripts.papers.free_floating.formulations import HORIZON
from scripts.papers.free_floating.optimality import PLAN, SECOND_OPINION, certificate_rows, indirect_summary
from scripts.papers.free_floating.results import (
    ASSUMED,
    CAVEATS,
    CHOSEN,
    NOTE,
    PAPER_ACCELERATIONS,
    PAPER_PEAKS,
    START,
    Results,
)
from scripts.papers.run import Content, Row, Table, compared, text_table

PEAKS = PAPER_PEAKS["optimum"]


def files(results: Results) -> Mapping[str, Content]:
    """What is written beside the figures."""
    return {
        "table1_peak_velocity.csv": Table(peak_table(results)),
        "table2_acceleration.csv": Table(acceleration_table(results)),
        "sensitivity.csv": Table(results.sensitivity),
        "convergence.csv": Table(results.convergence),
        "false_optima.csv": Table([trial.row() for trial in results.trials], digits=7),
        "certificate.csv": Table(certificate_rows(results.agreement), digits=4),
        "extremals.csv": Table(extremals.table(results.searches, PEAKS)),
        "summary.json": summary(results),
        "certificate.txt": certificate_text(results),
        "audit.txt": f"{results.audit}\n",
    }


def report(results: Results) -> str:
    """Paper value, our value and the difference, and every table."""
    laws = results.laws
    parts = ("guess", "seed", "cost", "jump_deg_s", "task_error_m_s", "audit", "intervals", "refined_cost", "verdict")
    trials = [{name: trial.row()[name] for name in parts} for trial in results.trials]
    return "\n\n".join(
        [
            "Table 1, peak joint velocity\n" + _noted(peak_table(results)),
            "Table 2, joint acceleration at the peak\n" + _noted(acceleration_table(results)),
            "Peaks of the pseudo-inverse for other link lengths\n" + text_table(results.sensitivity),
            f"Optimum, horizon {HORIZON:g} s: J = {results.agreement.backward.cost:.12f} rad^2/s\n"
            + text_table(results.convergence, 4),
            f"The plan, re-integrated: tip off its line by {laws.tip_error:.1e} m, momentum at most "
            f"{laws.momentum_drift:.1e} (SI units), centre of mass moved by {laws.center_of_mass_drift:.1e} m\n"
            f"{results.audit}",
            certificate_text(results),
            f"From other guesses, horizon {FALSE_HORIZON:g} s\n" + text_table(trials),
            _extremals(results),
            NOTE,
        ]
    )


def _noted(rows: list[Row]) -> str:
    """A table, its notes below it."""
    notes = dict.fromkeys(f"\n  {row['method']}: {row['note']}" for row in rows)
    return text_table([{name: value for name, value in row.items() if name != "note"} for row in rows]) + "".join(notes)


def _extremals(results: Results) -> str:
    """Every extremal, the best at each horizon, and that none is the paper's."""
    peaks = [f"joint{i}_peak_deg_s" for i in (1, 2, 3)]
    columns = ["horizon_s", "cost_direct", "cost_indirect", "found", "starts", *peaks]
    columns += ["largest_difference_from_paper_deg_s", "verdict", "best"]
    rows = [{name: row[name] for name in columns} for row in extremals.table(results.searches, PEAKS)]
    lines = ["Extremals at other horizons, from seeded first guesses", text_table(rows)]
    lines += [
        f"  {one.horizon:g} s: best J = {one.best.indirect_cost:.9f}, "
        f"from {one.best.guess_count} of {one.starts} guesses; "
        f"{len(one.extremals)} extremals, {one.rejected} plans jump or change on a finer mesh"
        for one in results.searches
    ]
    nearest = extremals.summary(results.searches, PEAKS)["nearest_to_paper"]
    lines += [
        f"  {extremals.NOT_GLOBAL}.",
        f"  None has the peaks of the paper's optimum: the nearest (horizon {nearest['horizon_s']:g} s, J = "
        f"{nearest['cost']:.6g}) is {nearest['largest_difference_deg_s']:.4g} deg/s off",
    ]
    return "\n".join(lines)


def certificate_text(results: Results) -> str:
    """Both certificates, one formulation each, for problem and costates are one but the controls are not."""
    return "\n\n".join(str(one) for one in results.agreement.certificates.values()) + "\n"


def peak_table(results: Results) -> list[Row]:
    """Table 1."""
    rows: list[Row] = []
    for method, motion in results.tabled.items():
        peaks, times = motion.peak_joint_rates()
        for joint, (paper, ours, time) in enumerate(zip(PAPER_PEAKS[method], np.degrees(peaks), times, strict=True), 1):
            values = {**compared(paper, float(ours), "deg_s"), "time_s": float(time)}
            rows.append({"method": method, "joint": joint, **values, "note": CAVEATS["peaks"][method]})
    return rows


def acceleration_table(results: Results) -> list[Row]:
    """Table 2, and the largest acceleration anywhere."""
    rows: list[Row] = []
    for method, motion in results.tabled.items():
        ours = np.degrees(motion.accelerations_at_peaks()).tolist()
        largest = np.degrees(motion.largest_accelerations).tolist()
        for joint, (paper, at_peak, most) in enumerate(zip(PAPER_ACCELERATIONS[method], ours, largest, strict=True), 1):
            values = {**compared(paper, at_peak, "deg_s2"), "ours_largest_anywhere_deg_s2": most}
            rows.append({"method": method, "joint": joint, **values, "note": CAVEATS["accelerations"][method]})
    return rows


def summary(results: Results) -> dict[str, Any]:
    """The numbers that matter, nested by what they belong to."""
    local, result, trials = results.local, results.agreement, results.trials
    plan, reference = result.plan, result.backward.cost
    least = int(local.manipulability.argmin())
    peaks = {name: motion.peak_joint_rates() for name, motion in results.tabled.items()}
    at_peaks = {name: np.degrees(motion.accelerations_at_peaks()) for name, motion in results.tabled.items()}

    def solved(solution: Any) -> dict[str, Any]:
        difference = solution.cost - reference
        return {"cost": solution.cost, "difference": difference, "iterations": solution.iterations}

    return {
        "paper": {
            "source": "Kim, Kim 2011: redundancy resolution for free-floating manipulators",
            "peak_joint_velocity_deg_s": PAPER_PEAKS,
            "joint_acceleration_at_peak_deg_s2": PAPER_ACCELERATIONS,
        },
        "assumptions": [ASSUMED, CHOSEN],
        "caveats": CAVEATS,
        "pseudo_inverse": {
            "peak_joint_velocity_deg_s": np.degrees(peaks["pseudo-inverse"][0]),
            "peak_time_s": peaks["pseudo-inverse"][1],
            "joint_acceleration_at_peak_deg_s2": at_peaks["pseudo-inverse"],
            "largest_joint_acceleration_deg_s2": np.degrees(results.near_peaks.largest_accelerations),
            "min_manipulability": local.manipulability[least],
            "min_manipulability_time_s": local.t[least],
        },
        "optimal": {
            "horizon_s": plan.horizon,
            "cost_reference": reference,
            "collocation": {"scheme": PLAN.scheme, "degree": PLAN.degree, "intervals": PLAN.intervals, **solved(plan)},
            "multiple_shooting": {
                "control": SECOND_OPINION.control,
                "intervals": SECOND_OPINION.intervals,
                **solved(result.shooting),
            },
            "indirect": indirect_summary(result, START),
            "certified": {name: one.passed for name, one in result.certificates.items()},
            "peak_joint_velocity_deg_s": np.degrees(peaks["optimum"][0]),
            "peak_time_s": peaks["optimum"][1],
            "joint_acceleration_at_peak_deg_s2": at_peaks["optimum"],
            "min_manipulability": results.optimal.manipulability.min(),
            "momentum_drift": results.laws.momentum_drift,
            "center_of_mass_drift_m": results.laws.center_of_mass_drift,
            "tip_error_m": results.laws.tip_error,
            "integration_error": results.audit.integration_error,
            "audit_passed": results.audit.passed,
        },
        "false_optima": {
            "horizon_s": FALSE_HORIZON,
            "guesses": len(trials),
            "passed": sum(trial.audit for trial in trials),
            "extremals": sum(trial.verdict == EXTREMAL for trial in trials),
            "false": sum(trial.verdict == FALSE for trial in trials),
            "extremal_costs": sorted({round(trial.refined_cost, 5) for trial in trials if trial.verdict != FALSE}),
        },
        "extremals": extremals.summary(results.searches, PEAKS),
    }
