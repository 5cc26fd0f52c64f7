"""The README's Python and the site's runs, each block alone and all of a page in order, as a reader would type them."""

from __future__ import annotations

import csv
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from scripts.robots import robots
from scripts.site.executed import blocks

ROOT = Path(__file__).resolve().parent.parent
README = ROOT / "README.md"
SITE = ROOT / "scripts" / "site"
PAGES = (README, *sorted(SITE.rglob("*.md")))
LINK = re.compile(r"\]\(([^)#\s]+)(?:#[^)]*)?\)")
MAKE = re.compile(r"(?:`|^)make ([a-z]+)", re.MULTILINE)
FENCED = re.compile(r"^(```+).*?^\1$", re.MULTILINE | re.DOTALL)

ALONE = {
    f"{page.relative_to(ROOT)}:{line}": (page, line, source)
    for page in PAGES
    for line, alone, source in blocks(page.read_text(encoding="utf-8"))
    if alone
}
SEVERAL = [page for page in PAGES if sum(block.alone for block in blocks(page.read_text(encoding="utf-8"))) > 1]
"""Pages of one block say the same alone and in order."""


def run(page: Path, line: int, source: str, namespace: dict[str, object]) -> None:
    # The padding makes a traceback point at the line in the page.
    exec(compile("\n" * (line - 1) + source, str(page), "exec"), namespace)


@pytest.mark.parametrize("place", ALONE)
def test_a_python_block_runs_alone(place: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)  # what a block writes must not land in the repository
    monkeypatch.syspath_prepend(tmp_path)  # as a script's own folder is
    run(*ALONE[place], {"__name__": "__main__"})


@pytest.mark.parametrize("page", SEVERAL, ids=lambda page: str(page.relative_to(ROOT)))
def test_the_python_blocks_run_in_their_order(page: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    namespace: dict[str, object] = {"__name__": "__main__"}
    for line, alone, source in blocks(page.read_text(encoding="utf-8")):
        if alone:
            run(page, line, source, namespace)


def test_the_readme_plans_and_the_tutorials_do_what_they_are_about() -> None:
    assert [page for page, _, _ in ALONE.values()].count(README) == 1
    tutorials = {page.stem for page, _, _ in ALONE.values() if page.parent.name == "tutorials"}
    assert tutorials == {page.stem for page in (SITE / "tutorials").glob("*.md")}


def test_the_readme_plans_for_many_places(tmp_path: Path) -> None:
    """The script that it shows, for one place instead of a hundred times a hundred."""
    text = README.read_text(encoding="utf-8")
    script = re.search(r"`places\.py`.*?^```\n(.*?)^```$", text, re.MULTILINE | re.DOTALL)
    assert script is not None
    assert script[1].count("range(100)") == 2
    source = script[1].replace("range(100)", "range(1)").replace("ur5.urdf", str(robots.UR5.path))
    (tmp_path / "places.py").write_text(source, encoding="utf-8")
    subprocess.run([sys.executable, "places.py"], cwd=tmp_path, check=True, env={**os.environ, "PYTHONPATH": str(ROOT)})
    rows = list(csv.DictReader((tmp_path / "places.csv").read_text(encoding="utf-8").splitlines()))
    assert [row["status"] for row in rows] == ["done"]


def test_the_readme_is_short() -> None:
    assert len(README.read_text(encoding="utf-8").splitlines()) <= 120


def test_every_make_target_named_in_the_readme_and_on_the_site_exists() -> None:
    targets = set(re.findall(r"^([a-z]+):", (ROOT / "Makefile").read_text(encoding="utf-8"), re.MULTILINE))
    for page in PAGES:
        named = set(MAKE.findall(page.read_text(encoding="utf-8")))
        assert named <= targets, page
        assert page != README or {"reproduce", "test", "site"} <= named


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_every_local_link_leads_to_a_file(page: Path) -> None:
    text = FENCED.sub("", page.read_text(encoding="utf-8"))
    links = [link for link in LINK.findall(text) if "://" not in link]
    assert links or page != README, "README.md shows no local file: not even a picture"
    missing = [link for link in links if not (page.parent / link).exists()]
    assert not missing, f"{page} points at files that do not exist: {missing}"


def test_the_list_of_modules_is_the_tree_as_it_is() -> None:
    house = (SITE / "house.md").read_text(encoding="utf-8").partition("```\n")[2].partition("```")[0]
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
