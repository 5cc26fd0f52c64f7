"""Isomerisation of alpha-pinene: five rates from eight measurements.

y1' = -(a + b) y1, y2' = a y1, y3' = b y1 - (c + d) y3 + e y5, y4' = c y3, y5' = d y3 - e y5, from (100, 0, 0, 0, 0);
time in units of 1e4 min. Box, Hunter, MacGregor & Erjavec, 1973; COPS 3, problem 5.
"""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np

from ocp import Collocation, Phases, Problem

from .entry import COPS, Entry
from .estimation import estimation

TIMES = [0.0, 0.1230, 0.3060, 0.4920, 0.7800, 1.0680, 1.5030, 2.2620, 3.6420]
START = [100.0, 0.0, 0.0, 0.0, 0.0]
DATA = np.array([
    START,
    [88.35, 7.3, 2.3, 0.4, 1.75], [76.4, 15.6, 4.5, 0.7, 2.8], [65.1, 23.1, 5.3, 1.1, 5.8],
    [50.4, 32.9, 6.0, 1.5, 9.3], [37.5, 42.7, 6.0, 1.9, 12.0], [25.9, 49.1, 5.9, 2.2, 17.0],
    [14.0, 57.4, 5.1, 2.6, 21.0], [4.5, 63.1, 3.8, 2.9, 25.7],
])  # fmt: skip


def rates(problem: Problem, y: Any) -> Any:
    a, b, c, d, e = (problem.free_parameter(name, lower=0.0, guess=0.5) for name in "abcde")
    return ca.vertcat(-(a + b) * y[0], a * y[0], b * y[0] - (c + d) * y[2] + e * y[4], c * y[2], d * y[2] - e * y[4])


def build() -> Phases:
    return estimation("alpha-pinene", TIMES, DATA, rates, states=5, initial=START)


ENTRY = Entry("pinene", (COPS,), build, {COPS: 19.872}, method=Collocation(4, 3), second=Collocation(6, 3, "legendre"))
