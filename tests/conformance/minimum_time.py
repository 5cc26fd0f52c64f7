"""Double integrator, least time, |u| <= 1.

From (0, 0) to (1, 0): full push, full brake, switch halfway at 1 s, cost T = 2. H = lq v + lv u + 1 vanishes, so
lv(0) = -1, lv(2) = 1 and lq = -1 (the terminal cost T adds the 1).
"""

from __future__ import annotations

import numpy as np

from ocp import Problem
from tests.ocp.problems import double_integrator

from .case import Array, Case, Extremal, Switch, held, radau, shooting, within


def build() -> Problem:
    problem, *_ = double_integrator("minimum time", horizon=None, limit=1.0)
    problem.minimize(terminal=problem.horizon(lower=0.1, upper=10.0, guess=3.0))
    return problem


def optimum(t: Array) -> Extremal:
    return Extremal(
        state={"q": np.where(t < 1, t**2 / 2, 1 - (2 - t) ** 2 / 2), "v": np.minimum(t, 2 - t)},
        control={"u": np.where(t < 1, 1.0, -1.0)},
        costate={"q": np.full_like(t, -1.0), "v": t - 1},
    )


RUNS = (
    # held controls and an even number of intervals: the switch lies on a node, the optimum is held exactly
    *within(*held(20), cost=(2e-9, 2e-9), state=2e-9, control=1e-8, costate=1e-8, time=1e-8),
    # an odd number: the switch lies inside an interval; still every plan is admissible
    *within(radau(31, control="held"), cost=(1e-8, 3e-3), state=5e-2, control=1e-8, costate=5e-3, time=5e-3),
    *within(shooting(31, "held"), cost=(1e-8, 3e-3), state=3e-3, control=1e-8, costate=5e-3, time=5e-3),
)
CASE = Case(
    "minimum time", build, 2.0, RUNS, horizon=2.0, optimum=optimum, switches=(Switch(1.0, lambda x, lam: lam["v"]),)
)
