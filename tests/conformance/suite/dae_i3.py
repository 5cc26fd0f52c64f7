"""Length of a pendulum from 20 measurements, with its rod force as an algebraic variable: index 3.

x1'' = F x1, x2'' = F x2, x1^2 + x2^2 = L^2; the measurements are those of a motion without gravity with L = 1, (sin t,
cos t), so that the least sum of squares is zero. Schittkowski, 2002; PSOPT, example dae_i3.
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
    problem.path("rod", y[0] ** 2 + y[1] ** 2 - length**2, 0.0, 0.0)
    return ca.vertcat(y[2], y[3], force * y[0], force * y[1])


def build() -> Phases:
    guess = np.hstack([DATA, np.ones((len(TIMES), 2))])
    return estimation("pendulum", TIMES.tolist(), DATA, rates, states=4, guess=guess)


ENTRY = Entry(
    "dae_i3", (PSOPT,), build, {PSOPT: 2.4e-18}, 0.0, method=Collocation(2, 4), second=Collocation(3, 3, "legendre")
)
