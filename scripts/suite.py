"""Pictures and page of the public suites: `python scripts/suite.py [--out results] [--problems]`.

Reads OUT/suite/suite.csv, which `make suite` writes. Writes OUT/suite/profile.png, the performance profile, and the
table of docs/suite.md; with --problems also OUT/suite/problems.png, for which it solves every problem.
"""

from __future__ import annotations

import argparse
import sys
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))  # run as a file, from anywhere

from ocp import SolveError, solve
from scripts import drawing
from tests.conformance.suite.__main__ import rows_of
from tests.conformance.suite.library import entries
from tests.conformance.suite.page import PAGE, write_page

ROOT = Path(__file__).resolve().parents[1]
TOOLS = {"seconds": ("selfmotion", "blue"), "rockit_seconds": ("rockit", "orange")}
PANELS = 9  # a row
SIZE = (9.0, 9.0)


def profile(path: Path, rows: Mapping[str, Mapping[str, str]]) -> None:
    """Share of the problems, tried by both, that a tool solves within a multiple of the least time of all tools."""
    times = np.array([[_seconds(row, key) for key in TOOLS] for row in rows.values() if row["rockit_cost"]])
    times = times[np.isfinite(times).any(axis=1)]
    ratio = np.where(np.isfinite(times), times / np.nanmin(times, axis=1, keepdims=True), np.inf)
    note = "First solve on the same equal mesh from the same guess, with the time to pose it; of the processor."
    with drawing.sheet(path, (1, 1), (6.3, 3.4), note, xlabel="time over that of the faster tool") as (_, axes):
        for k, (name, color) in enumerate(TOOLS.values()):
            at = np.sort(ratio[:, k])
            share = np.arange(1, len(at) + 1) / len(at)
            axes[0, 0].step(at, share, where="post", label=name, color=drawing.COLORS[color])
        axes[0, 0].set(xscale="log", ylim=(0, 1.02), ylabel="share of the problems")
        axes[0, 0].legend(loc="lower right")


def _seconds(row: Mapping[str, str], key: str) -> float:
    cost = row["first_cost"] if key == "seconds" else row["rockit_cost"]
    return float(row[key]) if row[key] and cost.lstrip("-")[:1].isdigit() else np.nan


def problems(path: Path, rows: Mapping[str, Mapping[str, str]]) -> None:
    """States of every problem that is in the table over its horizon, each divided by its size."""
    known = {name: entry for name, entry in entries().items() if rows.get(name, {}).get("seconds")}
    note = "States, each divided by its size, over the horizon; phases side by side over their own durations."
    with drawing.sheet(path, (-(-len(known) // PANELS), PANELS), SIZE, note) as (_, axes):
        for ax in axes.ravel():
            ax.set_axis_off()
        for ax, (name, entry) in zip(axes.ravel(), known.items(), strict=False):
            ax.set_title(name, fontsize=5)
            try:
                plan: Any = solve(entry.build(), entry.method)
            except SolveError:
                continue
            for values in plan.states.values():
                ax.plot(plan.t, values / np.abs(values).max(axis=0).clip(1e-12), lw=0.7)
    drawing.reduce_colors(path, 128)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=ROOT / "results")
    parser.add_argument("--problems", action="store_true")
    options = parser.parse_args()
    warnings.simplefilter("ignore")
    rows = rows_of(options.out / "suite")
    profile(options.out / "suite" / "profile.png", rows)
    write_page(PAGE, rows)
    if options.problems:
        problems(options.out / "suite" / "problems.png", rows)
