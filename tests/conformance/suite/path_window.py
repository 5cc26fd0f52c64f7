"""A limit of the velocity that holds from 0.35 s to 0.65 s only.

x' = v, v' = u, |u| <= 20, from (0, 0) to (1, 0) in 1 s, least int u^2 dt, v <= 1.3 within the window. Outside, the
limit is relaxed by 50 (1 - gate), where gate is a product of two sigmoids of steepness 200 / s: the statement of PSOPT,
example path_window.
"""

from __future__ import annotations

import casadi as ca

from ocp import Collocation, Problem

from .entry import PSOPT, Entry

BEGIN, END, LIMIT, STEEPNESS, RELAXATION = 0.35, 0.65, 1.30, 200.0, 50.0


def build() -> Problem:
    problem = Problem("path window")
    x = problem.state("x", initial=0.0, terminal=1.0, lower=-5.0, upper=5.0)
    v = problem.state("v", initial=0.0, terminal=0.0, lower=-5.0, upper=5.0)
    u = problem.control("u", lower=-20.0, upper=20.0)
    problem.horizon(1.0)
    problem.dynamics(x, v)
    problem.dynamics(v, u)
    t = problem.time
    gate = 1 / (1 + ca.exp(-STEEPNESS * (t - BEGIN))) / (1 + ca.exp(STEEPNESS * (t - END)))
    problem.path("limit within the window", v - LIMIT - RELAXATION * (1 - gate), upper=0.0)
    problem.minimize(running=u**2)
    return problem


ENTRY = Entry("path_window", (PSOPT,), build, {PSOPT: 12.97886}, method=Collocation(60, 4))
