"""Where a page says `<!-- numbers of the papers -->`: every number that they print beside ours, out of results/."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import groupby
from pathlib import Path
from typing import Any

from scripts.papers.reproduced import Printed, read

__all__ = ["MARK", "listed", "setup"]

MARK = "<!-- numbers of the papers -->"
RESULTS = Path(__file__).resolve().parents[1] / "results"


def listed(found: Sequence[Printed]) -> str:
    """Markdown: how many are reproduced, and for each paper a table and, below it, why what differs does."""
    count = sum(one.reproduced for one in found)
    parts = [f"**{count} of {len(found)} numbers are reproduced.**\n"]
    for paper, group in groupby(found, key=lambda one: one.paper):
        numbers = [*group]
        reasons = list(dict.fromkeys(one.why for one in numbers if not one.reproduced))
        parts.append(f"### {paper}\n\n| | | printed | ours | reproduced |\n|---|---|---:|---:|---|")
        for one in numbers:
            verdict = "yes" if one.reproduced else f"no ({reasons.index(one.why) + 1})"
            parts.append(f"| {one.place} | {one.quantity} | {one.printed:.6g} | {one.ours:.4g} | {verdict} |")
        parts.append("")
        parts += [f"{number}. {why}." for number, why in enumerate(reasons, 1)]
        parts.append("")
    return "\n".join(parts)


def setup(app: Any) -> dict[str, bool]:
    """For Sphinx."""

    def fill(app: Any, name: str, content: list[str]) -> None:
        if MARK in content[0]:
            found, missing = read(RESULTS)
            if missing:
                raise RuntimeError(f"{name}: {'; '.join(missing)}")
            content[0] = content[0].replace(MARK, listed(found))

    app.connect("source-read", fill)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
