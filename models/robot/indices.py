"""How good a posture of the joints is: the indices that spare freedom is spent on."""

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
    """Sum of ((q - middle) / range)^2 over the joints with two limits, (23) of Yoo et al. 2004. Shape (1, 1).

    Each joint adds 0 at the middle of its range and 1/4 at a limit; a joint without limits adds nothing.
    """
    q = joint_vector(robot, q)
    width = robot.upper - robot.lower
    limited = np.flatnonzero(np.isfinite(width) & (width > 0)).tolist()
    middle = (robot.upper[limited] + robot.lower[limited]) / 2
    return ca.sumsqr((q[limited] - ca.DM(middle)) / ca.DM(width[limited])) if limited else type(q)(1, 1)


def joint_excess(robot: Robot, q: Expression) -> Expression:
    """How far the worst joint is beyond its limits, negative inside; -inf without limits. Shape (1, 1), rad or m."""
    q = joint_vector(robot, q)
    lower, upper = np.flatnonzero(np.isfinite(robot.lower)).tolist(), np.flatnonzero(np.isfinite(robot.upper)).tolist()
    if not lower and not upper:
        return ca.DM(-np.inf)
    return ca.mmax(ca.densify(ca.vertcat(ca.DM(robot.lower[lower]) - q[lower], q[upper] - ca.DM(robot.upper[upper]))))


@on_scalars
def jacobian_manipulability(jacobian: Expression, rows: Sequence[int] = range(TWIST_SIZE)) -> Expression:
    """sqrt(det(G_r G_r')) of the rows r of a tip Jacobian G (Yoshikawa 1985). Shape (1, 1).

    Zero where the task is singular.

    Args:
        jacobian: Shape (6, n).
        rows: Which rows of the twist the task fixes: angular 0..2, linear 3..5.

    Raises:
        ModelError: Rows out of range, repeated, or none.
    """
    return manipulability_of(ca.densify(expression(jacobian))[checked_rows(rows), :])


@on_scalars
def manipulability_of(task: Expression) -> Expression:
    """sqrt(det(G G')) of the Jacobian G of any task, shape (m, n). Shape (1, 1)."""
    square = ca.mtimes(task, task.T)
    if square.shape[0] <= 7:  # a determinant without divisions
        volume = determinant(square)
    else:  # of two arms, say: an expansion would be long
        diagonal, _, _ = ca.ldl(ca.densify(square), False)
        volume = 1
        for entry in ca.vertsplit(ca.vec(diagonal)):
            volume = volume * entry
    return ca.sqrt(ca.fmax(volume, 0))  # rounding can make a zero negative


def checked_rows(rows: Sequence[int]) -> list[int]:
    """`rows` as a list; ModelError unless they are different indices of a twist, 0..5, and at least one."""
    try:
        check_entries(rows)
        given = floats(list(rows))
    except NOT_NUMBERS:
        given = np.array([np.nan])
    whole = given.ndim == 1 and bool((given == np.round(given)).all())
    chosen = given.astype(int).tolist() if whole else []
    if not whole:
        message = f"rows must be a list of the twist rows 0..5, not {rows!r}"
    elif not chosen:
        message = "rows is empty; a task fixes at least one of the twist rows 0..5"
    elif len(set(chosen)) < len(chosen):
        message = f"rows {chosen} name a twist row more than once"
    elif not all(0 <= row < TWIST_SIZE for row in chosen):
        message = f"rows {chosen} are not all among the twist rows 0..5 (angular 0..2, linear 3..5)"
    else:
        return chosen
    raise ModelError(message, name="rows", value=rows, limit=(0, TWIST_SIZE - 1))
