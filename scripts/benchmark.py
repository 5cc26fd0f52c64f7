"""How fast problems are built, solved and audited, costates evaluated, rigs, paths and robots computed, beside peers.

`python scripts/benchmark.py [--out results] [--only NAME ...] [--repeats 5]` writes OUT/benchmark/summary.json, tables
and plots. All figures are of one run on one machine; what is claimed are ratios and growth, not seconds.
"""

from __future__ import annotations

import importlib
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))  # run as a file, from anywhere

from scripts.papers.run import Table, command, progress, write
from scripts.timing import optimal_control

ROOT = Path(__file__).resolve().parents[1]
PARTS = (
    "build_and_solve",
    "costate_rate",
    "optimal_control",
    "arms",
    "audit",
    "planning",
    "waypoints",
    "batch",
    "schedules",
    "controllers",
    "cts",
    "blend",
    "robots",
    "distances",
    "clearance",
)
"""Modules of scripts/timing, each with run(repeats) -> numbers, plot(path, numbers) and report(numbers) -> text."""
TOGETHER = PARTS[:2]
"""Those whose numbers stand in summary.json; the others have a file NAME.json."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Time the parts, write and report; 0."""
    parser = command(__doc__, PARTS)
    parser.add_argument(
        "--repeats", type=int, default=5, help="runs of which the median or least is taken (default: 5)"
    )
    options = parser.parse_args(arguments)
    folder = options.out / "benchmark"
    by_name = {}
    for name in progress(options.only or PARTS, "benchmark"):
        by_name[name] = run_part(name, folder, options.repeats)
    if all(name in by_name for name in TOGETHER):
        summary: dict[str, Any] = {}
        for name in TOGETHER:
            summary |= {name if key == "rows" else key: value for key, value in by_name[name].items()}
        write(folder / "summary.json", summary)
    if "optimal_control" in by_name and options.out.resolve() == ROOT / "results":
        optimal_control.write_readme(ROOT / "README.md", by_name["optimal_control"]["first"])
    for name, numbers in by_name.items():
        print(f"{importlib.import_module(f'scripts.timing.{name}').report(numbers)}\n")
    print(f"written to {folder}")
    return 0


def run_part(name: str, folder: Path, repeats: int) -> dict[str, Any]:
    """Run a part and write its plot, its numbers, and a table of every list of rows among them.

    The list called "rows" becomes NAME.csv, another one NAME_LIST.csv.
    """
    module = importlib.import_module(f"scripts.timing.{name}")
    numbers: dict[str, Any] = module.run(repeats)
    for key, value in numbers.items():
        if isinstance(value, list) and value and all(isinstance(row, dict) for row in value):
            write(folder / (f"{name}.csv" if key == "rows" else f"{name}_{key}.csv"), Table(value, digits=6))
    if name not in TOGETHER:
        write(folder / f"{name}.json", numbers)
    module.plot(folder / f"{name}.png", numbers)
    return numbers


if __name__ == "__main__":
    sys.exit(main())
