"""The benchmark of the methods: both ways to build find one optimum, numbers stand where they are sought."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from scripts import benchmark
from scripts.timing import build_and_solve, costate_rate


@pytest.mark.long
def test_the_loop_of_constraints_finds_the_optimum_of_the_package(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(build_and_solve, "INTERVALS", (50, 100))
    numbers = benchmark.run_part("build_and_solve", tmp_path, 1)
    assert [row["intervals"] for row in numbers["rows"]] == [50, 100]
    for row in numbers["rows"]:
        assert abs(row["cost_difference"]) < 1e-9
        assert row["build_ratio"] == pytest.approx(row["opti_build_s"] / row["build_s"])
    assert numbers["build_ratio_at_100"] == numbers["rows"][1]["build_ratio"]
    assert 0 < numbers["import_ocp_s"] < 60
    endings = ("csv", "png", "svg", "caption.txt")
    assert {path.name for path in tmp_path.iterdir()} == {f"build_and_solve.{ending}" for ending in endings}


@pytest.mark.long
def test_costates_are_timed_by_four_methods(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(costate_rate, "JOINTS", (3, 7))
    numbers = costate_rate.run(1)
    for row, joints in zip(numbers["rows"], (3, 7), strict=True):
        assert row["joints"] == joints
        times = [row[f"{path}_us"] for path in ("casadi_vm", "compiled", "recursion_numpy", "finite_differences")]
        assert np.isfinite(times).all()
        assert row["recursion_over_compiled"] == pytest.approx(times[2] / times[1])
    assert numbers["recursion_over_compiled_at_7"] == numbers["rows"][1]["recursion_over_compiled"]
    assert "7 joints" in costate_rate.report(numbers)


def test_the_summary_holds_the_numbers_of_both_and_the_others_have_their_own_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    by_name: dict[str, dict[str, Any]] = {
        "build_and_solve": {"rows": [{"intervals": 100}], "build_ratio_at_100": 2.0},
        "costate_rate": {"rows": [{"joints": 7}], "recursion_over_compiled_at_7": 3.0},
    }
    monkeypatch.setattr(benchmark, "run_part", lambda name, folder, repeats: by_name[name])
    for module in (build_and_solve, costate_rate):
        monkeypatch.setattr(module, "report", lambda numbers: "")
    assert benchmark.main(["--out", str(tmp_path), "--only", *by_name]) == 0
    assert json.loads((tmp_path / "benchmark" / "summary.json").read_text(encoding="utf-8")) == {
        "build_and_solve": [{"intervals": 100}],
        "build_ratio_at_100": 2.0,
        "costate_rate": [{"joints": 7}],
        "recursion_over_compiled_at_7": 3.0,
    }
