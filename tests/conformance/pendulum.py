"""Pendulum as a differential-algebraic system (Betts, example 10.103), and the same in its angle.

Unit mass on a unit rod, driven sideways to the rod by u, from horizontal rest to x = 0, x' = 0 in 3 s, least int u^2
dt: x'' = -2 z x + u y, y'' = -g - 2 z y - u x. The rod's force 2 z is that of x^2 + y^2 = 1 differentiated twice, 2 z
= x'^2 + y'^2 - g y: z is a control tied by a path equality. Its bounds matter: a swing up to the top costs 6.467 but
needs z = 20.5 and a speed of 5.6. In the angle, x = cos a: a'' = -g cos a - u, and the end is a = -pi/2. The initial
costates were found by shooting. Betts, Practical Methods for Optimal Control, 3rd ed. 2020: 12.8738850.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import pi

import casadi as ca
import numpy as np

from ocp import Problem

from .case import Array, Case, Extremal, legendre, radau, shooting, within
from .flow import flow

G = 9.81
HORIZON = 3.0
COST = 12.8738888777096
COSTATE_AT_START = (54.67128267461884, 13.10630039966066, 11.68350733253824, 0.2769958876541763)
ANGLE_COSTATE_AT_START = (13.10630039966069, 0.27699588765432)


def build() -> Problem:
    problem = Problem("pendulum as DAE")
    x = problem.state("x", initial=1.0, terminal=0.0, lower=-5.0, upper=5.0)
    y = problem.state("y", initial=0.0, lower=-5.0, upper=5.0, guess=lambda t: -t / HORIZON)
    vx = problem.state("vx", initial=0.0, terminal=0.0, lower=-5.0, upper=5.0)
    vy = problem.state("vy", initial=0.0, lower=-5.0, upper=5.0)
    u = problem.control("u")
    z = problem.control("z", lower=-1.0, upper=15.0)
    problem.horizon(HORIZON)
    problem.dynamics(x, vx)
    problem.dynamics(y, vy)
    problem.dynamics(vx, -2 * z * x + u * y)
    problem.dynamics(vy, -G - 2 * z * y - u * x)
    problem.path("rod", vx**2 + vy**2 - 2 * z - G * y, lower=0.0, upper=0.0)
    problem.minimize(running=u**2)
    return problem


def build_in_angle() -> Problem:
    problem = Problem("pendulum in its angle")
    a = problem.state("a", initial=0.0, terminal=-pi / 2)
    w = problem.state("w", initial=0.0, terminal=0.0)
    u = problem.control("u")
    problem.horizon(HORIZON)
    problem.dynamics(a, w)
    problem.dynamics(w, -G * ca.cos(a) - u)
    problem.minimize(running=u**2)
    return problem


def canonical(t: float, s: Array) -> Sequence[float]:
    x, y, vx, vy, lx, ly, lvx, lvy = s
    u = (lvy * x - lvx * y) / 2
    z2 = vx**2 + vy**2 - G * y
    radial = lvx * x + lvy * y  # z2 is a function of the state: its derivatives pull along the rod
    return (
        vx,
        vy,
        -z2 * x + u * y,
        -G - z2 * y - u * x,
        lvx * z2 + lvy * u,
        lvy * z2 - lvx * u - G * radial,
        2 * vx * radial - lx,
        2 * vy * radial - ly,
    )


def canonical_in_angle(t: float, s: Array) -> Sequence[float]:
    a, w, la, lw = s
    return (w, -G * np.cos(a) - lw / 2, -lw * G * np.sin(a), -la)


EXTREMAL = flow(canonical, (1.0, 0.0, 0.0, 0.0, *COSTATE_AT_START), (0.0, HORIZON))
EXTREMAL_IN_ANGLE = flow(canonical_in_angle, (0.0, 0.0, *ANGLE_COSTATE_AT_START), (0.0, HORIZON))


def optimum(t: Array) -> Extremal:
    x, y, vx, vy, lx, ly, lvx, lvy = EXTREMAL(t)
    return Extremal(
        state={"x": x, "y": y, "vx": vx, "vy": vy},
        control={"u": (lvy * x - lvx * y) / 2, "z": (vx**2 + vy**2 - G * y) / 2},
        costate={"x": lx, "y": ly, "vx": lvx, "vy": lvy},
    )


def optimum_in_angle(t: Array) -> Extremal:
    a, w, la, lw = EXTREMAL_IN_ANGLE(t)
    return Extremal(state={"a": a, "w": w}, control={"u": lw / 2}, costate={"a": la, "w": lw})


RUNS = (
    # no shooting: z held or linear over an interval meets the path equality at the nodes only
    *within(radau(20, degree=7), cost=(1e-9, 1e-9), state=5e-7, control=1e-4, costate=5e-4),
    *within(legendre(30, degree=4), cost=(2e-6, 2e-6), state=5e-5, control=2e-3, costate=2e-3),
)
CASE = Case("pendulum as DAE", build, COST, RUNS, horizon=HORIZON, optimum=optimum)

RUNS_IN_ANGLE = (
    *within(radau(20, degree=7), cost=(1e-10, 1e-10), state=1e-8, control=5e-7, costate=1e-5),
    *within(legendre(30, degree=4), cost=(2e-9, 2e-9), state=5e-6, control=1e-4, costate=1e-4),
    *within(shooting(60, "linear"), cost=(1e-6, 5e-4), state=1e-4, control=2e-2, costate=2e-3),
    *within(shooting(100, "held"), cost=(1e-6, 5e-2), state=3e-3, control=0.3, costate=0.1),
)
CASE_IN_ANGLE = Case(
    "pendulum in its angle", build_in_angle, COST, RUNS_IN_ANGLE, horizon=HORIZON, optimum=optimum_in_angle
)
