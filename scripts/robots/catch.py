"""A free-floating arm captures drifting targets: control in a receding horizon at 20 Hz, simulated by MuJoCo.

The satellite reacts to each motion of the arm. `python scripts/robots/catch.py [--out results]` draws the loop.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))  # run as a file, from anywhere

from models import FreeFloating
from models.checks import Array
from ocp import MultipleShooting, Problem, prepare
from scripts.papers.run import command
from scripts.robots.loops import Loop, draw
from scripts.robots.robots import SPACE_ARM
from scripts.robots.simulation import Simulation

PERIOD = 0.05  # s, of the controller
INTERVALS, INTERVAL = 10, 0.2  # of the horizon; s
RATE, ACCELERATION = 0.5, 0.5  # of each joint, rad/s and rad/s^2
MARGIN = 0.01  # rad and rad/s, for what the inner loop misses
HOME = np.array([0.3, 0.9, 0.2, -1.6, 0.3, 0.9, 0.4])  # rad
NEAR, SLOW = 0.01, 0.01  # m and m/s: position and velocity of the tip relative to a captured target


def build_problem(machine: FreeFloating) -> Problem:
    """Return the problem of one step; it ends with joints at rest, so that the arm can always stop in its limits."""
    n = machine.joint_size
    problem = Problem("capture a drifting target")
    pose, joints, rates = problem.parameter("pose", 7), problem.parameter("joints", n), problem.parameter("rates", n)
    place, velocity = problem.parameter("place", 3), problem.parameter("velocity", 3)
    base = problem.state("base", 7, initial=pose)
    lower, upper = machine.robot.lower + MARGIN, machine.robot.upper - MARGIN
    q = problem.state("q", n, initial=joints, lower=lower, upper=upper)
    v = problem.state("v", n, initial=rates, lower=-RATE + MARGIN, upper=RATE - MARGIN)
    a = problem.control("a", n, lower=-ACCELERATION, upper=ACCELERATION)
    problem.dynamics(base, machine.base_rate(base, q, v))
    problem.dynamics(q, v)
    problem.dynamics(v, a)
    problem.horizon(INTERVALS * INTERVAL)
    miss = machine.tip_pose(base, q).position - (place + velocity * problem.time)
    slip = machine.tip_twist(base, q, v)[3:6] - velocity
    problem.minimize(running=ca.sumsqr(miss) + 0.5 * ca.sumsqr(slip) + 0.002 * ca.sumsqr(v) + 0.002 * ca.sumsqr(a))
    return problem


class Target:
    """A target that drifts with random accelerations; a new one appears near the arm after each capture or 30 s."""

    def __init__(self, seed: int, tip: Array) -> None:
        self._random = np.random.default_rng(seed)
        self.appear(tip)

    def appear(self, tip: Array) -> None:
        """Appear near a position of the tip, m, with a velocity of a few cm/s."""
        self.place = tip + self._random.uniform(-0.3, 0.3, 3)
        self.velocity, self.age = self._random.uniform(-0.02, 0.02, 3), 0.0

    def move(self, period: float) -> None:
        """Move for a period, s."""
        self.velocity = self.velocity + 0.004 * np.sqrt(period) * self._random.normal(size=3)
        self.place, self.age = self.place + period * self.velocity, self.age + period


def run(steps: int, seed: int = 0) -> Loop:
    """Control the simulated machine for a number of steps of 50 ms."""
    machine = FreeFloating(SPACE_ARM.read())
    prepared: Any = prepare(build_problem(machine), MultipleShooting(INTERVALS), compiled=True)
    simulation = Simulation(machine, HOME, step=0.005, bandwidth=8.0)
    base, q, v = ca.SX.sym("base", 7), ca.SX.sym("q", 7), ca.SX.sym("v", 7)
    tip = ca.Function("tip", [base, q, v], [machine.tip_pose(base, q).position, machine.tip_twist(base, q, v)[3:6]])

    def measure_tip() -> tuple[Array, Array]:
        place, velocity = tip(simulation.base, simulation.joints, simulation.rates)
        return np.array(place).ravel(), np.array(velocity).ravel()

    home, loop = measure_tip()[0], Loop(PERIOD)
    target = Target(seed, home)

    def measure() -> dict[str, Array]:
        state = {"pose": simulation.base, "joints": simulation.joints, "rates": simulation.rates}
        return state | {"place": target.place, "velocity": target.velocity}

    controller = prepared.controller(prepared.solve(measure()), iterations=3, qp_iterations=40, shift=0)
    for _ in range(steps):
        step = controller.step(measure())
        simulation.run(step.control["a"], PERIOD)
        target.move(PERIOD)
        place, velocity = measure_tip()
        loop.add(step, simulation, place, target.place)
        captured = np.linalg.norm(place - target.place) < NEAR and np.linalg.norm(velocity - target.velocity) < SLOW
        if captured or target.age > 30.0:
            loop.captures.append(captured)
            target.appear(home)
    loop.violations = simulation.violations
    print(simulation.excess)
    return loop


if __name__ == "__main__":
    options = command(__doc__, ()).parse_args()
    draw(options.out / "gallery" / "catch.png", run(2000), "A free-floating arm captures drifting targets")
