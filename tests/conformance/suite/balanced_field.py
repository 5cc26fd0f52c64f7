"""Take-off of an airliner after an engine failure: the shortest distance to 35 ft.

r' = v cos gamma, v' = (T cos a - D) / m - g sin gamma, h' = v sin gamma, gamma' = (T sin a + L) / (m v) - g cos gamma /
v, with a lift coefficient linear in the angle of attack a and an induced drag reduced by the ground effect; 0 <= a <=
15 deg, v >= 1, h >= 0, from (600 m, 70 m/s, 0, 0) to h = 10.668 m, gamma = 5 deg (0.0873 rad). Dymos, example balanced
field; OptimalControlProblems.jl, balanced_field, the climb alone.
"""

from __future__ import annotations

import casadi as ca
import numpy as np

from ocp import Collocation, Problem

from .entry import TOOLBOX, Entry

MASS, GRAVITY, DENSITY, SURFACE, THRUST = 79015.8, 9.80665, 1.225, 124.7, 120102.0
DRAG, ASPECT, OSWALD, WING_HEIGHT, HALF_SPAN = 0.03, 9.45, 0.801, 1.0, 35.7 / 2
LIFT, MAX_LIFT, STALL = 0.5, 2.0, 0.1745


def build() -> Problem:
    problem = Problem("balanced field")
    r = problem.state("r", initial=600.0, unit="m", guess=lambda t: 600 + 75 * t)
    v = problem.state("v", initial=70.0, lower=1.0, guess=80.0, unit="m/s")
    h = problem.state("h", initial=0.0, terminal=10.668, lower=0.0, unit="m")
    gamma = problem.state("gamma", initial=0.0, terminal=0.0873, unit="rad")
    alpha = problem.control("alpha", lower=0.0, upper=0.2618, guess=0.1, unit="rad")
    problem.horizon(lower=0.1, upper=100.0, guess=10.0)
    pressure = DENSITY * v**2 / 2 * SURFACE
    coefficient = LIFT + alpha / STALL * (MAX_LIFT - LIFT)
    ground = 33 * ((h + WING_HEIGHT) / HALF_SPAN) ** 1.5
    induced = ground / (1 + ground) / (np.pi * ASPECT * OSWALD)
    lift, drag = pressure * coefficient, pressure * (DRAG + induced * coefficient**2)
    problem.dynamics(r, v * ca.cos(gamma))
    problem.dynamics(v, (THRUST * ca.cos(alpha) - drag) / MASS - GRAVITY * ca.sin(gamma))
    problem.dynamics(h, v * ca.sin(gamma))
    problem.dynamics(gamma, (THRUST * ca.sin(alpha) + lift) / (MASS * v) - GRAVITY * ca.cos(gamma) / v)
    problem.minimize(terminal=r)
    return problem


ENTRY = Entry("balanced_field", (TOOLBOX,), build, method=Collocation(40, 4), second=Collocation(57, 3, "legendre"))
