"""Drive of an electric vehicle over a hilly road with least energy.

x' = v, v' = u - 0.001 v^2 - 0.1 - (3 + 0.4 x - x^2 + 0.1 x^3), from rest at 0 to rest at 10 in 1 s, least int u v + u^2
dt. Petit & Sciarretta, 2011; OptimalControlProblems.jl, electric_vehicle.
"""

from __future__ import annotations

from ocp import Collocation, Indirect, Problem

from .entry import TOOLBOX, Entry


def build() -> Problem:
    problem = Problem("electric vehicle")
    x = problem.state("x", initial=0.0, terminal=10.0)
    v = problem.state("v", initial=0.0, terminal=0.0)
    u = problem.control("u", guess=0.1)
    problem.horizon(1.0)
    problem.dynamics(x, v)
    problem.dynamics(v, u - 1e-3 * v**2 - 0.1 - (3 + 0.4 * x - x**2 + 0.1 * x**3))
    problem.minimize(running=u * v + u**2)
    return problem


ENTRY = Entry(
    "electric_vehicle", (TOOLBOX,), build, {"CTDirect": "1.23e3"}, method=Collocation(20, 4), second=Indirect()
)
