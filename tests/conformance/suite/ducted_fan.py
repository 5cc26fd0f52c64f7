"""A planar ducted fan moved 1 m aside from hover to hover.

m x'' = u1 cos a - u2 sin a, m y'' = -m g + u1 sin a + u2 cos a, J a'' = r u1, |a| <= 30 deg, |u1| <= 5 N, 0 <= u2 <= 17
N, least int 2 u1^2 + u2^2 dt + 1000 T, free time T. Graichen & Petit, 2009; OptimalControlProblems.jl, ducted_fan.
"""

from __future__ import annotations

import casadi as ca
import numpy as np

from ocp import Collocation, Problem

from .entry import TOOLBOX, Entry

LEVER, INERTIA, MASS, WEIGHT, PRICE = 0.2, 0.05, 2.2, 4.0, 1000.0


def build() -> Problem:
    problem = Problem("ducted fan")
    place = problem.state("place", initial=[0.0, 0.0], terminal=[1.0, 0.0], unit="m")
    velocity = problem.state("velocity", initial=[0.0, 0.0], terminal=[0.0, 0.0], unit="m/s")
    tilt = np.deg2rad(30.0)
    a = problem.state("a", initial=0.0, terminal=0.0, lower=-tilt, upper=tilt, unit="rad")
    rate = problem.state("rate", initial=0.0, terminal=0.0, unit="rad/s")
    side = problem.control("u1", lower=-5.0, upper=5.0, unit="N")
    lift = problem.control("u2", lower=0.0, upper=17.0, guess=WEIGHT, unit="N")
    horizon = problem.horizon(lower=0.1, upper=20.0, guess=1.0)
    s, c = ca.sin(a), ca.cos(a)
    problem.dynamics(place, velocity)
    problem.dynamics(velocity, ca.vertcat(side * c - lift * s, -WEIGHT + side * s + lift * c) / MASS)
    problem.dynamics(a, rate)
    problem.dynamics(rate, LEVER * side / INERTIA)
    problem.minimize(running=2 * side**2 + lift**2, terminal=PRICE * horizon)
    return problem


ENTRY = Entry("ducted_fan", (TOOLBOX,), build, method=Collocation(50, 4), second=Collocation(71, 3, "legendre"))
