"""The scripts are short, and run as files from anywhere and as modules."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from tests.families import some

FOLDER = Path(__file__).resolve().parents[2] / "scripts"
OPTIONS = {
    "free_floating": ["--out"],
    "standing": ["--out"],
    "blend": ["--out"],
    "cts": ["--out"],
    "gallery": ["--out", "--only", "space_arm", "panda", "ur5", "posture_set", "mobile_manipulator", "pushing"],
    "benchmark": ["--out", "--only", "--repeats", "costate_rate"],
    "reproduce": ["--out", "--only", "free_floating"],
    "suite": ["--out", "--problems"],
}
"""What each of them tells of its options."""


@pytest.mark.parametrize("name", some(OPTIONS, 3))
def test_every_script_is_short_and_runs_as_a_file_from_anywhere(name: str, tmp_path: Path) -> None:
    file = FOLDER / f"{name}.py"
    assert len(file.read_text(encoding="utf-8").splitlines()) < 100
    command = [sys.executable, str(file), "--help"]
    report = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=True, timeout=120).stdout
    assert all(option in report for option in OPTIONS[name])


@pytest.mark.long
def test_a_script_runs_as_a_module() -> None:
    command = [sys.executable, "-m", "scripts.reproduce", "--help"]
    report = subprocess.run(command, cwd=FOLDER.parent, capture_output=True, text=True, check=True, timeout=120).stdout
    assert "--only" in report


def test_there_is_no_other_script() -> None:
    assert {file.stem for file in FOLDER.glob("*.py")} == {*OPTIONS, "drawing"}
