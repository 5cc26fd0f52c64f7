"""Captive trajectory rig (Lee, Lee 2017): roll by the paper's two iterations and by the global optimum, store release.

`python scripts/cts.py [--out results]` writes OUT/cts/ and prints paper value, our value and the difference.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))  # run as a file, from anywhere

import numpy as np

from scripts.drawing import Row, text_table, write_json, write_table
from scripts.papers.cts.figures import draw, draw_release
from scripts.papers.cts.plan import draw_plan, plan_summary
from scripts.papers.cts.results import NOTE, PAPER_TIMES, REFERENCE, Results, compute

__all__ = ["NAME", "main", "summary", "write"]

NAME = "cts"
TIME_NOTE = (
    "Rows 'jacobian' and 'combined': arithmetic alone, mapped steps times iterations. A call from Python costs 20 to "
    "30 us whatever it computes, more than any of these steps: called from Python the ratio of the two methods shrinks "
    "towards that of their numbers of calls (time_ratio_in_python). Compiled rows are free of it."
)


def main(arguments: Sequence[str] | None = None) -> int:
    """Compute, write and print; exit status 0 when no minimum is missed, all poses are tracked, the plan is sound."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("results"), help="folder to write into (default: results)")
    folder = parser.parse_args(arguments).out / NAME
    results = compute()
    write(results, folder)
    report(results)
    print(f"\nwritten to {folder}")
    sound = not results.random["global_missed"] and bool(results.release.table.ok.all()) and results.plan.passed
    return 0 if sound else 1


def write(results: Results, folder: Path) -> None:
    """All files of the paper, each whole or not at all."""
    folder.mkdir(parents=True, exist_ok=True)
    write_table(folder / "table6_time.csv", time_table(results))
    write_table(folder / "iterations.csv", method_table(results))
    write_table(folder / "reference_rolls.csv", reference_table(results))
    write_table(folder / "sweep.csv", sweep_table(results))
    write_json(folder / "summary.json", summary(results))
    draw(folder, results)
    draw_release(folder, results)
    draw_plan(folder / "plan.png", results.plan)


def report(results: Results) -> None:
    """Print paper value, our value and the difference."""
    print("Table 6, time of 200 targets\n" + text_table(time_table(results), 4) + f"\n{TIME_NOTE}")
    print("\nIterations\n" + text_table(method_table(results), 4))
    print("\nReference rolls\n" + text_table(reference_table(results), 8))
    print("\nRandom targets\n" + text_table([results.random], 4))
    found = results.release
    print(f"\nStore release: tracked to {found.tracking[:, 0].max():.1e} m, {found.tracking[:, 1].max():.1e} rad;")
    print(f"least clearance {found.clearance.min():.4f} m, {found.nearest[0]} to {found.nearest[1]}")
    plan = plan_summary(results.plan)
    print("\nWhole sweep planned at once\n" + text_table([plan["plan"], plan["each_target_by_itself"]], 4))
    print(results.plan.audit)
    if results.nanoseconds:
        print("\nCompiled, ns a target: " + ", ".join(f"{k} {v:.0f}" for k, v in results.nanoseconds.items()))
    print(f"\n{NOTE}")


def time_table(results: Results) -> list[Row]:
    """Table 6: the paper's machine and code are not ours, only the ratio compares."""
    ours = {"jacobian": results.arithmetic["jacobian, gain 20"], "combined": results.arithmetic["combined"]}
    rows: list[Row] = [
        {
            "what": f"{name}, s",
            "paper": PAPER_TIMES[name],
            "ours": ours[name],
            "difference": ours[name] - PAPER_TIMES[name],
        }
        for name in ("jacobian", "combined")
    ]
    ratio, own = PAPER_TIMES["jacobian"] / PAPER_TIMES["combined"], ours["jacobian"] / ours["combined"]
    rows.append({"what": "ratio", "paper": ratio, "ours": own, "difference": own - ratio})
    closed = results.seconds["i1 closed form"]
    rows.append(
        {"what": "closed form from Python, s", "paper": float("nan"), "ours": closed, "difference": float("nan")}
    )
    if results.nanoseconds:
        compiled = 200e-9 * results.nanoseconds["closed form, reach"]
        paper = PAPER_TIMES["combined"]
        rows.append({"what": "compiled, s", "paper": paper, "ours": compiled, "difference": compiled - paper})
    return rows


def method_table(results: Results) -> list[Row]:
    """Iterations and convergence of the iterations, by index, method and gain."""
    return [
        {
            "index": name,
            "method": method,
            "gain": gain,
            "iterations_mean": float(run.iterations.mean()),
            "iterations_max": int(run.iterations.max()),
            "converged": int(run.converged.sum()),
            "of": len(run.iterations),
            "gain_n6_squared_bend_max": results.stability.get((name, gain), 0.0),
        }
        for (name, method, gain), run in results.runs.items()
    ]


def reference_table(results: Results) -> list[Row]:
    """Reference rolls, known from an independent computation."""
    return [
        {
            "z_in": z,
            "reference_rad": known,
            "ours_rad": results.reference[z],
            "difference": results.reference[z] - known,
        }
        for z, known in REFERENCE.items()
    ]


def sweep_table(results: Results) -> list[Row]:
    """Joints of the global optimum over the sweep."""
    table = results.optimal["i1"]
    names = ("q1_m", "q2_rad", "q3_rad", "q4_rad", "q5_rad", "q6_rad")
    return [
        {"z_m": row[2], **dict(zip(names, q, strict=True)), "active": active, "status": status}
        for row, q, active, status in zip(table.targets, table.joints, table.active, table.status, strict=True)
    ]


def summary(results: Results) -> dict[str, Any]:
    """The numbers that matter."""

    def of(name: str, method: str, gain: float) -> dict[str, Any]:
        run = results.runs[name, method, gain]
        return {
            "iterations_mean": run.iterations.mean(),
            "iterations_max": int(run.iterations.max()),
            "converged": int(run.converged.sum()),
            "gain": gain,
            "gain_n6_squared_bend_max": results.stability.get((name, gain), 0.0),
        }

    found, seconds, arithmetic = results.release, results.seconds, results.arithmetic
    content: dict[str, Any] = {
        "paper": {
            "source": "Lee, Lee 2017: kinematics of a captive trajectory simulation system",
            "table6_s": PAPER_TIMES,
        },
        "assumptions": [NOTE],
        "phi_reference": list(results.reference.values()),
        "i1": {
            "combined": of("i1", "combined", 0.0),
            "jacobian": of("i1", "jacobian", 20.0),
            "jacobian_gain_1": of("i1", "jacobian", 1.0),
        },
        "i2": {
            "combined": of("i2", "combined", 0.0),
            "jacobian": of("i2", "jacobian", 20.0),
            "jacobian_gain_1": of("i2", "jacobian", 1.0),
        },
        "newton_maximum_share": results.random["newton_maximum_share"],
        "global_missed": results.random["global_missed"],
        "random_targets": results.random,
        "time_ratio_jacobian_over_combined": arithmetic["jacobian, gain 20"] / arithmetic["combined"],
        "time_ratio_jacobian_over_combined_gain_1": arithmetic["jacobian, gain 1"] / arithmetic["combined"],
        "time_ratio_in_python": seconds["i1 jacobian, gain 20"] / seconds["i1 combined"],
        "arithmetic_seconds_of_200_targets": arithmetic,
        "seconds_of_200_targets": seconds,
        "release": {
            "seconds": float(found.t[-1]),
            "tracking_m": found.tracking[:, 0].max(),
            "tracking_rad": found.tracking[:, 1].max(),
            "least_clearance_m": found.clearance.min(),
            "nearest": list(found.nearest),
            "roll_range_rad": float(np.ptp(found.table.joints[:, 5])),
        },
        "plan": plan_summary(results.plan),
        "table6_note": TIME_NOTE,
    }
    if results.nanoseconds:
        reach = results.nanoseconds["closed form, reach"]
        content["compiled_ns_per_target"] = results.nanoseconds["closed form, limits off"]
        content["compiled_ns_per_target_in_reach"] = reach
        content["paper_time_over_compiled"] = PAPER_TIMES["combined"] / (200e-9 * reach)
    return content


if __name__ == "__main__":
    sys.exit(main())
