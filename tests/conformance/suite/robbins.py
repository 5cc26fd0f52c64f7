"""Robbins' problem: a state constraint of third order, whose boundary the optimum touches infinitely often.

x' = v, v' = a, a' = u, x >= 0, from (1, -2, 0) to rest at 0 in 10 s, least int 3 x + u^2 / 2 dt. Robbins, 1980; Bocop;
OptimalControlProblems.jl, robbins.
"""

from __future__ import annotations

from ocp import Collocation, Problem

from .entry import TOOLBOX, Entry


def build() -> Problem:
    problem = Problem("Robbins")
    x = problem.state("x", initial=1.0, terminal=0.0, lower=0.0, guess=0.1)
    v = problem.state("v", initial=-2.0, terminal=0.0, guess=0.1)
    a = problem.state("a", initial=0.0, terminal=0.0, guess=0.1)
    u = problem.control("u", guess=0.1)
    problem.horizon(10.0)
    problem.dynamics(x, v)
    problem.dynamics(v, a)
    problem.dynamics(a, u)
    problem.minimize(running=3 * x + u**2 / 2)
    return problem


ENTRY = Entry(
    "robbins", (TOOLBOX,), build, {"CTDirect": "19.4"}, method=Collocation(60, 4), second=Collocation(85, 3, "legendre")
)
