"""Lambert's problem: the orbit between two places in a given time.

r'' = -mu r / |r|^3 from (15945.34, 0, 0) km to (12214.83899, 10249.46731, 0) km in 76 min, without a cost. Vallado,
Fundamentals of Astrodynamics and Applications, 2001, example 7-5; PSOPT, example lambert, with mu = 6.6720e-11
5.9742e24.
"""

from __future__ import annotations

import casadi as ca

from ocp import Collocation, Problem

from .entry import PSOPT, Entry, line

MU = 6.6720e-11 * 5.9742e24 * 1e-9  # km^3/s^2
START, END, DURATION = [15945.34, 0.0, 0.0], [12214.83899, 10249.46731, 0.0], 76 * 60.0


def build() -> Problem:
    problem = Problem("Lambert")
    r = problem.state("r", initial=START, terminal=END, unit="km", scale=1e4)
    v = problem.state(
        "v", 3, guess=line([s / DURATION for s in START], [s / DURATION for s in END], DURATION), unit="km/s", scale=1.0
    )
    problem.horizon(DURATION)
    problem.dynamics(r, v)
    problem.dynamics(v, -MU * r / ca.norm_2(r) ** 3)
    problem.minimize()
    return problem


ENTRY = Entry("lambert", (PSOPT,), build, {PSOPT: 0.0}, 0.0, method=Collocation(20, 4))
