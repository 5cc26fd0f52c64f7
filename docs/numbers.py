"""Tables of the numbers that the papers print beside ours, in place of `<!-- numbers of the papers -->`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from scripts.papers.reproduced import read_tables

__all__ = ["MARK", "listed", "setup"]

MARK = "<!-- numbers of the papers -->"
RESULTS = Path(__file__).resolve().parents[1] / "results"


def listed(tables: Mapping[str, Sequence[Mapping[str, str]]]) -> str:
    """Markdown of the tables of all papers: the number of reproduced values, the values, and reasons of differences."""
    compared = [row for rows in tables.values() for row in rows if row["ours"]]
    count = sum(row["reproduced"] == "yes" for row in compared)
    parts = [f"**{count} of {len(compared)} numbers are reproduced.** Computing times are left blank.\n"]
    for paper, rows in tables.items():
        reasons = list(dict.fromkeys(row["why"] for row in rows if row["why"]))
        parts.append(f"### {paper}\n\n| | | printed | ours | reproduced |\n|---|---|---:|---:|---|")
        for row in rows:
            verdict = f"{row['reproduced']} ({reasons.index(row['why']) + 1})" if row["why"] else row["reproduced"]
            cells = (row["place"], row["quantity"], row["printed"], row["ours"], verdict.strip())
            parts.append(f"| {' | '.join(cells)} |")
        parts += ["", *(f"{number}. {why}." for number, why in enumerate(reasons, 1)), ""]
    return "\n".join(parts)


def setup(app: Any) -> dict[str, bool]:
    """For Sphinx."""

    def fill(app: Any, name: str, content: list[str]) -> None:
        if MARK in content[0]:
            content[0] = content[0].replace(MARK, listed(read_tables(RESULTS)))

    app.connect("source-read", fill)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
