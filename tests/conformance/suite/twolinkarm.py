"""Two-link arm moved in least time with bounded torques.

Rates x1 and x2 of both links, angle x3 between them, angle x4 of the first; |u| <= 1, from rest at (0.5, 0) to rest at
(0.5, 0.522). Both torques switch, the optimum is bang-bang. Luus, 2000; PSOPT, example twolinkarm.
"""

from __future__ import annotations

import casadi as ca

from ocp import Collocation, Problem

from .entry import PSOPT, Entry


def build() -> Problem:
    start, end = [0.0, 0.0, 0.5, 0.0], [0.0, 0.0, 0.5, 0.522]
    problem = Problem("two-link arm")
    x = problem.state("x", initial=start, terminal=end, lower=-2.0, upper=2.0, guess=end)
    u = problem.control("u", 2, lower=-1.0, upper=1.0, guess=0.0)
    horizon = problem.horizon(lower=1.0, upper=10.0, guess=3.0)
    s, c = ca.sin(x[2]), ca.cos(x[2])
    determinant = 31 / 36 + 9 / 4 * s**2
    first = s * (9 / 4 * c * x[0] ** 2 + 2 * x[1] ** 2) + 4 / 3 * (u[0] - u[1]) - 3 / 2 * c * u[1]
    second = -(s * (7 / 2 * x[0] ** 2 + 9 / 4 * c * x[1] ** 2) - 7 / 3 * u[1] + 3 / 2 * c * (u[0] - u[1]))
    problem.dynamics(x, ca.vertcat(first / determinant, second / determinant, x[1] - x[0], x[0]))
    problem.minimize(terminal=horizon)
    return problem


ENTRY = Entry(
    "twolinkarm", (PSOPT,), build, {PSOPT: 2.988662}, method=Collocation(60, 3),
    second=Collocation(85, 3, "legendre"),
)  # fmt: skip
