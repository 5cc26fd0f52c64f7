"""Bryson-Denham: double integrator turned round below a ceiling.

(q, v) from (0, 1) to (0, -1) in 1 s, q <= l = 1/9, least int u^2 / 2 dt. Three arcs: free to t1 = 3 l, along the
ceiling, free again; cost 4 / (9 l) = 4. The ceiling is adjoined directly, H + mu (q - l), whose costates are the
derivatives of the optimal cost: that of q is 2 / (9 l^2) = 18 before contact, 0 along the ceiling, -18 after it, and
jumps at both ends of the contact. Bryson & Ho, Applied Optimal Control, 1975, section 3.11.
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np

from ocp import Problem
from tests.ocp.problems import double_integrator

from .case import Array, Case, Extremal, legendre, radau, shooting, within

CEILING = 1 / 9
T1 = 3 * CEILING  # contact begins; it ends at 1 - T1


def build(*, as_path: bool = False) -> Problem:
    bound = None if as_path else CEILING
    problem, q, _, u = double_integrator("Bryson-Denham", (0.0, 1.0), (0.0, -1.0), ceiling=bound)
    if as_path:
        problem.path("ceiling", q, upper=CEILING)
    problem.minimize(running=u**2 / 2)
    return problem


def optimum(t: Array) -> Extremal:
    left = np.maximum(1 - np.minimum(t, 1 - t) / T1, 0.0)  # share of the free arc still ahead (or behind)
    side = np.where(t < 0.5, 1.0, -1.0)
    slope = 2 / (9 * CEILING**2)
    return Extremal(
        state={"q": CEILING * (1 - left**3), "v": side * left**2},
        control={"u": -2 / T1 * left},
        costate={"q": slope * side * (left > 0), "v": 2 / T1 * left},
    )


# contact begins and ends on a node, and each arc is a cubic: these hold the optimum exactly
EXACT = within(
    radau(12), legendre(12), shooting(12, "linear"), cost=(2e-9, 2e-9), state=1e-5, control=2e-4, costate=2e-3
)

RUNS = (
    *EXACT,
    # contact begins inside an interval: between the points the ceiling is overstepped a little
    *within(radau(20), legendre(20), cost=(2e-4, 1e-8), state=2e-3, control=0.1, costate=0.1),
    *within(shooting(48, "held"), cost=(1e-8, 1e-2), state=2e-3, control=0.2, costate=0.1),
)
CASE = Case("Bryson-Denham", build, 4 / (9 * CEILING), RUNS, horizon=1.0, optimum=optimum, jumps=(T1, 1 - T1))

CASE_AS_PATH = replace(CASE, name="Bryson-Denham, ceiling as a path", build=partial(build, as_path=True), runs=EXACT)
