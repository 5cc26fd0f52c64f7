"""Whether a standing machine can start at all where it is asked to: limits of the joints, and what the ground bears."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import casadi as ca
import numpy as np

from models.machines.standing import Standing
from models.robot.dynamics import Wrench
from ocp.errors import ProblemError
from ocp.tasks.start import Array
from ocp.tasks.tip_path import Path, path_derivatives
from ocp.tasks.zmp_rules import Following, IndexAtLeast, Pinned, ZmpRule, foot_edges

__all__ = ["check_freedom", "check_loads", "check_slope", "inside_limits", "tip_demand"]

ROUNDING = 1e-8
"""How far beyond a limit a start may be, rad or m: what rounding and inverse kinematics leave."""

MISSED = 1e-6
"""Share of a limit by which it has to be missed to count as missed."""

FAR = 1e6
"""Greatest acceleration that is thought of, rad/s^2 or m/s^2."""


def inside_limits(machine: Standing, joints: Array, lower: Array, upper: Array) -> Array:
    """The start, moved onto the limits where rounding has it beyond them. Shape (n,).

    Raises:
        ProblemError: A joint that starts outside its limits or has no room between them.
    """
    for name, value, low, high in zip(machine.robot.joint_names, joints, lower, upper, strict=True):
        if not low - ROUNDING <= value <= high + ROUNDING:
            raise ProblemError(f"start_joints: {name!r} starts at {value:g}, outside its limits {low:g} .. {high:g}")
        if not low < high:
            raise ProblemError(f"joint {name!r} cannot move between its limits {low:g} .. {high:g}: lock it there")
    return np.clip(joints, lower, upper)


def check_freedom(machine: Standing, rows: Sequence[int], zmp: ZmpRule, along: str, tip_level: str, end: str) -> None:
    """Raise ProblemError where tip and zero moment point ask for all joints, and these are to come to rest besides."""
    pinned = len(machine.moving_directions) if isinstance(zmp, Pinned | Following) else 0
    fixed = len(rows) + pinned - (along == "parameter")
    left = machine.joint_size - fixed
    follows = tip_level == "acceleration" and not pinned  # joints that the tip takes along to its rest
    if left < 0 or (left == 0 and end == "rest" and not follows):
        asked = f"the tip's {len(rows)} rows" + (f" and {pinned} of the zero moment point" if pinned else "")
        if left < 0:
            raise ProblemError(f"{asked} are more than {machine.joint_size} joints can do; ask for less")
        raise ProblemError(
            f"{asked} leave the {machine.joint_size} joints no freedom to come to rest at the end; say end='free', "
            + ("or pin the point less" if pinned else "or tip_level='acceleration'")
        )


def check_slope(machine: Standing, rows: Sequence[int], joints: Array, weight: float) -> None:
    """Raise ProblemError where the manipulability has no slope at the start, which the cost needs."""
    q = ca.SX.sym("q", machine.joint_size)
    slope = ca.Function("slope", [q], [ca.gradient(machine.manipulability((), q, rows), q)])
    if weight and not np.isfinite(np.array(slope(joints))).all():
        raise ProblemError(
            f"start_joints {np.round(joints, 4).tolist()}: the task's rows are singular there, and the manipulability "
            "in the cost has no slope; start elsewhere, or say Weights(manipulability=0)"
        )


def check_loads(
    machine: Standing,
    joints: Array,
    wrenches: Sequence[Wrench],
    zmp: ZmpRule,
    least_force: float,
    bounds: Mapping[str, Any],
    tip: tuple[Array, Array] | None,
) -> None:
    """Raise ProblemError where no joint accelerations at all would do at the start, from rest.

    Torques, vertical force and zero moment point are linear in them: a linear program finds those that miss the least.

    Args:
        machine, joints, wrenches: At the start.
        zmp, least_force, bounds: What may be, see standing_problem; bounds as Limits.bounds.
        tip: Rows T and values a of what the tip asks of them, T q'' = a; None where it asks nothing.
    """
    n, rest = machine.joint_size, np.zeros(machine.joint_size)
    qdd = ca.SX.sym("qdd", n)
    reaction = machine.ground_reaction(joints, rest, qdd, wrenches)
    torques = machine.joint_torques(joints, rest, qdd, wrenches)
    effort = np.asarray(bounds["torques"])
    rows = [
        (torques[i] / effort[i], f"the torque of {name!r}, at most {effort[i]:g} N m (N)")
        for i, name in enumerate(machine.robot.joint_names)
        if np.isfinite(effort[i])
    ]
    low, high = [-1.0] * len(rows), [1.0] * len(rows)
    sides = [(reaction[5] / least_force, f"the vertical force, at least {least_force:g} N")]
    low.append(1.0)
    for normal, offset in _edges(machine, zmp):
        moment = normal[0] * -reaction[1] + normal[1] * reaction[0] - offset * reaction[5]
        sides.append(
            (moment / (machine.weight * machine.support.half_widths.max()), "the place of the zero moment point")
        )
        low.append(0.0)
    high += [np.inf] * len(sides)
    rows += sides
    values = ca.vertcat(*(value for value, _ in rows))
    function = ca.Function("start", [qdd], [ca.densify(values), ca.densify(ca.jacobian(values, qdd))])
    at_rest, slopes = (np.array(part) for part in function(rest))
    missed = _least_missed(at_rest.ravel(), slopes, np.array(low), np.array(high), bounds["accelerations"], tip)
    if missed is None or missed.max(initial=0.0) <= MISSED:
        return
    words = [f"{what}, by {100 * share:.3g} %" for (_, what), share in zip(rows, missed, strict=True) if share > MISSED]
    raise ProblemError(
        f"start_joints {np.round(joints, 4).tolist()}: whatever the joints do there, limits are missed: "
        f"{'; '.join(words)}; start elsewhere, load the tip less, or allow for more"
    )


def tip_demand(
    machine: Standing, tip_path: Path, rows: Sequence[int], joints: Array, along_parameter: bool
) -> tuple[Array, Array]:
    """Rows and values of the accelerations that the path asks for at its start, from rest.

    Along a parameter the tip may move along the path's direction as fast as it likes: what remains is across it.
    """
    jacobian = np.array(ca.DM(machine.tip_jacobian((), joints)))[list(rows)]
    symbol = ca.MX.sym("progress")
    function = ca.Function("path", [symbol], list(path_derivatives(tip_path, symbol, len(jacobian))[1:]))
    slope, bend = (np.array(part).ravel() for part in function(0.0))
    if not along_parameter:
        return jacobian, bend
    length = np.linalg.norm(slope)
    direction = slope / length if length > 0 else slope
    across = np.eye(len(slope)) - np.outer(direction, direction)
    return across @ jacobian, np.zeros(len(slope))


def _edges(machine: Standing, zmp: ZmpRule) -> list[tuple[Array, float]]:
    """Inward normals and offsets of the half-planes that the zero moment point has to be in."""
    edges = list(zip(*foot_edges(machine, zmp), strict=True))
    unit = np.eye(2)
    if isinstance(zmp, IndexAtLeast):
        low, high = zmp.region(machine)
    elif isinstance(zmp, Pinned | Following):
        unit = machine.moving_directions
        low = high = unit @ np.array(ca.DM(zmp.place(machine, ca.DM(0.0)))).ravel()
    else:
        return edges
    for axis, least, greatest in zip(unit, low, high, strict=True):
        edges += [(axis, float(least)), (-axis, -float(greatest))]
    return edges


def _least_missed(
    at_rest: Array, slopes: Array, low: Array, high: Array, most: Any, tip: tuple[Array, Array] | None
) -> Array | None:
    """By how much each row is missed, the sum being least; None where the tip's demand cannot be met anyway."""
    m, n = slopes.shape
    inside = (at_rest >= low) & (at_rest <= high)
    if inside.all() and (tip is None or not np.any(tip[1])):
        return np.zeros(m)
    demand, wanted = (np.zeros((0, n)), np.zeros(0)) if tip is None else tip
    matrix = np.block([[slopes, np.eye(m), -np.eye(m)], [demand, np.zeros((len(demand), 2 * m))]])
    lower, upper = np.concatenate([low - at_rest, wanted]), np.concatenate([high - at_rest, wanted])
    reach = np.minimum(np.broadcast_to(np.asarray(most, dtype=float), (n,)), FAR)
    sizes = np.concatenate([np.zeros(n), np.ones(2 * m)])
    settings = {"error_on_fail": False, "highs": {"output_flag": False}}
    solver = ca.conic(
        "start", "highs", {"a": ca.DM(matrix).sparsity(), "h": ca.Sparsity(n + 2 * m, n + 2 * m)}, settings
    )
    found = solver(
        a=ca.DM(matrix), g=sizes, lba=lower, uba=upper,
        lbx=np.concatenate([-reach, np.zeros(2 * m)]), ubx=np.concatenate([reach, np.full(2 * m, np.inf)]),
    )  # fmt: skip
    if not solver.stats()["success"]:
        return None
    slack = np.array(found["x"]).ravel()[n:]
    return np.asarray(slack[:m] + slack[m:])
