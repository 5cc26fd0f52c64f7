"""Code of the gallery: every entry shows some and links to a script that exists; what stands alone is run."""

from __future__ import annotations

import ast
import builtins
import re
from inspect import signature
from pathlib import Path
from typing import Any

import pytest

import models
import models.paths
import ocp

GALLERY = Path(__file__).resolve().parents[2] / "docs" / "gallery.md"
DETAILS = sorted(GALLERY.with_suffix("").glob("*.md"))
CODE = re.compile(r"^```python3\n(.*?)^```$", re.MULTILINE | re.DOTALL)
LINK = re.compile(r"\]\((?!http)([^)#]+)(?:#[^)]*)?\)")


def sections() -> dict[str, str]:
    """Texts of the gallery by their headings; the first one, before all headings, is called ""."""
    first, *others = re.split(r"^## ", GALLERY.read_text(encoding="utf-8"), flags=re.MULTILINE)
    return {"": first} | {text.partition("\n")[0]: text for text in others}


def fragments() -> list[tuple[str, str]]:
    """Names of pages, and the code that they show."""
    return [
        (page.stem, code) for page in (GALLERY, *DETAILS) for code in CODE.findall(page.read_text(encoding="utf-8"))
    ]


@pytest.mark.parametrize("heading", [heading for heading in sections() if heading])
def test_every_entry_links_to_a_script_and_shows_its_code(heading: str) -> None:
    """The code stands in the entry, or in the page of its details; shorter entries describe the call in a sentence."""
    links = LINK.findall(sections()[heading])
    details = [page for page in DETAILS if f"gallery/{page.name}" in links]
    texts = [sections()[heading], *(page.read_text(encoding="utf-8") for page in details)]
    scripts = [link for text in texts for link in LINK.findall(text) if link.endswith(".py")]
    assert scripts
    for script in scripts:
        assert (GALLERY.parents[1] / script.lstrip("./")).is_file()
    papers = all("scripts/papers/" in script for script in scripts)
    assert papers or any("```python3" in text or "`plan(" in text or "essential lines" in text for text in texts)


@pytest.mark.parametrize(("page", "code"), fragments(), ids=[f"{k} {page}" for k, (page, _) in enumerate(fragments())])
def test_calls_of_the_shown_code_fit_the_functions_of_the_library(page: str, code: str) -> None:
    """A fragment may leave out what a task is, but no name or argument that it shows is wrong."""
    public: dict[str, Any] = {
        name: getattr(face, name) for face in (models.paths, ocp, models) for name in face.__all__
    }
    trees = [ast.parse(text) for _, text in fragments()]
    defined = {node.name for tree in trees for node in ast.walk(tree) if isinstance(node, ast.FunctionDef)}
    for node in ast.walk(ast.parse(code)):
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id not in defined:
            name, positional = node.func.id, [None] * len(node.args)
            keywords = {keyword.arg: None for keyword in node.keywords if keyword.arg is not None}
            assert name in public or hasattr(builtins, name) or name == "files", f"{page}: {name}"
            if name in public:
                signature(public[name]).bind_partial(*positional, **keywords)


@pytest.mark.parametrize(
    "heading",
    [
        "A Panda in circles",
        pytest.param("A UR5 with a free tool roll", marks=pytest.mark.long),
        pytest.param("A Panda that has to reconfigure", marks=pytest.mark.long),
    ],
)
def test_the_code_of_an_entry_runs_after_the_lines_of_the_introduction(heading: str) -> None:
    """Entries use names of those before them, such as `rest_to_rest`."""
    texts = sections()
    (introduction,), (code,) = CODE.findall(texts[""]), CODE.findall(texts[heading])
    space: dict[str, Any] = {"rest_to_rest": models.paths.rest_to_rest}
    exec(compile(introduction, "introduction", "exec"), space)
    exec(compile(code, heading, "exec"), space)
    result = space["result"]
    if heading.endswith("reconfigure"):
        assert (len(result.segments), len(result.reconfigurations)) == (2, 1)
        assert all(segment.audit().passed for segment in result.segments)
    else:
        assert result.audit().passed
