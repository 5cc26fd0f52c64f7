"""Coupled growth of algae and bacteria over a day, periodic: greatest production of methane.

y' = mu(t) y / (1 + y) - (0.005 + u) y, s' = -m b + u (y - s), b' = (m - u) b with m = 0.1 s / (s + 0.05), mu = sin^2(pi
t / 5) in the first half of a day of 10 and 0 in the second, 0 <= u <= 1, y, b >= 1 at the start, equal values at both
ends, greatest int m b / 3 dt. Bocop, example bioreactor; CTDirect.jl, bioreactor_1day_periodic.
"""

from __future__ import annotations

import casadi as ca
import numpy as np

from ocp import Collocation, Problem

from .entry import TOOLBOX, Entry

DAY = 10.0


def build() -> Problem:
    problem = Problem("bioreactor of a day")
    y = problem.state("y", lower=0.0, guess=5.0)
    s = problem.state("s", lower=0.0, guess=2.75)
    b = problem.state("b", lower=0.001, guess=1.75)
    u = problem.control("u", lower=0.0, upper=1.0, guess=0.1)
    problem.horizon(DAY)
    light = ca.fmax(0, ca.sin(2 * np.pi * problem.time / DAY)) ** 2
    growth = 0.1 * s / (s + 0.05)
    problem.dynamics(y, light * y / (1 + y) - (0.005 + u) * y)
    problem.dynamics(s, -growth * b + u * (y - s))
    problem.dynamics(b, (growth - u) * b)
    problem.start("algae", y, lower=1.0)
    problem.start("bacteria", b, lower=1.0)
    for name, x in (("y", y), ("s", s), ("b", b)):
        problem.end(f"periodic {name}", x - problem.at_start(x), 0.0, 0.0)
    problem.minimize(running=-growth * b / 3)
    return problem


ENTRY = Entry(
    "bioreactor_1day", (TOOLBOX,), build, {"CTDirect": -0.614134}, method=Collocation(60, 3),
    second=Collocation(84, 3, "legendre"),
)  # fmt: skip
