"""The cannonball of greatest range for a given muzzle energy: its radius is sought, too.

v' = -D / m - g sin gamma, gamma' = -g cos gamma / v, h' = v sin gamma, r' = v cos gamma; iron ball, 1 to 10 cm, drag
coefficient 0.5, exponential atmosphere, energy at most 400 kJ, v at most 500 m/s; range in km. Dymos, example
cannonball, where the atmosphere is a table;
OptimalControlProblems.jl, cannonball, which has a control that acts on nothing.
"""

from __future__ import annotations

import casadi as ca
import numpy as np

from ocp import Collocation, Problem

from .entry import TOOLBOX, Entry

IRON, DRAG, ENERGY, GRAVITY, AIR, SCALE_HEIGHT = 7870.0, 0.5, 400000.0, 9.80665, 1.225, 8440.0


def build() -> Problem:
    problem = Problem("cannonball")
    v = problem.state("v", lower=0.1, upper=500.0, guess=100.0, unit="m/s")
    gamma = problem.state("gamma", guess=lambda t: 0.785 * (1 - t / 5), unit="rad")
    h = problem.state("h", initial=0.0, terminal=0.0, lower=0.0, guess=lambda t: 50 * t * (10 - t), unit="m")
    r = problem.state("r", initial=0.0, lower=0.0, guess=lambda t: 70 * t, unit="m")
    radius = problem.free_parameter("radius", lower=0.01, upper=0.1, guess=0.05, unit="m")
    problem.horizon(lower=0.1, upper=100.0, guess=10.0)
    mass, area = 4 / 3 * np.pi * IRON * radius**3, np.pi * radius**2
    drag = AIR * ca.exp(-h / SCALE_HEIGHT) * v**2 / 2 * area * DRAG
    problem.dynamics(v, -drag / mass - GRAVITY * ca.sin(gamma))
    problem.dynamics(gamma, -GRAVITY * ca.cos(gamma) / v)
    problem.dynamics(h, v * ca.sin(gamma))
    problem.dynamics(r, v * ca.cos(gamma))
    problem.start("elevation", gamma, np.deg2rad(5.0), np.deg2rad(85.0))
    problem.start("muzzle energy", mass * v**2 / 2 / ENERGY, upper=1.0)
    problem.minimize(terminal=-r / 1000)
    return problem


ENTRY = Entry(
    "cannonball", (TOOLBOX,), build, method=Collocation(30, 4),
    second=Collocation(43, 3, "legendre"),
)  # fmt: skip
