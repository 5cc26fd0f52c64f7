"""Bolza problem with free final time: time against energy.

x' = u, x from 0 to 1 in a free time T > 0, least T + int u^2 / 2 dt. The control is constant, 1/T, and T + 1/(2 T) is
least at T = 1/sqrt 2: cost sqrt 2, costate -u = -sqrt 2.
"""

from __future__ import annotations

from math import sqrt

import numpy as np

from ocp import Problem

from .case import Array, Case, Extremal, legendre, radau, shooting, within


def build() -> Problem:
    problem = Problem("Bolza, free time")
    x = problem.state("x", initial=0.0, terminal=1.0)
    u = problem.control("u")
    horizon = problem.horizon(lower=0.01, upper=10.0, guess=2.0)
    problem.dynamics(x, u)
    problem.minimize(running=u**2 / 2, terminal=horizon)
    return problem


def optimum(t: Array) -> Extremal:
    return Extremal(
        state={"x": sqrt(2) * t}, control={"u": np.full_like(t, sqrt(2))}, costate={"x": np.full_like(t, -sqrt(2))}
    )


RUNS = (
    # a constant control: every method holds the optimum exactly
    *within(
        radau(5),
        legendre(5),
        shooting(5, "held"),
        shooting(5, "linear"),
        cost=(1e-11, 1e-11),
        state=1e-11,
        control=1e-10,
        costate=1e-10,
        time=1e-10,
    ),
)
CASE = Case("Bolza, free time", build, sqrt(2), RUNS, horizon=1 / sqrt(2), optimum=optimum)
