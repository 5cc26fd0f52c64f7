"""All papers with one command: what fails is told and does not stop the rest."""

from __future__ import annotations

import importlib
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from types import ModuleType

import pytest

from scripts import reproduce

Main = Callable[[Sequence[str]], int]


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
        monkeypatch.setattr(reproduce, "PAPERS", {name: f"paper_{name}" for name in mains})

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


def test_a_script_that_cannot_be_imported_is_reported(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(reproduce, "PAPERS", {"missing": "scripts.no_such_paper"})
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


def test_every_paper_is_a_script_under_its_own_name() -> None:
    assert set(reproduce.PAPERS) == {"free_floating", "standing", "blend", "cts"}
    for name, module in reproduce.PAPERS.items():
        assert importlib.import_module(module).PAPER.name == name
