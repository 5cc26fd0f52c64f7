"""Least time with a chance constraint on the velocity, whose covariance grows by process noise.

x' = v, v' = u, |u| <= 1, from rest at 0 to rest at 1; the covariance P obeys P11' = 2 P12, P12' = P22, P22' = 0.05 from
zero, and v <= 1.1 with probability 0.95: v + 1.6449 sqrt(P22 + 0.0025) <= 1.1. PSOPT, example chance_covariance.
"""

from __future__ import annotations

import casadi as ca

from ocp import Collocation, Problem

from .entry import PSOPT, Entry, line

NOISE, QUANTILE, LIMIT, SMOOTHING = 0.05, 1.6449, 1.10, 2.5e-3


def build() -> Problem:
    problem = Problem("chance constraint with covariance")
    x = problem.state("x", initial=0.0, terminal=1.0, lower=-5.0, upper=5.0, guess=line(0.0, 1.0, 3.0))
    v = problem.state("v", initial=0.0, terminal=0.0, lower=-5.0, upper=5.0, guess=0.0)
    p = problem.state("P", initial=[0.0, 0.0, 0.0], lower=[0.0, -1.0, 0.0], upper=2.0, guess=0.0)
    u = problem.control("u", lower=-1.0, upper=1.0, guess=0.0)
    horizon = problem.horizon(lower=0.5, upper=10.0, guess=3.0)
    problem.dynamics(x, v)
    problem.dynamics(v, u)
    problem.dynamics(p, ca.vertcat(2 * p[1], p[2], NOISE))
    problem.path("chance constraint", v + QUANTILE * ca.sqrt(p[2] + SMOOTHING), upper=LIMIT)
    problem.minimize(terminal=horizon)
    return problem


ENTRY = Entry(
    "chance_covariance", (PSOPT,), build, {PSOPT: 2.122454}, method=Collocation(40, 3),
    second=Collocation(57, 3, "legendre"),
)  # fmt: skip
