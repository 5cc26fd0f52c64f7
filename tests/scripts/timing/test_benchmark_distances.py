"""The benchmark of distances: what it measures is the same by every way, and its goals stand beside it."""

from __future__ import annotations

from pathlib import Path

import pytest

from scripts import benchmark
from scripts.timing import distances


def test_distances_are_timed_by_every_method(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(distances, "BOXES", 1)
    monkeypatch.setattr(distances, "CALLS", 1)
    assert "distances" in benchmark.PARTS
    numbers = distances.run(1)
    rows = numbers["rows"]
    assert all(row["us"] > 0 for row in rows)
    assert len({row["pairs"] for row in rows}) == 2
    assert "60 us" in distances.report(numbers)
    distances.plot(tmp_path / "distances.png", numbers)
    assert (tmp_path / "distances.png").stat().st_size > 10_000
