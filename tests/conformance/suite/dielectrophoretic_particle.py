"""A particle moved in least time by an electric field.

x' = y u - 0.75 u^2, y' = -y + u, |u| <= 1, from (1, 0) to x = 2. Chang, Petit & Rouchon, IEEE Trans. Automatic Control
51, 2006; OptimalControlProblems.jl, dielectrophoretic_particle.
"""

from __future__ import annotations

from ocp import Collocation, Problem

from .entry import TOOLBOX, Entry

ALPHA = -0.75


def build() -> Problem:
    problem = Problem("dielectrophoretic particle")
    x = problem.state("x", initial=1.0, terminal=2.0)
    y = problem.state("y", initial=0.0, guess=1.0)
    u = problem.control("u", lower=-1.0, upper=1.0, guess=0.1)
    horizon = problem.horizon(lower=0.1, upper=50.0, guess=5.0)
    problem.dynamics(x, y * u + ALPHA * u**2)
    problem.dynamics(y, -y + u)
    problem.minimize(terminal=horizon)
    return problem


ENTRY = Entry("dielectrophoretic_particle", (TOOLBOX,), build, method=Collocation(40, 4))
