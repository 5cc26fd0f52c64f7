"""Goddard's rocket as PSOPT states it: without the reference altitude in the drag, which is then below 1e-214.

h' = v, v' = (T - 310 v^2 exp(-500 h)) / m - 1 / h^2, m' = -2 T, 0 <= T <= 3.5, from (1, 0, 1) to m = 0.6, greatest h.
Without drag it is best to burn all fuel at once: full thrust, then coast. The problem with drag is
`tests.conformance.goddard`. Bryson, Dynamic Optimization, 1999; PSOPT, example goddard.
"""

from __future__ import annotations

import casadi as ca

from ocp import Collocation, Problem

from .entry import PSOPT, Entry

EXHAUST, DRAG, BETA = 0.5, 310.0, 500.0


def build() -> Problem:
    problem = Problem("Goddard of PSOPT")
    v = problem.state("v", initial=0.0, lower=0.0, upper=2.0, guess=0.0)
    h = problem.state("h", initial=1.0, lower=1.0, upper=2.0, guess=1.0)
    m = problem.state("m", initial=1.0, terminal=0.6, lower=0.6, upper=1.0, guess=1.0)
    thrust = problem.control("T", lower=0.0, upper=3.5, guess=3.5)
    problem.horizon(lower=0.1, upper=1.0, guess=0.5)
    problem.dynamics(v, (thrust - DRAG * v**2 * ca.exp(-BETA * h)) / m - 1 / h**2)
    problem.dynamics(h, v)
    problem.dynamics(m, -thrust / EXHAUST)
    problem.minimize(terminal=-h)
    return problem


ENTRY = Entry(
    "goddard", (PSOPT,), build, {PSOPT: -1.025336}, method=Collocation(50, 3),
    second=Collocation(71, 3, "legendre"),
)  # fmt: skip
