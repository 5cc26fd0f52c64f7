"""A mass on a spring, excited, with a damper whose mass is coupled by an adjustable dashpot.

m1 x1'' = -(k1 + k2) x1 + k2 x2 + sin t, m2 x2'' = k2 (x1 - x2) - c (1 - u) x2', |u| <= 1, x(0) = 0 with free
velocities, 2 pi s, least int (x1^2 + x2^2 + u^2) / 2 dt. Coudurier, Lepreux & Petit, 2018; OptimalControlProblems.jl,
double_oscillator.
"""

from __future__ import annotations

import casadi as ca
import numpy as np

from ocp import Collocation, Problem

from .entry import TOOLBOX, Entry

M1, M2, DASHPOT, K1, K2 = 100.0, 2.0, 0.5, 100.0, 3.0


def build() -> Problem:
    problem = Problem("double oscillator")
    x = problem.state("x", initial=[0.0, 0.0])
    v = problem.state("v", 2)
    u = problem.control("u", lower=-1.0, upper=1.0)
    problem.horizon(2 * np.pi)
    problem.dynamics(x, v)
    problem.dynamics(
        v,
        ca.vertcat(
            (-(K1 + K2) * x[0] + K2 * x[1] + ca.sin(problem.time)) / M1,
            (K2 * (x[0] - x[1]) - DASHPOT * (1 - u) * v[1]) / M2,
        ),
    )
    problem.minimize(running=(ca.sumsqr(x) + u**2) / 2)
    return problem


ENTRY = Entry("double_oscillator", (TOOLBOX,), build, method=Collocation(30, 4))
