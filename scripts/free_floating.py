"""Free-floating manipulator (Kim, Kim 2011): pseudo-inverse and optimum, every figure and table.

`python scripts/free_floating.py [--out results]` writes OUT/free_floating/ and prints paper value, our value and the
difference. What the paper does not print, and what cannot be reproduced, stands beside every number it touches.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))  # run as a file, from anywhere

import numpy as np

from scripts.drawing import Row, text_table, write_json, write_table, written
from scripts.papers.free_floating import extremals
from scripts.papers.free_floating.false_optima import EXTREMAL, FALSE
from scripts.papers.free_floating.false_optima import HORIZON as FALSE_HORIZON
from scripts.papers.free_floating.figures import draw, draw_animation, draw_convergence, draw_false_optima
from scripts.papers.free_floating.optimality import PLAN, SECOND_OPINION, certificate_rows, indirect_summary
from scripts.papers.free_floating.optimality_figures import draw_costates, draw_extremals, draw_hamiltonian
from scripts.papers.free_floating.results import (
    ASSUMED,
    CAVEATS,
    CHOSEN,
    HORIZON,
    NOTE,
    PAPER_ACCELERATIONS,
    PAPER_PEAKS,
    START,
    Results,
    compute,
    progress,
)

__all__ = ["NAME", "main", "peak_table", "summary", "write"]

NAME = "free_floating"


def main(arguments: Sequence[str] | None = None) -> int:
    """Compute, write and print; the exit status is 0 when the plan passes its audit and the methods agree."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("results"), help="folder to write into (default: results)")
    folder = parser.parse_args(arguments).out / NAME
    results = compute()
    write(results, folder)
    report(results)
    print(f"\nwritten to {folder}")
    certified = all(one.passed for one in results.agreement.certificates.values())
    return 0 if results.audit.passed and certified else 1


def write(results: Results, folder: Path) -> None:
    """All files of the paper, each whole or not at all."""
    folder.mkdir(parents=True, exist_ok=True)
    write_table(folder / "table1_peak_velocity.csv", peak_table(results))
    write_table(folder / "table2_acceleration.csv", acceleration_table(results))
    write_table(folder / "sensitivity.csv", results.sensitivity)
    write_table(folder / "convergence.csv", results.convergence)
    write_table(folder / "false_optima.csv", [trial.row() for trial in results.trials], digits=7)
    write_table(folder / "certificate.csv", certificate_rows(results.agreement), digits=4)
    write_table(folder / "extremals.csv", extremals.table(results.searches, PAPER_PEAKS["optimum"]))
    write_json(folder / "summary.json", summary(results))
    with written(folder / "certificate.txt") as path:
        path.write_text(certificate_text(results), encoding="utf-8")
    with written(folder / "audit.txt") as path:
        path.write_text(f"{results.audit}\n", encoding="utf-8")
    draw(folder, results.machine, results.local, results.optimal, NOTE)
    draw_convergence(folder, results.convergence, NOTE)
    draw_false_optima(folder, results.trials, f"{ASSUMED}; horizon {FALSE_HORIZON:g} s (chosen, not printed).")
    draw_costates(folder, results.agreement, NOTE)
    draw_hamiltonian(folder, results.agreement, NOTE)
    draw_extremals(folder, results.searches, f"{ASSUMED}; horizons chosen, not printed. {extremals.NOT_GLOBAL}.")
    motions = results.machine, results.local, results.optimal
    draw_animation(folder, *motions, NOTE, lambda times: progress(times, "animation"))


def report(results: Results) -> None:
    """Print paper value, our value and the difference."""
    print("Table 1, peak joint velocity")
    _print_table(peak_table(results))
    print("\nTable 2, joint acceleration at the peak")
    _print_table(acceleration_table(results))
    print("\nPeaks of the pseudo-inverse for other link lengths\n" + text_table(results.sensitivity))
    print(f"\nOptimum, horizon {HORIZON:g} s: J = {results.agreement.backward.cost:.12f} rad^2/s")
    print(text_table(results.convergence, 4))
    laws = results.laws
    print(f"\nThe plan, re-integrated: tip off its line by {laws.tip_error:.1e} m, momentum at most", end=" ")
    print(f"{laws.momentum_drift:.1e} (SI units), centre of mass moved by {laws.center_of_mass_drift:.1e} m")
    print(f"{results.audit}\n\n{certificate_text(results)}")
    columns = ("guess", "seed", "cost", "jump_deg_s", "task_error_m_s", "audit", "intervals", "refined_cost", "verdict")
    rows = [{name: trial.row()[name] for name in columns} for trial in results.trials]
    print(f"\nFrom other guesses, horizon {FALSE_HORIZON:g} s\n" + text_table(rows))
    _report_extremals(results)
    print(f"\n{NOTE}")


def _report_extremals(results: Results) -> None:
    """Every extremal, the best at each horizon, and that none is the paper's."""
    columns = ("horizon_s", "cost_direct", "cost_indirect", "found", "starts")
    peaks = ("joint1_peak_deg_s", "joint2_peak_deg_s", "joint3_peak_deg_s", "largest_difference_from_paper_deg_s")
    rows = extremals.table(results.searches, PAPER_PEAKS["optimum"])
    rows = [{name: row[name] for name in (*columns, *peaks, "verdict", "best")} for row in rows]
    print("\nExtremals at other horizons, from seeded first guesses\n" + text_table(rows))
    for one in results.searches:
        best = one.best
        print(
            f"  {one.horizon:g} s: best J = {best.indirect_cost:.9f}, from {best.found} of {one.starts} guesses; "
            f"{len(one.extremals)} extremals, {one.rejected} plans jump or change on a finer mesh"
        )
    nearest = extremals.summary(results.searches, PAPER_PEAKS["optimum"])["nearest_to_paper"]
    print(f"  {extremals.NOT_GLOBAL}.")
    print(
        f"  None has the peaks of the paper's optimum: the nearest (horizon {nearest['horizon_s']:g} s, J = "
        f"{nearest['cost']:.6g}) is {nearest['largest_difference_deg_s']:.4g} deg/s off"
    )


def certificate_text(results: Results) -> str:
    """Both certificates, one formulation each, for problem and costates are one but the controls are not."""
    return "\n\n".join(str(one) for one in results.agreement.certificates.values()) + "\n"


def _print_table(rows: list[Row]) -> None:
    """A table, its notes below it."""
    print(text_table([{name: value for name, value in row.items() if name != "note"} for row in rows]))
    for method, note in dict.fromkeys((row["method"], row["note"]) for row in rows):
        print(f"  {method}: {note}")


def peak_table(results: Results) -> list[Row]:
    """Table 1."""
    rows: list[Row] = []
    for method, motion in (("pseudo-inverse", results.near_peaks), ("optimum", results.optimal)):
        peaks, times = motion.peak_joint_rates()
        for joint, (paper, ours, time) in enumerate(zip(PAPER_PEAKS[method], np.degrees(peaks), times, strict=True), 1):
            rows.append(
                {
                    "method": method,
                    "joint": joint,
                    "paper_deg_s": paper,
                    "ours_deg_s": float(ours),
                    "difference_deg_s": float(ours - paper),
                    "time_s": float(time),
                    "note": CAVEATS["peaks"][method],
                }
            )
    return rows


def acceleration_table(results: Results) -> list[Row]:
    """Table 2, and the largest acceleration anywhere."""
    rows: list[Row] = []
    for method, motion in (("pseudo-inverse", results.near_peaks), ("optimum", results.optimal)):
        at_peaks = np.degrees(motion.accelerations_at_peaks())
        largest = np.degrees(np.abs(motion.joint_accelerations).max(axis=0))
        for joint, (paper, ours, most) in enumerate(
            zip(PAPER_ACCELERATIONS[method], at_peaks, largest, strict=True), 1
        ):
            rows.append(
                {
                    "method": method,
                    "joint": joint,
                    "paper_deg_s2": paper,
                    "ours_deg_s2": float(ours),
                    "difference_deg_s2": float(ours - paper),
                    "ours_largest_anywhere_deg_s2": float(most),
                    "note": CAVEATS["accelerations"][method],
                }
            )
    return rows


def summary(results: Results) -> dict[str, Any]:
    """The numbers that matter, nested by what they belong to."""
    local, found = results.local, results.agreement
    plan, reference = found.plan, found.backward.cost
    least = int(local.manipulability.argmin())
    costs = {round(trial.refined_cost, 5) for trial in results.trials if trial.verdict != FALSE}
    tables = {"pseudo-inverse": results.near_peaks, "optimum": results.optimal}
    peaks = {name: motion.peak_joint_rates() for name, motion in tables.items()}
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
            "largest_joint_acceleration_deg_s2": np.degrees(np.abs(results.near_peaks.joint_accelerations).max(axis=0)),
            "min_manipulability": local.manipulability[least],
            "min_manipulability_time_s": local.t[least],
        },
        "optimal": {
            "horizon_s": plan.horizon,
            "cost_reference": reference,
            "collocation": {
                "scheme": PLAN.scheme,
                "degree": PLAN.degree,
                "intervals": PLAN.intervals,
                "cost": plan.cost,
                "difference": plan.cost - reference,
                "iterations": plan.iterations,
            },
            "multiple_shooting": {
                "control": SECOND_OPINION.control,
                "intervals": SECOND_OPINION.intervals,
                "cost": found.shooting.cost,
                "difference": found.shooting.cost - reference,
                "iterations": found.shooting.iterations,
            },
            "indirect": indirect_summary(found, START),
            "certified": {name: one.passed for name, one in found.certificates.items()},
            "peak_joint_velocity_deg_s": np.degrees(peaks["optimum"][0]),
            "peak_time_s": peaks["optimum"][1],
            "min_manipulability": results.optimal.manipulability.min(),
            "momentum_drift": results.laws.momentum_drift,
            "center_of_mass_drift_m": results.laws.center_of_mass_drift,
            "tip_error_m": results.laws.tip_error,
            "integration_error": results.audit.integration_error,
            "audit_passed": results.audit.passed,
        },
        "false_optima": {
            "horizon_s": FALSE_HORIZON,
            "guesses": len(results.trials),
            "passed": sum(trial.audit for trial in results.trials),
            "extremals": sum(trial.verdict == EXTREMAL for trial in results.trials),
            "false": sum(trial.verdict == FALSE for trial in results.trials),
            "extremal_costs": sorted(costs),
        },
        "extremals": extremals.summary(results.searches, PAPER_PEAKS["optimum"]),
    }


if __name__ == "__main__":
    sys.exit(main())
