"""The table of the public suites as the page of the documentation shows it."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from .library import entries, module_of

PAGE = Path(__file__).resolve().parents[3] / "docs" / "suite.md"
MARKS = ("<!-- made by scripts/suite.py -->", "<!-- end -->")
WORDS = {"True": "yes", "False": "no"}
"""Of verdicts of the audit."""
HEAD = (
    "| problem | cost | printed | verdict | digits | feasible | minimum | s | refined, s | rockit, s | PSOPT, s "
    "| automatic, s |"
)


def table(rows: Mapping[str, Mapping[str, str]]) -> str:
    """The rows as Markdown."""
    lines = [HEAD, "|---|---:|---:|---|---:|---|---|---:|---:|---:|---:|---:|"]
    for name, row in rows.items():
        rockit = row["rockit_seconds"] if row["rockit_cost"].lstrip("-")[:1].isdigit() else ""
        times = (row["seconds"], row["refined_seconds"], rockit, row["psopt_seconds"])
        cells = (
            f"[{name}](../tests/conformance/suite/{module_of(name)}.py)",
            f"{float(row['cost']):.8g}" if row["cost"] else "-",
            f"{float(row['exact']):.8g} (exact)" if row["exact"] else row["published"] or "-",
            row["verdict"] or "-",
            f"{float(row['digits']):.0f}" if row["digits"] else "-",
            WORDS.get(row["feasible"], "-"),
            WORDS.get(row["optimal"], "undetermined" if row["feasible"] else "-"),
            *(f"{float(seconds):.2g}" if seconds else "-" for seconds in times),
            automatic(row),
        )
        lines.append(f"| {' | '.join(cells)} |")
    missing = [name for name in entries() if name not in rows]
    lines += [f"| {name} |{' - |' * HEAD.count(' |')}".removesuffix(" - |") for name in missing]
    return "\n".join(lines)


def automatic(row: Mapping[str, str]) -> str:
    """Seconds of the solve without a method, with the guess that it needed; "no" where it misses the cost."""
    if not row["automatic"]:
        return "-"
    if row["automatic"] != "True":
        return "no"
    return f"{float(row['automatic_seconds']):.2g}" + " (guess)" * (row["automatic_start"] == "guess")


def write_page(page: Path, rows: Mapping[str, Mapping[str, str]]) -> None:
    """Put the table between its marks."""
    text = page.read_text(encoding="utf-8")
    begin, end = (text.index(mark) for mark in MARKS)
    page.write_text(f"{text[:begin]}{MARKS[0]}\n{table(rows)}\n{text[end:]}", encoding="utf-8")
