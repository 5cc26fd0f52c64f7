"""Soft lander (Meditch): fall free, then brake at full thrust.

h' = v, v' = u - 1.5, from h = 10, v = -2 to rest on the ground, 0 <= u <= 3, least int u dt, free final time. The
engine fires at t1, the root of 1.5 t1^2 + 4 t1 = 26/3; it burns for t1 + 4/3, so the cost is 3 t1 + 4 = sqrt 68. The
costate of v is -1 at the switch, and H = 0 there gives that of h. Meditch, IEEE Trans. Automatic Control 9, 1964.
"""

from __future__ import annotations

from math import sqrt

import numpy as np

from ocp import Problem

from .case import Array, Case, Extremal, Switch, fitted, held, radau, within

GRAVITY, THRUST = 1.5, 3.0
T1 = (sqrt(68) - 4) / 3
HORIZON = 2 * T1 + 4 / 3
LH = 3 / sqrt(68)
MESH = fitted((T1 / HORIZON,), 20)


def build() -> Problem:
    problem = Problem("soft lander")
    h = problem.state("h", initial=10.0, terminal=0.0)
    v = problem.state("v", initial=-2.0, terminal=0.0)
    u = problem.control("u", lower=0.0, upper=THRUST)
    problem.horizon(lower=0.5, upper=20.0, guess=5.0)
    problem.dynamics(h, v)
    problem.dynamics(v, u - GRAVITY)
    problem.minimize(running=u)
    return problem


def optimum(t: Array) -> Extremal:
    left = HORIZON - t
    brake = THRUST - GRAVITY
    return Extremal(
        state={
            "h": np.where(t < T1, 10 - 2 * t - GRAVITY * t**2 / 2, brake * left**2 / 2),
            "v": np.where(t < T1, -2 - GRAVITY * t, -brake * left),
        },
        control={"u": np.where(t < T1, 0.0, THRUST)},
        costate={"h": np.full_like(t, LH), "v": -1 - LH * (t - T1)},
    )


RUNS = (
    # held controls: both quadratures are exact, so every plan is admissible and none beats the optimum. The
    # costate is known to an interval only: a switching function with its zero a little aside switches alike
    *within(*held(50), cost=(1e-8, 1e-4), state=5e-3, control=5e-8, costate=0.05, time=0.05),
    # the switch on a node
    *within(*held(MESH), cost=(1e-8, 1e-8), state=1e-8, control=5e-8, costate=0.05, time=0.15),
    # a polynomial across the switch overshoots between its points and beats the optimum, here by 3.0e-5
    *within(radau(51), cost=(1e-4, 0.0), state=2e-2, control=1e-7, costate=0.02, time=0.05),
)
CASE = Case(
    "soft lander",
    build,
    sqrt(68),
    RUNS,
    horizon=HORIZON,
    optimum=optimum,
    switches=(Switch(T1, lambda x, lam: 1 + lam["v"]),),
)
