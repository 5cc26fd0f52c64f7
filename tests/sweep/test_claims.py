"""Pages claim what the committed results say."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from scripts.papers.reproduced import read_tables
from tests.sweep.results import rows_of

ROOT = Path(__file__).resolve().parents[2]


def test_the_guide_to_goals_has_the_numbers_of_the_rows() -> None:
    rows = rows_of(ROOT / "results" / "sweeps" / "motion_bench_maker.jsonl").values()
    shortest = [row for row in rows if not row["kind"].endswith("time")]
    fastest = [row for row in rows if row["kind"].endswith("time")]
    assert not [row for row in rows if row["wrong"]]
    page = " ".join((ROOT / "docs" / "tutorials" / "goals.md").read_text(encoding="utf-8").split())
    claims = re.search(
        r"has (\d+) problems .* path length is ([\d.]+) rad\. The median processor time of a plan is ([\d.]+) s, the "
        r"longest (\d+) s .* For all (\d+) problems a motion was found; (\d+) motions last at most 0\.3 %",
        page,
    )
    assert claims is not None
    near = sum(row["cost"] <= 1.003 * row["bound"] for row in fastest)
    numbers = [len(shortest), round(float(np.mean([row["length"] for row in shortest])), 2)]
    numbers += [round(float(np.median([row["cpu"] for row in shortest])), 1)]
    numbers += [round(max(row["cpu"] for row in shortest)), len(fastest), near]
    assert [float(claim) for claim in claims.groups()] == numbers


def test_pages_have_the_number_of_reproduced_results() -> None:
    tables = read_tables(ROOT / "results").values()
    verdicts = [row["reproduced"] for rows in tables for row in rows]
    counts = [len(verdicts), verdicts.count("yes")]
    for name in ("README.md", "CHANGELOG.md", "docs/papers.md"):
        page = " ".join((ROOT / name).read_text(encoding="utf-8").split())
        claims = re.search(r"Of the (\d+) results that the papers print as numbers, (\d+) are reproduced", page)
        assert claims is not None, name
        assert [int(claim) for claim in claims.groups()] == counts, name
    claims = re.search(r"are reproduced\. (\d+) differ", page)
    assert claims is not None
    assert int(claims[1]) == verdicts.count("no")
