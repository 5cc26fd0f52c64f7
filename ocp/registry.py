"""Functions of upper packages that classes of lower packages offer as methods.

`Solution.audit`, `Solution.sensitivity` and the `plot` methods belong to classes, but the work is done by packages that
import `Solution`. The upper packages register those functions here by name, and the methods look them up, so that
imports run in one direction. A function is registered by its module's name and imported on its first call: a program
that plots nothing does not load matplotlib.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable
from typing import Any

__all__ = ["call_registered", "register"]

_FUNCTIONS: dict[str, str] = {}


def register(operation: str, module: str) -> None:
    """Register the function called `operation` of a module under its own name."""
    _FUNCTIONS[operation] = module


def call_registered(operation: str, *args: Any, **options: Any) -> Any:
    """Call a registered function.

    Raises:
        LookupError: No package has registered a function of that name.
    """
    if operation not in _FUNCTIONS:
        raise LookupError(f"no package has registered {operation!r}; import ocp, which registers all of them")
    function: Callable[..., Any] = getattr(importlib.import_module(_FUNCTIONS[operation]), operation)
    return function(*args, **options)
