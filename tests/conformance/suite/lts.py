"""Linear tangent steering: the direction of a constant thrust that reaches a height and a speed in least time.

x'' = a cos u, y'' = a sin u, a = 100, |u| <= pi / 2, from rest to y = 5, x' = 45, y' = 0. The tangent of u is linear in
time. Bryson & Ho, 1975; Betts, 2010; PSOPT, example lts; COPS 3, problem 9 (steering).
"""

from __future__ import annotations

import casadi as ca
import numpy as np

from ocp import Collocation, Indirect, Problem

from .entry import COPS, PSOPT, TOOLBOX, Entry, line

ACCELERATION = 100.0


def build() -> Problem:
    problem = Problem("linear tangent steering")
    r = problem.state("r", initial=[0.0, 0.0], terminal=[np.nan, 5.0], guess=line([0.0, 0.0], [12.0, 5.0]))
    v = problem.state("v", initial=[0.0, 0.0], terminal=[45.0, 0.0], guess=line([0.0, 0.0], [45.0, 0.0]))
    u = problem.control("u", lower=-np.pi / 2, upper=np.pi / 2, guess=line(1.0, -1.0))
    horizon = problem.horizon(lower=0.1, upper=1.0, guess=1.0)
    problem.dynamics(r, v)
    problem.dynamics(v, ACCELERATION * ca.vertcat(ca.cos(u), ca.sin(u)))
    problem.minimize(terminal=horizon)
    return problem


ENTRY = Entry(
    "lts", (PSOPT, COPS, TOOLBOX), build, {PSOPT: 0.5545709, COPS: 0.55458}, method=Collocation(20, 4),
    second=Indirect(),
)  # fmt: skip
