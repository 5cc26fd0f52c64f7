"""Point mass in the plane whose acceleration stays in a disc, a second-order cone.

r' = v, v' = a with |a| <= 0.8, from rest at (0, 0) to rest at (1, 0.5) in 2.5 s, least int |a|^2 dt. By symmetry a is
along the line between both ends: a double integrator over the distance d = sqrt(1.25) whose acceleration is cut off at
0.8 for ts at both ends, and falls linearly between. With c = T / 2 the slope is k = 0.8 / (c - ts), and
d = 0.8 ts (T - ts) + 2 k (c - ts)^3 / 3. PSOPT, example conic_soc, with |a| smoothed by 1e-4.
"""

from __future__ import annotations

from math import sqrt

import casadi as ca
from scipy.optimize import brentq

from ocp import Problem

from .entry import PSOPT, Entry

LIMIT, DURATION = 0.8, 2.5
DISTANCE = sqrt(1.25)


def build() -> Problem:
    problem = Problem("second-order cone")
    r = problem.state("r", initial=[0.0, 0.0], terminal=[1.0, 0.5], lower=-5.0, upper=5.0)
    v = problem.state("v", initial=[0.0, 0.0], terminal=[0.0, 0.0], lower=-5.0, upper=5.0)
    a = problem.control("a", 2, lower=-2.0, upper=2.0)
    problem.horizon(DURATION)
    problem.dynamics(r, v)
    problem.dynamics(v, a)
    problem.path("cone", ca.sumsqr(a), upper=LIMIT**2)
    problem.minimize(running=ca.sumsqr(a))
    return problem


def energy() -> float:
    """Least integral of |a|^2."""
    c = DURATION / 2

    def distance(saturated: float) -> float:
        return LIMIT * saturated * (DURATION - saturated) + 2 * LIMIT * (c - saturated) ** 2 / 3

    saturated = float(brentq(lambda t: distance(t) - DISTANCE, 0.0, c, xtol=1e-15))
    return 2 * LIMIT**2 * (saturated + (c - saturated) / 3)


ENTRY = Entry("conic_soc", (PSOPT,), build, {PSOPT: 0.9997182}, exact=energy())
