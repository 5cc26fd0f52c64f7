"""Problem (27) of Kim, Kim 2011 in its two forms: joint rates as the control, or u of the null space.

Both begin from the damped pseudo-inverse motion.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import casadi as ca
import numpy as np

from models import Machine, paper_example
from ocp import Problem, RateOptions, TipTask, minimum_velocity_problem, resolve
from ocp.direct.guess import Samples
from ocp.motion.local.rates import LocalSolution, least_rates
from ocp.motion.tasks.equations import bind

__all__ = ["HORIZON", "ROWS", "START_JOINTS", "TASK", "TIP_VELOCITY", "null_space_problem", "problem"]

ROWS = (3, 4)  # the task: linear velocity of the tip in the plane, its orientation free
TIP_VELOCITY = np.array([-1.0, -1.0])  # m/s, printed
TASK = TipTask(rows=ROWS, velocity=TIP_VELOCITY)
START_JOINTS = np.radians([45.0, 60.0, -60.0])  # printed
HORIZON = 5.0  # s, chosen
DAMPING = 0.005  # of the guess, relative to the root mean square of the singular values at the start


def problem(horizon: float = HORIZON, *, machine: Machine | None = None, guess_damping: float = DAMPING) -> Problem:
    """The paper's example with joint rates as the control.

    Args:
        horizon: s. machine: The paper's if None.
        guess_damping: 0.001 to 0.02 lead to J = 1.7351, 0.03 to J = 1.7467.
    """
    machine = machine or paper_example()
    result = minimum_velocity_problem(machine, TASK, horizon, start=START_JOINTS)
    local = damped_motion(machine, horizon, guess_damping)
    _begin_from(result, local, {"rates": local.joint_rates})
    return result


def null_space_problem(horizon: float = HORIZON, *, machine: Machine | None = None) -> Problem:
    """The paper's example with u of x2' = (1 - G# G) u + G# v, equation (26), as the control "null".

    It does the task by itself, and is fragile: G# is unbounded where the Jacobian loses rank. The part G# G u of the
    control has no effect on the motion; 1/2 |G# G u|^2 is added to the cost, so that the running cost is 1/2 |u|^2 +
    1/2 |G# v|^2. It vanishes at the optimum and makes the optimal u unique: u lies in the null space and x2' = u + G# v
    there. Without it shooting with linear controls takes hundreds of iterations instead of ten.
    """
    machine = machine or paper_example()
    equations, robot = bind(machine, TASK), machine.robot
    result = Problem("minimum velocity, null space")
    base: Any = np.zeros(0)
    if machine.base_size:
        base = result.state("base", initial=machine.base_home(), unit="m, rad")
    joints = result.state("joints", initial=START_JOINTS, lower=robot.lower, upper=robot.upper, unit=robot.unit())
    null = result.control("null", machine.joint_size, guess=0.0, unit=robot.unit("/s"))
    result.horizon(horizon)
    jacobian, wanted = equations.jacobian(base, joints), equations.right(base, joints, equations.targets(result.time))
    both = least_rates(jacobian, ca.horzcat(wanted, ca.mtimes(jacobian, null)))
    idle = both[:, 1]  # G# G u, without effect
    rates = null + both[:, 0] - idle
    base_rate, rates, idle = ca.cse([machine.base_rate(base, joints, rates), rates, idle])
    if machine.base_size:
        result.dynamics(base, base_rate)
    result.dynamics(joints, rates)
    result.minimize(running=ca.sumsqr(idle) / 2 + ca.sumsqr(rates) / 2)
    _begin_from(result, damped_motion(machine, horizon, DAMPING), {})
    return result


def damped_motion(machine: Machine, horizon: float, damping: float) -> LocalSolution:
    """The damped pseudo-inverse motion, its damping relative to the singular values at the start."""
    jacobian = np.array(ca.DM(bind(machine, TASK).jacobian(machine.base_home(), START_JOINTS)))
    size = float(np.linalg.norm(jacobian)) / np.sqrt(len(ROWS))
    return resolve(
        machine, TASK, horizon, start=START_JOINTS, options=RateOptions(damping=damping * size, tolerance=1e-8)
    )


def _begin_from(problem: Problem, local: LocalSolution, controls: dict[str, Any]) -> None:
    declared = problem.declared
    for name in declared.states:
        declared.states[name] = replace(declared.states[name], guess=Samples(local.t, getattr(local, name)))
    for name, values in controls.items():
        declared.controls[name] = replace(declared.controls[name], guess=Samples(local.t, values))
