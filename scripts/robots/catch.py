"""A free-floating arm captures drifting targets: control in a receding horizon at 20 Hz, simulated by MuJoCo.

The satellite reacts to each motion of the arm. `python scripts/robots/catch.py [--out results]` draws the loop.
"""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))  # run as a file, from anywhere

from models import FreeFloating
from models.checks import Array
from ocp import Collocation, Problem, prepare
from scripts.papers.run import command
from scripts.robots.loops import Loop, draw
from scripts.robots.robots import SPACE_ARM
from scripts.robots.simulation import Simulation
from scripts.robots.targets import DriftingTarget

PERIOD = 0.05  # s, of the controller
INTERVALS, INTERVAL = 8, 0.25  # of the horizon; s
LIMITS: dict[str, Any] = {"lower": -3.0, "upper": 3.0, "velocity": 0.15, "effort": 120.0}  # assumed: rad, rad/s, N m
ACCELERATION = 0.2  # of each joint, rad/s^2
MARGIN = 0.01  # rad and rad/s, for what the inner loop misses
HOME = np.array([0.3, 0.9, 0.2, -1.6, 0.3, 0.9, 0.4])  # rad
NEAR = 0.01  # m and m/s: largest distance and relative velocity at a capture


def build_problem(machine: FreeFloating) -> Problem:
    """Return the problem of one step; it ends with joints at rest, so that the arm can always stop in its limits."""
    n = machine.joint_size
    problem = Problem("capture a drifting target")
    pose, joints, rates = problem.parameter("pose", 7), problem.parameter("joints", n), problem.parameter("rates", n)
    place, velocity = problem.parameter("place", 3), problem.parameter("velocity", 3)
    base = problem.state("base", 7, initial=pose)
    robot = machine.robot
    lower, upper, fastest = robot.lower + MARGIN, robot.upper - MARGIN, robot.velocity - MARGIN
    q = problem.state("q", n, initial=joints, lower=lower, upper=upper)
    v = problem.state("v", n, initial=rates, terminal=0.0, lower=-fastest, upper=fastest)
    a = problem.control("a", n, lower=-ACCELERATION, upper=ACCELERATION)
    problem.dynamics(base, machine.base_rate(base, q, v))
    problem.dynamics(q, v)
    problem.dynamics(v, a)
    problem.horizon(INTERVALS * INTERVAL)
    miss = machine.tip_pose(base, q).position - (place + velocity * problem.time)
    slip = machine.tip_twist(base, q, v)[3:6] - velocity
    problem.minimize(running=ca.sumsqr(miss) + 0.5 * ca.sumsqr(slip) + 0.002 * ca.sumsqr(v) + 0.002 * ca.sumsqr(a))
    return problem


def run(steps: int, seed: int = 0) -> Loop:
    """Control the simulated machine for a number of steps of 50 ms."""
    robot = SPACE_ARM.read()
    joints = tuple(replace(joint, **LIMITS) if joint.moves else joint for joint in robot.joints)
    machine = FreeFloating(replace(robot, joints=joints))
    prepared: Any = prepare(build_problem(machine), Collocation(INTERVALS, 2, control="held"), compiled=True)
    simulation = Simulation(machine, HOME, step=0.005, bandwidth=8.0)
    base, q, v = (ca.SX.sym(name, 7) for name in "bqv")
    tip = ca.Function("tip", [base, q, v], [machine.tip_pose(base, q).position, machine.tip_twist(base, q, v)[3:6]])

    def measure_tip() -> tuple[Array, Array]:
        place, velocity = tip(simulation.base, simulation.joints, simulation.rates)
        return np.array(place).ravel(), np.array(velocity).ravel()

    home, loop = measure_tip()[0], Loop(machine, PERIOD)
    target = DriftingTarget(seed, home)

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
        captured = max(map(np.linalg.norm, (place - target.place, velocity - target.velocity))) < NEAR
        if captured or target.age > 30.0:
            loop.captures.append(bool(captured))
            target.appear(home)
    return loop


if __name__ == "__main__":
    options = command(__doc__, ()).parse_args()
    note = (
        "Control in a receding horizon of 2 s at 20 Hz, simulated by MuJoCo. A target counts as captured within 10 mm "
        "and 10 mm/s; then the next one appears. The limits of the joints are assumed."
    )
    draw(options.out / "gallery" / "catch.png", run(1000), "A free-floating arm captures drifting targets", note)
