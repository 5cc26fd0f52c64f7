"""Rules of public signatures: how many parameters a function has, in which order, and what they are called.

A function or method is public if neither its name nor that of its class begins with an underscore; constructors written
by hand count too. The rules read the source and import nothing. Each is also tried on a function that breaks it.
"""

from __future__ import annotations

import ast
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
MOST_POSITIONAL = 4
MOST_PARAMETERS = 8
MOST_OF_FRONT_DOORS = 12
"""Largest number of parameters of `plan`, of `schedule` and of the methods of `Problem`."""
FRONT_DOORS = {"plan", "schedule"}
ORDER = ("machine", "tasks", "horizon")
"""First parameters of a function of motions that has any two of them, after the problem that it declares."""
TASKS = {"task", "goal", "equations"}
"""Names of one task, of a goal, and of the equations of tasks: they stand where tasks do."""


@dataclass(frozen=True)
class Signature:
    """Name, place and parameters of a public function."""

    name: str
    place: str
    positional: tuple[str, ...]
    keywords: tuple[str, ...]
    annotations: dict[str, str]

    @property
    def is_front_door(self) -> bool:
        return self.name in FRONT_DOORS or self.name.startswith("Problem.")


def signatures_of(text: str, place: str) -> Iterator[Signature]:
    """Yield the signatures of a module's public functions and methods."""

    def visit(body: list[ast.stmt], owner: str) -> Iterator[Signature]:
        for node in body:
            if isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
                yield from visit(node.body, f"{owner}{node.name}.")
            elif isinstance(node, ast.FunctionDef) and (not node.name.startswith("_") or node.name == "__init__"):
                arguments = node.args
                positional = [*arguments.posonlyargs, *arguments.args]
                if owner and positional and positional[0].arg in ("self", "cls"):
                    positional = positional[1:]
                every = [*positional, *arguments.kwonlyargs]
                annotations = {each.arg: ast.unparse(each.annotation) for each in every if each.annotation is not None}
                names = tuple(each.arg for each in positional), tuple(each.arg for each in arguments.kwonlyargs)
                yield Signature(owner + node.name, f"{place}:{node.lineno}", *names, annotations)

    yield from visit(ast.parse(text).body, "")


def library() -> Iterator[Signature]:
    for package in ("models", "ocp"):
        for file in sorted((ROOT / package).rglob("*.py")):
            yield from signatures_of(file.read_text(encoding="utf-8"), file.relative_to(ROOT).as_posix())


def too_many(signature: Signature) -> str:
    positional, total = len(signature.positional), len(signature.positional) + len(signature.keywords)
    most = MOST_OF_FRONT_DOORS if signature.is_front_door else MOST_PARAMETERS
    if total > most:
        return f"has {total} parameters, at most {most}"
    if positional > MOST_POSITIONAL:
        return f"has {positional} positional parameters, at most {MOST_POSITIONAL}"
    return ""


def out_of_order(signature: Signature) -> str:
    """Functions of motions take `machine, tasks, horizon` first; a task, goal or equations count as tasks."""
    if not signature.place.startswith("ocp/motion/"):
        return ""
    every = (*signature.positional, *signature.keywords)
    names = ["tasks" if name in TASKS else name for name in (every[1:] if every[:1] == ("problem",) else every)]
    if "machine" not in names or not {"tasks", "horizon"} & set(names):
        return ""
    expected = [name for name in ORDER if name in names]
    if names[: len(expected)] != expected:
        return f"takes {', '.join(names[: len(expected)])} first, expected {', '.join(expected)}"
    return ""


def ambiguous_start(signature: Signature) -> str:
    """`start` of a function of motions is where the motion begins: never a time and never an option of a solver."""
    annotation = signature.annotations.get("start", "")
    if signature.place.startswith("ocp/motion/") and annotation in ("float", "int", "bool", "str", "float | None"):
        return f"has a start of type {annotation}, expected a configuration or state in which the motion begins"
    return ""


RULES = (too_many, out_of_order, ambiguous_start)


@pytest.mark.parametrize("rule", RULES, ids=lambda rule: rule.__name__)
def test_public_signatures_keep_the_rule(rule: object) -> None:
    assert callable(rule)
    broken = [f"{each.place} {each.name} {words}" for each in library() if (words := rule(each))]
    assert not broken, f"{len(broken)} signatures:\n" + "\n".join(broken)


PLANTED = [
    (too_many, "def f(a, b, c, d): ...", ""),
    (too_many, "def f(a, b, c, d, e): ...", "has 5 positional parameters"),
    (too_many, "def f(a, b, c, d, *, e, f, g, h): ...", ""),
    (too_many, "def f(a, *, b, c, d, e, f, g, h, i): ...", "has 9 parameters, at most 8"),
    (too_many, "def _f(a, b, c, d, e): ...", ""),
    (too_many, "class A:\n    def f(self, a, b, c, d): ...", ""),
    (too_many, "class A:\n    def __init__(self, a, b, c, d, e): ...", "has 5 positional"),
    (too_many, "class A:\n    @classmethod\n    def f(cls, a, b, c, d, e): ...", "has 5 positional"),
    (too_many, "class _A:\n    def f(self, a, b, c, d, e): ...", ""),
    (too_many, "def plan(a, *, b, c, d, e, f, g, h, i, j, k, l): ...", ""),
    (too_many, "class Problem:\n    def state(self, a, *, b, c, d, e, f, g, h, i): ...", ""),
    (too_many, "def schedule(a, *, b, c, d, e, f, g, h, i, j, k, l, m): ...", "has 13 parameters, at most 12"),
    (out_of_order, "def f(machine, tasks, horizon, *, start): ...", ""),
    (out_of_order, "def f(machine, horizon): ...", ""),
    (out_of_order, "def f(tasks, horizon): ...", ""),
    (out_of_order, "def f(machine, task, *, start): ...", ""),
    (out_of_order, "def f(machine, goal, horizon, *, start): ...", ""),
    (out_of_order, "def f(machine, equations, horizon, joints): ...", ""),
    (out_of_order, "def f(problem, machine, horizon): ...", ""),
    (out_of_order, "def f(problem, horizon, machine): ...", "takes horizon, machine first, expected machine, horizon"),
    (out_of_order, "def f(machine, equations, joints, horizon): ...", "takes machine, tasks, joints first"),
    (out_of_order, "def f(tasks, machine): ...", "takes tasks, machine first, expected machine, tasks"),
    (out_of_order, "def f(machine, start, tasks): ...", "takes machine, start first, expected machine, tasks"),
    (ambiguous_start, "def f(start: Start): ...", ""),
    (ambiguous_start, "def f(start: float): ...", "has a start of type float"),
]


@pytest.mark.parametrize(("rule", "text", "message"), PLANTED, ids=[f"{p[0].__name__}: {p[1]}" for p in PLANTED])
def test_a_planted_signature_is_judged(rule: object, text: str, message: str) -> None:
    assert callable(rule)
    words = "".join(rule(signature) for signature in signatures_of(text, "ocp/motion/plan/example.py"))
    assert message in words
    assert bool(message) == bool(words)
