"""Marine population dynamics: growth and mortality of eight stages from 21 counts.

y_i' = g_(i-1) y_(i-1) - (m_i + g_i) y_i with g_0 = g_8 = 0: 15 rates, and the counts at the start, are sought. Counts
in thousands. Rothschild, Sharov, Kearsley & Bondarenko, 1997; COPS 3, problem 6, whose cost in counts is 1e6 times
this.
"""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np

from ocp import Collocation, Phases, Problem

from .entry import COPS, Entry
from .estimation import estimation

TIMES = np.linspace(0.0, 10.0, 21).tolist()
COUNTS = np.array([
    [20000, 17000, 10000, 15000, 12000, 9000, 7000, 3000], [12445, 15411, 13040, 13338, 13484, 8426, 6615, 4022],
    [7705, 13074, 14623, 11976, 12453, 9272, 6891, 5020], [4664, 8579, 12434, 12603, 11738, 9710, 6821, 5722],
    [2977, 7053, 11219, 11340, 13665, 8534, 6242, 5695], [1769, 5054, 10065, 11232, 12112, 9600, 6647, 7034],
    [943, 3907, 9473, 10334, 11115, 8826, 6842, 7348], [581, 2624, 7421, 10297, 12427, 8747, 7199, 7684],
    [355, 1744, 5369, 7748, 10057, 8698, 6542, 7410], [223, 1272, 4713, 6869, 9564, 8766, 6810, 6961],
    [137, 821, 3451, 6050, 8671, 8291, 6827, 7525], [87, 577, 2649, 5454, 8430, 7411, 6423, 8388],
    [49, 337, 2058, 4115, 7435, 7627, 6268, 7189], [32, 228, 1440, 3790, 6474, 6658, 5859, 7467],
    [17, 168, 1178, 3087, 6524, 5880, 5562, 7144], [11, 99, 919, 2596, 5360, 5762, 4480, 7256],
    [7, 65, 647, 1873, 4556, 5058, 4944, 7538], [4, 44, 509, 1571, 4009, 4527, 4233, 6649],
    [2, 27, 345, 1227, 3677, 4229, 3805, 6378], [1, 20, 231, 934, 3197, 3695, 3159, 6454],
    [1, 12, 198, 707, 2562, 3163, 3232, 5566],
])  # fmt: skip


def rates(problem: Problem, y: Any) -> Any:
    g = problem.free_parameter("g", 7, lower=0.0, guess=0.5)
    m = problem.free_parameter("m", 8, lower=0.0, guess=0.1)
    onwards = g * y[:7]
    return ca.vertcat(0, onwards) - ca.vertcat(onwards, 0) - m * y


def build() -> Phases:
    return estimation("marine population", TIMES, COUNTS / 1000, rates, states=8)


ENTRY = Entry("marine", (COPS,), build, {COPS: 19.7465}, method=Collocation(2, 3), second=Collocation(3, 3, "legendre"))
