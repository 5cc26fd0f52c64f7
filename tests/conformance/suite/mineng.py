"""Double integrator of least control energy with three kinds of ends.

x' = v, v' = u from rest at 0, 1 s, least int u^2 / 2 dt, to (1, 0), to x = 1 with a free velocity, or to the line
x - 2 v = 1. The costate of v is linear in time, so that u is: 6 - 12 t, 3 - 3 t and -(3/7) (1 + t). Locatelli, Optimal
Control of a Double Integrator, 2017; PSOPT, examples mineng_di (and dqc), mineng_free_vf, mineng_target_set.
"""

from __future__ import annotations

from functools import partial

from ocp import Collocation, Problem

from .entry import PSOPT, Entry

ENDS = {"point": (1.0, 0.0), "free velocity": (1.0, None), "line": (None, None)}


def build(end: str) -> Problem:
    problem = Problem(f"least energy to a {end}")
    place, velocity = ENDS[end]
    x = problem.state("x", initial=0.0, terminal=place, lower=-5.0, upper=5.0)
    v = problem.state("v", initial=0.0, terminal=velocity, lower=-5.0, upper=5.0)
    u = problem.control("u", lower=-50.0, upper=50.0)
    problem.horizon(1.0)
    problem.dynamics(x, v)
    problem.dynamics(v, u)
    if end == "line":
        problem.end("line", x - 2 * v, 1.0, 1.0)
    problem.minimize(running=u**2 / 2)
    return problem


COARSE, OTHER = Collocation(5, 3), Collocation(7, 3, "legendre")
ENTRIES = (
    Entry("mineng_di", (PSOPT,), partial(build, "point"), {PSOPT: 6.0}, 6.0, COARSE, OTHER),
    Entry("mineng_free_vf", (PSOPT,), partial(build, "free velocity"), {PSOPT: 1.5}, 1.5, COARSE, OTHER),
    Entry("mineng_target_set", (PSOPT,), partial(build, "line"), {PSOPT: 0.2142857}, 3 / 14, COARSE, OTHER),
)
