"""Double integrator, least consumption int |u| dt, |u| <= 5.

From (0, 0) to (1, 0) in 1 s. |u| is written as u = up - um, both in [0, 5]. The control is 5, 0, -5: it burns while
the costate of v is below -1, brakes while it is above 1. Distance 1 = 5 t1 (1 - t1) gives the switch t1; the cost is
10 t1 = 5 - sqrt 5.
"""

from __future__ import annotations

from math import sqrt

import numpy as np

from ocp import Problem

from .case import Array, Case, Extremal, Switch, fitted, held, within

LIMIT = 5.0
T1 = (1 - sqrt(1 - 4 / LIMIT)) / 2  # end of the first burn, s
SLOPE = 2 / (1 - 2 * T1)  # of the costate of v: -1 at T1, 1 at 1 - T1
MESH = fitted((T1, 1 - T1), 16)


def build() -> Problem:
    problem = Problem("consumption")
    q = problem.state("q", initial=0.0, terminal=1.0)
    v = problem.state("v", initial=0.0, terminal=0.0)
    up = problem.control("up", lower=0.0, upper=LIMIT)
    um = problem.control("um", lower=0.0, upper=LIMIT)
    problem.horizon(1.0)
    problem.dynamics(q, v)
    problem.dynamics(v, up - um)
    problem.minimize(running=up + um)
    return problem


def optimum(t: Array) -> Extremal:
    mirrored = np.minimum(t, 1 - t)  # v is even about 1/2, q - 1/2 is odd
    v = LIMIT * np.minimum(mirrored, T1)
    first_half = np.where(mirrored < T1, LIMIT * mirrored**2 / 2, LIMIT * T1 * (mirrored - T1 / 2))
    return Extremal(
        state={"q": np.where(t <= 0.5, first_half, 1 - first_half), "v": v},
        control={"up": np.where(t < T1, LIMIT, 0.0), "um": np.where(t > 1 - T1, LIMIT, 0.0)},
        costate={"q": np.full_like(t, -SLOPE), "v": SLOPE * (t - 0.5)},
    )


RUNS = (
    # held controls: both quadratures are exact, so every plan is admissible and none beats the optimum. The
    # costate is known to an interval only: a switching function with its zeros a little aside switches alike
    *within(*held(40), cost=(1e-8, 1e-3), state=1e-2, control=1e-7, costate=0.3, time=0.02),
    # switches on nodes
    *within(*held(MESH), cost=(1e-8, 1e-8), state=1e-8, control=1e-7, costate=0.3, time=0.03),
)
CASE = Case(
    "consumption",
    build,
    5 - sqrt(5),
    RUNS,
    horizon=1.0,
    optimum=optimum,
    switches=(Switch(T1, lambda x, lam: 1 + lam["v"]), Switch(1 - T1, lambda x, lam: 1 - lam["v"])),
)
