"""Linear regulator between two values.

x' = u from 1 to 1/2 in 2 s, least int (x^2 + u^2) / 2 dt. The extremal is x'' = x, and the cost is
((x0^2 + x1^2) cosh T - 2 x0 x1) / (2 sinh T). PSOPT, examples lqr_gauss and lqr_radau.
"""

from __future__ import annotations

from math import cosh, sinh

from ocp import Collocation, Problem

from .entry import PSOPT, Entry

START, END, DURATION = 1.0, 0.5, 2.0


def build() -> Problem:
    problem = Problem("linear regulator")
    x = problem.state("x", initial=START, terminal=END, lower=-50.0, upper=50.0)
    u = problem.control("u", lower=-50.0, upper=50.0)
    problem.horizon(DURATION)
    problem.dynamics(x, u)
    problem.minimize(running=(x**2 + u**2) / 2)
    return problem


OPTIMUM = ((START**2 + END**2) * cosh(DURATION) - 2 * START * END) / (2 * sinh(DURATION))
ENTRY = Entry("lqr_gauss", (PSOPT,), build, {PSOPT: 0.5104614}, exact=OPTIMUM, method=Collocation(10, 4))
