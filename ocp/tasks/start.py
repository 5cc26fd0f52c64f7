"""What the tip is asked to do and where the machine starts: checked once, for builders and local resolution alike."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, TypeAlias

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from models import Machine, ModelError
from models.robot.indices import checked_rows
from ocp.errors import ProblemError

__all__ = [
    "Array",
    "Start",
    "Velocity",
    "checked_configuration",
    "checked_horizon",
    "checked_start",
    "checked_weights",
    "is_singular",
    "track_expression",
    "velocity_expression",
]

Array: TypeAlias = NDArray[np.float64]
Velocity: TypeAlias = Any  # a constant of one entry for each row, or a function: casadi time -> casadi vector


@dataclass(frozen=True)
class Start:
    """A task and where it starts, checked and in plain arrays.

    Attributes:
        rows: Twist rows that the task fixes.
        joints: Shape (joint_size,).
        base: Shape (base_size,).
        horizon: s.
    """

    rows: list[int]
    joints: Array
    base: Array
    horizon: float


def velocity_expression(tip_velocity: Velocity, time: Any, size: int) -> Any:
    """The tip velocity as a column of expressions of the symbol `time`. Shape (size, 1).

    Raises:
        ProblemError: Wrong size, not finite, or an expression of anything but the time.
    """
    return track_expression(tip_velocity, time, (size, 1), "tip_velocity")


def track_expression(
    track: Any, time: Any, shapes: tuple[int, int] | tuple[tuple[int, int], ...], what: str = "track"
) -> Any:
    """A constant or a function of time as a dense matrix of expressions of the symbol `time`.

    Args:
        track: A constant, or a function: casadi time -> casadi matrix, array, or a list of expressions.
        time: The symbol.
        shapes: The shape it has, or several that it may have.
        what: Its name in errors.

    Raises:
        ProblemError: Another shape, not finite, or an expression of anything but the time.
    """
    allowed = (shapes,) if isinstance(shapes[0], int) else shapes
    value = track(time) if callable(track) else track
    if isinstance(value, np.ndarray) and value.dtype == object:
        value = list(value.ravel())
    if isinstance(value, list | tuple) and any(isinstance(part, ca.SX | ca.MX) for part in value):
        value = ca.vertcat(*value)
    wanted = " or ".join(map(str, allowed))
    if not isinstance(value, ca.SX | ca.MX | ca.DM):
        try:
            value = ca.DM(np.asarray(value, dtype=float))
        except (TypeError, ValueError, NotImplementedError) as error:
            raise ProblemError(f"{what} gives {value!r}, not numbers or expressions of shape {wanted}") from error
    if value.shape not in allowed:
        hint = ": one entry for each row of the task" if what == "tip_velocity" else ""
        raise ProblemError(f"{what} has shape {tuple(value.shape)}, expected {wanted}{hint}")
    if isinstance(value, ca.DM):
        if not np.isfinite(np.array(value)).all():
            raise ProblemError(f"{what} {np.array(value).ravel().tolist()} is not finite")
    elif strange := [str(symbol) for symbol in ca.symvar(value) if not ca.is_equal(symbol, time, 1)]:
        raise ProblemError(f"{what} depends on {strange}, but only the time it is called with may occur")
    return ca.densify(value)


def checked_start(machine: Machine, rows: Sequence[int], start_joints: Any, horizon: float, start_base: Any) -> Start:
    """The task's rows, the start and the horizon, checked against the machine.

    Raises:
        ProblemError: Rows out of range, repeated, none, more than joints, or moved by no joint; wrong sizes;
            a quaternion that is not of unit length; a horizon that is not positive.
    """
    try:
        chosen = checked_rows(rows)
    except ModelError as error:
        raise ProblemError(str(error)) from error
    if len(chosen) > machine.joint_size:
        raise ProblemError(
            f"the task fixes {len(chosen)} rows {chosen} but the machine has only {machine.joint_size} joints"
        )
    joints, base = checked_configuration(machine, start_joints, start_base)
    unmoved = _unmoved_rows(machine, chosen)
    if unmoved:
        raise ProblemError(f"rows {chosen}: no joint moves the tip in rows {unmoved}; leave them out of the task")
    return Start(chosen, joints, base, checked_horizon(horizon))


def checked_horizon(horizon: Any) -> float:
    """The horizon; ProblemError unless it is a positive, finite number."""
    try:
        duration = float(horizon)
    except (TypeError, ValueError):
        duration = np.nan
    if not 0 < duration < np.inf:
        raise ProblemError(f"horizon must be a positive number of seconds, not {horizon!r}")
    return duration


def checked_configuration(machine: Machine, joints: Any, base: Any) -> tuple[Array, Array]:
    """Joints (joint_size,) and base (base_size,) at the start; the machine's base_home() if None.

    Raises:
        ProblemError: Wrong sizes, not finite; a quaternion that is not of unit length.
    """
    if joints is None:
        raise ProblemError("start_joints are missing; inverse_kinematics(machine, task) finds some for a pose")
    angles = _numbers(joints, machine.joint_size, "start_joints", "one entry for each joint")
    home = machine.base_home() if base is None else base
    place = _numbers(home, machine.base_size, "start_base", "the machine's base configuration")
    if machine.base_size == 7 and abs(np.linalg.norm(place[3:]) - 1) > 1e-9:
        raise ProblemError(f"start_base has the quaternion {place[3:].tolist()}, which is not of unit length")
    return angles, place


def checked_weights(weights: Any, size: int) -> Array:
    """Weights of the squared joint rates, ones if None; ProblemError unless they are positive. Shape (size,)."""
    if weights is None:
        return np.ones(size)
    given = _numbers(weights, size, "weights", "one for each joint")
    if not (given > 0).all():
        raise ProblemError(f"weights {given.tolist()} must be positive")
    return given


def is_singular(machine: Machine, start: Start) -> bool:
    """Whether the rows of the task's Jacobian are linearly dependent at the start, to rounding."""
    jacobian = np.array(ca.DM(machine.tip_jacobian(start.base, start.joints)))[start.rows]
    values = np.linalg.svd(jacobian, compute_uv=False)
    return bool(values[-1] <= 1e-12 * values[0])


def _unmoved_rows(machine: Machine, rows: list[int]) -> list[int]:
    base, joints = ca.SX.sym("base", machine.base_size), ca.SX.sym("joints", machine.joint_size)
    jacobian = machine.tip_jacobian(base, joints)
    return [row for row in rows if all(entry.is_zero() for entry in ca.horzsplit(jacobian[row, :]))]


def _numbers(value: Any, size: int, what: str, meaning: str) -> Array:
    try:
        array = np.asarray(value, dtype=float).ravel()
    except (TypeError, ValueError) as error:
        raise ProblemError(f"{what} {value!r} is not numeric") from error
    if array.shape != (size,):
        raise ProblemError(f"{what} has {array.size} entries, expected {size}: {meaning}")
    if not np.isfinite(array).all():
        raise ProblemError(f"{what} {array.tolist()} is not finite")
    return array
