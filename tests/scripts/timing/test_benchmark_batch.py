"""The benchmark of batches runs and says what it measures; how long things take is not tested."""

from __future__ import annotations

from pathlib import Path

import pytest
from PIL import Image

from scripts import benchmark
from scripts.timing import batch
from scripts.timing.placing import nothing, placed


@pytest.mark.long
def test_batches_are_measured_and_drawn(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(batch, "PLANS", 2)
    monkeypatch.setattr(batch, "placed", nothing)
    monkeypatch.setattr(batch, "SHORT", 30)
    monkeypatch.setattr(batch, "CUT", 10)
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)  # as without Dask, which takes its time to start
    numbers = benchmark.run_part("batch", tmp_path, 1)
    assert [(row["plans"], row["passed"]) for row in numbers["rows"]] == [(2, 0), (2, 0)]  # nothing has no audit
    assert all(row["same_costs"] for row in numbers["rows"])
    assert all(0 < row["busy_workers"] <= 2 for row in numbers["rows"])
    assert [row["record"] for row in numbers["short"]] == list(range(30))
    assert numbers["goals"]["Dask, two workers"]["figure"] is None
    assert "of 30 short tasks" in batch.report(numbers)
    shares = [numbers["goals"][f"{path}, share"]["figure"] for path in ("two workers", "Dask, two workers")]
    gains = [row["times_one_worker"] for row in numbers["rows"]]
    assert shares == [pytest.approx(gains[1] / numbers["plain"]["gain"]), None]
    with Image.open(tmp_path / "batch.png") as picture:
        assert picture.size[0] > 500
    assert "batch" in benchmark.PARTS


def test_a_part_in_reach_is_planned_for() -> None:
    assert placed({"x": 0.45, "y": -0.1}).audit().passed
