"""Hypersensitive problem: a boundary layer at each end of a long horizon.

x' = -x^3 + u from 1.5 to 1 in 50 s, least int (x^2 + u^2) / 2 dt. Rao & Mease, Automatica 35, 1999; PSOPT, example
hypersensitive.
"""

from __future__ import annotations

import numpy as np

from ocp import Collocation, Problem

from .entry import PSOPT, Entry

ENDS = (0.0, *np.geomspace(0.004, 0.5, 20).tolist())
MESH = (*ENDS, *(1 - node for node in reversed(ENDS[:-1])))
"""Nodes that crowd at both ends, where the boundary layers are."""


def build() -> Problem:
    problem = Problem("hypersensitive")
    x = problem.state("x", initial=1.5, terminal=1.0, lower=-50.0, upper=50.0, guess=1.0)
    u = problem.control("u", lower=-50.0, upper=50.0, guess=0.0)
    problem.horizon(50.0)
    problem.dynamics(x, -(x**3) + u)
    problem.minimize(running=(x**2 + u**2) / 2)
    return problem


ENTRY = Entry(
    "hypersensitive", (PSOPT,), build, {PSOPT: 1.330826}, method=Collocation(len(MESH) - 1, 4, "radau", "points", MESH)
)
