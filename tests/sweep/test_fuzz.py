"""A sample of the mutated files for every reader, and that what goes wrong is seen."""

from __future__ import annotations

import os
import signal
from pathlib import Path
from typing import Any

import pytest

from tests.families import some
from tests.sweep.fuzz import GOOD, KINDS, Kind, planted, trials, tried


@pytest.mark.parametrize("name", some(KINDS, 3))
def test_mutated_files_are_read_or_refused(name: str) -> None:
    matches = [trial for _, trial in trials(KINDS[name], 8, 7)]
    assert matches[0].outcome == "read", matches[0]
    assert [trial for trial in matches if trial.outcome not in GOOD] == []


def fills(file: Path) -> Any:
    return bytearray(10**9)


def waits(file: Path) -> None:
    while True:
        pass


def writes(file: Path) -> None:
    (file.parents[1] / "victim").write_text("stolen")


def raises(file: Path) -> None:
    raise KeyError(file)


def crashes(file: Path) -> None:
    os.kill(os.getpid(), signal.SIGKILL)


@pytest.mark.parametrize(
    ("read", "outcome"),
    [(fills, "memory"), (waits, "hang"), (writes, "written"), (raises, "foreign"), (crashes, "crash")],
)
def test_failures_are_detected(read: Any, outcome: str, tmp_path: Path) -> None:
    assert tried(Kind(".csv", lambda: b"", read), b"", planted(tmp_path)).outcome == outcome
