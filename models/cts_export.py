"""The rig's functions by name: what a controller without Python needs, to be written as C by models.c_export."""

from __future__ import annotations

from typing import Any

import casadi as ca

from models.cts import HOME, Branch, Rig, Tunnel, forward, goose_neck_corner, inverse
from models.cts_optimal import optimal_inverse
from models.cts_table import arc_functions


def rig_functions(rig: Rig, tunnel: Tunnel, branch: Branch = HOME, rate_weight: float = 5.0) -> dict[str, Any]:
    """All functions of a rig, by name; each can be mapped over a table with `.map(samples)`.

    forward: (joints) -> (pose). inverse: (target, roll) -> (joints, reach), see cts.inverse. corner: (target, roll)
    -> (P_G). arc_ends, feasible: see cts_table.arc_functions. optimal_inverse_i1_free, optimal_inverse_i1,
    optimal_inverse_i2: (target, previous) -> (joints, cost, active, status), see cts_optimal; I2 with `rate_weight`.
    """
    q, target, roll = ca.SX.sym("joints", 6), ca.SX.sym("target", 5), ca.SX.sym("roll")
    functions = [
        ca.Function("forward", [q], [forward(rig, q)], ["joints"], ["pose"]),
        ca.Function("inverse", [target, roll], ca.cse(list(inverse(rig, target, roll, branch)))),
        ca.Function("corner", [target, roll], [goose_neck_corner(rig, target, roll)]),
        *arc_functions(rig, branch),
        optimal_inverse(rig, tunnel, branch, limits=False),
        optimal_inverse(rig, tunnel, branch),
        optimal_inverse(rig, tunnel, branch, rate_weight=rate_weight),
    ]
    return {function.name(): function for function in functions}
