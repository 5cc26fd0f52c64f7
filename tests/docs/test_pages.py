"""Pages of the site: their Python names what there is, their formulas are MathML, and all of them are in the index."""

from __future__ import annotations

import ast
import importlib
import re
import textwrap
from pathlib import Path
from xml.etree import ElementTree

import pytest
from latex2mathml.converter import convert

from docs.docstrings import documented, names, prepared
from docs.executed import WIDTH, blocks, executed, wrapped
from docs.numbers import MARK, listed
from docs.players import command, titles
from ocp.__main__ import parser
from scripts.papers.reproduced import read_tables

SITE = Path(__file__).resolve().parents[2] / "docs"
PAGES = sorted(SITE.rglob("*.md"))
NEEDS = {"example-robot-data": "gallery", "spartpy": "gallery", "run_batch": "cluster", "read_joint_limits": "yaml",
         "from_mjcf": "mujoco"}  # fmt: skip
"""Names that need an extra, by a word of a block."""
FORMULAS = re.compile(r"\$\$(.+?)\$\$|(?<![\w$])\$([^$\n]+?)\$(?![\w$])", re.DOTALL)


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(SITE)))
def test_imports_of_pages_exist(page: Path) -> None:
    for line, _, source in blocks(page.read_text(encoding="utf-8")):
        tree = ast.parse(textwrap.dedent(source), str(page))
        for node in ast.walk(tree):
            if isinstance(node, ast.ImportFrom) and str(node.module).partition(".")[0] in ("models", "ocp"):
                module = importlib.import_module(str(node.module))
                missing = [alias.name for alias in node.names if not hasattr(module, alias.name)]
                assert not missing, f"{page}:{line} imports {missing} of {node.module}"


def test_blocks_name_the_extra_that_they_need_in_their_first_line() -> None:
    for page in PAGES:
        for line, alone, source in blocks(page.read_text(encoding="utf-8")):
            for word, extra in NEEDS.items():
                needed = f'# needs pip install ".[{extra}]" in a clone\n'
                assert not alone or word not in source or source.startswith(needed), f"{page}:{line}"


def test_every_page_is_in_the_index() -> None:
    index = (SITE / "index.md").read_text(encoding="utf-8")
    listed = {
        line.strip()
        for tree in re.findall(r"```\{toctree\}\n(.*?)```", index, re.DOTALL)
        for line in tree.splitlines()
        if line.strip() and not line.startswith(":")
    }
    assert listed == {str(page.relative_to(SITE).with_suffix("")) for page in PAGES} - {"index"}


def test_every_public_name_is_in_the_reference_once() -> None:
    listed = [entry for page in PAGES for entry in names(page.read_text(encoding="utf-8"))]
    faces = ("models", "models.paths", "ocp", "ocp.app", "ocp.app.batch", "ocp.app.files", "ocp.motion.schedule")
    shared = set(importlib.import_module("models").__all__)
    public = [
        (face, name)
        for face in faces
        for name in importlib.import_module(face).__all__
        if face != "models.paths" or name not in shared
    ]
    assert sorted(listed) == sorted(public)


def test_listed_names_become_directives_of_their_kind_in_the_order_of_the_list() -> None:
    report = documented("Before.\n```{names} models\nsmooth, Path,\nSTANDING_STARTS\n```\nAfter.")
    assert re.findall(r"^\.\. (\w+):: (\S+)$", report, re.MULTILINE) == [
        ("autofunction", "models.smooth"),
        ("autoclass", "models.Path"),
        ("autodata", "models.examples.STANDING_STARTS"),
    ]
    assert report.startswith("Before.\n```{eval-rst}\n")
    assert report.endswith("\n```\nAfter.")


def test_every_formula_becomes_mathml() -> None:
    count = 0
    for page in PAGES:
        text = re.sub(r"^```.*?^```$|`[^`\n]*`", "", page.read_text(encoding="utf-8"), flags=re.MULTILINE | re.DOTALL)
        for block, inline in FORMULAS.findall(text):
            result = convert((block or inline).strip())
            root = ElementTree.fromstring(result)
            assert root.tag.endswith("math")
            assert "\\" not in "".join(root.itertext()), f"{page}: {block or inline}"
            count += 1
    assert count > 40


def test_output_of_a_block_follows_it() -> None:
    page = textwrap.dedent(
        """
        # A page
        ```python
        x = 20
        print("printed", x)
        ```
        Words.
        ```py
        class Shown:
            def _repr_svg_(self):
                return "<svg></svg>"

        x + 1
        ```
        ```py
        Shown()
        ```
        ```
        no Python
        ```
        """
    )
    report = executed(page, "page")
    printed, shown, picture = (report.rindex(word) for word in ("printed 20", "\n21\n", "<svg></svg>"))
    assert report.index("Words.") > printed
    assert report.index("Words.") < shown < picture
    assert report.count("```python\n") == 3
    assert "no Python" in report


def test_a_block_that_fails_ends_the_build_with_its_page_and_line() -> None:
    with pytest.raises(RuntimeError, match=r"(?s)the/page.*line 3.*ZeroDivisionError"):
        executed("# A page\n```python\n1 / 0\n```\n", "the/page")


def test_docstrings_mean_nothing_but_what_they_say() -> None:
    report = prepared(
        [
            "Half |v|^2, `a|b` and ``c*d``, x_ * y.",
            "",
            "    q = |a| * b",
            "    + c*",
            "",
            "Args:",
            "    n: |n| of `a_`.",
        ]
    )
    assert report[0] == "Half \\|v\\|^2, `a|b` and ``c*d``, x\\_ \\* y."
    assert report[2:6] == ["::", "", "    q = |a| * b", "    + c*"]
    assert report[-1] == "    n: \\|n\\| of `a_`."


def test_every_number_of_the_papers_stands_on_its_page_with_its_reason() -> None:
    tables = read_tables(SITE.parent / "results")
    page = listed(tables)
    rows = [row for part in tables.values() for row in part if row["ours"]]
    assert f"**{sum(row['reproduced'] == 'yes' for row in rows)} of {len(rows)} numbers" in page
    for (paper, numbers), part in zip(tables.items(), page.split("### ")[1:], strict=True):
        assert part.startswith(f"{paper}\n")
        for row in numbers:
            (line,) = (line for line in part.splitlines() if f"| {row['place']} | {row['quantity']} |" in line)
            if row["reproduced"] == "yes":
                assert line.endswith("| yes |")
            else:
                number = int(line.rpartition("(")[2].partition(")")[0])
                assert f"\n{number}. {row['why']}.\n" in part
    assert sum(MARK in page.read_text(encoding="utf-8") for page in PAGES) == 1


def test_standalone_blocks_are_distinguished_from_continuations() -> None:
    result = blocks("a\n```python\nx = 1\n```\nb\n```py\nx + 1\n```\n```python3\nno\n```\n")
    assert [(line, alone) for line, alone, _ in result] == [(3, True), (7, False)]
    assert [source for _, _, source in result] == ["x = 1\n", "x + 1\n"]


def test_long_lines_keep_their_words_and_fit_the_column_and_tables_break_before_their_last_column() -> None:
    row = "  cost, relative" + 40 * " " + "1.53e-16    ok      " + "reported 0.09073374, integrated 0.09073374"
    lines = wrapped(row).splitlines()
    assert lines[0].endswith("ok")
    assert lines[1].startswith("        reported")
    for line in (row, "word " * 50, 9 * "  " + "deep " * 40, "short"):
        assert wrapped(line).split() == line.split()
        assert max(map(len, wrapped(line).splitlines())) <= WIDTH


def test_long_output_is_truncated_at_its_end() -> None:
    report = executed("```python\nfor k in range(61):\n    print('line', k)\n```\n", "page")
    assert "line 59\n... and 1 lines more" in report
    assert "line 60" not in report
    report = executed("```python\nfor k in range(60):\n    print('line', k)\n```\n", "page")
    assert "line 59" in report
    assert "lines more" not in report


def test_every_plan_of_the_gallery_is_played_beside_its_comparison() -> None:
    text = (SITE / "gallery.md").read_text(encoding="utf-8")
    plans = sorted((SITE.parent / "results" / "gallery").glob("*.npz"))
    assert titles().keys() == {plan.stem for plan in plans}
    assert "## " + titles()["panda"] in text
    assert sorted(re.findall(r"```\{player\} (\w+)", text)) == [plan.stem for plan in plans]
    for plan in plans:
        words = command(plan, SITE / "out.html", titles()[plan.stem])[3:]
        options = parser().parse_args(words)
        assert options.plan == plan
        assert options.title == titles()[plan.stem] != plan.name
        assert (options.workpiece is not None) == plan.with_suffix(".obj").exists() == (plan.stem == "ur5")
        assert options.page == SITE / "out.html"
        beside = [file for file in [plan.with_name(f"{plan.stem}.local.csv")] if file.exists()]
        assert options.beside == beside
        assert len(options.name) == 1 + len(beside)
        assert f"## {options.title}\n" in text


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(SITE)))
def test_code_fits_into_the_column_of_the_page(page: Path) -> None:
    text = page.read_text(encoding="utf-8")
    code = re.findall(r"^```([^\n]*)\n(.*?)^```$", text, re.MULTILINE | re.DOTALL)
    shown = [line for kind, block in code if not kind.startswith("{") for line in block.splitlines()]
    assert not [line for line in shown if len(line) > 88]
