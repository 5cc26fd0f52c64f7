"""Past two round obstacles at constant speed in a given time.

x' = V cos theta, y' = V sin theta, V = 2.138, from (0, 0) to (1.2, 1.6) in 1 s, outside of two discs of radius
sqrt(0.1) around (0.4, 0.5) and (0.8, 1.5). The cost int x'^2 + y'^2 dt is V^2 for every path: a problem of feasibility.
PROPT manual; PSOPT, example obstacle.
"""

from __future__ import annotations

import casadi as ca

from ocp import Collocation, Problem

from .entry import PSOPT, Entry, line

SPEED = 2.138


def build() -> Problem:
    problem = Problem("obstacles")
    x = problem.state("x", initial=0.0, terminal=1.2, lower=0.0, upper=2.0, guess=line(0.0, 1.2))
    y = problem.state("y", initial=0.0, terminal=1.6, lower=0.0, upper=2.0, guess=line(0.0, 1.6))
    theta = problem.control("theta", lower=-10.0, upper=10.0, guess=0.0)
    problem.horizon(1.0)
    across, up = SPEED * ca.cos(theta), SPEED * ca.sin(theta)
    problem.dynamics(x, across)
    problem.dynamics(y, up)
    problem.path("first obstacle", (x - 0.4) ** 2 + (y - 0.5) ** 2, lower=0.1)
    problem.path("second obstacle", (x - 0.8) ** 2 + (y - 1.5) ** 2, lower=0.1)
    problem.minimize(running=across**2 + up**2)
    return problem


ENTRY = Entry("obstacle", (PSOPT,), build, {PSOPT: 4.571044}, SPEED**2, method=Collocation(20, 3))
