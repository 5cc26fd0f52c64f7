"""Grid mode: a table of poses in, a table of joints out, rows that cannot be held marked with the reason.

For controllers without Python: the rig's functions by name, and any functions as C.

The C needs nothing but the mathematics library: what is left of a search after its fixed number of operations is
straight-line code and a few branches, so that its time has a bound.
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

from models.arrays import (
    Array,
    ArrayInput,
    checked_array,
    checked_broadcast,
    checked_each,
    checked_flag,
    checked_instance,
    checked_number,
    warn_of_degrees,
)
from models.cts.best_roll import optimal_inverse
from models.cts.clearance import CollisionScene, clear_inverse
from models.cts.rig import (
    BRANCHES,
    HOME,
    Branch,
    Rig,
    Tunnel,
    checked_branch,
    forward,
    goose_neck_corner,
    inverse,
    posture_at,
)
from models.cts.roll import ACTIVE, STATUS, angle_ends, limit_code, slide_ends, verdict
from models.errors import ModelError
from models.spatial import FULL_TURN


@dataclass(frozen=True, eq=False)
class Table:
    """Joints for a table of targets.

    Attributes:
        targets: Shape (samples, 5), m and rad.
        joints: Shape (samples, 6), m and rad; nan in the rows that are not ok.
        cost: Index of the roll, nan in the rows that are not ok. Shape (samples,).
        status: One of roll.STATUS for each row: "ok", or why there are no joints.
        active: One of roll.ACTIVE for each row: the constraint that holds the roll, "free" where none does, ""
            where the row is not ok.
        branch: The branch of each row, None where the row is not ok.
    """

    targets: Array
    joints: Array
    cost: Array
    status: tuple[str, ...]
    active: tuple[str, ...]
    branch: tuple[Branch | None, ...]

    @property
    def ok(self) -> Any:
        """Which rows have joints. Shape (samples,), bool."""
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
    scene: CollisionScene | None = None,
    clearance: float = -np.inf,
    clearance_weight: float = 0.0,
    clearance_width: float = 0.05,
) -> Table:
    """Joints of least index for every target; a bad row is marked and does not touch the others.

    Args:
        targets: Shape (samples, 5), m and rad; rows may hold nan.
        branches: The joint sets to choose from: of those that hold the target the one of least index, the first of
            equals.
        previous: Roll before each target, rad, shape (samples,) or one for all; with in_sequence before the first.
        in_sequence: Whether each row's roll is the previous one of the next, as in a motion; rows that are not ok are
            passed over.
        rate_weight: w4 of I2; 0 for I1.
        scene: What to keep clear of, None for nothing, by at least `clearance`, m, or by a term
            clearance_weight exp(-distance / clearance_width) of the index; see clear_inverse.

    Raises:
        ModelError: An empty table, another shape, no branch, an unknown branch, a previous roll that is not finite.
    """
    checked_instance(rig, Rig, "rig", "rig")
    checked_instance(tunnel, Tunnel, "rig", "tunnel")
    checked_flag(in_sequence, "table", "in_sequence")
    rows = checked_targets(targets, finite=False)
    chosen = [checked_branch(branch) for branch in checked_each(branches, Branch, "table", "branches")]
    if not chosen:
        raise ModelError("branches is empty; give at least one, for example (HOME,)", name="branches", value=branches)
    count = len(rows)
    before = checked_broadcast(previous, count, "table", "previous", "targets")
    if scene is None:
        functions = [optimal_inverse(rig, tunnel, branch, rate_weight=rate_weight) for branch in chosen]
    else:
        asked: dict[str, Any] = {"clearance": clearance, "weight": clearance_weight, "width": clearance_width}
        asked["rate_weight"] = rate_weight
        functions = [clear_inverse(rig, tunnel, scene, branch, **asked) for branch in chosen]
    if in_sequence:
        roll, steps = float(before[0]), []
        for row in rows:
            steps.append(_best([f(row, roll) for f in functions]))
            if steps[-1][9] == 0:
                roll = float(steps[-1][5])
        found = np.array(steps)
    else:
        found = _best([f.map(count)(rows.T, before[None]) for f in functions])
        found = found.reshape(count, -1)
    status = tuple(STATUS[int(code)] for code in found[:, 9])
    fine = found[:, 9] == 0
    active = tuple(ACTIVE[int(code)] if good else "" for code, good in zip(found[:, 8], fine, strict=True))
    branch = tuple(chosen[int(i)] if good else None for i, good in zip(found[:, 7], fine, strict=True))
    return Table(rows, found[:, :6], found[:, 6], status, active, branch)


def _best(results: list[Any]) -> Array:
    """Of the branches' results the best, per row: joints, cost, branch number, active, status. Shape (samples, 10)."""
    best: Array | None = None
    for number, (joints, cost, active, status, *_) in enumerate(results):
        columns = [np.array(part, dtype=float) for part in (joints, cost, active, status)]
        rows = np.vstack([columns[0], columns[1], np.full_like(columns[1], number), columns[2], columns[3]]).T
        if best is None:
            best = rows
            continue
        solved, known = rows[:, 9] == 0, best[:, 9] == 0
        better = solved & (~known | (rows[:, 6] < best[:, 6] - 1e-12))
        nearer = ~solved & ~known & (rows[:, 9] > best[:, 9])  # the branch that came furthest names the reason
        best = np.where((better | nearer)[:, None], rows, best)
    assert best is not None
    return best if len(best) > 1 else best[0]


@dataclass(frozen=True)
class RollInterval:
    """A range of rolls that reach within all limits.

    Attributes:
        start, end: rad, end >= start; a whole turn is -pi .. pi.
        holds: Constraints (of roll.ACTIVE) at start and end; ("free", "free") for a whole turn.
    """

    start: float
    end: float
    holds: tuple[str, str]


def reachable_rolls(rig: Rig, target: ArrayInput, branch: Branch = HOME) -> list[RollInterval]:
    """All rolls, modulo a turn, that hold a target within reach and joint limits, start in [-pi, pi).

    Args:
        target: Shape (5,), m and rad.

    Raises:
        ModelError: A target of another shape or not finite.
    """
    checked_instance(rig, Rig, "rig", "rig")
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
    found = []
    count = len(turns)
    for k in np.flatnonzero(inside & ~np.roll(inside, 1)):
        last = int(k)
        while inside[(last + 1) % count]:
            last += 1
        stop = (last + 1) % count
        end = float(turns[stop] + (FULL_TURN if turns[stop] <= turns[k] else 0.0))
        found.append(RollInterval(float(turns[k]), end, (ACTIVE[codes[k]], ACTIVE[codes[stop]])))
    return found


@lru_cache(maxsize=16)  # a rig is frozen; one asked again is the same
def roll_interval_functions(rig: Rig, branch: Branch = HOME) -> tuple[Any, Any]:
    """Functions (target) -> points that hold all ends of arcs, rows cosine, sine, code; (target, roll) -> 1 or 0."""
    target, roll = ca.SX.sym("target", 5), ca.SX.sym("roll")
    angle = ca.horzcat(*[ca.vertcat(*candidate) for candidate in angle_ends(rig, target, branch)])
    x = ca.MX.sym("target", 5)
    parts = [ca.Function("angle_ends", [target], [angle])(x)]
    for upper in (False, True):
        if np.isfinite(rig.limit(1, upper)):
            found = slide_ends(rig, branch, upper)(x)
            parts.append(ca.vertcat(found, ca.DM.ones(1, 8) * limit_code(1, upper)))
    ends = ca.Function("arc_ends", [x], [ca.horzcat(*parts)], ["target"], ["points"])
    c, s = ca.cos(roll), ca.sin(roll)
    meets = verdict(rig, target, posture_at(rig, target, c, s, branch), c, s)
    inside = ca.logic_and(meets.relaxed(), meets.slide())
    return ends, ca.Function("feasible", [target, roll], [inside], ["target", "roll"], ["feasible"])


def all_joint_sets(rig: Rig, target: ArrayInput, roll: float) -> list[tuple[Branch, Array]]:
    """Every branch that reaches a target with a given roll, and its joints, shape (6,); joint limits are not asked.

    Raises:
        ModelError: A target or roll that is not finite; a pose that no branch reaches, naming the link.
    """
    checked_instance(rig, Rig, "rig", "rig")
    row = checked_targets([target])[0]
    checked_number(roll, "rig", "roll")
    found, short = [], []
    for branch in BRANCHES:
        joints, reach = inverse(rig, ca.DM(row), ca.DM(roll), branch)
        margin = np.array(reach).ravel()
        short.append(margin)
        if (margin >= 0).all():
            found.append((branch, np.array(joints).ravel()))
    if not found:
        pitch, yaw = np.max(short, axis=0)
        link, by = ("pitch", pitch * rig.pitch_link) if pitch < 0 else ("yaw", yaw * rig.yaw_link_1)
        message = f"target {row.tolist()} with roll {roll} rad: the {link} link is {-by:.4g} m too short"
        raise ModelError(message, name=f"{link} link", value=-by, limit=0.0)
    return found


def checked_targets(targets: ArrayInput, finite: bool = True) -> Array:
    """Targets (x, y, z, yaw, pitch), at least one, shape (samples, 5); ModelError naming the first wrong row."""
    rows = checked_array(targets, ("samples", 5), "table", "targets", finite=finite, nan=not finite)
    warn_of_degrees(rows[:, 3:], "table", "targets", "yaw or pitch")
    return rows


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
