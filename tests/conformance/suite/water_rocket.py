"""A water rocket: the propelled phase that ends highest, by the amount of water and the elevation.

r' = v cos gamma, h' = v sin gamma, v' = (2 A (p - pa) - D) / m - g sin gamma, gamma' = -g cos gamma / v, V' = -A sqrt(2
(p - pa) / rho), p' = 1.2 p V' / (Vb - V), m = 0.15 kg + rho V, from v = 0.1 m/s and 6.5 bar above the atmosphere until
the water is out. OptimalControlProblems.jl, water_rocket, which has a control that acts on nothing.
"""

from __future__ import annotations

import casadi as ca
import numpy as np

from ocp import Collocation, Problem

from .entry import TOOLBOX, Entry

GRAVITY, WATER, ATMOSPHERE, ADIABATIC, BOTTLE = 9.80665, 1000.0, 1.01325e5, 1.2, 2e-3
NOZZLE, SECTION = np.pi * 0.013**2 / 4, np.pi * 0.106**2 / 4
DRAG, AIR, EMPTY = 0.345, 1.225, 0.15


def build() -> Problem:
    problem = Problem("water rocket")
    start = 6.5e5 + ATMOSPHERE
    r = problem.state("r", initial=0.0, unit="m", guess=lambda t: 5 * t)
    h = problem.state("h", initial=0.0, lower=0.0, unit="m", guess=lambda t: 5 * t)
    v = problem.state("v", initial=0.1, lower=0.01, unit="m/s", guess=lambda t: 0.1 + 100 * t)
    gamma = problem.state("gamma", guess=0.785, unit="rad")
    p = problem.state("p", initial=start, lower=ATMOSPHERE, guess=start, unit="Pa")
    volume = problem.state(
        "V", terminal=0.0, lower=0.0, upper=0.99 * BOTTLE, guess=lambda t: 1e-3 * (1 - t / 0.3), scale=1e-3, unit="m^3"
    )
    problem.horizon(lower=0.001, upper=1.0, guess=0.3)
    outflow = NOZZLE * ca.sqrt(2 * (p - ATMOSPHERE) / WATER)
    mass = EMPTY + WATER * volume
    drag = AIR * v**2 / 2 * DRAG * SECTION
    problem.dynamics(r, v * ca.cos(gamma))
    problem.dynamics(h, v * ca.sin(gamma))
    problem.dynamics(v, (2 * NOZZLE * (p - ATMOSPHERE) - drag) / mass - GRAVITY * ca.sin(gamma))
    problem.dynamics(gamma, -GRAVITY * ca.cos(gamma) / v)
    problem.dynamics(p, -ADIABATIC * p * outflow / (BOTTLE - volume))
    problem.dynamics(volume, -outflow)
    problem.start("elevation", gamma, 0.1, 1.5)
    problem.start("water", volume * 1000, 0.1, 1.9, unit="l")
    problem.minimize(terminal=-h)
    return problem


ENTRY = Entry("water_rocket", (TOOLBOX,), build, method=Collocation(30, 4))
