"""The reference: lists of names become their documentation, and docstrings are made fit for reStructuredText.

A block fenced as `{names} PACKAGE` lists public names of a package, separated by commas. On the site, the signatures
and docstrings of these names take its place, in the order of the list.
"""

from __future__ import annotations

import importlib
import inspect
import re
import sys
from typing import Any

__all__ = ["documented", "escaped", "names", "prepared", "setup"]

NAMES = re.compile(r"^```\{names\} ([\w.]+)\n(.*?)^```$", re.MULTILINE | re.DOTALL)

QUOTED = re.compile(r"(``.+?``|:\w+:`[^`]+`|`[^`]+`)")
"""What is marked as code, or as a reference, is left as it is."""
MARKS = re.compile(r"([*|]|(?<=\w)_(?=\W|$))")
UNPARSABLE = re.compile(r"<factory>|<class '(?:\w+\.)*(\w+)'>")
FORMULA = re.compile(r"^    ")
SECTION = re.compile(r"^(Args|Attributes|Returns|Raises|Yields):$")


def escaped(line: str) -> str:
    """The line, with no mark that would mean something: a product's star, a norm's bars, an underscore at an end."""
    return "".join(part if number % 2 else MARKS.sub(r"\\\1", part) for number, part in enumerate(QUOTED.split(line)))


def names(text: str) -> list[tuple[str, str]]:
    """Packages and names that a page of the reference lists, in their order."""
    lists = NAMES.findall(text)
    return [(package, name) for package, listed in lists for name in re.split(r"[,\s]+", listed.strip())]


def documented(text: str) -> str:
    """The page with the documentation of the names that it lists."""

    def directives(block: re.Match[str]) -> str:
        lines = []
        for package, name in names(block[0]):
            value = getattr(importlib.import_module(package), name)
            if inspect.isclass(value):
                lines += [f".. autoclass:: {package}.{name}", "   :members:", ""]
            elif inspect.isfunction(value):
                lines += [f".. autofunction:: {package}.{name}", ""]
            else:  # its docstring stands where it is assigned
                lines += [f".. autodata:: {_home(package, name)}.{name}", "   :no-value:", ""]
        return "\n".join(["```{eval-rst}", *lines, "```"])

    return NAMES.sub(directives, text)


def _home(package: str, name: str) -> str:
    """The module that assigns a constant which a package exports."""
    assigned = re.compile(rf"^{name}(:.*)? = ", re.MULTILINE)
    for module in [module for module in sys.modules.values() if module.__name__.startswith(f"{package}.")]:
        if name in vars(module) and assigned.search(inspect.getsource(module)):
            return module.__name__
    raise ValueError(f"no module of {package} assigns {name}")


def _read(app: Any, name: str, content: list[str]) -> None:
    content[0] = documented(content[0])


def setup(app: Any) -> dict[str, bool]:
    """For Sphinx."""
    app.connect("source-read", _read)
    app.connect("autodoc-process-docstring", _process, priority=100)  # before napoleon
    app.connect("autodoc-process-signature", _signature)
    return {"parallel_read_safe": True, "parallel_write_safe": True}


def _process(app: Any, what: str, name: str, thing: Any, options: Any, lines: list[str]) -> None:
    lines[:] = prepared(lines)


def _signature(
    app: Any, what: str, name: str, thing: Any, options: Any, signature: str | None, returns: str | None
) -> tuple[str | None, str | None]:
    """Return a signature that Sphinx can parse, without `<factory>` and `<class 'module.Name'>` as defaults."""
    return signature and UNPARSABLE.sub(lambda match: match[1] or "...", signature), returns


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
