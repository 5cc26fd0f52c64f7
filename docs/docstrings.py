"""Docstrings as they are written here, plain sentences, made fit for reStructuredText before napoleon reads them."""

from __future__ import annotations

import re
from typing import Any

__all__ = ["escaped", "prepared", "setup"]

QUOTED = re.compile(r"(``.+?``|:\w+:`[^`]+`|`[^`]+`)")
"""What is marked as code, or as a reference, is left as it is."""
MARKS = re.compile(r"([*|]|(?<=\w)_(?=\W|$))")
FORMULA = re.compile(r"^    ")
SECTION = re.compile(r"^(Args|Attributes|Returns|Raises|Yields):$")


def escaped(line: str) -> str:
    """The line, with no mark that would mean something: a product's star, a norm's bars, an underscore at an end."""
    return "".join(part if number % 2 else MARKS.sub(r"\\\1", part) for number, part in enumerate(QUOTED.split(line)))


def setup(app: Any) -> dict[str, bool]:
    """For Sphinx."""
    app.connect("autodoc-process-docstring", _process, priority=100)  # before napoleon
    return {"parallel_read_safe": True, "parallel_write_safe": True}


def _process(app: Any, what: str, name: str, thing: Any, options: Any, lines: list[str]) -> None:
    lines[:] = prepared(lines)


def prepared(lines: list[str]) -> list[str]:
    """A docstring's lines, with a formula that stands by itself, indented after an empty line, as it is written."""
    made: list[str] = []
    in_section = in_formula = False
    for line in lines:
        in_section |= SECTION.match(line) is not None
        if line.strip():
            begins = FORMULA.match(line) is not None and bool(made) and not made[-1].strip() and not in_section
            if begins and not in_formula:
                made += ["::", ""]
            in_formula = FORMULA.match(line) is not None and (in_formula or begins)
        made.append(line if in_formula else escaped(line))
    return made
