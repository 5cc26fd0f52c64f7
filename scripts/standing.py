"""Manipulator that stands on the ground (Yoo et al. 2004): zero moment point by local laws and by optimal control.

`python scripts/standing.py [--out results]` writes OUT/standing/ and prints known value, our value and the difference.
The paper prints figures and no table of results; what its figures show, and an independent computation, are what is
compared with.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))  # run as a file, from anywhere

from scripts.drawing import Row, text_table, write_json, write_table, written
from scripts.papers.standing.animation import draw_animations
from scripts.papers.standing.cases import ASSUMED, CHOSEN, GAINS, machine
from scripts.papers.standing.checks import ALLOWED, STATIONARITY, failures
from scripts.papers.standing.figures import draw
from scripts.papers.standing.plan_figures import draw_convergence, draw_plans
from scripts.papers.standing.plans import LIFT_SETTINGS, SETTINGS
from scripts.papers.standing.results import (
    Results,
    comparison_table,
    compute,
    forms_difference,
    motion_table,
    progress,
)

__all__ = ["NAME", "main", "sound", "summary", "write"]

NAME = "standing"

CAVEATS = {
    "figure 4": "pinning the zero moment point at acceleration level is unstable: the index is 1 by construction while "
    "the machine lifts off. With the sign of C as printed in (22) it survives, with an index that is not 1: a likely "
    "cause of the figure",
    "local costs": "of the motion up to where it stops, which is before the horizon where it lifts off or diverges",
    "stabilised": "poles and damping are the reference's; the gain of p1 that it leaves open is 0 here. Its cost and "
    "peak acceleration are not met: stabiliser.csv shows what other gains give; none is chosen by it",
    "pinned plans": "accelerations held over intervals leave a pinned point between the nodes: the plan drawn has them "
    "free at Legendre points; the held one is the one of the reference, and its cost still falls with the intervals "
    "(5 % from its limit on Table 1 at 80, see convergence.csv)",
    "audit": f"'{STATIONARITY}' of plans with held accelerations: a constraint of the ground or of a torque is active "
    "at one end of an interval, its multiplier belongs there and the audit looks inside; it falls with the interval",
    "figure 10": "text and caption differ in whether the spring pulls: both are shown",
}


PRINTED = (
    "task",
    "motion",
    "reason",
    "time_s",
    "cost",
    "index_min",
    "zmp_min_m",
    "zmp_max_m",
    "vertical_force_min_n",
    "leaves_joint_limits_s",
    "peak_joint_velocity_rad_s",
    "peak_joint_acceleration_rad_s2",
)
"""Columns of the table of motions that are printed; all are in motions.csv."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Compute, write and print; the exit status is 0 when every plan that is drawn is sound between its nodes."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("results"), help="folder to write into (default: results)")
    folder = parser.parse_args(arguments).out / NAME
    results = compute()
    write(results, folder)
    report(results)
    print(f"\nwritten to {folder}")
    return 0 if sound(results) else 1


def sound(results: Results) -> bool:
    """Whether every drawn plan holds what it must between its nodes and fails at most STATIONARITY in its audit."""
    held = all(row["holds"] for row in results.checks if row["drawn"])
    drawn = [plan for group in results.plans.values() for plan in group.values() if plan.request.drawn]
    missed = {
        name
        for plan in drawn
        for name, _, _ in failures(plan)
        if not (name == STATIONARITY and plan.request.transcription == "held")
    }
    return held and not missed


def write(results: Results, folder: Path) -> None:
    """All files of the paper, each whole or not at all."""
    folder.mkdir(parents=True, exist_ok=True)
    write_table(folder / "comparison.csv", comparison_table(results), digits=7)
    write_table(folder / "motions.csv", motion_table(results), digits=7)
    write_table(folder / "checks.csv", results.checks, digits=5)
    write_table(folder / "convergence.csv", results.convergence, digits=9)
    write_table(folder / "layers.csv", results.layers, digits=5)
    write_table(folder / "stabiliser.csv", results.stabiliser, digits=6)
    with written(folder / "audit.txt") as path:
        path.write_text(audit_text(results), encoding="utf-8")
    write_json(folder / "summary.json", summary(results))
    draw(folder, results.local, results.plans, machine().weight)
    draw_plans(folder, results.plans)
    draw_convergence(folder, results.convergence)
    draw_animations(folder, results.local, results.plans, lambda times: progress(times, "animation"))


def report(results: Results) -> None:
    """Print known value, our value and the difference, and every table."""
    print("Known value, ours and the difference; reaches_s: how far the motion goes before it fails")
    print(text_table(comparison_table(results), 5))
    print("\nEvery motion\n" + text_table([{name: row[name] for name in PRINTED} for row in motion_table(results)], 4))
    print("\nPlans at ten times as many instants\n" + text_table([_short(row) for row in results.checks], 3))
    print("\nConvergence\n" + text_table(results.convergence, 7))
    print("\nLayers over a pinned zero moment point, Table 1\n" + text_table(results.layers, 4))
    print("\nGains of the stabilised law, Table 1\n" + text_table(results.stabiliser, 4))
    apart = max(forms_difference(results).values())
    print(f"\nAugmented and null-space form differ by at most {apart:.1e} (rad, rad/s, rad/s²)")
    for what, words in CAVEATS.items():
        print(f"  {what}: {words}")
    print(f"\n{ASSUMED}.\n{CHOSEN}.\n{GAINS}.\n{SETTINGS}.\n{LIFT_SETTINGS}.")


def _short(row: Row) -> Row:
    """A row of checks without the bounds that nothing exceeds."""
    names = ("task", "plan", "method", "drawn", "zmp_excess_m", "tip_error_m", "vertical_force_min_n")
    limits = max(value for name, value in row.items() if "excess" in name and not name.startswith("zmp"))
    return {**{name: row[name] for name in names}, "limit_excess": limits, "holds": row["holds"], "audit": row["audit"]}


def audit_text(results: Results) -> str:
    """The audit of every plan."""
    parts = [
        f"{task}, {key}: {plan.request.title}, {plan.request.intervals} intervals\n{plan.audit}"
        for task, group in results.plans.items()
        for key, plan in group.items()
    ]
    return "\n\n".join(parts) + "\n"


def summary(results: Results) -> dict[str, Any]:
    """The numbers that matter, nested by what they belong to."""
    content: dict[str, Any] = {
        "paper": {"source": "Yoo, So, Yi, Kim 2004: redundancy resolution with the zero moment point"},
        "assumptions": [ASSUMED, CHOSEN, GAINS, SETTINGS, LIFT_SETTINGS],
        "caveats": CAVEATS,
        "forms_difference": forms_difference(results),
        "table1": {},
        "table2": {},
        "minimum_time": {},
    }
    for row in motion_table(results):
        numbers = {name: value for name, value in row.items() if name not in ("task", "motion", "time_s")}
        content[row["task"]][row["motion"]] = numbers
    for task, laws in results.local.items():
        for key, found in laws.items():
            stopped = found.reason in ("lift_off", "divergence", "breakdown")
            content[task][key] |= {
                "verdict": found.words,
                "fails_s": None if found.reason == "stands" else found.time,
                "stopped_s": found.time if stopped else None,
                "diverges_s": found.diverges,
            }
    checks = {(row["task"], row["plan"]): row for row in results.checks}
    for task, plans in results.plans.items():
        for key, plan in plans.items():
            row = checks[task, key]
            content[task][key] |= {
                "intervals": plan.request.intervals,
                "iterations": plan.solution.iterations,
                "audit_passed": plan.audit.passed,
                "audit": row["audit"],
                "holds_between_nodes": row["holds"],
                "drawn": plan.request.drawn,
            }
    for key, plan in results.plans["minimum_time"].items():
        content["minimum_time"][f"{key}_s"] = plan.solution.horizon
    content["convergence"] = results.convergence
    content["checks"] = {
        "allowed": ALLOWED,
        "worst_of_drawn_plans": {name: max(row[name] for row in results.checks if row["drawn"]) for name in ALLOWED},
        "all_drawn_plans_hold": all(row["holds"] for row in results.checks if row["drawn"]),
        "sound": sound(results),
    }
    return content


if __name__ == "__main__":
    sys.exit(main())
