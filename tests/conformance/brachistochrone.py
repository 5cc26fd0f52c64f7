"""Brachistochrone: the fastest slide from rest, 10 m across and 5 m down.

x' = v sin a, y' = v cos a (y down), v' = g cos a. The curve is a cycloid of radius R, x = R (p - sin p), y = R (1 -
cos p), with p = sqrt(g/R) t and a = p/2. The costates follow from H = 0 and dH/da = 0: lx = -sin a / v, ly + lv g / v
= -cos a / v.
"""

from __future__ import annotations

from math import cos, pi, sin, sqrt

import casadi as ca
import numpy as np
from scipy.optimize import brentq

from ocp import Problem

from .case import Array, Case, Extremal, legendre, radau, shooting, within

ACROSS, DOWN, G = 10.0, 5.0, 9.80665
P = float(brentq(lambda p: (p - sin(p)) / (1 - cos(p)) - ACROSS / DOWN, 1.0, 6.0, xtol=1e-15, rtol=1e-15))
R = DOWN / (1 - cos(P))
HORIZON = P * sqrt(R / G)


def build() -> Problem:
    problem = Problem("brachistochrone")
    x = problem.state("x", initial=0.0, terminal=ACROSS, guess=lambda t: ACROSS * t / 2)
    y = problem.state("y", initial=0.0, terminal=DOWN, guess=lambda t: DOWN * t / 2)
    v = problem.state("v", initial=0.0, guess=lambda t: G * t / 2)
    a = problem.control("a", lower=0.0, upper=pi, guess=lambda t: 0.1 + 0.7 * t)
    horizon = problem.horizon(lower=0.5, upper=10.0, guess=2.0)
    problem.dynamics(x, v * ca.sin(a))
    problem.dynamics(y, v * ca.cos(a))
    problem.dynamics(v, G * ca.cos(a))
    problem.minimize(terminal=horizon)
    return problem


def optimum(t: Array) -> Extremal:
    p = sqrt(G / R) * t
    v = 2 * sqrt(G * R) * np.sin(p / 2)
    lx = -1 / (2 * sqrt(G * R))
    ly = -cos(P / 2) / (2 * sqrt(G * R) * sin(P / 2))  # lv vanishes at the end, where v is free
    return Extremal(
        state={"x": R * (p - np.sin(p)), "y": R * (1 - np.cos(p)), "v": v},
        control={"a": p / 2},
        costate={"x": np.full_like(t, lx), "y": np.full_like(t, ly), "v": -(np.cos(p / 2) + ly * v) / G},
    )


RUNS = (
    *within(
        radau(30, degree=5),
        legendre(30, degree=4),
        cost=(1e-12, 1e-12),
        state=1e-8,
        control=2e-6,
        costate=2e-9,
        time=1e-12,
    ),
    *within(shooting(50, "linear"), cost=(1e-8, 1e-8), state=3e-7, control=2e-4, costate=2e-7, time=1e-8),
    *within(shooting(50, "held"), cost=(1e-8, 3e-4), state=2e-3, control=0.02, costate=1e-4, time=3e-4),
)
CASE = Case("brachistochrone", build, HORIZON, RUNS, horizon=HORIZON, optimum=optimum)
