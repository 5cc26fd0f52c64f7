"""A 2 x 2 matrix [[1, b], [b, c]] that stays positive semidefinite: c >= b^2.

b' = u1, c' = u2 from (0, 1), b(1) = 0.8, least c(1) + int 0.01 (u1^2 + u2^2) dt. Without the constraint both are
straight lines, and c' = -50 would be cheapest: so c falls in a straight line to the boundary, c(1) = b(1)^2, which
touches it nowhere else. PSOPT, example conic_sdp.
"""

from __future__ import annotations

from ocp import Problem

from .entry import PSOPT, Entry, line

END = 0.8


def build() -> Problem:
    problem = Problem("semidefinite matrix")
    b = problem.state("b", initial=0.0, terminal=END, lower=-2.0, upper=2.0, guess=line(0.0, END))
    c = problem.state("c", initial=1.0, lower=-0.1, upper=3.0, guess=1.0)
    u = problem.control("u", 2, lower=-5.0, upper=5.0)
    problem.horizon(1.0)
    problem.dynamics(b, u[0])
    problem.dynamics(c, u[1])
    problem.path("determinant", c - b**2, lower=0.0)
    problem.minimize(running=0.01 * (u[0] ** 2 + u[1] ** 2), terminal=c)
    return problem


ENTRY = Entry("conic_sdp", (PSOPT,), build, {PSOPT: 0.647696}, exact=END**2 + 0.01 * (END**2 + (1 - END**2) ** 2))
