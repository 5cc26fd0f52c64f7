"""Double integrator, least control energy, |u| <= 5.

As `energy`, but the control saturates: u = clip(-lv, -5, 5) with lv a line through zero at 1/2. Distance 1 puts the
corners at 1/2 -+ a with a^2 = 3/20; the cost is 25/2 - 50 a/3 = 6.0450277563.
"""

from __future__ import annotations

from math import sqrt

import numpy as np

from ocp import Problem
from tests.ocp.problems import double_integrator

from .case import Array, Case, Extremal, Switch, fitted, legendre, radau, shooting, within

LIMIT = 5.0
A = sqrt(3 / 20)  # half of the unsaturated arc, s
SLOPE = LIMIT / A  # of the costate of v
MESH = fitted((0.5 - A, 0.5 + A), 16)


def build() -> Problem:
    problem, _, _, u = double_integrator("energy, bounded", limit=LIMIT)
    problem.minimize(running=u**2 / 2)
    return problem


def optimum(t: Array) -> Extremal:
    mirrored = np.minimum(t, 1 - t)  # v is even about 1/2, q - 1/2 is odd
    s = np.maximum(mirrored - (0.5 - A), 0.0)  # time since the corner
    v = LIMIT * mirrored - LIMIT / A * s**2 / 2
    first_half = LIMIT * mirrored**2 / 2 - LIMIT / A * s**3 / 6
    return Extremal(
        state={"q": np.where(t <= 0.5, first_half, 1 - first_half), "v": v},
        control={"u": np.clip(-SLOPE * (t - 0.5), -LIMIT, LIMIT)},
        costate={"q": np.full_like(t, -SLOPE), "v": SLOPE * (t - 0.5)},
    )


RUNS = (
    *within(radau(40), legendre(40), cost=(2e-6, 2e-6), state=5e-4, control=3e-3, costate=8e-3, time=5e-4),
    # corners on nodes: a cubic an arc
    *within(radau(MESH), cost=(1e-8, 1e-8), state=3e-6, control=2e-5, costate=5e-5, time=1e-5),
    *within(
        legendre(MESH), shooting(MESH, "linear"), cost=(1e-8, 1e-8), state=1e-8, control=1e-6, costate=2e-7, time=1e-8
    ),
    # held controls: every plan is admissible
    *within(shooting(50, "held"), cost=(1e-8, 5e-3), state=1e-3, control=0.15, costate=5e-3, time=1e-3),
)
SWITCHES = (Switch(0.5 - A, lambda x, lam: lam["v"] + LIMIT), Switch(0.5 + A, lambda x, lam: lam["v"] - LIMIT))
CASE = Case("energy, bounded", build, 12.5 - 50 * A / 3, RUNS, horizon=1.0, optimum=optimum, switches=SWITCHES)
