"""The benchmark of the audit times what it says and compares it with the solve; how long things take is not tested."""

from __future__ import annotations

import csv
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from scripts import benchmark
from scripts.timing import audit as benchmark_audit

pytestmark = pytest.mark.xdist_group("benchmark_audit")  # one process, so that the cases are timed once


@pytest.fixture(scope="module")
def measured_audit(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, Any]]:
    folder = tmp_path_factory.mktemp("benchmark")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(benchmark_audit, "INTERVALS", (50, 100))
        return folder, benchmark.run_part("audit", folder, 1)


@pytest.mark.long
def test_every_case_is_timed_on_every_number_of_intervals(measured_audit: tuple[Path, dict[str, Any]]) -> None:
    _, numbers = measured_audit
    named = [(row["case"], row["intervals"]) for row in numbers["rows"]]
    assert named == [(case, n) for case in benchmark_audit.CASES for n in (50, 100)]
    for row in numbers["rows"]:
        assert np.isfinite([row["build_s"], row["solve_s"], row["audit_s"], row["first_audit_s"]]).all()
        assert row["audit_over_solve"] == pytest.approx(row["audit_s"] / row["solve_s"])
        assert row["audit_ms_an_interval"] == pytest.approx(1e3 * row["audit_s"] / row["intervals"])


@pytest.mark.long
def test_the_worst_ratio_and_growth_stand_beside_their_goals(measured_audit: tuple[Path, dict[str, Any]]) -> None:
    _, numbers = measured_audit
    assert numbers["worst_ratio"] == max(row["audit_over_solve"] for row in numbers["rows"])
    assert numbers["worst_growth_over_linear"] == pytest.approx(1.0)  # from 100 to 100 intervals
    assert numbers["goals"] == {"worst_ratio": 1.0, "worst_growth_over_linear": 1.2}
    assert "audit over solve, worst" in benchmark_audit.report(numbers)


@pytest.mark.long
def test_tables_and_the_picture_are_written(measured_audit: tuple[Path, dict[str, Any]]) -> None:
    folder, numbers = measured_audit
    assert "audit" in benchmark.PARTS
    assert json.loads((folder / "audit.json").read_text(encoding="utf-8"))["worst_ratio"] == numbers["worst_ratio"]
    with (folder / "audit.csv").open(newline="", encoding="utf-8") as stream:
        assert len(list(csv.DictReader(stream))) == len(numbers["rows"])
    with Image.open(folder / "audit.png") as picture:
        assert picture.width > 900
