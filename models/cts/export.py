"""For controllers without Python: the rig's functions by name, and any functions as C.

The C needs nothing but the mathematics library: what is left of a search after its fixed number of operations is
straight-line code and a few branches, so that its time has a bound.
"""

from __future__ import annotations

import os
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import casadi as ca

from models.cts.best_roll import optimal_inverse
from models.cts.rig import HOME, Branch, Rig, Tunnel, forward, goose_neck_corner, inverse
from models.cts.table import roll_interval_functions
from models.errors import ModelError


def rig_functions(rig: Rig, tunnel: Tunnel, branch: Branch = HOME, rate_weight: float = 5.0) -> dict[str, Any]:
    """All functions of a rig, by name; each can be mapped over a table with `.map(samples)`.

    forward: (joints) -> (pose). inverse: (target, roll) -> (joints, reach), see rig.inverse. corner: (target, roll)
    -> (P_G). arc_ends, feasible: see table.roll_interval_functions. optimal_inverse_i1_free, optimal_inverse_i1,
    optimal_inverse_i2: (target, previous) -> (joints, cost, active, status), see best_roll; I2 with `rate_weight`.
    """
    q, target, roll = ca.SX.sym("joints", 6), ca.SX.sym("target", 5), ca.SX.sym("roll")
    functions = [
        ca.Function("forward", [q], [forward(rig, q)], ["joints"], ["pose"]),
        ca.Function("inverse", [target, roll], ca.cse(list(inverse(rig, target, roll, branch)))),
        ca.Function("corner", [target, roll], [goose_neck_corner(rig, target, roll)]),
        *roll_interval_functions(rig, branch),
        optimal_inverse(rig, tunnel, branch, limits=False),
        optimal_inverse(rig, tunnel, branch),
        optimal_inverse(rig, tunnel, branch, rate_weight=rate_weight),
    ]
    return {function.name(): function for function in functions}


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
        raise ModelError("export: there is no function to write", name="functions", value=functions)
    if path.suffix != ".c":
        raise ModelError(f"export: {path.name!r} must end in .c", name="path", value=path, limit=".c")
    path.parent.mkdir(parents=True, exist_ok=True)
    code = ca.CodeGenerator(path.name, {"with_header": True, "casadi_int": "long long int"})
    for function in chosen:
        code.add(function)
    code.generate(os.path.join(path.parent.resolve(), ""))  # casadi joins folder and name as text
    return path
