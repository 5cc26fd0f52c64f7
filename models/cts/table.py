"""Inverse kinematics of the rig for tables of targets, intervals of feasible roll angles, and export to C code.

`solve_table` converts a table of targets to a table of joints; rows without a solution have the reason as their status.
`rig_functions` and `export` serve controllers without Python. The generated C needs only the mathematics library. It is
straight-line code with a few branches, so its computing time is bounded.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np

from models.checks import Array, ArrayInput, require, warn_of_degrees
from models.cts.best_roll import optimal_inverse
from models.cts.clearance import Avoidance, collision_free_inverse
from models.cts.rig import (
    HOME,
    Branch,
    Rig,
    Tunnel,
    checked_branch,
    configuration_at,
    forward,
    goose_neck_corner,
    inverse,
)
from models.cts.roll import ACTIVE, STATUS, arc_ends, check_constraints, limit_code, slide_ends
from models.errors import ModelError
from models.spatial import FULL_TURN


@dataclass(frozen=True, eq=False)
class Table:
    """Inverse kinematics solutions of the rig for a table of targets.

    Attributes:
        targets: (x, y, z, yaw, pitch) in world. Shape (samples, 5), m and rad.
        joints: Joint positions. Shape (samples, 6), m and rad; nan for targets without a solution.
        cost: Value of the index at the roll, nan for targets without a solution. Shape (samples,).
        status: "ok" or the reason why there is no solution, for each target; one of roll.STATUS.
        active: Active constraint of each target, one of roll.ACTIVE; "free" if there is none, "" without a solution.
        branch: Branch of inverse kinematics of each target, None without a solution.
    """

    targets: Array
    joints: Array
    cost: Array
    status: tuple[str, ...]
    active: tuple[str, ...]
    branch: tuple[Branch | None, ...]

    @property
    def ok(self) -> Any:
        """Whether each target has a solution. Shape (samples,), bool."""
        return np.array([status == "ok" for status in self.status])


def solve_table(
    rig: Rig,
    tunnel: Tunnel,
    targets: ArrayInput,
    *,
    branches: Sequence[Branch] = (HOME,),
    previous: ArrayInput = 0.0,
    in_sequence: bool = False,
    rate_weight: float = 0.0,
    avoidance: Avoidance | None = None,
) -> Table:
    """Return the joint positions that minimise the cost index I1 or I2 for every target of a table.

    A target without a solution does not affect the others.

    Args:
        targets: Shape (samples, 5), m and rad; rows may hold nan.
        branches: Branches of inverse kinematics to choose from; of equal indices the first branch is taken.
        previous: Roll before each target, rad, shape (samples,) or one for all; with in_sequence, before the first.
        in_sequence: Whether the roll of each row is the previous roll of the next, as in a motion; rows without a
            solution are skipped.
        rate_weight: w4 of I2; 0 for I1.
        avoidance: Obstacles to avoid, as in `collision_free_inverse`; None for none.

    Raises:
        ModelError: The table is empty or has a wrong shape, there is no branch or an unknown one, or a previous roll is
            not finite.
    """
    require.flag("table: in_sequence", in_sequence)
    rows = checked_targets(targets, finite=False)
    branches = require.each("table: branches", branches, Branch)
    if not branches:
        message = "table: branches is empty; give at least one, for example (HOME,)"
        raise ModelError(message, name="branches", value=branches)
    count = len(rows)
    before = require.broadcast("table: previous", previous, count, "targets")
    if avoidance is None:
        functions = [optimal_inverse(rig, tunnel, branch, rate_weight=rate_weight) for branch in branches]
    else:
        functions = [collision_free_inverse(rig, tunnel, avoidance, each, rate_weight=rate_weight) for each in branches]
    if in_sequence:
        roll, results = float(before[0]), []
        for row in rows:
            results.append(_best_branch([f(row, roll) for f in functions])[0])
            if results[-1][9] == 0:
                roll = float(results[-1][5])
        best = np.array(results)
    else:
        best = _best_branch([f.map(count)(rows.T, before[None]) for f in functions])
    solved = best[:, 9] == 0
    status = tuple(STATUS[int(code)] for code in best[:, 9])
    active = tuple(ACTIVE[int(code)] if ok else "" for code, ok in zip(best[:, 8], solved, strict=True))
    branch = tuple(branches[int(i)] if ok else None for i, ok in zip(best[:, 7], solved, strict=True))
    return Table(rows, best[:, :6], best[:, 6], status, active, branch)


def _best_branch(results: list[Any]) -> Array:
    """Return for each target the least-cost solution among the inverse kinematics branches. Shape (samples, 10).

    Columns: joint positions (6), cost, branch number, codes of active constraint and status.
    """
    best: Array | None = None
    for number, (joints, cost, active, status, *_) in enumerate(results):
        columns = [np.array(part, dtype=float) for part in (joints, cost, active, status)]
        rows = np.vstack([columns[0], columns[1], np.full_like(columns[1], number), columns[2], columns[3]]).T
        if best is None:
            best = rows
            continue
        solved, best_solved = rows[:, 9] == 0, best[:, 9] == 0
        better = solved & (~best_solved | (rows[:, 6] < best[:, 6] - 1e-12))
        further = ~solved & ~best_solved & (rows[:, 9] > best[:, 9])  # most satisfied tests: names the reason
        best = np.where((better | further)[:, None], rows, best)
    assert best is not None
    return best


@dataclass(frozen=True)
class RollInterval:
    """An interval of roll angles at which the rig reaches a target within all joint limits.

    Attributes:
        start, end: rad, end >= start; a full turn is -pi .. pi.
        constraints: Active constraints (of roll.ACTIVE) at start and end; ("free", "free") for a full turn.
    """

    start: float
    end: float
    constraints: tuple[str, str]


def reachable_rolls(rig: Rig, target: ArrayInput, branch: Branch = HOME) -> list[RollInterval]:
    """Return the intervals of roll angles, modulo a full turn, in which the rig reaches a target within joint limits.

    Every interval starts in [-pi, pi).

    Args:
        target: Shape (5,), m and rad.

    Raises:
        ModelError: The target has a wrong shape or is not finite.
    """
    require.instance("rig: rig", rig, Rig)
    row = checked_targets([target])[0]
    ends, feasible = roll_interval_functions(rig, checked_branch(branch))
    points = np.array(ends(row))
    turns = np.arctan2(points[1], points[0])
    order = np.argsort(turns)
    turns, codes = turns[order], points[2][order].astype(int)
    if not len(turns):
        turns, codes = np.array([-np.pi]), np.array([0])
    middles = (turns + np.append(turns[1:], turns[0] + FULL_TURN)) / 2
    inside = np.array(feasible.map(len(middles))(row, middles[None])).ravel() > 0
    if inside.all():
        return [RollInterval(-np.pi, np.pi, ("free", "free"))]
    intervals = []
    count = len(turns)
    for k in np.flatnonzero(inside & ~np.roll(inside, 1)):
        last = int(k)
        while inside[(last + 1) % count]:
            last += 1
        stop = (last + 1) % count
        end = float(turns[stop] + (FULL_TURN if turns[stop] <= turns[k] else 0.0))
        intervals.append(RollInterval(float(turns[k]), end, (ACTIVE[codes[k]], ACTIVE[codes[stop]])))
    return intervals


@lru_cache(maxsize=16)
def roll_interval_functions(rig: Rig, branch: Branch = HOME) -> tuple[Any, Any]:
    """Return CasADi Functions for the possible ends of feasible roll intervals and for the feasibility of a roll angle.

    (target) -> points, with rows cosine, sine and code of the constraint in roll.ACTIVE; (target, roll) -> feasible.
    """
    target, roll = ca.SX.sym("target", 5), ca.SX.sym("roll")
    angle = ca.horzcat(*[ca.vertcat(*candidate) for candidate in arc_ends(rig, target, branch)])
    x = ca.MX.sym("target", 5)
    parts = [ca.Function("angle_ends", [target], [angle])(x)]
    for upper in (False, True):
        if np.isfinite(rig.limit(1, upper)):
            parts.append(ca.vertcat(slide_ends(rig, branch, upper)(x), ca.DM.ones(1, 8) * limit_code(1, upper)))
    ends = ca.Function("arc_ends", [x], [ca.horzcat(*parts)], ["target"], ["points"])
    c, s = ca.cos(roll), ca.sin(roll)
    meets = check_constraints(rig, target, configuration_at(rig, target, c, s, branch=branch), c=c, s=s)
    inside = ca.logic_and(meets.all_but_slide(), meets.slide())
    return ends, ca.Function("feasible", [target, roll], [inside], ["target", "roll"], ["feasible"])


def checked_targets(targets: ArrayInput, finite: bool = True) -> Array:
    """Return targets (x, y, z, yaw, pitch), one per row of an array; raise ModelError about the first invalid row."""
    rows = require.array("table: targets", targets, ("samples", 5), entries="finite" if finite else "any")
    warn_of_degrees("table: yaw or pitch", rows[:, 3:], "targets")
    return rows


def rig_functions(rig: Rig, tunnel: Tunnel, branch: Branch = HOME, rate_weight: float = 5.0) -> dict[str, Any]:
    """Return the CasADi Functions of a rig's forward and inverse kinematics, by name, for tables or export to C.

    `.map(samples)` applies a Function to a table. forward: (joints) -> (pose). inverse: (target, roll) -> (joints,
    reach), see `rig.inverse`. corner: (target, roll) -> (P_G). arc_ends, feasible: see `roll_interval_functions`.
    optimal_inverse_i1_free, optimal_inverse_i1, optimal_inverse_i2: (target, previous) -> (joints, cost, active,
    status), see `best_roll.optimal_inverse`; I2 with `rate_weight`.
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
    """Write CasADi Functions as a C file and its header; the code needs only the C mathematics library.

    Args:
        functions: CasADi Functions, or a dictionary of them.
        path: Path of the C file; its folder is created.

    Raises:
        ModelError: There is no function, or the path does not end in .c.
    """
    exported = list(functions.values()) if isinstance(functions, dict) else list(functions)
    if not exported:
        raise ModelError("export: there is no function to write", name="functions", value=functions)
    if path.suffix != ".c":
        raise ModelError(f"export: {path.name!r} must end in .c", name="path", value=path, limit=".c")
    path.parent.mkdir(parents=True, exist_ok=True)
    code = ca.CodeGenerator(path.name, {"with_header": True, "casadi_int": "long long int"})
    for function in exported:
        code.add(function)
    code.generate(os.path.join(path.parent.resolve(), ""))  # casadi concatenates folder and name
    return path
