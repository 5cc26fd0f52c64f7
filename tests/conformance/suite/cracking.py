"""Catalytic cracking of gas oil: three rates from 21 measurements.

y1' = -(a + c) y1^2, y2' = a y1^2 - b y2; least sum of squares. PSOPT (example cracking) seeks the states at the start
as well, COPS 3 (problem 12, gasoil) knows them to be (1, 0). Tjoa & Biegler, 1991.
"""

from __future__ import annotations

from functools import partial
from typing import Any

import casadi as ca
import numpy as np

from ocp import Collocation, Phases, Problem

from .entry import COPS, PSOPT, Entry
from .estimation import estimation

TIMES = [0, 0.025, 0.05, 0.075, 0.1, 0.125, 0.15, 0.175, 0.2, 0.225, 0.25, 0.3, 0.35, 0.4, 0.45, 0.5, 0.55, 0.65, 0.75,
         0.85, 0.95]  # fmt: skip
DATA = np.array([
    [1.0, 0.8105, 0.6208, 0.5258, 0.4345, 0.3903, 0.3342, 0.3034, 0.2735, 0.2405, 0.2283, 0.2071, 0.1669, 0.153,
     0.1339, 0.1265, 0.12, 0.099, 0.087, 0.077, 0.069],
    [0.0, 0.2, 0.2886, 0.301, 0.3215, 0.3123, 0.2716, 0.2551, 0.2258, 0.1959, 0.1789, 0.1457, 0.1198, 0.0909, 0.0719,
     0.0561, 0.046, 0.028, 0.019, 0.014, 0.01],
]).T  # fmt: skip


def rates(problem: Problem, y: Any) -> Any:
    a, b, c = (problem.free_parameter(name, lower=0.0, upper=20.0, guess=5.0) for name in "abc")
    return ca.vertcat(-(a + c) * y[0] ** 2, a * y[0] ** 2 - b * y[1])


def build(initial: list[float] | None) -> Phases:
    return estimation("gas oil", TIMES, DATA, rates, states=2, initial=initial, lower=0.0)


FIRST, SECOND = Collocation(2, 4), Collocation(3, 3, "legendre")
ENTRIES = (
    Entry("cracking", (PSOPT,), partial(build, None), {PSOPT: 5.228971e-3}, None, FIRST, SECOND),
    Entry("gasoil", (COPS,), partial(build, [1.0, 0.0]), {COPS: 5.2366e-3}, None, FIRST, SECOND),
)
