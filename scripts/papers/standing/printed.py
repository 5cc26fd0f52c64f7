"""The null-space law (22) of Yoo et al. 2004 with the sign of C as it is printed: a likely cause of its Figure 4.

The corrected law is local.accelerations' "null_space". With -C the zero moment point is not held where it is asked
to be, and the machine does not fall.
"""

from __future__ import annotations

import casadi as ca
import numpy as np

from models import Standing
from models.machines.standing import StandingMotion, standing_motion
from ocp import TipTask
from ocp.curves import rk4_step
from ocp.motion.local.rates import least_rates
from ocp.motion.tasks.equations import bind

__all__ = ["printed_law"]

STEP = 1e-3  # s


def printed_law(
    machine: Standing, task: TipTask, start_joints: np.ndarray, horizon: float, sign: float = -1.0
) -> tuple[StandingMotion, float]:
    """Simulate q'' = J^+ (u'' - h) + P [J_m P]^+ (sign C - J_m J^+ (u'' - h) - q'^T H_m q') from rest by RK4.

    Args:
        sign: Of C: -1 as printed, +1 corrected.

    Returns:
        The motion, and the greatest distance of the tip from its path, m.
    """
    n, axes = machine.joint_size, list(machine.moving_axes)
    time, q, qd = ca.SX.sym("time"), ca.SX.sym("q", n), ca.SX.sym("qd", n)
    equations, none = bind(machine, task), ca.DM(0, 1)
    jacobian = equations.jacobian(none, q)
    wanted = -equations.acceleration(none, q, qd, ca.DM(n, 1), progress=(time,))
    inverse = least_rates(jacobian, ca.DM.eye(task.size))
    free = ca.DM.eye(n) - ca.mtimes(inverse, jacobian)
    balance = machine.zmp_rows(q, qd, machine.most_stable_point)
    motion_rows, constant = balance.jacobian[axes, :], balance.right[axes]
    needed = balance.needed(qd)[axes] + (sign - 1) * constant
    first = ca.mtimes(inverse, wanted)
    second = least_rates(ca.mtimes(motion_rows, free), needed - ca.mtimes(motion_rows, first))
    gap = ca.norm_2(equations.error(none, q, equations.targets(time)))
    law = ca.Function("printed", [time, q, qd], [first + second, gap], {"cse": True})

    steps = int(np.ceil(horizon / STEP))
    h = horizon / steps
    state, at = ca.MX.sym("state", 2 * n), ca.MX.sym("at")

    def rate(t: ca.MX, x: ca.MX) -> ca.MX:
        return ca.vertcat(x[n:], law(t, x[:n], x[n:])[0])

    after = rk4_step(lambda place, x: rate(at + place * h, x), state, h)
    step = ca.Function("step", [state, at], [after])
    start = np.concatenate([start_joints, np.zeros(n)])
    times = np.linspace(0.0, horizon, steps + 1)
    states = np.vstack([start, np.array(step.mapaccum("steps", steps)(start, times[None, :-1])).T])
    joints, velocities = states[:, :n], states[:, n:]
    accelerations, gaps = law.map(steps + 1)(times[None, :], joints.T, velocities.T)
    motion = standing_motion(
        machine, times, joints, velocities, joint_accelerations=np.array(accelerations).T, rows=task.chosen
    )
    return motion, float(np.max(np.array(gaps)))
