"""Robertson's stiff chemical kinetics over 40 s: a simulation stated as a problem without a cost.

x' = -0.04 x + 1e4 y z, y' = 0.04 x - 1e4 y z - 3e7 y^2, z' = 3e7 y^2 from (1, 0, 0). Robertson, 1966; OptimalControl-
Problems.jl, robertson.
"""

from __future__ import annotations

import numpy as np

from ocp import Collocation, Problem

from .entry import TOOLBOX, Entry

K1, K2, K3 = 0.04, 1e4, 3e7


def build() -> Problem:
    problem = Problem("Robertson")
    x = problem.state("x", initial=1.0, guess=1.0)
    y = problem.state("y", initial=0.0, guess=1e-5, scale=1e-5)
    z = problem.state("z", initial=0.0, guess=0.0)
    problem.horizon(40.0)
    problem.dynamics(x, -K1 * x + K2 * y * z)
    problem.dynamics(y, K1 * x - K2 * y * z - K3 * y**2)
    problem.dynamics(z, K3 * y**2)
    problem.minimize()
    return problem


MESH = (0.0, *np.geomspace(1e-7, 1.0, 60).tolist())
"""Nodes that crowd at the start, where y rises within milliseconds."""
ENTRY = Entry(
    "robertson", (TOOLBOX,), build, exact=0.0, method=Collocation(len(MESH) - 1, 3, "radau", "points", MESH),
    second=Collocation(len(MESH) - 1, 5, "radau", "points", MESH),
)  # fmt: skip
