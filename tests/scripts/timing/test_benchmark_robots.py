from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from scripts.timing import robots as benchmark_robots


def test_formulas_of_the_generalized_jacobian_agree_and_are_drawn(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The script compares the results before it compares the times."""
    monkeypatch.setattr(benchmark_robots, "has_compiler", lambda: False)
    names = ("UR5", "space arm")
    monkeypatch.setattr(benchmark_robots, "ROBOTS", {name: benchmark_robots.ROBOTS[name] for name in names})
    summary = benchmark_robots.run(repeats=1)
    assert [(row["robot"], row["joints"], row["links"]) for row in summary["loading"]] == [
        ("UR5", 6, 11),
        ("space arm", 7, 9),
    ]
    assert [row["by"].split()[0] for row in summary["space_arm"]] == ["map", "one", "Pinocchio"]
    benchmark_robots.plot(tmp_path / "robots.png", summary)
    with Image.open(tmp_path / "robots.png") as picture:
        assert picture.size[0] > 1000


def test_functions_that_differ_are_not_timed() -> None:
    with pytest.raises(RuntimeError, match=r"ours: the generalized Jacobian differs by 1.0e-09"):
        benchmark_robots.check(np.array([1.0 + 1e-9]), np.array([1.0]), "ours")


def test_missing_peers_are_omitted(monkeypatch: pytest.MonkeyPatch) -> None:
    missing: dict[str, Any] = {name: ("no-such-distribution", "robot.urdf", {}) for name in ("UR5", "space arm")}
    monkeypatch.setattr(benchmark_robots, "ROBOTS", missing)
    assert benchmark_robots.run(repeats=1) == {"loading": [], "space_arm": [], "goals_us": benchmark_robots.GOALS}
