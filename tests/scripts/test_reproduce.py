"""All papers with one command: what fails is told and does not stop the rest."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from types import ModuleType

import pytest

from scripts import reproduce

Main = Callable[[Sequence[str]], int]
ROOT = Path(__file__).resolve().parents[2]


def writes_a_file(arguments: Sequence[str]) -> int:
    assert arguments[0] == "--out"
    folder = Path(arguments[1]) / "good"
    folder.mkdir(parents=True)
    (folder / "summary.json").write_text("{}", encoding="utf-8")
    return 0


def raises(arguments: Sequence[str]) -> int:
    raise ValueError("the plan jumps")


def exits(arguments: Sequence[str]) -> int:
    sys.exit(3)


def fails_its_audit(arguments: Sequence[str]) -> int:
    return 1


def interrupted(arguments: Sequence[str]) -> int:
    raise KeyboardInterrupt


@pytest.fixture
def papers(monkeypatch: pytest.MonkeyPatch) -> Callable[..., None]:
    """Replaces the registered papers by functions."""

    def register(**mains: Main) -> None:
        for name, main in mains.items():
            module = ModuleType(f"paper_{name}")
            module.__dict__["main"] = main
            monkeypatch.setitem(sys.modules, module.__name__, module)
        monkeypatch.setattr(reproduce, "present", lambda: {name: f"paper_{name}" for name in mains})

    return register


def test_all_scripts_run_and_the_exit_status_is_zero(
    papers: Callable[..., None], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    papers(good=writes_a_file)
    assert reproduce.main(["--out", str(tmp_path)]) == 0
    assert (tmp_path / "good" / "summary.json").exists()
    printed = capsys.readouterr().out
    assert "ok" in printed
    assert str(tmp_path) in printed


@pytest.mark.parametrize(
    ("bad", "reason"),
    [(raises, "ValueError: the plan jumps"), (exits, "exit status 3"), (fails_its_audit, "exit status 1")],
)
def test_a_failing_script_does_not_stop_the_others(
    bad: Main, reason: str, papers: Callable[..., None], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    papers(bad=bad, good=writes_a_file)
    assert reproduce.main(["--out", str(tmp_path)]) == 1
    assert (tmp_path / "good" / "summary.json").exists()
    printed = capsys.readouterr().out
    assert reason in printed
    assert printed.rstrip().endswith("failed: bad")


def test_a_script_that_cannot_be_imported_is_told(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(reproduce, "present", lambda: {"missing": "scripts.no_such_paper"})
    assert reproduce.main(["--out", str(tmp_path)]) == 1
    assert "no_such_paper" in capsys.readouterr().out


def test_only_the_chosen_scripts_run(papers: Callable[..., None], tmp_path: Path) -> None:
    papers(bad=raises, good=writes_a_file)
    assert reproduce.main(["--out", str(tmp_path), "--only", "good"]) == 0


def test_an_unknown_paper_is_refused(papers: Callable[..., None], capsys: pytest.CaptureFixture[str]) -> None:
    papers(good=writes_a_file)
    with pytest.raises(SystemExit) as stop:
        reproduce.main(["--only", "other"])
    assert stop.value.code == 2
    assert "good" in capsys.readouterr().err


def test_an_interrupt_stops_everything(papers: Callable[..., None], tmp_path: Path) -> None:
    papers(slow=interrupted, good=writes_a_file)
    with pytest.raises(KeyboardInterrupt):
        reproduce.main(["--out", str(tmp_path)])
    assert not (tmp_path / "good").exists()


def test_every_present_script_is_registered_under_its_own_name() -> None:
    present = reproduce.present()
    assert "free_floating" in present
    for name, module in present.items():
        assert module == f"scripts.{name}"
        assert (ROOT / "scripts" / f"{name}.py").exists()


def test_it_runs_as_a_file_from_anywhere(tmp_path: Path) -> None:
    command = [sys.executable, str(ROOT / "scripts" / "reproduce.py"), "--help"]
    told = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=True, timeout=120)
    assert "--out" in told.stdout
    assert "free_floating" in told.stdout
