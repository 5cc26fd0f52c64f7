"""Double integrator with a chance constraint on its velocity, as the deterministic constraint that implies it.

x' = v, v' = u from (0, 0) to (1, 0) in 1 s, least int u^2 dt. The velocity is known with a standard deviation of 0.03
and shall stay below 1.3 with probability 0.95: v <= 1.3 - 1.6449 0.03 = V. As for any ceiling of v there are three
arcs: u falls linearly from u0 to zero in t1, v = V, and the same in reverse; V = u0 t1 / 2 and 1 = V (1 - 2 t1 / 3),
so the cost is 2 u0^2 t1 / 3. PSOPT, example chance_constraint.
"""

from __future__ import annotations

from ocp import Problem

from .entry import PSOPT, Entry

CEILING = 1.30 - 1.6449 * 0.03
T1 = 1.5 * (1 - 1 / CEILING)
U0 = 2 * CEILING / T1


def build() -> Problem:
    problem = Problem("chance constraint")
    x = problem.state("x", initial=0.0, terminal=1.0, lower=-5.0, upper=5.0)
    v = problem.state("v", initial=0.0, terminal=0.0, lower=-5.0, upper=CEILING)
    u = problem.control("u", lower=-20.0, upper=20.0)
    problem.horizon(1.0)
    problem.dynamics(x, v)
    problem.dynamics(v, u)
    problem.minimize(running=u**2)
    return problem


ENTRY = Entry("chance_constraint", (PSOPT,), build, {PSOPT: 13.8738}, exact=2 * U0**2 * T1 / 3)
