"""Length of a pendulum from 20 measurements, with its rod force as an algebraic variable.

x'' = F x, |x| = L, a system of index 3; the measurements are those of a motion without gravity with L = 1, (sin t, cos
t), so that the least sum of squares is zero. Differentiated twice, the constraint is F L^2 + |x'|^2 = 0, which contains
F; it and its derivative hold at the start: so the index is reduced to 1. Schittkowski, 2002; PSOPT, example dae_i3.
"""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np

from ocp import Collocation, Phases, Problem

from .entry import PSOPT, Entry
from .estimation import estimation

TIMES = np.arange(0.5, 10.01, 0.5)
DATA = np.column_stack([np.sin(TIMES + 0.5), np.cos(TIMES + 0.5)])


def rates(problem: Problem, y: Any) -> Any:
    force = problem.control("F", lower=-10.0, upper=10.0, guess=0.0)
    length = problem.free_parameter("L", lower=0.05, upper=5.0, guess=0.5)
    problem.path("rod", force * length**2 + y[2] ** 2 + y[3] ** 2, 0.0, 0.0)
    return ca.vertcat(y[2], y[3], force * y[0], force * y[1])


def build() -> Phases:
    guess = np.hstack([DATA, np.gradient(DATA, TIMES, axis=0)])
    phases = estimation("pendulum", TIMES.tolist(), DATA, rates, states=4, guess=guess)
    y, length = phases["p0"].at_start("y"), phases["p0"].at_start("L")
    phases.end("length at the start", y[0] ** 2 + y[1] ** 2 - length**2, 0.0, 0.0)
    phases.end("rate of the length at the start", y[0] * y[2] + y[1] * y[3], 0.0, 0.0)
    return phases


ENTRY = Entry(
    "dae_i3", (PSOPT,), build, {PSOPT: 2.4e-18}, 0.0, method=Collocation(2, 4), second=Collocation(3, 3, "legendre")
)
