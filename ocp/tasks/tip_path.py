"""Where the tip is asked to be: a path of positions over time or over a path parameter, checked once."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, TypeAlias

import casadi as ca
import numpy as np

from models import Machine
from ocp.errors import ProblemError
from ocp.tasks.start import Array, velocity_expression

__all__ = ["Path", "check_path", "check_rest", "linear_rows", "path_derivatives", "path_samples"]

Path: TypeAlias = Callable[[Any], Any]
"""Position of the tip in the task's rows (m, world), as a function of a casadi time (s) or path parameter 0..1."""

SAMPLES = 201
START_TOLERANCE = 1e-6  # m
REST_TOLERANCE = 1e-6  # m/s


def linear_rows(rows: Sequence[int]) -> list[int]:
    """Coordinates x, y, z (0..2) of the position that twist rows 3..5 fix.

    Raises:
        ProblemError: An angular row: a path gives positions.
    """
    angular = [row for row in rows if row not in (3, 4, 5)]
    if angular:
        raise ProblemError(f"rows {list(rows)}: a tip path gives positions, rows 3, 4, 5; leave out {angular}")
    return [row - 3 for row in rows]


def path_derivatives(tip_path: Path, symbol: Any, size: int) -> tuple[Any, Any, Any]:
    """The path and its first and second derivative in its symbol. Shape (size, 1) each.

    Raises:
        ProblemError: Wrong size, not finite, or an expression of anything but the symbol.
    """
    try:
        position = velocity_expression(tip_path, symbol, size)
    except ProblemError as error:
        raise ProblemError(str(error).replace("tip_velocity", "tip_path")) from error
    position = type(symbol)(position)
    velocity = ca.jacobian(position, symbol)
    return ca.densify(position), ca.densify(velocity), ca.densify(ca.jacobian(velocity, symbol))


def path_samples(tip_path: Path, size: int, end: float) -> tuple[Array, Array]:
    """Times (or parameters) from 0 to `end`, (SAMPLES,), and the positions there, (SAMPLES, size).

    Raises:
        ProblemError: As path_derivatives, or a position that is not finite.
    """
    function = _path_function(tip_path, size)
    at = np.linspace(0.0, end, SAMPLES)
    values = np.array(function.map(SAMPLES)(at[None, :])[0]).T
    wrong = ~np.isfinite(values).all(axis=1)
    if wrong.any():
        raise ProblemError(f"tip_path is not finite at {at[wrong][0]:g}: {values[wrong][0].tolist()}")
    return at, values


def check_path(machine: Machine, tip_path: Path, rows: Sequence[int], start_joints: Any, base: Any, end: float) -> None:
    """Raise ProblemError where the path does not begin at the tip, or leaves the reach of the arm.

    Args:
        tip_path: Over 0..end.
        start_joints, base: Where the machine starts.
    """
    axes = linear_rows(rows)
    at, wanted = path_samples(tip_path, len(axes), end)
    tip = np.array(ca.DM(machine.tip_pose(base, start_joints).position)).ravel()[axes]
    gap = float(np.linalg.norm(wanted[0] - tip))
    if gap > START_TOLERANCE:
        raise ProblemError(
            f"tip_path starts at {wanted[0].tolist()} m, {gap:.3g} m from the tip, which is at {tip.tolist()} m "
            "at the start joints; let the path begin there or start elsewhere"
        )
    if machine.base_size == 0:
        shoulder, reach = _reach(machine)
        far = np.linalg.norm(wanted - shoulder[axes], axis=1)
        worst = int(far.argmax())
        if far[worst] > reach:
            raise ProblemError(
                f"tip_path leads {far[worst]:.4g} m away from the first joint at {at[worst]:.4g}, "
                f"to {wanted[worst].tolist()} m, but the arm is at most {reach:.4g} m long"
            )


def check_rest(tip_path: Path, size: int, *times: float | None) -> None:
    """Raise ProblemError where the tip is asked to move at a time at which the joints are to rest; None: no time."""
    function = _path_function(tip_path, size)
    for time in times:
        if time is not None:
            velocity = np.array(function(time)[1]).ravel()
            if np.linalg.norm(velocity) > REST_TOLERANCE:
                raise ProblemError(
                    f"tip_path moves at {velocity.tolist()} m/s at {time:g} s, where the joints are to be at rest; "
                    "let the path come to rest there, or say 'free' for that end"
                )


def _path_function(tip_path: Path, size: int) -> Any:
    """time -> (position, velocity), of MX symbols where the path needs them."""
    for symbols in (ca.SX, ca.MX):
        symbol = symbols.sym("time")
        try:
            return ca.Function("path", [symbol], list(path_derivatives(tip_path, symbol, size)[:2]))
        except (RuntimeError, NotImplementedError):  # interpolants and external functions take MX only
            if symbols is ca.MX:
                raise
    raise AssertionError


def _reach(machine: Machine) -> tuple[Array, float]:
    """Where the first moving joint stands in the world, (3,), and how far from there the tip can be at most."""
    robot = machine.robot
    chain = robot.path_to(str(robot.tip))
    first = next((i for i, joint in enumerate(chain) if joint.moves), len(chain) - 1)
    frame = machine.world_from_base(np.zeros(0))
    turn, shoulder = np.array(ca.DM(frame.rotation)), np.array(ca.DM(frame.position)).ravel()
    for joint in chain[: first + 1]:
        shoulder, turn = shoulder + turn @ joint.translation, turn @ joint.rotation
    reach = float(np.linalg.norm(robot.tip_translation))
    reach += sum(float(np.linalg.norm(joint.translation)) for joint in chain[first + 1 :])
    reach += sum(max(abs(joint.lower), abs(joint.upper)) for joint in chain if joint.kind == "prismatic")
    return shoulder, reach
