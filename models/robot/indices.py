"""How good a posture of the joints is: the indices that spare freedom is spent on."""

from __future__ import annotations

import casadi as ca
import numpy as np

from models.robot.kinematics import joint_vector
from models.robot.robot import Robot
from models.spatial import Expression


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
