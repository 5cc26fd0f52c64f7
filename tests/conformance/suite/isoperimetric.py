"""Isoperimetric constraint: given control energy.

x' = -sin x + u, |u| <= 4, from 1 to 0 in 1 s, int u^2 dt = 10, least int x dt. PROPT manual; PSOPT, example
isoperimetric.
"""

from __future__ import annotations

import casadi as ca

from ocp import Collocation, Problem

from .entry import PSOPT, Entry


def build() -> Problem:
    problem = Problem("isoperimetric")
    x = problem.state("x", initial=1.0, terminal=0.0, lower=-10.0, upper=10.0, guess=0.0)
    u = problem.control("u", lower=-4.0, upper=4.0, guess=0.0)
    problem.horizon(1.0)
    problem.dynamics(x, -ca.sin(x) + u)
    problem.integral("energy", u**2, 10.0, 10.0)
    problem.minimize(running=x)
    return problem


ENTRY = Entry("isoperimetric", (PSOPT,), build, {PSOPT: -0.3755057}, method=Collocation(20, 5))
