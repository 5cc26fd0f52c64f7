"""What a file of results says of the code that it is of."""

from __future__ import annotations

import csv
from pathlib import Path

import pytest

from tests.sweep.results import TABLE, Row, Sweep, code_of, parser, rows_of

COUNTS = {"small": 3, "large": 1}


def swept(file: Path, *options: str, code: str = "") -> tuple[Sweep, list[Row], list[tuple[str, int]]]:
    """A sweep into a file: what it yields, and which cases were done now."""
    sweep, done = Sweep(__file__, parser("", COUNTS).parse_args(["--out", str(file), *options]), COUNTS), []
    sweep.code = code or sweep.code

    def result(kind: str, seed: int, known: Row | None) -> Row:
        done.append((kind, seed))
        return {"seconds": 1.0, "length": 2.5, "wrong": ["dear"] * (kind == "large"), "before": known}

    return sweep, list(sweep.rows(result)), done


def test_recorded_cases_are_repeated_on_request_or_for_changed_code(tmp_path: Path) -> None:
    file = tmp_path / "made" / "some.jsonl"
    cases = [("small", 0), ("large", 0), ("small", 1), ("small", 2)]  # the kinds in turn
    assert swept(file, "--count", "2", code="old")[2] == cases[:2]
    sweep, rows, done = swept(file)
    assert done == cases[2:]
    assert [row["code"] == sweep.code for row in rows] == [False, False, True, True]
    assert sweep.summary(rows) == "4 of 4 cases: 2 of this code, 0 of them wrong; 2 of older code, 1 of them wrong"
    assert swept(file, "--again", "--minutes", "0")[2] == []
    sweep, rows, done = swept(file, "--again")
    assert done == cases[:2]
    assert all(row["code"] == sweep.code for row in rows)
    assert rows[0]["before"]["code"] == "old"  # a sweep may keep what is dear of it
    assert swept(file, "--again")[2] == []


def test_the_table_counts_the_last_result_of_each_case_by_the_code_of_it(tmp_path: Path) -> None:
    file = tmp_path / "some.jsonl"
    swept(file, code="old")
    code = swept(file, "--again", "--only", "large")[0].code
    with (tmp_path / TABLE).open() as table:
        matches = [
            (row["kind"], row["code"], row["cases"], row["wrong"], row["broken"], row["figures"])
            for row in csv.DictReader(table)
        ]
    assert matches == [("small", "old", "3", "0", "", ""), ("large", code, "1", "1", "dear 1", "length 2.5")]


def test_finished_cases_are_recorded_when_the_next_is_stopped(tmp_path: Path) -> None:
    file = tmp_path / "some.jsonl"
    sweep = Sweep(__file__, parser("", COUNTS).parse_args(["--out", str(file)]), COUNTS)

    def stopped(kind: str, seed: int, known: Row | None) -> Row:
        if seed:
            raise KeyboardInterrupt
        return {"seconds": 1.0, "wrong": []}

    with pytest.raises(KeyboardInterrupt):
        list(sweep.rows(stopped))
    assert list(rows_of(file)) == [("small", 0), ("large", 0)]
    assert swept(file)[2] == [("small", 1), ("small", 2)]


def test_the_code_is_another_when_a_source_of_a_plan_is_and_not_when_one_that_draws_is(tmp_path: Path) -> None:
    for room in ("planning", "app"):
        (tmp_path / "ocp" / room).mkdir(parents=True)
        (tmp_path / "ocp" / room / "some.py").write_text("one = 1\n")
    for package in ("ocp", "models"):
        (tmp_path / package).mkdir(exist_ok=True)
        (tmp_path / package / "__init__.py").touch()
    before = code_of(Path(__file__), tmp_path)
    (tmp_path / "ocp" / "app" / "some.py").write_text("one = 2\n")
    assert code_of(Path(__file__), tmp_path) == before
    (tmp_path / "ocp" / "planning" / "some.py").write_text("one = 2\n")
    changed = code_of(Path(__file__), tmp_path)
    assert changed != before
    (tmp_path / "ocp" / "planning" / "some.py").rename(tmp_path / "models" / "some.py")
    assert code_of(Path(__file__), tmp_path) not in (before, changed)
