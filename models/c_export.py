"""Functions as C that needs nothing but the mathematics library: for controllers without Python."""

from __future__ import annotations

import os
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import casadi as ca

from models.errors import ModelError


def export(functions: dict[str, Any] | Iterable[Any], path: Path) -> Path:
    """Write functions as one C file with its header, with no dependency but the C mathematics library.

    Args:
        functions: casadi Functions, or a dictionary of them.
        path: The C file; its folder is made.

    Raises:
        ModelError: No function, or a path that does not end in .c.
    """
    chosen = list(functions.values()) if isinstance(functions, dict) else list(functions)
    if not chosen:
        raise ModelError("export: there is no function to write")
    if path.suffix != ".c":
        raise ModelError(f"export: {path.name!r} must end in .c")
    path.parent.mkdir(parents=True, exist_ok=True)
    code = ca.CodeGenerator(path.name, {"with_header": True, "casadi_int": "long long int"})
    for function in chosen:
        code.add(function)
    code.generate(os.path.join(path.parent.resolve(), ""))  # casadi joins folder and name as text
    return path
