"""Double integrator with a singular arc: full throttle, cruise at unit speed, full brake.

x' = v, v' = u, |u| <= 1, from rest at 2 to rest at 5, least int (1 + v^2) / 2 dt, free time. On the singular arc u = 0,
and H = 0 there requires v = 1: u = 1 for 1 s, 0 for 2 s, -1 for 1 s. Both ramps cost 2/3 each, the cruise costs 2, so
the cost is 10/3. Locatelli, 2017, problem 11.2-1a; PSOPT, example singular_di.
"""

from __future__ import annotations

from ocp import Collocation, Problem

from .entry import PSOPT, Entry, samples

TIMES = [0.0, 1.0, 3.0, 4.0]


def build() -> Problem:
    problem = Problem("singular double integrator")
    x = problem.state("x", initial=2.0, terminal=5.0, lower=-10.0, upper=10.0)
    v = problem.state("v", initial=0.0, terminal=0.0, lower=-5.0, upper=5.0, guess=samples(TIMES, [0.0, 1.0, 1.0, 0.0]))
    u = problem.control("u", lower=-1.0, upper=1.0, guess=lambda t: 1.0 * (t < 1) - 1.0 * (t > 3))
    problem.horizon(lower=2.0, upper=8.0, guess=4.0)
    problem.dynamics(x, v)
    problem.dynamics(v, u)
    problem.minimize(running=(1 + v**2) / 2)
    return problem


ENTRY = Entry(
    "singular_di", (PSOPT,), build, {PSOPT: 3.333328}, 10 / 3, method=Collocation(40, 3),
    second=Collocation(61, 3, "legendre"),
)  # fmt: skip
