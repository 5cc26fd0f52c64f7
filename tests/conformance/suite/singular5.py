"""A nearly singular control of three states.

x1' = x2, x2' = -x3 u + 16 t - 8, x3' = u, 0 <= u <= 10, from (0, -1, -sqrt 5), 1 s, least int x1^2 + x2^2 + 0.0005 (x2
+ 16 t - 8 - 0.1 x3 u^2)^2 dt. Luus, 2002; PSOPT, example singular5.
"""

from __future__ import annotations

from math import sqrt

from ocp import Collocation, Problem

from .entry import PSOPT, Entry


def build() -> Problem:
    problem = Problem("singular 5")
    x1 = problem.state("x1", initial=0.0, guess=0.0)
    x2 = problem.state("x2", initial=-1.0, guess=-1.0)
    x3 = problem.state("x3", initial=-sqrt(5.0), guess=-sqrt(5.0))
    u = problem.control("u", lower=0.0, upper=10.0, guess=0.0)
    problem.horizon(1.0)
    t = problem.time
    problem.dynamics(x1, x2)
    problem.dynamics(x2, -x3 * u + 16 * t - 8)
    problem.dynamics(x3, u)
    problem.minimize(running=x1**2 + x2**2 + 0.0005 * (x2 + 16 * t - 8 - 0.1 * x3 * u**2) ** 2)
    return problem


ENTRY = Entry("singular5", (PSOPT,), build, {PSOPT: 0.119262}, method=Collocation(50, 3))
