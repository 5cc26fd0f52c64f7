"""Rules of the architecture: which package may import which, what a package's `__init__` shows, how large things are.

The rules read the source and import nothing, so a lazy import and one for annotations count like any other. Each rule
is also tried on a small tree of modules that breaks it.
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

pytestmark = pytest.mark.xdist_group("imports")  # the source is read once
ROOT = Path(__file__).resolve().parent.parent
Rule: TypeAlias = Callable[["Architecture"], list[str]]

LAYERS = {
    "models": [
        ["errors", "files"],
        ["checks"],
        ["spatial"],
        ["robot", "paths"],
        ["shapes"],
        ["machines", "cts"],
        ["examples"],
    ],
    "ocp": [
        ["errors", "curves", "tolerances"],
        ["console"],
        ["storage", "solution_data"],
        ["problem"],
        ["solution"],
        ["direct", "audit"],
        ["indirect"],
        ["methods"],
        ["switching", "tightening"],
        ["refinement"],
        ["adaptive"],
        ["motion"],
        ["app"],
        ["__main__"],
    ],
    "ocp.motion": [["tasks"], ["local", "schedule"], ["builders"], ["sampling", "search"], ["result"], ["plan"]],
    "ocp.app": [["files", "batch"], ["check"], ["view"], ["subcommands"]],
}
"""Packages and single modules of each package, from the lowest layer up: each may import from lower layers only."""
MACHINES = {"ocp.motion", "ocp.app"}
"""What may import `models`: all else knows no machine, beyond the modules of MATHEMATICS."""
MATHEMATICS = {"models.checks", "models.errors", "models.files", "models.shapes.hull"}
FOREIGN = {"models": {"casadi", "collada", "mujoco", "numpy", "scipy", "xacro", "xacrodoc"}}
LARGEST_PACKAGE = 14
LARGEST_MODULE = 500


@dataclass(frozen=True)
class Module:
    """A module's name, whether it is a package's `__init__`, its syntax tree and the modules that it imports."""

    name: str
    is_package: bool
    tree: ast.Module
    imports: frozenset[str]
    lines: int

    @property
    def package(self) -> str:
        return self.name.partition(".")[0]

    @property
    def part(self) -> str:
        """The part of its top-level package that it belongs to, such as `ocp.motion`."""
        return ".".join(self.name.split(".")[:2])


class Architecture:
    """All modules of the two packages below a folder."""

    def __init__(self, root: Path) -> None:
        packages = [package for package in LAYERS if "." not in package]
        files = {name: file for package in packages for name, file in _files(root, package)}
        self.modules = {
            name: Module(name, file.name == "__init__.py", tree, _imports(tree, name, files), text.count("\n"))
            for name, file in files.items()
            for text in [file.read_text(encoding="utf-8")]
            for tree in [ast.parse(text)]
        }

    def arrows(self) -> Iterator[tuple[Module, str]]:
        """A module and one that it imports."""
        for module in self.modules.values():
            for other in sorted(module.imports):
                yield module, other


def _files(root: Path, package: str) -> Iterator[tuple[str, Path]]:
    for file in sorted((root / package).rglob("*.py")):
        parts = file.relative_to(root).with_suffix("").parts
        yield ".".join(parts[:-1] if parts[-1] == "__init__" else parts), file


def _imports(tree: ast.Module, own: str, files: dict[str, Path]) -> frozenset[str]:
    """Whole names of what a module imports: our own modules as deep as they are named, of others the package."""
    wrong = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            wrong |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{own}: imports are absolute"
            for alias in node.names:
                inner = f"{node.module}.{alias.name}"
                wrong.add(inner if inner in files else str(node.module))
    return frozenset(name if name in files else name.partition(".")[0] for name in wrong) - {own}


def circles(code: Architecture) -> list[str]:
    graph: dict[str, set[str]] = {name: set() for name in code.modules}
    for module, other in code.arrows():
        if other in graph:
            graph[module.name].add(other)
    try:
        graphlib.TopologicalSorter(graph).prepare()
    except graphlib.CycleError as error:
        return ["circle: " + " <- ".join(error.args[1])]
    return []


def upward_imports(code: Architecture) -> list[str]:
    wrong = []
    for module, other in code.arrows():
        for package, layers in LAYERS.items():
            if not (module.name.startswith(package + ".") and (other + ".").startswith(package + ".")):
                continue
            layer = {name: number for number, names in enumerate(layers) for name in names}
            own, target = (name.removeprefix(package).strip(".").partition(".")[0] for name in (module.name, other))
            if own != target and (not target or layer.get(own, -1) <= layer.get(target, len(layer))):
                wrong.append(f"{module.name} imports {other}, which is not in a lower layer")
    return wrong


def forbidden_packages(code: Architecture) -> list[str]:
    wrong = []
    for module, other in code.arrows():
        package = other.partition(".")[0]
        allowed = FOREIGN.get(module.package)
        if allowed is not None and package not in {*allowed, module.package, *sys.stdlib_module_names}:
            wrong.append(f"{module.name} imports {package}; {module.package} takes {', '.join(sorted(allowed))} only")
        knows_machines = module.name == "ocp" or module.part in MACHINES
        if package == "models" != module.package and not knows_machines and other not in MATHEMATICS:
            wrong.append(f"{module.name} imports {other}; only {', '.join(sorted(MACHINES))} may import models")
    return wrong


def sizes(code: Architecture) -> list[str]:
    """A package holds few modules and subpackages, a module few lines."""
    wrong = []
    for module in code.modules.values():
        inside = [name for name in code.modules if name.rpartition(".")[0] == module.name]
        if module.is_package and "." in module.name and len(inside) > LARGEST_PACKAGE:
            wrong.append(f"{module.name} holds {len(inside)} modules; at most {LARGEST_PACKAGE}")
        if module.lines > LARGEST_MODULE:
            wrong.append(f"{module.name} has {module.lines} lines; at most {LARGEST_MODULE}")
    return wrong


def shadowed_modules(code: Architecture) -> list[str]:
    """Names in a package's face that are not the submodule of that name."""
    wrong = []
    for module in code.modules.values():
        inside = {name.rpartition(".")[2] for name in code.modules if name.rpartition(".")[0] == module.name}
        for name, source in _bound(module.tree):
            if name in inside and source != module.name:
                wrong.append(f"{module.name}: {name!r} hides the module {module.name}.{name}")
    return wrong


def faces(code: Architecture) -> list[str]:
    """A face lists in `__all__`, sorted, exactly what it imports; every `__all__` names what is there."""
    wrong = []
    for module in code.modules.values():
        bound = {name for name, _ in _bound(module.tree)}
        listed = _listed(module.tree)
        public = {name for name in bound if not name.startswith("_")} - {"annotations"}
        if listed is None:
            if module.is_package and public:
                wrong.append(f"{module.name}: no __all__ for {', '.join(sorted(public))}")
            continue
        if sorted(set(listed)) != sorted(listed):
            wrong.append(f"{module.name}: __all__ names something twice")
        differing = set(listed) ^ public if module.is_package else set(listed) - bound
        if differing:
            wrong.append(f"{module.name}: __all__ and what is there differ in {', '.join(sorted(differing))}")
    return wrong


def places(code: Architecture) -> list[str]:
    """Every module belongs to a layer and says what it is."""
    wrong = []
    for module in code.modules.values():
        for package, layers in LAYERS.items():
            own = module.name.removeprefix(package + ".").partition(".")[0]
            if module.name.startswith(package + ".") and own not in {name for names in layers for name in names}:
                wrong.append(f"{module.name} is in no layer of {package}")
        if not ast.get_docstring(module.tree):
            wrong.append(f"{module.name} does not say what it is: no docstring")
    return wrong


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
def built() -> Architecture:
    return Architecture(ROOT)


RULES: tuple[Rule, ...] = (circles, upward_imports, forbidden_packages, shadowed_modules, faces, places, sizes)


@pytest.mark.parametrize("rule", RULES, ids=lambda rule: rule.__name__)
def test_the_code_keeps_the_rule(rule: Rule) -> None:
    broken = rule(built())
    assert not broken, "\n".join(broken)


SOUND = {
    "models/__init__.py": '"""Face."""\nfrom models.robot.robot import Robot\n__all__ = ["Robot"]\n',
    "models/robot/__init__.py": '"""Robots."""\n',
    "models/robot/robot.py": '"""A robot."""\nimport casadi\nfrom models.errors import ModelError\nclass Robot: ...\n',
    "models/robot/tree.py": '"""A tree."""\n',
    "models/files.py": '"""Files."""\n',
    "models/errors.py": '"""Errors."""\nclass ModelError(ValueError): ...\n',
    "ocp/__init__.py": '"""Face."""\nfrom ocp.methods import solve\n__all__ = ["solve"]\n',
    "ocp/methods.py": '"""Methods."""\nfrom ocp.direct.nlp import call\ndef solve(): ...\n',
    "ocp/solution.py": '"""A solution."""\n',
    "ocp/audit/__init__.py": '"""Audits."""\n',
    "ocp/audit/audit.py": '"""The audit."""\nimport ocp.solution\n',
    "ocp/direct/__init__.py": '"""Direct methods."""\n',
    "ocp/direct/nlp.py": '"""Programs."""\ndef call(): ...\n',
    "ocp/direct/guess.py": '"""Guesses."""\nfrom models import files\n',
    "ocp/motion/__init__.py": '"""Motions."""\n',
    "ocp/motion/tasks/__init__.py": '"""Tasks."""\n',
    "ocp/motion/tasks/tip_task.py": '"""Tip tasks."""\nfrom models import Robot\n',
    "ocp/motion/schedule/__init__.py": '"""Schedules."""\n',
    "ocp/motion/schedule/limits.py": '"""Limits."""\nimport ocp.errors\n',
    "ocp/errors.py": '"""Errors."""\n',
    "ocp/curves.py": '"""Curves."""\n',
}


def architecture_of(folder: Path, files: dict[str, str]) -> Architecture:
    for name, text in files.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(text, encoding="utf-8")
    return Architecture(folder)


def test_a_sound_architecture_breaks_no_rule(tmp_path: Path) -> None:
    code = architecture_of(tmp_path, SOUND)
    assert len(code.modules) == len(SOUND)
    assert [broken for rule in RULES for broken in rule(code)] == []


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
    (
        upward_imports,
        "ocp.motion.tasks.tip_task imports ocp.motion.schedule",
        {"ocp/motion/tasks/tip_task.py": "import ocp.motion.schedule"},
    ),
    (forbidden_packages, "models.robot.tree imports matplotlib", {"models/robot/tree.py": "import matplotlib.pyplot"}),
    (forbidden_packages, "models.robot.tree imports ocp", {"models/robot/tree.py": "from ocp.errors import x"}),
    (forbidden_packages, "ocp.direct.nlp imports models", {"ocp/direct/nlp.py": "from models import Robot"}),
    (
        upward_imports,
        "ocp.motion.tasks.tip_task imports ocp.motion.plan",
        {"ocp/motion/tasks/tip_task.py": "def f():\n    import ocp.motion.plan", "ocp/motion/plan/__init__.py": ""},
    ),
    (upward_imports, "ocp.solution imports ocp.audit.audit", {"ocp/solution.py": "import ocp.audit.audit"}),
    (sizes, "ocp.direct.nlp has 501 lines", {"ocp/direct/nlp.py": "# a line\n" * 498}),
    (sizes, "ocp.direct holds 15 modules", {f"ocp/direct/part_{number}.py": '"""A part."""' for number in range(13)}),
    (shadowed_modules, "'methods' hides", {"ocp/__init__.py": "from ocp.methods import solve as methods"}),
    (shadowed_modules, "'audit' hides", {"ocp/audit/__init__.py": "def audit(): ..."}),
    (faces, "differ in call", {"ocp/__init__.py": "from ocp.direct.nlp import call"}),
    (faces, "differ in Robot", {"models/__init__.py": "__all__ = []"}),
    (faces, "differ in Link", {"models/__init__.py": "__all__ = ['Link', 'Robot']"}),
    (faces, "no __all__ for call", {"ocp/direct/__init__.py": "from ocp.direct.nlp import call"}),
    (faces, "differ in gone", {"ocp/direct/nlp.py": "__all__ = ['gone']"}),
    (places, "ocp.utils is in no layer of ocp", {"ocp/utils.py": '"""Odds and ends."""'}),
    (places, "ocp.extras.thing is in no layer of ocp", {"ocp/extras/thing.py": '"""A thing."""'}),
    (places, "ocp.direct.bare does not say", {"ocp/direct/bare.py": "x = 1"}),
]


@pytest.mark.parametrize(("rule", "report", "lines"), PLANTED, ids=[f"{p[0].__name__}: {p[1]}" for p in PLANTED])
def test_a_planted_violation_is_named(rule: Rule, report: str, lines: dict[str, str], tmp_path: Path) -> None:
    files = {file: SOUND.get(file, "") + line + "\n" for file, line in lines.items()}
    broken = rule(architecture_of(tmp_path, {**SOUND, **files}))
    assert any(report in message for message in broken), broken
