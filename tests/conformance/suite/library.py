"""All problems of the public suites that can be stated, and why the others cannot."""

from __future__ import annotations

from functools import cache
from importlib import import_module
from pathlib import Path

from .entry import Entry

OTHERS = {"__init__", "__main__", "entry", "estimation", "library", "page", "peer", "run", "table", "test_suite"}
"""Modules beside those of problems."""
MODULES = sorted(file.stem for file in Path(__file__).parent.glob("*.py") if file.stem not in OTHERS)


@cache
def stated() -> dict[str, tuple[str, Entry]]:
    """Every problem by its name, with the module that states it."""
    pairs = []
    for name in MODULES:
        module = import_module(f"{__package__}.{name}")
        pairs += [(name, entry) for entry in getattr(module, "ENTRIES", None) or (module.ENTRY,)]
    return {entry.name: (name, entry) for name, entry in sorted(pairs, key=lambda pair: pair[1].name)}


def entries() -> dict[str, Entry]:
    """Every problem by its name."""
    return {name: entry for name, (_, entry) in stated().items()}


def module_of(name: str) -> str:
    """The module that states a problem."""
    return stated()[name][0]


SAME = {"dqc": "mineng_di", "lqr_radau": "lqr_gauss", "space_shuttle": "shuttle_reentry", "steering": "lts"}
"""Problems of the suites that are stated under the name of another."""
EXCLUDED = {
    "delay_history": "a comparison of two transcriptions of delayed states, without a cost to compare",
    "int_static_linear": "a parameter with integer values: four problems, to be solved one by one",
    "notorious": "its data are drawn by the generator of the source, so that its cost cannot be reproduced",
}
"""Problems of the suites that are not stated, and the reason."""
