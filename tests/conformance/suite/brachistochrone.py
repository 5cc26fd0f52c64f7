"""Brachistochrone to a point 2 m across and 2 m down, the cycloid of `tests.conformance.brachistochrone`.

x' = v sin theta, y' = v cos theta, v' = g cos theta from rest at the origin, g = 9.8 m/s^2, least time. Bryson & Ho,
1975; PSOPT, example brac1. Radau points, of which one is at the end, end from this guess in a weak local minimum that
falls along the bound theta = 2 pi at last (0.8269 s). The audit finds that other controls lower its Hamiltonian.
"""

from __future__ import annotations

from math import cos, pi, sin, sqrt

import casadi as ca
from scipy.optimize import brentq

from ocp import Collocation, Indirect, Problem

from .entry import PSOPT, Entry, line

GRAVITY, END = 9.8, 2.0
P = float(brentq(lambda p: (p - sin(p)) - (1 - cos(p)), 1.0, 6.0, xtol=1e-15))  # the turn of the rolling circle
OPTIMUM = P * sqrt(END / (1 - cos(P)) / GRAVITY)


def build() -> Problem:
    problem = Problem("brachistochrone to (2, 2)")
    x = problem.state("x", initial=0.0, terminal=END, guess=line(0.0, 1.0, 2.0))
    y = problem.state("y", initial=0.0, terminal=END, guess=line(0.0, 1.0, 2.0))
    v = problem.state("v", initial=0.0, guess=line(0.0, 1.0, 2.0))
    theta = problem.control("theta", lower=0.0, upper=2 * pi, guess=1.0)
    horizon = problem.horizon(lower=0.01, upper=10.0, guess=2.0)
    problem.dynamics(x, v * ca.sin(theta))
    problem.dynamics(y, v * ca.cos(theta))
    problem.dynamics(v, GRAVITY * ca.cos(theta))
    problem.minimize(terminal=horizon)
    return problem


ENTRY = Entry(
    "brac1", (PSOPT,), build, {PSOPT: 0.8247591}, OPTIMUM, method=Collocation(20, 4, "legendre"),
    second=Indirect(),
)  # fmt: skip
