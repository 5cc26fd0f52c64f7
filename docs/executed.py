"""Pages whose Python is run when the site is built: below each block stands what it printed or drew.

A block fenced as `python` also runs alone, which the tests try; one fenced as `py` goes on where those above it ended.
All blocks of a page are run in their order, in a process and a folder of their own. What the last line of a block is
worth is shown as a notebook shows it. A block that fails ends the build.
"""

from __future__ import annotations

import ast
import io
import json
import os
import re
import subprocess
import sys
import tempfile
import textwrap
from contextlib import redirect_stdout
from pathlib import Path
from typing import Any, NamedTuple

__all__ = ["Block", "blocks", "executed", "main", "setup", "wrapped"]

FENCE = re.compile(r"^```(python|py)\n(.*?)^```$", re.MULTILINE | re.DOTALL)
ROOT = Path(__file__).resolve().parents[1]
LONGEST = 900  # s, of a page
MOST_LINES = 60
"""Of what a block prints, that are shown."""
WIDTH = 88
"""Characters of a line that the column of a page holds."""


class Block(NamedTuple):
    """A fenced block: its first line in the page, whether it stands alone, and its text."""

    line: int
    alone: bool
    source: str


def blocks(text: str) -> list[Block]:
    """The Python of a page in Markdown."""
    return [
        Block(text.count("\n", 0, match.start(2)) + 1, match.group(1) == "python", match.group(2))
        for match in FENCE.finditer(text)
    ]


def executed(text: str, name: str) -> str:
    """A page with what its blocks print and show below them.

    Raises:
        RuntimeError: A block fails; with the page, the line and what it said.
    """
    shown = iter(_run(name, blocks(text)))
    return FENCE.sub(lambda match: f"```python\n{match.group(2)}```\n" + _below(*next(shown)), text)


def _below(printed: str, html: str) -> str:
    parts = ""
    if printed.strip():
        lines = printed.rstrip("\n").splitlines()
        if len(lines) > MOST_LINES:
            lines = [*lines[:MOST_LINES], f"... and {len(lines) - MOST_LINES} lines more"]
        shown = "\n".join(wrapped(line) for line in lines)
        parts += f"\n::::{{container}} output\n````{{code-block}} text\n{shown}\n````\n::::\n"
    if html:
        parts += f'\n````{{raw}} html\n<div class="output">{html}</div>\n````\n'
    return parts


def wrapped(line: str) -> str:
    """Return a printed line, if it is too long for the page as several lines; the last column of a table moves down."""
    if len(line) <= WIDTH:
        return line
    table = re.match(r"(.*\S)\s{2,}(\S.*)", line)
    first, rest = table.groups() if table and len(table[1]) <= WIDTH else ("", line)
    indent = " " * (len(line) - len(line.lstrip()) + 6)
    lines = textwrap.wrap(rest, WIDTH, initial_indent=indent if first else "", subsequent_indent=indent)
    return "\n".join([first, *lines] if first else lines)


def _run(name: str, found: list[Block]) -> list[tuple[str, str]]:
    with tempfile.TemporaryDirectory() as folder:
        work, task = Path(folder) / "work", Path(folder) / "task.json"
        work.mkdir()
        task.write_text(json.dumps([name, found]), encoding="utf-8")
        path = os.pathsep.join([str(work), str(ROOT)])
        environment = {**os.environ, "PYTHONPATH": path, "MPLBACKEND": "Agg", "PYTHONHASHSEED": "0"}
        done = subprocess.run(
            [sys.executable, "-m", "docs.executed", str(task)],
            cwd=work,
            env=environment,
            capture_output=True,
            text=True,
            timeout=LONGEST,
            check=False,
        )
        if done.returncode:
            raise RuntimeError(f"{name}: a block fails\n{done.stdout}\n{done.stderr}")
        told: list[tuple[str, str]] = json.loads(task.with_suffix(".out").read_text(encoding="utf-8"))
        return told


def main(file: str) -> None:
    """Run the blocks that a file holds, and write what they show beside it."""
    task = Path(file)
    name, found = json.loads(task.read_text(encoding="utf-8"))
    namespace: dict[str, Any] = {"__name__": "__main__"}
    told = []
    for line, _, source in found:
        tree = ast.parse("\n" * (line - 1) + source, f"{name}.md")
        last = tree.body.pop() if tree.body and isinstance(tree.body[-1], ast.Expr) else None
        stream, value = io.StringIO(), None
        with redirect_stdout(stream):
            exec(compile(tree, f"{name}.md", "exec"), namespace)
            if isinstance(last, ast.Expr):
                value = eval(compile(ast.Expression(last.value), f"{name}.md", "eval"), namespace)
        told.append((stream.getvalue() + _as_text(value), _as_html(value)))
    task.with_suffix(".out").write_text(json.dumps(told), encoding="utf-8")


def _as_html(value: Any) -> str:
    for name in ("_repr_svg_", "_repr_html_"):
        if hasattr(value, name):
            return str(getattr(value, name)())
    return ""


def _as_text(value: Any) -> str:
    return "" if value is None or _as_html(value) else f"{value!r}\n"


def setup(app: Any) -> dict[str, bool]:
    """For Sphinx."""

    def read(app: Any, name: str, content: list[str]) -> None:
        if FENCE.search(content[0]):
            content[0] = executed(content[0], name)

    app.connect("source-read", read)
    return {"parallel_read_safe": True, "parallel_write_safe": True}


if __name__ == "__main__":
    main(sys.argv[1])
