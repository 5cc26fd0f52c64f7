"""The table of printed numbers: its rule, its reasons, that it reports what is missing, and the committed tables."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pytest

from scripts.papers.blend.example import PAPER_GAMMA, PAPER_SPEED_ERROR, PAPER_TIMES
from scripts.papers.reproduced import READERS, Printed, committed, read, read_tables, table, text, write_tables

RESULTS = Path(__file__).resolve().parents[3] / "results"
METHODS = ("pseudo-inverse", "optimum")
LAWS = {"table1": ("augmented", "joint_limits", "all_layers"), "table2": ("augmented_spring",)}
SUMMARIES: Mapping[str, Mapping[str, Any]] = {
    "free_floating": {
        "paper": {
            "peak_joint_velocity_deg_s": {method: [10.0, 20.0, 30.0] for method in METHODS},
            "joint_acceleration_at_peak_deg_s2": {method: [1.0, 2.0, 3.0] for method in METHODS},
        },
        "caveats": {"accelerations": dict.fromkeys(METHODS, "the peak is inside the motion")},
        **{
            method: {
                "peak_joint_velocity_deg_s": [10.05, 25.0, 30.0],
                "joint_acceleration_at_peak_deg_s2": [0.0, 2.0, 3.0],
                "min_manipulability_time_s": 3.2,
            }
            for method in ("pseudo_inverse", "optimal")
        },
    },
    "standing": {
        group: {law: {"reaches_s": 1.1, "reason": "lift_off"} for law in laws} for group, laws in LAWS.items()
    },
    "blend": {
        "gamma_table": [[remaining, *values] for remaining, values in PAPER_GAMMA.items()],
        "blend_times_s": [PAPER_TIMES[0] + 0.1, *PAPER_TIMES[1:]],
        "speed_error_mm_s": {"predictor_corrector_2ms": PAPER_SPEED_ERROR},
    },
    "cts": {
        "paper": {"table6_s": {"jacobian": 0.2376, "combined": 0.0281}},
        "arithmetic_seconds_of_200_targets": {"jacobian, gain 20": 0.01, "combined": 0.002},
        "time_ratio_jacobian_over_combined": 5.0,
    },
}
"""Summaries as the scripts write them, with numbers of which some are reproduced and some are not."""


@pytest.fixture
def written(tmp_path: Path) -> Path:
    for paper, summary in SUMMARIES.items():
        (tmp_path / paper).mkdir()
        (tmp_path / paper / "summary.json").write_text(json.dumps(summary), encoding="utf-8")
    return tmp_path


def test_one_per_cent_or_a_unit_of_the_last_digit_is_reproduced() -> None:
    def reproduced(value: float, ours: float, decimals: int) -> bool:
        return Printed("", "", "", value, ours, decimals).reproduced

    assert reproduced(200.0, 201.99, 3)
    assert reproduced(-200.0, -198.01, 3)
    assert not reproduced(200.0, 202.01, 3)
    assert not reproduced(200.0, -200.0, 3)
    assert reproduced(0.4, 0.49, 1)
    assert not reproduced(0.4, 0.51, 1)
    assert not reproduced(0.4, 0.49, 2)
    assert reproduced(0.0, 0.0009, 3)
    assert not reproduced(1.0, float("nan"), 0)


def test_every_number_is_reproduced_or_gives_its_reason(written: Path) -> None:
    numbers, missing = read(written)
    assert not missing
    assert {number.paper for number in numbers} == set(READERS)
    for row in table(numbers):
        assert bool(row["why"]) != row["reproduced"], row
        assert row["difference"] == row["ours"] - row["printed"]
    printed = text(numbers, missing)
    assert printed.splitlines()[-1].startswith(
        f"{sum(number.reproduced for number in numbers)} of {len(numbers)} numbers"
    )
    for number in numbers:
        assert number.quantity in printed
        assert number.reproduced or printed.count(f" {number.why}\n") == 1


def test_a_table_of_a_paper_rounds_as_the_paper_and_holds_no_duration(written: Path) -> None:
    numbers, _ = read(written)
    write_tables(written, numbers)
    tables = read_tables(written)
    assert {paper: len(rows) for paper, rows in tables.items()} == {
        paper: sum(number.paper == paper for number in numbers) for paper in READERS
    }
    first, second = tables["free_floating"][:2]
    assert (first["printed"], first["ours"], first["reproduced"], first["why"]) == ("10.000", "10.050", "yes", "")
    assert second["reproduced"] == "no"
    assert "link length" in second["why"]
    assert {(row["ours"], row["reproduced"]) for row in tables["cts"]} == {("", "")}
    assert committed([Printed("", "", "", 1.0, -1e-9, 3)])[0]["ours"] == "0.000"
    write_tables(written / "none", [])
    assert not (written / "none").exists()


@pytest.mark.parametrize("name", READERS)
def test_a_summary_that_is_missing_or_damaged_is_reported_and_the_others_are_read(name: str, written: Path) -> None:
    whole, _ = read(written)
    file = written / name / "summary.json"
    for content in (None, "{", "{}", "[]", json.dumps({"paper": 3})):
        if content is None:
            file.unlink()
        else:
            file.write_text(content, encoding="utf-8")
        numbers, (missing,) = read(written)
        assert missing.startswith(f"{name}: ")
        assert [number.quantity for number in numbers] == [n.quantity for n in whole if n.paper != name]
        assert f"missing: {name}" in text(numbers, [missing])


def test_a_change_of_our_number_changes_the_count(written: Path) -> None:
    before, _ = read(written, ["blend"])
    summary = json.loads((written / "blend" / "summary.json").read_text(encoding="utf-8"))
    summary["gamma_table"][0][1] *= 1.1
    (written / "blend" / "summary.json").write_text(json.dumps(summary), encoding="utf-8")
    after, _ = read(written, ["blend"])
    assert sum(number.reproduced for number in after) == sum(number.reproduced for number in before) - 1


def test_the_printed_ratio_of_times_is_that_of_the_printed_times(written: Path) -> None:
    (ratio,) = (number for number in read(written, ["cts"])[0] if number.quantity == "times of both, ratio")
    assert abs(ratio.printed - 8.45) < 0.01  # printed in the paper's text, too


def test_the_committed_tables_cover_every_number(written: Path) -> None:
    numbers, _ = read(written)
    for paper, rows in read_tables(RESULTS).items():
        assert [row["quantity"] for row in rows] == [number.quantity for number in numbers if number.paper == paper]
        assert all(row["why"] or row["reproduced"] == "yes" for row in rows)
