"""Double integrator, least control energy.

q' = v, v' = u, from (0, 0) to (1, 0) in 1 s, least int u^2 / 2 dt. H = u^2/2 + lq v + lv u gives u = -lv, lv' = -lq,
lq' = 0: a control linear in time, fixed by the ends.
"""

from __future__ import annotations

import numpy as np

from ocp import Problem
from tests.ocp.problems import double_integrator

from .case import Array, Case, Extremal, legendre, radau, shooting, within


def build() -> Problem:
    problem, _, _, u = double_integrator("energy")
    problem.minimize(running=u**2 / 2)
    return problem


def optimum(t: Array) -> Extremal:
    return Extremal(
        state={"q": 3 * t**2 - 2 * t**3, "v": 6 * t - 6 * t**2},
        control={"u": 6 - 12 * t},
        costate={"q": np.full_like(t, -12.0), "v": 12 * t - 6},
    )


HELD = 6 / (50**2 - 1)  # what 50 held controls cost more than free ones

RUNS = (
    # q is a cubic, v a quadratic, u a line: these hold the optimum exactly
    *within(
        radau(5), legendre(5), shooting(10, "linear"), cost=(1e-11, 1e-11), state=1e-11, control=1e-10, costate=1e-10
    ),
    # N held controls: the best of them costs 6 N^2 / (N^2 - 1), exactly
    *within(shooting(50, "held"), cost=(1e-9 - HELD, 1e-9 + HELD), state=1e-3, control=0.13, costate=1e-2),
)
CASE = Case("energy", build, 6.0, RUNS, horizon=1.0, optimum=optimum)
