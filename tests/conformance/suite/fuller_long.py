"""Fuller's problem over a long horizon: the optimal control switches infinitely often.

p'' = u, |u| <= 0.01, from (0, 1) to rest at 0 in 300 s, least int p^2 dt. With time in units of 1 / 0.01 s = 100 s and
p in units of 100 m it is the problem of `tests.conformance.fuller` with a horizon of 3 instead of 3.5, both longer
than the 2.92 in which the chattering ends: the optimal cost is 100^2 100 times that one's. Nita, Kerrigan, Vila & Nie,
CDC 2022; PSOPT, example fuller, without a cost to compare.
"""

from __future__ import annotations

from ocp import Collocation, Problem
from tests.conformance.fuller import optimal_cost

from .entry import PSOPT, Entry, line

LIMIT, HORIZON = 0.01, 300.0


def build() -> Problem:
    problem = Problem("Fuller, 300 s")
    p = problem.state("p", initial=0.0, terminal=0.0, lower=-200.0, upper=200.0, guess=0.0)
    v = problem.state("v", initial=1.0, terminal=0.0, lower=-5.0, upper=5.0, guess=line(1.0, 0.0, HORIZON))
    u = problem.control("u", lower=-LIMIT, upper=LIMIT, guess=-0.001)
    problem.horizon(HORIZON)
    problem.dynamics(p, v)
    problem.dynamics(v, u)
    problem.minimize(running=p**2)
    return problem


ENTRY = Entry(
    "fuller", (PSOPT,), build, exact=optimal_cost() / LIMIT**3, method=Collocation(150, 3, control="held"),
    second=Collocation(211, 3, "legendre", control="held"),
    note="chattering: the best control with as many values as the mesh has intervals",
)  # fmt: skip
