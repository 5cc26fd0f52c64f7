"""The guide to goals claims what the committed results of MotionBenchMaker say."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from tests.sweep.results import rows_of

ROOT = Path(__file__).resolve().parents[2]


def test_the_guide_to_goals_has_the_numbers_of_the_rows() -> None:
    rows = rows_of(ROOT / "results" / "sweeps" / "motion_bench_maker.jsonl").values()
    shortest = [row for row in rows if not row["kind"].endswith("time")]
    fastest = [row for row in rows if row["kind"].endswith("time")]
    assert not [row for row in rows if row["wrong"]]
    page = " ".join((ROOT / "docs" / "tutorials" / "goals.md").read_text(encoding="utf-8").split())
    claims = re.search(
        r"has (\d+) problems .* length is ([\d.]+) rad, the median planning time ([\d.]+) s of one core, the longest "
        r"(\d+) s\. .* all (\d+) are .*; (\d+) motions last at most 0\.3 %",
        page,
    )
    assert claims is not None
    near = sum(row["cost"] <= 1.003 * row["bound"] for row in fastest)
    numbers = [len(shortest), round(float(np.mean([row["length"] for row in shortest])), 2)]
    numbers += [round(float(np.median([row["cpu"] for row in shortest])), 1)]
    numbers += [round(max(row["seconds"] for row in shortest)), len(fastest), near]
    assert [float(claim) for claim in claims.groups()] == numbers
