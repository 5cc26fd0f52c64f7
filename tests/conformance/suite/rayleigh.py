"""Rayleigh's tunnel-diode oscillator with a mixed constraint of control and state.

x1' = x2, x2' = -x1 + (1.4 - 0.14 x2^2) x2 + 4 u, u + x1 / 6 <= 0, from (-5, -5), 4.5 s, least int u^2 + x1^2 dt. Betts,
2010; PSOPT, example rayleigh. Without the constraint it is `tests.conformance.rayleigh`.
"""

from __future__ import annotations

from ocp import Collocation, Problem

from .entry import PSOPT, Entry


def build() -> Problem:
    problem = Problem("Rayleigh, mixed constraint")
    x1 = problem.state("x1", initial=-5.0, lower=-10.0, upper=10.0, guess=-5.0)
    x2 = problem.state("x2", initial=-5.0, lower=-10.0, upper=10.0, guess=-5.0)
    u = problem.control("u", lower=-10.0, upper=10.0, guess=0.0)
    problem.horizon(4.5)
    problem.dynamics(x1, x2)
    problem.dynamics(x2, -x1 + (1.4 - 0.14 * x2**2) * x2 + 4 * u)
    problem.path("mixed", u + x1 / 6, upper=0.0)
    problem.minimize(running=u**2 + x1**2)
    return problem


ENTRY = Entry("rayleigh", (PSOPT,), build, {PSOPT: 44.77625}, method=Collocation(40, 4))
