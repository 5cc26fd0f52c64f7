"""A state constraint that varies with time.

x1' = x2, x2' = -x2 + u, |u| <= 20, x2 <= 8 (t - 0.5)^2 - 0.5, from (0, -1), 1 s, least int x1^2 + x2^2 + 0.005 u^2 dt.
Jacobson & Lele, 1969; Teo, Goh & Wong, 1991; PSOPT, example stc1.
"""

from __future__ import annotations

from ocp import Collocation, Problem

from .entry import PSOPT, Entry


def build() -> Problem:
    problem = Problem("moving state constraint")
    x1 = problem.state("x1", initial=0.0, lower=-2.0, upper=2.0, guess=0.0)
    x2 = problem.state("x2", initial=-1.0, lower=-2.0, upper=2.0, guess=0.0)
    u = problem.control("u", lower=-20.0, upper=20.0, guess=0.0)
    problem.horizon(1.0)
    problem.dynamics(x1, x2)
    problem.dynamics(x2, -x2 + u)
    problem.path("ceiling", x2 - 8 * (problem.time - 0.5) ** 2, upper=-0.5)
    problem.minimize(running=x1**2 + x2**2 + 0.005 * u**2)
    return problem


ENTRY = Entry("stc1", (PSOPT,), build, {PSOPT: 0.1698180}, method=Collocation(40, 4))
