"""A Panda follows a target that moves unpredictably: control in a receding horizon at 100 Hz, simulated by MuJoCo.

The controller knows only where the target is now. `python scripts/robots/follow.py [--out results]` draws the loop.
"""

from __future__ import annotations

import sys
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

PERIOD = 0.01  # s, of the controller
INTERVALS, INTERVAL = 8, 0.05  # of the horizon; s
MARGINS = 0.01, 0.02  # of positions, rad, and of velocities, rad/s: for what the inner loop misses
ACCELERATION = 10.0  # rad/s^2
HOME = np.array([0.0, -0.4, 0.0, -2.0, 0.0, 1.6, 0.8])  # rad


def build_problem(machine: FixedBase) -> Problem:
    """Return the problem of one step; it ends at rest, so that the robot can always stop within its limits."""
    robot, n = machine.robot, machine.robot.dof
    problem = Problem("follow a target")
    joints, rates, target = problem.parameter("joints", n), problem.parameter("rates", n), problem.parameter("target", 3)
    lower, upper, fastest = robot.lower + MARGINS[0], robot.upper - MARGINS[0], robot.velocity - MARGINS[1]
    q = problem.state("q", n, initial=joints, lower=lower, upper=upper)
    v = problem.state("v", n, initial=rates, terminal=0.0, lower=-fastest, upper=fastest)
    a = problem.control("a", n, lower=-ACCELERATION, upper=ACCELERATION)
    problem.dynamics(q, v)
    problem.dynamics(v, a)
    problem.horizon(INTERVALS * INTERVAL)
    miss = ca.sumsqr(tip_pose(robot, q).position - target)
    problem.minimize(running=50 * miss + 0.02 * ca.sumsqr(v) + 1e-3 * ca.sumsqr(a), terminal=10 * miss)
    return problem


class Target:
    """A point that drifts with random accelerations in a box, and jumps about every two seconds, by a seed."""

    LOWER, UPPER = np.array([0.3, -0.4, 0.2]), np.array([0.65, 0.4, 0.7])  # m

    def __init__(self, seed: int) -> None:
        self._random = np.random.default_rng(seed)
        self.place, self._velocity = np.array([0.45, 0.0, 0.5]), np.zeros(3)

    def move(self, period: float) -> None:
        """Move for a period, s."""
        self._velocity += period * (0.4 * self._random.normal(size=3) / np.sqrt(period) - self._velocity)
        self.place = self.place + period * self._velocity
        outside = (self.place < self.LOWER) | (self.place > self.UPPER)
        self._velocity[outside] *= -1
        if self._random.uniform() < 0.5 * period:
            self.place = self.place + self._random.uniform(-0.15, 0.15, 3)
        self.place = np.clip(self.place, self.LOWER, self.UPPER)


def run(steps: int, seed: int = 0) -> Loop:
    """Control the simulated robot for a number of steps of 10 ms."""
    machine = FixedBase(PANDA.read())
    prepared: Any = prepare(build_problem(machine), MultipleShooting(INTERVALS), compiled=True)
    simulation, target, loop = Simulation(machine, HOME), Target(seed), Loop(PERIOD)
    place = ca.Function("place", [q := ca.SX.sym("q", 7)], [tip_pose(machine.robot, q).position])

    def measure() -> dict[str, Array]:
        return {"joints": simulation.joints, "rates": simulation.rates, "target": target.place}

    controller = prepared.controller(prepared.solve(measure()), iterations=3, qp_iterations=40, shift=0)
    for _ in range(steps):
        step = controller.step(measure())
        simulation.run(step.control["a"], PERIOD)
        target.move(PERIOD)
        loop.add(step, simulation, np.array(place(simulation.joints)).ravel(), target.place)
    print(simulation.excess); loop.violations = simulation.violations
    return loop


if __name__ == "__main__":
    options = command(__doc__, ()).parse_args()
    draw(options.out / "gallery" / "follow.png", run(1500), "A Panda follows a target that moves unpredictably")
