"""Breakwell's problem: a double integrator turned round below a ceiling of 0.1.

`tests.conformance.bryson_denham` with l = 0.1 in place of 1/9: the cost is 4 / (9 l), and twice that for int u^2 dt.
PSOPT, example breakwell; Bocop and OptimalControlProblems.jl, beam.
"""

from __future__ import annotations

from functools import partial

from ocp import Collocation, Problem

from .entry import PSOPT, TOOLBOX, Entry

CEILING = 0.1


def build(weight: float) -> Problem:
    problem = Problem("Breakwell")
    x = problem.state("x", initial=0.0, terminal=0.0, lower=-2.0, upper=CEILING, guess=0.0)
    v = problem.state("v", initial=1.0, terminal=-1.0, lower=-2.0, upper=2.0, guess=1.0)
    u = problem.control("u", lower=-10.0, upper=10.0, guess=0.0)
    problem.horizon(1.0)
    problem.dynamics(x, v)
    problem.dynamics(v, u)
    problem.minimize(running=weight * u**2)
    return problem


ENTRIES = (
    Entry("breakwell", (PSOPT,), partial(build, 0.5), {PSOPT: 4.444439}, 4 / (9 * CEILING), Collocation(40, 3)),
    Entry("beam", (TOOLBOX,), partial(build, 1.0), {TOOLBOX: 8.8913352}, 8 / (9 * CEILING), Collocation(40, 3)),
)
