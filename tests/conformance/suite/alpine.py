"""Alp rider: four states kept outside a ball whose radius has sharp peaks in time.

x1' = -10 x1 + u1 + u2, x2' = -2 x2 + u1 + 2 u2, x3' = -3 x3 + 5 x4 + u1 - u2, x4' = 5 x3 - 3 x4 + u1 + 3 u2, 20 s, from
(2, 1, 2, 1) to (2, 3, 1, -2), least int 100 |x|^2 + 0.01 |u|^2 dt with |x|^2 >= 3 p(3, 12) + 3 p(6, 10) + 3 p(10, 6) +
8 p(15, 4) + 0.01, where p(a, b) = exp(-b (t - a)^2). The mode x3 + x4 grows as exp(2 t). Betts, Practical Methods for
Optimal Control, 2010; PSOPT, example alpine, which its solvers do not end within 120 s.
"""

from __future__ import annotations

import casadi as ca

from ocp import Collocation, Problem

from .entry import PSOPT, Entry, line

PEAKS = ((3.0, 3.0, 12.0), (3.0, 6.0, 10.0), (3.0, 10.0, 6.0), (8.0, 15.0, 4.0))
"""Height, time, s, and sharpness, 1/s^2, of each peak."""


def build() -> Problem:
    problem = Problem("alp rider")
    start, end = [2.0, 1.0, 2.0, 1.0], [2.0, 3.0, 1.0, -2.0]
    x = problem.state("x", initial=start, terminal=end, lower=-4.0, upper=4.0, guess=line(start, end, 20.0))
    u = problem.control("u", 2, lower=-500.0, upper=500.0, guess=0.0)
    problem.horizon(20.0)
    problem.dynamics(
        x,
        ca.vertcat(
            -10 * x[0] + u[0] + u[1],
            -2 * x[1] + u[0] + 2 * u[1],
            -3 * x[2] + 5 * x[3] + u[0] - u[1],
            5 * x[2] - 3 * x[3] + u[0] + 3 * u[1],
        ),
    )
    terrain = sum(height * ca.exp(-sharpness * (problem.time - at) ** 2) for height, at, sharpness in PEAKS)
    problem.path("terrain", ca.sumsqr(x) - terrain, lower=0.01)
    problem.minimize(running=100 * ca.sumsqr(x) + 0.01 * ca.sumsqr(u))
    return problem


ENTRY = Entry(
    "alpine",
    (PSOPT,),
    build,
    {"literature": 2030.856},
    method=Collocation(120, 4),
    second=Collocation(150, 3, "legendre"),
)
