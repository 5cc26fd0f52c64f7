"""Double integrator whose acceleration changes by at most 4 a second.

x' = v, v' = u, u' = w, |w| <= 4, from (0, 0, 0) to (1, 0) in 2 s, least int u^2 dt. The rate of the control is the
control. PSOPT, example control_rate.
"""

from __future__ import annotations

from ocp import Problem

from .entry import PSOPT, Entry

LIMIT = 4.0


def build() -> Problem:
    problem = Problem("control rate")
    x = problem.state("x", initial=0.0, terminal=1.0, lower=-5.0, upper=5.0)
    v = problem.state("v", initial=0.0, terminal=0.0, lower=-5.0, upper=5.0)
    u = problem.state("u", initial=0.0, lower=-10.0, upper=10.0)
    w = problem.control("w", lower=-LIMIT, upper=LIMIT)
    problem.horizon(2.0)
    problem.dynamics(x, v)
    problem.dynamics(v, u)
    problem.dynamics(u, w)
    problem.minimize(running=u**2)
    return problem


ENTRY = Entry("control_rate", (PSOPT,), build, {PSOPT: 1.846315})
