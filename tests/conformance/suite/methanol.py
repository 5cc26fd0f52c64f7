"""Methanol to hydrocarbons: five rates from 16 measurements.

y1' = -(2 b - a y2 / d + c + e) y1, y2' = a y1 (b y1 - y2) / d + c y1, y3' = a y1 (y2 + f y1) / d + e y1 with d = (b +
f) y1 + y2, from (1, 0, 0). Maria, 1989; COPS 3, problem 13.
"""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np

from ocp import Collocation, Phases, Problem

from .entry import COPS, Entry
from .estimation import estimation

TIMES = [0, 0.050, 0.065, 0.080, 0.123, 0.233, 0.273, 0.354, 0.397, 0.418, 0.502, 0.553, 0.681, 0.750, 0.916, 0.937,
         1.122]  # fmt: skip
DATA = np.array([
    [1.0, 0.7085, 0.5971, 0.5537, 0.3684, 0.1712, 0.1198, 0.0747, 0.0529, 0.0415, 0.0261, 0.0208, 0.0085, 0.0053,
     0.0019, 0.0018, 0.0006],
    [0.0, 0.1621, 0.1855, 0.1989, 0.2845, 0.3491, 0.3098, 0.3576, 0.3347, 0.3388, 0.3557, 0.3483, 0.3836, 0.3611,
     0.3609, 0.3485, 0.3698],
    [0.0, 0.0811, 0.0965, 0.1198, 0.1535, 0.2097, 0.2628, 0.2467, 0.2884, 0.2757, 0.3167, 0.2954, 0.2950, 0.2937,
     0.2831, 0.2846, 0.2899],
]).T  # fmt: skip


def rates(problem: Problem, y: Any) -> Any:
    a, b, c, e, f = (problem.free_parameter(name, lower=0.0, guess=1.0) for name in ("a", "b", "c", "e", "f"))
    share = a * y[0] / ((b + f) * y[0] + y[1])
    return ca.vertcat(
        -(2 * b + c + e) * y[0] + share * y[1],
        share * (b * y[0] - y[1]) + c * y[0],
        share * (y[1] + f * y[0]) + e * y[0],
    )


def build() -> Phases:
    return estimation("methanol", TIMES, DATA, rates, states=3, initial=[1.0, 0.0, 0.0])


ENTRY = Entry(
    "methanol", (COPS,), build, {COPS: 9.0223e-3}, method=Collocation(3, 4), second=Collocation(4, 3, "legendre")
)
