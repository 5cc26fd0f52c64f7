"""A rocket of one stage to an orbit of 185 km in least time.

x'' = (F cos theta - D x' / v) / m, y'' = (F sin theta - D y' / v) / m - g, m' = -F / (g Isp), D = rho v^2 Cd S / 2 with
rho = 1.225 exp(-y / 8440) kg/m^3, flat Earth; from rest at the origin to y = 185 km, (7796.6961, 0) m/s. Longuski,
Guzman & Prussing, 2014; Dymos, example SSTO; OptimalControlProblems.jl, ssto_earth.
"""

from __future__ import annotations

import casadi as ca
import numpy as np

from ocp import Collocation, Problem

from .entry import TOOLBOX, Entry, line

GRAVITY, AIR, SCALE_HEIGHT, DRAG, SURFACE = 9.80665, 1.225, 8440.0, 0.5, 7.069
THRUST, IMPULSE, MASS = 2100000.0, 265.2, 117000.0
SMALL = 1e-6  # m^2/s^2, by which the square of the speed is smoothed at rest


def build() -> Problem:
    problem = Problem("one stage to orbit")
    r = problem.state("r", initial=[0.0, 0.0], terminal=[np.nan, 185000.0], guess=line([0.0, 0.0], [4e5, 185e3], 150.0))
    v = problem.state("v", initial=[0.0, 0.0], terminal=[7796.6961, 0.0])
    m = problem.state("m", initial=MASS, lower=1000.0, upper=MASS, guess=line(MASS, 0.2 * MASS, 150.0))
    theta = problem.control("theta", lower=-np.pi / 2, upper=np.pi / 2, guess=line(1.5, -0.4, 150.0))
    horizon = problem.horizon(lower=10.0, upper=1000.0, guess=150.0)
    speed = ca.sqrt(ca.sumsqr(v) + SMALL)
    drag = AIR * ca.exp(-r[1] / SCALE_HEIGHT) * speed / 2 * DRAG * SURFACE  # over the speed
    problem.dynamics(r, v)
    push = THRUST * ca.vertcat(ca.cos(theta), ca.sin(theta)) - drag * v
    problem.dynamics(v, push / m - ca.DM([0.0, GRAVITY]))
    problem.dynamics(m, -THRUST / (GRAVITY * IMPULSE))
    problem.minimize(terminal=horizon)
    return problem


ENTRY = Entry("ssto_earth", (TOOLBOX,), build, method=Collocation(40, 4), second=Collocation(57, 3, "legendre"))
