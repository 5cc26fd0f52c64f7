"""The table of printed numbers: its rule, its reasons, and that it says what is missing."""

from __future__ import annotations

import csv
import json
import shutil
from pathlib import Path

import pytest

from scripts.papers.reproduced import READERS, Printed, read, table, text, write_table

RESULTS = Path(__file__).resolve().parents[3] / "results"


def test_one_per_cent_or_a_unit_of_the_last_digit_is_reproduced() -> None:
    def printed(value: float, ours: float, decimals: int) -> bool:
        return Printed("", "", "", value, ours, decimals).reproduced

    assert printed(200.0, 201.99, 3)
    assert printed(-200.0, -198.01, 3)
    assert not printed(200.0, 202.01, 3)
    assert not printed(200.0, -200.0, 3)
    assert printed(0.4, 0.49, 1)
    assert not printed(0.4, 0.51, 1)
    assert not printed(0.4, 0.49, 2)
    assert printed(0.0, 0.0009, 3)
    assert not printed(1.0, float("nan"), 0)


def test_every_number_of_the_committed_results_is_reproduced_or_says_why() -> None:
    found, missing = read(RESULTS)
    assert not missing
    assert {one.paper for one in found} == set(READERS)
    for row in table(found):
        assert bool(row["why"]) != row["reproduced"], row
        assert row["difference"] == row["ours"] - row["printed"]
    told = text(found, missing)
    assert told.splitlines()[-1].startswith(f"{sum(one.reproduced for one in found)} of {len(found)} numbers")
    for one in found:
        assert one.quantity in told
        assert one.reproduced or told.count(f" {one.why}\n") == 1


def test_the_file_has_a_row_for_every_number(tmp_path: Path) -> None:
    found, _ = read(RESULTS)
    write_table(tmp_path, found)
    with (tmp_path / "reproduced.csv").open(encoding="utf-8") as stream:
        rows = list(csv.DictReader(stream))
    assert [row["quantity"] for row in rows] == [one.quantity for one in found]
    assert sum(row["reproduced"] == "yes" for row in rows) == sum(one.reproduced for one in found)
    write_table(tmp_path / "none", [])
    assert not (tmp_path / "none").exists()


@pytest.mark.parametrize("name", READERS)
def test_a_summary_that_is_not_there_or_not_whole_is_told_and_the_others_are_read(name: str, tmp_path: Path) -> None:
    whole, _ = read(RESULTS)
    for paper in READERS:
        (tmp_path / paper).mkdir()
        shutil.copy(RESULTS / paper / "summary.json", tmp_path / paper)
    file = tmp_path / name / "summary.json"
    for content in (None, "{", "{}", "[]", json.dumps({"paper": 3})):
        if content is None:
            file.unlink()
        else:
            file.write_text(content, encoding="utf-8")
        found, (missing,) = read(tmp_path)
        assert missing.startswith(f"{name}: ")
        assert [one.quantity for one in found] == [one.quantity for one in whole if one.paper != name]
        assert f"missing: {name}" in text(found, [missing])


def test_a_change_of_our_number_changes_the_count(tmp_path: Path) -> None:
    told = json.loads((RESULTS / "blend" / "summary.json").read_text(encoding="utf-8"))
    before, _ = read(RESULTS, ["blend"])
    told["gamma_table"][0][1] *= 1.1
    (tmp_path / "blend").mkdir()
    (tmp_path / "blend" / "summary.json").write_text(json.dumps(told), encoding="utf-8")
    after, _ = read(tmp_path, ["blend"])
    assert sum(one.reproduced for one in after) == sum(one.reproduced for one in before) - 1


def test_the_printed_ratio_of_times_is_that_of_the_printed_times() -> None:
    (ratio,) = (one for one in read(RESULTS, ["cts"])[0] if one.quantity == "times of both, ratio")
    assert abs(ratio.printed - 8.45) < 0.01  # printed in the paper's text, too
