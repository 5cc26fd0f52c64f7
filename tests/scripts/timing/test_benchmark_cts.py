"""The benchmark of the captive trajectory rig, and how scripts/benchmark.py runs its parts."""

from __future__ import annotations

import csv
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from models import optimal_inverse, reference_rig, reference_tunnel
from scripts import benchmark
from scripts.papers.cts.results import sweep_targets
from scripts.timing import cts as benchmark_cts


@pytest.mark.long
def test_a_part_is_run_and_its_tables_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(benchmark_cts, "COUNT", 8)
    monkeypatch.setattr(benchmark_cts, "PEER_COUNT", 2)
    monkeypatch.setattr(benchmark_cts, "has_compiler", lambda: False)
    assert "cts" in benchmark.PARTS
    benchmark.run_part("cts", tmp_path, 1)
    with (tmp_path / "cts.csv").open(newline="", encoding="utf-8") as stream:
        rows = list(csv.DictReader(stream))
    named = {(row["method"], row["targets"]): float(row["ns_per_target"]) for row in rows}
    assert named["map, I1, joint limits", "random"] > 0
    assert all(float(row["solved"]) == 1 for row in rows if "I1, reach" in row["method"])
    content: dict[str, Any] = json.loads((tmp_path / "cts.json").read_text(encoding="utf-8"))
    assert content["goals"]["compiled_limits_off_ns"]["figure"] is None
    with Image.open(tmp_path / "cts.png") as picture:
        assert picture.width > 600


@pytest.mark.long
def test_compiled_functions_equal_python_and_a_bad_row_affects_no_other() -> None:
    function = optimal_inverse(reference_rig(**benchmark_cts.LIMITS), reference_tunnel())
    rows = np.vstack([benchmark_cts.random_reachable(60), sweep_targets(20)])
    rows[[5, 17], [0, 3]] = np.nan, np.inf
    result = benchmark_cts.compiled_inverse(function, rows, 1)[0]
    joints, cost, active, status = (np.array(part) for part in function.map(80)(rows.T, np.zeros((1, 80))))
    np.testing.assert_array_equal(result[:, 8], status[0])
    np.testing.assert_array_equal(result[:, 7][status[0] == 0], active[0][status[0] == 0])
    np.testing.assert_allclose(result[:, :6], joints.T, rtol=0, atol=1e-9, equal_nan=True)
    np.testing.assert_allclose(result[:, 6], cost[0], rtol=0, atol=1e-12, equal_nan=True)
    assert set(np.flatnonzero(status[0] == 1)) == {5, 17}
