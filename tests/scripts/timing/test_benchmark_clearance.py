"""The benchmark of clearance: what does not bind changes nothing, what binds is held, and proofs are settled."""

from __future__ import annotations

from pathlib import Path

import pytest

from scripts import benchmark
from scripts.timing import clearance


@pytest.mark.long
def test_plans_and_proofs_are_timed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(clearance, "SEEDS", 1)
    monkeypatch.setattr(clearance, "CASES", {"Panda": clearance.CASES["Panda"]})
    assert "clearance" in benchmark.PARTS
    numbers = clearance.run(1)
    plain, free, bound = numbers["rows"]
    assert plain["cost"] == pytest.approx(free["cost"], rel=1e-6)
    assert (plain["held"], free["held"]) == (0, 0)
    assert bound["held"] > 0
    assert bound["cost"] > plain["cost"]
    assert all(row["settled"] and row["pairs"] > 300 for row in numbers["proofs"])
    assert "4 times" in clearance.report(numbers)
    clearance.plot(tmp_path / "clearance.png", numbers)
    assert (tmp_path / "clearance.png").stat().st_size > 10_000
