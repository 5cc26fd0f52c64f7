"""The benchmark of the schedules runs and says what it measures; how long things take is not tested."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from scripts import benchmark
from scripts.timing import schedules


def test_schedules_are_measured_and_drawn(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(schedules, "solve_minimum_time", lambda *_, guess, **__: guess)  # which takes some 10 s
    monkeypatch.setattr(schedules, "CASES", dict.fromkeys(schedules.CASES, ((20, 1.0, None),)))
    numbers = {
        "rows": [schedules.row(case, 20, 1) | {"goal_s": 1.0} for case in schedules.CASES],
        "arms": [schedules.arm_row(seed) for seed in range(2)],
        "toppra": [],
        "goals": {},
    }
    for row in numbers["rows"]:
        assert row["segments"] == 20
        assert row["seconds"] > 0
        assert row["duration_s"] > 0
    for row in numbers["arms"]:
        assert row["longer"] == 0.0
        assert row["largest_demand"] <= 1.001
    assert "2 random arms" in schedules.report(numbers)
    schedules.plot(tmp_path / "schedules.png", numbers)
    with Image.open(tmp_path / "schedules.png") as picture:
        assert picture.size[0] > 500
    assert "schedules" in benchmark.PARTS


def test_the_waves_have_the_derivatives_that_they_say() -> None:
    _, joints, _ = schedules.random_arm(0)
    s, h = np.linspace(0.1, 0.5, 9), 1e-5
    before, here, after = (joints.at(s + k * h) for k in (-1, 0, 1))
    for low, high in (("position", "first"), ("first", "second"), ("second", "third")):
        slope = (getattr(after, low) - getattr(before, low)) / (2 * h)
        assert slope == pytest.approx(getattr(here, high), rel=1e-5, abs=1e-5)
