"""Steps: down to zero, along it, and up again.

x' = u, |u| <= 1, 0 <= x, x(0) = x(3) = 1, least int x dt: two triangles, whose cost is 1. Gong, Fahroo & Ross, 2008;
PSOPT, example steps.
"""

from __future__ import annotations

from ocp import Collocation, Problem

from .entry import PSOPT, Entry


def build() -> Problem:
    problem = Problem("steps")
    x = problem.state("x", initial=1.0, terminal=1.0, lower=0.0, upper=5.0, guess=1.0)
    u = problem.control("u", lower=-1.0, upper=1.0, guess=0.0)
    problem.horizon(3.0)
    problem.dynamics(x, u)
    problem.minimize(running=x)
    return problem


ENTRY = Entry(
    "steps", (PSOPT,), build, {PSOPT: 1.0}, 1.0, method=Collocation(30, 3),
    second=Collocation(45, 2, "legendre"),
)  # fmt: skip
