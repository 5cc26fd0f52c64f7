"""Smooth connected paths and their time schedule (Lee, Ryu, Cheong 2006): figures, tables, and what they leave out.

`python scripts/blend.py [--out results]` writes OUT/blend/ and prints paper value, our value and the difference.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))  # run as a file, from anywhere

import numpy as np

from ocp.schedule import joint_trajectory
from scripts.drawing import Row, text_table, write_json, write_table, written
from scripts.papers.blend.example import CENTRIPETAL, MM, NOTE, PAPER_SPEED_ERROR, PAPER_TIMES, PERIOD, SPEED
from scripts.papers.blend.figures import draw_paper
from scripts.papers.blend.findings import draw_animation, draw_findings
from scripts.papers.blend.results import Results, asked_centripetal, compute, event_table, exit_steps, limit_table

__all__ = ["NAME", "main", "summary", "write"]

NAME = "blend"


def main(arguments: Sequence[str] | None = None) -> int:
    """Compute, write and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("results"), help="folder to write into (default: results)")
    folder = parser.parse_args(arguments).out / NAME
    results = compute()
    write(results, folder)
    report(results)
    print(f"\nwritten to {folder}")
    return 0


def write(results: Results, folder: Path) -> None:
    """All files of the paper, each whole or not at all."""
    folder.mkdir(parents=True, exist_ok=True)
    write_table(folder / "table2_gamma.csv", results.gamma_table)
    write_table(folder / "events.csv", event_table(results))
    write_table(folder / "mapping_example.csv", results.mappings)
    write_table(folder / "mapping_small_blends.csv", results.small_blends)
    write_table(folder / "limits.csv", limit_table(results))
    with written(folder / "trajectory.csv") as path:
        joint_trajectory(results.mean, results.joints, PERIOD).write_csv(path)
    write_json(folder / "summary.json", summary(results))
    draw_paper(folder, results)
    draw_findings(folder, results)
    draw_animation(folder, results)


def summary(results: Results) -> dict[str, Any]:
    """The numbers that matter, lengths in mm where the paper has them so; times in the mean reading unless said."""
    cubic, quintic = results.cubic, results.quintic
    asked = asked_centripetal(cubic)

    def found(mapping: str, key: str, blend: str = "line-line") -> float:
        wanted = {"mapping": mapping, "blend": blend, "period_ms": 2}
        return float(next(row[key] for row in results.mappings if all(row[k] == v for k, v in wanted.items())))

    def drift(mapping: str, remaining: float) -> float:
        wanted = {"blend": "cubic", "mapping": mapping, "remaining_mm": remaining, "period_ms": 1}
        return float(
            next(row["drift_um"] for row in results.small_blends if all(row[k] == v for k, v in wanted.items())) * 1e-3
        )

    return {
        "gamma_table": [
            [row["remaining_mm"], row["constant_30_90deg"], row["shape_1_90deg"], row["shape_1_45deg"]]
            for row in results.gamma_table
        ],
        "lengths_mm": cubic.piece_lengths / MM,
        "total_length_mm": cubic.length / MM,
        "duration_s": results.mean.duration,
        "blend_times_s": results.mean.time_at(cubic.bounds[1:5]),
        "duration_peak_reading_s": results.peak.duration,
        "blend_times_peak_reading_s": results.peak.time_at(cubic.bounds[1:5]),
        "blend_times_paper_s": PAPER_TIMES,
        "speed_error_mm_s": {
            "paper": PAPER_SPEED_ERROR,
            "predictor_corrector_2ms": found("predictor_corrector", "chord_speed_error_mm_s"),
            "predictor_corrector_2ms_true": found("predictor_corrector", "true_speed_error_mm_s"),
            "predictor_corrector_2ms_line_arc": found("predictor_corrector", "chord_speed_error_mm_s", "line-arc"),
            "predictor_corrector_2ms_blend_ends": exit_steps(results),
            "gauss_2ms": found("gauss_newton", "true_speed_error_mm_s"),
            "gauss_2ms_line_arc": found("gauss_newton", "true_speed_error_mm_s", "line-arc"),
            "gauss_2ms_chord": found("gauss_newton", "chord_speed_error_mm_s"),
        },
        "drift_mm": {
            f"{name}_1ms_{remaining}mm": drift(mapping, remaining)
            for name, mapping in (("predictor_corrector", "predictor_corrector"), ("gauss", "gauss_newton"))
            for remaining in (5, 10, 150)
        },
        "max_curvature_jump_cubic": float(cubic.curvature_jumps().max()) * MM,
        "max_curvature_jump_quintic": float(quintic.curvature_jumps().max()) * MM,
        "curvature_jumps_cubic_per_mm": cubic.curvature_jumps() * MM,
        "asked_centripetal_mm_s2": [value / MM for value in asked],
        "speed_for_centripetal_limit_mm_s": {
            "limit_mm_s2": CENTRIPETAL / MM,
            "speeds": [float(np.sqrt(CENTRIPETAL / value)) * SPEED / MM for value in asked],
        },
        "limited": limit_table(results),
        "dips": {name: [str(dip) for dip in plan.schedule.dips] for name, plan in results.plans.items()},
        "assumptions": NOTE,
    }


def report(results: Results) -> None:
    """Print paper value, our value and the difference."""
    found = summary(results)
    error = found["speed_error_mm_s"]
    print("Printed numbers\n" + text_table(printed_numbers(results, error["predictor_corrector_2ms"])))
    print("0.443 of Table 2 is a misprint of 0.442, the closed form being |1 - 1.5/4| cos 45 deg = 0.4419.")
    print("\nTimes, in both readings of the acceleration\n" + text_table(event_table(results)))
    print("no reading gives all four printed times; the blends' durations agree within 2.5 ms in both")
    print(f"\nlengths {np.round(found['lengths_mm'], 5).tolist()} mm, total {found['total_length_mm']:.5f} mm")
    print(f"duration {results.mean.duration:.6f} s (mean reading), {results.peak.duration:.6f} s (peak reading)")
    print(
        f"of the speed error {error['predictor_corrector_2ms_true']:.4f} mm/s are true, the rest is chord against arc; "
        f"the default mapping's true one is {error['gauss_2ms']:.1e} mm/s"
    )
    steps = ", ".join(f"{value:+.2f}" for value in error["predictor_corrector_2ms_blend_ends"])
    print(f"where its blends end, the paper's mapping makes its drift good in one step of {steps} mm/s")
    print("\nBoth mappings on the example\n" + text_table(results.mappings, 4))
    print("\nAnd on 90 deg corners of other sizes\n" + text_table(results.small_blends, 4))
    jumps = ", ".join(f"{value:.3g}" for value in found["curvature_jumps_cubic_per_mm"])
    print(f"\ncurvature jumps of the cubic at the ends of its blends: {jumps} /mm; quintic at most ", end="")
    print(f"{found['max_curvature_jump_quintic']:.1e} /mm")
    centripetal = ", ".join(f"{value:.0f}" for value in found["asked_centripetal_mm_s2"])
    speeds = ", ".join(f"{value:.0f}" for value in found["speed_for_centripetal_limit_mm_s"]["speeds"])
    print(
        f"centripetal acceleration that the example asks in its blends at 1000 mm/s: {centripetal} mm/s²; "
        f"{CENTRIPETAL / MM:g} mm/s² would permit {speeds} mm/s"
    )
    print("\nUnder more limits: the schedule and the minimum time of the optimal control problem")
    print(text_table(found["limited"], 5))
    for name, dips in found["dips"].items():
        for dip in dips:
            print(f"  {name}: {dip}")
    print(f"\n{NOTE}")


def printed_numbers(results: Results, speed_error: float) -> list[Row]:
    """Every number that the paper prints of its results but the times, beside ours."""
    rows: list[Row] = []
    for row in results.gamma_table:
        for name, text in (
            ("constant_30_90deg", "alpha 30 mm, 90 deg"),
            ("shape_1_90deg", "lambda 1, 90 deg"),
            ("shape_1_45deg", "lambda 1, 45 deg"),
        ):
            paper, ours = row[f"{name}_paper"], row[name]
            quantity = f"gamma, Lr {row['remaining_mm']} mm, {text}"
            rows.append({"quantity": quantity, "paper": paper, "ours": ours, "difference": ours - paper})
    for scale, unit in ((1.0, "mm/s"), (100 * MM / SPEED, "%")):
        paper, ours = scale * PAPER_SPEED_ERROR, scale * speed_error
        rows.append(
            {"quantity": f"worst speed error, {unit}", "paper": paper, "ours": ours, "difference": ours - paper}
        )
    return rows


if __name__ == "__main__":
    sys.exit(main())
