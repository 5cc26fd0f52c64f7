"""A car too weak for a hill swings itself up in least time.

x' = v, v' = 0.001 u - 0.0025 cos 3 x, |u| <= 1, |v| <= 0.07, -1.2 <= x <= 0.5, from rest at -0.5 to x = 0.5 with v >=
0. Dymos, example mountain car; OptimalControlProblems.jl, mountain_car, begins at 10 s, far from any
motion that reaches the top; the guess here swings.
"""

from __future__ import annotations

import casadi as ca

from ocp import Collocation, Problem

from .entry import TOOLBOX, Entry, samples

TIMES, PLACES = [0.0, 25.0, 65.0, 100.0], [-0.5, -0.1, -1.0, 0.5]


def build() -> Problem:
    problem = Problem("mountain car")
    x = problem.state("x", initial=-0.5, terminal=0.5, lower=-1.2, upper=0.5, guess=samples(TIMES, PLACES))
    v = problem.state("v", initial=0.0, lower=-0.07, upper=0.07, guess=0.0)
    u = problem.control("u", lower=-1.0, upper=1.0, guess=lambda t: -1.0 if 25 < t < 65 else 1.0)
    horizon = problem.horizon(lower=0.1, upper=500.0, guess=100.0)
    problem.dynamics(x, v)
    problem.dynamics(v, 0.001 * u - 0.0025 * ca.cos(3 * x))
    problem.end("forwards", v, lower=0.0)
    problem.minimize(terminal=horizon)
    return problem


ENTRY = Entry(
    "mountain_car", (TOOLBOX,), build, method=Collocation(60, 3),
    second=Collocation(85, 3, "legendre"),
)  # fmt: skip
