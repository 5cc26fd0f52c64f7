"""The README's Python and the site's runs, each block alone and all of a page in order, as a reader would type them."""

from __future__ import annotations

import csv
import json
import os
import pkgutil
import re
import subprocess
import sys
import tomllib
from contextlib import suppress
from importlib import metadata
from pathlib import Path

import pytest

from docs.executed import blocks
from tests.readme import steps

ROOT = Path(__file__).resolve().parent.parent
README = ROOT / "README.md"
CONTRIBUTING = (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8")
SITE = ROOT / "docs"
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


def test_the_readme_and_the_tutorials_run() -> None:
    assert [page for page, _, _ in ALONE.values()].count(README) == 1
    tutorials = {page.stem for page, _, _ in ALONE.values() if page.parent.name == "tutorials"}
    assert tutorials == {page.stem for page in (SITE / "tutorials").glob("*.md")}


HIDE = """
import importlib.metadata as metadata, json, os, sys

hidden, distributions = json.loads(os.environ["HIDDEN"])

class Hidden:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in hidden:
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)

sys.meta_path.insert(0, Hidden())
there = metadata.MetadataPathFinder.find_distributions
metadata.MetadataPathFinder.find_distributions = lambda *context: (
    found for found in there(*context) if found.metadata["Name"] not in distributions
)
"""
"""Of an environment without extras: modules and distributions that the package's own dependencies do not bring."""


def distributions(extras: str) -> set[str]:
    """What `pip install .` brings, with extras that commas part, by the normal names of the distributions."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    result, waiting = set[str](), list(project["dependencies"])
    for extra in filter(None, extras.split(",")):
        waiting += project["optional-dependencies"][extra]
    while waiting:
        words = re.match(r"([\w.-]+)([^;]*)(;.*)?", waiting.pop())
        assert words is not None
        name = normal(words[1])
        if name not in result and "extra" not in (words[3] or ""):
            result.add(name)
            with suppress(metadata.PackageNotFoundError):  # of another platform
                waiting += metadata.requires(name) or []
    return result


def normal(name: str) -> str:
    return re.sub(r"[-_.]+", "-", name).lower()


@pytest.mark.long
def test_the_readme_runs_with_its_stated_requirements(tmp_path: Path) -> None:
    """In a folder that is empty, in processes of their own: without extras but those that a block is said to need."""
    (tmp_path / "hiding").mkdir()
    (tmp_path / "hiding" / "sitecustomize.py").write_text(HIDE, encoding="utf-8")
    home = tmp_path / "home"
    home.mkdir()
    there = {**os.environ, "PYTHONPATH": os.pathsep.join([str(tmp_path / "hiding"), str(ROOT)]), "MPLBACKEND": "Agg"}
    command = [sys.executable, "-c", "import sys; from ocp.__main__ import main; sys.exit(main(sys.argv[1:]))"]
    programs = {"python": [sys.executable], "selfmotion": command}

    def run(extras: str, *words: str) -> subprocess.CompletedProcess[str]:
        program, hidden = [*programs[words[0]], *words[1:]], json.dumps(missing(extras))
        environment = {**there, "HIDDEN": hidden}
        return subprocess.run(program, cwd=home, env=environment, capture_output=True, text=True, check=False)

    assert {"pinocchio", "coal", "yaml", "distributed", "pyarrow", "mcap"} <= set(missing("")[0])
    for gone in ("import coal", "from importlib.metadata import files; files('example-robot-data')"):
        completed = run("", "python", "-c", gone)
        assert "ModuleNotFoundError" in completed.stderr or "PackageNotFoundError" in completed.stderr, completed
    for step in steps():
        if step.file:
            (home / step.file).write_text(step.text, encoding="utf-8")
        if step.extras:
            completed = run("", *step.words)
            assert f"selfmotion[{step.extras}]" in completed.stderr, (step.words, completed.stdout, completed.stderr)
        if step.words:
            completed = run(step.extras, *step.words)
            assert completed.returncode == 0, (step.words, completed.stdout, completed.stderr)
    rows = list(csv.DictReader((home / "places.csv").read_text(encoding="utf-8").splitlines()))
    assert [row["status"] for row in rows] == ["done"]
    distinct = {path.name for path in home.iterdir()}
    assert {"plan.csv", "six_axis.urdf", "seam.npz", "seam.html", "report.html", "places"} <= distinct


def missing(extras: str) -> tuple[list[str], list[str]]:
    """Modules and distributions that are installed here and are not brought by the package with these extras."""
    kept, own = distributions(extras), {"models", "ocp"}
    for one in metadata.distributions():
        if normal(one.metadata["Name"]) in kept:
            own |= {file.parts[0].partition(".")[0] for file in one.files or ()}
    installed = [place for place in sys.path if Path(place).name == "site-packages"]
    hidden = sorted({module.name for module in pkgutil.iter_modules(installed)} - own)
    return hidden, [
        one.metadata["Name"] for one in metadata.distributions() if normal(one.metadata["Name"]) not in kept
    ]


def test_the_readme_shows_its_stated_output() -> None:
    names = [step.file or " ".join(step.words[:2]) for step in steps()]
    commands = ["selfmotion plan", "selfmotion check", "selfmotion view", "selfmotion report"]
    assert names == ["first.py", "seam.toml", *commands, "places.py"]


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


def test_the_page_of_the_architecture_lists_every_module() -> None:
    listed: dict[str, list[str]] = {}
    for line in (SITE / "architecture.md").read_text(encoding="utf-8").splitlines():
        if folder := re.match(r"### `([\w/]+)/`", line):
            modules = listed.setdefault(folder[1], [])
        elif module := re.match(r"- `(\w+)`: \S", line):
            modules.append(module[1])
    there: dict[str, list[str]] = {}
    for file in (file for name in ("models", "ocp") for file in sorted((ROOT / name).rglob("*.py"))):
        if file.name != "__init__.py":
            there.setdefault(str(file.parent.relative_to(ROOT)), []).append(file.stem)
    assert listed == there


def test_the_index_of_formulas_names_the_modules_that_contain_them() -> None:
    """At least half of the words of each entry are in the modules of its row, by their first six letters."""
    rows = re.findall(r"^\| ([^|`]+) \| (`(?:models|ocp)/[^|]+) \|$", CONTRIBUTING, re.MULTILINE)
    assert len(rows) >= 30
    for formulas, modules in rows:
        text = "".join((ROOT / name).read_text(encoding="utf-8") for name in re.findall(r"`([^`]+)`", modules)).lower()
        for formula in re.sub(r"\(.*?\)", "", formulas).split(","):
            stems = [word[:6] for word in re.findall(r"[a-z]{4,}", formula.lower())]
            assert 2 * sum(stem in text for stem in stems) >= len(stems) > 0, f"{formula!r} is not in {modules}"
