"""Six problems of known optimum, posed and solved by this package, rockit, Dymos and Drake: time over error of cost.

Every tool runs in a process of its own, on finer and finer meshes, until it comes as near to the optimum as rounding
allows or has had its time. What is not installed is left out. Times are of the processor: posing and solving, and
solving again with another parameter from the plan before, without the imports.
"""

from __future__ import annotations

import json
import math
import os
import subprocess
import sys
from collections.abc import Iterable, Sequence
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from scripts import drawing
from scripts.papers.run import progress, text_table
from scripts.timing.statements import STATEMENTS
from scripts.timing.tools import TOOLS

ROOT = Path(__file__).resolve().parents[2]
MESHES = (5, 10, 20, 40, 80)
TOLERANCE = 1e-6
"""Relative error of the cost at which times are compared."""
DISTRIBUTIONS = {"rockit": "rockit-meco", "Dymos": "dymos", "Drake": "drake"}
README_MARKS = ("<!-- made by scripts/benchmark.py -->", "<!-- end -->")
MARKS = dict(zip(TOOLS, zip("oD^v", ("blue", "orange", "green", "purple"), strict=True), strict=True))


def run(repeats: int = 5) -> dict[str, Any]:
    """Each problem by each tool that is there, once (`repeats` is not needed: what is compared differs by much more).

    Returns:
        "rows": by problem, tool and number of intervals; those that failed say so. "first": by problem and tool, the
        first mesh within ASKED of the optimum. "versions": of the tools, "not installed" where there is none.
    """
    versions = {name: installed(of) for name, of in DISTRIBUTIONS.items()}
    tools = [tool for tool in TOOLS if versions.get(tool) != "not installed"]
    rows = [
        row
        for problem in progress(STATEMENTS, "optimal control")
        for tool in tools
        for row in rows_of(tool, problem, MESHES)
    ]
    return {"rows": rows, "first": first_within(rows), "versions": versions, "asked": TOLERANCE}


def installed(distribution: str) -> str:
    """Its version, or "not installed"."""
    try:
        return version(distribution)
    except PackageNotFoundError:
        return "not installed"


def rows_of(tool: str, problem: str, meshes: Iterable[int]) -> list[dict[str, Any]]:
    """Rows of a process of its own; at least one, which says what failed where nothing was found."""
    command = [sys.executable, "-W", "ignore", "-m", "scripts.timing.tools", tool, problem, *map(str, meshes)]
    ran = subprocess.run(command, capture_output=True, text=True, cwd=ROOT, env={**os.environ, "PYTHONPATH": str(ROOT)})
    blank = {"tool": tool, "problem": problem, "intervals": 0, "how": "", "cold_s": None, "warm_s": None}
    blank |= {"error": None, "cost": None, "cost_then": None, "failed": ""}
    matches = [blank | json.loads(line) for line in ran.stdout.splitlines() if line.startswith("{")]
    last = ran.stderr.strip().splitlines()[-1:] or [f"ended with {ran.returncode}"]
    return matches or [blank | {"failed": last[0][:300]}]


def first_within(rows: Sequence[dict[str, Any]], request: float = TOLERANCE) -> list[dict[str, Any]]:
    """For each problem and tool the coarsest mesh whose cost is so near to the optimum; else the nearest, "reached"
    False; else that there is none, "error" None."""
    first = []
    for problem, tool in dict.fromkeys((row["problem"], row["tool"]) for row in rows):
        mine = [row for row in rows if (row["problem"], row["tool"]) == (problem, tool)]
        done = sorted((row for row in mine if row["error"] is not None), key=lambda row: row["intervals"])
        near = [row for row in done if row["error"] <= request]
        best = near[0] if near else min(done, key=lambda row: row["error"], default=mine[0])
        names = ("problem", "tool", "intervals", "error", "cold_s", "warm_s")
        first.append({name: best[name] for name in names} | {"reached": bool(near)})
    return first


def readme_table(first: Sequence[dict[str, Any]]) -> str:
    """A table in Markdown: seconds cold / warm at the first mesh within ASKED; the error where none is."""
    tools = list(dict.fromkeys(row["tool"] for row in first))
    lines = ["| | " + " | ".join(tools) + " |", "|---|" + "---|" * len(tools)]
    for problem in dict.fromkeys(row["problem"] for row in first):
        cells = []
        for tool in tools:
            row = next(row for row in first if (row["problem"], row["tool"]) == (problem, tool))
            cell = "-" if row["error"] is None else f"{seconds(row['cold_s'])} / {seconds(row['warm_s'])}"
            cells.append(cell if row["reached"] or cell == "-" else f"{cell} ({power(row['error'])})")
        lines.append(f"| {problem} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


def write_readme(readme: Path, first: Sequence[dict[str, Any]]) -> None:
    """Put the table between its marks."""
    text = readme.read_text(encoding="utf-8")
    begin, end = (text.index(mark) for mark in README_MARKS)
    readme.write_text(f"{text[:begin]}{README_MARKS[0]}\n{readme_table(first)}\n{text[end:]}", encoding="utf-8")


def seconds(value: float) -> str:
    """Milliseconds in two digits."""
    digits = 1 - math.floor(math.log10(1e3 * value))
    return f"{round(1e3 * value, digits):.{max(digits, 0)}f}"


def power(value: float) -> str:
    """An error in one digit."""
    return f"{value:.0e}".replace("e-0", "e-")


def report(summary: dict[str, Any]) -> str:
    """The first meshes that are near enough, and what there is."""
    failed = [row for row in summary["rows"] if row["failed"]]
    lines = [text_table(summary["first"], 4), *(f"{name}: {of}" for name, of in summary["versions"].items())]
    lines += [f"{row['tool']}, {row['problem']}, {row['intervals']} intervals: {row['failed']}" for row in failed]
    return "\n".join(lines)


def plot(path: Path, summary: dict[str, Any]) -> None:
    """Error of the cost over the time of the cold solve and of the one after it, for every problem and tool."""
    rows = [row for row in summary["rows"] if row["error"] is not None]
    problems = [name for name in STATEMENTS if any(row["problem"] == name for row in rows)]
    note = (
        "Filled: posed and solved; hollow: solved again with another parameter from the plan before. Meshes of "
        f"{', '.join(map(str, MESHES))} intervals; time of the processor of one run, without imports. "
        "Same formulas, guess and degree (Drake: cubic), IPOPT at 1e-9 (Dymos: SLSQP; Drake: SNOPT, else IPOPT)."
    )
    with drawing.sheet(path, (2, 3), (9.0, 6.0), note) as (figure, axes):
        for axis, problem in zip(axes.ravel(), problems, strict=False):
            for tool, (mark, color) in MARKS.items():
                mine = [row for row in rows if (row["problem"], row["tool"]) == (problem, tool)]
                errors = [max(row["error"], 1e-14) for row in mine]
                style: Any = {"color": drawing.COLORS[color], "marker": mark, "ms": 4, "lw": 1}
                axis.loglog([row["cold_s"] for row in mine], errors, "-", label=tool, **style)
                axis.loglog([row["warm_s"] for row in mine], errors, ":", **style, mfc="white")
            axis.axhline(TOLERANCE, color=drawing.COLORS["grey"], lw=0.7)
            axis.set(title=problem)
        for axis in axes[-1]:
            axis.set_xlabel("time, s")
        for axis in axes[:, 0]:
            axis.set_ylabel("relative error of the cost")
        handles, labels = axes[0, 0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside upper center", ncols=len(labels))
