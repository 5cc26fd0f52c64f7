"""The README's Python blocks run, each alone and all in their order, as a reader would type them."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
README = ROOT / "README.md"
FENCE = re.compile(r"^```python\n(.*?)^```$", re.MULTILINE | re.DOTALL)
LINK = re.compile(r"\]\(([^)#\s]+)(?:#[^)]*)?\)")
MAKE = re.compile(r"\bmake ([a-z]+)")


def python_blocks(text: str) -> list[tuple[int, str]]:
    """The fenced Python blocks of a Markdown text, each with the line number of its first line."""
    return [(text.count("\n", 0, match.start(1)) + 1, match.group(1)) for match in FENCE.finditer(text)]


BLOCKS = python_blocks(README.read_text(encoding="utf-8"))


def run(line: int, source: str, namespace: dict[str, object]) -> None:
    # The padding makes a traceback point at the line in README.md.
    exec(compile("\n" * (line - 1) + source, str(README), "exec"), namespace)


@pytest.mark.parametrize(("line", "source"), BLOCKS, ids=[f"line {line}" for line, _ in BLOCKS])
def test_a_python_block_runs_alone(line: int, source: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)  # what a block writes must not land in the repository
    monkeypatch.syspath_prepend(tmp_path)  # as a script's own folder is
    run(line, source, {"__name__": "__main__"})


def test_the_python_blocks_run_in_their_order(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    assert BLOCKS, "README.md has no Python block: the pattern or the fences are wrong"
    namespace: dict[str, object] = {"__name__": "__main__"}
    for line, source in BLOCKS:
        run(line, source, namespace)


def test_every_make_target_named_in_the_readme_exists() -> None:
    named = set(MAKE.findall(" ".join(re.findall(r"`[^`]+`", README.read_text(encoding="utf-8")))))
    targets = set(re.findall(r"^([a-z]+):", (ROOT / "Makefile").read_text(encoding="utf-8"), re.MULTILINE))
    assert {"reproduce", "test"} <= named
    assert named <= targets


def test_every_local_link_of_the_readme_leads_to_a_file() -> None:
    links = [link for link in LINK.findall(README.read_text(encoding="utf-8")) if "://" not in link]
    assert links, "README.md shows no local file: not even a picture"
    missing = [link for link in links if not (ROOT / link).exists()]
    assert not missing, f"README.md points at files that do not exist: {missing}"


def test_the_list_of_modules_is_the_tree_as_it_is() -> None:
    house = README.read_text(encoding="utf-8").partition("## The house")[2].partition("```\n")[2].partition("```")[0]
    listed: dict[str, list[str]] = {}
    package = room = ""
    for line in house.splitlines():
        if folder := re.match(r"(  )?([\w/]+)/ ", f"{line} "):
            package, room = (package, folder[2]) if folder[1] else (folder[2], "")
            line = line[folder.end() :] if folder[1] else ""
        if package in ("models", "ocp"):
            listed.setdefault(f"{package}/{room}".rstrip("/"), []).extend(line.split())
    found: dict[str, list[str]] = {}
    for file in (file for name in ("models", "ocp") for file in sorted((ROOT / name).rglob("*.py"))):
        if file.name != "__init__.py":
            found.setdefault(str(file.parent.relative_to(ROOT)), []).append(file.stem)
    assert {folder: sorted(names) for folder, names in listed.items()} == found
