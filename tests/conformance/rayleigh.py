"""Rayleigh's tunnel-diode oscillator, regulated.

x1' = x2, x2' = -x1 + (1.4 - 0.14 x2^2) x2 + 4 u from (-5, -5), 2.5 s, end free, least int x1^2 + u^2 dt; u = -2 l2.
The initial costate was found by shooting on l(2.5) = 0. Published: 29.3760796560.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from math import inf

import numpy as np

from ocp import Problem

from .case import Array, Case, Extremal, legendre, radau, shooting, within
from .flow import Flow, flow

HORIZON = 2.5
COSTATE_AT_START = (-8.737062564584093, -2.581398186091974)


def statement(name: str, horizon: float, limit: float) -> Problem:
    problem = Problem(name)
    x1 = problem.state("x1", initial=-5.0)
    x2 = problem.state("x2", initial=-5.0)
    u = problem.control("u", lower=-limit, upper=limit)
    problem.horizon(horizon)
    problem.dynamics(x1, x2)
    problem.dynamics(x2, -x1 + (1.4 - 0.14 * x2**2) * x2 + 4 * u)
    problem.minimize(running=x1**2 + u**2)
    return problem


def feedback(l2: Array, limit: float) -> Array:
    return np.clip(-2 * l2, -limit, limit)


def extremal(costate_at_start: tuple[float, float], horizon: float, limit: float) -> Flow:
    def canonical(t: float, y: Array) -> Sequence[float]:
        x1, x2, l1, l2 = y
        return (
            x2,
            -x1 + (1.4 - 0.14 * x2**2) * x2 + 4 * float(feedback(l2, limit)),
            -2 * x1 + l2,
            -l1 - l2 * (1.4 - 0.42 * x2**2),
        )

    return flow(canonical, (-5.0, -5.0, *costate_at_start), (0.0, horizon))


def build() -> Problem:
    return statement("Rayleigh", HORIZON, inf)


@cache
def free_extremal() -> Flow:
    return extremal(COSTATE_AT_START, HORIZON, inf)


def optimum(t: Array) -> Extremal:
    x1, x2, l1, l2 = free_extremal()(t)
    return Extremal(
        state={"x1": x1, "x2": x2},
        control={"u": feedback(l2, inf)},
        costate={"x1": l1, "x2": l2},
    )


CASE = Case(
    name="Rayleigh",
    build=build,
    cost=29.3760796559429,
    horizon=HORIZON,
    optimum=optimum,
    runs=(
        *within(radau(40, degree=7), cost=(1e-10, 1e-10), state=3e-7, control=5e-6, costate=2e-6),
        *within(legendre(60, degree=4), cost=(2e-9, 2e-9), state=3e-5, control=1e-3, costate=2e-5),
        *within(shooting(100, "linear", steps=4), cost=(1e-6, 5e-5), state=2e-4, control=0.1, costate=3e-5),
        *within(shooting(100, "held", steps=4), cost=(1e-6, 2e-2), state=5e-3, control=0.5, costate=5e-3),
    ),
)
