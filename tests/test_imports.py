"""The rules of the house: who may import whom, what a package's face shows, which rooms there are.

The rules read the source and import nothing, so a lazy import and one for annotations count like any other. Each rule
is tried on a small house in which it is broken, too.
"""

from __future__ import annotations

import ast
import graphlib
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import TypeAlias

import pytest

ROOT = Path(__file__).resolve().parent.parent
Rule: TypeAlias = Callable[["House"], list[str]]

FLOORS = {
    "models": [
        ["errors", "input_files"],
        ["cache", "real_numbers"],
        ["arrays"],
        ["spatial"],
        ["robot", "paths"],
        ["shapes"],
        ["machines", "cts"],
        ["papers"],
    ],
    "ocp": [
        ["errors", "curves", "status", "tolerances"],
        ["console"],
        ["storage", "libraries", "tables", "solution_data"],
        ["problem", "schedule", "tasks"],
        ["solution"],
        ["direct", "audit", "local"],
        ["indirect"],
        ["methods"],
        ["confirmation", "refinement", "switching", "tightening"],
        ["builders"],
        ["planning"],
        ["batch", "files"],
        ["app"],
    ],
}
"""Rooms and single modules from the ground up; each may import what stands on lower floors."""
SEES_MODELS = {"tasks", "local", "builders", "planning", "batch", "files", "app"}
LAZY = {
    ("ocp.solution", "ocp.audit.audit"),
    ("ocp.solution", "ocp.direct.sensitivity"),
    ("ocp.solution", "ocp.app.plots"),
    ("ocp.planning.motion", "ocp.app.plots"),
}
"""Imports that go up, when `Solution.audit`, `Solution.sensitivity`, or `plot` of a solution or a plan, is called."""
SEEN_BY_ALL = {"models.cache", "models.input_files", "models.real_numbers", "models.shapes.nearest"}
"""What all of ocp may import of models: they know no machine."""
FOREIGN = {"models": {"casadi", "collada", "numpy", "scipy"}}


@dataclass(frozen=True)
class Module:
    """A module's name, whether it is a package's `__init__`, its syntax tree and the modules that it imports."""

    name: str
    is_package: bool
    tree: ast.Module
    imports: frozenset[str]

    @property
    def package(self) -> str:
        return self.name.partition(".")[0]

    @property
    def room(self) -> str:
        return self.name.partition(".")[2].partition(".")[0]


class House:
    """All modules of the two packages below a folder."""

    def __init__(self, root: Path) -> None:
        files = {name: file for package in FLOORS for name, file in _files(root, package)}
        self.modules = {
            name: Module(name, file.name == "__init__.py", tree, _imports(tree, name, files))
            for name, file in files.items()
            for tree in [ast.parse(file.read_text(encoding="utf-8"))]
        }

    def arrows(self) -> Iterator[tuple[Module, str]]:
        """A module and one that it imports, the lazy exceptions left out."""
        for module in self.modules.values():
            for other in sorted(module.imports):
                if (module.name, other) not in LAZY:
                    yield module, other


def _files(root: Path, package: str) -> Iterator[tuple[str, Path]]:
    for file in sorted((root / package).rglob("*.py")):
        parts = file.relative_to(root).with_suffix("").parts
        yield ".".join(parts[:-1] if parts[-1] == "__init__" else parts), file


def _imports(tree: ast.Module, own: str, files: dict[str, Path]) -> frozenset[str]:
    """Whole names of what a module imports: our own modules as deep as they are named, of others the package."""
    found = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{own}: imports are absolute"
            for alias in node.names:
                inner = f"{node.module}.{alias.name}"
                found.add(inner if inner in files else str(node.module))
    return frozenset(name if name in files else name.partition(".")[0] for name in found) - {own}


def circles(house: House) -> list[str]:
    graph: dict[str, set[str]] = {name: set() for name in house.modules}
    for module, other in house.arrows():
        if other in graph:
            graph[module.name].add(other)
    try:
        graphlib.TopologicalSorter(graph).prepare()
    except graphlib.CycleError as error:
        return ["circle: " + " <- ".join(error.args[1])]
    return []


def upward_imports(house: House) -> list[str]:
    found = []
    for module, other in house.arrows():
        package, _, rest = other.partition(".")
        if package != module.package or package not in FLOORS or not module.room:
            continue
        floor = {name: number for number, names in enumerate(FLOORS[package]) for name in names}
        room = rest.partition(".")[0]
        if room == module.room:
            continue
        if not room or floor.get(module.room, -1) <= floor.get(room, len(floor)):
            found.append(f"{module.name} imports {other}, which does not stand below it")
    return found


def forbidden_packages(house: House) -> list[str]:
    found = []
    for module, other in house.arrows():
        package = other.partition(".")[0]
        allowed = FOREIGN.get(module.package)
        if allowed is not None and package not in {*allowed, module.package, *sys.stdlib_module_names}:
            found.append(f"{module.name} imports {package}; {module.package} takes {', '.join(sorted(allowed))} only")
        if other in SEEN_BY_ALL:
            continue
        if (module.package, package) == ("ocp", "models") and module.room not in SEES_MODELS | {""}:
            found.append(f"{module.name} imports {other}; only {', '.join(sorted(SEES_MODELS))} may import models")
    return found


def shadowed_modules(house: House) -> list[str]:
    """Names in a package's face that are not the submodule of that name."""
    found = []
    for module in house.modules.values():
        inside = {name.rpartition(".")[2] for name in house.modules if name.rpartition(".")[0] == module.name}
        for name, source in _bound(module.tree):
            if name in inside and source != module.name:
                found.append(f"{module.name}: {name!r} hides the module {module.name}.{name}")
    return found


def faces(house: House) -> list[str]:
    """A face lists in `__all__`, sorted, exactly what it imports; every `__all__` names what is there."""
    found = []
    for module in house.modules.values():
        bound = {name for name, _ in _bound(module.tree)}
        listed = _listed(module.tree)
        public = {name for name in bound if not name.startswith("_")} - {"annotations"}
        if listed is None:
            if module.is_package and public:
                found.append(f"{module.name}: no __all__ for {', '.join(sorted(public))}")
            continue
        if sorted(set(listed)) != sorted(listed):
            found.append(f"{module.name}: __all__ names something twice")
        wrong = set(listed) ^ public if module.is_package else set(listed) - bound
        if wrong:
            found.append(f"{module.name}: __all__ and what is there differ in {', '.join(sorted(wrong))}")
    return found


def rooms(house: House) -> list[str]:
    found = []
    for module in house.modules.values():
        known = {name for floor in FLOORS[module.package] for name in floor}
        if module.room and module.room not in known:
            found.append(f"{module.name} lies outside the rooms of {module.package}")
        if not ast.get_docstring(module.tree):
            found.append(f"{module.name} does not say what it is: no docstring")
    return found


def _bound(tree: ast.Module) -> Iterator[tuple[str, str]]:
    """Names that a module's top level binds, and for an import the module that it comes from."""
    for node in tree.body:
        if isinstance(node, ast.ImportFrom):
            yield from ((alias.asname or alias.name, str(node.module)) for alias in node.names)
        elif isinstance(node, ast.Import):
            yield from ((alias.asname or alias.name.partition(".")[0], alias.name) for alias in node.names)
        elif isinstance(node, ast.FunctionDef | ast.ClassDef):
            yield node.name, ""
        elif isinstance(node, ast.Assign | ast.AnnAssign):
            for target in node.targets if isinstance(node, ast.Assign) else [node.target]:
                yield from ((part.id, "") for part in ast.walk(target) if isinstance(part, ast.Name))


def _listed(tree: ast.Module) -> list[str] | None:
    lists = [
        node.value for node in tree.body if isinstance(node, ast.Assign) and ast.unparse(node.targets[0]) == "__all__"
    ]
    return list(ast.literal_eval(lists[-1])) if lists else None


@cache
def built() -> House:
    return House(ROOT)


RULES: tuple[Rule, ...] = (circles, upward_imports, forbidden_packages, shadowed_modules, faces, rooms)


@pytest.mark.parametrize("rule", RULES, ids=lambda rule: rule.__name__)
def test_the_house_keeps_the_rule(rule: Rule) -> None:
    broken = rule(built())
    assert not broken, "\n".join(broken)


SOUND = {
    "models/__init__.py": '"""Face."""\nfrom models.robot.robot import Robot\n__all__ = ["Robot"]\n',
    "models/robot/__init__.py": '"""Robots."""\n',
    "models/robot/robot.py": '"""A robot."""\nimport casadi\nfrom models.errors import ModelError\nclass Robot: ...\n',
    "models/robot/tree.py": '"""A tree."""\n',
    "models/cache.py": '"""Files."""\n',
    "models/errors.py": '"""Errors."""\nclass ModelError(ValueError): ...\n',
    "ocp/__init__.py": '"""Face."""\nfrom ocp.methods import solve\n__all__ = ["solve"]\n',
    "ocp/methods.py": '"""Methods."""\nfrom ocp.direct.nlp import call\ndef solve(): ...\n',
    "ocp/solution.py": '"""A solution."""\ndef audit():\n    from ocp.audit.audit import audit\n',
    "ocp/audit/__init__.py": '"""Audits."""\n',
    "ocp/audit/audit.py": '"""The audit."""\nfrom ocp.solution import audit as again\n',
    "ocp/direct/__init__.py": '"""Direct methods."""\n',
    "ocp/direct/nlp.py": '"""Programs."""\ndef call(): ...\n',
    "ocp/direct/guess.py": '"""Guesses."""\nfrom models import cache\n',
    "ocp/tasks/__init__.py": '"""Tasks."""\n',
    "ocp/tasks/tip_task.py": '"""Tip tasks."""\nfrom models import Robot\n',
    "ocp/schedule/__init__.py": '"""Schedules."""\n',
    "ocp/schedule/limits.py": '"""Limits."""\nimport ocp.errors\n',
    "ocp/errors.py": '"""Errors."""\n',
    "ocp/curves.py": '"""Curves."""\n',
}


def house_of(folder: Path, files: dict[str, str]) -> House:
    for name, text in files.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(text, encoding="utf-8")
    return House(folder)


def test_a_sound_house_breaks_no_rule(tmp_path: Path) -> None:
    house = house_of(tmp_path, SOUND)
    assert len(house.modules) == len(SOUND)
    assert [broken for rule in RULES for broken in rule(house)] == []


PLANTED: list[tuple[Rule, str, dict[str, str]]] = [
    (
        circles,
        "ocp.direct.guess",
        {"ocp/direct/guess.py": "from ocp.direct import nlp", "ocp/direct/nlp.py": "from ocp.direct import guess"},
    ),
    (
        circles,
        "models.robot.robot",
        {
            "models/robot/tree.py": "import models.robot.robot",
            "models/robot/robot.py": "from models.robot.tree import x",
        },
    ),
    (circles, "models.errors", {"models/errors.py": "if False:\n    from models import Robot"}),
    (upward_imports, "ocp.direct.guess imports ocp.methods", {"ocp/direct/guess.py": "from ocp.methods import solve"}),
    (
        upward_imports,
        "ocp.direct.guess imports ocp.audit.audit",
        {"ocp/direct/guess.py": "from ocp.audit import audit"},
    ),
    (upward_imports, "ocp.errors imports ocp.solution", {"ocp/errors.py": "def f():\n    import ocp.solution"}),
    (upward_imports, "ocp.curves imports ocp, ", {"ocp/curves.py": "from ocp import solve"}),
    (
        upward_imports,
        "models.errors imports models.robot.tree",
        {"models/errors.py": "from models.robot.tree import x"},
    ),
    (upward_imports, "ocp.schedule.limits imports ocp.tasks", {"ocp/schedule/limits.py": "import ocp.tasks"}),
    (forbidden_packages, "models.robot.tree imports matplotlib", {"models/robot/tree.py": "import matplotlib.pyplot"}),
    (forbidden_packages, "models.robot.tree imports ocp", {"models/robot/tree.py": "from ocp.errors import x"}),
    (forbidden_packages, "ocp.direct.nlp imports models", {"ocp/direct/nlp.py": "from models import Robot"}),
    (shadowed_modules, "'methods' hides", {"ocp/__init__.py": "from ocp.methods import solve as methods"}),
    (shadowed_modules, "'audit' hides", {"ocp/audit/__init__.py": "def audit(): ..."}),
    (faces, "differ in call", {"ocp/__init__.py": "from ocp.direct.nlp import call"}),
    (faces, "differ in Robot", {"models/__init__.py": "__all__ = []"}),
    (faces, "differ in Link", {"models/__init__.py": "__all__ = ['Link', 'Robot']"}),
    (faces, "no __all__ for call", {"ocp/direct/__init__.py": "from ocp.direct.nlp import call"}),
    (faces, "differ in gone", {"ocp/direct/nlp.py": "__all__ = ['gone']"}),
    (rooms, "ocp.utils lies outside", {"ocp/utils.py": '"""Odds and ends."""'}),
    (rooms, "ocp.extras.thing lies outside", {"ocp/extras/thing.py": '"""A thing."""'}),
    (rooms, "ocp.direct.bare does not say", {"ocp/direct/bare.py": "x = 1"}),
]


@pytest.mark.parametrize(("rule", "told", "lines"), PLANTED, ids=[f"{p[0].__name__}: {p[1]}" for p in PLANTED])
def test_a_planted_violation_is_named(rule: Rule, told: str, lines: dict[str, str], tmp_path: Path) -> None:
    files = {file: SOUND.get(file, "") + line + "\n" for file, line in lines.items()}
    broken = rule(house_of(tmp_path, {**SOUND, **files}))
    assert any(told in message for message in broken), broken
