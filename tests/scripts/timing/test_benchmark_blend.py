"""The benchmark of the blends runs and says what it measures; how long things take is not tested."""

from __future__ import annotations

import importlib
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from models import smooth
from scripts.papers.blend.example import REMAINING, example
from scripts.papers.run import write
from scripts.timing import blend as benchmark_blend
from scripts.timing.measure import has_compiler

pytestmark = [pytest.mark.xdist_group("benchmark_blend"), pytest.mark.long]


@pytest.fixture(scope="module")
def summary() -> dict[str, Any]:
    return benchmark_blend.run(1, segments=(20, 40))


def by_method(summary: dict[str, Any]) -> dict[str, dict[str, float]]:
    return {row["method"]: row for row in summary["rows"]}


def test_every_method_is_timed_and_as_accurate_as_it_is(summary: dict[str, Any]) -> None:
    rows = by_method(summary)
    assert len(rows) == len(summary["rows"])
    assert all(np.isfinite(row["ns_per_sample"]) and row["ns_per_sample"] > 0 for row in rows.values())
    paths = ("map", "march", *(("compiled",) if has_compiler() else ()))
    for how in paths:
        # the drift at a blend's end that was checked for 1 ms: 3.73 um, and rounding
        assert rows[f"predictor_corrector, cubic, {how}"]["worst_error_um"] == pytest.approx(3.73, abs=0.01)
        for kind in ("cubic", "quintic"):
            assert rows[f"gauss_newton, {kind}, {how}"]["worst_error_um"] < 1e-6
    assert rows["SmoothPath.parameter, quintic, numpy"]["worst_error_um"] < 1e-6
    assert rows["brentq, quintic, scipy"]["worst_error_um"] < 1e-6
    assert 1e-3 < rows["table lookup, cubic, numpy"]["worst_error_um"] < 1


def test_the_targets_name_the_figures_they_are_for(summary: dict[str, Any]) -> None:
    targets = summary["targets"]
    assert set(targets) == {"compiled_default_ns", "planning_example_ms", "largest_scale_s"}
    if has_compiler():
        default = by_method(summary)["gauss_newton, cubic, compiled"]
        assert targets["compiled_default_ns"]["figure"] == default["ns_per_sample"]
    assert targets["planning_example_ms"]["figure"] == summary["planning"][0]["ms"]
    assert targets["largest_scale_s"]["figure"] == summary["scale"][-1]["total_s"]


def test_the_plans_are_those_of_the_example(summary: dict[str, Any]) -> None:
    durations = [row["duration_s"] for row in summary["planning"]]
    assert durations[0] == pytest.approx(1.868825, abs=1e-6)
    # jerks held over intervals cost the reference as much as 1 %; the schedule is not bound to them
    assert durations[2] * 0.9 < durations[3] < durations[2] * 1.01
    assert max(summary["profiles"]["ours"]["speed"]) == pytest.approx(1.0, abs=1e-9)
    peer = summary["toppra"]
    if isinstance(peer, dict):  # its speed is not constant: per-axis limits slow the blend, or let it pass 1 m/s
        slow, fast = peer["plans"]
        assert slow["least_speed_in_blend"] < 0.6
        assert fast["largest_speed"] > 1.1


def test_long_paths_keep_their_speed(summary: dict[str, Any]) -> None:
    for row, segments in zip(summary["scale"], (20, 40), strict=True):
        assert row["segments"] == segments
        assert row["largest_chord_speed"] < benchmark_blend.TASK_SPEED * 1.001
        assert row["samples"] == int(np.ceil(row["duration_s"] / benchmark_blend.PERIOD)) + 1
        assert row["peak_memory_kB_per_segment"] > 0
    first, again = benchmark_blend.random_task(5), benchmark_blend.random_task(5)
    assert np.array_equal(first.start, again.start)


def test_it_is_written_and_drawn(summary: dict[str, Any], tmp_path: Path) -> None:
    write(tmp_path / "blend.json", summary)
    read = json.loads((tmp_path / "blend.json").read_text(encoding="utf-8"))
    assert list(read) == ["rows", "planning", "scale", "toppra", "profiles", "targets"]
    benchmark_blend.plot(tmp_path / "blend.png", read)
    assert (tmp_path / "blend.png").stat().st_size > 10_000


def test_peers_that_are_not_installed_are_left_out(monkeypatch: pytest.MonkeyPatch) -> None:
    def missing(name: str) -> Any:
        raise ImportError(name)

    monkeypatch.setattr(importlib, "import_module", missing)
    path = smooth(example(), REMAINING)
    assert benchmark_blend.peer_plans(path, 1) is None
    assert benchmark_blend.roots(path.coefficients[0]) is None
