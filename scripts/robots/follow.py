"""A Panda follows a target that moves unpredictably: control in a receding horizon at 100 Hz, simulated by MuJoCo.

The controller knows only where the target is now. `python scripts/robots/follow.py [--out results]` draws the loop.
"""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))  # run as a file, from anywhere

from models import FixedBase, tip_pose
from models.checks import Array
from ocp import MultipleShooting, Problem, prepare
from scripts.papers.run import command
from scripts.robots.loops import Loop, draw
from scripts.robots.robots import PANDA
from scripts.robots.simulation import Simulation
from scripts.robots.targets import JumpingTarget

PERIOD = 0.01  # s, of the controller
INTERVALS, INTERVAL = 8, 0.05  # of the horizon; s
MARGINS = 0.01, 0.02  # of positions, rad, and of velocities, rad/s: for what the inner loop misses
SPEED = 0.4  # joint velocity limits over those of the robot
ACCELERATION = 10.0  # rad/s^2
HOME = np.array([0.0, -0.4, 0.0, -2.0, 0.0, 1.6, 0.8])  # rad


def build_problem(machine: FixedBase) -> Problem:
    """Return the problem of one step; it ends at rest, so that the robot can always stop within its limits."""
    robot, n = machine.robot, machine.robot.dof
    problem = Problem("follow a target")
    joints, rates, target = (
        problem.parameter("joints", n),
        problem.parameter("rates", n),
        problem.parameter("target", 3),
    )
    lower, upper, fastest = robot.lower + MARGINS[0], robot.upper - MARGINS[0], robot.velocity - MARGINS[1]
    q = problem.state("q", n, initial=joints, lower=lower, upper=upper)
    v = problem.state("v", n, initial=rates, terminal=0.0, lower=-fastest, upper=fastest)
    a = problem.control("a", n, lower=-ACCELERATION, upper=ACCELERATION)
    problem.dynamics(q, v)
    problem.dynamics(v, a)
    problem.horizon(INTERVALS * INTERVAL)
    miss = ca.sumsqr(tip_pose(robot, q).position - target)
    problem.minimize(running=500 * miss + 0.02 * ca.sumsqr(v) + 1e-3 * ca.sumsqr(a), terminal=100 * miss)
    return problem


def run(steps: int, seed: int = 0) -> Loop:
    """Control the simulated robot for a number of steps of 10 ms."""
    robot = PANDA.read()
    joints = tuple(replace(joint, velocity=SPEED * joint.velocity) if joint.moves else joint for joint in robot.joints)
    machine = FixedBase(replace(robot, joints=joints))
    prepared: Any = prepare(build_problem(machine), MultipleShooting(INTERVALS), compiled=True)
    simulation, target, loop = Simulation(machine, HOME), JumpingTarget(seed), Loop(machine, PERIOD)
    place = ca.Function("place", [q := ca.SX.sym("q", 7)], [tip_pose(machine.robot, q).position])

    def measure() -> dict[str, Array]:
        return {"joints": simulation.joints, "rates": simulation.rates, "target": target.place}

    controller = prepared.controller(prepared.solve(measure()), iterations=3, qp_iterations=40, shift=0)
    for _ in range(steps):
        step = controller.step(measure())
        simulation.run(step.control["a"], PERIOD)
        target.move(PERIOD)
        loop.add(step, simulation, np.array(place(simulation.joints)).ravel(), target.place)
    return loop


if __name__ == "__main__":
    options = command(__doc__, ()).parse_args()
    title = "A Panda follows a target that moves unpredictably, and keeps its limits"
    note = (
        "Control in a receding horizon of 0.4 s at 100 Hz; the robot is simulated by MuJoCo. The target drifts with "
        "random accelerations and jumps by up to 0.15 m in each direction. The controller knows only where it is now."
    )
    draw(options.out / "gallery" / "follow.png", run(1000), title, note)
