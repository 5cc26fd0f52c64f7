"""Performance indices of a configuration: manipulability and distance from the joint limits."""

from __future__ import annotations

from collections.abc import Sequence

import casadi as ca
import numpy as np

from models.arrays import NOT_NUMBERS, check_entries, floats
from models.errors import ModelError
from models.robot.kinematics import joint_vector
from models.robot.robot import Robot
from models.spatial import Expression, determinant, expression, on_scalars

TWIST_SIZE = 6


def joint_limit_index(robot: Robot, q: Expression) -> Expression:
    """Return the sum of ((q - middle) / range)^2 over the joints with two limits, (23) of Yoo et al. 2004.

    Each joint adds 0 at the middle of its range and 1/4 at a limit; a joint without limits adds nothing. Shape (1, 1).
    """
    q = joint_vector(robot, q)
    width = robot.upper - robot.lower
    limited = np.flatnonzero(np.isfinite(width) & (width > 0)).tolist()
    middle = (robot.upper[limited] + robot.lower[limited]) / 2
    return ca.sumsqr((q[limited] - ca.DM(middle)) / ca.DM(width[limited])) if limited else type(q)(1, 1)


def joint_excess(robot: Robot, q: Expression) -> Expression:
    """Return the largest violation of a position limit, negative inside, -inf without limits. Shape (1, 1)."""
    q = joint_vector(robot, q)
    lower, upper = np.flatnonzero(np.isfinite(robot.lower)).tolist(), np.flatnonzero(np.isfinite(robot.upper)).tolist()
    if not lower and not upper:
        return ca.DM(-np.inf)
    return ca.mmax(ca.densify(ca.vertcat(ca.DM(robot.lower[lower]) - q[lower], q[upper] - ca.DM(robot.upper[upper]))))


@on_scalars
def jacobian_manipulability(jacobian: Expression, rows: Sequence[int] = range(TWIST_SIZE)) -> Expression:
    """Return sqrt(det(G_r G_r')) of the rows r of a tip Jacobian G (Yoshikawa 1985), zero where the task is singular.

    Args:
        jacobian: Shape (6, n).
        rows: Rows of the twist that the task fixes: angular 0..2, linear 3..5.

    Returns:
        Shape (1, 1).

    Raises:
        ModelError: Rows out of range, repeated, or none.
    """
    return manipulability_of(ca.densify(expression(jacobian))[checked_rows(rows), :])


@on_scalars
def manipulability_of(task: Expression) -> Expression:
    """Return sqrt(det(G G')) of a task Jacobian G of shape (m, n). Shape (1, 1)."""
    square = ca.mtimes(task, task.T)
    if square.shape[0] <= 7:  # division-free
        volume = determinant(square)
    else:  # several arms: the expansion would be long
        diagonal, _, _ = ca.ldl(ca.densify(square), False)
        volume = 1
        for entry in ca.vertsplit(ca.vec(diagonal)):
            volume = volume * entry
    return ca.sqrt(ca.fmax(volume, 0))  # rounding can make a zero negative


def checked_rows(rows: Sequence[int]) -> list[int]:
    """Return `rows` as a list; raise ModelError unless they are distinct indices 0..5 of a twist, and not empty."""
    try:
        check_entries(rows)
        numbers = floats(list(rows))
    except NOT_NUMBERS:
        numbers = np.array([np.nan])
    integral = numbers.ndim == 1 and bool((numbers == np.round(numbers)).all())
    indices = numbers.astype(int).tolist() if integral else []
    if not integral:
        message = f"rows must be a list of the twist rows 0..5, not {rows!r}"
    elif not indices:
        message = "rows is empty; a task fixes at least one of the twist rows 0..5"
    elif len(set(indices)) < len(indices):
        message = f"rows {indices} name a twist row more than once"
    elif not all(0 <= row < TWIST_SIZE for row in indices):
        message = f"rows {indices} are not all among the twist rows 0..5 (angular 0..2, linear 3..5)"
    else:
        return indices
    raise ModelError(message, name="rows", value=rows, limit=(0, TWIST_SIZE - 1))
