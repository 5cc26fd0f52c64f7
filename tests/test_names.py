"""Names in the code are words of the field: none of those that CONTRIBUTING lists as replaced."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
REPLACED = {
    "asked", "bent", "brief", "cheaper", "cheapest", "dear", "dearer", "drawn", "found", "given", "instant", "instants",
    "looked", "made", "misfit", "posture", "postures", "said", "stray", "strays", "sunk", "surroundings", "told",
    "touch", "touches", "touching",
}  # fmt: skip
"""Words that no name contains: participles and riddles in place of the noun of what is named."""
VERBS = {"bent", "drawn", "found", "given", "made"}
"""Words that the name of a test, which is a sentence, may use as verbs: `test_known_extremals_are_found`."""
FOLDERS = ("models", "ocp", "scripts", "tests")
FILES = sorted(file for folder in FOLDERS for file in (ROOT / folder).rglob("*.py") if file != Path(__file__))


def names(tree: ast.AST) -> Iterator[tuple[str, int]]:
    """Names that a module defines: functions, classes, arguments, fields and variables, with their lines."""
    for node in ast.walk(tree):
        if isinstance(node, ast.FunctionDef | ast.ClassDef):
            yield node.name, node.lineno
        elif isinstance(node, ast.arg):
            yield node.arg, node.lineno
        elif isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store):
            yield node.id, node.lineno
        elif isinstance(node, ast.Attribute) and isinstance(node.ctx, ast.Store):
            yield node.attr, node.lineno


def words(name: str) -> set[str]:
    """The words of a name in snake_case, CamelCase or capitals, in lower case."""
    return {word.lower() for word in re.findall(r"[A-Z]?[a-z]+|[A-Z]+(?![a-z])", name)}


def replaced_words(name: str) -> set[str]:
    """The words of a name that should be others."""
    return words(name) & (REPLACED - VERBS if name.startswith("test_") else REPLACED)


@pytest.mark.parametrize("file", FILES, ids=lambda file: str(file.relative_to(ROOT)))
def test_names_are_words_of_the_field(file: Path) -> None:
    tree = ast.parse(file.read_text(encoding="utf-8"))
    assert not [f"line {line}: {name}" for name, line in names(tree) if replaced_words(name)]


def test_every_kind_of_name_is_read() -> None:
    source = "class AskedFor:\n    told: int = 0\n"
    source += "def _found(given, *, STRAYS=1):\n    self.postures = drawn = lambda bent: 0\n"
    source += "def test_extremals_are_found(): ...\ndef test_it_is_told(): ...\n"
    read = {name for name, _ in names(ast.parse(source)) if replaced_words(name)}
    assert read == {
        "AskedFor", "told", "_found", "given", "STRAYS", "postures", "drawn", "bent", "test_it_is_told",
    }  # fmt: skip
