"""Maximum range of a body with a thrust of half its weight.

x' = v u1, y' = v u2, v' = a - g u2 with u1^2 + u2^2 = 1, g = 1, a = g / 2, from rest at the origin; the greatest x at
y = 0.1 after 2 s. Bryson & Ho, Applied Optimal Control, 1975; PSOPT, example bryson_max_range.
"""

from __future__ import annotations

from ocp import Problem

from .entry import PSOPT, Entry

GRAVITY, THRUST = 1.0, 0.5


def build() -> Problem:
    problem = Problem("maximum range")
    x = problem.state("x", initial=0.0, lower=-10.0, upper=10.0)
    y = problem.state("y", initial=0.0, terminal=0.1, lower=-10.0, upper=10.0)
    v = problem.state("v", initial=0.0, lower=-10.0, upper=10.0)
    u = problem.control("u", 2, lower=-10.0, upper=10.0, guess=[1.0, 0.0])
    problem.horizon(2.0)
    problem.dynamics(x, v * u[0])
    problem.dynamics(y, v * u[1])
    problem.dynamics(v, THRUST - GRAVITY * u[1])
    problem.path("direction", u[0] ** 2 + u[1] ** 2, 1.0, 1.0)
    problem.minimize(terminal=-x)
    return problem


ENTRY = Entry("bryson_max_range", (PSOPT,), build, {PSOPT: -1.712314})
